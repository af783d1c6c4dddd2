#ifndef CBCT_CORE_METAL_H
#define CBCT_CORE_METAL_H

#include <stdint.h>

#include "core/correct/input.h"
#include "core/fdk.h"

/* The metal stage of core/recon/recon.c: see metal.c. Its list and its traces serve dense.c, too. */

/*
 * A voxel of metal, or of its rim: what lies so near and is so bright that it is the metal's blur, which goes with the
 * traces. The list is in order and may go to a file and come back.
 */
enum { METAL_CORE, METAL_RIM };
struct metal_voxel {
	uint32_t z, at; /* slice, and which voxel of it: y * nx + x */
	uint32_t kind;
	float value; /* 1/mm, of the first FDK */
};

/* Pixels first .. last of a row in the shadow of metal, or without counts. */
struct metal_trace {
	int view, row, first, last;
};

struct metal {
	struct metal_voxel *voxels; /* owned */
	size_t voxels_count;
	size_t found;   /* of the voxels, those that are not rim */
	float *beneath; /* [voxels_count], owned: what the volume has there while the metal is shown, or NULL */
	struct metal_trace *traces; /* owned; by view, row, column */
	size_t traces_count, traces_room;
	struct metal_trace *dark; /* owned: samples that have no counts, by view, row, column from metal_replace on */
	size_t dark_count, dark_room;
	size_t replaced; /* samples in traces */
	int views;       /* with any */
	bool filled;     /* metal_fill was there */
};
void metal_clear(struct metal *metal);

/* Data and scratch of the stage, all of it borrowed. */
struct metal_tools {
	const struct backend *backend;
	struct plan *plan;
	struct fdk *fdk;           /* nothing pending */
	struct stack *projections; /* a slot for each view */
	struct stack *batch;       /* of `slots` slots, for what is projected */
	int slots;                 /* metal_slots */
	struct volume *volume;     /* to work in: mask, then prior */
	const struct geometry *geometry;
	const struct grid *grid;
	double mu_water;           /* 1/mm */
	double pixel;              /* mm, at the isocentre */
	const struct input *input; /* absent views have no traces */
	const struct cancel *cancel;
};

struct correction_job;
/* Of a job with the slots of metal_slots to work in. */
struct metal_tools metal_tools_of(const struct correction_job *job);

/* Views that are projected in one go. */
static inline int metal_slots(const struct geometry *geometry)
{
	return fdk_batch_most(geometry->count);
}

/* Pixels first .. last of a row of this view have no counts above the dark. In any order of views. */
int metal_note_dark(struct metal *metal, int view, int row, int first, int last, struct error *err);

/*
 * The voxels of `from` that have at least the threshold (1/mm) beside another one that has, those around them that
 * belong to the same object, and its rim.
 */
int metal_find(struct metal *metal, const struct metal_tools *tools, struct volume *from, double threshold,
	       struct error *err);
/* Takes the list from where recon_found's bytes went; ERR_INVALID where it is none of this grid. */
int metal_put(struct metal *metal, const struct grid *grid, const void *bytes, size_t count, struct error *err);

/* The shadows of the list's voxels, and the samples without counts that touch them. */
int metal_find_traces(struct metal *metal, const struct metal_tools *tools, struct error *err);

/* Replaces them in the projections. After metal_find_traces. `list`: of the metal in the volume to work in. */
int metal_replace(struct metal *metal, struct metal *list, const struct metal_tools *tools, struct error *err);

/* First of the traces, in order, of this view or a later one. */
size_t metal_traces_from(const struct metal_trace *traces, size_t count, int view);
/* Adds the traces of another list. */
int metal_add_traces(struct metal *metal, const struct metal *other, struct error *err);
/* Traces that leave too little to the detector's edge to begin a line from go up to it. True if any does. */
bool metal_reach_edges(struct metal *metal, int columns);
/* Whether a trace covers the row's first column, and its last one. */
void metal_edges_of(const struct metal *metal, int view, int row, int columns, bool ret_covered[2]);
/*
 * Fills the traces with what tools->volume, an FDK volume that becomes a prior without the voxels of another list,
 * explains of them, and with lines of the difference to that: between what lies beside them, or to 0 at the detector's
 * edge, for a shadow of metal that is cut off says nothing of the object.
 */
int metal_fill(struct metal *metal, struct metal *without, const struct metal_tools *tools, struct error *err);

/* The list's voxels, on the grid `of`, whose centres lie outside of another grid. */
int metal_take_outside(const struct metal *all, const struct grid *of, const struct grid *grid,
		       struct metal *ret_outside, struct error *err);

/* FDK of all projections, in the order of their numbers, instead of what is in `to`. */
int metal_fdk(const struct metal_tools *tools, struct volume *to, struct error *err);

/* Reliability of the first volume in each place: see metal_blend.c. */
enum { METAL_LOW, METAL_HIGH, METAL_BANDS };
struct metal_doubt {
	float *first;          /* [z][y][x], owned: that volume, on the host */
	float *low;            /* likewise: the lower band of what was squared last */
	float *there;          /* likewise: how much of the means in the lower band there is */
	bool *hidden;          /* likewise: by metal and its blur */
	int cell[3], cells[3]; /* voxels a cell, and how many cells there are along the axes */
	float *expected[METAL_BANDS], *measured[METAL_BANDS]; /* [cells], owned: mean squares in each cell */
	bool cut;                                             /* metal lies at the grid's sides */
};
/* What it takes on the host while volumes are weighed. */
size_t metal_doubt_bytes(const struct grid *grid);
void metal_doubt_clear(struct metal_doubt *doubt);
/*
 * Before metal_replace: from the projections as they were measured and the volume `first`, FDK of them. through: where
 * their residuals come from, the same, or of a larger grid with FDK in its volume to work in; list: metal in that.
 * That volume, or `first` where it is the same, is the metal alone afterwards.
 */
int metal_doubt_make(struct metal_doubt *ret_doubt, const struct metal *metal, const struct metal_tools *tools,
		     struct volume *first, const struct metal_tools *through, struct metal *list, struct error *err);
/* The volume, FDK after metal_replace, with a part of the first one where that is the better one. */
int metal_doubt_blend(struct metal_doubt *doubt, const struct metal *metal, const struct metal_tools *tools,
		      struct volume *volume, struct error *err);

/*
 * Puts the metal into the volume: its own voxels as the first FDK had them, and in the rim what that had more. Then
 * back: the same bits as before.
 */
int metal_show(struct metal *metal, const struct metal_tools *tools, struct volume *volume, struct error *err);
int metal_hide(struct metal *metal, const struct metal_tools *tools, struct volume *volume, struct error *err);

/* Marks the rays of the shadows in the projections as RAY_LEFT_OUT. After metal_replace. */
int metal_leave_out(struct metal *metal, const struct metal_tools *tools, struct error *err);

/* ---- for tests: one view ---- */

struct metal_view {
	int columns, rows;
	float *values;      /* [row][column], line integrals */
	const float *prior; /* likewise, through the prior; or NULL */
	const bool *trace;  /* [row][column]: to be replaced */
	/*
	 * A ray that leaves the grid across its ends along z misses what the prior has
	 * beyond them, and may meet metal there: the column's lines do not start from it. NULL: all are whole.
	 */
	const struct grid *grid;
	const struct view *view; /* NULL without a grid */
	bool air_beyond;         /* along a row, a trace that meets the detector's edge ends in air there */
};

/*
 * Replaces the trace's pixels by straight lines from what lies before to what lies
 * behind, along the row and along the column, means of a few pixels out of the
 * trace; with a prior, lines of the difference to it. Held where a trace meets
 * the detector's edge; where row and column are all trace nothing is done.
 */
void metal_fill_view(const struct metal_view *of);
bool metal_is_whole(const struct metal_view *of, int column, int row);

#endif

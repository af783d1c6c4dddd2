#ifndef CBCT_CORE_METAL_H
#define CBCT_CORE_METAL_H

#include <stdint.h>

#include "core/fdk.h"

/* The metal stage of core/recon.c, and nobody else's: see metal.c. */

/* A voxel of metal; the list is in order and may go to a file and come back. */
struct metal_voxel {
	uint32_t z, at; /* slice, and which voxel of it: y * nx + x */
	float value;    /* 1/mm */
};

/* Pixels first .. last of a row in the shadow of metal. */
struct metal_trace {
	int view, row, first, last;
};

struct metal {
	struct metal_voxel *voxels; /* owned */
	size_t voxels_count;
	struct metal_trace *traces; /* owned; by view, row, column */
	size_t traces_count, traces_room;
	size_t replaced; /* samples in traces */
	int views;       /* with any */
};
void metal_clear(struct metal *metal);

/* What the stage works with, all of it borrowed. */
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
	double mu_water; /* 1/mm */
	const struct cancel *cancel;
};

/* Views that are projected in one go. */
static inline int metal_slots(const struct geometry *geometry)
{
	return fdk_batch_most(geometry->count);
}

/* The voxels of `from` that have at least the threshold (1/mm) beside another one that has. */
int metal_find(struct metal *metal, const struct metal_tools *tools, struct volume *from, double threshold,
	       struct error *err);
/* Takes the list from where recon_metal's bytes went; ERR_INVALID where it is none of this grid. */
int metal_put(struct metal *metal, const struct grid *grid, const void *bytes, size_t count, struct error *err);

/* Replaces the shadows of the list's voxels in the projections. */
int metal_replace(struct metal *metal, const struct metal_tools *tools, struct error *err);

/* FDK of all projections, in the order of their numbers, instead of what is in `to`. */
int metal_fdk(const struct metal_tools *tools, struct volume *to, struct error *err);

/* Exchanges the volume's voxels with the values in the list: once, and the metal is in the volume; twice, and it is as
 * before. */
int metal_exchange(struct metal *metal, const struct metal_tools *tools, struct volume *volume, struct error *err);

/* ---- for tests: one row ---- */

/*
 * Replaces the pixels of `count` traces of one row, in order: a straight line
 * from what lies before to what lies behind, means of a few pixels out of all
 * traces; with a prior, a line of the difference to it. Held where a trace meets
 * the detector's edge. False, and nothing done, where all of the row is a trace.
 */
bool metal_fill_row(float *row, const float *prior, int columns, const struct metal_trace *traces, size_t count);

#endif

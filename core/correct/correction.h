#ifndef CBCT_CORE_CORRECTION_H
#define CBCT_CORE_CORRECTION_H

#include "core/fdk.h"
#include "core/recipe.h"
#include "core/warning.h"

/*
 * The chain of corrections that a scan passes beside its reconstruction: each is a row of corrections[], which stand
 * there in the order in which they run. core/recon goes over the table at five times and knows no correction by name.
 * One thread at a time.
 */
enum correction_time {
	CORRECT_SAMPLES,          /* each view's raw samples, on their way to line integrals */
	CORRECT_LINE_INTEGRALS,   /* each view's line integrals, before FDK takes them */
	CORRECT_AFTER_FDK,        /* the FDK volume, once; where `needs` says so all projections are there */
	CORRECT_BEFORE_ITERATING, /* all projections, once, before an iteration sees them */
	/*
	 * In place of AFTER_FDK in a resumed run, which starts from an iterate: the projections become what they were.
	 */
	CORRECT_RESUMED,
	CORRECTION_TIMES
};

/* Bits: the data that a correction needs beside the values that it changes. */
enum correction_needs {
	NEEDS_NEIGHBOURS = 1,   /* of a pixel, in its row and column */
	NEEDS_WHOLE_IMAGES = 2, /* all of a view */
	NEEDS_ALL_VIEWS = 4,    /* the projections of all views, kept from the first one on, and a volume to work in */
	NEEDS_VOLUME = 8        /* the FDK volume */
};

/* A pointwise row may be done by an operation of the backend, together with others. The row checks and warns then. */
enum correction_fused { FUSED_NOT, FUSED_LINEARISE, FUSED_FILTER };

/* The data that the corrections of one reconstruction work on; all of it is borrowed, and outlives their states. */
struct correction_job {
	const struct backend *backend;
	struct device *device;
	struct plan *plan;
	const struct geometry *geometry; /* upright, see struct input.turned */
	const struct orbit *orbit;
	const struct recipe *recipe; /* resolved */
	struct fdk *fdk;             /* nothing pending; where FDK is on */
	int extend;                  /* columns by which FDK extends truncated rows, plan_options.extend */
	struct stack *projections;   /* a slot for each view where a row needs all views */
	struct stack *batch;         /* of corrections_slots slots, to work in */
	struct volume *volume;       /* FDK's, then the iterate */
	struct volume *work;         /* on the recipe's grid, to work in */
	const struct input *input;   /* what was seen of the samples so far (core/correct/input.h) */
	const int *iteration;        /* iterations that are done */
	/*
	 * Where the object is wider than the detector and the iterations begin, called for all slices before the start
	 * is changed, and once more for those that not all views see when it has been.
	 */
	int (*wide)(void *context, int first, int count, struct error *err);
	void *wide_context;
	bool averages;                     /* recipe_averages: iterations get means over pixels (averaging.h) */
	bool subsets;                      /* iterations are SART's */
	struct recon_agreement *agreement; /* what the check of the geometry finds goes there */
	bool *outside;                     /* set where matter outside of the grid was taken out of the projections */
	bool *left_out_dense;              /* set where rays through what is very dense were left out of them */
	double *settled;                   /* iterations after which relaxation falls (averaging.h); INFINITY: never */
	struct metal *dense;               /* what is very dense, and its traces (dense.h); the chain's own */
	/*
	 * The model by which matter outside of the grid was taken out of the projections, on the host alone, until
	 * truncated rows are held to FDK's means (exterior.h, step 3); where it does not go on nothing was taken. The
	 * chain's own.
	 */
	struct exterior_volume *exterior;
	const struct warning_sink *warnings;
	const struct cancel *cancel;
};

/* A view on its way in. */
struct correction_view {
	const void *samples; /* [row][column], upright */
	int view, slot;
	struct stack *to;                   /* has its line integrals in `slot` */
	const struct defect_counts *before; /* what linearise had counted before this view */
};

/* Memory that corrections hold beside the job's plan, projections, volumes and working stack: the sum over the rows. */
struct correction_bytes {
	size_t device;   /* beside `borrowed` */
	size_t borrowed; /* of the job's plan's block (plan_options.lends) */
	size_t host;     /* out of core (core/outofcore/outofcore.h) */
	size_t aside;    /* the host's whatever the device is: the job's, too, where its device works in that */
};
/* The job before anything is open; the recipe is resolved. */
struct correction_ask {
	const struct backend *backend;
	struct device *device;
	const struct geometry *geometry;
	const struct orbit *orbit;
	const struct recipe *recipe;
	bool averages, subsets; /* as in struct correction_job */
};

/* Voxels in some slices of a volume that is kept. */
struct correction_marks {
	const int *slices; /* [count], z, ascending */
	int count;
	unsigned char *marked; /* [count][y][x]: not 0 where the voxel is an estimate */
	size_t metal;          /* voxels of metal in all slices */
};

struct correction {
	const char *name;    /* "metal" */
	const char *summary; /* for documentation */
	unsigned int times;  /* bits 1 << enum correction_time */
	unsigned int needs;  /* of enum correction_needs */
	enum correction_fused fused;
	double work; /* in FDKs of the whole scan: for the progress bar */

	/* True if the job has this correction; NULL: every job has. */
	bool (*wanted)(const struct recipe *recipe, const struct linearise *linearise);
	/* Refuses input that cannot be corrected, before a view is read; geometry and linearise are upright. */
	int (*check)(const struct linearise *linearise, const struct geometry *geometry, struct error *err);
	/* Slots of the stack that it works in; NULL: none. */
	int (*slots)(const struct geometry *geometry);
	/* Adds to *bytes what it holds. NULL: nothing. */
	int (*bytes)(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err);
	/* *ret_state may stay NULL. */
	int (*open)(const struct correction_job *job, void **ret_state, struct error *err);
	void (*close)(void *state); /* NULL is fine */

	/*
	 * At SAMPLES, before all else: changes counts above the dark, [row][column] as the detector has them, NaN where
	 * a pixel says nothing. The row is wanted where counts_wanted (counts.h) is.
	 */
	int (*counts)(const struct correction_job *job, void *state, int view, float *counts, struct error *err);
	/* At SAMPLES and LINE_INTEGRALS. The slot has the view's line integrals already. */
	int (*view)(const struct correction_job *job, void *state, const struct correction_view *view,
		    struct error *err);
	/* At the other times. *ret_changed: the volume is another one now. */
	int (*apply)(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		     struct error *err);
	/* Called once, when all views have come, but not in a resumed run: warns of what they showed. */
	int (*warn)(const struct correction_job *job, void *state, struct error *err);
	bool warns_late; /* that takes long and changes no volume, and does not keep FDK's waiting */

	/*
	 * Puts into a volume that is to be kept what belongs into the image only; `hide` takes it out again and
	 * restores the same bits. *ret_estimate_mm: voxels nearer to it than this are an estimate; 0: there was nothing
	 * to show, and the volume is as it was.
	 */
	int (*show)(const struct correction_job *job, void *state, double *ret_estimate_mm, struct error *err);
	int (*hide)(const struct correction_job *job, void *state, struct error *err);
	/* Marks the voxels that are estimates where `show` has given a distance, and counts metal. NULL: there are
	 * none. */
	void (*mark)(const struct correction_job *job, const void *state, struct correction_marks *marks);
	/*
	 * Findings of AFTER_FDK, bytes that the state owns; `resume` gets them back in a resumed run. One row has any.
	 */
	const void *(*found)(const void *state, size_t *ret_bytes);
	int (*resume)(const struct correction_job *job, void *state, const void *bytes, size_t size, struct error *err);
};

enum { CORRECTION_COUNT = 16 };
extern const struct correction *const corrections[CORRECTION_COUNT];

/* The corrections of one reconstruction. */
struct correction_chain {
	struct correction_job job;
	struct input *input;
	const struct linearise *linearise;
	void *state[CORRECTION_COUNT];
	float *counts; /* of a view, owned; NULL where no row changes counts */
};

/* ---- going over the table ---- */

bool corrections_need(const struct recipe *recipe, const struct linearise *linearise, unsigned int needs);
double corrections_work(const struct recipe *recipe, const struct linearise *linearise);
int corrections_check(const struct linearise *linearise, const struct geometry *geometry, struct error *err);
/* Slots of the one stack that they work in in turn. */
int corrections_slots(const struct recipe *recipe, const struct linearise *linearise, const struct geometry *geometry);
int corrections_bytes(const struct correction_ask *ask, const struct linearise *linearise,
		      struct correction_bytes *ret_bytes, struct error *err);

/* Opens the rows that the job wants. `input` is the job's too, open, and is written while views come in. */
int corrections_open(struct correction_chain *ret_chain, const struct correction_job *job, struct input *input,
		     struct error *err);
void corrections_close(struct correction_chain *chain);

/* Linearises a view, in rows and columns as it came, into a slot, and corrects it. */
int corrections_take(struct correction_chain *chain, const void *samples, int view, int slot, struct stack *to,
		     struct error *err);
/* Runs the corrections of a time that is not one of views; *ret_changed: the volume is another one now. */
int corrections_apply(struct correction_chain *chain, enum correction_time time, bool *ret_changed, struct error *err);
/* Calls `warn` of the rows whose warns_late is `late`. */
int corrections_warn(struct correction_chain *chain, bool late, struct error *err);
int corrections_show(struct correction_chain *chain, double *ret_estimate_mm, struct error *err);
void corrections_mark(const struct correction_chain *chain, struct correction_marks *marks);
/* Draws which rays of a view are in the traces of what is very dense, [row][column]. */
void corrections_draw_dense(const struct correction_chain *chain, int view, bool *ret_image);
int corrections_hide(struct correction_chain *chain, struct error *err);
const void *corrections_found(const struct correction_chain *chain, size_t *ret_bytes);
/* ERR_INVALID where the job has no correction that finds anything. */
int corrections_resume(struct correction_chain *chain, const void *bytes, size_t size, struct error *err);

#endif

#ifndef CBCT_CORE_ALGORITHM_H
#define CBCT_CORE_ALGORITHM_H

#include "core/recon/recon.h"

/*
 * The iterative algorithms: a row of algorithms[] for each, and all that a
 * reconstruction, a recipe and a job's document need to know of it. The loop
 * around it, with TV, kept volumes, history, stop rules and preemption, is
 * core/recon/run.c's. One thread at a time.
 */

enum { ALGORITHM_HOLDS = 4 }; /* volumes at most, and stacks */

/* The problem that an algorithm works on, all of it borrowed. */
struct problem {
	const struct backend *backend;
	struct device *device;
	struct plan *plan;
	const struct geometry *geometry;
	const struct grid *grid;
	const struct stack *projections; /* slot = view, line integrals; NaN: a ray that is left out */
	struct volume *volume;           /* the iterate */
	struct volume *before; /* scratch at the beginning of an iteration, at its end the iterate before it */
	/* The algorithm's own, as many as its row asks for, not cleared. */
	struct volume *volumes[ALGORITHM_HOLDS];
	struct stack *stacks[ALGORITHM_HOLDS]; /* of all views */
	const int *views;                      /* [geometry.count]: 0, 1, 2 ... */
	const struct cancel *cancel;           /* or NULL */
	bool nonnegative;                      /* the iterate has no voxel below 0 */
	bool momentum;                         /* of SART, see core/recon/sart.c */
	enum ray_weights weights;              /* of algorithms that weigh rays */
};

/* When automatic iterations end (core/recon/stopping.h). */
#define STOP_NOISE_MIDDLE 0.008
struct stop_limits {
	/*
	 * The volume has changed by less than this share of its norm, at STOP_NOISE_MIDDLE of relative noise in the
	 * projections. Where there is less noise the limit goes with its power -quiet, where more, with its power loud.
	 */
	double change, quiet, loud;
	double change_most; /* 0: the limit has no most */
	double fall;        /* the residual has fallen by less than this share of it; 0: it does not count */
	int least;          /* iterations at least */
};

struct algorithm {
	const char *name;         /* the recipe's member, the stage of its volumes: "sart" */
	const char *summary;      /* for documentation */
	int iterations;           /* that `{}` runs */
	enum projector projector; /* that a recipe without one takes */
	enum stage stage;         /* of its iterations, in progress and timings */
	bool subsets;             /* its update is the backend's sart_iterate over ordered subsets */
	bool weighs;              /* rays may have statistical weights, core/recon/weights.h */
	/* How many problem.volumes and stacks it works in, beside projections, iterate, its copy and the plan. */
	int volumes, stacks;
	int momentum_volumes; /* more of them, where the recipe asks for momentum */
	double updates; /* of SART, that take up as much noise as one iteration; 0: as many as there are subsets */
	/* Iterations after which a start from zero has its least error on anatomies; fewer are told. 0: never told. */
	int from_zero;
	struct stop_limits stops[2], momentum_stops[2]; /* without TV, and with it */
	bool clips_last; /* zero is enforced by the loop, behind TV, and not by `iterate` */
	double work;     /* of an iteration, in FDKs of the whole scan: for the progress bar */

	/* Allocates the rest of its state; *ret_state may stay NULL without any. The problem outlives it. */
	int (*open)(const struct problem *problem, void **ret_state, struct error *err);
	void (*close)(const struct problem *problem, void *state); /* NULL is fine */
	/*
	 * One iteration. moved: the iterate is not the one that the last iteration left, TV was there, or it is the
	 * first iteration.
	 */
	int (*iterate)(const struct problem *problem, void *state, bool moved, struct iteration_sums *ret_sums,
		       struct error *err);
	/*
	 * The algorithm's part of a checkpoint: what a resumed run needs beside the iterate to end with the same bits;
	 * NULL: nothing. `resume` gets those bytes before the first iteration.
	 */
	size_t (*state_bytes)(const struct problem *problem);
	int (*save)(const struct problem *problem, void *state, const struct checkpoint_sink *sink, struct error *err);
	int (*resume)(const struct problem *problem, void *state, const char *bytes, struct error *err);
};

/* Volumes that the recipe's algorithm works in. */
static inline int algorithm_volumes(const struct recipe *recipe)
{
	const struct algorithm *algorithm = recipe->algorithm;

	if (algorithm == NULL)
		return 0;
	return algorithm->volumes + (recipe->sart.momentum ? algorithm->momentum_volumes : 0);
}

extern const struct algorithm *const algorithms[ALGORITHM_COUNT];
/* Finds an algorithm by its name; NULL when there is none. */
const struct algorithm *algorithm_find(const char *name);

/* ---- steps over all views: core/recon/problem.c ---- */

/* y = A x. */
int problem_project(const struct problem *problem, const struct volume *x, struct stack *y, struct error *err);
/* y += A^T x. */
int problem_backproject(const struct problem *problem, const struct stack *x, struct volume *y, struct error *err);
/* weights /= L, L the ray's length in the grid in mm; 0 where it misses or grazes it. `before` is worked in. */
int problem_divide_by_lengths(const struct problem *problem, struct stack *lengths, struct stack *weights,
			      struct error *err);
/* Returns the shortest side of a voxel, mm. */
double problem_shortest(const struct problem *problem);

/* Writes all slices of a volume of the problem's grid into a checkpoint. */
int checkpoint_volume(const struct problem *problem, struct volume *volume, const struct checkpoint_sink *sink,
		      struct error *err);

/*
 * The history row of one iteration, all of it finite whatever the scan was:
 * residual is 0 where the projections are all zero and so is A v (else 1);
 * change is 1 where the volume was zero before and no longer is, 0 where it
 * still is. Fails with ERR_IMPOSSIBLE where the iteration has diverged.
 */
int algorithm_row(int iteration, const struct iteration_sums *sums, const struct volume_norms *norms,
		  double norm2_before, struct history_row *ret_row, struct error *err);

#endif

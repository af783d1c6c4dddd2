#ifndef CBCT_CORE_SURROUNDINGS_H
#define CBCT_CORE_SURROUNDINGS_H

#include "core/fdk.h"

/*
 * FDK over all of the field of view, and all of the recipe's grid, on a coarse
 * grid of its own: what the object is outside of the recipe's grid (core/exterior.h).
 * Out there two things are no object and set to zero: what lies outside of the
 * field of view, where FDK's sums lack views, and a place that some view sees
 * through air, whatever a wide cone or a short arc made of it.
 */
/*
 * Voxels a side, and views that are projected in one go: little beside a job's own
 * memory. That of a small job has room for as many voxels only as its grid or a quarter
 * of its pixels, but not for fewer than SURROUNDINGS_LEAST a side.
 */
enum { SURROUNDINGS_LEAST = 64, SURROUNDINGS_MOST = 128, SURROUNDINGS_VIEWS = 4 };

/* What it is made from, all of it borrowed. */
struct surroundings_options {
	const struct backend *backend;
	struct device *device;
	const struct geometry *geometry;
	const struct orbit *orbit;
	const struct grid *grid;   /* the recipe's */
	struct plan *plan;         /* of that, in whose memory it works */
	struct stack *projections; /* a slot for each view */
	double factor;             /* that makes up for blank views, 1 without */
	bool poor;                 /* FDK is, and not to be believed outside of the recipe's grid */
	bool inside_only;          /* leaves what lies outside of the recipe's grid away */
	const struct cancel *cancel;
};

struct surroundings {
	const struct backend *backend;
	struct grid grid;
	struct fdk_weights weights;
	struct plan *plan;
	struct volume *volume;
	float *voxels;       /* the same on the host, owned */
	size_t truncated[2]; /* as of backend.filter_extended */
	bool goes_on;        /* something is left outside of the recipe's grid */
};

struct surroundings_bytes {
	size_t device;   /* beside the job's own, */
	size_t borrowed; /* and of its plan's block (plan_options.lends) */
	size_t host;     /* as of parts.h */
};

/* Known beforehand; of the options it needs backend, device, geometry, orbit and grid. */
int surroundings_bytes(const struct surroundings_options *options, struct surroundings_bytes *ret_bytes,
		       struct error *err);

/* In place, for the plan points into it: not to be copied. Free with surroundings_clear. */
int surroundings_make(struct surroundings *surroundings, const struct surroundings_options *options, struct error *err);
void surroundings_clear(struct surroundings *surroundings);

/* `to` becomes the same on the recipe's grid. */
int surroundings_sample(const struct surroundings *surroundings, const struct grid *grid, struct volume *to,
			struct error *err);

#endif

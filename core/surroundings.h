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
/* Voxels a side, 8 MiB at most, and views that are projected in one go: little beside a job's own memory. */
enum { SURROUNDINGS_MOST = 128, SURROUNDINGS_VIEWS = 4 };

/* What it is made from, all of it borrowed. */
struct surroundings_options {
	const struct backend *backend;
	struct device *device;
	const struct geometry *geometry;
	const struct orbit *orbit;
	const struct grid *grid;   /* the recipe's */
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

/* Bytes on the device and on the host (parts.h); of the options it needs backend, device, geometry, orbit and grid. */
int surroundings_bytes(const struct surroundings_options *options, size_t *ret_device, size_t *ret_host,
		       struct error *err);

/* In place, for the plan points into it: not to be copied. Free with surroundings_clear. */
int surroundings_make(struct surroundings *surroundings, const struct surroundings_options *options, struct error *err);
void surroundings_clear(struct surroundings *surroundings);

/* `to` becomes the same on the recipe's grid. */
int surroundings_sample(const struct surroundings *surroundings, const struct grid *grid, struct volume *to,
			struct error *err);

#endif

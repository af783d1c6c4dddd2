#ifndef CBCT_CORE_SURROUNDINGS_H
#define CBCT_CORE_SURROUNDINGS_H

#include "core/correct/metal.h"
#include "core/fdk.h"

/*
 * A model of the exterior, the object outside of the recipe's grid (core/correct/exterior.h): a volume on a coarse grid
 * that holds the recipe's grid, the field of view, and all places in it that any ray meets, also beyond the detector's
 * rows.
 *
 * exterior_volume_make gives its start, an FDK volume. Out there two things are no object and set to zero: what lies
 * beside the field of view, and a place that some view sees through air, whatever a wide cone or a short arc made of
 * it. A place that is on the rows of some views only, where FDK's sums lack the others, has the value of the nearest
 * slice towards the middle that all views see: bodies go on more often than they end.
 *
 * In a scan whose rows are truncated, what lies beside the field of view has the value at its rim instead, wherever no
 * view sees it through air, and fades to zero over EXTERIOR_MARGIN of the radius. A volume that ends at the rim falls
 * as the chord of a circle does, which no smooth difference to the projections follows, and its voxels are steps there:
 * SART put 20 to 35 HU of that into the grid (tests/bench/results/truncation.txt).
 *
 * exterior_volume_fit makes that agree with the projections, by SART (core/correct/coarse.h), but for the rays through
 * what is very dense: coarse voxels do not hold that, and what fills its traces is a guess. A ray near the end of the
 * grid is in it for a short part of its length, to which SART ascribes all of the ray's error: a hundredth of the
 * integral is hundreds of HU there. Slices of a trunk of +-250 mm that end inside of a panel of +-84 mm, worst error of
 * their means: 500 to 1300 HU with that start set to zero where not all views see it, 30 to 340 with SART from there,
 * 12 to 60 from FDK's low sums and 2 to 7 from the nearest slice.
 *
 * Where FDK is poor, the arc short, the start is zero, and the fit goes on for longer: after 8 iterations the density
 * of a trunk was 48 HU too low in its middle slices, after 32 with a relaxation of 1.5 it is 22. The job's iterations
 * begin with that model, for of what FDK has put there, 430 HU too low, six of them left 49.
 */
/*
 * Voxels a side, and views that are projected in one go: little beside a job's own
 * memory. That of a small job has room for as many voxels only as its grid or a quarter
 * of its pixels, and for half as many where they are fitted; but not for fewer than EXTERIOR_VOLUME_LEAST a side.
 */
enum { EXTERIOR_VOLUME_LEAST = 64, EXTERIOR_VOLUME_MOST = 128, EXTERIOR_VOLUME_VIEWS = 4 };

/*
 * Slices of the model that are as high as a row where rows are truncated; fewer where voxels do not go so far. FDK has
 * a body's end as sharp as rows are high. A model with slices as high as its columns are wide, a row or more, lacks of
 * the end what it has too much beyond; step 2 of exterior.h takes that for something beyond the field of view, all of
 * it but what is finer than its columns, and the end slices were 50 to 120 HU lower than FDK's
 * (tests/bench/results/exterior.txt).
 */
enum { EXTERIOR_SLICES_OF_A_ROW = 3 };

/* Margin about the field of view, as a share of its radius. */
#define EXTERIOR_MARGIN 0.25

/* Inputs of the model, all of them borrowed. */
struct exterior_volume_options {
	const struct backend *backend;
	struct device *device;
	const struct geometry *geometry;
	const struct orbit *orbit;
	const struct grid *grid;   /* the recipe's */
	struct plan *plan;         /* of that, in whose memory it works */
	struct stack *projections; /* a slot for each view */
	double factor;             /* that makes up for blank views, 1 without */
	const int *blank;          /* [blanks], those */
	int blanks;
	bool poor;        /* FDK is, and not to be believed outside of the recipe's grid */
	bool truncated;   /* rows are, so that the object goes on beside the field of view */
	bool fine_slices; /* the model is to show a body's end as sharply as FDK, for rows are truncated */
	bool inside_only; /* leaves what lies outside of the recipe's grid away */
	/* Traces of what is very dense, which are filled: a row says nothing of where they meet the detector's edge. */
	const struct metal *dense;
	const struct cancel *cancel;
};

struct exterior_volume {
	const struct backend *backend;
	struct grid grid;
	struct fdk_weights weights;
	struct plan *plan;
	struct volume *volume;
	float *voxels; /* the same on the host, owned */
	/* [voxels], owned: between the middles of the outermost rows of all views (one row: on it) and, where rows are
	 * truncated, in the field of view */
	bool *seen;
	size_t truncated[2]; /* as of backend.filter_extended */
	bool goes_on;        /* something is left outside of the recipe's grid */
	float *within;       /* exterior_within_make's (exterior.h), on the recipe's grid, owned; NULL without */
	int rows[2];         /* it is of these rows of the projections, the first and the last one */
	int reach;           /* rows to either side whose mean is not held to it; 0: all is */
};

/*
 * Its grid: around the recipe's grid, the field of view, with its margin where rows are truncated, and its rays;
 * without the margin, the rays, or around the recipe's grid alone, where the sources leave no room for more.
 */
void exterior_volume_grid(const struct exterior_volume_options *options, struct grid *ret);

struct exterior_volume_bytes {
	size_t device;   /* beside the job's own, */
	size_t borrowed; /* and of its plan's block (plan_options.lends) */
	size_t host;     /* as of outofcore.h */
};

/* Known beforehand, at most; of the options it needs backend, device, geometry, orbit and grid. */
int exterior_volume_bytes(const struct exterior_volume_options *options, struct exterior_volume_bytes *ret_bytes,
			  struct error *err);

/*
 * Tells whether anything may lie outside of the recipe's grid: a place in the field of view that rays of the views
 * looked at meet, none of them through air. It is looked for on the coarse grid, so that *ret_possible is false only
 * where no fit is worth its time; blank views and those that FDK makes little of count as any other.
 */
int exterior_volume_may_go_on(const struct exterior_volume_options *options, bool *ret_possible, struct error *err);

/* Makes the model in place, for its plan points into it: it must not be copied. Free with exterior_volume_clear. */
int exterior_volume_make(struct exterior_volume *exterior, const struct exterior_volume_options *options,
			 struct error *err);
/* The same options; the projections may have changed since. */
int exterior_volume_fit(struct exterior_volume *exterior, const struct exterior_volume_options *options,
			struct error *err);
/* After the fit: whether it has some of the object, and not the smear of one that ends with that grid, outside of it.
 */
bool exterior_volume_has_outside(const struct exterior_volume *exterior, const struct grid *grid);
void exterior_volume_clear(struct exterior_volume *exterior);
/* Its voxels on the host, which exterior_volume_sample takes, become means over (1 2 1) / 4 along each axis, by a share
 * of 0 .. 1; or, along x, y and z, means of these variances, mm^2. */
void exterior_volume_smooth(struct exterior_volume *exterior, double share);
void exterior_volume_mean(struct exterior_volume *exterior, const double variances[3]);
/* Frees all but what these two need, on the host; exterior_volume_clear frees that. */
void exterior_volume_leave_device(struct exterior_volume *exterior);

/*
 * A part of exterior_volume_make, where rows are truncated. Beside the field of view the voxels on the host become the
 * value at the same height a voxel and a half within its rim, where FDK's sums are whole, fading outwards, but for what
 * is empty ([voxels]).
 */
void exterior_volume_hold_rim(struct exterior_volume *exterior, const struct orbit *orbit, const bool *empty);
/* A slice of it on the recipe's grid, [y][x]. */
void exterior_volume_slice(const struct exterior_volume *exterior, const struct grid *grid, int z, float *ret_slice);
/* `to` becomes the same on the recipe's grid. */
int exterior_volume_sample(const struct exterior_volume *exterior, const struct grid *grid, struct volume *to,
			   struct error *err);
/*
 * The same of the means over the recipe's voxels, along axes where those are the wider ones, d against s. What w has
 * more finely, the end of a body or a layer on it, is in no voxel's middle, and stays in A w - A u (exterior.h) all
 * over the grid: a layer a slice thick was lost so. R is the mean at n places of a voxel, n the least that are no
 * farther apart than s; those have the variance (1 - 1 / n^2) d^2 / 12, what lies between w's middles adds s^2 / 6, and
 * a voxel has d^2 / 12. What there is more is e, and u = R - e/2 R'', as in core/recon/means.h. The outermost voxels
 * have w's values at their middles, for faces of means are 50 HU off where a body ends a little beyond them.
 */
int exterior_volume_means(const struct exterior_volume *exterior, const struct grid *grid, struct volume *to,
			  struct error *err);
/*
 * A slice of it [y][x]: 1 where all views see a place, 0 where one of them has it beside its rows (or, where rows are
 * truncated, beside its columns), in between nearer to that than a voxel of the coarse grid. True when it is 1 all over
 * the field of view.
 */
bool exterior_volume_seen(const struct exterior_volume *exterior, const struct grid *grid, int z, float *ret_slice);

#endif

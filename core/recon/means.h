#ifndef CBCT_CORE_RECON_MEANS_H
#define CBCT_CORE_RECON_MEANS_H

#include "core/backend.h"
#include "core/fdk.h"
#include "core/recipe.h"
#include "core/scan/grid.h"
#include "core/scan/orbit.h"

/*
 * FDK's means over voxels, in volumes of the default that are kept, where pixels are finer than voxels.
 *
 * A voxel's value is the mean over it. FDK's is the value at its middle, blurred by the filter's window. Iterations
 * have voxels of linear interpolation, which blur an edge or overshoot beside it by how it lies to the grid, whatever
 * mean over pixels they get. But fine pixels say what the mean is: R is the mean of FDK at MEANS_PLACES places of each
 * voxel, a quarter of a voxel to either side of its middle along each axis, without a window. Along an axis such places
 * have the variance 1/16 and the fourth cumulant -1/128 of a voxel, a voxel itself 1/12 and -1/120. A pixel's width and
 * the linear interpolation between pixels add 1/12 + 1/6 of a pixel's square; where both together are not 1/12 of a
 * voxel's, the second derivative makes up for the difference e:
 *
 *   T = R - e/2 R''  along each axis
 *
 * T has noise and the streaks of views, which the iterate V has less of. How strong they are is known from the same
 * means of every other view, A and B: what they differ by, E = (A - B) / 2, is as strong as noise and streaks are in
 * their mean, and has nothing of the object. D is T - V less its own mean over (2 MEANS_WIDE + 1)^2 voxels of the
 * slice, since V knows better what changes slowly, and where a slice cuts through an end. Then
 *
 *   V' = V + 4/5 w D,  w = 1 - <E^2> / 4 <D^2>  over 3 x 3 voxels, and at least 0
 *
 * A quarter, for A and B have the streaks of half as many views, most of which their mean has not. In even places, u of
 * them (restraint_places.h, in air as well), V stays: w is times 1 - u. All of it where the variance of R is up to 1.5
 * of a voxel's, nothing from 2 on: from 2 and 1.55 pixels a voxel. Beside what is as dense as metal streaks begin at
 * edges, and both halves have most of them: nothing is done there.
 *
 * An object that is made of the grid's voxels has no other means than V has, and V stays. It is linear from one voxel's
 * middle to the next, so that R is K F: F is FDK at the middles without a window, and K the kernel 1/8, 3/4, 1/8 along
 * each axis. Of
 *
 *   q = sum (R - K F)^2 / sum (K F - F)^2
 *
 * such objects have .05 to .24, bodies .29 to .64, what changes slowly .56: all is done from .29 on, nothing up to .24.
 * Squares are products of what each half of the views shows, which noise has no part in.
 *
 * Only volumes that are kept have V'; the iterate goes on as it is. tests/bench/results/denoise.txt has the figures and
 * what else was tried. One thread at a time; the same bits for any number of threads.
 */
enum { MEANS_PLACES = 8, MEANS_WIDE = 5 };

struct means;

/* R's blur beside a voxel's. */
struct means_blur {
	float excess[3]; /* e / 2 along x, y and z, in voxels' squares */
	float share;     /* 0 .. 1: of what is done */
};
/* share is 0 where the axis leans, too: rows do not lie in slices then. */
struct means_blur means_blur(const struct grid *grid, const struct orbit *orbit);

struct means_options {
	const struct backend *backend;
	struct device *device;
	const struct geometry *geometry;
	const struct orbit *orbit;
	const struct recipe *recipe;
};

/* Bytes beside the job's plan, projections, volumes and FDK's batch. */
struct means_bytes {
	size_t device;   /* beside `borrowed` */
	size_t borrowed; /* of the job's plan's block (plan_options.lends) */
	size_t host;     /* out of core */
	size_t kept;     /* the host's whatever the device is */
};
/* All 0 where means_new makes nothing. */
int means_bytes(const struct means_options *options, struct means_bytes *ret_bytes, struct error *err);
/* *ret_means stays NULL where the share is 0. Borrows what the options point to. */
int means_new(const struct means_options *options, struct means **ret_means, struct error *err);
void means_free(struct means *means); /* NULL is fine */

/* What R is made of and with. */
struct means_source {
	struct plan *plan;               /* the job's, which lends */
	const struct fdk *fdk;           /* the job's, with nothing pending: its batch is worked in */
	const struct stack *projections; /* [views] */
	struct volume *work;             /* is overwritten */
	const int *views;                /* [count], those that FDK has, ascending */
	int count;
	double factor; /* by which FDK of them all is too small */
	const struct cancel *cancel;
};
int means_make(struct means *means, const struct means_source *source, struct error *err);

/* State for a run that goes on; 0 bytes for NULL, else always as many. */
size_t means_state_bytes(const struct means *means);
const void *means_state(const struct means *means);
void means_resume(struct means *means, const char *bytes);

/* Whether there is anything to show; false for NULL. */
bool means_there(const struct means *means);
/* V, the volume, becomes V'. */
int means_show(const struct means *means, struct volume *volume, struct error *err);

#endif

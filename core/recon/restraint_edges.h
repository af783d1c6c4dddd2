#ifndef CBCT_CORE_RECON_RESTRAINT_EDGES_H
#define CBCT_CORE_RECON_RESTRAINT_EDGES_H

#include "core/backend.h"
#include "core/filter.h"
#include "core/scan/grid.h"
#include "core/scan/orbit.h"

/*
 * Edges of both FDK and the iterate, where FDK's pixels are so much finer than the voxels that it blurs no more than a
 * voxel does.
 *
 * FDK's blur is known. Along a row it has the variances, in pixels' squares, of a pixel's width (1/12), of the linear
 * interpolation between pixels (1/6) and of the filter's window (Hann: 1/2); along the axis those of the first two. A
 * voxel's mean has 1/12 of its own width's square. At three pixels a voxel both are the same along a row, so that FDK's
 * edges are those of the truth, but for noise and streaks. Iterations in voxels of linear interpolation come near to
 * them at best: they blur or overshoot by how an edge lies to the grid, whatever mean over pixels they get. Where the
 * difference e of the variances is not 0, the second derivative makes up for it:
 *
 *   T = S - e/2 S''  along each axis, S the volume that the iterations began with
 *
 * What T has and the iterate V has not, D = T - V, is noise and streaks of S, and at edges what is wrong with either.
 * How strong the first are is known from FDK volumes of every other view, A and B. What they differ by, E = (A - B) /
 * 2, is as strong as noise and streaks are in their mean, and has nothing of the object. m^2 = <D^2> and s^2 = <E^2>
 * over 3 x 3 voxels, E sharpened as S is: m^2 is s^2 + 2 b^2, if the edges of both are wrong by b, and independently;
 * the mean of T and V that has the least error is
 *
 *   V' = V + w D,  w = b^2 / (2 b^2 + s^2) = (1 - s^2 / m^2) / 2
 *
 * and at least 0. s^2 counts four times, since V has noise as well. In even places, u of them (restraint_places.h, in
 * air as well), V stays: w is times 1 - u. All of it where FDK's variance is up to 1.5 of a voxel's, nothing from 2 on,
 * which is 2.1 pixels a voxel with Hann's window. Beside what is as dense as metal streaks begin at edges, and both
 * halves have most of them: nothing is done there.
 * tests/bench/results/denoise.txt has the figures and what else was tried.
 */
struct edge_blur {
	float excess[3]; /* e / 2 along x, y and z, in voxels' squares */
	float share;     /* 0 .. 1: of what is done */
};

/* share is 0 where the axis leans, too: rows do not lie in slices then. */
struct edge_blur edges_blur(const struct grid *grid, const struct orbit *orbit, enum window window, double cutoff);

/* What both of these work in; one thread at a time, and the same bits for any number of threads. */
size_t edges_bytes(const struct grid *grid);
/* The FDK volume of all views, and that of `part` of them, every other one. */
struct edge_halves {
	const struct backend *backend;
	struct volume *all, *half;
	double part;
};
/* s of each voxel, for edges_show; work gets E. Both are [z][y][x]. */
int edges_see(const struct edge_blur *blur, const struct grid *grid, double mu_water, const struct edge_halves *halves,
	      float *work, unsigned char *ret_noise, struct error *err);
/* V, the volume, becomes V'. start: S, [z][y][x]. */
int edges_show(const struct edge_blur *blur, const struct grid *grid, double mu_water, bool nonnegative,
	       const float *start, const unsigned char *noise, const struct backend *backend, struct volume *volume,
	       struct error *err);

#endif

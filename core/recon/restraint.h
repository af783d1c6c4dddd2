#ifndef CBCT_CORE_RECON_RESTRAINT_H
#define CBCT_CORE_RECON_RESTRAINT_H

#include "core/backend.h"
#include "core/correct/correction.h"
#include "core/scan/grid.h"

/*
 * How far the default's iterations are followed, where they may come out worse than FDK: beside what is very dense, and
 * where the object goes on outside of the grid, for a rod there is in no voxel and its shadow stays in the projections.
 * The residual does not tell, since it falls in any case; the image itself does.
 *
 * Roughness. h(V) = V less the mean of its four neighbours in the slice. Anatomy makes some places rough, noise and
 * streaks make all of them. So the quietest quarter of the object's cubes, of CELL voxels a side, is asked, in the
 * iterate V and in the volume S that the iterations began with:
 *
 *   V' = S + w (V - S),  w = (c^2 - <h(S) h(V - S)>) / (c^2 + <h(V - S)^2>), c = .004 <S>
 *
 * w is that of the least roughness there, drawn towards 1 by c where there is next to none. Beside rods outside of the
 * grid iterations were worse than FDK by 6 to 14 %, and w is -.04 to .28; where they are better, .37 to 1.2; in scans
 * without anything dense .99 and more. From .85 on nothing is changed, and below it V' has w or, if that is less,
 * (w - .2) / .65, for the quietest quarter shows less of the streaks than the rest.
 *
 * Places. One w holds edges back with the streaks, or lets streaks of some places pass with the rest. So where S has
 * voxels as dense as metal, where w is below .85, and where two thirds of the even voxels lie in places that are
 * rougher in V than in S, V' has a w of each place, w(x) (core/recon/restraint_places.h). No other scan is touched by
 * that.
 *
 * Means. Beside metal the volume of few photons is so noisy that TV takes bone with the noise: 800 HU become 660. In
 * such a scan S is not FDK's volume T after TV, but that with what TV took of its means, g(T, F - T), F being FDK's
 * before TV:
 *
 *   g(V, d) = a V + b, the straight line in V that is nearest to d in 8 voxels a side around a corner of cubes, linear
 *             between these corners (a guided filter: He, Sun and Tang, IEEE Trans. Pattern Anal. Mach. Intell. 35,
 *             2013, on a coarse lattice: He and Sun, arXiv 1505.00996)
 *
 * and V gets g(V, S - V) back, by LOST times what TV took of FDK there at most, and in the same direction. Voxels
 * of 2.6 times water and more have no part in it.
 *
 * Metal. Where the rays through what is very dense are left out of the iterations (core/correct/dense.c), the others
 * move it all the same, by 50 to 3000 HU. V' has FDK's own values there.
 *
 * Of a job that takes metal out S has none, and it is held back only where the object goes on outside of the grid.
 *
 * Only volumes that are kept have V'; the iterate goes on as it is. tests/bench/results/dense.txt has the figures and
 * what else was tried. One thread at a time; the same bits for any number of threads.
 */
struct restraint;

struct restraint_report {
	bool changed;
	double share;    /* W, 1 where all of the change is kept */
	bool places;     /* were told apart */
	double rougher;  /* the share of even voxels where V is rougher than S; 0 where places are not told apart */
	double rough[2]; /* of S and V in the quietest quarter, 1/mm, root mean square of h */
	double restored, most; /* share of the object that got back more than 25 HU; the most, 1/mm */
};

/* FDK's largest value, times water, from which on what TV takes is looked at, and from which on w is asked for. */
#define RESTRAINT_METAL 3.1
#define RESTRAINT_DENSE 2.5

/* Bytes of the host's memory, once it has begun; 0: restraint_new makes nothing, the grid has too few voxels. */
size_t restraint_bytes(const struct grid *grid);
/* blur: the width of FDK's, mm. */
int restraint_new(const struct grid *grid, double mu_water, double blur, bool nonnegative,
		  struct restraint **ret_restraint, struct error *err);
void restraint_free(struct restraint *restraint); /* NULL is fine */

/* Notes what TV took of FDK's means. Before restraint_begin. */
int restraint_see_loss(struct restraint *restraint, const struct backend *backend, struct volume *fdk,
		       struct volume *smoothed, struct error *err);
/* Takes S from the volume that the iterations begin with. */
int restraint_begin(struct restraint *restraint, const struct backend *backend, struct volume *volume,
		    struct error *err);

/* State for a run that goes on; 0 bytes for NULL and before restraint_begin, else restraint_kept_bytes. */
size_t restraint_kept_bytes(const struct restraint *restraint);
size_t restraint_state_bytes(const struct restraint *restraint);
const void *restraint_state(const struct restraint *restraint);
int restraint_resume(struct restraint *restraint, const char *bytes, struct error *err);

/*
 * V becomes V', where it has begun. dense: what has the traces of the rays that were left out; or NULL.
 */
int restraint_show(struct restraint *restraint, const struct backend *backend, struct volume *volume,
		   const struct correction_chain *dense, struct restraint_report *ret_report, struct error *err);

#endif

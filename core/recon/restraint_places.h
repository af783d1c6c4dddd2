#ifndef CBCT_CORE_RECON_RESTRAINT_PLACES_H
#define CBCT_CORE_RECON_RESTRAINT_PLACES_H

#include "core/correct/correction.h"

/*
 * The restraint of each place, w(x) in place of one w: see restraint.h.
 *
 * Edges make a place rough, and iterations sharpen them; so a place is asked where it is even. u is 1 where S differs
 * by up to EVEN HU within two widths of FDK's blur along x and y, 0 from twice of that on and outside of the object,
 * and sums over cubes of u h(S)^2 and so on, smoothed over the cubes beside them, give each cube its own
 *
 *   w = (c^2 - <h(S) h(V - S)>) / (c^2 + <h(V - S)^2>)  and  s^2 = <(V - S)^2>
 *
 * Cubes without any such voxel have those of the nearest ones. What the iterations change at an edge is a streak of the
 * even parts beside it, or sharpens it; where it is much larger than theirs, it is the latter:
 *
 *   w(x) = w + (1 - u) max(0, 1 - 4 s^2 / m^2) max(0, W - w),  m^2 = <(V - S)^2> over 5 x 5 voxels, W that of the
 * object
 *
 * Where the rays through what is very dense are left out, few of those through a place beside it may be left, and w(x)
 * is less: times (1 - k) / .1 from k = .9 on, k the share of up to PLACE_VIEWS views whose ray through the place is. Up
 * to k = .2 iterations leave .65 of FDK's error, .8 at .5, .93 at .8, and 1.22 from .9 on.
 */
struct places;

/* w, or less of it the nearer it is to .2; 1 from .85 on. */
double places_kept(double w);

/* Voxels a side of a cube; the same as the restraint's. */
enum { PLACE_CELL = 4, PLACE_VIEWS = 60 };

/* Voxels that two widths of FDK's blur have, where that is at most a voxel. */
enum { PLACE_REACH = 2 };
/* u of a voxel of a slice [y][x] of size voxels, asked as far as reach, also outside of the object. */
float place_evenness(const int size[2], const int reach[2], float mu_water, const float *slice, int x, int y);
/* A voxel's place between the middles of two cubes along an axis: the first of them, and the second one's share. */
int place_between(int voxel, int cells, float *ret_share);

size_t places_bytes(const struct grid *grid);
/* blur: the width of FDK's, mm. */
int places_new(const struct grid *grid, double mu_water, double blur, struct places **ret_places, struct error *err);
void places_free(struct places *places); /* NULL is fine */

void places_begin(struct places *places);
/* Slices [y][x] of S and of V. */
void places_add(struct places *places, int z, const float *start, const float *values);
/*
 * Once all that is to be asked has been added. Returns the share of even voxels in cubes where V is rougher than S: w
 * is below a half there.
 */
double places_finish(struct places *places);

/* After places_finish: those rays are in the traces of what is dense. */
int places_see(struct places *places, const struct correction_chain *dense, struct error *err);

/* V of a slice becomes S + w(x) (V - S), before any bounds; most: W. */
void places_restrain(struct places *places, int z, double most, const float *start, float *values);

#endif

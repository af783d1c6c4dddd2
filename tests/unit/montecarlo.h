#ifndef CBCT_TESTS_MONTECARLO_H
#define CBCT_TESTS_MONTECARLO_H

#include "core/scan/geometry.h"
#include "core/scan/phantom.h"

/*
 * Scattered photons of one view, by Monte Carlo: an independent truth for what core/correct/scatter.h estimates.
 *
 * Photons of 65 keV start from the source towards the detector, which the beam is collimated to; free paths by
 * Woodcock's method through the phantom's densities (1/mm at 65 keV); at each collision 92 % are scattered by Klein
 * and Nishina, the others absorbed; densities fall with the photon's energy as water's do. Every collision sends its
 * share to every cell of the detector (forced detection), which counts energies. Up to eight collisions.
 *
 * ret: [along][across], what a pixel amid the cell counts of scattered photons against what it counts in air. The same
 * seed gives the same numbers. phantom: of ellipsoids and cylinders that lie within `radius` mm of the isocentre.
 */
struct montecarlo {
	const struct phantom *phantom;
	const struct geometry *geometry;
	double radius;
	int across, along; /* cells */
	int photons;
	unsigned long long seed;
};
void montecarlo_scatter(const struct montecarlo *montecarlo, int view, float *ret);

#endif

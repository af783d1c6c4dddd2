#ifndef CBCT_TESTS_EXPOSURES_H
#define CBCT_TESTS_EXPOSURES_H

#include "core/fit/scatter.h"
#include "core/scan/geometry.h"
#include "core/scan/phantom.h"

/*
 * Exposures whose scatter is known from Monte Carlo (montecarlo.h): of plates and bottles that models of scatter are
 * fitted on, and of bodies that they are tried on. On WIDE x HIGH pixels; the scatter has ACROSS x ALONG cells.
 */
enum { WIDE = 100, HIGH = 76, ACROSS = 20, ALONG = 15, CELLS = ACROSS * ALONG };
#define EXPOSED_WATER 0.0192 /* 1/mm */

/* Bilinear between the centres of Monte Carlo's cells. */
double cell_value(const float *cells, int column, int row);

/* Plates that do not cover the beam, and bottles of water. */
enum { FITTED = 6, BOTTLES = 3 /* the first of them */ };
/* Primary and scatter of a view, the first, against air: of those from `first` on; the others have none. */
void exposures_make(const struct geometry *geometry, int photons, int first, struct scatter_exposure ret[FITTED]);
void exposures_clear(struct scatter_exposure exposures[FITTED]);

/*
 * Kernels for that beam whose scatter is `scale` times as much, as another grid makes it. Or, without any, a body, from
 * the bottles alone: a thick plate that does not cover the beam is before or behind the isocentre where rays pass its
 * sides, and no body as the model has it.
 */
int exposures_fit(const struct scatter_exposure exposures[FITTED], const struct scatter_beam *beam, double scale,
		  int kernels, struct scatter_fit *ret, struct error *err);

/* Bodies within 260 mm of the isocentre; flat parts of each, by their centres and radius. */
enum { EXPOSED_HEAD, EXPOSED_THIGH, EXPOSED_ABDOMEN, EXPOSED_BELLY, EXPOSED_PELVIS, EXPOSED_BODIES };
struct exposed_body {
	const char *name;
	struct phantom phantom;
	double flat[4][3];
	double radius;
};
extern const struct exposed_body exposed_bodies[EXPOSED_BODIES];
/* Scattered photons of a view of a body, [cell]. */
void exposed_scatter(const struct phantom *phantom, const struct geometry *geometry, int view, int photons,
		     unsigned long long seed, float ret[CELLS]);

#endif

#ifndef CBCT_CLIENTS_NOISE_H
#define CBCT_CLIENTS_NOISE_H

#include <stdbool.h>
#include <stdint.h>

#include "core/backend.h"

/*
 * The detector's imperfections, applied to exact line integrals p in this order, each where it is on:
 *
 *   multiplicative A   p (1 - A r), r uniform in 0..1 (the noise of the 2010 study)
 *   photons N          n ~ Poisson(N exp(-p)); p = -ln(max(n, 1) / N)
 *   raw                counts = dark + (flat - dark) n / N, or of exp(-p) without photons;
 *                      rounded and held to 0..65535 for uint16
 *   defects            this share of the detector's pixels is dead: 0 in every view
 *
 * With structure, the flat falls off towards the corners and each pixel has a
 * gain and an offset of its own; without, flat = air everywhere and dark = 0.
 */
struct noise {
	double photons, multiplicative; /* 0: off */
	bool raw;
	enum sample sample; /* of raw counts */
	double air;         /* counts of the open beam in the middle of the detector */
	bool structure;
	double defects; /* 0..1 */
	uint64_t seed;
};

/* The images of a structured detector; both are [rows][columns], the caller's. */
void noise_images(const struct noise *noise, int columns, int rows, float *ret_flat, float *ret_dark);

/*
 * One view: line integrals [rows][columns] -> samples of the scan's type in
 * ret_samples. flat and dark are those of noise_images, or NULL without structure.
 * The same seed and view give the same samples, for any number of threads.
 */
void noise_apply(const struct noise *noise, int view, int columns, int rows, const float *projection, const float *flat,
		 const float *dark, void *ret_samples);

#endif

/* Quantum noise and raw counts: see noise.h. Each row draws from a random stream of its own. */
#include "clients/cbct/noise.h"

#include <math.h>

#include "clients/cbct/rng.h"

/* Streams of the detector itself, far from those of (view, row). */
static const uint64_t STREAM_IMAGES = 1ull << 62, STREAM_DEFECTS = 1ull << 61;

void noise_images(const struct noise *noise, int columns, int rows, float *ret_flat, float *ret_dark)
{
	struct rng rng;

	rng_seed(&rng, noise->seed, STREAM_IMAGES);
	for (int row = 0; row < rows; row++)
		for (int column = 0; column < columns; column++) {
			/* -1..1 from edge to edge. */
			double x = columns > 1 ? 2.0 * column / (columns - 1) - 1 : 0;
			double y = rows > 1 ? 2.0 * row / (rows - 1) - 1 : 0;
			double falloff = 1 - 0.15 * (x * x + y * y), gain = 1 + 0.04 * (rng_uniform(&rng) - 0.5);
			double dark = noise->air * 0.01 * (1 + 0.2 * (rng_uniform(&rng) - 0.5));
			size_t i = (size_t)row * (size_t)columns + (size_t)column;

			ret_dark[i] = (float)dark;
			ret_flat[i] = (float)(dark + noise->air * falloff * gain);
		}
}

/* The share of the open beam that this pixel counts. */
static double transmission(const struct noise *noise, struct rng *rng, double p)
{
	if (noise->photons > 0)
		return rng_poisson(rng, noise->photons * exp(-p)) / noise->photons;
	return exp(-p);
}

static double line_integral(const struct noise *noise, struct rng *rng, double p)
{
	if (noise->photons > 0)
		return -log(fmax(transmission(noise, rng, p), 1 / noise->photons));
	return p;
}

static void row_apply(const struct noise *noise, struct rng *rng, int columns, const float *projection,
		      const float *flat, const float *dark, void *ret_row)
{
	for (int i = 0; i < columns; i++) {
		double p = (double)projection[i];

		if (noise->multiplicative > 0)
			p *= 1 - noise->multiplicative * rng_uniform(rng);
		if (!noise->raw) {
			((float *)ret_row)[i] = (float)line_integral(noise, rng, p);
			continue;
		}
		double zero = dark != NULL ? (double)dark[i] : 0, open = flat != NULL ? (double)flat[i] : noise->air;
		double counts = zero + (open - zero) * transmission(noise, rng, p);

		if (noise->sample == SAMPLE_UINT16)
			((uint16_t *)ret_row)[i] = (uint16_t)fmin(fmax(rint(counts), 0), 65535);
		else
			((float *)ret_row)[i] = (float)counts;
	}
}

static void row_kill(const struct noise *noise, struct rng *rng, int columns, void *ret_row)
{
	bool narrow = noise->raw && noise->sample == SAMPLE_UINT16;

	for (int i = 0; i < columns; i++)
		if (rng_uniform(rng) >= noise->defects)
			continue;
		else if (narrow)
			((uint16_t *)ret_row)[i] = 0;
		else
			((float *)ret_row)[i] = 0;
}

void noise_apply(const struct noise *noise, int view, int columns, int rows, const float *projection, const float *flat,
		 const float *dark, void *ret_samples)
{
	size_t size = noise->raw && noise->sample == SAMPLE_UINT16 ? sizeof(uint16_t) : sizeof(float);

#pragma omp parallel for
	for (int row = 0; row < rows; row++) {
		size_t at = (size_t)row * (size_t)columns;
		void *to = (char *)ret_samples + at * size;
		struct rng rng;

		rng_seed(&rng, noise->seed, (uint64_t)view << 32 | (uint64_t)row);
		row_apply(noise, &rng, columns, projection + at, flat != NULL ? flat + at : NULL,
			  dark != NULL ? dark + at : NULL, to);
		if (noise->defects > 0) {
			rng_seed(&rng, noise->seed, STREAM_DEFECTS | (uint64_t)row);
			row_kill(noise, &rng, columns, to);
		}
	}
}

/*
 * Random numbers: xoshiro256++ (Blackman and Vigna 2021) seeded by splitmix64,
 * and Poisson deviates by counting (small means) and by Hoermann's transformed
 * rejection PTRS (Insurance: Mathematics and Economics 12, 1993), both exact.
 */
#include "clients/cbct/rng.h"

#include <math.h>

/* Golden ratio increments: neighbouring seeds and streams give unrelated states. */
static uint64_t splitmix(uint64_t *state)
{
	uint64_t z = *state += 0x9e3779b97f4a7c15u;

	z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
	z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
	return z ^ (z >> 31);
}

void rng_seed(struct rng *ret_rng, uint64_t seed, uint64_t stream)
{
	uint64_t state = seed;

	state = splitmix(&state) ^ stream;
	for (int i = 0; i < 4; i++)
		ret_rng->state[i] = splitmix(&state);
}

static uint64_t rotate(uint64_t x, int by)
{
	return x << by | x >> (64 - by);
}

static uint64_t rng_next(struct rng *rng)
{
	uint64_t *s = rng->state;
	uint64_t value = rotate(s[0] + s[3], 23) + s[0];
	uint64_t t = s[1] << 17;

	s[2] ^= s[0];
	s[3] ^= s[1];
	s[1] ^= s[2];
	s[0] ^= s[3];
	s[2] ^= t;
	s[3] = rotate(s[3], 45);
	return value;
}

double rng_uniform(struct rng *rng)
{
	return ((double)(rng_next(rng) >> 11) + 0.5) * 0x1p-53;
}

/* Events of a unit-rate process before `mean`: the product of uniforms falls below exp(-mean). */
static double poisson_count(struct rng *rng, double mean)
{
	double limit = exp(-mean), product = rng_uniform(rng);
	int count = 0;

	for (; product > limit; count++)
		product *= rng_uniform(rng);
	return count;
}

/* PTRS, the names of the constants as in the paper's algorithm; for means of 10 and more. */
static double poisson_rejection(struct rng *rng, double mean)
{
	double b = 0.931 + 2.53 * sqrt(mean), a = -0.059 + 0.02483 * b;
	double inverse_alpha = 1.1239 + 1.1328 / (b - 3.4), v_r = 0.9277 - 3.6224 / (b - 2);
	double log_mean = log(mean);

	for (;;) {
		double u = rng_uniform(rng) - 0.5, v = rng_uniform(rng);
		double us = 0.5 - fabs(u), k = floor((2 * a / us + b) * u + mean + 0.43);
		int sign;

		if (us >= 0.07 && v <= v_r)
			return k;
		if (k < 0 || (us < 0.013 && v > us))
			continue;
		/* lgamma_r: the plain one writes to a global. */
		if (log(v * inverse_alpha / (a / (us * us) + b)) <= k * log_mean - mean - lgamma_r(k + 1, &sign))
			return k;
	}
}

double rng_poisson(struct rng *rng, double mean)
{
	return mean < 10 ? poisson_count(rng, mean) : poisson_rejection(rng, mean);
}

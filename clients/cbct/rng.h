#ifndef CBCT_CLIENTS_RNG_H
#define CBCT_CLIENTS_RNG_H

#include <stdint.h>

/*
 * Random numbers that are the same on every machine and for any number of
 * threads: each detector row of each view takes a stream of its own.
 */
struct rng {
	uint64_t state[4];
};

void rng_seed(struct rng *ret_rng, uint64_t seed, uint64_t stream);
/* Uniform in the open interval 0..1, 53 bits. */
double rng_uniform(struct rng *rng);
/* Poisson distributed with this mean (>= 0), exact for every mean. */
double rng_poisson(struct rng *rng, double mean);

#endif

#ifndef CBCT_CORE_RECON_MOMENTUM_H
#define CBCT_CORE_RECON_MOMENTUM_H

#include "core/recon/algorithm.h"

/*
 * Nesterov's extrapolation (Soviet Math. Dokl. 27, 1983; with ordered subsets: Kim, Ramani and Fessler, IEEE Trans.
 * Med. Imaging 34, 2015), once an iteration, whatever that is: iteration k + 1 begins at
 *
 *   z = v_k + (t_k - 1) / t_(k+1) (v_k - v_(k-1)),  t_(k+1) = (1 + sqrt(1 + 4 t_k^2)) / 2
 *
 * where v_k is what the loop made of iteration k, TV included. t_1 is 2, not 1 as in FISTA (Beck and Teboulle, SIAM J.
 * Imaging Sci. 2, 2009), so that the second iteration has momentum already (tests/bench/results/algorithms.txt). Where
 * the residual has risen, t begins anew (O'Donoghue and Candes, Found. Comput. Math. 15, 2015): the next iteration is
 * one without momentum. One thread at a time.
 */
struct momentum {
	struct volume *previous; /* v_(k-1), one of problem.volumes */
	/* Numbers that a resumed run needs beside it; all 0 before the first iteration. */
	struct momentum_numbers {
		double t;        /* t_k; 0 after a restart too */
		double residual; /* ||p - A v||^2 / ||p||^2 of the last iteration */
	} numbers;
};

/* The iterate, which problem.before has a copy of, becomes z. */
int momentum_extrapolate(const struct problem *problem, struct momentum *momentum, struct error *err);
/* Begins anew where the residual has risen. */
void momentum_heed(struct momentum *momentum, const struct iteration_sums *sums);

/* The momentum's part of a checkpoint, see struct algorithm. */
size_t momentum_bytes(const struct problem *problem);
int momentum_save(const struct problem *problem, const struct momentum *momentum, const struct checkpoint_sink *sink,
		  struct error *err);
int momentum_resume(const struct problem *problem, struct momentum *momentum, const char *bytes, struct error *err);

#endif

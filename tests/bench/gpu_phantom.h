#ifndef CBCT_TESTS_BENCH_GPU_PHANTOM_H
#define CBCT_TESTS_BENCH_GPU_PHANTOM_H

#include "core/backend.h"
#include "core/scan/phantom.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Exact line integrals of ellipsoids (12 at most) as seen from these views into slots of a stack of the CUDA backend.
 */
int gpu_phantom_project(const struct phantom *phantom, const struct geometry *geometry, const int *views,
			const int *slots, int count, struct stack *to, struct error *err);

#ifdef __cplusplus
}
#endif

#endif

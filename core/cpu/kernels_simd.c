/* The table of inner loops of one instruction set; see core/cpu/cpu.h. */
#include "core/cpu/simd.h"

#if defined(SIMD_avx512)
#define NAME "AVX-512"
#elif defined(SIMD_avx2)
#define NAME "AVX2"
#else
#define NAME "baseline"
#endif
#define QUOTE2(x) #x
#define QUOTE(x) QUOTE2(x)

const struct cpu_kernels SIMD_NAME(cpu_kernels) = {
    .isa = QUOTE(SIMD_ISA),
    .name = NAME,
    .project = SIMD_NAME(project),
    .backproject = SIMD_NAME(backproject),
    .backproject_matched = SIMD_NAME(backproject_matched),
    .tv_flux = SIMD_NAME(tv_flux),
    .tv_dual = SIMD_NAME(tv_dual),
    .tv_update = SIMD_NAME(tv_update),
    .tgv_dual = SIMD_NAME(tgv_dual),
    .tgv_primal = SIMD_NAME(tgv_primal),
};

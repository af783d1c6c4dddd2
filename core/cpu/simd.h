#ifndef CBCT_CORE_SIMD_H
#define CBCT_CORE_SIMD_H

/*
 * One register of floats, for the files core/NAME_simd.c. The Makefile compiles
 * them once for each instruction set with -DSIMD_ISA=base, avx2 or avx512;
 * core/cpu/cpu.c picks one at run time. Arithmetic is written with the operators of
 * the compilers' vector types; what those lack is here. `base` has no intrinsics
 * and is also what another processor gets.
 */
#include <stdint.h>
#include <string.h>

#include "core/cpu/cpu.h"

#if defined(SIMD_avx512) || defined(SIMD_avx2)
#include <immintrin.h>
#endif

#if defined(SIMD_avx512)
#define LANES 16
#elif defined(SIMD_avx2)
#define LANES 8
#else
#define LANES 4
#endif

#define SIMD_JOIN2(name, isa) name##_##isa
#define SIMD_JOIN(name, isa) SIMD_JOIN2(name, isa)
#define SIMD_NAME(name) SIMD_JOIN(name, SIMD_ISA)

typedef float vf __attribute__((vector_size(LANES * 4)));
typedef int32_t vi __attribute__((vector_size(LANES * 4)));

static inline vf vf_load(const float *from)
{
	vf v;

	memcpy(&v, from, sizeof(v));
	return v;
}

static inline void vf_store(float *to, vf v)
{
	memcpy(to, &v, sizeof(v));
}

/* The first `count` lanes only. */
static inline void vf_store_first(float *to, vf v, int count)
{
	float lane[LANES];

	if (count >= LANES) {
		vf_store(to, v);
		return;
	}
	vf_store(lane, v);
	for (int l = 0; l < count; l++)
		to[l] = lane[l];
}

static inline vf vf_all(float x)
{
	return x - (vf){0};
}

static inline vi vi_all(int32_t x)
{
	return x - (vi){0};
}

/* 0, 1, 2, ... */
static inline vf vf_iota(void)
{
	vf v;

	for (int l = 0; l < LANES; l++)
		v[l] = (float)l;
	return v;
}

static inline vi vi_from(vf v) /* towards zero */
{
	return __builtin_convertvector(v, vi);
}

static inline vf vf_from(vi v)
{
	return __builtin_convertvector(v, vf);
}

/* a b + c, in one rounding where the processor can. */
static inline vf vf_fma(vf a, vf b, vf c)
{
#if defined(SIMD_avx512)
	return (vf)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif defined(SIMD_avx2)
	return (vf)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
	return a * b + c;
#endif
}

static inline vf vf_reciprocal(vf a)
{
#if defined(SIMD_avx512)
	vf guess = (vf)_mm512_rcp14_ps((__m512)a);

	return guess + guess * vf_fma(-a, guess, vf_all(1)); /* Newton's step: 14 bits become all */
#else
	return vf_all(1) / a;
#endif
}

/* Whole and fractional part of what is not negative. */
static inline vi vf_split(vf v, vf *ret_fraction)
{
	vi whole = vi_from(v);

#if defined(SIMD_avx512)
	*ret_fraction = (vf)_mm512_reduce_ps((__m512)v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
#else
	*ret_fraction = v - vf_from(whole);
#endif
	return whole;
}

#if defined(SIMD_avx512)

static inline vf vf_min(vf a, vf b)
{
	return (vf)_mm512_min_ps((__m512)a, (__m512)b);
}

static inline vf vf_max(vf a, vf b)
{
	return (vf)_mm512_max_ps((__m512)a, (__m512)b);
}

static inline vf vf_floor(vf a)
{
	return (vf)_mm512_roundscale_ps((__m512)a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
}

static inline vf vf_sqrt(vf a)
{
	return (vf)_mm512_sqrt_ps((__m512)a);
}

/* from[index] of each lane. */
static inline vf vf_gather(const float *from, vi index)
{
	return (vf)_mm512_i32gather_ps((__m512i)index, from, 4);
}

/* from[index] and from[index + 1]: one gather of 8 bytes is half the work of two of 4. */
static inline void vf_gather_pair(const float *from, vi index, vf *ret_a, vf *ret_b)
{
	__m512i lower = (__m512i)index;
	__m512 first = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(lower), (const void *)from, 4));
	__m512 last = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(lower, 1), (const void *)from, 4));
	const __m512i even = _mm512_set_epi32(30, 28, 26, 24, 22, 20, 18, 16, 14, 12, 10, 8, 6, 4, 2, 0);

	*ret_a = (vf)_mm512_permutex2var_ps(first, even, last);
	*ret_b = (vf)_mm512_permutex2var_ps(first, _mm512_add_epi32(even, _mm512_set1_epi32(1)), last);
}

/* Looks up each lane's index, of which only 0 .. LANES - 1 counts, in a register. */
static inline vf vf_look_up(vf from, vi index)
{
	return (vf)_mm512_permutexvar_ps((__m512i)index, (__m512)from);
}

/* Looks up each lane's index, of which only 0 .. 2 LANES - 1 counts, in two registers. */
static inline vf vf_window(vf low, vf high, vi index)
{
	return (vf)_mm512_permutex2var_ps((__m512)low, (__m512i)index, (__m512)high);
}

/* a where the index is at least `least`, else b. */
static inline vf vf_where_reached(vi index, int least, vf a, vf b)
{
	return (vf)_mm512_mask_mov_ps((__m512)b, _mm512_cmpge_epi32_mask((__m512i)index, _mm512_set1_epi32(least)),
				      (__m512)a);
}

#elif defined(SIMD_avx2)

static inline vf vf_min(vf a, vf b)
{
	return (vf)_mm256_min_ps((__m256)a, (__m256)b);
}

static inline vf vf_max(vf a, vf b)
{
	return (vf)_mm256_max_ps((__m256)a, (__m256)b);
}

static inline vf vf_floor(vf a)
{
	return (vf)_mm256_floor_ps((__m256)a);
}

static inline vf vf_sqrt(vf a)
{
	return (vf)_mm256_sqrt_ps((__m256)a);
}

static inline vf vf_gather(const float *from, vi index)
{
	return (vf)_mm256_i32gather_ps(from, (__m256i)index, 4);
}

static inline void vf_gather_pair(const float *from, vi index, vf *ret_a, vf *ret_b)
{
	*ret_a = vf_gather(from, index);
	*ret_b = vf_gather(from + 1, index);
}

static inline vf vf_look_up(vf from, vi index)
{
	return (vf)_mm256_permutevar8x32_ps((__m256)from, (__m256i)index);
}

static inline vf vf_window(vf low, vf high, vi index)
{
	__m256 a = _mm256_permutevar8x32_ps((__m256)low, (__m256i)index);
	__m256 b = _mm256_permutevar8x32_ps((__m256)high, (__m256i)index);

	/* bit 3 of the index chooses the register: moved to the sign */
	return (vf)_mm256_blendv_ps(a, b, _mm256_castsi256_ps(_mm256_slli_epi32((__m256i)index, 28)));
}

static inline vf vf_where_reached(vi index, int least, vf a, vf b)
{
	const __m256i reached = _mm256_cmpgt_epi32((__m256i)index, _mm256_set1_epi32(least - 1));

	return (vf)_mm256_blendv_ps((__m256)b, (__m256)a, _mm256_castsi256_ps(reached));
}

#else

static inline vf vf_min(vf a, vf b)
{
	for (int l = 0; l < LANES; l++)
		a[l] = a[l] < b[l] ? a[l] : b[l];
	return a;
}

static inline vf vf_max(vf a, vf b)
{
	for (int l = 0; l < LANES; l++)
		a[l] = a[l] > b[l] ? a[l] : b[l];
	return a;
}

static inline vf vf_floor(vf a)
{
	for (int l = 0; l < LANES; l++)
		a[l] = __builtin_floorf(a[l]);
	return a;
}

static inline vf vf_sqrt(vf a)
{
	for (int l = 0; l < LANES; l++)
		a[l] = __builtin_sqrtf(a[l]);
	return a;
}

static inline vf vf_gather(const float *from, vi index)
{
	vf v;

	for (int l = 0; l < LANES; l++)
		v[l] = from[index[l]];
	return v;
}

static inline void vf_gather_pair(const float *from, vi index, vf *ret_a, vf *ret_b)
{
	*ret_a = vf_gather(from, index);
	*ret_b = vf_gather(from + 1, index);
}

static inline vf vf_look_up(vf from, vi index)
{
	vf v;

	for (int l = 0; l < LANES; l++)
		v[l] = from[index[l] & (LANES - 1)];
	return v;
}

static inline vf vf_window(vf low, vf high, vi index)
{
	float both[2 * LANES];
	vf v;

	vf_store(both, low);
	vf_store(both + LANES, high);
	for (int l = 0; l < LANES; l++)
		v[l] = both[index[l] & (2 * LANES - 1)];
	return v;
}

static inline vf vf_where_reached(vi index, int least, vf a, vf b)
{
	for (int l = 0; l < LANES; l++)
		b[l] = index[l] >= least ? a[l] : b[l];
	return b;
}

#endif

/* Looks up each lane's index, below registers x LANES, in so many registers that follow each other: 2, 4 or 6. */
static inline __attribute__((always_inline)) vf vf_windows(const float *from, int registers, vi index)
{
	vf ret = vf_window(vf_load(from), vf_load(from + LANES), index);

	for (int r = 2; r < registers; r += 2)
		ret =
		    vf_where_reached(index, r * LANES,
				     vf_window(vf_load(from + r * LANES), vf_load(from + (r + 1) * LANES), index), ret);
	return ret;
}

/*
 * Linear interpolation in a row at positions that are not negative and below
 * 2 LANES - 1: two registers hold all that the lanes need, and a permutation does
 * what a gather would.
 */
static inline vf vf_window_sample(vf low, vf high, vf position)
{
	vf fraction;
	vi index = vf_split(position, &fraction);
	vf a = vf_window(low, high, index), b = vf_window(low, high, index + 1);

	return vf_fma(fraction, b - a, a);
}

/* True if LANES samples so far apart fall into such a window, wherever in its first cell the first lies. */
static inline int window_holds(double step)
{
	return (LANES - 1) * (step < 0 ? -step : step) < 2 * LANES - 2;
}

static inline vf vf_clamp(vf v, vf low, vf high)
{
	return vf_min(vf_max(v, low), high);
}

static inline float vf_highest(vf v)
{
	float x = v[0];

	for (int l = 1; l < LANES; l++)
		x = v[l] > x ? v[l] : x;
	return x;
}

static inline float vf_lowest(vf v)
{
	float x = v[0];

	for (int l = 1; l < LANES; l++)
		x = v[l] < x ? v[l] : x;
	return x;
}

/* Functions of each core/cpu/NAME_simd.c for the table in core/cpu/kernels_simd.c; see struct cpu_kernels. */
void SIMD_NAME(project)(const struct plan *plan, int view, int column, int count, const float *volume, float *ret,
			float *ret_length, float *scratch);
bool SIMD_NAME(backproject)(const struct plan *plan, int view, const struct tile *tile, enum backprojection weight,
			    const float *projection, float *sums, float *cover);
void SIMD_NAME(backproject_matched)(const struct plan *plan, int view, const struct tile *tile, const float *projection,
				    float *sums, float *cover, float *scratch);

void SIMD_NAME(tv_flux)(const struct tv_row *row, const struct tv_weights *weights, float epsilon2,
			const struct tv_flux *ret);
void SIMD_NAME(tv_dual)(const struct tv_row *row, const struct tv_weights *weights, float sigma,
			const struct tv_flux *old, const struct tv_flux *ret);
void SIMD_NAME(tv_update)(int count, const struct tv_flux *flux, const struct tv_flux *before,
			  const struct tv_weights *weights, const struct tv_step *step, const float *f, float *v,
			  float *ahead);
void SIMD_NAME(tgv_dual)(const struct tgv_row *row, const struct tgv_step *step);
void SIMD_NAME(tgv_primal)(const struct tgv_row *row, const struct tgv_step *step);

#endif

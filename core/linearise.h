#ifndef CBCT_CORE_LINEARISE_H
#define CBCT_CORE_LINEARISE_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/detector.h"
#include "core/scan/image.h"

/*
 * How raw samples become line integrals, and what one pixel says:
 *
 *   p = -ln((I - dark) / (flat - dark))
 *
 * Every backend, and every correction that looks at samples, reads pixels with the functions here, so that an image
 * that changes the counts is a line of linearise_transmission.
 */
enum sample { SAMPLE_FLOAT32, SAMPLE_UINT16 };
enum quantity { QUANTITY_LINE_INTEGRAL, QUANTITY_INTENSITY };
struct linearise {
	enum sample sample;
	enum quantity quantity;
	double air; /* counts; used where the scan has no flat image */
	/*
	 * [row][column], the images that the scan has (core/scan/image.h), NULL for none; memory that outlives the
	 * plan. A plan is given IMAGE_DEFECTS with the defects that were found beside those of the scan's map
	 * (core/correct/defects.h).
	 */
	const void *image[IMAGE_COUNT];
	double saturation; /* counts at and above this are defects; 0 = 65535 for uint16, none for float32 */
	/* [row][column], not zero: a defect in every view, found by core/correct/stuck.h; NULL for none. */
	const unsigned char *stuck;
	/*
	 * First column, first row, last column, last row, all included: the mean
	 * transmission (I - dark) / (flat - dark) there, defects left out, is each view's
	 * own air, so that p is 0 where the mean is. For QUANTITY_INTENSITY only.
	 */
	bool has_air_region;
	int air_region[4];
	/* p' = sum over k of hardening[k] p^k, the last step before defects are replaced; count 0 for none. */
	const double *hardening;
	int hardening_count;
	/* Of intensities, before all else (core/correct/lag.h, scatter.h); NULL: none. A backend knows neither. */
	const struct lag_model *lag;
	const struct scatter_model *scatter;
	const struct scatter_source *scatter_source; /* where the model has images (core/correct/scatter_images.h) */
	const int *numbers; /* [views], rising: each view's number in the order of time; NULL: its own */
};
enum { HARDENING_MOST = 8 }; /* coefficients */

/* Kinds of pixels; all but PIXEL_GOOD are defects, which struct defect_counts explains. */
enum pixel_kind { PIXEL_GOOD, PIXEL_MAPPED, PIXEL_NOT_FINITE, PIXEL_SATURATED, PIXEL_ZERO, PIXEL_KINDS };

#ifdef __CUDACC__
#define LINEARISE_INLINE static __host__ __device__ __forceinline__
#else
#define LINEARISE_INLINE static inline
#endif

/* The count from which on a sample is saturated; INFINITY: none is. */
static inline float linearise_saturation(const struct linearise *linearise)
{
	if (linearise->saturation > 0)
		return (float)linearise->saturation;
	return linearise->sample == SAMPLE_UINT16 ? 65535.0f : INFINITY;
}

static inline size_t linearise_sample_bytes(const struct linearise *linearise)
{
	return linearise->sample == SAMPLE_UINT16 ? sizeof(uint16_t) : sizeof(float);
}

/* The sample at `at`, [row][column] of one view. */
LINEARISE_INLINE float linearise_sample(const struct linearise *linearise, const void *samples, size_t at)
{
	return linearise->sample == SAMPLE_UINT16 ? (float)((const uint16_t *)samples)[at]
						  : ((const float *)samples)[at];
}

/* The pixel of an image of counts; `without`: where the scan has no such image. */
LINEARISE_INLINE float linearise_counts(const struct linearise *linearise, enum image image, size_t at, double without)
{
	return linearise->image[image] != NULL ? ((const float *)linearise->image[image])[at] : (float)without;
}

LINEARISE_INLINE bool linearise_mapped(const struct linearise *linearise, size_t at)
{
	const void *map = linearise->image[IMAGE_DEFECTS];

	return map != NULL && ((const unsigned char *)map)[at] != 0;
}

/*
 * Counts above the dark that say nothing yet: a whole number beside a dark that is a mean is 0 up to a half. Float
 * counts may be in any unit.
 */
LINEARISE_INLINE float linearise_least(const struct linearise *linearise)
{
	return linearise->sample == SAMPLE_UINT16 ? 0.5f : 0;
}

/* (I - dark) / (flat - dark); anything for a defect. For intensities; the defect map is not used. */
LINEARISE_INLINE enum pixel_kind linearise_transmission(const struct linearise *linearise, float sample, size_t at,
							float saturation, float *ret)
{
	const float dark = linearise_counts(linearise, IMAGE_DARK, at, 0);
	const float above = sample - dark, range = linearise_counts(linearise, IMAGE_FLAT, at, linearise->air) - dark;

	*ret = above / range;
	if (!isfinite(sample) || !isfinite(range) || !(range > 0))
		return PIXEL_NOT_FINITE;
	if (!(sample < saturation))
		return PIXEL_SATURATED;
	return above > linearise_least(linearise) ? PIXEL_GOOD : PIXEL_ZERO;
}

/* p of a pixel, without the view's own air and hardening. */
static inline enum pixel_kind linearise_pixel(const struct linearise *linearise, const void *samples, size_t at,
					      float *ret)
{
	const float sample = linearise_sample(linearise, samples, at);
	enum pixel_kind kind;
	float transmission;

	if (linearise_mapped(linearise, at))
		return PIXEL_MAPPED;
	if (linearise->quantity == QUANTITY_LINE_INTEGRAL) {
		*ret = sample;
		return isfinite(sample) ? PIXEL_GOOD : PIXEL_NOT_FINITE;
	}
	kind = linearise_transmission(linearise, sample, at, linearise_saturation(linearise), &transmission);
	if (kind == PIXEL_GOOD)
		*ret = -logf(transmission);
	return kind;
}

#endif

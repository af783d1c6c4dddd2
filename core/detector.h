#ifndef CBCT_CORE_DETECTOR_H
#define CBCT_CORE_DETECTOR_H

#include <stddef.h>

/* Parameters of what tube, object and detector add to the counts, as plain data: core/correct/scatter.h and lag.h. */

enum { SCATTER_KERNELS_MOST = 4, LAG_TERMS_MOST = 4, SCATTER_IMAGE_MOST = 4096 /* along a side */ };
#define SCATTER_AMPLITUDE_MOST 100
#define SCATTER_EXPONENT_LEAST (-0.9)
#define SCATTER_EXPONENT_MOST 6
#define SCATTER_POWER_MOST 6
#define SCATTER_ASYMMETRY_MOST 1
#define SCATTER_FRACTION_MOST 10
#define SCATTER_BODY_LEAST 0.001 /* of a body's amplitude */
#define SCATTER_MULTIPLE_MOST 10
#define LAG_FRAMES_MOST 10000

/* A Gaussian on the detector that a pencil of the beam makes, see core/correct/scatter.h. */
struct scatter_kernel {
	double amplitude, exponent, power;
	double width_mm; /* standard deviation, on the detector */
	double asymmetry;
};

/*
 * Images of the scatter that somebody else has computed, in counts, over all of the detector: one of each `every`-th
 * projection from the first on, and one of the last. They are numbered by themselves, from 0 on.
 */
struct scatter_images {
	int columns, rows, every; /* columns 0: there are none */
};

/* A body of water about the isocentre, as thick as the primary says, which scatters: core/correct/scatter_body.h. */
struct scatter_body {
	double amplitude; /* 0: there is none */
	double multiple;
};

struct scatter_model {
	double fraction; /* of the primary behind the densest part, the same all over the detector; 0: kernels */
	int count;       /* kernels */
	struct scatter_kernel kernels[SCATTER_KERNELS_MOST];
	struct scatter_body body;     /* in place of both */
	struct scatter_images images; /* in place of all */
};

/* 0 where there are none. */
static inline int scatter_images_count(const struct scatter_images *images, int projections)
{
	return images->columns == 0 ? 0 : (projections - 2 + images->every) / images->every + 1;
}

/* The projection that an image is of. */
static inline int scatter_image_projection(const struct scatter_images *images, int projections, int image)
{
	return image < scatter_images_count(images, projections) - 1 ? image * images->every : projections - 1;
}

/* The image of a projection; -1: it has none of its own. */
static inline int scatter_image_of(const struct scatter_images *images, int projections, int projection)
{
	if (images->columns == 0 || (projection % images->every != 0 && projection != projections - 1))
		return -1;
	return projection == projections - 1 ? scatter_images_count(images, projections) - 1
					     : projection / images->every;
}

static inline size_t scatter_image_bytes(const struct scatter_images *images)
{
	return (size_t)images->columns * (size_t)images->rows * sizeof(float);
}

/* A share of each signal that the detector gives in later frames, falling by a factor of e in so many frames. */
struct lag_term {
	double share, frames;
};

struct lag_model {
	int count;
	struct lag_term terms[LAG_TERMS_MOST];
};

#endif

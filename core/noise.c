/*
 * The noise of a volume, from the volume itself: whatever its source, photons,
 * electronics or too few views, it is measured where it will be removed.
 *
 * Cubes of a few voxels that lie inside the object each give the mean square of
 * differences between voxels that are one and two apart. Noise is in all cubes,
 * edges and texture are in some: the lower quartile of the cubes is taken, after
 * the idea of Immerkaer (Comput. Vis. Image Underst. 64, 1996) and of block methods
 * in general (Olsen, CVGIP: Graph. Models Image Process. 55, 1993). Two distances,
 * because reconstructed noise is correlated: neighbours of a finely sampled volume
 * are alike, and voxels at twice the distance, by the ramp filter, are rather opposite.
 */
#include "core/noise.h"

#include <math.h>
#include <stdlib.h>

/* Side of a cube in voxels: hundreds of differences, and yet places for it in a finger's bone. */
enum { CUBE = 6 };

/* Bone and metal count as so many times the object's mean at most: a screw says nothing of the anatomy's contrast. */
static const double BRIGHT = 2.5;

/*
 * The level between background and object: the mean of both classes' means
 * (Ridler and Calvard, IEEE Trans. Syst. Man Cybern. 8, 1978).
 */
static double level_of(const float *slices, size_t voxels)
{
	const size_t stride = voxels / 200000 + 1;
	double level = 0;

	for (int pass = 0; pass < 20; pass++) {
		double sum[2] = {0, 0}, last = level;
		size_t count[2] = {0, 0};

		for (size_t i = 0; i < voxels; i += stride) {
			const double v = (double)slices[i];

			if (!isfinite(v))
				continue;
			sum[v > level] += v;
			count[v > level]++;
		}
		if (count[1] == 0)
			break;
		level = (sum[1] / (double)count[1] + (count[0] > 0 ? sum[0] / (double)count[0] : 0)) / 2;
		if (fabs(level - last) <= 1e-3 * fabs(level))
			break;
	}
	return level;
}

/* Half the mean square difference of voxels one and two apart along each axis; negative where a voxel is background. */
static float cube_variance(const float *corner, const int side[3], const size_t stride[3], float level)
{
	double sum = 0;
	size_t count = 0;

	for (int z = 0; z < side[2]; z++)
		for (int y = 0; y < side[1]; y++)
			for (int x = 0; x < side[0]; x++) {
				const int place[3] = {x, y, z};
				const float *v =
				    corner + (size_t)z * stride[2] + (size_t)y * stride[1] + (size_t)x * stride[0];

				if (!(*v > level))
					return -1;
				for (int axis = 0; axis < 3; axis++)
					for (int apart = 1; apart <= 2; apart++) {
						if (place[axis] + apart >= side[axis])
							continue;
						const double d = (double)(v[(size_t)apart * stride[axis]] - *v);

						sum += d * d;
						count++;
					}
			}
	return count > 0 ? (float)(sum / (2 * (double)count)) : 0;
}

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

static double contrast_of(const float *slices, size_t voxels, double level, double variance)
{
	const size_t stride = voxels / 200000 + 1;
	double mean = 0, square = 0;
	size_t count = 0;

	for (size_t i = 0; i < voxels; i += stride)
		if ((double)slices[i] > level && isfinite(slices[i])) {
			mean += (double)slices[i];
			count++;
		}
	if (count == 0)
		return 0;
	mean /= (double)count;
	for (size_t i = 0; i < voxels; i += stride)
		if ((double)slices[i] > level && isfinite(slices[i])) {
			const double d = fmin((double)slices[i], BRIGHT * mean) - mean;

			square += d * d;
		}
	return sqrt(fmax(0, square / (double)count - variance));
}

int noise_of_slices(const float *slices, const int size[3], struct volume_noise *ret_noise, struct error *err)
{
	const size_t stride[3] = {1, (size_t)size[0], (size_t)size[0] * (size_t)size[1]};
	const size_t voxels = stride[2] * (size_t)size[2];
	const double level = level_of(slices, voxels);
	int side[3], cubes[3];
	size_t all = 1, inside = 0;
	float *variances;

	for (int a = 0; a < 3; a++) {
		side[a] = size[a] < CUBE ? size[a] : CUBE;
		cubes[a] = size[a] / side[a];
		all *= (size_t)cubes[a];
	}
	variances = malloc(all * sizeof(*variances));
	if (variances == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the noise of %zu cubes", all);
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < all; i++) {
		const size_t x = i % (size_t)cubes[0], y = i / (size_t)cubes[0] % (size_t)cubes[1],
			     z = i / ((size_t)cubes[0] * (size_t)cubes[1]);

		variances[i] = cube_variance(slices + (size_t)side[2] * z * stride[2] +
						 (size_t)side[1] * y * stride[1] + (size_t)side[0] * x,
					     side, stride, (float)level);
	}
	for (size_t i = 0; i < all; i++)
		if (variances[i] >= 0)
			variances[inside++] = variances[i];
	qsort(variances, inside, sizeof(*variances), compare_floats);
	*ret_noise = (struct volume_noise){.sigma = inside > 0 ? sqrt((double)variances[inside / 4]) : 0};
	ret_noise->contrast = contrast_of(slices, voxels, level, ret_noise->sigma * ret_noise->sigma);
	free(variances);
	return 0;
}

/*
 * How far medium TV moves a voxel, from phantoms of heads, wrists, necks and abdomens (tests/bench/denoise.c): the
 * balance with the least error beside the truth. The FDK volume is blurred already, and TV blurs its edges further:
 * there is nothing to be won before the noise exceeds a fortieth of the contrast. SART's iterations take up noise
 * again each time, and overshoot at edges by a share of the contrast, which grows when nothing holds it.
 */
static const double ALPHA_MOST = 1e9; /* beyond it, TV moves nothing that a float of a gray level could tell */
static const double FDK_NOISE = 0.35, FDK_CONTRAST = 0.025, SART_NOISE = 0.2, SART_CONTRAST = 0.025;

double noise_alpha(const struct volume_noise *noise, enum tv_strength strength, enum noise_stage stage, double unit)
{
	static const double factors[TV_STRENGTH_COUNT] = {[TV_LIGHT] = 0.5, [TV_MEDIUM] = 1, [TV_STRONG] = 2};
	const double after_fdk = FDK_NOISE * fmax(0, noise->sigma - FDK_CONTRAST * noise->contrast);
	const double after_sart = hypot(SART_NOISE * noise->sigma, SART_CONTRAST * noise->contrast);

	const double alpha = unit / (factors[strength] * (stage == NOISE_OF_FDK ? after_fdk : after_sart));

	return alpha <= ALPHA_MOST ? alpha : INFINITY;
}

double noise_reach(const struct tv_options *options)
{
	const double steps = options->step * options->iterations, balanced = 1 / options->alpha;

	return options->unit * (options->method == TV_PROXIMAL ? balanced : fmin(steps, balanced));
}

int noise_measure(const struct backend *backend, struct volume *volume, const struct grid *grid,
		  struct volume_noise *ret_noise, struct error *err)
{
	const int count = grid->size[2] < NOISE_SLICES ? grid->size[2] : NOISE_SLICES;
	const int size[3] = {grid->size[0], grid->size[1], count};
	float *slices = malloc(sizeof(*slices) * (size_t)size[0] * (size_t)size[1] * (size_t)count);
	int code;

	if (slices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d slices", count);
	code = backend->volume_download(volume, (grid->size[2] - count) / 2, count, slices, err);
	if (code == 0)
		code = noise_of_slices(slices, size, ret_noise, err);
	free(slices);
	return code;
}

/*
 * The noise of a volume, from the volume itself: whatever its source, photons,
 * electronics or too few views, it is measured where it will be removed.
 *
 * Cubes of a few voxels that lie in the object each give the mean square of
 * differences between voxels that are one and two apart. Noise is in all cubes,
 * edges and texture are in some: the lower quartile of the cubes is taken, as block
 * methods do (Olsen, CVGIP: Graph. Models Image Process. 55, 1993). Two distances,
 * because reconstructed noise is correlated: neighbours of a finely sampled volume
 * are alike, and voxels at twice the distance, by the ramp filter, are rather opposite.
 */
#include "core/noise.h"

#include <math.h>
#include <stdlib.h>

#include "core/sart.h"

/*
 * Sides of a cube in voxels: hundreds of differences in the first. Where less than CUBES_LEAST of them fit into the
 * object, a finger or a few slices, the next one is tried. Of a large volume some cubes are left out.
 */
static const int sides[] = {6, 4, 3};
enum { SIDES = sizeof(sides) / sizeof(sides[0]), CUBES_LEAST = 12, CUBES_MOST = 40000 };

/* A cube lies in the object when its mean is so much of the object's: fat counts, lung and a rim of air do not. */
static const double INSIDE = 0.8;

/* Bone and metal count as so many times the object's mean at most: a screw says nothing of the anatomy's contrast. */
static const double BRIGHT = 2.5;

/* Voxels above `level` are the object. */
struct classes {
	double level, mean; /* mean: of the object */
};

/*
 * The level between background and object: the mean of both classes' means
 * (Ridler and Calvard, IEEE Trans. Syst. Man Cybern. 8, 1978).
 */
static struct classes classes_of(const float *slices, size_t voxels)
{
	const size_t stride = voxels / 200000 + 1;
	struct classes classes = {0};

	for (int pass = 0; pass < 20; pass++) {
		const double last = classes.level;
		double sum[2] = {0, 0};
		size_t count[2] = {0, 0};

		for (size_t i = 0; i < voxels; i += stride) {
			const double v = (double)slices[i];

			if (!isfinite(v))
				continue;
			sum[v > last] += v;
			count[v > last]++;
		}
		if (count[1] == 0)
			break;
		classes.mean = sum[1] / (double)count[1];
		classes.level = (classes.mean + (count[0] > 0 ? sum[0] / (double)count[0] : 0)) / 2;
		if (fabs(classes.level - last) <= 1e-3 * fabs(classes.level))
			break;
	}
	return classes;
}

/* Half the mean square difference of voxels one and two apart along each axis; negative where the mean is below
 * `least`.
 */
static float cube_variance(const float *corner, const int side[3], const size_t stride[3], double least)
{
	double square = 0, sum = 0;
	size_t count = 0;

	for (int z = 0; z < side[2]; z++)
		for (int y = 0; y < side[1]; y++)
			for (int x = 0; x < side[0]; x++) {
				const int place[3] = {x, y, z};
				const float *v =
				    corner + (size_t)z * stride[2] + (size_t)y * stride[1] + (size_t)x * stride[0];

				sum += (double)*v;
				for (int axis = 0; axis < 3; axis++)
					for (int apart = 1; apart <= 2; apart++) {
						if (place[axis] + apart >= side[axis])
							continue;
						const double d = (double)(v[(size_t)apart * stride[axis]] - *v);

						square += d * d;
						count++;
					}
			}
	if (!(sum >= least * side[0] * side[1] * side[2]) || count == 0 || !isfinite(square))
		return -1;
	return (float)(square / (2 * (double)count));
}

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

static double contrast_of(const float *slices, size_t voxels, const struct classes *classes, double variance)
{
	const size_t stride = voxels / 200000 + 1;
	double square = 0;
	size_t count = 0;

	for (size_t i = 0; i < voxels; i += stride)
		if ((double)slices[i] > classes->level && isfinite(slices[i])) {
			const double d = fmin((double)slices[i], BRIGHT * classes->mean) - classes->mean;

			square += d * d;
			count++;
		}
	return count > 0 ? sqrt(fmax(0, square / (double)count - variance)) : 0;
}

/*
 * The lower quartile of the variances of cubes with this side, which overlap by half or, in a large volume, lie
 * apart; *ret_count of them lie in the object.
 */
static int quartile_of_cubes(const float *slices, const int size[3], int side, double least, double *ret_variance,
			     size_t *ret_count, struct error *err)
{
	const size_t stride[3] = {1, (size_t)size[0], (size_t)size[0] * (size_t)size[1]};
	int sides3[3], cubes[3], step = (side + 1) / 2;
	size_t all, inside = 0;
	float *variances;

	for (;; step++) {
		all = 1;
		for (int a = 0; a < 3; a++) {
			sides3[a] = size[a] < side ? size[a] : side;
			cubes[a] = (size[a] - sides3[a]) / step + 1;
			all *= (size_t)cubes[a];
		}
		if (all <= CUBES_MOST)
			break;
	}
	variances = malloc(all * sizeof(*variances));
	if (variances == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the noise of %zu cubes", all);
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < all; i++) {
		const size_t place[3] = {i % (size_t)cubes[0], i / (size_t)cubes[0] % (size_t)cubes[1],
					 i / ((size_t)cubes[0] * (size_t)cubes[1])};

		variances[i] =
		    cube_variance(slices + (size_t)step * (place[0] + place[1] * stride[1] + place[2] * stride[2]),
				  sides3, stride, least);
	}
	for (size_t i = 0; i < all; i++)
		if (variances[i] >= 0)
			variances[inside++] = variances[i];
	qsort(variances, inside, sizeof(*variances), compare_floats);
	*ret_variance = inside > 0 ? (double)variances[inside / 4] : 0;
	*ret_count = inside;
	free(variances);
	return 0;
}

int noise_of_slices(const float *slices, const int size[3], struct volume_noise *ret_noise, struct error *err)
{
	const size_t voxels = (size_t)size[0] * (size_t)size[1] * (size_t)size[2];
	const struct classes classes = classes_of(slices, voxels);
	double variance = 0;
	size_t count = 0;
	int code = 0;

	if (classes.mean > 0)
		for (int i = 0; i < SIDES && code == 0 && count < CUBES_LEAST; i++)
			code = quartile_of_cubes(slices, size, sides[i], INSIDE * classes.mean, &variance, &count, err);
	if (code < 0)
		return code;
	*ret_noise =
	    (struct volume_noise){.sigma = sqrt(variance), .contrast = contrast_of(slices, voxels, &classes, variance)};
	return 0;
}

/*
 * How far medium TV moves a voxel, from phantoms of heads, wrists, necks and abdomens (tests/bench/denoise.c): the
 * balance with the least error beside the truth. The FDK volume is blurred already, and TV blurs its edges further:
 * there is nothing to be won before the noise exceeds a fortieth of the contrast. SART's iterations take up noise
 * again each time, the more updates they have, and overshoot at edges by a share of the contrast, the more the fewer
 * views an update has. Both are given for ten updates of ten views; how they go with
 * the updates was measured from one of 80 views to 80 of one.
 */
static const double FDK_NOISE = 0.35, FDK_CONTRAST = 0.025, SART_NOISE = 0.18, SART_CONTRAST = 0.035;
static const double UPDATES = 10, VIEWS = 10;
/* Beyond it, TV moves nothing that a float of a gray level could tell. */
static const double ALPHA_MOST = 1e9;

static double reach_after_fdk(const struct volume_noise *noise)
{
	return FDK_NOISE * fmax(0, noise->sigma - FDK_CONTRAST * noise->contrast);
}

static double reach_after_sart(const struct volume_noise *noise, const struct recipe *recipe, int views)
{
	const double subsets = subsets_count(recipe->sart.subsets, views), step = recipe->sart.relaxation;

	return hypot(SART_NOISE * noise->sigma * step * subsets / UPDATES,
		     SART_CONTRAST * noise->contrast * sqrt(step * VIEWS * subsets / views));
}

double noise_alpha(const struct volume_noise *noise, const struct recipe *recipe, int views, enum noise_stage stage)
{
	static const double factors[TV_STRENGTH_COUNT] = {[TV_LIGHT] = 0.5, [TV_MEDIUM] = 1, [TV_STRONG] = 2};
	const double reach = stage == NOISE_OF_FDK ? reach_after_fdk(noise) : reach_after_sart(noise, recipe, views);
	const double alpha = recipe->tv.options.unit / (factors[recipe->tv.strength] * reach);

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

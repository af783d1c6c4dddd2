/*
 * The noise of a volume, from the volume itself, where TV will remove it.
 *
 * Cubes of a few voxels that lie in the object each give the mean square of mixed
 * differences, v(x, z) - v(x + 2, z) - v(x, z + 2) + v(x + 2, z + 2), and the same with y.
 * White noise of variance s^2 makes that 4 s^2. A slope or an edge along an axis
 * cancels, and so do the streaks of few views, which hardly change from slice to
 * slice: they are no noise, and stronger TV takes small contrasts with them. Voxels
 * two apart, because reconstructed noise is correlated and neighbours of a finely
 * sampled volume are alike. Noise is in all cubes, edges and texture are in some:
 * the lower quartile of the cubes is taken, as block methods do (Olsen, CVGIP: Graph.
 * Models Image Process. 55, 1993). Beside metal that is bounded by the quietest of them.
 */
#include "core/recon/noise.h"

#include <math.h>
#include <stdlib.h>

#include "core/correct/averaging.h"
#include "core/recon/algorithm.h"
#include "core/recon/recon.h"

/*
 * Sides of a cube in voxels: hundreds of mixed differences in the first. Where less than CUBES_LEAST of them fit into
 * the object, a finger or a few slices, the next one is tried. Of a large volume some cubes are left out.
 */
static const int sides[] = {6, 4, 3};
enum { SIDES = sizeof(sides) / sizeof(sides[0]), CUBES_LEAST = 12, CUBES_MOST = 20000 };

/* Voxels that the object's level, mean and contrast are taken from, about. */
enum { SAMPLES = 100000 };

/*
 * A cube lies in the object when its mean is so much of the object's: fat counts, lung and a rim of air do not. Behind
 * a thick skull the brain is below that of the mean, and the median is the brain's: cubes of the shell alone would tell
 * its edges for noise.
 */
static const double INSIDE = 0.8;

/* Bone and metal count as so many times the object's mean at most: a screw says nothing of the anatomy's contrast. */
static const double BRIGHT = 2.5;
/* Times water's attenuation, which bone does not reach. */
static const double METAL = 3.1;

/*
 * Beside metal all cubes but a few may have an edge or a streak: between screws the lower quartile was 107 HU where
 * even tissue had 3. Noise is in all of them, so that the lowest tenth of those without metal is little below the
 * quartile, by less than this. A bound and no measure, and only where FDK's edges are as sharp as voxels: streaks are
 * mostly worth being taken for noise (tests/bench/results/denoise.txt).
 */
static const double ALIKE = 4;
/* Parts of the cubes. */
enum { QUARTER = 4, TENTH = 10 };

/* Voxels above `level` are the object. */
struct classes {
	double level, mean, median; /* of the object */
};

/*
 * The value from which on voxels are metal and no part of the object, INFINITY where there is none. Beside a cup of
 * steel, body and air would be one class, and the cup's edges the noise. An object that is metal itself has more of
 * that than of anything between half of water and metal.
 */
static float metal_of(const float *slices, size_t voxels, double mu_water)
{
	const size_t stride = voxels / SAMPLES + 1;
	const float metal = (float)(METAL * mu_water), body = (float)(mu_water / 2);
	size_t dense = 0, object = 0;

	for (size_t i = 0; i < voxels; i += stride) {
		dense += slices[i] >= metal;
		object += slices[i] >= body && slices[i] < metal;
	}
	return dense > 0 && dense < object ? metal : INFINITY;
}

/*
 * The level between background and object: the mean of both classes' means
 * (Ridler and Calvard, IEEE Trans. Syst. Man Cybern. 8, 1978).
 */
static struct classes classes_of(const float *slices, size_t voxels, float metal)
{
	const size_t stride = voxels / SAMPLES + 1;
	struct classes classes = {0};

	for (int pass = 0; pass < 20; pass++) {
		const double last = classes.level;
		double sum[2] = {0, 0};
		size_t count[2] = {0, 0};

		for (size_t i = 0; i < voxels; i += stride) {
			const double v = (double)slices[i];

			if (!isfinite(v) || slices[i] >= metal)
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

/* The pairs of axes of the mixed differences: both with z, or of a single slice x with y. */
static const int with_z[2][2] = {{0, 2}, {1, 2}}, in_slice[1][2] = {{0, 1}};
enum { APART = 2 }; /* voxels */

/* Sum of squares of the cube's mixed differences along two axes; *ret_count gets their number added. */
static double mixed_differences(const float *corner, const int side[3], const size_t stride[3], const int axes[2],
				size_t *ret_count)
{
	const size_t a = APART * stride[axes[0]], b = APART * stride[axes[1]];
	int count[3] = {side[0], side[1], side[2]};
	double square = 0;

	for (int i = 0; i < 2; i++)
		count[axes[i]] = side[axes[i]] > APART ? side[axes[i]] - APART : 0;
	for (int z = 0; z < count[2]; z++)
		for (int y = 0; y < count[1]; y++)
			for (int x = 0; x < count[0]; x++) {
				const float *v =
				    corner + (size_t)z * stride[2] + (size_t)y * stride[1] + (size_t)x * stride[0];
				const double d = (double)((v[a + b] - v[a]) - (v[b] - v[0]));

				square += d * d;
			}
	*ret_count += (size_t)count[0] * (size_t)count[1] * (size_t)count[2];
	return square;
}

static double cube_mean(const float *corner, const int side[3], const size_t stride[3])
{
	double sum = 0;

	for (int z = 0; z < side[2]; z++)
		for (int y = 0; y < side[1]; y++)
			for (int x = 0; x < side[0]; x++)
				sum += (double)
				    corner[(size_t)z * stride[2] + (size_t)y * stride[1] + (size_t)x * stride[0]];
	return sum / ((double)side[0] * side[1] * side[2]);
}

/* The cubes that count: their mean is at least `least`, and all of their voxels are below `metal`. */
struct inside {
	double least;
	float metal;
};

static bool cube_has_metal(const float *corner, const int side[3], const size_t stride[3], float metal)
{
	for (int z = 0; z < side[2]; z++)
		for (int y = 0; y < side[1]; y++)
			for (int x = 0; x < side[0]; x++)
				if (corner[(size_t)z * stride[2] + (size_t)y * stride[1] + (size_t)x * stride[0]] >=
				    metal)
					return true;
	return false;
}

/* The variance of white noise with these mixed differences; negative where the cube does not count. */
static float cube_variance(const float *corner, const int side[3], const size_t stride[3], const struct inside *inside)
{
	const bool deep = side[2] > APART;
	double square = 0;
	size_t count = 0;

	if (!(cube_mean(corner, side, stride) >= inside->least))
		return -1;
	if (isfinite(inside->metal) && cube_has_metal(corner, side, stride, inside->metal))
		return -1;
	for (int i = 0; i < (deep ? 2 : 1); i++)
		square += mixed_differences(corner, side, stride, deep ? with_z[i] : in_slice[i], &count);
	return count > 0 && isfinite(square) ? (float)(square / (4 * (double)count)) : -1;
}

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

/* The median of the object. ERR_NO_MEMORY. */
static int find_median(const float *slices, size_t voxels, float metal, struct classes *classes, struct error *err)
{
	const size_t stride = voxels / SAMPLES + 1;
	float *values = malloc(sizeof(*values) * (voxels / stride + 1));
	size_t count = 0;

	if (values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the median of %zu voxels", voxels);
	for (size_t i = 0; i < voxels; i += stride)
		if ((double)slices[i] > classes->level && isfinite(slices[i]) && slices[i] < metal)
			values[count++] = slices[i];
	qsort(values, count, sizeof(*values), compare_floats);
	classes->median = count > 0 ? (double)values[count / 2] : 0;
	free(values);
	return 0;
}

static double contrast_of(const float *slices, size_t voxels, const struct classes *classes, double variance)
{
	const size_t stride = voxels / SAMPLES + 1;
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
 * The lowest quantile, one part of `parts`, of the variances of cubes with this side, which overlap by half or, in a
 * large volume, lie apart; *ret_count of them count.
 */
static int quantile_of_cubes(const float *slices, const int size[3], int side, const struct inside *inside,
			     size_t parts, double *ret_variance, size_t *ret_count, struct error *err)
{
	const size_t stride[3] = {1, (size_t)size[0], (size_t)size[0] * (size_t)size[1]};
	int sides3[3], cubes[3], step = (side + 1) / 2;
	size_t all, count = 0;
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
				  sides3, stride, inside);
	}
	for (size_t i = 0; i < all; i++)
		if (variances[i] >= 0)
			variances[count++] = variances[i];
	qsort(variances, count, sizeof(*variances), compare_floats);
	*ret_variance = count > 0 ? (double)variances[count / parts] : 0;
	*ret_count = count;
	free(variances);
	return 0;
}

/* The same of the largest cubes of which enough count. */
static int quantile(const float *slices, const int size[3], const struct inside *inside, size_t parts,
		    double *ret_variance, size_t *ret_count, struct error *err)
{
	int code = 0;

	*ret_count = 0;
	for (int i = 0; i < SIDES && code == 0 && *ret_count < CUBES_LEAST; i++)
		code = quantile_of_cubes(slices, size, sides[i], inside, parts, ret_variance, ret_count, err);
	return code;
}

int noise_of_slices(const float *slices, const int size[3], double mu_water, double sharp,
		    struct volume_noise *ret_noise, struct error *err)
{
	const size_t voxels = (size_t)size[0] * (size_t)size[1] * (size_t)size[2];
	const float metal = metal_of(slices, voxels, mu_water);
	struct classes classes = classes_of(slices, voxels, metal);
	const bool bounded = sharp > 0 && isfinite(metal);
	double variance = 0, quiet = 0;
	size_t count = 0;
	int code = classes.mean > 0 ? find_median(slices, voxels, metal, &classes, err) : 0;

	if (code == 0 && classes.mean > 0) {
		const double least = INSIDE * fmin(classes.mean, classes.median);

		code = quantile(slices, size, &(struct inside){least, INFINITY}, QUARTER, &variance, &count, err);
		if (code == 0 && bounded)
			code = quantile(slices, size, &(struct inside){least, metal}, TENTH, &quiet, &count, err);
		if (code == 0 && bounded && count >= CUBES_LEAST)
			variance = fmin(variance, pow(ALIKE / sharp, 2) * quiet);
	}
	if (code < 0)
		return code;
	*ret_noise =
	    (struct volume_noise){.sigma = sqrt(variance), .contrast = contrast_of(slices, voxels, &classes, variance)};
	return 0;
}

/* Parts of the contrast: less noise is believed; and what the bound leaves to streaks. Times the projections' noise. */
static const double DOUBTFUL = 0.1, STREAKS = 0.01, TIMES = 2;

bool noise_is_doubtful(const struct volume_noise *noise, const struct recipe *recipe, const struct orbit *orbit)
{
	double pixels[2];

	averaging_pixels(orbit, &recipe->grid, pixels);
	return pixels[0] > SETTLING_NONE && noise->sigma > DOUBTFUL * noise->contrast;
}

/*
 * The mean over n views of filtered noise at the isocentre: pi^2 / (n p^2) times the power of the filter's response, p
 * being the pixel there (Kak and Slaney, Principles of Computerized Tomographic Imaging, ch. 5). Of a displaced
 * detector half of the views see the outer places.
 */
struct volume_noise noise_bounded(const struct volume_noise *noise, const struct orbit *orbit, double variance,
				  const float *response, int length)
{
	const double views = orbit->displaced ? 0.5 * orbit->count : orbit->count;
	struct volume_noise ret = *noise;
	double power = 0, propagated;

	for (int k = 0; k <= length / 2; k++)
		power += (k == 0 || 2 * k == length ? 1 : 2) * (double)response[k] * (double)response[k] / length;
	propagated = M_PI * sqrt(variance * power / views) / orbit->pixel_at_isocentre[0];
	ret.sigma = fmin(ret.sigma, TIMES * propagated + STREAKS * ret.contrast);
	return ret;
}

/*
 * How far medium TV moves a voxel: the balance with the least error beside the truth, or a weaker one where the error
 * hardly changes and small contrasts stay. From phantoms of heads, wrists, necks and abdomens (tests/bench/denoise.c,
 * and results/denoise.txt beside it, which has other rules, too).
 *
 * The FDK volume is blurred already, and TV blurs its edges further: there is nothing to be won before the noise
 * exceeds a fortieth of the contrast.
 */
static const double FDK_NOISE = 0.35, FDK_CONTRAST = 0.025;

/*
 * SART takes up noise again in each iteration, the more updates that has (measured from 1 to 80). Of FDK's noise it
 * knows what the grid can hold: pixels that are finer than the voxels bring FDK noise that SART's rays average away.
 * The power of the noise is just below 1: where there is little noise, the grid's own error adds to it.
 */
static const double SART_NOISE = 0.2, NOISE_POWER = 0.85, FINENESS_POWER = 0.9, FINENESS_MOST = 2, UPDATES = 10;

/*
 * SART's artefacts beside noise go with the contrast. Few views leave streaks. Where the detector resolves more than
 * the grid can hold (`fineness`, pixel over voxel, below FINE), strong edges overshoot: that is bone, and the third
 * power of the contrast beside STRONG of water's attenuation tells it from soft tissue. Where pixels are finer
 * still, they are averaged if they show edges (core/correct/averaging.h), and AVERAGED of it is left. The default's
 * mean leaves as much of what contrasts up to STRONG have, less of stronger ones, since by the third power a thick
 * skull had 50 HU an iteration, and nothing where noise is NOISY of the contrast: TV takes enough for that.
 */
static const double FEW = 0.012, FEW_VIEWS = 60, FEWEST_VIEWS = 40;
static const double EDGES = 0.057, FINE = 0.63, STRONG = 0.28, AVERAGED = 0.25, NOISY = 0.1;

/* Beyond it, TV moves nothing that a float of a gray level could tell. */
static const double ALPHA_MOST = 1e9;

static double reach_after_fdk(const struct volume_noise *noise)
{
	return FDK_NOISE * fmax(0, noise->sigma - FDK_CONTRAST * noise->contrast);
}

static double reach_after_sart(const struct volume_noise *noise, const struct recipe *recipe, const struct orbit *orbit)
{
	const double *mm = recipe->grid.spacing, *pixel = orbit->pixel_at_isocentre;
	const double fineness = sqrt(pixel[0] * pixel[1]) / cbrt(mm[0] * mm[1] * mm[2]);
	const double updates = recipe_updates(recipe, orbit) / UPDATES;
	const double averaged = recipe_averages(recipe, orbit) ? averaging_part(1 / fineness) : 0;
	const double streaks = FEW * pow(FEW_VIEWS / fmax(orbit->count, FEWEST_VIEWS), 4);
	const struct averaging_mean mean = averaging_mean(recipe);
	const double left = 1 - (1 - AVERAGED) * averaging_fineness(&mean, 1 / fineness);
	const double strong = noise->contrast / (STRONG * recipe->mu_water);
	const double beside =
	    AVERAGED * pow(fmin(strong, 1 / strong), 3) * fmax(0, 1 - noise->sigma / (NOISY * noise->contrast));
	const double overshoot = (1 - averaged) * pow(strong, 3) + averaged * beside;
	const double edges = EDGES * left * fmax(0, 1 - pow(fineness / FINE, 4)) * overshoot;
	const double noisy = SART_NOISE * pow(noise->sigma, NOISE_POWER) * pow(noise->contrast, 1 - NOISE_POWER) *
			     pow(fmin(fineness, FINENESS_MOST), FINENESS_POWER);

	return updates * noisy + sqrt(updates) * noise->contrast * (streaks + edges);
}

double noise_alpha(const struct volume_noise *noise, const struct recipe *recipe, const struct orbit *orbit,
		   enum noise_stage stage)
{
	static const double factors[TV_STRENGTH_COUNT] = {[TV_LIGHT] = 0.5, [TV_MEDIUM] = 1, [TV_STRONG] = 2};
	const double reach = stage == NOISE_OF_FDK ? reach_after_fdk(noise) : reach_after_sart(noise, recipe, orbit);
	const double alpha = recipe->tv.options.unit / (factors[recipe->tv.strength] * reach);

	return alpha <= ALPHA_MOST ? alpha : INFINITY;
}

double noise_reach(const struct tv_options *options)
{
	const double steps = options->step * options->iterations, balanced = 1 / options->alpha;

	return options->unit * (options->method == TV_GRADIENT ? fmin(steps, balanced) : balanced);
}

int noise_measure(const struct backend *backend, struct volume *volume, const struct grid *grid, double mu_water,
		  double sharp, struct volume_noise *ret_noise, struct error *err)
{
	const int count = grid->size[2] < NOISE_SLICES ? grid->size[2] : NOISE_SLICES;
	const int size[3] = {grid->size[0], grid->size[1], count};
	float *slices = malloc(sizeof(*slices) * (size_t)size[0] * (size_t)size[1] * (size_t)count);
	int code;

	if (slices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d slices", count);
	code = backend->volume_download(volume, (grid->size[2] - count) / 2, count, slices, err);
	if (code == 0)
		code = noise_of_slices(slices, size, mu_water, sharp, ret_noise, err);
	free(slices);
	return code;
}

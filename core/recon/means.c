/* FDK's means over voxels, in volumes that are kept: see means.h. */
#include "core/recon/means.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/restraint_places.h"

/* R's variance in those of a voxel: up to the first all is done, nothing from the second on. */
static const double WHOLE = 1.5, NONE = 2;
/* Of D, where all of it is certain. */
static const float MOST = 0.8f;
/* Of <E^2>: halves have streaks of half as many views, most of which all together have not. */
static const float COUNTED = 0.25f;
/* q of objects that are made of voxels, and of bodies. */
static const double VOXELS = 0.24, BODY = 0.29;
/* What halves have in common is known where it is so many times what chance alone makes of it. */
static const double CERTAIN = 10;
/* <D^2> and <E^2> are over so many voxels to either side. */
enum { BESIDE = 1 };
enum { MIDDLE = MEANS_PLACES };
/* s, the root of <E^2>, is kept in a byte: so many steps double it, and the first one is so many HU. */
static const float STEPS = 16, FIRST = 0.25f;

struct means {
	struct means_options of;
	struct means_blur blur;
	size_t pixels, voxels; /* of a slice, and of all */
	float *values;         /* [z][y][x], R, owned; all 0 before it is made */
	float *within;         /* behind values: how far the object is not made of voxels, 0 .. 1 */
	unsigned char *noise;  /* [z][y][x], behind that: s */
	bool there;
};

struct means_blur means_blur(const struct grid *grid, const struct orbit *orbit)
{
	static const double pixel = 1. / 12, between = 1. / 6, places = 1. / 16, voxel = 1. / 12;
	struct means_blur blur = {.share = 1};

	for (int axis = 0; axis < 3; axis++) {
		const double pixels = orbit->pixel_at_isocentre[axis == 2] / grid->spacing[axis];
		const double variance = (pixel + between) * pixels * pixels + places;

		blur.excess[axis] = (float)((variance - voxel) / 2);
		blur.share = fminf(blur.share, (float)fmax(0, (NONE - variance / voxel) / (NONE - WHOLE)));
	}
	if (orbit->lean != 0 || orbit->turned)
		blur.share = 0;
	return blur;
}

/* ---- memory ---- */

static size_t state_bytes(const struct grid *grid)
{
	return (grid_voxels(grid) + 1) * sizeof(float) + grid_voxels(grid);
}

static struct plan_options plan_options_of(const struct means_options *of, const struct grid *grid,
					   const struct fdk_weights *weights)
{
	struct plan_options plan = {
	    .geometry = of->geometry,
	    .grid = grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = weights->columns,
	    .filter_response = weights->response,
	    .pad = {weights->pad[0], weights->pad[1]},
	    .extend = weights->extend,
	    .extended_response = weights->extended,
	    .axis = weights->axis,
	    .reference_precision = of->recipe->reference_precision,
	    .no_samples = true,
	    .no_projection = true,
	};

	return plan;
}

int means_bytes(const struct means_options *options, struct means_bytes *ret_bytes, struct error *err)
{
	const struct geometry *geometry = options->geometry;
	const struct grid *grid = &options->recipe->grid;
	const size_t view = (size_t)geometry->columns * (size_t)geometry->rows * sizeof(float);
	float some = 0; /* stands for the weights: only whether there are any is asked here */
	const struct fdk_weights weights = {.columns = &some,
					    .response = &some,
					    .extended = &some,
					    .pad = {options->orbit->pad[0], options->orbit->pad[1]},
					    .extend = options->recipe->fdk.extend ? geometry->columns : 0};
	const struct plan_options plan = plan_options_of(options, grid, &weights);
	struct plan_bytes bytes;
	int code;

	*ret_bytes = (struct means_bytes){0};
	if (!(means_blur(grid, options->orbit).share > 0))
		return 0;
	code = options->backend->plan_bytes(options->device, &plan, &bytes, err);
	if (code < 0)
		return code;
	ret_bytes->kept = state_bytes(grid) + 3 * (size_t)grid->size[0] * (size_t)grid->size[1] * sizeof(float) +
			  2 * grid_voxels(grid) * sizeof(float);
	ret_bytes->borrowed = bytes.block;
	ret_bytes->device = bytes.volumes + bytes.scratch - bytes.block + bytes.raw;
	/* The volume and the projections are the job's, and out of core they lie with the plan on the host. */
	if (bytes.host > 0)
		ret_bytes->host = bytes.host - (size_t)geometry->count * view - grid_voxels(grid) * sizeof(float);
	else
		ret_bytes->device -= options->backend->volume_bytes(options->device, grid);
	return 0;
}

int means_new(const struct means_options *options, struct means **ret_means, struct error *err)
{
	const struct grid *grid = &options->recipe->grid;
	const struct means_blur blur = means_blur(grid, options->orbit);
	struct means *means;

	*ret_means = NULL;
	if (!(blur.share > 0))
		return 0;
	means = malloc(sizeof(*means));
	if (means == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for means");
	*means = (struct means){
	    .of = *options,
	    .blur = blur,
	    .pixels = (size_t)grid->size[0] * (size_t)grid->size[1],
	    .voxels = grid_voxels(grid),
	    .values = calloc(1, state_bytes(grid)),
	};
	if (means->values == NULL) {
		free(means);
		return error_set(err, ERR_NO_MEMORY, "no memory for means over %zu voxels", grid_voxels(grid));
	}
	means->within = means->values + means->voxels;
	means->noise = (unsigned char *)(means->within + 1);
	*ret_means = means;
	return 0;
}

void means_free(struct means *means)
{
	if (means == NULL)
		return;
	free(means->values);
	free(means);
}

size_t means_state_bytes(const struct means *means)
{
	return means != NULL ? state_bytes(&means->of.recipe->grid) : 0;
}

const void *means_state(const struct means *means)
{
	return means->values;
}

void means_resume(struct means *means, const char *bytes)
{
	memcpy(means->values, bytes, means_state_bytes(means));
	for (size_t i = 0; i < means->voxels && !means->there; i++)
		means->there = means->values[i] != 0;
}

bool means_there(const struct means *means)
{
	return means != NULL && means->there;
}

/* ---- slices ---- */

/* What a slice is worked in. */
struct slices {
	const struct means *means;
	float *values, *differences, *sums; /* [y][x] each, owned as one */
};

static int open_slices(const struct means *means, struct slices *ret, struct error *err)
{
	float *slices = calloc(3 * means->pixels, sizeof(*slices));

	if (slices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for slices of %zu pixels", means->pixels);
	*ret = (struct slices){means, slices, slices + means->pixels, slices + 2 * means->pixels};
	return 0;
}

static int held(int i, int count)
{
	return i < 0 ? 0 : i < count ? i : count - 1;
}

/* T of a voxel of R, or the same of E; beyond the grid's ends values go on as they are there. */
static float sharpened(const struct means *means, int x, int y, int z)
{
	const int at[3] = {x, y, z}, *size = means->of.recipe->grid.size;
	const ptrdiff_t stride[3] = {1, size[0], (ptrdiff_t)size[0] * size[1]};
	const float *here = means->values + z * stride[2] + y * stride[1] + x;
	float value = *here;

	for (int axis = 0; axis < 3; axis++) {
		const float below = at[axis] > 0 ? here[-stride[axis]] : *here;
		const float above = at[axis] + 1 < size[axis] ? here[stride[axis]] : *here;

		value -= means->blur.excess[axis] * (below + above - 2 * *here);
	}
	return value;
}

/* T less the slice's values. */
static void differ(const struct slices *slices, int z)
{
	const int columns = slices->means->of.recipe->grid.size[0], rows = slices->means->of.recipe->grid.size[1];

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const ptrdiff_t at = (ptrdiff_t)y * columns + x;

			slices->differences[at] = sharpened(slices->means, x, y, z) - slices->values[at];
		}
}

/* Sums over (2 beside + 1) differences along x, of their squares or of themselves. */
static void sum_along_rows(const struct slices *slices, int beside, bool squares)
{
	const int columns = slices->means->of.recipe->grid.size[0], rows = slices->means->of.recipe->grid.size[1];

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++) {
		const float *row = slices->differences + (ptrdiff_t)y * columns;

		for (int x = 0; x < columns; x++) {
			float sum = 0;

			for (int i = x - beside; i <= x + beside; i++) {
				const float value = row[held(i, columns)];

				sum += squares ? value * value : value;
			}
			slices->sums[(ptrdiff_t)y * columns + x] = sum;
		}
	}
}

/* The mean of what was summed along x, over as many voxels along y. */
static float mean_at(const struct slices *slices, int beside, int x, int y)
{
	const int columns = slices->means->of.recipe->grid.size[0], rows = slices->means->of.recipe->grid.size[1];
	const int across = 2 * beside + 1;
	float sum = 0;

	for (int i = y - beside; i <= y + beside; i++)
		sum += slices->sums[(ptrdiff_t)held(i, rows) * columns + x];
	return sum / (float)(across * across);
}

/* ---- R ---- */

/* s^2 of a voxel. */
static float spread_of(const struct means *means, unsigned char noise)
{
	const float s = FIRST * exp2f((float)noise / STEPS) * (float)means->of.recipe->mu_water / 1000;

	return s * s;
}

static unsigned char noise_of(const struct means *means, float spread)
{
	const float hu = sqrtf(spread) * 1000 / (float)means->of.recipe->mu_water;

	return (unsigned char)fminf(UCHAR_MAX, fmaxf(0, roundf(STEPS * log2f(hu / FIRST))));
}

/*
 * Adds FDK of every other view, from the first or the second on, at one place of each voxel; behind the places is its
 * middle.
 */
static int add_place(const struct means *means, const struct means_source *source, const struct fdk_weights *weights,
		     int place, int first, struct error *err)
{
	const struct backend *backend = means->of.backend;
	struct grid grid = means->of.recipe->grid;
	struct plan_options options = plan_options_of(&means->of, &grid, weights);
	struct fdk fdk = *source->fdk;
	int code = cancel_check(source->cancel, err);

	for (int axis = 0; axis < 3 && place != MIDDLE; axis++)
		grid.origin[axis] += (place >> axis & 1 ? 0.25 : -0.25) * grid.spacing[axis];
	options.lender = source->plan;
	if (code == 0)
		code = backend->plan_new(means->of.device, &options, &fdk.plan, err);
	if (code < 0)
		return code;
	if (backend->plan_batch(fdk.plan) < fdk.batch)
		fdk.batch = backend->plan_batch(fdk.plan);
	for (int i = first; i < source->count && code == 0; i += 2)
		code = fdk_add(&fdk, source->views[i], source->views[i], source->projections, source->work, err);
	if (code == 0)
		code = fdk_flush(&fdk, source->projections, source->work, err);
	backend->plan_free(fdk.plan);
	return code;
}

static int add_half(const struct means *means, const struct means_source *source, const struct fdk_weights *weights,
		    int first, struct error *err)
{
	int code = 0;

	for (int place = 0; place < MEANS_PLACES && code == 0; place++)
		code = add_place(means, source, weights, place, first, err);
	return code;
}

/* A has those of `part` of the views, and B all others: E from what A and both together make, in the place of A. */
static int subtract(struct slices *slices, const struct means_source *source, double part, float *values,
		    struct error *err)
{
	const double factor = source->factor / MEANS_PLACES;
	const float own = (float)(factor * (.5 / part + .5 / (1 - part))), all = (float)(factor * .5 / (1 - part));
	const struct means *means = slices->means;
	int code = 0;

	for (int z = 0; z < means->of.recipe->grid.size[2] && code == 0; z++) {
		float *slice = values + (size_t)z * means->pixels;

		code = means->of.backend->volume_download(source->work, z, 1, slices->values, err);
		for (size_t i = 0; i < means->pixels && code == 0; i++)
			slice[i] = own * slice[i] - all * slices->values[i];
	}
	memset(slices->values, 0, means->pixels * sizeof(*slices->values));
	return code;
}

/* ---- whether the object is made of voxels ---- */

/* K F of a voxel within the grid. */
static float linear(const int size[3], const float *middles, size_t at)
{
	static const float weights[3] = {0.125f, 0.75f, 0.125f};
	const size_t row = (size_t)size[0], slice = row * (size_t)size[1];
	float sum = 0;

	for (size_t k = 0; k < 3; k++)
		for (size_t j = 0; j < 3; j++) {
			const float *line = middles + at + k * slice + j * row - slice - row;

			sum += weights[k] * weights[j] * (weights[0] * (line[-1] + line[1]) + weights[1] * line[0]);
		}
	return sum;
}

/* Products of what both halves of the views show. */
struct shown {
	double departs, departs2; /* of R - K F, and their squares */
	double bends, bends2;     /* of K F - F */
};

/* middles, means: of both halves, of the slice the means alone, times MEANS_PLACES. */
static struct shown sum_slice(const int size[3], const float *const middles[2], const float *const means[2], int z)
{
	struct shown sum = {0};

	for (int y = 1; y + 1 < size[1]; y++)
		for (int x = 1; x + 1 < size[0]; x++) {
			const size_t in_slice = (size_t)y * (size_t)size[0] + (size_t)x;
			const size_t at = (size_t)z * (size_t)size[0] * (size_t)size[1] + in_slice;
			double departs = 1, bends = 1;

			for (int half = 0; half < 2; half++) {
				const float smooth = linear(size, middles[half], at);

				departs *= means[half][in_slice] / MEANS_PLACES - smooth;
				bends *= smooth - middles[half][at];
			}
			sum.departs += departs;
			sum.departs2 += departs * departs;
			sum.bends += bends;
			sum.bends2 += bends * bends;
		}
	return sum;
}

/* How far the object is not made of voxels. The means of the first half are in values, those of all in `work`. */
static int look_within(struct means *means, const struct slices *slices, const struct means_source *source,
		       const float *const middles[2], struct error *err)
{
	const int *size = means->of.recipe->grid.size;
	struct shown sum = {0};
	int code = 0;

	for (int z = 1; z + 1 < size[2] && code == 0; z++) {
		const float *half = means->values + (size_t)z * means->pixels;
		const float *const of[2] = {half, slices->values};
		struct shown slice;

		code = means->of.backend->volume_download(source->work, z, 1, slices->values, err);
		if (code < 0)
			break;
		for (size_t i = 0; i < means->pixels; i++)
			slices->values[i] -= half[i];
		slice = sum_slice(size, middles, of, z);
		sum.departs += slice.departs;
		sum.departs2 += slice.departs2;
		sum.bends += slice.bends;
		sum.bends2 += slice.bends2;
	}
	*means->within = 1;
	if (sum.bends > CERTAIN * sqrt(sum.bends2))
		*means->within = (float)fmin(1, fmax(0, (sum.departs / sum.bends - VOXELS) / (BODY - VOXELS)));
	return code;
}

/* s of each voxel, of E, which lies in the place of R. */
static void note_noise(struct means *means, const struct slices *slices)
{
	const int *size = means->of.recipe->grid.size;

	/* The slice's values are 0, so that differences are E. */
	for (int z = 0; z < size[2]; z++) {
		unsigned char *noise = means->noise + (size_t)z * means->pixels;

		differ(slices, z);
		sum_along_rows(slices, BESIDE, true);
#pragma omp parallel for schedule(static)
		for (int y = 0; y < size[1]; y++)
			for (int x = 0; x < size[0]; x++)
				noise[(ptrdiff_t)y * size[0] + x] = noise_of(means, mean_at(slices, BESIDE, x, y));
	}
}

int means_make(struct means *means, const struct means_source *source, struct error *err)
{
	const struct backend *backend = means->of.backend;
	const struct grid *grid = &means->of.recipe->grid;
	const float factor = (float)(source->factor / MEANS_PLACES);
	struct fdk_weights weights = {0};
	struct slices slices = {0};
	float *middles = NULL;
	int code = source->count < 2 ? 0 : open_slices(means, &slices, err);

	if (code < 0 || source->count < 2)
		return code;
	middles = malloc(2 * means->voxels * sizeof(*middles));
	if (middles == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for means over %zu voxels", means->voxels);
	if (code == 0)
		code = fdk_weights_make(&weights, means->of.orbit, means->of.geometry, WINDOW_RAM_LAK, 1,
					means->of.recipe->fdk.extend, err);
	for (int half = 0; half < 2 && code == 0; half++) {
		code = backend->volume_fill(source->work, 0, err);
		if (code == 0)
			code = add_place(means, source, &weights, MIDDLE, 1 - half, err);
		if (code == 0)
			code = backend->volume_download(source->work, 0, grid->size[2],
							middles + (size_t)half * means->voxels, err);
	}
	if (code == 0)
		code = backend->volume_fill(source->work, 0, err);
	if (code == 0)
		code = add_half(means, source, &weights, 1, err);
	if (code == 0)
		code = backend->volume_download(source->work, 0, grid->size[2], means->values, err);
	if (code == 0)
		code = add_half(means, source, &weights, 0, err);
	if (code == 0)
		code =
		    look_within(means, &slices, source, (const float *const[2]){middles, middles + means->voxels}, err);
	if (code == 0)
		code = subtract(&slices, source, (double)(source->count / 2) / source->count, means->values, err);
	if (code == 0)
		note_noise(means, &slices);
	if (code == 0)
		code = backend->volume_download(source->work, 0, grid->size[2], means->values, err);
	for (size_t i = 0; i < means->voxels && code == 0; i++)
		means->values[i] *= factor;
	means->there = code == 0;
	fdk_weights_clear(&weights);
	free(middles);
	free(slices.values);
	return code;
}

/* ---- a volume that is kept ---- */

/* D less its mean, in place. */
static void take_mean(const struct slices *slices)
{
	const int columns = slices->means->of.recipe->grid.size[0], rows = slices->means->of.recipe->grid.size[1];

	sum_along_rows(slices, MEANS_WIDE, false);
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++)
			slices->differences[(ptrdiff_t)y * columns + x] -= mean_at(slices, MEANS_WIDE, x, y);
}

/* V' of a slice, in the place of D. */
static void mend_slice(const struct slices *slices, int z, float share)
{
	static const int reach[2] = {PLACE_REACH, PLACE_REACH};
	const struct means *means = slices->means;
	const struct recipe *recipe = means->of.recipe;
	const int columns = recipe->grid.size[0], rows = recipe->grid.size[1];
	const unsigned char *noise = means->noise + (size_t)z * means->pixels;

	take_mean(slices);
	sum_along_rows(slices, BESIDE, true);
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const ptrdiff_t at = (ptrdiff_t)y * columns + x;
			const float spread = COUNTED * spread_of(means, noise[at]),
				    square = mean_at(slices, BESIDE, x, y);
			float value = slices->values[at];

			if (square > spread)
				value += share * (1 - spread / square) * slices->differences[at] *
					 (1 - place_evenness(recipe->grid.size, reach, (float)recipe->mu_water,
							     slices->values, x, y));
			slices->differences[at] = recipe->iterate.nonnegative ? fmaxf(value, 0) : value;
		}
}

int means_show(const struct means *means, struct volume *volume, struct error *err)
{
	const struct backend *backend = means->of.backend;
	const float share = MOST * means->blur.share * *means->within;
	struct slices slices;
	int code = open_slices(means, &slices, err);

	if (code < 0)
		return code;
	for (int z = 0; z < means->of.recipe->grid.size[2] && code == 0; z++) {
		code = backend->volume_download(volume, z, 1, slices.values, err);
		if (code < 0)
			break;
		differ(&slices, z);
		mend_slice(&slices, z, share);
		code = backend->volume_put(volume, z, 1, slices.differences, err);
	}
	free(slices.values);
	return code;
}

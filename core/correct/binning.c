/* Blocks of pixels taken as one: see binning.h. */
#include "core/correct/binning.h"

#include <stdlib.h>

struct linearise binning_linearise(const struct linearise *linearise, int n)
{
	struct linearise binned = *linearise;

	if (n == 1)
		return binned;
	binned.sample = SAMPLE_FLOAT32;
	if (isfinite(linearise_saturation(linearise)))
		binned.saturation = (double)linearise_saturation(linearise);
	return binned;
}

/* ---- one block ---- */

/* The sums over a block's pixels that can be good in any view. */
struct block {
	double dark, flat; /* sums of counts */
	int pixels;
};

static float dark_of(const struct linearise *given, size_t at)
{
	return linearise_counts(given, IMAGE_DARK, at, 0);
}

static float flat_of(const struct linearise *given, size_t at)
{
	return linearise_counts(given, IMAGE_FLAT, at, given->air);
}

static bool is_usable(const struct linearise *given, size_t at)
{
	float range;

	if (linearise_mapped(given, at))
		return false;
	if (given->quantity == QUANTITY_LINE_INTEGRAL)
		return true;
	range = flat_of(given, at) - dark_of(given, at);
	return isfinite(range) && range > 0;
}

/* The index of a block's k-th pixel. */
static size_t pixel_of(const struct binning *binning, int column, int row, int k)
{
	const struct pixel_blocks *blocks = &binning->blocks;
	const int c = blocks->first[0] + column * blocks->size[0] + k % blocks->size[0];
	const int r = blocks->first[1] + row * blocks->size[1] + k / blocks->size[0];

	return (size_t)r * (size_t)binning->columns + (size_t)c;
}

static int pixels_of(const struct binning *binning)
{
	return binning->blocks.size[0] * binning->blocks.size[1];
}

static struct block block_of(const struct binning *binning, int column, int row)
{
	struct block block = {0};

	for (int k = 0; k < pixels_of(binning); k++) {
		const size_t at = pixel_of(binning, column, row, k);

		if (!is_usable(&binning->given, at))
			continue;
		block.dark += (double)dark_of(&binning->given, at);
		block.flat += (double)flat_of(&binning->given, at);
		block.pixels++;
	}
	return block;
}

/* The mean line integral; NaN where no pixel is good. */
static float mean_integral(const struct binning *binning, const void *samples, int column, int row)
{
	double sum = 0;
	int good = 0;

	for (int k = 0; k < pixels_of(binning); k++) {
		const size_t at = pixel_of(binning, column, row, k);
		const float p = linearise_sample(&binning->given, samples, at);

		if (!is_usable(&binning->given, at) || !isfinite(p))
			continue;
		sum += (double)p;
		good++;
	}
	return good > 0 ? (float)(sum / good) : NAN;
}

/*
 * The sample whose transmission is that of the block. A pixel that counted nothing is a measurement here, which a sum
 * can hold. Without a good sample it is the saturation where some were saturated, or NaN.
 */
static float sum_counts(const struct binning *binning, const void *samples, int column, int row)
{
	const struct linearise *given = &binning->given;
	const float saturation = linearise_saturation(given);
	const struct block block = block_of(binning, column, row);
	double above = 0, range = 0, share;
	bool saturated = false;

	for (int k = 0; k < pixels_of(binning); k++) {
		const size_t at = pixel_of(binning, column, row, k);
		const float sample = linearise_sample(given, samples, at), dark = dark_of(given, at);

		if (!is_usable(given, at) || !isfinite(sample))
			continue;
		if (!(sample < saturation)) {
			saturated = true;
			continue;
		}
		above += (double)sample - (double)dark;
		range += (double)flat_of(given, at) - (double)dark;
	}
	if (!(range > 0))
		return saturated ? saturation : NAN;
	share = above / range;
	return (float)((block.dark + share * (block.flat - block.dark)) / block.pixels);
}

const void *binning_view(struct binning *binning, const void *samples)
{
	const struct pixel_blocks *blocks = &binning->blocks;
	const bool integrals = binning->given.quantity == QUANTITY_LINE_INTEGRAL;

	if (binning->n == 1)
		return samples;
#pragma omp parallel for schedule(static)
	for (int row = 0; row < blocks->count[1]; row++)
		for (int column = 0; column < blocks->count[0]; column++)
			binning->view[(size_t)row * (size_t)blocks->count[0] + (size_t)column] =
			    integrals ? mean_integral(binning, samples, column, row)
				      : sum_counts(binning, samples, column, row);
	return binning->view;
}

/* ---- images ---- */

/* The means of dark and flat, and the map of blocks without a usable pixel. */
static void bin_images(struct binning *binning)
{
	float *flat = binning->image[IMAGE_FLAT], *dark = binning->image[IMAGE_DARK];
	unsigned char *marks = binning->image[IMAGE_DEFECTS];

	for (int row = 0; row < binning->blocks.count[1]; row++)
		for (int column = 0; column < binning->blocks.count[0]; column++) {
			const size_t at = (size_t)row * (size_t)binning->blocks.count[0] + (size_t)column;
			const struct block block = block_of(binning, column, row);
			const double pixels = block.pixels > 0 ? block.pixels : 1;

			if (flat != NULL)
				flat[at] = (float)(block.flat / pixels);
			if (dark != NULL)
				dark[at] = (float)(block.dark / pixels);
			marks[at] = block.pixels == 0;
		}
}

/* Blocks within the region, or those that it touches. */
static void bin_region(const struct binning *binning, int region[4])
{
	const struct pixel_blocks *blocks = &binning->blocks;

	for (int i = 0; i < 2; i++) {
		const int size = blocks->size[i], last = blocks->count[i] - 1;
		const int from = region[i] - blocks->first[i], to = region[2 + i] - blocks->first[i];
		/* from is -size / 2 at least. */
		const int within[2] = {(from + 2 * size - 1) / size - 1, (to + 1 + size) / size - 2};
		const int touched[2] = {(from + size) / size - 1, (to + size) / size - 1};
		const int *chosen = within[0] <= within[1] ? within : touched;

		region[i] = chosen[0] < 0 ? 0 : chosen[0] > last ? last : chosen[0];
		region[2 + i] = chosen[1] > last ? last : chosen[1] < 0 ? 0 : chosen[1];
	}
}

int binning_open(struct binning *ret_binning, const struct linearise *linearise, const struct geometry *geometry, int n,
		 struct error *err)
{
	struct binning binning = {.n = n,
				  .columns = geometry->columns,
				  .rows = geometry->rows,
				  .blocks = geometry_blocks(geometry, n),
				  .given = *linearise,
				  .binned = binning_linearise(linearise, n)};
	const int columns = binning.blocks.count[0], rows = binning.blocks.count[1];
	bool there = true;
	int code;

	*ret_binning = binning;
	if (n == 1)
		return 0;
	code = defect_map_make(&binning.found, linearise, geometry->columns, geometry->rows, err);
	if (code < 0)
		return code;
	binning.given.image[IMAGE_DEFECTS] = binning.found.map;
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (linearise->image[i] == NULL && i != IMAGE_DEFECTS)
			continue;
		binning.image[i] = malloc(image_bytes(i, columns, rows));
		binning.binned.image[i] = binning.image[i];
		there = there && binning.image[i] != NULL;
	}
	binning.binned.stuck = NULL; /* the map has them */
	binning.view = malloc((size_t)columns * (size_t)rows * sizeof(*binning.view));
	if (!there || binning.view == NULL) {
		binning_clear(&binning);
		return error_set(err, ERR_NO_MEMORY, "no memory for images of %d x %d pixels", columns, rows);
	}
	bin_images(&binning);
	if (linearise->has_air_region)
		bin_region(&binning, binning.binned.air_region);
	*ret_binning = binning;
	return 0;
}

void binning_clear(struct binning *binning)
{
	for (int i = 0; i < IMAGE_COUNT; i++)
		free(binning->image[i]);
	free(binning->view);
	defect_map_clear(&binning->found);
	*binning = (struct binning){0};
}

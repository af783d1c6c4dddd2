/* Defective pixels from a map and from the flat and dark images: see defects.h. */
#include "core/correct/defects.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { REACH = 7, WINDOW = 2 * REACH + 1 };

static const float DEAD = 0.5f, HOT = 1.5f, HOT_DARK = 0.25f, NOISY_DARK = 0.05f, LIT = 0.02f;
/* Counts: the least range of a pixel, the least that `air` may be. */
static const float RANGE_LEAST = 1e-6f;
/*
 * A dark that is further below 0 than the flat is above by this factor leaves nothing of the counts: all of them are
 * the same share of the range. Detectors whose counts are signed stay far below.
 */
static const float DEEP = 1000;

/* The images of one detector; range is NAN where a value is not finite. */
struct images {
	const struct linearise *linearise;
	int columns, rows;
	float saturation;
	float lit;                         /* a neighbourhood's range from which on it is judged */
	float *range, *dark;               /* [row][column] */
	float *range_median, *dark_median; /* of the neighbourhood */
	float *scratch;
};

/* The values of a window that slides along a line, in ascending order, without those that are NAN. */
struct sliding {
	float sorted[WINDOW];
	int count;
};

static void sliding_add(struct sliding *window, float value)
{
	int at = window->count;

	if (isnan(value))
		return;
	for (; at > 0 && window->sorted[at - 1] > value; at--)
		window->sorted[at] = window->sorted[at - 1];
	window->sorted[at] = value;
	window->count++;
}

static void sliding_remove(struct sliding *window, float value)
{
	int at = 0;

	if (isnan(value))
		return;
	while (window->sorted[at] < value)
		at++;
	window->count--;
	for (; at < window->count; at++)
		window->sorted[at] = window->sorted[at + 1];
}

/* Writes for each value the median of those up to REACH away along one direction; NAN where there is none. */
static void median_along(const float *from, float *to, int lines, size_t line, int count, size_t step)
{
#pragma omp parallel for schedule(static)
	for (int l = 0; l < lines; l++) {
		const float *in = from + (size_t)l * line;
		struct sliding window = {.count = 0};

		for (int i = 0; i < REACH && i < count; i++)
			sliding_add(&window, in[(size_t)i * step]);
		for (int i = 0; i < count; i++) {
			if (i > REACH)
				sliding_remove(&window, in[(size_t)(i - REACH - 1) * step]);
			if (i + REACH < count)
				sliding_add(&window, in[(size_t)(i + REACH) * step]);
			to[(size_t)l * line + (size_t)i * step] =
			    window.count > 0 ? window.sorted[window.count / 2] : NAN;
		}
	}
}

static void neighbourhood(const struct images *images, const float *from, float *ret)
{
	const size_t columns = (size_t)images->columns;

	median_along(from, images->scratch, images->rows, columns, images->columns, 1);
	median_along(images->scratch, ret, images->columns, 1, images->rows, columns);
}

/* Why a pixel's flat and dark can be no reference for any count. */
enum reference { REFERENCE_GOOD, NOT_FINITE, NOT_ABOVE, TOO_FAINT, TOO_DEEP, REFERENCES };

static enum reference reference_of(float flat, float dark)
{
	const float range = flat - dark;

	if (!isfinite(range))
		return NOT_FINITE;
	if (!(range > 0))
		return NOT_ABOVE;
	if (range < RANGE_LEAST)
		return TOO_FAINT;
	return -dark > DEEP * fabsf(flat) ? TOO_DEEP : REFERENCE_GOOD;
}

/* Fills range and dark; counts the kinds of reference. */
static void read_images(struct images *images, size_t ret_counts[REFERENCES])
{
	const struct linearise *linearise = images->linearise;
	const size_t pixels = (size_t)images->columns * (size_t)images->rows;

	for (size_t i = 0; i < pixels; i++) {
		const float flat = linearise_counts(linearise, IMAGE_FLAT, i, linearise->air);
		const float dark = linearise_counts(linearise, IMAGE_DARK, i, 0);
		const enum reference reference = reference_of(flat, dark);

		images->dark[i] = isfinite(dark) ? dark : NAN;
		/* A range of 0 and below is that of a collimator's shadow, where each sample is taken for what it is.
		 */
		images->range[i] = reference == REFERENCE_GOOD || reference == NOT_ABOVE ? flat - dark : NAN;
		ret_counts[reference]++;
	}
}

/* Refuses images that are a reference in less than half of the pixels, for the reason that most of the others have. */
static int check_references(const struct linearise *linearise, const size_t counts[REFERENCES], size_t pixels,
			    struct error *err)
{
	const char *flat = linearise->image[IMAGE_FLAT] != NULL ? "flat image" : "air value";
	const bool has_dark = linearise->image[IMAGE_DARK] != NULL;
	enum reference most = NOT_FINITE;
	size_t bad = 0;
	double share;

	for (int i = NOT_FINITE; i < REFERENCES; i++) {
		bad += counts[i];
		most = counts[i] > counts[most] ? (enum reference)i : most;
	}
	if (2 * bad <= pixels)
		return 0;
	share = 100 * (double)bad / (double)pixels;
	switch (most) {
	case NOT_FINITE:
		return error_set(err, ERR_IMPOSSIBLE, "the flat or dark image is not finite in %.3g %% of the pixels",
				 share);
	case TOO_FAINT:
		return error_set(err, ERR_IMPOSSIBLE, "the %s is less than %g above the dark in %.3g %% of the pixels",
				 flat, (double)RANGE_LEAST, share);
	case TOO_DEEP:
		return error_set(err, ERR_IMPOSSIBLE,
				 "the dark image lies too far below 0, more than %g times the %s, in %.3g %% of the "
				 "pixels: nothing of the counts would be left",
				 (double)DEEP, flat, share);
	default:
		return error_set(err, ERR_IMPOSSIBLE, "the %s is not above %s in %.3g %% of the pixels%s", flat,
				 has_dark ? "the dark image" : "0", share, has_dark ? ": are they exchanged?" : "");
	}
}

enum verdict { GOOD, DEAD_PIXEL, HOT_PIXEL, NOISY_PIXEL };

static enum verdict judge(const struct images *images, size_t at)
{
	const struct linearise *linearise = images->linearise;
	const float range = images->range[at], around = images->range_median[at];
	const float dark = images->dark[at] - images->dark_median[at];

	if (isnan(range))
		return NOISY_PIXEL;
	if (linearise_counts(linearise, IMAGE_FLAT, at, 0) >= images->saturation)
		return HOT_PIXEL;
	if (!(around >= images->lit))
		return GOOD;
	if (range > HOT * around || dark > HOT_DARK * around)
		return HOT_PIXEL;
	if (range < DEAD * around)
		return DEAD_PIXEL;
	return fabsf(dark) > NOISY_DARK * around ? NOISY_PIXEL : GOOD;
}

/* Adds what the images show to the map. */
static void find(struct images *images, struct defect_map *map)
{
	const size_t pixels = (size_t)images->columns * (size_t)images->rows;

	neighbourhood(images, images->range, images->range_median);
	if (images->linearise->image[IMAGE_DARK] != NULL)
		neighbourhood(images, images->dark, images->dark_median);
	else
		memset(images->dark_median, 0, pixels * sizeof(float));
	images->lit = 0;
	for (size_t i = 0; i < pixels; i++)
		images->lit = fmaxf(images->lit, LIT * images->range_median[i]);
	for (size_t i = 0; i < pixels; i++) {
		const enum verdict verdict = map->map[i] ? GOOD : judge(images, i);

		map->dead += verdict == DEAD_PIXEL;
		map->hot += verdict == HOT_PIXEL;
		map->noisy += verdict == NOISY_PIXEL;
		if (verdict != GOOD)
			map->map[i] = 1;
	}
}

static int examine(const struct linearise *linearise, int columns, int rows, struct defect_map *map, struct error *err)
{
	const size_t pixels = (size_t)columns * (size_t)rows;
	float *floats = malloc(5 * pixels * sizeof(*floats));
	struct images images;
	size_t references[REFERENCES] = {0};
	int code;

	if (floats == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look for defects in %d x %d pixels", columns, rows);
	images = (struct images){
	    .linearise = linearise,
	    .columns = columns,
	    .rows = rows,
	    .saturation = linearise_saturation(linearise),
	    .range = floats,
	    .dark = floats + pixels,
	    .range_median = floats + 2 * pixels,
	    .dark_median = floats + 3 * pixels,
	    .scratch = floats + 4 * pixels,
	};
	read_images(&images, references);
	code = check_references(linearise, references, pixels, err);
	if (code == 0)
		find(&images, map);
	free(floats);
	return code;
}

/* How many bad pixels lie in a row through one, `step` bytes apart, where `before` lie before it and `behind` behind.
 */
static int run_through(const unsigned char *at, ptrdiff_t step, int before, int behind)
{
	int low = 0, high = 0;

	while (low < before && at[-(low + 1) * step])
		low++;
	while (high < behind && at[(high + 1) * step])
		high++;
	return low + 1 + high;
}

/* The side of the largest square of bad pixels, row by row from those that end at the pixels above and before. */
static int find_widest(struct defect_map *map, int columns, int rows, struct error *err)
{
	int *side = calloc((size_t)columns, sizeof(*side)); /* of the square whose last corner is the pixel above */

	if (side == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a row of %d pixels", columns);
	for (int r = 0; r < rows; r++)
		for (int c = 0, corner = 0; c < columns; c++) {
			const unsigned char *at = map->map + (size_t)r * (size_t)columns + (size_t)c;
			const int above = side[c], before = c > 0 ? side[c - 1] : 0;
			const int least = above < before ? above : before;

			side[c] = !*at ? 0 : 1 + (corner < least ? corner : least);
			corner = above;
			if (side[c] <= map->widest)
				continue;
			map->widest = side[c];
			map->lines = 2 * run_through(at, 1, c, columns - 1 - c) >= columns ||
				     2 * run_through(at, columns, r, rows - 1 - r) >= rows;
		}
	free(side);
	return 0;
}

void defect_map_warn(const struct defect_map *map, int columns, int rows, const struct warning_sink *sink)
{
	enum { BLOCK = 6, LINES = 4 };
	const double share = 0.35, pixels = (double)columns * rows;
	const size_t all = map->given + map->dead + map->hot + map->noisy + map->stuck;

	if (map->widest >= (map->lines ? LINES : BLOCK) || (double)all >= share * pixels)
		warning_tell(
		    sink, "defects_wide",
		    "%.3g %% of the pixels are bad, and up to %d of them side by side: what is filled in there "
		    "is a guess, and the image may be off by 50 HU and more where rays pass it",
		    100 * (double)all / pixels, map->widest);
}

int defect_map_make(struct defect_map *ret_map, const struct linearise *linearise, int columns, int rows,
		    struct error *err)
{
	const size_t pixels = (size_t)columns * (size_t)rows;
	size_t all;
	const bool images = linearise->quantity == QUANTITY_INTENSITY &&
			    (linearise->image[IMAGE_FLAT] != NULL || linearise->image[IMAGE_DARK] != NULL);
	struct defect_map map = {0};
	int code = 0;

	if (!images && linearise->image[IMAGE_DEFECTS] == NULL && linearise->stuck == NULL) {
		*ret_map = map;
		return 0;
	}
	map.map = calloc(pixels, 1);
	if (map.map == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a defect map of %d x %d pixels", columns, rows);
	for (size_t i = 0; i < pixels; i++) {
		map.map[i] = linearise_mapped(linearise, i);
		map.given += map.map[i];
	}
	if (images)
		code = examine(linearise, columns, rows, &map, err);
	for (size_t i = 0; linearise->stuck != NULL && i < pixels; i++) {
		map.stuck += linearise->stuck[i] != 0 && !map.map[i];
		map.map[i] = map.map[i] || linearise->stuck[i] != 0;
	}
	all = map.given + map.dead + map.hot + map.noisy + map.stuck;
	if (code == 0 && 2 * all > pixels)
		code = error_set(err, ERR_IMPOSSIBLE,
				 "%.3g %% of the pixels are defects, half of them can be at most: %zu of the given "
				 "map, and %zu dead, %zu hot or saturated and %zu noisy ones that the flat and dark "
				 "images show",
				 100 * (double)all / (double)pixels, map.given, map.dead, map.hot, map.noisy);
	if (code == 0)
		code = find_widest(&map, columns, rows, err);
	if (code < 0 || all == 0)
		defect_map_clear(&map);
	if (code == 0)
		*ret_map = map;
	return code;
}

void defect_map_clear(struct defect_map *map)
{
	free(map->map);
	*map = (struct defect_map){0};
}

/* Defective pixels from a map and from the flat and dark images: see defects.h. */
#include "core/correct/defects.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { REACH = 7, WINDOW = 2 * REACH + 1 };

static const float DEAD = 0.5f, HOT = 1.5f, HOT_DARK = 0.25f, NOISY_DARK = 0.05f, LIT = 0.02f;

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

/* The median of up to WINDOW values without those that are NAN; NAN where all are. Sorts them. */
static float median(float *values, int count)
{
	int good = 0;

	for (int i = 0; i < count; i++) {
		const float value = values[i];
		int at = good;

		if (isnan(value))
			continue;
		for (; at > 0 && values[at - 1] > value; at--)
			values[at] = values[at - 1];
		values[at] = value;
		good++;
	}
	return good > 0 ? values[good / 2] : NAN;
}

/* For each value the median of those up to REACH away along one direction. */
static void median_along(const float *from, float *to, int lines, size_t line, int count, size_t step)
{
#pragma omp parallel for schedule(static)
	for (int l = 0; l < lines; l++) {
		const float *in = from + (size_t)l * line;

		for (int i = 0; i < count; i++) {
			const int first = i > REACH ? i - REACH : 0, last = i + REACH < count ? i + REACH : count - 1;
			float values[WINDOW];

			for (int k = first; k <= last; k++)
				values[k - first] = in[(size_t)k * step];
			to[(size_t)l * line + (size_t)i * step] = median(values, last - first + 1);
		}
	}
}

static void neighbourhood(const struct images *images, const float *from, float *ret)
{
	const size_t columns = (size_t)images->columns;

	median_along(from, images->scratch, images->rows, columns, images->columns, 1);
	median_along(images->scratch, ret, images->columns, 1, images->rows, columns);
}

/* Fills range and dark; returns how many pixels have no range above 0. */
static size_t read_images(struct images *images)
{
	const struct linearise *linearise = images->linearise;
	const size_t pixels = (size_t)images->columns * (size_t)images->rows;
	size_t without = 0;

	for (size_t i = 0; i < pixels; i++) {
		const float flat = linearise_counts(linearise, IMAGE_FLAT, i, linearise->air);

		images->dark[i] = linearise_counts(linearise, IMAGE_DARK, i, 0);
		images->range[i] = flat - images->dark[i];
		if (!isfinite(images->dark[i]))
			images->dark[i] = NAN;
		if (!isfinite(images->range[i]))
			images->range[i] = NAN;
		without += !(images->range[i] > 0);
	}
	return without;
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
	size_t without;
	int code = 0;

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
	without = read_images(&images);
	if (2 * without > pixels)
		code = error_set(err, ERR_IMPOSSIBLE,
				 "%s is not above the dark image in %.3g %% of the pixels: are they exchanged?",
				 linearise->image[IMAGE_FLAT] != NULL ? "the flat image" : "the air value",
				 100 * (double)without / (double)pixels);
	else
		find(&images, map);
	free(floats);
	return code;
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
				 "map, and %zu dead, %zu hot and %zu noisy ones that the flat and dark images show",
				 100 * (double)all / (double)pixels, map.given, map.dead, map.hot, map.noisy);
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

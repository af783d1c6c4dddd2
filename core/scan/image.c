/* The table of images: see image.h. */
#include "core/scan/image.h"

#include <math.h>
#include <string.h>

#define IMAGE_ROW(id, ...) [IMAGE_##id] = {__VA_ARGS__},
const struct image_kind image_kinds[IMAGE_COUNT] = {IMAGES(IMAGE_ROW)};

int image_find(const char *name)
{
	for (int i = 0; i < IMAGE_COUNT; i++)
		if (strcmp(image_kinds[i].name, name) == 0)
			return i;
	return -1;
}

static int check_marks(const unsigned char *marks, size_t count, struct error *err)
{
	size_t marked = 0;

	for (size_t i = 0; i < count; i++)
		marked += marks[i] != 0;
	if (2 * marked > count)
		return error_set(err, ERR_IMPOSSIBLE,
				 "the defect map marks %.3g %% of the pixels, half of them can be at most: not zero is "
				 "a defect",
				 100 * (double)marked / (double)count);
	return 0;
}

int image_check(enum image image, const void *pixels, size_t count, struct error *err)
{
	const float *counts = pixels;
	size_t finite = 0, positive = 0;

	if (image_kinds[image].pixel == IMAGE_MARKS)
		return check_marks(pixels, count, err);
	for (size_t i = 0; i < count; i++) {
		finite += isfinite(counts[i]) != 0;
		positive += isfinite(counts[i]) && counts[i] > 0;
	}
	if (2 * finite < count)
		return error_set(err, ERR_IMPOSSIBLE,
				 "the %s is finite in %.3g %% of the pixels, half of them are needed",
				 image_kinds[image].title, 100 * (double)finite / (double)count);
	if (image == IMAGE_FLAT && positive == 0)
		return error_set(err, ERR_IMPOSSIBLE, "the flat image has no pixel above 0");
	return 0;
}

int image_check_pair(const float *flat, const float *dark, size_t count, struct error *err)
{
	size_t without = 0;

	for (size_t i = 0; i < count; i++) {
		const float range = flat[i] - dark[i];

		without += !isfinite(range) || !(range > 0);
	}
	if (2 * without > count)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "the flat image is not above the dark image in %.3g %% of the pixels: are they exchanged?",
		    100 * (double)without / (double)count);
	return 0;
}

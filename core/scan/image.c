/* The table of images: see image.h. */
#include "core/scan/image.h"

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

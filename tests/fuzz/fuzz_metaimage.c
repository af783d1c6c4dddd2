/* Any bytes as the header of a MetaImage: refused with a reason, or sizes and places that can be reckoned with. */
#include <math.h>
#include <string.h>

#include "proto/metaimage.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct metaimage image = {.dimensions = -1};
	struct error err = {0};

	if (metaimage_parse((const char *)data, size, &image, &err) != 0) {
		PROMISE(image.dimensions == -1 && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(image.dimensions == 2 || image.dimensions == 3);
	PROMISE(image.length <= size && image.type < PIXEL_TYPE_COUNT && image.header_size >= -1);
	PROMISE(memchr(image.data_file, '\0', sizeof(image.data_file)) != NULL && image.data_file[0] != '\0');
	for (int i = 0; i < 3; i++) {
		PROMISE(image.size[i] >= 1 && image.size[i] <= METAIMAGE_SIZE_MAX);
		PROMISE(isfinite(image.spacing[i]) && isfinite(image.origin[i]));
		for (int j = 0; j < 3; j++)
			PROMISE(fabs(image.direction[i][j]) < 2);
	}
	return 0;
}

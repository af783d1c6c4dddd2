/* PNG in memory: picture.h. */
#include "daemon/picture.h"

#include <math.h>
#include <png.h>
#include <stdlib.h>

static unsigned char gray(float value, float black, float scale)
{
	float level = (value - black) * scale;

	if (!(level > 0))
		return 0;
	return level < 255 ? (unsigned char)lrintf(level) : 255;
}

int picture_make(const float *values, int width, int height, float black, float white, char **ret_png,
		 size_t *ret_length, struct error *err)
{
	png_image image = {.version = PNG_IMAGE_VERSION,
			   .width = (png_uint_32)width,
			   .height = (png_uint_32)height,
			   .format = PNG_FORMAT_GRAY};
	size_t count = (size_t)width * (size_t)height;
	unsigned char *pixels = malloc(count);
	png_alloc_size_t length = PNG_IMAGE_PNG_SIZE_MAX(image);
	char *png = malloc(length);
	int code = 0;

	if (pixels == NULL || png == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a picture of %d x %d", width, height);
		goto out;
	}
	for (size_t i = 0; i < count; i++)
		pixels[i] = gray(values[i], black, white > black ? 255 / (white - black) : 0);
	if (png_image_write_to_memory(&image, png, &length, 0, pixels, 0, NULL) == 0) {
		code = error_set(err, ERR_INTERNAL, "a picture cannot be made: %s", image.message);
		goto out;
	}
	*ret_png = png;
	*ret_length = length;
	png = NULL;
out:
	png_image_free(&image);
	free(pixels);
	free(png);
	return code;
}

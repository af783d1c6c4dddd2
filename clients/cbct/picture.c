/* PNG files, through libpng's simplified interface: see picture.h. */
#include "clients/cbct/picture.h"

#include <stdio.h>
#include <string.h>

#include <png.h>

int picture_write(const char *path, const unsigned char *pixels, int width, int height, struct error *err)
{
	png_image image = {.version = PNG_IMAGE_VERSION, .format = PNG_FORMAT_GRAY};
	int written;

	image.width = (png_uint_32)width;
	image.height = (png_uint_32)height;
	if (strcmp(path, "-") == 0)
		written = png_image_write_to_stdio(&image, stdout, 0, pixels, 0, NULL);
	else
		written = png_image_write_to_file(&image, path, 0, pixels, 0, NULL);
	return written ? 0 : error_set(err, ERR_IO, "%s: %s", path, image.message);
}

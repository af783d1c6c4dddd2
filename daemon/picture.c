/* PNG in memory: picture.h. */
#include "daemon/picture.h"

#include <math.h>
#include <stdlib.h>

#include "proto/slice.h"

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
	size_t count = (size_t)width * (size_t)height;
	unsigned char *pixels = malloc(count);
	int code;

	if (pixels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture of %d x %d", width, height);
	for (size_t i = 0; i < count; i++)
		pixels[i] = gray(values[i], black, white > black ? 255 / (white - black) : 0);
	code = gray_png(pixels, width, height, NULL, ret_png, ret_length, err);
	free(pixels);
	return code;
}

#ifndef CBCT_DAEMON_PICTURE_H
#define CBCT_DAEMON_PICTURE_H

#include <stddef.h>

#include "core/error.h"

/*
 * An 8-bit gray PNG of values [height][width], the first row on top: `black`
 * and below are 0, `white` and above 255, what is not finite is black. Allocates *ret_png (free).
 */
int picture_make(const float *values, int width, int height, float black, float white, char **ret_png,
		 size_t *ret_length, struct error *err);

#endif

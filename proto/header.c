/* Text headers of image files: see header.h. */
#include "proto/header.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

bool header_line(const char *text, size_t length, size_t *at, char *ret_line, size_t size)
{
	const char *end = memchr(text + *at, '\n', length - *at);
	size_t width;

	if (end == NULL)
		return false;
	width = (size_t)(end - (text + *at));
	snprintf(ret_line, size, "%.*s", (int)(width < size ? width : size - 1), text + *at);
	width = strlen(ret_line);
	while (width > 0 && strchr(" \t\r", ret_line[width - 1]) != NULL)
		ret_line[--width] = '\0';
	*at += (size_t)(end - (text + *at)) + 1;
	return true;
}

int header_numbers(const char *text, int most, double *ret)
{
	int count = 0;

	while (*text != '\0' && count < most) {
		char *end;
		double number;

		if (strchr(" \t(),", *text) != NULL) {
			text++;
			continue;
		}
		number = strtod(text, &end);
		if (end == text || !isfinite(number))
			return -1;
		ret[count++] = number;
		text = end;
	}
	return count;
}

int header_refuse(const char *key, const char *value, struct error *err)
{
	return error_set(err, ERR_INVALID, "%.60s: \"%.60s\" is not read", key, value);
}

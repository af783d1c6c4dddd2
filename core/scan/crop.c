/* A part of a detector taken for all of it: see crop.h. */
#include "core/scan/crop.h"

#include <string.h>

int geometry_crop(struct geometry *ret_geometry, const struct geometry *geometry, const struct pixel_area *area,
		  struct error *err)
{
	int code = geometry_copy(ret_geometry, geometry, err);

	if (code < 0)
		return code;
	ret_geometry->columns = area->count[0];
	ret_geometry->rows = area->count[1];
	for (int k = 0; k < geometry->count; k++) {
		struct view *view = &ret_geometry->views[k];

		for (int i = 0; i < 3; i++)
			view->pixel0[i] += area->first[0] * view->column_step[i] + area->first[1] * view->row_step[i];
	}
	return 0;
}

void pixels_crop(const void *from, size_t bytes, int columns, const struct pixel_area *area, void *to)
{
	const size_t line = (size_t)area->count[0] * bytes;

	for (int row = 0; row < area->count[1]; row++) {
		const size_t at = (size_t)(area->first[1] + row) * (size_t)columns + (size_t)area->first[0];

		memmove((char *)to + (size_t)row * line, (const char *)from + at * bytes, line);
	}
}

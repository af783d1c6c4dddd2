/* Any bytes as a geometry of RTK: refused with a reason, or finite views that another file brings back. */
#include <math.h>

#include "proto/rtk_geometry.h"
#include "tests/fuzz/fuzz.h"

/* What was read and is a geometry of its own can be written and read again. */
static void round_trip(const struct geometry *geometry)
{
	struct rtk_geometry written, read;
	struct rtk_stack stack;
	struct error err = {0};
	size_t length;
	char *text;

	if (rtk_geometry_from_views(geometry, 1e-3, &written, &stack, &err) != 0) {
		PROMISE(err.code < 0 && err.text[0] != '\0');
		return;
	}
	text = rtk_geometry_print(&written, &length);
	PROMISE(text != NULL);
	PROMISE(rtk_geometry_parse(text, length, &read, &err) == 0 && read.count == geometry->count);
	free(text);
	rtk_geometry_clear(&written);
	rtk_geometry_clear(&read);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	const struct rtk_stack stack = {{-31.5, -23.5}, {1, 0}, {0, 0.5}};
	struct rtk_geometry rtk = {.count = -1};
	struct error err = {0};

	if (rtk_geometry_parse((const char *)data, size, &rtk, &err) != 0) {
		PROMISE(rtk.count == -1 && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(rtk.count >= 1);
	for (int trust = 0; trust < RTK_TRUST_COUNT; trust++) {
		struct geometry geometry;

		if (rtk_geometry_views(&rtk, &stack, 64, 48, (enum rtk_trust)trust, &geometry, &err) != 0) {
			PROMISE(err.code < 0 && err.text[0] != '\0');
			continue;
		}
		for (int k = 0; k < geometry.count; k++)
			for (int i = 0; i < 3; i++)
				PROMISE(isfinite(geometry.views[k].source[i]) && isfinite(geometry.views[k].pixel0[i]));
		round_trip(&geometry);
		geometry_clear(&geometry);
	}
	rtk_geometry_clear(&rtk);
	return 0;
}

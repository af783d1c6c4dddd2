/* Any document of a scan: refused with a reason, or a scan that tells what it is and whose document reads as itself. */
#include <string.h>

#include "proto/scan.h"
#include "tests/fuzz/fuzz.h"

static void print_and_free(cJSON *value)
{
	char *text = json_print(value, NULL);

	PROMISE(text != NULL);
	free(text);
	cJSON_Delete(value);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct scan *scan = NULL, *again = NULL;
	struct error err = {0};
	char *text;

	if (scan_parse((const char *)data, size, &scan, &err) != 0) {
		PROMISE(scan == NULL && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(scan->count >= 1 && scan->geometry.count == scan->count && scan_projection_bytes(scan) >= 2);
	print_and_free(scan_derived(scan));
	print_and_free(scan_warnings(scan));
	text = json_print(scan->document, NULL);
	PROMISE(text != NULL && scan_parse(text, strlen(text), &again, &err) == 0);
	PROMISE(memcmp(scan->geometry.views, again->geometry.views, sizeof(struct view) * (size_t)scan->count) == 0);
	free(text);
	scan_free(scan);
	scan_free(again);
	return 0;
}

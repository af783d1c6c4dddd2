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

/* The odd projections are not there. */
static void reduce(struct scan *scan)
{
	const int count = scan->count;
	unsigned char *present = malloc((size_t)count);
	struct error err = {0};

	PROMISE(present != NULL);
	for (int k = 0; k < count; k++)
		present[k] = k % 2 == 0;
	PROMISE(scan_reduce(scan, present, &err) == 0);
	PROMISE(scan->count == (count + 1) / 2 && scan->geometry.count == scan->count);
	for (int k = 0; k < scan->count && count > 1; k++)
		PROMISE(scan->projection[k] == 2 * k);
	print_and_free(scan_derived(scan));
	free(present);
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
	PROMISE(memcmp(scan->air_region, again->air_region, sizeof(scan->air_region)) == 0);
	PROMISE(memcmp(scan->hardening, again->hardening, sizeof(scan->hardening)) == 0);
	PROMISE(memcmp(&scan->lag, &again->lag, sizeof(scan->lag)) == 0);
	PROMISE(memcmp(&scan->scatter, &again->scatter, sizeof(scan->scatter)) == 0);
	reduce(again);
	free(text);
	scan_free(scan);
	scan_free(again);
	return 0;
}

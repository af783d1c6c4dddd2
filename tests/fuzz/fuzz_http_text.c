/* Any text where a header's value or a target is expected: what is understood lies within its bounds. */
#include <string.h>

#include "daemon/http/text.h"
#include "tests/fuzz/fuzz.h"

static void check_range(const char *text, uint64_t size)
{
	uint64_t first = 0, length = 0;

	if (range_parse(text, size, &first, &length) == RANGE_ONE)
		PROMISE(length >= 1 && first < size && length <= size - first);
}

static void check_numbers(const char *text, size_t size)
{
	double number = 0;
	long index = 0;

	if (number_parse(text, -5, 5, &number))
		PROMISE(number >= -5 && number <= 5);
	if (index_parse(text, size, 1000, &index))
		PROMISE(index >= 0 && index <= 1000);
	if (prefer_wait(text, &number))
		PROMISE(number >= 0);
}

static void check_names(const char *text, size_t length)
{
	char host[HOST_MAX];
	long port = 0;

	if (authority_parse(text, length, host, &port))
		PROMISE(host[0] != '\0' && strlen(host) <= length && port >= -1 && port <= 65535);
	if (origin_parse(text, host, &port))
		PROMISE(host[0] != '\0' && strlen(host) < length && port >= 0 && port <= 65535);
	if (media_type_is_json(text))
		PROMISE(length > 5);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	char *text = malloc(size + 1);
	struct error err = {0};
	uint8_t digest[32];
	bool given;
	size_t length;

	PROMISE(text != NULL);
	memcpy(text, data, size);
	text[size] = '\0';
	length = strlen(text);
	check_range(text, 0);
	check_range(text, 1000);
	check_range(text, UINT64_MAX);
	check_numbers(text, length);
	check_names(text, length);
	coding_weight(text, "zstd");
	etag_in(text, "\"tag\"", false);
	etag_in(text, "\"tag\"", true);
	if (content_digest_parse(text, &given, digest, &err) != 0)
		PROMISE(err.code == ERR_INVALID && err.text[0] != '\0');
	if (percent_decode(text, true))
		PROMISE(strlen(text) <= length);
	free(text);
	return 0;
}

/*
 * Any bytes on a connection: how they are cut changes nothing of what goes on, and what goes on is understood in the
 * same way when it is read again.
 */
#include <string.h>

#include "daemon/http/framing.h"
#include "tests/fuzz/fuzz.h"

/* What goes on of the data, given in pieces of `step` bytes, what is held back in front of the next. */
static size_t pass_in_pieces(struct framing *framing, const uint8_t *data, size_t size, size_t step, char *ret_passed)
{
	char *held = malloc(size + 1);
	size_t length = 0, passed = 0;

	PROMISE(held != NULL);
	for (size_t at = 0; at < size && framing->status == 0; at += step) {
		size_t more = size - at < step ? size - at : step, went;

		memcpy(held + length, data + at, more);
		length += more;
		went = framing_pass(framing, held, length);
		PROMISE(went <= length);
		memcpy(ret_passed + passed, held, went);
		passed += went;
		length -= went;
		memmove(held, held + went, length);
		PROMISE(framing->status != 0 || length < HEAD_BYTES_MAX);
	}
	free(held);
	return passed;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static const size_t steps[] = {1, 7, 4096};
	struct framing whole = {0};
	char *passed = malloc(size + 1), *again = malloc(size + 1);
	size_t count;

	PROMISE(passed != NULL && again != NULL);
	count = pass_in_pieces(&whole, data, size, size + 1, passed);
	PROMISE((whole.status == 0) == (whole.detail[0] == '\0'));
	for (size_t i = 0; i < sizeof(steps) / sizeof(*steps); i++) {
		struct framing pieces = {0};

		PROMISE(pass_in_pieces(&pieces, data, size, steps[i], again) == count);
		PROMISE(memcmp(passed, again, count) == 0);
		PROMISE(pieces.heads == whole.heads && (pieces.status == 0) == (whole.status == 0));
	}
	{
		struct framing second = {0};

		PROMISE(pass_in_pieces(&second, (uint8_t *)passed, count, count + 1, again) == count);
		PROMISE(second.status == 0 && second.heads == whole.heads && memcmp(passed, again, count) == 0);
	}
	free(passed);
	free(again);
	return 0;
}

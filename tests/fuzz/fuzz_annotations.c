/* Any bytes as the annotations of a job: refused with a reason, or a document that reads as itself. */
#include <string.h>

#include "proto/annotations.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	char *text = NULL, *again = NULL;
	size_t length = 0, second = 0;
	struct error err = {0};

	if (annotations_read((const char *)data, size, &text, &length, &err) != 0) {
		PROMISE(text == NULL && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(strlen(text) == length);
	PROMISE(annotations_read(text, length, &again, &second, &err) == 0);
	PROMISE(second == length && memcmp(text, again, length) == 0);
	free(text);
	free(again);
	return 0;
}

/* Any bytes as an archive's answer to STOW-RS or QIDO-RS: refused with a reason, or no more instances than results. */
#include <string.h>

#include "daemon/dicom/answer.h"
#include "tests/fuzz/fuzz.h"

static void count(void *context, const char *instance)
{
	PROMISE(strlen(instance) < SIZE_MAX);
	++*(int *)context;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static const long statuses[] = {200, 202, 409, 0};
	const char *text = (const char *)data;
	struct error err = {0};
	int visited = 0, results = answer_instances(text, size, count, &visited, &err);

	PROMISE(results >= 0 ? visited <= results : err.code == results && err.text[0] != '\0');
	for (size_t i = 0; i < sizeof(statuses) / sizeof(*statuses); i++) {
		int code;

		err = (struct error){0};
		code = answer_stored(text, size, statuses[i], &err);
		PROMISE(code == err.code && (code == 0 || (code < 0 && err.text[0] != '\0')));
		PROMISE(code != 0 || statuses[i] == 200 || statuses[i] == 202);
	}
	return 0;
}

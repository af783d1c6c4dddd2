/* Any bytes: refused with a reason, or a value whose text reads as itself. */
#include <string.h>

#include "proto/json.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	cJSON *value = NULL, *again = NULL;
	struct error err = {0};
	char *once, *twice;

	if (json_parse((const char *)data, size, &value, &err) != 0) {
		PROMISE(value == NULL && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	once = json_print(value, NULL);
	PROMISE(once != NULL && json_parse(once, strlen(once), &again, &err) == 0);
	twice = json_print(again, NULL);
	PROMISE(twice != NULL && strcmp(once, twice) == 0);
	free(once);
	free(twice);
	cJSON_Delete(value);
	cJSON_Delete(again);
	return 0;
}

/* Labels of scans and jobs: see labels.h. */
#include "proto/labels.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int fail(struct error *err, int code, const char *base, const char *what)
{
	error_set(err, code, "%s", what);
	snprintf(err->pointer, sizeof(err->pointer), "%s", base);
	return code;
}

static int check_label(const cJSON *label, const char *base, struct error *err)
{
	char what[100];
	const size_t name = utf8_length(label->string);

	if (!cJSON_IsString(label))
		return fail(err, ERR_INVALID, base, "a label is no text: {\"key\": \"value\"} is expected");
	if (name == 0 || has_control(label->string) || has_control(label->valuestring))
		return fail(err, ERR_INVALID, base, "a label without a name or with control characters");
	if (name > LABEL_NAME_MOST || utf8_length(label->valuestring) > LABEL_MOST) {
		snprintf(what, sizeof(what), "a name of %zu characters with %zu, at most %d and %d are expected", name,
			 utf8_length(label->valuestring), LABEL_NAME_MOST, LABEL_MOST);
		return fail(err, ERR_IMPOSSIBLE, base, what);
	}
	return 0;
}

int labels_read(const cJSON *value, const char *base, char **ret_text, struct error *err)
{
	const cJSON *label;
	char what[100], *text;
	size_t length = 0;

	if (value == NULL || cJSON_IsNull(value)) {
		*ret_text = NULL;
		return 0;
	}
	if (!cJSON_IsObject(value))
		return fail(err, ERR_INVALID, base, "an object of texts is expected");
	if (cJSON_GetArraySize(value) > LABELS_MOST) {
		snprintf(what, sizeof(what), "%d labels, at most %d are expected", cJSON_GetArraySize(value),
			 LABELS_MOST);
		return fail(err, ERR_IMPOSSIBLE, base, what);
	}
	cJSON_ArrayForEach(label, value)
	{
		if (check_label(label, base, err) != 0)
			return err->code;
	}
	text = json_print(value, &length);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for labels");
	if (length >= LABELS_TEXT_MAX) {
		snprintf(what, sizeof(what), "labels of %zu bytes in all, at most %d are expected", length,
			 LABELS_TEXT_MAX - 1);
		free(text);
		return fail(err, ERR_IMPOSSIBLE, base, what);
	}
	*ret_text = text;
	return 0;
}

#include "tests/unit/documents.h"

#include <check.h>
#include <string.h>

char *request_printed(const struct job_request *request)
{
	cJSON *json = job_request_json(request);
	char *text;

	ck_assert_ptr_nonnull(json);
	text = json_print(json, NULL);
	cJSON_Delete(json);
	return text;
}

void expect_refused(const char *text, int code, const struct error *err, int wanted, const char *pointer,
		    const char *says)
{
	ck_assert_msg(code == wanted && err->code == code, "%s: %d %s", text, code, err->text);
	ck_assert_msg(strcmp(err->pointer, pointer) == 0, "%s: at %s", text, err->pointer);
	ck_assert_msg(strstr(err->text, says) != NULL, "%s: %s", text, err->text);
}

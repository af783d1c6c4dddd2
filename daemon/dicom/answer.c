/* What archives answer to DICOMweb: answer.h. */
#include "daemon/dicom/answer.h"

#include <cjson/cJSON.h>

int answer_refusal(long status, const char *what, struct error *err)
{
	const char *why = status == 401 || status == 403 ? " (the token is not accepted)"
			  : status == 404                ? " (is the url that of its DICOMweb?)"
			  : status == 413                ? " (the request is too large for it)"
			  : status == 507                ? " (its disk is full)"
							 : "";

	return error_set(err, ERR_IO, "it answered %s with %ld%s", what, status, why);
}

int answer_instances(const char *bytes, size_t size, void (*visit)(void *context, const char *instance), void *context,
		     struct error *err)
{
	cJSON *list = size > 0 ? cJSON_ParseWithLength(bytes, size) : cJSON_CreateArray();
	const cJSON *one;
	int count = 0;

	if (!cJSON_IsArray(list)) {
		cJSON_Delete(list);
		return error_set(err, ERR_IO, "its answer to QIDO-RS is no DICOM JSON");
	}
	cJSON_ArrayForEach(one, list)
	{
		const cJSON *instance = cJSON_GetObjectItemCaseSensitive(one, "00080018");
		const cJSON *value = cJSON_GetArrayItem(cJSON_GetObjectItemCaseSensitive(instance, "Value"), 0);

		if (cJSON_IsString(value))
			visit(context, value->valuestring);
		count++;
	}
	cJSON_Delete(list);
	return count;
}

int answer_stored(const char *bytes, size_t size, long status, struct error *err)
{
	cJSON *document = size > 0 ? cJSON_ParseWithLength(bytes, size) : NULL;
	const cJSON *sequence = cJSON_GetObjectItemCaseSensitive(document, "00081198"), *first, *reason;
	const cJSON *failed = cJSON_GetObjectItemCaseSensitive(sequence, "Value");
	const int count = cJSON_GetArraySize(failed);
	int code = 0;

	first = cJSON_GetArrayItem(failed, 0);
	reason = cJSON_GetArrayItem(
	    cJSON_GetObjectItemCaseSensitive(cJSON_GetObjectItemCaseSensitive(first, "00081197"), "Value"), 0);
	if (count > 0)
		code = error_set(err, ERR_IO, "it refused %d objects, reason 0x%04x", count,
				 cJSON_IsNumber(reason) ? (unsigned)reason->valueint : 0);
	else if (status != 200 && status != 202)
		code = answer_refusal(status, "STOW-RS", err);
	cJSON_Delete(document);
	return code;
}

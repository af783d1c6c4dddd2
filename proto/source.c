/* The objects that projections were: source.h. */
#include "proto/source.h"

#include <stdio.h>

#include "proto/json.h"
#include "proto/subject.h"

static void read_uid(struct json_reader *reader, const char *name)
{
	char uid[UID_MOST + 1] = "";

	json_string(reader, name, true, uid, sizeof(uid));
	if (reader->code == 0 && !uid_valid(uid))
		json_fail(reader, ERR_INVALID, name, UID_EXPECTED);
}

int source_check(const cJSON *source, struct error *err)
{
	const cJSON *instances, *instance;
	struct json_reader reader;
	char place[32];
	int count = 0;

	if (source == NULL)
		return 0;
	json_begin(&reader, source, "/source", err);
	read_uid(&reader, "class");
	read_uid(&reader, "series");
	instances = json_member(&reader, "instances", true);
	if (reader.code == 0 && (!cJSON_IsArray(instances) || instances->child == NULL))
		json_fail(&reader, ERR_INVALID, "instances", "expected a list of UIDs");
	cJSON_ArrayForEach(instance, instances)
	{
		snprintf(place, sizeof(place), "instances/%d", count);
		if (count++ == SOURCE_INSTANCES_MOST)
			json_fail(&reader, ERR_IMPOSSIBLE, "instances", "at most %d are expected",
				  SOURCE_INSTANCES_MOST);
		if (reader.code == 0 && (!cJSON_IsString(instance) || !uid_valid(instance->valuestring)))
			json_fail(&reader, ERR_INVALID, place, UID_EXPECTED);
	}
	return json_end(&reader);
}

cJSON *source_of(const char *text)
{
	cJSON *document = text != NULL ? cJSON_Parse(text) : NULL;
	cJSON *source = cJSON_DetachItemFromObjectCaseSensitive(document, "source");

	cJSON_Delete(document);
	return source;
}

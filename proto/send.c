/* The member "send" of a job: send.h. */
#include "proto/send.h"

#include <ctype.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { ITERATION_MOST = 100000 };

bool destination_name_valid(const char *name)
{
	const size_t length = strlen(name);

	for (size_t i = 0; i < length; i++)
		if (!isalnum((unsigned char)name[i]) && strchr("-_.", name[i]) == NULL)
			return false;
	return length > 0 && length <= DESTINATION_NAME_MOST && name[0] != '.';
}

/* ---- reading ---- */

static bool is_stage(const cJSON *value)
{
	return cJSON_IsString(value) &&
	       (strcmp(value->valuestring, "fdk") == 0 || strcmp(value->valuestring, "fdk-tv") == 0);
}

static void read_list(struct json_reader *reader, const cJSON *list, char ret[SEND_VOLUMES_SIZE])
{
	size_t used = 0;
	int place = 0;
	const cJSON *one;
	char name[40];

	ret[0] = '\0';
	cJSON_ArrayForEach(one, list)
	{
		const double number = cJSON_IsNumber(one) ? one->valuedouble : 0;

		snprintf(name, sizeof(name), "volumes/%d", place);
		if (!is_stage(one) && (number < 1 || number > ITERATION_MOST || number != (int)number)) {
			json_fail(reader, ERR_INVALID, name, "expected an iteration from 1 on, \"fdk\" or \"fdk-tv\"");
			return;
		}
		if (is_stage(one))
			used += (size_t)snprintf(ret + used, SEND_VOLUMES_SIZE - used, "%s%s", place > 0 ? "," : "",
						 one->valuestring);
		else
			used += (size_t)snprintf(ret + used, SEND_VOLUMES_SIZE - used, "%s%d", place > 0 ? "," : "",
						 (int)number);
		if (used >= SEND_VOLUMES_SIZE) {
			json_fail(reader, ERR_IMPOSSIBLE, "volumes", "the list is longer than %d characters",
				  SEND_VOLUMES_SIZE - 1);
			return;
		}
		place++;
	}
	if (place == 0)
		json_fail(reader, ERR_INVALID, "volumes", "the list is empty");
}

static void read_volumes(struct json_reader *reader, const cJSON *value, char ret[SEND_VOLUMES_SIZE])
{
	if (value == NULL || cJSON_IsNull(value))
		snprintf(ret, SEND_VOLUMES_SIZE, "last");
	else if (cJSON_IsArray(value))
		read_list(reader, value, ret);
	else if (cJSON_IsString(value) &&
		 (strcmp(value->valuestring, "last") == 0 || strcmp(value->valuestring, "all") == 0))
		snprintf(ret, SEND_VOLUMES_SIZE, "%s", value->valuestring);
	else
		json_fail(reader, ERR_INVALID, "volumes", "expected \"last\", \"all\" or a list of iterations");
}

int send_wish_read(const cJSON *value, const char *base, struct send_wish *ret_wish, struct error *err)
{
	struct send_wish wish = {.to = "", .volumes = "last"};
	struct json_reader reader;
	int code = 0;

	if (cJSON_IsString(value)) {
		if (!destination_name_valid(value->valuestring))
			return error_set_at(err, ERR_INVALID, base, "\"%.40s\" is no name of a destination",
					    value->valuestring);
		snprintf(wish.to, sizeof(wish.to), "%.*s", DESTINATION_NAME_MOST, value->valuestring);
	} else {
		json_begin(&reader, value, base, err);
		json_string(&reader, "to", true, wish.to, sizeof(wish.to));
		read_volumes(&reader, json_member(&reader, "volumes", false), wish.volumes);
		if (reader.code == 0 && !destination_name_valid(wish.to))
			json_fail(&reader, ERR_INVALID, "to", "\"%s\" is no name of a destination", wish.to);
		code = json_end(&reader);
	}
	if (code == 0)
		*ret_wish = wish;
	return code;
}

int sends_read(const cJSON *value, const char *base, char **ret_text, struct error *err)
{
	struct send_wish wishes[SENDS_MOST];
	char pointer[192];
	const cJSON *one;
	int count = 0;

	*ret_text = NULL;
	if (value == NULL || cJSON_IsNull(value))
		return 0;
	if (!cJSON_IsArray(value))
		return error_set_at(err, ERR_INVALID, base, "expected a list of destinations");
	cJSON_ArrayForEach(one, value)
	{
		snprintf(pointer, sizeof(pointer), "%s/%d", base, count);
		if (count == SENDS_MOST)
			return error_set_at(err, ERR_IMPOSSIBLE, base, "more than %d destinations", SENDS_MOST);
		if (send_wish_read(one, pointer, &wishes[count], err) != 0)
			return err->code;
		for (int i = 0; i < count; i++)
			if (strcmp(wishes[i].to, wishes[count].to) == 0)
				return error_set_at(err, ERR_IMPOSSIBLE, pointer, "\"%s\" stands there twice",
						    wishes[i].to);
		count++;
	}
	*ret_text = sends_text(wishes, count);
	return *ret_text != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a job");
}

int sends_parse(const char *text, struct send_wish ret_wishes[SENDS_MOST])
{
	cJSON *list = text != NULL ? cJSON_Parse(text) : NULL;
	struct error ignored;
	const cJSON *one;
	int count = 0;

	cJSON_ArrayForEach(one, list)
	{
		if (count < SENDS_MOST && send_wish_read(one, "", &ret_wishes[count], &ignored) == 0)
			count++;
	}
	cJSON_Delete(list);
	return count;
}

/* ---- writing ---- */

cJSON *send_volumes_json(const char *volumes)
{
	char text[SEND_VOLUMES_SIZE], *rest = text, *one;
	cJSON *list;

	if (strcmp(volumes, "last") == 0 || strcmp(volumes, "all") == 0 || strcmp(volumes, SEND_STEP) == 0)
		return cJSON_CreateString(volumes);
	list = cJSON_CreateArray();
	snprintf(text, sizeof(text), "%s", volumes);
	while (list != NULL && (one = strsep(&rest, ",")) != NULL)
		json_append(list,
			    isdigit((unsigned char)one[0]) ? cJSON_CreateNumber(atoi(one)) : cJSON_CreateString(one));
	return list;
}

char *sends_text(const struct send_wish *wishes, int count)
{
	cJSON *list = cJSON_CreateArray();
	char *text;

	for (int i = 0; i < count && list != NULL; i++) {
		cJSON *one = cJSON_CreateObject();

		cJSON_AddStringToObject(one, "to", wishes[i].to);
		json_add(one, "volumes", send_volumes_json(wishes[i].volumes));
		json_append(list, one);
	}
	text = json_print(list, NULL);
	cJSON_Delete(list);
	return text;
}

bool send_wants(const char *volumes, const char *name, int iteration, bool last)
{
	const bool of_stage = strcmp(name, "fdk") == 0 || strcmp(name, "fdk-tv") == 0;
	char text[SEND_VOLUMES_SIZE], *rest = text, *one;

	if (strcmp(volumes, "all") == 0)
		return true;
	if (strcmp(volumes, "last") == 0)
		return last;
	snprintf(text, sizeof(text), "%s", volumes);
	while ((one = strsep(&rest, ",")) != NULL) {
		if (of_stage ? strcmp(one, name) == 0 : isdigit((unsigned char)one[0]) && atoi(one) == iteration)
			return true;
	}
	return false;
}

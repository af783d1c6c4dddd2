/* Tables of parameters and JSON: see parameter.h. */
#include "proto/parameter.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

/* ---- reading ---- */

/* Whole numbers first, then their range: 8.5 is malformed, -8 is impossible. */
static void read_integers(struct json_reader *reader, const struct parameter *parameter, const char *name, void *record)
{
	double values[PARAMETER_LIST_MAX];

	json_numbers(reader, name, true, parameter->count, -1e100, 1e100, values);
	for (int i = 0; i < parameter->count && reader->code == 0; i++) {
		char place[PARAMETER_POINTER_MAX];

		snprintf(place, sizeof(place), "%s/%d", name, i);
		if (values[i] != rint(values[i]))
			json_fail(reader, ERR_INVALID, place, "%.10g, a whole number is expected", values[i]);
		else if (!(values[i] >= parameter->least && values[i] <= parameter->most))
			json_fail(reader, ERR_IMPOSSIBLE, place, "%.10g %s, %.10g to %.10g are expected", values[i],
				  parameter->unit, parameter->least, parameter->most);
		else
			parameter_set(parameter, record, i, values[i]);
	}
}

static void read_numbers(struct json_reader *reader, const struct parameter *parameter, const char *name, void *record)
{
	double values[PARAMETER_LIST_MAX];

	json_numbers(reader, name, true, parameter->count, parameter->least, parameter->most, values);
	for (int i = 0; i < parameter->count && reader->code == 0; i++)
		parameter_set(parameter, record, i, values[i]);
}

/* A number, a flag or a name, as parameter_set takes them. */
static double read_value(struct json_reader *reader, const struct parameter *parameter, const char *name)
{
	double number = 0;
	long integer = 0;
	bool flag = false;
	int index = 0;

	switch (parameter->type) {
	case PARAMETER_NUMBER:
		json_number(reader, name, true, parameter->least, parameter->most, &number);
		return number;
	case PARAMETER_INTEGER:
		json_integer(reader, name, true, (long)parameter->least, (long)parameter->most, &integer);
		return (double)integer;
	case PARAMETER_FLAG:
		json_bool(reader, name, true, &flag);
		return flag;
	default:
		json_choice(reader, name, true, parameter->names, parameter->count, &index);
		return index;
	}
}

void json_parameter(struct json_reader *reader, const struct parameter *parameter, const char *name, void *record)
{
	const cJSON *member = json_member(reader, name, parameter->presets == PRESET_REQUIRED);
	double value;

	if (member == NULL)
		return;
	if (parameter->type == PARAMETER_NUMBERS) {
		read_numbers(reader, parameter, name, record);
	} else if (parameter->type == PARAMETER_INTEGERS) {
		read_integers(reader, parameter, name, record);
	} else if (parameter->word != NULL && cJSON_IsString(member) &&
		   strcmp(member->valuestring, parameter->word) == 0) {
		parameter_set(parameter, record, 0, PARAMETER_WORD);
	} else if (parameter->word != NULL && !cJSON_IsNumber(member)) {
		json_fail(reader, ERR_INVALID, name, "a number or \"%s\" is expected", parameter->word);
	} else {
		value = read_value(reader, parameter, name);
		if (reader->code == 0)
			parameter_set(parameter, record, 0, value);
	}
}

/* The row's name within the object that `prefix`, "" or "stop/", leads to; NULL: it is not in there. */
static const char *name_within(const struct parameter_set *set, int row, const char *prefix, const void *record)
{
	const struct parameter *parameter = &set->parameters[row];
	const size_t length = strlen(prefix);

	if (strcmp(parameter->object, set->object) != 0 || strncmp(parameter->name, prefix, length) != 0 ||
	    (set->counting && !parameter_counts(parameter, record)))
		return NULL;
	return parameter->name + length;
}

/* Asks for the rows that are members by themselves, and for the members that hold others. */
static void read_members(struct json_reader *reader, const struct parameter_set *set, const char *prefix, void *record)
{
	for (int row = 0; row < set->count; row++) {
		const char *name = name_within(set, row, prefix, record);
		char part[PARAMETER_POINTER_MAX];

		if (name == NULL)
			continue;
		snprintf(part, sizeof(part), "%.*s", (int)strcspn(name, "/"), name);
		if (strlen(part) == strlen(name))
			json_parameter(reader, &set->parameters[row], name, record);
		else
			json_has(reader, part);
	}
}

void json_parameters(struct json_reader *reader, const struct parameter_set *set, void *record)
{
	read_members(reader, set, "", record);
}

static int read_object(const cJSON *value, const char *base, const struct parameter_set *set, const char *prefix,
		       void *record, struct error *err)
{
	struct json_reader reader;
	const cJSON *member;
	int code;

	json_begin(&reader, value, base, err);
	read_members(&reader, set, prefix, record);
	code = json_end(&reader);
	/* Every member is known now: those that are objects hold other rows, the rest have been read. */
	for (member = code == 0 ? value->child : NULL; member != NULL && code == 0; member = member->next) {
		char inner[PARAMETER_POINTER_MAX], pointer[PARAMETER_POINTER_MAX * 2];
		bool holds = false;

		snprintf(inner, sizeof(inner), "%s%s/", prefix, member->string);
		snprintf(pointer, sizeof(pointer), "%s/%s", base, member->string);
		for (int row = 0; row < set->count && !holds; row++)
			holds = name_within(set, row, inner, record) != NULL;
		if (holds && !cJSON_IsNull(member))
			code = read_object(member, pointer, set, inner, record, err);
	}
	return code;
}

int parameters_read(const cJSON *value, const char *base, const struct parameter_set *set, void *record,
		    struct error *err)
{
	return read_object(value, base, set, "", record, err);
}

/* ---- writing ---- */

static cJSON *list_json(const struct parameter *parameter, const void *record)
{
	double values[PARAMETER_LIST_MAX];

	for (int i = 0; i < parameter->count; i++)
		values[i] = parameter_get(parameter, record, i);
	return cJSON_CreateDoubleArray(values, parameter->count);
}

static cJSON *value_json(const struct parameter *parameter, const void *record)
{
	double value;

	if (parameter_is_list(parameter))
		return list_json(parameter, record);
	value = parameter_get(parameter, record, 0);
	if (parameter_is_word(parameter, record))
		return cJSON_CreateString(parameter->word);
	if (parameter->type == PARAMETER_FLAG)
		return cJSON_CreateBool(value != 0);
	if (parameter->names != NULL)
		return cJSON_CreateString(parameter->names[(int)value]);
	return cJSON_CreateNumber(value);
}

/* The member under that name; an object of its own is made for "stop" of "stop/residual". NULL for no memory. */
static cJSON *holder_of(cJSON *json, const char **name)
{
	const char *slash;

	while ((slash = strchr(*name, '/')) != NULL && json != NULL) {
		char part[PARAMETER_POINTER_MAX];
		cJSON *inner;

		snprintf(part, sizeof(part), "%.*s", (int)(slash - *name), *name);
		inner = cJSON_GetObjectItemCaseSensitive(json, part);
		json = inner != NULL ? inner : cJSON_AddObjectToObject(json, part);
		*name = slash + 1;
	}
	return json;
}

bool parameters_add(cJSON *json, const struct parameter_set *set, const void *record)
{
	for (int row = 0; row < set->count; row++) {
		const struct parameter *parameter = &set->parameters[row];
		const char *name = parameter->name;
		cJSON *holder;

		if (strcmp(parameter->object, set->object) != 0 || !parameter_counts(parameter, record) ||
		    (parameter->presets == PRESET_OPEN && parameter_get(parameter, record, 0) == 0))
			continue;
		holder = holder_of(json, &name);
		if (holder == NULL || !json_add(holder, name, value_json(parameter, record)))
			return false;
	}
	return true;
}

/* ---- the rows themselves ---- */

static cJSON *default_json(const struct parameter *parameter, const void *record)
{
	if (parameter->presets != PRESET_FIXED)
		return cJSON_CreateNull();
	return value_json(parameter, record);
}

static bool add_range(cJSON *json, const struct parameter *parameter)
{
	bool added = true;

	if (parameter->names != NULL)
		return json_add(json, "choices", cJSON_CreateStringArray(parameter->names, parameter->count));
	if (parameter->type == PARAMETER_FLAG)
		return true;
	added = json_add(json, "minimum", cJSON_CreateNumber(parameter->least)) &&
		json_add(json, "maximum", cJSON_CreateNumber(parameter->most));
	if (added && parameter_is_list(parameter))
		added = json_add(json, "count", cJSON_CreateNumber(parameter->count));
	if (added && parameter->word != NULL)
		added = json_add(json, "word", cJSON_CreateString(parameter->word));
	return added;
}

cJSON *parameter_json(const struct parameter *parameter, const char *object, const void *record)
{
	static const char *const types[PARAMETER_TYPE_COUNT] = {"number", "integer", "boolean", "choice",
								"choice", "numbers", "integers"};
	char pointer[PARAMETER_POINTER_MAX];
	cJSON *json = cJSON_CreateObject();
	bool added;

	parameter_pointer(parameter, object, pointer);
	added = json != NULL && json_add(json, "pointer", cJSON_CreateString(pointer)) &&
		json_add(json, "type", cJSON_CreateString(types[parameter->type])) &&
		json_add(json, "required", cJSON_CreateBool(parameter->presets == PRESET_REQUIRED)) &&
		json_add(json, "default", default_json(parameter, record)) && add_range(json, parameter) &&
		json_add(json, "help", cJSON_CreateString(parameter->help));
	if (added && parameter->unit != NULL)
		added = json_add(json, "unit", cJSON_CreateString(parameter->unit));
	if (added)
		return json;
	cJSON_Delete(json);
	return NULL;
}

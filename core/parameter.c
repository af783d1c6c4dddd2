/* Parameters as rows of tables: see parameter.h. */
#include "core/parameter.h"

#include <stdio.h>

bool parameter_counts(const struct parameter *parameter, const void *record)
{
	return parameter->counts == NULL || parameter->counts(record);
}

bool parameter_is_list(const struct parameter *parameter)
{
	return parameter->type == PARAMETER_NUMBERS || parameter->type == PARAMETER_INTEGERS;
}

bool parameter_is_word(const struct parameter *parameter, const void *record)
{
	const char *bytes = record;

	if (parameter->word == NULL)
		return false;
	if (parameter->word_offset != 0)
		return *(const bool *)(const void *)(bytes + parameter->word_offset);
	return *(const int *)(const void *)(bytes + parameter->offset) == PARAMETER_WORD;
}

double parameter_get(const struct parameter *parameter, const void *record, int i)
{
	const char *bytes = record;
	const void *at = bytes + parameter->offset;

	if (parameter_is_word(parameter, record))
		return PARAMETER_WORD;
	switch (parameter->type) {
	case PARAMETER_NUMBER:
	case PARAMETER_NUMBERS:
		return ((const double *)at)[i];
	case PARAMETER_FLAG:
	case PARAMETER_SWITCH:
		return *(const bool *)at ? 1 : 0;
	default:
		return ((const int *)at)[i];
	}
}

void parameter_set(const struct parameter *parameter, void *record, int i, double value)
{
	char *bytes = record;
	void *at = bytes + parameter->offset;

	if (parameter->word_offset != 0) {
		*(bool *)(void *)(bytes + parameter->word_offset) = value == PARAMETER_WORD;
		if (value == PARAMETER_WORD)
			return;
	}
	switch (parameter->type) {
	case PARAMETER_NUMBER:
	case PARAMETER_NUMBERS:
		((double *)at)[i] = value;
		break;
	case PARAMETER_FLAG:
	case PARAMETER_SWITCH:
		*(bool *)at = value != 0;
		break;
	default:
		((int *)at)[i] = (int)value;
		break;
	}
}

void parameters_preset(const struct parameter *parameters, int count, void *record)
{
	for (int k = 0; k < count; k++)
		if (!parameter_is_list(&parameters[k]))
			parameter_set(&parameters[k], record, 0, parameters[k].preset);
}

void parameter_pointer(const struct parameter *parameter, const char *object, char ret_pointer[PARAMETER_POINTER_MAX])
{
	snprintf(ret_pointer, PARAMETER_POINTER_MAX, "%s/%s", object != NULL ? object : parameter->object,
		 parameter->name);
}

static int refuse(const struct parameter *parameter, const char *object, int i, double value, double least, double most,
		  struct error *err)
{
	char pointer[PARAMETER_POINTER_MAX], place[PARAMETER_POINTER_MAX + 16];

	parameter_pointer(parameter, object, pointer);
	if (parameter_is_list(parameter))
		snprintf(place, sizeof(place), "%s/%d", pointer, i);
	else
		snprintf(place, sizeof(place), "%s", pointer);
	return error_set_at(err, ERR_IMPOSSIBLE, place, "%.10g, a number from %.10g to %.10g is expected", value, least,
			    most);
}

int parameter_check(const struct parameter *parameter, const void *record, const char *object, struct error *err)
{
	const bool named = parameter->type == PARAMETER_CHOICE || parameter->type == PARAMETER_SWITCH;
	const double least = named ? 0 : parameter->least, most = named ? parameter->count - 1 : parameter->most;
	const int values = parameter_is_list(parameter) ? parameter->count : 1;

	if (!parameter_counts(parameter, record) || parameter->type == PARAMETER_FLAG)
		return 0;
	for (int i = 0; i < values; i++) {
		const double value = parameter_get(parameter, record, i);

		if (parameter_is_word(parameter, record) || (parameter->presets == PRESET_OPEN && value == 0))
			continue;
		if (!(value >= least && value <= most)) /* NaN is in no range */
			return refuse(parameter, object, i, value, least, most, err);
	}
	return 0;
}

bool parameter_same(const struct parameter *parameter, const void *a, const void *b)
{
	const int values = parameter_is_list(parameter) ? parameter->count : 1;
	const bool counts = parameter_counts(parameter, a);

	if (counts != parameter_counts(parameter, b))
		return false;
	for (int i = 0; i < values && counts; i++)
		if (parameter_get(parameter, a, i) != parameter_get(parameter, b, i))
			return false;
	return true;
}

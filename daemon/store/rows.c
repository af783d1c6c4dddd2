/* Records, values and rows of record.json, by the lists of columns: store/tables.h. */
#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/catalogue.h"
#include "daemon/store/tables.h"
#include "proto/json.h"

/* ---- values ---- */

struct value value_integer(long long integer)
{
	return (struct value){.type = VALUE_INTEGER, .integer = integer};
}

struct value value_real(double real)
{
	return isnan(real) ? (struct value){.type = VALUE_NULL} : (struct value){.type = VALUE_REAL, .real = real};
}

struct value value_text(const char *text)
{
	return text == NULL ? (struct value){.type = VALUE_NULL}
			    : (struct value){.type = VALUE_TEXT, .bytes = text, .size = strlen(text)};
}

struct value value_bytes(const void *bytes, size_t size)
{
	return (struct value){.type = VALUE_BYTES, .bytes = bytes, .size = size};
}

void row_clear(struct row *row)
{
	for (int i = 0; i < row->owned_count; i++)
		free(row->owned[i]);
	row->owned_count = 0;
}

/* ---- records to values ---- */

static void *own(struct row *row, void *memory)
{
	if (memory != NULL)
		row->owned[row->owned_count++] = memory;
	return memory;
}

/* {"fdk": 1.2}: a name that a later version adds changes nothing of what is written here. */
static char *print_named(const struct column *column, const double *numbers)
{
	cJSON *object = cJSON_CreateObject();
	char *text;

	for (int i = 0; i < column->choices; i++) {
		if (numbers[i] != 0)
			cJSON_AddNumberToObject(object, column->names[i], numbers[i]);
	}
	text = json_print(object, NULL);
	cJSON_Delete(object);
	return text;
}

static struct value integer_at(const struct column *column, const void *at)
{
	long long number;
	int small;

	if (column->size == sizeof(number)) {
		memcpy(&number, at, sizeof(number));
		return value_integer(number);
	}
	memcpy(&small, at, sizeof(small));
	return value_integer(small);
}

static int add_value(const struct column *column, const void *record, const struct value *parent, struct row *row,
		     int index, struct error *err)
{
	const char *at = (const char *)record + column->at;
	struct value *value = &row->values[index];
	double real;
	int choice;

	switch (column->type) {
	case COLUMN_INT:
	case COLUMN_LONG:
	case COLUMN_NUMBER:
	case COLUMN_SEQUENCE:
		*value = integer_at(column, at);
		break;
	case COLUMN_BOOL:
		*value = value_integer(*(const bool *)(const void *)at);
		break;
	case COLUMN_REAL:
		memcpy(&real, at, sizeof(real));
		*value = value_real(real);
		break;
	case COLUMN_TEXT:
		*value = value_text(at);
		break;
	case COLUMN_STRING:
		*value = value_text(*(char *const *)(const void *)at);
		break;
	case COLUMN_CHOICE:
		memcpy(&choice, at, sizeof(choice));
		assert(choice >= 0 && choice < column->choices);
		*value = value_text(column->names[choice]);
		break;
	case COLUMN_BYTES:
		if (column->known == 0 || *((const bool *)record + column->known))
			*value = value_bytes(at, column->size);
		else
			*value = column->nullable ? value_text(NULL) : value_bytes("", 0);
		break;
	case COLUMN_NAMED:
		*value = value_text(own(row, print_named(column, (const double *)(const void *)at)));
		if (value->bytes == NULL)
			return error_set_errno(err, ENOMEM, "catalogue");
		break;
	case COLUMN_PARENT:
		*value = *parent;
		break;
	}
	return 0;
}

int row_of_column(const struct column *column, const void *record, struct row *ret_row, struct error *err)
{
	ret_row->owned_count = 0;
	return add_value(column, record, NULL, ret_row, 0, err);
}

int row_of_record(const struct table *table, enum statement statement, const void *record, const struct value *parent,
		  struct row *ret_row, struct error *err)
{
	int count = 0, code = 0;

	ret_row->owned_count = 0;
	for (int i = 0; i < table->count && code == 0; i++) {
		if (column_takes_part(&table->columns[i], statement))
			code = add_value(&table->columns[i], record, parent, ret_row, count++, err);
	}
	return code == 0 ? count : code;
}

/* ---- values to records ---- */

/* Numbers without a name in the text stay 0; names that this version does not know are passed over. */
static bool read_named(const struct column *column, const char *text, double *ret)
{
	cJSON *object = cJSON_Parse(text);
	const cJSON *number;
	bool fine = cJSON_IsObject(object);

	for (int i = 0; i < column->choices && fine; i++) {
		number = cJSON_GetObjectItemCaseSensitive(object, column->names[i]);
		if (cJSON_IsNumber(number))
			ret[i] = number->valuedouble;
	}
	cJSON_Delete(object);
	return fine;
}

static bool read_choice(const struct column *column, const char *text, int *ret_choice)
{
	for (int i = 0; i < column->choices; i++) {
		if (strcmp(text, column->names[i]) == 0) {
			*ret_choice = i;
			return true;
		}
	}
	return false;
}

static void put_integer(const struct column *column, long long number, void *at)
{
	int small = (int)number;

	if (column->size == sizeof(number))
		memcpy(at, &number, sizeof(number));
	else
		memcpy(at, &small, sizeof(small));
}

/* False: the value is invalid, or there is no memory (*ret_memory false). */
static bool read_value(const struct column *column, const struct value *value, void *record, bool *ret_memory)
{
	char *at = (char *)record + column->at;
	bool text = value->type == VALUE_TEXT;
	double real = value->type == VALUE_NULL   ? NAN
		      : value->type == VALUE_REAL ? value->real
						  : (double)value->integer;
	int choice;

	*ret_memory = true;
	switch (column->type) {
	case COLUMN_INT:
	case COLUMN_LONG:
	case COLUMN_NUMBER:
	case COLUMN_SEQUENCE:
		put_integer(column, value->integer, at);
		return value->type == VALUE_INTEGER;
	case COLUMN_BOOL:
		*(bool *)(void *)at = value->integer != 0;
		return value->type == VALUE_INTEGER;
	case COLUMN_REAL:
		memcpy(at, &real, sizeof(real));
		return !text && value->type != VALUE_BYTES && (column->nullable || value->type != VALUE_NULL);
	case COLUMN_TEXT:
		snprintf(at, column->size, "%s", text ? (const char *)value->bytes : "");
		return text;
	case COLUMN_STRING:
		*(char **)(void *)at = text ? strdup(value->bytes) : NULL;
		*ret_memory = !text || *(char **)(void *)at != NULL;
		return *ret_memory && (text || (column->nullable && value->type == VALUE_NULL));
	case COLUMN_CHOICE:
		if (!text || !read_choice(column, value->bytes, &choice))
			return false;
		memcpy(at, &choice, sizeof(choice));
		return true;
	case COLUMN_BYTES:
		if (column->known != 0)
			*((bool *)record + column->known) = value->size == column->size;
		if (value->type == VALUE_BYTES && value->size == column->size)
			memcpy(at, value->bytes, column->size);
		return value->type == VALUE_BYTES || (column->nullable && value->type == VALUE_NULL);
	case COLUMN_NAMED:
		return text && read_named(column, value->bytes, (double *)(void *)at);
	case COLUMN_PARENT:
		break;
	}
	return true;
}

int record_of_row(const struct table *table, const struct value *values, void *record, struct error *err)
{
	bool memory;

	for (int i = 0; i < table->count; i++) {
		if (!column_takes_part(&table->columns[i], STATEMENT_LIST))
			continue;
		if (!read_value(&table->columns[i], values++, record, &memory))
			return memory ? error_set(err, ERR_IO, "catalogue: a row of %s has an invalid %s", table->name,
						  table->columns[i].name)
				      : error_set_errno(err, ENOMEM, "rows of %s", table->name);
	}
	return 0;
}

void table_clear(const struct table *table, void *record)
{
	for (int i = 0; i < table->count; i++) {
		if (table->columns[i].type == COLUMN_STRING)
			free(*(char **)(void *)((char *)record + table->columns[i].at));
	}
}

/* ---- rows of record.json ---- */

cJSON *json_of_value(const struct value *value)
{
	cJSON *object;
	char *hex;

	switch (value->type) {
	case VALUE_INTEGER:
		return cJSON_CreateNumber((double)value->integer);
	case VALUE_REAL:
		return cJSON_CreateNumber(value->real);
	case VALUE_TEXT:
		return cJSON_CreateString(value->bytes);
	case VALUE_BYTES:
		hex = malloc(2 * value->size + 1);
		if (hex == NULL)
			return NULL;
		hex[0] = '\0';
		for (size_t i = 0; i < value->size; i++)
			snprintf(hex + 2 * i, 3, "%02x", ((const unsigned char *)value->bytes)[i]);
		object = cJSON_CreateObject();
		if (cJSON_AddStringToObject(object, "hex", hex) == NULL) {
			cJSON_Delete(object);
			object = NULL;
		}
		free(hex);
		return object;
	default:
		return cJSON_CreateNull();
	}
}

cJSON *json_of_row(const struct table *table, const struct value *values)
{
	cJSON *object = cJSON_CreateObject();

	for (int i = 0; i < table->count; i++) {
		const struct column *column = &table->columns[i];

		if (!column_takes_part(column, STATEMENT_LIST))
			continue;
		if (column->type != COLUMN_NUMBER) {
			cJSON *member = json_of_value(values);

			/* A row that lacks a column would be read with that column's default. */
			if (!json_add(object, column->name, member)) {
				cJSON_Delete(object);
				return NULL;
			}
		}
		values++;
	}
	return object;
}

/* The bytes of {"hex": ...}. */
static bool read_hex(const cJSON *value, struct row *row, struct value *ret_value)
{
	const cJSON *hex = cJSON_GetObjectItemCaseSensitive(value, "hex");
	unsigned char *bytes;
	size_t size;

	if (!cJSON_IsString(hex))
		return false;
	size = strlen(hex->valuestring) / 2;
	bytes = own(row, malloc(size + 1));
	for (size_t i = 0; i < size && bytes != NULL; i++) {
		const char digits[3] = {hex->valuestring[2 * i], hex->valuestring[2 * i + 1], '\0'};

		bytes[i] = (unsigned char)strtoul(digits, NULL, 16);
	}
	*ret_value = value_bytes(bytes, size);
	return bytes != NULL;
}

static bool value_of_json(const struct column *column, const cJSON *member, struct row *row, struct value *ret_value)
{
	bool real = column->type == COLUMN_REAL;

	if (member == NULL && column->initial != NULL && column_is_text(column))
		*ret_value = value_text(column->initial);
	else if (member == NULL && column->initial != NULL)
		*ret_value = real ? value_real(strtod(column->initial, NULL)) : value_integer(atoll(column->initial));
	else if (member == NULL || cJSON_IsNull(member))
		*ret_value = value_text(NULL);
	else if (cJSON_IsString(member))
		*ret_value = value_text(member->valuestring);
	else if (cJSON_IsNumber(member) && real)
		*ret_value = value_real(member->valuedouble);
	else if (cJSON_IsNumber(member) && fabs(member->valuedouble) < 9e15)
		*ret_value = value_integer((long long)member->valuedouble);
	else
		return cJSON_IsObject(member) && read_hex(member, row, ret_value);
	return true;
}

int row_of_json(const struct table *table, enum statement statement, const cJSON *object, const struct value *parent,
		struct row *ret_row, struct error *err)
{
	union {
		struct catalogue_scan scan;
		struct job_record job;
		struct volume_record volume;
		struct warning_record warning;
		struct catalogue_event event;
	} room;
	void *record = memset(&room, 0, sizeof(room));
	bool memory = true;
	int count = 0;

	assert(table->size <= sizeof(room));
	ret_row->owned_count = 0;
	for (int i = 0; i < table->count; i++) {
		const struct column *column = &table->columns[i];
		const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, column->name);
		struct value *value = &ret_row->values[count];

		if (!column_takes_part(column, statement))
			continue;
		count++;
		if (column->type == COLUMN_PARENT)
			*value = *parent;
		else if (!value_of_json(column, member, ret_row, value) ||
			 !read_value(column, value, record, &memory)) {
			table_clear(table, record);
			return memory ? error_set(err, ERR_INVALID, "its row of %s does not fit in %s", table->name,
						  column->name)
				      : error_set_errno(err, ENOMEM, "rows of %s", table->name);
		}
	}
	table_clear(table, record);
	return count;
}

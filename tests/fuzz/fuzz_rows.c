/*
 * Any bytes as rows of the catalogue. The first byte says which table. Text after it is a row of record.json; what
 * other bytes say are values as a damaged catalogue may hold them. Refused with a reason, or a row that comes back the
 * same.
 */
#include <string.h>

#include "daemon/store/tables.h"
#include "proto/json.h"
#include "tests/fuzz/fuzz.h"

static void check_json(const struct table *table, const char *text, size_t length)
{
	struct error err = {0};
	cJSON *object = NULL;

	if (json_parse(text, length, &object, &err) != 0)
		return;
	for (int i = 0; i < 2; i++) {
		const struct value parent = value_integer(1);
		struct row row;

		memset(&row, 0, sizeof(row));
		if (row_of_json(table, i == 0 ? STATEMENT_RESTORE : STATEMENT_PUT, object, &parent, &row, &err) < 0)
			PROMISE(err.code < 0 && err.text[0] != '\0');
		row_clear(&row);
	}
	cJSON_Delete(object);
}

/* A byte of type, then of length where there is one, then the content; texts end with 0 as a database gives them. */
static const uint8_t *take_value(const uint8_t *data, const uint8_t *end, struct value *ret, char *ret_text)
{
	const int type = data < end ? *data++ % 5 : VALUE_NULL;
	size_t length = type >= 3 && data < end ? *data++ : 8;
	double real = 0;

	if (length > (size_t)(end - data))
		length = (size_t)(end - data);
	switch (type) {
	case 1:
		memcpy(&ret->integer, data, length);
		*ret = value_integer(ret->integer);
		break;
	case 2:
		memcpy(&real, data, length);
		*ret = value_real(real);
		break;
	case 3:
		memcpy(ret_text, data, length);
		ret_text[length] = '\0';
		*ret = value_text(ret_text);
		break;
	case 4:
		memcpy(ret_text, data, length);
		*ret = value_bytes(ret_text, length);
		break;
	default:
		length = 0;
	}
	return data + length;
}

static void check_values(const struct table *table, const uint8_t *data, size_t size)
{
	static char texts[COLUMNS_MAX][256];
	const uint8_t *const end = data + size;
	struct value values[COLUMNS_MAX];
	void *record = calloc(1, table->size);
	struct error err = {0};
	struct row row;

	PROMISE(record != NULL);
	memset(values, 0, sizeof(values));
	for (int i = 0; i < COLUMNS_MAX; i++)
		data = take_value(data, end, &values[i], texts[i]);
	cJSON_Delete(json_of_row(table, values));
	if (record_of_row(table, values, record, &err) == 0) {
		const struct value parent = value_integer(1);

		memset(&row, 0, sizeof(row));
		if (row_of_record(table, STATEMENT_INSERT, record, &parent, &row, &err) < 0)
			PROMISE(err.code < 0);
		row_clear(&row);
	} else {
		PROMISE(err.code < 0 && err.text[0] != '\0');
	}
	table_clear(table, record);
	free(record);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	if (size < 1)
		return 0;
	if (data[0] < 0x80)
		check_json(&tables[data[0] % TABLE_COUNT], (const char *)data + 1, size - 1);
	else
		check_values(&tables[data[0] % TABLE_COUNT], data + 1, size - 1);
	return 0;
}

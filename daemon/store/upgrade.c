/* Older catalogues, and what older records have in other forms: store/upgrade.h. */
#include "daemon/store/upgrade.h"

#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/log.h"
#include "daemon/store/catalogue.h"
#include "daemon/store/tables.h"

/* ---- up to version 10: arrays of the processor's numbers, in this order; older ones are shorter ---- */

static const char *const earlier_stages[] = {"load", "fdk", "sart", "tv", "save", "cgls"};
static const size_t earlier_memory[] = {
    offsetof(struct job_record, memory.projections), offsetof(struct job_record, memory.volumes),
    offsetof(struct job_record, memory.scratch),     offsetof(struct job_record, memory.total),
    offsetof(struct job_record, memory.available),   offsetof(struct job_record, memory.host),
};
#define COUNT(array) (sizeof(array) / sizeof((array)[0]))

static void read_seconds(const unsigned char *bytes, size_t size, struct job_record *job)
{
	double seconds;

	for (size_t i = 0; i < COUNT(earlier_stages) && (i + 1) * sizeof(seconds) <= size; i++) {
		memcpy(&seconds, bytes + i * sizeof(seconds), sizeof(seconds));
		for (int stage = 0; stage < STAGE_COUNT; stage++) {
			if (strcmp(stage_names[stage], earlier_stages[i]) == 0)
				job->seconds[stage] = seconds;
		}
	}
}

static void read_memory(const unsigned char *bytes, size_t size, struct job_record *job)
{
	uint64_t number;

	for (size_t i = 0; i < COUNT(earlier_memory) && (i + 1) * sizeof(number) <= size; i++) {
		memcpy(&number, bytes + i * sizeof(number), sizeof(number));
		*(size_t *)(void *)((char *)job + earlier_memory[i]) = (size_t)number;
	}
}

/* The columns that took the place of the arrays. */
static bool came_from_array(const struct column *column)
{
	return column->size > 0 && (column->at == offsetof(struct job_record, seconds) ||
				    (column->at >= offsetof(struct job_record, memory) &&
				     column->at < offsetof(struct job_record, memory) + sizeof(struct recon_memory)));
}

/* ---- rows of a record ---- */

static size_t read_hex(const cJSON *row, const char *name, unsigned char *ret_bytes, size_t most)
{
	const cJSON *hex = cJSON_GetObjectItemCaseSensitive(cJSON_GetObjectItemCaseSensitive(row, name), "hex");
	size_t size = cJSON_IsString(hex) ? strlen(hex->valuestring) / 2 : 0;

	for (size_t i = 0; i < size && i < most; i++) {
		const char digits[3] = {hex->valuestring[2 * i], hex->valuestring[2 * i + 1], '\0'};

		ret_bytes[i] = (unsigned char)strtoul(digits, NULL, 16);
	}
	return size < most ? size : most;
}

int catalogue_upgrade_job(cJSON *row, struct error *err)
{
	const struct table *jobs = &tables[TABLE_JOBS];
	struct job_record job = {.id = ""};
	unsigned char bytes[128];
	struct row values;
	int code = 0;

	if (cJSON_GetObjectItemCaseSensitive(row, "seconds") == NULL)
		return 0;
	read_seconds(bytes, read_hex(row, "seconds", bytes, sizeof(bytes)), &job);
	read_memory(bytes, read_hex(row, "memory", bytes, sizeof(bytes)), &job);
	for (int i = 0; i < jobs->count && code == 0; i++) {
		if (!came_from_array(&jobs->columns[i]))
			continue;
		code = row_of_column(&jobs->columns[i], &job, &values, err);
		if (code == 0 && !json_add(row, jobs->columns[i].name, json_of_value(&values.values[0])))
			code = error_set_errno(err, ENOMEM, "a row of the catalogue");
		row_clear(&values);
	}
	return code;
}

/* ---- rows of a catalogue ---- */

struct arrays {
	FILE *out; /* one UPDATE for each row */
};

static int convert_row(void *context, const struct value *row, struct error *err)
{
	const struct table *jobs = &tables[TABLE_JOBS];
	const struct arrays *arrays = context;
	struct job_record job = {.id = ""};
	const char *between = "";
	struct row values;
	int code = 0;

	read_memory(row[1].bytes, row[1].size, &job);
	read_seconds(row[2].bytes, row[2].size, &job);
	fprintf(arrays->out, "UPDATE jobs SET ");
	for (int i = 0; i < jobs->count && code == 0; i++) {
		if (!came_from_array(&jobs->columns[i]))
			continue;
		code = row_of_column(&jobs->columns[i], &job, &values, err);
		if (code != 0)
			break;
		fprintf(arrays->out, "%s%s = ", between, jobs->columns[i].name);
		if (values.values[0].type == VALUE_TEXT)
			fprintf(arrays->out, "'%s'", (const char *)values.values[0].bytes);
		else
			fprintf(arrays->out, "%lld", values.values[0].integer);
		between = ", ";
		row_clear(&values);
	}
	fprintf(arrays->out, " WHERE number = %lld;", row[0].integer);
	return code;
}

static int convert_arrays(const struct catalogue_backend *backend, void *database, struct error *err)
{
	struct arrays arrays;
	char *text = NULL;
	size_t size;
	int code;

	arrays.out = open_memstream(&text, &size);
	if (arrays.out == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	code = backend->run(database, SESSION_WRITER, "SELECT number, memory, seconds FROM jobs", NULL, 0, convert_row,
			    &arrays, err);
	if (fclose(arrays.out) != 0 && code == 0)
		code = error_set_errno(err, ENOMEM, "catalogue");
	if (code == 0)
		code = backend->script(database, text, err);
	free(text);
	if (code == 0)
		code = backend->script(
		    database, "ALTER TABLE jobs DROP COLUMN memory; ALTER TABLE jobs DROP COLUMN seconds;", err);
	return code;
}

/* ---- tables and columns ---- */

struct present {
	const struct table *table;
	bool any, columns[COLUMNS_MAX];
};

static int note_column(void *context, const struct value *values, struct error *err)
{
	struct present *present = context;

	(void)err;
	present->any = true;
	for (int i = 0; i < present->table->count; i++) {
		if (strcmp(present->table->columns[i].name, values[0].bytes) == 0)
			present->columns[i] = true;
	}
	return 0;
}

/* Runs a statement that was made, and frees it. */
static int run_made(const struct catalogue_backend *backend, void *database, char *sql, struct error *err)
{
	int code = sql == NULL ? error_set_errno(err, ENOMEM, "catalogue") : backend->script(database, sql, err);

	free(sql);
	return code;
}

static int complete_table(const struct catalogue_backend *backend, void *database, const struct table *table,
			  struct error *err)
{
	struct present present = {.table = table};
	int code = backend->columns(database, table->name, note_column, &present, err);

	if (code == 0 && !present.any)
		code = run_made(backend, database, table_creation(table, &backend->dialect), err);
	for (int i = 0; i < table->count && code == 0 && present.any; i++) {
		if (!present.columns[i])
			code = run_made(backend, database, table_addition(table, &table->columns[i], &backend->dialect),
					err);
	}
	if (code == 0 && table->index != NULL)
		code = backend->script(database, table->index, err);
	return code;
}

int catalogue_upgrade(const struct catalogue_backend *backend, void *database, int version, struct error *err)
{
	struct error ignored;
	int code = backend->begin(database, true, err);

	if (code != 0)
		return code;
	for (int i = 0; i < TABLE_COUNT && code == 0; i++)
		code = complete_table(backend, database, &tables[i], err);
	if (code == 0 && version > 0 && version < 11)
		code = convert_arrays(backend, database, err);
	if (code == 0)
		code = backend->set_version(database, CATALOGUE_VERSION, err);
	if (code != 0) {
		backend->end(database, false, &ignored);
		return code;
	}
	code = backend->end(database, true, err);
	if (code == 0 && version > 0)
		log_line(LEVEL_INFO, "the catalogue was of version %d and has version %d now", version,
			 CATALOGUE_VERSION);
	return code;
}

/* Lists of columns, and the statements made from them: store/tables.h. */
#include "daemon/store/tables.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/catalogue.h"

#define AT(record, member) .at = offsetof(struct record, member), .size = sizeof(((struct record *)0)->member)

static const struct column scan_columns[] = {
    {"number", COLUMN_NUMBER, .size = 0},
    {"id", COLUMN_TEXT, AT(catalogue_scan, id), .unique = true},
    {"name", COLUMN_TEXT, AT(catalogue_scan, name)},
    {"client", COLUMN_TEXT, AT(catalogue_scan, client), .initial = ""},
    {"created", COLUMN_REAL, AT(catalogue_scan, created)},
    {"columns", COLUMN_INT, AT(catalogue_scan, columns)},
    {"rows", COLUMN_INT, AT(catalogue_scan, rows)},
    {"count", COLUMN_INT, AT(catalogue_scan, count)},
    {"sample", COLUMN_CHOICE, AT(catalogue_scan, sample), .names = sample_names, .choices = 2},
    {"quantity", COLUMN_CHOICE, AT(catalogue_scan, quantity), .names = quantity_names, .choices = 2},
    {"air", COLUMN_REAL, AT(catalogue_scan, air)},
#define IMAGE_COLUMN(id, name, ...)                                                                                    \
	{name,                                                                                                         \
	 COLUMN_BYTES,                                                                                                 \
	 AT(catalogue_scan, images[IMAGE_##id].sha256),                                                                \
	 .known = offsetof(struct catalogue_scan, images[IMAGE_##id].known),                                           \
	 .nullable = true,                                                                                             \
	 .assigned = true},
    IMAGES(IMAGE_COLUMN) // SHA-256 of each image
    {"scatter_columns", COLUMN_INT, AT(catalogue_scan, scatter.columns), .initial = "0"},
    {"scatter_rows", COLUMN_INT, AT(catalogue_scan, scatter.rows), .initial = "0"},
    {"scatter_every", COLUMN_INT, AT(catalogue_scan, scatter.every), .initial = "0"},
    {"pinned", COLUMN_BOOL, AT(catalogue_scan, pinned), .initial = "0", .assigned = true},
    {"closed", COLUMN_BOOL, AT(catalogue_scan, closed), .initial = "0", .assigned = true},
    {"stamp", COLUMN_LONG, AT(catalogue_scan, stamp), .initial = "0", .assigned = true},
};

/* A row: the samples are on the disk. */
static const struct column projection_columns[] = {
    {"scan", COLUMN_PARENT, .size = 0},
    {"view", COLUMN_INT, AT(catalogue_projection, view)},
    {"sha256", COLUMN_BYTES, AT(catalogue_projection, sha256)},
};

/* Idempotency-Keys of POST /v1/scans. */
static const struct column scan_key_columns[] = {
    {"key", COLUMN_STRING, AT(catalogue_scan_key, key)},
    {"request_sha256", COLUMN_BYTES, AT(catalogue_scan_key, sha256)},
    {"scan", COLUMN_PARENT, .size = 0},
};

static const struct column job_columns[] = {
    {"number", COLUMN_NUMBER, .size = 0},
    {"id", COLUMN_TEXT, AT(job_record, id), .unique = true},
    {"scan", COLUMN_TEXT, AT(job_record, scan)}, /* its id; the scan may be gone once the job has ended */
    {"state", COLUMN_CHOICE, AT(job_record, state), .names = job_state_names, .choices = JOB_STATE_COUNT,
     .changes = true},
    {"priority", COLUMN_CHOICE, AT(job_record, priority), .names = priority_names, .choices = PRIORITY_COUNT},
    {"ticket", COLUMN_LONG, AT(job_record, ticket), .changes = true},
    {"request", COLUMN_STRING, AT(job_record, request)},
    {"mu_water", COLUMN_REAL, AT(job_record, mu_water)},
    {"iterations", COLUMN_INT, AT(job_record, iterations)},
    {"idempotency_key", COLUMN_STRING, AT(job_record, key), .nullable = true, .unique = true},
    {"request_sha256", COLUMN_BYTES, AT(job_record, digest), .nullable = true},
    {"cancel_asked", COLUMN_BOOL, AT(job_record, cancel_asked), .changes = true},
    {"pinned", COLUMN_BOOL, AT(job_record, pinned), .initial = "0", .changes = true},
    {"annotated", COLUMN_BOOL, AT(job_record, annotated), .initial = "0", .assigned = true},
    {"attempts", COLUMN_INT, AT(job_record, attempts), .changes = true},
    {"crashes", COLUMN_INT, AT(job_record, crashes), .changes = true},
    {"checkpoint", COLUMN_INT, AT(job_record, checkpoint), .changes = true},
    {"backend", COLUMN_TEXT, AT(job_record, backend), .changes = true},
    {"device", COLUMN_TEXT, AT(job_record, device), .changes = true},
    {"plan", COLUMN_TEXT, AT(job_record, plan), .changes = true},
    {"ran_on", COLUMN_TEXT, AT(job_record, ran_on), .initial = "", .changes = true},
#define MEMORY(member)                                                                                                 \
	{                                                                                                              \
		"memory_" #member, COLUMN_LONG, AT(job_record, memory.member), .initial = "0", .changes = true         \
	}
    MEMORY(projections),
    MEMORY(volumes),
    MEMORY(scratch),
    MEMORY(total),
    MEMORY(available),
    MEMORY(host),
    {"error_code", COLUMN_INT, AT(job_record, error_code), .changes = true},
    {"error_pointer", COLUMN_TEXT, AT(job_record, error_pointer), .changes = true},
    {"error_text", COLUMN_TEXT, AT(job_record, error_text), .changes = true},
    {"error_report", COLUMN_TEXT, AT(job_record, error_report), .initial = "", .changes = true},
    {"created", COLUMN_REAL, AT(job_record, created)},
    {"queued", COLUMN_REAL, AT(job_record, queued), .changes = true},
    {"started", COLUMN_REAL, AT(job_record, started), .changes = true},
    {"ended", COLUMN_REAL, AT(job_record, ended), .changes = true},
    {"stage_seconds", COLUMN_NAMED, AT(job_record, seconds), .names = stage_names, .choices = STAGE_COUNT,
     .initial = "{}", .changes = true},
    {"stage", COLUMN_CHOICE, AT(job_record, stage), .names = stage_names, .choices = STAGE_COUNT, .changes = true},
    {"iteration", COLUMN_INT, AT(job_record, iteration), .changes = true},
    {"fraction", COLUMN_REAL, AT(job_record, fraction), .changes = true},
    {"basis", COLUMN_INT, AT(job_record, basis), .initial = "0", .changes = true},
    {"stamp", COLUMN_LONG, AT(job_record, stamp), .initial = "0", .assigned = true},
    {"noise_hu", COLUMN_REAL, AT(job_record, noise_hu), .nullable = true, .changes = true},
    {"tv_alpha", COLUMN_REAL, AT(job_record, tv_alpha), .nullable = true, .changes = true},
    {"client", COLUMN_TEXT, AT(job_record, client), .initial = ""},
    {"subject", COLUMN_STRING, AT(job_record, subject), .nullable = true},
    {"stop_rule", COLUMN_CHOICE, AT(job_record, stop.rule), .names = stop_rule_names, .choices = STOP_RULE_COUNT,
     .initial = "none", .changes = true},
    {"stop_iteration", COLUMN_INT, AT(job_record, stop.iteration), .initial = "0", .changes = true},
    {"stop_residual", COLUMN_REAL, AT(job_record, stop.residual), .initial = "0", .changes = true},
    {"stop_change", COLUMN_REAL, AT(job_record, stop.change), .initial = "0", .changes = true},
    {"stop_noise", COLUMN_REAL, AT(job_record, stop.noise), .initial = "0", .changes = true},
    {"agreement_views", COLUMN_INT, AT(job_record, agreement.views), .initial = "0", .changes = true},
    {"agreement_mm", COLUMN_REAL, AT(job_record, agreement.mm), .initial = "0", .changes = true},
    {"agreement_sigma_mm", COLUMN_REAL, AT(job_record, agreement.sigma_mm), .initial = "0", .changes = true},
    {"agreement_unexplained", COLUMN_REAL, AT(job_record, agreement.unexplained), .initial = "0", .changes = true},
};

_Static_assert(sizeof(job_columns) / sizeof(job_columns[0]) <= COLUMNS_MAX, "a row has room for a job");

static const struct column volume_columns[] = {
    {"number", COLUMN_NUMBER, .size = 0},
    {"job", COLUMN_PARENT, .size = 0},
    {"name", COLUMN_TEXT, AT(volume_record, name)},
    {"stage", COLUMN_TEXT, AT(volume_record, stage)},
    {"iteration", COLUMN_INT, AT(volume_record, iteration)},
    {"nx", COLUMN_INT, AT(volume_record, grid.size[0])},
    {"ny", COLUMN_INT, AT(volume_record, grid.size[1])},
    {"nz", COLUMN_INT, AT(volume_record, grid.size[2])},
    {"dx", COLUMN_REAL, AT(volume_record, grid.spacing[0])},
    {"dy", COLUMN_REAL, AT(volume_record, grid.spacing[1])},
    {"dz", COLUMN_REAL, AT(volume_record, grid.spacing[2])},
    {"x0", COLUMN_REAL, AT(volume_record, grid.origin[0])},
    {"y0", COLUMN_REAL, AT(volume_record, grid.origin[1])},
    {"z0", COLUMN_REAL, AT(volume_record, grid.origin[2])},
    {"bytes", COLUMN_LONG, AT(volume_record, bytes)},
    {"sha256", COLUMN_BYTES, AT(volume_record, sha256), .known = offsetof(struct volume_record, hashed)},
    {"norm2", COLUMN_REAL, AT(volume_record, norms.norm2), .nullable = true},
    {"difference2", COLUMN_REAL, AT(volume_record, norms.difference2), .nullable = true},
    {"tv", COLUMN_REAL, AT(volume_record, norms.tv), .nullable = true},
    {"minimum", COLUMN_REAL, AT(volume_record, norms.minimum), .nullable = true},
    {"maximum", COLUMN_REAL, AT(volume_record, norms.maximum), .nullable = true},
    {"mean", COLUMN_REAL, AT(volume_record, norms.mean), .nullable = true},
    {"not_finite", COLUMN_LONG, AT(volume_record, norms.not_finite)},
    {"created", COLUMN_REAL, AT(volume_record, created)},
    {"estimate_mm", COLUMN_REAL, AT(volume_record, estimate_mm), .initial = "0"},
    {"noise_hu", COLUMN_REAL, AT(volume_record, quality.noise_hu), .nullable = true},
    {"streak_hu", COLUMN_REAL, AT(volume_record, quality.streak_hu), .nullable = true},
    {"ring_hu", COLUMN_REAL, AT(volume_record, quality.ring_hu), .nullable = true},
    {"edge_mm", COLUMN_REAL, AT(volume_record, quality.edge_mm), .nullable = true},
    {"metal_share", COLUMN_REAL, AT(volume_record, support.metal), .nullable = true},
    {"estimated_share", COLUMN_REAL, AT(volume_record, support.estimated), .nullable = true},
    {"held_out", COLUMN_INT, AT(volume_record, support.held_out), .initial = "0"},
    {"held_residual", COLUMN_REAL, AT(volume_record, support.held_residual), .nullable = true},
    {"used_residual", COLUMN_REAL, AT(volume_record, support.used_residual), .nullable = true},
};

static const struct column history_columns[] = {
    {"job", COLUMN_PARENT, .size = 0},
    {"iteration", COLUMN_INT, AT(history_row, iteration)},
    {"residual", COLUMN_REAL, AT(history_row, residual), .nullable = true},
    {"change", COLUMN_REAL, AT(history_row, change), .nullable = true},
    {"tv", COLUMN_REAL, AT(history_row, tv), .nullable = true},
    {"seconds", COLUMN_REAL, AT(history_row, seconds), .nullable = true},
};

static const struct column warning_columns[] = {
    {"number", COLUMN_NUMBER, .size = 0},
    {"job", COLUMN_PARENT, .size = 0},
    {"code", COLUMN_TEXT, AT(warning_record, code)},
    {"detail", COLUMN_TEXT, AT(warning_record, detail)},
};

static const struct column sending_columns[] = {
    {"job", COLUMN_PARENT, .size = 0},
    {"name", COLUMN_TEXT, AT(sending_record, name)},
    {"destination", COLUMN_TEXT, AT(sending_record, destination)},
    {"volume", COLUMN_TEXT, AT(sending_record, volume)},
    {"volumes", COLUMN_TEXT, AT(sending_record, volumes)},
    {"state", COLUMN_CHOICE, AT(sending_record, state), .names = sending_state_names, .choices = SENDING_STATE_COUNT},
    {"attempts", COLUMN_INT, AT(sending_record, attempts)},
    {"instances", COLUMN_INT, AT(sending_record, instances)},
    {"stored", COLUMN_INT, AT(sending_record, stored)},
    {"error", COLUMN_TEXT, AT(sending_record, error)},
    {"created", COLUMN_REAL, AT(sending_record, created)},
    {"next", COLUMN_REAL, AT(sending_record, next)},
    {"ended", COLUMN_REAL, AT(sending_record, ended)},
    {"transaction_uid", COLUMN_TEXT, AT(sending_record, transaction), .initial = ""},
};

static const struct column event_columns[] = {
    {"number", COLUMN_SEQUENCE, AT(catalogue_event, number)}, /* clients resume from it */
    {"job", COLUMN_PARENT, .size = 0},
    {"created", COLUMN_REAL, AT(catalogue_event, created)},
    {"kind", COLUMN_STRING, AT(catalogue_event, kind)},
    {"data", COLUMN_STRING, AT(catalogue_event, data)},
    /* De-duplication key: a restarted job repeats its work, an event with this key is recorded once. NULL: no key. */
    {"once", COLUMN_STRING, AT(catalogue_event, once), .nullable = true},
};

static const struct column removal_columns[] = {
    {"number", COLUMN_LONG, AT(catalogue_removal, number)},
    {"job", COLUMN_TEXT, AT(catalogue_removal, job)},
};

#define COLUMNS(list) .columns = (list), .count = sizeof(list) / sizeof((list)[0])
const struct table tables[TABLE_COUNT] = {
    [TABLE_SCANS] = {"scans", COLUMNS(scan_columns), .size = sizeof(struct catalogue_scan), .key = "id", .order = "id"},
    [TABLE_PROJECTIONS] = {"projections", COLUMNS(projection_columns), .size = sizeof(struct catalogue_projection),
			   .key = "scan, view", .clustered = true, .parent = "scans", .reference = "scan",
			   .recorded_apart = true, .order = "view", .name_of = "view", .put = PUT_REPLACES},
    [TABLE_SCAN_KEYS] = {"scan_keys", COLUMNS(scan_key_columns), .size = sizeof(struct catalogue_scan_key),
			 .key = "key", .clustered = true, .parent = "scans", .reference = "scan", .order = "key",
			 .put = PUT_KEEPS,
			 .index = "CREATE INDEX IF NOT EXISTS scan_keys_of_scan ON scan_keys (scan);"},
    [TABLE_JOBS] = {"jobs", COLUMNS(job_columns), .size = sizeof(struct job_record), .key = "id", .order = "id"},
    [TABLE_HISTORY] = {"history", COLUMNS(history_columns), .size = sizeof(struct history_row), .key = "job, iteration",
		       .clustered = true, .parent = "jobs", .reference = "job", .order = "iteration",
		       .put = PUT_REPLACES},
    [TABLE_VOLUMES] = {"volumes", COLUMNS(volume_columns), .size = sizeof(struct volume_record), .key = "job, name",
		       .unique = "job, name", .parent = "jobs", .reference = "job", .order = "number",
		       .name_of = "name", .put = PUT_MOVES},
    [TABLE_WARNINGS] = {"warnings", COLUMNS(warning_columns), .size = sizeof(struct warning_record),
			.key = "job, code, detail", .unique = "job, code, detail", .parent = "jobs", .reference = "job",
			.order = "number", .put = PUT_KEEPS},
    [TABLE_SENDINGS] = {"sendings", COLUMNS(sending_columns), .size = sizeof(struct sending_record), .key = "job, name",
			.clustered = true, .parent = "jobs", .reference = "job", .order = "name", .name_of = "name",
			.put = PUT_REPLACES},
    [TABLE_EVENTS] = {"events", COLUMNS(event_columns), .size = sizeof(struct catalogue_event), .key = "number",
		      .parent = "jobs", .reference = "job", .order = "number", .put = PUT_KEEPS,
		      .index = "CREATE INDEX IF NOT EXISTS events_of_job ON events (job, number);"
			       "CREATE UNIQUE INDEX IF NOT EXISTS events_once ON events (job, once);"},
    /* A page that was away for more removals than are kept reads its list anew. */
    [TABLE_REMOVALS] = {"removals", COLUMNS(removal_columns), .size = sizeof(struct catalogue_removal), .key = "number",
			.clustered = true, .order = "number", .kept = 1000},
};

/* ---- statements ---- */

bool column_takes_part(const struct column *column, enum statement statement)
{
	switch (statement) {
	case STATEMENT_LIST:
	case STATEMENT_GET:
		return column->size > 0;
	case STATEMENT_UPDATE:
		return column->changes;
	case STATEMENT_RESTORE:
		return column->type != COLUMN_NUMBER;
	default:
		return column->type != COLUMN_NUMBER && column->type != COLUMN_SEQUENCE;
	}
}

/* The names of the columns of a statement, each with what `format` makes of it; returns how many. */
static int print_names(FILE *out, const struct table *table, enum statement statement, const char *between,
		       const char *format)
{
	int count = 0;

	for (int i = 0; i < table->count; i++) {
		if (!column_takes_part(&table->columns[i], statement))
			continue;
		fprintf(out, "%s%s", count++ > 0 ? between : "", table->columns[i].name);
		if (strcmp(format, "=") == 0)
			fprintf(out, " = $%d", count);
		else if (strcmp(format, "excluded") == 0)
			fprintf(out, " = excluded.%s", table->columns[i].name);
	}
	return count;
}

static void print_parameters(FILE *out, const struct table *table, enum statement statement)
{
	int count = 0;

	for (int i = 0; i < table->count; i++) {
		if (!column_takes_part(&table->columns[i], statement))
			continue;
		fputs(count++ > 0 ? ", " : "", out);
		if (table->columns[i].type == COLUMN_PARENT)
			fprintf(out, "(SELECT number FROM %s WHERE id = $%d)", table->parent, count);
		else
			fprintf(out, "$%d", count);
	}
}

static void print_parent(FILE *out, const struct table *table)
{
	if (table->parent != NULL)
		fprintf(out, " WHERE %s = (SELECT number FROM %s WHERE id = $1)", table->reference, table->parent);
}

static void print_insertion(FILE *out, const struct table *table, enum statement statement)
{
	fprintf(out, "INSERT INTO %s (", table->name);
	print_names(out, table, statement, ", ", "");
	fprintf(out, ") VALUES (");
	print_parameters(out, table, statement);
	fprintf(out, ")");
	if (statement == STATEMENT_PUT) {
		fprintf(out, " ON CONFLICT (%s) DO UPDATE SET ", table->key);
		print_names(out, table, statement, ", ", "excluded");
	} else if (statement == STATEMENT_INSERT) {
		fprintf(out, "%s RETURNING %s", table->put == PUT_KEEPS ? " ON CONFLICT DO NOTHING" : "",
			table->columns[0].name);
	}
}

static void print_statement(FILE *out, const struct table *table, enum statement statement)
{
	int count;

	switch (statement) {
	case STATEMENT_UPDATE:
		fprintf(out, "UPDATE %s SET ", table->name);
		count = print_names(out, table, statement, ", ", "=");
		fprintf(out, " WHERE id = $%d", count + 1);
		break;
	case STATEMENT_LIST:
	case STATEMENT_GET:
		fprintf(out, "SELECT ");
		print_names(out, table, statement, ", ", "");
		fprintf(out, " FROM %s", table->name);
		print_parent(out, table);
		fprintf(out, statement == STATEMENT_GET ? " WHERE id = $1" : " ORDER BY %s", table->order);
		break;
	case STATEMENT_REMOVE:
		fprintf(out, "DELETE FROM %s", table->name);
		if (table->parent != NULL)
			print_parent(out, table);
		else
			fprintf(out, " WHERE id = $1");
		break;
	case STATEMENT_TAKE:
		fprintf(out, "DELETE FROM %s", table->name);
		print_parent(out, table);
		fprintf(out, " AND %s = $2", table->name_of != NULL ? table->name_of : table->key);
		break;
	case STATEMENT_TRIM:
		fprintf(out, "DELETE FROM %s WHERE %s <= (SELECT %s FROM %s ORDER BY %s DESC LIMIT 1 OFFSET %d)",
			table->name, table->key, table->key, table->name, table->key, table->kept);
		break;
	default:
		print_insertion(out, table, statement);
	}
}

/* The text of a stream that open_memstream made; NULL: no memory. */
static char *finish(FILE *out, char **text)
{
	if (out != NULL && fclose(out) == 0)
		return *text;
	if (out != NULL)
		free(*text);
	return NULL;
}

char *table_statement(const struct table *table, enum statement statement)
{
	char *text = NULL;
	size_t size;
	FILE *out = open_memstream(&text, &size);

	if (out != NULL)
		print_statement(out, table, statement);
	return finish(out, &text);
}

char *table_assignment(const struct table *table, int column)
{
	char *text = NULL;

	return asprintf(&text, "UPDATE %s SET %s = $1 WHERE id = $2", table->name, table->columns[column].name) < 0
		   ? NULL
		   : text;
}

bool column_is_text(const struct column *column)
{
	return column->type == COLUMN_TEXT || column->type == COLUMN_STRING || column->type == COLUMN_CHOICE ||
	       column->type == COLUMN_NAMED;
}

static const char *type_words(const struct column *column, const struct dialect *dialect)
{
	switch (column->type) {
	case COLUMN_NUMBER:
		return dialect->number;
	case COLUMN_SEQUENCE:
		return dialect->sequence;
	case COLUMN_REAL:
		return dialect->real;
	case COLUMN_BYTES:
		return dialect->bytes;
	default:
		return column_is_text(column) ? dialect->text : dialect->integer;
	}
}

static void print_definition(FILE *out, const struct table *table, const struct column *column,
			     const struct dialect *dialect)
{
	fprintf(out, "%s %s", column->name, type_words(column, dialect));
	if (column->type == COLUMN_NUMBER || column->type == COLUMN_SEQUENCE)
		return;
	if (!column->nullable)
		fprintf(out, " NOT NULL");
	if (column->initial != NULL)
		fprintf(out, column_is_text(column) ? " DEFAULT '%s'" : " DEFAULT %s", column->initial);
	if (column->unique)
		fprintf(out, " UNIQUE");
	if (table->reference != NULL && strcmp(column->name, table->reference) == 0)
		fprintf(out, " REFERENCES %s(number) ON DELETE CASCADE", table->parent);
}

char *table_creation(const struct table *table, const struct dialect *dialect)
{
	char *text = NULL;
	size_t size;
	FILE *out = open_memstream(&text, &size);

	if (out == NULL)
		return NULL;
	fprintf(out, "CREATE TABLE %s (", table->name);
	for (int i = 0; i < table->count; i++) {
		fputs(i > 0 ? ", " : "", out);
		print_definition(out, table, &table->columns[i], dialect);
	}
	if (table->unique != NULL)
		fprintf(out, ", UNIQUE (%s)", table->unique);
	if (table->clustered)
		fprintf(out, ", PRIMARY KEY (%s))%s;", table->key, dialect->clustered);
	else
		fprintf(out, ");");
	return finish(out, &text);
}

char *table_addition(const struct table *table, const struct column *column, const struct dialect *dialect)
{
	char *text = NULL;
	size_t size;
	FILE *out = open_memstream(&text, &size);

	if (out == NULL)
		return NULL;
	fprintf(out, "ALTER TABLE %s ADD COLUMN ", table->name);
	print_definition(out, table, column, dialect);
	return finish(out, &text);
}

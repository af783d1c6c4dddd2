/* The catalogue over whatever database runs its statements: store/catalogue.h. */
#include "daemon/store/catalogue.h"

#include <assert.h>
#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/lock.h"
#include "daemon/store/catalogue_internal.h"
#include "daemon/store/upgrade.h"

extern const struct catalogue_backend catalogue_sqlite;
extern const struct catalogue_backend catalogue_postgresql __attribute__((weak));

/* NULL: what it needs was not there when this was built. */
static const struct {
	const char *name;
	bool address; /* it has one */
	const struct catalogue_backend *backend;
} engines[] = {{"sqlite", false, &catalogue_sqlite}, {"postgresql", true, &catalogue_postgresql}};
enum { ENGINE_COUNT = sizeof(engines) / sizeof(engines[0]) };

const enum table_id catalogue_record_tables[RECORD_KINDS] = {TABLE_SCANS, TABLE_JOBS};

/* ---- opening ---- */

static int make_statements(struct catalogue *catalogue, struct error *err)
{
	bool made = true;

	for (int i = 0; i < TABLE_COUNT; i++) {
		for (int j = 0; j < STATEMENT_COUNT; j++) {
			catalogue->statements[i][j] = table_statement(&tables[i], (enum statement)j);
			made = made && catalogue->statements[i][j] != NULL;
		}
		for (int j = 0; j < tables[i].count; j++) {
			catalogue->assignments[i][j] = table_assignment(&tables[i], j);
			made = made && catalogue->assignments[i][j] != NULL;
		}
	}
	return made ? 0 : error_set_errno(err, ENOMEM, "catalogue");
}

/* The address itself is not told: it may have a password. */
static int find_engine(const char *address, const struct catalogue_backend **ret_backend, struct error *err)
{
	for (int i = 0; i < ENGINE_COUNT; i++) {
		const size_t length = strlen(engines[i].name);

		if (strncmp(address, engines[i].name, length) != 0 ||
		    (engines[i].address ? strncmp(address + length, "://", 3) != 0 : address[length] != '\0'))
			continue;
		if (engines[i].backend == NULL)
			return error_set(err, ERR_INVALID,
					 "the catalogue is to be %s://..., but this cbctd was built "
					 "without libpq (Debian's libpq-dev)",
					 engines[i].name);
		*ret_backend = engines[i].backend;
		return 0;
	}
	return error_set(err, ERR_INVALID, "the catalogue is to be \"%.*s\"; sqlite and postgresql://... are known",
			 (int)strcspn(address, ":/@= "), address);
}

int catalogue_check_address(const char *address, struct error *err)
{
	const struct catalogue_backend *backend;
	int code = find_engine(address, &backend, err);

	return code == 0 && backend->check != NULL ? backend->check(address, err) : code;
}

int catalogue_new(const struct catalogue_place *place, const struct catalogue_hooks *hooks,
		  struct catalogue **ret_catalogue, struct error *err)
{
	const struct catalogue_backend *backend = NULL;
	struct catalogue *catalogue;
	int code = find_engine(place->address, &backend, err);

	if (code != 0)
		return code;
	catalogue = calloc(1, sizeof(*catalogue));
	if (catalogue == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	snprintf(catalogue->site.directory, sizeof(catalogue->site.directory), "%s", place->directory);
	snprintf(catalogue->site.address, sizeof(catalogue->site.address), "%s", place->address);
	catalogue->site.timeout = place->timeout;
	catalogue->site.context = hooks->context;
	catalogue->site.failed = hooks->failed;
	catalogue->site.make_room = hooks->make_room;
	catalogue->backend = backend;
	for (int i = 0; i < SESSION_COUNT; i++)
		lock_init(&catalogue->locks[i], LOCK_CATALOGUE);
	code = make_statements(catalogue, err);
	if (code != 0)
		catalogue_free(catalogue);
	else
		*ret_catalogue = catalogue;
	return code;
}

static void close_database(struct catalogue *catalogue)
{
	catalogue->backend->close(catalogue->database);
	catalogue->database = NULL;
}

void catalogue_free(struct catalogue *catalogue)
{
	if (catalogue == NULL)
		return;
	close_database(catalogue);
	catalogue_forget_former(catalogue);
	free(catalogue->former);
	for (int i = 0; i < SESSION_COUNT; i++)
		pthread_mutex_destroy(&catalogue->locks[i]);
	for (int i = 0; i < TABLE_COUNT; i++) {
		for (int j = 0; j < STATEMENT_COUNT; j++)
			free(catalogue->statements[i][j]);
		for (int j = 0; j < COLUMNS_MAX; j++)
			free(catalogue->assignments[i][j]);
	}
	free(catalogue);
}

int catalogue_open(struct catalogue *catalogue, bool *ret_fresh, bool *ret_interrupted, struct error *err)
{
	const struct catalogue_backend *backend = catalogue->backend;
	int version = 0, code;

	close_database(catalogue);
	atomic_store(&catalogue->site.damaged, false);
	code = backend->look(&catalogue->site, &version, ret_interrupted, err);
	if (code == 0 && version > CATALOGUE_VERSION)
		code = error_set(err, ERR_CONFLICT,
				 "the catalogue has version %d, made by a later cbctd; this one knows %d", version,
				 CATALOGUE_VERSION);
	if (code == 0)
		code = backend->open(&catalogue->site, &catalogue->database, err);
	if (code == 0 && version < CATALOGUE_VERSION)
		code = catalogue_upgrade(backend, catalogue->database, version, err);
	if (code != 0)
		close_database(catalogue);
	else
		*ret_fresh = version == 0;
	return code;
}

bool catalogue_damaged(const struct catalogue *catalogue)
{
	return atomic_load(&catalogue->site.damaged);
}

bool catalogue_away(const struct catalogue *catalogue)
{
	return atomic_load(&catalogue->site.away);
}

const char *catalogue_engine(const struct catalogue *catalogue)
{
	return catalogue->backend->name;
}

const char *catalogue_file(const struct catalogue *catalogue)
{
	return catalogue->backend->file;
}

unsigned long catalogue_losses(const struct catalogue *catalogue)
{
	return atomic_load(&catalogue->site.losses);
}

int catalogue_set_aside(struct catalogue *catalogue, const char *why, struct error *err)
{
	close_database(catalogue);
	return catalogue->backend->set_aside(&catalogue->site, why, err);
}

int catalogue_start(struct catalogue *catalogue, struct error *err)
{
	return catalogue->backend->start(catalogue->database, err);
}

int catalogue_freeze(struct catalogue *catalogue, bool frozen, struct error *err)
{
	return catalogue->backend->freeze(catalogue->database, frozen, err);
}

/* ---- groups ---- */

int catalogue_begin(struct catalogue *catalogue, bool synced, struct error *err)
{
	int code;

	pthread_mutex_lock(&catalogue->locks[SESSION_WRITER]);
	code = catalogue->backend->begin(catalogue->database, synced, err);
	if (code == 0 && catalogue->unsettled != SETTLED)
		code = catalogue_settle(catalogue, synced, err);
	catalogue->group_event = 0;
	catalogue->group_removes = false;
	if (code != 0)
		pthread_mutex_unlock(&catalogue->locks[SESSION_WRITER]);
	return code;
}

int catalogue_end(struct catalogue *catalogue, int code, struct error *err)
{
	struct error ignored;

	if (code == 0) {
		code = catalogue->backend->end(catalogue->database, true, err);
		if (code == ERR_AWAY)
			catalogue->unsettled = UNKNOWN;
		if ((code == 0 || catalogue->group_removes) && catalogue->group_event > catalogue->acknowledged)
			catalogue->acknowledged = catalogue->group_event;
	} else {
		catalogue->backend->end(catalogue->database, false, &ignored);
	}
	if (catalogue->unsettled == SETTLED)
		catalogue_forget_former(catalogue);
	pthread_mutex_unlock(&catalogue->locks[SESSION_WRITER]);
	return code;
}

/* ---- statements ---- */

int catalogue_write(struct catalogue *catalogue, const char *sql, const struct value *values, int count,
		    struct error *err)
{
	return catalogue->backend->run(catalogue->database, SESSION_WRITER, sql, values, count, NULL, NULL, err);
}

/* What a group whose end is not known may have left is seen by nobody. */
static int settle_before_reading(struct catalogue *catalogue, struct error *err)
{
	int code = catalogue_begin(catalogue, true, err);

	return code == 0 ? catalogue_end(catalogue, 0, err) : code;
}

int catalogue_read(struct catalogue *catalogue, const char *sql, const struct value *values, int count,
		   row_function row, void *context, struct error *err)
{
	int code = 0;

	if (catalogue->unsettled != SETTLED)
		code = settle_before_reading(catalogue, err);
	if (code != 0)
		return code;

	pthread_mutex_lock(&catalogue->locks[SESSION_READER]);
	code = catalogue->backend->run(catalogue->database, SESSION_READER, sql, values, count, row, context, err);
	pthread_mutex_unlock(&catalogue->locks[SESSION_READER]);
	return code;
}

static int note_row(void *context, const struct value *values, struct error *err)
{
	long long *first = context;

	(void)err;
	*first = values[0].type == VALUE_INTEGER ? values[0].integer : 1;
	return 0;
}

/* INSERT or PUT; *ret_first: the first column of the new row where that is a number, else 1; 0: nothing was new. */
static int write_record(struct catalogue *catalogue, enum table_id table, enum statement statement, const char *owner,
			const void *record, long long *ret_first, struct error *err)
{
	const struct value id = value_text(owner);
	struct row row;
	int code, count = row_of_record(&tables[table], statement, record, &id, &row, err);

	*ret_first = 0;
	code = count < 0 ? count
			 : catalogue->backend->run(catalogue->database, SESSION_WRITER,
						   catalogue->statements[table][statement], row.values, count, note_row,
						   ret_first, err);
	row_clear(&row);
	return code;
}

static int note_fresh(struct catalogue *catalogue, enum table_id table, const void *record, struct error *err)
{
	const enum record_kind kind = table == TABLE_SCANS ? RECORD_SCAN : RECORD_JOB;
	const struct catalogue_scan *scan = record;
	const struct job_record *job = record;

	return catalogue_note_former(catalogue, kind, kind == RECORD_SCAN ? scan->id : job->id, true, err);
}

int catalogue_put_row(struct catalogue *catalogue, enum table_id table, const char *owner, const void *record,
		      long long *ret_number, struct error *err)
{
	bool replaces = tables[table].put == PUT_REPLACES;
	long long first = 0;
	int code = tables[table].put == PUT_MOVES ? catalogue_take_row(catalogue, table, owner, record, err) : 0;

	if (code == 0 && (table == TABLE_SCANS || table == TABLE_JOBS))
		code = note_fresh(catalogue, table, record, err);
	if (code == 0)
		code = write_record(catalogue, table, replaces ? STATEMENT_PUT : STATEMENT_INSERT, owner, record,
				    &first, err);
	if (code == 0 && tables[table].kept > 0)
		code = catalogue_write(catalogue, catalogue->statements[table][STATEMENT_TRIM], NULL, 0, err);
	if (code == 0 && ret_number != NULL)
		*ret_number = replaces ? 1 : first;
	if (code == 0 && table == TABLE_EVENTS && first > catalogue->group_event)
		catalogue->group_event = first;
	catalogue->group_removes |= table == TABLE_REMOVALS;
	return code;
}

int catalogue_remove_rows(struct catalogue *catalogue, enum table_id table, const char *id, struct error *err)
{
	const struct value value = value_text(id);

	return catalogue_write(catalogue, catalogue->statements[table][STATEMENT_REMOVE], &value, 1, err);
}

int catalogue_set_member(struct catalogue *catalogue, enum table_id table, const char *id, const void *record,
			 const void *member, struct error *err)
{
	size_t at = (size_t)((const char *)member - (const char *)record);
	struct row row;
	int column = 0, code;

	while (!tables[table].columns[column].assigned || tables[table].columns[column].at != at) {
		column++;
		assert(column < tables[table].count);
	}
	code = row_of_column(&tables[table].columns[column], record, &row, err);
	if (code == 0)
		code =
		    catalogue_note_former(catalogue, table == TABLE_SCANS ? RECORD_SCAN : RECORD_JOB, id, false, err);
	row.values[1] = value_text(id);
	if (code == 0)
		code = catalogue_write(catalogue, catalogue->assignments[table][column], row.values, 2, err);
	row_clear(&row);
	return code;
}

int catalogue_take_row(struct catalogue *catalogue, enum table_id table, const char *owner, const void *record,
		       struct error *err)
{
	const struct column *column = tables[table].columns;
	struct value values[2];
	struct row row;
	int code;

	assert(tables[table].name_of != NULL);
	while (strcmp(column->name, tables[table].name_of) != 0)
		column++;
	code = row_of_column(column, record, &row, err);
	values[0] = value_text(owner);
	values[1] = row.values[0];
	if (code == 0)
		code = catalogue_write(catalogue, catalogue->statements[table][STATEMENT_TAKE], values, 2, err);
	row_clear(&row);
	return code;
}

struct listing {
	const struct table *table;
	char *records;
	int count;
};

static int add_record(void *context, const struct value *values, struct error *err)
{
	struct listing *listing = context;
	size_t size = listing->table->size;
	int count = listing->count;

	if ((count & (count - 1)) == 0) { /* the array doubles */
		char *more = realloc(listing->records, (size_t)(count == 0 ? 1 : 2 * count) * size);

		if (more == NULL)
			return error_set_errno(err, ENOMEM, "rows of %s", listing->table->name);
		listing->records = more;
	}
	memset(listing->records + (size_t)count * size, 0, size);
	listing->count++;
	return record_of_row(listing->table, values, listing->records + (size_t)count * size, err);
}

int catalogue_list_rows(struct catalogue *catalogue, enum table_id table, const char *owner, void *ret_records,
			int *ret_count, struct error *err)
{
	struct listing listing = {.table = &tables[table]};
	const struct value id = value_text(owner);
	int code;

	assert((owner != NULL) == (tables[table].parent != NULL));
	code = catalogue_read(catalogue, catalogue->statements[table][STATEMENT_LIST], &id, owner != NULL, add_record,
			      &listing, err);
	if (code != 0) {
		for (int i = 0; i < listing.count; i++)
			table_clear(listing.table, listing.records + (size_t)i * listing.table->size);
		free(listing.records);
		return code;
	}
	/* A pointer of the records' own type: all pointers to objects have one form (POSIX). */
	memcpy(ret_records, &listing.records, sizeof(listing.records));
	*ret_count = listing.count;
	return 0;
}

/* ---- scans and jobs alike ---- */

int catalogue_remove(struct catalogue *catalogue, enum record_kind kind, const char *id, struct error *err)
{
	return catalogue_remove_rows(catalogue, catalogue_record_tables[kind], id, err);
}

struct stamp_visit {
	int (*visit)(void *context, const char *id, long long stamp, struct error *err);
	void *context;
};

static int visit_stamp(void *context, const struct value *values, struct error *err)
{
	const struct stamp_visit *visit = context;

	return visit->visit(visit->context, values[0].bytes, values[1].integer, err);
}

int catalogue_stamps(struct catalogue *catalogue, enum record_kind kind,
		     int (*visit)(void *context, const char *id, long long stamp, struct error *err), void *context,
		     struct error *err)
{
	static const char *const statements[RECORD_KINDS] = {"SELECT id, stamp FROM scans ORDER BY id",
							     "SELECT id, stamp FROM jobs ORDER BY id"};
	struct stamp_visit each = {visit, context};

	return catalogue->backend->run(catalogue->database, SESSION_WRITER, statements[kind], NULL, 0, visit_stamp,
				       &each, err);
}

/* The tables whose rows go into a record beneath that of the scan or job; projections have records of their own. */
static bool is_beneath(const struct table *table, enum record_kind kind)
{
	return table->parent != NULL && !table->recorded_apart &&
	       strcmp(table->parent, tables[catalogue_record_tables[kind]].name) == 0;
}

struct exported {
	const struct table *table;
	cJSON *list;
};

static int export_row(void *context, const struct value *values, struct error *err)
{
	const struct exported *exported = context;
	cJSON *object = json_of_row(exported->table, values);

	if (json_append(exported->list, object))
		return 0;
	return error_set_errno(err, ENOMEM, "rows of %s", exported->table->name);
}

static int export_rows(struct catalogue *catalogue, enum table_id table, enum statement statement, const char *id,
		       cJSON *rows, struct error *err)
{
	struct exported exported = {&tables[table], cJSON_AddArrayToObject(rows, tables[table].name)};
	const struct value value = value_text(id);

	if (exported.list == NULL)
		return error_set_errno(err, ENOMEM, "rows of %s", tables[table].name);
	return catalogue->backend->run(catalogue->database, SESSION_WRITER, catalogue->statements[table][statement],
				       &value, 1, export_row, &exported, err);
}

int catalogue_export(struct catalogue *catalogue, enum record_kind kind, const char *id, cJSON **ret_rows,
		     struct error *err)
{
	enum table_id own = catalogue_record_tables[kind];
	cJSON *rows = cJSON_CreateObject();
	int code = export_rows(catalogue, own, STATEMENT_GET, id, rows, err);

	for (int i = 0; i < TABLE_COUNT && code == 0; i++) {
		if (is_beneath(&tables[i], kind))
			code = export_rows(catalogue, (enum table_id)i, STATEMENT_LIST, id, rows, err);
	}
	if (code == 0 && cJSON_GetArraySize(cJSON_GetObjectItemCaseSensitive(rows, tables[own].name)) == 0) {
		cJSON_Delete(rows);
		rows = NULL;
	}
	if (code == 0)
		*ret_rows = rows;
	else
		cJSON_Delete(rows);
	return code;
}

static int import_row(struct catalogue *catalogue, enum table_id table, enum statement statement, const char *id,
		      const cJSON *object, struct error *err)
{
	const struct value parent = value_text(id);
	struct row row;
	int code, count = row_of_json(&tables[table], statement, object, &parent, &row, err);

	code = count < 0 ? count
			 : catalogue_write(catalogue, catalogue->statements[table][statement], row.values, count, err);
	row_clear(&row);
	/* The row breaks a rule of its table: another row has this number or key. */
	if (code == ERR_INTERNAL)
		code = error_set(err, ERR_INVALID, "its row of %s does not fit beside the others", tables[table].name);
	return code;
}

static int import_own(struct catalogue *catalogue, enum record_kind kind, const cJSON *object, struct error *err)
{
	cJSON *row = cJSON_Duplicate(object, true);
	int code = kind == RECORD_JOB ? catalogue_upgrade_job(row, err) : 0;

	if (code == 0)
		code = import_row(catalogue, catalogue_record_tables[kind], STATEMENT_PUT, NULL, row, err);
	cJSON_Delete(row);
	return code;
}

static int import_rows(struct catalogue *catalogue, enum record_kind kind, const char *id, const cJSON *rows,
		       struct error *err)
{
	const char *name = tables[catalogue_record_tables[kind]].name;
	const cJSON *row;
	int code =
	    import_own(catalogue, kind, cJSON_GetArrayItem(cJSON_GetObjectItemCaseSensitive(rows, name), 0), err);

	for (int i = 0; i < TABLE_COUNT && code == 0; i++) {
		if (!is_beneath(&tables[i], kind))
			continue;
		code = catalogue_remove_rows(catalogue, (enum table_id)i, id, err);
		cJSON_ArrayForEach(row, cJSON_GetObjectItemCaseSensitive(rows, tables[i].name))
		{
			if (code == 0)
				code = import_row(catalogue, (enum table_id)i, STATEMENT_RESTORE, id, row, err);
		}
	}
	return code;
}

int catalogue_import(struct catalogue *catalogue, enum record_kind kind, const char *id, const cJSON *rows,
		     struct error *err)
{
	struct error ignored;
	int code = catalogue_write(catalogue, "SAVEPOINT import", NULL, 0, err);

	if (code != 0)
		return code;
	code = import_rows(catalogue, kind, id, rows, err);
	if (code == 0)
		return catalogue_write(catalogue, "RELEASE import", NULL, 0, err);
	catalogue_write(catalogue, "ROLLBACK TO import", NULL, 0, &ignored);
	catalogue_write(catalogue, "RELEASE import", NULL, 0, &ignored);
	return code;
}

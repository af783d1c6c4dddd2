/*
 * Groups whose end is not known: the answer to their commit was lost with the connection. Their callers were told that
 * they had failed and went on from what was before; so before the next group the catalogue does, too, should the
 * database have committed after all. What has to be as it was are the own rows of scans and jobs, which are kept as
 * they were while a group changes them, and the events, which go by their numbers.
 */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/log.h"
#include "daemon/store/catalogue_internal.h"

static int add_former(struct catalogue *catalogue, enum record_kind kind, const char *id, cJSON *row, struct error *err)
{
	int space = catalogue->former_space == 0 ? 4 : 2 * catalogue->former_space;
	struct former *more = catalogue->former, *former;

	if (catalogue->former_count == catalogue->former_space) {
		more = realloc(more, (size_t)space * sizeof(*more));
		if (more == NULL) {
			cJSON_Delete(row);
			return error_set_errno(err, ENOMEM, "catalogue");
		}
		catalogue->former = more;
		catalogue->former_space = space;
	}
	former = &catalogue->former[catalogue->former_count++];
	*former = (struct former){.kind = kind, .row = row};
	memcpy(former->id, id, sizeof(former->id));
	return 0;
}

struct former_row {
	const struct table *table;
	cJSON *row;
};

static int take_row(void *context, const struct value *values, struct error *err)
{
	struct former_row *former = context;

	former->row = json_of_row(former->table, values);
	return former->row == NULL ? error_set_errno(err, ENOMEM, "catalogue") : 0;
}

int catalogue_note_former(struct catalogue *catalogue, enum record_kind kind, const char *id, bool fresh,
			  struct error *err)
{
	const enum table_id table = catalogue_record_tables[kind];
	struct former_row former = {&tables[table], NULL};
	const struct value value = value_text(id);
	int code = 0;

	if (catalogue->backend->committed == NULL)
		return 0;
	for (int i = 0; i < catalogue->former_count; i++) {
		if (catalogue->former[i].kind == kind && strcmp(catalogue->former[i].id, id) == 0)
			return 0;
	}
	if (!fresh)
		code = catalogue->backend->run(catalogue->database, SESSION_WRITER,
					       catalogue->statements[table][STATEMENT_GET], &value, 1, take_row,
					       &former, err);
	return code == 0 ? add_former(catalogue, kind, id, former.row, err) : code;
}

void catalogue_forget_former(struct catalogue *catalogue)
{
	for (int i = 0; i < catalogue->former_count; i++)
		cJSON_Delete(catalogue->former[i].row);
	catalogue->former_count = 0;
}

static int undo_row(struct catalogue *catalogue, const struct former *former, struct error *err)
{
	const enum table_id table = catalogue_record_tables[former->kind];
	struct row row;
	int count, code;

	if (former->row == NULL)
		return catalogue_remove_rows(catalogue, table, former->id, err);
	count = row_of_json(&tables[table], STATEMENT_PUT, former->row, NULL, &row, err);
	code = count < 0
		   ? count
		   : catalogue_write(catalogue, catalogue->statements[table][STATEMENT_PUT], row.values, count, err);
	row_clear(&row);
	return code;
}

/* In a group. */
static int undo_rows(struct catalogue *catalogue, struct error *err)
{
	const struct value acknowledged = value_integer(catalogue->acknowledged);
	int code = 0;

	for (int i = 0; i < catalogue->former_count && code == 0; i++)
		code = undo_row(catalogue, &catalogue->former[i], err);
	if (code == 0)
		code = catalogue_write(catalogue, "DELETE FROM events WHERE number > $1", &acknowledged, 1, err);
	if (code == 0)
		code = catalogue_write(catalogue, "DELETE FROM removals WHERE number > $1", &acknowledged, 1, err);
	return code;
}

int catalogue_settle(struct catalogue *catalogue, bool synced, struct error *err)
{
	const struct catalogue_backend *backend = catalogue->backend;
	struct error ignored;
	int code = 0;

	if (catalogue->unsettled == UNKNOWN)
		catalogue->unsettled = backend->committed(catalogue->database) ? TO_UNDO : SETTLED;
	if (catalogue->unsettled == TO_UNDO) {
		log_line(LEVEL_INFO, "the catalogue had taken a change whose answer was lost: it is taken back");
		code = undo_rows(catalogue, err);
		if (code == 0)
			code = backend->end(catalogue->database, true, err);
		else
			backend->end(catalogue->database, false, &ignored);
		if (code != 0)
			return code;
		catalogue->unsettled = SETTLED;
		code = backend->begin(catalogue->database, synced, err);
	}
	catalogue_forget_former(catalogue);
	return code;
}

/* The calls of the catalogue for scans, jobs and events: store/catalogue.h. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/catalogue_internal.h"
#include "proto/clock.h"

enum { REMOVALS_KEPT = 1000 /* a page that was away for longer reads its list anew */ };

/* ---- scans ---- */

int catalogue_add_scan(struct catalogue *catalogue, const struct catalogue_scan *scan, const struct store_key *key,
		       long long *ret_number, struct error *err)
{
	int code = catalogue_write_record(catalogue, TABLE_SCANS, STATEMENT_INSERT, NULL, scan, ret_number, err);
	struct catalogue_scan_key row;
	long long first;

	if (code != 0 || key == NULL)
		return code;
	row.key = key->text;
	memcpy(row.sha256, key->digest, sizeof(row.sha256));
	code = catalogue_write_record(catalogue, TABLE_SCAN_KEYS, STATEMENT_INSERT, scan->id, &row, &first, err);
	if (code == 0 && first == 0)
		return error_set(err, ERR_CONFLICT, "this Idempotency-Key was used meanwhile");
	return code;
}

struct found_key {
	char *scan;
	uint8_t *sha256;
};

static int take_key(void *context, const struct value *values, struct error *err)
{
	const struct found_key *found = context;

	if (values[1].size != 32)
		return error_set(err, ERR_IO, "catalogue: the row of a key is invalid");
	snprintf(found->scan, ID_SIZE, "%s", (const char *)values[0].bytes);
	memcpy(found->sha256, values[1].bytes, 32);
	return 0;
}

int catalogue_find_scan_key(struct catalogue *catalogue, const char *key, char ret_scan[ID_SIZE],
			    uint8_t ret_sha256[32], struct error *err)
{
	struct found_key found = {ret_scan, ret_sha256};
	const struct value value = value_text(key);

	ret_scan[0] = '\0';
	return catalogue_read(
	    catalogue,
	    "SELECT scans.id, request_sha256 FROM scan_keys JOIN scans ON scans.number = scan_keys.scan"
	    " WHERE key = $1",
	    &value, 1, take_key, &found, err);
}

int catalogue_scans(struct catalogue *catalogue, struct catalogue_scan **ret_scans, int *ret_count, struct error *err)
{
	void *records;
	int code = catalogue_list(catalogue, TABLE_SCANS, NULL, &records, ret_count, err);

	if (code == 0)
		*ret_scans = records;
	return code;
}

int catalogue_set_image(struct catalogue *catalogue, const char *scan, enum image image, const uint8_t sha256[32],
			struct error *err)
{
	struct catalogue_scan record = {.closed = false};

	record.images[image].known = sha256 != NULL;
	if (sha256 != NULL)
		memcpy(record.images[image].sha256, sha256, 32);
	return catalogue_assign(catalogue, TABLE_SCANS, image_kinds[image].name, &record, scan, err);
}

int catalogue_set_closed(struct catalogue *catalogue, const char *scan, struct error *err)
{
	const struct catalogue_scan record = {.closed = true};

	return catalogue_assign(catalogue, TABLE_SCANS, "closed", &record, scan, err);
}

static int remove_projection(struct catalogue *catalogue, long long scan, int view, struct error *err)
{
	const struct value values[] = {value_integer(scan), value_integer(view)};

	return catalogue_write(catalogue, "DELETE FROM projections WHERE scan = $1 AND view = $2", values, 2, err);
}

int catalogue_put_projection(struct catalogue *catalogue, long long scan, int view, const uint8_t *sha256,
			     struct error *err)
{
	struct catalogue_projection row = {.scan = scan, .view = view};

	if (sha256 == NULL)
		return remove_projection(catalogue, scan, view, err);
	memcpy(row.sha256, sha256, sizeof(row.sha256));
	return catalogue_write_record(catalogue, TABLE_PROJECTIONS, STATEMENT_PUT, NULL, &row, NULL, err);
}

int catalogue_projections(struct catalogue *catalogue, long long scan, struct catalogue_projection **ret_projections,
			  int *ret_count, struct error *err)
{
	const struct value number = value_integer(scan);
	void *records;
	int code = catalogue_list(catalogue, TABLE_PROJECTIONS, &number, &records, ret_count, err);

	if (code == 0)
		*ret_projections = records;
	return code;
}

/* ---- jobs ---- */

int catalogue_add_job(struct catalogue *catalogue, const struct job_record *job, struct error *err)
{
	return catalogue_write_record(catalogue, TABLE_JOBS, STATEMENT_INSERT, NULL, job, NULL, err);
}

static int update_row(struct catalogue *catalogue, const struct job_record *job, struct error *err)
{
	struct row row;
	int code, count = row_of_record(&tables[TABLE_JOBS], STATEMENT_UPDATE, job, NULL, &row, err);

	if (count >= 0)
		row.values[count] = value_text(job->id);
	code = count < 0 ? count
			 : catalogue_write(catalogue, catalogue->statements[TABLE_JOBS][STATEMENT_UPDATE], row.values,
					   count + 1, err);
	row_clear(&row);
	return code;
}

static int rewind_history(struct catalogue *catalogue, const char *job, int iteration, struct error *err)
{
	const struct value values[] = {value_text(job), value_integer(iteration)};

	return catalogue_write(
	    catalogue, "DELETE FROM history WHERE job = (SELECT number FROM jobs WHERE id = $1) AND iteration > $2",
	    values, 2, err);
}

/* Events go too: those with a key may be recorded once more. */
static int remove_past(struct catalogue *catalogue, const char *job, struct error *err)
{
	static const enum table_id past[] = {TABLE_HISTORY, TABLE_VOLUMES, TABLE_WARNINGS};
	const struct value id = value_text(job);
	int code = 0;

	for (size_t i = 0; i < sizeof(past) / sizeof(past[0]) && code == 0; i++)
		code = catalogue_remove_rows(catalogue, past[i], job, err);
	if (code != 0)
		return code;
	return catalogue_write(
	    catalogue, "DELETE FROM events WHERE job = (SELECT number FROM jobs WHERE id = $1) AND kind <> 'state'",
	    &id, 1, err);
}

int catalogue_update_job(struct catalogue *catalogue, const struct job_record *job, enum job_past past,
			 struct error *err)
{
	int code = update_row(catalogue, job, err);

	if (code == 0 && past == PAST_REWINDS)
		code = rewind_history(catalogue, job->id, job->checkpoint, err);
	else if (code == 0 && past == PAST_GOES)
		code = remove_past(catalogue, job->id, err);
	return code;
}

int catalogue_jobs(struct catalogue *catalogue, struct job_record **ret_jobs, int *ret_count, struct error *err)
{
	void *records;
	int code = catalogue_list(catalogue, TABLE_JOBS, NULL, &records, ret_count, err);

	if (code == 0)
		*ret_jobs = records;
	return code;
}

struct visit {
	void (*visit)(void *context, const char *job);
	void *context;
};

static int visit_id(void *context, const struct value *values, struct error *err)
{
	const struct visit *visit = context;

	(void)err;
	visit->visit(visit->context, values[0].bytes);
	return 0;
}

int catalogue_undigested(struct catalogue *catalogue, void (*visit)(void *context, const char *job), void *context,
			 struct error *err)
{
	struct visit each = {visit, context};

	return catalogue_read(catalogue,
			      "SELECT id FROM jobs WHERE number IN (SELECT job FROM volumes WHERE length(sha256) = 0)"
			      " ORDER BY number",
			      NULL, 0, visit_id, &each, err);
}

int catalogue_put_history(struct catalogue *catalogue, const char *job, const struct history_row *row,
			  struct error *err)
{
	return catalogue_write_record(catalogue, TABLE_HISTORY, STATEMENT_PUT, job, row, NULL, err);
}

/* A volume that is made again takes its place behind the others. */
int catalogue_put_volume(struct catalogue *catalogue, const char *job, const struct volume_record *volume,
			 struct error *err)
{
	int code = catalogue_remove_volume(catalogue, job, volume->name, err);

	return code == 0 ? catalogue_write_record(catalogue, TABLE_VOLUMES, STATEMENT_INSERT, job, volume, NULL, err)
			 : code;
}

int catalogue_set_digest(struct catalogue *catalogue, const char *job, const struct volume_record *volume,
			 struct error *err)
{
	const struct value values[] = {value_bytes(volume->sha256, sizeof(volume->sha256)), value_text(job),
				       value_text(volume->name), value_real(volume->created)};

	return catalogue_write(
	    catalogue,
	    "UPDATE volumes SET sha256 = $1 WHERE job = (SELECT number FROM jobs WHERE id = $2) AND name = $3"
	    " AND created = $4",
	    values, 4, err);
}

int catalogue_remove_volume(struct catalogue *catalogue, const char *job, const char *name, struct error *err)
{
	const struct value values[] = {value_text(job), value_text(name)};

	return catalogue_write(catalogue,
			       "DELETE FROM volumes WHERE job = (SELECT number FROM jobs WHERE id = $1) AND name = $2",
			       values, 2, err);
}

int catalogue_add_warning(struct catalogue *catalogue, const char *job, const struct warning_record *warning,
			  bool *ret_new, struct error *err)
{
	long long number;
	int code = catalogue_write_record(catalogue, TABLE_WARNINGS, STATEMENT_INSERT, job, warning, &number, err);

	if (code == 0)
		*ret_new = number != 0;
	return code;
}

static int list_of_job(struct catalogue *catalogue, enum table_id table, const char *job, void **ret_records,
		       int *ret_count, struct error *err)
{
	const struct value id = value_text(job);

	return catalogue_list(catalogue, table, &id, ret_records, ret_count, err);
}

int catalogue_history(struct catalogue *catalogue, const char *job, struct history_row **ret_rows, int *ret_count,
		      struct error *err)
{
	void *records;
	int code = list_of_job(catalogue, TABLE_HISTORY, job, &records, ret_count, err);

	if (code == 0)
		*ret_rows = records;
	return code;
}

int catalogue_volumes(struct catalogue *catalogue, const char *job, struct volume_record **ret_volumes, int *ret_count,
		      struct error *err)
{
	void *records;
	int code = list_of_job(catalogue, TABLE_VOLUMES, job, &records, ret_count, err);

	if (code == 0)
		*ret_volumes = records;
	return code;
}

int catalogue_warnings(struct catalogue *catalogue, const char *job, struct warning_record **ret_warnings,
		       int *ret_count, struct error *err)
{
	void *records;
	int code = list_of_job(catalogue, TABLE_WARNINGS, job, &records, ret_count, err);

	if (code == 0)
		*ret_warnings = records;
	return code;
}

/* ---- events ---- */

int catalogue_add_event(struct catalogue *catalogue, const char *job, const struct event *event, long long *ret_number,
			struct error *err)
{
	const struct catalogue_event row = {
	    .created = clock_realtime(), .kind = event->kind, .data = event->data, .once = event->once};

	return catalogue_write_record(catalogue, TABLE_EVENTS, STATEMENT_INSERT, job, &row, ret_number, err);
}

int catalogue_add_removal(struct catalogue *catalogue, const char *job, long long number, struct error *err)
{
	const struct value kept = value_integer(REMOVALS_KEPT);
	struct catalogue_removal row = {.number = number};
	int code;

	snprintf(row.job, sizeof(row.job), "%s", job);
	code = catalogue_write_record(catalogue, TABLE_REMOVALS, STATEMENT_INSERT, NULL, &row, NULL, err);
	if (code != 0)
		return code;
	return catalogue_write(catalogue,
			       "DELETE FROM removals WHERE number <="
			       " (SELECT number FROM removals ORDER BY number DESC LIMIT 1 OFFSET $1)",
			       &kept, 1, err);
}

struct event_listing {
	struct event_record *events;
	int count;
};

static int take_event(void *context, const struct value *values, struct error *err)
{
	struct event_listing *listing = context;
	struct event_record *more = listing->events, *event;
	int count = listing->count;

	if ((count & (count - 1)) == 0)
		more = realloc(listing->events, (size_t)(count == 0 ? 1 : 2 * count) * sizeof(*more));
	if (more == NULL)
		return error_set_errno(err, ENOMEM, "events");
	listing->events = more;
	event = &more[listing->count++];
	event->number = values[0].integer;
	snprintf(event->job, sizeof(event->job), "%s", (const char *)values[1].bytes);
	snprintf(event->kind, sizeof(event->kind), "%s", (const char *)values[2].bytes);
	event->data = strdup(values[3].bytes);
	return event->data == NULL ? error_set_errno(err, ENOMEM, "events") : 0;
}

int catalogue_events(struct catalogue *catalogue, const char *job, long long after, int limit,
		     struct event_record **ret_events, int *ret_count, struct error *err)
{
	struct event_listing listing = {NULL, 0};
	int code;

	if (job != NULL)
		code =
		    catalogue_read(catalogue,
				   "SELECT events.number, jobs.id, kind, data FROM events, jobs"
				   " WHERE events.number > $1 AND events.job = jobs.number AND jobs.id = $2"
				   " ORDER BY events.number LIMIT $3",
				   (const struct value[]){value_integer(after), value_text(job), value_integer(limit)},
				   3, take_event, &listing, err);
	else
		code = catalogue_read(catalogue,
				      "SELECT events.number, jobs.id, kind, data FROM events, jobs"
				      " WHERE events.number > $1 AND events.job = jobs.number"
				      " UNION ALL SELECT number, job, 'removed', '{}' FROM removals WHERE number > $1"
				      " ORDER BY 1 LIMIT $2",
				      (const struct value[]){value_integer(after), value_integer(limit)}, 2, take_event,
				      &listing, err);
	if (code != 0) {
		event_records_free(listing.events, listing.count);
		return code;
	}
	*ret_events = listing.events;
	*ret_count = listing.count;
	return 0;
}

int catalogue_last_event(struct catalogue *catalogue, long long *ret_number, struct error *err)
{
	return catalogue->backend->last_number(catalogue->database, tables[TABLE_EVENTS].name, ret_number, err);
}

int catalogue_pass_events(struct catalogue *catalogue, long long least, struct error *err)
{
	return catalogue->backend->pass_number(catalogue->database, tables[TABLE_EVENTS].name, least, err);
}

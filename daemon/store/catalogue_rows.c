/* Statements that the lists of columns do not give: store/catalogue.h. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/catalogue_internal.h"

/* ---- scans ---- */

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

/* ---- jobs ---- */

static int update_row(struct catalogue *catalogue, const struct job_record *job, struct error *err)
{
	struct row row;
	int code, count;

	code = catalogue_note_former(catalogue, RECORD_JOB, job->id, false, err);
	if (code != 0)
		return code;
	count = row_of_record(&tables[TABLE_JOBS], STATEMENT_UPDATE, job, NULL, &row, err);
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

int catalogue_unsent(struct catalogue *catalogue, void (*visit)(void *context, const char *job), void *context,
		     struct error *err)
{
	struct visit each = {visit, context};

	return catalogue_read(catalogue,
			      "SELECT id FROM jobs WHERE number IN (SELECT job FROM sendings WHERE ended = 0)"
			      " ORDER BY number",
			      NULL, 0, visit_id, &each, err);
}

static int count_row(void *context, const struct value *values, struct error *err)
{
	int *count = context;

	(void)values;
	(void)err;
	++*count;
	return 0;
}

int catalogue_take_warnings(struct catalogue *catalogue, const char *job, const char *beginning,
			    const struct warning_record *kept, int *ret_count, struct error *err)
{
	const struct value values[] = {value_text(job), value_text(kept->code), value_text(beginning),
				       value_text(kept->detail)};
	int count = 0, code;

	code = catalogue->backend->run(catalogue->database, SESSION_WRITER,
				       "DELETE FROM warnings WHERE job = (SELECT number FROM jobs WHERE id = $1)"
				       " AND code = $2 AND substr(detail, 1, length($3)) = $3 AND detail <> $4"
				       " RETURNING number",
				       values, 4, count_row, &count, err);
	if (code == 0)
		*ret_count = count;
	return code;
}

int catalogue_set_digest(struct catalogue *catalogue, const char *job, const struct volume_record *volume,
			 struct error *err)
{
	const struct volume_quality *quality = &volume->quality;
	const struct value values[] = {value_bytes(volume->sha256, sizeof(volume->sha256)),
				       value_real(quality->noise_hu),
				       value_real(quality->streak_hu),
				       value_real(quality->ring_hu),
				       value_real(quality->edge_mm),
				       value_text(job),
				       value_text(volume->name),
				       value_real(volume->created)};

	return catalogue_write(
	    catalogue,
	    "UPDATE volumes SET sha256 = $1, noise_hu = $2, streak_hu = $3, ring_hu = $4, edge_mm = $5"
	    " WHERE job = (SELECT number FROM jobs WHERE id = $6) AND name = $7 AND created = $8",
	    values, 8, err);
}

/* ---- events ---- */

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
	int code = catalogue->backend->last_number(catalogue->database, tables[TABLE_EVENTS].name, ret_number, err);

	if (code == 0)
		catalogue->acknowledged = *ret_number;
	return code;
}

int catalogue_pass_events(struct catalogue *catalogue, long long least, struct error *err)
{
	return catalogue->backend->pass_number(catalogue->database, tables[TABLE_EVENTS].name, least, err);
}

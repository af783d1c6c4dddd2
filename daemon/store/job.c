/* Rows of jobs, of their history, volumes, warnings and events, as they are written. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/db.h"
#include "daemon/store/deleted.h"
#include "daemon/store/record.h"
#include "proto/clock.h"
#include "proto/reconstruction.h"

enum { REMOVALS_KEPT = 1000 /* a page that was away for longer reads its list anew */ };

const char *const job_state_names[JOB_STATE_COUNT] = {"waiting",   "queued", "running",
						      "succeeded", "failed", "cancelled"};

void store_job_directory(const struct store *store, const char *id, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/jobs/%s", store->directory, id);
}

void store_volume_path(const struct store *store, const char *id, const char *name, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/jobs/%s/%s.nii", store->directory, id, name);
}

void job_record_clear(struct job_record *job)
{
	free(job->request);
	free(job->key);
	job->request = job->key = NULL;
}

void job_records_free(struct job_record *jobs, int count)
{
	for (int i = 0; i < count; i++)
		job_record_clear(&jobs[i]);
	free(jobs);
}

/* ---- writing ---- */

static int add_event(struct store *store, const char *id, const struct event *event, struct error *err)
{
	struct query query;

	if (event == NULL)
		return 0;
	query_begin(&query, &store->writer,
		    "INSERT INTO events (job, created, kind, data, once)"
		    " VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?, ?, ?) ON CONFLICT (job, once) DO NOTHING",
		    err);
	query_text(&query, id);
	query_real(&query, clock_realtime());
	query_text(&query, event->kind);
	query_text(&query, event->data);
	query_text(&query, event->once);
	if (query_run(&query) == 0 && sqlite3_changes(store->writer.db) > 0)
		store->event_written = sqlite3_last_insert_rowid(store->writer.db);
	return query.code;
}

/* The columns that can change, in the order of both statements below. */
static void bind_changing(struct query *query, const struct job_record *job)
{
	query_text(query, job_state_names[job->state]);
	query_integer(query, job->ticket);
	query_integer(query, job->cancel_asked);
	query_integer(query, job->attempts);
	query_integer(query, job->crashes);
	query_integer(query, job->checkpoint);
	query_text(query, job->backend);
	query_text(query, job->device);
	query_text(query, job->plan);
	query_blob(query, &job->memory, sizeof(job->memory));
	query_integer(query, job->error_code);
	query_text(query, job->error_pointer);
	query_text(query, job->error_text);
	query_real(query, job->queued);
	query_real(query, job->started);
	query_real(query, job->ended);
	query_blob(query, job->seconds, sizeof(job->seconds));
	query_text(query, stage_names[job->stage]);
	query_integer(query, job->iteration);
	query_real(query, job->fraction);
	query_integer(query, job->basis);
	query_real(query, job->noise_hu);
	query_real(query, job->tv_alpha);
	query_text(query, job->id);
}

/*
 * Ends a transaction that changed what the job's record tells: that goes first. It is synced where somebody was or will
 * be told for good; after a power cut any other is written again from the row.
 */
static int end_with_record(struct store *store, const char *id, bool synced, int code, struct error *err)
{
	bool written = code == 0;

	if (code == 0)
		code = record_write(store, RECORD_JOB, id, synced, err);
	code = store_end(store, code, err);
	if (code != 0 && written) {
		pthread_mutex_lock(&store->writer.lock);
		record_undo(store, RECORD_JOB, id);
		pthread_mutex_unlock(&store->writer.lock);
	}
	return code;
}

int store_job_insert(struct store *store, const struct job_record *job, const struct event *event, struct error *err)
{
	char directory[1024];
	struct query query;
	int code;

	store_job_directory(store, job->id, directory);
	if (mkdir(directory, 0700) != 0) /* synced with its record */
		return error_set_errno(err, errno, "mkdir %s", directory);
	code = store_begin(store, err);
	if (code != 0) {
		rmdir(directory);
		return code;
	}
	query_begin(
	    &query, &store->writer,
	    "INSERT INTO jobs (state, ticket, cancel_asked, attempts, crashes, checkpoint, backend, device, plan,"
	    " memory, error_code, error_pointer, error_text, queued, started, ended, seconds, stage, iteration,"
	    " fraction, basis, noise_hu, tv_alpha, id, scan, priority, request, mu_water, iterations, idempotency_key, "
	    "request_sha256,"
	    " created) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?,"
	    " ?, ?, ?, ?)",
	    err);
	bind_changing(&query, job);
	query_text(&query, job->scan);
	query_text(&query, priority_names[job->priority]);
	query_text(&query, job->request);
	query_real(&query, job->mu_water);
	query_integer(&query, job->iterations);
	query_text(&query, job->key);
	query_blob(&query, job->digest, sizeof(job->digest));
	query_real(&query, job->created);
	code = query_run(&query);
	if (code == 0)
		code = add_event(store, job->id, event, err);
	code = end_with_record(store, job->id, true, code, err);
	if (code != 0)
		rmdir(directory); /* empty but for a record that could not be taken back: then the next start sees to it
				   */
	return code;
}

static int rewind_history(struct store *store, const struct job_record *job, struct error *err)
{
	struct query query;

	query_begin(&query, &store->writer,
		    "DELETE FROM history WHERE job = (SELECT number FROM jobs WHERE id = ?) AND iteration > ?", err);
	query_text(&query, job->id);
	query_integer(&query, job->checkpoint);
	return query_run(&query);
}

/* Events go too: those with a key may be recorded once more. */
static int remove_past(struct store *store, const char *id, struct error *err)
{
	static const char *const statements[] = {
	    "DELETE FROM history WHERE job = (SELECT number FROM jobs WHERE id = ?)",
	    "DELETE FROM volumes WHERE job = (SELECT number FROM jobs WHERE id = ?)",
	    "DELETE FROM warnings WHERE job = (SELECT number FROM jobs WHERE id = ?)",
	    "DELETE FROM events WHERE job = (SELECT number FROM jobs WHERE id = ?) AND kind <> 'state'",
	};
	struct query query;
	int code = 0;

	for (size_t i = 0; i < sizeof(statements) / sizeof(statements[0]) && code == 0; i++) {
		query_begin(&query, &store->writer, statements[i], err);
		query_text(&query, id);
		code = query_run(&query);
	}
	return code;
}

int store_job_update(struct store *store, const struct job_record *job, const struct event *event,
		     const struct event *end, enum job_past past, struct error *err)
{
	struct query query;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	query_begin(
	    &query, &store->writer,
	    "UPDATE jobs SET state = ?, ticket = ?, cancel_asked = ?, attempts = ?, crashes = ?, checkpoint = ?,"
	    " backend = ?, device = ?, plan = ?, memory = ?, error_code = ?, error_pointer = ?, error_text = ?,"
	    " queued = ?, started = ?, ended = ?, seconds = ?, stage = ?, iteration = ?, fraction = ?, basis = ?,"
	    " noise_hu = ?, tv_alpha = ?"
	    " WHERE id = ?",
	    err);
	bind_changing(&query, job);
	code = query_run(&query);
	if (code == 0 && past == PAST_REWINDS)
		code = rewind_history(store, job, err);
	else if (code == 0 && past == PAST_GOES)
		code = remove_past(store, job->id, err);
	if (code == 0)
		code = add_event(store, job->id, event, err);
	if (code == 0)
		code = add_event(store, job->id, end, err);
	return end_with_record(store, job->id, job->cancel_asked || job->ended != 0, code, err);
}

/* Takes a number from the job's own events, which go with it. */
static int note_removal(struct store *store, const char *id, struct error *err)
{
	struct event event = {.kind = "removed", .data = (char[]){"{}"}};
	struct query query;

	if (add_event(store, id, &event, err) != 0)
		return err->code;
	query_begin(&query, &store->writer, "INSERT INTO removals (number, job) VALUES (?, ?)", err);
	query_integer(&query, store->event_written);
	query_text(&query, id);
	if (query_run(&query) != 0)
		return query.code;
	query_begin(&query, &store->writer,
		    "DELETE FROM removals WHERE number <="
		    " (SELECT number FROM removals ORDER BY number DESC LIMIT 1 OFFSET ?)",
		    err);
	query_integer(&query, REMOVALS_KEPT);
	return query_run(&query);
}

int store_job_delete(struct store *store, const char *id, struct error *err)
{
	struct query query;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	code = store_note_deletion(store, DELETED_JOB, id, err);
	if (code != 0)
		return store_end(store, code, err);
	code = note_removal(store, id, err);
	if (code == 0) {
		query_begin(&query, &store->writer, "DELETE FROM jobs WHERE id = ?", err);
		query_text(&query, id);
		code = query_run(&query);
	}
	code = store_end(store, code, err);
	/* From its note on it is deleted: on a full disk the row goes at the next start. */
	return code == ERR_NO_SPACE ? 0 : code;
}

void store_job_remove_files(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_job_directory(store, id, directory);
	if (directory_remove(directory, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: files stay until the next start: %s", id, err.text);
	store_reserve_save(store);
}

void store_job_remove_checkpoint(const struct store *store, const char *id)
{
	char directory[1024], path[1100];

	store_job_directory(store, id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, CHECKPOINT_FILE);
	if (unlink(path) < 0 && errno != ENOENT && errno != ENOTDIR)
		log_line(LEVEL_WARNING, "job %s: %s stays: %s", id, path, strerror(errno));
}

static int remove_volume(void *context, const char *name, struct error *err)
{
	const char *extension = strrchr(name, '.');
	char path[1400];

	snprintf(path, sizeof(path), "%s/%s", (const char *)context, name);
	if (extension != NULL && strcmp(extension, ".nii") == 0 && unlink(path) < 0 && errno != ENOENT)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

void store_job_remove_volumes(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_job_directory(store, id, directory);
	if (directory_visit(directory, remove_volume, directory, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: volumes that are void are still there: %s", id, err.text);
}

static int remove_temporary(void *context, const char *name, struct error *err)
{
	char path[1400];

	/* A record is written whenever a digest is known. */
	if (!name_is_temporary(name) || strncmp(name, RECORD_FILE, strlen(RECORD_FILE)) == 0)
		return 0;
	snprintf(path, sizeof(path), "%s/%s", (const char *)context, name);
	if (unlink(path) < 0 && errno != ENOENT)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

void store_job_tidy(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_job_remove_checkpoint(store, id);
	store_job_directory(store, id, directory);
	if (directory_visit(directory, remove_temporary, directory, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: half-written files stay until the next start: %s", id, err.text);
}

static int add_row(struct store *store, const char *id, const struct history_row *row, struct error *err)
{
	struct query query;

	query_begin(&query, &store->writer,
		    "INSERT OR REPLACE INTO history (job, iteration, residual, change, tv, seconds)"
		    " VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?, ?, ?, ?)",
		    err);
	query_text(&query, id);
	query_integer(&query, row->iteration);
	query_real(&query, row->residual);
	query_real(&query, row->change);
	query_real(&query, row->tv);
	query_real(&query, row->seconds);
	return query_run(&query);
}

int store_job_add_rows(struct store *store, const char *id, const struct history_row *rows, const struct event *events,
		       int count, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		code = add_row(store, id, &rows[i], err);
		if (code == 0)
			code = add_event(store, id, &events[i], err);
	}
	return store_end(store, code, err);
}

int store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
			 const struct event *event, struct error *err)
{
	struct query query;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	/* A job that starts again keeps its volumes again: the later one is what the file holds. */
	query_begin(
	    &query, &store->writer,
	    "INSERT OR REPLACE INTO volumes (job, name, stage, iteration, nx, ny, nz, dx, dy, dz, x0, y0, z0,"
	    " bytes, sha256, norm2, difference2, tv, minimum, maximum, mean, not_finite, created, estimate_mm)"
	    " VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?,"
	    " ?, ?, ?, ?, ?, ?)",
	    err);
	query_text(&query, id);
	query_text(&query, volume->name);
	query_text(&query, volume->stage);
	query_integer(&query, volume->iteration);
	for (int i = 0; i < 3; i++)
		query_integer(&query, volume->grid.size[i]);
	for (int i = 0; i < 3; i++)
		query_real(&query, volume->grid.spacing[i]);
	for (int i = 0; i < 3; i++)
		query_real(&query, volume->grid.origin[i]);
	query_integer(&query, (long long)volume->bytes);
	query_blob(&query, volume->sha256, volume->hashed ? (int)sizeof(volume->sha256) : 0);
	query_real(&query, volume->norms.norm2);
	query_real(&query, volume->norms.difference2);
	query_real(&query, volume->norms.tv);
	query_real(&query, volume->norms.minimum);
	query_real(&query, volume->norms.maximum);
	query_real(&query, volume->norms.mean);
	query_integer(&query, (long long)volume->norms.not_finite);
	query_real(&query, volume->created);
	query_real(&query, volume->estimate_mm);
	code = query_run(&query);
	if (code == 0)
		code = add_event(store, id, event, err);
	return store_end(store, code, err);
}

int store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume, struct error *err)
{
	struct query query;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	query_begin(&query, &store->writer,
		    "UPDATE volumes SET sha256 = ? WHERE job = (SELECT number FROM jobs WHERE id = ?) AND name = ?"
		    " AND created = ?",
		    err);
	query_blob(&query, volume->sha256, sizeof(volume->sha256));
	query_text(&query, id);
	query_text(&query, volume->name);
	query_real(&query, volume->created);
	return end_with_record(store, id, false, query_run(&query), err);
}

int store_job_remove_volume(struct store *store, const char *id, const char *name, struct error *err)
{
	struct query query;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	query_begin(&query, &store->writer,
		    "DELETE FROM volumes WHERE job = (SELECT number FROM jobs WHERE id = ?) AND name = ?", err);
	query_text(&query, id);
	query_text(&query, name);
	return end_with_record(store, id, false, query_run(&query), err);
}

int store_job_add_warning(struct store *store, const char *id, const struct warning_record *warning,
			  const struct event *event, bool *ret_new, struct error *err)
{
	struct query query;
	bool new = false;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	query_begin(&query, &store->writer,
		    "INSERT OR IGNORE INTO warnings (job, code, detail)"
		    " VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?)",
		    err);
	query_text(&query, id);
	query_text(&query, warning->code);
	query_text(&query, warning->detail);
	code = query_run(&query);
	new = code == 0 && sqlite3_changes(store->writer.db) > 0;
	if (new)
		code = add_event(store, id, event, err);
	code = new ? end_with_record(store, id, false, code, err) : store_end(store, code, err);
	if (code == 0)
		*ret_new = new;
	return code;
}

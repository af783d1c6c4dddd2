/* Rows of jobs: what they are, what became of them, what they kept, and what is told of it. */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/db.h"
#include "daemon/store/deleted.h"
#include "daemon/store/quarantine.h"
#include "daemon/store/record.h"
#include "proto/clock.h"
#include "proto/json.h"
#include "proto/spool.h"

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

/* Events too: what is told once is told once more. */
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
	snprintf(path, sizeof(path), "%s/%s", directory, SPOOL_CHECKPOINT);
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
	    " bytes, sha256, norm2, difference2, tv, minimum, maximum, mean, not_finite, created)"
	    " VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?,"
	    " ?, ?, ?, ?, ?)",
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

/* ---- reading ---- */

static int column_name(struct query *query, int column, const char *const *names, int count)
{
	const unsigned char *text = sqlite3_column_text(query->statement, column);

	return text == NULL ? -1 : name_index((const char *)text, names, count);
}

static bool column_copy(struct query *query, int column, char **ret_text)
{
	const unsigned char *text = sqlite3_column_text(query->statement, column);

	*ret_text = text == NULL ? NULL : strdup((const char *)text);
	return text == NULL || *ret_text != NULL;
}

/* Leaves ret as it is when the blob has another size: made by a build with other stages. */
static void column_bytes(struct query *query, int column, void *ret, size_t size)
{
	if ((size_t)sqlite3_column_bytes(query->statement, column) == size)
		memcpy(ret, sqlite3_column_blob(query->statement, column), size);
}

/* Room for one more element in an array that doubles; NULL: no memory, the array stays. */
static void *grow(void *array, int count, size_t size)
{
	if (count != 0 && (count & (count - 1)) != 0)
		return array;
	return realloc(array, (size_t)(count == 0 ? 1 : 2 * count) * size);
}

/* SQLite keeps a NaN as NULL. */
static double column_real(struct query *query, int column)
{
	return sqlite3_column_type(query->statement, column) == SQLITE_NULL
		   ? NAN
		   : sqlite3_column_double(query->statement, column);
}

static int read_job(struct query *query, struct job_record *job, struct error *err)
{
	sqlite3_stmt *row = query->statement;
	int state, priority, stage;

	*job = (struct job_record){0};
	column_text(query, 0, job->id, sizeof(job->id));
	column_text(query, 1, job->scan, sizeof(job->scan));
	state = column_name(query, 2, job_state_names, JOB_STATE_COUNT);
	priority = column_name(query, 3, priority_names, PRIORITY_COUNT);
	job->ticket = sqlite3_column_int64(row, 4);
	job->mu_water = sqlite3_column_double(row, 6);
	job->iterations = sqlite3_column_int(row, 7);
	column_bytes(query, 9, job->digest, sizeof(job->digest));
	job->cancel_asked = sqlite3_column_int(row, 10) != 0;
	job->attempts = sqlite3_column_int(row, 11);
	job->crashes = sqlite3_column_int(row, 12);
	job->checkpoint = sqlite3_column_int(row, 13);
	column_text(query, 14, job->backend, sizeof(job->backend));
	column_text(query, 15, job->device, sizeof(job->device));
	column_text(query, 16, job->plan, sizeof(job->plan));
	column_bytes(query, 17, &job->memory, sizeof(job->memory));
	job->error_code = sqlite3_column_int(row, 18);
	column_text(query, 19, job->error_pointer, sizeof(job->error_pointer));
	column_text(query, 20, job->error_text, sizeof(job->error_text));
	job->created = sqlite3_column_double(row, 21);
	job->queued = sqlite3_column_double(row, 22);
	job->started = sqlite3_column_double(row, 23);
	job->ended = sqlite3_column_double(row, 24);
	column_bytes(query, 25, job->seconds, sizeof(job->seconds));
	stage = column_name(query, 26, stage_names, STAGE_COUNT);
	job->iteration = sqlite3_column_int(row, 27);
	job->fraction = sqlite3_column_double(row, 28);
	job->basis = (unsigned)sqlite3_column_int64(row, 29);
	job->noise_hu = column_real(query, 30);
	job->tv_alpha = column_real(query, 31);
	if (state < 0 || priority < 0 || stage < 0 || !id_valid(job->id))
		return error_set(err, ERR_IO, "catalogue: the row of job \"%s\" makes no sense", job->id);
	job->state = (enum job_state)state;
	job->priority = (enum priority)priority;
	job->stage = (enum stage)stage;
	if (!column_copy(query, 5, &job->request) || !column_copy(query, 8, &job->key))
		return error_set_errno(err, ENOMEM, "list of jobs");
	return 0;
}

int store_job_load(struct store *store, struct job_record **ret_jobs, int *ret_count, struct error *err)
{
	struct job_record *jobs = NULL, *more;
	struct query query;
	int count = 0, code = 0;

	pthread_mutex_lock(&store->reader.lock);
	query_begin(
	    &query, &store->reader,
	    "SELECT id, scan, state, priority, ticket, request, mu_water, iterations, idempotency_key,"
	    " request_sha256, cancel_asked, attempts, crashes, checkpoint, backend, device, plan, memory,"
	    " error_code, error_pointer, error_text, created, queued, started, ended, seconds, stage, iteration,"
	    " fraction, basis, noise_hu, tv_alpha FROM jobs ORDER BY id",
	    err);
	while (code == 0 && query_row(&query)) {
		more = grow(jobs, count, sizeof(*jobs));
		if (more == NULL) {
			code = error_set_errno(err, ENOMEM, "list of jobs");
			break;
		}
		jobs = more;
		code = read_job(&query, &jobs[count++], err);
	}
	if (query_end(&query) != 0)
		code = query.code;
	pthread_mutex_unlock(&store->reader.lock);
	if (code != 0) {
		job_records_free(jobs, count);
		return code;
	}
	*ret_jobs = jobs;
	*ret_count = count;
	return 0;
}

static void read_row(struct query *query, void *element)
{
	struct history_row *row = element;

	row->iteration = sqlite3_column_int(query->statement, 0);
	row->residual = column_real(query, 1);
	row->change = column_real(query, 2);
	row->tv = column_real(query, 3);
	row->seconds = column_real(query, 4);
}

static void read_volume(struct query *query, void *element)
{
	struct volume_record *volume = element;
	sqlite3_stmt *row = query->statement;

	*volume = (struct volume_record){0};
	column_text(query, 0, volume->name, sizeof(volume->name));
	column_text(query, 1, volume->stage, sizeof(volume->stage));
	volume->iteration = sqlite3_column_int(row, 2);
	for (int i = 0; i < 3; i++) {
		volume->grid.size[i] = sqlite3_column_int(row, 3 + i);
		volume->grid.spacing[i] = sqlite3_column_double(row, 6 + i);
		volume->grid.origin[i] = sqlite3_column_double(row, 9 + i);
	}
	volume->bytes = (size_t)sqlite3_column_int64(row, 12);
	volume->hashed = sqlite3_column_bytes(row, 13) == (int)sizeof(volume->sha256);
	column_bytes(query, 13, volume->sha256, sizeof(volume->sha256));
	volume->norms.norm2 = column_real(query, 14);
	volume->norms.difference2 = column_real(query, 15);
	volume->norms.tv = column_real(query, 16);
	volume->norms.minimum = column_real(query, 17);
	volume->norms.maximum = column_real(query, 18);
	volume->norms.mean = column_real(query, 19);
	volume->norms.not_finite = (size_t)sqlite3_column_int64(row, 20);
	volume->created = sqlite3_column_double(row, 21);
}

static void read_warning(struct query *query, void *element)
{
	struct warning_record *warning = element;

	column_text(query, 0, warning->code, sizeof(warning->code));
	column_text(query, 1, warning->detail, sizeof(warning->detail));
}

/* All rows that belong to a job, into an array of elements of `size` bytes. */
static int read_all(struct store *store, const char *sql, const char *id, size_t size,
		    void (*read)(struct query *query, void *element), void **ret_array, int *ret_count,
		    struct error *err)
{
	char *array = NULL, *more;
	struct query query;
	int count = 0, code = 0;

	pthread_mutex_lock(&store->reader.lock);
	query_begin(&query, &store->reader, sql, err);
	query_text(&query, id);
	while (query_row(&query)) {
		more = grow(array, count, size);
		if (more == NULL) {
			code = error_set_errno(err, ENOMEM, "rows of job %s", id);
			break;
		}
		array = more;
		read(&query, array + (size_t)count++ * size);
	}
	if (query_end(&query) != 0)
		code = query.code;
	pthread_mutex_unlock(&store->reader.lock);
	if (code != 0) {
		free(array);
		return code;
	}
	*ret_array = array;
	*ret_count = count;
	return 0;
}

int store_job_rows(struct store *store, const char *id, struct history_row **ret_rows, int *ret_count,
		   struct error *err)
{
	void *array;
	int code = read_all(store,
			    "SELECT iteration, residual, change, tv, seconds FROM history"
			    " WHERE job = (SELECT number FROM jobs WHERE id = ?) ORDER BY iteration",
			    id, sizeof(**ret_rows), read_row, &array, ret_count, err);

	if (code == 0)
		*ret_rows = array;
	return code;
}

int store_job_volumes(struct store *store, const char *id, struct volume_record **ret_volumes, int *ret_count,
		      struct error *err)
{
	void *array;
	int code = read_all(store,
			    "SELECT name, stage, iteration, nx, ny, nz, dx, dy, dz, x0, y0, z0, bytes, sha256, norm2,"
			    " difference2, tv, minimum, maximum, mean, not_finite, created FROM volumes"
			    " WHERE job = (SELECT number FROM jobs WHERE id = ?) ORDER BY number",
			    id, sizeof(**ret_volumes), read_volume, &array, ret_count, err);

	if (code == 0)
		*ret_volumes = array;
	return code;
}

int store_job_warnings(struct store *store, const char *id, struct warning_record **ret_warnings, int *ret_count,
		       struct error *err)
{
	void *array;
	int code = read_all(store,
			    "SELECT code, detail FROM warnings WHERE job = (SELECT number FROM jobs WHERE id = ?)"
			    " ORDER BY number",
			    id, sizeof(**ret_warnings), read_warning, &array, ret_count, err);

	if (code == 0)
		*ret_warnings = array;
	return code;
}

int store_jobs_undigested(struct store *store, void (*visit)(void *context, const char *id), void *context,
			  struct error *err)
{
	struct query query;
	char id[ID_SIZE];

	pthread_mutex_lock(&store->reader.lock);
	query_begin(&query, &store->reader,
		    "SELECT id FROM jobs WHERE number IN (SELECT job FROM volumes WHERE length(sha256) = 0)"
		    " ORDER BY number",
		    err);
	while (query_row(&query)) {
		column_text(&query, 0, id, sizeof(id));
		visit(context, id);
	}
	query_end(&query);
	pthread_mutex_unlock(&store->reader.lock);
	return query.code;
}

void event_records_free(struct event_record *events, int count)
{
	for (int i = 0; i < count; i++)
		free(events[i].data);
	free(events);
}

int store_job_events(struct store *store, const char *id, long long after, int limit, struct event_record **ret_events,
		     int *ret_count, struct error *err)
{
	struct event_record *events = NULL, *more;
	struct query query;
	int count = 0, code = 0;

	pthread_mutex_lock(&store->reader.lock);
	if (id != NULL) {
		query_begin(&query, &store->reader,
			    "SELECT events.number, jobs.id, kind, data FROM events, jobs"
			    " WHERE jobs.id = ? AND events.job = jobs.number AND events.number > ?"
			    " ORDER BY events.number LIMIT ?",
			    err);
		query_text(&query, id);
	} else {
		query_begin(&query, &store->reader,
			    "SELECT events.number, jobs.id, kind, data FROM events, jobs"
			    " WHERE events.job = jobs.number AND events.number > ?"
			    " UNION ALL SELECT number, job, 'removed', '{}' FROM removals WHERE number > ?"
			    " ORDER BY 1 LIMIT ?",
			    err);
		query_integer(&query, after);
	}
	query_integer(&query, after);
	query_integer(&query, limit);
	while (code == 0 && query_row(&query)) {
		more = grow(events, count, sizeof(*events));
		if (more == NULL) {
			code = error_set_errno(err, ENOMEM, "events");
			break;
		}
		events = more;
		events[count].number = sqlite3_column_int64(query.statement, 0);
		column_text(&query, 1, events[count].job, sizeof(events[count].job));
		column_text(&query, 2, events[count].kind, sizeof(events[count].kind));
		if (!column_copy(&query, 3, &events[count].data))
			code = error_set_errno(err, ENOMEM, "events");
		count++;
	}
	if (query_end(&query) != 0)
		code = query.code;
	pthread_mutex_unlock(&store->reader.lock);
	if (code != 0) {
		event_records_free(events, count);
		return code;
	}
	*ret_events = events;
	*ret_count = count;
	return 0;
}

long long store_last_event(const struct store *store)
{
	return atomic_load(&store->last_event);
}

/* ---- at the start ---- */

/* Of jobs that are gone, too: a client may have seen them. */
int store_load_last_event(struct store *store, struct error *err)
{
	struct query query;

	query_begin(&query, &store->reader, "SELECT seq FROM sqlite_sequence WHERE name = 'events'", err);
	if (query_row(&query))
		atomic_store(&store->last_event, sqlite3_column_int64(query.statement, 0));
	return query_end(&query);
}

/*
 * Volumes that were told of and may not be whole on the disk: their job was not
 * through with them. A checkpoint may be of a later iteration than the catalogue
 * knows: a run that went on from there would not make them again.
 */
static int remove_unsettled(struct store *store, const char *id, struct volume_record *volumes, int *count,
			    struct error *err)
{
	int kept = 0, code = 0;
	char path[1024];

	for (int i = 0; i < *count && code == 0; i++) {
		if (volumes[i].hashed) {
			volumes[kept++] = volumes[i];
			continue;
		}
		log_line(LEVEL_INFO, "job %s: its volume %s had not reached the disk, it is made again", id,
			 volumes[i].name);
		code = store_job_remove_volume(store, id, volumes[i].name, err);
		store_volume_path(store, id, volumes[i].name, path);
		if (code == 0)
			unlink(path);
	}
	if (code == 0 && kept < *count)
		store_job_remove_checkpoint(store, id);
	*count = kept;
	return code;
}

struct sweep {
	struct store *store;
	const char *id;
	struct volume_record *volumes;
	int count;
	bool ended; /* else it makes the volumes that have no row again */
};

static bool has_row(const struct sweep *sweep, const char *name, size_t length)
{
	for (int i = 0; i < sweep->count; i++) {
		if (strlen(sweep->volumes[i].name) == length && strncmp(sweep->volumes[i].name, name, length) == 0)
			return true;
	}
	return false;
}

/* Half-written files go. A volume that no row tells of is set aside, unless the job makes it again over it. */
static int sweep_file(void *context, const char *name, struct error *err)
{
	const struct sweep *sweep = context;
	const char *extension = strrchr(name, '.');
	char directory[1024], path[1400];

	if (!name_is_temporary(name)) {
		if (extension == NULL || strcmp(extension, ".nii") != 0 || !sweep->ended ||
		    has_row(sweep, name, (size_t)(extension - name)))
			return 0;
		snprintf(path, sizeof(path), "jobs/%s/%s", sweep->id, name);
		return quarantine_move(sweep->store->directory, path, "the catalogue does not know this volume", err);
	}
	store_job_directory(sweep->store, sweep->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, name);
	if (unlink(path) < 0)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

/* A volume that is gone is a warning of its job; one that cannot be written now is told to who asks for the volume. */
static void tell_gone(const struct sweep *sweep, const struct volume_record *volume)
{
	struct warning_record warning = {.code = "damaged_volume"};
	struct event event = {.kind = "warning"};
	cJSON *document;
	struct error err;
	bool new;

	store_volume_gone(volume, &err);
	log_line(LEVEL_ERROR, "job %s: %s", sweep->id, err.text);
	snprintf(warning.detail, sizeof(warning.detail), "%s", err.text);
	document = json_warning(warning.code, warning.detail);
	event.data = json_print(document, NULL);
	cJSON_Delete(document);
	if (event.data == NULL)
		return;
	if (store_job_add_warning(sweep->store, sweep->id, &warning, &event, &new, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: a warning cannot be written: %s", sweep->id, err.text);
	free(event.data);
}

static void check_volumes(const struct sweep *sweep)
{
	char path[1024];

	for (int i = 0; i < sweep->count; i++) {
		store_volume_path(sweep->store, sweep->id, sweep->volumes[i].name, path);
		if (access(path, F_OK) != 0 && errno == ENOENT)
			tell_gone(sweep, &sweep->volumes[i]);
	}
}

/* False where there is no such job; *ret_at_work: it is, or was, with a worker. */
static int job_is_known(struct store *store, const char *id, bool *ret_known, bool *ret_at_work, bool *ret_ended,
			struct error *err)
{
	struct query query;

	query_begin(&query, &store->reader,
		    "SELECT state IN ('waiting', 'running'), state IN ('succeeded', 'failed', 'cancelled')"
		    " FROM jobs WHERE id = ?",
		    err);
	query_text(&query, id);
	*ret_known = query_row(&query);
	*ret_at_work = *ret_known && sqlite3_column_int(query.statement, 0) != 0;
	*ret_ended = *ret_known && sqlite3_column_int(query.statement, 1) != 0;
	return query_end(&query);
}

static int sweep_directory(void *context, const char *name, struct error *err)
{
	struct sweep sweep = {.store = context, .id = name};
	char path[1024];
	bool known = false, at_work = false;
	int code;

	if (!id_valid(name))
		return 0; /* not ours */
	store_job_directory(sweep.store, name, path);
	code = job_is_known(sweep.store, name, &known, &at_work, &sweep.ended, err);
	if (code != 0 || !known)
		return code;
	code = store_job_volumes(sweep.store, name, &sweep.volumes, &sweep.count, err);
	if (code != 0)
		return code;
	if (at_work)
		code = remove_unsettled(sweep.store, name, sweep.volumes, &sweep.count, err);
	if (code == 0) {
		check_volumes(&sweep);
		code = directory_visit(path, sweep_file, &sweep, err);
	}
	free(sweep.volumes);
	return code;
}

int store_sweep_jobs(struct store *store, struct error *err)
{
	char path[1024];
	int code;

	/* One transaction for all that is read: each job's rows are read before they are changed. */
	if (sqlite3_exec(store->reader.db, "BEGIN", NULL, NULL, NULL) != SQLITE_OK)
		return error_set(err, ERR_IO, "catalogue: %s", sqlite3_errmsg(store->reader.db));
	snprintf(path, sizeof(path), "%s/jobs", store->directory);
	code = directory_visit(path, sweep_directory, store, err);
	sqlite3_exec(store->reader.db, "COMMIT", NULL, NULL, NULL);
	return code;
}

/* Rows of jobs as they are read: store.h. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/db.h"

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
	volume->estimate_mm = sqlite3_column_double(row, 22);
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
			    " difference2, tv, minimum, maximum, mean, not_finite, created, estimate_mm FROM volumes"
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

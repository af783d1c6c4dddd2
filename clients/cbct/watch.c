/*
 * cbct watch: a job's progress to its end, by asking again with ?wait=. With
 * --save, volumes come in over a connection of their own meanwhile.
 */
#include "clients/cbct/watch.h"

#include <errno.h>
#include <pthread.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/stat.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/progress.h"
#include "clients/cbct/stream.h"

struct watch_options {
	const char *job, *directory;
	struct volume_query query;
	struct http_options http;
};
static const struct option rows[] = {
    {"save", 0, OPTION_TEXT, offsetof(struct watch_options, directory), "DIR",
     "each volume into DIR the moment it is kept; prints the names, and progress on standard error", 0, 0, 0, NULL},
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct watch_options, http)},
    {"volumes that are saved", volume_query_rows, offsetof(struct watch_options, query)},
    {0},
};

/* The progress bar on the terminal, and the failure of the thread beside the one that draws it. */
struct view {
	pthread_mutex_t lock; /* guards progress */
	struct progress *progress;
	atomic_bool failed;
	watch_check check; /* watch_job's, constant as its context; NULL: none */
	void *context;
};

/* Whether the program says when the job's iterations end. */
static bool is_automatic(const cJSON *job)
{
	const cJSON *stage;

	cJSON_ArrayForEach(stage, job)
	{
		if (cJSON_IsObject(stage) && strcmp(member_text(stage, "iterations", ""), "auto") == 0)
			return true;
	}
	return false;
}

static void show(struct view *view, const cJSON *job)
{
	const cJSON *history = cJSON_GetObjectItemCaseSensitive(job, "history");
	const cJSON *views = cJSON_GetObjectItemCaseSensitive(job, "views");
	const cJSON *obstacle;
	int rows = cJSON_GetArraySize(history);
	const char *state = member_text(job, "state", "?"), *stage = member_text(job, "stage", "");
	double iterations = member_number(job, "iterations", 0);
	char text[140]; /* what the daemon calls things is cut, the numbers fit */
	int used = snprintf(text, sizeof(text), "%.20s", state);

	if (strcmp(state, "running") == 0 && stage[0] != 0)
		used = snprintf(text, sizeof(text), "%.20s", stage);
	if (strcmp(state, "queued") == 0 && member_number(job, "queue_position", -1) >= 0)
		used += snprintf(text + used, sizeof(text) - (size_t)used, ", place %.10g",
				 member_number(job, "queue_position", 0));
	cJSON_ArrayForEach(obstacle, cJSON_GetObjectItemCaseSensitive(job, "waiting_for"))
	{
		const char *what = cJSON_GetStringValue(obstacle);

		if (used < 60 && what != NULL && strcmp(what, "projections") != 0 && strcmp(what, "worker") != 0)
			used += snprintf(text + used, sizeof(text) - (size_t)used, ", for %.10s", what);
	}
	if (strcmp(state, "waiting") == 0 && cJSON_IsObject(views))
		used += snprintf(text + used, sizeof(text) - (size_t)used, ", %.10g of %.10g projections",
				 member_number(views, "received", 0), member_number(views, "of", 0));
	if (iterations > 0)
		used += snprintf(text + used, sizeof(text) - (size_t)used, "  iteration %.10g of %s%.10g",
				 member_number(job, "iteration", 0), is_automatic(job) ? "at most " : "", iterations);
	if (rows > 0)
		snprintf(text + used, sizeof(text) - (size_t)used, "  residual %.4g",
			 member_number(cJSON_GetArrayItem(history, rows - 1), "residual", 0));
	pthread_mutex_lock(&view->lock);
	progress_show(view->progress, member_number(job, "progress", 0), member_number(job, "eta_s", -1), "%s", text);
	pthread_mutex_unlock(&view->lock);
}

static bool ended(const char *state)
{
	return strcmp(state, "succeeded") == 0 || strcmp(state, "failed") == 0 || strcmp(state, "cancelled") == 0;
}

static int judge(const cJSON *job, struct error *err)
{
	const cJSON *error = cJSON_GetObjectItemCaseSensitive(job, "error");
	const char *state = member_text(job, "state", "?"), *detail = member_text(error, "detail", "");

	if (strcmp(state, "succeeded") == 0)
		return 0;
	if (strcmp(state, "cancelled") == 0)
		return error_set(err, ERR_CANCELLED, "the job was cancelled");
	if (cJSON_IsString(error))
		detail = error->valuestring;
	return error_set(err, ERR_IO, "the job failed%s%s", detail[0] != 0 ? ": " : "", detail);
}

static int ask(struct http *http, const char *path, bool first, cJSON **ret_job, struct error *err)
{
	int code, attempt = 0;

	/* A daemon that is being restarted is worth waiting for, one that was never there is not. */
	do
		code = http_json(http, "GET", path, ret_job, err);
	while (!(first && http_unreachable(http)) && http_again(http, code, attempt++));
	if (code == 0 && *ret_job == NULL)
		code = error_set(err, ERR_IO, "the daemon answered with no job");
	return code;
}

static int follow(struct http *http, const char *job, struct view *view, struct error *err)
{
	bool first = true, end = false;
	char path[200];
	int code = 0;

	snprintf(path, sizeof(path), "/v1/jobs/%.100s", job);
	while (code == 0 && !end && !atomic_load(&view->failed)) {
		cJSON *document = NULL;

		code = ask(http, path, first, &document, err);
		if (code != 0)
			break;
		show(view, document);
		end = ended(member_text(document, "state", "?"));
		if (end)
			code = judge(document, err);
		else if (view->check != NULL)
			code = view->check(view->context, document, err);
		cJSON_Delete(document);
		/* The first answer at once; later ones after a second, or when the job ends. */
		snprintf(path, sizeof(path), "/v1/jobs/%.100s?wait=1", job);
		first = false;
	}
	return code;
}

int watch_job(struct http *http, const char *job, FILE *to, watch_check check, void *context, struct error *err)
{
	struct view view = {.lock = PTHREAD_MUTEX_INITIALIZER,
			    .progress = progress_new(to, PROGRESS_OR_LINES, job),
			    .check = check,
			    .context = context};
	int code = follow(http, job, &view, err);

	progress_free(view.progress);
	return code;
}

/* ---- with volumes ---- */

struct saver {
	struct stream_options stream;
	struct view *view;
	struct error err;
	int code;
};

static void on_saved(void *context, const char *path)
{
	struct saver *saver = context;

	pthread_mutex_lock(&saver->view->lock);
	progress_clear(saver->view->progress);
	puts(path);
	fflush(stdout);
	pthread_mutex_unlock(&saver->view->lock);
}

static void *run_saver(void *context)
{
	struct saver *saver = context;

	saver->code = stream_save(&saver->stream, &saver->err);
	if (saver->code != 0)
		atomic_store(&saver->view->failed, true);
	return NULL;
}

static int watch_and_save(struct http *http, const struct watch_options *options, struct error *err)
{
	struct view view = {.lock = PTHREAD_MUTEX_INITIALIZER,
			    .progress = progress_new(stderr, PROGRESS_OR_LINES, options->job)};
	struct saver saver = {.view = &view,
			      .stream = {.job = options->job,
					 .directory = options->directory,
					 .query = &options->query,
					 .http = &options->http,
					 .saved = on_saved,
					 .context = &saver}};
	pthread_t thread;
	int code;

	if (mkdir(options->directory, 0777) != 0 && errno != EEXIST)
		code = error_set_errno(err, errno, "%s", options->directory);
	else if ((code = pthread_create(&thread, NULL, run_saver, &saver)) != 0)
		code = error_set_errno(err, code, "a thread for volumes");
	else {
		code = follow(http, options->job, &view, err);
		/* Behind the job's last volume its stream ends. */
		pthread_join(thread, NULL);
		if (code == 0 && saver.code != 0) {
			*err = saver.err;
			code = saver.code;
		}
	}
	progress_free(view.progress);
	return code;
}

static int watch_run(const void *values, struct error *err)
{
	const struct watch_options *options = values;
	struct http *http = NULL;
	int code = http_new(&options->http, &http, err);

	if (code == 0)
		code = options->directory != NULL ? watch_and_save(http, options, err)
						  : watch_job(http, options->job, stdout, NULL, NULL, err);
	http_free(http);
	return code;
}

static const struct watch_options defaults = {.query = VOLUME_QUERY_DEFAULTS};
static const struct positional positionals[] = {
    {"JOB", "its id", offsetof(struct watch_options, job), true},
    {0},
};

const struct command command_watch = {"watch",     "a job's progress, to its end; exit status 0 only when it succeeded",
				      positionals, groups,
				      &defaults,   sizeof(defaults),
				      watch_run};

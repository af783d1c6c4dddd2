/* cbct watch: a job's progress to its end, by asking again with ?wait=. */
#include "clients/cbct/watch.h"

#include <string.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/progress.h"

struct watch_options {
	const char *job;
	struct http_options http;
};
static const struct option_group groups[] = {
    {"options", http_option_rows, offsetof(struct watch_options, http)},
    {0},
};

static void show(struct progress *progress, const cJSON *job)
{
	const cJSON *history = cJSON_GetObjectItemCaseSensitive(job, "history");
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
	if (iterations > 0)
		used += snprintf(text + used, sizeof(text) - (size_t)used, "  iteration %.10g of %.10g",
				 member_number(job, "iteration", 0), iterations);
	if (rows > 0)
		snprintf(text + used, sizeof(text) - (size_t)used, "  residual %.4g",
			 member_number(cJSON_GetArrayItem(history, rows - 1), "residual", 0));
	progress_show(progress, member_number(job, "progress", 0), member_number(job, "eta_s", -1), "%s", text);
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

int watch_job(struct http *http, const char *job, FILE *to, struct error *err)
{
	struct progress *progress = progress_new(to, PROGRESS_OR_LINES, job);
	char path[200];
	bool first = true, end = false;
	int code = 0;

	snprintf(path, sizeof(path), "/v1/jobs/%.100s", job);
	while (code == 0 && !end) {
		cJSON *document = NULL;

		code = ask(http, path, first, &document, err);
		if (code != 0)
			break;
		show(progress, document);
		end = ended(member_text(document, "state", "?"));
		if (end)
			code = judge(document, err);
		cJSON_Delete(document);
		/* The first answer at once; later ones after a second, or when the job ends. */
		snprintf(path, sizeof(path), "/v1/jobs/%.100s?wait=1", job);
		first = false;
	}
	progress_free(progress);
	return code;
}

static int watch_run(const void *values, struct error *err)
{
	const struct watch_options *options = values;
	struct http *http = NULL;
	int code = http_new(&options->http, &http, err);

	if (code == 0)
		code = watch_job(http, options->job, stdout, err);
	http_free(http);
	return code;
}

static const struct watch_options defaults = {0};
static const struct positional positionals[] = {
    {"JOB", "its id", offsetof(struct watch_options, job), true},
    {0},
};

const struct command command_watch = {"watch",     "a job's progress, to its end; exit status 0 only when it succeeded",
				      positionals, groups,
				      &defaults,   sizeof(defaults),
				      watch_run};

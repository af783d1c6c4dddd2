/* cbct submit: a job, from a document, from options, or from both. */
#include <stdint.h>
#include <sys/random.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/recipe_options.h"
#include "clients/cbct/watch.h"

struct submit_options {
	const char *scan, *recipe, *once;
	struct recipe_options pipeline;
	bool wait, print;
	struct http_options http;
};

static const struct option rows[] = {
    {"wait", 0, OPTION_FLAG, offsetof(struct submit_options, wait), NULL, "and watch it to its end", 0, 0, 0, NULL},
    {"once", 0, OPTION_TEXT, offsetof(struct submit_options, once), "TEXT",
     "another job with the same text is the same job", 0, 0, 0, NULL},
    {"print", 0, OPTION_FLAG, offsetof(struct submit_options, print), NULL, "print the document and send nothing", 0, 0,
     0, NULL},
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct submit_options, http)},
    {"pipeline (over what RECIPE says)", recipe_option_rows, offsetof(struct submit_options, pipeline)},
    {0},
};

/* With a key, the caller's or one of its own, so that asking again after a lost reply makes no second job. */
static int post(struct http *http, const cJSON *document, const char *once, cJSON **ret_job, struct error *err)
{
	uint64_t random[2] = {0, 0};
	char key[40];
	int code, attempt = 0;

	if (once == NULL && getrandom(random, sizeof(random), 0) != (ssize_t)sizeof(random))
		return error_set(err, ERR_IO, "no random numbers for a key");
	snprintf(key, sizeof(key), "%016llx%016llx", (unsigned long long)random[0], (unsigned long long)random[1]);
	do
		code = http_post(http, "/v1/jobs", document, once != NULL ? once : key, ret_job, err);
	while (!http_unreachable(http) && http_again(http, code, attempt++));
	return code;
}

static int submit(const struct submit_options *options, const cJSON *document, struct error *err)
{
	struct http *http = NULL;
	cJSON *job = NULL;
	const char *id;
	int code = http_new(&options->http, &http, err);

	if (code == 0)
		code = post(http, document, options->once, &job, err);
	if (code == 0) {
		id = member_text(job, "id", "");
		puts(id);
		fflush(stdout);
		/* On the other stream: `job=$(cbct submit ...)` takes the id alone. */
		if (options->wait)
			code = watch_job(http, id, stderr, NULL, NULL, err);
	}
	cJSON_Delete(job);
	http_free(http);
	return code;
}

static int submit_run(const void *values, struct error *err)
{
	const struct submit_options *options = values;
	cJSON *document = NULL;
	int code = recipe_document(&options->pipeline, options->recipe, options->scan, &document, err);

	if (code == 0)
		code = options->print ? document_print(document, err) : submit(options, document, err);
	cJSON_Delete(document);
	return code;
}

static const struct submit_options defaults;
static const struct positional positionals[] = {
    {"SCAN", "its id", offsetof(struct submit_options, scan), true},
    {"RECIPE", "a job document; without it, and without options of a stage, every stage with its defaults",
     offsetof(struct submit_options, recipe), false},
    {0},
};

const struct command command_submit = {
    "submit", "a job over a scan; prints the job's id", positionals, groups, &defaults, sizeof(defaults), submit_run};

/* cbct send, destinations: a job's volumes to archives. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "proto/send.h"

struct send_options {
	const char *job, *to, *volumes;
	bool stop, wait, json;
	struct http_options http;
};

#define ROW(name, kind, member, argument, help)                                                                        \
	{                                                                                                              \
		name, 0, kind, offsetof(struct send_options, member), argument, help, 0, 0, 0, NULL                    \
	}
static const struct option send_rows[] = {
    ROW("to", OPTION_TEXT, to, "NAME", "the destination; without it, what was sent and how far it is"),
    ROW("volumes", OPTION_TEXT, volumes, "LIST", "last, all, or iterations, fdk and fdk-tv as 5,10 (default: last)"),
    ROW("stop", OPTION_FLAG, stop, NULL, "send nothing more of the job to the destination"),
    ROW("wait", OPTION_FLAG, wait, NULL, "until all is sent; fails where something cannot be"),
    ROW("json", OPTION_FLAG, json, NULL, "the daemon's document as it is"),
    {0},
};
static const struct option destination_rows[] = {
    ROW("json", OPTION_FLAG, json, NULL, "the daemon's document as it is"),
    {0},
};
static const struct option_group send_groups[] = {
    {"options", send_rows, 0},
    {"", http_option_rows, offsetof(struct send_options, http)},
    {0},
};
static const struct option_group destination_groups[] = {
    {"options", destination_rows, 0},
    {"", http_option_rows, offsetof(struct send_options, http)},
    {0},
};
static const struct positional send_positionals[] = {
    {"JOB", "its id", offsetof(struct send_options, job), true},
    {0},
};
static const struct positional none[] = {{0}};

static void add_volumes(cJSON *body, const char *volumes)
{
	char *copy, *rest, *one;
	cJSON *list;

	if (strcmp(volumes, "last") == 0 || strcmp(volumes, "all") == 0) {
		cJSON_AddStringToObject(body, "volumes", volumes);
		return;
	}
	list = cJSON_AddArrayToObject(body, "volumes");
	copy = rest = strdup(volumes);
	while (rest != NULL && (one = strsep(&rest, ",")) != NULL) {
		char *end;
		const double number = strtod(one, &end);

		cJSON_AddItemToArray(list,
				     end != one && *end == '\0' ? cJSON_CreateNumber(number) : cJSON_CreateString(one));
	}
	free(copy);
}

static void print_sending(const cJSON *sending)
{
	printf("%-16s %-10s %-10s %4.0f of %.0f objects  %s\n", member_text(sending, "to", "?"),
	       member_text(sending, "volume", "-"), member_text(sending, "state", "?"),
	       member_number(sending, "stored", 0), member_number(sending, "instances", 0),
	       member_text(sending, "error", ""));
}

static void print_destination(const cJSON *destination)
{
	const cJSON *reachable = cJSON_GetObjectItemCaseSensitive(destination, "reachable");

	printf("%-16s %-9s %-12s %s  %s\n", member_text(destination, "name", "?"),
	       member_text(destination, "kind", "?"),
	       cJSON_IsTrue(reachable)    ? "answers"
	       : cJSON_IsFalse(reachable) ? "not there"
					  : "not asked",
	       member_text(destination, "address", "?"), member_text(destination, "detail", ""));
}

static int print(const struct send_options *options, const cJSON *document, const char *name,
		 void (*line)(const cJSON *), struct error *err)
{
	const cJSON *one;

	if (options->json)
		return document_print(document, err);
	cJSON_ArrayForEach(one, cJSON_GetObjectItemCaseSensitive(document, name)) line(one);
	return 0;
}

/* How many volumes have not arrived; *ret_failed: the error of one that failed, or NULL. */
static int open_sendings(const cJSON *document, const char **ret_failed)
{
	const cJSON *one;
	int count = 0;

	*ret_failed = NULL;
	cJSON_ArrayForEach(one, cJSON_GetObjectItemCaseSensitive(document, "sendings"))
	{
		/* A department that is told of the step is no archive that somebody waits for. */
		if (strcmp(member_text(one, "volumes", ""), SEND_STEP) == 0)
			continue;
		count += !cJSON_IsString(cJSON_GetObjectItemCaseSensitive(one, "ended"));
		if (strcmp(member_text(one, "state", ""), "failed") == 0)
			*ret_failed = member_text(one, "error", "");
	}
	return count;
}

static int ask(struct http *http, const struct send_options *options, const char *path, cJSON **ret_document,
	       struct error *err)
{
	cJSON *body = cJSON_CreateObject();
	int code;

	cJSON_AddStringToObject(body, "to", options->to);
	if (options->volumes != NULL)
		add_volumes(body, options->volumes);
	code = http_post(http, path, body, NULL, ret_document, err);
	cJSON_Delete(body);
	return code;
}

/* Asks again until nothing is open. */
static int wait_for_end(struct http *http, const char *path, cJSON **document, struct error *err)
{
	const useconds_t pause = 300000;
	const char *failed;
	int code = 0;

	while (open_sendings(*document, &failed) > 0 && code == 0) {
		usleep(pause);
		cJSON_Delete(*document);
		*document = NULL;
		code = http_json(http, "GET", path, document, err);
	}
	if (code == 0 && failed != NULL)
		code = error_set(err, ERR_IO, "%s", failed);
	return code;
}

static int send_run(const void *values, struct error *err)
{
	const struct send_options *options = values;
	cJSON *document = NULL;
	struct http *http = NULL;
	char path[200], stop[280];
	int code = http_new(&options->http, &http, err);

	snprintf(path, sizeof(path), "/v1/jobs/%.63s/send", options->job);
	snprintf(stop, sizeof(stop), "%s/%.64s", path, options->to != NULL ? options->to : "");
	if (code == 0 && options->stop && options->to == NULL)
		code = error_set(err, ERR_USAGE, "--stop wants --to");
	if (code == 0 && options->stop)
		code = http_json(http, "DELETE", stop, &document, err);
	if (code == 0 && options->to != NULL && !options->stop)
		code = ask(http, options, path, &document, err);
	else if (code == 0)
		code = http_json(http, "GET", path, &document, err);
	if (code == 0 && options->wait)
		code = wait_for_end(http, path, &document, err);
	if (document != NULL && (code == 0 || options->wait) &&
	    print(options, document, "sendings", print_sending, err) != 0)
		code = err->code;
	cJSON_Delete(document);
	http_free(http);
	return code;
}

static int destinations_run(const void *values, struct error *err)
{
	const struct send_options *options = values;
	cJSON *document = NULL;
	struct http *http = NULL;
	int code = http_new(&options->http, &http, err);

	if (code == 0)
		code = http_json(http, "GET", "/v1/destinations?wait=15", &document, err);
	if (code == 0)
		code = print(options, document, "destinations", print_destination, err);
	/* A script that asks whether its archive answers is not told yes. */
	if (code == 0 && cJSON_GetArraySize(cJSON_GetObjectItemCaseSensitive(document, "destinations")) == 0)
		code = error_set(err, ERR_NOT_FOUND,
				 "the daemon knows no destinations: its setting `destinations` names a file of them");
	cJSON_Delete(document);
	http_free(http);
	return code;
}

static const struct send_options defaults = {0};
const struct command command_send = {
    "send",  "sends a job's volumes to an archive", send_positionals, send_groups, &defaults, sizeof(defaults),
    send_run};
const struct command command_destinations = {"destinations",
					     "the archives that volumes can be sent to, and whether they answer",
					     none,
					     destination_groups,
					     &defaults,
					     sizeof(defaults),
					     destinations_run};

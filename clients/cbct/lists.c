/* cbct scans, jobs, calibrations, status, limits, complete, pin, unpin, rm: what the daemon knows, a line each. */
#include <ctype.h>
#include <stdio.h>
#include <string.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"

enum { QUERY_MAX = 4096 };

struct list_options {
	const char *id;
	long limit;
	bool json;
	const char *state, *scan, *priority, *label, *text;
	struct http_options http;
};

#define ROW(name, kind, member, argument, help, least, most)                                                           \
	{                                                                                                              \
		name, 0, kind, offsetof(struct list_options, member), argument, help, least, most, 0, NULL             \
	}
static const struct option json_rows[] = {
    ROW("json", OPTION_FLAG, json, NULL, "the daemon's document as it is", 0, 0),
    {0},
};
static const struct option list_rows[] = {
    ROW("limit", OPTION_INTEGER, limit, "N", "the newest so many", 1, 1000),
    {0},
};
static const struct option common_rows[] = {
    ROW("state", OPTION_TEXT, state, "NAME[,NAME]", "those in one of these states", 0, 0),
    ROW("label", OPTION_TEXT, label, "NAME[=VALUE]", "those with this label", 0, 0),
    ROW("text", OPTION_TEXT, text, "TEXT", "those with this in id, name or label", 0, 0),
    {0},
};
static const struct option job_rows[] = {
    ROW("scan", OPTION_TEXT, scan, "SCAN", "those of this scan", 0, 0),
    ROW("priority", OPTION_TEXT, priority, "NAME[,NAME]", "those of one of these priorities", 0, 0),
    {0},
};
static const struct option_group list_groups[] = {
    {"options", list_rows, 0},
    {"", json_rows, 0},
    {"", http_option_rows, offsetof(struct list_options, http)},
    {0},
};
static const struct option_group scans_groups[] = {
    {"options", list_rows, 0},
    {"", common_rows, 0},
    {"", json_rows, 0},
    {"", http_option_rows, offsetof(struct list_options, http)},
    {0},
};
static const struct option_group jobs_groups[] = {
    {"options", list_rows, 0},
    {"", common_rows, 0},
    {"", job_rows, 0},
    {"", json_rows, 0},
    {"", http_option_rows, offsetof(struct list_options, http)},
    {0},
};
static const struct option_group status_groups[] = {
    {"options", json_rows, 0},
    {"", http_option_rows, offsetof(struct list_options, http)},
    {0},
};
static const struct option_group rm_groups[] = {
    {"options", http_option_rows, offsetof(struct list_options, http)},
    {0},
};

static int fetch(const struct list_options *options, const char *method, const char *path, cJSON **ret_document,
		 struct error *err)
{
	struct http *http = NULL;
	int code = http_new(&options->http, &http, err);

	if (code == 0)
		code = http_json(http, method, path, ret_document, err);
	http_free(http);
	return code;
}

static void print_scan(const cJSON *scan)
{
	const cJSON *projections = cJSON_GetObjectItemCaseSensitive(scan, "projections");
	const cJSON *missing = cJSON_GetObjectItemCaseSensitive(scan, "missing");

	printf("%-20s %5.0f projections%s  %s\n", member_text(scan, "id", "?"), member_number(projections, "count", 0),
	       cJSON_GetArraySize(missing) > 0 ? ", some missing" : "", member_text(scan, "name", ""));
}

static void print_job(const cJSON *job)
{
	printf("%-20s %-10s %3.0f %%  scan %s\n", member_text(job, "id", "?"), member_text(job, "state", "?"),
	       100 * member_number(job, "progress", 0), member_text(job, "scan", "?"));
}

static void print_calibration(const cJSON *calibration)
{
	const double day = 86400;

	const cJSON *residual = cJSON_GetObjectItemCaseSensitive(calibration, "residual_isocentre_mm");
	char text[32] = "";

	/* One that failed, or is being made, has none that means anything. */
	if (cJSON_IsNumber(residual) && strcmp(member_text(calibration, "state", ""), "succeeded") == 0)
		snprintf(text, sizeof(text), "%.3f mm", residual->valuedouble);
	printf("%-20s %-10s %9s  %4.0f days  %s\n", member_text(calibration, "id", "?"),
	       member_text(calibration, "state", "?"), text, member_number(calibration, "age_s", 0) / day,
	       member_text(calibration, "arm", ""));
}

static void print_device(const cJSON *device)
{
	const bool aside = cJSON_IsObject(cJSON_GetObjectItemCaseSensitive(device, "set_aside"));

	printf("%-6s %-8s %s%s%s%s\n", member_text(device, "backend", "?"), member_text(device, "state", "?"),
	       member_text(device, "device", "?"), aside ? ", set aside (" : "",
	       aside ? member_text(device, "last_error", "") : "", aside ? ")" : "");
}

/* The members of array `name` of the document at `path`, one line each. */
static int list(const struct list_options *options, const char *path, const char *name, void (*print)(const cJSON *),
		struct error *err)
{
	cJSON *document = NULL;
	const cJSON *entry;
	int code = fetch(options, "GET", path, &document, err);

	if (code == 0 && options->json) {
		code = document_print(document, err);
	} else if (code == 0) {
		cJSON_ArrayForEach(entry, cJSON_GetObjectItemCaseSensitive(document, name)) print(entry);
	}
	cJSON_Delete(document);
	return code;
}

/* Adds &name=value with the value's bytes as RFC 3986 has them; what has no room is left out. */
static void add_query(char path[QUERY_MAX], const char *name, const char *value)
{
	size_t length = strlen(path);

	if (value == NULL || length + strlen(name) + 3 * strlen(value) + 3 > QUERY_MAX)
		return;
	length += (size_t)snprintf(path + length, QUERY_MAX - length, "&%s=", name);
	for (; *value != '\0'; value++) {
		const unsigned char byte = (unsigned char)*value;

		length += (size_t)snprintf(path + length, QUERY_MAX - length, isalnum(byte) ? "%c" : "%%%02X", byte);
	}
}

static void list_path(const struct list_options *options, const char *what, char ret_path[QUERY_MAX])
{
	snprintf(ret_path, QUERY_MAX, "/v1/%s?limit=%ld", what, options->limit);
	add_query(ret_path, "state", options->state);
	add_query(ret_path, "scan", options->scan);
	add_query(ret_path, "priority", options->priority);
	add_query(ret_path, "label", options->label);
	add_query(ret_path, "text", options->text);
}

static int scans_run(const void *values, struct error *err)
{
	const struct list_options *options = values;
	char path[QUERY_MAX];

	list_path(options, "scans", path);
	return list(options, path, "scans", print_scan, err);
}

static int jobs_run(const void *values, struct error *err)
{
	const struct list_options *options = values;
	char path[QUERY_MAX];

	list_path(options, "jobs", path);
	return list(options, path, "jobs", print_job, err);
}

static int calibrations_run(const void *values, struct error *err)
{
	const struct list_options *options = values;
	char path[80];

	snprintf(path, sizeof(path), "/v1/calibrations?limit=%ld", options->limit);
	return list(options, path, "calibrations", print_calibration, err);
}

static int status_run(const void *values, struct error *err)
{
	return list(values, "/v1/devices", "devices", print_device, err);
}

/* An id says not whose it is: all kinds are tried. */
static int rm_run(const void *values, struct error *err)
{
	static const char *const kinds[] = {"jobs", "scans", "calibrations"};
	const struct list_options *options = values;
	cJSON *document = NULL;
	char path[100];
	int code = ERR_NOT_FOUND;

	for (size_t i = 0; i < sizeof(kinds) / sizeof(kinds[0]) && code == ERR_NOT_FOUND; i++) {
		snprintf(path, sizeof(path), "/v1/%s/%.63s", kinds[i], options->id);
		code = fetch(options, "DELETE", path, &document, err);
	}
	if (code == ERR_NOT_FOUND)
		code = error_set(err, code, "there is neither a job nor a scan \"%s\", nor a calibration", options->id);
	cJSON_Delete(document);
	return code;
}

/* PUT or DELETE of the pin of a job, or else of a scan. */
static int set_pin(const struct list_options *options, const char *method, struct error *err)
{
	static const char *const kinds[] = {"jobs", "scans"};
	cJSON *document = NULL;
	char path[100];
	int code = ERR_NOT_FOUND;

	for (size_t i = 0; i < sizeof(kinds) / sizeof(kinds[0]) && code == ERR_NOT_FOUND; i++) {
		snprintf(path, sizeof(path), "/v1/%s/%.63s/pin", kinds[i], options->id);
		code = fetch(options, method, path, &document, err);
	}
	if (code == ERR_NOT_FOUND)
		code = error_set(err, code, "there is neither a job nor a scan \"%s\"", options->id);
	cJSON_Delete(document);
	return code;
}

static int pin_run(const void *values, struct error *err)
{
	return set_pin(values, "PUT", err);
}

static int unpin_run(const void *values, struct error *err)
{
	return set_pin(values, "DELETE", err);
}

static void print_limit(const cJSON *limits, const char *whose, const char *what)
{
	const cJSON *limit = cJSON_GetObjectItemCaseSensitive(limits, what);
	const double used = member_number(limit, "used", 0), most = member_number(limit, "most", -1);
	const bool bytes = strcmp(what, "bytes") == 0;
	const double unit = bytes ? 1e6 : 1;
	const char *name = bytes ? "MB" : what;

	if (most >= 0)
		printf("%-4s %12.*f of %.*f %s, %.*f left\n", whose, bytes, used / unit, bytes, most / unit, name,
		       bytes, (most > used ? most - used : 0) / unit);
	else
		printf("%-4s %12.*f %s\n", whose, bytes, used / unit, name);
}

static int limits_run(const void *values, struct error *err)
{
	const struct list_options *options = values;
	cJSON *document = NULL;
	const cJSON *own, *all;
	int code = fetch(options, "GET", "/v1/limits", &document, err);

	if (code == 0 && options->json) {
		code = document_print(document, err);
	} else if (code == 0) {
		own = cJSON_GetObjectItemCaseSensitive(document, "own");
		all = cJSON_GetObjectItemCaseSensitive(document, "all");
		printf("of %s\n", member_text(document, "client", "?"));
		print_limit(own, "own", "jobs");
		print_limit(own, "own", "scans");
		print_limit(own, "own", "bytes");
		print_limit(all, "all", "jobs");
		print_limit(all, "all", "bytes");
		if (member_number(all, "reserve", -1) >= 0)
			printf("of which %.1f MB are reserved for what is being acquired\n",
			       member_number(all, "reserve", 0) / 1e6);
		if (member_number(document, "keep_s", -1) >= 0)
			printf("what has ended or broken off is kept for %.1f h, unless it is pinned\n",
			       member_number(document, "keep_s", 0) / 3600);
	}
	cJSON_Delete(document);
	return code;
}

/* The line shows a scan that was ended too early. */
static void print_completed(const cJSON *scan)
{
	const cJSON *projections = cJSON_GetObjectItemCaseSensitive(scan, "projections");

	printf("%-20s %.0f of %.0f projections\n", member_text(scan, "id", "?"),
	       member_number(scan, "received_count", 0), member_number(projections, "count", 0));
}

static int complete_run(const void *values, struct error *err)
{
	const struct list_options *options = values;
	cJSON *document = NULL;
	char path[100];
	int code;

	snprintf(path, sizeof(path), "/v1/scans/%.63s/complete", options->id);
	code = fetch(options, "POST", path, &document, err);
	if (code == 0 && options->json)
		code = document_print(document, err);
	else if (code == 0)
		print_completed(document);
	cJSON_Delete(document);
	return code;
}

static const struct list_options defaults = {.limit = 20};
static const struct positional none[] = {{0}};
static const struct positional rm_positionals[] = {
    {"ID", "of a job, a scan or a calibration", offsetof(struct list_options, id), true},
    {0},
};

static const struct positional pin_positionals[] = {
    {"ID", "of a job or a scan", offsetof(struct list_options, id), true},
    {0},
};

static const struct positional complete_positionals[] = {
    {"SCAN", "its id", offsetof(struct list_options, id), true},
    {0},
};

const struct command command_complete = {"complete",
					 "ends a scan that was broken off, with the projections that are there",
					 complete_positionals,
					 status_groups,
					 &defaults,
					 sizeof(defaults),
					 complete_run};
const struct command command_scans = {"scans",   "the newest scans", none,     scans_groups,
				      &defaults, sizeof(defaults),   scans_run};
const struct command command_jobs = {"jobs",    "the newest jobs", none,    jobs_groups,
				     &defaults, sizeof(defaults),  jobs_run};
const struct command command_calibrations = {"calibrations",   "the newest calibrations", none, list_groups, &defaults,
					     sizeof(defaults), calibrations_run};
const struct command command_status = {
    "status", "the devices that reconstruct", none, status_groups, &defaults, sizeof(defaults), status_run};
const struct command command_rm = {
    "rm",           "cancels a running job, removes a finished one, a scan or a calibration",
    rm_positionals, rm_groups,
    &defaults,      sizeof(defaults),
    rm_run};
const struct command command_pin = {"pin",           "keeps a job with its scan, or a scan, whatever its age",
				    pin_positionals, rm_groups,
				    &defaults,       sizeof(defaults),
				    pin_run};
const struct command command_unpin = {
    "unpin",  "lets a job or scan go for its age again", pin_positionals, rm_groups, &defaults, sizeof(defaults),
    unpin_run};
const struct command command_limits = {"limits",  "jobs, scans and bytes that there are, and how many there may be",
				       none,      status_groups,
				       &defaults, sizeof(defaults),
				       limits_run};

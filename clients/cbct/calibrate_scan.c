/* cbct calibrate-scan: has a daemon calibrate an arm from one of its scans. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "proto/json.h"
#include "proto/scan_directory.h"

struct calibrate_scan_options {
	const char *scan, *phantom, *arm;
	bool adjust_balls, json;
	struct http_options http;
};

#define ROW(name, kind, member, argument, help)                                                                        \
	{                                                                                                              \
		name, 0, kind, offsetof(struct calibrate_scan_options, member), argument, help, 0, 0, 0, NULL          \
	}
static const struct option rows[] = {
    ROW("arm", OPTION_TEXT, arm, "NAME", "a name of the arm, for people"),
    ROW("adjust-balls", OPTION_FLAG, adjust_balls, NULL,
	"let the balls' places follow the shadows, too: errors of machining drop out"),
    ROW("json", OPTION_FLAG, json, NULL, "the daemon's document as it is"),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct calibrate_scan_options, http)},
    {0},
};

static int request_make(const struct calibrate_scan_options *options, cJSON **ret_request, struct error *err)
{
	cJSON *phantom = NULL, *request;
	char *text = NULL;
	size_t length;
	int code = file_read(options->phantom, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = json_parse(text, length, &phantom, err);
	free(text);
	if (code != 0)
		return code;
	request = cJSON_CreateObject();
	cJSON_AddStringToObject(request, "scan", options->scan);
	if (options->arm != NULL)
		cJSON_AddStringToObject(request, "arm", options->arm);
	cJSON_AddBoolToObject(request, "adjust_balls", options->adjust_balls);
	cJSON_AddItemToObject(request, "phantom", phantom);
	*ret_request = request;
	return 0;
}

static bool has_ended(const cJSON *calibration)
{
	const char *state = member_text(calibration, "state", "");

	return strcmp(state, "succeeded") == 0 || strcmp(state, "failed") == 0;
}

static int wait_for(struct http *http, cJSON **calibration, struct error *err)
{
	char path[120];
	int code = 0;

	snprintf(path, sizeof(path), "/v1/calibrations/%.63s?wait=60", member_text(*calibration, "id", ""));
	while (code == 0 && !has_ended(*calibration)) {
		cJSON *next = NULL;

		code = http_json(http, "GET", path, &next, err);
		if (code == 0) {
			cJSON_Delete(*calibration);
			*calibration = next;
		}
	}
	return code;
}

/* The id on standard output, the rest for people. */
static int result_say(const struct calibrate_scan_options *options, const cJSON *calibration, struct error *err)
{
	const cJSON *error = cJSON_GetObjectItemCaseSensitive(calibration, "error"), *warning;

	if (strcmp(member_text(calibration, "state", ""), "failed") == 0)
		return error_set(err, ERR_IMPOSSIBLE, "%s", member_text(error, "detail", "the calibration has failed"));
	cJSON_ArrayForEach(warning, cJSON_GetObjectItemCaseSensitive(calibration, "warnings"))
	    fprintf(stderr, "%s: %s\n", member_text(warning, "severity", "?"), member_text(warning, "detail", ""));
	if (options->json)
		return document_print(calibration, err);
	fprintf(stderr, "%.0f of %d views, residual %.3f pixels, %.4f mm at the isocentre\n",
		member_number(calibration, "used", 0),
		cJSON_GetArraySize(cJSON_GetObjectItemCaseSensitive(calibration, "views")),
		member_number(calibration, "residual_pixels", 0),
		member_number(calibration, "residual_isocentre_mm", 0));
	printf("%s\n", member_text(calibration, "id", ""));
	return 0;
}

static int calibrate_scan_run(const void *values, struct error *err)
{
	const struct calibrate_scan_options *options = values;
	cJSON *request = NULL, *calibration = NULL;
	struct http *http = NULL;
	int code = request_make(options, &request, err);

	if (code == 0)
		code = http_new(&options->http, &http, err);
	if (code == 0)
		code = http_post(http, "/v1/calibrations", request, NULL, &calibration, err);
	if (code == 0)
		code = wait_for(http, &calibration, err);
	if (code == 0)
		code = result_say(options, calibration, err);
	http_free(http);
	cJSON_Delete(request);
	cJSON_Delete(calibration);
	return code;
}

static const struct calibrate_scan_options defaults = {0};
static const struct positional positionals[] = {
    {"SCAN", "id of the daemon's scan of the balls", offsetof(struct calibrate_scan_options, scan), true},
    {"PHANTOM", "its drawing as JSON, as for cbct calibrate", offsetof(struct calibrate_scan_options, phantom), true},
    {0},
};

const struct command command_calibrate_scan = {"calibrate-scan",  "has a daemon calibrate an arm from a scan of balls",
					       positionals,       groups,
					       &defaults,         sizeof(defaults),
					       calibrate_scan_run};

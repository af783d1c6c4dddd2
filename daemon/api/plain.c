/*
 * /plain: jobs, and slices of their volumes, as pages without scripts: for
 * browsers that cannot run the page at /, and in its place where the daemon was
 * built without it. They only show; all that they show of a job is its document.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "daemon/api/assets.h"

enum { LIST = 50, ROWS = 100 };

static const char policy[] = "default-src 'none'; style-src 'self'; img-src 'self' data:; base-uri 'none'; "
			     "form-action 'none'; frame-ancestors 'none'";

static const char style[] =
    ":root{color-scheme:light dark;background:Canvas;color:CanvasText;font:16px/1.5 system-ui,sans-serif}"
    "body{max-width:62rem;margin:0 auto;padding:1rem;overflow-wrap:anywhere}"
    "table{border-collapse:collapse;width:100%}th,td{text-align:left;padding:.3rem .6rem .3rem 0;"
    "border-bottom:1px solid color-mix(in srgb,currentColor 20%,transparent)}"
    ".planes{display:flex;flex-wrap:wrap;gap:.5rem}"
    ".planes img{background:#000;max-width:100%;min-width:12rem;flex:1 1 12rem;object-fit:contain}"
    "nav a,p a{margin-right:.8rem}time{white-space:nowrap}"
    "@media(pointer:coarse){a{display:inline-flex;align-items:center;min-width:44px;min-height:44px}}";

static const struct preset {
	const char *name;
	int window, level; /* HU */
} presets[] = {{"bone", 2000, 300}, {"soft tissue", 400, 40}, {"lung", 1500, -600}};
enum { PRESET_COUNT = sizeof(presets) / sizeof(presets[0]) };

/* ---- HTML ---- */

/* Text or the value of a quoted attribute. */
static void put_text(FILE *out, const char *text)
{
	for (; text != NULL && *text != '\0'; text++) {
		switch (*text) {
		case '&':
			fputs("&amp;", out);
			break;
		case '<':
			fputs("&lt;", out);
			break;
		case '>':
			fputs("&gt;", out);
			break;
		case '"':
			fputs("&quot;", out);
			break;
		default:
			fputc(*text, out);
		}
	}
}

static const char *text_of(const cJSON *object, const char *name)
{
	const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, name));

	return text != NULL ? text : "";
}

static double number_of(const cJSON *object, const char *name)
{
	const cJSON *value = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsNumber(value) ? value->valuedouble : 0;
}

static void put_head(FILE *out, const char *title, bool again)
{
	fputs("<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
	      "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n"
	      "<link rel=\"stylesheet\" href=\"/plain.css\">\n<link rel=\"icon\" href=\"data:,\">\n",
	      out);
	fputs("<title>", out);
	put_text(out, title);
	fputs(" - cbctd</title>\n</head>\n<body>\n<main>\n", out);
	if (again) /* a page that reloads by itself takes the place away from who reads it */
		fputs("<p><a href=\"\">Look again</a></p>\n", out);
	if (assets[0].name == NULL)
		fputs("<p>This daemon was built without its web page, since npm or its registry could not be reached; "
		      "this plain one needs neither.</p>\n",
		      out);
}

/* Takes the text that was written to `out`. */
static int reply_page(struct request *request, FILE *out, char **text, size_t *length, struct error *err)
{
	fputs("</main>\n</body>\n</html>\n", out);
	if (fclose(out) != 0) {
		free(*text);
		return error_set(err, ERR_NO_MEMORY, "no memory for a page");
	}
	if (request_reply_text(request, 200, "text/html; charset=utf-8", *text, *length, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Security-Policy", "%s", policy);
	request_reply_header(request, "X-Content-Type-Options", "nosniff");
	request_reply_header(request, "Referrer-Policy", "no-referrer");
	return 0;
}

static void scan_name(struct api *api, const char *id, char ret_name[SCAN_NAME_BYTES])
{
	struct scan_facts facts;
	struct error err;

	snprintf(ret_name, SCAN_NAME_BYTES, "scan %s", id);
	if (store_scan_look(api->store, id, &facts, &err) == 0 && facts.name[0] != '\0')
		memcpy(ret_name, facts.name, sizeof(facts.name));
}

static void put_state(FILE *out, const cJSON *job)
{
	put_text(out, text_of(job, "state"));
	if (strcmp(text_of(job, "state"), "running") == 0)
		fprintf(out, ", %.0f %%", 100 * number_of(job, "progress"));
	if (number_of(job, "iterations") > 0)
		fprintf(out, ", iteration %.0f of %.0f", number_of(job, "iteration"), number_of(job, "iterations"));
	if (number_of(job, "eta_s") > 0)
		fprintf(out, ", %.0f s left", number_of(job, "eta_s"));
}

/* "2026-11-27T03:57:00.714Z" as people write it. */
static void put_minute(FILE *out, const char *time)
{
	if (strlen(time) >= strlen("2026-11-27T03:57"))
		fprintf(out, "<time>%.10s %.5s UTC</time>", time, time + 11);
}

/* ---- the jobs ---- */

static void put_job_row(FILE *out, struct api *api, struct job *job)
{
	struct error err;
	cJSON *document = job_document(job, true, &err);
	char name[SCAN_NAME_BYTES];

	scan_name(api, text_of(document, "scan"), name);
	fprintf(out, "<tr><td><a href=\"/plain/%s\">", text_of(document, "id"));
	put_text(out, name);
	fputs("</a></td><td>", out);
	put_state(out, document);
	fputs("</td><td>", out);
	put_minute(out, text_of(document, "created"));
	fputs("</td></tr>\n", out);
	cJSON_Delete(document);
}

int plain_list(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *jobs[LIST];
	char *text = NULL;
	size_t length = 0;
	FILE *out;
	int count;
	bool more;

	if (jobs_list(api->jobs, NULL, LIST, jobs, &count, &more, err) != 0)
		return err->code;
	out = open_memstream(&text, &length);
	if (out != NULL) {
		put_head(out, "Jobs", true);
		fprintf(out, "<h1>Jobs</h1>\n%s<table>\n<tr><th>Scan</th><th>State</th><th>Asked for</th></tr>\n",
			count == 0 ? "<p>There are none yet.</p>\n" : "");
		for (int i = 0; i < count; i++)
			put_job_row(out, api, jobs[i]);
		fprintf(out, "</table>\n%s",
			more ? "<p>Older ones are at <a href=\"/v1/jobs\">/v1/jobs</a>.</p>\n" : "");
	}
	for (int i = 0; i < count; i++)
		job_release(jobs[i]);
	if (out == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a page");
	return reply_page(request, out, &text, &length, err);
}

/* ---- one of them ---- */

struct shown {
	const char *job;
	const struct volume_record *volumes; /* in the order of their making */
	int count, chosen;
	const struct preset *preset;
	struct patient patient;
};

static void put_choices(FILE *out, const struct shown *shown)
{
	const char *chosen = shown->volumes[shown->chosen].name;

	fputs("<nav aria-label=\"Volume\">Volume: ", out);
	for (int i = 0; i < shown->count; i++) {
		if (i == shown->chosen)
			fprintf(out, "<strong>%s</strong> ", chosen);
		else
			fprintf(out, "<a href=\"/plain/%s?volume=%s&amp;window=%d\">%s</a> ", shown->job,
				shown->volumes[i].name, (int)(shown->preset - presets), shown->volumes[i].name);
	}
	fputs("</nav>\n<nav aria-label=\"Window\">Window: ", out);
	for (int i = 0; i < PRESET_COUNT; i++) {
		if (&presets[i] == shown->preset)
			fprintf(out, "<strong>%s</strong> ", presets[i].name);
		else
			fprintf(out, "<a href=\"/plain/%s?volume=%s&amp;window=%d\">%s</a> ", shown->job, chosen, i,
				presets[i].name);
	}
	fputs("</nav>\n", out);
}

/* Across which of the world's axes, and which run to the right and downwards, or upwards. */
static const struct plane {
	const char *axis, *plain_name;
	int across, columns, rows;
	bool down;
} planes[] = {{"z", "z plane", 2, 0, 1, true}, {"x", "x plane", 0, 1, 2, false}, {"y", "y plane", 1, 0, 2, false}};

/* Names the plane by the patient's axes where they are known. */
static const char *plane_name(const struct shown *shown, const struct plane *plane)
{
	char letters[PATIENT_LETTERS_MAX];

	if (!shown->patient.known)
		return plane->plain_name;
	patient_letters(&shown->patient, plane->across, false, letters);
	return strchr("SI", letters[0]) != NULL ? "axial" : strchr("AP", letters[0]) != NULL ? "coronal" : "sagittal";
}

static void put_sides(FILE *out, const struct shown *shown)
{
	fputs("<p>Left, right, top and bottom of the pictures:", out);
	for (int i = 0; i < 3; i++) {
		const struct plane *plane = &planes[i];
		char edge[4][PATIENT_LETTERS_MAX];

		patient_letters(&shown->patient, plane->columns, true, edge[0]);
		patient_letters(&shown->patient, plane->columns, false, edge[1]);
		patient_letters(&shown->patient, plane->rows, plane->down, edge[2]);
		patient_letters(&shown->patient, plane->rows, !plane->down, edge[3]);
		fprintf(out, "%s %s <strong>%s %s %s %s</strong>", i > 0 ? "," : "", plane_name(shown, plane), edge[0],
			edge[1], edge[2], edge[3]);
	}
	if (!shown->patient.known)
		fputs(". What of that is the patient's left and right is not known: nobody has said how the patient "
		      "lies",
		      out);
	fputs(".</p>\n", out);
}

/* The address of a picture, to its end. */
static void put_slice(FILE *out, const struct shown *shown, const struct plane *plane, const char *more)
{
	fprintf(out, "/v1/jobs/%s/volumes/%s/slice?%saxis=%s&amp;window=%d&amp;level=%d", shown->job,
		shown->volumes[shown->chosen].name, more, plane->axis, shown->preset->window, shown->preset->level);
}

static void put_file(FILE *out, const struct shown *shown, const char *query, const char *name)
{
	fprintf(out, "<a href=\"/v1/jobs/%s/volumes/%s%s\">%s</a> ", shown->job, shown->volumes[shown->chosen].name,
		query, name);
}

static void put_planes(FILE *out, const struct shown *shown)
{
	const char *volume = shown->volumes[shown->chosen].name;

	fputs("<p class=\"planes\">", out);
	for (int i = 0; i < 3; i++) {
		fputs("<img src=\"", out);
		put_slice(out, shown, &planes[i], "");
		fprintf(out, "\" alt=\"the middle of %s: %s\">", volume, plane_name(shown, &planes[i]));
	}
	fputs("</p>\n", out);
	if (shown->volumes[shown->chosen].estimate_mm > 0)
		fprintf(
		    out,
		    "<p><strong>Within %g mm of metal this volume is an estimate: do not measure there.</strong></p>\n",
		    shown->volumes[shown->chosen].estimate_mm);
	put_sides(out, shown);
	fputs("<p>All planes: ", out);
	for (int i = 0; i < 3; i++) {
		fputs("<a href=\"", out);
		put_slice(out, shown, &planes[i], "sheet=1&amp;");
		fprintf(out, "\">%s</a> ", plane_name(shown, &planes[i]));
	}
	fputs("</p>\n<p>Files: ", out);
	put_file(out, shown, "?type=int16", "NIfTI, HU");
	put_file(out, shown, "?type=int16&amp;format=mha", "MetaImage, HU");
	put_file(out, shown, "", "NIfTI, 1/mm");
	fputs("</p>\n", out);
}

static void put_messages(FILE *out, const cJSON *job)
{
	const cJSON *warning, *error = cJSON_GetObjectItemCaseSensitive(job, "error");

	if (cJSON_IsObject(error)) {
		fputs("<p><strong>It failed:</strong> ", out);
		put_text(out, text_of(error, "detail"));
		fputs("</p>\n", out);
	}
	cJSON_ArrayForEach(warning, cJSON_GetObjectItemCaseSensitive(job, "warnings"))
	{
		fputs("<p><strong>", out);
		put_text(out, text_of(warning, "severity"));
		fputs("</strong>: ", out);
		put_text(out, text_of(warning, "summary"));
		fputs(" <small>", out);
		put_text(out, text_of(warning, "detail"));
		fputs("</small></p>\n", out);
	}
}

static void put_history(FILE *out, const cJSON *job)
{
	const cJSON *row, *history = cJSON_GetObjectItemCaseSensitive(job, "history");
	int skip = cJSON_GetArraySize(history) - ROWS;

	if (cJSON_GetArraySize(history) == 0)
		return;
	fputs("<h2>Iterations</h2>\n<table>\n<tr><th>Iteration</th><th>Residual</th><th>Change</th><th>TV</"
	      "th><th>Seconds</th></tr>\n",
	      out);
	cJSON_ArrayForEach(row, history)
	{
		if (skip-- > 0)
			continue;
		fprintf(out, "<tr><td>%.0f</td><td>%.4g</td><td>%.4g</td><td>%.4g</td><td>%.2f</td></tr>\n",
			number_of(row, "iteration"), number_of(row, "residual"), number_of(row, "change"),
			number_of(row, "tv"), number_of(row, "seconds"));
	}
	fputs("</table>\n", out);
}

static void put_job(FILE *out, struct api *api, const cJSON *job, bool ended, const struct shown *shown)
{
	char name[SCAN_NAME_BYTES];

	scan_name(api, text_of(job, "scan"), name);
	put_head(out, name, !ended);
	fputs("<p><a href=\"/plain\">All jobs</a></p>\n<h1>", out);
	put_text(out, name);
	fputs("</h1>\n<p>", out);
	put_state(out, job);
	fputs("</p>\n", out);
	put_messages(out, job);
	if (shown->count > 0) {
		put_choices(out, shown);
		put_planes(out, shown);
	} else {
		fputs("<p>No volume is kept yet.</p>\n", out);
	}
	put_history(out, job);
}

/* ?volume=NAME, else the newest; ?window= is the place of a preset. */
static int read_choice(struct request *request, struct shown *shown, struct error *err)
{
	const char *volume = request_query(request, "volume"), *window = request_query(request, "window");

	long preset = 0;

	if (window != NULL && !index_parse(window, strlen(window), PRESET_COUNT - 1, &preset))
		return error_set(err, ERR_INVALID, "window is \"%.40s\", expected 0 to %d", window, PRESET_COUNT - 1);
	shown->preset = &presets[preset];
	shown->chosen = volume == NULL ? shown->count - 1 : -1;
	for (int i = 0; volume != NULL && i < shown->count; i++) {
		if (strcmp(volume, shown->volumes[i].name) == 0)
			shown->chosen = i;
	}
	if (volume != NULL && shown->chosen < 0)
		return error_set(err, ERR_NOT_FOUND, "job %s has no volume \"%.40s\"", shown->job, volume);
	return 0;
}

static int reply_job(struct api *api, struct request *request, struct job *job, struct error *err)
{
	struct volume_record *volumes = NULL;
	struct shown shown = {0};
	const struct job_request *asked;
	struct job_facts facts;
	cJSON *document;
	char *text = NULL;
	size_t length = 0;
	FILE *out;

	job_facts(job, &facts);
	if (store_job_volumes(api->store, facts.id, &volumes, &shown.count, err) != 0)
		return err->code;
	shown.job = facts.id;
	shown.volumes = volumes;
	if (read_choice(request, &shown, err) != 0) {
		free(volumes);
		return err->code;
	}
	shown.patient = job_request(job, &asked, err) == 0 ? asked->patient : patient_unknown;
	document = job_document(job, false, err);
	if (document == NULL) {
		free(volumes);
		return err->code;
	}
	out = open_memstream(&text, &length);
	if (out != NULL)
		put_job(out, api, document, facts.ended, &shown);
	cJSON_Delete(document);
	free(volumes);
	if (out == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a page");
	return reply_page(request, out, &text, &length, err);
}

int plain_job(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	int code;

	if (jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0)
		return err->code;
	code = reply_job(api, request, job, err);
	job_release(job);
	return code;
}

int plain_style(void *context, struct request *request, struct error *err)
{
	(void)context;
	if (request_reply_constant(request, 200, style, sizeof(style) - 1, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Type", "text/css; charset=utf-8");
	request_reply_header(request, "Cache-Control", "public, max-age=3600");
	request_reply_header(request, "X-Content-Type-Options", "nosniff");
	return 0;
}

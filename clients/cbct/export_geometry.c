/*
 * cbct export-geometry: the geometry of a scan directory, or of a scan that the
 * daemon has, in the words of other tools. However the scan wrote it, it is views
 * by then, and each format is one function of them.
 */
#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "clients/cbct/output.h"
#include "proto/rtk_geometry.h"
#include "proto/scan.h"
#include "proto/scan_directory.h"

struct export_options {
	const char *scan, *output, *stack;
	int format;
	double tolerance;
	struct http_options http;
};

/* ---- formats ---- */

static int write_rtk(const struct export_options *options, const struct geometry *geometry, FILE *to, struct error *err)
{
	struct rtk_geometry rtk;
	struct rtk_stack stack;
	size_t length = 0;
	char *text;
	int code = rtk_geometry_from_views(geometry, options->tolerance, &rtk, &stack, err);

	if (code != 0)
		return code;
	text = rtk_geometry_print(&rtk, &length);
	rtk_geometry_clear(&rtk);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a geometry of %d views", geometry->count);
	fwrite(text, 1, length, to);
	free(text);
	return 0;
}

static void write_numbers(const double *numbers, int count, FILE *to)
{
	for (int i = 0; i < count; i++) {
		char text[NUMBER_TEXT_MAX];

		number_print(numbers[i], text);
		fprintf(to, "%s%s", i > 0 ? " " : "", text);
	}
	fputc('\n', to);
}

static int write_matrices(const struct export_options *options, const struct geometry *geometry, FILE *to,
			  struct error *err)
{
	(void)options;
	(void)err;
	fprintf(
	    to,
	    "# 3x4 matrices, row by row: (x, y, z, 1) in mm to w (column, row, 1), pixel centres are whole numbers\n");
	for (int k = 0; k < geometry->count; k++) {
		double matrix[12];

		view_matrix(&geometry->views[k], matrix);
		write_numbers(matrix, 12, to);
	}
	return 0;
}

/* ASTRA's vectors: source, the detector's centre, u from column to column, v from row to row; its world is ours. */
static int write_astra(const struct export_options *options, const struct geometry *geometry, FILE *to,
		       struct error *err)
{
	(void)options;
	(void)err;
	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];
		double vectors[12];

		for (int i = 0; i < 3; i++) {
			vectors[i] = view->source[i];
			vectors[3 + i] = view->pixel0[i] + 0.5 * (geometry->columns - 1) * view->column_step[i] +
					 0.5 * (geometry->rows - 1) * view->row_step[i];
			vectors[6 + i] = view->column_step[i];
			vectors[9 + i] = view->row_step[i];
		}
		write_numbers(vectors, 12, to);
	}
	return 0;
}

static int (*const writers[])(const struct export_options *options, const struct geometry *geometry, FILE *to,
			      struct error *err) = {write_rtk, write_matrices, write_astra};
static const char *const format_names[] = {"rtk", "matrices", "astra", NULL};

#define ROW(name, letter, kind, member, argument, help, least, most, names)                                            \
	{                                                                                                              \
		name, letter, kind, offsetof(struct export_options, member), argument, help, least, most, 0, names     \
	}
static const struct option rows[] = {
    ROW("output", 'o', OPTION_TEXT, output, "FILE", "- is standard output", 0, 0, NULL),
    ROW("format", 0, OPTION_CHOICE, format, "FORMAT",
	"rtk: XML with parameters and matrices; matrices: 12 numbers a view; astra: the 12 numbers a view of cone_vec",
	0, 0, format_names),
    ROW("stack", 0, OPTION_TEXT, stack, "FILE.mhd",
	"also write a MetaImage header of the directory's projections, which RTK reads together with the XML", 0, 0,
	NULL),
    ROW("tolerance", 0, OPTION_NUMBER, tolerance, "PIXELS",
	"how far RTK's parameters may be off, which know neither skewed pixels nor a pitch that changes", 0, 100, NULL),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct export_options, http)},
    {0},
};

/* ---- the scan ---- */

/* Parses the scan that was posted out of the daemon's document of it. */
static int scan_of_reply(cJSON *reply, struct scan **ret_scan, struct error *err)
{
	static const char *const members[] = {"name", "detector", "projections", "geometry"};
	cJSON *document = cJSON_CreateObject();
	size_t length = 0;
	char *text;
	int code;

	for (size_t i = 0; i < sizeof(members) / sizeof(members[0]); i++)
		cJSON_AddItemToObject(document, members[i], cJSON_DetachItemFromObjectCaseSensitive(reply, members[i]));
	text = json_print(document, &length);
	code = text != NULL ? scan_parse(text, length, ret_scan, err)
			    : error_set(err, ERR_NO_MEMORY, "no memory for a scan document");
	free(text);
	cJSON_Delete(document);
	return code;
}

static int fetch_scan(const struct export_options *options, struct scan **ret_scan, struct error *err)
{
	struct http *http = NULL;
	cJSON *reply = NULL;
	char path[160];
	int code = http_new(&options->http, &http, err);

	snprintf(path, sizeof(path), "/v1/scans/%.100s", options->scan);
	if (code == 0)
		code = http_json(http, "GET", path, &reply, err);
	if (code == 0)
		code = scan_of_reply(reply, ret_scan, err);
	cJSON_Delete(reply);
	http_free(http);
	return code;
}

static int load_scan(const struct export_options *options, struct scan **ret_scan, struct error *err)
{
	char path[PATH_MAX], *text = NULL;
	size_t length = 0;
	struct stat status;
	int code;

	if (stat(options->scan, &status) != 0 || !S_ISDIR(status.st_mode)) {
		if (options->stack != NULL)
			return error_set(err, ERR_USAGE, "--stack needs a scan directory, '%.100s' is none",
					 options->scan);
		return fetch_scan(options, ret_scan, err);
	}
	snprintf(path, sizeof(path), "%s/scan.json", options->scan);
	code = file_read(path, JSON_BYTES_MAX, &text, &length, err);
	if (code == 0)
		code = scan_parse(text, length, ret_scan, err);
	free(text);
	return code;
}

/* ---- the stack ---- */

static void print_stack(const struct rtk_stack *stack, const struct scan *scan, const char *data, FILE *to)
{
	const double *o = stack->origin, *u = stack->column_step, *v = stack->row_step;
	const double spacing[3] = {u[0], fabs(v[1]), 1}, origin[3] = {o[0], o[1], 0};
	const double direction[9] = {1, 0, 0, 0, v[1] < 0 ? -1 : 1, 0, 0, 0, 1};

	fprintf(to, "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
		    "CompressedData = False\nTransformMatrix = ");
	write_numbers(direction, 9, to);
	fprintf(to, "Offset = ");
	write_numbers(origin, 3, to);
	fprintf(to, "ElementSpacing = ");
	write_numbers(spacing, 3, to);
	fprintf(to, "DimSize = %d %d %d\nElementType = %s\nElementDataFile = %s\n", scan->geometry.columns,
		scan->geometry.rows, scan->count, scan->sample == SAMPLE_UINT16 ? "MET_USHORT" : "MET_FLOAT", data);
}

static int write_stack(const struct export_options *options, const struct scan *scan, struct error *err)
{
	char path[PATH_MAX], whole[PATH_MAX];
	struct rtk_geometry rtk;
	struct rtk_stack stack;
	FILE *to;
	int code = rtk_geometry_from_views(&scan->geometry, options->tolerance, &rtk, &stack, err);

	if (code != 0)
		return code;
	rtk_geometry_clear(&rtk);
	snprintf(path, sizeof(path), "%s/projections.raw", options->scan);
	if (realpath(path, whole) == NULL)
		return error_set_errno(err, errno, "%s", path);
	code = output_open(options->stack, &to, err);
	if (code != 0)
		return code;
	print_stack(&stack, scan, whole, to);
	return output_close(to, options->stack, err);
}

static int write_geometry(const struct export_options *options, const struct scan *scan, struct error *err)
{
	FILE *to;
	int code = output_open(options->output, &to, err), closed;

	if (code != 0)
		return code;
	code = writers[options->format](options, &scan->geometry, to, err);
	closed = output_close(to, options->output, code == 0 ? err : &(struct error){0});
	return code != 0 ? code : closed;
}

static int export_run(const void *values, struct error *err)
{
	const struct export_options *options = values;
	struct scan *scan = NULL;
	int code = load_scan(options, &scan, err);

	if (code == 0)
		code = write_geometry(options, scan, err);
	if (code == 0 && options->stack != NULL)
		code = write_stack(options, scan, err);
	scan_free(scan);
	return code;
}

static const struct export_options defaults = {.output = "-", .tolerance = 1e-6};
static const struct positional positionals[] = {
    {"SCAN", "a scan directory, or the id of a scan that the daemon has", offsetof(struct export_options, scan), true},
    {0},
};

const struct command command_export_geometry = {
    "export-geometry", "a scan's geometry for other tools: RTK, 3x4 matrices, ASTRA",
    positionals,       groups,
    &defaults,         sizeof(defaults),
    export_run,
};

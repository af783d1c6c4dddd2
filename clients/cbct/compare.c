/*
 * cbct compare: how far a volume is from the truth. Volumes must lie on the same
 * grid; nothing is resampled. Only voxels that all of --mask, --body, --slices,
 * --region, --fov and --scan leave are compared.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/metrics.h"
#include "clients/cbct/volume_input.h"
#include "proto/scan_directory.h"

struct compare_options {
	const char *volume, *truth;
	struct volume_options file;
	const char *mask, *slices, *region, *scan;
	double value; /* in place of the truth, NaN: none */
	double body, fov, peak;
	bool zero_outside, hu_volume, hu_truth, json;
};

#define ROW(name, kind, member, argument, help, least, most, count)                                                    \
	{                                                                                                              \
		name, 0, kind, offsetof(struct compare_options, member), argument, help, least, most, count, NULL      \
	}
static const struct option mask_rows[] = {
    ROW("mask", OPTION_TEXT, mask, "FILE", "only where this volume is not 0", 0, 0, 0),
    ROW("body", OPTION_NUMBER, body, "VALUE", "only where the truth is above VALUE, in HU with --hu", 0, 0, 0),
    ROW("slices", OPTION_TEXT, slices, "A-B", "only slices z = A to B, both included", 0, 0, 0),
    ROW("region", OPTION_TEXT, region, "X-X,Y-Y,Z-Z", "only these voxels, both ends included", 0, 0, 0),
    ROW("fov", OPTION_NUMBER, fov, "MM", "only within this radius of the z axis", 0, 1e9, 0),
    ROW("scan", OPTION_TEXT, scan, "FILE",
	"only in the field of view of this scan.json: the cylinder that all views see (or --fov), cut by the cone", 0,
	0, 0),
    ROW("zero-outside-fov", OPTION_FLAG, zero_outside, NULL,
	"set A to 0/mm outside of --fov or --scan and compare there as well", 0, 0, 0),
    {0},
};
static const struct option measure_rows[] = {
    ROW("value", OPTION_NUMBER, value, "VALUE", "the truth is this value everywhere; TRUTH is left out", 0, 0, 0),
    ROW("peak", OPTION_NUMBER, peak, "VALUE", "for PSNR and SSIM (default: the truth's largest - smallest value)",
	1e-12, 1e12, 0),
    ROW("hu", OPTION_FLAG, file.hu, NULL, "compare in Hounsfield units, to which both are converted", 0, 0, 0),
    ROW("hu-volume", OPTION_FLAG, hu_volume, NULL, "A's file holds Hounsfield units", 0, 0, 0),
    ROW("hu-truth", OPTION_FLAG, hu_truth, NULL, "the truth's file holds Hounsfield units", 0, 0, 0),
    ROW("mu-water", OPTION_NUMBER, file.mu_water, "MU", "water, 1/mm", 1e-9, 1e3, 0),
    ROW("json", OPTION_FLAG, json, NULL, "print one JSON object", 0, 0, 0),
    {0},
};
static const struct option_group groups[] = {
    {"mask", mask_rows, 0},
    {"measures", measure_rows, 0},
    {"raw files (one of the two may leave it to the other)", volume_grid_rows, offsetof(struct compare_options, file)},
    {0},
};

static int grids_agree(const struct grid *a, const struct grid *b, struct error *err)
{
	for (int i = 0; i < 3; i++) {
		/* Files keep float32: seven digits. */
		double tolerance = 1e-3 * b->spacing[i];
		double far = a->origin[i] + a->spacing[i] * a->size[i] - b->origin[i] - b->spacing[i] * b->size[i];

		if (a->size[i] != b->size[i])
			return error_set(err, ERR_INVALID, "%d voxels along %c, the truth has %d", a->size[i], "xyz"[i],
					 b -> size[i]);
		if (fabs(a->origin[i] - b->origin[i]) > tolerance || fabs(far) > tolerance)
			return error_set(err, ERR_INVALID,
					 "along %c voxels of %g mm from %g mm, the truth has %g mm from %g mm",
					 "xyz"[i], a -> spacing[i], a -> origin[i], b -> spacing[i], b -> origin[i]);
	}
	return 0;
}

/* Whether a file brings no grid of its own: its name is none of a known format. */
static bool is_raw(const char *path)
{
	size_t length = strlen(path);

	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		size_t ending = strlen(format->extension);

		if (strcmp(format->name, "raw") != 0 && length > ending &&
		    strcmp(path + length - ending, format->extension) == 0)
			return false;
	}
	return true;
}

struct pair {
	struct grid grid;
	double axes[3][3]; /* directions of the grid's, LPS */
	float *a, *truth;
	unsigned char *mask; /* [z][y][x], 0 = left out */
};

/* Oblique volumes count their grids along their own axes: those must be the same, or the grids tell nothing. */
static int axes_agree(double a[3][3], double b[3][3], struct error *err)
{
	const double tolerance = 1e-4; /* of a unit vector: what single precision and printed digits leave */

	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			if (!(fabs(a[i][j] - b[i][j]) <= tolerance))
				return error_set(err, ERR_INVALID, "its axes are turned against those of the truth");
	return 0;
}

static int pair_load_both(const struct compare_options *options, struct pair *pair, struct error *err)
{
	struct grid a, truth;
	double axes[3][3] = {{0}};
	bool truth_first = is_raw(options->volume) && !is_raw(options->truth);
	int code = 0;

	for (int turn = 0; turn < 2 && code == 0; turn++)
		if ((turn == 0) == truth_first)
			code = volume_load(options->truth, &options->file, truth_first ? NULL : &a, &truth, pair->axes,
					   &pair->truth, err);
		else
			code = volume_load(options->volume, &options->file, truth_first ? &truth : NULL, &a, axes,
					   &pair->a, err);
	/* Raw voxels lie along whatever the other file's do. */
	if (code == 0 && !is_raw(options->volume) && !is_raw(options->truth))
		code = axes_agree(axes, pair->axes, err);
	if (code == 0)
		code = grids_agree(&a, &truth, err);
	if (code == 0)
		pair->grid = truth;
	return code;
}

static int pair_load(const struct compare_options *options, struct pair *pair, struct error *err)
{
	size_t count;
	int code;

	if ((options->truth != NULL) == !isnan(options->value))
		return error_set(err, ERR_USAGE, "either TRUTH or --value is expected");
	if (options->truth != NULL)
		return pair_load_both(options, pair, err);
	code = volume_load(options->volume, &options->file, NULL, &pair->grid, pair->axes, &pair->a, err);
	if (code != 0)
		return code;
	count = grid_voxels(&pair->grid);
	pair->truth = malloc(count * sizeof(*pair->truth));
	if (pair->truth == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", count);
	for (size_t i = 0; i < count; i++)
		pair->truth[i] = (float)options->value;
	return 0;
}

static void keep_body(const struct compare_options *options, struct pair *pair)
{
	size_t count = grid_voxels(&pair->grid);

	for (size_t i = 0; i < count; i++)
		if (!((double)pair->truth[i] > options->body))
			pair->mask[i] = 0;
}

static int keep_mask(const struct compare_options *options, struct pair *pair, struct error *err)
{
	size_t count = grid_voxels(&pair->grid);
	struct grid grid;
	double axes[3][3];
	float *mask = NULL;
	int code = volume_load(options->mask, &options->file, &pair->grid, &grid, axes, &mask, err);

	if (code == 0 && !is_raw(options->mask))
		code = axes_agree(axes, pair->axes, err);
	if (code == 0)
		code = grids_agree(&grid, &pair->grid, err);
	for (size_t i = 0; i < count && code == 0; i++)
		if (mask[i] == 0)
			pair->mask[i] = 0;
	free(mask);
	return code;
}

/* "24-39" within 0 .. size - 1, followed by `end`; returns what is behind it, NULL when it is none. */
static const char *range_parse(const char *text, int size, char end, int *ret_first, int *ret_last)
{
	int used = 0;

	if (sscanf(text, "%d-%d%n", ret_first, ret_last, &used) != 2 || *ret_first < 0 || *ret_last < *ret_first ||
	    *ret_last >= size || text[used] != end)
		return NULL;
	return text + used + (end != 0);
}

static int keep_box(const char *option, const char *text, bool slices, struct pair *pair, struct error *err)
{
	const int *size = pair->grid.size;
	int first[3] = {0, 0, 0}, last[3] = {size[0] - 1, size[1] - 1, size[2] - 1};
	const char *at = text;

	for (int i = slices ? 2 : 0; i < 3 && at != NULL; i++)
		at = range_parse(at, size[i], i < 2 ? ',' : 0, &first[i], &last[i]);
	if (at == NULL)
		return error_set(err, ERR_USAGE, "--%s: '%s' is no range within a volume of %d x %d x %d voxels",
				 option, text, size[0], size[1], size[2]);
	for (int z = 0; z < size[2]; z++)
		for (int y = 0; y < size[1]; y++)
			for (int x = 0; x < size[0]; x++) {
				size_t i = ((size_t)z * (size_t)size[1] + (size_t)y) * (size_t)size[0] + (size_t)x;

				if (x < first[0] || x > last[0] || y < first[1] || y > last[1] || z < first[2] ||
				    z > last[2])
					pair->mask[i] = 0;
			}
	return 0;
}

/* Rows from half a pixel before the first to half a pixel behind the last, in every view. */
static bool rows_see(const double (*matrices)[12], int views, int rows, const double point[3])
{
	for (int i = 0; i < views; i++) {
		double column, row;

		if (view_project(matrices[i], point, &column, &row) <= 0 || row < -0.5 || row > rows - 0.5)
			return false;
	}
	return true;
}

/* Clears `inside` outside of the cylinder and, where there are matrices, of the rays to the rows. */
static void clear_outside(const struct grid *grid, double radius, const double (*matrices)[12], int views, int rows,
			  unsigned char *inside)
{
#pragma omp parallel for schedule(dynamic)
	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				const double point[3] = {grid->origin[0] + x * grid->spacing[0],
							 grid->origin[1] + y * grid->spacing[1],
							 grid->origin[2] + z * grid->spacing[2]};
				size_t i =
				    ((size_t)z * (size_t)grid->size[1] + (size_t)y) * (size_t)grid->size[0] + (size_t)x;

				if (hypot(point[0], point[1]) > radius || !rows_see(matrices, views, rows, point))
					inside[i] = 0;
			}
}

static int fov_of_scan(const struct compare_options *options, const struct grid *grid, unsigned char *inside,
		       struct error *err)
{
	char *text = NULL;
	size_t length = 0;
	struct scan *scan = NULL;
	double(*matrices)[12] = NULL;
	int code = file_read(options->scan, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = scan_parse(text, length, &scan, err);
	if (code == 0) {
		matrices = malloc((size_t)scan->count * sizeof(*matrices));
		if (matrices == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for %d matrices", scan->count);
	}
	if (code == 0) {
		double radius = isnan(options->fov) ? scan->orbit.field_of_view / 2 : options->fov;

		for (int i = 0; i < scan->count; i++)
			view_matrix(&scan->geometry.views[i], matrices[i]);
		clear_outside(grid, radius, (const double(*)[12])matrices, scan->count, scan->geometry.rows, inside);
	}
	free(matrices);
	scan_free(scan);
	free(text);
	return code;
}

/* Outside of the field of view: left out, or A is 0 there. */
static int keep_fov(const struct compare_options *options, struct pair *pair, struct error *err)
{
	size_t count = grid_voxels(&pair->grid);
	unsigned char *inside = malloc(count);
	int code = 0;

	if (inside == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a mask of %zu voxels", count);
	memset(inside, 1, count);
	if (options->scan != NULL)
		code = fov_of_scan(options, &pair->grid, inside, err);
	else
		clear_outside(&pair->grid, options->fov, NULL, 0, 0, inside);
	for (size_t i = 0; i < count && code == 0; i++) {
		if (inside[i] != 0)
			continue;
		if (options->zero_outside)
			pair->a[i] = options->file.hu ? -1000 : 0;
		else
			pair->mask[i] = 0;
	}
	free(inside);
	return code;
}

static int pair_mask(const struct compare_options *options, struct pair *pair, struct error *err)
{
	size_t count = grid_voxels(&pair->grid);
	bool has_fov = !isnan(options->fov) || options->scan != NULL;
	int code = 0;

	if (options->zero_outside && !has_fov)
		return error_set(err, ERR_USAGE, "--zero-outside-fov needs --fov or --scan");
	pair->mask = malloc(count);
	if (pair->mask == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a mask of %zu voxels", count);
	memset(pair->mask, 1, count);
	if (!isnan(options->body))
		keep_body(options, pair);
	if (options->mask != NULL)
		code = keep_mask(options, pair, err);
	if (code == 0 && options->slices != NULL)
		code = keep_box("slices", options->slices, true, pair, err);
	if (code == 0 && options->region != NULL)
		code = keep_box("region", options->region, false, pair, err);
	if (code == 0 && has_fov)
		code = keep_fov(options, pair, err);
	return code;
}

static void to_hu(float *voxels, size_t count, double mu_water)
{
	for (size_t i = 0; i < count; i++)
		voxels[i] = (float)(1000 * ((double)voxels[i] - mu_water) / mu_water);
}

static void pair_units(const struct compare_options *options, struct pair *pair)
{
	size_t count = grid_voxels(&pair->grid);
	double water = options->file.mu_water;

	/* As simulate does it: the truth has nothing below vacuum. A may have. */
	if (options->hu_truth)
		volume_from_hu(pair->truth, count, water);
	if (options->file.hu)
		to_hu(pair->truth, count, water);
	if (options->file.hu && !options->hu_volume)
		to_hu(pair->a, count, water);
	if (!options->file.hu && options->hu_volume)
		for (size_t i = 0; i < count; i++)
			pair->a[i] = (float)(water * (1 + (double)pair->a[i] / 1000));
}

/* One row for each measure, so that text and JSON say the same. */
static const struct {
	const char *name, *label;
	size_t offset;
	bool in_unit; /* 1/mm or HU */
} measures[] = {
    {"mean", "mean", offsetof(struct metrics, mean), true},
    {"relative_error", "relative L2 error", offsetof(struct metrics, relative_error), false},
    {"mean_difference", "mean difference", offsetof(struct metrics, mean_difference), true},
    {"mean_absolute_error", "mean |error|", offsetof(struct metrics, mean_error), true},
    {"rmse", "RMSE", offsetof(struct metrics, rmse), true},
    {"largest_error", "largest |error|", offsetof(struct metrics, largest_error), true},
    {"peak", "peak", offsetof(struct metrics, peak), true},
    {"psnr_db", "PSNR, dB", offsetof(struct metrics, psnr), false},
    {"ssim", "SSIM, 3D", offsetof(struct metrics, ssim), false},
    {"correlation", "correlation", offsetof(struct metrics, correlation), false},
};

static int print_metrics(const struct compare_options *options, const struct metrics *metrics, struct error *err)
{
	const char *unit = options->file.hu ? " HU" : "";
	cJSON *json = cJSON_CreateObject();
	char *text;

	cJSON_AddNumberToObject(json, "voxels", (double)metrics->voxels);
	if (!options->json)
		printf("%-18s %zu\n", "voxels", metrics->voxels);
	for (size_t i = 0; i < sizeof(measures) / sizeof(measures[0]); i++) {
		double value = *(const double *)((const char *)metrics + measures[i].offset);

		cJSON_AddNumberToObject(json, measures[i].name, value);
		if (!options->json)
			printf("%-18s %.6g%s\n", measures[i].label, value, measures[i].in_unit ? unit : "");
	}
	text = json_print(json, NULL);
	cJSON_Delete(json);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the measures");
	if (options->json)
		puts(text);
	free(text);
	return 0;
}

static int compare_run(const void *values, struct error *err)
{
	const struct compare_options *options = values;
	struct pair pair = {0};
	struct metrics metrics;
	int code = pair_load(options, &pair, err);

	if (code == 0) {
		pair_units(options, &pair);
		code = pair_mask(options, &pair, err);
	}
	if (code == 0)
		code = metrics_compute(pair.a, pair.truth, pair.mask, pair.grid.size, options->peak, &metrics, err);
	if (code == 0)
		code = print_metrics(options, &metrics, err);
	free(pair.a);
	free(pair.truth);
	free(pair.mask);
	return code;
}

static const struct compare_options defaults = {.file = VOLUME_OPTIONS_DEFAULTS,
						.value = OPTION_UNSET_NUMBER,
						.body = OPTION_UNSET_NUMBER,
						.fov = OPTION_UNSET_NUMBER};

static const struct positional positionals[] = {
    {"A", "the volume that is judged", offsetof(struct compare_options, volume), true},
    {"TRUTH", "the volume that it should be", offsetof(struct compare_options, truth), false},
    {0},
};

const struct command command_compare = {
    "compare", "how far a volume is from the truth", positionals, groups, &defaults, sizeof(defaults), compare_run};

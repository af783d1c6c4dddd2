/* cbct simulate: a scan directory (proto/scan_directory.h) made from a phantom or a volume. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/noise.h"
#include "clients/cbct/object.h"
#include "clients/cbct/progress.h"
#include "clients/cbct/scan_output.h"
#include "clients/cbct/setup.h"
#include "clients/cbct/volume_output.h"
#include "proto/scan_directory.h"

struct simulate_options {
	const char *output;
	struct object_options object;
	struct setup_options setup;
	struct {
		double photons, multiplicative, air, defects;
		int raw; /* enum raw, or unset */
		int sample;
		long seed;
	} detector;
	struct {
		const char *path;
		double size[3];
		long samples;
	} truth;
};

#define ROW(name, letter, kind, member, argument, help, least, most, count, names)                                     \
	{                                                                                                              \
		name, letter, kind, offsetof(struct simulate_options, member), argument, help, least, most, count,     \
		    names                                                                                              \
	}
enum raw { RAW_AIR, RAW_FLAT };
static const char *const raw_names[] = {"air", "flat", NULL};
static const struct option output_rows[] = {
    ROW("output", 'o', OPTION_TEXT, output, "DIR", "the scan directory, made where it is missing", 0, 0, 0, NULL),
    {0},
};
static const struct option detector_rows[] = {
    ROW("photons", 0, OPTION_NUMBER, detector.photons, "N", "Poisson noise: photons in a pixel of the open beam", 1,
	1e15, 0, NULL),
    ROW("multiplicative", 0, OPTION_NUMBER, detector.multiplicative, "A", "each value times 1 - A r, r uniform in 0..1",
	0, 1, 0, NULL),
    ROW("raw", 0, OPTION_CHOICE, detector.raw, "HOW",
	"write counts in place of line integrals, of an even detector (--air) or an uneven one with flat.f32 and "
	"dark.f32",
	0, 0, 0, raw_names),
    ROW("sample", 0, OPTION_CHOICE, detector.sample, "TYPE", "of raw counts", 0, 0, 2, sample_names),
    ROW("air", 0, OPTION_NUMBER, detector.air, "COUNTS", "of the open beam", 1, 1e12, 0, NULL),
    ROW("defects", 0, OPTION_NUMBER, detector.defects, "SHARE", "of pixels that count nothing in any view", 0, 0.5, 0,
	NULL),
    ROW("seed", 0, OPTION_INTEGER, detector.seed, "N", "of the noise; the same seed gives the same bytes", 0, 0, 0,
	NULL),
    {0},
};
static const struct option truth_rows[] = {
    ROW("truth", 0, OPTION_TEXT, truth.path, "FILE", "write the truth: the volume, or the phantom's voxels", 0, 0, 0,
	NULL),
    ROW("grid", 0, OPTION_EACH, truth.size, "N[,N,N]", "voxels of a phantom's truth; --spacing and --origin go with it",
	1, GRID_SIZE_MAX, 3, NULL),
    ROW("samples", 0, OPTION_INTEGER, truth.samples, "N", "a voxel is the mean of N^3 points", 1, 64, 0, NULL),
    {0},
};

static const struct option_group groups[] = {
    {"output", output_rows, 0},
    {"a phantom", object_phantom_rows, offsetof(struct simulate_options, object)},
    {"or a volume", object_volume_rows, offsetof(struct simulate_options, object)},
    {"", volume_hu_rows, offsetof(struct simulate_options, object.file)},
    {"voxels of the volume, or of a phantom's truth", volume_grid_rows, offsetof(struct simulate_options, object.file)},
    {"geometry", setup_rows, offsetof(struct simulate_options, setup)},
    {"detector", detector_rows, 0},
    {"truth", truth_rows, 0},
    {0},
};

/* All views, in order, with what the detector makes of them. */
static int write_projections(const struct simulate_options *options, const struct noise *noise,
			     const struct object *object, const struct scan *scan, const float *flat, const float *dark,
			     struct error *err)
{
	size_t pixels = (size_t)scan->geometry.columns * (size_t)scan->geometry.rows;
	float *projection = malloc(pixels * sizeof(*projection));
	void *samples = malloc(pixels * sizeof(float));
	struct progress *progress = progress_new(stderr, PROGRESS_BAR_ONLY, "simulating");
	int fd = -1, code;

	code = projection == NULL || samples == NULL
		   ? error_set(err, ERR_NO_MEMORY, "no memory for a projection of %zu pixels", pixels)
		   : scan_output_create(options->output, "projections.raw", &fd, err);
	for (int view = 0; view < scan->count && code == 0; view++) {
		object_project(object, &scan->geometry, view, projection);
		noise_apply(noise, view, scan->geometry.columns, scan->geometry.rows, projection, flat, dark, samples);
		code = scan_output_write(fd, samples, scan_projection_bytes(scan), err);
		progress_show(progress, (double)(view + 1) / scan->count, -1, "view %d of %d", view + 1, scan->count);
	}
	if (fd >= 0 && close(fd) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s/projections.raw", options->output);
	progress_free(progress);
	free(projection);
	free(samples);
	return code;
}

static int write_phantom(const struct simulate_options *options, const struct object *object,
			 const struct patient *patient, struct error *err)
{
	const struct volume_options *voxels_of = &options->object.file;
	struct grid grid;
	float *voxels;
	int code;

	if (isnan(options->truth.size[0]) || isnan(voxels_of->spacing[0]))
		return error_set(err, ERR_USAGE, "--truth of a phantom needs --grid and --spacing");
	code = grid_from_numbers(options->truth.size, voxels_of->spacing, voxels_of->origin, &grid, err);
	if (code != 0)
		return code;
	voxels = malloc(grid_voxels(&grid) * sizeof(*voxels));
	if (voxels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", grid_voxels(&grid));
	phantom_voxelise(&object->phantom, &grid, (int)options->truth.samples, voxels);
	code = volume_write(options->truth.path, &grid, patient, voxels, err);
	free(voxels);
	return code;
}

static int write_truth(const struct simulate_options *options, const struct object *object,
		       const struct patient *patient, struct error *err)
{
	if (object->voxels == NULL)
		return write_phantom(options, object, patient, err);
	if (!isnan(options->truth.size[0]))
		return error_set(err, ERR_USAGE, "--grid is for phantoms: the truth of a volume is the volume itself");
	return volume_write(options->truth.path, &object->grid, patient, object->voxels, err);
}

static int write_scan(const struct simulate_options *options, const struct noise *noise, const struct object *object,
		      const struct scan *scan, struct error *err)
{
	size_t pixels = (size_t)scan->geometry.columns * (size_t)scan->geometry.rows;
	float *flat = NULL, *dark = NULL;
	int code = scan_output_begin(options->output, err);

	if (code != 0)
		return code;
	if (noise->structure) {
		flat = malloc(pixels * sizeof(*flat));
		dark = malloc(pixels * sizeof(*dark));
		if (flat == NULL || dark == NULL) {
			code = error_set(err, ERR_NO_MEMORY, "no memory for a flat of %zu pixels", pixels);
			goto out;
		}
		noise_images(noise, scan->geometry.columns, scan->geometry.rows, flat, dark);
		code = scan_output_file(options->output, "flat.f32", flat, pixels * sizeof(*flat), err);
		if (code == 0)
			code = scan_output_file(options->output, "dark.f32", dark, pixels * sizeof(*dark), err);
	}
	if (code == 0 && options->truth.path != NULL)
		code = write_truth(options, object, &scan->patient, err);
	if (code == 0)
		code = write_projections(options, noise, object, scan, flat, dark, err);
	/* Last: a directory with a document is whole. */
	if (code == 0)
		code = scan_output_document(options->output, scan, err);
out:
	free(flat);
	free(dark);
	return code;
}

static cJSON *projections_json(const struct noise *noise)
{
	cJSON *json = cJSON_CreateObject();

	cJSON_AddStringToObject(json, "sample", sample_names[noise->raw ? noise->sample : SAMPLE_FLOAT32]);
	cJSON_AddStringToObject(json, "quantity",
				quantity_names[noise->raw ? QUANTITY_INTENSITY : QUANTITY_LINE_INTEGRAL]);
	if (noise->raw && !noise->structure)
		cJSON_AddNumberToObject(json, "air", noise->air);
	return json;
}

static int simulate_run(const void *values, struct error *err)
{
	const struct simulate_options *options = values;
	const struct noise noise = {
	    .photons = options->detector.photons,
	    .multiplicative = options->detector.multiplicative,
	    .raw = options->detector.raw != OPTION_UNSET_CHOICE,
	    .sample = (enum sample)options->detector.sample,
	    .air = options->detector.air,
	    .structure = options->detector.raw == RAW_FLAT,
	    .defects = options->detector.defects,
	    .seed = (uint64_t)options->detector.seed,
	};
	struct object object = {0};
	struct scan *scan = NULL;
	int code;

	code = object_open(&options->object, &object, err);
	if (code == 0)
		code = setup_scan(&options->setup, projections_json(&noise), &scan, err);
	if (code == 0)
		code = write_scan(options, &noise, &object, scan, err);
	scan_free(scan);
	object_close(&object);
	return code;
}

static const struct simulate_options defaults = {
    .output = "scan",
    .object = OBJECT_OPTIONS_DEFAULTS,
    .setup = SETUP_OPTIONS_DEFAULTS,
    .detector = {.air = 60000, .raw = OPTION_UNSET_CHOICE, .sample = SAMPLE_UINT16, .seed = 1},
    .truth = {.size = OPTION_UNSET_3, .samples = 4},
};

static const struct positional positionals[] = {{0}};

const struct command command_simulate = {
    "simulate",  "a scan directory from a phantom or a volume", positionals, groups, &defaults, sizeof(defaults),
    simulate_run};

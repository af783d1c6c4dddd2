/*
 * cbct import: projections and geometry of other tools as a scan, posted to the
 * daemon or written as a scan directory. What the images are say images.c and
 * import_values.c, where they were taken import_geometry.c.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/import_geometry.h"
#include "clients/cbct/import_values.h"
#include "clients/cbct/progress.h"
#include "clients/cbct/scan_output.h"
#include "clients/cbct/upload.h"
#include "clients/cbct/warning.h"

struct import_options {
	const char *images, *output, *name;
	struct image_options image;
	struct import_geometry geometry;
	struct import_values values;
	struct upload_settings upload;
};

#define ROW(name, letter, member, argument, help)                                                                      \
	{                                                                                                              \
		name, letter, OPTION_TEXT, offsetof(struct import_options, member), argument, help, 0, 0, 0, NULL      \
	}
static const struct option output_rows[] = {
    ROW("output", 'o', output, "DIR", "write a scan directory there in place of posting the scan"),
    ROW("name", 0, name, "NAME", "of the scan (default: the images' name)"),
    {0},
};

static const struct option_group groups[] = {
    {"output", output_rows, 0},
    {"", upload_rows, offsetof(struct import_options, upload)},
    {"", http_option_rows, offsetof(struct import_options, upload.http)},
    {"images: MetaImage (.mha, .mhd), TIFF, NumPy (.npy), DICOM XA and Enhanced XA (through DCMTK's programs), Heimann "
     ".his, Varian .hnd and .xim, Nikon .xtekct, Zeiss .txrm, NeXus and Data Exchange in HDF5 (through libhdf5), raw",
     image_option_rows, offsetof(struct import_options, image)},
    {"geometry: one of --rtk, --matrices, --astra, --angles, --angle-step; DICOM and scanners' own files have theirs",
     import_geometry_rows, offsetof(struct import_options, geometry)},
    {"numbers", import_value_rows, offsetof(struct import_options, values)},
    {0},
};

/* ---- the document ---- */

static const char *scan_name(const struct import_options *options)
{
	const char *slash = strrchr(options->images, '/');

	if (options->name != NULL)
		return options->name;
	return slash != NULL && slash[1] != '\0' ? slash + 1 : options->images;
}

/* How the patient lies and who that is make one member, the study another. */
static void add_patient(cJSON *document, const struct patient *patient, const struct subject *subject)
{
	cJSON *told = subject_json(subject), *who = cJSON_GetObjectItemCaseSensitive(told, "patient");
	cJSON *lies = patient->known ? patient_json(patient) : NULL, *member;

	if (patient->known && who == NULL)
		who = cJSON_AddObjectToObject(told, "patient");
	while (lies != NULL && (member = cJSON_DetachItemFromArray(lies, 0)) != NULL)
		cJSON_AddItemToObject(who, member->string, member);
	while (told != NULL && (member = cJSON_DetachItemFromArray(told, 0)) != NULL)
		cJSON_AddItemToObject(document, member->string, member);
	cJSON_Delete(lies);
	cJSON_Delete(told);
}

static int make_document(const struct import_options *options, struct images *images, cJSON *document,
			 struct error *err)
{
	cJSON *detector = NULL, *geometry = NULL, *projections = NULL;
	struct patient patient = patient_unknown;
	int code = import_geometry(&options->geometry, images, &detector, &geometry, &patient, err);

	if (code == 0)
		code = import_values(&options->values, images, &projections, err);
	cJSON_AddStringToObject(document, "name", scan_name(options));
	add_patient(document, &patient, &images->subject);
	if (images->source != NULL)
		cJSON_AddItemToObject(document, "source", cJSON_Duplicate(images->source, true));
	cJSON_AddItemToObject(document, "detector", detector);
	cJSON_AddItemToObject(document, "projections", projections);
	cJSON_AddItemToObject(document, "geometry", geometry);
	return code;
}

static int make_scan(const struct import_options *options, struct images *images, struct scan **ret_scan,
		     struct error *err)
{
	cJSON *document = cJSON_CreateObject();
	int code = document != NULL ? make_document(options, images, document, err)
				    : error_set(err, ERR_NO_MEMORY, "no memory for a document");
	char *text = NULL;
	size_t length = 0;

	if (code == 0) {
		text = json_print(document, &length);
		code = text != NULL ? scan_parse(text, length, ret_scan, err)
				    : error_set(err, ERR_NO_MEMORY, "no memory for a document");
	}
	free(text);
	cJSON_Delete(document);
	return code;
}

/* ---- the directory ---- */

static int write_projections(const struct import_options *options, struct images *images, const struct scan *scan,
			     const char *directory, struct error *err)
{
	size_t pixels = (size_t)images->columns * (size_t)images->rows;
	float *scratch = malloc(pixels * sizeof(*scratch));
	void *samples = malloc(pixels * sizeof(float));
	struct progress *progress =
	    options->upload.quiet ? NULL : progress_new(stderr, PROGRESS_BAR_ONLY, "reading images");
	int fd = -1, code;

	code = scratch == NULL || samples == NULL
		   ? error_set(err, ERR_NO_MEMORY, "no memory for an image of %zu pixels", pixels)
		   : scan_output_create(directory, "projections.raw", &fd, err);
	for (int k = 0; k < images->count && code == 0; k++) {
		code = import_samples(&options->values, images, k, scan->sample, scratch, samples, err);
		if (code == 0)
			code = scan_output_write(fd, samples, scan_projection_bytes(scan), err);
		progress_show(progress, (double)(k + 1) / images->count, -1, "image %d of %d", k + 1, images->count);
	}
	if (fd >= 0 && close(fd) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s/projections.raw", directory);
	progress_free(progress);
	free(scratch);
	free(samples);
	return code;
}

static int write_mean(const struct import_options *options, const struct images *images, const char *from,
		      const char *directory, const char *name, struct error *err)
{
	size_t pixels = (size_t)images->columns * (size_t)images->rows;
	float *mean;
	int code;

	if (from == NULL)
		return 0;
	mean = malloc(pixels * sizeof(*mean));
	code = mean != NULL ? import_mean(&options->values, &options->image, from, images, mean, err)
			    : error_set(err, ERR_NO_MEMORY, "no memory for an image");
	if (code == 0)
		code = scan_output_file(directory, name, mean, pixels * sizeof(*mean), err);
	free(mean);
	return code;
}

static int write_defects(const struct import_options *options, const struct images *images, const char *directory,
			 struct error *err)
{
	size_t pixels = (size_t)images->columns * (size_t)images->rows;
	unsigned char *defects;
	int code;

	if (options->values.defects == NULL)
		return 0;
	defects = malloc(pixels);
	code = defects != NULL ? import_defects(&options->image, options->values.defects, images, defects, err)
			       : error_set(err, ERR_NO_MEMORY, "no memory for an image");
	if (code == 0)
		code = scan_output_file(directory, "defects.u8", defects, pixels, err);
	free(defects);
	return code;
}

static int write_directory(const struct import_options *options, struct images *images, const struct scan *scan,
			   const char *directory, struct error *err)
{
	int code = scan_output_begin(directory, err);

	if (code == 0)
		code = write_mean(options, images, options->values.flat, directory, "flat.f32", err);
	if (code == 0)
		code = write_mean(options, images, options->values.dark, directory, "dark.f32", err);
	if (code == 0)
		code = write_defects(options, images, directory, err);
	if (code == 0)
		code = write_projections(options, images, scan, directory, err);
	if (code == 0)
		code = scan_output_document(directory, scan, err);
	return code;
}

/* ---- posting ---- */

/* The one temporary directory: who breaks an upload off shall not find gigabytes of it a month later. */
static char temporary[1000];
static int temporary_fd = -1;

/* Nothing but what a signal's handler may call. */
static void remove_temporary(void)
{
	static const char *const names[] = {"scan.json", "projections.raw", "flat.f32", "dark.f32", "defects.u8"};

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++)
		unlinkat(temporary_fd, names[i], 0);
	rmdir(temporary);
}

static void end_by_signal(int number)
{
	remove_temporary();
	_exit(128 + number);
}

static int make_temporary(struct error *err)
{
	const char *base = getenv("TMPDIR");
	struct sigaction action = {.sa_handler = end_by_signal};

	if (snprintf(temporary, sizeof(temporary), "%s/cbct-import-XXXXXX", base != NULL ? base : "/tmp") >=
	    (int)sizeof(temporary))
		return error_set(err, ERR_INVALID, "TMPDIR is too long");
	if (mkdtemp(temporary) == NULL)
		return error_set_errno(err, errno, "no temporary directory %s", temporary);
	temporary_fd = open(temporary, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
	if (temporary_fd < 0) {
		int code = error_set_errno(err, errno, "%s", temporary);

		rmdir(temporary);
		return code;
	}
	sigaction(SIGINT, &action, NULL);
	sigaction(SIGTERM, &action, NULL);
	sigaction(SIGHUP, &action, NULL);
	return 0;
}

/* By way of a directory: runs of projections go over several connections, again where one broke. */
static int post(const struct import_options *options, struct images *images, const struct scan *scan, struct error *err)
{
	int code = make_temporary(err);

	if (code != 0)
		return code;
	code = write_directory(options, images, scan, temporary, err);
	if (code == 0)
		code = upload_directory(temporary, &options->upload, err);
	remove_temporary();
	close(temporary_fd);
	return code;
}

static int import_run(const void *values, struct error *err)
{
	const struct import_options *options = values;
	struct images *images = NULL;
	struct scan *scan = NULL;
	int code = images_open(options->images, &options->image, &images, err);

	if (code == 0)
		code = make_scan(options, images, &scan, err);
	if (code == 0 && options->output != NULL) {
		code = write_directory(options, images, scan, options->output, err);
		if (code == 0)
			warnings_print_scan(scan);
	} else if (code == 0) {
		code = post(options, images, scan, err);
	}
	scan_free(scan);
	images_free(images);
	return code;
}

static const struct import_options defaults = {
    .image = IMAGE_OPTIONS_DEFAULTS,
    .geometry = IMPORT_GEOMETRY_DEFAULTS,
    .values = IMPORT_VALUES_DEFAULTS,
    .upload = UPLOAD_DEFAULTS,
};
static const struct positional positionals[] = {
    {"IMAGES",
     "a file of images, a folder of numbered ones, or a .txt or .lst file with their names. The first column is where "
     "u "
     "begins and the first row where v does: seen from the source with z up, columns run to the right and rows upward.",
     offsetof(struct import_options, images), true},
    {0},
};

const struct command command_import = {
    "import",    "projections and geometry of other tools as a scan: RTK, TIFF, raw, NumPy, DICOM XA, 3x4 matrices",
    positionals, groups,
    &defaults,   sizeof(defaults),
    import_run,
};

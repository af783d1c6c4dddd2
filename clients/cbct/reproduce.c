/*
 * cbct reproduce: makes a volume again from what its file says of itself (proto/provenance.h), on a daemon that has the
 * scan or from a scan directory, and compares bits. What was not the same when it was made again is told by name.
 */
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/tool.h"
#include "clients/cbct/watch.h"
#include "proto/format.h"
#include "proto/patient.h"
#include "proto/recipe.h"
#include "proto/scan_directory.h"

struct reproduce_options {
	const char *volume, *scan, *directory;
	bool keep;
	struct http_options http;
};

static const struct option rows[] = {
    {"scan", 0, OPTION_TEXT, offsetof(struct reproduce_options, scan), "ID",
     "of the scan on the daemon, where it is not the one that the file names", 0, 0, 0, NULL},
    {"from", 0, OPTION_TEXT, offsetof(struct reproduce_options, directory), "DIR",
     "a scan directory, e.g. BACKUP/scans/ID, in place of a daemon", 0, 0, 0, NULL},
    {"keep", 0, OPTION_FLAG, offsetof(struct reproduce_options, keep), NULL,
     "leave the job that makes the volume again on the daemon", 0, 0, 0, NULL},
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct reproduce_options, http)},
    {0},
};

/*
 * Backends and devices round otherwise: volumes of one scan then differ by some tenths of a Hounsfield unit. This is
 * the bound that the tests of the CUDA backend hold against the CPU's (tests/gpu/end_to_end.sh).
 */
static const double PRECISION_HU = 0.5;

enum { PATH_BYTES = 1200 };

struct work {
	const struct reproduce_options *options;
	char url[300], path[300]; /* of a volume that is named by its URL */
	char directory[1100];     /* of the files below */
	char file[PATH_BYTES];    /* that is to be made again */
	char again[PATH_BYTES];
	struct http_options connection;
	struct http *http; /* NULL with --from */
	bool hu;
	struct provenance was, is;
	cJSON *recipe;
	char job[100]; /* that has made it again */
	bool given_up; /* the job would never, or shall not, make it */
};

/* ---- the volume as it was ---- */

static bool write_piece(void *context, const void *data, size_t length)
{
	return fwrite(data, 1, length, context) == length;
}

static int download(struct http *http, const char *path, const char *to, struct error *err)
{
	FILE *file = fopen(to, "wbe");
	struct http_reply reply = {0};
	int code;

	if (file == NULL)
		return error_set_errno(err, errno, "%s", to);
	code = http_send(http,
			 &(struct http_request){.method = "GET", .path = path, .write = write_piece, .context = file},
			 &reply, err);
	http_reply_clear(&reply);
	if (fclose(file) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s", to);
	return code;
}

/* Takes http://HOST:PORT/v1/jobs/... apart; any other name is a file's. */
static void split_url(struct work *work)
{
	const char *volume = work->options->volume, *path = strstr(volume, "/v1/jobs/");

	if ((strncmp(volume, "http://", 7) != 0 && strncmp(volume, "https://", 8) != 0) || path == NULL)
		return;
	snprintf(work->url, sizeof(work->url), "%.*s", (int)(path - volume), volume);
	snprintf(work->path, sizeof(work->path), "%.*s", (int)strcspn(path, "?"), path);
	work->connection.url = work->url;
}

static int open_volume(struct work *work, struct error *err)
{
	int code = 0;

	if (work->http == NULL && (work->options->directory == NULL || work->path[0] != '\0'))
		code = http_new(&work->connection, &work->http, err);
	if (code == 0 && work->path[0] != '\0') {
		snprintf(work->file, sizeof(work->file), "%s/was.nii", work->directory);
		code = download(work->http, work->path, work->file, err);
	} else {
		snprintf(work->file, sizeof(work->file), "%s", work->options->volume);
	}
	if (code == 0)
		code = provenance_of_file(work->file, &work->was, &work->hu, err);
	if (code == 0 && work->was.stage[0] == '\0')
		code = error_set(err, ERR_INVALID, "%.200s does not say of which stage it is", work->file);
	return code;
}

/* The members of a job's document that are its recipe. */
static cJSON *recipe_of_job(const cJSON *job)
{
	struct recipe defaults;
	cJSON *all, *recipe = cJSON_CreateObject();
	const cJSON *member;

	recipe_defaults(&defaults);
	defaults.has_grid = true;
	all = recipe_json(&defaults);
	cJSON_ArrayForEach(member, all)
	{
		const cJSON *value = cJSON_GetObjectItemCaseSensitive(job, member->string);

		if (value != NULL)
			cJSON_AddItemToObject(recipe, member->string, cJSON_Duplicate(value, true));
	}
	cJSON_Delete(all);
	return recipe;
}

static bool fits(const cJSON *recipe, const char *digest)
{
	char text[DIGEST_TEXT_MAX];
	struct error ignored;

	return recipe != NULL && digest_recipe(recipe, text, &ignored) == 0 && strcmp(text, digest) == 0;
}

/*
 * The recipe that the file tells; where that is not the one that its digest is of, a header had no room for all of it
 * or was changed since, the one of the job, as long as the daemon has that.
 */
static int find_recipe(struct work *work, struct error *err)
{
	char path[200];
	cJSON *job = NULL, *recipe = NULL;
	struct error ignored;

	if (!fits(work->was.recipe, work->was.recipe_digest) && work->http != NULL && work->was.job[0] != '\0') {
		snprintf(path, sizeof(path), "/v1/jobs/%.100s", work->was.job);
		if (http_json(work->http, "GET", path, &job, &ignored) == 0)
			recipe = recipe_of_job(job);
		cJSON_Delete(job);
	}
	if (recipe != NULL && !fits(recipe, work->was.recipe_digest)) {
		cJSON_Delete(recipe);
		recipe = NULL;
	}
	if (recipe != NULL && work->was.recipe != NULL)
		puts("recipe: the file's is not the one that it was made with; that of its job is taken");
	work->recipe = recipe != NULL ? recipe : cJSON_Duplicate(work->was.recipe, true);
	if (work->recipe == NULL)
		return error_set(err, ERR_INVALID, "%.200s has no recipe, and its job is not there", work->file);
	return 0;
}

/* ---- once more ---- */

/* The job's document: it keeps the one volume that is to be compared. */
static cJSON *make_document(const struct work *work, const char *scan)
{
	cJSON *document = cJSON_Duplicate(work->recipe, true), *emit = cJSON_AddArrayToObject(document, "emit");
	const bool before = work->was.iteration == 0;

	cJSON_AddStringToObject(document, "scan", scan);
	if (before && strcmp(work->was.stage, "fdk") == 0)
		cJSON_AddItemToArray(emit, cJSON_CreateString("fdk"));
	else if (before)
		cJSON_AddItemToArray(emit, cJSON_CreateString("fdk-tv"));
	else
		cJSON_AddItemToArray(emit, cJSON_CreateNumber(work->was.iteration));
	return document;
}

/* The volume of that stage and iteration: "final" may be another name of it. */
static void name_of_volume(const struct work *work, char ret_name[40])
{
	if (work->was.iteration > 0)
		snprintf(ret_name, 40, "iter-%d", work->was.iteration);
	else
		snprintf(ret_name, 40, "%s", strcmp(work->was.stage, "fdk") == 0 ? "fdk" : "fdk-tv");
}

/* The signal that ends the command when the job is removed; a second one does so at once. */
static volatile sig_atomic_t interrupted;

static void note_signal(int number)
{
	interrupted = number;
}

static void catch_signals(void)
{
	/* No request is cut short: the signal is seen at the next look at the job. */
	struct sigaction action = {.sa_handler = note_signal, .sa_flags = (int)SA_RESETHAND | SA_RESTART};

	sigaction(SIGINT, &action, NULL);
	sigaction(SIGTERM, &action, NULL);
}

/* "7, 11-13" of [[7, 7], [11, 13]], cut where there is no room. */
static void print_ranges(const cJSON *ranges, char *text, size_t size)
{
	const cJSON *range;
	size_t used = 0;

	text[0] = '\0';
	cJSON_ArrayForEach(range, ranges)
	{
		const double first = cJSON_GetNumberValue(cJSON_GetArrayItem(range, 0));
		const double last = cJSON_GetNumberValue(cJSON_GetArrayItem(range, 1));
		const char *comma = used > 0 ? ", " : "";
		char one[60];

		if (last > first)
			snprintf(one, sizeof(one), "%s%.10g-%.10g", comma, first, last);
		else
			snprintf(one, sizeof(one), "%s%.10g", comma, first);
		if (used + strlen(one) + sizeof(", ...") > size) {
			snprintf(text + used, size - used, ", ...");
			return;
		}
		used += (size_t)snprintf(text + used, size - used, "%s", one);
	}
}

static int tell_missing(struct work *work, const char *scan, struct error *err)
{
	cJSON *document = NULL;
	char path[200], ranges[120];
	int code;

	snprintf(path, sizeof(path), "/v1/scans/%.100s", scan);
	code = http_json(work->http, "GET", path, &document, err);
	if (code == 0) {
		print_ranges(cJSON_GetObjectItemCaseSensitive(document, "missing"), ranges, sizeof(ranges));
		code = error_set(err, ERR_IO,
				 "projections: %s of the scan %.60s are not there, or damaged on the disk: "
				 "the volume cannot be made again",
				 ranges, scan);
	}
	cJSON_Delete(document);
	return code;
}

/* What a job waits for that nobody will send ends the watch: the scan had all of it when the volume was made. */
static int check_job(void *context, const cJSON *job, struct error *err)
{
	struct work *work = context;
	const char *scan = member_text(job, "scan", ""), *image = NULL;
	bool projections = false, checking = false;
	const cJSON *obstacle;

	cJSON_ArrayForEach(obstacle, cJSON_GetObjectItemCaseSensitive(job, "waiting_for"))
	{
		const char *what = cJSON_GetStringValue(obstacle);

		if (what == NULL)
			continue;
		projections = projections || strcmp(what, "projections") == 0;
		checking = checking || strcmp(what, "check") == 0;
		for (int i = 0; i < IMAGE_COUNT; i++)
			image = strcmp(what, image_kinds[i].name) == 0 ? image_kinds[i].title : image;
		image = strcmp(what, "scatter") == 0 ? "scatter images" : image;
	}
	work->given_up = interrupted != 0 || (!checking && (projections || image != NULL));
	if (interrupted != 0)
		return error_set(err, ERR_CANCELLED, "interrupted");
	if (!work->given_up)
		return 0;
	if (projections)
		return tell_missing(work, scan, err);
	return error_set(err, ERR_IO,
			 "%s: of the scan %.60s not there, or damaged on the disk: the volume cannot be made again",
			 image, scan);
}

/* Once to cancel it, where it has not ended, and once to remove it. */
static void remove_job(const struct work *work)
{
	static const char *const waits[] = {"?wait=10", ""};
	bool gone = false;
	int code = 0;

	for (int i = 0; i < 2 && code == 0 && !gone; i++) {
		cJSON *document = NULL;
		struct error err;
		char path[200];

		snprintf(path, sizeof(path), "/v1/jobs/%.100s%s", work->job, waits[i]);
		code = http_json(work->http, "DELETE", path, &document, &err);
		gone = code == 0 && document == NULL;
		cJSON_Delete(document);
		if (code != 0)
			fprintf(stderr, "the job %s is left on the daemon: %s\n", work->job, err.text);
	}
}

static int make_on_daemon(struct work *work, struct error *err)
{
	const char *scan = work->options->scan != NULL ? work->options->scan : work->was.scan;
	char path[300], name[40];
	cJSON *document, *labels, *job = NULL;
	int code;

	if (scan[0] == '\0')
		return error_set(err, ERR_USAGE, "%.200s names no scan: --scan or --from must", work->file);
	document = make_document(work, scan);
	labels = cJSON_AddObjectToObject(document, "labels");
	cJSON_AddStringToObject(labels, "reproduces", work->was.job[0] != '\0' ? work->was.job : "file");
	catch_signals();
	code = http_post(work->http, "/v1/jobs", document, NULL, &job, err);
	cJSON_Delete(document);
	if (code == 0) {
		snprintf(work->job, sizeof(work->job), "%s", member_text(job, "id", ""));
		code = watch_job(work->http, work->job, stderr, check_job, work, err);
	}
	cJSON_Delete(job);
	if (code != 0)
		return code;
	name_of_volume(work, name);
	snprintf(work->again, sizeof(work->again), "%s/again.nii", work->directory);
	snprintf(path, sizeof(path), "/v1/jobs/%.100s/volumes/%s?type=%s", work->job, name,
		 volume_type_names[work->hu ? VOLUME_INT16 : VOLUME_FLOAT32]);
	return download(work->http, path, work->again, err);
}

static int make_from_directory(struct work *work, struct error *err)
{
	char recipe[PATH_BYTES], name[40];
	const char *arguments[] = {
	    "/proc/self/exe", "recon", work->options->directory, recipe, "--output", work->directory, "--quiet", NULL};
	cJSON *document = make_document(work, "directory");
	size_t length = 0;
	char *text = json_print(document, &length);
	int code = text == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a recipe") : 0;

	name_of_volume(work, name);
	snprintf(recipe, sizeof(recipe), "%s/recipe.json", work->directory);
	snprintf(work->again, sizeof(work->again), "%s/%s.nii", work->directory, name);
	if (code == 0)
		code = file_write_durable(recipe, text, length, err);
	if (code == 0)
		code = tool_run(arguments, "cbctd", NULL, NULL, err);
	cJSON_Delete(document);
	free(text);
	return code;
}

/* ---- comparing ---- */

/* The version alone: the daemon's worker and `cbct recon` compute the same. */
static const char *version_of(const char *program)
{
	const char *blank = strrchr(program, ' ');

	return blank != NULL ? blank + 1 : program;
}

/* Tells what both say and say otherwise. */
static void tell_difference(const char *what, const char *was, const char *is)
{
	if (was[0] != '\0' && is[0] != '\0' && strcmp(was, is) != 0)
		printf("%s: was %s, is %s\n", what, was, is);
}

/* Tells what the volume was made with and what it was made with now, where that is not the same; true if devices are
 * not. */
static bool tell_differences(const struct work *work)
{
	const struct provenance *was = &work->was, *is = &work->is;
	char what[64];

	tell_difference("version", version_of(was->program), version_of(is->program));
	tell_difference("commit", was->commit, is->commit);
	tell_difference("scan", was->scan_digest, is->scan_digest);
	tell_difference("projections", was->projections_digest, is->projections_digest);
	for (int i = 0; i < IMAGE_COUNT; i++) {
		const bool one = was->projections_digest[0] != '\0' && is->projections_digest[0] != '\0';
		const char *none = one ? "none" : "";

		snprintf(what, sizeof(what), "%s", image_kinds[i].title);
		tell_difference(what, was->image_digest[i][0] != '\0' ? was->image_digest[i] : none,
				is->image_digest[i][0] != '\0' ? is->image_digest[i] : none);
	}
	tell_difference("recipe", was->recipe_digest, is->recipe_digest);
	tell_difference("backend", was->backend, is->backend);
	tell_difference("device", was->device, is->device);
	return strcmp(was->backend, is->backend) != 0 || strcmp(was->device, is->device) != 0;
}

static int tell_result(const struct work *work, const float *was, const float *is, size_t count, struct error *err)
{
	const double water = member_number(work->recipe, "mu_water", 0.0192), scale = work->hu ? 1 : 1000 / water;
	double square = 0, most = 0;
	size_t other = 0;
	bool device;

	for (size_t i = 0; i < count; i++) {
		const double d = scale * ((double)is[i] - (double)was[i]);

		other += memcmp(&was[i], &is[i], sizeof(*was)) != 0;
		square += d * d;
		most = fabs(d) > most ? fabs(d) : most;
	}
	device = tell_differences(work);
	if (other == 0) {
		printf("the same bits: %zu voxels\n", count);
		return 0;
	}
	square = sqrt(square / (double)count);
	printf("not the same bits: %zu of %zu voxels, %.4g HU RMS, at most %.4g HU\n", other, count, square, most);
	if (device)
		printf("another device rounds otherwise, by up to %g HU RMS: this is %s that\n", PRECISION_HU,
		       square <= PRECISION_HU ? "within" : "beyond");
	return error_set(err, ERR_IO, "the volume is not the same");
}

/*
 * Voxels elsewhere, or on another side, are another volume whatever their bits. Files keep places as float32 or in
 * decimals. Where one of both does not know how the patient lies, their axes may be other ones.
 */
static int compare_places(const struct work *work, const struct grid grid[2], double axes[2][3][3], struct error *err)
{
	const struct patient *was = &work->was.patient, *is = &work->is.patient;
	const double part = 1e-4; /* of a voxel */

	for (int i = 0; i < 3; i++) {
		const double voxel = grid[1].spacing[i];

		if (fabs(grid[0].spacing[i] - voxel) * grid[1].size[i] > part * voxel)
			return error_set(err, ERR_IO, "voxels: were %g mm wide along axis %d, are %g",
					 grid[0].spacing[i], i, voxel);
	}
	if (was->known && is->known && !patient_same(was, is))
		return error_set(err, ERR_IO, "patient: lies otherwise in the file than in the scan");
	for (int i = 0; i < 3 && patient_same(was, is); i++) {
		if (fabs(grid[0].origin[i] - grid[1].origin[i]) > part * grid[1].spacing[i])
			return error_set(err, ERR_IO, "place: the first voxel was at %g mm along axis %d, is at %g",
					 grid[0].origin[i], i, grid[1].origin[i]);
		for (int j = 0; j < 3; j++)
			if (fabs(axes[0][i][j] - axes[1][i][j]) * grid[1].size[i] > part)
				return error_set(err, ERR_IO, "axis %d is turned", i);
	}
	return 0;
}

static int compare(struct work *work, struct error *err)
{
	struct grid grid[2] = {0};
	double axes[2][3][3];
	float *voxels[2] = {NULL, NULL};
	bool hu = false;
	int code = provenance_of_file(work->again, &work->is, &hu, err);

	if (code == 0)
		code = volume_read(work->file, &grid[0], axes[0], &voxels[0], err);
	if (code == 0)
		code = volume_read(work->again, &grid[1], axes[1], &voxels[1], err);
	if (code == 0 && memcmp(grid[0].size, grid[1].size, sizeof(grid[0].size)) != 0)
		code = error_set(err, ERR_INVALID,
				 "%d x %d x %d voxels, made again it has %d x %d x %d: it was scaled, or a part was "
				 "cut out",
				 grid[0].size[0], grid[0].size[1], grid[0].size[2], grid[1].size[0], grid[1].size[1],
				 grid[1].size[2]);
	if (code == 0)
		code = compare_places(work, grid, axes, err);
	/* From a directory the volume is always in 1/mm. */
	if (code == 0 && work->hu && !hu) {
		const size_t count = grid_voxels(&grid[1]);
		int16_t *units = malloc(count * sizeof(*units));

		if (units == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", count);
		for (size_t i = 0; i < count && code == 0; i++) {
			volume_to_hu(&voxels[1][i], 1, member_number(work->recipe, "mu_water", 0.0192), &units[i]);
			voxels[1][i] = units[i];
		}
		free(units);
	}
	if (code == 0)
		code = tell_result(work, voxels[0], voxels[1], grid_voxels(&grid[0]), err);
	free(voxels[0]);
	free(voxels[1]);
	return code;
}

/* ---- the command ---- */

static void remove_files(const struct work *work)
{
	static const char *const names[] = {"was.nii",   "again.nii", "recipe.json",
					    "final.nii", "fdk.nii",   "fdk-tv.nii"};
	char path[PATH_BYTES];

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
		snprintf(path, sizeof(path), "%s/%s", work->directory, names[i]);
		unlink(path);
	}
	if (work->options->directory != NULL)
		unlink(work->again);
	rmdir(work->directory);
}

static int reproduce_run(const void *values, struct error *err)
{
	struct work work = {.options = values, .connection = ((const struct reproduce_options *)values)->http};
	const char *folder = getenv("TMPDIR");
	int code;

	snprintf(work.directory, sizeof(work.directory), "%.1000s/cbct-reproduce-XXXXXX",
		 folder != NULL ? folder : "/tmp");
	if (mkdtemp(work.directory) == NULL)
		return error_set_errno(err, errno, "%s", work.directory);
	split_url(&work);
	code = open_volume(&work, err);
	if (code == 0)
		code = find_recipe(&work, err);
	if (code == 0)
		code = work.options->directory != NULL ? make_from_directory(&work, err) : make_on_daemon(&work, err);
	if (code == 0)
		code = compare(&work, err);
	if (work.job[0] != '\0' && (!work.options->keep || work.given_up))
		remove_job(&work);
	else if (work.job[0] != '\0')
		printf("job %s\n", work.job);
	remove_files(&work);
	http_free(work.http);
	cJSON_Delete(work.recipe);
	provenance_clear(&work.was);
	provenance_clear(&work.is);
	if (interrupted != 0) {
		fflush(stdout);
		raise(interrupted);
	}
	return code;
}

static const struct reproduce_options defaults;
static const struct positional positionals[] = {
    {"VOLUME", "a volume's file (NIfTI, MetaImage, NRRD), or its URL, http://HOST:PORT/v1/jobs/JOB/volumes/NAME",
     offsetof(struct reproduce_options, volume), true},
    {0},
};

const struct command command_reproduce = {
    "reproduce",  "makes a volume again and compares bits", positionals, groups, &defaults, sizeof(defaults),
    reproduce_run};

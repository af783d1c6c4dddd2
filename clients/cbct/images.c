/*
 * Series of images: see images.h. A folder may have a thousand files: each is
 * opened once to see what it holds, and once more when its turn comes, so that
 * one at a time is open.
 */
#include "clients/cbct/images.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <fnmatch.h>
#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clients/cbct/http.h"
#include "proto/scan_directory.h"

const struct option image_option_rows[] = {
    {"pattern", 0, OPTION_TEXT, offsetof(struct image_options, pattern), "GLOB",
     "which files of a folder, e.g. 'proj_*.tif' (default: all that are images)", 0, 0, 0, NULL},
    {"size", 0, OPTION_NUMBERS, offsetof(struct image_options, size), "COLUMNS,ROWS", "of raw images", 1, DETECTOR_MAX,
     2, NULL},
    {"type", 0, OPTION_CHOICE, offsetof(struct image_options, type), "TYPE", "of the numbers in raw images", 0, 0,
     PIXEL_TYPE_COUNT, pixel_type_names},
    {"big-endian", 0, OPTION_FLAG, offsetof(struct image_options, big_endian), NULL, "raw images: high byte first", 0,
     0, 0, NULL},
    {"header", 0, OPTION_INTEGER, offsetof(struct image_options, header), "BYTES",
     "before the first image of a raw file", 0, 1e15, 0, NULL},
    {"flip-columns", 0, OPTION_FLAG, offsetof(struct image_options, flip_columns), NULL,
     "mirror each image from left to right", 0, 0, 0, NULL},
    {"flip-rows", 0, OPTION_FLAG, offsetof(struct image_options, flip_rows), NULL,
     "mirror each image from top to bottom: for files whose first row is the highest", 0, 0, 0, NULL},
    {"inverted", 0, OPTION_FLAG, offsetof(struct image_options, inverted), NULL,
     "pixels of 8 or 16 bits that fall with the beam, as Elekta's .his: 255 or 65535 less each", 0, 0, 0, NULL},
    {0},
};

/* Raw is the last: nothing tells it. */
static const struct image_format *const formats[] = {&image_metaimage, &image_tiff,   &image_npy, &image_dicom,
						     &image_his,       &image_hnd,    &image_xim, &image_hdf5,
						     &image_txrm,      &image_xtekct, &image_raw};
enum { FORMAT_COUNT = sizeof(formats) / sizeof(formats[0]), FORMAT_RAW = FORMAT_COUNT - 1 };

struct entry {
	char *path;
	int first; /* its first image's number in the series */
};

struct images_files {
	struct entry *entries;
	int count, room;
	const struct image_options *options;
	struct image_file open;
	int open_entry; /* -1: none */
};

/* ---- one file ---- */

static int format_of(const char *path, int *ret_format, struct error *err)
{
	unsigned char head[IMAGE_HEAD] = {0};
	struct stat status;
	int file = open(path, O_RDONLY | O_CLOEXEC), code = 0;
	ssize_t got;

	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	if (fstat(file, &status) == 0 && !S_ISREG(status.st_mode)) {
		close(file);
		return error_set(err, ERR_INVALID, "%.200s is no file", path);
	}
	got = pread(file, head, sizeof(head), 0);
	if (got < 0)
		code = error_set_errno(err, errno, "%s cannot be read", path);
	close(file);
	*ret_format = FORMAT_RAW;
	for (int i = 0; i < FORMAT_RAW && code == 0; i++)
		if (formats[i]->recognise(head, (size_t)got)) {
			*ret_format = i;
			break;
		}
	return code;
}

static void file_close(struct image_file *file)
{
	if (file->format != NULL)
		file->format->close(file);
	free(file->positions);
	free(file->circle.degrees);
	memset(file, 0, sizeof(*file));
}

static int file_check(const struct image_file *file, struct error *err)
{
	if (file->columns < 1 || file->columns > DETECTOR_MAX || file->rows < 1 || file->rows > DETECTOR_MAX)
		return error_set(err, ERR_IMPOSSIBLE, "images of %d x %d pixels, 1 to %d are expected on each side",
				 file->columns, file->rows, DETECTOR_MAX);
	if (file->count < 1 || file->count > VIEWS_MAX)
		return error_set(err, ERR_IMPOSSIBLE, "%d images, 1 to %d are expected", file->count, VIEWS_MAX);
	return 0;
}

/* The text of an error behind the file that it is about, unless the text names it. */
static int about(const char *path, int code, struct error *err)
{
	char text[sizeof(err->text)];
	const char *slash = strrchr(path, '/'), *name = slash != NULL ? slash + 1 : path;

	if (strstr(err->text, name) != NULL)
		return code;
	snprintf(text, sizeof(text), "%s", err->text);
	return error_set(err, code, "%.100s: %s", name, text);
}

static int file_open(struct image_file *ret, const char *path, const struct image_options *options, struct error *err)
{
	int format = 0, code = format_of(path, &format, err);

	if (code != 0)
		return code;
	*ret = (struct image_file){.format = formats[format],
				   .pixel = {OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER},
				   .intensity = "",
				   .circle = IMAGE_CIRCLE_UNKNOWN};
	code = ret->format->open(ret, path, options, err);
	if (code == 0)
		code = file_check(ret, err);
	if (code != 0) {
		file_close(ret);
		return about(path, code, err);
	}
	return 0;
}

/* ---- the list of files ---- */

static int add_entry(struct images_files *files, const char *directory, const char *name, struct error *err)
{
	char path[PATH_MAX];

	if (files->count == files->room) {
		int room = files->room > 0 ? 2 * files->room : 64;
		void *grown = realloc(files->entries, (size_t)room * sizeof(*files->entries));

		if (grown == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for %d files", room);
		files->entries = grown;
		files->room = room;
	}
	if (snprintf(path, sizeof(path), "%s%s%s", name[0] == '/' ? "" : directory, name[0] == '/' ? "" : "/", name) >=
	    (int)sizeof(path))
		return error_set(err, ERR_INVALID, "the path of %.60s is too long", name);
	files->entries[files->count].path = strdup(path);
	if (files->entries[files->count].path == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a path");
	files->count++;
	return 0;
}

static bool has_extension(const char *path, const char *const *extensions)
{
	const char *dot = strrchr(path, '.');

	for (; dot != NULL && *extensions != NULL; extensions++)
		if (strcasecmp(dot, *extensions) == 0)
			return true;
	return false;
}

/* In a folder of several kinds, files with a header are meant: .mhd and not the .raw beside it, no notes, no lists. */
static int keep_one_format(struct images_files *files, const char *path, struct error *err)
{
	static const char *const raw_names[] = {".raw", ".bin", ".img", ".dat", ".f32", ".u16", NULL};
	int of[FORMAT_COUNT] = {0}, kept = 0, chosen = -1, *format;

	format = calloc((size_t)files->count + 1, sizeof(*format));
	if (format == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d files", files->count);
	for (int i = 0; i < files->count; i++) {
		int code = format_of(files->entries[i].path, &format[i], err);

		if (code != 0) {
			free(format);
			return code;
		}
		if (format[i] == FORMAT_RAW && !has_extension(files->entries[i].path, raw_names))
			format[i] = -1;
		else
			of[format[i]]++;
	}
	for (int i = 0; i < FORMAT_RAW; i++) {
		if (of[i] > 0 && chosen >= 0) {
			free(format);
			return error_set(err, ERR_INVALID, "%.120s has both %s and %s files: --pattern chooses", path,
					 formats[chosen]->name, formats[i]->name);
		}
		if (of[i] > 0)
			chosen = i;
	}
	if (chosen < 0 && of[FORMAT_RAW] > 0)
		chosen = FORMAT_RAW;
	for (int i = 0; i < files->count; i++) {
		if (format[i] == chosen && chosen >= 0)
			files->entries[kept++] = files->entries[i];
		else
			free(files->entries[i].path);
	}
	if (kept < files->count && kept > 0)
		fprintf(stderr, "note: %d of %d files in %s are no %s images and passed over\n", files->count - kept,
			files->count, path, formats[chosen]->name);
	files->count = kept;
	free(format);
	return 0;
}

static int list_folder(struct images_files *files, const char *path, struct error *err)
{
	struct dirent **names = NULL;
	/* Numbers in names count as numbers: 9 before 10. */
	int count = scandir(path, &names, NULL, versionsort), code = 0;
	const char *pattern = files->options->pattern;

	if (count < 0)
		return error_set_errno(err, errno, "%s", path);
	for (int i = 0; i < count; i++) {
		struct stat status;
		char whole[PATH_MAX];
		const char *name = names[i]->d_name;

		snprintf(whole, sizeof(whole), "%s/%s", path, name);
		if (code == 0 && name[0] != '.' && stat(whole, &status) == 0 && S_ISREG(status.st_mode) &&
		    (pattern == NULL || fnmatch(pattern, name, 0) == 0))
			code = add_entry(files, path, name, err);
		free(names[i]);
	}
	free(names);
	if (code == 0 && pattern == NULL)
		code = keep_one_format(files, path, err);
	if (code == 0 && files->count == 0)
		code = error_set(err, ERR_NOT_FOUND, "%.160s has no images%s%.60s", path,
				 pattern != NULL ? " like " : "", pattern != NULL ? pattern : "");
	return code;
}

static int list_names(struct images_files *files, const char *path, struct error *err)
{
	enum { LIST_BYTES = 16 << 20 };
	const char *slash = strrchr(path, '/');
	char directory[PATH_MAX], *text = NULL, *line, *rest;
	size_t length;
	int code = file_read(path, LIST_BYTES, &text, &length, err);

	snprintf(directory, sizeof(directory), "%.*s", slash != NULL ? (int)(slash - path) : 1,
		 slash != NULL ? path : ".");
	rest = text;
	while (code == 0 && (line = strsep(&rest, "\n")) != NULL) {
		line[strcspn(line, "\r")] = '\0';
		if (line[0] != '\0' && line[0] != '#')
			code = add_entry(files, directory, line, err);
	}
	free(text);
	if (code == 0 && files->count == 0)
		code = error_set(err, ERR_INVALID, "%.200s names no images", path);
	return code;
}

static int list_files(struct images_files *files, const char *path, struct error *err)
{
	static const char *const lists[] = {".txt", ".lst", NULL};
	struct stat status;

	if (stat(path, &status) != 0)
		return error_set_errno(err, errno, "%s", path);
	if (S_ISDIR(status.st_mode))
		return list_folder(files, path, err);
	if (has_extension(path, lists))
		return list_names(files, path, err);
	return add_entry(files, path[0] == '/' ? "" : ".", path, err);
}

/* ---- the series ---- */

static int same_as_first(const struct images *images, const struct image_file *file, const char *path,
			 struct error *err)
{
	if (file->columns != images->columns || file->rows != images->rows)
		return error_set(err, ERR_INVALID, "%.120s: images of %d x %d pixels, the first has %d x %d", path,
				 file->columns, file->rows, images->columns, images->rows);
	if (file->type != images->type)
		return error_set(err, ERR_INVALID, "%.120s: images of %s, the first is %s", path,
				 pixel_type_names[file->type], pixel_type_names[images->type]);
	if ((file->positions != NULL) != (images->positions != NULL))
		return error_set(err, ERR_INVALID, "%.120s: another kind of file than the first", path);
	for (int i = 0; i <= STUDY_UID; i++)
		if (strcmp(file->subject.text[i], images->subject.text[i]) != 0)
			return error_set(err, ERR_INVALID, "%.120s: its %s's %s is another than the first's", path,
					 subject_rows[i].object, subject_rows[i].name);
	return 0;
}

static int add_positions(struct images *images, const struct image_file *file, struct error *err)
{
	size_t total = (size_t)images->count + (size_t)file->count;
	void *grown;

	if (file->positions == NULL)
		return 0;
	grown = realloc(images->positions, total * sizeof(*images->positions));
	if (grown == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu positions", total);
	images->positions = grown;
	memcpy(images->positions + images->count, file->positions, (size_t)file->count * sizeof(*file->positions));
	return 0;
}

/* Objects of several series, or of none, are referenced by nothing. */
static int add_source(struct images *images, const struct image_file *file, int entry, struct error *err)
{
	const struct image_source *source = &file->source;
	const bool told = source->class[0] != '\0' && source->series[0] != '\0' && source->instance[0] != '\0';
	cJSON *one;

	if (entry == 0 && told) {
		images->source = cJSON_CreateObject();
		cJSON_AddStringToObject(images->source, "class", source->class);
		cJSON_AddStringToObject(images->source, "series", source->series);
		cJSON_AddArrayToObject(images->source, "instances");
	}
	if (images->source == NULL)
		return 0;
	if (!told || strcmp(member_text(images->source, "class", ""), source->class) != 0 ||
	    strcmp(member_text(images->source, "series", ""), source->series) != 0) {
		cJSON_Delete(images->source);
		images->source = NULL;
		return 0;
	}
	one = cJSON_CreateString(source->instance);
	return cJSON_AddItemToArray(cJSON_GetObjectItemCaseSensitive(images->source, "instances"), one)
		   ? 0
		   : error_set(err, ERR_NO_MEMORY, "no memory for an object's UID");
}

static int open_entry(struct images *images, int entry, struct error *err)
{
	struct images_files *files = images->files;
	int code;

	file_close(&files->open);
	files->open_entry = -1;
	code = file_open(&files->open, files->entries[entry].path, files->options, err);
	if (code == 0)
		files->open_entry = entry;
	return code;
}

static int look_into(struct images *images, int entry, struct error *err)
{
	struct images_files *files = images->files;
	const struct image_file *file = &files->open;
	int code = open_entry(images, entry, err);

	if (code != 0)
		return code;
	if (entry == 0) {
		images->columns = file->columns;
		images->rows = file->rows;
		images->type = file->type;
		images->has_stack = file->has_stack;
		images->stack = file->stack;
		images->intensity = file->intensity;
		images->subject = file->subject;
		if (files->count == 1) {
			images->circle = file->circle;
			files->open.circle.degrees = NULL; /* the series has them now */
		}
		images->flip_columns = files->options->flip_columns;
		images->flip_rows = files->options->flip_rows;
		memcpy(images->pixel, file->pixel, sizeof(images->pixel));
	} else {
		code = same_as_first(images, file, files->entries[entry].path, err);
	}
	if (code == 0)
		code = add_positions(images, file, err);
	if (code == 0)
		code = add_source(images, file, entry, err);
	if (code == 0 && images->count + file->count > VIEWS_MAX)
		code = error_set(err, ERR_IMPOSSIBLE, "more than %d images", VIEWS_MAX);
	files->entries[entry].first = images->count;
	images->count += file->count;
	return code;
}

int images_open(const char *path, const struct image_options *options, struct images **ret_images, struct error *err)
{
	struct images *images = calloc(1, sizeof(*images));
	int code;

	if (images != NULL)
		images->files = calloc(1, sizeof(*images->files));
	if (images == NULL || images->files == NULL) {
		free(images);
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of images");
	}
	images->files->options = options;
	images->files->open_entry = -1;
	code = list_files(images->files, path, err);
	for (int i = 0; i < images->files->count && code == 0; i++)
		code = look_into(images, i, err);
	if (code != 0) {
		images_free(images);
		return code;
	}
	*ret_images = images;
	return 0;
}

void images_free(struct images *images)
{
	if (images == NULL)
		return;
	file_close(&images->files->open);
	for (int i = 0; i < images->files->count; i++)
		free(images->files->entries[i].path);
	free(images->files->entries);
	free(images->files);
	free(images->positions);
	free(images->circle.degrees);
	cJSON_Delete(images->source);
	free(images);
}

static void swap(float *a, float *b, size_t count)
{
	for (size_t i = 0; i < count; i++) {
		float kept = a[i];

		a[i] = b[i];
		b[i] = kept;
	}
}

static void mirror(const struct images *images, float *pixels)
{
	size_t columns = (size_t)images->columns, rows = (size_t)images->rows;

	if (images->files->options->flip_rows)
		for (size_t r = 0; r < rows / 2; r++)
			swap(pixels + r * columns, pixels + (rows - 1 - r) * columns, columns);
	if (images->files->options->flip_columns)
		for (size_t r = 0; r < rows; r++)
			for (size_t c = 0; c < columns / 2; c++)
				swap(pixels + r * columns + c, pixels + r * columns + columns - 1 - c, 1);
}

static int invert(const struct images *images, float *pixels, struct error *err)
{
	const size_t count = (size_t)images->columns * (size_t)images->rows;
	const float most = images->type == PIXEL_UINT8 ? 255.0f : 65535.0f;

	if (images->type != PIXEL_UINT8 && images->type != PIXEL_UINT16)
		return error_set(err, ERR_USAGE, "--inverted is about uint8 and uint16, these are %s",
				 pixel_type_names[images->type]);
	for (size_t i = 0; i < count; i++)
		pixels[i] = most - pixels[i];
	return 0;
}

int images_read(struct images *images, int index, float *ret_pixels, struct error *err)
{
	struct images_files *files = images->files;
	int entry = files->open_entry >= 0 ? files->open_entry : 0, code = 0;

	while (entry > 0 && files->entries[entry].first > index)
		entry--;
	while (entry + 1 < files->count && files->entries[entry + 1].first <= index)
		entry++;
	if (entry != files->open_entry)
		code = open_entry(images, entry, err);
	if (code == 0)
		code = files->open.format->read(&files->open, index - files->entries[entry].first, ret_pixels, err);
	if (code != 0)
		return about(files->entries[entry].path, code, err);
	if (files->options->inverted)
		code = invert(images, ret_pixels, err);
	mirror(images, ret_pixels);
	return code;
}

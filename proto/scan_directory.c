/*
 * Scan directories. Whatever a path names is there whole or not at all: it is
 * written beside it, synced, renamed, and the directory synced; every return
 * value on that way counts.
 */
#include "proto/scan_directory.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/correct/stuck.h"
#include "proto/durable.h"
#include "proto/format.h"
#include "proto/nifti.h"
#include "proto/regular.h"
#include "proto/saver.h"
#include "proto/sums.h"

/* ---- files ---- */

int file_read_at(int file, void *ret_to, size_t size, size_t offset, const char *path, struct error *err)
{
	bool again = false;

	for (size_t done = 0; done < size;) {
		ssize_t got = pread(file, (char *)ret_to + done, size - done, (off_t)(offset + done));

		if (got < 0 && errno == EINTR)
			continue;
		/* A link that was reset fails one read. What cannot be read is given up as damaged, so it is tried
		 * twice. */
		if (got < 0 && errno == EIO && !again) {
			again = true;
			continue;
		}
		if (got < 0)
			return error_set_errno(err, errno, "%s cannot be read", path);
		if (got == 0)
			return error_set(err, ERR_IO, "%.200s ends at byte %zu, %zu are expected", path, offset + done,
					 offset + size);
		done += (size_t)got;
	}
	return 0;
}

int file_read(const char *path, size_t most, char **ret_text, size_t *ret_length, struct error *err)
{
	int file = open(path, O_RDONLY | O_CLOEXEC), code = 0;
	struct stat status;
	char *text = NULL;

	if (file < 0 && errno == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "%.200s does not exist", path);
	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	if (fstat(file, &status) != 0) {
		code = error_set_errno(err, errno, "%s cannot be read", path);
		goto out;
	}
	if ((size_t)status.st_size > most) {
		code = error_set(err, ERR_TOO_LARGE, "%.200s: %zu bytes, at most %zu are expected", path,
				 (size_t)status.st_size, most);
		goto out;
	}
	text = malloc((size_t)status.st_size + 1);
	if (text == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for the %zu bytes of %.200s", (size_t)status.st_size,
				 path);
		goto out;
	}
	code = file_read_at(file, text, (size_t)status.st_size, 0, path, err);
	if (code == 0) {
		text[status.st_size] = '\0';
		*ret_text = text;
		*ret_length = (size_t)status.st_size;
		text = NULL;
	}
out:
	free(text);
	close(file);
	return code;
}

int file_write_durable(const char *path, const void *data, size_t length, struct error *err)
{
	struct durable d;
	int code = durable_open(&d, path, length, err);

	if (code != 0)
		return code;
	code = durable_write(&d, data, length, err);
	if (code != 0) {
		durable_abandon(&d);
		return code;
	}
	return durable_commit(&d, err);
}

/* ---- a scan directory ---- */

int path_join(char *ret_path, size_t size, const char *directory, const char *name, const char *extension,
	      struct error *err)
{
	if (snprintf(ret_path, size, "%s/%s%s", directory, name, extension) >= (int)size)
		return error_set(err, ERR_INVALID, "the path of %s in %.200s is too long", name, directory);
	return 0;
}

/* *ret_sums -1: there is none. */
static int open_sums(const char *directory, int *ret_sums, struct error *err)
{
	struct error why;
	bool whole;
	int code = sums_open(directory, false, 0, 0, ret_sums, &whole, &why);

	if (code == ERR_NOT_FOUND) {
		*ret_sums = -1;
		return 0;
	}
	if (code != 0)
		*err = why;
	return code;
}

/* A whole file against its record; bytes NULL: there is no such file. */
static int check_part(int sums, enum sums_part part, const char *name, const void *bytes, size_t size,
		      struct error *err)
{
	unsigned char state = SUM_NONE;
	struct sum sum;
	int code = sums < 0 ? 0 : sums_get(sums, part, 1, 0, &sum, &state, err);

	if (sums < 0 || code != 0 || (state == SUM_NONE && bytes == NULL))
		return code;
	if (state == SUM_GOOD && !sum.lost && bytes != NULL && sum.bytes == size && sum.crc == checksum(0, bytes, size))
		return 0;
	return error_set(err, ERR_DAMAGED, "%s of the scan is damaged: it does not fit its record in %s", name,
			 SUMS_FILE);
}

static int read_scan(const char *directory, int sums, struct scan **ret_scan, struct error *err)
{
	char path[PATH_MAX], *text = NULL;
	size_t length = 0;
	int code = path_join(path, sizeof(path), directory, "scan.json", "", err);

	if (code == 0)
		code = file_read(path, JSON_BYTES_MAX, &text, &length, err);
	if (code == 0)
		code = check_part(sums, SUMS_SCAN, "scan.json", text, length, err);
	if (code == 0)
		code = scan_parse(text, length, ret_scan, err);
	free(text);
	return code;
}

static int open_projections(const char *directory, const struct scan *scan, int *ret_file, struct error *err)
{
	size_t expected = scan_projection_bytes(scan) * (size_t)scan->count;
	char path[PATH_MAX];
	struct stat status;
	int code = path_join(path, sizeof(path), directory, "projections.raw", "", err), file;

	if (code != 0)
		return code;
	file = regular_open(path, O_RDONLY, 0);
	if (file < 0 && errno == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "%.200s does not exist", path);
	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	if (fstat(file, &status) != 0)
		code = error_set_errno(err, errno, "%s cannot be read", path);
	else if ((size_t)status.st_size != expected)
		code = error_set(err, ERR_INVALID, "%.150s: %zu bytes, but %d projections of %d x %d %s have %zu", path,
				 (size_t)status.st_size, scan->count, scan->geometry.columns, scan->geometry.rows,
				 sample_names[scan->sample], expected);
	if (code != 0)
		close(file);
	else
		*ret_file = file;
	return code;
}

/* An image of so many bytes; *ret_image stays NULL where there is none. */
static int read_image(const char *directory, const char *name, size_t expected, void **ret_image, struct error *err)
{
	size_t length = 0;
	char path[PATH_MAX], *bytes = NULL;
	int code = path_join(path, sizeof(path), directory, name, "", err);

	if (code != 0)
		return code;
	code = file_read(path, expected, &bytes, &length, err);
	if (code == ERR_NOT_FOUND)
		return 0;
	if (code == 0 && length != expected) {
		free(bytes);
		return error_set(err, ERR_INVALID, "%.200s: %zu bytes, %zu are expected", path, length, expected);
	}
	if (code == 0)
		*ret_image = bytes; /* malloc's alignment suits any type */
	return code;
}

static int read_images(const char *directory, struct scan_files *files, struct error *err)
{
	const struct geometry *geometry = &files->scan->geometry;
	int code = 0;

	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		const struct image_kind *kind = &image_kinds[i];
		const size_t bytes = image_bytes(i, geometry->columns, geometry->rows);

		code = read_image(directory, kind->file, bytes, &files->image[i], err);
		if (code == 0)
			code = check_part(files->sums, kind->slot, kind->file, files->image[i], bytes, err);
	}
	return code;
}

/* Beside records of what they held, files that are gone or have another size were damaged since. */
static int damaged_since(const struct scan_files *files, int code, struct error *err)
{
	char text[sizeof(err->text)];

	if (files->sums < 0 || (code != ERR_NOT_FOUND && code != ERR_INVALID))
		return code;
	snprintf(text, sizeof(text), "%s", err->text);
	return error_set(err, ERR_DAMAGED, "%s", text);
}

int scan_files_open(const char *directory, struct scan_files *ret_files, struct error *err)
{
	struct scan_files files = {.projections = -1, .sums = -1};
	int code = open_sums(directory, &files.sums, err);

	if (code == 0)
		code = damaged_since(&files, read_scan(directory, files.sums, &files.scan, err), err);
	if (code == 0)
		code = damaged_since(&files, open_projections(directory, files.scan, &files.projections, err), err);
	if (code == 0)
		code = damaged_since(&files, read_images(directory, &files, err), err);
	if (code != 0)
		scan_files_close(&files);
	else
		*ret_files = files;
	return code;
}

void scan_files_close(struct scan_files *files)
{
	if (files == NULL)
		return;
	scan_free(files->scan);
	if (files->projections >= 0)
		close(files->projections);
	if (files->sums >= 0)
		close(files->sums);
	for (int i = 0; i < IMAGE_COUNT; i++)
		free(files->image[i]);
	*files = (struct scan_files){.projections = -1, .sums = -1};
}

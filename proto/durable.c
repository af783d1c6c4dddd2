/*
 * Files that are there whole or not at all: durable.h. Every return value on
 * that way counts.
 */
#include "proto/durable.h"
#include "proto/regular.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/pulse.h"

enum { PIECE_BYTES = 4 << 20 }; /* written back in one go */

int durable_sync_names(const char *path, struct error *err)
{
	char directory[PATH_MAX];
	const char *slash = strrchr(path, '/');
	int file, code = 0;

	snprintf(directory, sizeof(directory), "%.*s", slash == NULL ? 1 : (int)(slash - path) + 1,
		 slash == NULL ? "." : path);
	file = open(directory, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", directory);
	if (fsync(file) != 0)
		code = error_set_sync(err, errno, "%s cannot be synced", directory);
	close(file);
	return code;
}

int durable_open(struct durable *ret, const char *path, size_t size, struct error *err)
{
	struct durable d = {.path = path};
	int code;

	if (snprintf(d.beside, sizeof(d.beside), "%s.tmp", path) >= (int)sizeof(d.beside))
		return error_set(err, ERR_INVALID, "a path of %zu bytes is too long", strlen(path));
	d.file = open(d.beside, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0640);
	if (d.file < 0)
		return error_set_errno(err, errno, "%s cannot be created", d.beside);
	/* File systems that cannot set space aside say so; the writes will then tell. */
	if (size > 0 && fallocate(d.file, 0, 0, (off_t)size) != 0 && errno != EOPNOTSUPP && errno != EINTR) {
		code = error_set_errno(err, errno, "%zu bytes for %s", size, d.beside);
		close(d.file);
		unlink(d.beside);
		return code;
	}
	*ret = d;
	return 0;
}

void durable_abandon(struct durable *d)
{
	if (d->file >= 0)
		close(d->file);
	d->file = -1;
	unlink(d->beside);
}

static int give_name(const struct durable *d, struct error *err)
{
	return rename(d->beside, d->path) == 0 ? 0 : error_set_errno(err, errno, "%s cannot be renamed", d->beside);
}

/*
 * The bytes, piece by piece, each of them a finished step (core/pulse.h): so a disk that is slow is told from one that
 * hangs. Two pieces at a time keep the disk busy. An error is reported once, so it counts here as in a sync.
 */
static int write_back(const struct durable *d, struct error *err)
{
	struct stat status;
	off_t size = fstat(d->file, &status) == 0 ? status.st_size : 0;

	for (off_t at = 0; at < size + PIECE_BYTES; at += PIECE_BYTES) {
		if (at < size)
			sync_file_range(d->file, at, PIECE_BYTES, SYNC_FILE_RANGE_WRITE);
		if (at > 0 &&
		    sync_file_range(d->file, at - PIECE_BYTES, PIECE_BYTES, SYNC_FILE_RANGE_WAIT_AFTER) != 0 &&
		    errno != ENOSYS)
			return error_set_sync(err, errno, "%s cannot be synced", d->path);
		pulse_beat();
	}
	return 0;
}

static int sync_data(const struct durable *d, struct error *err)
{
	int code = write_back(d, err);

	if (code != 0)
		return code;
	return fdatasync(d->file) == 0 ? 0 : error_set_sync(err, errno, "%s cannot be synced", d->path);
}

static int sync_and_close(struct durable *d, struct error *err)
{
	int code = sync_data(d, err);

	if (close(d->file) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s cannot be closed", d->path);
	d->file = -1;
	return code;
}

int durable_commit(struct durable *d, struct error *err)
{
	int code = sync_and_close(d, err);

	if (code == 0)
		code = give_name(d, err);
	if (code == 0)
		code = durable_sync_names(d->path, err);
	if (code != 0)
		durable_abandon(d);
	return code;
}

int durable_name(struct durable *d, struct error *err)
{
	int code = access(d->path, F_OK) == 0 ? sync_data(d, err) : 0;

	return code != 0 ? code : give_name(d, err);
}

int durable_settle(struct durable *d, struct error *err)
{
	int code = sync_and_close(d, err);

	return code != 0 ? code : durable_sync_names(d->path, err);
}

int durable_settle_named(const char *path, struct error *err)
{
	struct durable d = {.file = regular_open(path, O_RDONLY, 0), .path = path};
	int code;

	if (d.file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	code = durable_settle(&d, err);
	/* The bytes were written by somebody else: they cannot be written anew here, whatever the reason was. */
	if (code == ERR_NO_SPACE)
		code = err->code = ERR_SYNC;
	return code;
}

int durable_write(struct durable *d, const void *from, size_t size, struct error *err)
{
	for (size_t done = 0; done < size;) {
		ssize_t put = write(d->file, (const char *)from + done, size - done);

		if (put < 0 && errno == EINTR)
			continue;
		if (put < 0)
			return error_set_errno(err, errno, "%s cannot be written", d->beside);
		done += (size_t)put;
		pulse_beat();
	}
	return 0;
}

int durable_map(struct durable *d, size_t size, char **ret_bytes, struct error *err)
{
	/* Where the file system cannot set space aside, the C library writes zeros, which takes long. */
	int result = posix_fallocate(d->file, 0, (off_t)size);
	void *bytes;

	if (result != 0)
		return error_set_errno(err, result, "%zu bytes for %s", size, d->beside);
	bytes = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, d->file, 0);
	if (bytes == MAP_FAILED)
		return error_set_errno(err, errno, "%s cannot be mapped", d->beside);
	*ret_bytes = bytes;
	return 0;
}

int durable_link(const char *from, const char *path, bool *ret_linked, struct error *err)
{
	struct durable d = {.file = -1, .path = path};
	int code;

	if (snprintf(d.beside, sizeof(d.beside), "%s.tmp", path) >= (int)sizeof(d.beside))
		return error_set(err, ERR_INVALID, "a path of %zu bytes is too long", strlen(path));
	unlink(d.beside); /* what a crash left */
	if (link(from, d.beside) != 0) {
		if (errno == ENOSPC || errno == EDQUOT || errno == EIO)
			return error_set_errno(err, errno, "%s cannot be linked", d.beside);
		*ret_linked = false;
		return 0;
	}
	code = give_name(&d, err);
	unlink(d.beside); /* still there when that failed, or did nothing because both were one file already */
	if (code == 0)
		*ret_linked = true;
	return code;
}

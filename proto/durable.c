/*
 * Files that are there whole or not at all: durable.h. Every return value on
 * that way counts.
 */
#include "proto/durable.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

/* The names in the directory of `path` reach the disk. */
static int sync_directory_of(const char *path, struct error *err)
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
		code = error_set_errno(err, errno, "%s cannot be synced", directory);
	close(file);
	return code;
}

int durable_open(struct durable *ret, const char *path, size_t size, struct error *err)
{
	struct durable d = {.path = path};
	int code;

	if (snprintf(d.beside, sizeof(d.beside), "%s.tmp", path) >= (int)sizeof(d.beside))
		return error_set(err, ERR_INVALID, "a path of %zu bytes is too long", strlen(path));
	d.file = open(d.beside, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0640);
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

static int durable_rename(struct durable *d, struct error *err)
{
	int code = 0;

	if (rename(d->beside, d->path) != 0)
		code = error_set_errno(err, errno, "%s cannot be renamed", d->beside);
	return code != 0 ? code : sync_directory_of(d->path, err);
}

int durable_commit(struct durable *d, struct error *err)
{
	int code = 0;

	if (fdatasync(d->file) != 0)
		code = error_set_errno(err, errno, "%s cannot be synced", d->beside);
	if (close(d->file) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s cannot be closed", d->beside);
	d->file = -1;
	if (code == 0)
		code = durable_rename(d, err);
	if (code != 0)
		durable_abandon(d);
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
	}
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
	code = durable_rename(&d, err);
	unlink(d.beside); /* still there when that failed, or did nothing because both were one file already */
	if (code == 0)
		*ret_linked = true;
	return code;
}

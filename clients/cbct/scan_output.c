/* Scan directories that the client writes: see scan_output.h. */
#include "clients/cbct/scan_output.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

int scan_output_create(const char *directory, const char *name, int *ret_fd, struct error *err)
{
	char path[1200];
	int fd;

	snprintf(path, sizeof(path), "%s/%s", directory, name);
	fd = open(path, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
	if (fd < 0)
		return error_set_errno(err, errno, "%s", path);
	*ret_fd = fd;
	return 0;
}

int scan_output_write(int fd, const void *data, size_t length, struct error *err)
{
	const char *at = data;

	while (length > 0) {
		ssize_t written = write(fd, at, length);

		if (written < 0 && errno != EINTR)
			return error_set_errno(err, errno, "the scan directory cannot be written");
		if (written > 0) {
			at += written;
			length -= (size_t)written;
		}
	}
	return 0;
}

int scan_output_file(const char *directory, const char *name, const void *data, size_t length, struct error *err)
{
	int fd = -1, code = scan_output_create(directory, name, &fd, err);

	if (code == 0)
		code = scan_output_write(fd, data, length, err);
	if (fd >= 0 && close(fd) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s/%s", directory, name);
	return code;
}

int scan_output_document(const char *directory, const struct scan *scan, struct error *err)
{
	char *text = json_print(scan->document, NULL);
	int code = text != NULL ? scan_output_file(directory, "scan.json", text, strlen(text), err)
				: error_set(err, ERR_NO_MEMORY, "no memory for a scan document");

	free(text);
	return code;
}

int scan_output_begin(const char *directory, struct error *err)
{
	static const char *const names[] = {"scan.json", "flat.f32", "dark.f32", "defects.u8"};
	char path[1200];

	if (mkdir(directory, 0777) != 0 && errno != EEXIST)
		return error_set_errno(err, errno, "%s", directory);
	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
		snprintf(path, sizeof(path), "%s/%s", directory, names[i]);
		unlink(path);
	}
	return 0;
}

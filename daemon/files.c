/* Directories of the state: files.h. */
#include "daemon/files.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

int directory_sync(const char *path, struct error *err)
{
	int code = 0, directory = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC);

	if (directory < 0)
		return error_set_errno(err, errno, "open %s", path);
	if (fsync(directory) < 0)
		code = error_set_sync(err, errno, "fsync %s", path);
	close(directory);
	return code;
}

static void parent_of(const char *path, char *ret_parent, size_t size)
{
	char *slash;

	snprintf(ret_parent, size, "%s", path);
	slash = strrchr(ret_parent, '/');
	if (slash == NULL)
		snprintf(ret_parent, size, ".");
	else
		slash[slash == ret_parent] = '\0';
}

int directory_make(const char *path, struct error *err)
{
	char parent[1024];
	int code;

	parent_of(path, parent, sizeof(parent));
	if (mkdir(path, 0700) == 0)
		return directory_sync(parent, err);
	if (errno == EEXIST)
		return 0;
	if (errno != ENOENT || strcmp(parent, path) == 0)
		return error_set_errno(err, errno, "mkdir %s", path);
	code = directory_make(parent, err);
	if (code != 0)
		return code;
	if (mkdir(path, 0700) < 0 && errno != EEXIST)
		return error_set_errno(err, errno, "mkdir %s", path);
	return directory_sync(parent, err);
}

int directory_visit(const char *path, int (*visit)(void *context, const char *name, struct error *err), void *context,
		    struct error *err)
{
	DIR *directory = opendir(path);
	struct dirent *entry;
	int code = 0;

	if (directory == NULL)
		return errno == ENOENT ? 0 : error_set_errno(err, errno, "open %s", path);
	while (code == 0 && (entry = readdir(directory)) != NULL) {
		if (strcmp(entry->d_name, ".") != 0 && strcmp(entry->d_name, "..") != 0)
			code = visit(context, entry->d_name, err);
	}
	closedir(directory);
	return code;
}

static int remove_entry(void *context, const char *name, struct error *err)
{
	char path[1400];

	snprintf(path, sizeof(path), "%s/%s", (const char *)context, name);
	if (unlink(path) < 0 && errno != ENOENT)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

int directory_remove(const char *path, struct error *err)
{
	char copy[1024];
	int code;

	snprintf(copy, sizeof(copy), "%s", path);
	code = directory_visit(path, remove_entry, copy, err);
	if (code != 0)
		return code;
	if (rmdir(path) < 0 && errno != ENOENT)
		return error_set_errno(err, errno, "rmdir %s", path);
	return 0;
}

bool name_is_temporary(const char *name)
{
	return strstr(name, ".tmp") != NULL;
}

int space_free(const char *path, unsigned long long *ret_bytes, struct error *err)
{
	struct statvfs space;

	if (statvfs(path, &space) < 0)
		return error_set_errno(err, errno, "statvfs %s", path);
	*ret_bytes = (unsigned long long)space.f_bavail * space.f_frsize;
	return 0;
}

void path_hide(char *text, const char *directory)
{
	size_t length = strlen(directory);
	char *found;

	while (length > 0 && directory[length - 1] == '/')
		length--;
	if (length == 0)
		return;
	for (char *from = text; (found = strchr(from, directory[0])) != NULL; from = found) {
		char *end, *name;

		if (strncmp(found, directory, length) != 0 || found[length] != '/') {
			found++;
			continue;
		}
		end = found + length + strcspn(found + length, " \t\"',:;");
		for (name = end; name[-1] != '/'; name--)
			;
		memmove(found, name, strlen(name) + 1);
		found += end - name;
	}
}

/* Memory of this machine and of the process's control group: host_memory.h. */
#include "core/host_memory.h"

#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { TEXT_SIZE = 16384 }; /* memory.stat of a machine with many nodes has some kilobytes */

/* False, and "", where there is no such file. */
static bool read_text(const char *path, char ret_text[TEXT_SIZE])
{
	int file = open(path, O_RDONLY | O_CLOEXEC);
	ssize_t got = 0;
	size_t length = 0;

	while (file >= 0 && length < TEXT_SIZE - 1 && (got = read(file, ret_text + length, TEXT_SIZE - 1 - length)) > 0)
		length += (size_t)got;
	if (file >= 0)
		close(file);
	ret_text[length] = '\0';
	return length > 0;
}

/* The number behind a name at the beginning of a line; 0 where there is no such line. */
static unsigned long long number_of(const char *text, const char *name)
{
	const size_t length = strlen(name);

	for (const char *line = text; line != NULL; line = strchr(line, '\n')) {
		line += *line == '\n';
		if (strncmp(line, name, length) == 0 && line[length] == ' ')
			return strtoull(line + length, NULL, 10);
	}
	return 0;
}

/* ---- the group ---- */

/* A line is NUMBER:CONTROLLERS:PATH; version 2 has number 0 and no controllers. NULL: there is no such line. */
static char *path_in(char *list, const char *controllers)
{
	for (char *line = list, *end; *line != '\0'; line = end) {
		char *first = strchr(line, ':'), *second = first == NULL ? NULL : strchr(first + 1, ':');
		const size_t length = strlen(controllers);

		end = line + strcspn(line, "\n");
		if (second != NULL && second < end && (size_t)(second - first - 1) == length &&
		    strncmp(first + 1, controllers, length) == 0) {
			*end = '\0';
			return strcmp(second + 1, "/") == 0 ? second + 2 : second + 1;
		}
		end += *end == '\n';
	}
	return NULL;
}

/* True where the directory, or else the root that is mounted, has this file of a group. */
static bool settle(struct memory_group *group, const char *root, const char *path, const char *file)
{
	char name[640];

	group->root_length = strlen(root);
	for (int whole = 1; whole >= 0; whole--) {
		snprintf(group->directory, sizeof(group->directory), "%s%s", root, whole ? path : "");
		snprintf(name, sizeof(name), "%s/%s", group->directory, file);
		if (access(name, R_OK) == 0)
			return true;
	}
	return false;
}

void memory_group_find(const char *groups, const char *list, struct memory_group *ret_group)
{
	struct memory_group group = {.unified = true};
	char text[TEXT_SIZE], root[256];
	const char *path;
	bool found = false;

	*ret_group = (struct memory_group){0};
	if (!read_text(list, text))
		return;
	/* Where both versions are mounted, only one of them has the controller of memory, and the line of version 1. */
	path = path_in(text, "memory");
	if (path != NULL) {
		group.unified = false;
		snprintf(root, sizeof(root), "%s/memory", groups);
		found = settle(&group, root, path, "memory.limit_in_bytes");
	} else {
		path = path_in(text, "");
		found = path != NULL && settle(&group, groups, path, "memory.current");
	}
	if (found)
		*ret_group = group;
}

/* "max" of version 2, and a number above all memory of version 1, are no limit. */
static size_t bytes_in(const char *directory, const char *file, size_t otherwise)
{
	char path[640], text[TEXT_SIZE];

	snprintf(path, sizeof(path), "%s/%s", directory, file);
	if (!read_text(path, text) || text[0] < '0' || text[0] > '9')
		return otherwise;
	return (size_t)strtoull(text, NULL, 10);
}

/* The cache of files, which the kernel takes away before it kills. */
static size_t cache_of(const char *directory, bool unified)
{
	char path[640], text[TEXT_SIZE];

	snprintf(path, sizeof(path), "%s/memory.stat", directory);
	read_text(path, text);
	return (size_t)(number_of(text, unified ? "inactive_file" : "total_inactive_file") +
			number_of(text, unified ? "active_file" : "total_active_file"));
}

void memory_group_bounds(const struct memory_group *group, size_t *ret_limit, size_t *ret_left)
{
	size_t least = SIZE_MAX, least_left = SIZE_MAX;
	char directory[sizeof(group->directory)];
	char *slash = directory;

	memcpy(directory, group->directory, sizeof(directory));
	/* Each group above bounds this one, too. */
	while (directory[0] != '\0' && slash != NULL) {
		size_t limit = bytes_in(directory, group->unified ? "memory.max" : "memory.limit_in_bytes", SIZE_MAX);
		size_t used = bytes_in(directory, group->unified ? "memory.current" : "memory.usage_in_bytes", 0);
		size_t cache = cache_of(directory, group->unified), left;

		used = used > cache ? used - cache : 0;
		left = limit > used ? limit - used : 0;
		if (limit < SIZE_MAX && left < least_left)
			least_left = left;
		if (limit < least)
			least = limit;
		slash = strchr(directory + group->root_length, '/') == NULL ? NULL : strrchr(directory, '/');
		if (slash != NULL)
			*slash = '\0';
	}
	*ret_limit = least;
	*ret_left = least_left;
}

unsigned long memory_group_kills(const struct memory_group *group)
{
	char path[640], text[TEXT_SIZE];

	if (group->directory[0] == '\0')
		return 0;
	snprintf(path, sizeof(path), "%s/%s", group->directory,
		 group->unified ? "memory.events" : "memory.oom_control");
	read_text(path, text);
	return (unsigned long)number_of(text, "oom_kill");
}

/* ---- the machine ---- */

void host_memory(struct host_memory *ret_memory)
{
	const size_t total = (size_t)sysconf(_SC_PHYS_PAGES) * (size_t)sysconf(_SC_PAGESIZE);
	struct memory_group group;
	char text[TEXT_SIZE];
	size_t available = total / 2, limit, left;

	/* Only /proc/meminfo says what can be had: sysinfo(2) counts a cache full of projections as used. */
	read_text("/proc/meminfo", text);
	if (strstr(text, "MemAvailable:") != NULL)
		available = (size_t)number_of(text, "MemAvailable:") << 10;
	memory_group_find(CONTROL_GROUPS, "/proc/self/cgroup", &group);
	memory_group_bounds(&group, &limit, &left);
	*ret_memory = (struct host_memory){.total = limit < total ? limit : total,
					   .available = left < available ? left : available,
					   .limit = limit < total ? limit : SIZE_MAX};
}

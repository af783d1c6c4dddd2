/* Volume files in memory: mapping.h. */
#include "daemon/volumes/mapping.h"

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "proto/format.h"
#include "proto/regular.h"
#include "daemon/lock.h"

enum { IDLE_MAX = 8 };

struct mapping {
	struct mapping *next; /* the one that was used before it */
	char path[1024];
	dev_t device;
	ino_t inode;
	void *start;
	size_t size;   /* bytes mapped */
	size_t voxels; /* where they begin in it */
	int references;
};

struct mappings {
	pthread_mutex_t lock; /* guards the list and the references */
	struct mapping *first;
};

int mappings_new(struct mappings **ret_mappings, struct error *err)
{
	struct mappings *mappings = calloc(1, sizeof(*mappings));

	if (mappings == NULL)
		return error_set_errno(err, ENOMEM, "mapped volumes");
	lock_init(&mappings->lock, LOCK_MAPPINGS);
	*ret_mappings = mappings;
	return 0;
}

static void mapping_free(struct mapping *mapping)
{
	if (mapping->start != NULL)
		munmap(mapping->start, mapping->size);
	free(mapping);
}

void mappings_free(struct mappings *mappings)
{
	if (mappings == NULL)
		return;
	while (mappings->first != NULL) {
		struct mapping *mapping = mappings->first;

		assert(mapping->references == 0);
		mappings->first = mapping->next;
		mapping_free(mapping);
	}
	pthread_mutex_destroy(&mappings->lock);
	free(mappings);
}

static int map_file(const char *path, const struct grid *grid, struct mapping **ret_mapping, struct error *err)
{
	struct mapping *mapping = calloc(1, sizeof(*mapping));
	int file = regular_open(path, O_RDONLY, 0);
	struct stat status;
	int code = 0;

	if (mapping == NULL || file < 0) {
		code = file < 0 && errno == ENOENT ? error_set(err, ERR_NOT_FOUND, "the volume is not there any more")
						   : error_set_errno(err, errno, "open a volume");
		goto out;
	}
	if (fstat(file, &status) != 0) {
		code = error_set_errno(err, errno, "the volume's file cannot be read");
		goto out;
	}
	code = volume_own_start(file, path, grid, &mapping->voxels, err);
	if (code != 0)
		goto out;
	mapping->size = mapping->voxels + grid_voxels(grid) * sizeof(float);
	mapping->start = mmap(NULL, mapping->size, PROT_READ, MAP_SHARED, file, 0);
	if (mapping->start == MAP_FAILED) {
		mapping->start = NULL;
		code = error_set_errno(err, errno, "map a volume");
		goto out;
	}
	snprintf(mapping->path, sizeof(mapping->path), "%s", path);
	mapping->device = status.st_dev;
	mapping->inode = status.st_ino;
	mapping->references = 1;
	*ret_mapping = mapping;
	mapping = NULL;
out:
	if (file >= 0)
		close(file);
	if (mapping != NULL)
		mapping_free(mapping);
	return code;
}

/* Finds the mapping and moves it to the front; the lock is held. */
static struct mapping *find(struct mappings *mappings, const struct stat *status, size_t bytes)
{
	for (struct mapping **at = &mappings->first; *at != NULL; at = &(*at)->next) {
		struct mapping *mapping = *at;

		if (mapping->inode != status->st_ino || mapping->device != status->st_dev ||
		    mapping->size - mapping->voxels != bytes)
			continue;
		*at = mapping->next;
		mapping->next = mappings->first;
		mappings->first = mapping;
		mapping->references++;
		return mapping;
	}
	return NULL;
}

/* Drops the unused mappings of files in `directory`; NULL: all but the `stay` that were used last. */
static void drop_idle(struct mappings *mappings, int stay, const char *directory)
{
	size_t length = directory != NULL ? strlen(directory) : 0;
	struct mapping **at = &mappings->first;

	while (*at != NULL) {
		struct mapping *mapping = *at;
		bool inside = directory == NULL ||
			      (strncmp(mapping->path, directory, length) == 0 && mapping->path[length] == '/');

		if (mapping->references > 0 || !inside || stay-- > 0) {
			at = &mapping->next;
			continue;
		}
		*at = mapping->next;
		mapping_free(mapping);
	}
}

int mapping_get(struct mappings *mappings, const char *path, const struct grid *grid, struct mapping **ret_mapping,
		struct error *err)
{
	size_t bytes = grid_voxels(grid) * sizeof(float);
	struct mapping *mapping = NULL, *fresh = NULL;
	struct stat status;
	int code = 0;

	if (stat(path, &status) == 0) {
		pthread_mutex_lock(&mappings->lock);
		mapping = find(mappings, &status, bytes);
		pthread_mutex_unlock(&mappings->lock);
	}
	if (mapping == NULL) {
		code = map_file(path, grid, &fresh, err);
		if (code != 0)
			return code;
		pthread_mutex_lock(&mappings->lock);
		fresh->next = mappings->first;
		mappings->first = mapping = fresh;
		drop_idle(mappings, IDLE_MAX, NULL);
		pthread_mutex_unlock(&mappings->lock);
	}
	*ret_mapping = mapping;
	return 0;
}

void mapping_release(struct mappings *mappings, struct mapping *mapping)
{
	if (mapping == NULL)
		return;
	pthread_mutex_lock(&mappings->lock);
	mapping->references--;
	pthread_mutex_unlock(&mappings->lock);
}

const float *mapping_voxels(const struct mapping *mapping)
{
	return (const float *)(const void *)((const char *)mapping->start + mapping->voxels);
}

void mappings_forget(struct mappings *mappings, const char *directory)
{
	pthread_mutex_lock(&mappings->lock);
	drop_idle(mappings, 0, directory);
	pthread_mutex_unlock(&mappings->lock);
}

#ifndef CBCT_TESTS_VOLUME_FILE_H
#define CBCT_TESTS_VOLUME_FILE_H

#include <stddef.h>

/* One file of a volume in a directory of its own: a fixture, volume_file_make and volume_file_remove. */
extern char volume_file[]; /* its path */
void volume_file_make(void);
void volume_file_remove(void);

/* Header and voxels, in place of what was there. */
void volume_file_write(const void *header, size_t header_size, const void *voxels, size_t voxels_size);

#endif

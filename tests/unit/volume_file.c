#include "tests/unit/volume_file.h"

#include <check.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static char directory[] = "/tmp/cbct-volume-XXXXXX";
char volume_file[sizeof(directory) + sizeof("/volume")];

void volume_file_make(void)
{
	memcpy(directory + strlen(directory) - 6, "XXXXXX", 6);
	ck_assert_ptr_nonnull(mkdtemp(directory));
	snprintf(volume_file, sizeof(volume_file), "%s/volume", directory);
}

void volume_file_remove(void)
{
	unlink(volume_file);
	rmdir(directory);
}

void volume_file_write(const void *header, size_t header_size, const void *voxels, size_t voxels_size)
{
	FILE *file = fopen(volume_file, "wb");

	ck_assert_ptr_nonnull(file);
	ck_assert_uint_eq(fwrite(header, 1, header_size, file), header_size);
	ck_assert_uint_eq(fwrite(voxels, 1, voxels_size, file), voxels_size);
	ck_assert_int_eq(fclose(file), 0);
}

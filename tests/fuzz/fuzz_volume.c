/* Any bytes as a volume file: refused with a reason, or a volume on a grid that is one. */
#include <stdio.h>
#include <sys/mman.h>
#include <unistd.h>

#include "proto/format.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static int file = -1;
	struct grid grid = {{1, 1, 2}, {1, 1, 1}, {0, 0, 0}};
	struct error err = {0};
	float *voxels = NULL, sum = 0;
	char path[64];

	if (file < 0)
		file = memfd_create("volume", MFD_CLOEXEC);
	PROMISE(file >= 0 && ftruncate(file, 0) == 0 && pwrite(file, data, size, 0) == (ssize_t)size);
	snprintf(path, sizeof(path), "/proc/self/fd/%d", file);
	if (volume_read(path, &grid, NULL, &voxels, &err) != 0) {
		PROMISE(voxels == NULL && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(grid_check(&grid, &err) == 0);
	for (size_t i = 0; i < grid_voxels(&grid); i++)
		sum += voxels[i]; /* all of them are there */
	*(volatile float *)&sum = sum;
	free(voxels);
	return 0;
}

/*
 * Linked into the unit tests by tests/same_bits.sh, with -Wl,--wrap=recon_read: each volume, or run of slices, that a
 * test reads gets a line `TEST FIRST COUNT DIGEST` at the end of the file that DIGESTS names. Nothing else changes.
 */
#include <check.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/recon/recon.h"

/* FNV-1a of 32-bit words (Fowler, Noll and Vo). */
static uint64_t digest_of(const float *voxels, size_t count)
{
	uint64_t digest = 14695981039346656037u;

	for (size_t i = 0; i < count; i++) {
		uint32_t word;

		memcpy(&word, &voxels[i], sizeof(word));
		digest = (digest ^ word) * 1099511628211u;
	}
	return digest;
}

/* One write, so that the lines of tests that run beside each other do not mix. */
static void note(const char *line, size_t length)
{
	const char *path = getenv("DIGESTS");
	int file = path != NULL ? open(path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644) : -1;

	if (file < 0 || write(file, line, length) != (ssize_t)length) {
		fprintf(stderr, "digests: cannot write to %s\n", path != NULL ? path : "DIGESTS, which is not set");
		exit(EXIT_FAILURE);
	}
	close(file);
}

int __real_recon_read(struct recon *recon, int z_first, int z_count, float *ret_slices, struct error *err);
int __wrap_recon_read(struct recon *recon, int z_first, int z_count, float *ret_slices, struct error *err);

int __wrap_recon_read(struct recon *recon, int z_first, int z_count, float *ret_slices, struct error *err)
{
	const int *size = recon_grid(recon)->size;
	int code = __real_recon_read(recon, z_first, z_count, ret_slices, err);
	char line[256];

	if (code == 0)
		note(line, (size_t)snprintf(line, sizeof(line), "%s %d %d %016llx\n", tcase_name(), z_first, z_count,
					    (unsigned long long)digest_of(
						ret_slices, (size_t)size[0] * (size_t)size[1] * (size_t)z_count)));
	return code;
}

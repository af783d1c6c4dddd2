/* Any bytes as projections.sums, and as a file with checksums at its end: only what checks itself counts. */
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "proto/seal.h"
#include "proto/sums.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	enum { COUNT = 16 };
	struct sum sums[COUNT];
	unsigned char states[COUNT];
	uint8_t record[SUMS_RECORD_BYTES];
	struct seal seal = {0};
	struct error err = {0};
	int file = memfd_create("sums", 0);

	PROMISE(file >= 0 && write(file, data, size) == (ssize_t)size);
	PROMISE(sums_get(file, SUMS_SCAN, COUNT, 48, sums, states, &err) == 0);
	for (int i = 0; i < COUNT; i++) {
		size_t at = (size_t)(SUMS_FIRST + SUMS_RECORD_BYTES * (SUMS_SCAN + i));

		PROMISE(states[i] <= SUM_DAMAGED);
		if (states[i] != SUM_GOOD)
			continue;
		PROMISE(sums[i].bytes == 48 && at + SUMS_RECORD_BYTES <= size);
		sum_pack(&sums[i], SUMS_SCAN + i, record);
		PROMISE(memcmp(record, data + at, 56) == 0);
	}
	if (seal_read(file, &seal, &err) == 0) {
		PROMISE(seal.content + seal_bytes(seal.content) == size);
		PROMISE(seal_first_damaged(&seal, data) < seal.count);
		seal_clear(&seal);
	}
	close(file);
	return 0;
}

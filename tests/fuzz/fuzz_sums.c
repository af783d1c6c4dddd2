/* Any bytes as projections.sums: only records that check themselves count. */
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "proto/sums.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	enum { COUNT = 16 };
	struct sum sums[COUNT];
	unsigned char states[COUNT];
	uint8_t record[SUMS_RECORD_BYTES];
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
	close(file);
	return 0;
}

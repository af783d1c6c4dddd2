/* Any bytes as a file of angles or matrices, text or NumPy array: refused with a reason, or finite numbers. */
#include <math.h>
#include <stdio.h>
#include <sys/mman.h>
#include <unistd.h>

#include "clients/cbct/numbers.h"
#include "tests/fuzz/fuzz.h"

static void check_finite(const double *numbers, size_t count)
{
	for (size_t i = 0; i < count; i++)
		PROMISE(isfinite(numbers[i]));
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static int file = -1;
	struct error err = {0};
	double *numbers = NULL, *matrices = NULL;
	size_t count = 0;
	int matrix_count = 0;
	char path[64];

	if (file < 0)
		file = memfd_create("numbers", MFD_CLOEXEC);
	PROMISE(file >= 0 && ftruncate(file, 0) == 0 && pwrite(file, data, size, 0) == (ssize_t)size);
	snprintf(path, sizeof(path), "/proc/self/fd/%d", file);
	if (numbers_read(path, &numbers, &count, &err) == 0) {
		PROMISE(count >= 1);
		check_finite(numbers, count);
	} else {
		PROMISE(numbers == NULL && err.code < 0 && err.text[0] != '\0');
	}
	if (matrices_read(path, &matrices, &matrix_count, &err) == 0) {
		PROMISE(matrix_count >= 1 && 12 * (size_t)matrix_count == count);
		check_finite(matrices, count);
	} else {
		PROMISE(matrices == NULL && err.code < 0 && err.text[0] != '\0');
	}
	free(numbers);
	free(matrices);
	return 0;
}

/* Reading the test data: see data.h. */
#include "tests/unit/data.h"

#include <check.h>
#include <stdio.h>
#include <stdlib.h>

double *data_npy(const char *name, size_t numbers)
{
	const char *data = getenv("CBCT_TEST_DATA");
	char path[1024];
	unsigned char head[10];
	double *values;
	FILE *file;

	snprintf(path, sizeof(path), "%s/%s", data ? data : "../shared/data", name);
	file = fopen(path, "rbe");
	if (file == NULL) {
		printf("skipped: %s is not there\n", path);
		return NULL;
	}
	values = malloc(numbers * sizeof(*values));
	ck_assert_ptr_nonnull(values);
	/* Magic and version, then the length of the header's text. */
	ck_assert_uint_eq(fread(head, 1, sizeof(head), file), sizeof(head));
	ck_assert_int_eq(fseek(file, 10 + head[8] + 256 * head[9], SEEK_SET), 0);
	ck_assert_uint_eq(fread(values, sizeof(*values), numbers, file), numbers);
	fclose(file);
	return values;
}

/* Reading the test data: see data.h. */
#include "tests/unit/data.h"

#include <check.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <zstd.h>

static FILE *data_open(const char *name)
{
	const char *data = getenv("CBCT_TEST_DATA");
	static bool told;
	char path[1024];
	FILE *file;

	snprintf(path, sizeof(path), "%s/%s", data ? data : "../shared/data", name);
	file = fopen(path, "rbe");
	/* Each test is a process of its own, and one skip. */
	if (file == NULL && !told)
		printf("SKIP unit %s is not there\n", path);
	told = told || file == NULL;
	return file;
}

float *data_f32(const char *name, size_t numbers)
{
	const size_t bytes = numbers * sizeof(float), most = ZSTD_compressBound(bytes);
	FILE *file = data_open(name);
	char *packed;
	float *values;

	if (file == NULL)
		return NULL;
	packed = malloc(most);
	values = malloc(bytes);
	ck_assert(packed != NULL && values != NULL);
	ck_assert_uint_eq(ZSTD_decompress(values, bytes, packed, fread(packed, 1, most, file)), bytes);
	free(packed);
	fclose(file);
	return values;
}

double *data_npy(const char *name, size_t numbers)
{
	unsigned char head[10];
	double *values;
	FILE *file = data_open(name);

	if (file == NULL)
		return NULL;
	values = malloc(numbers * sizeof(*values));
	ck_assert_ptr_nonnull(values);
	/* Magic and version, then the length of the header's text. */
	ck_assert_uint_eq(fread(head, 1, sizeof(head), file), sizeof(head));
	ck_assert_int_eq(fseek(file, 10 + head[8] + 256 * head[9], SEEK_SET), 0);
	ck_assert_uint_eq(fread(values, sizeof(*values), numbers, file), numbers);
	fclose(file);
	return values;
}

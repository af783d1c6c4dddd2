#ifndef CBCT_TESTS_DATA_H
#define CBCT_TESTS_DATA_H

#include <stddef.h>

/*
 * Test data outside of the project: the directory in CBCT_TEST_DATA, else
 * ../shared/data. NULL, said aloud, where the file is not there: the test returns.
 */

/* `numbers` float64 in C order, as numpy writes version 1 files. Free with free. */
double *data_npy(const char *name, size_t numbers);
/* `numbers` float32 of a .f32.zst file. Free with free. */
float *data_f32(const char *name, size_t numbers);

#endif

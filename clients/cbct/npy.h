#ifndef CBCT_CLIENTS_NPY_H
#define CBCT_CLIENTS_NPY_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"
#include "proto/pixel.h"

/* The header of a NumPy array file (.npy), C order. */
enum { NPY_HEAD_MAX = 1 << 16, NPY_DIMENSIONS_MAX = 4 };

struct npy {
	enum pixel_type type;
	bool big_endian;
	int dimensions; /* 1 .. NPY_DIMENSIONS_MAX */
	size_t shape[NPY_DIMENSIONS_MAX];
	size_t start; /* of the numbers in the file */
};

bool npy_recognise(const unsigned char *head, size_t length);
/* From a file's beginning; ERR_INVALID for Fortran order, structures and types that are no plain numbers. */
int npy_parse(const char *head, size_t length, struct npy *ret_npy, struct error *err);

#endif

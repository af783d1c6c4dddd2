#ifndef CBCT_CLIENTS_PICTURE_H
#define CBCT_CLIENTS_PICTURE_H

#include "core/error.h"

/* 8-bit gray PNG: pixels [height][width], the first row on top. "-" is standard output. */
int picture_write(const char *path, const unsigned char *pixels, int width, int height, struct error *err);

#endif

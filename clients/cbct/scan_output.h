#ifndef CBCT_CLIENTS_SCAN_OUTPUT_H
#define CBCT_CLIENTS_SCAN_OUTPUT_H

#include "proto/scan.h"

/* Writing a scan directory (proto/scan_directory.h): images and projections first, the document last. */

/* Makes the directory where it is missing, and removes what an earlier scan may have left and this one may lack. */
int scan_output_begin(const char *directory, struct error *err);
/* A file of the directory, written from its beginning; the caller closes *ret_fd. */
int scan_output_create(const char *directory, const char *name, int *ret_fd, struct error *err);
int scan_output_write(int fd, const void *data, size_t length, struct error *err);
/* A whole file. */
int scan_output_file(const char *directory, const char *name, const void *data, size_t length, struct error *err);
/* scan.json: a directory with a document is whole. */
int scan_output_document(const char *directory, const struct scan *scan, struct error *err);

#endif

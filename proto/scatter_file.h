#ifndef CBCT_PROTO_SCATTER_FILE_H
#define CBCT_PROTO_SCATTER_FILE_H

#include <stdbool.h>

#include "core/detector.h"
#include "proto/scan.h"
#include "proto/sums.h"

/*
 * The images of scatter in a scan directory, where the scan announces them:
 *
 *   scatter.raw   [image][row][column] float32, counts; core/detector.h says which projections have one
 *   scatter.sums  a record of each, as projections.sums has them; the daemon always has it
 *
 * Any thread; one writer of an image at a time.
 */
#define SCATTER_FILE "scatter.raw"

struct scatter_file {
	struct scatter_images images;
	int projections;   /* of the scan */
	int count;         /* images */
	int samples, sums; /* descriptors; sums -1: there are none, and nothing is checked */
};

/* A file of holes and blank records, durably. */
int scatter_file_create(const char *directory, const struct scatter_images *images, int projections, struct error *err);
/* ERR_NOT_FOUND where there are no images, ERR_INVALID where they are another number. *ret_whole: as sums_open has it.
 */
int scatter_file_open(const char *directory, const struct scatter_images *images, int projections, bool writing,
		      struct scatter_file *ret_file, bool *ret_whole, struct error *err);
void scatter_file_close(struct scatter_file *file); /* a closed one is fine */

/* *ret_sum is set where there are records; ERR_DAMAGED: the samples do not fit theirs, or it has none. */
int scatter_file_read(const struct scatter_file *file, int image, float *ret_image, struct sum *ret_sum,
		      struct error *err);
/* On the disk behind this. */
int scatter_file_write(const struct scatter_file *file, int image, const float *pixels, struct error *err);
/* Its record says that it is damaged, behind this. */
int scatter_file_lose(const struct scatter_file *file, int image, struct error *err);

#endif

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
 * An image that never came has a record too, of no bytes, and so has slot SUMS_SCAN: a record that is blank was lost.
 * In a file of an earlier version, whose slot SUMS_SCAN is blank, that is one of an image that never came.
 *
 * The record of an image that was lost keeps its digest, so that other bytes are refused in its place. Where that
 * record was damaged, too, nobody can tell: the record of the image that comes then has 1 for its order of arrival, and
 * whoever had begun with the one before begins anew.
 *
 * Any thread; one writer of an image at a time.
 */
#define SCATTER_FILE "scatter.raw"

struct scatter_file {
	struct scatter_images images;
	int projections;   /* of the scan */
	int count;         /* images */
	int samples, sums; /* descriptors; sums -1: there are none, and nothing is checked */
	bool marked;       /* a blank record was lost */
};

enum scatter_state { SCATTER_NONE, SCATTER_STORED, SCATTER_LOST };

/* A file of holes and records of images that never came, durably. */
int scatter_file_create(const char *directory, const struct scatter_images *images, int projections, struct error *err);
/* ERR_NOT_FOUND where there are no images, ERR_INVALID where they are another number. *ret_whole: as sums_open has it.
 */
int scatter_file_open(const char *directory, const struct scatter_images *images, int projections, bool writing,
		      struct scatter_file *ret_file, bool *ret_whole, struct error *err);
void scatter_file_close(struct scatter_file *file); /* a closed one is fine */
/*
 * By their records: ret_states[count], enum scatter_state; ret_others[count], 0, or of an image that may be another
 * than the one that was there before it a number that its bytes give.
 */
int scatter_file_states(const struct scatter_file *file, unsigned char *ret_states, unsigned *ret_others,
			struct error *err);
/*
 * Files that are not there, or not whole, are made again, with what is left of them: images without a good record count
 * as lost, but for those that never came, by what `states` says (NULL: nothing is known); samples that are gone are
 * zeros, which do not fit their records. *ret_mended: something was not whole. Nobody else writes them meanwhile.
 */
int scatter_file_mend(const char *directory, const struct scatter_images *images, int projections,
		      const unsigned char *states, bool *ret_mended, struct error *err);

/* *ret_sum is set where there are records; ERR_DAMAGED: the samples do not fit theirs, or it has none. */
int scatter_file_read(const struct scatter_file *file, int image, float *ret_image, struct sum *ret_sum,
		      struct error *err);
/* The record that the image gets; ERR_CONFLICT: it was lost, and had other bytes. *ret_other: as above. */
int scatter_file_describe(const struct scatter_file *file, int image, const float *pixels, struct sum *ret_sum,
			  unsigned *ret_other, struct error *err);
/* On the disk behind this, with that record. */
int scatter_file_write(const struct scatter_file *file, int image, const float *pixels, const struct sum *sum,
		       struct error *err);
/* Its record says that it is damaged, behind this. */
int scatter_file_lose(const struct scatter_file *file, int image, struct error *err);
/* Those with flags[count] are as if they had never come, and take no room where the file system can do that. */
int scatter_file_forget(const struct scatter_file *file, const unsigned char *flags, struct error *err);

#endif

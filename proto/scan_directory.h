#ifndef CBCT_PROTO_SCAN_DIRECTORY_H
#define CBCT_PROTO_SCAN_DIRECTORY_H

#include <stdbool.h>
#include <stdint.h>

#include "core/recon/recon.h"
#include "core/scan/image.h"
#include "proto/recipe.h"
#include "proto/scan.h"

/*
 * Scans and volumes as files. The daemon's reconstruction, `cbct simulate`'s output and
 * the input of `cbct recon` are the same directory:
 *
 *   scan.json        the document of POST /v1/scans
 *   projections.raw  [view][row][column] of the scan's sample type, preallocated
 *   projections.sums checksums of all these files (proto/sums.h); the daemon always has them
 *   flat.f32 ...     the images that are given, core/scan/image.h
 *   scatter.raw ...  images of scatter, where the scan announces them, proto/scatter_file.h
 *
 * Kept volumes are NAME.nii files: a NIfTI header with an extension that says where
 * they come from, VOLUME_FILE_OFFSET bytes in all, and float32 voxels, so that raw
 * and nifti are both sent straight from the file. Files from before there was an
 * extension begin their voxels earlier: volume_own_head of proto/format.h says where.
 */
enum { VOLUME_FILE_OFFSET = 4096 };

/*
 * Whole small file; *ret_text ends with a zero byte beyond its length. Free with
 * free. ERR_NOT_FOUND where there is none, ERR_TOO_LARGE beyond `most` bytes.
 */
int file_read(const char *path, size_t most, char **ret_text, size_t *ret_length, struct error *err);
/* `size` bytes from `offset` of an open file, all of them; `path` is for the error's text. */
int file_read_at(int file, void *ret_to, size_t size, size_t offset, const char *path, struct error *err);
/*
 * Beside the path as PATH.tmp, fsync, rename, fsync of the directory: there
 * whole or not at all. One writer of a path at a time. A sync that failed is
 * final (the kernel may have dropped the pages): it is reported, never tried again.
 */
int file_write_durable(const char *path, const void *data, size_t length, struct error *err);

/* "directory/name" and an extension; ERR_INVALID where it does not fit. */
int path_join(char *ret_path, size_t size, const char *directory, const char *name, const char *extension,
	      struct error *err);

/* A scan directory opened for reading. */
struct scan_files {
	struct scan *scan;
	int projections;          /* descriptor */
	int sums;                 /* descriptor of projections.sums, -1: there is none, and nothing is checked */
	void *image[IMAGE_COUNT]; /* [row][column] of the kind's pixels, or NULL */
};
/*
 * Reads scan.json and the images and checks that every file is as long as the
 * scan says, and that it fits its record where there is projections.sums;
 * whether all projections have arrived only the owner of the directory knows.
 * ERR_NOT_FOUND where a file is missing, ERR_DAMAGED where one does not fit.
 */
int scan_files_open(const char *directory, struct scan_files *ret_files, struct error *err);
void scan_files_close(struct scan_files *files); /* NULL and a closed one are fine */

#endif

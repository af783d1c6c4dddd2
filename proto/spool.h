#ifndef CBCT_PROTO_SPOOL_H
#define CBCT_PROTO_SPOOL_H

#include <stdbool.h>
#include <stdint.h>

#include "core/recon.h"
#include "proto/recipe.h"
#include "proto/scan.h"

/*
 * Scans and volumes as files. The daemon's spool, `cbct simulate`'s output and
 * the input of `cbct recon` are the same directory:
 *
 *   scan.json        the document of POST /v1/scans
 *   projections.raw  [view][row][column] of the scan's sample type, preallocated
 *   flat.f32 dark.f32  [row][column] float32, where given
 *
 * Kept volumes are NAME.nii files: a 352-byte NIfTI header and float32 voxels,
 * so that raw and nifti are both sent straight from the file.
 */
enum { SPOOL_VOLUME_OFFSET = 352 };

/* Whole small file; *ret_text ends with a zero byte beyond its length. Free with free. */
int file_read(const char *path, size_t most, char **ret_text, size_t *ret_length, struct error *err);
/* Beside the path, fsync, rename, fsync of the directory: there whole or not at all. */
int file_write_durable(const char *path, const void *data, size_t length, struct error *err);

/* A scan directory opened for reading. */
struct scan_files {
	struct scan *scan;
	int projections;    /* descriptor */
	float *flat, *dark; /* [row][column] or NULL */
};
int scan_files_open(const char *directory, struct scan_files *ret_files, struct error *err);
void scan_files_close(struct scan_files *files);

/* One kept volume on its way to disk. */
struct saved_volume {
	char path[1024];
	size_t bytes;       /* of voxels, the header not counted */
	uint8_t sha256[32]; /* of the voxels */
};

/*
 * The pipeline over a directory: opens the recon, pushes the views in [views]
 * (NULL: all), runs, and writes each kept volume into out_directory before it
 * calls on_volume. Used by the worker and by `cbct recon`, so that both do the
 * same thing. checkpoint: path of an iterate to resume from, or NULL; `iteration` is the one it holds.
 */
struct spool_hooks {
	struct recon_hooks recon; /* keep is spool_run's own and must be NULL here */
	int (*on_volume)(void *context, const struct kept_volume *volume, const struct saved_volume *saved,
	                 struct error *err);
	void (*on_open)(void *context, const struct recon_memory *memory, const char *plan);
};
int spool_run(const struct backend *backend, struct device *device, const char *scan_directory,
              const struct recipe *recipe, const char *out_directory, const char *checkpoint, int iteration,
              const struct spool_hooks *hooks, struct error *err);

/* Where a yielding run leaves its iterate: OUT/checkpoint.f32, written when recon.yield ended the run. */
#define SPOOL_CHECKPOINT "checkpoint.f32"

#endif

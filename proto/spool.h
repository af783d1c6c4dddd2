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
 *   projections.sums checksums of all these files (proto/sums.h); the daemon always has them
 *   flat.f32 dark.f32  [row][column] float32, where given
 *   defects.u8         [row][column] bytes, not zero where a pixel is defective, where given
 *
 * Kept volumes are NAME.nii files: a NIfTI header with an extension that says where
 * they come from, SPOOL_VOLUME_OFFSET bytes in all, and float32 voxels, so that raw
 * and nifti are both sent straight from the file. Files from before there was an
 * extension begin their voxels earlier: volume_own_head of proto/format.h tells.
 */
enum { SPOOL_VOLUME_OFFSET = 4096 };

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

/* A scan directory opened for reading. */
struct scan_files {
	struct scan *scan;
	int projections;    /* descriptor */
	int sums;           /* descriptor of projections.sums, -1: there is none, and nothing is checked */
	float *flat, *dark; /* [row][column] or NULL */
	unsigned char *defects;
};
/*
 * Reads scan.json and the images and checks that every file is as long as the
 * scan says, and that it fits its record where there is projections.sums;
 * whether all projections have arrived only the owner of the directory knows.
 * ERR_NOT_FOUND where a file is missing, ERR_DAMAGED where one does not fit.
 */
int scan_files_open(const char *directory, struct scan_files *ret_files, struct error *err);
void scan_files_close(struct scan_files *files); /* NULL and a closed one are fine */

/* The file of one kept volume. */
struct saved_volume {
	char path[1024];
	size_t bytes; /* of voxels, the header not counted */
};

/*
 * The pipeline over a directory, in three steps: opened, given its projections in
 * any order and as they arrive, and finished. Each kept volume becomes a file of
 * out_directory and is told of twice: by on_volume as soon as everybody can read
 * it there, whole, and by on_settled when it is on the disk. However a run ends,
 * what was told of is settled first, unless that is what failed: then its file is
 * removed. Where "final" is the same iterate as
 * the volume before it, it is another link to that file. The worker and `cbct
 * recon` both do it this way. One thread at a time.
 */
struct spool_hooks {
	struct recon_hooks recon; /* any may be NULL, its context goes to all of these; keep is the spool's own and must
				     be NULL here */
	int (*on_volume)(void *context, const struct kept_volume *volume, const struct saved_volume *saved,
			 struct error *err);
	int (*on_settled)(void *context, const char *name, struct error *err);
	void (*on_open)(void *context, const struct recon_memory *memory, const char *plan);
};

/* What is to be reconstructed; all of it is borrowed until spool_close. */
struct spool_options {
	const char *scan_directory, *out_directory;
	/*
	 * In the daemon's spool: the scan directory must have projections.sums (ERR_DAMAGED without), and the volumes'
	 * files end with their checksums (proto/seal.h).
	 */
	bool checked;
	/* A flag for each projection of scan.json: those that make up the scan, the others never come. NULL: all. */
	const unsigned char *present;
	const struct recipe *recipe;
	/* For the files' descriptions: the program, job and scan by their names ("" or NULL: none). */
	const char *program, *job, *scan;
	const struct patient *patient; /* NULL: as scan.json says */
	/*
	 * Of a run that yielded, or NULL; `iteration` is the one it holds as far as the
	 * caller knows. The file itself knows better (a crash may lie between its writing
	 * and the caller's note): where they differ, the file counts and a warning
	 * "checkpoint" says so. One that is missing or damaged is ERR_INVALID.
	 */
	const char *checkpoint;
	int iteration;
	const struct spool_hooks *hooks;
};

struct spool;
int spool_open(const struct backend *backend, struct device *device, const struct spool_options *options,
	       struct spool **ret_spool, struct error *err);
void spool_close(struct spool *spool); /* NULL is fine */

/* Projections that the reconstruction has, and that it wants in all. */
int spool_pushed(const struct spool *spool);
int spool_wanted(const struct spool *spool);
/*
 * Reads these projections and reconstructs as far as they go, in this order: the
 * same order gives the same bits, however many a call brings. Each once
 * (ERR_CONFLICT), and only those that are present (ERR_INVALID). ERR_DAMAGED:
 * one does not fit its checksum, and none of it was used.
 */
int spool_push(struct spool *spool, const int *projections, int count, struct error *err);
/* All that have not been pushed, by their numbers. */
int spool_push_rest(struct spool *spool, struct error *err);
/*
 * Once, when all are there: the rest of the pipeline. A run that hooks->recon.yield ended returns ERR_BUSY and has
 * left its iterate as OUT/checkpoint.f32, durably.
 */
int spool_finish(struct spool *spool, struct error *err);

/* The three in a row. */
int spool_run(const struct backend *backend, struct device *device, const struct spool_options *options,
	      struct error *err);

/*
 * A line of text padded to SPOOL_CHECKPOINT_OFFSET bytes with iteration, size and noise, then float32 voxels [z][y][x],
 * the list of metal where there is one, and a seal (proto/seal.h).
 */
#define SPOOL_CHECKPOINT "checkpoint.f32"
enum { SPOOL_CHECKPOINT_OFFSET = 160 };

#endif

#ifndef CBCT_PROTO_RECONSTRUCTION_H
#define CBCT_PROTO_RECONSTRUCTION_H

#include <stdbool.h>
#include <stddef.h>
#include <time.h>

#include "core/recon/recon.h"
#include "proto/patient.h"
#include "proto/recipe.h"

/* The file of one kept volume. */
struct saved_volume {
	char path[1024];
	size_t bytes;            /* of voxels, the header not counted */
	struct timespec written; /* saver_written */
};

/*
 * The pipeline over a directory, in three steps: opened, given its projections as
 * far as they have arrived, and finished. Each kept volume becomes a file of
 * out_directory and is announced twice: by on_volume as soon as everybody can read
 * it there, whole, and by on_settled when it is on the disk. However a run ends,
 * announced volumes are settled first, unless that is what failed: then its file is
 * removed. Where "final" is the same iterate as
 * the volume before it, it is another link to that file. The worker and `cbct
 * recon` both do it this way. One thread at a time.
 */
struct reconstruction_hooks {
	struct recon_hooks recon; /* any may be NULL, its context goes to all of these; keep is the reconstruction's own
				     and must be NULL here */
	int (*on_volume)(void *context, const struct kept_volume *volume, const struct saved_volume *saved,
			 struct error *err);
	int (*on_settled)(void *context, const char *name, struct error *err);
	/* A checkpoint of that iteration is on the disk in out_directory (proto/checkpoint.h). NULL where none are
	 * made. */
	int (*on_checkpoint)(void *context, int iteration, struct error *err);
	void (*on_open)(void *context, const struct recon_memory *memory, const char *plan);
	/* A step begins that may take so many seconds on a slow disk; 0: it is finished. */
	void (*on_step)(void *context, double seconds);
};

/* The scan, the recipe and the place of the results; all of it is borrowed until reconstruction_close. */
struct reconstruction_options {
	const char *scan_directory, *out_directory;
	/*
	 * In the daemon: the scan directory must have projections.sums (ERR_DAMAGED without), and the volumes'
	 * files end with their checksums (proto/seal.h).
	 */
	bool checked;
	/* A flag for each projection of scan.json: those that make up the scan, the others never come. NULL: all. */
	const unsigned char *present;
	const struct recipe *recipe;
	/* A volume with checksums that a recipe with a reference goes by, and its grid. NULL: such a recipe is refused.
	 */
	const char *reference;
	struct grid reference_grid;
	/* For the files' descriptions: the program, job and scan by their names ("" or NULL: none). */
	const char *program, *job, *scan;
	const struct patient *patient; /* NULL: as scan.json says */
	/*
	 * The checkpoint of a run that yielded or was broken off, or NULL; `iteration` is the one it holds as far
	 * as the caller knows, which has the history and the volumes so far. Where it is missing or damaged the other
	 * one of the directory serves, with a warning "damaged_checkpoint" (checkpoint_resume); rows of its history
	 * that the caller may not have come first. Without that: ERR_INVALID.
	 */
	const char *checkpoint;
	int iteration;
	double checkpoint_seconds; /* of work between two checkpoints; 0: none are made */
	const struct reconstruction_hooks *hooks;
};

struct reconstruction;
int reconstruction_open(const struct backend *backend, struct device *device,
			const struct reconstruction_options *options, struct reconstruction **ret_reconstruction,
			struct error *err);
void reconstruction_close(struct reconstruction *reconstruction); /* NULL is fine */

/* Projections that the reconstruction has, and that it wants in all. */
int reconstruction_pushed(const struct reconstruction *reconstruction);
int reconstruction_wanted(const struct reconstruction *reconstruction);
/*
 * Reads the next of the projections, by their numbers, until the first `count` of those that are present are there, and
 * reconstructs as far as they go. The order of the sum is always the same, and so are the bits, however many a call
 * brings. ERR_INVALID: there are not so many. ERR_DAMAGED: one does not fit its checksum, and none of it was used.
 */
int reconstruction_push(struct reconstruction *reconstruction, int count, struct error *err);
/* All that have not been pushed. */
int reconstruction_push_rest(struct reconstruction *reconstruction, struct error *err);
/*
 * Once, when all are there: the rest of the pipeline. A run that hooks->recon.yield ended returns ERR_BUSY and has
 * left its iterate as a checkpoint in OUT, durably.
 */
int reconstruction_finish(struct reconstruction *reconstruction, struct error *err);

/* The three in a row. */
int reconstruction_run(const struct backend *backend, struct device *device,
		       const struct reconstruction_options *options, struct error *err);

#endif

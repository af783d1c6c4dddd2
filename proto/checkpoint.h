#ifndef CBCT_PROTO_CHECKPOINT_H
#define CBCT_PROTO_CHECKPOINT_H

#include <stdbool.h>

#include "core/recon/recon.h"

/*
 * Checkpoints: all that a reconstruction needs to go on behind an iteration and to end with the bits
 * of a run that was never broken off. A file is a line of text padded to CHECKPOINT_FILE_OFFSET bytes
 * with iteration, size and noise, then float32 voxels [z][y][x], what the algorithm holds, the list of
 * metal where there is one, the history, five float64 for each iteration, and a seal (proto/seal.h). The directory has
 * two, the newest as CHECKPOINT_FILE and the one before it as CHECKPOINT_FILE_BEFORE, so that there is one to go on
 * from where the newest turns out to be damaged.
 */
#define CHECKPOINT_FILE "checkpoint.f32"
#define CHECKPOINT_FILE_BEFORE "checkpoint-before.f32"
enum { CHECKPOINT_FILE_OFFSET = 160 };

/* The rows of the iterations so far, in their order from the first on. */
struct history {
	struct history_row *rows; /* owned; free it */
	int count, room;
	double seconds; /* of all rows */
};
int history_add(struct history *history, const struct history_row *row, struct error *err);

/* Writes the checkpoint durably, as the only one. For a run that stops here. */
int checkpoint_save(struct recon *recon, const struct history *history, const char *directory, struct error *err);
/*
 * Opens the checkpoint of that iteration, whichever of the two files has it. ERR_NOT_FOUND: there is none. What it
 * holds is not looked at.
 */
int checkpoint_open(const char *directory, int iteration, int *ret_file, struct error *err);
/* The iteration that the first line of an open file names; 0: it is no checkpoint. */
int checkpoint_iteration(int file);
/* Whether the file is whole, by its seal. ERR_INVALID: it is not. */
int checkpoint_check(int file, struct error *err);
/* Removes the checkpoints of the directory. For a run that begins: they are of another one, and must not serve it. */
void checkpoint_remove(const char *directory);

/* The iteration that the checkpoint expected by the caller is of, and the latest that may serve where it is damaged. */
struct checkpoint_target {
	int iteration, latest;
};
/*
 * Gives an opened recon the checkpoint at `path`, or the one before it in the same directory: whichever is of the
 * target iteration, else the newest. Where that is missing or damaged the other one serves; *ret_damage
 * then says why, its code is 0 otherwise. The history is replaced by that of the checkpoint. Without any: ERR_INVALID.
 */
int checkpoint_resume(struct recon *recon, const char *path, const struct checkpoint_target *target,
		      struct history *history, struct error *ret_damage, struct error *err);

/*
 * Checkpoints of a run that goes on. The caller's thread copies the iterate into a file's pages, which another one
 * sends to the disk (saver.h), so that no memory is held and the iterations wait for the copy alone. One thread calls.
 */
struct checkpointer;
/* seconds: of work between two checkpoints. ahead: files are prepared while a device computes. */
int checkpointer_new(const char *directory, double seconds, bool ahead, struct checkpointer **ret, struct error *err);
/* The checkpoint on its way to the disk is not needed any more: nobody waits for it. */
void checkpointer_discard(struct checkpointer *checkpointer);
void checkpointer_free(struct checkpointer *checkpointer); /* waits for the disk; NULL is fine */
/*
 * Whether the next checkpoint is due: so many seconds of work after the last, or later where the copies
 * would take more than a fiftieth of the time, and the last one is on the disk. left: seconds of work until the run's
 * end, at most. One that would not be on the disk by then, as long as the last one took, is never due: nobody could go
 * on from it, and the volume at the end would wait for the disk behind it.
 */
bool checkpointer_due(const struct checkpointer *checkpointer, double left);
/*
 * Gets the next file's pages beside the work that goes on, where that is asked for and the checkpoint is due in a
 * second or less. For each iteration that leaves none; a hint.
 */
void checkpointer_prepare(struct checkpointer *checkpointer, const struct recon *recon, const struct history *history,
			  double left);
/*
 * Begins a checkpoint of the iterate as it is. A disk without room for it, and for a volume of the job beside it, is no
 * error: there is none then.
 */
int checkpointer_begin(struct checkpointer *checkpointer, struct recon *recon, const struct history *history,
		       struct error *err);
/* *ret_iteration: of the checkpoint that has reached the disk since the last call, 0: none has. */
int checkpointer_settled(struct checkpointer *checkpointer, bool wait, int *ret_iteration, struct error *err);

#endif

#ifndef CBCT_PROTO_REFINING_FILE_H
#define CBCT_PROTO_REFINING_FILE_H

#include "core/refine/refine.h"

/*
 * What a refinement has reached, in a file of the job's directory, so that a run that made room for another job, or
 * ended otherwise, goes on from there: a line of text padded to REFINING_OFFSET bytes with the number that says of
 * what it is, then the pieces of refine_state, and a seal (proto/seal.h). One thread.
 */
#define REFINING_FILE "refining"
enum { REFINING_OFFSET = 64 };

struct refining_file;
/*
 * Reads the file that is there, where it is whole and of this basis; any other one is as none, and will be written
 * over. seconds: of work between two of them. Free with refining_file_free.
 */
int refining_file_open(const char *directory, uint64_t basis, double seconds, struct refining_file **ret_file,
		       struct error *err);
void refining_file_free(struct refining_file *file); /* NULL is fine */
/* For refine_find; the file's own. */
const struct refine_keep *refining_file_keep(const struct refining_file *file);
/* Removes it: what it was for has been found, or is given up. */
void refining_file_remove(const char *directory);

#endif

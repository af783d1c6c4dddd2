#ifndef CBCT_TESTS_STATE_H
#define CBCT_TESTS_STATE_H

#include "daemon/jobs/job.h"

/* A state directory of its own for each test, and what tests of the store and the jobs do all the time. Failures end
 * the test. */
struct state {
	char directory[256];
	struct store *store;
	struct jobs *jobs;
	int failures; /* calls of the store's failed hook */
	int turns;    /* projections that state_put has stored */
};

/* The catalogue is in SQLite, or where CBCT_TEST_CATALOGUE says. */
struct store_options state_options(struct state *state);
void state_open(struct state *state);   /* a new directory */
void state_close(struct state *state);  /* as if the daemon had died: nothing is finished, the directory stays */
void state_reopen(struct state *state); /* close, and open the same directory */
void state_remove(struct state *state); /* close, and the directory goes */

/* The catalogue's file in the directory: without it the catalogue is lost. */
const char *state_catalogue(void);
/* What is about SQLite's own files is skipped, aloud, where the catalogue is another database's. */
bool state_skips(const char *test);
#define OF_SQLITE()                                                                                                    \
	do {                                                                                                           \
		if (state_skips(__func__))                                                                             \
			return;                                                                                        \
	} while (0)

/* Path of a file below the directory, in a buffer that the next call uses again. */
const char *state_path(const struct state *state, const char *format, ...) __attribute__((format(printf, 2, 3)));
bool path_exists(const char *path);
void path_fill(const char *path); /* a file of a few bytes */

/* A scan of `count` projections of 4 x 3 pixels; intensity: without air. */
struct stored_scan *state_scan(struct state *state, int count, bool intensity);
/* Claims, writes, syncs and records projections first .. last, whose first pixel is `mark`, with their checksums. */
void state_digest(int mark, uint8_t ret_sha256[32]); /* of one of them */
void state_put(struct state *state, struct stored_scan *scan, int first, int last, int mark);
/* FDK and two SART iterations. */
struct job *state_post(struct state *state, struct stored_scan *scan, const char *priority);
enum job_state state_of(struct job *job);
void state_set(struct job *job, enum job_state to, const struct job_change *change);

#endif

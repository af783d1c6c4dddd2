#ifndef CBCT_DAEMON_JOBS_OUTCOME_H
#define CBCT_DAEMON_JOBS_OUTCOME_H

#include "daemon/jobs/job.h"

/*
 * The decision what becomes of a job when its worker is through with it: one table, without clocks, sockets, locks or
 * files. The supervisor gathers the conditions, asks, and carries out the outcome (ending.c). Any thread.
 */

/* How a worker was through with its job: what its last message said, or what its process did. */
enum worker_end {
	END_DONE,      /* the last volume is there */
	END_MADE_ROOM, /* it left the job at an iteration, with a checkpoint */
	END_SYNC,      /* a sync failed: the disk is no longer trusted */
	END_DEVICE,    /* its device failed, and the process is about to exit */
	END_NO_SPACE,  /* the disk is full */
	END_IO,        /* a file could not be read or written; it may pass */
	END_NO_MEMORY, /* memory was not to be had, or the kernel has ended the process for want of it; it may pass */
	END_DAMAGED,   /* what it read of the scan does not fit its checksums */
	END_INVALID,   /* what it was given makes no sense to it, a checkpoint for one */
	END_OTHER,     /* any other error */
	END_DIED,      /* its process ended without a word about the job */
	END_STOPPED,   /* the same while the daemon stops */
	END_COUNT
};
/* For the code of a worker's last message about its job. */
enum worker_end worker_end_of(int code);

/* Conditions at that moment; bits. */
enum condition {
	CONDITION_CANCELLED = 1 << 0,  /* a client asked for the job's end */
	CONDITION_UNRECORDED = 1 << 1, /* the daemon could not record something of this run, and stopped it */
	CONDITION_FULL = 1 << 2,       /* ... for want of space on the disk */
	CONDITION_STALE = 1 << 3,      /* its scan is understood otherwise than when the worker began */
	CONDITION_ARRIVING = 1 << 4,   /* the job still waits for projections, which the worker attended */
	CONDITION_RESUMED = 1 << 5,    /* the worker began from a checkpoint */
	CONDITION_BROKEN = 1 << 6,     /* with this one, the job was broken off as often as it may be */
	CONDITION_DOUBTED = 1 << 7,    /* time and again, no file of a scan that a worker found damaged was damaged */
	CONDITION_ASKED = 1 << 8,      /* the worker was asked to make room */
	CONDITION_TROUBLE = 1 << 9,    /* with UNRECORDED: a file or memory could not be had, which may pass */
	CONDITION_ALL = (1 << 10) - 1
};

/* The point from which the job goes on. */
enum outcome_from {
	FROM_START,
	FROM_RECORDED, /* the checkpoint that the catalogue knows */
	FROM_SAID      /* the iteration of the worker's last message */
};

/* The author of the words and of the error code that the log and a failed job bear. */
enum outcome_words {
	WORDS_WORKER, /* what it said, or how it died */
	WORDS_DAEMON  /* why the daemon stopped the run */
};

struct outcome {
	enum job_state to;
	enum outcome_from from;
	enum outcome_words words;
	bool crashed; /* counts as a run that was broken off */
	bool yielded; /* it goes on later, which is no new attempt */
	enum job_obstacle obstacle;
	bool distrust;      /* the daemon ends: nothing more is acknowledged */
	bool check_scan;    /* all files of the scan are held against their checksums */
	bool warn;          /* the job bears the warning damaged_checkpoint */
	const char *reason; /* other words for the log; NULL: those above */
};

/* conditions: of enum condition. */
struct outcome outcome_of(enum worker_end end, unsigned conditions);

/* The worker takes no more jobs after this: its process is about to exit. */
bool worker_leaves(enum worker_end end, unsigned conditions);

/* For the tests: the number of rows, and the row that decides. */
extern const int outcome_rows;
int outcome_row(enum worker_end end, unsigned conditions);

#endif

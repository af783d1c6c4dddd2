/* The table of decisions at the end of a worker's job: outcome.h. The first row that fits decides. */
#include "daemon/jobs/outcome.h"

#include <assert.h>

/* Sets of ends. */
enum {
	ANY = (1 << END_COUNT) - 1,
	LOST = 1 << END_DIED | 1 << END_DEVICE /* the process is lost */
};
/* Where a job goes that its worker could not bring to an end: to the queue, or to wait on for projections. */
#define BACK JOB_STATE_COUNT

static const struct row {
	unsigned ends;   /* bits 1 << enum worker_end */
	unsigned when;   /* conditions that must all hold */
	unsigned unless; /* conditions of which none may hold */
	struct outcome outcome;
} rows[] = {
    /* After the next start, since nothing can be recorded any more. */
    {1 << END_SYNC, 0, 0, {.to = BACK, .distrust = true}},
    /* A cancel that was asked for is carried out when this is recorded: job_change_state. */
    {1 << END_STOPPED, 0, 0, {.to = BACK, .from = FROM_RECORDED, .reason = "the daemon stops"}},
    /* A job that a client has cancelled meanwhile succeeds too: the result is there. */
    {1 << END_DONE, 0, CONDITION_UNRECORDED | CONDITION_STALE, {.to = JOB_SUCCEEDED, .reason = ""}},
    {ANY, CONDITION_CANCELLED, 0, {.to = JOB_CANCELLED, .reason = ""}},
    /* A result that could not be recorded is lost, even where the worker was done before it heard of that. */
    {ANY,
     CONDITION_UNRECORDED | CONDITION_FULL,
     0,
     {.to = BACK, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE, .words = WORDS_DAEMON}},
    {ANY,
     CONDITION_UNRECORDED | CONDITION_TROUBLE,
     CONDITION_BROKEN,
     {.to = BACK, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_DISK_TROUBLE, .words = WORDS_DAEMON}},
    {ANY, CONDITION_UNRECORDED, 0, {.to = JOB_FAILED, .words = WORDS_DAEMON}},
    /* A stale run comes back too: the job that begins again sees that its basis differs, and leaves the checkpoint. */
    {1 << END_MADE_ROOM, 0, 0, {.to = BACK, .from = FROM_SAID, .yielded = true, .reason = "it made room"}},
    /* Whatever the worker says of it, and if it dies over it: that is no fault of the job's. */
    {ANY, CONDITION_STALE, 0, {.to = BACK, .reason = "its scan is understood otherwise now"}},
    {1 << END_NO_SPACE, 0, 0, {.to = BACK, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE}},
    {LOST | 1 << END_IO | 1 << END_NO_MEMORY, CONDITION_BROKEN, 0, {.to = JOB_FAILED, .crashed = true}},
    {LOST, 0, 0, {.to = BACK, .from = FROM_RECORDED, .crashed = true}},
    /* No descriptor was free, or a disk was slow to answer. */
    {1 << END_IO, 0, 0, {.to = BACK, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_DISK_TROUBLE}},
    {1 << END_NO_MEMORY, 0, 0, {.to = BACK, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_NO_MEMORY}},
    /* The files are whole, time and again: the memory of this worker or of its machine is at fault. */
    {1 << END_DAMAGED, CONDITION_DOUBTED, 0, {.to = JOB_FAILED}},
    /* The job waits until the files were checked, and for what is to be sent again. */
    {1 << END_DAMAGED, 0, 0, {.to = JOB_WAITING, .check_scan = true}},
    {1 << END_INVALID,
     CONDITION_RESUMED,
     0,
     {.to = JOB_QUEUED, .warn = true, .reason = "its checkpoint is damaged or gone: from the start"}},
    {ANY, 0, 0, {.to = JOB_FAILED}},
};

const int outcome_rows = sizeof(rows) / sizeof(rows[0]);

int outcome_row(enum worker_end end, unsigned conditions)
{
	for (int i = 0; i < outcome_rows; i++) {
		if ((rows[i].ends & 1u << end) != 0 && (conditions & rows[i].when) == rows[i].when &&
		    (conditions & rows[i].unless) == 0)
			return i;
	}
	assert(!"the last row fits everything");
	return outcome_rows - 1;
}

struct outcome outcome_of(enum worker_end end, unsigned conditions)
{
	struct outcome outcome = rows[outcome_row(end, conditions)].outcome;

	if (outcome.to == BACK)
		outcome.to = (conditions & CONDITION_ARRIVING) != 0 ? JOB_WAITING : JOB_QUEUED;
	return outcome;
}

bool worker_leaves(enum worker_end end, unsigned conditions)
{
	/* Without a request of ours, a signal from outside ended the process. */
	return end == END_DEVICE || (end == END_MADE_ROOM && (conditions & CONDITION_ASKED) == 0);
}

enum worker_end worker_end_of(int code)
{
	static const struct {
		int code;
		enum worker_end end;
	} ends[] = {{0, END_DONE},
		    {ERR_BUSY, END_MADE_ROOM},
		    {ERR_SYNC, END_SYNC},
		    {ERR_DEVICE, END_DEVICE},
		    {ERR_NO_SPACE, END_NO_SPACE},
		    {ERR_IO, END_IO},
		    {ERR_NO_MEMORY, END_NO_MEMORY},
		    {ERR_DAMAGED, END_DAMAGED},
		    {ERR_INVALID, END_INVALID}};

	for (size_t i = 0; i < sizeof(ends) / sizeof(ends[0]); i++) {
		if (ends[i].code == code)
			return ends[i].end;
	}
	return END_OTHER;
}

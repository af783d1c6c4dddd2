/* What becomes of a job when its worker is through with it: each row of the table, and what holds for all. */
#include <check.h>
#include <string.h>

#include "daemon/jobs/outcome.h"

enum {
	CANCELLED = CONDITION_CANCELLED,
	UNRECORDED = CONDITION_UNRECORDED,
	FULL = CONDITION_UNRECORDED | CONDITION_FULL,
	STALE = CONDITION_STALE,
	ARRIVING = CONDITION_ARRIVING,
	RESUMED = CONDITION_RESUMED,
	BROKEN = CONDITION_BROKEN,
	DOUBTED = CONDITION_DOUBTED,
	ASKED = CONDITION_ASKED,
	TROUBLE = CONDITION_TROUBLE
};

/* In the order of the table; a case names the row that is to decide it. */
static const struct {
	int row;
	enum worker_end end;
	unsigned conditions;
	struct outcome expected;
} cases[] = {
    /* A disk that is not trusted. */
    {0, END_SYNC, 0, {.to = JOB_QUEUED, .distrust = true}},
    {0, END_SYNC, ARRIVING, {.to = JOB_WAITING, .distrust = true}},
    {0, END_SYNC, CANCELLED, {.to = JOB_QUEUED, .distrust = true}},
    {0, END_SYNC, UNRECORDED, {.to = JOB_QUEUED, .distrust = true}},
    /* The daemon stops. */
    {1, END_STOPPED, 0, {.to = JOB_QUEUED, .from = FROM_RECORDED}},
    {1, END_STOPPED, ARRIVING, {.to = JOB_WAITING, .from = FROM_RECORDED}},
    {1, END_STOPPED, CANCELLED | BROKEN, {.to = JOB_QUEUED, .from = FROM_RECORDED}},
    /* Done. */
    {2, END_DONE, 0, {.to = JOB_SUCCEEDED}},
    {2, END_DONE, ARRIVING, {.to = JOB_SUCCEEDED}},
    {2, END_DONE, CANCELLED, {.to = JOB_SUCCEEDED}},
    {2, END_DONE, BROKEN | DOUBTED | RESUMED | ASKED, {.to = JOB_SUCCEEDED}},
    /* A client asked for the end. */
    {3, END_OTHER, CANCELLED, {.to = JOB_CANCELLED}},
    {3, END_DIED, CANCELLED | BROKEN, {.to = JOB_CANCELLED}},
    {3, END_DEVICE, CANCELLED, {.to = JOB_CANCELLED}},
    {3, END_MADE_ROOM, CANCELLED | ASKED, {.to = JOB_CANCELLED}},
    {3, END_DONE, CANCELLED | UNRECORDED, {.to = JOB_CANCELLED}},
    {3, END_DAMAGED, CANCELLED | STALE, {.to = JOB_CANCELLED}},
    /* The daemon could not record something. */
    {4, END_OTHER, FULL, {.to = JOB_QUEUED, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE, .words = WORDS_DAEMON}},
    {4,
     END_DONE,
     FULL | ARRIVING,
     {.to = JOB_WAITING, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE, .words = WORDS_DAEMON}},
    {4,
     END_DIED,
     FULL | BROKEN,
     {.to = JOB_QUEUED, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE, .words = WORDS_DAEMON}},
    {5,
     END_OTHER,
     UNRECORDED | TROUBLE,
     {.to = JOB_QUEUED, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_DISK_TROUBLE, .words = WORDS_DAEMON}},
    {5,
     END_DONE,
     UNRECORDED | TROUBLE | ARRIVING,
     {.to = JOB_WAITING, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_DISK_TROUBLE, .words = WORDS_DAEMON}},
    {6, END_OTHER, UNRECORDED | TROUBLE | BROKEN, {.to = JOB_FAILED, .words = WORDS_DAEMON}},
    {6, END_OTHER, UNRECORDED, {.to = JOB_FAILED, .words = WORDS_DAEMON}},
    {6, END_DONE, UNRECORDED | STALE, {.to = JOB_FAILED, .words = WORDS_DAEMON}},
    {6, END_DIED, UNRECORDED | ARRIVING, {.to = JOB_FAILED, .words = WORDS_DAEMON}},
    /* It made room. */
    {7, END_MADE_ROOM, ASKED, {.to = JOB_QUEUED, .from = FROM_SAID, .yielded = true}},
    {7, END_MADE_ROOM, ARRIVING | ASKED, {.to = JOB_WAITING, .from = FROM_SAID, .yielded = true}},
    {7, END_MADE_ROOM, STALE, {.to = JOB_QUEUED, .from = FROM_SAID, .yielded = true}},
    /* The scan is understood otherwise. */
    {8, END_OTHER, STALE, {.to = JOB_QUEUED}},
    {8, END_OTHER, STALE | ARRIVING, {.to = JOB_WAITING}},
    {8, END_DONE, STALE, {.to = JOB_QUEUED}},
    {8, END_DIED, STALE | BROKEN, {.to = JOB_QUEUED}},
    {8, END_DAMAGED, STALE | DOUBTED, {.to = JOB_QUEUED}},
    /* The disk is full. */
    {9, END_NO_SPACE, 0, {.to = JOB_QUEUED, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE}},
    {9, END_NO_SPACE, ARRIVING | BROKEN, {.to = JOB_WAITING, .from = FROM_RECORDED, .obstacle = JOB_NO_SPACE}},
    /* Broken off as often as may be. */
    {10, END_DIED, BROKEN, {.to = JOB_FAILED, .crashed = true}},
    {10, END_DEVICE, BROKEN, {.to = JOB_FAILED, .crashed = true}},
    {10, END_IO, BROKEN | ARRIVING, {.to = JOB_FAILED, .crashed = true}},
    {10, END_NO_MEMORY, BROKEN, {.to = JOB_FAILED, .crashed = true}},
    /* Broken off, and tried again. */
    {11, END_DIED, 0, {.to = JOB_QUEUED, .from = FROM_RECORDED, .crashed = true}},
    {11, END_DIED, ARRIVING, {.to = JOB_WAITING, .from = FROM_RECORDED, .crashed = true}},
    {11, END_DEVICE, RESUMED, {.to = JOB_QUEUED, .from = FROM_RECORDED, .crashed = true}},
    {12, END_IO, 0, {.to = JOB_QUEUED, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_DISK_TROUBLE}},
    {12, END_IO, ARRIVING, {.to = JOB_WAITING, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_DISK_TROUBLE}},
    {13, END_NO_MEMORY, 0, {.to = JOB_QUEUED, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_NO_MEMORY}},
    {13,
     END_NO_MEMORY,
     ARRIVING | RESUMED,
     {.to = JOB_WAITING, .from = FROM_RECORDED, .crashed = true, .obstacle = JOB_NO_MEMORY}},
    /* The scan is damaged, or the worker's memory. */
    {14, END_DAMAGED, DOUBTED, {.to = JOB_FAILED}},
    {15, END_DAMAGED, 0, {.to = JOB_WAITING, .check_scan = true}},
    {15, END_DAMAGED, ARRIVING | BROKEN, {.to = JOB_WAITING, .check_scan = true}},
    /* The checkpoint is damaged. */
    {16, END_INVALID, RESUMED, {.to = JOB_QUEUED, .warn = true}},
    /* Anything else is the job's own failure. */
    {17, END_INVALID, 0, {.to = JOB_FAILED}},
    {17, END_OTHER, 0, {.to = JOB_FAILED}},
    {17, END_OTHER, ARRIVING | RESUMED | BROKEN | DOUBTED | ASKED, {.to = JOB_FAILED}},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]) };

START_TEST(each_case_is_decided_by_its_row)
{
	const struct outcome *expected = &cases[_i].expected;
	struct outcome outcome = outcome_of(cases[_i].end, cases[_i].conditions);

	ck_assert_int_eq(outcome_row(cases[_i].end, cases[_i].conditions), cases[_i].row);
	ck_assert_int_eq(outcome.to, expected->to);
	ck_assert_int_eq(outcome.from, expected->from);
	ck_assert_int_eq(outcome.words, expected->words);
	ck_assert_int_eq(outcome.crashed, expected->crashed);
	ck_assert_int_eq(outcome.yielded, expected->yielded);
	ck_assert_int_eq(outcome.obstacle, expected->obstacle);
	ck_assert_int_eq(outcome.distrust, expected->distrust);
	ck_assert_int_eq(outcome.check_scan, expected->check_scan);
	ck_assert_int_eq(outcome.warn, expected->warn);
}
END_TEST

START_TEST(each_row_decides_a_case)
{
	for (int row = 0; row < outcome_rows; row++) {
		bool found = false;

		for (int i = 0; i < CASES; i++)
			found |= cases[i].row == row;
		ck_assert_msg(found, "row %d", row);
	}
}
END_TEST

/* All 12288 combinations of an end and conditions. */
START_TEST(what_holds_for_every_end)
{
	enum worker_end end = (enum worker_end)_i;

	for (unsigned conditions = 0; conditions <= CONDITION_ALL; conditions++) {
		struct outcome outcome = outcome_of(end, conditions);
		enum job_state from = (conditions & ARRIVING) != 0 ? JOB_WAITING : JOB_RUNNING;
		bool back = outcome.to == JOB_QUEUED || outcome.to == JOB_WAITING;

		/* A job that waits is recorded as running before it succeeds; every other way is one step. */
		ck_assert(job_state_may_follow(outcome.to == JOB_SUCCEEDED ? JOB_RUNNING : from, outcome.to));
		/* Success is what the worker says, and nothing that was lost or is stale succeeds. */
		if (outcome.to == JOB_SUCCEEDED)
			ck_assert(end == END_DONE && (conditions & (UNRECORDED | STALE)) == 0);
		/* A job that was not asked to end is not cancelled. */
		if (outcome.to == JOB_CANCELLED)
			ck_assert((conditions & CANCELLED) != 0);
		/* One that was asked to end is through, but where only the next start can record it. */
		if ((conditions & CANCELLED) != 0 && end != END_SYNC && end != END_STOPPED)
			ck_assert(job_state_ended(outcome.to));
		/* No job is tried for ever: what counts against it fails it in the end. */
		if (outcome.crashed && (conditions & BROKEN) != 0)
			ck_assert_int_eq(outcome.to, JOB_FAILED);
		if (outcome.check_scan)
			ck_assert((conditions & DOUBTED) == 0);
		/* What no longer holds is not gone on from. */
		if ((conditions & STALE) != 0 && back && end != END_MADE_ROOM && end != END_STOPPED &&
		    outcome.words != WORDS_DAEMON)
			ck_assert_int_eq(outcome.from, FROM_START);
		/* An end has no checkpoint, no obstacle and no second run. */
		if (!back)
			ck_assert(outcome.from == FROM_START && outcome.obstacle == JOB_UNHINDERED && !outcome.yielded);
		ck_assert(!worker_leaves(end, conditions) || end == END_DEVICE || end == END_MADE_ROOM);
	}
}
END_TEST

START_TEST(a_code_says_how_a_worker_was_through)
{
	ck_assert_int_eq(worker_end_of(0), END_DONE);
	ck_assert_int_eq(worker_end_of(ERR_BUSY), END_MADE_ROOM);
	ck_assert_int_eq(worker_end_of(ERR_SYNC), END_SYNC);
	ck_assert_int_eq(worker_end_of(ERR_DEVICE), END_DEVICE);
	ck_assert_int_eq(worker_end_of(ERR_NO_SPACE), END_NO_SPACE);
	ck_assert_int_eq(worker_end_of(ERR_IO), END_IO);
	ck_assert_int_eq(worker_end_of(ERR_DAMAGED), END_DAMAGED);
	ck_assert_int_eq(worker_end_of(ERR_INVALID), END_INVALID);
	ck_assert_int_eq(worker_end_of(ERR_NO_MEMORY), END_NO_MEMORY);
	ck_assert_int_eq(worker_end_of(ERR_CANCELLED), END_OTHER);
}
END_TEST

START_TEST(a_worker_that_was_not_asked_to_make_room_leaves)
{
	ck_assert(worker_leaves(END_DEVICE, 0));
	ck_assert(worker_leaves(END_DEVICE, CANCELLED | ASKED));
	ck_assert(worker_leaves(END_MADE_ROOM, 0));
	ck_assert(!worker_leaves(END_MADE_ROOM, ASKED));
	ck_assert(!worker_leaves(END_DONE, 0));
	ck_assert(!worker_leaves(END_SYNC, 0));
}
END_TEST

Suite *outcome_suite(void)
{
	Suite *suite = suite_create("outcome");
	TCase *tests = tcase_create("outcome");

	tcase_add_loop_test(tests, each_case_is_decided_by_its_row, 0, CASES);
	tcase_add_test(tests, each_row_decides_a_case);
	tcase_add_loop_test(tests, what_holds_for_every_end, 0, END_COUNT);
	tcase_add_test(tests, a_code_says_how_a_worker_was_through);
	tcase_add_test(tests, a_worker_that_was_not_asked_to_make_room_leaves);
	suite_add_tcase(suite, tests);
	return suite;
}

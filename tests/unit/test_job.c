/* The life of a job: its states, its place in the queue, what a restart makes of it. */
#include <check.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "daemon/jobs/digest.h"
#include "daemon/problem.h"
#include "proto/clock.h"
#include "daemon/api/document.h"
#include "daemon/files.h"
#include "proto/durable.h"
#include "proto/format.h"
#include "proto/seal.h"
#include "proto/scan_directory.h"
#include "tests/unit/state.h"

static struct state state;
static struct stored_scan *scan; /* complete; NULL after a restart */

static void set_up(void)
{
	state_open(&state);
	scan = state_scan(&state, 4, false);
	state_put(&state, scan, 0, 3, 1);
}

static const struct job_change on_some = {.backend = "cpu", .device = "some", .ran_on = "0"};

static void tear_down(void)
{
	stored_scan_release(scan);
	scan = NULL;
	state_remove(&state);
}

static void restart(void)
{
	stored_scan_release(scan);
	scan = NULL;
	state_reopen(&state);
}

static struct job *find(const char *id)
{
	struct job *job = NULL;
	struct error err = {0};

	ck_assert_msg(jobs_find(state.jobs, id, &job, &err) == 0, "%s", err.text);
	return job;
}

static void keep_id(struct job *job, char ret_id[ID_SIZE])
{
	struct job_facts facts;

	job_facts(job, &facts);
	memcpy(ret_id, facts.id, ID_SIZE);
}

static void add_row(struct job *job, int iteration)
{
	const struct history_row row = {
	    .iteration = iteration, .residual = 0.5 / iteration, .change = 0.1, .tv = 3, .seconds = 2};
	struct error err = {0};

	ck_assert_msg(job_add_rows(job, &row, 1, &err) == 0, "%s", err.text);
}

static int rows_of(const char *id)
{
	struct history_row *rows;
	struct error err = {0};
	int count;

	ck_assert_int_eq(store_job_rows(state.store, id, &rows, &count, &err), 0);
	free(rows);
	return count;
}

START_TEST(the_table_of_transitions_is_the_contracts)
{
	/* rows: from, columns: to; waiting, queued, running, succeeded, failed, cancelled */
	static const char *const expected[JOB_STATE_COUNT] = {"wqr.fc", "w.r.fc", "wq.sfc",
							      "......", "......", "......"};

	for (int from = 0; from < JOB_STATE_COUNT; from++)
		for (int to = 0; to < JOB_STATE_COUNT; to++)
			ck_assert_msg(job_state_may_follow((enum job_state)from, (enum job_state)to) ==
					  (expected[from][to] != '.'),
				      "%s -> %s", job_state_names[from], job_state_names[to]);
}
END_TEST

START_TEST(what_the_table_forbids_changes_nothing)
{
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};

	ck_assert_int_eq(job_set_state(job, JOB_SUCCEEDED, NULL, &err), ERR_CONFLICT);
	ck_assert_int_eq(state_of(job), JOB_QUEUED);
	ck_assert_int_eq(job_queue_position(job), 1);
	job_release(job);
}
END_TEST

START_TEST(a_job_waits_for_its_last_projection)
{
	struct stored_scan *growing = state_scan(&state, 3, false);
	struct job *job = state_post(&state, growing, "routine");
	struct error err = {0};

	ck_assert_int_eq(state_of(job), JOB_WAITING);
	state_put(&state, growing, 0, 1, 1);
	ck_assert_int_eq(jobs_promote(state.jobs, &err), 0);
	ck_assert_int_eq(state_of(job), JOB_WAITING);
	state_put(&state, growing, 2, 2, 1);
	ck_assert_int_eq(jobs_promote(state.jobs, &err), 0);
	ck_assert_int_eq(state_of(job), JOB_QUEUED);
	job_release(job);
	stored_scan_release(growing);
}
END_TEST

START_TEST(a_waiting_job_is_attended_and_runs_with_its_last_projection)
{
	struct stored_scan *growing = state_scan(&state, 3, false);
	struct job *job = state_post(&state, growing, "routine"), *found;
	const struct job_change died = {.crashed = true};
	struct job_record record;
	struct error err = {0};
	bool arriving;

	found = jobs_arriving(state.jobs, 0, NULL, &arriving);
	ck_assert_ptr_eq(found, job); /* also before anything has come */
	ck_assert(!arriving);
	job_release(found);
	ck_assert_int_eq(job_attend(job, &on_some, &err), 0);
	ck_assert_ptr_null(jobs_arriving(state.jobs, 0, NULL, &arriving));
	job_reconstructed(job, 2);
	/* its scan is ready, but it is in a worker's hands */
	state_put(&state, growing, 0, 2, 1);
	ck_assert_int_eq(jobs_promote(state.jobs, &err), 0);
	ck_assert_int_eq(state_of(job), JOB_WAITING);
	job_record(job, &record);
	ck_assert(record.attended && record.reconstructed == 2 && record.attempts == 0);
	/* a worker that dies with it is an attempt, one that leaves is none */
	state_set(job, JOB_WAITING, &died);
	job_record(job, &record);
	ck_assert(!record.attended && record.reconstructed == 0 && record.attempts == 2 && record.crashes == 1);
	ck_assert_int_eq(job_attend(job, &on_some, &err), 0);
	ck_assert_int_eq(job_leave(job, &err), 0);
	ck_assert_int_eq(state_of(job), JOB_WAITING);
	ck_assert_int_eq(job_attend(job, &on_some, &err), 0);
	state_set(job, JOB_RUNNING, NULL);
	job_record(job, &record);
	ck_assert(!record.attended && record.attempts == 2 && record.ticket > 0 && record.queued > 0);
	ck_assert_int_eq(job_attend(job, &on_some, &err), ERR_CONFLICT);
	job_release(job);
	stored_scan_release(growing);
}
END_TEST

START_TEST(who_arrives_goes_before_who_does_not_then_the_higher_priority)
{
	struct stored_scan *a = state_scan(&state, 3, false), *b = state_scan(&state, 3, false);
	struct job *stat = state_post(&state, a, "stat"), *routine = state_post(&state, b, "routine"), *found;
	bool arriving;

	found = jobs_arriving(state.jobs, 0, NULL, &arriving);
	ck_assert_ptr_eq(found, stat);
	ck_assert(!arriving);
	job_release(found);
	state_put(&state, b, 0, 0, 1);
	found = jobs_arriving(state.jobs, 1, NULL, &arriving);
	ck_assert_ptr_eq(found, routine);
	ck_assert(arriving);
	job_release(found);
	found =
	    jobs_arriving(state.jobs, 1e300, NULL, &arriving); /* that was long ago, but the other has had none yet */
	ck_assert_ptr_eq(found, routine);
	ck_assert(!arriving);
	job_release(found);
	state_put(&state, a, 0, 0, 1);
	state_put(&state, b, 1, 1, 1);
	found = jobs_arriving(state.jobs, 1, NULL, &arriving); /* both at once */
	ck_assert_ptr_eq(found, stat);
	job_release(found);
	job_release(stat);
	job_release(routine);
	stored_scan_release(a);
	stored_scan_release(b);
}
END_TEST

/* A worker was lost over the job, which is about to go back to the queue or to wait when the DELETE comes. */
START_TEST(a_cancel_that_comes_between_the_end_of_a_worker_and_its_record_is_carried_out)
{
	const enum job_state back[] = {JOB_QUEUED, JOB_WAITING};
	const struct job_change died = {.crashed = true};

	for (int i = 0; i < 2; i++) {
		struct job *job = state_post(&state, scan, "routine");
		struct error err = {0};
		bool removed;

		state_set(job, JOB_RUNNING, NULL);
		ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), 0);
		ck_assert_int_eq(state_of(job), JOB_RUNNING);
		state_set(job, back[i], &died);
		ck_assert_int_eq(state_of(job), JOB_CANCELLED);
		ck_assert_ptr_null(jobs_next(state.jobs, NULL));
		job_release(job);
	}
}
END_TEST

START_TEST(a_cancel_of_an_attended_job_waits_for_its_worker_or_a_restart)
{
	struct stored_scan *growing = state_scan(&state, 3, false);
	struct error err = {0};
	char id[ID_SIZE];
	bool removed;

	for (int restarts = 0; restarts < 2; restarts++) {
		struct job *job = state_post(&state, growing, "routine");

		keep_id(job, id);
		ck_assert_int_eq(job_attend(job, &on_some, &err), 0);
		ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), 0);
		ck_assert(!removed);
		ck_assert_int_eq(state_of(job), JOB_WAITING);
		if (restarts == 0)
			ck_assert_int_eq(job_leave(job, &err), 0);
		job_release(job);
		if (restarts > 0) {
			stored_scan_release(growing);
			restart();
		}
		job = find(id);
		ck_assert_int_eq(state_of(job), JOB_CANCELLED);
		job_release(job);
	}
}
END_TEST

START_TEST(a_waiting_job_is_found_again_after_a_restart)
{
	struct stored_scan *growing = state_scan(&state, 3, false);
	struct job *job = state_post(&state, growing, "routine"), *found;
	bool arriving;

	state_put(&state, growing, 1, 1, 1);
	stored_scan_release(growing);
	job_release(job);
	restart();
	found = jobs_arriving(state.jobs, 1, NULL, &arriving);
	ck_assert_ptr_nonnull(found);
	ck_assert(!arriving); /* in this life */
	ck_assert_int_eq(state_of(found), JOB_WAITING);
	job_release(found);
}
END_TEST

START_TEST(one_that_yielded_stands_in_front_of_its_class)
{
	struct job *first = state_post(&state, scan, "routine"), *second = state_post(&state, scan, "routine");
	struct job *stat = state_post(&state, scan, "stat"), *next;
	const struct job_change yielded = {.checkpoint = 1, .yielded = true};

	state_set(stat, JOB_CANCELLED, NULL);
	next = jobs_next(state.jobs, NULL);
	ck_assert_ptr_eq(next, first);
	job_release(next);
	state_set(first, JOB_RUNNING, NULL);
	ck_assert_int_eq(job_queue_position(second), 1);
	state_set(first, JOB_QUEUED, &yielded);
	ck_assert_int_eq(job_queue_position(first), 1);
	ck_assert_int_eq(job_queue_position(second), 2);
	job_release(first);
	job_release(second);
	job_release(stat);
}
END_TEST

START_TEST(only_a_run_from_the_start_is_an_attempt)
{
	struct job *job = state_post(&state, scan, "routine");
	const struct job_change yielded = {.checkpoint = 1, .yielded = true}, died = {.checkpoint = 1, .crashed = true};
	struct job_record record;

	state_set(job, JOB_RUNNING, NULL);
	state_set(job, JOB_QUEUED, &yielded);
	state_set(job, JOB_RUNNING, NULL);
	job_record(job, &record);
	ck_assert_int_eq(record.attempts, 1);
	ck_assert_int_eq(record.iteration, 1);
	state_set(job, JOB_QUEUED, &died);
	state_set(job, JOB_RUNNING, NULL);
	job_record(job, &record);
	ck_assert_int_eq(record.attempts, 2);
	ck_assert_int_eq(record.crashes, 1);
	job_release(job);
}
END_TEST

START_TEST(a_running_job_that_has_a_time_left_keeps_one)
{
	struct job *job = state_post(&state, scan, "routine");
	const struct job_change yielded = {.checkpoint = 1, .yielded = true};

	state_set(job, JOB_RUNNING, NULL);
	ck_assert_double_lt(job_eta(job), 0);
	job_progress(job, STAGE_SART, 0, 0.5);
	ck_assert_double_ge(job_eta(job), 0);
	/* Of this run nothing is done yet. */
	state_set(job, JOB_QUEUED, &yielded);
	state_set(job, JOB_RUNNING, NULL);
	ck_assert_double_ge(job_eta(job), 0);
	job_release(job);
}
END_TEST

START_TEST(a_running_job_is_queued_again_after_a_restart)
{
	struct job *first = state_post(&state, scan, "routine"), *second = state_post(&state, scan, "routine");
	struct job_record record;
	char first_id[ID_SIZE], second_id[ID_SIZE];

	keep_id(first, first_id);
	keep_id(second, second_id);
	state_set(first, JOB_RUNNING, NULL);
	add_row(first, 1);
	job_release(first);
	job_release(second);
	restart();
	first = find(first_id);
	second = find(second_id);
	ck_assert_int_eq(state_of(first), JOB_QUEUED);
	ck_assert_int_eq(job_queue_position(first), 1);
	ck_assert_int_eq(job_queue_position(second), 2);
	ck_assert_int_eq(rows_of(first_id), 0); /* it starts anew */
	state_set(first, JOB_RUNNING, NULL);
	job_record(first, &record);
	ck_assert_int_eq(record.attempts, 2);
	ck_assert_int_eq(record.crashes, 0);
	/* The time before the restart is not known, so none is made up. */
	ck_assert_double_lt(record.seconds[STAGE_LOAD], 60);
	job_release(first);
	job_release(second);
}
END_TEST

START_TEST(a_checkpoint_is_kept_over_a_restart_where_its_file_is)
{
	struct job *with = state_post(&state, scan, "routine"), *without = state_post(&state, scan, "routine");
	const struct job_change yielded = {.checkpoint = 1, .yielded = true};
	struct job_record record;
	struct error err = {0};
	char with_id[ID_SIZE], without_id[ID_SIZE];

	keep_id(with, with_id);
	keep_id(without, without_id);
	ck_assert_int_eq(directory_make(state_path(&state, "jobs/%s", with_id), &err), 0);
	path_fill(state_path(&state, "jobs/%s/checkpoint.f32", with_id));
	path_fill(state_path(&state, "jobs/%s/refining", with_id));
	for (int i = 0; i < 2; i++) {
		struct job *job = i == 0 ? with : without;

		state_set(job, JOB_RUNNING, NULL);
		add_row(job, 1);
		state_set(job, JOB_QUEUED, &yielded);
		state_set(job, JOB_RUNNING, NULL);
		add_row(job, 2);
		job_release(job);
	}
	restart();
	with = find(with_id);
	without = find(without_id);
	job_record(with, &record);
	ck_assert_int_eq(record.checkpoint, 1);
	ck_assert_int_eq(rows_of(with_id), 1); /* what came behind the checkpoint comes again */
	job_record(without, &record);
	ck_assert_int_eq(record.checkpoint, 0);
	ck_assert_int_eq(rows_of(without_id), 0);
	ck_assert(path_exists(state_path(&state, "jobs/%s/refining", with_id)));
	state_set(with, JOB_RUNNING, NULL);
	state_set(with, JOB_CANCELLED, NULL);
	ck_assert(!path_exists(state_path(&state, "jobs/%s/checkpoint.f32", with_id)));
	ck_assert(!path_exists(state_path(&state, "jobs/%s/refining", with_id)));
	job_release(with);
	job_release(without);
	/* As a daemon leaves it that dies before it has removed the files of a job that has ended. */
	path_fill(state_path(&state, "jobs/%s/checkpoint-before.f32", with_id));
	restart();
	ck_assert(!path_exists(state_path(&state, "jobs/%s/checkpoint-before.f32", with_id)));
}
END_TEST

START_TEST(a_failed_job_reads_the_same_after_a_restart)
{
	const struct job_change failed = {.error_code = ERR_IO, .error_text = "no more"};
	struct job *job = state_post(&state, scan, "routine");
	struct job_record before, after;
	char id[ID_SIZE];

	state_set(job, JOB_RUNNING, NULL);
	job_reconstructed(job, 3);
	state_set(job, JOB_FAILED, &failed);
	job_record(job, &before);
	keep_id(job, id);
	job_release(job);
	restart();
	job = find(id);
	job_record(job, &after);
	ck_assert_int_eq(after.state, JOB_FAILED);
	ck_assert_int_eq(before.reconstructed, after.reconstructed);
	ck_assert(before.fraction == after.fraction && before.iteration == after.iteration);
	ck_assert_str_eq(before.error_text, after.error_text);
	job_release(job);
}
END_TEST

START_TEST(a_cancel_that_was_asked_for_survives_a_restart)
{
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};
	char id[ID_SIZE];
	bool removed;

	keep_id(job, id);
	state_set(job, JOB_RUNNING, NULL);
	ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), 0);
	ck_assert(!removed);
	ck_assert_int_eq(state_of(job), JOB_RUNNING); /* until its worker has heard of it */
	job_release(job);
	restart();
	job = find(id);
	ck_assert_int_eq(state_of(job), JOB_CANCELLED);
	job_release(job);
}
END_TEST

START_TEST(deleting_cancels_first_and_then_removes)
{
	struct job *job = state_post(&state, scan, "routine"), *gone = NULL;
	struct error err = {0};
	char id[ID_SIZE];
	bool removed;

	keep_id(job, id);
	ck_assert_int_eq(directory_make(state_path(&state, "jobs/%s", id), &err), 0);
	path_fill(state_path(&state, "jobs/%s/final.nii", id));
	ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), 0);
	ck_assert(!removed);
	ck_assert_int_eq(state_of(job), JOB_CANCELLED);
	ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), 0);
	ck_assert(removed);
	ck_assert_int_eq(jobs_find(state.jobs, id, &gone, &err), ERR_NOT_FOUND);
	ck_assert(!path_exists(state_path(&state, "jobs/%s", id)));
	ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), ERR_NOT_FOUND);
	job_release(job);
}
END_TEST

START_TEST(a_scan_stays_while_a_job_needs_it)
{
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};

	ck_assert_int_eq(jobs_delete_scan(state.jobs, scan, &err), ERR_CONFLICT);
	state_set(job, JOB_CANCELLED, NULL);
	ck_assert_int_eq(jobs_delete_scan(state.jobs, scan, &err), 0);
	job_release(job);
}
END_TEST

static int post_with_key(const char *key, int mark, struct job **ret_job, bool *ret_new, struct error *err)
{
	struct job_request request;
	uint8_t digest[32];
	char text[128];
	int code;

	memset(digest, mark, sizeof(digest));
	snprintf(text, sizeof(text), "{\"scan\": \"%s\", \"fdk\": {}}", stored_scan_id(scan));
	ck_assert_int_eq(job_request_parse(text, strlen(text), &request, err), 0);
	ck_assert_int_eq(job_request_resolve(&request, stored_scan_parsed(scan), err), 0);
	code = jobs_post(state.jobs, &request, scan, NULL, "somebody", key, digest, ret_job, ret_new, err);
	job_request_clear(&request);
	return code;
}

START_TEST(a_key_makes_one_job_also_over_a_restart)
{
	struct job *job = NULL, *again = NULL;
	struct error err = {0};
	uint8_t digest[32];
	char id[ID_SIZE];
	bool new;

	ck_assert_int_eq(post_with_key("a key", 1, &job, &new, &err), 0);
	ck_assert(new);
	ck_assert_int_eq(post_with_key("a key", 1, &again, &new, &err), 0);
	ck_assert(!new);
	ck_assert_ptr_eq(job, again);
	job_release(again);
	ck_assert_int_eq(post_with_key("a key", 2, &again, &new, &err), ERR_CONFLICT);
	ck_assert_int_eq(post_with_key("another", 2, &again, &new, &err), 0);
	ck_assert(new);
	job_release(again);
	keep_id(job, id);
	job_release(job);
	restart();
	memset(digest, 1, sizeof(digest));
	ck_assert_int_eq(jobs_repeat(state.jobs, "a key", digest, &job, &err), 0);
	ck_assert_ptr_nonnull(job);
	keep_id(job, id);
	job_release(job);
	ck_assert_int_eq(jobs_repeat(state.jobs, "unheard of", digest, &job, &err), 0);
	ck_assert_ptr_null(job);
}
END_TEST

static void expect_warnings(const char *id, int expected, const char *const *details)
{
	struct warning_record *warnings;
	struct error err = {0};
	int count;

	ck_assert_int_eq(store_job_warnings(state.store, id, &warnings, &count, &err), 0);
	ck_assert_int_eq(count, expected);
	for (int i = 0; i < count; i++)
		ck_assert_ptr_nonnull(strstr(warnings[i].detail, details[i]));
	free(warnings);
}

static void damage(struct job *job, const char *volume, const char *why)
{
	struct error words, err = {0};

	ck_assert_int_eq(store_volume_damaged(volume, why, &words), ERR_DAMAGED);
	ck_assert_int_eq(job_add_warning(job, "damaged_volume", words.text, &err), 0);
}

START_TEST(a_damaged_volume_has_one_warning_until_it_is_whole)
{
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};
	char id[ID_SIZE];

	keep_id(job, id);
	damage(job, "iter-1", "block 2 of 4");
	damage(job, "iter-10", "block 3 of 4");
	damage(job, "iter-1", "its header");
	damage(job, "iter-1", "its header");
	ck_assert_int_eq(job_add_warning(job, "arc", "the volume iter-1 is damaged on the disk", &err), 0);
	expect_warnings(id, 3,
			(const char *[]){"iter-10 is damaged on the disk (block 3", "(its header)", "iter-1 is"});
	damage(job, "iter-10", "its file is gone");
	expect_warnings(id, 3,
			(const char *[]){"(its header)", "iter-1 is", "iter-10 is damaged on the disk (its file"});
	job_volume_whole(job, "iter-1");
	job_volume_whole(job, "final");
	expect_warnings(id, 2, (const char *[]){"iter-1 is", "iter-10"});
	job_volume_whole(job, "iter-10");
	job_release(job);
	restart();
	expect_warnings(id, 1, (const char *[]){"iter-1 is"});
}
END_TEST

START_TEST(events_come_in_order_from_where_one_left_off)
{
	static const char *const expected[] = {"state",  "state",    "warning", "progress",
					       "volume", "progress", "state",   "end"};
	const struct volume_record volume = {
	    .name = "iter-1", .stage = "sart", .iteration = 1, .grid = {.size = {4, 4, 4}}, .bytes = 256};
	struct job *job = state_post(&state, scan, "routine");
	struct event_record *events;
	struct error err = {0};
	char id[ID_SIZE];
	long long third;
	int count;

	keep_id(job, id);
	state_set(job, JOB_RUNNING, NULL);
	ck_assert_int_eq(job_add_warning(job, "arc", "too short", &err), 0);
	ck_assert_int_eq(job_add_warning(job, "arc", "too short", &err), 0); /* said once */
	add_row(job, 1);
	path_fill(state_path(&state, "jobs/%s/iter-1.nii", id)); /* else the next start tells that it is gone */
	ck_assert_int_eq(job_add_volume(job, &volume, &err), 0);
	add_row(job, 1); /* what a lost run had done is done again, and not told again */
	ck_assert_int_eq(job_add_volume(job, &volume, &err), 0);
	add_row(job, 2);
	state_set(job, JOB_SUCCEEDED, NULL);
	job_release(job);
	restart();
	ck_assert_int_eq(store_job_events(state.store, id, 0, 100, &events, &count, &err), 0);
	ck_assert_int_eq(count, 8);
	for (int i = 0; i < count; i++) {
		ck_assert_str_eq(events[i].kind, expected[i]);
		ck_assert_str_eq(events[i].job, id);
		if (i > 0)
			ck_assert_int_gt(events[i].number, events[i - 1].number);
	}
	ck_assert_int_eq(store_last_event(state.store), events[7].number);
	third = events[2].number;
	event_records_free(events, count);
	ck_assert_int_eq(store_job_events(state.store, NULL, third, 2, &events, &count, &err), 0);
	ck_assert_int_eq(count, 2);
	ck_assert_str_eq(events[0].kind, "progress");
	ck_assert_str_eq(events[1].kind, "volume");
	event_records_free(events, count);
}
END_TEST

START_TEST(rows_of_one_commit_are_told_one_by_one)
{
	struct job *job = state_post(&state, scan, "routine");
	struct history_row rows[JOB_ROWS_MAX];
	struct store_statistics before, after;
	struct event_record *events;
	struct error err = {0};
	char id[ID_SIZE], start[32];
	int count;

	keep_id(job, id);
	state_set(job, JOB_RUNNING, NULL);
	add_row(job, 1);
	for (int i = 0; i < JOB_ROWS_MAX; i++)
		rows[i] = (struct history_row){.iteration = i + 1};
	store_statistics(state.store, &before);
	ck_assert_int_eq(job_add_rows(job, rows, JOB_ROWS_MAX, &err), 0);
	store_statistics(state.store, &after);
	ck_assert_int_eq((int)(after.commits - before.commits), 1);
	job_release(job);
	ck_assert_int_eq(rows_of(id), JOB_ROWS_MAX);
	ck_assert_int_eq(store_job_events(state.store, id, 0, 100, &events, &count, &err), 0);
	ck_assert_int_eq(count, 2 + JOB_ROWS_MAX); /* the first row was told before */
	for (int i = 0; i < JOB_ROWS_MAX; i++) {
		snprintf(start, sizeof(start), "{\"iteration\":%d,", i + 1);
		ck_assert_str_eq(events[2 + i].kind, "progress");
		ck_assert_msg(strncmp(events[2 + i].data, start, strlen(start)) == 0, "%s", events[2 + i].data);
	}
	event_records_free(events, count);
}
END_TEST

START_TEST(a_volume_whose_row_is_missing_is_made_again)
{
	const struct volume_record volume = {.name = "fdk", .stage = "fdk", .bytes = 256, .hashed = true};
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};
	char id[ID_SIZE];

	keep_id(job, id);
	state_set(job, JOB_RUNNING, NULL);
	ck_assert_int_eq(directory_make(state_path(&state, "jobs/%s", id), &err), 0);
	path_fill(state_path(&state, "jobs/%s/fdk.nii", id));
	path_fill(state_path(&state, "jobs/%s/iter-1.nii", id));
	path_fill(state_path(&state, "jobs/%s/iter-2.nii.tmp", id));
	path_fill(state_path(&state, "jobs/%s/blank.tmp", id));
	ck_assert_int_eq(job_add_volume(job, &volume, &err), 0);
	job_release(job);
	restart();
	ck_assert(!path_exists(state_path(&state, "jobs/%s/blank.tmp", id)));
	ck_assert(path_exists(state_path(&state, "jobs/%s/fdk.nii", id)));
	ck_assert(path_exists(state_path(&state, "jobs/%s/iter-1.nii", id))); /* until the job writes over it */
	ck_assert(!path_exists(state_path(&state, "jobs/%s/iter-2.nii.tmp", id)));
}
END_TEST

/* Without a name where there is none. */
static struct volume_record volume_of(const char *id, const char *name)
{
	struct volume_record *volumes, found = {.name = ""};
	struct error err = {0};
	int count;

	ck_assert_int_eq(store_job_volumes(state.store, id, &volumes, &count, &err), 0);
	for (int i = 0; i < count; i++)
		if (strcmp(volumes[i].name, name) == 0)
			found = volumes[i];
	free(volumes);
	return found;
}

/* The volume's file: `text` as voxels, and checksums. */
static void put_voxels(const char *id, const char *name, const char *text)
{
	const struct provenance provenance = {.patient = patient_unknown};
	const struct grid grid = {.size = {0}}; /* the tests' records have none */
	uint8_t bytes[FORMAT_HEADER_MAX];
	struct seal_maker seal;
	struct error err = {0};
	size_t length;

	ck_assert_int_eq(volume_formats[0].header(&grid, VOLUME_FLOAT32, &provenance, bytes, &length, &err), 0);
	ck_assert_uint_eq(length, VOLUME_FILE_OFFSET);
	ck_assert_int_eq(directory_make(state_path(&state, "jobs/%s", id), &err), 0);
	memcpy(bytes + VOLUME_FILE_OFFSET, text, strlen(text));
	length += strlen(text);
	ck_assert_int_eq(seal_maker_new(length, &seal, &err), 0);
	seal_maker_add(&seal, bytes, length);
	seal_write(seal.blocks, length, bytes + length);
	seal_maker_clear(&seal);
	ck_assert_int_eq(file_write_durable(state_path(&state, "jobs/%s/%s.nii", id, name), bytes,
					    length + seal_bytes(length), &err),
			 0);
}

/* Within half a minute; the digest is what a volume of these voxels has. */
static void await_digest(const char *id, const char *name, const char *text)
{
	const struct timespec moment = {.tv_nsec = 2000000};
	uint8_t expected[32];

	for (int i = 0; i < 15000 && !volume_of(id, name).hashed; i++)
		nanosleep(&moment, NULL);
	ck_assert(volume_of(id, name).hashed);
	EVP_Digest(text, strlen(text), expected, NULL, EVP_sha256(), NULL);
	ck_assert_mem_eq(volume_of(id, name).sha256, expected, 32);
}

/* Of a job at work; its checkpoint may be of what came after the volume. */
START_TEST(a_volume_that_may_not_have_reached_the_disk_is_made_again)
{
	const struct volume_record fdk = {.name = "fdk", .stage = "fdk", .bytes = 256, .hashed = true};
	const struct volume_record second = {.name = "iter-2", .stage = "sart", .iteration = 2, .bytes = 256};
	const struct job_change yielded = {.checkpoint = 1, .yielded = true};
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};
	struct job_record record;
	struct event_record *events;
	char id[ID_SIZE];
	int count, told = 0;

	keep_id(job, id);
	state_set(job, JOB_RUNNING, NULL);
	put_voxels(id, "fdk", "a");
	put_voxels(id, "iter-2", "b");
	path_fill(state_path(&state, "jobs/%s/checkpoint.f32", id));
	ck_assert_int_eq(job_add_volume(job, &fdk, &err), 0);
	state_set(job, JOB_QUEUED, &yielded);
	state_set(job, JOB_RUNNING, NULL);
	ck_assert_int_eq(job_add_volume(job, &second, &err), 0);
	ck_assert(!volume_of(id, "iter-2").hashed);
	job_release(job);
	restart();
	ck_assert_str_eq(volume_of(id, "fdk").name, "fdk");
	ck_assert_str_eq(volume_of(id, "iter-2").name, "");
	ck_assert(path_exists(state_path(&state, "jobs/%s/fdk.nii", id)));
	ck_assert(!path_exists(state_path(&state, "jobs/%s/iter-2.nii", id)));
	ck_assert(!path_exists(state_path(&state, "jobs/%s/checkpoint.f32", id)));
	job = find(id);
	job_record(job, &record);
	ck_assert_int_eq(record.state, JOB_QUEUED);
	ck_assert_int_eq(record.checkpoint, 0);
	state_set(job, JOB_RUNNING, NULL);
	ck_assert_int_eq(job_add_volume(job, &second, &err), 0);
	ck_assert_int_eq(store_job_events(state.store, id, 0, 100, &events, &count, &err), 0);
	for (int i = 0; i < count; i++)
		told += strcmp(events[i].kind, "volume") == 0;
	event_records_free(events, count);
	ck_assert_int_eq(told, 2); /* each of them once */
	job_release(job);
}
END_TEST

START_TEST(a_volume_of_a_job_that_waits_is_made_again_too)
{
	const struct volume_record fdk = {.name = "fdk", .stage = "fdk", .bytes = 1};
	struct stored_scan *arriving = state_scan(&state, 5, false);
	struct job *job = state_post(&state, arriving, "routine");
	struct error err = {0};
	char id[ID_SIZE];

	keep_id(job, id);
	ck_assert_int_eq(state_of(job), JOB_WAITING);
	put_voxels(id, "fdk", "a");
	ck_assert_int_eq(job_add_volume(job, &fdk, &err), 0);
	job_release(job);
	stored_scan_release(arriving);
	restart();
	ck_assert_str_eq(volume_of(id, "fdk").name, "");
	ck_assert(!path_exists(state_path(&state, "jobs/%s/fdk.nii", id)));
}
END_TEST

static int volumes_of(const char *id)
{
	struct volume_record *volumes;
	struct error err = {0};
	int count;

	ck_assert_msg(store_job_volumes(state.store, id, &volumes, &count, &err) == 0, "%s", err.text);
	free(volumes);
	return count;
}

static int warnings_of(const char *id)
{
	struct warning_record *warnings;
	struct error err = {0};
	int count;

	ck_assert_msg(store_job_warnings(state.store, id, &warnings, &count, &err) == 0, "%s", err.text);
	free(warnings);
	return count;
}

START_TEST(a_job_whose_scan_is_understood_otherwise_begins_anew)
{
	const struct volume_record fdk = {.name = "fdk", .stage = "fdk", .bytes = 1};
	const struct job_change before = {.basis = 1}, later = {.basis = 3};
	const struct job_change yielded = {.checkpoint = 1, .yielded = true};
	struct job *job = state_post(&state, scan, "routine");
	struct event_record *events;
	struct job_record record;
	struct error err = {0};
	char id[ID_SIZE];
	int count;

	keep_id(job, id);
	state_set(job, JOB_RUNNING, &before);
	put_voxels(id, "fdk", "a");
	path_fill(state_path(&state, "jobs/%s/checkpoint.f32", id));
	ck_assert_int_eq(job_add_volume(job, &fdk, &err), 0);
	ck_assert_int_eq(job_digest_volume(job, &fdk, &err), 0);
	ck_assert_int_eq(job_add_warning(job, "no_dark", "none", &err), 0);
	add_row(job, 1);
	job_progress(job, STAGE_SART, 1, 0.5);
	state_set(job, JOB_QUEUED, &yielded);
	state_set(job, JOB_RUNNING, &before); /* nothing has changed */
	job_record(job, &record);
	ck_assert_int_eq(record.iteration, 1);
	ck_assert_double_gt(record.fraction, 0);
	ck_assert_int_eq(rows_of(id) + volumes_of(id) + warnings_of(id), 3);
	state_set(job, JOB_QUEUED, &yielded);
	job_release(job);
	restart(); /* what it ran with is known over it */
	job = find(id);
	ck_assert_int_eq(rows_of(id) + volumes_of(id) + warnings_of(id), 3);
	state_set(job, JOB_RUNNING, &later);
	job_record(job, &record);
	ck_assert_int_eq(record.iteration, 0);
	ck_assert_int_eq(record.checkpoint, 0);
	ck_assert_double_eq(record.fraction, 0);
	ck_assert_int_eq(rows_of(id) + volumes_of(id) + warnings_of(id), 0);
	ck_assert(!path_exists(state_path(&state, "jobs/%s/fdk.nii", id)));
	add_row(job, 1); /* this one was never told */
	ck_assert_int_eq(store_job_events(state.store, id, 0, 100, &events, &count, &err), 0);
	for (int i = 0; i < count; i++)
		ck_assert_str_eq(events[i].kind, i + 1 < count ? "state" : "progress");
	event_records_free(events, count);
	job_release(job);
}
END_TEST

START_TEST(a_digest_that_was_not_made_before_a_restart_is_made_after_it)
{
	static const enum job_state states[] = {JOB_SUCCEEDED, JOB_CANCELLED, JOB_QUEUED};
	const struct volume_record fdk = {.name = "fdk", .stage = "fdk", .bytes = 1}, lost = {.name = "iter-1"};
	struct digester *digester = NULL;
	struct error err = {0};
	char ids[3][ID_SIZE];

	for (int i = 0; i < 3; i++) {
		struct job *job = state_post(&state, scan, "routine");

		keep_id(job, ids[i]);
		state_set(job, JOB_RUNNING, NULL);
		put_voxels(ids[i], "fdk", "abc");
		ck_assert_int_eq(job_add_volume(job, &lost, &err), 0); /* whose file is not there */
		ck_assert_int_eq(job_add_volume(job, &fdk, &err), 0);
		state_set(job, states[i], NULL);
		job_release(job);
	}
	restart();
	ck_assert_int_eq(digester_start(state.jobs, 2, &digester, &err), 0);
	for (int i = 0; i < 3; i++)
		await_digest(ids[i], "fdk", "abc");
	digester_stop(digester);
	digester_stop(NULL);
}
END_TEST

START_TEST(digests_come_for_what_is_told_to_be_on_the_disk)
{
	struct volume_record fdk = {.name = "fdk", .stage = "fdk", .bytes = 1, .created = 1};
	const struct volume_record final = {.name = "final", .stage = "fdk", .bytes = 1, .created = 2};
	struct job *job = state_post(&state, scan, "routine"), *gone = state_post(&state, scan, "routine");
	struct digester *digester = NULL;
	struct error err = {0};
	char id[ID_SIZE], deleted[ID_SIZE], from[512];
	bool removed, linked = false;

	keep_id(job, id);
	keep_id(gone, deleted);
	ck_assert_int_eq(digester_start(state.jobs, 1, &digester, &err), 0);
	state_set(job, JOB_RUNNING, NULL);
	put_voxels(id, "fdk", "old");
	snprintf(from, sizeof(from), "%s", state_path(&state, "jobs/%s/fdk.nii", id));
	ck_assert_int_eq(durable_link(from, state_path(&state, "jobs/%s/final.nii", id), &linked, &err), 0);
	ck_assert_int_eq(job_add_volume(job, &fdk, &err), 0);
	ck_assert_int_eq(job_add_volume(job, &final, &err), 0);
	/* Jobs that are not there, or not any more, are none of its trouble. */
	digester_add(digester, "none", NULL);
	state_set(gone, JOB_CANCELLED, NULL);
	ck_assert_int_eq(jobs_delete(state.jobs, gone, &removed, &err), 0);
	ck_assert(removed);
	digester_add(digester, deleted, "fdk");
	digester_add(digester, id, "fdk");
	await_digest(id, "fdk", "old");
	ck_assert(!volume_of(id, "final").hashed); /* nobody said so */
	digester_add(digester, id, NULL);
	await_digest(id, "final", "old");
	/* Made again: what the old one's digest was is nothing to the new one. */
	fdk = volume_of(id, "fdk");
	put_voxels(id, "fdk", "new");
	ck_assert_int_eq(
	    job_add_volume(job, &(struct volume_record){.name = "fdk", .stage = "fdk", .created = 3}, &err), 0);
	ck_assert_int_eq(job_digest_volume(job, &fdk, &err), 0);
	ck_assert(!volume_of(id, "fdk").hashed);
	digester_add(digester, id, "fdk");
	await_digest(id, "fdk", "new");
	digester_stop(digester);
	job_release(job);
	job_release(gone);
}
END_TEST

START_TEST(what_a_dead_worker_told_of_is_settled_for_it)
{
	const struct volume_record fdk = {.name = "fdk", .stage = "fdk", .bytes = 4}, lost = {.name = "iter-1"};
	struct job *job = state_post(&state, scan, "routine");
	struct error err = {0};
	char id[ID_SIZE];

	keep_id(job, id);
	state_set(job, JOB_RUNNING, NULL);
	put_voxels(id, "fdk", "abcd");
	ck_assert_int_eq(job_add_volume(job, &fdk, &err), 0);
	ck_assert_int_eq(job_add_volume(job, &lost, &err), 0); /* whose file is not there */
	ck_assert_int_eq(job_sync_volumes(job, &err), 0);
	ck_assert_str_eq(volume_of(id, "fdk").name, "fdk");
	ck_assert_str_eq(volume_of(id, "iter-1").name, "");
	/* What it was at goes when the job has ended. */
	path_fill(state_path(&state, "jobs/%s/blank.tmp", id));
	path_fill(state_path(&state, "jobs/%s/iter-1.nii.tmp", id));
	state_set(job, JOB_CANCELLED, NULL);
	ck_assert(!path_exists(state_path(&state, "jobs/%s/blank.tmp", id)));
	ck_assert(!path_exists(state_path(&state, "jobs/%s/iter-1.nii.tmp", id)));
	ck_assert(path_exists(state_path(&state, "jobs/%s/fdk.nii", id)));
	job_release(job);
}
END_TEST

START_TEST(the_document_has_what_the_contract_names)
{
	static const char *const members[] = {
	    "id",       "state",   "stage",   "iteration", "iterations", "progress", "eta_s",
	    "device",   "backend", "timings", "error",     "warnings",   "history",  "scan",
	    "attempts", "grid",    "fdk",     "sart",      "tv",         "emit",     "priority",
	    "created",  "started", "ended",   "volumes",   "memory",     "plan",     "queue_position"};
	const struct job_change failed = {
	    .error_code = ERR_NO_MEMORY, .error_pointer = "/grid/size", .error_text = "too much"};
	struct job *job = state_post(&state, scan, "urgent");
	cJSON *document, *error;
	struct error err;

	state_set(job, JOB_RUNNING, NULL);
	add_row(job, 1);
	state_set(job, JOB_FAILED, &failed);
	document = job_document(job, false, &err);
	for (size_t i = 0; i < sizeof(members) / sizeof(members[0]); i++)
		ck_assert_msg(cJSON_HasObjectItem(document, members[i]), "%s", members[i]);
	error = cJSON_GetObjectItem(document, "error");
	ck_assert_str_eq(cJSON_GetStringValue(cJSON_GetObjectItem(error, "type")), "urn:cbctd:problem:no-memory");
	ck_assert_str_eq(cJSON_GetStringValue(cJSON_GetObjectItem(error, "pointer")), "/grid/size");
	ck_assert_str_eq(cJSON_GetStringValue(cJSON_GetObjectItem(document, "state")), "failed");
	ck_assert_int_eq(cJSON_GetArraySize(cJSON_GetObjectItem(document, "history")), 1);
	cJSON_Delete(document);
	job_release(job);
}
END_TEST

START_TEST(each_error_code_has_one_problem_with_a_name_of_its_own)
{
	for (int code = ERR_DAMAGED; code <= ERR_INVALID; code++) {
		const struct problem *problem = problem_of_code(code);

		ck_assert_int_eq(problem->code, code);
		ck_assert_ptr_eq(problem_named(problem->name), problem);
	}
	ck_assert_str_eq(problem_of_code(ERR_NO_SPACE)->name, "no-space");
	ck_assert_int_eq(problem_of_code(12345)->code, ERR_INTERNAL);
	ck_assert_int_eq(problem_named("range-outside")->status, 416);
}
END_TEST

START_TEST(times_are_written_as_iso_8601)
{
	char text[CLOCK_TEXT_SIZE];

	clock_text(0.25, text);
	ck_assert_str_eq(text, "1970-01-01T00:00:00.250Z");
	clock_text(951782400, text); /* the 29th of February 2000 */
	ck_assert_str_eq(text, "2000-02-29T00:00:00.000Z");
}
END_TEST

Suite *job_suite(void)
{
	Suite *suite = suite_create("job");
	TCase *tests = tcase_create("job");

	tcase_add_checked_fixture(tests, set_up, tear_down);
	tcase_add_test(tests, the_table_of_transitions_is_the_contracts);
	tcase_add_test(tests, what_the_table_forbids_changes_nothing);
	tcase_add_test(tests, a_job_waits_for_its_last_projection);
	tcase_add_test(tests, a_waiting_job_is_attended_and_runs_with_its_last_projection);
	tcase_add_test(tests, who_arrives_goes_before_who_does_not_then_the_higher_priority);
	tcase_add_test(tests, a_cancel_of_an_attended_job_waits_for_its_worker_or_a_restart);
	tcase_add_test(tests, a_cancel_that_comes_between_the_end_of_a_worker_and_its_record_is_carried_out);
	tcase_add_test(tests, a_waiting_job_is_found_again_after_a_restart);
	tcase_add_test(tests, one_that_yielded_stands_in_front_of_its_class);
	tcase_add_test(tests, only_a_run_from_the_start_is_an_attempt);
	tcase_add_test(tests, a_running_job_that_has_a_time_left_keeps_one);
	tcase_add_test(tests, a_running_job_is_queued_again_after_a_restart);
	tcase_add_test(tests, a_checkpoint_is_kept_over_a_restart_where_its_file_is);
	tcase_add_test(tests, a_failed_job_reads_the_same_after_a_restart);
	tcase_add_test(tests, a_cancel_that_was_asked_for_survives_a_restart);
	tcase_add_test(tests, deleting_cancels_first_and_then_removes);
	tcase_add_test(tests, a_scan_stays_while_a_job_needs_it);
	tcase_add_test(tests, a_key_makes_one_job_also_over_a_restart);
	tcase_add_test(tests, a_damaged_volume_has_one_warning_until_it_is_whole);
	tcase_add_test(tests, events_come_in_order_from_where_one_left_off);
	tcase_add_test(tests, rows_of_one_commit_are_told_one_by_one);
	tcase_add_test(tests, a_volume_whose_row_is_missing_is_made_again);
	tcase_add_test(tests, a_volume_that_may_not_have_reached_the_disk_is_made_again);
	tcase_add_test(tests, a_volume_of_a_job_that_waits_is_made_again_too);
	tcase_add_test(tests, a_job_whose_scan_is_understood_otherwise_begins_anew);
	tcase_add_test(tests, a_digest_that_was_not_made_before_a_restart_is_made_after_it);
	tcase_add_test(tests, digests_come_for_what_is_told_to_be_on_the_disk);
	tcase_add_test(tests, what_a_dead_worker_told_of_is_settled_for_it);
	tcase_add_test(tests, the_document_has_what_the_contract_names);
	tcase_add_test(tests, each_error_code_has_one_problem_with_a_name_of_its_own);
	tcase_add_test(tests, times_are_written_as_iso_8601);
	tcase_set_timeout(tests, 60);
	suite_add_tcase(suite, tests);
	return suite;
}

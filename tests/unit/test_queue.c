/* Who is next, who makes room, and ids that sort by time. */
#include <check.h>
#include <stdio.h>
#include <string.h>

#include "daemon/id.h"
#include "daemon/jobs/queue.h"

/* The tickets of the queue from its front, "3 1 2". */
static const char *order_of(const struct queue *queue)
{
	static char text[256];
	size_t length = 0;

	text[0] = '\0';
	for (const struct queue_entry *entry = queue->first; entry != NULL; entry = entry->next)
		length += (size_t)snprintf(text + length, sizeof(text) - length, "%s%lld",
					   entry == queue->first ? "" : " ", entry->ticket);
	return text;
}

START_TEST(higher_priority_goes_first_and_equals_in_their_order)
{
	struct queue queue = {0};
	struct queue_client client = {.used = 7};
	struct queue_entry entries[] = {
	    {.priority = PRIORITY_ROUTINE, .ticket = 1}, {.priority = PRIORITY_URGENT, .ticket = 2},
	    {.priority = PRIORITY_ROUTINE, .ticket = 3}, {.priority = PRIORITY_STAT, .ticket = 4},
	    {.priority = PRIORITY_URGENT, .ticket = 5},  {.priority = PRIORITY_STAT, .ticket = 6}};

	for (int i = 5; i >= 0; i--) {
		entries[i].client = &client;
		queue_add(&queue, &entries[i]);
	}
	ck_assert_str_eq(order_of(&queue), "4 6 2 5 1 3");
	ck_assert_int_eq(queue_position(&queue, &entries[3]), 1);
	ck_assert_int_eq(queue_position(&queue, &entries[2]), 6);
	queue_remove(&queue, &entries[1]);
	queue_remove(&queue, &entries[3]);
	queue_remove(&queue, &entries[2]);
	ck_assert_str_eq(order_of(&queue), "6 5 1");
	ck_assert_int_eq(queue_position(&queue, &entries[2]), 0);
	queue_remove(&queue, &entries[2]); /* not queued: nothing happens */
	/* One that yielded keeps its ticket and stands in front of its class. */
	queue_add(&queue, &entries[1]);
	ck_assert_str_eq(order_of(&queue), "6 2 5 1");
}
END_TEST

START_TEST(the_lowest_and_latest_makes_room_for_the_higher)
{
	static const struct {
		int queued[3], queued_count;
		struct queue_running running[3];
		int running_count, idle, victim;
		const char *why;
		int arriving; /* priority + 1 of one that is not queued, 0: none */
	} cases[] = {
	    {{PRIORITY_STAT}, 0, {{PRIORITY_ROUTINE, 1, 1, false, false}}, 1, 0, -1, "an empty queue", 0},
	    {{PRIORITY_ROUTINE}, 1, {{PRIORITY_ROUTINE, 1, 1, false, false}}, 1, 0, -1, "an equal waits", 0},
	    {{PRIORITY_URGENT}, 1, {{PRIORITY_STAT, 1, 1, false, false}}, 1, 0, -1, "a lower one waits", 0},
	    {{PRIORITY_URGENT}, 1, {{PRIORITY_ROUTINE, 1, 1, false, false}}, 1, 0, 0, "a higher one pushes", 0},
	    {{PRIORITY_STAT}, 1, {{PRIORITY_ROUTINE, 1, 1, false, false}}, 1, 1, -1, "a worker is idle", 0},
	    {{PRIORITY_STAT}, 1, {{PRIORITY_ROUTINE, 1, 1, true, false}}, 1, 0, -1, "room is being made", 0},
	    {{PRIORITY_STAT, PRIORITY_STAT},
	     2,
	     {{PRIORITY_ROUTINE, 1, 1, true, false}, {PRIORITY_URGENT, 2, 1, false, false}},
	     2,
	     0,
	     1,
	     "room for two",
	     0},
	    {{PRIORITY_STAT},
	     1,
	     {{PRIORITY_URGENT, 1, 1, false, false},
	      {PRIORITY_ROUTINE, 2, 1, false, false},
	      {PRIORITY_ROUTINE, 3, 1, false, false}},
	     3,
	     0,
	     2,
	     "the latest of the lowest",
	     0},
	    {{PRIORITY_STAT, PRIORITY_URGENT},
	     2,
	     {{PRIORITY_URGENT, 1, 1, true, false}, {PRIORITY_URGENT, 2, 1, false, false}},
	     2,
	     0,
	     -1,
	     "the second pushes no equal",
	     0},
	    {{PRIORITY_ROUTINE},
	     1,
	     {{PRIORITY_STAT, 1, 1, false, true}},
	     1,
	     0,
	     0,
	     "who has nothing to do goes for any",
	     0},
	    {{PRIORITY_STAT},
	     1,
	     {{PRIORITY_ROUTINE, 1, 1, false, false}, {PRIORITY_STAT, 2, 1, false, true}},
	     2,
	     0,
	     1,
	     "and before all",
	     0},
	    {{PRIORITY_STAT}, 0, {{PRIORITY_STAT, 1, 1, false, true}}, 1, 0, -1, "but not for nobody", 0},
	    {{PRIORITY_STAT},
	     0,
	     {{PRIORITY_ROUTINE, 1, 1, false, false}},
	     1,
	     0,
	     0,
	     "one that arrives pushes a lower one",
	     1 + PRIORITY_URGENT},
	    {{PRIORITY_STAT},
	     0,
	     {{PRIORITY_URGENT, 1, 1, false, false}},
	     1,
	     0,
	     -1,
	     "and no equal",
	     1 + PRIORITY_URGENT},
	    {{PRIORITY_URGENT},
	     1,
	     {{PRIORITY_ROUTINE, 1, 1, false, false}},
	     1,
	     1,
	     0,
	     "both get a worker",
	     1 + PRIORITY_URGENT},
	    {{PRIORITY_ROUTINE},
	     1,
	     {{PRIORITY_ROUTINE, 1, 1, false, false}},
	     1,
	     1,
	     -1,
	     "the idle one is for who arrives",
	     1 + PRIORITY_URGENT},
	};

	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		struct queue queue = {0};
		struct queue_entry entries[3] = {0};
		struct queue_entry arriving;

		for (int k = 0; k < cases[i].queued_count; k++) {
			entries[k].priority = (enum priority)cases[i].queued[k];
			entries[k].ticket = 100 + k;
			queue_add(&queue, &entries[k]);
		}
		arriving = (struct queue_entry){.priority = (enum priority)(cases[i].arriving - 1)};
		ck_assert_msg(queue_victim(&queue, cases[i].arriving > 0 ? &arriving : NULL, cases[i].running,
					   cases[i].running_count, cases[i].idle, 4) == cases[i].victim,
			      "%s", cases[i].why);
	}
}
END_TEST

static bool all_fit(const void *context, const struct queue_entry *entry)
{
	(void)context;
	(void)entry;
	return true;
}

static bool is_not(const void *context, const struct queue_entry *entry)
{
	return entry != context;
}

START_TEST(the_client_goes_first_that_has_used_the_least)
{
	struct queue_client a = {.used = 10}, b = {.used = 3};
	struct queue_entry entries[] = {{.client = &a, .priority = PRIORITY_ROUTINE, .ticket = 1},
					{.client = &a, .priority = PRIORITY_ROUTINE, .ticket = 2},
					{.client = &b, .priority = PRIORITY_ROUTINE, .ticket = 3},
					{.client = &b, .priority = PRIORITY_ROUTINE, .ticket = 4},
					{.client = &a, .priority = PRIORITY_URGENT, .ticket = 5}};
	struct queue queue = {0};

	for (int i = 0; i < 5; i++)
		queue_add(&queue, &entries[i]);
	/* Priority goes before shares. */
	ck_assert_ptr_eq(queue_next(&queue, all_fit, NULL), &entries[4]);
	/* In turns, by what they have used. */
	ck_assert_int_eq(queue_position(&queue, &entries[4]), 1);
	ck_assert_int_eq(queue_position(&queue, &entries[2]), 2);
	ck_assert_int_eq(queue_position(&queue, &entries[0]), 3);
	ck_assert_int_eq(queue_position(&queue, &entries[3]), 4);
	ck_assert_int_eq(queue_position(&queue, &entries[1]), 5);
	queue_remove(&queue, &entries[4]);
	ck_assert_ptr_eq(queue_next(&queue, all_fit, NULL), &entries[2]);
	ck_assert_ptr_eq(queue_next(&queue, is_not, &entries[2]), &entries[3]);
	entries[2].held = entries[3].held = true;
	ck_assert_ptr_eq(queue_next(&queue, all_fit, NULL), &entries[0]);
	entries[2].held = entries[3].held = false;
	/* Equals in the order of their tickets. */
	b.used = 10;
	ck_assert_ptr_eq(queue_next(&queue, all_fit, NULL), &entries[0]);
	b.used = 10.5;
	ck_assert_ptr_eq(queue_next(&queue, all_fit, NULL), &entries[0]);
}
END_TEST

START_TEST(what_may_not_run_here_pushes_nobody_out_and_is_waited_for_by_nobody)
{
	struct queue_client client = {0};
	struct queue_entry entries[] = {{.client = &client, .priority = PRIORITY_STAT, .ticket = 1},
					{.client = &client, .priority = PRIORITY_STAT, .ticket = 2},
					{.client = &client, .priority = PRIORITY_ROUTINE, .ticket = 3}};
	const struct queue_running running = {.priority = PRIORITY_ROUTINE};
	struct queue queue = {0};

	for (int i = 0; i < 3; i++)
		queue_add(&queue, &entries[i]);
	ck_assert_int_eq(queue_victim(&queue, NULL, &running, 1, 0, 1), 0);
	entries[0].elsewhere = entries[1].elsewhere = true;
	ck_assert_int_eq(queue_victim(&queue, NULL, &running, 1, 0, 1), -1);
	ck_assert_int_eq(queue_position(&queue, &entries[2]), 1);
	/* Among themselves, and for whoever has a host for them, they are in order. */
	ck_assert_int_eq(queue_position(&queue, &entries[0]), 1);
	ck_assert_ptr_eq(queue_next(&queue, all_fit, NULL), &entries[0]);
	/* The device that a push sets free may be one that it may not have. */
	entries[0].elsewhere = false;
	entries[0].choosy = true;
	ck_assert_int_eq(queue_victim(&queue, NULL, &running, 1, 0, 1), -1);
	ck_assert_int_eq(queue_position(&queue, &entries[2]), 2);
	entries[1].elsewhere = false;
	ck_assert_int_eq(queue_victim(&queue, NULL, &running, 1, 0, 1), 0);
}
END_TEST

/* Jobs on several devices: who wants four pushes out until four are there, who has four sets four free. */
START_TEST(room_is_counted_in_devices)
{
	struct queue_client client = {0};
	struct queue_entry wide = {.client = &client, .priority = PRIORITY_STAT, .ticket = 9, .devices = 4};
	struct queue_running running[] = {{.priority = PRIORITY_ROUTINE, .ticket = 1},
					  {.priority = PRIORITY_ROUTINE, .ticket = 2, .devices = 1},
					  {.priority = PRIORITY_STAT, .ticket = 3}};
	struct queue queue = {0};

	queue_add(&queue, &wide);
	/* Of four devices one is free, one has an equal's job: two make room, and the rest is waited for. */
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 3, 1, 4), 1);
	running[1].leaving = true;
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 3, 1, 4), 0);
	running[0].leaving = true;
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 3, 1, 4), -1);
	/* Where there are three in service, it has what it can get. */
	running[0].leaving = false;
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 2, 1, 2), -1);
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 2, 1, 3), 0);
	wide.devices = DEVICES_ALL;
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 2, 1, 2), -1);
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 2, 1, 3), 0);
	/* One job that leaves four devices is enough. */
	running[1].devices = 4;
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 2, 0, 4), -1);
	running[1].leaving = false;
	ck_assert_int_eq(queue_victim(&queue, NULL, running, 2, 0, 4), 1);
}
END_TEST

START_TEST(nobody_saves_time_up)
{
	struct queue_client a = {0}, b = {0}, c = {0};
	struct queue queue = {0};

	queue_know(&queue, &a);
	queue_know(&queue, &b);
	queue_know(&queue, &c);
	queue_enter(&queue, &a);
	ck_assert_double_eq(a.used, 0);
	a.used = 1000;
	/* One that comes later begins where the others are, and not before them for the next 1000 s. */
	queue_enter(&queue, &b);
	ck_assert_double_eq(b.used, 1000);
	b.used = 1010;
	queue_enter(&queue, &c);
	ck_assert_double_eq(c.used, 1000);
	/* With jobs there it keeps what it has; one that has used more keeps that, too. */
	a.used = 2000;
	queue_enter(&queue, &c);
	ck_assert_double_eq(c.used, 1000);
	queue_leave(&a);
	queue_enter(&queue, &a);
	ck_assert_double_eq(a.used, 2000);
}
END_TEST

/* Jobs of one second and of ten: what counts is the time. */
START_TEST(long_and_short_jobs_share_the_time)
{
	struct queue_client slow = {0}, quick = {0};
	struct queue_entry entries[2] = {{.client = &slow, .priority = PRIORITY_ROUTINE, .ticket = 1},
					 {.client = &quick, .priority = PRIORITY_ROUTINE, .ticket = 2}};
	struct queue queue = {0};
	double given[2] = {0};

	for (int i = 0; i < 2; i++)
		queue_add(&queue, &entries[i]);
	for (int turn = 0; turn < 1100; turn++) {
		const int next = (int)(queue_next(&queue, all_fit, NULL) - entries);
		const double seconds = next == 0 ? 10 : 1;

		given[next] += seconds;
		entries[next].client->used += seconds;
	}
	ck_assert_double_le(given[0] > given[1] ? given[0] - given[1] : given[1] - given[0], 10);
}
END_TEST

START_TEST(ids_sort_by_the_time_of_making)
{
	char before[ID_SIZE], id[ID_SIZE];
	struct error err = {0};

	ck_assert_int_eq(id_make(before, &err), 0);
	for (int i = 0; i < 1000; i++) {
		ck_assert_int_eq(id_make(id, &err), 0);
		ck_assert(id_valid(id));
		ck_assert_str_gt(id, before);
		memcpy(before, id, sizeof(id));
	}
	/* A clock that was set back: what is in the catalogue is from the year 2100. */
	id_floor("3rzzzzzzz0000000");
	ck_assert_int_eq(id_make(id, &err), 0);
	ck_assert_str_gt(id, "3rzzzzzzzzzzzzzz");
}
END_TEST

START_TEST(what_is_no_id_is_refused)
{
	static const char *const wrong[] = {"",
					    "1m7xy0w9je9g8xv",
					    "1m7xy0w9je9g8xvww",
					    "1M7XY0W9JE9G8XVW",
					    "../../etc/passwd",
					    "1m7xy0w9je9g8xv/",
					    "1m7xy0w9je9g8xvl"};

	ck_assert(id_valid("1m7xy0w9je9g8xvw"));
	for (size_t i = 0; i < sizeof(wrong) / sizeof(wrong[0]); i++)
		ck_assert_msg(!id_valid(wrong[i]), "%s", wrong[i]);
}
END_TEST

Suite *queue_suite(void)
{
	Suite *suite = suite_create("queue");
	TCase *tests = tcase_create("queue");

	tcase_add_test(tests, higher_priority_goes_first_and_equals_in_their_order);
	tcase_add_test(tests, the_client_goes_first_that_has_used_the_least);
	tcase_add_test(tests, what_may_not_run_here_pushes_nobody_out_and_is_waited_for_by_nobody);
	tcase_add_test(tests, room_is_counted_in_devices);
	tcase_add_test(tests, nobody_saves_time_up);
	tcase_add_test(tests, long_and_short_jobs_share_the_time);
	tcase_add_test(tests, the_lowest_and_latest_makes_room_for_the_higher);
	tcase_add_test(tests, ids_sort_by_the_time_of_making);
	tcase_add_test(tests, what_is_no_id_is_refused);
	suite_add_tcase(suite, tests);
	return suite;
}

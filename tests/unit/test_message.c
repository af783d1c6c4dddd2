/* Messages between daemon and worker: each kind there and back, and what a broken peer can do. */
#include <check.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "proto/message.h"

static int ends[2];

static void open_pair(void)
{
	ck_assert_int_eq(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends), 0);
}

static void close_pair(void)
{
	close(ends[0]);
	close(ends[1]);
}

static struct message through(const struct message *message)
{
	struct message back;
	struct error err = {0};
	bool got = false;

	ck_assert_msg(message_send(ends[0], message, &err) == 0, "%s", err.text);
	ck_assert_msg(message_receive(ends[1], 1000, &back, &got, &err) == 0, "%s %s", err.text, err.pointer);
	ck_assert(got);
	ck_assert_int_eq(back.kind, message->kind);
	return back;
}

static void request_of(const char *text, struct job_request *ret)
{
	struct error err = {0};

	ck_assert_msg(job_request_parse(text, strlen(text), ret, &err) == 0, "%s", err.text);
}

START_TEST(a_start_carries_the_whole_recipe)
{
	struct message start = {.kind = MESSAGE_START,
				.job = "0123456789abcdef",
				.scan_directory = "/var/lib/cbctd/scans/a b\xc3\xa9\"\\",
				.job_directory = "/var/lib/cbctd/jobs/x",
				.iteration = 17},
		       back;

	request_of("{\"scan\":\"s\",\"grid\":{\"size\":[3,4,5],\"spacing_mm\":[0.1,0.2,0.30000000000000004]},"
		   "\"fdk\":{\"window\":\"cosine\"},\"sart\":{\"subsets\":\"views\"},\"tv\":{\"unit\":1.1e-5},"
		   "\"emit\":[\"fdk\",9,2],\"priority\":\"stat\"}",
		   &start.request);
	back = through(&start);
	ck_assert_str_eq(back.job, start.job);
	ck_assert_str_eq(back.scan_directory, start.scan_directory);
	ck_assert_str_eq(back.job_directory, start.job_directory);
	ck_assert_int_eq(back.iteration, 17);
	ck_assert(job_request_same(&back.request, &start.request));
	message_clear(&start);
	message_clear(&back);
}
END_TEST

START_TEST(the_longest_list_of_volumes_fits)
{
	struct message start = {.kind = MESSAGE_START}, back;

	request_of("{\"scan\":\"s\",\"sart\":{\"iterations\":100000}}", &start.request);
	memset(start.scan_directory, '"', sizeof(start.scan_directory) - 1); /* two bytes each on the way */
	memset(start.job_directory, '"', sizeof(start.job_directory) - 1);
	start.request.recipe.emit = calloc(EMITS_MAX, sizeof(int));
	start.request.recipe.emits = EMITS_MAX;
	ck_assert_ptr_nonnull(start.request.recipe.emit);
	for (int i = 0; i < EMITS_MAX; i++)
		start.request.recipe.emit[i] = ITERATIONS_MAX - i;
	start.arriving = start.reduced = true;
	memset(start.present, 0xff, sizeof(start.present));
	back = through(&start);
	ck_assert(job_request_same(&back.request, &start.request));
	ck_assert(back.arriving && back.reduced);
	ck_assert_mem_eq(back.present, start.present, sizeof(start.present));
	message_clear(&start);
	message_clear(&back);
}
END_TEST

START_TEST(a_start_says_which_projections_are_there)
{
	struct message start = {.kind = MESSAGE_START, .reduced = true, .present = {[0] = 0x81, [17] = 0x10}}, back;

	request_of("{\"scan\":\"s\",\"fdk\":{}}", &start.request);
	back = through(&start);
	ck_assert(back.reduced && !back.arriving);
	ck_assert_mem_eq(back.present, start.present, sizeof(start.present));
	message_clear(&start);
	message_clear(&back);
}
END_TEST

START_TEST(short_messages_carry_their_job)
{
	static const enum message_kind kinds[] = {MESSAGE_CANCEL, MESSAGE_YIELD, MESSAGE_QUIT};

	for (int i = 0; i < 3; i++) {
		struct message message = {.kind = kinds[i], .job = "abc"}, back = through(&message);

		ck_assert_str_eq(back.job, kinds[i] == MESSAGE_QUIT ? "" : "abc");
	}
}
END_TEST

START_TEST(what_a_worker_says_comes_back)
{
	struct message message = {.kind = MESSAGE_HELLO,
				  .backend = "cuda",
				  .info = {.name = "NVIDIA H200",
					   .driver = "570.1\nline",
					   .bytes_total = 151ull << 30,
					   .bytes_free = (150ull << 30) + 1}},
		       back = through(&message);

	ck_assert_str_eq(back.backend, "cuda");
	ck_assert_str_eq(back.info.name, "NVIDIA H200");
	ck_assert_str_eq(back.info.driver, "570.1\nline");
	ck_assert_uint_eq(back.info.bytes_free, (150ull << 30) + 1);

	message =
	    (struct message){.kind = MESSAGE_OPENED, .job = "j", .plan = "untilted", .memory = {1, 2, 3, 6, 1000, 77}};
	back = through(&message);
	ck_assert_str_eq(back.plan, "untilted");
	ck_assert_uint_eq(back.memory.scratch, 3);
	ck_assert_uint_eq(back.memory.available, 1000);
	ck_assert_uint_eq(back.memory.host, 77);

	message = (struct message){.kind = MESSAGE_RECONSTRUCTED, .job = "j", .count = 118};
	ck_assert_int_eq(through(&message).count, 118);
	message = (struct message){.kind = MESSAGE_VIEWS, .job = "j", .count = 20000};
	ck_assert_int_eq(through(&message).count, 20000);

	message = (struct message){.kind = MESSAGE_WARNING, .job = "j", .code_name = "defects", .text = "3 pixels"};
	back = through(&message);
	ck_assert_str_eq(back.code_name, "defects");
	ck_assert_str_eq(back.text, "3 pixels");

	message = (struct message){
	    .kind = MESSAGE_ENDED, .job = "j", .code = ERR_BUSY, .iteration = 12, .text = "yielded after iteration 12"};
	back = through(&message);
	ck_assert_int_eq(back.code, ERR_BUSY);
	ck_assert_int_eq(back.iteration, 12);
	ck_assert_str_eq(back.text, "yielded after iteration 12");

	for (int stage = 0; stage < STAGE_COUNT; stage++) {
		message = (struct message){
		    .kind = MESSAGE_PROGRESS, .stage = (enum stage)stage, .iteration = stage, .fraction = 0.1 * stage};
		back = through(&message);
		ck_assert_int_eq(back.stage, stage);
		ck_assert_double_eq(back.fraction, 0.1 * stage);
	}
}
END_TEST

START_TEST(numbers_come_back_the_same_and_nan_as_nan)
{
	struct message
	    message = {.kind = MESSAGE_ROW,
		       .row = {.iteration = 3, .residual = 0.1 + 0.2, .change = NAN, .tv = 1e300, .seconds = 5e-324}},
	    back = through(&message);

	ck_assert_int_eq(back.row.iteration, 3);
	ck_assert_double_eq(back.row.residual, 0.1 + 0.2);
	ck_assert(isnan(back.row.change));
	ck_assert_double_eq(back.row.tv, 1e300);
	ck_assert_double_eq(back.row.seconds, 5e-324);
	message = (struct message){.kind = MESSAGE_VOLUME,
				   .name = "iter-5",
				   .volume_stage = "sart",
				   .iteration = 5,
				   .bytes = 1ull << 40,
				   .grid = {{7, 8, 9}, {0.1, 0.2, 0.7}, {-1.1, 2e-7, 3}},
				   .norms = {1.0 / 3, INFINITY, 2, -0.5, 0.7, 0.01, 4},
				   .estimate_mm = 10,
				   .support = {0.1, 1.0 / 7, 5, 0.3, NAN}};
	back = through(&message);
	ck_assert_str_eq(back.name, "iter-5");
	ck_assert_str_eq(back.volume_stage, "sart");
	ck_assert_uint_eq(back.bytes, 1ull << 40);
	ck_assert_mem_eq(&back.grid.size, &message.grid.size, sizeof(back.grid.size));
	ck_assert_mem_eq(&back.grid.spacing, &message.grid.spacing, sizeof(back.grid.spacing));
	ck_assert_mem_eq(&back.grid.origin, &message.grid.origin, sizeof(back.grid.origin));
	ck_assert_double_eq(back.norms.norm2, 1.0 / 3);
	ck_assert(isnan(back.norms.difference2));
	ck_assert_double_eq(back.norms.minimum, -0.5);
	ck_assert_uint_eq(back.norms.not_finite, 4);
	ck_assert_double_eq(back.estimate_mm, 10);
	ck_assert_double_eq(back.support.metal, 0.1);
	ck_assert_double_eq(back.support.estimated, 1.0 / 7);
	ck_assert_int_eq(back.support.held_out, 5);
	ck_assert_double_eq(back.support.held_residual, 0.3);
	ck_assert(isnan(back.support.used_residual));
	message = (struct message){.kind = MESSAGE_SETTLED, .name = "final"};
	back = through(&message);
	ck_assert_str_eq(back.name, "final");
}
END_TEST

START_TEST(a_text_cut_within_a_character_is_not_lost)
{
	struct message message = {.kind = MESSAGE_ENDED, .code = ERR_DEVICE}, back;

	memset(message.text, 'x', sizeof(message.text) - 1);
	memcpy(message.text + sizeof(message.text) - 3, "\xe2\x82", 2);
	back = through(&message);
	ck_assert_int_eq(back.code, ERR_DEVICE);
	ck_assert_mem_eq(back.text, message.text, sizeof(message.text) - 8);
}
END_TEST

START_TEST(nothing_comes_when_nothing_was_sent)
{
	struct message back;
	struct error err = {0};
	bool got = true;

	ck_assert_int_eq(message_receive(ends[1], 0, &back, &got, &err), 0);
	ck_assert(!got);
	got = true;
	ck_assert_int_eq(message_receive(ends[1], 20, &back, &got, &err), 0);
	ck_assert(!got);
}
END_TEST

START_TEST(a_peer_that_has_gone_is_an_error_after_its_last_word)
{
	struct message message = {.kind = MESSAGE_CANCEL, .job = "last"}, back;
	struct error err = {0};
	bool got = false;

	ck_assert_int_eq(message_send(ends[0], &message, &err), 0);
	close(ends[0]);
	ck_assert_int_eq(message_receive(ends[1], -1, &back, &got, &err), 0);
	ck_assert(got);
	ck_assert_str_eq(back.job, "last");
	ck_assert_int_eq(message_receive(ends[1], -1, &back, &got, &err), ERR_IO);
	ck_assert_int_eq(message_send(ends[1], &message, &err), ERR_IO); /* and no SIGPIPE */
	ends[0] = dup(ends[1]);                                          /* for close_pair */
}
END_TEST

START_TEST(a_message_that_makes_no_sense_is_refused_and_the_next_is_read)
{
	static const char *const nonsense[] = {
	    "x",
	    "{}",
	    "[]",
	    "{\"kind\":\"dance\"}",
	    "{\"kind\":\"cancel\"}",
	    "{\"kind\":\"cancel\",\"job\":7}",
	    "{\"kind\":\"quit\",\"job\":\"j\"}",
	    "{\"kind\":\"row\",\"job\":\"j\",\"iteration\":1.5}",
	    "{\"kind\":\"views\",\"job\":\"j\",\"runs\":[1]}",
	    "{\"kind\":\"views\",\"job\":\"j\",\"runs\":[5,4]}",
	    "{\"kind\":\"views\",\"job\":\"j\",\"runs\":[0,20000]}",
	    "{\"kind\":\"views\",\"job\":\"j\",\"runs\":[-1,2]}",
	    ("{\"kind\":\"start\",\"job\":\"j\",\"scan_directory\":\"\",\"job_directory\":\"\",\"iteration\":0,"
	     "\"request\":{\"scan\":\"s\",\"emit\":[1,2,0.5]}}"),
	    "{\"kind\":\"settled\",\"job\":\"j\"}",
	};

	for (size_t i = 0; i < sizeof(nonsense) / sizeof(nonsense[0]); i++) {
		struct message message = {.kind = MESSAGE_QUIT}, back = {.job = "untouched"};
		struct error err = {0};
		bool got = false;

		ck_assert_int_eq(send(ends[0], nonsense[i], strlen(nonsense[i]), 0), (ssize_t)strlen(nonsense[i]));
		ck_assert_msg(message_receive(ends[1], 0, &back, &got, &err) == ERR_INVALID, "%s", nonsense[i]);
		ck_assert_str_eq(back.job, "untouched");
		through(&message);
	}
}
END_TEST

START_TEST(a_packet_that_is_too_long_is_refused_and_the_next_is_read)
{
	int room = 1 << 20;
	char *packet = malloc(MESSAGE_BYTES_MAX + 1);
	struct message message = {.kind = MESSAGE_QUIT}, back;
	struct error err = {0};
	bool got = false;

	ck_assert_ptr_nonnull(packet);
	memset(packet, ' ', MESSAGE_BYTES_MAX + 1);
	setsockopt(ends[0], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
	ck_assert_int_eq(send(ends[0], packet, MESSAGE_BYTES_MAX + 1, 0), MESSAGE_BYTES_MAX + 1);
	ck_assert_int_eq(message_receive(ends[1], 0, &back, &got, &err), ERR_TOO_LARGE);
	through(&message);
	free(packet);
}
END_TEST

enum { SENDERS = 4, EACH = 300 };

static void *send_many(void *context)
{
	struct message message = {.kind = MESSAGE_ROW};
	struct error err = {0};

	snprintf(message.job, sizeof(message.job), "job-%d", *(int *)context);
	for (int i = 0; i < EACH; i++) {
		message.row.iteration = i;
		if (message_send(ends[0], &message, &err) != 0)
			return context; /* anything but NULL */
	}
	return NULL;
}

START_TEST(any_thread_may_send_and_packets_stay_whole)
{
	pthread_t threads[SENDERS];
	int names[SENDERS], next[SENDERS] = {0};

	for (int i = 0; i < SENDERS; i++) {
		names[i] = i;
		ck_assert_int_eq(pthread_create(&threads[i], NULL, send_many, &names[i]), 0);
	}
	for (int n = 0; n < SENDERS * EACH; n++) {
		struct message back;
		struct error err = {0};
		bool got = false;
		int sender = -1;

		ck_assert_int_eq(message_receive(ends[1], 10000, &back, &got, &err), 0);
		ck_assert(got);
		ck_assert_int_eq(sscanf(back.job, "job-%d", &sender), 1);
		ck_assert(sender >= 0 && sender < SENDERS);
		ck_assert_int_eq(back.row.iteration, next[sender]++); /* in the order of each sender */
	}
	for (int i = 0; i < SENDERS; i++) {
		void *failed = NULL;

		ck_assert_int_eq(pthread_join(threads[i], &failed), 0);
		ck_assert_ptr_null(failed);
	}
}
END_TEST

Suite *message_suite(void)
{
	Suite *suite = suite_create("message");
	TCase *tests = tcase_create("messages");

	tcase_set_timeout(tests, 60); /* sanitizers on a loaded machine */
	tcase_add_checked_fixture(tests, open_pair, close_pair);
	tcase_add_test(tests, a_start_carries_the_whole_recipe);
	tcase_add_test(tests, the_longest_list_of_volumes_fits);
	tcase_add_test(tests, a_start_says_which_projections_are_there);
	tcase_add_test(tests, short_messages_carry_their_job);
	tcase_add_test(tests, what_a_worker_says_comes_back);
	tcase_add_test(tests, numbers_come_back_the_same_and_nan_as_nan);
	tcase_add_test(tests, a_text_cut_within_a_character_is_not_lost);
	tcase_add_test(tests, nothing_comes_when_nothing_was_sent);
	tcase_add_test(tests, a_peer_that_has_gone_is_an_error_after_its_last_word);
	tcase_add_test(tests, a_message_that_makes_no_sense_is_refused_and_the_next_is_read);
	tcase_add_test(tests, a_packet_that_is_too_long_is_refused_and_the_next_is_read);
	tcase_add_test(tests, any_thread_may_send_and_packets_stay_whole);
	suite_add_tcase(suite, tests);
	return suite;
}

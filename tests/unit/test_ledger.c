/*
 * A fleet's ledger: each offer has one taker at a time, numbers of claims grow, and an old number changes nothing. In
 * the PostgreSQL server of CBCT_TEST_CATALOGUE.
 */
#include <check.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <time.h>
#include <unistd.h>

#include "core/error.h"
#include "daemon/store/ledger.h"
#include "proto/clock.h"

#define LEASE 3.0 /* s: what is to be done within it is done in time on a busy machine, too */

enum { HOSTS = 3, TAKERS = 12, JOBS = 240 };

static const char *database;
static char fleet[32];
static struct ledger *hosts[HOSTS];
/* Of whoever claims. */
static double device_bytes[] = {8e9, 24e9};
static int device_count;

static struct ledger_options options_of(const char *host, double lease)
{
	return (struct ledger_options){.database = database,
				       .fleet = fleet,
				       .host = host,
				       .url = "http://127.0.0.1:1",
				       .lease = lease,
				       .timeout = 30};
}

static struct ledger *join_fleet(const char *host, double lease)
{
	const struct ledger_options options = options_of(host, lease);
	struct ledger *ledger = NULL;
	struct error err = {0};

	ck_assert_msg(ledger_open(&options, &ledger, &err) == 0, "%s", err.text);
	return ledger;
}

/* A fleet of its own for each test: hosts "a", "b" and "c". */
static void form_fleet(double lease)
{
	static int fleets;
	char name[2] = "a";

	snprintf(fleet, sizeof(fleet), "t%ld_%d", (long)getpid(), fleets++);
	for (int i = 0; i < HOSTS; i++, name[0]++)
		hosts[i] = join_fleet(name, lease);
}

static void disband(void)
{
	for (int i = 0; i < HOSTS; i++)
		ledger_close(hosts[i]);
}

static struct offer offer_of(const char *job, int priority, int rank)
{
	struct offer offer = {.priority = priority, .rank = rank};

	snprintf(offer.job, sizeof(offer.job), "%s", job);
	return offer;
}

static void offer(struct ledger *ledger, const struct offer *offers, int count)
{
	struct error err = {0};

	ck_assert_msg(ledger_offer(ledger, offers, count, &err) == 0, "%s", err.text);
}

/* The job that was claimed, "" for none. */
static const char *claim(struct ledger *ledger, int least, struct fleet_claim *ret_claim)
{
	struct error err = {0};
	bool got = true;

	ck_assert_msg(ledger_claim(ledger, least, 0, device_bytes, device_count, ret_claim, &got, &err) == 0, "%s",
		      err.text);
	return got ? ret_claim->job : "";
}

static int renew(struct ledger *ledger, struct fleet_claim *ret_claims)
{
	struct error err = {0};
	int count;

	ck_assert_msg(ledger_renew(ledger, ret_claims, JOBS, &count, &err) == 0, "%s", err.text);
	return count;
}

static int claimed(struct ledger *ledger, struct fleet_claim *ret_claims)
{
	struct error err = {0};
	int count;

	ck_assert_msg(ledger_claimed(ledger, ret_claims, JOBS, &count, &err) == 0, "%s", err.text);
	return count;
}

static bool give_back(struct ledger *ledger, const struct fleet_claim *claim, double pause)
{
	struct error err = {0};
	bool had;

	ck_assert_msg(ledger_give_back(ledger, claim, pause, &had, &err) == 0, "%s", err.text);
	return had;
}

static void seen(struct ledger *ledger)
{
	struct error err = {0};

	ck_assert_msg(ledger_seen(ledger, NULL, 0, "", &err) == 0, "%s", err.text);
}

static void sleep_for(double seconds)
{
	const struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (double)(time_t)seconds))};

	nanosleep(&time, NULL);
}

START_TEST(the_highest_priority_goes_first_and_owners_take_turns)
{
	const struct offer of_a[] = {offer_of("a0", 0, 0), offer_of("a1", 0, 1), offer_of("a2", 2, 2)};
	const struct offer of_b[] = {offer_of("b0", 0, 0), offer_of("b1", 0, 1)};
	const char *const order[] = {"a2", "a0", "b0", "a1", "b1", ""};
	struct fleet_claim claims[JOBS];
	long long number = 0;

	form_fleet(60);
	offer(hosts[0], of_a, 3);
	offer(hosts[1], of_b, 2);
	for (int i = 0; i < 6; i++) {
		ck_assert_str_eq(claim(hosts[2], 0, &claims[0]), order[i]);
		ck_assert_int_eq(claims[0].priority, i == 0 ? 2 : 0);
		ck_assert_int_gt(claims[0].number, i < 5 ? number : number - 1);
		number = claims[0].number;
	}
	/* The owners see who has them, and the taker what it has. */
	ck_assert_int_eq(claimed(hosts[0], claims), 3);
	ck_assert_str_eq(claims[0].taker, "c");
	ck_assert_str_eq(claims[0].url, "http://127.0.0.1:1");
	ck_assert_int_eq(claimed(hosts[1], claims), 2);
	ck_assert_int_eq(renew(hosts[2], claims), 5);
	ck_assert_int_eq(renew(hosts[1], claims), 0);
	disband();
}
END_TEST

START_TEST(an_offer_goes_where_it_may_run)
{
	const struct {
		struct where where;
		int devices; /* of host b */
		bool goes;
	} cases[] = {
	    {{.host = "c"}, 2, false},
	    {{.host = "b"}, 0, true},
	    {{.host = "nobody"}, 2, false},
	    {{.memory = 8e9}, 0, false},
	    {{.memory = 8e9}, 1, true},
	    {{.memory = 24e9}, 1, false},
	    {{.memory = 24e9}, 2, true},
	    {{.memory = 24e9 + 1}, 2, false},
	    {{.devices = 1}, 0, true},
	    {{.devices = 2}, 1, false},
	    {{.devices = 2}, 2, true},
	    {{.memory = 24e9, .devices = 2}, 2, false},
	    {{.host = "b", .memory = 8e9, .devices = 2}, 2, true},
	    {{.host = "c", .memory = 8e9, .devices = 2}, 2, false},
	};
	struct fleet_claim taken_claim;

	form_fleet(60);
	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		struct offer one = offer_of("a0", 0, 0);

		one.where = cases[i].where;
		device_count = cases[i].devices;
		offer(hosts[0], &one, 1);
		ck_assert_msg(strcmp(claim(hosts[1], 0, &taken_claim), cases[i].goes ? "a0" : "") == 0, "case %zu", i);
		/* The rule is one, in the database and here. */
		ck_assert(where_fits(&one.where, "b", device_bytes, device_count) == cases[i].goes);
		offer(hosts[0], NULL, 0);
	}
	device_count = 0;
	disband();
}
END_TEST

START_TEST(nobody_claims_its_own_or_what_is_below_the_least)
{
	const struct offer of_a[] = {offer_of("a0", 1, 0)};
	struct fleet_claim one;

	form_fleet(60);
	offer(hosts[0], of_a, 1);
	ck_assert_str_eq(claim(hosts[0], 0, &one), "");
	ck_assert_str_eq(claim(hosts[1], 2, &one), "");
	ck_assert_str_eq(claim(hosts[1], 1, &one), "a0");
	/* An offer that goes takes its claim with it. */
	offer(hosts[0], NULL, 0);
	ck_assert(!give_back(hosts[1], &one, 0));
	disband();
}
END_TEST

START_TEST(an_old_number_changes_nothing)
{
	const struct offer of_a[] = {offer_of("a0", 0, 0)};
	struct fleet_claim claims[JOBS], old, new;

	form_fleet(LEASE);
	offer(hosts[0], of_a, 1);
	seen(hosts[0]);
	ck_assert_str_eq(claim(hosts[1], 0, &old), "a0");
	ck_assert_str_eq(claim(hosts[2], 0, &new), "");
	ck_assert_int_eq(claimed(hosts[0], claims), 1);
	ck_assert(!claims[0].lapsed);
	sleep_for(LEASE + 0.1);
	ck_assert_int_eq(claimed(hosts[0], claims), 1);
	ck_assert(claims[0].lapsed);
	/* An owner that has not been seen for a lease has nothing that is worth a claim. */
	ck_assert_str_eq(claim(hosts[2], 0, &new), "");
	seen(hosts[0]);
	ck_assert_str_eq(claim(hosts[2], 0, &new), "a0");
	ck_assert_int_gt(new.number, old.number);
	/* What the first taker does after its sleep. */
	ck_assert_int_eq(renew(hosts[1], claims), 0);
	ck_assert(!give_back(hosts[1], &old, 0));
	ck_assert_int_eq(claimed(hosts[0], claims), 1);
	ck_assert_int_eq(claims[0].number, new.number);
	ck_assert_str_eq(claims[0].taker, "c");
	/* A lease that has ended and that nobody has taken goes on. */
	sleep_for(LEASE + 0.1);
	ck_assert_int_eq(renew(hosts[2], claims), 1);
	ck_assert_int_eq(claims[0].number, new.number);
	ck_assert_int_eq(claimed(hosts[0], claims), 1);
	ck_assert(!claims[0].lapsed);
	/* Given back, it has a new number with the next. */
	ck_assert(give_back(hosts[2], &new, 0));
	seen(hosts[0]);
	ck_assert_str_eq(claim(hosts[1], 0, &old), "a0");
	ck_assert_int_gt(old.number, new.number);
	/* Nobody has it for a while that its owner says. */
	ck_assert(give_back(hosts[0], &old, LEASE / 2));
	seen(hosts[0]);
	ck_assert_str_eq(claim(hosts[2], 0, &new), "");
	ck_assert_int_eq(claimed(hosts[0], claims), 0);
	sleep_for(LEASE / 2 + 0.1);
	seen(hosts[0]);
	ck_assert_str_eq(claim(hosts[2], 0, &new), "a0");
	disband();
}
END_TEST

START_TEST(offers_that_stay_keep_their_claims)
{
	const struct offer first[] = {offer_of("a0", 0, 0), offer_of("a1", 0, 1)};
	const struct offer next[] = {offer_of("a1", 1, 0), offer_of("a2", 0, 1)};
	struct fleet_claim claims[JOBS], one;

	form_fleet(60);
	offer(hosts[0], first, 2);
	ck_assert_str_eq(claim(hosts[1], 0, &one), "a0");
	ck_assert_str_eq(claim(hosts[1], 0, &one), "a1");
	offer(hosts[0], next, 2);
	ck_assert_int_eq(claimed(hosts[0], claims), 1);
	ck_assert_str_eq(claims[0].job, "a1");
	ck_assert_int_eq(claims[0].number, one.number);
	ck_assert_int_eq(claims[0].priority, 1);
	ck_assert_str_eq(claim(hosts[2], 0, &one), "a2");
	disband();
}
END_TEST

START_TEST(a_host_is_one_daemon)
{
	const struct ledger_options options = options_of("b", 60);
	struct ledger *second = NULL;
	struct error err = {0};

	form_fleet(60);
	ck_assert_int_eq(ledger_open(&options, &second, &err), ERR_CONFLICT);
	ck_assert(strstr(err.text, "\"b\"") != NULL);
	/* It may come back. */
	ledger_close(hosts[1]);
	for (int i = 0; i < 200 && second == NULL; i++, sleep_for(0.05))
		ledger_open(&options, &second, &err);
	ck_assert_msg(second != NULL, "%s", err.text);
	hosts[1] = second;
	disband();
}
END_TEST

START_TEST(a_change_wakes_who_waits)
{
	const struct offer of_a[] = {offer_of("a0", 0, 0)};
	const int wake = eventfd(0, EFD_CLOEXEC);
	const uint64_t one = 1;
	struct error err = {0};
	double begun;

	form_fleet(60);
	offer(hosts[0], of_a, 1);
	begun = clock_monotonic();
	for (int i = 0; i < 3; i++) /* notifications of the fleet's beginning may be left */
		ck_assert_int_eq(ledger_wait(hosts[1], wake, i == 0 ? 50 : 0.1, &err), 0);
	ck_assert(clock_monotonic() - begun < 50);
	ck_assert_int_eq(write(wake, &one, sizeof(one)), sizeof(one));
	begun = clock_monotonic();
	ck_assert_int_eq(ledger_wait(hosts[1], wake, 50, &err), 0);
	ck_assert(clock_monotonic() - begun < 50);
	close(wake);
	disband();
}
END_TEST

/* ---- many takers at once ---- */

static atomic_int taken[JOBS];

static void *take_all(void *context)
{
	struct ledger *ledger;
	struct fleet_claim one;
	char host[16];

	snprintf(host, sizeof(host), "taker%d", (int)(size_t)context);
	ledger = join_fleet(host, 60);
	while (claim(ledger, 0, &one)[0] != '\0') {
		ck_assert_str_eq(one.taker, host);
		atomic_fetch_add(&taken[atoi(one.job)], 1);
	}
	ledger_close(ledger);
	return NULL;
}

START_TEST(each_offer_has_one_taker_however_many_ask)
{
	static struct offer offers[JOBS];
	static struct fleet_claim claims[JOBS];
	pthread_t takers[TAKERS];
	char job[16];

	form_fleet(60);
	for (int i = 0; i < JOBS; i++) {
		snprintf(job, sizeof(job), "%d", i);
		offers[i] = offer_of(job, i % 3, i);
		atomic_store(&taken[i], 0);
	}
	offer(hosts[0], offers, JOBS);
	for (size_t i = 0; i < TAKERS; i++)
		ck_assert_int_eq(pthread_create(&takers[i], NULL, take_all, (void *)i), 0);
	for (int i = 0; i < TAKERS; i++)
		pthread_join(takers[i], NULL);
	for (int i = 0; i < JOBS; i++)
		ck_assert_msg(atomic_load(&taken[i]) == 1, "offer %d has %d takers", i, atomic_load(&taken[i]));
	ck_assert_int_eq(claimed(hosts[0], claims), JOBS);
	for (int i = 1; i < JOBS; i++)
		ck_assert_int_gt(claims[i].number, claims[i - 1].number);
	disband();
}
END_TEST

START_TEST(names_that_can_be_none_are_refused)
{
	static const char *const fleets[] = {"", "A", "a b", "a;b", "a\"b", "abcdefghijklmnopqrstuvwxyz0123456"};
	static const char *const names[] = {"", "a b", "a'b", "a/b"};
	struct ledger_options options = options_of("a", 60);
	struct error err = {0};

	for (size_t i = 0; i < sizeof(fleets) / sizeof(fleets[0]); i++) {
		options.fleet = fleets[i];
		ck_assert_int_eq(ledger_check(&options, &err), ERR_INVALID);
	}
	options.fleet = "hospital_1";
	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
		options.host = names[i];
		ck_assert_int_eq(ledger_check(&options, &err), ERR_INVALID);
	}
	options.host = "cart-7.example";
	ck_assert_int_eq(ledger_check(&options, &err), 0);
	options.database = "postgresql://user:secret@host:port/db";
	ck_assert_int_eq(ledger_check(&options, &err), ERR_INVALID);
	ck_assert(strstr(err.text, "secret") == NULL);
}
END_TEST

Suite *ledger_suite(void)
{
	Suite *suite = suite_create("ledger");
	TCase *tests = tcase_create("ledger");

	suite_add_tcase(suite, tests);
	database = getenv("CBCT_TEST_CATALOGUE");
	if (database == NULL || ledger_open == NULL) {
		puts("SKIP unit suite ledger: it needs a PostgreSQL server (http/test_fleet has one)");
		return suite;
	}
	tcase_set_timeout(tests, 120);
	tcase_add_test(tests, the_highest_priority_goes_first_and_owners_take_turns);
	tcase_add_test(tests, an_offer_goes_where_it_may_run);
	tcase_add_test(tests, nobody_claims_its_own_or_what_is_below_the_least);
	tcase_add_test(tests, an_old_number_changes_nothing);
	tcase_add_test(tests, offers_that_stay_keep_their_claims);
	tcase_add_test(tests, a_host_is_one_daemon);
	tcase_add_test(tests, a_change_wakes_who_waits);
	tcase_add_test(tests, each_offer_has_one_taker_however_many_ask);
	tcase_add_test(tests, names_that_can_be_none_are_refused);
	return suite;
}

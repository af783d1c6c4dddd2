/*
 * How long a claim takes in the ledger of a fleet while many workers claim at once: an owner offers its queue, each
 * worker claims an offer, has it for a while, and claims the next. All of it is the ledger's own calls, against a real
 * server.
 *
 * Usage: claims DATABASE WORKERS JOBS SECONDS: that a job takes, on average. One line of text.
 */
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "daemon/store/ledger.h"
#include "proto/clock.h"

enum { WORKERS_MOST = 200, CLAIMS_MOST = 1000000, OFFERED = 64 };
static const double LOOK = 1;     /* s, as the daemons' */
static const double APART = 0.05; /* s, as between the first and the last daemon that was woken */

struct test {
	const char *database;
	int workers, jobs;
	double seconds;
	atomic_int done, claims, got;
	atomic_bool stop;
	atomic_bool *ended; /* [jobs] */
	float *took;        /* [CLAIMS_MOST] s */
};

struct worker {
	struct test *test;
	int index;
	double idle, longest; /* monotonic since when it is; the longest time so, but for the first */
};

static void die(const struct error *err)
{
	fprintf(stderr, "%s\n", err->text);
	exit(1);
}

static struct ledger *join(const struct test *test, const char *name)
{
	const struct ledger_options options = {.database = test->database,
					       .fleet = "claims",
					       .host = name,
					       .url = "http://127.0.0.1:1",
					       .lease = 15,
					       .timeout = 60};
	struct ledger *ledger;
	struct error err;

	if (ledger_open(&options, &ledger, &err) != 0)
		die(&err);
	return ledger;
}

static void pause_for(double seconds)
{
	const struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (double)(time_t)seconds))};

	nanosleep(&time, NULL);
}

static void *work(void *context)
{
	struct worker *worker = context;
	struct test *test = worker->test;
	const double memory[] = {80e9};
	struct fleet_claim claim;
	struct ledger *ledger;
	unsigned seed = (unsigned)worker->index;
	char name[32];
	struct error err;

	snprintf(name, sizeof(name), "worker%d", worker->index);
	ledger = join(test, name);
	while (!atomic_load(&test->stop)) {
		const double began = clock_monotonic();
		bool got = false;
		int at;

		if (ledger_claim(ledger, 0, 0, memory, 1, &claim, &got, &err) != 0)
			die(&err);
		at = atomic_fetch_add(&test->claims, 1);
		if (at < CLAIMS_MOST)
			test->took[at] = (float)(clock_monotonic() - began);
		if (got) {
			const double idle = clock_monotonic() - worker->idle;

			if (worker->idle > 0 && idle > worker->longest)
				worker->longest = idle;
			atomic_fetch_add(&test->got, 1);
			pause_for(test->seconds * (0.5 + (double)rand_r(&seed) / RAND_MAX));
			worker->idle = clock_monotonic();
			atomic_store(&test->ended[atoi(claim.job)], true);
		} else if (ledger_wait(ledger, -1, LOOK, &err) != 0) {
			die(&err);
		}
		if (!got)
			pause_for(APART * worker->index / test->workers);
		if (ledger_seen(ledger, memory, 1, "", &err) != 0)
			die(&err);
	}
	ledger_close(ledger);
	return NULL;
}

/* As an owner's daemon: at most OFFERED of its queue at a time, in their order, a look each 50 ms. */
static void own(struct test *test)
{
	struct ledger *ledger = join(test, "owner");
	struct error err;
	int done = 0;

	while (done < test->jobs) {
		struct offer offers[OFFERED];
		int count = 0;

		done = 0;
		for (int i = 0; i < test->jobs; i++) {
			if (atomic_load(&test->ended[i])) {
				done++;
			} else if (count < OFFERED) {
				offers[count] = (struct offer){.rank = count};
				snprintf(offers[count++].job, sizeof(offers[0].job), "%016d", i);
			}
		}
		if (ledger_seen(ledger, NULL, 0, "", &err) != 0 || ledger_offer(ledger, offers, count, &err) != 0)
			die(&err);
		pause_for(0.05);
	}
	ledger_close(ledger);
}

static int compare(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
	static struct worker workers[WORKERS_MOST];
	pthread_t threads[WORKERS_MOST];
	struct test test = {.workers = argc > 2 ? atoi(argv[2]) : 0};
	double began, longest = 0;
	int claims;

	if (argc != 5 || test.workers < 1 || test.workers > WORKERS_MOST || atoi(argv[3]) < 1)
		return fprintf(stderr, "usage: claims DATABASE WORKERS JOBS SECONDS\n"), 2;
	test.database = argv[1];
	test.jobs = atoi(argv[3]);
	test.seconds = atof(argv[4]);
	test.ended = calloc((size_t)test.jobs, sizeof(*test.ended));
	test.took = calloc(CLAIMS_MOST, sizeof(*test.took));
	if (test.ended == NULL || test.took == NULL)
		return 1;
	for (int i = 0; i < test.workers; i++) {
		workers[i] = (struct worker){&test, i, 0, 0};
		if (pthread_create(&threads[i], NULL, work, &workers[i]) != 0)
			return 1;
	}
	pause_for(1);
	atomic_store(&test.claims, 0); /* those of the beginning waited for each other's tables */
	began = clock_monotonic();
	own(&test);
	began = clock_monotonic() - began;
	atomic_store(&test.stop, true);
	for (int i = 0; i < test.workers; i++)
		pthread_join(threads[i], NULL);
	claims = atomic_load(&test.claims) < CLAIMS_MOST ? atomic_load(&test.claims) : CLAIMS_MOST;
	qsort(test.took, (size_t)claims, sizeof(*test.took), compare);
	for (int i = 0; i < test.workers; i++)
		longest = workers[i].longest > longest ? workers[i].longest : longest;
	printf("%d workers, %d jobs of %g s in %.1f s: %d claims, of which %d got one; median %.1f ms, 95 %% %.1f, 99 "
	       "%% %.1f, longest %.1f; "
	       "a worker without a job for at most %.2f s\n",
	       test.workers, test.jobs, test.seconds, began, claims, atomic_load(&test.got),
	       1e3 * (double)test.took[claims / 2], 1e3 * (double)test.took[claims * 95 / 100],
	       1e3 * (double)test.took[claims * 99 / 100], 1e3 * (double)test.took[claims - 1], longest);
	free(test.ended);
	free(test.took);
	return 0;
}

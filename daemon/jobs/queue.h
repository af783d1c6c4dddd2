#ifndef CBCT_DAEMON_JOBS_QUEUE_H
#define CBCT_DAEMON_JOBS_QUEUE_H

#include <stdbool.h>

#include "proto/recipe.h"

/*
 * The order of jobs: stat before urgent before routine, and in the order of their
 * tickets within a priority. A job keeps the ticket of its first time in the
 * queue, so one that yielded stands in front of its class again.
 *
 * Plain data, no lock of its own: jobs.lock guards the one that the daemon has.
 */
struct queue_entry {
	enum priority priority;
	long long ticket;
	bool queued;
	bool held;                           /* its time has not come: it keeps its place, others go before it */
	struct queue_entry *previous, *next; /* the queue's */
};

struct queue {
	struct queue_entry *first;
};

void queue_add(struct queue *queue, struct queue_entry *entry);
void queue_remove(struct queue *queue, struct queue_entry *entry); /* not queued is fine */
int queue_position(const struct queue_entry *entry);               /* 1 = next; 0: not queued */
/* The first that is not held and fits, or NULL. */
struct queue_entry *queue_next(const struct queue *queue,
			       bool (*fits)(const void *context, const struct queue_entry *entry), const void *context);

/* A job that a worker is busy with. */
struct queue_running {
	enum priority priority;
	long long ticket;
	bool leaving;   /* asked to yield or to cancel: its worker is as good as free */
	bool gives_way; /* to any other: it has nothing to do just now */
};

/*
 * Which of running[count] should yield so that a queued job of higher priority
 * gets a worker, when `idle` workers are free: one that gives way, else the lowest
 * priority, and of those the one that came last. -1 when none should. `arriving`:
 * the priority of one more job that is not queued, but wants a worker like those
 * that are, behind all of its priority; NULL: there is none.
 */
int queue_victim(const struct queue *queue, const enum priority *arriving, const struct queue_running *running,
		 int count, int idle);

#endif

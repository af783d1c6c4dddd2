#ifndef CBCT_DAEMON_JOBS_QUEUE_H
#define CBCT_DAEMON_JOBS_QUEUE_H

#include <stdbool.h>

#include "proto/recipe.h"

/*
 * The order of jobs: stat before urgent before routine; within a priority the client goes first that has used the
 * devices for the shortest time, and of each client's jobs the one with the lowest ticket. A job keeps the ticket of
 * its first time in the queue, so one that yielded stands in front of its client's others again.
 *
 * Time is counted from when a client comes to have jobs that are queued or run: one that comes anew, or comes back,
 * begins with the least that any of the others has used, so that nobody saves time up (start-time fair queueing, Goyal,
 * Vin and Cheng 1996).
 *
 * Plain data, no lock of its own: jobs.lock guards the one that the daemon has.
 */
struct queue_client {
	double used; /* s of devices, beside what it was lifted to when it came */
	int active;  /* jobs that are queued or run */
	int rank;    /* of queue_position alone */
	struct queue_client *next;
};

struct queue_entry {
	struct queue_client *client; /* never NULL */
	enum priority priority;
	long long ticket;
	int devices; /* that it wants at once; DEVICES_ALL: all that there are; 0 as 1 */
	bool queued;
	bool held;      /* its time has not come: it keeps its place, others go before it */
	bool elsewhere; /* it may have no device here: nobody waits for it, and it pushes nobody out */
	bool choosy;    /* it may have some of the devices here alone: it pushes nobody out, the next might not fit */
	struct queue_entry *previous, *next; /* the queue's */
};

struct queue {
	struct queue_entry *first;
	struct queue_client *clients;
};

/* A client that has never had a job; it stays until the queue is given up. */
void queue_know(struct queue *queue, struct queue_client *client);
/* One job more is queued or runs; one less. */
void queue_enter(struct queue *queue, struct queue_client *client);
void queue_leave(struct queue_client *client);

void queue_add(struct queue *queue, struct queue_entry *entry);
void queue_remove(struct queue *queue, struct queue_entry *entry); /* not queued is fine */
/* 1 = next, if all jobs took as long and no others came; 0: not queued. */
int queue_position(struct queue *queue, const struct queue_entry *entry);
/* The one that goes first of those that are not held and fit, or NULL. */
struct queue_entry *queue_next(const struct queue *queue,
			       bool (*fits)(const void *context, const struct queue_entry *entry), const void *context);

/* A job that a worker is busy with. */
struct queue_running {
	enum priority priority;
	long long ticket;
	int devices;    /* that it has; 0 as 1 */
	bool leaving;   /* asked to yield or to cancel: its worker is as good as free */
	bool gives_way; /* to any other: it has nothing to do just now */
};

/*
 * Which of running[count] should yield so that a queued job of higher priority
 * gets its devices, when `idle` ones are free: one that gives way, else the lowest
 * priority, and of those the one that came last. -1 when none should. `arriving`:
 * priority and devices of one more job that is not queued, but wants a worker like
 * those that are, behind all of its priority; NULL: there is none. `most`: devices
 * that there are at all, which a job that wants more contents itself with.
 */
int queue_victim(const struct queue *queue, const struct queue_entry *arriving, const struct queue_running *running,
		 int count, int idle, int most);

#endif

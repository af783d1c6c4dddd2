#ifndef CBCT_DAEMON_JOBS_INTERNAL_H
#define CBCT_DAEMON_JOBS_INTERNAL_H

#include <pthread.h>

#include <cjson/cJSON.h>

#include "daemon/jobs/job.h"

/* Shared by job.c (the list of jobs, and the calls of the API), state.c and work.c (the calls of the supervisor). */

/* Why a job that could run is not given to a worker just now. In memory only: after a restart it is tried at once. */
struct hold {
	enum job_obstacle obstacle;
	double until;             /* monotonic seconds */
	unsigned long long space; /* bytes that must be free on the disk */
	int times;                /* in a row, without a run between them that got further */
};

struct job {
	/* Constant. */
	struct jobs *jobs;
	char id[ID_SIZE], scan[ID_SIZE];
	struct job_request request; /* see job_request */
	struct error unreadable;    /* code 0: request is there */

	struct job_extent {
		int views;
		double samples, bytes;
		bool closed; /* with projections missing: it stays here */
	} extent;            /* of its scan; 0: it has gone */

	struct job_trial trial; /* the supervisor's own */
	int doubts;             /* job_doubt, with the next; the supervisor's own */
	unsigned doubted_at;

	struct watch_list watchers;

	/* Guarded by jobs->lock; all but the running job's progress is changed with jobs->change held too. */
	struct job_record record;
	struct queue_entry entry;
	struct hold hold;
	int references; /* one of them is the array's */
	bool removed;
	bool stays;                    /* job_stay */
	double away_until;             /* monotonic: kept for other hosts; 0: not looked at yet; below: it never is */
	double lacks_devices;          /* monotonic, job_lacks_devices; 0: it does not */
	struct client *client;         /* constant; what it points to is not */
	bool active;                   /* counted in its client's */
	double charged;                /* monotonic: its time on a device is counted up to then */
	bool bytes_known;              /* false of jobs that had ended before the start, until somebody asks */
	unsigned long long kept_bytes; /* of its volumes: that it may make, or once it has ended that are there */
	double stage_since;            /* monotonic seconds, while running; 0 before this process saw it run */
	double run_since;              /* monotonic seconds */
	double run_fraction;           /* at run_since */
	double rest, rest_at;   /* what was told of the time left while it runs, and when, monotonic; 0: nothing yet */
	double row_at;          /* monotonic seconds of the last history row, or of the last moment before the first */
	double row_seconds;     /* smoothed time from row to row, 0 before the first */
	struct job_views views; /* job_views; of when there had been so many changes of its warnings: */
	unsigned views_of, warned;
};

/* Somebody who has posted jobs; there until the end. */
struct client {
	char name[STORE_CLIENT_SIZE];
	struct queue_client share;
	struct client *next;
};

struct jobs {
	struct store *store; /* constant, as the next */
	double opened;       /* monotonic */
	struct watch_list watchers;
	pthread_mutex_t change; /* one change at a time; held over its commit; guards next_ticket */
	long long next_ticket;
	pthread_mutex_t lock; /* guards what follows and each job's fields; held for copying only */
	struct job **all;     /* [count], by id: oldest first */
	int count, space;
	struct queue queue;
	struct client *clients;
	struct jobs_statistics statistics; /* what there is now is counted on demand */
	struct histogram stages[STAGE_COUNT];
	struct job_rate rate[JOB_RATES];
	int rates, oldest_rate;
	int running; /* jobs in this state */
	/* jobs_set_devices */
	bool devices_known;
	char host[WHERE_HOST_SIZE];
	double device_bytes[WHERE_DEVICES_MOST];
	int devices, devices_most;
	double keep_devices;                     /* s */
	struct jobs_host hosts[JOBS_HOSTS_MOST]; /* jobs_set_hosts */
	int host_count;
	jobs_explain *explain; /* jobs_set_explain, with the next */
	void *explain_context;
};

/* ---- jobs/offer.c ---- */
/* Whether the job may run here, by its "where", stands in its entry. jobs->lock is held. */
void job_place(struct job *job);

/* ---- jobs/work.c ---- */
/* References to all that wait and are not attended, oldest first; free the array. NULL when there are none. */
struct job **jobs_waiting(struct jobs *jobs, int *ret_count);
/* A worker could reconstruct the waiting job's projections as they arrive. *ret_facts: of its scan. */
bool job_attendable(struct job *job, struct scan_facts *ret_facts);

/* The job whose place in the queue this is. */
struct job *job_of_entry(const struct queue_entry *entry);

/* ---- jobs/forecast.c ---- */
/* What a job that has succeeded took, for those that come. jobs->lock is held, or nobody else has the jobs yet. */
void job_measure(struct job *job, const struct job_record *record);

/* Seconds on so many devices from beginning to end, by those rates; NAN: nobody knows. jobs->lock is held. */
double job_whole(struct job *job, const struct job_rate *rates, int count, int devices);
/* The devices that the job runs on, or that it will begin with, as far as that is known now. jobs->lock is held. */
int job_devices_here(const struct job *job);
/* A queued job's seconds until it has its devices, *ret_devices of them; NAN. jobs->lock is held. */
double job_turn_in(struct job *job, double now, int *ret_devices);

/* ---- jobs/choice.c ---- */
/* It is kept for other hosts just now, though a device here may be free. jobs->lock is held. */
bool job_is_kept_away(struct job *job, double now);
/* Another host may have it, as far as the job is concerned. jobs->lock is held. */
bool job_may_go(const struct job *job);

/* ---- jobs/share.c ---- */
/* How many devices the job runs on, or ran on last; 1 where it is not known. */
int job_devices(const struct job_record *record);
/* The client's own, made where there is none; NULL: no memory. jobs->lock is held, as by the next. */
struct client *jobs_client(struct jobs *jobs, const char *name);
/* The job's state has changed: whether it counts among its client's, and its time up to now. */
void job_share(struct job *job);
/* The time of all that run is counted up to now. */
void jobs_charge(struct jobs *jobs);
/* ERR_LIMIT, ERR_BUSY, ERR_QUOTA: one more job of this client is too many. jobs->change is held. */
int jobs_check_limits(struct jobs *jobs, const struct job *job, struct error *err);
/*
 * Where --max-jobs keep this one out: cancels the job that has waited longest for projections of which none come, of a
 * client that has no fewer jobs. False: there is none. jobs->change is held; *ret_cancelled is a reference, and whoever
 * watches it is to be woken without the lock.
 */
bool jobs_make_place(struct jobs *jobs, const struct job *job, struct job **ret_cancelled);
/* jobs->change is held: the request to cancel is on the disk before it is shown, so that a restart carries it out. */
int job_ask_cancel(struct job *job, struct error *err);
/* Bytes of the volumes that the job may make. */
unsigned long long job_bytes_wanted(const struct job_request *request);
/* An ended job's bytes are those that it has left. */
int job_count_bytes(struct job *job, struct error *err);
unsigned long long jobs_bytes(void *jobs, const char *client);
long jobs_unended(void *jobs, const char *client);

/* The sendings that a new job begins with: one for each of its wishes, and its step's; returns how many. */
enum { JOB_SENDINGS_MOST = SENDS_MOST + 1 };
int job_wanted_sendings(const struct job *job, struct sending_record ret_sendings[JOB_SENDINGS_MOST]);

/* Wakes those who watch the job or all jobs; no lock is held. */
void job_wake(struct job *job);
/* Its warnings have changed: job_views. */
void job_forget_views(struct job *job);

/* As job_set_state, with jobs->change held; the caller wakes the watchers after it. */
int job_change_state(struct job *job, enum job_state to, const struct job_change *change, struct error *err);
/* Where the job is to run, as far as the change says it. */
void job_note_devices(struct job_record *record, const struct job_change *change);
/* The time since the last call belongs to the stage that ran. jobs->lock is held. */
void job_account_stage(struct job *job);

/* An event that carries the document, which is taken. A NULL document becomes an error, so that callers check once. */
int job_event_make(struct event *ret_event, const char *kind, cJSON *document, struct error *err);
/* state, iteration, attempts, error: the event of a change of state. NULL when memory ran out. */
cJSON *job_state_document(const struct job_record *record);

#endif

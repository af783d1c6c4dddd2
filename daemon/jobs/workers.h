#ifndef CBCT_DAEMON_JOBS_WORKERS_H
#define CBCT_DAEMON_JOBS_WORKERS_H

#include <pthread.h>
#include <stdatomic.h>

#include "core/cards/cards.h"
#include "core/host_memory.h"
#include "daemon/jobs/digest.h"
#include "daemon/jobs/outcome.h"
#include "daemon/jobs/route.h"
#include "daemon/jobs/spawn.h"
#include "daemon/jobs/supervise.h"
#include "daemon/watchdog.h"
#include "proto/message.h"

/*
 * Inside of the supervisor: supervise.c (the loop), listen.c (messages), ending.c (the end of their jobs),
 * give.c (dispatch) and attend.c (projections that still arrive). All of it is the supervisor's one thread,
 * but where something else is said.
 */
enum {
	WORKERS_MAX = 64, /* devices; one more may stand for the processor, and others for other hosts */
	SLOTS_MAX = WORKERS_MAX + 1 + PLACES_MAX,
	LINKS_MAX = 64,  /* hosts whose links are known */
	CRASHES_MAX = 3, /* times that a worker may fail to read or write for a job */
};
#define NEVER 1e300     /* a time of clock_monotonic that does not come */
#define RETRY 1.0       /* s until a change that the disk refused is tried again */
#define SPACE_RETRY 5.0 /* s until a job goes on that met a full disk, which has room by now */
#define EXIT 2.0        /* s that a worker has to exit by itself */
/*
 * s without a projection after which a worker that waits for some is anybody's: an arm that turns sends several a
 * second, and an arm that has stopped has nothing to lose but what the worker has reconstructed.
 */
#define PATIENCE 2.0

/* The end of a worker's job; kept until the catalogue has taken it. */
struct ending {
	bool due;
	enum job_state to;
	int error_code;
	char error_text[320];
	char report[JOB_REPORT_SIZE];
	int checkpoint;
	bool crashed, yielded;
	double again; /* monotonic: not before */
};

/*
 * Syncs the volumes of a worker that died after it announced them, in a thread of
 * its own: the disk may be slow, and other workers do not wait for it.
 */
struct syncer {
	struct supervise *supervise;
	struct job *job; /* the worker's */
	pthread_t thread;
	bool running; /* the supervisor's own */
	_Atomic bool done;
	int code; /* with the next: the thread's until it is done */
	struct error err;
};

struct worker {
	struct supervise *supervise; /* its own, constant as the next */
	int index;
	enum worker_state state;
	struct child child;
	double born, start_at; /* monotonic: of this process; of the next one */
	double deadline;       /* monotonic: killed then; NEVER */
	unsigned failures;     /* in a row */
	unsigned starts;
	char backend[16];
	struct device_info info; /* of the last hello */
	char last_error[160];
	bool remote;               /* of another host: jobs/remote.c */
	struct place place;        /* with remote; number 0: none */
	bool spent;                /* with remote: the place is */
	bool fallback;             /* of the processor, by --fallback cpu; its process is there while it is needed */
	unsigned faults;           /* errors of its device since a job succeeded on it */
	bool aside;                /* its device is given no jobs until a self-test or an operator clears it */
	bool testing;              /* its process begins with the self-test */
	unsigned tests;            /* self-tests that have failed since it was set aside */
	unsigned mute;             /* processes in a row without a hello, the one that is starting included */
	double aside_since;        /* seconds since 1970 */
	bool hung;                 /* the daemon ended the process because it finished no step */
	struct memory_group group; /* that bounds the memory of this process */
	unsigned long kills;       /* for want of memory in the group, which explain no end of this process */
	bool starved;              /* the kernel has ended this process for want of memory */
	bool unheard;   /* a message of this process was lost: later ones are not listened to, they may build on it */
	char said[160]; /* what its last message about a job was */
	double work;    /* of its job: voxels times projections */
	struct watchdog_signs signs;
	size_t steps;     /* that it has finished by its last sign of life */
	char killed[128]; /* why the daemon ended the process: it ...; "" as long as it has not */

	struct job *job;                  /* reference; NULL: none */
	struct worker *cards[CARDS_MOST]; /* of the devices that its job has or had last, its own first: lend.c */
	int card_count;
	int failed_card;        /* place among them of the one that ended the job in an error */
	struct worker *lent_to; /* another one's job has its device; NULL: none */
	struct queue_running running;
	int checkpoint;      /* that it began from */
	size_t volume_bytes; /* of one volume of its job */
	int unsettled;       /* volumes that it has announced and not settled */
	/* The latest rows of its history, which the catalogue has yet to take; none between two turns but while it is
	 * away. */
	struct history_row rows[JOB_ROWS_MAX];
	int row_count;
	struct message *held; /* that the catalogue could not take, being away; NULL: none */
	bool cancelling, yielding;
	double room_since; /* monotonic: it was asked to make room for projections that came later; NEVER */
	/* While its job waits for the rest of its projections: the scan, a reference; NULL otherwise. */
	struct stored_scan *arriving;
	unsigned basis, losses;       /* of the scan when it began */
	int announced, reconstructed; /* projections that it knows to be there, that it has reconstructed */
	double attended, again;       /* monotonic: watchdog_attended; not before, after the catalogue refused */
	int failure_code;             /* why the daemon stopped its job; 0: it did not */
	char failure_text[320];
	struct ending ending;
	struct syncer syncer;
};

struct supervise {
	struct jobs *jobs; /* constant, as the next five */
	struct digester *digester;
	char worker[1024], backend[16];
	struct supervise_options options;
	char remote[4][1024]; /* texts of options.remote */
	int count;            /* of workers[] */
	int regular;          /* without the fallback and those of other hosts */
	int local;            /* without those of other hosts */
	int devices[SLOTS_MAX];
	int wake; /* eventfd */
	struct watch jobs_watch, arrivals_watch;
	pthread_t thread;

	double processor_rate;            /* s that the processor took for an iteration, by `work`; 0: not known */
	struct worker workers[SLOTS_MAX]; /* the thread's own, as the one before */
	double memory[WORKERS_MAX];       /* devices_memory, as the jobs were told of last; the thread's own */
	int memory_count;                 /* -1: not yet */
	double dispatch_at;               /* monotonic; the thread's own */
	double kept_until; /* monotonic: when a job that waits for devices, or for other hosts, waits no longer; 0 */
	double review_at;  /* monotonic: when jobs that are held are looked at, 0: none; its own */
	double stop_by;    /* monotonic: the stop's end, NEVER before it; the thread's own */

	bool held;           /* the catalogue is away, nobody is listened to and judged; its own */
	atomic_ullong turns; /* of the thread's loop */

	pthread_mutex_t lock; /* guards what follows */
	struct worker_facts facts[SLOTS_MAX];
	struct place places[PLACES_MAX], spent[PLACES_MAX];
	int place_count, spent_count;
	struct host_trouble troubles[TROUBLES_MAX];
	struct link {
		char host[64];
		double speed; /* bytes a second, smoothed */
	} links[LINKS_MAX];
	int links_known;          /* of all hosts that there ever were */
	unsigned long long clear; /* bit for each worker that an operator wants cleared */
	bool stop;
};

/* ---- supervise.c ---- */
/* Ends the sleep of the loop. Any thread. */
void supervise_wake(void *supervise);
/* Ends the process at once; `why` goes on after "it". */
void worker_kill(struct supervise *supervise, struct worker *worker, const char *why);
/* Shows other threads the worker as it is now. */
void worker_publish(struct supervise *supervise, const struct worker *worker);

/* ---- listen.c ---- */
/*
 * Reads all that is there of a worker that died, else for one turn: iterations of a small job end faster than their
 * rows are recorded. *ret_gone at the end of the stream, or when it makes no sense.
 */
void worker_read(struct supervise *supervise, struct worker *worker, bool died, bool *ret_gone);
/* A message that the catalogue could not take is dropped. */
void worker_forget_held(struct worker *worker);
/* Sends a message that has no more to it than its kind. */
void worker_order(struct worker *worker, enum message_kind kind);
/* The worker is to end its job soon; it is killed if it does not. */
void worker_cancel(struct supervise *supervise, struct worker *worker);

/* ---- ending.c ---- */
/* The last that a worker said of its job, or what its process did. */
struct worker_words {
	enum worker_end end;
	int code;         /* enum error_code that a failed job bears */
	int iteration;    /* with END_MADE_ROOM: of the checkpoint */
	const char *text; /* one sentence */
	const char *how;  /* how its process ended; NULL: it has not */
};
/* The worker is through with its job, which goes where outcome.c says as soon as the catalogue takes that. */
void worker_end_job(struct supervise *supervise, struct worker *worker, const struct worker_words *words);
/* The job's new state reaches the catalogue now, or is tried again: a full disk must not lose how it ended. */
void worker_finish_job(struct supervise *supervise, struct worker *worker);
/* The job's scan is understood otherwise than when the worker began. */
bool worker_is_stale(const struct worker *worker);

/* ---- device.c ---- */
/* Devices that were set aside before this start still are; each begins with its self-test. Before any worker starts. */
void devices_load(struct supervise *supervise);
/* The worker's device is at fault for the end of this process, or of this job. */
bool device_at_fault(const struct worker *worker, enum worker_end end);
/* Counts an error of the worker's device; with DEVICE_FAULTS of them in a row it is set aside. */
void device_fault(struct supervise *supervise, struct worker *worker, const char *what);
/* Its device is given jobs again. */
void device_clear(struct supervise *supervise, struct worker *worker, const char *why);
/* Decides where the worker's job goes on, when its run was lost, and keeps that with the job. */
enum route device_route(struct supervise *supervise, struct worker *worker, enum worker_end end);
/* Jobs that this worker may be given. */
bool device_fits(const void *worker, const struct job_trial *trial);
/* Whether every device here that is given jobs has the memory that a job wants, which no other host has claimed. */
bool devices_fit(const void *supervise, const struct job_trial *trial);
/* Tells jobs what devices there are; carries out what operators have asked for; starts the processor's worker when it
 * is needed, and ends it after. */
void devices_tend(struct supervise *supervise);
/* The job begins on the processor though it was meant for another device: its document says so. */
void device_tell_fallback(struct supervise *supervise, struct worker *worker, int iterations);
/* JSON of how a job's last run was lost, for the document of a job that fails; owned by the caller. NULL: no memory. */
char *device_report(struct worker *worker, const struct worker_words *words, int runs);

/* Set aside, or DEVICE_FAULTS processes in a row have ended without a hello, as without a driver. */
bool device_is_out(const struct worker *worker);

/* ---- lend.c ---- */
/* It could begin a job now. */
bool worker_is_free(const struct worker *worker);
/* Devices of this host that are given jobs. */
int devices_in_service(const struct supervise *supervise);
/* The devices with which the job would begin on this worker, its own first; returns 0 where some of them are not free.
 */
int devices_choose(struct worker *worker, const struct job_trial *trial, struct worker *ret_cards[CARDS_MOST]);
/* Those that are free, for a job that has waited for more; returns 0 where they have too little memory for it. */
int devices_choose_free(struct worker *worker, struct job *job, struct worker *ret_cards[CARDS_MOST]);
/* The worker's new job has them until devices_return finds that it has ended. */
void devices_lend(struct supervise *supervise, struct worker *worker, struct worker *const cards[], int count);
void devices_return(struct supervise *supervise);
/* The one whose device failed, when the worker's job ended in a device's error: itself, or one that is lent to it. */
struct worker *worker_failed_card(struct worker *worker);
enum { CARDS_TEXT = 64 };
struct device_names {
	char device[96];         /* job_change.device */
	char cards[CARDS_TEXT];  /* of MESSAGE_START */
	char ran_on[CARDS_TEXT]; /* job_change.ran_on */
};
void devices_name(const struct worker *worker, struct worker *const cards[], int count, struct device_names *ret);
/* The worker's job has fewer devices than it asks for, `waited`: it was tired of waiting. Its document says so. */
void devices_tell_fewer(struct worker *worker, const struct job_trial *trial, int count, bool waited);

/* ---- memory.c ---- */
/* Whether what no job can do without has room on so many devices like the worker's, or in the host's memory. */
bool devices_have_room(const struct worker *worker, const struct job *job, int count);

/* ---- starve.c ---- */
/* The worker's new process is there: which control group bounds its memory. */
void starve_begin(struct worker *worker);
/* The process has ended, as `how` says. True, and told there, where the kernel has ended it for want of memory. */
bool starve_ended(struct supervise *supervise, struct worker *worker, char *how, size_t size);
/* Bytes that its control group allows; 0: no limit below the machine's memory. */
size_t starve_limit(const struct worker *worker);

/* ---- remote.c ---- */
/* Slots follow the places that are set. */
void remote_tend(struct supervise *supervise);
/* The slot's process is through with its job, or has gone. */
void remote_spend(struct supervise *supervise, struct worker *worker);
/* The job that this slot is there for. */
bool remote_fits(const struct worker *worker, const struct job_trial *trial);
/* Why the host of this slot's place cannot be given its job; NULL: it can. */
void remote_trouble(struct supervise *supervise, const struct worker *worker, const char *why);
/* So many bytes went to the host of this slot's place in so many seconds. */
void remote_measure(struct supervise *supervise, const struct worker *worker, double bytes, double seconds);
/* How a run on another host ends for its job: what fails there is no failure of the job. */
enum worker_end remote_end(const struct worker *worker, enum worker_end end, int code);

/* ---- give.c ---- */
/* Idle workers get jobs. */
void supervise_dispatch(struct supervise *supervise);
/* A worker whose job has a lower priority than one that waits for a worker is asked to make room. */
void supervise_preempt(struct supervise *supervise);

/* ---- attend.c ---- */
/*
 * Projections that came are announced to the worker that waits for them; with the last one its job runs. A job that is
 * stale is left, running or not, and begins again.
 */
void worker_attend(struct supervise *supervise, struct worker *worker);
/* The last projection was announced: from now on this is a job as any other. A code when the catalogue refused. */
int worker_record_running(struct worker *worker, struct error *err);
/* The worker does not wait for projections of its job any more. */
void worker_stop_attending(struct worker *worker);
/* When the patience with a worker that waits for projections ends; NEVER for any other. */
double worker_patience_ends(const struct worker *worker);
/* Projections that came later than this are worth a worker: just now, or after the last of a worker that gives way. */
double supervise_arrivals_since(const struct supervise *supervise, double now);

#endif

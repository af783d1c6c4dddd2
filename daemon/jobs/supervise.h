#ifndef CBCT_DAEMON_JOBS_SUPERVISE_H
#define CBCT_DAEMON_JOBS_SUPERVISE_H

#include "daemon/jobs/job.h"

/*
 * Workers: started, given jobs, watched, restarted; and jobs that other hosts compute.
 *
 * One thread does all of it, and is the only one that talks to workers and
 * moves jobs out of the queue and through `running`. A worker that dies takes
 * nothing with it: its job is queued again (route.h says how often, then it has
 * failed), and a new worker is started, later and later while they keep dying.
 *
 * A free worker attends a waiting job with FDK: the stored projections are announced
 * to it, in the order of their numbers up to the first that is missing, and it reconstructs them. A job of higher
 * priority takes the worker from it, and any other that has something to do
 * after two seconds in which nothing arrived; it then begins again later. So it
 * does, at once, when an image comes late or the scan is closed, since what was
 * reconstructed is void then; a job that runs already is queued again for that.
 * Uploads never wait for any of this: they wake the thread, and one message at a
 * time is under way.
 *
 * A worker that is stopped or hangs is killed and another one started: watchdog.h
 * says after which time. A job that a device has failed goes on with another one,
 * and a device that fails time and again is set aside: route.h.
 *
 * Threads: any for everything below; supervise_start and supervise_stop once each.
 */
struct supervise;

/* How jobs go to other hosts, and who this one is. Strings are copied. */
struct remote_options {
	const char *program;     /* path of cbct; NULL: no job goes anywhere */
	const char *token_file;  /* shown to the other host; "": none */
	const char *authorities; /* who signs the other host's certificate; "": whom the system trusts */
	const char *host;        /* the name of this one, in the fleet where it is in one; NULL: it has none */
	double lease;            /* s without an answer after which a host is lost */
};

struct supervise_options {
	struct remote_options remote;
	const char *worker;        /* path of cbct-worker; NULL: beside this program, else from PATH */
	const char *backend;       /* "auto", "cuda", "cpu" */
	int workers;               /* 0 = 1 */
	int devices_per_job;       /* of jobs that do not say; DEVICES_ALL; 0 = 1 */
	double keep_devices;       /* s that free devices are kept for a job that waits for more of them */
	const int *devices;        /* [workers], the device of each; NULL: 0 .. workers - 1 */
	int threads;               /* of the CPU backend; 0 = all */
	size_t device_memory;      /* bytes a worker may use; 0 = what is free */
	bool fallback;             /* jobs whose devices fail go on with the processor */
	double checkpoint_seconds; /* of work between two checkpoints of a job; 0 = 5 */
	double hello_seconds;      /* until a new worker must have spoken; 0 = 30 */
	double cancel_seconds;     /* until a worker that does not cancel is killed; 0 = 1.5 */
	double stop_seconds;       /* until a worker that does not leave its job at the stop is killed; 0 = 20 */
};

/* The strings are copied. Returns at once; the first worker says hello later. */
int supervise_start(struct jobs *jobs, const struct supervise_options *options, struct supervise **ret_supervise,
		    struct error *err);
/* Running jobs leave a checkpoint and are queued, workers end, within stop_seconds + 2. NULL is fine. */
void supervise_stop(struct supervise *supervise);

/*
 * ERR_BUSY when the supervisor's thread does not come round within that time: nobody starts workers, gives them jobs or
 * finds those that hang. Waits for it.
 */
int supervise_probe(struct supervise *supervise, double seconds, struct error *err);

/* At least one worker is there that can take jobs (idle or busy), and answers. */
bool supervise_ready(struct supervise *supervise);

/*
 * Devices of a job that leaves them open become the daemon's default, as far as this host has so many. ERR_IMPOSSIBLE,
 * pointer "/devices": the job wants more than there are, and no other host may have them.
 */
int supervise_check_devices(const struct supervise *supervise, struct job_request *request, struct error *err);

/*
 * Compares the memory that a job needs with that of the workers: ERR_IMPOSSIBLE with both
 * numbers, pointer "/grid/size", when none of them could ever run it. Passes
 * while no worker has said yet what it has: the worker asks again at the start.
 */
int supervise_check_memory(struct supervise *supervise, const struct scan *scan, const struct job_request *request,
			   struct recon_memory *ret_memory, struct error *err);

/*
 * ---- jobs that other hosts compute: jobs/remote.c ----
 *
 * A place is another host that has claimed one of the queued jobs. Each has a process in a slot of its own, which is a
 * worker as any other to its job; a job that is given back is queued again. A place that is no more among those that
 * are set has its job taken back. A place is spent when the process has gone: its job has ended or is queued again, or
 * could not be given to it. It stays so until it is no more among those that are set; numbers never come twice.
 */
enum { PLACES_MAX = 16 };
struct place {
	char job[ID_SIZE];
	char host[64], url[256];
	long long number; /* of the claim, above 0 */
};
/* The key of the job on the other host: by it that host knows whose it is. */
void place_claim(const char *owner, const char *job, long long number, char *ret_text, size_t size);
void supervise_set_places(struct supervise *supervise, const struct place *places, int count);
/* Returns how many are spent. */
int supervise_spent(struct supervise *supervise, struct place ret_places[PLACES_MAX]);

/* Hosts that have claimed jobs of this one and cannot be given any: they refuse its token, or are not reached from
 * here.
 */
struct host_trouble {
	char host[64], text[200];
	double at; /* monotonic: the last time; 0: none */
};
enum { TROUBLES_MAX = 16 };
/* Returns how many there are: each host's last, of the last two minutes. */
int supervise_troubles(struct supervise *supervise, struct host_trouble ret_troubles[TROUBLES_MAX]);

/* Bytes a second that went to that host when projections were sent there last; 0: not known. */
double supervise_link(struct supervise *supervise, const char *host);

/* A copy of what is known of one worker, for GET /v1/devices, /readyz and /metrics. */
enum worker_state {
	WORKER_ABSENT,
	WORKER_STARTING,
	WORKER_IDLE,
	WORKER_BUSY,
	WORKER_ENDING,
	WORKER_LENT, /* idle, and another worker's job has its device; in worker_facts alone */
	WORKER_STATE_COUNT
};
extern const char *const worker_state_names[WORKER_STATE_COUNT];
struct worker_facts {
	int index, device_index; /* the second counts devices of its backend */
	enum worker_state state;
	long pid; /* 0: none */
	char backend[16], device[96], driver[64];
	size_t bytes_total, bytes_free;
	char job[ID_SIZE];    /* that has its device, "" when there is none */
	double stepped;       /* monotonic: when it was last seen to have finished a step; 0: it does not work */
	double heard;         /* monotonic: when something came from it */
	double step_seconds;  /* that its step under way may take by its nature */
	bool fallback;        /* the processor's, by --fallback cpu: there while it is needed */
	unsigned faults;      /* errors of its device since a job succeeded on it */
	bool aside;           /* it is given no jobs */
	double aside_since;   /* seconds since 1970 */
	double test_at;       /* monotonic: when its next self-test begins; 0: one is under way */
	unsigned restarts;    /* since the daemon's start */
	char last_error[160]; /* why the last one ended, "" */
};
/*
 * A worker that has been silent, or busy with one step that was not announced as a long one, for as long as one that
 * runs never is (watchdog.h), does not answer. Nobody has to be killed for that to be told.
 */
bool worker_answers(const struct worker_facts *facts);
/* Bytes of each device that is given jobs, of the processor's only where it is one; returns how many they are. */
int devices_memory(const struct worker_facts *facts, int count, double ret_memory[]);
/* Fills at most `most` entries, returns how many there are; those of other hosts are none of them. */
int supervise_workers(struct supervise *supervise, struct worker_facts *ret_facts, int most);
/*
 * An operator says that the device of worker `index` is to be given jobs again, and to be started at once where it is
 * not; *ret_facts is how it will be. ERR_NOT_FOUND: there is no such worker.
 */
int supervise_clear(struct supervise *supervise, int index, struct worker_facts *ret_facts, struct error *err);

#endif

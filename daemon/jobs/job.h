#ifndef CBCT_DAEMON_JOBS_JOB_H
#define CBCT_DAEMON_JOBS_JOB_H

#include "daemon/histogram.h"
#include "daemon/jobs/queue.h"
#include "daemon/store/store.h"
#include "proto/recipe.h"

/*
 * The life of a job.
 *
 *   waiting -> queued -> running -> succeeded | failed | cancelled
 *                 ^---------'  a yield, a dead worker, a restart
 *
 * A job whose scan loses projections or an image to the disk waits again (queued
 * or running -> waiting) until they are sent again, and begins anew then.
 *
 * A waiting job may be attended: a worker reconstructs its projections as they
 * arrive. With the last of them it is running, without having been queued; when
 * the worker is taken from it or dies, it waits as before.
 *
 * Whoever changes a state goes through job_set_state: it checks the one table
 * of transitions, commits the row with its event, then shows the change in
 * memory, logs it and wakes the watchers, in this order. So whatever a reader
 * sees is on the disk.
 *
 * Locks: jobs.change makes changes one at a time and is held over their commit;
 * jobs.lock guards the fields in memory and is held for copying only, so that
 * readers never wait for the disk. Order: change, then lock. Neither is held
 * when watchers are woken or when a caller's code runs.
 *
 * Threads: any, for every function that says nothing else.
 */
struct jobs;
struct job; /* counted references */

bool job_state_ended(enum job_state state);
bool job_state_may_follow(enum job_state from, enum job_state to);

/*
 * Loads all jobs. What was running goes back to the queue (with its checkpoint,
 * where there is one); a cancel that had been asked for is carried out.
 */
int jobs_open(struct store *store, struct jobs **ret_jobs, struct error *err);
void jobs_close(struct jobs *jobs); /* NULL is fine; all references must be back */
struct store *jobs_store(const struct jobs *jobs);

/* ---- calls of the API ---- */
/*
 * The job that an Idempotency-Key made before, or NULL in *ret_job (and 0).
 * ERR_CONFLICT, pointer "": that key came with another request (digest: SHA-256 of its body).
 */
int jobs_repeat(struct jobs *jobs, const char *key, const uint8_t digest[32], struct job **ret_job, struct error *err);

/*
 * A new job of a resolved request, queued when the scan is ready and waiting
 * otherwise. The request is copied. key may be NULL; if the key was used
 * meanwhile, what jobs_repeat would say. *ret_new: false for such a repeat.
 * ERR_NOT_FOUND, pointer "/scan", when the scan was deleted meanwhile; ERR_LIMIT, ERR_BUSY, ERR_QUOTA where the
 * client, or all of them, have as much as they may have.
 */
int jobs_post(struct jobs *jobs, const struct job_request *request, struct stored_scan *scan,
	      const struct recon_memory *memory, const char *client, const char *key, const uint8_t digest[32],
	      struct job **ret_job, bool *ret_new, struct error *err);

int jobs_find(struct jobs *jobs, const char *id, struct job **ret_job, struct error *err); /* ERR_NOT_FOUND */
struct job *job_reference(struct job *job);
void job_release(struct job *job); /* NULL is fine */
struct jobs *job_jobs(const struct job *job);

/* Newest first, as store_scan_list. */
int jobs_list(struct jobs *jobs, const char *after, int limit, struct job **ret_jobs, int *ret_count, bool *ret_more,
	      struct error *err);

/*
 * DELETE. A job that has not ended is asked to: waiting and queued ones are
 * cancelled on return, a running or attended one soon after (watch it). An ended job is
 * removed with its rows and files, ERR_CONFLICT while another one refines with its volume. *ret_removed says which it
 * was.
 */
int jobs_delete(struct jobs *jobs, struct job *job, bool *ret_removed, struct error *err);
/* When an ended job goes for its age (store_limits.keep), seconds since 1970; INFINITY: it stays. */
double job_kept_until(struct job *job);
/* A pinned job uses this scan: neither goes for its age. */
bool jobs_pin_scan(struct jobs *jobs, const char *scan);
/* A pinned job stays whatever its age. ERR_NOT_FOUND: it is removed. */
int job_pin(struct job *job, bool pinned, struct error *err);
/* How well its projections agree with its geometry, by the newest job that has found it; false: none has. */
bool jobs_agreement(struct jobs *jobs, const char *scan, struct recon_agreement *ret_agreement);
/* Deletes a scan with its files. ERR_CONFLICT, naming the job, while one that has not ended uses the scan. */
int jobs_delete_scan(struct jobs *jobs, struct stored_scan *scan, struct error *err);
/* Removes an image of a scan. ERR_CONFLICT, naming the job, while one that runs uses the scan. */
int jobs_remove_image(struct jobs *jobs, struct stored_scan *scan, enum image image, struct error *err);
/* The same of an image of scatter, or of all (-1); also while one has begun that goes on later. */
int jobs_remove_scatter(struct jobs *jobs, struct stored_scan *scan, int image, struct error *err);

/* Woken at each change of state and each new event of this job, or of any; not at mere progress. See watch.h. */
void job_watch(struct job *job, struct watch *watch);
void job_unwatch(struct job *job, struct watch *watch);
void jobs_watch(struct jobs *jobs, struct watch *watch);
void jobs_unwatch(struct jobs *jobs, struct watch *watch);

/* A copy of what a handler needs without making a document. */
struct job_facts {
	char id[ID_SIZE], scan[ID_SIZE];
	enum job_state state;
	bool ended, removed;
	bool cancel_asked, attended;
	enum priority priority;
	double mu_water;    /* 1/mm */
	struct where where; /* job_request_where */
	int devices;        /* that it has, or wants; DEVICES_ALL */
};
void job_facts(struct job *job, struct job_facts *ret);

/*
 * Gives the resolved request: as it was posted, or read from the catalogue when the daemon started. It lives as long
 * as the reference. The error of reading it, ERR_INVALID or another, where the stored one cannot be read.
 */
int job_request(const struct job *job, const struct job_request **ret_request, struct error *err);
/* The record as it is now; request and key point into the job and live as long as the reference. */
void job_record(struct job *job, struct job_record *ret_record);
/* 1 = next; 0 when it is not queued. */
int job_queue_position(struct job *job);
/* Seconds until it has ended, waiting for its turn included; negative where nobody can know. */
double job_eta(struct job *job);
/* Seconds until a queued job has a device; negative where nobody can know, or it is not queued. */
double job_start_in(struct job *job);

struct jobs_statistics {
	/* Now; the age, s, is that of the job that was posted first, 0 where there is none. */
	long count[JOB_STATE_COUNT][PRIORITY_COUNT];
	double oldest[JOB_STATE_COUNT][PRIORITY_COUNT];
	/* Since the daemon's start. */
	unsigned long long started, crashed, yielded, checkpoints, iterations;
	unsigned long long ended[JOB_STATE_COUNT];
	const struct histogram *stages; /* [STAGE_COUNT]: what each stage of a job took, counted when it ends */
};
void jobs_statistics(struct jobs *jobs, struct jobs_statistics *ret);

/* ---- jobs that other hosts compute: jobs/offer.c ---- */

/* A job with an Idempotency-Key that begins so is another daemon's: it is computed here, and no one else is to. */
#define JOB_MIRROR_KEY "fleet:"
bool job_is_mirror(const struct job_record *record);
/* Its Idempotency-Key as it was sent: one of a client with a name is kept behind that. NULL: it is this daemon's own.
 */
const char *job_mirror_key(const struct job_record *record);
struct job_offer {
	char id[ID_SIZE], scan[ID_SIZE];
	enum priority priority;
	struct where where;
	bool elsewhere; /* no device here may have it, or it is kept for other hosts just now */
};
/*
 * Queued jobs that another host may compute, in the order of the queue behind the first `skip` of it that may run here,
 * at most `most`. Returns how many. Not those that are held or another daemon's, and not those that may run here and
 * stay.
 */
int jobs_offers(struct jobs *jobs, int skip, struct job_offer *ret_offers, int most);
/*
 * Waiting jobs that nobody attends and another host may, whose projections have come after `since` (CLOCK_MONOTONIC),
 * oldest first.
 */
int jobs_offers_arriving(struct jobs *jobs, double since, struct job_offer *ret_offers, int most);
/* From now on the job is computed here alone; in memory only. */
void job_stay(struct job *job);

/* ---- calls of the supervisor, in its one thread ---- */
struct job_change {
	int error_code; /* with JOB_FAILED */
	const char *error_pointer, *error_text;
	const char *report;           /* with JOB_FAILED: JSON, of a run that was lost; NULL: none */
	int checkpoint;               /* to JOB_QUEUED: the iteration that checkpoint.f32 holds, 0: none */
	bool crashed;                 /* to JOB_QUEUED, JOB_WAITING or JOB_FAILED: the worker died with it */
	bool yielded;                 /* to JOB_QUEUED: it goes on later, which is no new attempt */
	unsigned basis;               /* to JOB_RUNNING: of its scan; after another one it begins anew, its past goes */
	const char *backend, *device; /* to JOB_RUNNING, as the next; NULL: those that it has */
	const char *ran_on;           /* job_record.ran_on */
	const char *reason;           /* for the log */
};
/* ERR_CONFLICT when the table does not allow it; the caller's picture was old. change may be NULL. */
int job_set_state(struct job *job, enum job_state to, const struct job_change *change, struct error *err);

/* Waiting jobs whose scan has become ready go to the queue, but for those that are attended. */
int jobs_promote(struct jobs *jobs, struct error *err);
/*
 * Where a job has been, and is not to be again; the supervisor's thread alone. In memory only: after a restart of the
 * daemon every device is worth a try.
 */
struct job_trial {
	const struct where *where; /* the job's own, constant, as the next */
	const int *devices;        /* that it wants at once; job_request.devices */
	int place;                 /* slot of the host that has claimed it (supervise.h), 0: none */
	int given_back;            /* runs that other hosts have begun and not ended */
	unsigned long long left;   /* bit for each worker whose device the job has left */
	int worker, deaths;        /* runs lost on this one's device without a checkpoint between them */
	bool processor;            /* it goes on with the processor, by --fallback cpu */
};
/* A test of jobs that a worker could take; where one is asked for, NULL lets all of them pass. */
struct job_filter {
	bool (*fits)(const void *context, const struct job_trial *trial);
	const void *context;
};
/*
 * The waiting job that an idle worker should attend, or NULL: it fits, it has FDK, and its
 * projections can be converted and are not all there. Those whose projections came after `since`
 * (CLOCK_MONOTONIC) go first, the higher priority before the lower; then those
 * that came later. *ret_arriving: it is one of the former.
 */
struct job *jobs_arriving(struct jobs *jobs, double since, const struct job_filter *filter, bool *ret_arriving);
/* ERR_CONFLICT when it does not wait any more, or was cancelled. */
int job_attend(struct job *job, const struct job_change *change, struct error *err);
/* The worker goes; a job that still waits is where it was before, or cancelled where that was asked for. */
int job_leave(struct job *job, struct error *err);
/*
 * A worker found the job's scan damaged when the scan had lost that much. How many times in a row workers did so,
 * without another loss since. The supervisor's thread only.
 */
void job_doubt(struct job *job, unsigned losses);
int job_doubts(const struct job *job, unsigned losses);
/* Projections reconstructed so far. */
void job_reconstructed(struct job *job, int count);
/*
 * An obstacle keeps a job from a worker though its scan is complete. The job is not given to one before `until`
 * (clock_monotonic) and before the disk has `space` bytes free; it keeps its place in the queue, and others go before
 * it. Returns how often in a row it was held for this obstacle.
 */
enum job_obstacle {
	JOB_UNHINDERED,
	JOB_NO_SPACE,
	JOB_DISK_TROUBLE,
	JOB_NO_MEMORY,
	JOB_NO_HOST,       /* by its "where" it may have no device here; it is not held for that */
	JOB_NO_CHECKPOINT, /* that it is to begin with has not come; nor for that */
	JOB_NO_DEVICES,    /* it is its turn, and not as many devices are free as it wants; nor for that */
	JOB_OBSTACLE_COUNT
};
/* As in `waiting_for`: "space", "disk", "memory", "host", "checkpoint", "devices". */
extern const char *const job_obstacle_names[JOB_OBSTACLE_COUNT];
int job_hold(struct job *job, enum job_obstacle obstacle, double until, unsigned long long space);
/* Releases held jobs whose time has come and for which the disk has room; true while others are still held. */
bool jobs_review_holds(struct jobs *jobs, double now, unsigned long long space);
enum job_obstacle job_obstacle(struct job *job); /* any thread */
/*
 * Why a queued job has no host yet, one sentence, "" where it is not for want of one: `elsewhere`, no device here may
 * run it. Called with the jobs' lock in hand. NULL: this host is in no fleet.
 */
typedef void jobs_explain(void *context, const struct where *where, bool elsewhere, char *ret_text, size_t size);
void jobs_set_explain(struct jobs *jobs, jobs_explain *explain, void *context);

/* ---- whether a job goes to another host: jobs/choice.c ---- */
/* Seconds a unit of work in a stage on so many devices: forecast.c. */
enum { JOB_RATES = 64 };
struct job_rate {
	enum stage stage;
	unsigned variant;
	int devices; /* that it ran on */
	double seconds;
};
/* What jobs have taken here; returns how many. Any thread. */
int jobs_rates(struct jobs *jobs, struct job_rate ret_rates[JOB_RATES]);
/* Another host that takes jobs of this one. */
enum { JOBS_HOSTS_MOST = 32 };
struct jobs_host {
	char name[WHERE_HOST_SIZE];
	double memory[WHERE_DEVICES_MOST]; /* bytes of each device */
	int devices, rates;
	double link; /* bytes a second on the way there and back */
	struct job_rate rate[JOB_RATES];
};
/* From now on there are these, at most JOBS_HOSTS_MOST; they are copied. */
void jobs_set_hosts(struct jobs *jobs, const struct jobs_host *hosts, int count);
/*
 * By what jobs have taken here and there: 1 where another host would have done the queued job sooner, with what is sent
 * and fetched for it, than devices here that it would have to wait for; 0 where it would not; -1: nobody can know.
 */
int job_goes_sooner(struct job *job);

enum { JOB_WAIT_SIZE = 320 };
void job_wait_text(struct job *job, char ret_text[JOB_WAIT_SIZE]); /* any thread */
struct job_trial *job_trial(struct job *job);
/*
 * This host's name and the bytes that its devices have, of which each job's "where" says whether it may run here; until
 * it is called any job may. A job that wants more than `most` devices may not, whatever some of them do just now. Those
 * that are free are kept for `keep` seconds for a job that waits for more of them.
 */
void jobs_set_devices(struct jobs *jobs, const char *host, const double *memory, int count, int most, double keep);
/* A job that has not ended waits for the processor. */
bool jobs_want_processor(struct jobs *jobs);

/*
 * It is its turn, and not as many devices are free as it wants; so until its state changes. Returns since when,
 * CLOCK_MONOTONIC.
 */
double job_lacks_devices(struct job *job);
/* Bytes that no job over this scan can do without: its projections as floats, the iterate and its copy. */
size_t job_least_bytes(const struct job *job);

/* The queued job that is due, not held, and fits, or NULL; it stays queued until job_set_state. */
struct job *jobs_next(struct jobs *jobs, const struct job_filter *filter);
/* queue_victim over the jobs' queue. */
int jobs_victim(struct jobs *jobs, const struct queue_entry *arriving, const struct queue_running *running, int count,
		int idle, int most);

void job_set_plan(struct job *job, const struct recon_memory *memory, const char *plan);
/* recon_hooks.denoising. Memory only, until the next change of state, as is the progress. */
void job_set_denoising(struct job *job, double noise_hu, double alpha);
/* recon_hooks.agreement; the same. */
void job_set_agreement(struct job *job, const struct recon_agreement *agreement);
/* How its automatic iterations ended, with an event; one that a run after a crash ends in again is told once. */
int job_set_stop(struct job *job, const struct recon_stop *stop, struct error *err);
/*
 * A checkpoint of that iteration is on the disk: the job goes on from it when its worker or the daemon is lost, and
 * workers that died before count against it no more. In one commit.
 */
int job_checkpointed(struct job *job, int iteration, struct error *err);
void job_progress(struct job *job, enum stage stage, int iteration, double fraction);
enum { JOB_ROWS_MAX = 64 };
/* In one commit, all or none: 1 to JOB_ROWS_MAX rows, each with its event. */
int job_add_rows(struct job *job, const struct history_row *rows, int count, struct error *err);
/* A volume whose file is there; before its job ends, or is queued again, it must be on the disk. */
int job_add_volume(struct job *job, const struct volume_record *volume, struct error *err);
/*
 * For a worker that did not live to do it: what has no digest reaches the disk; a file that cannot is removed. Any
 * thread; waits for the disk, with no lock held.
 */
int job_sync_volumes(struct job *job, struct error *err);
/* See store_job_digest_volume. */
int job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err);
int job_add_warning(struct job *job, const char *code, const char *detail, struct error *err);
/* All of a volume was found whole: no warning says any more that it is damaged, but for a failure that is logged. */
void job_volume_whole(struct job *job, const char *volume);
/* What its warnings say of projections; remembered until the next warning. Any thread. */
struct job_views {
	bool told; /* false: nothing, and the rest is 0 */
	int left_out, mended;
};
int job_views(struct job *job, struct job_views *ret, struct error *err);

/* Until when the first of the jobs stays that are kept for other hosts just now, CLOCK_MONOTONIC; 0: none is. */
double jobs_kept_away(struct jobs *jobs);

/* ---- checkpoints that go from daemon to daemon: jobs/resume.c ---- */
/* A checkpoint comes in pieces of so many bytes, the last one shorter, which may be none. */
enum { CHECKPOINT_PIECE = 4 << 20 };
/* Opens the job's checkpoint, which no later one changes. ERR_NOT_FOUND: it has none just now. Any thread. */
int job_checkpoint_open(struct job *job, int *ret_file, int *ret_iteration, struct error *err);
/*
 * Takes a piece of the checkpoint that the job waits for, from the first on; one that came before may come again. With
 * the last one the job may begin, whatever the pieces hold: its worker holds them against their checksums, and begins
 * anew where they do not fit. ERR_CONFLICT: it waits for none, or for an earlier piece. ERR_INVALID: all of them are no
 * checkpoint of that iteration.
 */
int job_checkpoint_take(struct job *job, long piece, const void *data, size_t length, struct error *err);

/* ---- sendings of its volumes to archives; the rules are those of daemon/sendings ---- */
/* Free the array. Any thread. */
int job_sendings(struct job *job, struct sending_record **ret_sendings, int *ret_count, struct error *err);
/* As store_job_put_sendings, with the event of each. ERR_NOT_FOUND: the job is removed. */
int job_put_sendings(struct job *job, const struct sending_record *sendings, int count, const char *taken,
		     struct error *err);

/* ---- what the job has refined: jobs/refined.c ---- */
/*
 * The document of proto/refinement.h, the caller's to delete. ERR_NOT_FOUND: the job was not asked for it, or ended
 * before; ERR_CONFLICT: it is not known yet; ERR_DAMAGED. Any thread.
 */
int job_refinement(struct job *job, cJSON **ret_document, struct error *err);

/* ---- annotations: what people have measured in its volumes (proto/annotations.h) ---- */
/* Another one for each text; quoted, for ETags. */
enum { ANNOTATIONS_TAG_MAX = 36 };
void annotations_tag(const char *text, size_t length, char ret_tag[ANNOTATIONS_TAG_MAX]);
/* The text as it is kept, ANNOTATIONS_NONE where there is none. Free *ret_text. Any thread. */
int job_annotations(struct job *job, char **ret_text, size_t *ret_length, struct error *err);
/*
 * Replaces it where `fits(context, tag)` says so of the tag that it has, and tells all who watch. *ret_fits false, and
 * nothing done: it did not. ERR_NOT_FOUND: the job is removed.
 */
int job_annotate(struct job *job, const char *text, size_t length, bool (*fits)(void *context, const char *tag),
		 void *context, bool *ret_fits, struct error *err);

#endif

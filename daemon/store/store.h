#ifndef CBCT_DAEMON_STORE_STORE_H
#define CBCT_DAEMON_STORE_STORE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/recon/quality.h"
#include "core/scan/image.h"
#include "core/warning.h"
#include "daemon/id.h"
#include "daemon/store/quarantine.h"
#include "daemon/watch.h"
#include "proto/recipe.h"
#include "proto/digest.h"
#include "proto/sums.h"

/*
 * Everything that outlives the process: the catalogue (SQLite) and the files.
 *
 *   STATE/lock              held by the one daemon that uses STATE
 *   STATE/reserve           room for the commits that empty a full disk
 *   STATE/reserve-start     room for the next start on a full disk
 *   STATE/deleted           ids that clients have deleted (store/deleted.h)
 *   STATE/calibrations/     of another room (daemon/calibrations/calibrations.h)
 *   STATE/quarantine/       files that were found and belong nowhere (store/quarantine.h)
 *   STATE/catalogue.sqlite  scans, projections, jobs, volumes, history, warnings, events; or, in its place,
 *   STATE/catalogue.postgresql  the name of the schema of a PostgreSQL database that has them
 *   STATE/scans/ID/         scan.json projections.raw flat.f32 dark.f32 defects.u8 (proto/scan_directory.h)
 *                           projections.sums (proto/sums.h)
 *   STATE/jobs/ID/          NAME.nii, checkpoint.f32, annotations.json, refinement.json, refining
 *   STATE/{scans,jobs}/ID/record.json  its rows of the catalogue (store/record.h)
 *
 * The directories are the truth, the catalogue is their index: what it lacks is found again in them
 * (store/reconcile.c), and nothing is deleted because the catalogue does not know it.
 *
 * A call that returns 0 has its change on the disk: in the catalogue, or for
 * projections in their records (projections.sums), which their rows follow at
 * the next start. The order is always: files
 * first, synced, then the row; and on the way out: a record of the deletion, the
 * row, then the files.
 * A volume's row comes before its file is synced, which its job waits for before
 * it ends or is queued again, and before its digest, which nobody waits for.
 *
 * Threads: every function may be called from any thread. Writing calls wait for
 * one commit at a time (about 0.3 ms each); reading calls never wait for them.
 * No hook is called with a lock held, except where a lock says so itself.
 *
 * A commit or sync that fails for any other reason than a full disk is final:
 * hooks.failed is called (once, in the thread of the failure), every later
 * writing call returns ERR_IO, and the process should end without acknowledging
 * anything more. A full disk is ERR_NO_SPACE, changes nothing, and may pass. So does ERR_AWAY: the catalogue is
 * another server's, which cannot be reached just now.
 */
struct store;
struct stored_scan; /* counted references */

struct store_options {
	void *context;
	/* Where the catalogue is: "sqlite", in STATE, or "postgresql://...". NULL: sqlite. Copied. */
	const char *catalogue;
	double catalogue_timeout; /* s until its server counts as away; 0: 5 */
	/* Optional. Must not call into the store. */
	void (*failed)(void *context, const char *what);
};

/* Makes STATE where it is missing. ERR_CONFLICT: another process has it. hooks may be NULL, else are copied. */
int store_open(const char *directory, const struct store_options *hooks, struct store **ret_store, struct error *err);
void store_close(struct store *store); /* NULL is fine; all references must be back */
/* The path that was given to store_open; lives as long as the store. */
const char *store_directory(const struct store *store);
/*
 * ERR_IO where that path is not the directory that was opened any more: it was moved or removed, or its disk is gone.
 * Any thread.
 */
int store_check_directory(const struct store *store, struct error *err);

/* Any thread. Does nothing unless err is of a sync that failed (ERR_SYNC); then the store has failed, see above. */
void store_distrust(struct store *store, const struct error *err);

/*
 * A full disk can be emptied: a few MiB are set aside in STATE/reserve for the commits that a removal needs. Spending
 * gives them back to the file system; false when they are spent already. Another room is the next start's alone:
 * store_open gives it up on a full disk, and all that opens behind it may use it until store_started.
 * store_reserve_save makes both anew as soon as there is room for them again; store_reserve_whole tells whether each
 * has what it needs. Any thread.
 */
bool store_reserve_spend(const struct store *store);
void store_reserve_save(const struct store *store);
bool store_reserve_whole(const struct store *store);
void store_started(struct store *store);
/* Bytes that the file system of STATE has free. */
int store_space(const struct store *store, unsigned long long *ret_bytes, struct error *err);

/* Repairs that store_open has made. */
struct store_repairs {
	int found[2];  /* scans, jobs that the catalogue did not know, or knew less of than their directories */
	int set_aside; /* directories moved to quarantine/ */
	bool remade;   /* the catalogue was damaged: it was moved to quarantine/ and made again */
};
void store_repairs(const struct store *store, struct store_repairs *ret);
/*
 * Moves the catalogue of a state directory that no daemon uses to quarantine/ and makes it again, with what is whole in
 * quarantine/ put back to its place.
 */
int store_rebuild(const char *directory, const struct store_options *hooks, struct store_repairs *ret,
		  struct error *err);

/* ERR_INVALID: no database is called so, or this cbctd was built without what it needs. */
int store_check_catalogue(const char *address, struct error *err);
/* The server of the catalogue cannot be reached: calls return ERR_AWAY until it can. Any thread. */
bool store_away(const struct store *store);

struct store_statistics {
	long scans;
	unsigned long long projections_stored; /* since the start */
	unsigned long long commits;
	double commit_seconds;       /* sum */
	const char *engine;          /* of the catalogue, constant: "sqlite" */
	unsigned long engine_losses; /* connections with it that were lost */
};
void store_statistics(struct store *store, struct store_statistics *ret);

/* ---- limits: store/limits.c ---- */

/* A client is who makes scans and jobs, by the name that the API gives it. */
enum { STORE_CLIENT_SIZE = 80 };
/* 0: no limit. */
struct store_limits {
	long jobs, client_jobs; /* that have not ended */
	double job_patience;    /* s without a projection after which a job that waits gives its place to another one */
	long client_scans;
	unsigned long long bytes, client_bytes; /* of projections, images and kept volumes */
	double keep;                            /* s after which what has ended, or broke off, is removed */
};
/* A share of the bytes that volumes may not take: what is being acquired cannot be had again. */
#define STORE_ACQUISITION_SHARE 0.1
/* The bytes beyond which no volume is made any more; 0: no limit. */
unsigned long long store_volumes_most(const struct store_limits *limits);
/* Before the jobs are opened, and before any other thread has the store. */
void store_set_limits(struct store *store, const struct store_limits *limits);
const struct store_limits *store_limits(const struct store *store);
/* What the owner of jobs, and that of calibrations, have of a client, or (NULL) of all. */
struct store_counter {
	unsigned long long (*bytes)(void *context, const char *client); /* of volumes, of calibrations */
	long (*unended)(void *context, const char *client);
	void *context;
};
enum { STORE_COUNTERS = 2 };
/* At the start, before any other thread has the store. */
void store_count(struct store *store, const struct store_counter *counter);
/* Jobs and calibrations that have not ended. client NULL: all. */
long store_unended(struct store *store, const char *client);
/* ERR_LIMIT, ERR_BUSY: the client, or all together, have as many of these as they may have. */
int store_check_unended(struct store *store, const char *client, struct error *err);
/* ERR_QUOTA when a limit has no room for that many bytes more of the client. */
int store_check_bytes(struct store *store, const char *client, unsigned long long more, struct error *err);
/* Bytes of scans that have room on the disk, of images, volumes and calibrations. client NULL: all. */
unsigned long long store_bytes(struct store *store, const char *client);
long store_scans_of(struct store *store, const char *client);
/*
 * ERR_QUOTA when a client cannot have that many bytes of volumes more; ERR_IMPOSSIBLE, pointer "/grid": nor could it if
 * there were nothing else.
 */
int store_check_volumes(struct store *store, const char *client, unsigned long long more, struct error *err);

/* ---- scans ---- */

/* An Idempotency-Key and the SHA-256 of the body of the request that it came with; borrowed. */
struct store_key {
	const char *text;
	uint8_t digest[32];
};

/*
 * Takes the parsed scan over (on success only), makes its directory with
 * scan.json and projections.raw at full size, which has room on the disk once the first projection comes.
 * ERR_NO_SPACE when the disk cannot hold all of it; ERR_LIMIT when the client has too many scans. key may be NULL;
 * ERR_CONFLICT when another request has used it meanwhile: store_scan_repeat finds the scan that it made. The reference
 * is the caller's.
 */
int store_scan_create(struct store *store, struct scan *scan, const char *client, const struct store_key *key,
		      struct stored_scan **ret_scan, struct error *err);
/*
 * The scan that this key made before: *ret_scan stays NULL where there is none (and 0 is returned). ERR_CONFLICT: the
 * key came with another request.
 */
int store_scan_repeat(struct store *store, const struct store_key *key, struct stored_scan **ret_scan,
		      struct error *err);
/* ERR_NOT_FOUND. Reads scan.json when the scan has not been used for a while; otherwise memory only. */
int store_scan_find(struct store *store, const char *id, struct stored_scan **ret_scan, struct error *err);
/* Finds a scan whatever state its files are in: for its removal. It may have no parsed form. */
int store_scan_refer(struct store *store, const char *id, struct stored_scan **ret_scan, struct error *err);
void stored_scan_release(struct stored_scan *scan); /* NULL is fine */

/*
 * Newest first: at most `limit` scans that are older than `after` (an id, or
 * NULL; it need not exist any more). The references in ret_scans[limit] are the
 * caller's. *ret_more: there are older ones. Good for brief documents and ids.
 */
int store_scan_list(struct store *store, const char *after, int limit, struct stored_scan **ret_scans, int *ret_count,
		    bool *ret_more, struct error *err);

/* Removes the rows; then the files may go. See jobs_delete_scan, which asks first whether a job needs it. */
int store_scan_delete(struct store *store, struct stored_scan *scan, struct error *err);
void store_scan_remove_files(const struct store *store, const char *id);

/* Constant while the reference lives; references from store_scan_list may have none (NULL). */
const struct scan *stored_scan_parsed(struct stored_scan *scan);
/* The scan that is reconstructed: the same, or once closed with projections missing, the views that are there. */
const struct scan *stored_scan_measured(struct stored_scan *scan);
const char *stored_scan_id(const struct stored_scan *scan);
/* STATE/scans/ID */
/*
 * When the scan goes for its age (store_limits.keep), seconds since 1970: it is not complete, and nothing came since.
 * INFINITY: it stays, also as a scan that was ended or that the disk has damaged a part of, since what such a scan
 * still has may be all that there is of a patient.
 */
double stored_scan_kept_until(struct stored_scan *scan);
void store_scan_directory(const struct store *store, const char *id, char ret_path[1024]);

/*
 * Memory only. Complete: every projection is there, or it was closed with those that are, and none of them was lost.
 * Convertible: so is whatever else makes line integrals of them, but images of scatter, which come one by one as they
 * do. Ready: all of that, and nothing of it is being checked.
 */
struct scan_scatter {
	struct scatter_images images;
	int count, received; /* images */
	int wanted;          /* that are not there and that its projections need */
	int lost;            /* found damaged, and to be sent again */
};
struct scan_facts {
	char name[SCAN_NAME_BYTES], client[STORE_CLIENT_SIZE];
	double created; /* seconds since 1970 */
	int columns, rows, count;
	enum sample sample;
	enum quantity quantity;
	double air;                   /* counts, 0: not given */
	int received;                 /* projections */
	bool image[IMAGE_COUNT];      /* that are there */
	bool lost_image[IMAGE_COUNT]; /* found damaged, and to be sent again */
	struct scan_scatter scatter;  /* count 0: none is announced */
	int lost;                     /* projections that were found damaged: missing until they are sent again */
	unsigned losses;              /* grows with each of them */
	bool document_damaged;        /* scan.json: the scan cannot be used any more */
	bool checked;                 /* its files are not being held against their checksums just now */
	bool closed;                  /* by store_scan_close, with projections missing */
	bool complete, convertible, ready;
	double asked; /* when somebody came with one, new or not, seconds of CLOCK_MONOTONIC; 0: not since the start */
	double arrived; /* when the last projection came, seconds of CLOCK_MONOTONIC; 0: none since the start */
	bool pinned;    /* it stays whatever its age */
	unsigned basis; /* another number: an image came or it was closed, what was made of its projections is void */
	bool deleted;
	bool damaged; /* its files were not there at the start */
};
void stored_scan_facts(struct stored_scan *scan, struct scan_facts *ret);
/* The same by id, without a reference. ERR_NOT_FOUND. */
int store_scan_look(struct store *store, const char *id, struct scan_facts *ret, struct error *err);
/* flags[count]: 1 where the projection is stored. */
void stored_scan_received(struct stored_scan *scan, unsigned char *ret_flags);
/*
 * How many of the scan's projections are there, with their scatter, before the first that is missing. Those that a
 * closed scan was closed without are none of its projections.
 */
int stored_scan_leading(struct stored_scan *scan);
/* False when it is not stored. ret_sum->bytes 0: only its SHA-256 is known yet. */
bool stored_scan_sum(struct stored_scan *scan, int index, struct sum *ret_sum);
/* Digest over the digests of the projections that are stored, as digest_projections of proto/digest.h has it. */
int stored_scan_digest(struct stored_scan *scan, char ret_text[DIGEST_TEXT_MAX], struct error *err);

/* The projections that were found damaged: flags[count]. */
void stored_scan_lost(struct stored_scan *scan, unsigned char *ret_flags);

/*
 * ---- damage ----
 *
 * Every read of a scan directory is held against projections.sums. A projection that does not fit is lost: missing as
 * if it had never come, though it may be sent again also to a scan that was closed with it. An image that does not fit
 * keeps its scan from being used until it is sent again. A document that does not fit cannot be had again: who finds
 * the scan gets ERR_DAMAGED.
 */
/*
 * Reads the samples of a stored projection from this descriptor of projections.raw into ret_samples[bytes].
 * ERR_DAMAGED: they do not fit, and it is lost now. ERR_NOT_FOUND: it is not stored.
 */
int stored_scan_read(struct stored_scan *scan, int descriptor, int index, void *ret_samples, struct sum *ret_sum,
		     struct error *err);
/* The same without the samples, for who sends them from the file; not again while nothing was written to that. */
int stored_scan_verify(struct stored_scan *scan, int descriptor, int index, struct sum *ret_sum, struct error *err);
/* Whether a projection is lost; its sum, as it was stored. */
bool stored_scan_lost_sum(struct stored_scan *scan, int index, struct sum *ret_sum);
/* The projection was found not to fit `seen`: it is lost, unless it was sent again since. */
void stored_scan_lose(struct stored_scan *scan, int index, const struct sum *seen);
/*
 * Somebody else, a worker, found something of the scan damaged: all of its files are checked by a thread of the store;
 * until then it is not ready.
 */
void store_scan_suspect(struct store *store, const char *id);

/* Woken when a projection is stored or lost, a check is over, a claim given back, an image set, the scan deleted. */
void stored_scan_watch(struct stored_scan *scan, struct watch *watch);
void stored_scan_unwatch(struct stored_scan *scan, struct watch *watch);
/* Woken when a projection or an image of any scan is stored, and when one is closed. */
void store_watch_arrivals(struct store *store, struct watch *watch);
void store_unwatch_arrivals(struct store *store, struct watch *watch);

/*
 * Nothing more will come: the scan is those projections that are there. Others
 * are refused from now on (ERR_CONFLICT), also those on their way. A scan that
 * is complete stays as it is. ERR_CONFLICT when fewer are there than VIEWS_LEAST
 * of them, or than the scan has in all.
 */
enum { VIEWS_LEAST = 2 }; /* an arc has two ends */
int store_scan_close(struct store *store, struct stored_scan *scan, struct error *err);

/* Somebody else refers to it just now: an upload that may take its time, a job that begins. */
bool stored_scan_in_use(struct stored_scan *scan);
/* A pinned scan stays whatever its age. ERR_NOT_FOUND: it was deleted. */
int store_scan_pin(struct store *store, struct stored_scan *scan, bool pinned, struct error *err);

/* ---- projections on their way in ---- */
/*
 * A caller that wants to write projection k into projections.raw claims it first:
 *
 *   CLAIM_GRANTED  it is yours: pwrite at k * scan_projection_bytes(), then its record
 *                  (stored_scan_put_sum), fdatasync of both, then store_put_projections;
 *                  or stored_scan_unclaim, and what was written counts for nothing
 *   CLAIM_STORED   it is there already: hash the body and compare with stored_scan_sum
 *                  (200 or 409), write nothing
 *   CLAIM_BUSY     another request is writing it: watch the scan and ask again
 *
 * Never write without a claim: a stored projection is never touched again.
 */
enum claim { CLAIM_GRANTED, CLAIM_STORED, CLAIM_BUSY };
/* ERR_NOT_FOUND when the scan was deleted meanwhile, ERR_CONFLICT when it is closed without this one. Memory only. */
int stored_scan_claim(struct stored_scan *scan, int index, enum claim *ret_claim, struct error *err);
void stored_scan_unclaim(struct stored_scan *scan, int index);

/*
 * Room on the disk for all of the scan's projections, taken once, before the first of them is written to this
 * descriptor of projections.raw: no projection fails half-way on a full disk. ERR_NO_SPACE when the disk has no room,
 * ERR_QUOTA when a limit has none.
 */
int stored_scan_take_room(struct stored_scan *scan, int descriptor, struct error *err);
/*
 * Gives the room back where no projection came to be stored and none is being written. True: it did; whoever met
 * CLAIM_BUSY meanwhile asks again.
 */
bool stored_scan_return_room(struct stored_scan *scan, int descriptor);

/*
 * A descriptor of projections.raw, the caller's to close; close-on-exec. A file that went while the daemon ran is made
 * anew, and the scan checked: its projections are lost.
 */
int stored_scan_open(struct stored_scan *scan, bool writing, int *ret_descriptor, struct error *err);
/* The same of projections.sums, for writing; made anew from memory, where it went or is not whole: nothing is lost. */
int stored_scan_open_sums(struct stored_scan *scan, int *ret_descriptor, struct error *err);

/*
 * Group commit: many claimed projections, of one scan or several, in one
 * transaction, after the caller's fdatasync of their bytes. On success every
 * claim is given back, and `stored` says for each whether it is there now
 * (false: the scan was deleted or closed meanwhile). On failure none is stored
 * and the claims are still the caller's.
 */
struct received_projection {
	struct stored_scan *scan;
	int index;
	struct sum sum; /* of the raw samples; its order is set by stored_scan_put_sum */
	bool stored;    /* out */
};
/*
 * Writes the projection's record into this file of projections.sums, not synced. turn: of projections that are stored
 * one after the other the first has the lower one; counted since the start.
 */
int stored_scan_put_sum(struct received_projection *projection, int sums, uint64_t turn, struct error *err);
int store_put_projections(struct store *store, struct received_projection *batch, int count, struct error *err);

/*
 * An image of core/scan/image.h, [row][column]. *ret_new false: the same pixels were there. ERR_CONFLICT: other pixels
 * are there. ERR_BUSY: another request is writing it just now.
 */
int store_put_image(struct store *store, struct stored_scan *scan, enum image image, const void *pixels, bool *ret_new,
		    struct error *err);
/* Removes an image, so that another one can be put. ERR_NOT_FOUND where there is none; ERR_BUSY as above. */
int store_remove_image(struct store *store, struct stored_scan *scan, enum image image, struct error *err);

/*
 * An image of scatter (core/detector.h), by its own number. As of an image of the detector, but that another one is not
 * taken in place of one that is there, and that one of a projection that the scan was completed without is refused
 * (ERR_CONFLICT).
 */
int store_put_scatter(struct stored_scan *scan, int image, const float *pixels, bool *ret_new, struct error *err);
/* Removes it, or all that are there (-1), as if it had never come: as store_remove_image has it. */
int store_remove_scatter(struct stored_scan *scan, int image, struct error *err);
/* ERR_NOT_FOUND: it is not stored. ERR_DAMAGED: it is lost now. */
int store_read_scatter(struct stored_scan *scan, int image, float *ret_pixels, struct sum *ret_sum, struct error *err);
/* flags[count]: 1 where the image is stored. */
void stored_scan_received_scatter(struct stored_scan *scan, unsigned char *ret_flags);

/* ---- rows of jobs: for job.c, which keeps the rules; everybody else uses job.h ---- */

enum job_state { JOB_WAITING, JOB_QUEUED, JOB_RUNNING, JOB_SUCCEEDED, JOB_FAILED, JOB_CANCELLED, JOB_STATE_COUNT };
extern const char *const job_state_names[JOB_STATE_COUNT];

enum { JOB_REPORT_SIZE = 1024 };
struct job_record {
	char id[ID_SIZE], scan[ID_SIZE];
	enum job_state state;
	enum priority priority;
	long long ticket;               /* place among its priority, 0 before it was ever queued */
	char *request;                  /* job_request_json as text, owned; constant after creation */
	double mu_water;                /* 1/mm */
	int iterations;                 /* that SART will run, 0 without */
	char *key;                      /* Idempotency-Key or NULL, owned; constant after creation */
	char client[STORE_CLIENT_SIZE]; /* who posted it; constant after creation */
	char *subject; /* subject_json and "source" of its scan as text, or NULL, owned; constant after creation */
	uint8_t digest[32];
	bool cancel_asked;
	bool pinned;    /* it stays whatever its age */
	bool annotated; /* annotations.json was written once, and belongs there since */
	int attempts; /* 1 with the first run, one more each time that a run was lost; going on after a yield is none */
	int crashes;  /* workers that died with it */
	int checkpoint; /* iteration that checkpoint.f32 holds, 0: none */
	unsigned basis; /* of its scan, when it ran last */
	char backend[16], device[96], plan[320];
	char ran_on[64]; /* numbers of the workers whose devices it has, or had last, "0,2"; "": none yet, or elsewhere
			  */
	struct recon_memory memory;
	double noise_hu, tv_alpha;        /* recon_hooks.denoising; NaN before it was called */
	struct recon_agreement agreement; /* recon_hooks.agreement; all 0 before it was called */
	/* How automatic iterations ended; STOP_NOT: they have not. */
	struct recon_stop stop;
	int error_code; /* 0: none */
	char error_pointer[192], error_text[320];
	char error_report[JOB_REPORT_SIZE];     /* JSON of how its last run was lost, "" without */
	double created, queued, started, ended; /* seconds since 1970, 0: not yet */
	double seconds[STAGE_COUNT];            /* spent in each stage, all attempts together */
	enum stage stage;
	int iteration;
	double fraction;
	long long stamp; /* of its record in its directory; store/record.h */
	/* Memory only. */
	bool attended;     /* it waits, and a worker reconstructs what arrives */
	int reconstructed; /* projections */
};

struct volume_record {
	char name[32], stage[16];
	int iteration;
	struct grid grid;
	size_t bytes;       /* of the voxels */
	bool hashed;        /* this is known, and its file is on the disk: */
	uint8_t sha256[32]; /* of the voxels */
	struct volume_norms norms;
	double estimate_mm;            /* kept_volume's */
	struct volume_support support; /* kept_volume's */
	struct volume_quality quality; /* known with the digest */
	double created;                /* seconds since 1970; another one when it is made again */
};

struct warning_record {
	char code[64], detail[WARNING_TEXT_SIZE];
};

/*
 * A volume that goes, went, or is to go to a destination. WAITING: the job has not ended, nobody knows yet which
 * volumes there will be. QUEUED: its turn, or the next try, is to come. SENT: the destination has been read back, and
 * has all of it; while it has not ended, an answer to a request for storage commitment is to come. COMMITTED: it has
 * also promised to keep it. STOPPED: a client has ended it.
 */
enum sending_state {
	SENDING_WAITING,
	SENDING_QUEUED,
	SENDING_SENDING,
	SENDING_SENT,
	SENDING_COMMITTED,
	SENDING_FAILED,
	SENDING_STOPPED,
	SENDING_STATE_COUNT
};
extern const char *const sending_state_names[SENDING_STATE_COUNT];

enum { SENDING_NAME_SIZE = DESTINATION_NAME_SIZE + 33 };
struct sending_record {
	char name[SENDING_NAME_SIZE]; /* among the job's: "pacs/final", "pacs" while it is waiting */
	char destination[DESTINATION_NAME_SIZE];
	char volume[32];                 /* "": not known yet */
	char volumes[SEND_VOLUMES_SIZE]; /* send_wish's */
	enum sending_state state;
	int attempts;
	int instances, stored; /* objects of the volume; those that the destination has, as last seen */
	char error[320];       /* of the last attempt, "" after one that succeeded */
	double created;        /* seconds since 1970, as the next two: asked for, the last time */
	double next;           /* the next attempt; 0: none is to come, or at once */
	double ended;          /* 0: it has not */
	char transaction[65];  /* UID of the last request for storage commitment; SENDING_REFUSED: its answer was no */
};
#define SENDING_REFUSED "refused"

/* An entry of a job's events: numbers grow, are never used twice, and are what Last-Event-ID holds. */
struct event_record {
	long long number;
	char job[ID_SIZE];
	char kind[16]; /* "state", "progress", "volume", "warning", "end" */
	char *data;    /* JSON text, owned */
};

/* Every one of these writes the event (NULL: none) in the same transaction. */
struct event {
	const char *kind;
	char *data;       /* JSON text */
	const char *once; /* NULL, or: of all events of the job with this name, the first is the only one */
};
int store_job_insert(struct store *store, const struct job_record *job, const struct sending_record *sendings,
		     int count, const struct event *event, struct error *err);
/*
 * The rows that a job's runs have left stay (PAST_STAYS); with PAST_REWINDS the history behind the checkpoint goes,
 * with PAST_GOES all history, volumes, warnings and events, but for its states.
 */
enum job_past { PAST_STAYS, PAST_REWINDS, PAST_GOES };
/* Writes all columns that can change. `end`, when not NULL, is a second event. */
int store_job_update(struct store *store, const struct job_record *job, const struct event *event,
		     const struct event *end, enum job_past past, struct error *err);
/* Removes the rows; then the files may go. Of the events only that it was removed stays, for those who watch all jobs.
 */
int store_job_delete(struct store *store, const char *id, struct error *err);
void store_job_remove_files(const struct store *store, const char *id);
void store_job_remove_checkpoint(const struct store *store, const char *id);
/* The checkpoint, and what a refinement has reached: nobody goes on from an end. */
void store_job_remove_reached(const struct store *store, const char *id);
/* The files of all its volumes, whose rows have gone. */
void store_job_remove_volumes(const struct store *store, const char *id);
/* The checkpoint, and what a worker that died left half-written or prepared: an ended job has no use for it. */
void store_job_tidy(const struct store *store, const char *id);
/* Adds all of the rows or none, each with its event. */
int store_job_add_rows(struct store *store, const char *id, const struct history_row *rows, const struct event *events,
		       int count, struct error *err);
/*
 * A volume whose file everybody can read, but which a power cut may still take: a
 * row without a digest. The job must not end, nor be queued again, before it is on
 * the disk: at the start, of a job that runs or waits, it is removed, and made again.
 */
int store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
			 const struct event *event, struct error *err);
/* Records a volume's digest, unless it was made again since, or is gone. Its file is on the disk. */
int store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume, struct error *err);
/*
 * The header of a kept volume's file and `bytes` bytes of its voxels from `first` on (as many as there are) are held
 * against its checksums, unless that was done lately. ERR_DAMAGED: they do not fit. ERR_NOT_FOUND: the file is gone.
 */
int store_volume_verify(struct store *store, const char *job, const struct volume_record *volume, uint64_t first,
			uint64_t bytes, struct error *err);
/* ERR_DAMAGED, and the words for a volume of this name whose file is not what was written, or is gone. */
int store_volume_damaged(const char *volume, const char *why, struct error *err);
int store_volume_gone(const struct volume_record *volume, struct error *err);
/*
 * A worker has just made the file, which had that time of change then: what is read of it is still in memory. A file
 * that has another one by now is not trusted.
 */
void store_volume_trust(struct store *store, const char *job, const struct volume_record *volume,
			const struct timespec *written);
/* The jobs that have volumes without a digest. */
int store_jobs_undigested(struct store *store, void (*visit)(void *context, const char *id), void *context,
			  struct error *err);
/* The row; then the file may go. */
int store_job_remove_volume(struct store *store, const char *id, const char *name, struct error *err);
/*
 * *ret_new false, and no event, when this very warning is there already. A damaged volume has one warning: the latest
 * of store_volume_damaged's words for it.
 */
int store_job_add_warning(struct store *store, const char *id, const struct warning_record *warning,
			  const struct event *event, bool *ret_new, struct error *err);
/* All of the volume was found whole: a warning that it is damaged goes. *ret_gone: there was one. */
int store_job_volume_whole(struct store *store, const char *id, const char *volume, bool *ret_gone, struct error *err);

/*
 * Writes sendings, new ones or those with their names anew, each with its event; the one named `taken` (NULL: none)
 * goes. All or nothing.
 */
int store_job_put_sendings(struct store *store, const char *id, const struct sending_record *sendings,
			   const struct event *events, int count, const char *taken, struct error *err);
/* In the order of their names; free the array. */
int store_job_sendings(struct store *store, const char *id, struct sending_record **ret_sendings, int *ret_count,
		       struct error *err);
/* The jobs with sendings that have not ended. */
int store_jobs_unsent(struct store *store, void (*visit)(void *context, const char *id), void *context,
		      struct error *err);

/*
 * A document that clients keep with the job, in its directory. ERR_NOT_FOUND: none was written yet. ERR_DAMAGED: it
 * does not fit its checksum. Free *ret_text.
 */
enum { STORE_ANNOTATIONS_MAX = 8 << 20 }; /* bytes */
int store_annotations_read(const struct store *store, const char *id, char **ret_text, size_t *ret_length,
			   struct error *err);
/* Replaces it, synced, then adds the event, and `annotated` in the job's row. One call at a time for a job. */
int store_annotations_write(struct store *store, const char *id, const char *text, size_t length,
			    const struct event *event, struct error *err);

/* Reads all jobs, oldest first; free the array with job_records_free. */
int store_job_load(struct store *store, struct job_record **ret_jobs, int *ret_count, struct error *err);
void job_record_clear(struct job_record *job);
void job_records_free(struct job_record *jobs, int count);

/* Reading, in order of making; arrays are the caller's (free). An unknown job has none of them. */
int store_job_rows(struct store *store, const char *id, struct history_row **ret_rows, int *ret_count,
		   struct error *err);
int store_job_volumes(struct store *store, const char *id, struct volume_record **ret_volumes, int *ret_count,
		      struct error *err);
int store_job_warnings(struct store *store, const char *id, struct warning_record **ret_warnings, int *ret_count,
		       struct error *err);
/* At most `limit` events with number > after; id NULL: of all jobs. Free with event_records_free. */
int store_job_events(struct store *store, const char *id, long long after, int limit, struct event_record **ret_events,
		     int *ret_count, struct error *err);
void event_records_free(struct event_record *events, int count);
/* The number of the latest event of all jobs, 0 when there has never been one. Memory only. */
long long store_last_event(const struct store *store);

/* STATE/jobs/ID; STATE/jobs/ID/NAME.nii */
void store_job_directory(const struct store *store, const char *id, char ret_path[1024]);
void store_volume_path(const struct store *store, const char *id, const char *name, char ret_path[1024]);

#endif

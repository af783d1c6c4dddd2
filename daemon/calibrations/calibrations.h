#ifndef CBCT_DAEMON_CALIBRATIONS_CALIBRATIONS_H
#define CBCT_DAEMON_CALIBRATIONS_CALIBRATIONS_H

#include <cjson/cJSON.h>

#include "daemon/store/store.h"
#include "daemon/watch.h"
#include "proto/scan.h"

/*
 * The library of calibrations: where an arm stood in each view of a sweep, made from scans of balls.
 *
 *   STATE/calibrations/ID/  request.json, and result.json once it was made or has failed (proto/calibration_files.h)
 *
 * The directories are all that there is: the catalogue knows nothing of calibrations, and at the start they are read,
 * each file held against its checksums. One that is damaged is set aside in quarantine/. A calibration without a result
 * is made, again after a restart, by `cbct-worker --calibrate`, one at a time. A scan that uses a calibration has a
 * copy of its matrices, so that deleting it harms nothing. One that a job has refined out of a scan of whatever it may
 * be (proto/refinement.h) is kept beside them: it has no phantom, and its result from the beginning.
 *
 * Threads: any, but calibrations_open and calibrations_close once each.
 */
struct calibrations;

struct calibrations_options {
	const char *worker; /* path of cbct-worker; NULL: beside this program, else from PATH */
	int threads;        /* of it; 0: all */
	long age;           /* days after which a scan that uses one is warned; 0: never */
};

int calibrations_open(struct store *store, const struct calibrations_options *options,
		      struct calibrations **ret_calibrations, struct error *err);
/* One that is being made is begun anew at the next start. NULL is fine. */
void calibrations_close(struct calibrations *calibrations);

/*
 * Reads the body of POST /v1/calibrations, of so many bytes, and takes it up; on the disk when this returns.
 * ERR_NOT_FOUND: no such scan; ERR_CONFLICT: the scan lacks projections or air; ERR_INVALID, ERR_IMPOSSIBLE: the
 * phantom; ERR_LIMIT, ERR_BUSY, ERR_QUOTA: a limit of jobs, among which it counts, or of bytes.
 */
int calibrations_post(struct calibrations *calibrations, const char *client, const cJSON *body, size_t length,
		      char ret_id[ID_SIZE], struct error *err);
/* What a job has refined, to be kept as a calibration. */
struct calibration_kept {
	const char *job, *scan, *arm; /* ids; arm "" for none */
	const cJSON *refinement;      /* proto/refinement.h */
};
/*
 * Takes it up as one that has succeeded, on the disk when this returns. ERR_CONFLICT: the scan has gone, or views of it
 * were missing when the job ran; ERR_LIMIT, ERR_QUOTA: a limit of bytes.
 */
int calibrations_keep(struct calibrations *calibrations, const char *client, const struct calibration_kept *kept,
		      char ret_id[ID_SIZE], struct error *err);
/* Removes those that have failed before that time; others stay, since scans of months to come use them. */
void calibrations_expire(struct calibrations *calibrations, double before);
/* ERR_CONFLICT while a calibration of this scan waits or is being made; otherwise 0. */
int calibrations_check_scan(struct calibrations *calibrations, const char *scan, struct error *err);
/* ERR_NOT_FOUND. One that is being made is stopped. */
int calibrations_delete(struct calibrations *calibrations, const char *id, struct error *err);

/*
 * As the API shows it, the caller's to delete. brief: without phantom, balls, views and geometry, from memory alone.
 * *ret_ended: it was made or has failed; may be NULL. ERR_NOT_FOUND, ERR_DAMAGED.
 */
int calibration_document(struct calibrations *calibrations, const char *id, bool brief, cJSON **ret_document,
			 bool *ret_ended, struct error *err);
/* Adds brief documents to a list, newest first, of at most `limit` that are older than `after` (an id or NULL). */
int calibrations_list(struct calibrations *calibrations, const char *after, int limit, cJSON *list,
		      char ret_last[ID_SIZE], bool *ret_more, struct error *err);

/* Woken at each change of any. */
void calibrations_watch(struct calibrations *calibrations, struct watch *watch);
void calibrations_unwatch(struct calibrations *calibrations, struct watch *watch);

/* The find of struct scan_calibrations; its context is a struct calibrations. */
int calibrations_find_views(void *context, const char *id, const struct scan *scan, const double *angles,
			    struct geometry *ret_geometry, cJSON *ret_notes, struct error *err);

/*
 * A view of the phantom's scan with circles where the calibration has the balls, as PNG (free). ERR_NOT_FOUND: no such
 * calibration or view, its scan is gone, or it has no phantom; ERR_CONFLICT: it has no result.
 */
int calibration_picture(struct calibrations *calibrations, const char *id, long view, char **ret_png,
			size_t *ret_length, struct error *err);

#endif

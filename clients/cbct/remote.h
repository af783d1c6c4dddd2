#ifndef CBCT_CLIENTS_REMOTE_H
#define CBCT_CLIENTS_REMOTE_H

#include "clients/cbct/http.h"
#include "proto/digest.h"
#include "proto/durable.h"
#include "proto/message.h"
#include "proto/saver.h"

/* What a volume must have been made from: digests of this side's own files (proto/digest.h). */
struct remote_source {
	char scan[DIGEST_TEXT_MAX], projections[DIGEST_TEXT_MAX], recipe[DIGEST_TEXT_MAX];
	char image[IMAGE_COUNT][DIGEST_TEXT_MAX]; /* "" where there is none */
	char scatter[DIGEST_TEXT_MAX];            /* over its images of scatter; "" where there are none */
	char scan_name[SCAN_NAME_BYTES];
};

/*
 * Fetches a volume of the job `job` on the other daemon, by its document in the list of volumes, into the job directory
 * of `start`, as the worker there would have written it but for the names of job and scan and where the patient lies.
 * Its bytes must have its digest, and it must have been made from `source`; else ERR_CONFLICT, and no file is left. On
 * return the file has its name and is on its way to the disk: saver_finish. *ret_here: what failed was this side's
 * disk.
 */
int remote_fetch_volume(struct http *http, const char *job, const cJSON *document, const struct message *start,
			const struct remote_source *source, struct saver *saver, struct message *ret_volume,
			bool *ret_here, struct error *err);

/* Checkpoints that come from the other daemon, and go to it. */
struct remote_checkpoint {
	int iteration;       /* the last that this side has, 0: none */
	double due;          /* monotonic: when to ask for the next */
	int pending;         /* of `file`, which is here but not to be used yet; 0: none */
	struct durable file; /* beside its name, which is `path` */
	char path[1100];
};
/*
 * Fetches the checkpoint of the job `job` on the other daemon, where it is of a later iteration: pending then. It must
 * fit its seal. No failure is one of the job; the next one is asked for after start->checkpoint_seconds, or later where
 * it would take more than a tenth of the time.
 */
void remote_fetch_checkpoint(struct http *http, const char *job, const struct message *start,
			     struct remote_checkpoint *checkpoint);
/* The pending checkpoint gets its name; all that the job has made before it is on this side's disk. */
int remote_keep_checkpoint(struct remote_checkpoint *checkpoint, struct error *err);
void remote_drop_checkpoint(struct remote_checkpoint *checkpoint); /* none pending is fine */

#endif

#ifndef CBCT_CLIENTS_REMOTE_H
#define CBCT_CLIENTS_REMOTE_H

#include "clients/cbct/http.h"
#include "proto/digest.h"
#include "proto/message.h"
#include "proto/saver.h"

/* What a volume must have been made from: digests of this side's own files (proto/digest.h). */
struct remote_source {
	char scan[DIGEST_TEXT_MAX], projections[DIGEST_TEXT_MAX], recipe[DIGEST_TEXT_MAX];
	char image[IMAGE_COUNT][DIGEST_TEXT_MAX]; /* "" where there is none */
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

#endif

#ifndef CBCT_DAEMON_INTAKE_INTAKE_H
#define CBCT_DAEMON_INTAKE_INTAKE_H

#include <stdbool.h>
#include <stddef.h>

#include "daemon/http/http.h"
#include "daemon/store/store.h"
#include "proto/json.h"

/*
 * Projections and images from a request's body to the disk.
 *
 * The connection's thread fills buffers of one projection each, from a pool of
 * bounded size; writer threads check and hash each full one, decide under its
 * claim whether it is new, the same or another, write it, and commit all that
 * are ready with one sync of the file and one transaction. The connection waits
 * without a thread: for a buffer when the pool is empty, and at the end for the
 * outcome. So a 2xx means that the bytes and the row are on the disk, and a
 * fast client is slowed down to the disk's pace.
 *
 * Each whole projection counts by itself: what came before a break is kept.
 * Where the end of a body may show that all of it was wrong (a digest, a
 * compressed frame, a length not known before), projections are written under
 * their claims as they come, but recorded only at the end, or at a break; with
 * a Content-Digest it is all or nothing.
 */
struct uploads;
struct upload; /* one request's; belongs to its connection's thread */

struct uploads_options {
	size_t buffer; /* bytes of all buffers together; one projection always fits */
	/* A sync failed: the process should end. Called once, from any thread. */
	void (*failed)(void *context, const char *what);
	void *context;
};
int uploads_new(struct store *store, const struct uploads_options *options, struct uploads **ret_uploads,
		struct error *err);
/* Writes what is whole; all uploads must have been released. NULL is fine. */
void uploads_free(struct uploads *uploads);

struct uploads_statistics {
	size_t buffered;          /* bytes of buffers in use */
	int starved;              /* connections that wait for a buffer */
	unsigned long long syncs; /* since the start */
	double sync_seconds;      /* sum */
};
void uploads_statistics(struct uploads *uploads, struct uploads_statistics *ret);

/*
 * The target says what the body should be: projections first .. last, or the
 * image named, or an image of scatter, `first`. Reads the request's Content-Length, -Encoding and -Digest and
 * refuses what cannot be right: ERR_INVALID with both lengths; for an unknown
 * encoding the reply is set and *ret_upload is NULL. Takes the reference to the
 * scan, on failure too.
 */
enum upload_kind { UPLOAD_PROJECTIONS, UPLOAD_IMAGE, UPLOAD_SCATTER };
struct upload_target {
	enum upload_kind kind;
	int first, last;
	enum image image;
};
int upload_new(struct uploads *uploads, struct request *request, struct stored_scan *scan,
	       const struct upload_target *target, struct upload **ret_upload, struct error *err);

/* As route.data. */
int upload_data(struct upload *upload, const void *data, size_t size, size_t *ret_taken, struct error *err);

struct upload_outcome {
	int created, same; /* projections or images */
	cJSON *warnings;   /* of an image, what is doubtful about it: the caller's to delete; NULL for projections */
};
/* The body has ended: HTTP_WAIT until all of it has its outcome. */
int upload_end(struct upload *upload, struct upload_outcome *ret_outcome, struct error *err);

/* The request is over, well or not; what is whole still takes its way. */
void upload_release(struct upload *upload);

#endif

/*
 * What the parts of cbct remote share: remote.c has the connections, the checkpoint that a job begins with and the
 * start, remote_scan.c brings the scan, remote_follow.c tells here what becomes of the job there. Everything runs in
 * one thread. Functions return 0, or a code that the job here ends with (ERR_BUSY: it goes on elsewhere).
 */
#ifndef CBCT_CLIENTS_REMOTE_INTERNAL_H
#define CBCT_CLIENTS_REMOTE_INTERNAL_H

#include "clients/cbct/remote.h"
#include "clients/cbct/upload.h"

enum { REMOTE_VOLUMES_MOST = 4096 };

struct remote_options {
	long socket;
	double lease;
	const char *claim, *host;
	struct http_options http;
};

struct remote {
	const struct remote_options *options;
	struct http *http;
	const struct message *start;
	struct scan_files files;
	struct remote_source source;
	struct saver *saver;
	char scan[64], job[64]; /* there */
	double contact;         /* monotonic: when the other daemon answered last */
	double look;            /* monotonic: next look at the job */
	bool cancel, leave;
	int announced, sent;   /* projections */
	bool there[VIEWS_MAX]; /* projections that the other daemon had before this process */
	/* What the daemon here was told already. */
	int rows, warnings, volumes;
	int iteration; /* of the last row */
	struct remote_checkpoint checkpoint;
	double waits; /* monotonic: since when the job there waits though it has all that it needs; 0: it does not */
	bool opened, denoised, agreed, stopped;
	char fetched[REMOTE_VOLUMES_MOST][32];
};

/* To the daemon here; the message gets the job's id. */
int remote_tell(struct remote *remote, struct message *message, struct error *err);
/* Takes what the daemon here says; waits for it at most timeout_ms. */
int remote_obey(struct remote *remote, int timeout_ms, struct error *err);

/*
 * What follows from the code of a request: 0 for done, 1 for another try, else its code, which the job ends with. A
 * daemon that starts anew has a lease's time to come back; one whose disk is full gives the job back.
 */
int remote_judge(struct remote *remote, int code, struct error *err);
/* Requests to the daemon there, until they are judged; the caller frees *ret_document. */
int remote_ask(struct remote *remote, const char *method, const char *path, cJSON **ret_document, struct error *err);
int remote_post(struct remote *remote, const char *path, const cJSON *document, const char *key, char ret_id[64],
		struct error *err);
int remote_put(struct remote *remote, const char *path, const void *data, size_t length, struct error *err);

/* The digests of what is here, as volumes from there must name them. */
int remote_know_source(struct remote *remote, struct error *err);
/* The scan there, with its images, its id in scan; projections that are there already are known behind it. */
int remote_post_scan(struct remote *remote, struct error *err);
/* The next run of the projections that are here, but for what is there already. */
int remote_send_some(struct remote *remote, struct error *err);
/* Looks at the job there, and tells here what is new. *ret_done: it has succeeded, and all of it is here. */
int remote_follow(struct remote *remote, bool *ret_done, struct error *err);

#endif

#ifndef CBCT_CLIENTS_STREAM_H
#define CBCT_CLIENTS_STREAM_H

#include "clients/cbct/http.h"
#include "clients/cbct/volume_query.h"

/*
 * Each kept volume of a job as a file in a directory, the moment it is kept, to
 * the job's end; whole or not at all, its digest checked. Connections that break
 * are taken up behind the last whole volume.
 */
struct stream_options {
	const char *job, *directory; /* which is there */
	const struct volume_query *query;
	const struct http_options *http;
	/* A file is there; called in the thread that runs stream_save. */
	void (*saved)(void *context, const char *path);
	void *context;
};
int stream_save(const struct stream_options *options, struct error *err);

#endif

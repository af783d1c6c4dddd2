#ifndef CBCT_CLIENTS_UPLOAD_H
#define CBCT_CLIENTS_UPLOAD_H

#include "clients/cbct/http.h"

/* How a scan directory goes to the daemon. */
struct upload_settings {
	const char *scan;     /* go on with this one; NULL: a new one */
	const char *key;      /* the new one's Idempotency-Key; NULL: none */
	const char *worklist; /* the step of the worklist that patient and study come from; NULL: the scan's own */
	long connections, run;
	bool zstd, quiet;
	struct http_options http;
};
extern const struct option upload_rows[]; /* all others */
#define UPLOAD_DEFAULTS                                                                                                \
	{                                                                                                              \
		.connections = 4, .run = OPTION_UNSET_INTEGER                                                          \
	}

/* PUT of bytes with their Content-Digest: one try. */
int upload_put(struct http *http, const char *path, const void *data, size_t length, struct error *err);

/* Prints the scan's id on standard output as soon as it has one. */
int upload_directory(const char *directory, const struct upload_settings *settings, struct error *err);

#endif

#ifndef CBCT_CLIENTS_HTTP_H
#define CBCT_CLIENTS_HTTP_H

#include <stdbool.h>
#include <stddef.h>

#include <cjson/cJSON.h>

#include "clients/cbct/options.h"

/*
 * Requests to a daemon, over libcurl. One struct http is one connection that is
 * kept open from request to request; it belongs to one thread.
 */
struct http;

/* 401 and 403: the daemon does not know who asks, or another role is wanted. */
enum { ERR_DENIED = -65 };

/* The options of every subcommand that talks to a daemon. */
struct http_options {
	const char *url; /* "http://HOST:PORT" or "unix:PATH"; NULL: $CBCT_URL, else http://127.0.0.1:2228 */
	/* Paths; NULL: as the environment says, else none. */
	const char *token_file, *authorities, *certificate, *key;
};
extern const struct option http_option_rows[];

int http_new(const struct http_options *options, struct http **ret_http, struct error *err);
void http_free(struct http *http); /* NULL is fine */

enum { HTTP_HEADERS_MAX = 4, HTTP_NAME_MAX = 128 };

struct http_request {
	const char *method, *path; /* "PUT", "/v1/scans/ID/flat" */
	const void *body;          /* NULL: none */
	size_t length;
	const char *headers[HTTP_HEADERS_MAX]; /* "Content-Type: application/json", the rest NULL */
	bool decompress;                       /* offers Accept-Encoding: zstd and undoes it */
	/* Takes a successful reply's body piece by piece; false ends the transfer. NULL: it is collected in memory. */
	bool (*write)(void *context, const void *data, size_t length);
	void *context;
};

struct http_reply {
	int status; /* 0: none came */
	char *body; /* ends with a zero byte beyond its length; "" when `write` took it */
	size_t length;
	char name[HTTP_NAME_MAX]; /* file name of Content-Disposition, "" without */
	char digest[64];          /* Repr-Digest, "" without */
};

/*
 * Sends one request and waits; a daemon that names another host of its fleet is followed there. Fails with ERR_IO when
 * no reply came, and on every status of 300 and more, with what the problem document said in err. `ret_reply` is filled
 * in both cases (http_reply_clear).
 */
int http_send(struct http *http, const struct http_request *request, struct http_reply *ret_reply, struct error *err);
void http_reply_clear(struct http_reply *reply);

/*
 * Whether the request that failed with `code` is worth another try, the attempt-th
 * (from 0): no reply, a broken one, 429, 500, 503. Pauses before it says yes, as
 * long as Retry-After wants or longer from attempt to attempt, some 6 s in all.
 */
bool http_again(struct http *http, int code, int attempt);
/* The last request found nobody listening. */
bool http_unreachable(const struct http *http);

/* GET of a JSON document, or any other method without a body. *ret_document may be NULL after a 204. */
int http_json(struct http *http, const char *method, const char *path, cJSON **ret_document, struct error *err);
/* POST of a JSON document; idempotency_key may be NULL. */
int http_post(struct http *http, const char *path, const cJSON *document, const char *idempotency_key,
	      cJSON **ret_document, struct error *err);

/* attachment; filename="name" -> name, "" without one or when it would leave the directory. disposition may be NULL. */
void disposition_name(const char *disposition, char ret_name[HTTP_NAME_MAX]);

/* Members of documents that come from a daemon: absent or of another type gives the fallback. */
const char *member_text(const cJSON *object, const char *name, const char *fallback);
double member_number(const cJSON *object, const char *name, double fallback);
/* A document as one line on standard output. */
int document_print(const cJSON *document, struct error *err);

#endif

#ifndef CBCT_DAEMON_HTTP_HTTP_H
#define CBCT_DAEMON_HTTP_HTTP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

#include <cjson/cJSON.h>

#include "core/error.h"
#include "daemon/histogram.h"
#include "daemon/http/text.h"
#include "proto/clock.h"
#include "proto/tokens.h"

/*
 * HTTP without the library that speaks it (libmicrohttpd stays in http*.c):
 * a table of routes, requests with their bodies, replies, and waiting without
 * holding a thread.
 *
 * A request lives in the one thread of its connection: begin, data and handle
 * are called there, never two at a time for one request, and must not wait for
 * anything slow; they return HTTP_WAIT and are called again. Only request_wake
 * may be called from other threads. Times are those of clock_monotonic.
 */
struct http;
struct request;

/* A handler's answers beside 0 (a reply was set) and a negative code (which becomes a problem document). */
enum { HTTP_WAIT = 1 /* call again after request_wake, or when the time of request_wait_until has come */ };

enum body {
	BODY_NONE,  /* what comes is read and dropped */
	BODY_WHOLE, /* held in memory, at most body_max bytes: request_body */
	BODY_STREAM /* given to `data` piece by piece */
};

struct route {
	const char *method; /* GET is HEAD as well */
	const char *path; /* "/v1/scans/{}/projections/{}": {} is any one segment, {flat} this one: request_argument */
	enum role role;   /* the least that may; never ROLE_UNSAID */
	/* The whole request is there. */
	int (*handle)(void *context, struct request *request, struct error *err);
	enum body body;
	size_t body_max;
	/* BODY_STREAM: the header is there; refuse now, before the client sends. */
	int (*begin)(void *context, struct request *request, struct error *err);
	/* BODY_STREAM: takes what it can; less than size only with HTTP_WAIT. After a failure the rest is dropped. */
	int (*data)(void *context, struct request *request, const void *data, size_t size, size_t *ret_taken,
		    struct error *err);
	const char
	    *queries; /* the names of its query parameters, with blanks between; others are refused. NULL: none */
};

struct http_options {
	const char *listen;       /* as config.listen */
	const char *server_names; /* as config.server_names */
	const char *state_dir;    /* replies do not show paths in it */
	/* Paths; "" and "" for no TLS. The last may be "": clients are not asked for certificates. */
	const char *tls_certificate, *tls_key, *tls_client_authorities;
	const char *audit;          /* as config.audit; state_dir is there once http_start is called */
	size_t audit_bytes;         /* of a file, before it is renamed */
	int audit_files;            /* renamed ones that are kept */
	const char *unix_roles;     /* as config.unix_roles; "": a Unix socket's peers are nobody in particular */
	const char *tokens;         /* the file of tokens; "": nobody is asked who they are */
	const struct route *routes; /* ends with method == NULL */
	void *context;              /* the handlers' */
	/* Asked before a request ends with ERR_NOT_FOUND: true, and a reply is set; or the error may be changed. */
	bool (*missing)(void *context, struct request *request, struct error *err);
	int threads;
	long max_connections, max_connections_per_address;
	double header_timeout, transfer_grace; /* s */
	size_t minimum_rate;                   /* bytes/s */
};

/*
 * Binds, without accepting yet. ERR_IMPOSSIBLE for an address beyond loopback
 * unless there are both tokens and TLS to guard it. The options are copied, what they point to is not.
 */
int http_new(const struct http_options *options, struct http **ret_http, struct error *err);
/* Accepts from now on, and says where on standard output. */
int http_start(struct http *http, struct error *err);
/* Reads tokens and certificates again; what is bad is logged, and the one before stays. One thread at a time. */
void http_reload(struct http *http);
/* No new connections; wakes all that wait; gives requests under way two seconds to end. Then http_free. */
void http_stop(struct http *http);
void http_free(struct http *http); /* NULL is fine */

/* Requests of one route that ended with one status, since the start. */
struct http_traffic {
	const struct route *route;         /* NULL: they found none */
	int status;                        /* 0: broken off */
	unsigned long long requests;       /* never 0 */
	unsigned long long received, sent; /* bytes of bodies; files and texts that were broken off are not in sent */
};
void http_traffic(const struct http *http, void (*visit)(void *context, const struct http_traffic *traffic),
		  void *context);
/* From the head of a request to the end of its answer, those that waited or went on as long as they were asked to, too.
 * NULL: of requests that found no route. */
const struct histogram *http_seconds(const struct http *http, const struct route *route);
/* ERR_BUSY when a thread of the server does not answer a connection within that time. One thread at a time. */
int http_probe(struct http *http, double seconds, struct error *err);
/* There is an audit log, and it cannot be written: lines are lost. Takes no lock. */
bool http_audit_fails(const struct http *http);
/* The number of connections that are open now; takes no lock. */
long http_connections(const struct http *http);

/* ---- what was asked ---- */
const char *request_id(const struct request *request);
/* The i-th {} of the route's path, decoded; never NULL. */
const char *request_argument(const struct request *request, int i);
/* Path and query as they were sent. */
const char *request_target(const struct request *request);
/* The value of ?name=value, decoded; NULL when the target has no such parameter. */
const char *request_query(const struct request *request, const char *name);
/* The first header of that name, or NULL. */
const char *request_header(struct request *request, const char *name);
/*
 * What its Accept-Encoding wants, on however many lines (RFC 9110, 12.5.3). prefers: a coding (zstd, gzip) rather than
 * the plain bytes: it names it with a weight that is above 0 and not below that of the plain bytes; or "*" alone takes
 * it in, with more weight than those have. takes_plain: only "identity;q=0", or "*;q=0" without identity, refuses them.
 */
bool request_prefers_coding(struct request *request, const char *coding);
bool request_takes_plain(struct request *request);
bool request_is_head(const struct request *request);
/* -1: not known (chunked). */
int64_t request_content_length(const struct request *request);
/* BODY_WHOLE; ends with a zero byte beyond its length. */
const char *request_body(const struct request *request, size_t *ret_length);

/* The handler's own, freed with the request; one at most. */
/* The audit log names this as what the request is of: a scan, job or calibration that it has made. */
void request_made(struct request *request, const char *id);
void request_set_state(struct request *request, void *state, void (*state_free)(void *state));
void *request_state(const struct request *request);

/* ---- who asks ---- */
/* The proof of a client's identity. */
enum proof {
	PROOF_NONE,
	PROOF_NOT_ASKED /* there are no tokens */,
	PROOF_TOKEN,
	PROOF_SESSION,
	PROOF_CERTIFICATE,
	PROOF_PEER,
	PROOF_COUNT
};
extern const char *const proof_names[PROOF_COUNT];
struct identity {
	char name[TOKEN_NAME_SIZE]; /* of the token, "" without one */
	enum role role;             /* ROLE_ANYONE: not known; ROLE_ADMIN where nobody is asked */
	int64_t expires;            /* as in struct token */
	enum proof proof;
	uint8_t token[TOKEN_DIGEST_BYTES];
};
/* The request's. It may do what its route is about: that was seen to before its handler is called. */
const struct identity *request_identity(const struct request *request);
/*
 * The client that limits and shares count for: the name of the token or certificate, "uid-N" at a Unix socket, and
 * the address of who shows neither.
 */
enum { CLIENT_SIZE = TOKEN_NAME_SIZE };
void request_client(const struct request *request, char ret_client[CLIENT_SIZE]);
/* For a handler that gives more to some: 0, or 0 with a reply that refuses (request_replied), or an error. */
int request_require(struct request *request, enum role least, struct error *err);
bool request_replied(const struct request *request);
/* After the reply was made. The cookie of a session for who asks with a token. */
int request_session_open(struct request *request, struct error *err);
/* Ends the session whose cookie the request has, and has the browser forget it. */
void request_session_close(struct request *request);

/* ---- waiting ---- */
/* Before HTTP_WAIT: be called again at that time (clock_monotonic) in any case. */
void request_wait_until(struct request *request, double time);
/*
 * The client has closed its side, or the connection is broken: on TCP nobody can tell one that still reads from one
 * that has gone. Any thread, while the request lives; takes no lock.
 */
bool request_peer_gone(const struct request *request);
/* The daemon is about to stop: what waits for a change should answer now. */
bool request_stopping(const struct request *request);
/* Any thread, while the request lives; as often as you like; takes no lock of ours but its own. */
void request_wake(struct request *request);
/* The same, at that time (clock_monotonic) if not before. Not from within a call of the server's own. */
void request_wake_by(struct request *request, double time);

/* ---- replies: exactly one for each request ---- */
/* Takes the value, NULL included (then ERR_NO_MEMORY). Cache-Control: no-store. */
int request_reply_json(struct request *request, int status, cJSON *value, struct error *err);
/* Takes the text (free). */
int request_reply_text(struct request *request, int status, const char *media_type, char *text, size_t length,
		       struct error *err);
/* Takes the data (free); the headers are the caller's. */
int request_reply_bytes(struct request *request, int status, void *data, size_t length, struct error *err);
int request_reply_empty(struct request *request, int status, struct error *err);
/* Bytes that stay where they are for as long as the program runs. */
int request_reply_constant(struct request *request, int status, const void *data, size_t length, struct error *err);
/* Takes the descriptor, on failure too. Sent by the kernel alone. */
int request_reply_file(struct request *request, int status, int descriptor, uint64_t offset, uint64_t size,
		       struct error *err);
/*
 * A body made as it is sent. read fills up to `size` bytes from `offset` on and
 * says how many; 0 is the end, negative breaks the connection. size is
 * UNKNOWN_SIZE where it is not known beforehand: offsets then only grow.
 * Takes the context (context_free, once, on failure too).
 */
#define UNKNOWN_SIZE UINT64_MAX
int request_reply_read(struct request *request, int status, uint64_t size,
		       ssize_t (*read)(void *context, uint64_t offset, void *to, size_t size), void *context,
		       void (*context_free)(void *context), struct error *err);
/*
 * A body that goes on for as long as something comes. read, as above, is called
 * in the request's thread; READ_WAIT calls it again after request_wake, or when
 * the time of request_wait_until has come. What it works on is request_state.
 * A client that has gone is noticed within a second, one that vanished by
 * keep-alive probes within 20; patience (s) is how long sent bytes may stay
 * unacknowledged.
 */
enum { READ_WAIT = -2 };
int request_reply_live(struct request *request, int status,
		       ssize_t (*read)(struct request *request, void *to, size_t size), double patience,
		       struct error *err);
/* After one of the above. */
void request_reply_header(struct request *request, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));

/*
 * A problem document by the name that ends its type ("range-outside", a row of
 * problems[] in daemon/problem.c), for those that no error code stands for. Counts
 * as a reply.
 */
int request_reply_problem(struct request *request, const char *name, struct error *err, const char *format, ...)
    __attribute__((format(printf, 4, 5)));

#endif

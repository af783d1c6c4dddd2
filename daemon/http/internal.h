#ifndef CBCT_DAEMON_HTTP_INTERNAL_H
#define CBCT_DAEMON_HTTP_INTERNAL_H

#include <pthread.h>
#include <stdatomic.h>
#include <sys/socket.h>

#include <gnutls/abstract.h>
#include <microhttpd.h>

#include "daemon/http/http.h"
#include "daemon/http/framing.h"
#include "daemon/id.h"

/* Shared by the files of this room; no other room includes this header. */

enum {
	ARGUMENTS_MAX = 4,
	QUERIES_MAX = 16,
	LINGERING_MAX = 64, /* beyond them, the oldest is closed */
	REFUSED_DROP_MOST =
	    1 << 20, /* bytes of a body that are read of who may not send it, so that the answer is read */
	SEGMENTS_MAX = 12,
	PROBES_MAX = 128, /* the daemon's connections to itself, of one look */
	LISTENERS_MAX = 8,
	REQUEST_ID_SIZE = 65, /* also of one that the client gives */
	TRACE_ID_SIZE = 33,
	TRACE_PARENT_SIZE = 56,
	DESCRIPTORS_MAX = 1 << 20
};

/* Where a connection stands; the clock judges its pace by it. */
enum phase {
	PHASE_IDLE,   /* the next request's header is not whole yet */
	PHASE_BODY,   /* it comes in */
	PHASE_HANDLE, /* it is whole, the answer is being made */
	PHASE_SEND    /* the answer goes out */
};

/* Bytes that were read from a connection's socket and may not go on yet; the connection's thread's own. */
struct gate {
	struct framing framing;
	char *held;                         /* bytes; NULL for none */
	size_t given, passed, length, room; /* of held: gone on; may go on; all; allocated */
	uint64_t handled;                   /* heads that the handler was called for */
	bool refused;                       /* what goes on last ends the request that was refused */
};

struct connection {
	struct http *http;
	struct MHD_Connection *mhd; /* NULL until one of its threads has taken it; guarded by lock */
	int socket;
	struct sockaddr_storage address;
	uid_t user;                                         /* of a Unix socket's peer */
	enum role peer_role;                                /* likewise; constant */
	bool tls;                                           /* constant */
	bool certificate_read;                              /* its thread's own, as is the next */
	char audited_id[20], audited_name[TOKEN_NAME_SIZE]; /* the last read that was told; its thread's own */
	char certificate[TOKEN_NAME_SIZE];  /* common name of the client's, which was verified; "" without one */
	struct connection *previous, *next; /* guarded by http->lock */
	int refused; /* status of its answers while it is one too many; 0: welcome; its thread's own */
	struct gate gate;
	struct request *request; /* that is under way, or was dropped by the library; its thread's own */

	pthread_mutex_t lock; /* guards all below */
	enum phase phase;
	struct identity who; /* of the request under way, whose time may be over before it ends */
	double since;        /* of this phase */
	double paused;       /* s of this phase that we made the client wait */
	uint64_t bytes;      /* of this phase's body so far, or in all when sending */
	bool suspended;      /* out of the library's hands until resumed */
	double suspended_at;
	bool woken;           /* request_wake came while it was not suspended */
	double wait_until;    /* of a suspended one */
	bool cut;             /* shut down for its pace, for another's sake, or because its peer has gone */
	uint64_t sent_before; /* bytes that the peer had acknowledged when this phase began; of PHASE_SEND */
	uint64_t made;        /* bytes of a reply of unknown length that the library has asked for */
	uint64_t taken_then;  /* bytes that the client had taken when it was last seen to keep up, */
	double kept_up_at;    /* and when that was; or when there was nothing to send */
	double looked_at;     /* by the clock, whether the peer is there */
	uint64_t bytes_then;  /* of a body, when that was */

	/* For a reply without an end in sight, seconds that sent bytes may stay unacknowledged; 0 for other replies. */
	double patience;
	double answered_at;    /* the last time that nothing was outstanding, or some of it came in */
	uint64_t acknowledged; /* bytes, then */
};

struct request {
	struct http *http;
	struct connection *connection;
	struct MHD_Connection *mhd;
	char id[REQUEST_ID_SIZE];             /* its X-Request-Id, or one of ours */
	char trace[TRACE_ID_SIZE];            /* of traceparent; "" without */
	char trace_parent[TRACE_PARENT_SIZE]; /* likewise */
	double started;
	char *target;  /* as it was sent; owned */
	char *decoded; /* what arguments and queries point into; owned */
	char method[16];
	const struct route *route;
	struct identity who;
	unsigned who_generation; /* of the tokens that knew it */
	const char *arguments[ARGUMENTS_MAX];
	char made[ID_SIZE]; /* by this request; "" without */
	struct {
		const char *name, *value;
	} queries[QUERIES_MAX];
	int query_count;

	bool begun;  /* the header was looked at */
	bool framed; /* the header tells of a body, if only of 0 bytes */
	bool chunked;
	bool dropping; /* the answer is known, the rest of the body is not wanted */
	int64_t content_length;
	uint64_t received, dropped; /* bytes of body */
	char *body;
	size_t body_length, body_room;

	struct MHD_Response *response;
	int status;
	uint64_t response_size; /* UNKNOWN_SIZE or bytes */
	uint64_t sent;          /* bytes, of a body that is made as it is sent */
	bool close;             /* no further request on this connection */
	bool header_lost;       /* of the reply, for want of memory */

	double wait_until; /* for the next suspension */
	void *state;
	void (*state_free)(void *state);
};

struct listener {
	int socket; /* -1 once closed */
	struct sockaddr_storage address;
	bool tls;
	char name[160];      /* "http://127.0.0.1:2228", "unix:/run/x" */
	char unix_path[108]; /* to be removed at the end; "" for TCP */
};

struct http {
	struct http_options options;
	struct access *access;
	struct audit *audit; /* NULL: there is none */
	struct listener listeners[LISTENERS_MAX];
	int listener_count;
	struct tls *tls; /* NULL: none */
	/* The library's threads, for connections without TLS and with; NULL where no listener has such. */
	struct MHD_Daemon *plain_daemon, *tls_daemon;

	pthread_t admission;
	bool admission_runs;
	atomic_bool admission_stop;
	int admission_kick;  /* an eventfd */
	double exhausted_at; /* the last time that there was no descriptor; the thread's own */

	pthread_mutex_t lock; /* guards the list, the probes, the clock's fields; taken before a connection's lock */
	struct {
		int socket;
		bool tls;
	} probes[PROBES_MAX]; /* [probe_count], which the admission thread has yet to take */
	int probe_count;
	struct lingering {
		int socket;
		double until;       /* monotonic */
	} lingering[LINGERING_MAX]; /* [lingering_count], the oldest first: closed for the library, but not for peers */
	int lingering_count;
	struct connection *connections;
	atomic_long connection_count; /* changed under the lock */
	pthread_t clock;
	bool clock_runs, clock_stop;
	pthread_cond_t clock_kick;
	double clock_next; /* when the clock looks again */

	atomic_bool stopping; /* whoever waits should answer */
	atomic_bool closing;  /* nothing may be suspended any more */
	atomic_size_t bodies; /* bytes of whole bodies in memory */
	atomic_ullong request_number;
	struct traffic *traffic; /* constant */
	uint32_t id_prefix;
};

/* ---- http/admit.c: who gets a connection ---- */
int admission_start(struct http *http, struct error *err);
void admission_end(struct http *http);
/* Takes a connection of the daemon's own as if it had been accepted. */
void admission_probe(struct http *http, int socket, bool tls);
/* Closes those that were never taken. */
void admission_forget_probes(struct http *http);
/* A connection that was one too many asks for something: is it welcome by now? */
bool admission_reconsider(struct connection *connection);
/* The library has it now, or no more. */
void connection_taken(struct connection *connection, struct MHD_Connection *mhd);
void connection_free(struct connection *connection);

/* ---- http/gate.c: between the socket and the library ---- */
int gate_open(struct error *err);
/* NULL: what is read from this descriptor is looked at no more. False when it is beyond the table. */
bool gate_set(int descriptor, struct connection *connection);
struct connection *gate_find(int descriptor);
/* Once for each head that the library has parsed: whether it went through the gate. */
bool gate_admits(struct connection *connection);
/* Why the request that is under way was refused; NULL when it was not. */
const struct framing *gate_refusal(const struct connection *connection);
void gate_free(struct gate *gate);

/* ---- http/listen.c: addresses and sockets ---- */
enum guard { GUARD_NONE = 0, GUARD_TOKENS = 1, GUARD_TLS = 2, GUARD_PEERS = 4 };
/*
 * guards: what there is of enum guard; with both, others than loopback addresses are allowed. Sockets that a service
 * manager has opened for this process (LISTEN_FDS, sd_listen_fds(3)) take the place of all in `listen`.
 */
int listeners_open(const char *listen, unsigned guards, struct listener ret_listeners[LISTENERS_MAX], int *ret_count,
		   struct error *err);
void listener_close(struct listener *listener);

/* ---- http/tls.c: certificates ---- */
extern const char tls_priorities[]; /* as GnuTLS writes them */
/* *ret_tls stays NULL where no TLS is configured. */
int tls_new(const struct http_options *options, struct tls **ret_tls, struct error *err);
void tls_free(struct tls *tls); /* NULL is fine */
/* On failure the certificates before stay. NULL is fine. */
int tls_reload(struct tls *tls, struct error *err);
/* PEM of those who sign clients' certificates; NULL where none is asked for. */
const char *tls_trust(const struct tls *tls);
/* The daemon's certificate, as gnutls_certificate_retrieve_function3 wants it. */
int tls_certificate(gnutls_session_t session, const struct gnutls_cert_retr_st *info, gnutls_pcert_st **ret_chain,
		    unsigned *ret_length, gnutls_ocsp_data_st **ret_ocsp, unsigned *ret_ocsp_length,
		    gnutls_privkey_t *ret_key, unsigned *ret_flags);
/* The common name of the client's certificate, "" without one that is trusted. Its thread alone. */
const char *tls_peer_name(struct connection *connection);
/* Tells the client that nothing more comes. */
void tls_end(struct connection *connection);

/* ---- http/clock.c: deadlines, and connections that wait ---- */
int clock_start(struct http *http, struct error *err);
void clock_end(struct http *http);
/*
 * The library is about to close the connection, whose peer may still be sending: its socket stays until the peer has
 * ended, or for some seconds, and what comes is dropped. The kernel would answer it with a reset otherwise, which takes
 * replies with it that are on their way. The thread of the connection.
 */
void connection_linger(struct connection *connection);
void connection_phase(struct connection *connection, enum phase phase, uint64_t bytes);
void connection_progress(struct connection *connection, uint64_t bytes);
/* So many bytes more of a reply of unknown length have gone to the library. */
void connection_made(struct connection *connection, uint64_t bytes);
enum suspension {
	SUSPENDED,
	WOKEN,  /* not suspended: something has happened already, look again */
	REFUSED /* the daemon closes, or the peer has gone: give the connection up */
};
enum suspension connection_suspend(struct connection *connection, double until);
/* Has the clock cut off those whose request goes on for somebody who is not known any more. */
void connections_recheck(struct http *http);
/* All that are suspended. */
void connections_wake(struct http *http);
/* True where no connection has a request under way. */
bool connections_idle(struct http *http);

/* ---- http/live.c: replies without an end in sight ---- */
/* Closed or broken, and nothing of it is unread; who has shut down its side for writing counts, too. */
bool live_hung_up(const struct connection *connection);
/* Whether a client has gone, with or without a word; with the connection's lock held. */
bool live_peer_gone(struct connection *connection, double now);
/* Bytes that the peer has acknowledged so far; UNKNOWN_SIZE on a Unix socket. */
uint64_t live_acknowledged(const struct connection *connection);
/* Bytes that were sent and that the peer has not taken yet. */
size_t live_untaken(const struct connection *connection);

/* ---- http/request.c: what the request line and headers say ---- */
struct request *request_new(struct http *http, struct connection *connection, const char *target);
void request_free(struct request *request); /* NULL is fine */
/* Method, framing, route; 0, or the reply is set (code < 0 when it is not). */
int request_read_header(struct request *request, const char *method, struct error *err);
/* X-Request-Id and traceparent go back with the reply. */
void request_reply_ids(struct request *request);
/*
 * The reply, whose reference is taken over; NULL: there was no memory for it (ERR_NO_MEMORY). size: bytes of its body,
 * UNKNOWN_SIZE where only its end will tell.
 */
int reply_set(struct request *request, int status, struct MHD_Response *response, uint64_t size, struct error *err);
/* Replies with the gate's reasons, and lets the connection end. */
int request_refuse(struct request *request, struct error *err);

/* ---- http/origin.c: who is addressed, and by whose page ---- */
/* ERR_INVALID for a list of server names in which one is none. */
int server_names_check(const char *names, struct error *err);
/* Host, Origin, Sec-Fetch-Site; 0, or 0 with a reply that refuses, or an error. */
int request_check_origin(struct request *request, struct error *err);

/* ---- http/access.c: who asks, and what they may ---- */
int access_new(const struct http_options *options, struct access **ret_access, struct error *err);
void access_free(struct access *access); /* NULL is fine */
/* Users of a Unix socket are known by the kernel: whoever is not in the list shows a token. */
bool access_has_peers(const struct access *access);
/* There are tokens, or roles for a Unix socket's peers, and whoever has none is nobody. */
bool access_is_asked(const struct access *access);
bool access_has_tokens(const struct access *access);
/* The highest role of a user and its groups, ROLE_ANYONE without one; when its connection is new. */
enum role access_peer_role(const struct access *access, int socket, const struct ucred *peer);
/* On failure the tokens before stay. */
int access_reload(struct access *access, struct error *err);
int access_check_routes(const struct route *routes, struct error *err);
/* Whether what showed it still holds: not expired, not revoked. */
bool access_still_holds(struct access *access, const struct identity *who);
/* Checks a request that has found its route: 0, with a reply where it is refused, or an error. */
int access_check(struct request *request, struct error *err);

/* ---- http/traffic.c: numbers of requests, bytes and seconds ---- */
int traffic_new(const struct route *routes, struct traffic **ret_traffic, struct error *err);
void traffic_free(struct traffic *traffic); /* NULL is fine */
/* Counts a request that has ended, in its thread. */
void traffic_count(struct http *http, const struct request *request, bool whole);

/*
 * While a body comes, and at its end: who sends it is still known, or the reply is set that refuses. 0, or an error.
 */
int access_confirm(struct request *request, struct error *err);

/* ---- http/audit.c: who asked for what ---- */
/* most: bytes of a file, before it is renamed; keep: renamed files. */
int audit_new(const char *path, size_t most, int keep, struct audit **ret_audit, struct error *err);
void audit_free(struct audit *audit); /* NULL is fine */
/* Adds the line of a request that has ended, in its thread; audit NULL is fine. */
void audit_tell(struct audit *audit, const struct request *request, bool whole);

/* ---- http/reply.c ---- */
int reply_problem_of(struct request *request, const struct error *err);
/* The reply takes its way; false when the connection has to be given up. */
bool reply_send(struct request *request);

#endif

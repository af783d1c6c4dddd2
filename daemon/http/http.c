/*
 * The HTTP server: connections and requests on top of libmicrohttpd, one epoll
 * loop in each of a few threads.
 *
 * The library calls on_request several times for one request: when the header
 * is there, for each piece of the body, at its end, and after each resumption.
 * A reply can be given at the header or at the end only. So a refusal that is
 * found out in between waits until the rest of the body was read and dropped;
 * closing at once would reset the connection under a client that still writes,
 * and the answer would be lost.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/json.h"

enum {
	/*
	 * Pieces of a body are at most half of it. The library clears that half when it has read a head, so every
	 * connection has it in memory, a watcher's too. Above 32 KiB the library maps it, so that it goes back to the
	 * system with the connection; what is allocated otherwise stays for good after a crowd. In 36 KiB no head fits
	 * that is at all limits of framing.c at once; with 64 and 128 uploads and streams take no less of a processor.
	 */
	CONNECTION_MEMORY = 40 << 10
};
static const size_t bodies_max = 256 << 20; /* bytes of whole bodies in memory, of all requests together */
static const double stop_grace = 2;         /* s */

/* ---- one request ---- */

/* The request is answered, or the connection is given up. */
static enum MHD_Result answer(struct request *request)
{
	return request->response != NULL && reply_send(request) ? MHD_YES : MHD_NO;
}

static enum MHD_Result on_header(struct request *request, const char *method)
{
	struct error err = {0};

	request->begun = true;
	connection_phase(request->connection, PHASE_BODY, 0);
	if (!gate_admits(request->connection)) {
		log_line(LEVEL_ERROR, "request id=%s: the HTTP library reads around the gate, nothing is served",
			 request->id);
		return MHD_NO;
	}
	if (request_read_header(request, method, &err) != 0)
		return MHD_NO;
	/* Without a body the library comes back at once, as at the end of one. */
	if (request->response != NULL && !request->dropping) {
		/* A body that nobody reads cannot be told from the next request. */
		request->close = request->close || request->chunked || request->content_length > 0;
		return answer(request);
	}
	return MHD_YES;
}

/* From now on the body is only read to its end. */
static int refuse_rest(struct request *request, const struct error *err)
{
	request->dropping = true;
	return reply_problem_of(request, err);
}

static int keep_body(struct request *request, const char *data, size_t size, struct error *err)
{
	struct http *http = request->http;
	size_t most = request->route->body_max, wanted = request->body_length + size;

	if (wanted > most)
		return error_set(err, ERR_TOO_LARGE, "the body has more than %zu bytes", most);
	if (wanted + 1 > request->body_room) {
		size_t room = request->body_room > 0 ? request->body_room : 4096;
		char *grown;

		while (room < wanted + 1)
			room *= 2;
		if (atomic_fetch_add(&http->bodies, room - request->body_room) + room > bodies_max) {
			atomic_fetch_sub(&http->bodies, room - request->body_room);
			return error_set(err, ERR_BUSY, "the bodies of all requests together have more than %zu bytes",
					 bodies_max);
		}
		grown = realloc(request->body, room);
		if (grown == NULL) {
			atomic_fetch_sub(&http->bodies, room - request->body_room);
			return error_set(err, ERR_NO_MEMORY, "no memory for a body of %zu bytes", wanted);
		}
		request->body = grown;
		request->body_room = room;
	}
	memcpy(request->body + request->body_length, data, size);
	request->body_length = wanted;
	request->body[wanted] = '\0';
	return 0;
}

/* *size: what is left when the connection was suspended, otherwise 0. */
static enum MHD_Result stream_body(struct request *request, const char *data, size_t *size)
{
	const struct route *route = request->route;
	struct error err = {0};

	while (*size > 0) {
		size_t taken = 0;
		enum suspension outcome;
		int code;

		request->wait_until = INFINITY;
		code = route->data(request->http->options.context, request, data, *size, &taken, &err);
		data += taken;
		*size -= taken;
		if (code < 0) {
			*size = 0;
			return refuse_rest(request, &err) == 0 ? MHD_YES : MHD_NO;
		}
		if (code != HTTP_WAIT)
			continue;
		outcome = connection_suspend(request->connection, request->wait_until);
		if (outcome != WOKEN)
			return outcome == SUSPENDED ? MHD_YES : MHD_NO;
	}
	return MHD_YES;
}

/*
 * Bytes of a body that are dropped for the sake of an answer; then the connection goes. Who was refused by the header
 * gets fewer: before that, nothing of the body was taken.
 */
static uint64_t drop_most(const struct request *request)
{
	const bool at_once = request->received == 0 || request->received < request->dropped;

	return at_once && (request->status == 401 || request->status == 403) ? REFUSED_DROP_MOST : 2ull << 30;
}

static enum MHD_Result on_body(struct request *request, const char *data, size_t *size)
{
	size_t came = *size;
	enum MHD_Result result = MHD_YES;
	struct error err = {0};

	if (!request->dropping && access_confirm(request, &err) != 0)
		return MHD_NO;
	request->dropping |= request->response != NULL;
	if (request->dropping || request->route->body == BODY_NONE) {
		request->dropped += came;
		*size = 0;
		result = request->dropped <= drop_most(request) ? MHD_YES : MHD_NO;
	} else if (request->route->body == BODY_WHOLE) {
		*size = 0;
		if (keep_body(request, data, came, &err) != 0)
			result = refuse_rest(request, &err) == 0 ? MHD_YES : MHD_NO;
	} else {
		result = stream_body(request, data, size);
	}
	request->received += came - *size;
	connection_progress(request->connection, came - *size);
	return result;
}

static enum MHD_Result on_whole(struct request *request)
{
	struct error err = {0};

	connection_phase(request->connection, PHASE_HANDLE, 0);
	/* The body was refused on its way, and ended before its time. */
	if (request->response == NULL && gate_refusal(request->connection) != NULL &&
	    request_refuse(request, &err) != 0)
		return MHD_NO;
	if (request->response == NULL && access_confirm(request, &err) != 0)
		return MHD_NO;
	while (request->response == NULL) {
		enum suspension outcome;
		int code;

		request->wait_until = INFINITY;
		json_set_missing(false); /* what other requests left on this thread */
		code = request->route->handle(request->http->options.context, request, &err);
		if (code < 0) {
			if (reply_problem_of(request, &err) != 0)
				return MHD_NO;
		} else if (code == HTTP_WAIT) {
			outcome = connection_suspend(request->connection, request->wait_until);
			if (outcome != WOKEN)
				return outcome == SUSPENDED ? MHD_YES : MHD_NO;
		}
	}
	return answer(request);
}

static enum MHD_Result on_request(void *context, struct MHD_Connection *mhd, const char *url, const char *method,
				  const char *version, const char *data, size_t *size, void **state)
{
	struct request *request = *state;
	enum MHD_Result result;

	(void)context;
	(void)mhd;
	(void)url;
	(void)version;
	if (request == NULL) /* there was no memory for it */
		return MHD_NO;
	log_set_request(request->id, request->trace);
	if (!request->begun)
		result = on_header(request, method);
	else if (*size > 0)
		result = on_body(request, data, size);
	else
		result = on_whole(request);
	log_set_request(NULL, NULL);
	return result;
}

/* The library's first word of a request; what is returned becomes its state. */
static void *on_target(void *context, const char *target, struct MHD_Connection *mhd)
{
	struct connection *connection =
	    MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_SOCKET_CONTEXT)->socket_context;

	request_free(connection->request);
	connection->request = request_new(context, connection, target);
	return connection->request;
}

static void log_request(const struct request *request, bool whole)
{
	enum log_level level = whole && request->status >= 500 && request->status != 503 && request->status != 505
				   ? LEVEL_WARNING
				   : LEVEL_DEBUG;
	const int path = (int)strcspn(request->target, "?");

	/* Without the query: it is no place for a token, but somebody will put one there. */
	log_line(level, "request id=%s method=%s target=%.*s status=%d bytes=%llu seconds=%.4f%s", request->id,
		 request->method, path < 200 ? path : 200, request->target, request->status,
		 (unsigned long long)request->received, clock_monotonic() - request->started, whole ? "" : " broken");
}

static void on_completed(void *context, struct MHD_Connection *mhd, void **state, enum MHD_RequestTerminationCode how)
{
	struct http *http = context;
	struct request *request = *state;
	bool whole = how == MHD_REQUEST_TERMINATED_COMPLETED_OK;

	(void)mhd;
	*state = NULL;
	if (request == NULL)
		return;
	if (request->begun) {
		traffic_count(http, request, whole);
		log_set_request(request->id, request->trace);
		log_request(request, whole);
		log_set_request(NULL, NULL);
		audit_tell(http->audit, request, whole);
	}
	if (request->close)
		connection_linger(request->connection);
	connection_phase(request->connection, PHASE_IDLE, 0);
	request->connection->request = NULL;
	request_free(request);
}

/* ---- connections ---- */

static void on_connection(void *context, struct MHD_Connection *mhd, void **state,
			  enum MHD_ConnectionNotificationCode what)
{
	struct connection *connection;

	(void)context;
	if (what == MHD_CONNECTION_NOTIFY_STARTED) {
		connection = gate_find(MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_CONNECTION_FD)->connect_fd);
		connection_taken(connection, mhd);
		*state = connection;
	} else {
		connection = *state;
		/* The library drops a request without a word when its memory runs out. */
		request_free(connection->request);
		connection_free(connection);
	}
}

/* ---- the server ---- */

static void on_library_message(void *context, const char *format, va_list args)
{
	char text[400];

	(void)context;
	vsnprintf(text, sizeof(text), format, args);
	text[strcspn(text, "\r\n")] = '\0';
	log_line(LEVEL_DEBUG, "libmicrohttpd: %s", text);
}

/* Each connection may have a file open as well, and the daemon has some of its own. */
static void fit_connections(struct http *http)
{
	const long own = 64, least = 4;
	struct http_options *options = &http->options;
	struct rlimit limit;
	long most;

	if (getrlimit(RLIMIT_NOFILE, &limit) == 0 && limit.rlim_cur < LONG_MAX) {
		most = ((long)limit.rlim_cur - own) / 2;
		most = most > least ? most : least;
		if (most < options->max_connections) {
			log_line(LEVEL_WARNING, "%ld connections in place of %ld: the process may have %ld descriptors",
				 most, options->max_connections, (long)limit.rlim_cur);
			options->max_connections = most;
		}
	}
	if (options->max_connections_per_address == 0)
		options->max_connections_per_address = (options->max_connections + 1) / 2;
}

static unsigned guards_of(const struct http *http)
{
	return (access_has_tokens(http->access) ? GUARD_TOKENS : GUARD_NONE) |
	       (http->tls != NULL ? GUARD_TLS : GUARD_NONE) |
	       (access_has_peers(http->access) ? GUARD_PEERS : GUARD_NONE);
}

int http_new(const struct http_options *options, struct http **ret_http, struct error *err)
{
	struct http *http = calloc(1, sizeof(*http));
	pthread_condattr_t monotonic;

	if (http == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the HTTP server");
	if (getrandom(&http->id_prefix, sizeof(http->id_prefix), 0) != (ssize_t)sizeof(http->id_prefix))
		http->id_prefix = (uint32_t)time(NULL);
	http->options = *options;
	http->admission_kick = -1;
	fit_connections(http);
	lock_init(&http->lock, LOCK_HTTP);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&http->clock_kick, &monotonic);
	pthread_condattr_destroy(&monotonic);
	if (access_check_routes(options->routes, err) != 0 || traffic_new(options->routes, &http->traffic, err) != 0 ||
	    access_new(options, &http->access, err) != 0 || tls_new(options, &http->tls, err) != 0 ||
	    gate_open(err) != 0 || server_names_check(options->server_names, err) != 0 ||
	    listeners_open(options->listen, guards_of(http), http->listeners, &http->listener_count, err) != 0) {
		http_free(http);
		return err->code;
	}
	*ret_http = http;
	return 0;
}

/* Admission counts; the library's own limit, of which each thread has its share, is out of its reach. */
#define LIBRARY_OPTIONS(http, threads)                                                                                 \
	MHD_OPTION_EXTERNAL_LOGGER, on_library_message, NULL, MHD_OPTION_THREAD_POOL_SIZE, (threads),                  \
	    MHD_OPTION_CONNECTION_LIMIT, (unsigned)DESCRIPTORS_MAX *(threads), MHD_OPTION_CONNECTION_MEMORY_LIMIT,     \
	    (size_t)CONNECTION_MEMORY, MHD_OPTION_CONNECTION_TIMEOUT, (unsigned)ceil((http)->options.header_timeout),  \
	    MHD_OPTION_URI_LOG_CALLBACK, on_target, (http), MHD_OPTION_NOTIFY_COMPLETED, on_completed, (http),         \
	    MHD_OPTION_NOTIFY_CONNECTION, on_connection, (http)

static int library_start(struct http *http, struct error *err)
{
	unsigned flags =
	    MHD_USE_EPOLL_INTERNAL_THREAD | MHD_ALLOW_SUSPEND_RESUME | MHD_USE_NO_LISTEN_SOCKET | MHD_USE_ERROR_LOG;
	unsigned threads = (unsigned)http->options.threads;
	bool wanted[2] = {false, false};

	for (int i = 0; i < http->listener_count; i++)
		wanted[http->listeners[i].tls] = true;
	if (wanted[false])
		http->plain_daemon = MHD_start_daemon(flags, 0, NULL, NULL, on_request, http,
						      LIBRARY_OPTIONS(http, threads), MHD_OPTION_END);
	if (wanted[true])
		http->tls_daemon = MHD_start_daemon(flags | MHD_USE_TLS, 0, NULL, NULL, on_request, http,
						    LIBRARY_OPTIONS(http, threads), MHD_OPTION_HTTPS_PRIORITIES,
						    tls_priorities, MHD_OPTION_HTTPS_CERT_CALLBACK2, tls_certificate,
						    MHD_OPTION_HTTPS_MEM_TRUST, tls_trust(http->tls), MHD_OPTION_END);
	if ((wanted[false] && http->plain_daemon == NULL) || (wanted[true] && http->tls_daemon == NULL))
		return error_set(err, ERR_IO, "the HTTP server does not start: %s", strerror(errno));
	return 0;
}

/* Where nobody is asked who they are there is a log only if one is wanted. */
static int start_audit(struct http *http, struct error *err)
{
	const struct http_options *options = &http->options;
	char path[PATH_MAX];

	if (strcmp(options->audit, "off") == 0 || (options->audit[0] == '\0' && !access_is_asked(http->access)))
		return 0;
	if (options->audit[0] != '\0')
		snprintf(path, sizeof(path), "%s", options->audit);
	else
		snprintf(path, sizeof(path), "%s/audit.jsonl", options->state_dir);
	return audit_new(path, options->audit_bytes, options->audit_files, &http->audit, err);
}

int http_start(struct http *http, struct error *err)
{
	if (start_audit(http, err) != 0 || clock_start(http, err) != 0 || library_start(http, err) != 0 ||
	    admission_start(http, err) != 0)
		return err->code;
	for (int i = 0; i < http->listener_count; i++)
		printf("listening on %s\n", http->listeners[i].name);
	fflush(stdout);
	return 0;
}

void http_reload(struct http *http)
{
	struct error err;

	if (access_reload(http->access, &err) != 0)
		log_line(LEVEL_ERROR, "the tokens that were read before stay: %s", err.text);
	connections_recheck(http);
	if (tls_reload(http->tls, &err) != 0)
		log_line(LEVEL_ERROR, "the certificate that was read before stays: %s", err.text);
}

void http_stop(struct http *http)
{
	const struct timespec nap = {0, 10 * 1000 * 1000};
	double end = clock_monotonic() + stop_grace;

	atomic_store(&http->stopping, true);
	admission_end(http);
	for (int i = 0; i < http->listener_count; i++)
		listener_close(&http->listeners[i]);
	do {
		connections_wake(http);
		nanosleep(&nap, NULL);
	} while (!connections_idle(http) && clock_monotonic() < end);
	atomic_store(&http->closing, true);
	connections_wake(http);
	if (http->plain_daemon != NULL)
		MHD_stop_daemon(http->plain_daemon);
	if (http->tls_daemon != NULL)
		MHD_stop_daemon(http->tls_daemon);
	http->plain_daemon = http->tls_daemon = NULL;
	while (http->connections != NULL) /* that the library had never taken */
		connection_free(http->connections);
	clock_end(http);
}

void http_free(struct http *http)
{
	if (http == NULL)
		return;
	http_stop(http);
	if (http->admission_kick >= 0)
		close(http->admission_kick);
	audit_free(http->audit);
	traffic_free(http->traffic);
	access_free(http->access);
	tls_free(http->tls);
	pthread_cond_destroy(&http->clock_kick);
	pthread_mutex_destroy(&http->lock);
	free(http);
}

long http_connections(const struct http *http)
{
	return atomic_load(&http->connection_count);
}

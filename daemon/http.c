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
#include "daemon/http_internal.h"

#include <errno.h>
#include <math.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#include "daemon/log.h"

enum {
	CONNECTION_MEMORY = 128 << 10, /* pieces of a body are at most half of it */
	CONNECTIONS_SPARE = 128        /* beyond the limit, to be told so */
};
static const size_t bodies_max = 256 << 20;   /* bytes of whole bodies in memory, of all requests together */
static const uint64_t drop_most = 2ull << 30; /* bytes dropped for the sake of an answer; then the connection goes */
static const double stop_grace = 2;           /* s */

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
	if (request_read_header(request, method, &err) != 0)
		return MHD_NO;
	/* Without a body the library comes back at once, as at the end of one. */
	if (request->response != NULL && !request->dropping)
		return answer(request);
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

static enum MHD_Result on_body(struct request *request, const char *data, size_t *size)
{
	size_t came = *size;
	enum MHD_Result result = MHD_YES;
	struct error err = {0};

	if (request->dropping || request->route->body == BODY_NONE) {
		request->dropped += came;
		*size = 0;
		result = request->dropped <= drop_most ? MHD_YES : MHD_NO;
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
	while (request->response == NULL) {
		enum suspension outcome;
		int code;

		request->wait_until = INFINITY;
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

	(void)context;
	(void)mhd;
	(void)url;
	(void)version;
	if (request == NULL) /* there was no memory for it */
		return MHD_NO;
	if (!request->begun)
		return on_header(request, method);
	if (*size > 0)
		return on_body(request, data, size);
	return on_whole(request);
}

/* The library's first word of a request; what is returned becomes its state. */
static void *on_target(void *context, const char *target, struct MHD_Connection *mhd)
{
	const union MHD_ConnectionInfo *info = MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_SOCKET_CONTEXT);

	return info->socket_context != NULL ? request_new(context, info->socket_context, target) : NULL;
}

static void log_request(const struct request *request, bool whole)
{
	enum log_level level = whole && request->status >= 500 && request->status != 503 ? LEVEL_WARNING : LEVEL_DEBUG;

	log_line(level, "request id=%s method=%s target=%.200s status=%d bytes=%llu seconds=%.4f%s", request->id,
		 request->method, request->target, request->status, (unsigned long long)request->received,
		 http_now() - request->started, whole ? "" : " broken");
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
		int class = whole && request->status >= 100 && request->status < 600 ? request->status / 100 : 0;

		atomic_fetch_add(&http->requests[class], 1);
		atomic_fetch_add(&http->bytes_in, request->received);
		if (whole && request->response_size != UNKNOWN_SIZE && !request_is_head(request))
			atomic_fetch_add(&http->bytes_out, request->response_size);
		log_request(request, whole);
	}
	connection_phase(request->connection, PHASE_IDLE, 0);
	request_free(request);
}

/* ---- connections ---- */

static bool same_host(const struct sockaddr_storage *a, const struct sockaddr_storage *b)
{
	if (a->ss_family != b->ss_family)
		return false;
	if (a->ss_family == AF_INET)
		return ((const struct sockaddr_in *)(const void *)a)->sin_addr.s_addr ==
		       ((const struct sockaddr_in *)(const void *)b)->sin_addr.s_addr;
	if (a->ss_family == AF_INET6)
		return memcmp(&((const struct sockaddr_in6 *)(const void *)a)->sin6_addr,
			      &((const struct sockaddr_in6 *)(const void *)b)->sin6_addr, sizeof(struct in6_addr)) == 0;
	return false; /* peers of a Unix socket have no address to count by */
}

/* Adds it to the list and judges whether it is one too many. */
static void connection_enter(struct http *http, struct connection *connection)
{
	long same = 0;

	pthread_mutex_lock(&http->lock);
	for (struct connection *c = http->connections; c != NULL; c = c->next)
		same += same_host(&c->address, &connection->address);
	if (http->connection_count >= http->options.max_connections)
		connection->refused = 503;
	else if (same >= http->options.max_connections_per_address)
		connection->refused = 429;
	connection->next = http->connections;
	if (http->connections != NULL)
		http->connections->previous = connection;
	http->connections = connection;
	http->connection_count++;
	pthread_mutex_unlock(&http->lock);
}

static struct connection *connection_new(struct http *http, struct MHD_Connection *mhd)
{
	struct connection *connection = calloc(1, sizeof(*connection));
	const union MHD_ConnectionInfo *info;

	if (connection == NULL)
		return NULL;
	connection->http = http;
	connection->mhd = mhd;
	pthread_mutex_init(&connection->lock, NULL);
	connection->since = http_now();
	info = MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_CONNECTION_FD);
	connection->socket = info->connect_fd;
	socklen_t length = sizeof(connection->address);
	if (getpeername(connection->socket, (struct sockaddr *)&connection->address, &length) != 0)
		connection->address.ss_family = AF_UNSPEC;
	connection_enter(http, connection);
	return connection;
}

static void connection_free(struct connection *connection)
{
	struct http *http = connection->http;

	pthread_mutex_lock(&http->lock);
	if (connection->previous != NULL)
		connection->previous->next = connection->next;
	else
		http->connections = connection->next;
	if (connection->next != NULL)
		connection->next->previous = connection->previous;
	http->connection_count--;
	pthread_mutex_unlock(&http->lock);
	pthread_mutex_destroy(&connection->lock);
	free(connection);
}

static void on_connection(void *context, struct MHD_Connection *mhd, void **state,
			  enum MHD_ConnectionNotificationCode what)
{
	if (what == MHD_CONNECTION_NOTIFY_STARTED)
		*state = connection_new(context, mhd);
	else if (*state != NULL)
		connection_free(*state);
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

int http_new(const struct http_options *options, struct http **ret_http, struct error *err)
{
	struct http *http = calloc(1, sizeof(*http));
	pthread_condattr_t monotonic;

	if (http == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the HTTP server");
	if (getrandom(&http->id_prefix, sizeof(http->id_prefix), 0) != (ssize_t)sizeof(http->id_prefix))
		http->id_prefix = (uint32_t)time(NULL);
	http->options = *options;
	pthread_mutex_init(&http->lock, NULL);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&http->clock_kick, &monotonic);
	pthread_condattr_destroy(&monotonic);
	if (server_names_check(options->server_names, err) != 0 ||
	    listeners_open(options->listen, http->listeners, &http->listener_count, err) != 0) {
		http_free(http);
		return err->code;
	}
	*ret_http = http;
	return 0;
}

static int listener_start(struct http *http, struct listener *listener, struct error *err)
{
	unsigned flags = MHD_USE_EPOLL_INTERNAL_THREAD | MHD_ALLOW_SUSPEND_RESUME | MHD_USE_ERROR_LOG;
	unsigned most = (unsigned)http->options.max_connections + CONNECTIONS_SPARE;

	/* Each thread has its share of the library's limit, and new connections come as the threads find them. */
	listener->daemon = MHD_start_daemon(
	    flags, 0, NULL, NULL, on_request, http, MHD_OPTION_EXTERNAL_LOGGER, on_library_message, NULL,
	    MHD_OPTION_LISTEN_SOCKET, listener->socket, MHD_OPTION_THREAD_POOL_SIZE, (unsigned)http->options.threads,
	    MHD_OPTION_CONNECTION_LIMIT, most * (unsigned)http->options.threads, MHD_OPTION_CONNECTION_MEMORY_LIMIT,
	    (size_t)CONNECTION_MEMORY, MHD_OPTION_CONNECTION_TIMEOUT, (unsigned)ceil(http->options.header_timeout),
	    MHD_OPTION_URI_LOG_CALLBACK, on_target, http, MHD_OPTION_NOTIFY_COMPLETED, on_completed, http,
	    MHD_OPTION_NOTIFY_CONNECTION, on_connection, http, MHD_OPTION_END);
	if (listener->daemon == NULL)
		return error_set(err, ERR_IO, "the HTTP server does not start on %s: %s", listener->name,
				 strerror(errno));
	return 0;
}

int http_start(struct http *http, struct error *err)
{
	if (clock_start(http, err) != 0)
		return err->code;
	for (int i = 0; i < http->listener_count; i++) {
		if (listener_start(http, &http->listeners[i], err) != 0)
			return err->code;
	}
	for (int i = 0; i < http->listener_count; i++)
		printf("listening on %s\n", http->listeners[i].name);
	fflush(stdout);
	return 0;
}

void http_stop(struct http *http)
{
	const struct timespec nap = {0, 10 * 1000 * 1000};
	double end = http_now() + stop_grace;

	atomic_store(&http->stopping, true);
	for (int i = 0; i < http->listener_count; i++) {
		if (http->listeners[i].daemon != NULL)
			MHD_quiesce_daemon(http->listeners[i].daemon);
		listener_close(&http->listeners[i]);
	}
	do {
		connections_wake(http);
		nanosleep(&nap, NULL);
	} while (!connections_idle(http) && http_now() < end);
	atomic_store(&http->closing, true);
	connections_wake(http);
	for (int i = 0; i < http->listener_count; i++) {
		if (http->listeners[i].daemon != NULL)
			MHD_stop_daemon(http->listeners[i].daemon);
		http->listeners[i].daemon = NULL;
	}
	clock_end(http);
}

void http_free(struct http *http)
{
	if (http == NULL)
		return;
	http_stop(http);
	pthread_cond_destroy(&http->clock_kick);
	pthread_mutex_destroy(&http->lock);
	free(http);
}

void http_statistics(struct http *http, struct http_statistics *ret)
{
	for (int i = 0; i < 6; i++)
		ret->requests[i] = atomic_load(&http->requests[i]);
	ret->bytes_in = atomic_load(&http->bytes_in);
	ret->bytes_out = atomic_load(&http->bytes_out);
	ret->connections = http_connections(http);
}

long http_connections(const struct http *http)
{
	return atomic_load(&http->connection_count);
}

/*
 * Connections and time: each one's pace is judged by the phase it is in, those
 * that wait are woken when their time has come, those without an end in sight
 * when their peer has gone. One thread looks at all
 * of them; it sleeps until the next deadline it saw, or a second.
 *
 * The library knows idle time only, so that a client which sends a byte every
 * few seconds would live for ever; and it cannot close a connection from
 * another thread, but it sees the end when the socket is shut down.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "daemon/log.h"

/* Deadlines this close to each other are seen in one go. */
static const double resolution = 0.01; /* s */

void connection_phase(struct connection *connection, enum phase phase, uint64_t bytes)
{
	pthread_mutex_lock(&connection->lock);
	connection->phase = phase;
	connection->since = clock_monotonic();
	connection->paused = 0;
	connection->bytes = bytes;
	connection->bytes_then = UNKNOWN_SIZE;
	connection->made = 0;
	connection->kept_up_at = connection->since;
	connection->woken = false;
	if (phase == PHASE_IDLE) {
		connection->patience = 0;
		connection->who.expires = TOKEN_NEVER;
	}
	if (phase == PHASE_SEND) {
		connection->sent_before = live_acknowledged(connection);
		connection->taken_then = connection->sent_before == UNKNOWN_SIZE ? 0 : connection->sent_before;
	}
	pthread_mutex_unlock(&connection->lock);
}

void connection_progress(struct connection *connection, uint64_t bytes)
{
	pthread_mutex_lock(&connection->lock);
	connection->bytes += bytes;
	pthread_mutex_unlock(&connection->lock);
}

void connection_made(struct connection *connection, uint64_t bytes)
{
	pthread_mutex_lock(&connection->lock);
	connection->made += bytes;
	pthread_mutex_unlock(&connection->lock);
}

enum suspension connection_suspend(struct connection *connection, double until)
{
	struct http *http = connection->http;
	enum suspension outcome = SUSPENDED;
	double now = clock_monotonic();

	pthread_mutex_lock(&connection->lock);
	if (atomic_load(&http->closing) || connection->cut) {
		outcome = REFUSED;
	} else if (connection->woken || until <= now) {
		connection->woken = false;
		outcome = WOKEN;
	} else {
		connection->suspended = true;
		connection->suspended_at = now;
		connection->wait_until = until;
		MHD_suspend_connection(connection->mhd);
	}
	pthread_mutex_unlock(&connection->lock);
	if (outcome == SUSPENDED && isfinite(until)) {
		pthread_mutex_lock(&http->lock);
		if (until < http->clock_next)
			pthread_cond_signal(&http->clock_kick);
		pthread_mutex_unlock(&http->lock);
	}
	return outcome;
}

/* With the connection's lock held. */
static void resume(struct connection *connection)
{
	connection->suspended = false;
	connection->paused += clock_monotonic() - connection->suspended_at;
	MHD_resume_connection(connection->mhd);
}

void request_wake(struct request *request)
{
	struct connection *connection = request->connection;

	pthread_mutex_lock(&connection->lock);
	if (connection->suspended)
		resume(connection);
	else
		connection->woken = true;
	pthread_mutex_unlock(&connection->lock);
}

void request_wake_by(struct request *request, double time)
{
	struct connection *connection = request->connection;
	struct http *http = connection->http;

	pthread_mutex_lock(&connection->lock);
	if (!connection->suspended)
		connection->woken = true;
	else if (time < connection->wait_until)
		connection->wait_until = time;
	pthread_mutex_unlock(&connection->lock);
	pthread_mutex_lock(&http->lock);
	if (time < http->clock_next)
		pthread_cond_signal(&http->clock_kick);
	pthread_mutex_unlock(&http->lock);
}

void connections_recheck(struct http *http)
{
	pthread_mutex_lock(&http->lock);
	for (struct connection *c = http->connections; c != NULL; c = c->next) {
		pthread_mutex_lock(&c->lock);
		if (!access_still_holds(http->access, &c->who))
			c->who.expires = 0;
		pthread_mutex_unlock(&c->lock);
	}
	pthread_mutex_unlock(&http->lock);
}

void connections_wake(struct http *http)
{
	pthread_mutex_lock(&http->lock);
	for (struct connection *c = http->connections; c != NULL; c = c->next) {
		pthread_mutex_lock(&c->lock);
		if (c->suspended)
			resume(c);
		pthread_mutex_unlock(&c->lock);
	}
	pthread_mutex_unlock(&http->lock);
}

bool connections_idle(struct http *http)
{
	bool idle = true;

	pthread_mutex_lock(&http->lock);
	for (struct connection *c = http->connections; c != NULL && idle; c = c->next) {
		pthread_mutex_lock(&c->lock);
		idle = c->phase == PHASE_IDLE;
		pthread_mutex_unlock(&c->lock);
	}
	pthread_mutex_unlock(&http->lock);
	return idle;
}

/* When this connection is cut off; with its lock held. */
static double deadline(const struct connection *connection)
{
	const struct http_options *options = &connection->http->options;

	switch (connection->phase) {
	case PHASE_IDLE:
		return connection->since + options->header_timeout;
	case PHASE_HANDLE:
		return INFINITY;
	case PHASE_BODY:
	case PHASE_SEND:
		if (connection->bytes == UNKNOWN_SIZE)
			return INFINITY; /* see is_stalled */
		break;
	}
	return connection->since + connection->paused + options->transfer_grace +
	       (double)connection->bytes / (double)options->minimum_rate;
}

/*
 * An idle connection whose client has gone with its last request: the end came with that edge of epoll, and the library
 * waits for another one.
 */
static bool is_left(const struct connection *connection, double now)
{
	return now - connection->since >= 1 && live_hung_up(connection);
}

/*
 * A body that has stopped because its client is gone. The library waits for an
 * edge of epoll; when the end of the connection came together with the last
 * bytes there is none any more, and what had come would lie unsaved, its
 * projections claimed, until the body's time is over. With the lock held.
 */
static bool body_is_broken(struct connection *connection)
{
	bool stopped = connection->bytes == connection->bytes_then;

	connection->bytes_then = connection->bytes;
	return stopped && live_hung_up(connection);
}

/*
 * A reply whose length nobody knew, and whose client reads it slower than the minimum rate for as long as any body may
 * be late. A stream that has nothing to say is suspended, and one that says little now and then is not slow where its
 * client has taken all but the last of it.
 */
static bool is_stalled(struct connection *connection, double now)
{
	const struct http_options *options = &connection->http->options;
	const size_t little = 4096; /* of a longer reply the socket holds more */
	uint64_t taken;

	if (connection->phase != PHASE_SEND || connection->bytes != UNKNOWN_SIZE)
		return false;
	taken = live_acknowledged(connection);
	if (taken == UNKNOWN_SIZE) /* a Unix socket holds little */
		taken = connection->made;
	if (connection->suspended || live_untaken(connection) < little ||
	    (double)(taken - connection->taken_then) >=
		(double)options->minimum_rate * fmax(1, now - connection->kept_up_at)) {
		connection->taken_then = taken;
		connection->kept_up_at = now;
	}
	return now - connection->kept_up_at >= options->transfer_grace;
}

/* Looks at one connection; returns when to look again. With http->lock held: the socket is not closed meanwhile. */
static double look(struct connection *connection, double now)
{
	static const char *const names[] = {"header", "body", "answer", "answer on its way"};
	double next = INFINITY;
	enum phase slow = PHASE_IDLE;
	bool cut = false;

	pthread_mutex_lock(&connection->lock);
	if (connection->mhd == NULL) {
		pthread_mutex_unlock(&connection->lock);
		return next;
	}
	if (!connection->cut && now >= connection->looked_at + 1) {
		connection->looked_at = now;
		if (connection->patience > 0)
			connection->cut = live_peer_gone(connection, now);
		else if (connection->phase == PHASE_BODY && !connection->suspended)
			connection->cut = body_is_broken(connection);
		else if (connection->phase == PHASE_IDLE)
			connection->cut = is_left(connection, now);
		/* A stream may go on for hours; who asked for it must be known all the time. */
		connection->cut = connection->cut || time(NULL) >= connection->who.expires;
		if (connection->cut)
			shutdown(connection->socket, SHUT_RDWR);
	}
	if (connection->suspended) {
		next = connection->wait_until;
		if (next <= now || connection->cut) {
			resume(connection);
			next = INFINITY;
		}
	} else if (!connection->cut && (deadline(connection) <= now || is_stalled(connection, now))) {
		cut = connection->cut = true;
		slow = connection->phase;
		shutdown(connection->socket, SHUT_RDWR);
	}
	pthread_mutex_unlock(&connection->lock);
	if (cut && slow != PHASE_IDLE)
		log_line(LEVEL_INFO, "connection cut off: its %s is slower than the minimum rate", names[slow]);
	return next;
}

/* ---- connections that are closed, but for what their peers still send ---- */

static const double LINGER = 5;         /* s */
static const double LINGER_LOOK = 0.05; /* s between two looks */

/* False when its end has come. */
static bool drop_rest(const struct lingering *lingering)
{
	enum { MOST = 64 };
	char rest[16384];
	ssize_t got = 1;

	for (int i = 0; i < MOST && got > 0; i++)
		got = recv(lingering->socket, rest, sizeof(rest), MSG_DONTWAIT);
	return got > 0 || (got < 0 && (errno == EAGAIN || errno == EINTR));
}

/* With http->lock held, as the next. Returns when to look again. */
static double look_at_lingering(struct http *http, double now)
{
	int kept = 0;

	for (int i = 0; i < http->lingering_count; i++) {
		if (drop_rest(&http->lingering[i]) && now < http->lingering[i].until)
			http->lingering[kept++] = http->lingering[i];
		else
			close(http->lingering[i].socket);
	}
	http->lingering_count = kept;
	return kept > 0 ? now + LINGER_LOOK : INFINITY;
}

static void end_lingering(struct http *http, int count)
{
	for (int i = 0; i < count; i++)
		close(http->lingering[i].socket);
	http->lingering_count -= count;
	memmove(http->lingering, http->lingering + count, (size_t)http->lingering_count * sizeof(*http->lingering));
}

void connection_linger(struct connection *connection)
{
	struct http *http = connection->http;
	struct lingering lingering = {.until = clock_monotonic() + LINGER};

	tls_end(connection);
	shutdown(connection->socket, SHUT_WR);
	lingering.socket = fcntl(connection->socket, F_DUPFD_CLOEXEC, 0);
	/* Where there is no descriptor for it, what has come by now is dropped. */
	if (lingering.socket < 0) {
		drop_rest(&(struct lingering){.socket = connection->socket});
		return;
	}
	pthread_mutex_lock(&http->lock);
	if (http->lingering_count == LINGERING_MAX)
		end_lingering(http, 1);
	http->lingering[http->lingering_count++] = lingering;
	if (clock_monotonic() + LINGER_LOOK < http->clock_next)
		pthread_cond_signal(&http->clock_kick);
	pthread_mutex_unlock(&http->lock);
}

static void *run_clock(void *context)
{
	struct http *http = context;

	pthread_mutex_lock(&http->lock);
	while (!http->clock_stop) {
		double now = clock_monotonic();
		struct timespec until;

		http->clock_next = fmin(now + 1, look_at_lingering(http, now));
		for (struct connection *c = http->connections; c != NULL; c = c->next)
			http->clock_next = fmin(http->clock_next, look(c, now));
		http->clock_next = fmax(http->clock_next, now + resolution);
		until = clock_timespec(http->clock_next);
		pthread_cond_timedwait(&http->clock_kick, &http->lock, &until);
	}
	end_lingering(http, http->lingering_count);
	pthread_mutex_unlock(&http->lock);
	return NULL;
}

int clock_start(struct http *http, struct error *err)
{
	int code = pthread_create(&http->clock, NULL, run_clock, http);

	if (code != 0)
		return error_set_errno(err, code, "thread for deadlines");
	http->clock_runs = true;
	return 0;
}

void clock_end(struct http *http)
{
	if (!http->clock_runs)
		return;
	pthread_mutex_lock(&http->lock);
	http->clock_stop = true;
	pthread_cond_signal(&http->clock_kick);
	pthread_mutex_unlock(&http->lock);
	pthread_join(http->clock, NULL);
	http->clock_runs = false;
}

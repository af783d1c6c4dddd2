/*
 * Admission: one thread accepts the connections of all addresses.
 *
 * Acquisition must get in whatever else talks to the daemon, and on a
 * workstation all of it comes from the same address. So a limit (in all, and
 * for each address, or each user of a Unix socket) does not turn the next one
 * away: it closes the connection that is needed least, an idle one, else one
 * that sends or reads slower than the minimum rate. Only where all are busy is
 * the newcomer refused (503, 429), and even then what it writes (PUT, POST) is
 * taken, as long as CONNECTIONS_SPARE lasts.
 *
 * The library would accept by itself; but out of descriptors it spins, and it
 * knows no other rule than closing the newcomer without a word.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <math.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"

enum {
	CONNECTIONS_SPARE = 128, /* beyond the limit, to be refused or to write */
	TURN = 64,               /* accepted from one socket before the next is looked at */
	PAUSE = 100              /* ms, where there is neither room nor a descriptor */
};
static const double idle_after = 1;         /* s, before which a request may be on its way */
static const double judged_after = 2;       /* s, before which no transfer counts as slow */
static const double exhaustion_logged = 60; /* s, within which it is logged once */

/* ---- the list of connections ---- */

static bool same_host(const struct connection *a, const struct connection *b)
{
	if (a->address.ss_family != b->address.ss_family)
		return false;
	if (a->address.ss_family == AF_INET)
		return ((const struct sockaddr_in *)(const void *)&a->address)->sin_addr.s_addr ==
		       ((const struct sockaddr_in *)(const void *)&b->address)->sin_addr.s_addr;
	if (a->address.ss_family == AF_INET6)
		return memcmp(&((const struct sockaddr_in6 *)(const void *)&a->address)->sin6_addr,
			      &((const struct sockaddr_in6 *)(const void *)&b->address)->sin6_addr,
			      sizeof(struct in6_addr)) == 0;
	return a->address.ss_family == AF_UNIX && a->user == b->user;
}

/*
 * How little a connection is needed, with its lock held: what is idle the longest first, then the slowest transfer,
 * before all a stream, or a request that waits, whose client has gone; negative: it is left alone.
 */
static double dispensable(const struct connection *connection, double now)
{
	const double idle = 1e9; /* s, more than any transfer takes */
	double age = now - connection->since, rate = (double)connection->http->options.minimum_rate;
	uint64_t moved = connection->bytes;

	if (connection->cut)
		return -1;
	/* The clock would see it within two seconds. */
	if ((connection->patience > 0 || (connection->suspended && connection->phase == PHASE_HANDLE)) &&
	    live_hung_up(connection))
		return INFINITY;
	if (connection->suspended)
		return -1;
	if (connection->phase == PHASE_IDLE)
		return age >= idle_after ? idle + age : -1;
	age -= connection->paused;
	if (age < judged_after || connection->phase == PHASE_HANDLE || connection->patience > 0)
		return -1;
	if (connection->phase == PHASE_SEND) {
		uint64_t sent = live_acknowledged(connection);

		if (sent == UNKNOWN_SIZE || connection->sent_before == UNKNOWN_SIZE)
			return -1;
		moved = sent - connection->sent_before;
	}
	return (double)moved < rate * age ? age : -1;
}

/* Closes the one that is needed least, of `like`'s host or (NULL) of all. With http->lock held. */
static bool make_room(struct http *http, const struct connection *like)
{
	struct connection *victim = NULL;
	double now = clock_monotonic(), most = -1;

	for (struct connection *c = http->connections; c != NULL; c = c->next) {
		double needless;

		if (like != NULL && !same_host(c, like))
			continue;
		pthread_mutex_lock(&c->lock);
		needless = dispensable(c, now);
		pthread_mutex_unlock(&c->lock);
		if (needless > most) {
			most = needless;
			victim = c;
		}
	}
	if (victim == NULL)
		return false;
	pthread_mutex_lock(&victim->lock);
	victim->cut = true;
	if (victim->mhd != NULL)
		shutdown(victim->socket, SHUT_RDWR);
	pthread_mutex_unlock(&victim->lock);
	pthread_cond_signal(&http->clock_kick); /* resumes one that is suspended, for its end */
	return true;
}

/* The status that one more of this kind is refused with, or 0. With http->lock held. */
static int over_limit(struct http *http, const struct connection *connection)
{
	long same = 0, all = 0;

	for (struct connection *c = http->connections; c != NULL; c = c->next) {
		bool leaves;

		pthread_mutex_lock(&c->lock);
		leaves = c->cut;
		pthread_mutex_unlock(&c->lock);
		if (c == connection || leaves)
			continue;
		all++;
		same += same_host(c, connection);
	}
	if (all >= http->options.max_connections)
		return 503;
	return same >= http->options.max_connections_per_address ? 429 : 0;
}

/* Others make room as long as it is one too many. With http->lock held. */
static void judge(struct http *http, struct connection *connection)
{
	do {
		connection->refused = over_limit(http, connection);
	} while (connection->refused != 0 && make_room(http, connection->refused == 429 ? connection : NULL));
}

bool admission_reconsider(struct connection *connection)
{
	struct http *http = connection->http;

	pthread_mutex_lock(&http->lock);
	judge(http, connection);
	pthread_mutex_unlock(&http->lock);
	return connection->refused == 0;
}

static void connection_enter(struct http *http, struct connection *connection)
{
	pthread_mutex_lock(&http->lock);
	if (connection->address.ss_family != AF_UNSPEC) /* a probe takes nobody's place */
		judge(http, connection);
	connection->next = http->connections;
	if (http->connections != NULL)
		http->connections->previous = connection;
	http->connections = connection;
	http->connection_count++;
	pthread_mutex_unlock(&http->lock);
}

static struct connection *connection_new(struct http *http, int socket, const struct sockaddr_storage *address,
					 bool tls)
{
	struct connection *connection = calloc(1, sizeof(*connection));
	struct ucred peer;
	socklen_t size = sizeof(peer);

	if (connection == NULL)
		return NULL;
	connection->http = http;
	connection->socket = socket;
	connection->address = *address;
	connection->tls = tls;
	connection->who.expires = TOKEN_NEVER;
	if (address->ss_family == AF_UNIX && getsockopt(socket, SOL_SOCKET, SO_PEERCRED, &peer, &size) == 0) {
		connection->user = peer.uid;
		connection->peer_role = access_peer_role(http->access, socket, &peer);
	}
	connection->since = clock_monotonic();
	lock_init(&connection->lock, LOCK_CONNECTION);
	connection_enter(http, connection);
	return connection;
}

void connection_taken(struct connection *connection, struct MHD_Connection *mhd)
{
	pthread_mutex_lock(&connection->lock);
	connection->mhd = mhd;
	if (connection->cut)
		shutdown(connection->socket, SHUT_RDWR);
	pthread_mutex_unlock(&connection->lock);
}

void connection_free(struct connection *connection)
{
	struct http *http = connection->http;

	gate_set(connection->socket, NULL);
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
	gate_free(&connection->gate);
	free(connection);
}

/* ---- accepting ---- */

/* A socket that the library has closed before it took it, for lack of memory, left its connection behind. */
static void forget_lost(int socket)
{
	struct connection *lost = gate_find(socket);

	if (lost != NULL)
		connection_free(lost);
}

static void admit(struct http *http, int socket, const struct sockaddr_storage *address, socklen_t size, bool tls)
{
	struct MHD_Daemon *daemon = tls ? http->tls_daemon : http->plain_daemon;
	struct connection *connection;

	forget_lost(socket);
	connection = connection_new(http, socket, address, tls);
	if (connection == NULL || !gate_set(socket, connection)) {
		if (connection != NULL)
			connection_free(connection);
		close(socket);
		return;
	}
	/* The library closes it if it fails. */
	if (MHD_add_connection(daemon, socket, (const struct sockaddr *)address, size) != MHD_YES)
		connection_free(connection);
}

static bool is_full(struct http *http)
{
	bool full;

	pthread_mutex_lock(&http->lock);
	full = http->connection_count >= http->options.max_connections + CONNECTIONS_SPARE;
	if (full)
		make_room(http, NULL);
	pthread_mutex_unlock(&http->lock);
	return full;
}

static void log_exhausted(struct http *http, int reason)
{
	double now = clock_monotonic();

	if (http->exhausted_at == 0 || now - http->exhausted_at > exhaustion_logged)
		log_line(LEVEL_WARNING, "no connection can be accepted just now, %ld are open: %s",
			 atomic_load(&http->connection_count), strerror(reason));
	http->exhausted_at = now;
	pthread_mutex_lock(&http->lock);
	make_room(http, NULL);
	pthread_mutex_unlock(&http->lock);
}

/* False when there is no room for any more just now. */
static bool accept_from(struct http *http, const struct listener *listener)
{
	for (int i = 0; i < TURN; i++) {
		struct sockaddr_storage address = {0};
		socklen_t size = sizeof(address);
		int socket;

		if (is_full(http))
			return false;
		socket = accept4(listener->socket, (struct sockaddr *)&address, &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
		if (socket >= 0) {
			admit(http, socket, &address, size, listener->tls);
		} else if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM) {
			log_exhausted(http, errno);
			return false;
		} else if (errno == EAGAIN || errno == EWOULDBLOCK) {
			break;
		}
	}
	return true;
}

/* True: the admission thread looks at what has changed. */
static bool kick(struct http *http)
{
	const uint64_t one = 1;

	return write(http->admission_kick, &one, sizeof(one)) == (ssize_t)sizeof(one);
}

void admission_probe(struct http *http, int socket, bool tls)
{
	bool full;

	pthread_mutex_lock(&http->lock);
	full = http->probe_count == PROBES_MAX;
	if (!full) {
		http->probes[http->probe_count].socket = socket;
		http->probes[http->probe_count++].tls = tls;
	}
	pthread_mutex_unlock(&http->lock);
	if (full)
		close(socket);
	else
		kick(http);
}

void admission_forget_probes(struct http *http)
{
	pthread_mutex_lock(&http->lock);
	while (http->probe_count > 0)
		close(http->probes[--http->probe_count].socket);
	pthread_mutex_unlock(&http->lock);
}

static void admit_probes(struct http *http)
{
	const struct sockaddr_storage nobody = {.ss_family = AF_UNSPEC};
	uint64_t ignored;
	bool some = true;

	if (read(http->admission_kick, &ignored, sizeof(ignored)) < 0)
		return;
	while (some) {
		int socket = -1;
		bool tls = false;

		pthread_mutex_lock(&http->lock);
		some = http->probe_count > 0;
		if (some) {
			socket = http->probes[--http->probe_count].socket;
			tls = http->probes[http->probe_count].tls;
		}
		pthread_mutex_unlock(&http->lock);
		if (some)
			admit(http, socket, &nobody, sizeof(nobody.ss_family), tls);
	}
}

static void *run_admission(void *context)
{
	struct http *http = context;
	struct pollfd polls[1 + LISTENERS_MAX] = {{http->admission_kick, POLLIN, 0}};
	bool room = true;

	for (int i = 0; i < http->listener_count; i++)
		polls[1 + i] = (struct pollfd){http->listeners[i].socket, POLLIN, 0};
	while (!atomic_load(&http->admission_stop)) {
		int ready = poll(polls, room ? 1 + (nfds_t)http->listener_count : 1, room ? -1 : PAUSE);

		if (ready < 0 && errno != EINTR)
			log_line(LEVEL_ERROR, "poll: %s", strerror(errno));
		if (ready > 0 && polls[0].revents != 0)
			admit_probes(http);
		room = true;
		for (int i = 0; i < http->listener_count && !atomic_load(&http->admission_stop); i++) {
			room = accept_from(http, &http->listeners[i]) && room;
		}
	}
	return NULL;
}

int admission_start(struct http *http, struct error *err)
{
	int code;

	http->admission_kick = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	if (http->admission_kick < 0)
		return error_set_errno(err, errno, "eventfd");
	code = pthread_create(&http->admission, NULL, run_admission, http);
	if (code != 0)
		return error_set_errno(err, code, "thread for new connections");
	http->admission_runs = true;
	return 0;
}

void admission_end(struct http *http)
{
	if (!http->admission_runs)
		return;
	atomic_store(&http->admission_stop, true);
	if (kick(http))
		pthread_join(http->admission, NULL);
	http->admission_runs = false;
}

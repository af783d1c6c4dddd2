/*
 * Replies without an end in sight: event streams and volumes as they are made.
 *
 * The library asks for bytes whenever the socket takes some; when there are
 * none yet the connection is suspended from within that call, out of the epoll
 * loop, until request_wake. No thread and no timer of its own for any of them.
 * A suspended connection does not see its peer go: so the clock looks at the
 * socket every second.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <math.h>
#include <linux/sockios.h>
#include <linux/tcp.h> /* the C library's has not all of struct tcp_info */
#include <netinet/in.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/ioctl.h>

struct live {
	struct request *request;
	ssize_t (*read)(struct request *request, void *to, size_t size);
};

/* Beneath TLS a farewell, which is one short record, may lie unread before the end. */
static bool tls_hung_up(const struct connection *connection)
{
	enum { FAREWELL_MAX = 64 };
	struct pollfd poll_one = {connection->socket, POLLRDHUP, 0};
	int unread = 0;

	return poll(&poll_one, 1, 0) > 0 && ioctl(connection->socket, FIONREAD, &unread) == 0 && unread <= FAREWELL_MAX;
}

bool live_hung_up(const struct connection *connection)
{
	char byte;
	ssize_t got;

	if (connection->tls)
		return tls_hung_up(connection);
	got = recv(connection->socket, &byte, 1, MSG_PEEK | MSG_DONTWAIT);

	return got == 0 || (got < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR);
}

bool request_peer_gone(const struct request *request)
{
	struct pollfd poll_one = {request->connection->socket, POLLRDHUP, 0};

	return poll(&poll_one, 1, 0) > 0;
}

uint64_t live_acknowledged(const struct connection *connection)
{
	struct tcp_info info = {0};
	socklen_t size = sizeof(info);

	return getsockopt(connection->socket, IPPROTO_TCP, TCP_INFO, &info, &size) == 0 ? info.tcpi_bytes_acked
											: UNKNOWN_SIZE;
}

size_t live_untaken(const struct connection *connection)
{
	int bytes = 0;

	return ioctl(connection->socket, SIOCOUTQ, &bytes) == 0 && bytes > 0 ? (size_t)bytes : 0;
}

/*
 * A peer that vanished acknowledges neither data nor the probes of an idle
 * connection; the kernel then makes its end an error of the socket. A peer that
 * does not read still answers the probes of its closed window.
 */
bool live_peer_gone(struct connection *connection, double now)
{
	struct tcp_info info = {0};
	socklen_t size = sizeof(info);

	if (live_hung_up(connection))
		return true;
	if (getsockopt(connection->socket, IPPROTO_TCP, TCP_INFO, &info, &size) != 0)
		return false; /* a Unix socket: a peer does not vanish */
	if ((info.tcpi_unacked == 0 && info.tcpi_probes == 0) || info.tcpi_bytes_acked != connection->acknowledged) {
		connection->acknowledged = info.tcpi_bytes_acked;
		connection->answered_at = now;
	}
	return now - connection->answered_at >= connection->patience;
}

/*
 * Ends the connection without an end of the body. An error from a reader leaves
 * it with the library, closed and counted, until its thread wakes up for
 * another reason; a write that fails cleans up at once.
 */
static ssize_t give_up(const struct connection *connection, char *to)
{
	shutdown(connection->socket, SHUT_RDWR);
	to[0] = ' ';
	return 1;
}

static ssize_t live_read(void *context, uint64_t offset, char *to, size_t size)
{
	struct live *live = context;
	struct request *request = live->request;

	(void)offset;
	for (;;) {
		ssize_t got;

		request->wait_until = INFINITY;
		got = live->read(request, to, size);
		if (got > 0) {
			request->sent += (uint64_t)got;
			connection_made(request->connection, (uint64_t)got);
			return got;
		}
		if (got == 0)
			return MHD_CONTENT_READER_END_OF_STREAM;
		if (got != READ_WAIT)
			return give_up(request->connection, to);
		switch (connection_suspend(request->connection, request->wait_until)) {
		case SUSPENDED:
			return 0;
		case REFUSED:
			return give_up(request->connection, to);
		case WOKEN:
			break;
		}
	}
}

static void live_free(void *context)
{
	free(context);
}

/* Good manners, not conditions: a Unix socket knows nothing of them. */
static void watch_peer(struct connection *connection, double patience)
{
	int on = 1, idle = 5, interval = 5, probes = 3;

	setsockopt(connection->socket, SOL_SOCKET, SO_KEEPALIVE, &on, sizeof(on));
	setsockopt(connection->socket, IPPROTO_TCP, TCP_KEEPIDLE, &idle, sizeof(idle));
	setsockopt(connection->socket, IPPROTO_TCP, TCP_KEEPINTVL, &interval, sizeof(interval));
	setsockopt(connection->socket, IPPROTO_TCP, TCP_KEEPCNT, &probes, sizeof(probes));
	/* Each event is due when it happens. */
	setsockopt(connection->socket, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
	pthread_mutex_lock(&connection->lock);
	connection->patience = patience;
	connection->looked_at = connection->answered_at = clock_monotonic();
	connection->acknowledged = 0;
	pthread_mutex_unlock(&connection->lock);
}

int request_reply_live(struct request *request, int status,
		       ssize_t (*read)(struct request *request, void *to, size_t size), double patience,
		       struct error *err)
{
	enum { BLOCK = 4096 }; /* each reply has one, for clients that know no chunks */
	struct live *live = malloc(sizeof(*live));
	struct MHD_Response *response = NULL;

	if (live != NULL) {
		*live = (struct live){request, read};
		response = MHD_create_response_from_callback(MHD_SIZE_UNKNOWN, BLOCK, live_read, live, live_free);
	}
	if (response == NULL)
		free(live);
	else
		watch_peer(request->connection, patience);
	return reply_set(request, status, response, UNKNOWN_SIZE, err);
}

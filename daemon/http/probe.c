/*
 * Whether the server answers, for a watchdog: a connection of the daemon's own to each of the library's threads, handed
 * to the admission thread as if it had been accepted. Without TLS it asks for /livez; with TLS it sends what is no
 * handshake, and the thread closes it. So each of these threads has shown that its loop turns.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <string.h>
#include <unistd.h>

static const char plain_question[] = "GET /livez HTTP/1.0\r\n\r\n", tls_question[] = "no handshake\r\n\r\n";

/*
 * The library (0.9.75) gives a connection to the thread of number `descriptor modulo threads`: so the far end gets a
 * descriptor for the thread that it is to reach.
 */
static int descriptor_for(int socket, int thread, int threads)
{
	int from = thread, moved;

	for (;;) {
		moved = fcntl(socket, F_DUPFD_CLOEXEC, from);
		if (moved < 0 || moved % threads == thread)
			break;
		from = moved - moved % threads + thread;
		from += from < moved ? threads : 0;
		close(moved);
	}
	close(socket);
	return moved;
}

/* Returns our end, or -1. */
static int probe_begin(struct http *http, bool tls, int thread)
{
	const char *question = tls ? tls_question : plain_question;
	size_t length = strlen(question);
	int pair[2];

	if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, pair) != 0)
		return -1;
	pair[1] = descriptor_for(pair[1], thread, http->options.threads);
	if (pair[1] < 0 || write(pair[0], question, length) != (ssize_t)length) {
		close(pair[0]);
		if (pair[1] >= 0)
			close(pair[1]);
		return -1;
	}
	admission_probe(http, pair[1], tls);
	return pair[0];
}

/* An answer, or the end of the connection. */
static bool answered(int socket, double end)
{
	struct pollfd one = {socket, POLLIN, 0};
	double left = end - clock_monotonic();

	return poll(&one, 1, left > 0 ? (int)(1000 * left) + 1 : 0) > 0;
}

int http_probe(struct http *http, double seconds, struct error *err)
{
	const bool wanted[2] = {http->plain_daemon != NULL, http->tls_daemon != NULL};
	int sockets[PROBES_MAX], count = 0, silent = 0, failed = 0;
	double end = clock_monotonic() + seconds;

	for (int tls = 0; tls < 2; tls++) {
		for (int i = 0; wanted[tls] && i < http->options.threads && count < PROBES_MAX; i++) {
			sockets[count] = probe_begin(http, tls != 0, i);
			failed = sockets[count] < 0 ? errno : failed;
			count += sockets[count] >= 0;
		}
	}
	for (int i = 0; i < count; i++) {
		silent += !answered(sockets[i], end);
		close(sockets[i]);
	}
	admission_forget_probes(http);
	if (silent > 0)
		return error_set(err, ERR_BUSY, "%d of %d threads do not answer within %.1f s", silent, count, seconds);
	/* Out of descriptors is no reason for a new start: there are clients, and they are served. */
	return count > 0 || failed == EMFILE || failed == ENFILE
		   ? 0
		   : error_set_errno(err, failed, "connection of the daemon to itself");
}

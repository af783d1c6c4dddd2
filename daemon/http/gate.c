/*
 * The gate: what libmicrohttpd reads has passed http/framing.c.
 *
 * The library is lenient where proxies are, too, but otherwise: a line that ends
 * with LF alone, a folded field, a blank before the colon, two Hosts ... Whoever
 * reads such a request otherwise than the one before it can be made to see
 * requests in the body of another (request smuggling). Its own refusals are
 * HTML, and what it drops for lack of memory never reaches a handler. It has no
 * hook between the socket and its parser; so this file stands in for recv(2),
 * which the library calls as a function of this program's: a definition in the
 * program goes before the C library's. Other ways were weighed:
 *
 * - checks in the handler come too late, the raw lines are gone by then;
 * - a look at the socket (MSG_PEEK) before the library reads it works for the
 *   first request of a connection, but not for those that follow in its buffer;
 * - a proxy in front on a socket pair copies every byte twice more (and sendfile
 *   no longer reaches the network).
 *
 * Nothing is copied here but an incomplete head: the bytes are read into the
 * library's buffer and looked at in place, of bodies only where they end. The
 * library takes a short count for an emptied socket (edges of epoll), so a count
 * is short only when the socket was empty.
 *
 * A refused head is replaced by one that asks for the refusal (gate_refusal), a
 * body that is refused midway is ended in the form that the library expects; so
 * the answer takes the way of every other, and the connection is closed after it.
 *
 * With TLS the library calls gnutls_record_recv in place of recv, and this file
 * stands in for that in the same way: what is looked at has been decrypted.
 * GnuTLS itself reads the socket by recv, which then passes all on.
 *
 * Should a later library read by other means than these, gate_admits tells: the
 * handler is called for more heads than went through, and refuses all.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>

/* Stand in place of a request whose head was refused; there is no body in the answer to HEAD. */
static const char substitute[] = "GET /refused HTTP/1.1\r\nHost: refused\r\nConnection: close\r\n\r\n";
static const char substitute_head[] = "HEAD /refused HTTP/1.1\r\nHost: refused\r\nConnection: close\r\n\r\n";

/*
 * Which connection has a descriptor; the process has one table of descriptors, and so one of these. An entry is set
 * before the library has the socket, and removed before it closes it.
 */
static _Atomic(struct connection *) *gated;
static size_t gated_count;

int gate_open(struct error *err)
{
	struct rlimit limit;

	if (gated != NULL)
		return 0;
	if (getrlimit(RLIMIT_NOFILE, &limit) != 0)
		return error_set_errno(err, errno, "the limit of descriptors");
	gated_count = limit.rlim_cur < DESCRIPTORS_MAX ? limit.rlim_cur : DESCRIPTORS_MAX;
	gated = calloc(gated_count, sizeof(*gated));
	return gated != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a table of descriptors");
}

bool gate_set(int descriptor, struct connection *connection)
{
	if (descriptor < 0 || (size_t)descriptor >= gated_count)
		return false;
	atomic_store(&gated[descriptor], connection);
	return true;
}

struct connection *gate_find(int descriptor)
{
	return descriptor >= 0 && (size_t)descriptor < gated_count ? atomic_load(&gated[descriptor]) : NULL;
}

/* ---- bytes that wait ---- */

/* The number of held bytes that may go on. */
static size_t waiting(const struct gate *gate)
{
	return gate->passed - gate->given;
}

static size_t give(struct gate *gate, char *to, size_t size)
{
	size_t given = waiting(gate) < size ? waiting(gate) : size;

	memcpy(to, gate->held + gate->given, given);
	gate->given += given;
	if (gate->given == gate->length) {
		free(gate->held);
		gate->held = NULL;
		gate->given = gate->passed = gate->length = gate->room = 0;
	}
	return given;
}

/* Room for so many bytes behind those held; what was given on is dropped. */
static bool make_room(struct gate *gate, size_t more)
{
	char *grown;

	if (gate->given > 0)
		memmove(gate->held, gate->held + gate->given, gate->length - gate->given);
	gate->passed -= gate->given;
	gate->length -= gate->given;
	gate->given = 0;
	if (gate->length + more <= gate->room)
		return true;
	grown = realloc(gate->held, gate->length + more);
	if (grown == NULL)
		return false;
	gate->held = grown;
	gate->room = gate->length + more;
	return true;
}

static bool hold(struct gate *gate, const char *data, size_t size)
{
	if (size == 0)
		return true;
	if (!make_room(gate, size))
		return false;
	memcpy(gate->held + gate->length, data, size);
	gate->length += size;
	return true;
}

/* Drops what was refused, and ends the request in the way that the library waits for. */
static bool end_refused(struct gate *gate)
{
	const char *ending = gate->framing.ending;

	gate->length = gate->passed;
	if (ending[0] == '\0') {
		ending = gate->framing.is_head ? substitute_head : substitute;
		gate->framing.heads++;
	}
	if (!hold(gate, ending, strlen(ending)))
		return false;
	gate->passed = gate->length;
	gate->refused = true;
	return true;
}

/* ---- reading ---- */

enum { HELD_STEP = 4096, RECORD_MAX = 16384 /* bytes in one record of TLS (RFC 8446, 5.1) */ };

/* Where a connection's bytes come from; each read returns as recv does. */
struct source {
	int descriptor;
	gnutls_session_t session; /* NULL: no TLS */
	size_t most;              /* bytes that one read returns at most */
};

static ssize_t source_read(const struct source *source, void *to, size_t size)
{
	unsigned char sequence[8];
	ssize_t got;

	if (source->session == NULL)
		return recvfrom(source->descriptor, to, size, 0, NULL, NULL);
	/* The general form of gnutls_record_recv. */
	got = gnutls_record_recv_seq(source->session, to, size, sequence);
	if (got >= 0)
		return got;
	errno = got == GNUTLS_E_AGAIN ? EAGAIN : got == GNUTLS_E_INTERRUPTED ? EINTR : EIO;
	return -1;
}

/* Reads into `to`, looks at it there, and holds back what may not go on yet. *ret_passed bytes may. */
static ssize_t read_through(struct gate *gate, const struct source *source, char *to, size_t size, size_t *ret_passed)
{
	ssize_t got = source_read(source, to, size);

	*ret_passed = 0;
	if (got <= 0)
		return got;
	*ret_passed = framing_pass(&gate->framing, to, (size_t)got);
	if (!hold(gate, to + *ret_passed, (size_t)got - *ret_passed)) {
		errno = ENOMEM;
		return -1;
	}
	return got;
}

/* The same for what continues an incomplete head: it grows where it is held. */
static ssize_t read_held(struct gate *gate, const struct source *source, size_t size)
{
	ssize_t got;

	if (!make_room(gate, size)) {
		errno = ENOMEM;
		return -1;
	}
	got = source_read(source, gate->held + gate->length, size);
	if (got <= 0)
		return got;
	gate->length += (size_t)got;
	gate->passed += framing_pass(&gate->framing, gate->held + gate->passed, gate->length - gate->passed);
	return got;
}

static ssize_t gate_read(struct gate *gate, const struct source *source, char *to, size_t size)
{
	size_t done = 0, wanted = 0;
	ssize_t got = 0;

	for (;;) {
		size_t passed = 0;

		if (gate->framing.status != 0 && !gate->refused && !end_refused(gate)) {
			errno = ENOMEM;
			return -1;
		}
		if (waiting(gate) > 0)
			done += give(gate, to + done, size - done);
		/*
		 * A short count, or none, tells that the socket is empty. Where nothing goes on, its end may be there
		 * as well, which came with the same edge.
		 */
		if (done == size || got < 0 || (got < (ssize_t)wanted && (done > 0 || got == 0)))
			break;
		if (gate->refused) { /* the connection is closed after the answer */
			errno = EAGAIN;
			got = -1;
			break;
		}
		if (gate->length > 0) {
			wanted = HELD_STEP;
			got = read_held(gate, source, wanted);
		} else {
			got = read_through(gate, source, to + done, size - done, &passed);
			wanted = size - done < source->most ? size - done : source->most;
		}
		done += passed;
	}
	return done > 0 ? (ssize_t)done : got;
}

/* Replaces the C library's recv, of which recvfrom is the general form. */
ssize_t recv(int descriptor, void *to, size_t size, int flags)
{
	struct connection *connection = flags == 0 && size > 0 ? gate_find(descriptor) : NULL;

	if (connection == NULL || connection->tls)
		return recvfrom(descriptor, to, size, flags, NULL, NULL);
	return gate_read(&connection->gate, &(struct source){.descriptor = descriptor, .most = SIZE_MAX}, to, size);
}

/* Replaces GnuTLS's. */
ssize_t gnutls_record_recv(gnutls_session_t session, void *to, size_t size)
{
	struct connection *connection = gate_find(gnutls_transport_get_int(session));
	ssize_t got;

	if (connection == NULL)
		return GNUTLS_E_INVALID_SESSION;
	got = gate_read(&connection->gate, &(struct source){.session = session, .most = RECORD_MAX}, to, size);
	if (got >= 0)
		return got;
	return errno == EAGAIN ? GNUTLS_E_AGAIN : errno == EINTR ? GNUTLS_E_INTERRUPTED : GNUTLS_E_PULL_ERROR;
}

/* ---- what the handler asks ---- */

bool gate_admits(struct connection *connection)
{
	return ++connection->gate.handled <= connection->gate.framing.heads;
}

const struct framing *gate_refusal(const struct connection *connection)
{
	const struct gate *gate = &connection->gate;

	return gate->refused && gate->handled == gate->framing.heads ? &gate->framing : NULL;
}

void gate_free(struct gate *gate)
{
	free(gate->held);
	gate->held = NULL;
}

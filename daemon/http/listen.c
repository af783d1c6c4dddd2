/*
 * Where the daemon listens: loopback addresses and Unix sockets, and others
 * where tokens say who may, and TLS keeps them from being read on the way.
 */
#include "daemon/http/internal.h"
#include "daemon/http/text.h"
#include "daemon/log.h"

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

static const char unix_prefix[] = "unix:";

static bool is_loopback(const struct sockaddr *address)
{
	if (address->sa_family == AF_INET) {
		const struct sockaddr_in *in = (const struct sockaddr_in *)(const void *)address;

		return ntohl(in->sin_addr.s_addr) >> 24 == 127;
	}
	if (address->sa_family == AF_INET6)
		return IN6_IS_ADDR_LOOPBACK(&((const struct sockaddr_in6 *)(const void *)address)->sin6_addr);
	return false;
}

/* Address and name, "http://127.0.0.1:2228", with the port that the kernel chose. */
static int name_socket(struct listener *listener, struct error *err)
{
	struct sockaddr_storage *bound = &listener->address;
	socklen_t length = sizeof(*bound);
	char host[NI_MAXHOST], port[NI_MAXSERV];
	bool six;

	if (getsockname(listener->socket, (struct sockaddr *)bound, &length) != 0)
		return error_set_errno(err, errno, "address of the listening socket");
	if (getnameinfo((struct sockaddr *)bound, length, host, sizeof(host), port, sizeof(port),
			NI_NUMERICHOST | NI_NUMERICSERV) != 0)
		return error_set(err, ERR_IO, "the listening socket's address has no name");
	six = bound->ss_family == AF_INET6;
	snprintf(listener->name, sizeof(listener->name), "http%s://%s%.64s%s:%.8s", listener->tls ? "s" : "",
		 six ? "[" : "", host, six ? "]" : "", port);
	return 0;
}

static int bind_tcp(const struct addrinfo *address, const char *text, struct listener *listener, struct error *err)
{
	int one = 1;

	listener->socket = socket(address->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (listener->socket < 0)
		return error_set_errno(err, errno, "socket for %s", text);
	setsockopt(listener->socket, SOL_SOCKET, SO_REUSEADDR, &one, sizeof(one));
	/* [::] is IPv6 alone; 0.0.0.0 is listened on beside it by who wants both. */
	if (address->ai_family == AF_INET6)
		setsockopt(listener->socket, IPPROTO_IPV6, IPV6_V6ONLY, &one, sizeof(one));
	if (bind(listener->socket, address->ai_addr, address->ai_addrlen) != 0)
		return error_set_errno(err, errno, "listen on %s", text);
	return name_socket(listener, err);
}

/* Checks the guards that an address beyond loopback needs. */
static int check_guards(const char *text, unsigned guards, struct error *err)
{
	if (guards & GUARD_TOKENS && guards & GUARD_TLS)
		return 0;
	return error_set(
	    err, ERR_IMPOSSIBLE,
	    "listen: %s is reached from other machines; without tokens and TLS only loopback addresses and "
	    "Unix sockets are allowed%s%s",
	    text, (guards & GUARD_TOKENS) != 0 ? "" : "; --tokens is not given",
	    (guards & GUARD_TLS) != 0 ? "" : "; --tls-cert is not given");
}

/* ADDR:PORT with a numeric address, [ADDR]:PORT for IPv6, or localhost:PORT. */
static int open_tcp(const char *text, unsigned guards, struct listener *listener, struct error *err)
{
	struct addrinfo hints = {.ai_flags = AI_NUMERICHOST | AI_NUMERICSERV | AI_PASSIVE, .ai_socktype = SOCK_STREAM};
	struct addrinfo *found = NULL;
	const char *colon = strrchr(text, ':'), *address = text;
	char host[80];
	size_t length;
	double port;
	int code;

	if (colon == NULL || colon == text || colon[1] == '\0')
		return error_set(err, ERR_INVALID, "listen: \"%s\" is neither ADDR:PORT nor unix:PATH", text);
	length = (size_t)(colon - text);
	if (text[0] == '[' && text[length - 1] == ']') {
		address++;
		length -= 2;
	}
	snprintf(host, sizeof(host), "%.*s", (int)length, address);
	if (strcmp(host, "localhost") == 0)
		snprintf(host, sizeof(host), "127.0.0.1");
	/* The resolver takes a port modulo 65536. */
	if (!number_parse(colon + 1, 0, 65535, &port) || port != (int)port)
		return error_set(err, ERR_INVALID, "listen: the port of \"%s\" is not between 0 and 65535", text);
	if (getaddrinfo(host, colon + 1, &hints, &found) != 0)
		return error_set(err, ERR_INVALID, "listen: \"%s\" is no numeric address with a port", text);
	listener->tls = (guards & GUARD_TLS) != 0;
	code = is_loopback(found->ai_addr) ? 0 : check_guards(text, guards, err);
	if (code == 0)
		code = bind_tcp(found, text, listener, err);
	freeaddrinfo(found);
	return code;
}

/* A socket file that nobody answers at is left from a daemon that was killed. */
static int remove_stale(const struct sockaddr_un *address, struct error *err)
{
	struct stat status;
	int probe, connected;

	if (lstat(address->sun_path, &status) != 0)
		return 0;
	if (!S_ISSOCK(status.st_mode))
		return error_set(err, ERR_CONFLICT, "listen: %s is there already and no socket", address->sun_path);
	probe = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
	if (probe < 0)
		return error_set_errno(err, errno, "socket");
	connected = connect(probe, (const struct sockaddr *)address, sizeof(*address));
	close(probe);
	if (connected == 0)
		return error_set(err, ERR_CONFLICT, "listen: %s is in use by another process", address->sun_path);
	if (unlink(address->sun_path) != 0 && errno != ENOENT)
		return error_set_errno(err, errno, "remove %s", address->sun_path);
	return 0;
}

static int open_unix(const char *path, unsigned guards, struct listener *listener, struct error *err)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};

	if (path[0] == '\0' || strlen(path) >= sizeof(address.sun_path))
		return error_set(err, ERR_INVALID, "listen: a socket's path has 1 to %zu bytes, not %zu",
				 sizeof(address.sun_path) - 1, strlen(path));
	memcpy(address.sun_path, path, strlen(path));
	if (remove_stale(&address, err) != 0)
		return err->code;
	listener->socket = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (listener->socket < 0)
		return error_set_errno(err, errno, "socket");
	/* The file's mode is who may connect: owner and group, unless each is asked who it is. Nobody can before
	 * listen(2). */
	if (bind(listener->socket, (struct sockaddr *)&address, sizeof(address)) != 0 ||
	    chmod(path, (guards & GUARD_PEERS) != 0 ? 0666 : 0660) != 0)
		return error_set_errno(err, errno, "listen on %s", path);
	snprintf(listener->unix_path, sizeof(listener->unix_path), "%s", path);
	snprintf(listener->name, sizeof(listener->name), "%s%s", unix_prefix, path);
	return 0;
}

/*
 * A socket that the service manager listens on for us: it stays when the daemon ends, and so does its file. Whoever
 * reaches it must be asked as on one of our own.
 */
static int inherit(int descriptor, unsigned guards, struct listener *listener, struct error *err)
{
	struct sockaddr_un path;
	socklen_t length = sizeof(int);
	int type = 0, listens = 0;

	listener->socket = descriptor;
	if (getsockopt(descriptor, SOL_SOCKET, SO_TYPE, &type, &length) != 0 || type != SOCK_STREAM ||
	    getsockopt(descriptor, SOL_SOCKET, SO_ACCEPTCONN, &listens, &length) != 0 || !listens)
		return error_set(err, ERR_INVALID,
				 "descriptor %d of LISTEN_FDS is no stream socket that is listened on", descriptor);
	if (fcntl(descriptor, F_SETFD, FD_CLOEXEC) != 0 || fcntl(descriptor, F_SETFL, O_NONBLOCK) != 0)
		return error_set_errno(err, errno, "descriptor %d of LISTEN_FDS", descriptor);
	length = sizeof(path);
	memset(&path, 0, sizeof(path));
	if (getsockname(descriptor, (struct sockaddr *)&path, &length) == 0 && path.sun_family == AF_UNIX) {
		snprintf(listener->name, sizeof(listener->name), "%s%s", unix_prefix, path.sun_path);
		return 0;
	}
	listener->tls = (guards & GUARD_TLS) != 0;
	if (name_socket(listener, err) != 0)
		return err->code;
	return is_loopback((const struct sockaddr *)&listener->address) ? 0 : check_guards(listener->name, guards, err);
}

/* sd_listen_fds(3): descriptors from 3 on, if they are meant for this process. 0: there are none. */
static int inherited_count(void)
{
	const char *pid = getenv("LISTEN_PID"), *count = getenv("LISTEN_FDS");
	int sockets = pid != NULL && count != NULL && strtol(pid, NULL, 10) == (long)getpid() ? atoi(count) : 0;

	unsetenv("LISTEN_PID");
	unsetenv("LISTEN_FDS");
	unsetenv("LISTEN_FDNAMES");
	return sockets;
}

static int listeners_inherit(int sockets, unsigned guards, struct listener ret_listeners[LISTENERS_MAX], int *ret_count,
			     struct error *err)
{
	enum { FIRST = 3 };

	if (sockets > LISTENERS_MAX)
		return error_set(err, ERR_INVALID, "LISTEN_FDS has %d sockets, at most %d are listened on", sockets,
				 LISTENERS_MAX);
	log_line(LEVEL_INFO, "%d sockets of the service manager take the place of the setting listen", sockets);
	for (int i = 0; i < sockets; i++) {
		memset(&ret_listeners[i], 0, sizeof(ret_listeners[i]));
		if (inherit(FIRST + i, guards, &ret_listeners[i], err) != 0)
			return err->code;
	}
	*ret_count = sockets;
	return 0;
}

int listeners_open(const char *listen_text, unsigned guards, struct listener ret_listeners[LISTENERS_MAX],
		   int *ret_count, struct error *err)
{
	char *copy, *next, *text;
	int count = 0, code = 0, sockets = inherited_count();

	if (sockets > 0)
		return listeners_inherit(sockets, guards, ret_listeners, ret_count, err);
	copy = next = strdup(listen_text);
	if (copy == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for listeners");
	while (code == 0 && (text = strsep(&next, ", ")) != NULL) {
		struct listener *listener = &ret_listeners[count];

		if (text[0] == '\0')
			continue;
		if (count == LISTENERS_MAX) {
			code = error_set(err, ERR_INVALID, "listen: more than %d addresses", LISTENERS_MAX);
			break;
		}
		memset(listener, 0, sizeof(*listener));
		listener->socket = -1;
		count++;
		if (strncmp(text, unix_prefix, sizeof(unix_prefix) - 1) == 0)
			code = open_unix(text + sizeof(unix_prefix) - 1, guards, listener, err);
		else
			code = open_tcp(text, guards, listener, err);
		if (code == 0 && listen(listener->socket, SOMAXCONN) != 0)
			code = error_set_errno(err, errno, "listen on %s", text);
	}
	if (code == 0 && count == 0)
		code = error_set(err, ERR_INVALID, "listen: no address is given");
	free(copy);
	if (code != 0) {
		while (count > 0)
			listener_close(&ret_listeners[--count]);
		return code;
	}
	*ret_count = count;
	return 0;
}

void listener_close(struct listener *listener)
{
	if (listener->unix_path[0] != '\0')
		unlink(listener->unix_path);
	listener->unix_path[0] = '\0';
	if (listener->socket >= 0)
		close(listener->socket);
	listener->socket = -1;
}

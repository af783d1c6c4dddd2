/*
 * Host and Origin: whether this daemon is addressed, and by the page of which site.
 *
 * Listening on loopback keeps other machines out, but not the pages of other
 * sites in a browser on this machine. Such a page can resolve a name of its own
 * to 127.0.0.1 (DNS rebinding) and then counts as the daemon's own to the
 * browser: only Host still has the foreign name. And it can send requests
 * without seeing the answers (cross-site request forgery): the browser tells
 * by Origin and Sec-Fetch-Site where they come from.
 *
 * X-Forwarded-Host and Forwarded are never read: anybody can send them. A proxy
 * passes Host on, or sends the listening address.
 */
#include "daemon/http/internal.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <string.h>
#include <strings.h>

#include "daemon/http/text.h"

/* "[::1]" and "127.0.0.1": is that this socket's own address? */
static bool is_address(const struct sockaddr_storage *own, const char *host)
{
	const struct sockaddr_in *four = (const struct sockaddr_in *)(const void *)own;
	const struct sockaddr_in6 *six = (const struct sockaddr_in6 *)(const void *)own;
	struct in6_addr address;
	char literal[HOST_MAX];
	size_t length = strlen(host);

	if (own->ss_family == AF_INET)
		return inet_pton(AF_INET, host, &address) == 1 &&
		       memcmp(&address, &four->sin_addr, sizeof(four->sin_addr)) == 0;
	if (own->ss_family != AF_INET6 || host[0] != '[')
		return false;
	memcpy(literal, host + 1, length - 1);
	literal[length - 2] = '\0';
	return inet_pton(AF_INET6, literal, &address) == 1 && memcmp(&address, &six->sin6_addr, sizeof(address)) == 0;
}

/* The next name of the list, moved behind it; false at its end. */
static bool next_name(const char **list, const char **ret_name, size_t *ret_length)
{
	*list += strspn(*list, ", ");
	*ret_name = *list;
	*ret_length = strcspn(*list, ", ");
	*list += *ret_length;
	return *ret_length > 0;
}

static bool is_configured(const struct http *http, const char *host)
{
	const char *list = http->options.server_names, *name;
	size_t length;

	while (next_name(&list, &name, &length)) {
		if (length == strlen(host) && strncasecmp(name, host, length) == 0)
			return true;
	}
	return false;
}

int server_names_check(const char *names, struct error *err)
{
	char host[HOST_MAX];
	const char *name;
	size_t length;
	long port;

	while (next_name(&names, &name, &length)) {
		if (!authority_parse(name, length, host, &port) || strlen(host) != length)
			return error_set(err, ERR_INVALID, "server-name: \"%.*s\" is no host's name without a port",
					 (int)length, name);
	}
	return 0;
}

/* No page reaches a Unix socket: a browser cannot open one. */
static bool is_ours(const struct request *request, const char *host)
{
	const struct http *http = request->http;
	struct sockaddr_storage own;
	socklen_t size = sizeof(own);

	if (request->connection->address.ss_family == AF_UNIX || strcmp(host, "localhost") == 0 ||
	    is_configured(http, host))
		return true;
	for (int i = 0; i < http->listener_count; i++) {
		if (is_address(&http->listeners[i].address, host))
			return true;
	}
	/* A daemon that listens on all addresses is reached by each. */
	return getsockname(request->connection->socket, (struct sockaddr *)&own, &size) == 0 && is_address(&own, host);
}

static bool is_safe(const struct request *request)
{
	return strcmp(request->method, "GET") == 0 || request_is_head(request) ||
	       strcmp(request->method, "OPTIONS") == 0;
}

/* The page that asks is the daemon's own: at the address that Host has, or at a configured name behind a proxy. */
static bool is_own_page(const struct request *request, const char *origin, const char *host, long port)
{
	char page[HOST_MAX];
	long page_port;

	/* The network may have changed a page that came without TLS: it is another origin then. */
	if (!origin_parse(origin, page, &page_port) ||
	    (request->connection->tls && strncasecmp(origin, "https:", 6) != 0))
		return false;
	if (is_configured(request->http, page))
		return true;
	if (port < 0)
		port = strncasecmp(origin, "https:", 6) == 0 ? 443 : 80;
	return strcmp(page, host) == 0 && page_port == port;
}

int request_check_origin(struct request *request, struct error *err)
{
	const char *text = request_header(request, "Host"), *origin = request_header(request, "Origin");
	const char *site = request_header(request, "Sec-Fetch-Site");
	char host[HOST_MAX] = "";
	long port = -1;

	/* HTTP/1.0 has no Host, and no browser speaks it. */
	if (text != NULL && !authority_parse(text, strlen(text), host, &port) &&
	    (text[0] != '\0' || request->connection->address.ss_family != AF_UNIX))
		return error_set(err, ERR_INVALID, "Host is \"%.80s\", expected a name or an address, and a port",
				 text);
	if (text != NULL && !is_ours(request, host))
		return request_reply_problem(request, "misdirected", err,
					     "Host is \"%.80s\", which is neither an address that is listened on, nor "
					     "localhost, nor a name that --server-name gives",
					     text);
	if (is_safe(request))
		return 0;
	if (origin != NULL && !is_own_page(request, origin, host, port))
		return request_reply_problem(request, "foreign-origin", err,
					     "%s from a page of \"%.80s\" (Origin), this is %.80s", request->method,
					     origin, text != NULL ? text : "another");
	if (site != NULL && strcasecmp(site, "cross-site") == 0)
		return request_reply_problem(request, "foreign-origin", err,
					     "%s from a page of another site (Sec-Fetch-Site)", request->method);
	return 0;
}

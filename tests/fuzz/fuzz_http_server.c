/*
 * Any bytes on a connection to the server itself, with the library that speaks HTTP and what reads Host, Origin,
 * targets, queries, Authorization, cookies and conditions: each connection ends, no request meets an internal error,
 * and nobody reads or changes what wants a role without showing the token, whose text the seeds have.
 */
#include <errno.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "daemon/http/http.h"
#include "daemon/log.h"
#include "tests/fuzz/fuzz.h"

enum { REPLY_MOST = 1 << 20, PATIENCE = 10000 /* ms */ };
static const char token[] = "the-token", secret[] = "[what only some may read]", etag[] = "\"tag\"";
static struct http *http;
static atomic_bool served; /* a route that wants a role */
static char folder[64], path[128];

/* ---- the routes ---- */

static int reply(struct request *request, const char *text, struct error *err)
{
	return request_reply_constant(request, 200, text, strlen(text), err);
}

static int get_secret(void *context, struct request *request, struct error *err)
{
	const char *range = request_header(request, "Range"), *wait = request_query(request, "wait");
	const size_t length = strlen(secret);
	uint64_t first = 0, count = length;
	double seconds = 0;

	served = true;
	(void)context;
	if (etag_in(request_header(request, "If-None-Match"), etag, true))
		return request_reply_empty(request, 304, err);
	if (wait != NULL && !number_parse(wait, 0, 300, &seconds))
		return error_set(err, ERR_INVALID, "wait is no number");
	(void)prefer_wait(request_header(request, "Prefer"), &seconds);
	if (range_parse(range, length, &first, &count) == RANGE_OUTSIDE)
		return request_reply_problem(request, "range-outside", err, "of %zu bytes", length);
	PROMISE(first + count <= length);
	return reply(request, secret, err);
}

static int get_public(void *context, struct request *request, struct error *err)
{
	(void)context;
	PROMISE(request_argument(request, 0)[0] != '\0');
	return reply(request, "public", err);
}

static int post_secret(void *context, struct request *request, struct error *err)
{
	size_t length = 0;
	const char *body = request_body(request, &length);

	served = true;
	(void)context;
	if (!media_type_is_json(request_header(request, "Content-Type")))
		return error_set(err, ERR_INVALID, "no JSON");
	PROMISE(body[length] == '\0');
	return reply(request, secret, err);
}

static int put_begin(void *context, struct request *request, struct error *err)
{
	uint8_t digest[32];
	bool given;

	served = true;
	(void)context;
	PROMISE(request_identity(request)->role >= ROLE_ACQUIRE);
	return content_digest_parse(request_header(request, "Content-Digest"), &given, digest, err);
}

static int put_data(void *context, struct request *request, const void *data, size_t size, size_t *ret_taken,
		    struct error *err)
{
	(void)context;
	(void)request;
	(void)data;
	(void)err;
	*ret_taken = size;
	return 0;
}

static int put_secret(void *context, struct request *request, struct error *err)
{
	(void)context;
	return reply(request, secret, err);
}

static int post_session(void *context, struct request *request, struct error *err)
{
	served = true;
	(void)context;
	if (request_reply_empty(request, 204, err) != 0)
		return err->code;
	return request_session_open(request, err);
}

static int delete_session(void *context, struct request *request, struct error *err)
{
	(void)context;
	if (request_reply_empty(request, 204, err) != 0)
		return err->code;
	request_session_close(request);
	return 0;
}

static const struct route routes[] = {
    {"GET", "/public/{}", ROLE_ANYONE, get_public, BODY_NONE, 0, NULL, NULL, "a b"},
    {"GET", "/secret", ROLE_VIEW, get_secret, BODY_NONE, 0, NULL, NULL, "wait index"},
    {"POST", "/secret", ROLE_ACQUIRE, post_secret, BODY_WHOLE, 4096, NULL, NULL, NULL},
    {"PUT", "/secret/{}/{flat}", ROLE_ACQUIRE, put_secret, BODY_STREAM, 0, put_begin, put_data, NULL},
    {"POST", "/session", ROLE_VIEW, post_session, BODY_WHOLE, 100, NULL, NULL, NULL},
    {"DELETE", "/session", ROLE_ANYONE, delete_session, BODY_NONE, 0, NULL, NULL, NULL},
    {0},
};

/* ---- the server ---- */

static void write_tokens(const char *file)
{
	struct token row = {.name = "arm", .role = ROLE_ADMIN, .expires = TOKEN_NEVER};
	char line[TOKEN_LINE_MAX];
	FILE *to = fopen(file, "w");

	PROMISE(EVP_Digest(token, strlen(token), row.sha256, NULL, EVP_sha256(), NULL) == 1);
	token_print(&row, line);
	PROMISE(to != NULL && fputs(line, to) >= 0 && fclose(to) == 0 && chmod(file, 0600) == 0);
}

static void start(void)
{
	static char listen[160], tokens[128], audit[128];
	struct http_options options = {.listen = listen,
				       .server_names = "cart",
				       .state_dir = folder,
				       .tokens = tokens,
				       .audit = audit,
				       .audit_bytes = 1 << 20,
				       .audit_files = 1,
				       .unix_roles = "",
				       .tls_certificate = "",
				       .tls_key = "",
				       .tls_client_authorities = "",
				       .routes = routes,
				       .threads = 2,
				       .max_connections = 100,
				       .max_connections_per_address = 100,
				       .header_timeout = 0.2,
				       .transfer_grace = 1,
				       .minimum_rate = 1};
	struct error err = {0};

	snprintf(folder, sizeof(folder), "/dev/shm/fuzz-http.XXXXXX");
	PROMISE(mkdtemp(folder) != NULL);
	snprintf(path, sizeof(path), "%s/socket", folder);
	snprintf(listen, sizeof(listen), "unix:%s", path);
	snprintf(tokens, sizeof(tokens), "%s/tokens", folder);
	snprintf(audit, sizeof(audit), "%s/audit", folder);
	write_tokens(tokens);
	log_set_level(LEVEL_ERROR);
	PROMISE(http_new(&options, &http, &err) == 0 && http_start(http, &err) == 0);
}

static void visit(void *context, const struct http_traffic *traffic)
{
	(void)context;
	PROMISE(traffic->status != 500);
}

/* What the server says to these bytes, until it closes. */
static size_t exchange(const uint8_t *data, size_t size, char *ret_reply)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	const int client = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
	size_t sent = 0, length = 0;
	ssize_t got = 1;
	int ready;

	memcpy(address.sun_path, path, strlen(path));
	PROMISE(client >= 0 && connect(client, (const struct sockaddr *)&address, sizeof(address)) == 0);
	while (got > 0 && length < REPLY_MOST) {
		struct pollfd wait = {.fd = client, .events = POLLIN};

		if (sent < size) {
			got = send(client, data + sent, size - sent, MSG_DONTWAIT | MSG_NOSIGNAL);
			sent = got > 0 ? sent + (size_t)got : size; /* a full buffer: the server is not interested */
			if (sent == size)
				shutdown(client, SHUT_WR);
			got = 1;
			continue;
		}
		/* libFuzzer's own timer interrupts it every 11 s. */
		do
			ready = poll(&wait, 1, PATIENCE);
		while (ready < 0 && errno == EINTR);
		PROMISE(ready == 1); /* else it hangs */
		got = recv(client, ret_reply + length, REPLY_MOST - length, 0);
		length += got > 0 ? (size_t)got : 0;
	}
	close(client);
	return length;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static char *said;
	size_t length;

	if (said == NULL) {
		said = malloc(REPLY_MOST);
		PROMISE(said != NULL);
		start();
	}
	if (size == 0)
		return 0;
	served = false;
	length = exchange(data, size, said);
	PROMISE(length == 0 || (length > 9 && memcmp(said, "HTTP/1.", 7) == 0));
	http_traffic(http, visit, NULL);
	if (served)
		PROMISE(memmem(data, size, token, strlen(token)) != NULL);
	return 0;
}

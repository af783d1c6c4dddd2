/*
 * The gate of access: finds the role of a client and holds it against the route.
 *
 * Without a file of tokens everybody who reaches the daemon may do everything:
 * it listens on loopback and Unix sockets only (http/listen.c). With one, a
 * request shows a token (RFC 6750), or the cookie of a session that a token
 * opened. A cookie holds random bits of its own, never the token; the daemon
 * has the SHA-256 of them, and asks the table of tokens again at each request,
 * so that a token that expires or is revoked takes its sessions along. On a
 * Unix socket the kernel tells whose process asks, which may be enough.
 *
 * A cookie is sent by the browser whoever asks it to. Two things keep pages of
 * other sites from using it: SameSite=Strict, and the rules of http/origin.c.
 */
#include "daemon/http/internal.h"

#include <arpa/inet.h>
#include <errno.h>
#include <grp.h>
#include <limits.h>
#include <pwd.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/random.h>
#include <time.h>

#include <openssl/crypto.h>
#include <openssl/evp.h>

#include "daemon/http/text.h"
#include "daemon/lock.h"
#include "daemon/log.h"

const char *const proof_names[PROOF_COUNT] = {
    [PROOF_NONE] = "none",       [PROOF_NOT_ASKED] = "not asked",     [PROOF_TOKEN] = "token",
    [PROOF_SESSION] = "session", [PROOF_CERTIFICATE] = "certificate", [PROOF_PEER] = "peer",
};

enum { SESSIONS_MAX = 1024, SESSIONS_OF_TOKEN = 16, PEER_RULES_MAX = 64, GROUPS_MAX = 1024 };
static const double session_seconds = 12 * 3600; /* a working day */
/*
 * Cookies are a host's, whatever the port (RFC 6265, 8.5): the name has the port, so that the daemons of one host do
 * not overwrite each other's.
 */
static const char session_cookie[] = "cbctd_session";
enum { COOKIE_NAME_MAX = 40 };

/* Guarded by access.lock. */
struct session {
	uint8_t cookie[TOKEN_DIGEST_BYTES]; /* SHA-256 of the cookie's value */
	uint8_t token[TOKEN_DIGEST_BYTES];  /* of the token that opened it */
	double ends;                        /* clock_monotonic; 0: free */
};

/* A role for a user or group on Unix sockets, without a token. */
struct peer_rule {
	bool group; /* otherwise a user */
	unsigned id;
	enum role role;
};

struct access {
	const char *path; /* "": there are no tokens */
	struct peer_rule rules[PEER_RULES_MAX];
	int rule_count;              /* constant */
	_Atomic unsigned generation; /* of the tokens: grows when they are read again */
	pthread_mutex_t lock;
	struct tokens tokens; /* guarded by lock, as is all below */
	struct session sessions[SESSIONS_MAX];
};

/* ---- life ---- */

/* "user:acq=acquire", "group:1000=view". The names are looked up once, at the start. */
static int rule_parse(char *text, struct peer_rule *ret_rule, struct error *err)
{
	char *kind = strsep(&text, ":"), *name = text != NULL ? strsep(&text, "=") : NULL;
	struct peer_rule rule = {.group = strcmp(kind, "group") == 0,
				 .role = text != NULL ? role_parse(text) : ROLE_UNSAID};
	const struct passwd *user = NULL;
	const struct group *group = NULL;
	long id;

	if ((!rule.group && strcmp(kind, "user") != 0) || rule.role == ROLE_UNSAID)
		return error_set(err, ERR_INVALID,
				 "unix-role: expected user:NAME=ROLE or group:NAME=ROLE, and view, "
				 "acquire or admin as its role");
	if (rule.group)
		group = getgrnam(name);
	else
		user = getpwnam(name);
	if (group != NULL)
		rule.id = group->gr_gid;
	else if (user != NULL)
		rule.id = user->pw_uid;
	else if (index_parse(name, strlen(name), INT_MAX, &id))
		rule.id = (unsigned)id;
	else
		return error_set(err, ERR_INVALID, "unix-role: there is no %s \"%.60s\"", kind, name);
	*ret_rule = rule;
	return 0;
}

static int rules_parse(struct access *access, const char *list, struct error *err)
{
	char *copy = strdup(list), *next = copy, *text;
	int code = 0;

	if (copy == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for roles");
	while (code == 0 && (text = strsep(&next, ", ")) != NULL) {
		if (text[0] == '\0')
			continue;
		if (access->rule_count == PEER_RULES_MAX)
			code = error_set(err, ERR_INVALID, "unix-role: more than %d", PEER_RULES_MAX);
		else
			code = rule_parse(text, &access->rules[access->rule_count++], err);
	}
	free(copy);
	return code;
}

int access_new(const struct http_options *options, struct access **ret_access, struct error *err)
{
	struct access *access = calloc(1, sizeof(*access));

	if (access == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for tokens");
	access->path = options->tokens;
	if (rules_parse(access, options->unix_roles, err) != 0 ||
	    (access_has_tokens(access) && tokens_read(access->path, &access->tokens, err) != 0)) {
		free(access);
		return err->code;
	}
	lock_init(&access->lock, LOCK_ACCESS);
	*ret_access = access;
	return 0;
}

void access_free(struct access *access)
{
	if (access == NULL)
		return;
	pthread_mutex_destroy(&access->lock);
	tokens_clear(&access->tokens);
	free(access);
}

bool access_has_tokens(const struct access *access)
{
	return access->path[0] != '\0';
}

bool access_has_peers(const struct access *access)
{
	return access->rule_count > 0;
}

bool access_is_asked(const struct access *access)
{
	return access_has_tokens(access) || access_has_peers(access);
}

enum role access_peer_role(const struct access *access, int socket, const struct ucred *peer)
{
	enum role highest = ROLE_ANYONE;
	gid_t groups[GROUPS_MAX];
	socklen_t size = sizeof(groups);

	if (access->rule_count == 0)
		return highest;
	if (getsockopt(socket, SOL_SOCKET, SO_PEERGROUPS, groups, &size) != 0)
		size = 0; /* an older kernel, or more groups than anybody has */
	for (int i = 0; i < access->rule_count; i++) {
		const struct peer_rule *rule = &access->rules[i];
		bool fits = rule->group ? rule->id == peer->gid : rule->id == peer->uid;

		for (size_t g = 0; rule->group && g < size / sizeof(*groups); g++)
			fits = fits || rule->id == groups[g];
		if (fits && rule->role > highest)
			highest = rule->role;
	}
	return highest;
}

int access_reload(struct access *access, struct error *err)
{
	struct tokens fresh, old;

	if (!access_has_tokens(access))
		return 0;
	if (tokens_read(access->path, &fresh, err) != 0)
		return err->code;
	pthread_mutex_lock(&access->lock);
	old = access->tokens;
	access->tokens = fresh;
	pthread_mutex_unlock(&access->lock);
	atomic_fetch_add(&access->generation, 1);
	tokens_clear(&old);
	log_line(LEVEL_INFO, "%d tokens in %s", fresh.count, access->path);
	return 0;
}

/* Every route says who may; 0 when one does not. */
int access_check_routes(const struct route *routes, struct error *err)
{
	for (; routes->method != NULL; routes++) {
		if (routes->role <= ROLE_UNSAID || routes->role >= ROLE_COUNT)
			return error_set(err, ERR_INTERNAL, "%s %s does not say which role may", routes->method,
					 routes->path);
	}
	return 0;
}

/* ---- what a request shows ---- */

static bool digest_text(const char *text, uint8_t ret_sha256[TOKEN_DIGEST_BYTES])
{
	return EVP_Digest(text, strlen(text), ret_sha256, NULL, EVP_sha256(), NULL) == 1;
}

/* False where the row is missing or its time is over. */
static bool take(const struct token *token, enum proof proof, struct identity *ret)
{
	if (token == NULL || !token_is_valid(token, time(NULL)))
		return false;
	snprintf(ret->name, sizeof(ret->name), "%s", token->name);
	ret->role = token->role;
	ret->expires = token->expires;
	ret->proof = proof;
	memcpy(ret->token, token->sha256, sizeof(ret->token));
	return true;
}

static bool find_token(struct access *access, const char *text, struct identity *ret)
{
	uint8_t sha256[TOKEN_DIGEST_BYTES];
	bool found;

	if (!digest_text(text, sha256))
		return false;
	pthread_mutex_lock(&access->lock);
	found = take(tokens_find(&access->tokens, sha256), PROOF_TOKEN, ret);
	pthread_mutex_unlock(&access->lock);
	return found;
}

/* With the lock held. */
static struct session *session_find(struct access *access, const char *cookie)
{
	uint8_t sha256[TOKEN_DIGEST_BYTES];
	struct session *found = NULL;
	double now = clock_monotonic();

	if (cookie == NULL || !digest_text(cookie, sha256))
		return NULL;
	for (int i = 0; i < SESSIONS_MAX; i++) {
		struct session *session = &access->sessions[i];

		if (now < session->ends && CRYPTO_memcmp(session->cookie, sha256, sizeof(sha256)) == 0)
			found = session;
	}
	return found;
}

/* "cbctd_session_2228", the port as the browser has it, which may be a proxy's; without a port no more than the name.
 */
static const char *cookie_name(struct request *request, char ret_name[COOKIE_NAME_MAX])
{
	const char *authority = request_header(request, "Host");
	char host[HOST_MAX];
	long port = -1;

	if (authority == NULL || !authority_parse(authority, strlen(authority), host, &port) || port < 0)
		snprintf(ret_name, COOKIE_NAME_MAX, "%s", session_cookie);
	else
		snprintf(ret_name, COOKIE_NAME_MAX, "%s_%ld", session_cookie, port);
	return ret_name;
}

static const char *cookie_value(struct request *request)
{
	char name[COOKIE_NAME_MAX];

	return MHD_lookup_connection_value(request->mhd, MHD_COOKIE_KIND, cookie_name(request, name));
}

static bool find_session(struct access *access, const char *cookie, struct identity *ret)
{
	const struct session *session;
	bool found;

	pthread_mutex_lock(&access->lock);
	session = session_find(access, cookie);
	found = session != NULL && take(tokens_find(&access->tokens, session->token), PROOF_SESSION, ret);
	pthread_mutex_unlock(&access->lock);
	return found;
}

static bool find_certificate(struct access *access, const char *name, struct identity *ret)
{
	bool found;

	pthread_mutex_lock(&access->lock);
	found = take(tokens_find_certificate(&access->tokens, name), PROOF_CERTIFICATE, ret);
	pthread_mutex_unlock(&access->lock);
	return found;
}

enum shown { SHOWN_NOTHING, SHOWN_BAD, SHOWN_GOOD };

static enum shown read_authorization(struct request *request, struct identity *ret)
{
	static const char scheme[] = "Bearer ";
	const char *text = request_header(request, "Authorization"); /* one at most: http/framing.c */

	if (text == NULL)
		return SHOWN_NOTHING;
	if (strncasecmp(text, scheme, sizeof(scheme) - 1) != 0)
		return SHOWN_BAD;
	text += sizeof(scheme) - 1;
	text += strspn(text, " ");
	return text[0] != '\0' && find_token(request->http->access, text, ret) ? SHOWN_GOOD : SHOWN_BAD;
}

static enum shown read_proof(struct request *request, struct identity *ret)
{
	enum shown shown = read_authorization(request, ret);
	const char *cookie;

	if (shown != SHOWN_NOTHING)
		return shown;
	cookie = cookie_value(request);
	if (request->connection->peer_role > ROLE_ANYONE) {
		*ret = (struct identity){
		    .role = request->connection->peer_role, .expires = TOKEN_NEVER, .proof = PROOF_PEER};
		snprintf(ret->name, sizeof(ret->name), "uid-%u", (unsigned)request->connection->user);
		return SHOWN_GOOD;
	}
	if (find_certificate(request->http->access, tls_peer_name(request->connection), ret) ||
	    find_session(request->http->access, cookie, ret))
		return SHOWN_GOOD;
	return SHOWN_NOTHING;
}

/* ---- refusals ---- */

static int refuse_unknown(struct request *request, enum shown shown, struct error *err)
{
	bool bad = shown == SHOWN_BAD;

	if (request_reply_problem(request, "unauthorized", err, "%s",
				  bad ? "Authorization has no token that is valid here"
				      : "a token is wanted: Authorization: Bearer TOKEN") != 0)
		return err->code;
	request_reply_header(request, "WWW-Authenticate", "Bearer realm=\"cbctd\"%s",
			     bad ? ", error=\"invalid_token\"" : "");
	return 0;
}

static int refuse_role(struct request *request, enum role least, struct error *err)
{
	if (request_reply_problem(request, "forbidden", err, "%s has the role %s, %s is wanted", request->who.name,
				  role_names[request->who.role], role_names[least]) != 0)
		return err->code;
	request_reply_header(request, "WWW-Authenticate",
			     "Bearer realm=\"cbctd\", error=\"insufficient_scope\", scope=\"%s\"", role_names[least]);
	return 0;
}

int request_require(struct request *request, enum role least, struct error *err)
{
	if (request->who.role >= least)
		return 0;
	return request->who.role == ROLE_ANYONE ? refuse_unknown(request, SHOWN_NOTHING, err)
						: refuse_role(request, least, err);
}

/* For the clock, which ends what goes on for longer than that. */
static void note_identity(struct request *request)
{
	pthread_mutex_lock(&request->connection->lock);
	request->connection->who = request->who;
	pthread_mutex_unlock(&request->connection->lock);
}

int access_check(struct request *request, struct error *err)
{
	enum role least = request->route->role;
	enum shown shown;

	if (!access_is_asked(request->http->access)) {
		request->who = (struct identity){.role = ROLE_ADMIN, .expires = TOKEN_NEVER, .proof = PROOF_NOT_ASKED};
		return 0;
	}
	request->who = (struct identity){.role = ROLE_ANYONE, .expires = TOKEN_NEVER};
	request->who_generation = atomic_load(&request->http->access->generation);
	shown = read_proof(request, &request->who);
	note_identity(request);
	/* Probes and the page itself do not fail for a token that is old. */
	if (shown == SHOWN_BAD && least > ROLE_ANYONE)
		return refuse_unknown(request, shown, err);
	return request_require(request, least, err);
}

bool access_still_holds(struct access *access, const struct identity *who)
{
	const struct token *token;
	bool holds;

	if (who->proof != PROOF_TOKEN && who->proof != PROOF_SESSION && who->proof != PROOF_CERTIFICATE)
		return true;
	pthread_mutex_lock(&access->lock);
	if (who->proof == PROOF_CERTIFICATE)
		token = tokens_find_certificate(&access->tokens, who->name);
	else
		token = tokens_find(&access->tokens, who->token);
	holds = token != NULL && token_is_valid(token, time(NULL)) && token->role >= who->role;
	pthread_mutex_unlock(&access->lock);
	return holds;
}

int access_confirm(struct request *request, struct error *err)
{
	struct access *access = request->http->access;
	const unsigned generation = atomic_load(&access->generation);

	if (request->who.proof <= PROOF_NOT_ASKED ||
	    (generation == request->who_generation && time(NULL) < request->who.expires))
		return 0;
	if (!access_still_holds(access, &request->who))
		return refuse_unknown(request, SHOWN_BAD, err);
	request->who_generation = generation;
	return 0;
}

const struct identity *request_identity(const struct request *request)
{
	return &request->who;
}

static bool is_loopback(const struct sockaddr_storage *address)
{
	if (address->ss_family == AF_INET)
		return ntohl(((const struct sockaddr_in *)(const void *)address)->sin_addr.s_addr) >> 24 == 127;
	return address->ss_family == AF_INET6 &&
	       IN6_IS_ADDR_LOOPBACK(&((const struct sockaddr_in6 *)(const void *)address)->sin6_addr);
}

void request_client(const struct request *request, char ret_client[CLIENT_SIZE])
{
	const struct connection *connection = request->connection;
	const struct sockaddr_storage *address = &connection->address;
	char text[INET6_ADDRSTRLEN] = "nobody";

	if (request->who.name[0] != '\0') {
		snprintf(ret_client, CLIENT_SIZE, "%s", request->who.name);
		return;
	}
	if (address->ss_family == AF_UNIX)
		snprintf(text, sizeof(text), "uid-%u", (unsigned)connection->user);
	else if (is_loopback(address)) /* whoever is on this machine may take any of its addresses */
		snprintf(text, sizeof(text), "127.0.0.1");
	else if (address->ss_family == AF_INET)
		inet_ntop(AF_INET, &((const struct sockaddr_in *)(const void *)address)->sin_addr, text, sizeof(text));
	else if (address->ss_family == AF_INET6)
		inet_ntop(AF_INET6, &((const struct sockaddr_in6 *)(const void *)address)->sin6_addr, text,
			  sizeof(text));
	snprintf(ret_client, CLIENT_SIZE, "%s", text);
}

/* ---- sessions ---- */

/*
 * A place that is free. Who opens more than SESSIONS_OF_TOKEN loses the oldest of its own; only where hundreds of
 * tokens have filled the table does somebody lose another's. With the lock held.
 */
static struct session *session_place(struct access *access, const uint8_t token[TOKEN_DIGEST_BYTES])
{
	struct session *oldest = &access->sessions[0], *own = NULL;
	double now = clock_monotonic();
	int count = 0;

	for (int i = 0; i < SESSIONS_MAX; i++) {
		struct session *session = &access->sessions[i];

		if (session->ends < oldest->ends)
			oldest = session;
		if (now < session->ends && memcmp(session->token, token, TOKEN_DIGEST_BYTES) == 0) {
			count++;
			own = own == NULL || session->ends < own->ends ? session : own;
		}
	}
	return count >= SESSIONS_OF_TOKEN ? own : oldest;
}

static void set_cookie(struct request *request, const char *value, double seconds)
{
	char name[COOKIE_NAME_MAX];

	request_reply_header(request, "Set-Cookie", "%s=%s; Path=/; Max-Age=%.0f; HttpOnly; SameSite=Strict%s",
			     cookie_name(request, name), value, seconds, request->connection->tls ? "; Secure" : "");
}

int request_session_open(struct request *request, struct error *err)
{
	struct access *access = request->http->access;
	uint8_t random[TOKEN_DIGEST_BYTES];
	struct session fresh = {.ends = clock_monotonic() + session_seconds};
	char value[TOKEN_TEXT_SIZE];

	if (getrandom(random, sizeof(random), 0) != (ssize_t)sizeof(random))
		return error_set_errno(err, errno, "random bits for a session");
	token_text(random, value);
	if (!digest_text(value, fresh.cookie))
		return error_set(err, ERR_NO_MEMORY, "the digest of a session cannot be made");
	memcpy(fresh.token, request->who.token, sizeof(fresh.token));
	pthread_mutex_lock(&access->lock);
	*session_place(access, fresh.token) = fresh;
	pthread_mutex_unlock(&access->lock);
	set_cookie(request, value, session_seconds);
	return 0;
}

void request_session_close(struct request *request)
{
	struct access *access = request->http->access;
	const char *cookie = cookie_value(request);
	struct session *session;

	pthread_mutex_lock(&access->lock);
	session = session_find(access, cookie);
	if (session != NULL)
		*session = (struct session){.ends = 0};
	pthread_mutex_unlock(&access->lock);
	set_cookie(request, "", 0);
}

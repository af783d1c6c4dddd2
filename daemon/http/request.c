/*
 * A request line and its headers: target, query, framing, route.
 *
 * The target is read from the line as it was sent: the library decodes %2F
 * before anybody has looked for slashes. That the head can be read in one way
 * only is the gate's doing (http/framing.h).
 */
#include "daemon/http/internal.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "daemon/http/text.h"
#include "proto/json.h"

static const uint64_t drop_max = 1ull << 30; /* a body that is read to its end only to give an answer */

struct request *request_new(struct http *http, struct connection *connection, const char *target)
{
	struct request *request = calloc(1, sizeof(*request));

	if (request == NULL)
		return NULL;
	request->http = http;
	request->connection = connection;
	request->mhd = connection->mhd;
	request->started = clock_monotonic();
	request->wait_until = INFINITY;
	request->target = strdup(target);
	request->decoded = strdup(target);
	snprintf(request->id, sizeof(request->id), "%08" PRIx32 "-%llx", http->id_prefix,
		 atomic_fetch_add(&http->request_number, 1) + 1);
	if (request->target == NULL || request->decoded == NULL) {
		request_free(request);
		return NULL;
	}
	return request;
}

void request_free(struct request *request)
{
	if (request == NULL)
		return;
	if (request->state_free != NULL)
		request->state_free(request->state);
	if (request->response != NULL)
		MHD_destroy_response(request->response);
	atomic_fetch_sub(&request->http->bodies, request->body_room);
	free(request->body);
	free(request->target);
	free(request->decoded);
	free(request);
}

/* ---- the target ---- */

/* What stands in documents is UTF-8, and so is what they are searched for, and what a refusal repeats. */
static bool decode_query(char *text)
{
	return percent_decode(text, true) && utf8_valid(text);
}

static bool read_query(struct request *request, char *text)
{
	char *pair;

	while ((pair = strsep(&text, "&")) != NULL) {
		char *value = strchr(pair, '=');

		if (pair[0] == '\0')
			continue;
		if (value != NULL)
			*value++ = '\0';
		if (request->query_count == QUERIES_MAX || !decode_query(pair) ||
		    (value != NULL && !decode_query(value)))
			return false;
		request->queries[request->query_count].name = pair;
		request->queries[request->query_count++].value = value != NULL ? value : "";
	}
	return true;
}

/* Segments of the path, decoded; -1 for a bad escape. */
static int read_path(char *path, char *segments[SEGMENTS_MAX])
{
	int count = 0;
	char *segment;

	if (path[0] != '/')
		return -1;
	path++;
	while ((segment = strsep(&path, "/")) != NULL) {
		if (!percent_decode(segment, false))
			return -1;
		if (count == SEGMENTS_MAX)
			return count + 1; /* longer than any route */
		segments[count++] = segment;
	}
	return count;
}

/* Does the pattern "/v1/scans/{}" have these segments? Fills the arguments. */
static bool path_matches(const char *pattern, char *const segments[], int count, const char *arguments[ARGUMENTS_MAX])
{
	int used = 0;

	for (int i = 0; i < count; i++) {
		size_t length;

		if (*pattern++ != '/')
			return false;
		length = strcspn(pattern, "/");
		if (length == 2 && memcmp(pattern, "{}", 2) == 0) {
			if (segments[i][0] == '\0')
				return false;
			arguments[used++] = segments[i];
		} else if (*pattern == '{') {
			if (strlen(segments[i]) != length - 2 || memcmp(pattern + 1, segments[i], length - 2) != 0)
				return false;
			arguments[used++] = segments[i];
		} else if (strlen(segments[i]) != length || memcmp(pattern, segments[i], length) != 0) {
			return false;
		}
		pattern += length;
	}
	return *pattern == '\0';
}

static void allow_add(char *allow, size_t size, const char *method)
{
	size_t length = strlen(allow);

	snprintf(allow + length, size - length, "%s%s", length > 0 ? ", " : "", method);
	if (strcmp(method, "GET") == 0)
		allow_add(allow, size, "HEAD");
}

static int find_route(struct request *request, char *const segments[], int count, struct error *err)
{
	const char *method = request_is_head(request) ? "GET" : request->method;
	char allow[64] = "";

	for (const struct route *route = request->http->options.routes; route->method != NULL; route++) {
		const char *arguments[ARGUMENTS_MAX] = {"", "", "", ""};

		if (count > SEGMENTS_MAX || !path_matches(route->path, segments, count, arguments))
			continue;
		if (strcmp(route->method, method) == 0) {
			request->route = route;
			memcpy(request->arguments, arguments, sizeof(arguments));
			return 0;
		}
		allow_add(allow, sizeof(allow), route->method);
	}
	if (allow[0] == '\0')
		return error_set(err, ERR_NOT_FOUND, "there is nothing at %.200s", request->target);
	if (request_reply_problem(request, "method-not-allowed", err, "%s is not for this resource; allowed: %s",
				  request->method, allow) != 0)
		return err->code;
	request_reply_header(request, "Allow", "%s", allow);
	return 0;
}

static int read_target(struct request *request, struct error *err)
{
	char *path = request->decoded, *query, *segments[SEGMENTS_MAX];
	int count;

	if (path[0] != '/' && strstr(path, "://") != NULL) /* the absolute form, as for a proxy */
		path = strstr(path, "://") + 3 + strcspn(strstr(path, "://") + 3, "/");
	query = strchr(path, '?');
	if (query != NULL)
		*query++ = '\0';
	if (query != NULL && !read_query(request, query))
		return error_set(err, ERR_INVALID,
				 "the query has a bad %%-escape, text that is no UTF-8, or more than %d parameters",
				 QUERIES_MAX);
	count = read_path(path, segments);
	if (count < 0)
		return error_set(err, ERR_INVALID, "the path has a bad %%-escape or does not begin with /");
	return find_route(request, segments, count, err);
}

static bool is_listed(const char *names, const char *name)
{
	const size_t length = strlen(name);

	while (names != NULL && *names != '\0') {
		const size_t one = strcspn(names, " ");

		if (one == length && memcmp(names, name, one) == 0)
			return true;
		names += one + strspn(names + one, " ");
	}
	return false;
}

/* A misspelt parameter must not be taken for its default in silence: whoever asks for ?typ=int16 wants no float32. */
static int check_queries(const struct request *request, struct error *err)
{
	const char *known = request->route->queries;

	for (int i = 0; i < request->query_count; i++) {
		const char *name = request->queries[i].name;

		if (!is_listed(known, name))
			return error_set(err, ERR_INVALID,
					 "\"%.60s\" is no query parameter of this resource; known: %s", name,
					 known != NULL ? known : "none");
		for (int j = 0; j < i; j++)
			if (strcmp(request->queries[j].name, name) == 0)
				return error_set(err, ERR_INVALID, "the query parameter %.60s is given twice", name);
	}
	return 0;
}

/* ---- framing ---- */

/* The gate has let it through: there is one statement about the body, and it is well-formed. */
static void read_framing(struct request *request)
{
	const char *length = request_header(request, "Content-Length");

	request->chunked = request_header(request, "Transfer-Encoding") != NULL;
	request->framed = request->chunked || length != NULL;
	request->content_length = request->chunked ? -1 : length != NULL ? strtoll(length, NULL, 10) : 0;
}

/* Answers a request that the gate has refused: the library saw another head, or a body end that nobody sent. */
int request_refuse(struct request *request, struct error *err)
{
	static const struct {
		int status;
		const char *name;
	} names[] = {
	    {400, "invalid"}, {413, "too-large"}, {414, "target-too-long"}, {431, "head-too-large"}, {505, "version"}};
	const struct framing *refusal = gate_refusal(request->connection);
	const char *name = names[0].name;

	for (size_t i = 0; i < sizeof(names) / sizeof(*names); i++) {
		if (names[i].status == refusal->status)
			name = names[i].name;
	}
	request->close = true;
	return request_reply_problem(request, name, err, "%s", refusal->detail);
}

/*
 * A page of another site may send plain text and forms without being asked
 * first; JSON it may not. So what changes something comes as JSON or without a
 * body, but for streams of samples: those need PUT, which is asked for as well.
 */
static bool must_be_json(const struct request *request)
{
	bool has_body = request->chunked || request->content_length > 0;

	if (request->route->body == BODY_NONE)
		return has_body && strcmp(request->route->method, "GET") != 0;
	return request->route->body == BODY_WHOLE && request->framed;
}

static int check_body(struct request *request, struct error *err)
{
	const struct route *route = request->route;
	const char *encoding = request_header(request, "Content-Encoding"),
		   *type = request_header(request, "Content-Type");

	if (strcmp(request->method, "PUT") == 0 && request_header(request, "Content-Range") != NULL)
		return error_set(err, ERR_INVALID,
				 "Content-Range is \"%.60s\", but a PUT sends the whole (RFC 9110, 14.5)",
				 request_header(request, "Content-Range"));
	if (must_be_json(request) && !media_type_is_json(type))
		return request_reply_problem(
		    request, "unsupported-media-type", err, "Content-Type is %s%.60s%s, expected application/json",
		    type != NULL ? "\"" : "", type != NULL ? type : "not given", type != NULL ? "\"" : "");
	if (route->body == BODY_WHOLE && encoding != NULL && strcasecmp(encoding, "identity") != 0)
		return request_reply_problem(request, "unsupported-encoding", err,
					     "Content-Encoding is \"%.40s\", a document comes as it is", encoding);
	if (route->body != BODY_NONE && !request->framed)
		return request_reply_problem(request, "length-required", err,
					     "neither Content-Length nor Transfer-Encoding tells of a body");
	if (route->body == BODY_WHOLE && request->content_length > (int64_t)route->body_max)
		return error_set(err, ERR_TOO_LARGE, "the body has %" PRId64 " bytes, at most %zu are accepted",
				 request->content_length, route->body_max);
	return route->begin != NULL ? route->begin(request->http->options.context, request, err) : 0;
}

static int refuse_connection(struct request *request, struct error *err)
{
	int status = request->connection->refused;

	request->close = true;
	return request_reply_problem(
	    request, status == 429 ? "too-many-connections" : "busy", err, "%ld connections%s are open already",
	    status == 429 ? request->http->options.max_connections_per_address : request->http->options.max_connections,
	    status == 429 ? " of this address" : "");
}

/* A refused body is read and dropped, so that the client comes to reading the answer; unless it waits for our word. */
static bool should_drop(struct request *request)
{
	if (request->close || MHD_lookup_connection_value(request->mhd, MHD_HEADER_KIND, "Expect") != NULL)
		return false;
	if (request->status == 401 || request->status == 403)
		return request->chunked || request->content_length <= REFUSED_DROP_MOST;
	return request->chunked || (uint64_t)request->content_length <= drop_max;
}

/* Beyond the limit only what writes is taken: acquisition. */
static bool is_one_too_many(const struct request *request)
{
	return request->connection->refused != 0 && !admission_reconsider(request->connection) &&
	       strcmp(request->method, "PUT") != 0 && strcmp(request->method, "POST") != 0;
}

static int read_header(struct request *request, struct error *err)
{
	int code = 0;

	if (gate_refusal(request->connection) != NULL)
		return request_refuse(request, err);
	read_framing(request);
	if (is_one_too_many(request))
		return refuse_connection(request, err);
	if (atomic_load(&request->http->stopping))
		return error_set(err, ERR_BUSY, "the daemon is stopping");
	code = request_check_origin(request, err);
	if (code == 0 && request->response == NULL)
		code = read_target(request, err);
	if (code == 0 && request->response == NULL)
		code = access_check(request, err);
	if (code == 0 && request->response == NULL)
		code = check_queries(request, err);
	if (code == 0 && request->response == NULL)
		code = check_body(request, err);
	return code;
}

/* ---- whose request it is in other systems' logs ---- */

/* Text that is safe in a log and a header: nothing that ends a field, and not much of it. */
static void read_request_id(struct request *request)
{
	static const char allowed[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._-";
	const char *given = request_header(request, "X-Request-Id");
	size_t length = given != NULL ? strlen(given) : 0;

	if (length > 0 && length < sizeof(request->id) && strspn(given, allowed) == length)
		memcpy(request->id, given, length + 1);
}

static bool is_hex(const char *text, size_t length)
{
	return strspn(text, "0123456789abcdef") >= length;
}

/*
 * W3C Trace Context, 3.2: "00-TRACE-PARENT-FLAGS" of 2, 32, 16 and 2 lower-case hexadecimal digits; a version that
 * comes later may have more behind them. Neither id is all zeros.
 */
static void read_trace(struct request *request)
{
	enum { TRACE = 3, PARENT = 36, FLAGS = 53, LENGTH = 55 };
	const char *given = request_header(request, "traceparent");
	size_t length = given != NULL ? strlen(given) : 0;

	if (length < LENGTH || (length > LENGTH && (memcmp(given, "00", 2) == 0 || given[LENGTH] != '-')) ||
	    memcmp(given, "ff", 2) == 0 || given[TRACE - 1] != '-' || given[PARENT - 1] != '-' ||
	    given[FLAGS - 1] != '-' || !is_hex(given, 2) || !is_hex(given + TRACE, 32) || !is_hex(given + PARENT, 16) ||
	    !is_hex(given + FLAGS, 2) || strspn(given + TRACE, "0") >= 32 || strspn(given + PARENT, "0") >= 16)
		return;
	snprintf(request->trace, sizeof(request->trace), "%.32s", given + TRACE);
	snprintf(request->trace_parent, sizeof(request->trace_parent), "%.55s", given);
}

void request_reply_ids(struct request *request)
{
	request_reply_header(request, "X-Request-Id", "%s", request->id);
	if (request->trace_parent[0] != '\0')
		request_reply_header(request, "traceparent", "%s", request->trace_parent);
}

int request_read_header(struct request *request, const char *method, struct error *err)
{
	int code;

	snprintf(request->method, sizeof(request->method), "%s", method);
	if (gate_refusal(request->connection) == NULL) {
		read_request_id(request);
		read_trace(request);
	}
	code = read_header(request, err);
	if (code != 0)
		code = reply_problem_of(request, err);
	request->dropping = request->response != NULL && should_drop(request);
	return code;
}

/* ---- what handlers ask ---- */

const char *request_id(const struct request *request)
{
	return request->id;
}

const char *request_target(const struct request *request)
{
	return request->target;
}

const char *request_argument(const struct request *request, int i)
{
	return request->arguments[i];
}

const char *request_query(const struct request *request, const char *name)
{
	for (int i = 0; i < request->query_count; i++) {
		if (strcmp(request->queries[i].name, name) == 0)
			return request->queries[i].value;
	}
	return NULL;
}

const char *request_header(struct request *request, const char *name)
{
	return MHD_lookup_connection_value(request->mhd, MHD_HEADER_KIND, name);
}

/* A name that is sought in all lines of Accept-Encoding, and the first weight that one of them gives to it. */
struct sought {
	const char *coding;
	double weight;
};

static enum MHD_Result seek_coding(void *context, enum MHD_ValueKind kind, const char *name, const char *value)
{
	struct sought *sought = context;

	(void)kind;
	if (value != NULL && sought->weight < 0 && strcasecmp(name, "Accept-Encoding") == 0)
		sought->weight = coding_weight(value, sought->coding);
	return MHD_YES;
}

/* Negative where no line names it. */
static double weight_of(struct request *request, const char *coding)
{
	struct sought sought = {.coding = coding, .weight = -1};

	MHD_get_connection_values(request->mhd, MHD_HEADER_KIND, seek_coding, &sought);
	return sought.weight;
}

static double weight_of_plain(struct request *request)
{
	const double weight = weight_of(request, "identity");

	return weight >= 0 ? weight : weight_of(request, "*");
}

bool request_prefers_coding(struct request *request, const char *coding)
{
	const double weight = weight_of(request, coding), plain = weight_of_plain(request);

	return weight >= 0 ? weight > 0 && weight >= plain : plain >= 0 && weight_of(request, "*") > plain;
}

bool request_takes_plain(struct request *request)
{
	return weight_of_plain(request) != 0;
}

bool request_is_head(const struct request *request)
{
	return strcmp(request->method, "HEAD") == 0;
}

int64_t request_content_length(const struct request *request)
{
	return request->content_length;
}

const char *request_body(const struct request *request, size_t *ret_length)
{
	*ret_length = request->body_length;
	return request->body != NULL ? request->body : "";
}

void request_made(struct request *request, const char *id)
{
	snprintf(request->made, sizeof(request->made), "%s", id);
}

void request_set_state(struct request *request, void *state, void (*state_free)(void *state))
{
	request->state = state;
	request->state_free = state_free;
}

void *request_state(const struct request *request)
{
	return request->state;
}

void request_wait_until(struct request *request, double time)
{
	request->wait_until = time;
}

bool request_replied(const struct request *request)
{
	return request->response != NULL;
}

bool request_stopping(const struct request *request)
{
	return atomic_load(&request->http->stopping);
}

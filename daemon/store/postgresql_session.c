/*
 * Every value crosses in PostgreSQL's binary form: integers and doubles in network order. Texts of ours are UTF-8, but
 * for sentences that were cut off: what is no UTF-8 becomes '?'.
 */
#include "daemon/store/postgresql_session.h"

#include <assert.h>
#include <dlfcn.h>
#include <endian.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/clock.h"

/* Types of results: pg_type.dat of PostgreSQL, which never changes these numbers. */
enum { OID_BOOL = 16, OID_BYTES = 17, OID_INT8 = 20, OID_INT4 = 23, OID_FLOAT8 = 701 };
enum { SERVER_LEAST = 120000 };

/*
 * libpq, loaded when a catalogue is in PostgreSQL: a daemon that keeps its own pays nothing for it, and its package
 * does not depend on it.
 */
/* clang-format off */
#define FUNCTIONS(X) \
	X(PQbackendPID) \
	X(PQclear) \
	X(PQcmdStatus) \
	X(PQconnectdbParams) \
	X(PQconninfoFree) \
	X(PQconninfoParse) \
	X(PQconsumeInput) \
	X(PQerrorMessage) \
	X(PQescapeLiteral) \
	X(PQfinish) \
	X(PQflush) \
	X(PQfreemem) \
	X(PQftype) \
	X(PQgetResult) \
	X(PQgetisnull) \
	X(PQgetlength) \
	X(PQgetvalue) \
	X(PQisBusy) \
	X(PQnfields) \
	X(PQnotifies) \
	X(PQntuples) \
	X(PQparameterStatus) \
	X(PQresultErrorField) \
	X(PQresultStatus) \
	X(PQsendPrepare) \
	X(PQsendQuery) \
	X(PQsendQueryParams) \
	X(PQsendQueryPrepared) \
	X(PQserverVersion) \
	X(PQsetNoticeReceiver) \
	X(PQsetnonblocking) \
	X(PQsocket) \
	X(PQstatus)
/* clang-format on */
static struct {
#define MEMBER(name) __typeof__(name) *name;
	FUNCTIONS(MEMBER)
#undef MEMBER
} pq;

static pthread_once_t loaded = PTHREAD_ONCE_INIT;
static char load_failure[160];

static void load(void)
{
	void *library = dlopen("libpq.so.5", RTLD_NOW | RTLD_LOCAL);

	if (library == NULL) {
		snprintf(load_failure, sizeof(load_failure), "%.159s", dlerror());
		return;
	}
#define LOOK_UP(name)                                                                                                  \
	*(void **)(void *)&pq.name = dlsym(library, #name);                                                            \
	if (pq.name == NULL)                                                                                           \
		snprintf(load_failure, sizeof(load_failure), "libpq.so.5 has no %s", #name);
	FUNCTIONS(LOOK_UP)
#undef LOOK_UP
}

static int load_library(struct error *err)
{
	pthread_once(&loaded, load);
	return load_failure[0] == '\0'
		   ? 0
		   : error_set(err, ERR_INVALID, "a catalogue in PostgreSQL needs libpq (Debian's libpq5): %s",
			       load_failure);
}

/* ---- words of the server ---- */

/* One line; libpq ends its own with a newline, and one for each address that it has tried. */
static void copy_line(char *to, size_t size, const char *from)
{
	size_t length = (size_t)snprintf(to, size, "%s", from);

	length = length < size ? length : size - 1;
	while (length > 0 && to[length - 1] == '\n')
		to[--length] = '\0';
	for (char *at = to; *at != '\0'; at++)
		*at = *at == '\n' || *at == '\t' ? ' ' : *at;
}

int session_away(struct error *err, const char *why)
{
	return error_set(err, ERR_AWAY, "the catalogue's database cannot be reached (%.160s), try again", why);
}

void session_close(struct pg_session *session)
{
	if (session->pg != NULL)
		pq.PQfinish(session->pg);
	session->pg = NULL;
	session->prepared_count = 0;
}

static int lose(struct pg_session *session, const char *why, struct error *err)
{
	char line[160];

	copy_line(line, sizeof(line), why);
	session_close(session);
	return session_away(err, line);
}

static bool is_class(const char *state, const char *class)
{
	return strncmp(state, class, strlen(class)) == 0;
}

/* Only the server's first sentence is told: the others may have values of the row. */
static int statement_error(struct pg_session *session, const PGresult *result, const char *what, struct error *err)
{
	const char *state = pq.PQresultErrorField(result, PG_DIAG_SQLSTATE);
	const char *message = pq.PQresultErrorField(result, PG_DIAG_MESSAGE_PRIMARY);
	char text[200];

	/* The server ends, or has become a copy that only reads. */
	if (state == NULL || pq.PQstatus(session->pg) != CONNECTION_OK || is_class(state, "57P") ||
	    is_class(state, "08") || is_class(state, "25006"))
		return lose(session, message != NULL ? message : pq.PQerrorMessage(session->pg), err);
	snprintf(text, sizeof(text), "%.60s: %.100s (%.5s)", what, message != NULL ? message : "", state);
	if (is_class(state, "53100"))
		return error_set(err, ERR_NO_SPACE, "the disk of the catalogue's database is full (%s)", text);
	if (is_class(state, "53200"))
		return error_set(err, ERR_NO_MEMORY, "catalogue: %s", text);
	if (is_class(state, "23"))
		return error_set(err, ERR_INTERNAL, "catalogue: %s", text);
	if (is_class(state, "40") || is_class(state, "55P03") || is_class(state, "57014"))
		return error_set(err, ERR_BUSY, "the catalogue is held by another program (%s)", text);
	if (is_class(state, "XX"))
		return error_set(err, ERR_DAMAGED, "the catalogue is damaged: %s", text);
	return error_set(err, ERR_IO, "catalogue: %s", text);
}

/* ---- a question and its answer, within the deadline ---- */

/* Waits until the connection's socket can be read, or written while something is to be sent. False: too long. */
static bool wait_socket(PGconn *pg, bool sending, double until)
{
	struct pollfd fd = {.fd = pq.PQsocket(pg), .events = (short)(POLLIN | (sending ? POLLOUT : 0))};
	double left = (until - clock_monotonic()) * 1000;

	return fd.fd >= 0 && left > 0 && poll(&fd, 1, (int)left + 1) > 0;
}

/*
 * The last result of what was sent, or the first that failed; NULL: the connection is of no more use, *ret_why says
 * why.
 */
static PGresult *take_result(PGconn *pg, double seconds, const char **ret_why)
{
	double until = clock_monotonic() + seconds;
	PGresult *result = NULL, *next;
	int sending = pq.PQflush(pg);

	*ret_why = "the server does not answer in time";
	for (;;) {
		while (sending > 0 || pq.PQisBusy(pg)) {
			if (!wait_socket(pg, sending > 0, until)) {
				pq.PQclear(result);
				return NULL;
			}
			if (pq.PQconsumeInput(pg) == 0 || (sending > 0 && (sending = pq.PQflush(pg)) < 0)) {
				*ret_why = pq.PQerrorMessage(pg);
				pq.PQclear(result);
				return NULL;
			}
		}
		next = pq.PQgetResult(pg);
		if (next == NULL)
			return result;
		if (result != NULL && pq.PQresultStatus(result) == PGRES_FATAL_ERROR) {
			pq.PQclear(next);
			continue;
		}
		pq.PQclear(result);
		result = next;
	}
}

static bool succeeded(const PGresult *result)
{
	return pq.PQresultStatus(result) == PGRES_COMMAND_OK || pq.PQresultStatus(result) == PGRES_TUPLES_OK ||
	       pq.PQresultStatus(result) == PGRES_EMPTY_QUERY;
}

/* The answer to what was sent (sent 0: it could not be); NULL: err is filled. */
static PGresult *answer(struct pg_session *session, int sent, const char *what, struct error *err)
{
	const char *why = pq.PQerrorMessage(session->pg);
	PGresult *result = sent != 0 ? take_result(session->pg, session->timeout, &why) : NULL;

	if (result == NULL) {
		lose(session, why, err);
	} else if (!succeeded(result)) {
		statement_error(session, result, what, err);
		pq.PQclear(result);
		result = NULL;
	}
	return result;
}

int session_execute(struct pg_session *session, const char *sql, char ret_tag[32], struct error *err)
{
	PGresult *result;

	if (session->pg == NULL)
		return session_away(err, "the connection was lost");
	result = answer(session, pq.PQsendQuery(session->pg, sql), sql, err);
	if (result == NULL)
		return err->code;
	if (ret_tag != NULL)
		snprintf(ret_tag, 32, "%s", pq.PQcmdStatus(result));
	pq.PQclear(result);
	return 0;
}

/* ---- values ---- */

/* The length of the UTF-8 character at text[0 .. size), 0 where there is none. */
static size_t character_length(const unsigned char *text, size_t size)
{
	static const struct {
		unsigned char mask, mark;
		unsigned least;
	} forms[] = {{0x80, 0, 0}, {0xe0, 0xc0, 0x80}, {0xf0, 0xe0, 0x800}, {0xf8, 0xf0, 0x10000}};
	unsigned code;
	size_t length = 0;

	while (length < 4 && (text[0] & forms[length].mask) != forms[length].mark)
		length++;
	if (length == 4 || length >= size)
		return 0;
	code = text[0] & (unsigned char)~forms[length].mask;
	for (size_t i = 1; i <= length; i++) {
		if ((text[i] & 0xc0) != 0x80)
			return 0;
		code = code << 6 | (text[i] & 0x3f);
	}
	return code < forms[length].least || code > 0x10ffff || (code >= 0xd800 && code < 0xe000) ? 0 : length + 1;
}

/* NULL: all of the text is UTF-8, or *ret_memory says that there was none; else a copy, which the caller frees. */
static char *clean_text(const char *text, size_t size, bool *ret_memory)
{
	char *copy = NULL;

	*ret_memory = true;
	for (size_t at = 0, length; at < size; at += length) {
		length = character_length((const unsigned char *)text + at, size - at);
		if (length > 0)
			continue;
		length = 1;
		if (copy == NULL)
			copy = strdup(text);
		if (copy == NULL) {
			*ret_memory = false;
			return NULL;
		}
		copy[at] = '?';
	}
	return copy;
}

struct parameters {
	const char *values[PG_VALUES_MAX];
	int lengths[PG_VALUES_MAX], formats[PG_VALUES_MAX];
	uint64_t numbers[PG_VALUES_MAX];
	char *owned[PG_VALUES_MAX];
	int owned_count;
};

static int set_parameter(const struct value *value, int index, struct parameters *parameters, struct error *err)
{
	uint64_t bits = (uint64_t)value->integer;
	const char *text = value->type == VALUE_TEXT || value->type == VALUE_BYTES ? value->bytes : NULL;
	bool memory = true;

	parameters->values[index] = value->type == VALUE_NULL ? NULL : text != NULL ? text : "";
	parameters->lengths[index] = (int)value->size;
	parameters->formats[index] = value->type != VALUE_TEXT;
	if (value->type == VALUE_REAL)
		memcpy(&bits, &value->real, sizeof(bits));
	if (value->type == VALUE_INTEGER || value->type == VALUE_REAL) {
		parameters->numbers[index] = htobe64(bits);
		parameters->values[index] = (const char *)&parameters->numbers[index];
		parameters->lengths[index] = sizeof(bits);
	}
	if (value->type == VALUE_TEXT) {
		char *clean = clean_text(text, value->size, &memory);

		if (clean != NULL)
			parameters->values[index] = parameters->owned[parameters->owned_count++] = clean;
	}
	return memory ? 0 : error_set_errno(err, ENOMEM, "catalogue");
}

static struct value value_of(const PGresult *result, int row, int column)
{
	struct value value = {.type = VALUE_TEXT,
			      .bytes = pq.PQgetvalue(result, row, column),
			      .size = (size_t)pq.PQgetlength(result, row, column)};
	uint64_t bits = 0;
	uint32_t small = 0;

	if (pq.PQgetisnull(result, row, column))
		return (struct value){.type = VALUE_NULL};
	memcpy(&bits, value.bytes, value.size < sizeof(bits) ? value.size : sizeof(bits));
	memcpy(&small, value.bytes, value.size < sizeof(small) ? value.size : sizeof(small));
	bits = be64toh(bits);
	switch (pq.PQftype(result, column)) {
	case OID_BYTES:
		value.type = VALUE_BYTES;
		break;
	case OID_BOOL:
		value = (struct value){.type = VALUE_INTEGER, .integer = *(const char *)value.bytes != 0};
		break;
	case OID_INT8:
		value = (struct value){.type = VALUE_INTEGER, .integer = (long long)bits};
		break;
	case OID_INT4:
		value = (struct value){.type = VALUE_INTEGER, .integer = (int32_t)be32toh(small)};
		break;
	case OID_FLOAT8:
		value.type = VALUE_REAL;
		memcpy(&value.real, &bits, sizeof(value.real));
		break;
	default:
		break;
	}
	return value;
}

static int visit_rows(const PGresult *result, row_function row, void *context, struct error *err)
{
	struct value values[PG_VALUES_MAX];
	int columns = pq.PQnfields(result), code = 0;

	assert(columns <= PG_VALUES_MAX);
	for (int i = 0; i < pq.PQntuples(result) && code >= 0 && row != NULL; i++) {
		for (int j = 0; j < columns; j++)
			values[j] = value_of(result, i, j);
		code = row(context, values, err);
	}
	return code < 0 ? code : 0;
}

/* ---- statements ---- */

static int prepare(struct pg_session *session, const char *sql, char ret_name[16], struct error *err)
{
	PGresult *result;
	int i = 0;

	while (i < session->prepared_count && session->prepared[i] != sql)
		i++;
	snprintf(ret_name, 16, "s%d", i);
	if (i < session->prepared_count)
		return 0;
	assert(i < PG_STATEMENTS_MAX);
	result = answer(session, pq.PQsendPrepare(session->pg, ret_name, sql, 0, NULL), sql, err);
	if (result == NULL)
		return err->code;
	pq.PQclear(result);
	session->prepared[session->prepared_count++] = sql;
	return 0;
}

int session_ask(struct pg_session *session, const char *sql, row_function row, void *context, struct error *err)
{
	PGresult *result;
	int code;

	if (session->pg == NULL)
		return session_away(err, "the connection was lost");
	result = answer(session, pq.PQsendQueryParams(session->pg, sql, 0, NULL, NULL, NULL, NULL, 1), sql, err);
	if (result == NULL)
		return err->code;
	code = visit_rows(result, row, context, err);
	pq.PQclear(result);
	return code;
}

int session_run(struct pg_session *session, const char *sql, const struct value *values, int count, row_function row,
		void *context, struct error *err)
{
	struct parameters parameters;
	PGresult *result = NULL;
	char name[16];
	int code;

	if (session->pg == NULL)
		return session_away(err, "the connection was lost");
	assert(count <= PG_VALUES_MAX);
	parameters.owned_count = 0;
	code = prepare(session, sql, name, err);
	for (int i = 0; i < count && code == 0; i++)
		code = set_parameter(&values[i], i, &parameters, err);
	if (code == 0) {
		result = answer(session,
				pq.PQsendQueryPrepared(session->pg, name, count, parameters.values, parameters.lengths,
						       parameters.formats, 1),
				sql, err);
		code = result == NULL ? err->code : visit_rows(result, row, context, err);
	}
	pq.PQclear(result);
	for (int i = 0; i < parameters.owned_count; i++)
		free(parameters.owned[i]);
	return code;
}

static bool take_notifications(struct pg_session *session)
{
	PGnotify *notification;
	bool some = false;

	while ((notification = pq.PQnotifies(session->pg)) != NULL) {
		some |= notification->extra[0] == '\0' || strcmp(notification->extra, session->listener) == 0;
		pq.PQfreemem(notification);
	}
	return some;
}

int session_wait(struct pg_session *session, int descriptor, double seconds, struct error *err)
{
	const double end = clock_monotonic() + seconds;
	bool done;

	if (session->pg == NULL)
		return session_away(err, "the connection was lost");
	/* Those that came with the answer to another question. */
	done = take_notifications(session);
	while (!done) {
		struct pollfd fds[2] = {{.fd = pq.PQsocket(session->pg), .events = POLLIN},
					{.fd = descriptor, .events = POLLIN}};
		const double left = end - clock_monotonic();
		int ready = poll(fds, 2, left <= 0 ? 0 : (int)(1000 * left) + 1);

		if (ready > 0 && fds[0].revents != 0 && pq.PQconsumeInput(session->pg) == 0)
			return lose(session, pq.PQerrorMessage(session->pg), err);
		done = take_notifications(session) || ready <= 0 || fds[1].revents != 0;
	}
	return 0;
}

int session_quote(struct pg_session *session, const char *text, char *ret_quoted, size_t size, struct error *err)
{
	char *quoted = session->pg == NULL ? NULL : pq.PQescapeLiteral(session->pg, text, strlen(text));
	int code = 0;

	if (quoted == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	if ((size_t)snprintf(ret_quoted, size, "%s", quoted) >= size)
		code = error_set(err, ERR_INVALID, "catalogue: a text of %zu bytes, there is room for %zu",
				 strlen(quoted), size);
	pq.PQfreemem(quoted);
	return code;
}

/* ---- opening ---- */

int session_check(const char *address, struct error *err)
{
	PQconninfoOption *options;
	bool fits;
	int code = load_library(err);

	if (code != 0)
		return code;
	options = pq.PQconninfoParse(address, NULL);
	fits = options != NULL;

	/* A password with a / or @ that is not written %2F or %40 ends up in the host or the port. */
	for (const PQconninfoOption *option = options; fits && option->keyword != NULL; option++) {
		if (option->val != NULL && strcmp(option->keyword, "port") == 0)
			fits = strspn(option->val, "0123456789,") == strlen(option->val);
		else if (option->val != NULL && strcmp(option->keyword, "host") == 0)
			fits = strchr(option->val, '@') == NULL;
	}
	pq.PQconninfoFree(options);
	return fits ? 0
		    : error_set(err, ERR_INVALID,
				"the catalogue's address cannot be read; it is "
				"postgresql://USER@HOST:PORT/DATABASE?NAME=VALUE&..., and in a password "
				"/ ? : @ and %% are written %%2F %%3F %%3A %%40 and %%25");
}

static void ignore_notice(void *context, const PGresult *result)
{
	(void)context;
	(void)result;
}

static int set_up(struct pg_session *session, const char *schema, struct error *err)
{
	char sql[600];

	/* The server finds out itself that a host of ours has gone, and gives its lock to the next one. */
	snprintf(sql, sizeof(sql),
		 "SET client_min_messages = error; SET search_path = %s; SET statement_timeout = 0;"
		 " SET idle_in_transaction_session_timeout = 0; SET lock_timeout = %d;"
		 " SET tcp_keepalives_idle = 10; SET tcp_keepalives_interval = 3; SET tcp_keepalives_count = 3;"
		 " SELECT set_config('synchronous_commit', 'on', false)"
		 " WHERE current_setting('synchronous_commit') = 'off'",
		 schema, (int)(500 * session->timeout));
	return session_execute(session, sql, NULL, err);
}

int session_open(struct pg_session *session, const char *address, const char *name, const char *schema,
		 struct error *err)
{
	static const char encoding[] = "UTF8";
	char seconds[16];
	/* What stands in the address goes before those that come ahead of it. */
	const char *const keys[] = {"connect_timeout",  "keepalives_idle",      "keepalives_interval",
				    "keepalives_count", "target_session_attrs", "dbname",
				    "application_name", "client_encoding",      NULL};
	const char *const values[] = {seconds, "10", "3", "3", "read-write", address, name, encoding, NULL};

	if (load_library(err) != 0)
		return err->code;
	snprintf(seconds, sizeof(seconds), "%.0f", session->timeout < 2 ? 2 : session->timeout);
	session->prepared_count = 0;
	session->pg = pq.PQconnectdbParams(keys, values, 1);
	if (session->pg == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	if (pq.PQstatus(session->pg) != CONNECTION_OK)
		return lose(session, pq.PQerrorMessage(session->pg), err);
	pq.PQsetNoticeReceiver(session->pg, ignore_notice, NULL);
	pq.PQsetnonblocking(session->pg, 1);
	session->process = pq.PQbackendPID(session->pg);
	if (strcmp(pq.PQparameterStatus(session->pg, "server_encoding"), encoding) != 0)
		return error_set(err, ERR_INVALID, "the catalogue's database has the encoding %s; it must be %s",
				 pq.PQparameterStatus(session->pg, "server_encoding"), encoding);
	if (pq.PQserverVersion(session->pg) < SERVER_LEAST)
		return error_set(err, ERR_INVALID, "the catalogue's server is PostgreSQL %d; %d is the least",
				 pq.PQserverVersion(session->pg) / 10000, SERVER_LEAST / 10000);
	return set_up(session, schema, err);
}

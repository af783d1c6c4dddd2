/*
 * Replies, and RFC 9457 problem documents: one table of the problems there are,
 * and which of them an error code becomes.
 */
#include "daemon/http/internal.h"

#include <assert.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "proto/json.h"

/* `name` ends the type, urn:cbctd:problem:NAME: it is stable, clients switch on it. The first of a code is its own. */
static const struct problem {
	int code; /* enum error_code, 0: none stands for it */
	int status;
	const char *name, *title;
} problems[] = {
    {ERR_INVALID, 400, "invalid", "The request is malformed"},
    {ERR_IMPOSSIBLE, 422, "impossible", "The request is well-formed, but cannot be done"},
    {ERR_NOT_FOUND, 404, "not-found", "There is no such thing"},
    {ERR_CONFLICT, 409, "conflict", "The request contradicts what is there"},
    {ERR_TOO_LARGE, 413, "too-large", "The body is longer than allowed"},
    {ERR_NO_MEMORY, 503, "no-memory", "Memory ran out"},
    {ERR_NO_SPACE, 507, "no-space", "The disk is full"},
    {ERR_IO, 500, "io", "Reading or writing failed"},
    {ERR_SYNC, 500, "sync", "The disk failed"},
    {ERR_DEVICE, 500, "device", "The accelerator failed"},
    {ERR_CANCELLED, 503, "cancelled", "The request was given up"},
    {ERR_BUSY, 503, "busy", "Not just now"},
    {ERR_INTERNAL, 500, "internal", "The daemon broke a promise of its own"},
    {ERR_DAMAGED, 500, "damaged", "The disk has damaged what was stored"},
    {0, 403, "foreign-origin", "A page of another site may not do this"},
    {0, 405, "method-not-allowed", "The resource does not know this method"},
    {0, 411, "length-required", "The request needs a body"},
    {0, 414, "target-too-long", "The request's target is longer than allowed"},
    {0, 415, "unsupported-encoding", "The body's encoding is not known"},
    {0, 415, "unsupported-media-type", "The body is of another type"},
    {0, 416, "range-outside", "The range lies outside of the body"},
    {0, 421, "misdirected", "The request is for another server"},
    {0, 431, "head-too-large", "The request's head is longer than allowed"},
    {0, 505, "version", "The request is in another version of HTTP"},
    {0, 429, "too-many-connections", "Too many connections from this address"},
};
enum { PROBLEM_COUNT = sizeof(problems) / sizeof(problems[0]) };

static const struct problem *problem_of_code(int code)
{
	for (int i = 0; i < PROBLEM_COUNT; i++) {
		if (problems[i].code == code && code != 0)
			return &problems[i];
	}
	return problem_of_code(ERR_INTERNAL);
}

static const struct problem *problem_named(const char *name)
{
	for (int i = 0; i < PROBLEM_COUNT; i++) {
		if (strcmp(problems[i].name, name) == 0)
			return &problems[i];
	}
	assert(!"a row of problems[]");
	return problem_of_code(ERR_INTERNAL);
}

/* ---- bodies ---- */

static int set_response(struct request *request, int status, struct MHD_Response *response, uint64_t size,
			struct error *err)
{
	if (response == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a reply");
	assert(request->response == NULL);
	request->response = response;
	request->status = status;
	request->response_size = size;
	request_reply_header(request, "X-Request-Id", "%s", request->id);
	return 0;
}

int request_reply_bytes(struct request *request, int status, void *data, size_t length, struct error *err)
{
	struct MHD_Response *response =
	    data != NULL ? MHD_create_response_from_buffer(length, data, MHD_RESPMEM_MUST_FREE) : NULL;

	if (response == NULL)
		free(data);
	return set_response(request, status, response, length, err);
}

int request_reply_text(struct request *request, int status, const char *media_type, char *text, size_t length,
		       struct error *err)
{
	if (request_reply_bytes(request, status, text, length, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Type", "%s", media_type);
	request_reply_header(request, "Cache-Control", "no-store");
	return 0;
}

static int reply_json(struct request *request, int status, const char *media_type, cJSON *value, struct error *err)
{
	size_t length = 0;
	char *text = value != NULL ? json_print(value, &length) : NULL;

	cJSON_Delete(value);
	return request_reply_text(request, status, media_type, text, length, err);
}

int request_reply_json(struct request *request, int status, cJSON *value, struct error *err)
{
	return reply_json(request, status, "application/json", value, err);
}

int request_reply_empty(struct request *request, int status, struct error *err)
{
	char nothing[] = "";

	return set_response(request, status, MHD_create_response_from_buffer(0, nothing, MHD_RESPMEM_MUST_COPY), 0,
			    err);
}

int request_reply_constant(struct request *request, int status, const void *data, size_t length, struct error *err)
{
	/* The library never writes to what is persistent. */
	return set_response(request, status,
			    MHD_create_response_from_buffer(length, (void *)(uintptr_t)data, MHD_RESPMEM_PERSISTENT),
			    length, err);
}

int request_reply_file(struct request *request, int status, int descriptor, uint64_t offset, uint64_t size,
		       struct error *err)
{
	struct MHD_Response *response = MHD_create_response_from_fd_at_offset64(size, descriptor, offset);

	if (response == NULL)
		close(descriptor);
	return set_response(request, status, response, size, err);
}

struct reader {
	ssize_t (*read)(void *context, uint64_t offset, void *to, size_t size);
	void *context;
	void (*context_free)(void *context);
};

static ssize_t reader_read(void *context, uint64_t offset, char *to, size_t size)
{
	struct reader *reader = context;
	ssize_t got = reader->read(reader->context, offset, to, size);

	if (got == 0)
		return MHD_CONTENT_READER_END_OF_STREAM;
	return got > 0 ? got : MHD_CONTENT_READER_END_WITH_ERROR;
}

static void reader_free(void *context)
{
	struct reader *reader = context;

	if (reader->context_free != NULL)
		reader->context_free(reader->context);
	free(reader);
}

int request_reply_read(struct request *request, int status, uint64_t size,
		       ssize_t (*read)(void *context, uint64_t offset, void *to, size_t size), void *context,
		       void (*context_free)(void *context), struct error *err)
{
	enum { BLOCK = 256 << 10 }; /* fits the second-level cache beside what it is made from */
	struct reader *reader = malloc(sizeof(*reader));
	struct MHD_Response *response;

	if (reader == NULL) {
		if (context_free != NULL)
			context_free(context);
		return error_set(err, ERR_NO_MEMORY, "no memory for a reply");
	}
	*reader = (struct reader){read, context, context_free};
	response = MHD_create_response_from_callback(size == UNKNOWN_SIZE ? MHD_SIZE_UNKNOWN : size, BLOCK, reader_read,
						     reader, reader_free);
	if (response == NULL)
		reader_free(reader);
	return set_response(request, status, response, size, err);
}

void request_reply_header(struct request *request, const char *name, const char *format, ...)
{
	char value[512];
	va_list args;

	va_start(args, format);
	vsnprintf(value, sizeof(value), format, args);
	va_end(args);
	if (request->response != NULL)
		MHD_add_response_header(request->response, name, value);
}

/* ---- problems ---- */

static int reply_problem(struct request *request, const struct problem *problem, const char *detail,
			 const char *pointer, struct error *err)
{
	cJSON *value = cJSON_CreateObject();
	char type[64];

	snprintf(type, sizeof(type), "urn:cbctd:problem:%s", problem->name);
	cJSON_AddStringToObject(value, "type", type);
	cJSON_AddStringToObject(value, "title", problem->title);
	cJSON_AddNumberToObject(value, "status", problem->status);
	cJSON_AddStringToObject(value, "detail", detail);
	if (pointer[0] != '\0')
		cJSON_AddStringToObject(value, "pointer", pointer);
	cJSON_AddStringToObject(value, "request_id", request->id);
	if (reply_json(request, problem->status, "application/problem+json", value, err) != 0)
		return err->code;
	if (problem->status == 503)
		request_reply_header(request, "Retry-After", "1");
	if (problem->status == 507) /* somebody has to make room first */
		request_reply_header(request, "Retry-After", "30");
	return 0;
}

int reply_problem_of(struct request *request, const struct error *err)
{
	const struct problem *problem = problem_of_code(err->code);
	char detail[sizeof(err->text)];
	struct error unable;

	/* What the daemon is to blame for is for its operator: clients do not see paths. */
	if (problem->status >= 500 && problem->status != 503)
		log_line(LEVEL_WARNING, "request id=%s: %s", request->id, err->text);
	snprintf(detail, sizeof(detail), "%s", err->text);
	path_hide(detail, request->http->options.state_dir);

	if (request->response != NULL) { /* it failed after it had begun to answer */
		MHD_destroy_response(request->response);
		request->response = NULL;
	}
	return reply_problem(request, problem, detail, err->pointer, &unable);
}

int request_reply_problem(struct request *request, const char *name, struct error *err, const char *format, ...)
{
	char detail[sizeof(err->text)];
	va_list args;

	va_start(args, format);
	vsnprintf(detail, sizeof(detail), format, args);
	va_end(args);
	return reply_problem(request, problem_named(name), detail, "", err);
}

bool reply_send(struct request *request)
{
	uint64_t size = request_is_head(request) ? 0 : request->response_size;
	enum MHD_Result queued;

	if (request->close || atomic_load(&request->http->stopping))
		request_reply_header(request, "Connection", "close");
	connection_phase(request->connection, PHASE_SEND, size);
	queued = MHD_queue_response(request->mhd, (unsigned)request->status, request->response);
	MHD_destroy_response(request->response);
	request->response = NULL;
	return queued == MHD_YES;
}

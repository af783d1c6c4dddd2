/* Replies, RFC 9457 problem documents among them. */
#include "daemon/http/internal.h"

#include <assert.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/problem.h"
#include "proto/json.h"

/* ---- bodies ---- */

/*
 * A reply to HEAD, and a 304, has no body. Where nobody knows how long the body would be, libmicrohttpd 0.9.75
 * announces chunks and sends the last of them, which the client takes for the beginning of the next reply. Without
 * chunks such a reply ends with its connection.
 */
static void end_with_connection(struct request *request)
{
	MHD_set_response_options(request->response, MHD_RF_HTTP_1_0_COMPATIBLE_STRICT, MHD_RO_END);
	request->close = true;
}

int reply_set(struct request *request, int status, struct MHD_Response *response, uint64_t size, struct error *err)
{
	if (response == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a reply");
	assert(request->response == NULL);
	request->response = response;
	request->status = status;
	request->response_size = size;
	if (size == UNKNOWN_SIZE && (status == 304 || request_is_head(request)))
		end_with_connection(request);
	request_reply_ids(request);
	return 0;
}

int request_reply_bytes(struct request *request, int status, void *data, size_t length, struct error *err)
{
	struct MHD_Response *response =
	    data != NULL ? MHD_create_response_from_buffer(length, data, MHD_RESPMEM_MUST_FREE) : NULL;

	if (response == NULL)
		free(data);
	return reply_set(request, status, response, length, err);
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
	char *text = json_print(value, &length);

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

	return reply_set(request, status, MHD_create_response_from_buffer(0, nothing, MHD_RESPMEM_MUST_COPY), 0, err);
}

int request_reply_constant(struct request *request, int status, const void *data, size_t length, struct error *err)
{
	/* The library never writes to what is persistent. */
	return reply_set(request, status,
			 MHD_create_response_from_buffer(length, (void *)(uintptr_t)data, MHD_RESPMEM_PERSISTENT),
			 length, err);
}

int request_reply_file(struct request *request, int status, int descriptor, uint64_t offset, uint64_t size,
		       struct error *err)
{
	struct MHD_Response *response = MHD_create_response_from_fd_at_offset64(size, descriptor, offset);

	if (response == NULL)
		close(descriptor);
	return reply_set(request, status, response, size, err);
}

struct reader {
	struct request *request;
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
	if (got > 0) {
		reader->request->sent += (uint64_t)got;
		connection_made(reader->request->connection, (uint64_t)got);
	}
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
	*reader = (struct reader){request, read, context, context_free};
	response = MHD_create_response_from_callback(size == UNKNOWN_SIZE ? MHD_SIZE_UNKNOWN : size, BLOCK, reader_read,
						     reader, reader_free);
	if (response == NULL)
		reader_free(reader);
	return reply_set(request, status, response, size, err);
}

void request_reply_header(struct request *request, const char *name, const char *format, ...)
{
	char value[512];
	va_list args;

	va_start(args, format);
	vsnprintf(value, sizeof(value), format, args);
	va_end(args);
	if (request->response != NULL && MHD_add_response_header(request->response, name, value) != MHD_YES)
		request->header_lost = true;
}

/* ---- problems ---- */

static int reply_problem(struct request *request, const struct problem *problem, const char *detail,
			 const char *pointer, struct error *err)
{
	cJSON *value = cJSON_CreateObject();

	problem_add_type(value, problem);
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
	if (problem->status == 429)
		request_reply_header(request, "Retry-After", "5");
	if (problem->status == 507) /* somebody has to make room first */
		request_reply_header(request, "Retry-After", "30");
	return 0;
}

int reply_problem_of(struct request *request, const struct error *why)
{
	const struct http_options *options = &request->http->options;
	struct error told = *why, *err = &told, unable;
	const struct problem *problem;
	char detail[sizeof(err->text)];

	if (err->code == ERR_NOT_FOUND && options->missing != NULL && request->route != NULL &&
	    options->missing(options->context, request, err))
		return 0;
	problem = problem_of_code(err->code);

	/* Failures of the daemon itself are for its operator: clients do not see paths. */
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
	/* Who asks again gets all of it; a reply without one of its headers may mean another thing. */
	queued = request->header_lost ? MHD_NO
				      : MHD_queue_response(request->mhd, (unsigned)request->status, request->response);
	MHD_destroy_response(request->response);
	request->response = NULL;
	return queued == MHD_YES;
}

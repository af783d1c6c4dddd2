/*
 * Messages between daemon and worker. One table says which members each kind
 * has; writing and reading both follow it, so that they cannot disagree. Numbers
 * that are not finite cross as null and come back as NaN.
 */
#include "proto/message.h"

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

#include "proto/clock.h"
#include "proto/json.h"

/* ---- the table ---- */

enum field_type {
	FIELD_STRING,
	FIELD_INT,
	FIELD_NUMBER,
	FIELD_SIZE,
	FIELD_BOOL,
	FIELD_STAGE,
	FIELD_RULE,
	FIELD_BITS,
	FIELD_GRID,
	FIELD_REQUEST
};

struct field {
	const char *name;
	enum field_type type;
	size_t offset, size;
};

#define FIELD(name, type, member)                                                                                      \
	{                                                                                                              \
		name, type, offsetof(struct message, member), sizeof(((struct message *)0)->member)                    \
	}

static const struct field start_fields[] = {FIELD("job", FIELD_STRING, job),
					    FIELD("scan_directory", FIELD_STRING, scan_directory),
					    FIELD("job_directory", FIELD_STRING, job_directory),
					    FIELD("request", FIELD_REQUEST, request),
					    FIELD("iteration", FIELD_INT, iteration),
					    FIELD("checkpoint_seconds", FIELD_NUMBER, checkpoint_seconds),
					    FIELD("cards", FIELD_STRING, cards),
					    FIELD("reference", FIELD_STRING, reference),
					    FIELD("grid", FIELD_GRID, grid),
					    FIELD("arriving", FIELD_BOOL, arriving),
					    FIELD("reduced", FIELD_BOOL, reduced),
					    FIELD("present", FIELD_BITS, present),
					    {0}};
static const struct field views_fields[] = {FIELD("job", FIELD_STRING, job), FIELD("count", FIELD_INT, count), {0}};
static const struct field job_fields[] = {FIELD("job", FIELD_STRING, job), {0}};
static const struct field no_fields[] = {{0}};
static const struct field hello_fields[] = {
    FIELD("backend", FIELD_STRING, backend),          FIELD("device", FIELD_STRING, info.name),
    FIELD("driver", FIELD_STRING, info.driver),       FIELD("bytes_total", FIELD_SIZE, info.bytes_total),
    FIELD("bytes_free", FIELD_SIZE, info.bytes_free), {0}};
static const struct field refused_fields[] = {FIELD("text", FIELD_STRING, text), {0}};
static const struct field alive_fields[] = {
    FIELD("steps", FIELD_SIZE, steps), FIELD("step_seconds", FIELD_NUMBER, step_seconds), {0}};
static const struct field opened_fields[] = {FIELD("job", FIELD_STRING, job),
					     FIELD("projections", FIELD_SIZE, memory.projections),
					     FIELD("volumes", FIELD_SIZE, memory.volumes),
					     FIELD("scratch", FIELD_SIZE, memory.scratch),
					     FIELD("total", FIELD_SIZE, memory.total),
					     FIELD("available", FIELD_SIZE, memory.available),
					     FIELD("host", FIELD_SIZE, memory.host),
					     FIELD("plan", FIELD_STRING, plan),
					     {0}};
static const struct field reconstructed_fields[] = {FIELD("job", FIELD_STRING, job),
						    FIELD("count", FIELD_INT, count),
						    FIELD("bytes", FIELD_SIZE, bytes),
						    FIELD("seconds", FIELD_NUMBER, row.seconds),
						    {0}};
static const struct field progress_fields[] = {FIELD("job", FIELD_STRING, job),
					       FIELD("stage", FIELD_STAGE, stage),
					       FIELD("iteration", FIELD_INT, iteration),
					       FIELD("fraction", FIELD_NUMBER, fraction),
					       {0}};
static const struct field row_fields[] = {FIELD("job", FIELD_STRING, job),
					  FIELD("iteration", FIELD_INT, row.iteration),
					  FIELD("residual", FIELD_NUMBER, row.residual),
					  FIELD("change", FIELD_NUMBER, row.change),
					  FIELD("tv", FIELD_NUMBER, row.tv),
					  FIELD("seconds", FIELD_NUMBER, row.seconds),
					  {0}};
static const struct field volume_fields[] = {FIELD("job", FIELD_STRING, job),
					     FIELD("name", FIELD_STRING, name),
					     FIELD("stage", FIELD_STRING, volume_stage),
					     FIELD("iteration", FIELD_INT, iteration),
					     FIELD("grid", FIELD_GRID, grid),
					     FIELD("bytes", FIELD_SIZE, bytes),
					     FIELD("norm2", FIELD_NUMBER, norms.norm2),
					     FIELD("difference2", FIELD_NUMBER, norms.difference2),
					     FIELD("tv", FIELD_NUMBER, norms.tv),
					     FIELD("minimum", FIELD_NUMBER, norms.minimum),
					     FIELD("maximum", FIELD_NUMBER, norms.maximum),
					     FIELD("mean", FIELD_NUMBER, norms.mean),
					     FIELD("not_finite", FIELD_SIZE, norms.not_finite),
					     FIELD("estimate_mm", FIELD_NUMBER, estimate_mm),
					     FIELD("metal_share", FIELD_NUMBER, support.metal),
					     FIELD("estimated_share", FIELD_NUMBER, support.estimated),
					     FIELD("held_out", FIELD_INT, support.held_out),
					     FIELD("held_residual", FIELD_NUMBER, support.held_residual),
					     FIELD("used_residual", FIELD_NUMBER, support.used_residual),
					     FIELD("written_s", FIELD_SIZE, written_s),
					     FIELD("written_ns", FIELD_SIZE, written_ns),
					     {0}};
static const struct field settled_fields[] = {FIELD("job", FIELD_STRING, job), FIELD("name", FIELD_STRING, name), {0}};
static const struct field checkpoint_fields[] = {
    FIELD("job", FIELD_STRING, job), FIELD("iteration", FIELD_INT, iteration), {0}};
static const struct field noise_fields[] = {FIELD("job", FIELD_STRING, job),
					    FIELD("noise_hu", FIELD_NUMBER, noise_hu),
					    FIELD("alpha", FIELD_NUMBER, alpha),
					    {0}};
static const struct field agreement_fields[] = {FIELD("job", FIELD_STRING, job),
						FIELD("views", FIELD_INT, agreement.views),
						FIELD("mm", FIELD_NUMBER, agreement.mm),
						FIELD("sigma_mm", FIELD_NUMBER, agreement.sigma_mm),
						FIELD("unexplained", FIELD_NUMBER, agreement.unexplained),
						{0}};
static const struct field stopped_fields[] = {FIELD("job", FIELD_STRING, job),
					      FIELD("rule", FIELD_RULE, stop.rule),
					      FIELD("iteration", FIELD_INT, stop.iteration),
					      FIELD("residual", FIELD_NUMBER, stop.residual),
					      FIELD("change", FIELD_NUMBER, stop.change),
					      FIELD("noise", FIELD_NUMBER, stop.noise),
					      {0}};
static const struct field warning_fields[] = {
    FIELD("job", FIELD_STRING, job), FIELD("code", FIELD_STRING, code_name), FIELD("detail", FIELD_STRING, text), {0}};
static const struct field ended_fields[] = {FIELD("job", FIELD_STRING, job),          FIELD("code", FIELD_INT, code),
					    FIELD("iteration", FIELD_INT, iteration), FIELD("text", FIELD_STRING, text),
					    FIELD("card", FIELD_INT, card),           {0}};

static const struct {
	const char *name;
	const struct field *fields;
} kinds[MESSAGE_KIND_COUNT] = {
    [MESSAGE_START] = {"start", start_fields},
    [MESSAGE_VIEWS] = {"views", views_fields},
    [MESSAGE_CANCEL] = {"cancel", job_fields},
    [MESSAGE_YIELD] = {"yield", job_fields},
    [MESSAGE_QUIT] = {"quit", no_fields},
    [MESSAGE_HELLO] = {"hello", hello_fields},
    [MESSAGE_REFUSED] = {"refused", refused_fields},
    [MESSAGE_ALIVE] = {"alive", alive_fields},
    [MESSAGE_OPENED] = {"opened", opened_fields},
    [MESSAGE_RECONSTRUCTED] = {"reconstructed", reconstructed_fields},
    [MESSAGE_PROGRESS] = {"progress", progress_fields},
    [MESSAGE_ROW] = {"row", row_fields},
    [MESSAGE_VOLUME] = {"volume", volume_fields},
    [MESSAGE_SETTLED] = {"settled", settled_fields},
    [MESSAGE_CHECKPOINT] = {"checkpoint", checkpoint_fields},
    [MESSAGE_NOISE] = {"noise", noise_fields},
    [MESSAGE_AGREEMENT] = {"agreement", agreement_fields},
    [MESSAGE_STOPPED] = {"stopped", stopped_fields},
    [MESSAGE_WARNING] = {"warning", warning_fields},
    [MESSAGE_ENDED] = {"ended", ended_fields},
};

/* ---- writing ---- */

/* Two digits a byte; zero bytes at the end are left out. */
static cJSON *bytes_json(const uint8_t *bytes, size_t count)
{
	static const char digits[] = "0123456789abcdef";
	cJSON *json;
	char *text;

	while (count > 0 && bytes[count - 1] == 0)
		count--;
	text = malloc(2 * count + 1);
	if (text == NULL)
		return NULL;
	for (size_t i = 0; i < count; i++) {
		text[2 * i] = digits[bytes[i] >> 4];
		text[2 * i + 1] = digits[bytes[i] & 15];
	}
	text[2 * count] = '\0';
	json = cJSON_CreateString(text);
	free(text);
	return json;
}

/* size, spacing, origin: nine numbers in a row. */
static cJSON *grid_json(const struct grid *grid)
{
	double numbers[9];

	for (int i = 0; i < 3; i++) {
		numbers[i] = grid->size[i];
		numbers[3 + i] = grid->spacing[i];
		numbers[6 + i] = grid->origin[i];
	}
	return cJSON_CreateDoubleArray(numbers, 9);
}

static cJSON *field_json(const struct field *field, const struct message *message)
{
	const void *at = (const char *)message + field->offset;

	switch (field->type) {
	case FIELD_STRING:
		return cJSON_CreateString(at);
	case FIELD_INT:
		return cJSON_CreateNumber(*(const int *)at);
	case FIELD_NUMBER:
		return cJSON_CreateNumber(*(const double *)at);
	case FIELD_SIZE:
		return cJSON_CreateNumber((double)*(const size_t *)at);
	case FIELD_BOOL:
		return cJSON_CreateBool(*(const bool *)at);
	case FIELD_STAGE:
		return cJSON_CreateString(stage_names[*(const enum stage *)at]);
	case FIELD_RULE:
		return cJSON_CreateString(stop_rule_names[*(const enum stop_rule *)at]);
	case FIELD_BITS:
		return bytes_json(at, field->size);
	case FIELD_GRID:
		return grid_json(at);
	case FIELD_REQUEST:
		return job_request_json(at);
	}
	return NULL;
}

static cJSON *message_json(const struct message *message)
{
	cJSON *value = cJSON_CreateObject();

	if (cJSON_AddStringToObject(value, "kind", kinds[message->kind].name) == NULL) {
		cJSON_Delete(value);
		return NULL;
	}
	for (const struct field *field = kinds[message->kind].fields; field->name != NULL; field++) {
		cJSON *member = field_json(field, message);

		if (!json_add(value, field->name, member)) {
			cJSON_Delete(value);
			return NULL;
		}
	}
	return value;
}

/* A packet goes whole or not at all; a socket that does not block is waited for. */
static int send_packet(int socket, const char *text, size_t length, struct error *err)
{
	for (;;) {
		ssize_t sent = send(socket, text, length, MSG_NOSIGNAL);

		if (sent == (ssize_t)length)
			return 0;
		if (sent >= 0)
			return error_set(err, ERR_IO, "a message of %zu bytes was cut to %zd", length, sent);
		if (errno == EAGAIN || errno == EWOULDBLOCK) {
			struct pollfd writable = {.fd = socket, .events = POLLOUT};

			(void)poll(&writable, 1, -1); /* whatever it says, send says it better */
		} else if (errno != EINTR) {
			return error_set_errno(err, errno, "a message cannot be sent");
		}
	}
}

int message_send(int socket, const struct message *message, struct error *err)
{
	cJSON *value = message_json(message);
	size_t length = 0;
	char *text = json_print(value, &length);
	int code;

	cJSON_Delete(value);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a message");
	if (length > MESSAGE_BYTES_MAX)
		code = error_set(err, ERR_TOO_LARGE, "a message of %zu bytes, at most %d are possible", length,
				 MESSAGE_BYTES_MAX);
	else
		code = send_packet(socket, text, length, err);
	free(text);
	return code;
}

/* ---- reading ---- */

static int hex_digit(char c)
{
	if (c >= '0' && c <= '9')
		return c - '0';
	return c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

/* Two digits each; those that are not there are zero. */
static void read_bytes(struct json_reader *reader, const char *name, size_t size, uint8_t *ret)
{
	const cJSON *member = json_member(reader, name, true);
	size_t length = cJSON_IsString(member) ? strlen(member->valuestring) : 0;

	if (member == NULL)
		return;
	if (!cJSON_IsString(member) || length % 2 != 0 || length > 2 * size) {
		json_fail(reader, ERR_INVALID, name, "at most %zu hexadecimal digits are expected, two for each byte",
			  2 * size);
		return;
	}
	memset(ret, 0, size);
	for (size_t i = 0; i < length / 2; i++) {
		const char *text = member->valuestring + 2 * i;
		int high = hex_digit(text[0]), low = hex_digit(text[1]);

		if (high < 0 || low < 0) {
			json_fail(reader, ERR_INVALID, name, "hexadecimal digits are expected");
			return;
		}
		ret[i] = (uint8_t)(high << 4 | low);
	}
}

static void read_grid(struct json_reader *reader, const char *name, struct grid *ret_grid)
{
	double numbers[9] = {0};

	json_numbers(reader, name, true, 9, -1e9, 1e9, numbers);
	for (int i = 0; i < 3; i++) {
		ret_grid->size[i] = (int)numbers[i];
		ret_grid->spacing[i] = numbers[3 + i];
		ret_grid->origin[i] = numbers[6 + i];
	}
}

/*
 * Unlike what comes from outside, texts of our own may hold line ends (a
 * driver's message), and one that was cut within a character has grown by its
 * replacement on the way: it is cut again rather than the message lost.
 */
static void read_text(struct json_reader *reader, const char *name, char *ret, size_t size)
{
	const cJSON *member = json_member(reader, name, true);
	size_t length;

	if (member == NULL)
		return;
	if (!cJSON_IsString(member)) {
		json_fail(reader, ERR_INVALID, name, "a text is expected");
		return;
	}
	length = strlen(member->valuestring);
	if (length >= size) {
		length = size - 1;
		while (length > 0 && (member->valuestring[length] & 0xc0) == 0x80) /* not within a character again */
			length--;
	}
	memcpy(ret, member->valuestring, length);
	ret[length] = '\0';
}

static void read_request(struct json_reader *reader, const char *name, struct job_request *ret_request)
{
	const cJSON *member = json_member(reader, name, true);

	if (member != NULL)
		reader->code = job_request_read(member, ret_request, reader->err);
}

static void read_field(struct json_reader *reader, const struct field *field, struct message *message)
{
	void *at = (char *)message + field->offset;
	long integer = 0;
	double number = NAN;
	int choice = 0;

	switch (field->type) {
	case FIELD_STRING:
		read_text(reader, field->name, at, field->size);
		break;
	case FIELD_INT:
		json_integer(reader, field->name, true, INT_MIN, INT_MAX, &integer);
		*(int *)at = (int)integer;
		break;
	case FIELD_NUMBER:
		json_number(reader, field->name, false, -HUGE_VAL, HUGE_VAL, &number);
		*(double *)at = number;
		break;
	case FIELD_SIZE:
		json_integer(reader, field->name, true, 0, 1L << 53, &integer);
		*(size_t *)at = (size_t)integer;
		break;
	case FIELD_STAGE:
		json_choice(reader, field->name, true, stage_names, STAGE_COUNT, &choice);
		*(enum stage *)at = (enum stage)choice;
		break;
	case FIELD_RULE:
		json_choice(reader, field->name, true, stop_rule_names, STOP_RULE_COUNT, &choice);
		*(enum stop_rule *)at = (enum stop_rule)choice;
		break;
	case FIELD_BOOL:
		json_bool(reader, field->name, true, at);
		break;
	case FIELD_BITS:
		read_bytes(reader, field->name, field->size, at);
		break;
	case FIELD_GRID:
		read_grid(reader, field->name, at);
		break;
	case FIELD_REQUEST:
		read_request(reader, field->name, at);
		break;
	}
}

static int message_read(const cJSON *value, struct message *ret_message, struct error *err)
{
	struct json_reader reader;
	const char *names[MESSAGE_KIND_COUNT];
	int kind = 0;

	for (int i = 0; i < MESSAGE_KIND_COUNT; i++)
		names[i] = kinds[i].name;
	json_begin(&reader, value, "", err);
	json_choice(&reader, "kind", true, names, MESSAGE_KIND_COUNT, &kind);
	if (reader.code != 0)
		return reader.code; /* which other members there may be is not known */
	ret_message->kind = (enum message_kind)kind;
	for (const struct field *field = kinds[kind].fields; field->name != NULL; field++)
		read_field(&reader, field, ret_message);
	return json_end(&reader);
}

/* 1 when there is something to receive (an end counts), 0 when the time is over. */
static int wait_readable(int socket, int timeout_ms, struct error *err)
{
	double deadline = clock_monotonic() + timeout_ms * 1e-3;
	int left = timeout_ms;

	for (;;) {
		struct pollfd readable = {.fd = socket, .events = POLLIN};
		int ready = poll(&readable, 1, left);

		if (ready >= 0)
			return ready > 0;
		if (errno != EINTR)
			return error_set_errno(err, errno, "cannot wait for a message");
		if (timeout_ms > 0) {
			double rest = (deadline - clock_monotonic()) * 1e3;

			left = rest > 0 ? (int)rest : 0;
		}
	}
}

/* *ret_length 0 when nothing was there after all: another thread may have taken it. */
static int receive_packet(int socket, char *buffer, size_t *ret_length, struct error *err)
{
	ssize_t length;

	do {
		length = recv(socket, buffer, MESSAGE_BYTES_MAX, MSG_TRUNC | MSG_DONTWAIT);
	} while (length < 0 && errno == EINTR);
	if (length == 0)
		return error_set(err, ERR_IO, "the other side has gone");
	if (length > MESSAGE_BYTES_MAX)
		return error_set(err, ERR_TOO_LARGE, "a message of %zd bytes, at most %d are possible", length,
				 MESSAGE_BYTES_MAX);
	if (length < 0 && errno != EAGAIN && errno != EWOULDBLOCK)
		return error_set_errno(err, errno, "a message cannot be received");
	*ret_length = length < 0 ? 0 : (size_t)length;
	return 0;
}

static int decode(const char *text, size_t length, struct message *ret_message, struct error *err)
{
	struct message *message = calloc(1, sizeof(*message));
	cJSON *value = NULL;
	int code;

	if (message == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a message");
	code = json_parse(text, length, &value, err);
	if (code == 0)
		code = message_read(value, message, err);
	if (code == 0)
		*ret_message = *message;
	else
		message_clear(message);
	cJSON_Delete(value);
	free(message);
	return code;
}

int message_receive(int socket, int timeout_ms, struct message *ret_message, bool *ret_got, struct error *err)
{
	char *buffer = NULL;
	size_t length = 0;
	int code = wait_readable(socket, timeout_ms, err);

	if (code < 0)
		return code;
	if (code == 0) {
		*ret_got = false;
		return 0;
	}
	buffer = malloc(MESSAGE_BYTES_MAX);
	if (buffer == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a message");
	code = receive_packet(socket, buffer, &length, err);
	if (code == 0 && length > 0)
		code = decode(buffer, length, ret_message, err);
	if (code == 0)
		*ret_got = length > 0;
	free(buffer);
	return code;
}

void message_clear(struct message *message)
{
	job_request_clear(&message->request);
}

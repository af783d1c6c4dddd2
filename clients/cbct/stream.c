/*
 * /v1/jobs/{}/stream into files: stream.h. The body is multipart/mixed (RFC
 * 2046, 5.1) whose parts all tell their length; it is taken apart as it comes.
 */
#include "clients/cbct/stream.h"

#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include <openssl/evp.h>

#include "proto/durable.h"
#include "proto/zstream.h"

enum { LINE_MAX_LENGTH = 1024, UNPACKED = 256 << 10 };

enum place { BOUNDARY, HEADER, BODY, BEHIND_BODY, END };

struct stream {
	const struct stream_options *options;
	char after[80]; /* the last volume that is there, "" for none */
	bool progressed;
	struct error err; /* of what came, or of the disk; code 0: none */
	bool disk_failed; /* then another connection helps nobody */

	enum place place;
	char line[LINE_MAX_LENGTH], boundary[80];
	size_t line_length;

	/* The part that is coming in. */
	char volume[80], name[HTTP_NAME_MAX], digest[80], path[PATH_MAX];
	bool packed;
	uint64_t left; /* bytes of its body */
	bool open;     /* a volume's; the last part, the job's document, is left out */
	struct durable file;
	EVP_MD_CTX *hash;
	struct zdecoder *decoder;
	bool unpacked_all;
	char unpacked[UNPACKED];
};

static void part_clear(struct stream *stream)
{
	if (stream->open)
		durable_abandon(&stream->file);
	zdecoder_free(stream->decoder);
	stream->decoder = NULL;
	stream->open = stream->packed = stream->unpacked_all = false;
	stream->volume[0] = stream->name[0] = stream->digest[0] = 0;
	stream->left = 0;
}

static int part_begin(struct stream *stream)
{
	struct error *err = &stream->err;

	stream->place = BODY;
	if (stream->volume[0] == 0)
		return 0;
	if (stream->name[0] == 0)
		return error_set(err, ERR_INVALID, "volume %s comes without a file name", stream->volume);
	snprintf(stream->path, sizeof(stream->path), "%.*s/%s", PATH_MAX - HTTP_NAME_MAX - 8,
		 stream->options->directory, stream->name);
	if (EVP_DigestInit_ex(stream->hash, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "a digest cannot be made");
	if (stream->packed && zdecoder_new(&stream->decoder, err) != 0)
		return err->code;
	stream->open = durable_open(&stream->file, stream->path, 0, err) == 0;
	stream->disk_failed = !stream->open;
	return stream->open ? 0 : err->code;
}

static int keep(struct stream *stream, const char *data, size_t size)
{
	int code = durable_write(&stream->file, data, size, &stream->err);

	stream->disk_failed = code != 0;
	return code;
}

static int unpack(struct stream *stream, const char *data, size_t size)
{
	size_t consumed = 0, produced = sizeof(stream->unpacked);

	/* A buffer that was filled may have more behind it. */
	while (size > 0 || produced == sizeof(stream->unpacked)) {
		if (zdecoder_step(stream->decoder, data, size, &consumed, stream->unpacked, sizeof(stream->unpacked),
				  &produced, &stream->unpacked_all, &stream->err) != 0 ||
		    keep(stream, stream->unpacked, produced) != 0)
			return stream->err.code;
		data += consumed;
		size -= consumed;
	}
	return 0;
}

static int part_take(struct stream *stream, const char *data, size_t size)
{
	stream->left -= size;
	if (!stream->open)
		return 0;
	EVP_DigestUpdate(stream->hash, data, size);
	return stream->packed ? unpack(stream, data, size) : keep(stream, data, size);
}

static int part_end(struct stream *stream)
{
	unsigned char sum[EVP_MAX_MD_SIZE], text[2 * EVP_MAX_MD_SIZE];
	char digest[2 * EVP_MAX_MD_SIZE + 16];
	int code;

	stream->place = BEHIND_BODY;
	if (!stream->open)
		return 0;
	EVP_DigestFinal_ex(stream->hash, sum, NULL);
	EVP_EncodeBlock(text, sum, 32);
	snprintf(digest, sizeof(digest), "sha-256=:%s:", (const char *)text);
	if ((stream->digest[0] != 0 && strcmp(digest, stream->digest) != 0) ||
	    (stream->packed && !stream->unpacked_all))
		return error_set(&stream->err, ERR_IO, "volume %s does not fit its digest", stream->volume);
	stream->open = false;
	code = durable_commit(&stream->file, &stream->err);
	stream->disk_failed = code != 0;
	if (code == 0) {
		memcpy(stream->after, stream->volume, sizeof(stream->after));
		stream->progressed = true;
		stream->options->saved(stream->options->context, stream->path);
	}
	return code;
}

/* ---- lines ---- */

static int take_boundary(struct stream *stream)
{
	size_t length = strlen(stream->boundary);

	if (stream->boundary[0] == 0 && strncmp(stream->line, "--", 2) == 0 &&
	    strlen(stream->line) < sizeof(stream->boundary)) {
		memcpy(stream->boundary, stream->line, strlen(stream->line) + 1);
		length = strlen(stream->boundary);
	}
	if (length == 0 || strncmp(stream->line, stream->boundary, length) != 0)
		return error_set(&stream->err, ERR_IO, "the stream of volumes has no boundary where it should");
	stream->place = strcmp(stream->line + length, "--") == 0 ? END : HEADER;
	part_clear(stream);
	return 0;
}

static int take_header(struct stream *stream)
{
	char *value = strchr(stream->line, ':');

	if (stream->line[0] == 0)
		return part_begin(stream);
	if (value == NULL)
		return error_set(&stream->err, ERR_IO, "the stream of volumes has a header \"%.60s\"", stream->line);
	*value++ = 0;
	value += strspn(value, " \t");
	if (strcasecmp(stream->line, "Content-Length") == 0)
		stream->left = strtoull(value, NULL, 10);
	else if (strcasecmp(stream->line, "Content-Disposition") == 0)
		disposition_name(value, stream->name);
	else if (strcasecmp(stream->line, "Content-Digest") == 0)
		snprintf(stream->digest, sizeof(stream->digest), "%.79s", value);
	else if (strcasecmp(stream->line, "Content-Encoding") == 0)
		stream->packed = strcasecmp(value, "zstd") == 0;
	else if (strcasecmp(stream->line, "CBCT-Volume") == 0)
		snprintf(stream->volume, sizeof(stream->volume), "%.79s", value);
	return 0;
}

static int take_line(struct stream *stream)
{
	switch (stream->place) {
	case BOUNDARY:
		return take_boundary(stream);
	case HEADER:
		return take_header(stream);
	case BEHIND_BODY:
		stream->place = BOUNDARY;
		return stream->line[0] == 0 ? 0 : error_set(&stream->err, ERR_IO, "a part is longer than it says");
	case BODY:
	case END:
		break;
	}
	return 0;
}

/* One byte of a line; at its end the line is taken. */
static int take_byte(struct stream *stream, char byte)
{
	if (byte != '\n') {
		if (stream->line_length == sizeof(stream->line) - 1)
			return error_set(&stream->err, ERR_IO, "the stream of volumes has a line of more than %d bytes",
					 LINE_MAX_LENGTH - 1);
		stream->line[stream->line_length++] = byte;
		return 0;
	}
	if (stream->line_length > 0 && stream->line[stream->line_length - 1] == '\r')
		stream->line_length--;
	stream->line[stream->line_length] = 0;
	stream->line_length = 0;
	return take_line(stream);
}

static bool on_piece(void *context, const void *data, size_t length)
{
	struct stream *stream = context;
	const char *at = data;
	int code = 0;

	while (code == 0 && (length > 0 || (stream->place == BODY && stream->left == 0))) {
		size_t part = 1;

		if (stream->place == BODY && stream->left == 0) {
			code = part_end(stream);
			continue;
		}
		if (stream->place == BODY) {
			part = length < stream->left ? length : (size_t)stream->left;
			code = part_take(stream, at, part);
		} else {
			code = take_byte(stream, *at);
		}
		at += part;
		length -= part;
	}
	return code == 0;
}

/* ---- the request ---- */

/* One connection, for as long as it holds. */
static int receive(struct stream *stream, struct http *http, struct error *err)
{
	char query[VOLUME_QUERY_MAX], path[600];
	struct http_reply reply = {0};
	int code;

	volume_query_text(stream->options->query, query);
	snprintf(path, sizeof(path), "/v1/jobs/%.100s/stream?%s%s%s", stream->options->job, query,
		 stream->after[0] != 0 ? "&after=" : "", stream->after);
	stream->place = BOUNDARY;
	stream->boundary[0] = 0;
	stream->line_length = 0;
	stream->progressed = false;
	stream->err.code = 0;
	code =
	    http_send(http,
		      &(struct http_request){.method = "GET",
					     .path = path,
					     .headers = {stream->options->query->zstd ? "Accept-Encoding: zstd" : NULL},
					     .write = on_piece,
					     .context = stream},
		      &reply, err);
	http_reply_clear(&reply);
	part_clear(stream);
	if (stream->err.code != 0) {
		*err = stream->err;
		return err->code;
	}
	if (code == 0 && stream->place != END)
		code = error_set(err, ERR_IO, "the stream of volumes broke off");
	return code;
}

int stream_save(const struct stream_options *options, struct error *err)
{
	struct stream *stream = calloc(1, sizeof(*stream));
	struct http *http = NULL;
	int code, attempt = 0;

	if (stream == NULL || (stream->hash = EVP_MD_CTX_new()) == NULL) {
		free(stream);
		return error_set(err, ERR_NO_MEMORY, "no memory for a stream of volumes");
	}
	stream->options = options;
	code = http_new(options->http, &http, err);
	if (code == 0) {
		do {
			code = receive(stream, http, err);
			attempt = stream->progressed ? 0 : attempt;
		} while (!stream->disk_failed && http_again(http, code, attempt++));
	}
	http_free(http);
	EVP_MD_CTX_free(stream->hash);
	free(stream);
	return code;
}

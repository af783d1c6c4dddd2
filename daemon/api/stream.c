/*
 * /v1/jobs/{}/stream: the kept volumes as multipart/mixed (RFC 2046, 5.1), each
 * when it is made, and the job's document when it has ended.
 *
 * The order is that of the job's events, so a reader gets each volume once, and
 * after=NAME goes on where another connection broke. A part's bytes come from
 * a file: who reads slowly holds neither memory nor the job.
 */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "daemon/api/internal.h"
#include "proto/json.h"

static const double patience = 15; /* s */
enum { BATCH = 64, HEAD_MAX = 1024 };

struct stream {
	struct api *api;
	struct request *request;
	struct job *job;
	struct job_facts facts; /* as it was at the beginning */
	struct content_options options;
	bool zstd;
	char boundary[40];
	struct watch watch, made;
	long long after; /* the number of the last event that was looked at */

	/* The bytes that go out next: this text, then the encoded copy. */
	char *text;
	size_t length, sent;
	struct encoded *encoded;
	struct volume_record volume; /* of the encoded copy */
	bool headed;                 /* length and digest were sent */
	uint64_t offset;
	bool last; /* nothing comes behind the text */
};

static void wake_stream(void *context)
{
	request_wake(context);
}

static void drop_encoded(struct stream *stream)
{
	if (stream->encoded == NULL)
		return;
	encoded_unwatch(stream->encoded, &stream->made);
	encoded_release(stream->encoded);
	stream->encoded = NULL;
}

static void stream_free(void *state)
{
	struct stream *stream = state;

	drop_encoded(stream);
	job_unwatch(stream->job, &stream->watch);
	job_release(stream->job);
	free(stream->text);
	free(stream);
}

/* ---- parts ---- */

/* Takes the text; it goes out next. */
static int set_text(struct stream *stream, char *text, int length)
{
	if (text == NULL || length < 0)
		return -1;
	free(stream->text);
	stream->text = text;
	stream->length = (size_t)length;
	stream->sent = 0;
	return 0;
}

static int begin_part(struct stream *stream, const struct volume_record *volume)
{
	bool encoded = stream->zstd && !content_is_packed(&stream->options);
	char filename[VOLUME_FILENAME_MAX], *text = NULL;
	struct error err;
	int length;

	if (encoded_get(stream->api->copies, stream->facts.id, volume, &stream->options, stream->zstd, &stream->encoded,
			&err) != 0)
		return -1;
	encoded_watch(stream->encoded, &stream->made);
	stream->volume = *volume;
	stream->headed = false;
	stream->offset = 0;
	volume_filename(stream->facts.id, volume->name, &stream->options, filename);
	length = asprintf(&text,
			  "--%s\r\nContent-Type: %s\r\nContent-Disposition: attachment; filename=\"%s\"\r\n"
			  "CBCT-Volume: %s\r\nCBCT-Stage: %s\r\nCBCT-Iteration: %d\r\n%s",
			  stream->boundary, volume_media_type(&stream->options), filename, volume->name, volume->stage,
			  volume->iteration, encoded ? "Content-Encoding: zstd\r\n" : "");
	return set_text(stream, text, length);
}

static int begin_body(struct stream *stream, const struct encoded_facts *facts)
{
	unsigned char digest[64];
	char *text = NULL;
	int length;

	EVP_EncodeBlock(digest, facts->sha256, sizeof(facts->sha256));
	length = asprintf(&text, "Content-Length: %llu\r\nContent-Digest: sha-256=:%s:\r\n\r\n",
			  (unsigned long long)facts->size, (const char *)digest);
	stream->headed = true;
	return set_text(stream, text, length);
}

static int end_part(struct stream *stream)
{
	drop_encoded(stream);
	return set_text(stream, strdup("\r\n"), 2);
}

static int last_part(struct stream *stream)
{
	size_t size = 0;
	struct error err;
	cJSON *document = job_document(stream->job, false, &err);
	char *json = json_print(document, &size), *text = NULL;
	int length = -1;

	cJSON_Delete(document);
	if (json != NULL)
		length = asprintf(&text,
				  "--%s\r\nContent-Type: application/json\r\nContent-Length: %zu\r\n"
				  "Content-Disposition: attachment; filename=\"%s.json\"\r\n\r\n%s\r\n--%s--\r\n",
				  stream->boundary, size, stream->facts.id, json, stream->boundary);
	free(json);
	stream->last = true;
	return set_text(stream, text, length);
}

/* The name of the next volume that has an event behind stream->after, "" for none yet. */
static int next_volume(struct stream *stream, char *ret_name, size_t size)
{
	struct event_record *events;
	struct error err;
	int count = BATCH;

	ret_name[0] = '\0';
	while (ret_name[0] == '\0' && count == BATCH && stream->after < store_last_event(stream->api->store)) {
		if (store_job_events(stream->api->store, stream->facts.id, stream->after, BATCH, &events, &count,
				     &err) != 0)
			return -1;
		for (int i = 0; i < count && ret_name[0] == '\0'; i++) {
			cJSON *data = strcmp(events[i].kind, "volume") == 0 ? cJSON_Parse(events[i].data) : NULL;
			const char *name = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(data, "name"));

			stream->after = events[i].number;
			if (name != NULL)
				snprintf(ret_name, size, "%s", name);
			cJSON_Delete(data);
		}
		event_records_free(events, count);
	}
	return 0;
}

/* READ_WAIT when there is none yet. */
static ssize_t next_part(struct stream *stream)
{
	struct volume_record volume;
	struct job_facts facts;
	struct error err;
	char name[sizeof(volume.name)];
	long long before = stream->after;
	int code;

	job_facts(stream->job, &facts); /* asked first: events from before the end are there by then */
	if (facts.removed || next_volume(stream, name, sizeof(name)) != 0)
		return -1;
	if (name[0] != '\0') {
		code = volume_find(stream->api, &stream->facts, name, &volume, &err);
		/*
		 * A damaged volume is left out before its part begins; the job's document has a warning. An encoded
		 * copy may have been made before the damage, and its bytes may be those of the kept file.
		 */
		if (code == 0 &&
		    volume_verify(stream->api, stream->facts.id, &volume, 0, volume.bytes, &err) == ERR_DAMAGED)
			return 0;
		if (code == 0)
			return begin_part(stream, &volume);
		/* A crash took the volume after its event was sent: the job makes it again. */
		stream->after = before;
		return code == ERR_NOT_FOUND && !facts.ended && !request_stopping(stream->request) ? READ_WAIT : -1;
	}
	if (facts.ended)
		return last_part(stream);
	return request_stopping(stream->request) ? -1 : READ_WAIT;
}

/* ---- sending ---- */

static ssize_t send_text(struct stream *stream, void *to, size_t size)
{
	size_t part = stream->length - stream->sent;

	if (part > size)
		part = size;
	memcpy(to, stream->text + stream->sent, part);
	stream->sent += part;
	return (ssize_t)part;
}

static ssize_t send_body(struct stream *stream, const struct encoded_facts *facts, void *to, size_t size)
{
	ssize_t got;

	if (size > facts->size - stream->offset)
		size = (size_t)(facts->size - stream->offset);
	do {
		got = pread(facts->descriptor, to, size, (off_t)(facts->offset + stream->offset));
	} while (got < 0 && errno == EINTR);
	if (got <= 0)
		return -1;
	stream->offset += (uint64_t)got;
	return got;
}

/* Goes on to what comes next; 0: something was made ready. */
static ssize_t go_on(struct stream *stream, void *to, size_t size, ssize_t *ret_sent)
{
	struct encoded_facts facts;

	if (stream->encoded == NULL)
		return next_part(stream);
	encoded_look(stream->encoded, &facts);
	if (facts.failed)
		return -1;
	if (!facts.made)
		return request_stopping(stream->request) ? -1 : READ_WAIT;
	if (!stream->headed)
		return begin_body(stream, &facts);
	if (stream->offset == facts.size)
		return end_part(stream);
	*ret_sent = send_body(stream, &facts, to, size);
	return *ret_sent < 0 ? -1 : 0;
}

static ssize_t stream_read(struct request *request, void *to, size_t size)
{
	struct stream *stream = request_state(request);

	for (;;) {
		ssize_t code, sent = 0;

		if (stream->sent < stream->length)
			return send_text(stream, to, size);
		if (stream->last)
			return 0;
		code = go_on(stream, to, size, &sent);
		if (code != 0 || sent > 0)
			return code != 0 ? code : sent;
	}
}

/* ---- the request ---- */

/* Moves stream->after behind the event of this volume. */
static int skip_to(struct stream *stream, const char *name, struct error *err)
{
	char next[sizeof(((struct volume_record *)NULL)->name)];

	do {
		if (next_volume(stream, next, sizeof(next)) != 0)
			return error_set(err, ERR_IO, "the catalogue cannot be read");
	} while (next[0] != '\0' && strcmp(next, name) != 0);
	if (next[0] == '\0')
		return error_set(err, ERR_INVALID, "after is \"%.40s\", expected a volume that job %s has kept", name,
				 stream->facts.id);
	return 0;
}

/* Takes the reference to the job. */
static int stream_new(struct api *api, struct request *request, struct job *job, struct stream **ret_stream,
		      struct error *err)
{
	struct stream *stream = calloc(1, sizeof(*stream));
	unsigned long long random[2];

	if (stream == NULL || getrandom(random, sizeof(random), 0) != (ssize_t)sizeof(random)) {
		free(stream);
		job_release(job);
		return error_set(err, ERR_NO_MEMORY, "no memory for a stream");
	}
	stream->api = api;
	stream->request = request;
	stream->job = job;
	job_facts(job, &stream->facts);
	snprintf(stream->boundary, sizeof(stream->boundary), "%016llx%016llx", random[0], random[1]);
	stream->zstd = request_prefers_coding(request, "zstd");
	stream->watch = (struct watch){.wake = wake_stream, .context = request};
	stream->made = stream->watch;
	job_watch(job, &stream->watch);
	request_set_state(request, stream, stream_free);
	*ret_stream = stream;
	return 0;
}

int volume_stream(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	const char *after = request_query(request, "after");
	struct stream *stream = NULL;
	struct job *job;

	if (jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0 ||
	    stream_new(api, request, job, &stream, err) != 0 ||
	    volume_options(request, &stream->facts, &stream->options, err) != 0 ||
	    (after != NULL && skip_to(stream, after, err) != 0))
		return err->code;
	if (stream->options.dicom)
		return error_set(err, ERR_INVALID,
				 "format=dicom is not streamed: its objects are fetched volume by volume");
	if (request_reply_live(request, 200, stream_read, patience, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Type", "multipart/mixed; boundary=\"%s\"", stream->boundary);
	request_reply_header(request, "Cache-Control", "no-store");
	request_reply_header(request, "Vary", "Accept-Encoding");
	return 0;
}

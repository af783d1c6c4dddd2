/*
 * DICOMweb (PS3.18): objects go by STOW-RS (10.5), several requests at once; what the archive has is asked by QIDO-RS
 * (10.6). There is no storage commitment in DICOMweb.
 */
#include <curl/curl.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "daemon/dicom/answer.h"
#include "daemon/dicom/dicom.h"
#include "proto/scan_directory.h"

enum {
	CONNECTIONS = 3,
	BATCH_BYTES = 8 << 20, /* of a request, or one object */
	REPLY_MOST = 64 << 20,
	TOKEN_MOST = 1 << 14,
	PAGE = 1000, /* instances asked for at a time */
	CONNECT_SECONDS = 10
};
static const char boundary[] = "cbctd-7f1c0b1e9d5a4c6f8e2b3a4d5c6e7f80";

struct reply {
	char *bytes;
	size_t size, space;
	long status;
};

static size_t take(char *from, size_t size, size_t count, void *context)
{
	struct reply *reply = context;
	const size_t length = size * count;

	if (reply->size + length + 1 > reply->space) {
		const size_t space = 2 * reply->space + length + 1024;
		char *grown = space <= REPLY_MOST ? realloc(reply->bytes, space) : NULL;

		if (grown == NULL)
			return 0;
		reply->bytes = grown;
		reply->space = space;
	}
	memcpy(reply->bytes + reply->size, from, length);
	reply->size += length;
	reply->bytes[reply->size] = '\0';
	return length;
}

/* How long the answer may still take, once the request has gone out. */
struct answer_limit {
	curl_off_t request; /* bytes */
	double seconds;     /* from then on */
	struct timespec since;
};

/* Not 0: the exchange is broken off. The time that a large request may take is not the answer's, byte by byte. */
static int watch_answer(void *context, curl_off_t expected, curl_off_t received, curl_off_t whole, curl_off_t sent)
{
	struct answer_limit *limit = context;
	struct timespec now;

	(void)expected;
	(void)received;
	(void)whole;
	clock_gettime(CLOCK_MONOTONIC, &now);
	if (sent < limit->request || limit->since.tv_sec == 0)
		limit->since = now;
	return (double)(now.tv_sec - limit->since.tv_sec) + 1e-9 * (double)(now.tv_nsec - limit->since.tv_nsec) >
	       limit->seconds;
}

/* "Authorization: Bearer ..." of the token in the destination's file. */
static int add_token(const cJSON *destination, struct curl_slist **headers, struct error *err)
{
	const char *path = destination_text(destination, "token_file");
	char *text, line[TOKEN_MOST + 40];
	size_t length;

	if (path[0] == '\0')
		return 0;
	if (file_read(path, TOKEN_MOST, &text, &length, err) != 0)
		return err->code;
	snprintf(line, sizeof(line), "Authorization: Bearer %.*s", (int)strcspn(text, "\r\n"), text);
	explicit_bzero(text, length);
	free(text);
	*headers = curl_slist_append(*headers, line);
	explicit_bzero(line, sizeof(line));
	return 0;
}

static CURL *open_connection(const cJSON *destination)
{
	CURL *curl = curl_easy_init();
	const char *authority = destination_text(destination, "ca_file");

	if (curl == NULL)
		return NULL;
	curl_easy_setopt(curl, CURLOPT_NOSIGNAL, 1L);
	curl_easy_setopt(curl, CURLOPT_CONNECTTIMEOUT, (long)CONNECT_SECONDS);
	/* A token goes to the archive alone. */
	curl_easy_setopt(curl, CURLOPT_FOLLOWLOCATION, 0L);
	if (authority[0] != '\0')
		curl_easy_setopt(curl, CURLOPT_CAINFO, authority);
	return curl;
}

/* One request; body NULL: GET. The reply's bytes are the caller's, on failure too. */
static int exchange(CURL *curl, const cJSON *destination, const char *url, const struct reply *body,
		    struct reply *ret_reply, struct error *err)
{
	struct curl_slist *headers = curl_slist_append(NULL, "Accept: application/dicom+json");
	struct answer_limit limit = {.request = body != NULL ? (curl_off_t)body->size : 0,
				     .seconds = destination_patience(destination, 0)};
	char type[160];
	CURLcode result = CURLE_OK;
	int code = add_token(destination, &headers, err);

	*ret_reply = (struct reply){.bytes = NULL};
	if (body != NULL) {
		snprintf(type, sizeof(type), "Content-Type: multipart/related; type=\"application/dicom\"; boundary=%s",
			 boundary);
		headers = curl_slist_append(headers, type);
		headers = curl_slist_append(headers, "Expect:");
		curl_easy_setopt(curl, CURLOPT_POST, 1L);
		curl_easy_setopt(curl, CURLOPT_POSTFIELDS, body->bytes);
		curl_easy_setopt(curl, CURLOPT_POSTFIELDSIZE_LARGE, (curl_off_t)body->size);
	} else {
		curl_easy_setopt(curl, CURLOPT_HTTPGET, 1L);
	}
	if (code == 0) {
		curl_easy_setopt(curl, CURLOPT_URL, url);
		/* Of the whole exchange: an answer may come a byte at a time. */
		curl_easy_setopt(curl, CURLOPT_TIMEOUT,
				 (long)ceil(destination_patience(destination, body != NULL ? (double)body->size : 0)));
		curl_easy_setopt(curl, CURLOPT_NOPROGRESS, 0L);
		curl_easy_setopt(curl, CURLOPT_XFERINFOFUNCTION, watch_answer);
		curl_easy_setopt(curl, CURLOPT_XFERINFODATA, &limit);
		curl_easy_setopt(curl, CURLOPT_HTTPHEADER, headers);
		curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, take);
		curl_easy_setopt(curl, CURLOPT_WRITEDATA, ret_reply);
		result = curl_easy_perform(curl);
		curl_easy_getinfo(curl, CURLINFO_RESPONSE_CODE, &ret_reply->status);
	}
	curl_slist_free_all(headers);
	if (result == CURLE_ABORTED_BY_CALLBACK)
		code = error_set(err, ERR_BUSY, "it answers too slowly");
	else if (result != CURLE_OK)
		code = error_set(err, ERR_BUSY, "it cannot be reached: %s", curl_easy_strerror(result));
	return code;
}

static void make_url(const cJSON *destination, char *ret_url, size_t size, const char *format, ...)
    __attribute__((format(printf, 4, 5)));
static void make_url(const cJSON *destination, char *ret_url, size_t size, const char *format, ...)
{
	const char *base = destination_text(destination, "url");
	size_t length = strlen(base);
	va_list args;

	while (length > 0 && base[length - 1] == '/')
		length--;
	length = (size_t)snprintf(ret_url, size, "%.*s", (int)length, base);
	va_start(args, format);
	vsnprintf(ret_url + length, size - length, format, args);
	va_end(args);
}

static int web_ask(const cJSON *destination, struct error *err)
{
	CURL *curl = open_connection(destination);
	struct reply reply = {0};
	char url[800];
	int code;

	if (curl == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a connection");
	make_url(destination, url, sizeof(url), "/studies?limit=1&StudyInstanceUID=1.2.3");
	code = exchange(curl, destination, url, NULL, &reply, err);
	if (code == 0 && (reply.status < 200 || reply.status > 299))
		code = answer_refusal(reply.status, "QIDO-RS", err);
	free(reply.bytes);
	curl_easy_cleanup(curl);
	return code;
}

/* ---- reading back ---- */

static void mark(void *context, const char *instance)
{
	objects_mark(context, instance);
}

static int web_find(const cJSON *destination, struct objects *objects, struct error *err)
{
	const struct dicom_head *head = &objects->list[0].head;
	CURL *curl = open_connection(destination);
	int code = 0, count = 1;
	char url[1024];

	if (curl == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a connection");
	for (int i = 0; i < objects->count; i++)
		objects->list[i].stored = false;
	for (int offset = 0; code == 0 && count > 0 && offset < objects->count; offset += count) {
		struct reply reply;

		make_url(destination, url, sizeof(url), "/studies/%s/series/%s/instances?limit=%d&offset=%d",
			 head->study, head->series, PAGE, offset);
		code = exchange(curl, destination, url, NULL, &reply, err);
		/* A series that is not there is an empty answer or a 404. */
		if (code == 0 && (reply.status == 404 || reply.status == 204))
			count = 0;
		else if (code == 0 && reply.status != 200)
			code = answer_refusal(reply.status, "QIDO-RS", err);
		else if (code == 0)
			count = answer_instances(reply.bytes, reply.size, mark, objects, err);
		if (count < 0)
			code = count;
		free(reply.bytes);
	}
	curl_easy_cleanup(curl);
	return code;
}

/* ---- sending ---- */

static bool put(struct reply *body, const void *bytes, size_t size)
{
	return take((char *)(uintptr_t)bytes, 1, size, body) == size;
}

static int add_part(struct reply *body, const struct objects *objects, int place, struct error *err)
{
	char head[160];
	uint8_t *bytes;
	size_t size, dataset;
	bool added;

	if (object_make(objects, place, &bytes, &size, &dataset, err) != 0)
		return err->code;
	snprintf(head, sizeof(head), "\r\n--%s\r\nContent-Type: application/dicom\r\n\r\n", boundary);
	/* The first delimiter has no line's end before it. */
	added = put(body, body->size == 0 ? head + 2 : head, strlen(head) - (body->size == 0 ? 2 : 0)) &&
		put(body, bytes, size);
	free(bytes);
	return added ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a request");
}

/* Takes objects until a request is full; *ret_count 0: all are taken. */
static int fill(struct load *load, struct reply *body, int *ret_count, struct error *err)
{
	char end[80];
	int code = 0, place;

	body->size = 0;
	*ret_count = 0;
	while (code == 0 && (body->size == 0 || body->size + body->size / (size_t)*ret_count < BATCH_BYTES)) {
		place = load_next(load);
		if (place < 0)
			break;
		code = add_part(body, load->objects, place, err);
		(*ret_count)++;
	}
	snprintf(end, sizeof(end), "\r\n--%s--\r\n", boundary);
	if (code == 0 && *ret_count > 0 && !put(body, end, strlen(end)))
		code = error_set(err, ERR_NO_MEMORY, "no memory for a request");
	return code;
}

static void *send_some(void *context)
{
	struct load *load = context;
	CURL *curl = open_connection(load->destination);
	struct reply body = {0}, reply = {0};
	struct error err = {0};
	char url[800];
	int count = 0, code = curl == NULL ? error_set(&err, ERR_NO_MEMORY, "no memory for a connection") : 0;

	make_url(load->destination, url, sizeof(url), "/studies");
	while (code == 0 && (code = fill(load, &body, &count, &err)) == 0 && count > 0) {
		code = exchange(curl, load->destination, url, &body, &reply, &err);
		if (code == 0)
			code = answer_stored(reply.bytes, reply.size, reply.status, &err);
		free(reply.bytes);
		if (code == 0)
			report_progress(count);
	}
	if (code != 0)
		load_fail(load, &err);
	free(body.bytes);
	if (curl != NULL)
		curl_easy_cleanup(curl);
	return NULL;
}

static int web_store(const cJSON *destination, const struct objects *objects, struct error *err)
{
	return load_run(destination, objects, CONNECTIONS, send_some, err);
}

const struct archive archive_web = {"dicomweb", web_ask, web_find, web_store, NULL};

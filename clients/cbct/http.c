/* Requests over libcurl: see http.h. */
#include "clients/cbct/http.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>

#include <curl/curl.h>

#include "proto/json.h"
#include "proto/scan_directory.h"
#include "proto/tokens.h"

#define HTTP_URL_DEFAULT "http://127.0.0.1:2228"

const struct option http_option_rows[] = {
    {"url", 0, OPTION_TEXT, offsetof(struct http_options, url), "URL",
     "the daemon, http://HOST:PORT, https://HOST:PORT or unix:PATH (default $CBCT_URL, else " HTTP_URL_DEFAULT ")", 0,
     0, 0, NULL},
    {"token-file", 0, OPTION_TEXT, offsetof(struct http_options, token_file), "FILE",
     "the token that the daemon asks for (default $CBCT_TOKEN_FILE; or the token itself in $CBCT_TOKEN)", 0, 0, 0,
     NULL},
    {"cacert", 0, OPTION_TEXT, offsetof(struct http_options, authorities), "FILE",
     "who signs the daemon's certificate (default $CBCT_CACERT, else those that the system trusts)", 0, 0, 0, NULL},
    {"cert", 0, OPTION_TEXT, offsetof(struct http_options, certificate), "FILE",
     "a client certificate in place of a token (default $CBCT_CERT)", 0, 0, 0, NULL},
    {"key", 0, OPTION_TEXT, offsetof(struct http_options, key), "FILE", "its key (default $CBCT_KEY)", 0, 0, 0, NULL},
    {0},
};

struct http {
	CURL *easy;
	char *authorization; /* a header field, or NULL */
	char *base;          /* no slash at the end */
	char *socket;        /* the path of a Unix socket, or NULL */
	char message[CURL_ERROR_SIZE];
	bool unreachable;
	double retry_after; /* s, of the last reply */
};

/* The state of a transfer, for the callback that takes its body. */
struct transfer {
	struct http *http;
	const struct http_request *request;
	struct http_reply *reply;
};

/* An option, else the environment's; NULL where neither is there. */
static const char *given(const char *option, const char *variable)
{
	const char *text = option != NULL ? option : getenv(variable);

	return text != NULL && text[0] != 0 ? text : NULL;
}

static int take_token(struct http *http, const char *text, const char *from, struct error *err)
{
	size_t length;

	text += strspn(text, " \t\r\n");
	length = strcspn(text, " \t\r\n");
	if (length == 0 || text[length + strspn(text + length, " \t\r\n")] != 0)
		return error_set(err, ERR_INVALID, "%s has no token, or more than one", from);
	if (asprintf(&http->authorization, "Authorization: Bearer %.*s", (int)length, text) < 0) {
		http->authorization = NULL;
		return error_set(err, ERR_NO_MEMORY, "no memory for a token");
	}
	return 0;
}

/* A file that is named goes before the environment's token. Others must not be able to read it. */
static int read_token(struct http *http, const struct http_options *options, struct error *err)
{
	enum { TOKEN_BYTES_MAX = 4096 };
	const char *path = options->token_file, *token = given(NULL, "CBCT_TOKEN");
	struct stat status;
	size_t length;
	char *text;
	int code;

	if (path == NULL && token != NULL)
		return take_token(http, token, "CBCT_TOKEN", err);
	path = given(path, "CBCT_TOKEN_FILE");
	if (path == NULL)
		return 0;
	if (stat(path, &status) != 0)
		return error_set_errno(err, errno, "%s", path);
	if (file_is_guarded(path, &status, err) != 0 || file_read(path, TOKEN_BYTES_MAX, &text, &length, err) != 0)
		return err->code;
	code = take_token(http, text, path, err);
	free(text);
	return code;
}

static void use_certificates(struct http *http, const struct http_options *options)
{
	const char *authorities = given(options->authorities, "CBCT_CACERT");
	const char *certificate = given(options->certificate, "CBCT_CERT"), *key = given(options->key, "CBCT_KEY");

	if (authorities != NULL)
		curl_easy_setopt(http->easy, CURLOPT_CAINFO, authorities);
	if (certificate != NULL)
		curl_easy_setopt(http->easy, CURLOPT_SSLCERT, certificate);
	if (key != NULL)
		curl_easy_setopt(http->easy, CURLOPT_SSLKEY, key);
	curl_easy_setopt(http->easy, CURLOPT_SSLVERSION, CURL_SSLVERSION_TLSv1_2);
}

int http_new(const struct http_options *options, struct http **ret_http, struct error *err)
{
	const char *url = options->url != NULL ? options->url : getenv("CBCT_URL");
	const char *socket = NULL;
	struct http *http = calloc(1, sizeof(*http));

	if (url == NULL || url[0] == 0)
		url = HTTP_URL_DEFAULT;
	if (strncmp(url, "unix:", 5) == 0) {
		socket = url + 5;
		url = "http://localhost";
	}
	if (http != NULL) {
		http->easy = curl_easy_init();
		http->base = strdup(url);
		http->socket = socket != NULL ? strdup(socket) : NULL;
	}
	if (http == NULL || http->easy == NULL || http->base == NULL || (socket != NULL && http->socket == NULL)) {
		http_free(http);
		return error_set(err, ERR_NO_MEMORY, "no memory for a connection");
	}
	if (read_token(http, options, err) != 0) {
		http_free(http);
		return err->code;
	}
	use_certificates(http, options);
	for (size_t n = strlen(http->base); n > 0 && http->base[n - 1] == '/'; n--)
		http->base[n - 1] = 0;
	curl_easy_setopt(http->easy, CURLOPT_ERRORBUFFER, http->message);
	curl_easy_setopt(http->easy, CURLOPT_NOSIGNAL, 1L);
	/*
	 * Another host of a fleet has what was asked for. The token goes along, as it would where the user names that
	 * host: the daemon that names it could do with the token whatever it likes. Never from TLS to none.
	 */
	curl_easy_setopt(http->easy, CURLOPT_FOLLOWLOCATION, socket == NULL ? 1L : 0L);
	curl_easy_setopt(http->easy, CURLOPT_MAXREDIRS, 1L);
	curl_easy_setopt(http->easy, CURLOPT_UNRESTRICTED_AUTH, 1L);
	curl_easy_setopt(http->easy, CURLOPT_REDIR_PROTOCOLS_STR,
			 strncmp(url, "https:", 6) == 0 ? "https" : "http,https");
	curl_easy_setopt(http->easy, CURLOPT_CONNECTTIMEOUT, 10L);
	/* Between two volumes of a stream nothing may come for hours: whether the daemon is still there is asked. */
	curl_easy_setopt(http->easy, CURLOPT_TCP_KEEPALIVE, 1L);
	curl_easy_setopt(http->easy, CURLOPT_TCP_KEEPIDLE, 15L);
	curl_easy_setopt(http->easy, CURLOPT_TCP_KEEPINTVL, 5L);
	curl_easy_setopt(http->easy, CURLOPT_BUFFERSIZE, 512L * 1024);
	curl_easy_setopt(http->easy, CURLOPT_UPLOAD_BUFFERSIZE, 2L * 1024 * 1024);
	curl_easy_setopt(http->easy, CURLOPT_USERAGENT, "cbct");
	if (socket != NULL)
		curl_easy_setopt(http->easy, CURLOPT_UNIX_SOCKET_PATH, socket);
	*ret_http = http;
	return 0;
}

void http_free(struct http *http)
{
	if (http == NULL)
		return;
	curl_easy_cleanup(http->easy);
	free(http->base);
	free(http->socket);
	free(http->authorization);
	free(http);
}

void http_reply_clear(struct http_reply *reply)
{
	free(reply->body);
	*reply = (struct http_reply){0};
}

static bool reply_append(struct http_reply *reply, const void *data, size_t length)
{
	char *body = realloc(reply->body, reply->length + length + 1);

	if (body == NULL)
		return false;
	memcpy(body + reply->length, data, length);
	reply->body = body;
	reply->length += length;
	body[reply->length] = 0;
	return true;
}

static size_t on_body(char *data, size_t one, size_t length, void *context)
{
	struct transfer *transfer = context;
	const struct http_request *request = transfer->request;
	long status = 0;

	(void)one;
	curl_easy_getinfo(transfer->http->easy, CURLINFO_RESPONSE_CODE, &status);
	if (request->write != NULL && status >= 200 && status < 300)
		return request->write(request->context, data, length) ? length : 0;
	return reply_append(transfer->reply, data, length) ? length : 0;
}

static const char *reply_header(struct http *http, const char *name)
{
	struct curl_header *header = NULL;

	return curl_easy_header(http->easy, name, 0, CURLH_HEADER, -1, &header) == CURLHE_OK ? header->value : NULL;
}

void disposition_name(const char *disposition, char ret_name[HTTP_NAME_MAX])
{
	const char *at = disposition != NULL ? strstr(disposition, "filename=\"") : NULL;
	size_t length;

	ret_name[0] = 0;
	if (at == NULL)
		return;
	at += strlen("filename=\"");
	length = strcspn(at, "\"");
	if (length < HTTP_NAME_MAX && memchr(at, '/', length) == NULL && at[0] != '.')
		snprintf(ret_name, HTTP_NAME_MAX, "%.*s", (int)length, at);
}

const char *member_text(const cJSON *object, const char *name, const char *fallback)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsString(member) ? member->valuestring : fallback;
}

double member_number(const cJSON *object, const char *name, double fallback)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsNumber(member) ? member->valuedouble : fallback;
}

int document_print(const cJSON *document, struct error *err)
{
	char *text = json_print(document, NULL);

	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a document");
	puts(text);
	free(text);
	return 0;
}

static int status_error(int status)
{
	switch (status) {
	case 401:
	case 403:
		return ERR_DENIED;
	case 404:
		return ERR_NOT_FOUND;
	case 409:
		return ERR_CONFLICT;
	case 413:
		return ERR_TOO_LARGE;
	case 422:
		return ERR_IMPOSSIBLE;
	case 429:
	case 503:
		return ERR_BUSY;
	case 507:
		return ERR_NO_SPACE;
	default:
		return status < 500 ? ERR_INVALID : ERR_IO;
	}
}

/* RFC 9457: what the daemon says is wrong; a reply that is none is quoted by its status alone. */
static int problem(const struct http_request *request, const struct http_reply *reply, struct error *err)
{
	cJSON *document = cJSON_ParseWithLength(reply->body != NULL ? reply->body : "", reply->length);
	const char *title = member_text(document, "title", ""), *detail = member_text(document, "detail", "");
	int code = status_error(reply->status);

	if (title[0] == 0)
		code = error_set(err, code, "%s %s was answered with status %d", request->method, request->path,
				 reply->status);
	else
		code = error_set_at(err, code, member_text(document, "pointer", ""), "%s%s%s (status %d)", title,
				    detail[0] != 0 ? ": " : "", detail, reply->status);
	cJSON_Delete(document);
	return code;
}

/* No reply, or one that broke off. */
static int no_reply(struct http *http, CURLcode result, struct error *err)
{
	long reason = 0;

	/* The library speaks of a host and a port, also where there is a socket. */
	if (http->socket != NULL && http->unreachable) {
		curl_easy_getinfo(http->easy, CURLINFO_OS_ERRNO, &reason);
		return error_set(err, ERR_IO, "unix:%s: %s", http->socket,
				 reason != 0 ? strerror((int)reason) : "nobody listens there");
	}
	return error_set(err, ERR_IO, "%s: %s", http->base,
			 http->message[0] != 0 ? http->message : curl_easy_strerror(result));
}

int http_send(struct http *http, const struct http_request *request, struct http_reply *ret_reply, struct error *err)
{
	struct http_reply reply = {0};
	struct transfer transfer = {http, request, &reply};
	struct curl_slist *headers = NULL;
	const char *retry_after, *digest;
	char url[1200];
	long status = 0;
	CURLcode result;

	snprintf(url, sizeof(url), "%s%s", http->base, request->path);
	for (int i = 0; i < HTTP_HEADERS_MAX && request->headers[i] != NULL; i++)
		headers = curl_slist_append(headers, request->headers[i]);
	if (http->authorization != NULL)
		headers = curl_slist_append(headers, http->authorization);
	http->message[0] = 0;
	curl_easy_setopt(http->easy, CURLOPT_URL, url);
	curl_easy_setopt(http->easy, CURLOPT_HTTPHEADER, headers);
	curl_easy_setopt(http->easy, CURLOPT_WRITEFUNCTION, on_body);
	curl_easy_setopt(http->easy, CURLOPT_WRITEDATA, &transfer);
	curl_easy_setopt(http->easy, CURLOPT_ACCEPT_ENCODING, request->decompress ? "zstd" : NULL);
	curl_easy_setopt(http->easy, CURLOPT_NOBODY, 0L);
	if (request->body != NULL) {
		curl_easy_setopt(http->easy, CURLOPT_POSTFIELDSIZE_LARGE, (curl_off_t)request->length);
		curl_easy_setopt(http->easy, CURLOPT_POSTFIELDS, request->body);
	} else if (strcmp(request->method, "HEAD") == 0) {
		curl_easy_setopt(http->easy, CURLOPT_NOBODY, 1L);
	} else {
		curl_easy_setopt(http->easy, CURLOPT_HTTPGET, 1L);
	}
	curl_easy_setopt(http->easy, CURLOPT_CUSTOMREQUEST, request->method);
	result = curl_easy_perform(http->easy);
	curl_slist_free_all(headers);

	curl_easy_getinfo(http->easy, CURLINFO_RESPONSE_CODE, &status);
	retry_after = reply_header(http, "Retry-After");
	reply.status = (int)status;
	http->retry_after = retry_after != NULL ? strtod(retry_after, NULL) : 0;
	http->unreachable = result == CURLE_COULDNT_CONNECT || result == CURLE_COULDNT_RESOLVE_HOST;
	disposition_name(reply_header(http, "Content-Disposition"), reply.name);
	digest = reply_header(http, "Repr-Digest");
	snprintf(reply.digest, sizeof(reply.digest), "%s", digest != NULL ? digest : "");
	*ret_reply = reply;
	/* A refusal that came before the whole body was sent counts, though the sending broke. */
	if (status >= 300)
		return problem(request, &reply, err);
	return result == CURLE_OK ? 0 : no_reply(http, result, err);
}

bool http_unreachable(const struct http *http)
{
	return http->unreachable;
}

bool http_again(struct http *http, int code, int attempt)
{
	static const double pauses[] = {0.1, 0.2, 0.4, 0.8, 1.6, 3.2};
	enum { PAUSE_COUNT = sizeof(pauses) / sizeof(pauses[0]) };
	double pause;

	if ((code != ERR_IO && code != ERR_BUSY) || attempt >= PAUSE_COUNT)
		return false;
	/* Somebody's idea of an hour is not waited for. */
	pause = fmin(fmax(pauses[attempt], http->retry_after), 30);
	nanosleep(&(struct timespec){(time_t)pause, (long)(1e9 * (pause - floor(pause)))}, NULL);
	return true;
}

static int send_json(struct http *http, const struct http_request *request, cJSON **ret_document, struct error *err)
{
	struct http_reply reply;
	cJSON *document = NULL;
	int code = http_send(http, request, &reply, err);

	if (code == 0 && reply.length > 0)
		code = json_parse(reply.body, reply.length, &document, err);
	if (code == 0)
		*ret_document = document;
	http_reply_clear(&reply);
	return code;
}

int http_json(struct http *http, const char *method, const char *path, cJSON **ret_document, struct error *err)
{
	return send_json(http, &(struct http_request){.method = method, .path = path}, ret_document, err);
}

int http_post(struct http *http, const char *path, const cJSON *document, const char *idempotency_key,
	      cJSON **ret_document, struct error *err)
{
	char *text = json_print(document, NULL), key[160];
	int code;

	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a document");
	struct http_request request = {.method = "POST",
				       .path = path,
				       .body = text,
				       .length = strlen(text),
				       .headers = {"Content-Type: application/json"}};

	if (idempotency_key != NULL) {
		snprintf(key, sizeof(key), "Idempotency-Key: %s", idempotency_key);
		request.headers[1] = key;
	}
	code = send_json(http, &request, ret_document, err);
	free(text);
	return code;
}

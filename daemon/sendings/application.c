/*
 * Our own application entity: the members "title", "listen" and "worklist" of the file of destinations, the listener's
 * process, and the worklist as its peer has told it last.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/sendings/internal.h"
#include "proto/clock.h"
#include "proto/recipe.h"
#include "proto/worklist.h"

/* PS3.5 6.2: AE. The default repertoire without backslash and controls, no blanks around. */
static void check_title(struct json_reader *reader, const char *name, const char *title)
{
	const size_t length = strlen(title);
	bool good = length > 0 && length < TITLE_SIZE && title[0] != ' ' && title[length - 1] != ' ';

	for (size_t i = 0; i < length; i++)
		good = good && title[i] >= 0x20 && title[i] <= 0x7e && title[i] != '\\';
	if (!good)
		json_fail(reader, ERR_INVALID, name,
			  "an application entity's title has 1 to 16 ASCII characters without \\ and without blanks "
			  "around");
}

static void read_title(struct json_reader *reader, const char *name, bool required, char ret[TITLE_SIZE])
{
	const bool told = json_has(reader, name);

	json_string(reader, name, required, ret, TITLE_SIZE);
	if (reader->code == 0 && told)
		check_title(reader, name, ret);
}

/* A name or an IPv4 address, as a resolver takes it: what is none would be looked up in vain at every attempt. */
static void read_host(struct json_reader *reader, char *ret, size_t size)
{
	static const char letters[] = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-_";

	json_string(reader, "host", true, ret, size);
	if (reader->code == 0 &&
	    (ret[0] == '\0' || strchr(".-", ret[0]) != NULL || strspn(ret, letters) != strlen(ret)))
		json_fail(reader, ERR_INVALID, "host", "expected the name or the IPv4 address of a host");
}

void application_file(struct json_reader *reader, const char *name)
{
	char path[1024] = "";

	if (!json_has(reader, name))
		return;
	json_string(reader, name, true, path, sizeof(path));
	if (reader->code == 0 && access(path, R_OK) != 0)
		json_fail(reader, ERR_INVALID, name, "the file %.200s cannot be read: %s", path, strerror(errno));
}

/* TLS: the authority of the peer's certificate, and what we show it. */
static void read_tls(struct json_reader *reader)
{
	application_file(reader, "ca_file");
	application_file(reader, "certificate_file");
	application_file(reader, "key_file");
	if (reader->code != 0)
		return;
	if (json_has(reader, "certificate_file") != json_has(reader, "key_file"))
		json_fail(reader, ERR_INVALID, "key_file", "certificate_file and key_file go together");
	else if (json_has(reader, "key_file") && !json_has(reader, "ca_file"))
		json_fail(reader, ERR_INVALID, "ca_file", "TLS needs the authority of the peer's certificate");
}

void application_peer(struct json_reader *reader, char *ret_address, size_t size)
{
	char host[256] = "", title[TITLE_SIZE] = "";
	double seconds;
	long port = 104;

	read_host(reader, host, sizeof(host));
	json_integer(reader, "port", true, 1, 65535, &port);
	read_title(reader, "title", true, title);
	json_number(reader, "timeout_s", false, 1, 3600, &seconds);
	read_tls(reader);
	snprintf(ret_address, size, "%s@%.250s:%ld", title, host, port);
}

static void read_worklist(const cJSON *value, struct json_reader *outer)
{
	char address[320], modality[TITLE_SIZE] = "", station[TITLE_SIZE] = "";
	struct json_reader reader;
	long days;

	json_begin(&reader, value, "/worklist", outer->err);
	application_peer(&reader, address, sizeof(address));
	json_string(&reader, "modality", false, modality, sizeof(modality));
	read_title(&reader, "station", false, station);
	json_integer(&reader, "days", false, 1, 31, &days);
	if (json_end(&reader) != 0)
		outer->code = reader.code;
}

/*
 * Options of `cbct import` about images, geometry and numbers; what it connects to and what it writes is not the file's
 * to say. http/dimse holds this list against the program's own help.
 */
static const char *const import_options[] = {
    "name",
    "pattern",
    "size",
    "type",
    "big-endian",
    "header",
    "flip-columns",
    "flip-rows",
    "inverted",
    "rtk",
    "trust",
    "matrices",
    "first-pixel",
    "astra",
    "angles",
    "first-angle",
    "angle-step",
    "clockwise",
    "radians",
    "pixel",
    "source-to-isocentre",
    "source-to-detector",
    "detector-offset",
    "patient",
    "source-offset",
    "quantity",
    "sample",
    "air",
    "air-region",
    "beam-hardening",
    "correct",
    "saturation",
    "flat",
    "dark",
    "defects",
    "scale",
    "bias",
};

static void check_import(struct json_reader *reader, const cJSON *import)
{
	const cJSON *option;

	if (import != NULL && !cJSON_IsObject(import))
		json_fail(reader, ERR_INVALID, "import", "expected an object");
	cJSON_ArrayForEach(option, import)
	{
		bool known = false;
		char place[80];

		for (size_t i = 0; i < sizeof(import_options) / sizeof(import_options[0]); i++)
			known |= strcmp(option->string, import_options[i]) == 0;
		snprintf(place, sizeof(place), "import/%.60s", option->string);
		if (!known)
			json_fail(reader, ERR_INVALID, place,
				  "expected an option of cbct import about images, geometry or numbers");
		else if (!(cJSON_IsString(option) || cJSON_IsNumber(option) || cJSON_IsTrue(option)))
			json_fail(reader, ERR_INVALID, place, "expected a text, a number or true");
	}
}

/* The job of each run: as it would be posted, but for the scan, which is yet to come. */
static void check_job(struct json_reader *reader, const cJSON *job)
{
	cJSON *whole = cJSON_IsObject(job) ? cJSON_Duplicate(job, true) : NULL;
	struct job_request request;
	struct error cause = {0};
	char place[sizeof(cause.pointer) + 8];

	if (job == NULL || reader->code != 0)
		return;
	if (whole == NULL || cJSON_HasObjectItem(job, "scan")) {
		json_fail(reader, ERR_INVALID, "job", "expected a job's document without its scan");
	} else {
		cJSON_AddStringToObject(whole, "scan", "received");
		if (job_request_read(whole, &request, &cause) != 0) {
			snprintf(place, sizeof(place), "job%s", cause.pointer);
			json_fail(reader, ERR_INVALID, place, "%.160s", cause.text);
		} else {
			job_request_clear(&request);
		}
	}
	cJSON_Delete(whole);
}

static void read_receive(const cJSON *value, struct json_reader *outer)
{
	struct json_reader reader;
	char url[1024] = "";
	double number;

	json_begin(&reader, value, "/listen/receive", outer->err);
	json_string(&reader, "url", true, url, sizeof(url));
	if (reader.code == 0 && strncmp(url, "http://", 7) != 0 && strncmp(url, "https://", 8) != 0 &&
	    strncmp(url, "unix:/", 6) != 0)
		json_fail(&reader, ERR_INVALID, "url", "expected http://, https:// or unix:/PATH");
	application_file(&reader, "token-file");
	application_file(&reader, "cacert");
	json_number(&reader, "quiet_s", false, 0.1, 3600, &number);
	json_number(&reader, "max_bytes", false, 1024, 1e13, &number);
	check_import(&reader, json_member(&reader, "import", false));
	check_job(&reader, json_member(&reader, "job", false));
	if (json_end(&reader) != 0)
		outer->code = reader.code;
}

static void read_listen(const cJSON *value, struct json_reader *outer)
{
	const cJSON *peers, *peer, *receive;
	struct json_reader reader;
	char address[64] = "", place[32];
	struct in_addr ignored;
	double seconds;
	int count = 0;
	long port;

	json_begin(&reader, value, "/listen", outer->err);
	json_integer(&reader, "port", true, 1, 65535, &port);
	json_string(&reader, "address", false, address, sizeof(address));
	if (reader.code == 0 && json_has(&reader, "address") && inet_pton(AF_INET, address, &ignored) != 1)
		json_fail(&reader, ERR_INVALID, "address", "expected an IPv4 address to listen on");
	json_number(&reader, "timeout_s", false, 1, 3600, &seconds);
	peers = json_member(&reader, "peers", true);
	receive = json_member(&reader, "receive", false);
	if (reader.code == 0 &&
	    (!cJSON_IsArray(peers) || cJSON_GetArraySize(peers) < 1 || cJSON_GetArraySize(peers) > 64))
		json_fail(&reader, ERR_INVALID, "peers", "expected a list of 1 to 64 titles that may call");
	cJSON_ArrayForEach(peer, peers)
	{
		snprintf(place, sizeof(place), "peers/%d", count++);
		if (reader.code == 0)
			check_title(&reader, place, cJSON_IsString(peer) ? peer->valuestring : "");
	}
	if (reader.code == 0 && receive != NULL)
		read_receive(receive, &reader);
	if (json_end(&reader) != 0)
		outer->code = reader.code;
}

static cJSON *copy_of(const cJSON *value, const struct application *application)
{
	cJSON *copy = cJSON_Duplicate(value, true);

	cJSON_AddStringToObject(copy, "own_title", application->title);
	return copy;
}

void application_read(struct json_reader *reader, struct application *ret)
{
	const cJSON *listen, *worklist;

	*ret = (struct application){.title = "CBCTD"};
	read_title(reader, "title", false, ret->title);
	listen = json_member(reader, "listen", false);
	worklist = json_member(reader, "worklist", false);
	if (reader->code == 0 && listen != NULL)
		read_listen(listen, reader);
	if (reader->code == 0 && worklist != NULL)
		read_worklist(worklist, reader);
	if (reader->code != 0)
		return;
	ret->listen = listen != NULL ? copy_of(listen, ret) : NULL;
	ret->worklist = worklist != NULL ? copy_of(worklist, ret) : NULL;
}

void application_free(struct application *application)
{
	cJSON_Delete(application->listen);
	cJSON_Delete(application->worklist);
	*application = (struct application){.title = ""};
}

/* ---- its processes ---- */

char *application_task(const struct sendings *sendings, int transfer)
{
	const bool listens = transfer == TRANSFER_LISTENER;
	const cJSON *row = listens ? sendings->application.listen : sendings->application.worklist;
	cJSON *task = row != NULL ? cJSON_CreateObject() : NULL, *copy;
	char *text, *line = NULL, directory[1100];

	if (task == NULL)
		return NULL;
	copy = cJSON_Duplicate(row, true);
	if (listens) {
		snprintf(directory, sizeof(directory), "%s/received", store_directory(sendings->store));
		cJSON_AddStringToObject(copy, "directory", directory);
	}
	json_add(task, listens ? "listen" : "worklist", copy);
	text = json_print(task, NULL);
	cJSON_Delete(task);
	if (text == NULL || asprintf(&line, "%s\n", text) < 0)
		line = NULL;
	free(text);
	return line;
}

static const char *text_of(const cJSON *object, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsString(member) ? member->valuestring : "";
}

static int number_of(const cJSON *object, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsNumber(member) ? member->valueint : 0;
}

static void take_received(const cJSON *received)
{
	const char *scan = text_of(received, "scan"), *job = text_of(received, "job"),
		   *error = text_of(received, "error");

	if (scan[0] == '\0')
		log_line(LEVEL_ERROR,
			 "a run of projections that was received cannot be imported, and stays in received/: %.300s",
			 error);
	else if (error[0] != '\0')
		log_line(LEVEL_ERROR, "a run of projections that was received is scan %.40s, and gets no job: %.300s",
			 scan, error);
	else if (job[0] != '\0')
		log_line(LEVEL_INFO, "a run of projections that was received is scan %.40s, reconstructed by job %.40s",
			 scan, job);
	else
		log_line(LEVEL_INFO, "a run of projections that was received is scan %.40s", scan);
}

static void take_listener(struct sendings *sendings, const cJSON *line)
{
	const cJSON *promise = cJSON_GetObjectItemCaseSensitive(line, "promise");
	const cJSON *received = cJSON_GetObjectItemCaseSensitive(line, "received");
	const cJSON *refused = cJSON_GetObjectItemCaseSensitive(line, "refused");

	if (cJSON_HasObjectItem(line, "listening"))
		log_line(LEVEL_INFO, "listening for DICOM associations as %s, port %d", sendings->application.title,
			 number_of(sendings->application.listen, "port"));
	if (promise != NULL)
		sender_promised(sendings, text_of(promise, "transaction"), number_of(promise, "kept"),
				number_of(promise, "refused"), number_of(promise, "reason"));
	if (received != NULL)
		take_received(received);
	if (refused != NULL)
		log_line(LEVEL_WARNING, "an association from %.40s, %s, is refused: %.160s%s",
			 text_of(refused, "address"),
			 text_of(refused, "title")[0] != '\0' ? text_of(refused, "title") : "without a title",
			 text_of(refused, "why"), text_of(refused, "more"));
}

void application_take(struct sendings *sendings, int transfer, const cJSON *line)
{
	const cJSON *step = cJSON_GetObjectItemCaseSensitive(line, "step");

	if (transfer == TRANSFER_LISTENER)
		take_listener(sendings, line);
	else if (cJSON_IsObject(step) && cJSON_GetArraySize(sendings->steps) < WORKLIST_MOST)
		json_append(sendings->steps, cJSON_Duplicate(step, true));
	else if (step != NULL)
		sendings->worklist.nobodys++;
}

void application_ended(struct sendings *sendings, int transfer, const cJSON *result, const char *how)
{
	const char *error = text_of(result, "error");
	struct worklist *worklist = &sendings->worklist;

	if (transfer == TRANSFER_LISTENER) {
		/* s before another one starts; what no attempt would change is not told all day. */
		const double pause = cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(result, "permanent")) ? 3600 : 10;

		if (!sendings->stop && !sendings->listener_stale)
			log_line(LEVEL_ERROR, "the process that listens for DICOM associations ended: %s",
				 error[0] != '\0' ? error : how);
		sendings->listen_at = clock_monotonic() + (sendings->listener_stale ? 0 : pause);
		sendings->listener_stale = false;
		return;
	}
	/* Another worklist is asked in its place; nobody waits for what the old one would have said. */
	if (sendings->worklist_stale) {
		cJSON_Delete(sendings->steps);
		sendings->steps = NULL;
		return;
	}
	worklist->wanted = false;
	worklist->checked = clock_realtime();
	snprintf(worklist->error, sizeof(worklist->error), "%s", result != NULL ? error : how);
	if (result != NULL && error[0] == '\0') {
		cJSON_Delete(worklist->steps);
		worklist->steps = sendings->steps;
		sendings->steps = NULL;
	}
	cJSON_Delete(sendings->steps);
	sendings->steps = NULL;
}

void worklist_forget(struct sendings *sendings)
{
	cJSON_Delete(sendings->worklist.steps);
	sendings->worklist =
	    (struct worklist){.wanted = sendings->worklist.wanted && sendings->application.worklist != NULL};
	sendings->worklist_stale = true;
}

/* ---- what the API shows ---- */

int worklist_ask(struct sendings *sendings, struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&sendings->lock);
	if (sendings->application.worklist == NULL)
		code = error_set(err, ERR_NOT_FOUND, "the file of destinations names no worklist");
	else
		sendings->worklist.wanted = true;
	pthread_mutex_unlock(&sendings->lock);
	sender_wake(sendings);
	return code;
}

bool worklist_asked(struct sendings *sendings)
{
	bool asked;

	pthread_mutex_lock(&sendings->lock);
	asked = sendings->worklist.wanted;
	pthread_mutex_unlock(&sendings->lock);
	return asked;
}

cJSON *worklist_document(struct sendings *sendings)
{
	cJSON *document = cJSON_CreateObject();
	const struct worklist *worklist = &sendings->worklist;

	pthread_mutex_lock(&sendings->lock);
	json_add(document, "steps",
		 worklist->steps != NULL ? cJSON_Duplicate(worklist->steps, true) : cJSON_CreateArray());
	cJSON_AddNumberToObject(document, "not_shown", worklist->nobodys);
	json_add_time(document, "checked", worklist->checked);
	if (worklist->wanted)
		cJSON_AddStringToObject(
		    document, "detail",
		    worklist->checked > 0
			? "it has not answered yet: these are the steps that it told when it was asked before"
			: "it has not answered yet");
	else if (worklist->error[0] != '\0')
		cJSON_AddStringToObject(document, "detail", worklist->error);
	else
		cJSON_AddNullToObject(document, "detail");
	pthread_mutex_unlock(&sendings->lock);
	return document;
}

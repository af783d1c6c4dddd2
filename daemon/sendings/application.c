/*
 * Our own application entity: the members "title", "listen" and "worklist" of the file of destinations, the listener's
 * process, and the worklist as its peer has told it last.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/log.h"
#include "daemon/sendings/internal.h"
#include "proto/clock.h"
#include "proto/worklist.h"

/* PS3.5 6.2: AE. The default repertoire without backslash and controls, no blanks around. */
static void read_title(struct json_reader *reader, const char *name, bool required, char ret[TITLE_SIZE])
{
	json_string(reader, name, required, ret, TITLE_SIZE);
	for (const char *at = ret; reader->code == 0 && *at != '\0'; at++)
		if (*at < 0x20 || *at > 0x7e || *at == '\\' || (*at == ' ' && (at == ret || at[1] == '\0'))) {
			json_fail(reader, ERR_INVALID, name,
				  "an application entity's title has up to 16 ASCII characters without \\ and without "
				  "blanks around");
			return;
		}
	if (reader->code == 0 && required && ret[0] == '\0')
		json_fail(reader, ERR_INVALID, name, "it is empty");
}

void application_peer(struct json_reader *reader, char *ret_address, size_t size)
{
	char host[256] = "", title[TITLE_SIZE] = "";
	double seconds;
	long port = 104;

	json_string(reader, "host", true, host, sizeof(host));
	json_integer(reader, "port", true, 1, 65535, &port);
	read_title(reader, "title", true, title);
	json_number(reader, "timeout_s", false, 1, 3600, &seconds);
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

/* Options of `cbct import`: texts, numbers and true. */
static void check_import(struct json_reader *reader, const cJSON *import)
{
	const cJSON *option;

	cJSON_ArrayForEach(option, import)
	{
		const char *name = option->string;

		if (strspn(name, "abcdefghijklmnopqrstuvwxyz-") != strlen(name) || name[0] == '-' ||
		    !(cJSON_IsString(option) || cJSON_IsNumber(option) || cJSON_IsTrue(option)))
			json_fail(reader, ERR_INVALID, "import",
				  "\"%.40s\": expected an option of cbct import, with a "
				  "text, a number or true",
				  name);
	}
	if (import != NULL && !cJSON_IsObject(import))
		json_fail(reader, ERR_INVALID, "import", "expected an object");
}

static void read_receive(const cJSON *value, struct json_reader *outer)
{
	struct json_reader reader;
	char path[1024] = "";
	double number;

	json_begin(&reader, value, "/listen/receive", outer->err);
	json_string(&reader, "url", true, path, sizeof(path));
	json_string(&reader, "token-file", false, path, sizeof(path));
	json_string(&reader, "cacert", false, path, sizeof(path));
	json_number(&reader, "quiet_s", false, 0.1, 3600, &number);
	json_number(&reader, "max_bytes", false, 1024, 1e13, &number);
	check_import(&reader, json_member(&reader, "import", false));
	if (json_end(&reader) != 0)
		outer->code = reader.code;
}

static void read_listen(const cJSON *value, struct json_reader *outer)
{
	const cJSON *peers, *peer, *receive;
	struct json_reader reader;
	char address[64] = "";
	double seconds;
	long port;

	json_begin(&reader, value, "/listen", outer->err);
	json_integer(&reader, "port", true, 1, 65535, &port);
	json_string(&reader, "address", false, address, sizeof(address));
	json_number(&reader, "timeout_s", false, 1, 3600, &seconds);
	peers = json_member(&reader, "peers", true);
	receive = json_member(&reader, "receive", false);
	if (reader.code == 0 &&
	    (!cJSON_IsArray(peers) || cJSON_GetArraySize(peers) < 1 || cJSON_GetArraySize(peers) > 64))
		json_fail(&reader, ERR_INVALID, "peers", "expected a list of 1 to 64 titles that may call");
	cJSON_ArrayForEach(peer, peers)
	{
		if (reader.code == 0 && (!cJSON_IsString(peer) || strlen(peer->valuestring) >= TITLE_SIZE))
			json_fail(&reader, ERR_INVALID, "peers", "expected titles of up to 16 characters");
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
	cJSON_AddItemToObject(task, listens ? "listen" : "worklist", copy);
	if (listens) {
		snprintf(directory, sizeof(directory), "%s/received", store_directory(sendings->store));
		cJSON_AddStringToObject(copy, "directory", directory);
	}
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

static void take_listener(struct sendings *sendings, const cJSON *line)
{
	const cJSON *promise = cJSON_GetObjectItemCaseSensitive(line, "promise");
	const cJSON *received = cJSON_GetObjectItemCaseSensitive(line, "received");

	if (cJSON_HasObjectItem(line, "listening"))
		log_line(LEVEL_INFO, "listening for DICOM associations as %s, port %d", sendings->application.title,
			 number_of(sendings->application.listen, "port"));
	if (promise != NULL)
		sender_promised(sendings, text_of(promise, "transaction"), number_of(promise, "kept"),
				number_of(promise, "refused"), number_of(promise, "reason"));
	if (received != NULL && text_of(received, "scan")[0] != '\0')
		log_line(LEVEL_INFO, "a run of projections that was received is scan %.40s", text_of(received, "scan"));
	else if (received != NULL)
		log_line(LEVEL_ERROR,
			 "a run of projections that was received cannot be imported, and stays in received/: %.300s",
			 text_of(received, "error"));
}

void application_take(struct sendings *sendings, int transfer, const cJSON *line)
{
	const cJSON *step = cJSON_GetObjectItemCaseSensitive(line, "step");

	if (transfer == TRANSFER_LISTENER)
		take_listener(sendings, line);
	else if (cJSON_IsObject(step) && cJSON_GetArraySize(sendings->steps) < WORKLIST_MOST)
		cJSON_AddItemToArray(sendings->steps, cJSON_Duplicate(step, true));
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
	cJSON_AddItemToObject(document, "steps",
			      worklist->steps != NULL ? cJSON_Duplicate(worklist->steps, true) : cJSON_CreateArray());
	cJSON_AddNumberToObject(document, "not_shown", worklist->nobodys);
	json_add_time(document, "checked", worklist->checked);
	if (worklist->error[0] != '\0')
		cJSON_AddStringToObject(document, "detail", worklist->error);
	else
		cJSON_AddNullToObject(document, "detail");
	pthread_mutex_unlock(&sendings->lock);
	return document;
}

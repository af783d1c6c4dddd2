/*
 * Destinations: a JSON file {"destinations": [{"name": ..., "kind": "dicomweb" | "dimse", ...}]}, with what
 * application.c reads. Their secrets are in files of their own, which cbct-dicom alone reads.
 */
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/log.h"
#include "daemon/sendings/internal.h"
#include "proto/scan_directory.h"

enum { FILE_MOST = 1 << 20, DESTINATIONS_MOST = 64 };

static const char *const kind_names[DESTINATION_KIND_COUNT] = {"dicomweb", "dimse", "mpps"};

void destinations_free(struct destination *destinations, int count)
{
	for (int i = 0; i < count; i++)
		cJSON_Delete(destinations[i].row);
	free(destinations);
}

struct destination *destination_find(const struct sendings *sendings, const char *name)
{
	for (int i = 0; i < sendings->destination_count; i++)
		if (strcmp(sendings->destinations[i].name, name) == 0)
			return &sendings->destinations[i];
	return NULL;
}

/* ---- reading ---- */

static void read_web(struct json_reader *reader, struct destination *ret)
{
	json_string(reader, "url", true, ret->address, sizeof(ret->address));
	application_file(reader, "token_file");
	application_file(reader, "ca_file");
	if (reader->code == 0 && strncmp(ret->address, "http://", 7) != 0 && strncmp(ret->address, "https://", 8) != 0)
		json_fail(reader, ERR_INVALID, "url", "expected http:// or https://");
	/* A document shows the URL. */
	if (reader->code == 0 && strpbrk(ret->address, "@?#") != NULL)
		json_fail(reader, ERR_INVALID, "url",
			  "a URL with a name, password or query is not taken; a token stands in token_file");
}

static void read_network(struct json_reader *reader, struct destination *ret)
{
	bool unproven;

	application_peer(reader, ret->address, sizeof(ret->address));
	ret->promise_seconds = 600;
	json_number(reader, "commitment_s", false, 0, 1e6, &ret->promise_seconds);
	json_bool(reader, "unproven", false, &unproven);
}

/* "none", "last", "all", or a list of iterations as a job's "volumes". */
static void read_rule(struct json_reader *reader, char ret_rule[SEND_VOLUMES_SIZE])
{
	const cJSON *value = json_member(reader, "send", false);
	struct send_wish wish;
	cJSON *wanted;

	ret_rule[0] = '\0';
	if (reader->code != 0 || value == NULL || (cJSON_IsString(value) && strcmp(value->valuestring, "none") == 0))
		return;
	wanted = cJSON_CreateObject();
	cJSON_AddStringToObject(wanted, "to", "rule");
	json_add(wanted, "volumes", cJSON_Duplicate(value, true));
	if (send_wish_read(wanted, "", &wish, reader->err) != 0)
		json_fail(reader, ERR_INVALID, "send",
			  "expected \"none\", \"last\", \"all\" or a list of iterations, \"fdk\" and \"fdk-tv\"");
	else
		memcpy(ret_rule, wish.volumes, SEND_VOLUMES_SIZE);
	cJSON_Delete(wanted);
}

static int read_row(const cJSON *value, int place, struct destination *ret, struct error *err)
{
	struct json_reader reader;
	int kind = 0, objects = 0;
	double seconds;
	char pointer[64];

	snprintf(pointer, sizeof(pointer), "/destinations/%d", place);
	json_begin(&reader, value, pointer, err);
	json_string(&reader, "name", true, ret->name, sizeof(ret->name));
	json_choice(&reader, "kind", true, kind_names, DESTINATION_KIND_COUNT, &kind);
	/* A destination that is told of steps takes no volumes. */
	if (kind != DESTINATION_MPPS) {
		json_choice(&reader, "objects", false, dicom_kind_names, DICOM_KIND_COUNT, &objects);
		read_rule(&reader, ret->rule);
	}
	if (reader.code == 0 && !destination_name_valid(ret->name))
		json_fail(&reader, ERR_INVALID, "name", "\"%s\" is no name: letters, digits, -, _ and .", ret->name);
	if (kind == DESTINATION_DIMSE) {
		read_network(&reader, ret);
	} else if (kind == DESTINATION_MPPS) {
		application_peer(&reader, ret->address, sizeof(ret->address));
	} else {
		read_web(&reader, ret);
		json_number(&reader, "timeout_s", false, 1, 3600, &seconds);
	}
	ret->kind = (enum destination_kind)kind;
	ret->objects = (enum dicom_kind)objects;
	ret->wanted = true;
	return json_end(&reader);
}

static int two_of(const char *name, int place, struct error *err)
{
	char pointer[64];

	snprintf(pointer, sizeof(pointer), "/destinations/%d/name", place);
	return error_set_at(err, ERR_INVALID, pointer, "two destinations are called %s", name);
}

static int read_list(const cJSON *list, struct destination **ret_destinations, int *ret_count, struct error *err)
{
	const int count = cJSON_GetArraySize(list);
	struct destination *read;
	const cJSON *one;
	int i = 0, code = 0, steps = 0;

	if (!cJSON_IsArray(list) || count > DESTINATIONS_MOST)
		return error_set_at(err, ERR_INVALID, "/destinations", "expected a list of at most %d destinations",
				    DESTINATIONS_MOST);
	read = calloc((size_t)count + 1, sizeof(*read));
	if (read == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for destinations");
	cJSON_ArrayForEach(one, list)
	{
		code = read_row(one, i, &read[i], err);
		for (int k = 0; k < i && code == 0; k++)
			if (strcmp(read[k].name, read[i].name) == 0)
				code = two_of(read[i].name, i, err);
		steps += code == 0 && read[i].kind == DESTINATION_MPPS;
		if (steps > 1)
			code = error_set_at(err, ERR_INVALID, "/destinations",
					    "one destination at most is told of performed steps");
		if (code == 0 && (read[i].row = cJSON_Duplicate(one, true)) == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for destinations");
		i++;
		if (code != 0)
			break;
	}
	if (code != 0) {
		destinations_free(read, i);
		return code;
	}
	*ret_destinations = read;
	*ret_count = count;
	return 0;
}

/* The jobs of received runs send to destinations that there are. */
static int check_received(const cJSON *listen, const struct destination *destinations, int count, struct error *err)
{
	const cJSON *receive = cJSON_GetObjectItemCaseSensitive(listen, "receive");
	const cJSON *job = cJSON_GetObjectItemCaseSensitive(receive, "job");
	const char base[] = "/listen/receive/job/send";
	struct send_wish wishes[SENDS_MOST];
	char *text = NULL, pointer[sizeof(base) + 16];
	int code = sends_read(cJSON_GetObjectItemCaseSensitive(job, "send"), base, &text, err), wanted;

	wanted = code == 0 ? sends_parse(text, wishes) : 0;
	for (int i = 0; i < wanted && code == 0; i++) {
		bool known = false;

		for (int k = 0; k < count; k++)
			known |=
			    destinations[k].kind != DESTINATION_MPPS && strcmp(destinations[k].name, wishes[i].to) == 0;
		snprintf(pointer, sizeof(pointer), "%s/%d", base, i);
		if (!known)
			code = error_set_at(err, ERR_INVALID, pointer, "there is no destination \"%s\"", wishes[i].to);
	}
	free(text);
	return code;
}

int destinations_read(const char *file, struct destination **ret_destinations, int *ret_count,
		      struct application *ret_application, struct error *err)
{
	struct json_reader reader;
	struct error cause = {0};
	cJSON *document = NULL;
	const cJSON *list;
	char *text = NULL;
	size_t length;
	int code;

	*ret_destinations = NULL;
	*ret_count = 0;
	*ret_application = (struct application){.title = ""};
	if (file[0] == '\0')
		return 0;
	code = file_read(file, FILE_MOST, &text, &length, &cause);
	if (code == 0)
		code = json_parse(text, length, &document, &cause);
	if (code == 0) {
		json_begin(&reader, document, "", &cause);
		list = json_member(&reader, "destinations", true);
		application_read(&reader, ret_application);
		code = json_end(&reader);
		if (code == 0)
			code = read_list(list, ret_destinations, ret_count, &cause);
		if (code == 0)
			code = check_received(ret_application->listen, *ret_destinations, *ret_count, &cause);
		if (code != 0) {
			destinations_free(*ret_destinations, *ret_count);
			*ret_destinations = NULL;
			*ret_count = 0;
			application_free(ret_application);
		}
	}
	free(text);
	cJSON_Delete(document);
	return code == 0 ? 0
			 : error_set(err, code, "destinations %.100s: %.40s%s%.160s", file, cause.pointer,
				     cause.pointer[0] != '\0' ? ": " : "", cause.text);
}

/* What is known of a destination stays where its row has stayed; another row is another archive. The lock is held. */
static void inherit(struct sendings *sendings, struct destination *fresh, int count)
{
	for (int i = 0; i < count; i++) {
		const struct destination *old = destination_find(sendings, fresh[i].name);

		fresh[i].edition = ++sendings->editions;
		if (old == NULL || !cJSON_Compare(old->row, fresh[i].row, true))
			continue;
		fresh[i].edition = old->edition;
		fresh[i].known = old->known;
		fresh[i].reachable = old->reachable;
		fresh[i].checked = old->checked;
		fresh[i].checked_at = old->checked_at;
		memcpy(fresh[i].detail, old->detail, sizeof(fresh[i].detail));
	}
}

void sendings_reload(struct sendings *sendings)
{
	struct application application, old_application;
	struct destination *fresh, *old;
	struct error err = {0};
	int count, old_count;

	if (destinations_read(sendings->file, &fresh, &count, &application, &err) != 0) {
		log_line(LEVEL_ERROR, "the destinations that were read before stay: %s", err.text);
		return;
	}
	pthread_mutex_lock(&sendings->lock);
	inherit(sendings, fresh, count);
	old = sendings->destinations;
	old_count = sendings->destination_count;
	sendings->destinations = fresh;
	sendings->destination_count = count;
	old_application = sendings->application;
	sendings->application = application;
	/* Associations that go on are not broken off for another's change. */
	if (!cJSON_Compare(old_application.listen, application.listen, true))
		sendings->listener_stale = true;
	if (!cJSON_Compare(old_application.worklist, application.worklist, true))
		worklist_forget(sendings);
	/* A port that was taken may be free by now. */
	sendings->listen_at = 0;
	/* What was changed may be the reason why something could not be sent. */
	for (int i = 0; i < sendings->count; i++)
		sendings->entries[i].record.next = 0;
	pthread_mutex_unlock(&sendings->lock);
	destinations_free(old, old_count);
	application_free(&old_application);
	sender_wake(sendings);
}

/* ---- what the API shows ---- */

static long unsent(const struct sendings *sendings, const char *name)
{
	long count = 0;

	for (int i = 0; i < sendings->count; i++)
		count += strcmp(sendings->entries[i].record.destination, name) == 0 &&
			 sendings->entries[i].record.state != SENDING_SENT;
	return count;
}

static cJSON *document_of(const struct sendings *sendings, const struct destination *one)
{
	cJSON *document = cJSON_CreateObject();

	cJSON_AddStringToObject(document, "name", one->name);
	cJSON_AddStringToObject(document, "kind", kind_names[one->kind]);
	cJSON_AddStringToObject(document, "address", one->address);
	if (one->kind != DESTINATION_MPPS)
		cJSON_AddStringToObject(document, "objects", dicom_kind_names[one->objects]);
	else
		cJSON_AddNullToObject(document, "objects");
	json_add(document, "send", one->rule[0] != '\0' ? send_volumes_json(one->rule) : cJSON_CreateString("none"));
	if (one->known)
		cJSON_AddBoolToObject(document, "reachable", one->reachable);
	else
		cJSON_AddNullToObject(document, "reachable");
	if (one->detail[0] != '\0')
		cJSON_AddStringToObject(document, "detail", one->detail);
	else
		cJSON_AddNullToObject(document, "detail");
	json_add_time(document, "checked", one->checked);
	cJSON_AddNumberToObject(document, "unsent", (double)unsent(sendings, one->name));
	return document;
}

cJSON *destinations_document(struct sendings *sendings)
{
	cJSON *document = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(document, "destinations");

	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->destination_count; i++)
		json_append(list, document_of(sendings, &sendings->destinations[i]));
	pthread_mutex_unlock(&sendings->lock);
	return document;
}

void destinations_ask(struct sendings *sendings)
{
	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->destination_count; i++)
		sendings->destinations[i].wanted = true;
	pthread_mutex_unlock(&sendings->lock);
	sender_wake(sendings);
}

bool destinations_asked(struct sendings *sendings)
{
	bool asked = false;

	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->destination_count; i++)
		asked |= sendings->destinations[i].wanted;
	pthread_mutex_unlock(&sendings->lock);
	return asked;
}

void destinations_watch(struct sendings *sendings, struct watch *watch)
{
	watch_add(&sendings->watchers, watch);
}

void destinations_unwatch(struct sendings *sendings, struct watch *watch)
{
	watch_remove(&sendings->watchers, watch);
}

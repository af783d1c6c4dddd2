/*
 * Archives of DICOM's own protocol: objects go by C-STORE, over several associations at once; what the archive has is
 * asked by C-FIND, and storage commitment has it promise to keep them. The protocol itself: dimse.h.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <unistd.h>

#include "daemon/dicom/dicom.h"

enum { ASSOCIATIONS = 3, PROMISE_SECONDS = 1 /* for an answer on the association that asked */ };

struct dimse_peer row_peer(const cJSON *row)
{
	return (struct dimse_peer){.host = destination_text(row, "host"),
				   .port = (int)destination_number(row, "port", 104),
				   .title = destination_text(row, "title"),
				   .own = destination_text(row, "own_title"),
				   .seconds = (int)ceil(destination_patience(row, 0)),
				   .authority = destination_text(row, "ca_file"),
				   .certificate = destination_text(row, "certificate_file"),
				   .key = destination_text(row, "key_file")};
}

static int begin(const cJSON *destination, enum dimse_service service, const char *class_uid, struct dimse **ret_dimse,
		 struct error *err)
{
	const struct dimse_peer peer = row_peer(destination);

	if (!dimse_built())
		return error_set(err, ERR_IMPOSSIBLE,
				 "this cbct-dicom was built without DCMTK (libdcmtk-dev): it has no C-STORE");
	patience(2 * peer.seconds);
	return dimse_open(&peer, service, class_uid, ret_dimse, err);
}

static int network_ask(const cJSON *destination, struct error *err)
{
	struct dimse *dimse = NULL;
	int code = begin(destination, DIMSE_ECHO, NULL, &dimse, err);

	if (code == 0)
		code = dimse_echo(dimse, err);
	if (dimse != NULL)
		dimse_close(dimse);
	return code;
}

static void mark(void *objects, const char *instance)
{
	objects_mark(objects, instance);
}

static int network_find(const cJSON *destination, struct objects *objects, struct error *err)
{
	const struct dicom_head *head = &objects->list[0].head;
	struct dimse *dimse = NULL;
	int code = begin(destination, DIMSE_FIND, NULL, &dimse, err);

	for (int i = 0; i < objects->count; i++)
		objects->list[i].stored = false;
	/* More than were sent are another's, who then has the series' UID. */
	if (code == 0) {
		patience(destination_patience(destination, 2048 * (double)objects->count));
		code = dimse_find(dimse, head->study, head->series, 2 * objects->count, mark, objects, err);
	}
	if (dimse != NULL)
		dimse_close(dimse);
	return code;
}

/* What an object's bytes may take is not its answer's, byte by byte: those that have gone out need none any more. */
struct sending {
	const cJSON *destination;
	size_t size;
};

static void sent(const void *context, size_t bytes)
{
	const struct sending *sending = context;

	patience(
	    destination_patience(sending->destination, bytes < sending->size ? (double)(sending->size - bytes) : 0));
}

static void *send_some(void *context)
{
	struct load *load = context;
	struct dimse *dimse = NULL;
	struct error err = {0};
	int place, code = begin(load->destination, DIMSE_STORE, load->objects->class, &dimse, &err);

	/* An archive that can be asked and does not take the class will never. */
	if (code == ERR_NOT_FOUND)
		code = error_set(&err, ERR_IMPOSSIBLE, "it does not take %s: \"objects\" of its row chooses another",
				 dicom_class_name(load->objects->words.kind));
	while (code == 0 && (place = load_next(load)) >= 0) {
		uint8_t *bytes = NULL;
		size_t size, dataset;

		code = object_make(load->objects, place, &bytes, &size, &dataset, &err);
		if (code == 0) {
			const struct sending sending = {load->destination, size};

			patience(destination_patience(load->destination, (double)size));
			code = dimse_store(dimse, bytes, size, sent, &sending, &err);
		}
		free(bytes);
		if (code == 0)
			report_progress(1);
	}
	if (code != 0)
		load_fail(load, &err);
	if (dimse != NULL)
		dimse_close(dimse);
	return NULL;
}

static int network_store(const cJSON *destination, const struct objects *objects, struct error *err)
{
	return load_run(destination, objects, ASSOCIATIONS, send_some, err);
}

/* A UID that nobody has had before: a random number below the root 2.25 (PS3.5 B.2). */
static int make_transaction(char ret_uid[65], struct error *err)
{
	enum { DIGITS = 37 }; /* of a number below 2^128 */
	unsigned char random[DIGITS];
	char digits[DIGITS + 1] = "";

	if (getrandom(random, sizeof(random), 0) != sizeof(random))
		return error_set(err, ERR_IO, "no random numbers");
	for (int i = 0; i < DIGITS; i++)
		digits[i] = (char)('0' + (i == 0 ? 1 + random[i] % 9 : random[i] % 10));
	snprintf(ret_uid, 65, "2.25.%s", digits);
	return 0;
}

static int judge_promise(const struct objects *objects, const struct dimse_promise *promise, struct error *err)
{
	if (promise->refused > 0 || promise->kept < objects->count)
		return error_set(err, ERR_IO, "it promises to keep %d of %d objects, reason 0x%04x", promise->kept,
				 objects->count, (unsigned)promise->reason);
	return 0;
}

static int network_commit(const cJSON *destination, const struct objects *objects, enum promise *ret_promise,
			  struct error *err)
{
	const char **instances = calloc((size_t)objects->count, sizeof(*instances));
	struct dimse_promise promise;
	struct dimse *dimse = NULL;
	char transaction[65];
	bool answered = false;
	int code = instances == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a request")
				     : make_transaction(transaction, err);

	if (code == 0 && destination_number(destination, "commitment_s", 600) == 0)
		code = ERR_NOT_FOUND;
	if (code == 0)
		code = begin(destination, DIMSE_COMMIT, NULL, &dimse, err);
	if (code == 0) {
		for (int i = 0; i < objects->count; i++)
			instances[i] = objects->list[i].head.instance;
		/* The daemon knows it before the archive does. */
		report_transaction(transaction);
		patience(destination_patience(destination, 0) + PROMISE_SECONDS);
		code = dimse_commit(dimse, objects->class, instances, objects->count, transaction, PROMISE_SECONDS,
				    &answered, &promise, err);
	}
	if (code == 0)
		*ret_promise = answered ? PROMISE_GIVEN : PROMISE_ASKED;
	if (code == 0 && answered && (code = judge_promise(objects, &promise, err)) != 0)
		*ret_promise = PROMISE_REFUSED;
	if (dimse != NULL)
		dimse_close(dimse);
	free(instances);
	if (code != ERR_NOT_FOUND)
		return code;
	*ret_promise = PROMISE_UNKNOWN;
	return 0;
}

const struct archive archive_network = {"dimse", network_ask, network_find, network_store, network_commit};

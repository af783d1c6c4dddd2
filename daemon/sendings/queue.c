/* Sendings that have not ended, and what clients ask of them: sendings.h. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/sendings/internal.h"
#include "proto/clock.h"

static bool has_ended(const struct sending_record *record)
{
	return record->ended != 0;
}

/* ---- entries; the lock is held ---- */

struct entry *entry_find(struct sendings *sendings, const char *job, const char *name)
{
	for (int i = 0; i < sendings->count; i++)
		if (strcmp(sendings->entries[i].job, job) == 0 && strcmp(sendings->entries[i].record.name, name) == 0)
			return &sendings->entries[i];
	return NULL;
}

struct entry *entry_promised(struct sendings *sendings, const char *transaction)
{
	for (int i = 0; i < sendings->count && transaction[0] != '\0'; i++)
		if (strcmp(sendings->entries[i].record.transaction, transaction) == 0)
			return &sendings->entries[i];
	return NULL;
}

int entry_add(struct sendings *sendings, const char *job, const struct sending_record *record, struct error *err)
{
	const int space = sendings->space == 0 ? 16 : 2 * sendings->space;
	struct entry *grown;

	if (sendings->count == sendings->space) {
		grown = realloc(sendings->entries, (size_t)space * sizeof(*grown));
		if (grown == NULL)
			return error_set_errno(err, ENOMEM, "sendings");
		sendings->entries = grown;
		sendings->space = space;
	}
	sendings->entries[sendings->count] = (struct entry){.record = *record};
	memcpy(sendings->entries[sendings->count++].job, job, ID_SIZE);
	return 0;
}

void entry_drop(struct sendings *sendings, struct entry *entry)
{
	*entry = sendings->entries[--sendings->count];
}

int entry_change(struct sendings *sendings, struct entry *entry, const struct sending_record *record, struct error *err)
{
	struct job *job;
	int code = jobs_find(sendings->jobs, entry->job, &job, err);

	if (code == 0) {
		code = job_put_sendings(job, record, 1, NULL, err);
		job_release(job);
	}
	if (code == ERR_NOT_FOUND)
		entry_drop(sendings, entry);
	if (code != 0)
		return code;
	entry->record = *record;
	if (has_ended(record)) {
		sendings->ended[record->state]++;
		entry_drop(sendings, entry);
	}
	return 0;
}

/* ---- the volumes of a wish ---- */

struct choice {
	struct sending_record *records; /* [count], owned */
	int count;
	bool any; /* a volume was meant, whether or not something is to be done */
};

/* Whether a sending is on its way or has arrived already. */
static bool is_done(const struct sending_record *there, int count, const char *name)
{
	for (int i = 0; i < count; i++)
		if (strcmp(there[i].name, name) == 0)
			return there[i].state != SENDING_FAILED && there[i].state != SENDING_STOPPED;
	return false;
}

/* New sendings of those volumes of the job that the wish means. */
static int choose(struct job *job, const char *destination, const char *volumes, struct choice *ret, struct error *err)
{
	struct job_facts facts;
	struct volume_record *kept = NULL;
	struct sending_record *there = NULL;
	int count = 0, there_count = 0, code;

	job_facts(job, &facts);
	code = store_job_volumes(jobs_store(job_jobs(job)), facts.id, &kept, &count, err);
	if (code == 0)
		code = job_sendings(job, &there, &there_count, err);
	ret->records = code == 0 ? calloc((size_t)count + 1, sizeof(*ret->records)) : NULL;
	if (code == 0 && ret->records == NULL)
		code = error_set_errno(err, ENOMEM, "sendings");
	for (int i = 0; i < count && code == 0; i++) {
		struct sending_record *record = &ret->records[ret->count];

		if (!send_wants(volumes, kept[i].name, kept[i].iteration, i == count - 1))
			continue;
		ret->any = true;
		*record = (struct sending_record){.state = SENDING_QUEUED, .created = clock_realtime()};
		snprintf(record->name, sizeof(record->name), "%s/%s", destination, kept[i].name);
		snprintf(record->destination, sizeof(record->destination), "%s", destination);
		snprintf(record->volume, sizeof(record->volume), "%s", kept[i].name);
		snprintf(record->volumes, sizeof(record->volumes), "%s", volumes);
		if (!is_done(there, there_count, record->name))
			ret->count++;
	}
	free(kept);
	free(there);
	return code;
}

static int add_all(struct sendings *sendings, const char *job, const struct choice *choice, struct error *err)
{
	int code = 0;

	for (int i = 0; i < choice->count && code == 0; i++)
		code = entry_add(sendings, job, &choice->records[i], err);
	return code;
}

static int fail_waiting(struct sendings *sendings, struct entry *entry, const char *why, struct error *err)
{
	struct sending_record record = entry->record;

	record.state = SENDING_FAILED;
	record.ended = clock_realtime();
	snprintf(record.error, sizeof(record.error), "%s", why);
	return entry_change(sendings, entry, &record, err);
}

int entry_expand(struct sendings *sendings, struct entry *entry, struct job *job, struct error *err)
{
	const struct entry waiting = *entry;
	struct choice choice = {0};
	struct job_facts facts;
	int code;

	job_facts(job, &facts);
	if (facts.state != JOB_SUCCEEDED)
		return fail_waiting(sendings, entry,
				    facts.state == JOB_FAILED ? "the job failed: nothing was sent"
							      : "the job was cancelled: nothing was sent",
				    err);
	code = choose(job, waiting.record.destination, waiting.record.volumes, &choice, err);
	if (code == 0 && !choice.any)
		code = fail_waiting(sendings, entry, "the job kept no such volume", err);
	else if (code == 0)
		code = job_put_sendings(job, choice.records, choice.count, waiting.record.name, err);
	if (code == ERR_NOT_FOUND || (code == 0 && choice.any)) {
		entry = entry_find(sendings, waiting.job, waiting.record.name);
		if (entry != NULL)
			entry_drop(sendings, entry);
	}
	if (code == 0)
		code = add_all(sendings, waiting.job, &choice, err);
	free(choice.records);
	return code;
}

/* ---- at the start ---- */

struct loading {
	struct sendings *sendings;
	struct error *err;
	int code;
};

static void load_job(void *context, const char *id)
{
	struct loading *loading = context;
	struct sending_record *rows;
	int count;

	if (loading->code != 0)
		return;
	loading->code = store_job_sendings(loading->sendings->store, id, &rows, &count, loading->err);
	if (loading->code != 0)
		return;
	for (int i = 0; i < count && loading->code == 0; i++) {
		/* The process that was sending ended with the daemon. */
		if (rows[i].state == SENDING_SENDING)
			rows[i].state = SENDING_QUEUED;
		if (!has_ended(&rows[i]))
			loading->code = entry_add(loading->sendings, id, &rows[i], loading->err);
	}
	free(rows);
}

struct ids {
	char (*list)[ID_SIZE];
	int count, space;
	bool failed;
};

/* Rows are read after the visit, which holds the catalogue's reader. */
static void note_id(void *context, const char *id)
{
	struct ids *ids = context;
	const int space = ids->space == 0 ? 64 : 2 * ids->space;

	if (ids->count == ids->space) {
		char(*grown)[ID_SIZE] = realloc(ids->list, (size_t)space * sizeof(*grown));

		ids->failed |= grown == NULL;
		if (grown == NULL)
			return;
		ids->list = grown;
		ids->space = space;
	}
	snprintf(ids->list[ids->count++], ID_SIZE, "%s", id);
}

int entries_load(struct sendings *sendings, struct error *err)
{
	struct loading loading = {sendings, err, 0};
	struct ids ids = {0};
	int code = store_jobs_unsent(sendings->store, note_id, &ids, err);

	if (code == 0 && ids.failed)
		code = error_set_errno(err, ENOMEM, "sendings");
	for (int i = 0; i < ids.count && code == 0; i++) {
		load_job(&loading, ids.list[i]);
		code = loading.code;
	}
	free(ids.list);
	return code;
}

int sendings_adopt(struct sendings *sendings, struct job *job, struct error *err)
{
	struct sending_record *rows;
	struct job_facts facts;
	int count, code;

	job_facts(job, &facts);
	pthread_mutex_lock(&sendings->lock);
	code = job_sendings(job, &rows, &count, err);
	for (int i = 0; i < count && code == 0; i++)
		if (!has_ended(&rows[i]) && entry_find(sendings, facts.id, rows[i].name) == NULL)
			code = entry_add(sendings, facts.id, &rows[i], err);
	pthread_mutex_unlock(&sendings->lock);
	if (code == 0)
		free(rows);
	sender_wake(sendings);
	return code;
}

/* ---- what clients ask ---- */

int sendings_default(struct sendings *sendings, char **ret_text, struct error *err)
{
	struct send_wish wishes[SENDS_MOST];
	int count = 0;

	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->destination_count && count < SENDS_MOST; i++) {
		const struct destination *one = &sendings->destinations[i];

		if (one->rule[0] == '\0')
			continue;
		memcpy(wishes[count].to, one->name, sizeof(one->name));
		memcpy(wishes[count++].volumes, one->rule, sizeof(one->rule));
	}
	pthread_mutex_unlock(&sendings->lock);
	*ret_text = count > 0 ? sends_text(wishes, count) : NULL;
	return count == 0 || *ret_text != NULL ? 0 : error_set_errno(err, ENOMEM, "sendings");
}

/* The lock is held. */
static int check_destination(const struct sendings *sendings, const char *name, struct error *err)
{
	const struct destination *one = destination_find(sendings, name);
	char names[200] = "";
	size_t used = 0;

	if (one != NULL && one->kind != DESTINATION_MPPS)
		return 0;
	if (one != NULL)
		return error_set(err, ERR_IMPOSSIBLE, "%s is told of performed steps, and takes no volumes", name);
	for (int i = 0; i < sendings->destination_count && used < sizeof(names); i++)
		used += (size_t)snprintf(names + used, sizeof(names) - used, "%s%s", i > 0 ? ", " : "",
					 sendings->destinations[i].name);
	return error_set(err, ERR_IMPOSSIBLE, "there is no destination \"%s\"; there %s", name,
			 used > 0 ? names : "are none (setting destinations)");
}

void sendings_step_to(struct sendings *sendings, char ret_name[DESTINATION_NAME_SIZE])
{
	ret_name[0] = '\0';
	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->destination_count; i++)
		if (sendings->destinations[i].kind == DESTINATION_MPPS)
			memcpy(ret_name, sendings->destinations[i].name, DESTINATION_NAME_SIZE);
	pthread_mutex_unlock(&sendings->lock);
}

int sendings_check(struct sendings *sendings, const struct send_wish *wishes, int count, const char *base,
		   struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < count && code == 0; i++) {
		code = check_destination(sendings, wishes[i].to, err);
		if (code != 0)
			snprintf(err->pointer, sizeof(err->pointer), "%.100s/%d", base, i);
	}
	pthread_mutex_unlock(&sendings->lock);
	return code;
}

/* A job that has not ended gets a wish more. */
static int ask_later(struct sendings *sendings, struct job *job, const char *id, const struct send_wish *wish,
		     bool *ret_new, struct error *err)
{
	struct sending_record record = {.state = SENDING_WAITING, .created = clock_realtime()};
	int code;

	if (entry_find(sendings, id, wish->to) != NULL)
		return 0;
	memcpy(record.name, wish->to, sizeof(wish->to));
	memcpy(record.destination, wish->to, sizeof(wish->to));
	memcpy(record.volumes, wish->volumes, sizeof(wish->volumes));
	code = job_put_sendings(job, &record, 1, NULL, err);
	if (code == 0)
		code = entry_add(sendings, id, &record, err);
	*ret_new = code == 0;
	return code;
}

static int ask_now(struct sendings *sendings, struct job *job, const char *id, const struct send_wish *wish,
		   bool *ret_new, struct error *err)
{
	struct choice choice = {0};
	int code = choose(job, wish->to, wish->volumes, &choice, err);

	if (code == 0 && !choice.any)
		code = error_set_at(err, ERR_IMPOSSIBLE, "/volumes", "the job has kept no such volume");
	if (code == 0 && choice.count > 0)
		code = job_put_sendings(job, choice.records, choice.count, wish->to, err);
	if (code == 0)
		code = add_all(sendings, id, &choice, err);
	*ret_new = code == 0 && choice.count > 0;
	free(choice.records);
	return code;
}

int sendings_ask(struct sendings *sendings, struct job *job, const struct send_wish *wish, bool *ret_new,
		 struct error *err)
{
	const struct job_request *request;
	const struct destination *one;
	struct job_facts facts;
	int code;

	*ret_new = false;
	code = job_request(job, &request, err);
	if (code == 0 && !request->patient.known)
		code = error_set(err, ERR_CONFLICT,
				 "nobody has said how the patient lies, and a CT image must say it: the job or the "
				 "scan needs a patient");
	if (code != 0)
		return code;
	pthread_mutex_lock(&sendings->lock);
	job_facts(job, &facts);
	one = destination_find(sendings, wish->to);
	if (one != NULL && one->kind == DESTINATION_MPPS)
		code = step_again(sendings, job, wish, ret_new, err);
	else if ((code = check_destination(sendings, wish->to, err)) != 0)
		snprintf(err->pointer, sizeof(err->pointer), "/to");
	else if (facts.ended && entry_find(sendings, facts.id, wish->to) == NULL)
		code = ask_now(sendings, job, facts.id, wish, ret_new, err);
	else
		code = ask_later(sendings, job, facts.id, wish, ret_new, err);
	pthread_mutex_unlock(&sendings->lock);
	if (*ret_new)
		sender_wake(sendings);
	return code;
}

int sendings_stop(struct sendings *sendings, struct job *job, const char *destination, struct error *err)
{
	struct sending_record *rows;
	struct job_facts facts;
	struct entry *entry;
	int count, found = 0, code;

	job_facts(job, &facts);
	pthread_mutex_lock(&sendings->lock);
	code = job_sendings(job, &rows, &count, err);
	for (int i = 0; i < count && code == 0; i++) {
		if (strcmp(rows[i].destination, destination) != 0)
			continue;
		found++;
		entry = entry_find(sendings, facts.id, rows[i].name);
		if (entry == NULL)
			continue;
		rows[i].state = SENDING_STOPPED;
		rows[i].next = 0;
		rows[i].ended = clock_realtime();
		code = entry_change(sendings, entry, &rows[i], err);
	}
	if (code == 0)
		free(rows);
	pthread_mutex_unlock(&sendings->lock);
	sender_wake(sendings);
	if (code == 0 && found == 0)
		return error_set(err, ERR_NOT_FOUND, "job %s has nothing to send to \"%.64s\"", facts.id, destination);
	return code;
}

bool sendings_pending(struct sendings *sendings, const char *job)
{
	bool pending = false;

	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->count; i++)
		pending |= strcmp(sendings->entries[i].job, job) == 0;
	pthread_mutex_unlock(&sendings->lock);
	return pending;
}

bool sendings_step_pending(struct sendings *sendings, const char *job)
{
	bool pending = false;

	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->count; i++)
		pending |= strcmp(sendings->entries[i].job, job) == 0 && entry_is_step(&sendings->entries[i]);
	pthread_mutex_unlock(&sendings->lock);
	return pending;
}

void sendings_statistics(struct sendings *sendings, struct sendings_statistics *ret)
{
	const double now = clock_realtime();

	*ret = (struct sendings_statistics){.oldest = 0};
	pthread_mutex_lock(&sendings->lock);
	for (int i = 0; i < sendings->count; i++) {
		const struct sending_record *record = &sendings->entries[i].record;

		ret->count[record->state]++;
		if (record->state != SENDING_WAITING && record->state != SENDING_SENT &&
		    now - record->created > ret->oldest)
			ret->oldest = now - record->created;
	}
	memcpy(ret->ended, sendings->ended, sizeof(ret->ended));
	ret->attempts = sendings->attempts;
	pthread_mutex_unlock(&sendings->lock);
}

/* ---- the start and the end ---- */

static void on_change(void *context)
{
	sender_wake(context);
}

int sendings_open(struct jobs *jobs, const struct sendings_options *options, struct sendings **ret_sendings,
		  struct error *err)
{
	struct sendings *sendings = calloc(1, sizeof(*sendings));
	int code;

	if (sendings == NULL)
		return error_set_errno(err, ENOMEM, "sendings");
	sendings->jobs = jobs;
	sendings->store = jobs_store(jobs);
	sendings->pause = options->pause;
	sendings->limit = options->limit;
	snprintf(sendings->file, sizeof(sendings->file), "%s", options->file);
	program_path("cbct-dicom", sendings->program, sizeof(sendings->program));
	lock_init(&sendings->lock, LOCK_SENDINGS);
	watch_list_init(&sendings->watchers);
	sendings->watch = (struct watch){.wake = on_change, .context = sendings};
	sendings->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	code = sendings->wake < 0 ? error_set_errno(err, errno, "eventfd") : 0;
	if (code == 0)
		code = destinations_read(sendings->file, &sendings->destinations, &sendings->destination_count,
					 &sendings->application, err);
	if (code == 0)
		code = entries_load(sendings, err);
	if (code == 0)
		code = sender_start(sendings, err);
	if (code != 0) {
		sendings_close(sendings);
		return code;
	}
	*ret_sendings = sendings;
	return 0;
}

void sendings_close(struct sendings *sendings)
{
	if (sendings == NULL)
		return;
	sender_stop(sendings);
	if (sendings->wake >= 0)
		close(sendings->wake);
	destinations_free(sendings->destinations, sendings->destination_count);
	application_free(&sendings->application);
	cJSON_Delete(sendings->worklist.steps);
	cJSON_Delete(sendings->steps);
	free(sendings->entries);
	watch_list_destroy(&sendings->watchers);
	pthread_mutex_destroy(&sendings->lock);
	free(sendings);
}

/*
 * The sender: a thread that has cbct-dicom ask destinations and carry out what is due, one sending a destination at a
 * time. A process gets its task as a line on its socket and answers with lines: {"stored": 12} as it goes on, and last
 * {"end": "sent", ...} or {"end": "failed", "error": ..., "permanent": ...}.
 */
#include <errno.h>
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/sendings/internal.h"
#include "proto/clock.h"
#include "proto/json.h"

static const double PAUSE_MOST = 900;   /* s between attempts */
static const double SILENCE_MOST = 300; /* s without a line, after which a process is killed */
static const double ASK_EVERY = 300;    /* s after which a destination is asked again, unless it was used meanwhile */

void sender_wake(struct sendings *sendings)
{
	if (eventfd_write(sendings->wake, 1) != 0)
		log_line(LEVEL_ERROR, "the sender cannot be woken: %s", strerror(errno));
}

static void drain(const struct sendings *sendings)
{
	eventfd_t count;

	/* The eventfd does not block; EAGAIN: nobody has written to it. */
	if (eventfd_read(sendings->wake, &count) != 0 && errno != EAGAIN)
		log_line(LEVEL_ERROR, "the sender's eventfd: %s", strerror(errno));
}

/* ---- results; the lock is held ---- */

/* edition: of the row that was asked; nothing is learnt about another one of the same name. */
static void note_answer(struct sendings *sendings, const char *name, unsigned long edition, bool reachable,
			const char *detail)
{
	struct destination *destination = destination_find(sendings, name);

	if (destination == NULL || destination->edition != edition)
		return;
	if (reachable && destination->known && !destination->reachable) {
		log_line(LEVEL_INFO, "destination %s answers again", name);
		for (int i = 0; i < sendings->count; i++)
			if (strcmp(sendings->entries[i].record.destination, name) == 0)
				sendings->entries[i].record.next = 0;
	}
	destination->known = true;
	destination->wanted = false;
	destination->reachable = reachable;
	destination->checked = clock_realtime();
	destination->checked_at = clock_monotonic();
	snprintf(destination->detail, sizeof(destination->detail), "%s", detail);
}

static const char *member_text(const cJSON *object, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsString(member) ? member->valuestring : "";
}

static int member_number(const cJSON *object, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsNumber(member) ? member->valueint : 0;
}

/* The row after an attempt that failed: another one follows, or it has failed for good. */
static void fail_attempt(const struct sendings *sendings, struct sending_record *record, bool permanent,
			 const char *why)
{
	const double now = clock_realtime();
	const double pause = sendings->pause * exp2(fmin(record->attempts - 1, 30));
	const bool over = sendings->limit > 0 && now - record->created > sendings->limit;

	snprintf(record->error, sizeof(record->error), "%s", why);
	record->state = permanent || over ? SENDING_FAILED : SENDING_QUEUED;
	record->next = permanent || over ? 0 : now + fmin(pause, PAUSE_MOST);
	record->ended = permanent || over ? now : 0;
}

/* Writes what became of an attempt. What cannot be written is tried again: the destination then has all of it. */
static void write_outcome(struct sendings *sendings, struct entry *entry, const struct sending_record *record)
{
	struct error err;
	const struct entry before = *entry;
	const int code = entry_change(sendings, entry, record, &err);

	if (code == ERR_NOT_FOUND)
		return;
	if (code != 0) {
		log_line(LEVEL_ERROR, "job %s: what became of a sending cannot be recorded: %s", before.job, err.text);
		entry->record.state = SENDING_QUEUED;
		entry->record.next = clock_realtime() + sendings->pause;
		return;
	}
	if (record->error[0] == '\0' && entry_is_step(&before))
		log_line(LEVEL_INFO, "job %s: %s is told %s", before.job, record->destination,
			 record->state == SENDING_SENT ? "how its step ended" : "that its step has begun");
	else if (record->error[0] == '\0')
		log_line(LEVEL_INFO, "job %s: %s is %s to %s, %d objects", before.job, record->volume,
			 sending_state_names[record->state], record->destination, record->stored);
	else
		log_line(LEVEL_WARNING, "job %s: %s is not sent to %s, attempt %d%s: %s", before.job,
			 entry_is_step(&before) ? "its step" : record->volume, record->destination, record->attempts,
			 record->state == SENDING_FAILED ? ", the last" : "", record->error);
}

/* The row of what was sent and may yet be promised to be kept: asked again later, until the limit. */
static void await_promise(const struct sendings *sendings, struct sending_record *record)
{
	const struct destination *destination = destination_find(sendings, record->destination);
	const double now = clock_realtime();

	if (destination == NULL || (sendings->limit > 0 && now - record->created > sendings->limit))
		return;
	record->ended = 0;
	record->next = now + destination->promise_seconds;
}

void sender_promised(struct sendings *sendings, const char *transaction, int kept, int refused, int reason)
{
	struct entry *entry = entry_promised(sendings, transaction);
	struct sending_record record;
	char why[160];

	if (entry == NULL)
		return;
	record = entry->record;
	/* Its process listens for the answer, too: the request was its last deed. */
	if (record.state == SENDING_SENDING)
		record.instances = record.stored = kept + refused;
	snprintf(why, sizeof(why), "it promises to keep %d of %d objects, reason 0x%04x", kept, record.instances,
		 (unsigned)reason);
	if (refused == 0 && kept > 0 && kept >= record.instances) {
		record.state = SENDING_COMMITTED;
		record.next = 0;
		record.ended = clock_realtime();
		record.error[0] = '\0';
	} else {
		fail_attempt(sendings, &record, false, why);
		snprintf(record.transaction, sizeof(record.transaction), SENDING_REFUSED);
	}
	write_outcome(sendings, entry, &record);
}

static void settle_sending(struct sendings *sendings, const struct transfer *transfer, const char *how)
{
	struct entry *entry = entry_find(sendings, transfer->job, transfer->name);
	const char *end = member_text(transfer->result, "end");
	const bool asked = strcmp(end, "asked") == 0, committed = strcmp(end, "committed") == 0;
	const bool sent = strcmp(end, "sent") == 0 || asked || committed;
	struct sending_record record;
	char why[320];

	/* At the daemon's end the row stays as it is: the next start begins the attempt anew. */
	if (entry == NULL || entry->record.state != SENDING_SENDING || (sendings->stop && transfer->result == NULL))
		return;
	record = entry->record;
	record.instances = member_number(transfer->result, "instances");
	record.stored = member_number(transfer->result, "stored");
	snprintf(why, sizeof(why), "%s", member_text(transfer->result, "error"));
	if (transfer->result == NULL)
		snprintf(why, sizeof(why), "the process that sends ended: %s", how);
	if (sent && entry_is_step(entry)) {
		step_told(entry, !asked, &record);
	} else if (sent) {
		record.state = committed ? SENDING_COMMITTED : SENDING_SENT;
		record.error[0] = '\0';
		record.next = 0;
		record.ended = clock_realtime();
		if (asked)
			await_promise(sendings, &record);
	} else {
		fail_attempt(sendings, &record,
			     cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(transfer->result, "permanent")), why);
		if (cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(transfer->result, "refused")))
			snprintf(record.transaction, sizeof(record.transaction), SENDING_REFUSED);
	}
	write_outcome(sendings, entry, &record);
}

static void settle(struct sendings *sendings, struct transfer *transfer, const char *how)
{
	const char *error = member_text(transfer->result, "error");
	char none[160];

	snprintf(none, sizeof(none), "the process that asks ended: %s", how);
	if (transfer->result != NULL)
		note_answer(sendings, transfer->destination, transfer->edition,
			    cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(transfer->result, "reachable")), error);
	else if (transfer->job[0] == '\0')
		note_answer(sendings, transfer->destination, transfer->edition, false, none);
	if (transfer->job[0] != '\0')
		settle_sending(sendings, transfer, how);
}

/* ---- processes ---- */

static struct transfer *free_transfer(struct sendings *sendings)
{
	for (int i = 0; i < TRANSFERS_MOST; i++)
		if (!sendings->transfers[i].runs)
			return &sendings->transfers[i];
	return NULL;
}

/* A destination has one process at a time. */
static bool is_busy(const struct sendings *sendings, const char *destination)
{
	for (int i = 0; i < TRANSFERS_MOST; i++)
		if (sendings->transfers[i].runs && strcmp(sendings->transfers[i].destination, destination) == 0)
			return true;
	return false;
}

static int start_process(struct sendings *sendings, struct transfer *transfer, const char *line, struct error *err)
{
	char *arguments[] = {"cbct-dicom", NULL};
	int ends[2], code;

	if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends) != 0)
		return error_set_errno(err, errno, "socketpair");
	code = process_start(sendings->program, arguments, ends[1], &transfer->process, err);
	close(ends[1]);
	/* The process reads it at once; one that has ended already is found by its end. */
	for (size_t length = strlen(line), done = 0; code == 0 && done < length;) {
		ssize_t got = send(ends[0], line + done, length - done, MSG_NOSIGNAL);

		if (got <= 0 && errno != EINTR)
			break;
		done += got > 0 ? (size_t)got : 0;
	}
	if (code != 0) {
		close(ends[0]);
		return code;
	}
	transfer->socket = ends[0];
	transfer->heard = clock_monotonic();
	transfer->filled = 0;
	transfer->result = NULL;
	transfer->over = false;
	transfer->runs = true;
	return 0;
}

/* A request for storage commitment goes out: its answer may come before the process ends. */
static void note_transaction(struct sendings *sendings, const struct transfer *transfer, const char *uid)
{
	struct entry *entry = entry_find(sendings, transfer->job, transfer->name);
	struct sending_record record;
	struct error err;

	if (uid[0] == '\0' || entry == NULL || entry->record.state != SENDING_SENDING)
		return;
	record = entry->record;
	snprintf(record.transaction, sizeof(record.transaction), "%s", uid);
	/* One that is not recorded is asked again. */
	if (entry_change(sendings, entry, &record, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: a request for storage commitment cannot be recorded: %s",
			 transfer->job, err.text);
}

static void take_line(struct sendings *sendings, struct transfer *transfer, size_t length)
{
	const int place = (int)(transfer - sendings->transfers);
	cJSON *value;
	struct error ignored;

	transfer->heard = clock_monotonic();
	if (json_parse(transfer->line, length, &value, &ignored) != 0)
		return;
	pthread_mutex_lock(&sendings->lock);
	if (place >= TRANSFERS_MOST)
		application_take(sendings, place, value);
	else
		note_transaction(sendings, transfer, member_text(value, "transaction"));
	pthread_mutex_unlock(&sendings->lock);
	if (cJSON_GetObjectItemCaseSensitive(value, "end") != NULL) {
		cJSON_Delete(transfer->result);
		transfer->result = value;
		return;
	}
	cJSON_Delete(value);
}

/* Reads what has come. */
static void listen_to(struct sendings *sendings, struct transfer *transfer)
{
	ssize_t got = recv(transfer->socket, transfer->line + transfer->filled,
			   sizeof(transfer->line) - transfer->filled, MSG_DONTWAIT);
	char *end;

	if (got <= 0) {
		transfer->over = got == 0 || (errno != EAGAIN && errno != EINTR);
		return;
	}
	transfer->filled += (size_t)got;
	while ((end = memchr(transfer->line, '\n', transfer->filled)) != NULL) {
		const size_t length = (size_t)(end - transfer->line);

		take_line(sendings, transfer, length);
		transfer->filled -= length + 1;
		memmove(transfer->line, end + 1, transfer->filled);
	}
	if (transfer->filled == sizeof(transfer->line)) /* no line of ours is so long */
		transfer->filled = 0;
}

/* The lock is not held. */
static void finish(struct sendings *sendings, struct transfer *transfer)
{
	char how[80];

	process_kill(&transfer->process); /* it has closed its end: nothing of it is needed any more */
	process_reap(&transfer->process, how, sizeof(how));
	close(transfer->socket);
	pthread_mutex_lock(&sendings->lock);
	if (transfer - sendings->transfers < TRANSFERS_MOST)
		settle(sendings, transfer, how);
	else
		application_ended(sendings, (int)(transfer - sendings->transfers), transfer->result, how);
	pthread_mutex_unlock(&sendings->lock);
	cJSON_Delete(transfer->result);
	transfer->result = NULL;
	transfer->runs = false;
	watch_wake(&sendings->watchers);
}

/* ---- what is due; the lock is held ---- */

/* A clock that was set back makes nobody wait longer than a pause. */
static bool is_due(struct sendings *sendings, const struct entry *entry, double now)
{
	if (entry_is_step(entry) && entry->record.state == SENDING_WAITING)
		return step_is_due(sendings, entry);
	return (entry->record.state == SENDING_QUEUED || entry->record.state == SENDING_SENT) &&
	       (entry->record.next <= now || entry->record.next > now + PAUSE_MOST);
}

/* True where the attempt that was recorded runs. */
static bool run_attempt(struct sendings *sendings, const struct entry *entry, struct transfer *transfer, int *ret_code,
			struct error *err)
{
	const struct destination *destination = destination_find(sendings, entry->record.destination);
	struct job *job = NULL;
	char *line = NULL;

	*ret_code = 0;
	if (destination == NULL)
		*ret_code =
		    error_set(err, ERR_NOT_FOUND, "there is no destination \"%s\" any more", entry->record.destination);
	else if (jobs_find(sendings->jobs, entry->job, &job, err) != 0)
		*ret_code = err->code;
	else if (task_make(sendings, destination, job, &entry->record, &line, err) != 0)
		*ret_code = err->code == ERR_NOT_FOUND ? ERR_DAMAGED : err->code;
	else {
		memcpy(transfer->destination, entry->record.destination, sizeof(transfer->destination));
		transfer->edition = destination->edition;
		memcpy(transfer->job, entry->job, sizeof(transfer->job));
		memcpy(transfer->name, entry->record.name, sizeof(transfer->name));
		*ret_code = start_process(sendings, transfer, line, err);
	}
	free(line);
	job_release(job);
	return *ret_code == 0;
}

static void attempt(struct sendings *sendings, struct entry *entry, struct transfer *transfer)
{
	struct sending_record record = entry->record;
	struct error err = {0};
	int code;

	/* Something new is to be told: its attempts and its limit are its own. */
	if (entry_is_step(entry) && record.state == SENDING_WAITING) {
		record.created = clock_realtime();
		record.attempts = 0;
	}
	record.state = SENDING_SENDING;
	record.attempts++;
	record.next = 0;
	if (entry_change(sendings, entry, &record, &err) != 0) {
		if (err.code != ERR_NOT_FOUND)
			entry->record.next = clock_realtime() + sendings->pause;
		return;
	}
	sendings->attempts++;
	if (run_attempt(sendings, entry, transfer, &code, &err))
		return;
	/* What the disk has damaged or lost no later attempt brings back. */
	fail_attempt(sendings, &record, code == ERR_DAMAGED, err.text);
	write_outcome(sendings, entry, &record);
}

/* Jobs that were removed take their sendings with them; waiting ones go on once their job has ended. */
static void review(struct sendings *sendings)
{
	for (int i = sendings->count - 1; i >= 0; i--) {
		struct entry *entry = &sendings->entries[i];
		struct job_facts facts;
		struct error err;
		struct job *job;

		if (jobs_find(sendings->jobs, entry->job, &job, &err) != 0) {
			entry_drop(sendings, entry);
			continue;
		}
		job_facts(job, &facts);
		if (entry->record.state == SENDING_WAITING && facts.ended && !entry_is_step(entry) &&
		    entry_expand(sendings, entry, job, &err) != 0 && err.code != ERR_NOT_FOUND)
			log_line(LEVEL_ERROR, "job %s cannot be sent: %s", facts.id, err.text);
		job_release(job);
	}
}

/* The due entry that was asked for first, of a destination that has nothing to do; NULL: none. */
static struct entry *next_due(struct sendings *sendings, double now)
{
	struct entry *found = NULL;

	for (int i = 0; i < sendings->count; i++) {
		struct entry *entry = &sendings->entries[i];

		if (is_due(sendings, entry, now) && !is_busy(sendings, entry->record.destination) &&
		    (found == NULL || entry->record.created < found->record.created))
			found = entry;
	}
	return found;
}

static void start_due(struct sendings *sendings)
{
	const double now = clock_realtime();
	struct transfer *transfer;
	struct entry *entry;

	/* An attempt leaves its entry running, with a later time, or gone. */
	while ((transfer = free_transfer(sendings)) != NULL && (entry = next_due(sendings, now)) != NULL)
		attempt(sendings, entry, transfer);
}

static void start_asking(struct sendings *sendings)
{
	struct error err;

	for (int i = 0; i < sendings->destination_count; i++) {
		struct destination *one = &sendings->destinations[i];
		struct transfer *transfer = free_transfer(sendings);
		char *line = NULL;

		one->wanted |= clock_monotonic() - one->checked_at > ASK_EVERY;
		if (!one->wanted || transfer == NULL || is_busy(sendings, one->name))
			continue;
		memcpy(transfer->destination, one->name, sizeof(one->name));
		transfer->edition = one->edition;
		transfer->job[0] = transfer->name[0] = '\0';
		if (task_make(sendings, one, NULL, NULL, &line, &err) != 0 ||
		    start_process(sendings, transfer, line, &err) != 0)
			note_answer(sendings, one->name, one->edition, false, err.text);
		free(line);
	}
}

/* The listener, and the worklist's process where it is asked. */
static void start_application(struct sendings *sendings)
{
	for (int i = TRANSFER_LISTENER; i <= TRANSFER_WORKLIST; i++) {
		struct transfer *transfer = &sendings->transfers[i];
		const bool wanted =
		    i == TRANSFER_WORKLIST ? sendings->worklist.wanted : clock_monotonic() >= sendings->listen_at;
		char *line = wanted && !transfer->runs ? application_task(sendings, i) : NULL;
		struct error err;

		if (line == NULL)
			continue;
		transfer->destination[0] = transfer->job[0] = transfer->name[0] = '\0';
		if (i == TRANSFER_WORKLIST) {
			sendings->steps = cJSON_CreateArray();
			sendings->worklist.nobodys = 0;
			sendings->worklist_stale = false;
		} else {
			sendings->listener_stale = false;
		}
		if (start_process(sendings, transfer, line, &err) != 0)
			application_ended(sendings, i, NULL, err.text);
		free(line);
	}
}

/* A process whose sending has ended without it: it was stopped, or its job is removed. */
static bool is_unwanted(struct sendings *sendings, const struct transfer *transfer)
{
	const struct entry *entry;
	const bool listens = transfer == &sendings->transfers[TRANSFER_LISTENER];

	if (sendings->stop || (clock_monotonic() - transfer->heard > SILENCE_MOST && !listens))
		return true;
	if (listens || transfer == &sendings->transfers[TRANSFER_WORKLIST])
		return listens ? sendings->listener_stale : sendings->worklist_stale;
	if (transfer->job[0] == '\0') {
		const struct destination *asked = destination_find(sendings, transfer->destination);

		return asked == NULL || asked->edition != transfer->edition;
	}
	entry = entry_find(sendings, transfer->job, transfer->name);
	return entry == NULL || entry->record.state != SENDING_SENDING;
}

/* Does what is due; returns the milliseconds until something may be. */
static int look(struct sendings *sendings, bool *ret_stop)
{
	double now, next = 60;

	pthread_mutex_lock(&sendings->lock);
	review(sendings);
	for (int i = 0; i < TRANSFER_COUNT; i++)
		if (sendings->transfers[i].runs && is_unwanted(sendings, &sendings->transfers[i]))
			process_kill(&sendings->transfers[i].process);
	if (!sendings->stop) {
		start_due(sendings);
		start_asking(sendings);
		start_application(sendings);
	}
	if (!sendings->transfers[TRANSFER_LISTENER].runs && sendings->application.listen != NULL)
		next = fmin(next, fmax(0, sendings->listen_at - clock_monotonic()));
	now = clock_realtime();
	for (int i = 0; i < sendings->count; i++)
		if ((sendings->entries[i].record.state == SENDING_QUEUED ||
		     sendings->entries[i].record.state == SENDING_SENT) &&
		    sendings->entries[i].record.next > now)
			next = fmin(next, sendings->entries[i].record.next - now);
	*ret_stop = sendings->stop;
	pthread_mutex_unlock(&sendings->lock);
	return (int)(1000 * next) + 1;
}

static bool any_runs(const struct sendings *sendings)
{
	for (int i = 0; i < TRANSFER_COUNT; i++)
		if (sendings->transfers[i].runs)
			return true;
	return false;
}

static void *sender_loop(void *context)
{
	struct sendings *sendings = context;
	bool stop = false;

	jobs_watch(sendings->jobs, &sendings->watch);
	for (;;) {
		struct pollfd fds[1 + TRANSFER_COUNT] = {{.fd = sendings->wake, .events = POLLIN}};
		const int wait = look(sendings, &stop);

		if (stop && !any_runs(sendings))
			break;
		for (int i = 0; i < TRANSFER_COUNT; i++)
			fds[1 + i] = (struct pollfd){
			    .fd = sendings->transfers[i].runs ? sendings->transfers[i].socket : -1, .events = POLLIN};
		poll(fds, 1 + TRANSFER_COUNT, wait);
		drain(sendings);
		for (int i = 0; i < TRANSFER_COUNT; i++) {
			if (fds[1 + i].revents != 0)
				listen_to(sendings, &sendings->transfers[i]);
			if (sendings->transfers[i].runs && sendings->transfers[i].over)
				finish(sendings, &sendings->transfers[i]);
		}
	}
	jobs_unwatch(sendings->jobs, &sendings->watch);
	return NULL;
}

int sender_start(struct sendings *sendings, struct error *err)
{
	const int result = pthread_create(&sendings->thread, NULL, sender_loop, sendings);

	sendings->has_thread = result == 0;
	return result == 0 ? 0 : error_set_errno(err, result, "sender");
}

void sender_stop(struct sendings *sendings)
{
	if (!sendings->has_thread)
		return;
	pthread_mutex_lock(&sendings->lock);
	sendings->stop = true;
	pthread_mutex_unlock(&sendings->lock);
	sender_wake(sendings);
	pthread_join(sendings->thread, NULL);
}

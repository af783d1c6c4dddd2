/*
 * /v1/jobs/{}/events, /v1/events: server-sent events (WHATWG HTML, 9.2).
 *
 * Events are sent as the catalogue holds them, with its numbers: so a client that
 * comes late or again, also to another run of the daemon, misses nothing and
 * sees nothing twice.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"

static const double heartbeat_every = 10; /* s */
static const double patience = 15;        /* s; with one heartbeat more, a client that vanished is gone within 30 */
static const char heartbeat_text[] = ":\n\n", greeting[] = "retry: 2000\n\n";

/*
 * To send one event to one watcher takes some 12 us of a processor, most of it in
 * the kernel's send. A crowd is sent at once what happened within that many
 * times a moment, so that however fast a job is, a thousand watchers take some six
 * hundredths of one processor from it, and are sent within a fifth of a second.
 * Events that were put off are sent to all in the same instant, of a grid of a few: each
 * thread then works through its share without a sleep between, and beside the
 * others.
 */
static const double moment = 200e-6, moments_most = 200e-3, instant = 10e-3; /* s */

struct watcher {
	struct http *http;
	struct event_ring *ring;
	struct jobs *jobs;
	struct job *job; /* NULL: all of them */
	char id[ID_SIZE];
	struct watch watch;
	long long after; /* the number of the last event that was fetched */
	double heartbeat;
	_Atomic double sent_at; /* the last time that there was something */
	bool greeted;
	struct event_text *text; /* on its way, NULL: none */
	size_t sent;             /* bytes of it */
};

static void wake_watcher(void *context)
{
	struct request *request = context;
	struct watcher *watcher = request_state(request);
	double pause = fmin(moment * (double)http_connections(watcher->http), moments_most);
	double due = watcher->sent_at + pause;

	if (due <= clock_monotonic())
		request_wake(request);
	else
		request_wake_by(request, ceil(due / instant) * instant);
}

static void watcher_free(void *state)
{
	struct watcher *watcher = state;

	if (watcher->job != NULL)
		job_unwatch(watcher->job, &watcher->watch);
	else
		jobs_unwatch(watcher->jobs, &watcher->watch);
	job_release(watcher->job);
	event_text_release(watcher->text);
	free(watcher);
}

/* Heartbeats lie on whole seconds, so that all watchers together wake the daemon once. */
static double next_heartbeat(void)
{
	return floor(clock_monotonic()) + heartbeat_every;
}

/* Takes as much as there is room for. */
static size_t send_text(struct watcher *watcher, char *to, size_t size)
{
	size_t part = watcher->text->length - watcher->sent;

	if (part > size)
		part = size;
	memcpy(to, watcher->text->text + watcher->sent, part);
	watcher->sent += part;
	if (watcher->sent == watcher->text->length) {
		event_text_release(watcher->text);
		watcher->text = NULL;
	}
	return part;
}

static bool job_is_over(struct watcher *watcher)
{
	struct job_facts facts;

	if (watcher->job == NULL)
		return false;
	job_facts(watcher->job, &facts);
	return facts.ended || facts.removed;
}

static ssize_t read_nothing_new(struct request *request, struct watcher *watcher, bool over, char *to)
{
	if (over || request_stopping(request))
		return 0;
	if (clock_monotonic() < watcher->heartbeat) {
		request_wait_until(request, watcher->heartbeat);
		return READ_WAIT;
	}
	watcher->heartbeat = next_heartbeat();
	memcpy(to, heartbeat_text, sizeof(heartbeat_text) - 1);
	return sizeof(heartbeat_text) - 1;
}

static ssize_t read_events(struct request *request, void *to, size_t size)
{
	struct watcher *watcher = request_state(request);
	struct error err;
	size_t filled = 0;
	bool over = false;

	if (size < sizeof(greeting))
		return -1;
	if (!watcher->greeted) {
		watcher->greeted = true;
		memcpy(to, greeting, sizeof(greeting) - 1);
		filled = sizeof(greeting) - 1;
	}
	while (filled < size) {
		if (watcher->text == NULL) {
			over = job_is_over(watcher); /* asked first: what comes before the end is in the ring by then */
			watcher->sent = 0;
			if (event_ring_next(watcher->ring, watcher->job != NULL ? watcher->id : NULL, &watcher->after,
					    &watcher->text, &err) != 0)
				return -1;
		}
		if (watcher->text == NULL)
			break;
		filled += send_text(watcher, (char *)to + filled, size - filled);
	}
	if (filled == 0)
		return read_nothing_new(request, watcher, over, to);
	watcher->sent_at = clock_monotonic();
	return (ssize_t)filled;
}

/*
 * Where to go on: the header, which a browser sends when it comes again to the
 * same address, goes before ?after=. -1: neither is there.
 */
static int read_position(struct api *api, struct request *request, long long *ret_after, struct error *err)
{
	const char *header = request_header(request, "Last-Event-ID"), *query = request_query(request, "after");
	const char *name = "Last-Event-ID", *text = header;
	long long latest = store_last_event(api->store);
	long number = -1;

	if (text == NULL || text[0] == '\0') {
		name = "after";
		text = query;
	}
	if (text != NULL && strcmp(text, "latest") == 0)
		number = (long)latest;
	else if (text != NULL && !index_parse(text, strlen(text), 1000000000000000000, &number))
		return error_set(err, ERR_INVALID, "%s is \"%.40s\", expected the number of an event", name, text);
	if (number > latest)
		return error_set(err, ERR_INVALID, "%s is %ld, the latest event is %lld", name, number, latest);
	*ret_after = number;
	return 0;
}

/* Takes the reference to the job. */
static int reply_events(struct api *api, struct request *request, struct job *job, long long after, struct error *err)
{
	struct watcher *watcher = calloc(1, sizeof(*watcher));
	struct job_facts facts;

	if (watcher == NULL) {
		job_release(job);
		return error_set(err, ERR_NO_MEMORY, "no memory for a watcher");
	}
	watcher->http = api->http;
	watcher->ring = api->events;
	watcher->jobs = api->jobs;
	watcher->job = job;
	watcher->after = after < 0 ? 0 : after;
	watcher->heartbeat = next_heartbeat();
	watcher->watch.wake = wake_watcher;
	watcher->watch.context = request;
	request_set_state(request, watcher, watcher_free); /* whoever wakes it looks there */
	if (job != NULL) {
		job_facts(job, &facts);
		memcpy(watcher->id, facts.id, sizeof(watcher->id));
		job_watch(job, &watcher->watch);
	} else {
		jobs_watch(api->jobs, &watcher->watch);
	}
	if (request_reply_live(request, 200, read_events, patience, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Type", "text/event-stream");
	request_reply_header(request, "Cache-Control", "no-store");
	request_reply_header(request, "X-Accel-Buffering", "no");
	return 0;
}

/* Whether one that comes again has heard the end already. */
static int heard_all(struct api *api, struct job *job, long long after, bool *ret_all, struct error *err)
{
	struct event_record *events;
	struct job_facts facts;
	int count;

	*ret_all = false;
	job_facts(job, &facts);
	if (after < 0 || !facts.ended)
		return 0;
	if (store_job_events(api->store, facts.id, after, 1, &events, &count, err) != 0)
		return err->code;
	event_records_free(events, count);
	*ret_all = count == 0;
	return 0;
}

int job_events(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	long long after;
	bool all;

	if (read_position(api, request, &after, err) != 0 ||
	    jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0)
		return err->code;
	if (heard_all(api, job, after, &all, err) != 0 || all) {
		job_release(job);
		/* 204 is what stops a browser from coming again and again. */
		return all ? request_reply_empty(request, 204, err) : err->code;
	}
	return reply_events(api, request, job, after, err);
}

int all_events(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	long long after;

	if (read_position(api, request, &after, err) != 0)
		return err->code;
	return reply_events(api, request, NULL, after, err);
}

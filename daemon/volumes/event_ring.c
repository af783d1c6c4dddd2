/*
 * Events for those who watch: event_ring.h.
 *
 * The ring holds every event with a number above `floor`, so whoever stands at
 * floor or later finds all that concerns him in it. It is filled by the first
 * reader that finds the catalogue ahead of it: a thousand watchers of one job
 * cost one query and one encoding for each event.
 */
#include "daemon/volumes/event_ring.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/lock.h"

enum {
	RING = 512, /* events: seconds of a busy daemon, and less than a megabyte */
	BATCH = 64  /* events of the catalogue at a time */
};

struct event_ring {
	struct store *store;
	pthread_mutex_t lock; /* guards the rest; the catalogue is read under it */
	struct event_text *ring[RING];
	int first, count;
	long long floor, last; /* all events behind floor, up to last, are in the ring */
};

void event_text_release(struct event_text *text)
{
	if (text != NULL && atomic_fetch_sub(&text->references, 1) == 1)
		free(text);
}

/* Data is one object on one line; the job that it is about is added as its first member. */
static int event_text(const struct event_record *event, char *to, size_t size)
{
	const char *members = event->data + 1;

	return snprintf(to, size, "id: %lld\nevent: %s\ndata: {\"job\":\"%s\"%s%s\n\n", event->number, event->kind,
			event->job, members[0] == '}' ? "" : ",", members);
}

static struct event_text *event_text_new(const struct event_record *events, int count)
{
	struct event_text *text;
	size_t length = 0, used = 0;

	for (int i = 0; i < count; i++)
		length += (size_t)event_text(&events[i], NULL, 0);
	text = malloc(sizeof(*text) + length + 1);
	if (text == NULL)
		return NULL;
	atomic_init(&text->references, 1);
	text->number = events[count - 1].number;
	memcpy(text->job, events[0].job, sizeof(text->job));
	text->length = length;
	for (int i = 0; i < count; i++)
		used += (size_t)event_text(&events[i], text->text + used, length + 1 - used);
	return text;
}

int event_ring_new(struct store *store, struct event_ring **ret_ring, struct error *err)
{
	struct event_ring *ring = calloc(1, sizeof(*ring));

	if (ring == NULL)
		return error_set_errno(err, ENOMEM, "ring of events");
	ring->store = store;
	ring->floor = ring->last = store_last_event(store);
	lock_init(&ring->lock, LOCK_EVENTS);
	*ret_ring = ring;
	return 0;
}

void event_ring_free(struct event_ring *ring)
{
	if (ring == NULL)
		return;
	for (int i = 0; i < ring->count; i++)
		event_text_release(ring->ring[(ring->first + i) % RING]);
	pthread_mutex_destroy(&ring->lock);
	free(ring);
}

/* Under the lock, as all down to event_ring_next. */
static struct event_text *ring_at(const struct event_ring *ring, int place)
{
	return ring->ring[(ring->first + place) % RING];
}

static void ring_drop(struct event_ring *ring)
{
	struct event_text *oldest = ring_at(ring, 0);

	ring->floor = oldest->number;
	ring->first = (ring->first + 1) % RING;
	ring->count--;
	event_text_release(oldest);
}

static int ring_add(struct event_ring *ring, const struct event_record *event, struct error *err)
{
	struct event_text *text = event_text_new(event, 1);

	if (text == NULL)
		return error_set_errno(err, ENOMEM, "event %lld", event->number);
	if (ring->count == RING)
		ring_drop(ring);
	ring->ring[(ring->first + ring->count++) % RING] = text;
	ring->last = event->number;
	return 0;
}

static int catch_up(struct event_ring *ring, struct error *err)
{
	long long newest = store_last_event(ring->store);
	int code = 0;

	/* Events that nobody has watched for long need not go through the ring. */
	if (newest - ring->last > RING) {
		while (ring->count > 0)
			ring_drop(ring);
		ring->floor = ring->last = newest - RING;
	}
	while (code == 0 && ring->last < newest) {
		struct event_record *events;
		int count;

		code = store_job_events(ring->store, NULL, ring->last, BATCH, &events, &count, err);
		if (code != 0)
			break;
		for (int i = 0; i < count && code == 0; i++)
			code = ring_add(ring, &events[i], err);
		event_records_free(events, count);
		if (code == 0 && count < BATCH && ring->last < newest)
			ring->last = newest; /* the jobs of the others are gone */
	}
	return code;
}

/* The first event in the ring behind this number. */
static int place_behind(const struct event_ring *ring, long long number)
{
	int low = 0, high = ring->count;

	while (low < high) {
		int middle = low + (high - low) / 2;

		if (ring_at(ring, middle)->number <= number)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

static struct event_text *find_in_ring(struct event_ring *ring, const char *job, long long *after)
{
	for (int i = place_behind(ring, *after); i < ring->count; i++) {
		struct event_text *text = ring_at(ring, i);

		if (job != NULL && strcmp(job, text->job) != 0)
			continue;
		atomic_fetch_add(&text->references, 1);
		*after = text->number;
		return text;
	}
	if (*after < ring->last)
		*after = ring->last;
	return NULL;
}

/* Without the lock. Nothing of the job stands between its last event that was found and `seen`. */
static int find_in_store(struct event_ring *ring, const char *job, long long seen, long long *after,
			 struct event_text **ret_text, struct error *err)
{
	struct event_text *text = NULL;
	struct event_record *events;
	int count, code = store_job_events(ring->store, job, *after, BATCH, &events, &count, err);

	if (code != 0)
		return code;
	if (count > 0) {
		text = event_text_new(events, count);
		if (text == NULL)
			code = error_set_errno(err, ENOMEM, "events");
		else
			*after = text->number;
	}
	event_records_free(events, count);
	if (code != 0)
		return code;
	if (count < BATCH && *after < seen)
		*after = seen;
	*ret_text = text;
	return 0;
}

int event_ring_next(struct event_ring *ring, const char *job, long long *after, struct event_text **ret_text,
		    struct error *err)
{
	struct event_text *found = NULL;
	long long seen;
	bool near;
	int code = 0;

	pthread_mutex_lock(&ring->lock);
	if (ring->last < store_last_event(ring->store))
		code = catch_up(ring, err);
	seen = ring->last;
	near = *after >= ring->floor;
	if (code == 0 && near)
		found = find_in_ring(ring, job, after);
	pthread_mutex_unlock(&ring->lock);
	if (code == 0 && !near)
		return find_in_store(ring, job, seen, after, ret_text, err);
	if (code == 0)
		*ret_text = found;
	return code;
}

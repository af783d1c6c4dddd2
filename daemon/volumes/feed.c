/*
 * Events for those who watch: feed.h.
 *
 * The ring holds every event with a number above `floor`, so whoever stands at
 * floor or later finds all that concerns him in it. It is filled by the first
 * reader that finds the catalogue ahead of it: a thousand watchers of one job
 * cost one query and one encoding for each event.
 */
#include "daemon/volumes/feed.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/lock.h"

enum {
	RING = 512, /* events: seconds of a busy daemon, and less than a megabyte */
	BATCH = 64  /* events of the catalogue at a time */
};

struct feed {
	struct store *store;
	pthread_mutex_t lock; /* guards the rest; the catalogue is read under it */
	struct telling *ring[RING];
	int first, count;
	long long floor, last; /* all events behind floor, up to last, are in the ring */
};

void telling_release(struct telling *telling)
{
	if (telling != NULL && atomic_fetch_sub(&telling->references, 1) == 1)
		free(telling);
}

/* Data is one object on one line; it is told with the job that it is about. */
static int event_text(const struct event_record *event, char *to, size_t size)
{
	const char *members = event->data + 1;

	return snprintf(to, size, "id: %lld\nevent: %s\ndata: {\"job\":\"%s\"%s%s\n\n", event->number, event->kind,
			event->job, members[0] == '}' ? "" : ",", members);
}

static struct telling *telling_new(const struct event_record *events, int count)
{
	struct telling *telling;
	size_t length = 0, used = 0;

	for (int i = 0; i < count; i++)
		length += (size_t)event_text(&events[i], NULL, 0);
	telling = malloc(sizeof(*telling) + length + 1);
	if (telling == NULL)
		return NULL;
	atomic_init(&telling->references, 1);
	telling->number = events[count - 1].number;
	memcpy(telling->job, events[0].job, sizeof(telling->job));
	telling->length = length;
	for (int i = 0; i < count; i++)
		used += (size_t)event_text(&events[i], telling->text + used, length + 1 - used);
	return telling;
}

int feed_new(struct store *store, struct feed **ret_feed, struct error *err)
{
	struct feed *feed = calloc(1, sizeof(*feed));

	if (feed == NULL)
		return error_set_errno(err, ENOMEM, "feed of events");
	feed->store = store;
	feed->floor = feed->last = store_last_event(store);
	lock_init(&feed->lock, LOCK_EVENTS);
	*ret_feed = feed;
	return 0;
}

void feed_free(struct feed *feed)
{
	if (feed == NULL)
		return;
	for (int i = 0; i < feed->count; i++)
		telling_release(feed->ring[(feed->first + i) % RING]);
	pthread_mutex_destroy(&feed->lock);
	free(feed);
}

/* Under the lock, as all down to feed_next. */
static struct telling *ring_at(const struct feed *feed, int place)
{
	return feed->ring[(feed->first + place) % RING];
}

static void ring_drop(struct feed *feed)
{
	struct telling *oldest = ring_at(feed, 0);

	feed->floor = oldest->number;
	feed->first = (feed->first + 1) % RING;
	feed->count--;
	telling_release(oldest);
}

static int ring_add(struct feed *feed, const struct event_record *event, struct error *err)
{
	struct telling *telling = telling_new(event, 1);

	if (telling == NULL)
		return error_set_errno(err, ENOMEM, "event %lld", event->number);
	if (feed->count == RING)
		ring_drop(feed);
	feed->ring[(feed->first + feed->count++) % RING] = telling;
	feed->last = event->number;
	return 0;
}

static int catch_up(struct feed *feed, struct error *err)
{
	long long newest = store_last_event(feed->store);
	int code = 0;

	/* What nobody has watched for long need not go through the ring. */
	if (newest - feed->last > RING) {
		while (feed->count > 0)
			ring_drop(feed);
		feed->floor = feed->last = newest - RING;
	}
	while (code == 0 && feed->last < newest) {
		struct event_record *events;
		int count;

		code = store_job_events(feed->store, NULL, feed->last, BATCH, &events, &count, err);
		if (code != 0)
			break;
		for (int i = 0; i < count && code == 0; i++)
			code = ring_add(feed, &events[i], err);
		event_records_free(events, count);
		if (code == 0 && count < BATCH && feed->last < newest)
			feed->last = newest; /* the jobs of the others are gone */
	}
	return code;
}

/* The first event in the ring behind this number. */
static int place_behind(const struct feed *feed, long long number)
{
	int low = 0, high = feed->count;

	while (low < high) {
		int middle = low + (high - low) / 2;

		if (ring_at(feed, middle)->number <= number)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

static struct telling *find_in_ring(struct feed *feed, const char *job, long long *after)
{
	for (int i = place_behind(feed, *after); i < feed->count; i++) {
		struct telling *telling = ring_at(feed, i);

		if (job != NULL && strcmp(job, telling->job) != 0)
			continue;
		atomic_fetch_add(&telling->references, 1);
		*after = telling->number;
		return telling;
	}
	if (*after < feed->last)
		*after = feed->last;
	return NULL;
}

/* Without the lock. Nothing of the job stands between its last event that was found and `seen`. */
static int find_in_store(struct feed *feed, const char *job, long long seen, long long *after,
			 struct telling **ret_telling, struct error *err)
{
	struct telling *telling = NULL;
	struct event_record *events;
	int count, code = store_job_events(feed->store, job, *after, BATCH, &events, &count, err);

	if (code != 0)
		return code;
	if (count > 0) {
		telling = telling_new(events, count);
		if (telling == NULL)
			code = error_set_errno(err, ENOMEM, "events");
		else
			*after = telling->number;
	}
	event_records_free(events, count);
	if (code != 0)
		return code;
	if (count < BATCH && *after < seen)
		*after = seen;
	*ret_telling = telling;
	return 0;
}

int feed_next(struct feed *feed, const char *job, long long *after, struct telling **ret_telling, struct error *err)
{
	struct telling *found = NULL;
	long long seen;
	bool near;
	int code = 0;

	pthread_mutex_lock(&feed->lock);
	if (feed->last < store_last_event(feed->store))
		code = catch_up(feed, err);
	seen = feed->last;
	near = *after >= feed->floor;
	if (code == 0 && near)
		found = find_in_ring(feed, job, after);
	pthread_mutex_unlock(&feed->lock);
	if (code == 0 && !near)
		return find_in_store(feed, job, seen, after, ret_telling, err);
	if (code == 0)
		*ret_telling = found;
	return code;
}

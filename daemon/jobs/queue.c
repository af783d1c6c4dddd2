/* The order of the queue, and who makes room: queue.h. */
#include "daemon/jobs/queue.h"

#include <assert.h>
#include <stddef.h>

static bool goes_before(const struct queue_entry *a, const struct queue_entry *b)
{
	return a->priority != b->priority ? a->priority > b->priority : a->ticket < b->ticket;
}

void queue_add(struct queue *queue, struct queue_entry *entry)
{
	struct queue_entry *before = NULL, *behind = queue->first;

	assert(!entry->queued);
	while (behind != NULL && !goes_before(entry, behind)) {
		before = behind;
		behind = behind->next;
	}
	entry->previous = before;
	entry->next = behind;
	if (before != NULL)
		before->next = entry;
	else
		queue->first = entry;
	if (behind != NULL)
		behind->previous = entry;
	entry->queued = true;
}

void queue_remove(struct queue *queue, struct queue_entry *entry)
{
	if (!entry->queued)
		return;
	if (entry->previous != NULL)
		entry->previous->next = entry->next;
	else
		queue->first = entry->next;
	if (entry->next != NULL)
		entry->next->previous = entry->previous;
	entry->previous = entry->next = NULL;
	entry->queued = false;
}

/* ---- clients ---- */

void queue_know(struct queue *queue, struct queue_client *client)
{
	client->next = queue->clients;
	queue->clients = client;
}

void queue_enter(struct queue *queue, struct queue_client *client)
{
	double least = -1;

	for (const struct queue_client *other = queue->clients; other != NULL; other = other->next) {
		if (other != client && other->active > 0 && (least < 0 || other->used < least))
			least = other->used;
	}
	if (client->active++ == 0 && client->used < least)
		client->used = least;
}

void queue_leave(struct queue_client *client)
{
	assert(client->active > 0);
	client->active--;
}

/* In a round of one job of each client, the n-th of each, who comes first. */
static bool has_used_less(const struct queue_entry *a, const struct queue_entry *b)
{
	return a->client->used != b->client->used ? a->client->used < b->client->used : a->ticket < b->ticket;
}

int queue_position(struct queue *queue, const struct queue_entry *entry)
{
	int position = 1, own = 0;

	if (!entry->queued)
		return 0;
	for (struct queue_entry *other = queue->first; other != NULL; other = other->next) {
		other->client->rank = 0;
		if (other->elsewhere && other != entry)
			continue;
		own += other->priority == entry->priority && other->client == entry->client &&
		       other->ticket <= entry->ticket;
	}
	for (struct queue_entry *other = queue->first; other != NULL; other = other->next) {
		int rank;

		if (other->elsewhere && other != entry)
			continue;
		if (other->priority != entry->priority) {
			position += other->priority > entry->priority;
			continue;
		}
		rank = ++other->client->rank;
		position += rank < own || (rank == own && has_used_less(other, entry));
	}
	return position;
}

static struct queue_entry *not_held(struct queue_entry *entry)
{
	while (entry != NULL && entry->held)
		entry = entry->next;
	return entry;
}

struct queue_entry *queue_next(const struct queue *queue,
			       bool (*fits)(const void *context, const struct queue_entry *entry), const void *context)
{
	struct queue_entry *best = NULL;

	for (struct queue_entry *entry = not_held(queue->first); entry != NULL; entry = not_held(entry->next)) {
		if (best != NULL && entry->priority < best->priority)
			break;
		/* In the order of tickets: of equals the first stays. */
		if ((best == NULL || entry->client->used < best->client->used) && fits(context, entry))
			best = entry;
	}
	return best;
}

static bool yields_before(const struct queue_running *a, const struct queue_running *b)
{
	if (a->gives_way != b->gives_way)
		return a->gives_way;
	return a->priority != b->priority ? a->priority < b->priority : a->ticket > b->ticket;
}

/* The job that gives way, or the one of the lowest priority below `priority`, and of those the latest ticket. */
static int least_of(const struct queue_running *running, int count, enum priority priority)
{
	int least = -1;

	for (int i = 0; i < count; i++) {
		if (running[i].leaving || (running[i].priority >= priority && !running[i].gives_way))
			continue;
		if (least < 0 || yields_before(&running[i], &running[least]))
			least = i;
	}
	return least;
}

/* The first from `entry` on that may push another job out. */
static const struct queue_entry *pushing(const struct queue_entry *entry)
{
	while (entry != NULL && (entry->held || entry->elsewhere || entry->choosy))
		entry = entry->next;
	return entry;
}

static int wanted(const struct queue_entry *entry, int most)
{
	const int devices = entry->devices == DEVICES_ALL || entry->devices > most ? most : entry->devices;

	return devices > 1 ? devices : 1;
}

int queue_victim(const struct queue *queue, const struct queue_entry *arriving, const struct queue_running *running,
		 int count, int idle, int most)
{
	const struct queue_entry *entry = pushing(queue->first);
	int coming = idle;

	for (int i = 0; i < count; i++)
		coming += running[i].leaving ? (running[i].devices > 1 ? running[i].devices : 1) : 0;
	/* The first jobs get the `coming` devices that are free already; the next one may push somebody out. */
	while (entry != NULL || arriving != NULL) {
		const struct queue_entry *next = entry;

		if (arriving != NULL && (entry == NULL || arriving->priority > entry->priority)) {
			next = arriving;
			arriving = NULL;
		} else {
			entry = pushing(entry->next);
		}
		coming -= wanted(next, most);
		if (coming < 0)
			return least_of(running, count, next->priority);
	}
	return -1;
}

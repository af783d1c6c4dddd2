/* The order of the queue, and who makes room: queue.h. */
#include "daemon/queue.h"

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

int queue_position(const struct queue_entry *entry)
{
	int position = 0;

	if (!entry->queued)
		return 0;
	for (; entry != NULL; entry = entry->previous)
		position++;
	return position;
}

/* The lowest priority below `priority`, and of those the latest ticket. */
static int least_of(const struct queue_running *running, int count, enum priority priority)
{
	int least = -1;

	for (int i = 0; i < count; i++) {
		if (running[i].leaving || running[i].priority >= priority)
			continue;
		if (least < 0 || running[i].priority < running[least].priority ||
		    (running[i].priority == running[least].priority && running[i].ticket > running[least].ticket))
			least = i;
	}
	return least;
}

int queue_victim(const struct queue *queue, const struct queue_running *running, int count, int idle)
{
	int coming = idle;

	for (int i = 0; i < count; i++)
		coming += running[i].leaving;
	/* The first `coming` jobs get workers that are free already; the next one may push somebody out. */
	for (const struct queue_entry *entry = queue->first; entry != NULL; entry = entry->next) {
		if (coming-- > 0)
			continue;
		return least_of(running, count, entry->priority);
	}
	return -1;
}

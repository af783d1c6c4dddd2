#ifndef CBCT_DAEMON_VOLUMES_EVENT_RING_H
#define CBCT_DAEMON_VOLUMES_EVENT_RING_H

#include <stdatomic.h>

#include "daemon/store/store.h"

/*
 * The catalogue's events as text/event-stream, each encoded once for all who
 * watch. The latest are in memory; who is further behind is given a batch read
 * from the catalogue. Any thread; to be woken, watch the jobs.
 */
struct event_ring;

int event_ring_new(struct store *store, struct event_ring **ret_ring, struct error *err);
void event_ring_free(struct event_ring *ring); /* NULL is fine; all tellings must be back */

/* One event, or several in order. Constant; counted references. */
struct event_text {
	atomic_int references;
	long long number; /* of the last */
	char job[ID_SIZE];
	size_t length;
	char text[]; /* "id: 7\nevent: state\ndata: {...}\n\n" */
};

/*
 * Gives the next event behind number *after, of this job or (NULL) of all, and
 * moves *after behind it. NULL in *ret_text when there is nothing more yet;
 * *after then may have moved over others' events.
 */
int event_ring_next(struct event_ring *ring, const char *job, long long *after, struct event_text **ret_text,
		    struct error *err);
void event_text_release(struct event_text *text); /* NULL is fine */

#endif

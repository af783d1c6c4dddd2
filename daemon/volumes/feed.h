#ifndef CBCT_DAEMON_VOLUMES_FEED_H
#define CBCT_DAEMON_VOLUMES_FEED_H

#include <stdatomic.h>

#include "daemon/store/store.h"

/*
 * The catalogue's events as text/event-stream, each encoded once for all who
 * watch. The latest are in memory; who is further behind is given a batch read
 * from the catalogue. Any thread; to be woken, watch the jobs.
 */
struct feed;

int feed_new(struct store *store, struct feed **ret_feed, struct error *err);
void feed_free(struct feed *feed); /* NULL is fine; all tellings must be back */

/* One event, or several in order. Constant; counted references. */
struct telling {
	atomic_int references;
	long long number; /* of the last */
	char job[ID_SIZE];
	size_t length;
	char text[]; /* "id: 7\nevent: state\ndata: {...}\n\n" */
};

/*
 * What comes next behind event number *after, of this job or (NULL) of all, and
 * moves *after behind it. NULL in *ret_telling when there is nothing more yet;
 * *after then may have moved over others' events.
 */
int feed_next(struct feed *feed, const char *job, long long *after, struct telling **ret_telling, struct error *err);
void telling_release(struct telling *telling); /* NULL is fine */

#endif

#ifndef CBCT_DAEMON_WATCH_H
#define CBCT_DAEMON_WATCH_H

#include <pthread.h>

/*
 * A watcher is woken when something changes.
 *
 * wake() only wakes (resumes a connection, writes an eventfd): it runs in the
 * thread of the change, with the list's lock held, and must not block, nor call
 * into the store or the jobs, nor add or remove a watch. A lock that wake()
 * takes must not be held while a watch is added or removed. Spurious wakes
 * happen: look again at what you wait for, and look once after adding.
 *
 * The struct is the watcher's own; it must stay until watch_remove has returned,
 * and after that wake() is not running and is not called again.
 */
struct watch {
	void (*wake)(void *context);
	void *context;
	struct watch *previous, *next; /* the list's, guarded by its lock */
};

struct watch_list {
	pthread_mutex_t lock; /* guards the links; innermost: nothing of ours is taken under it but wake()'s own */
	struct watch *first;
};

void watch_list_init(struct watch_list *list);
void watch_list_destroy(struct watch_list *list); /* must be empty */
void watch_add(struct watch_list *list, struct watch *watch);
void watch_remove(struct watch_list *list, struct watch *watch);
void watch_wake(struct watch_list *list);

#endif

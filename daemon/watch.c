/* Lists of who wants to be woken: watch.h. */
#include "daemon/watch.h"

#include <assert.h>
#include <stddef.h>

#include "daemon/lock.h"

void watch_list_init(struct watch_list *list)
{
	lock_init(&list->lock, LOCK_WATCHERS);
	list->first = NULL;
}

void watch_list_destroy(struct watch_list *list)
{
	assert(list->first == NULL);
	pthread_mutex_destroy(&list->lock);
}

void watch_add(struct watch_list *list, struct watch *watch)
{
	pthread_mutex_lock(&list->lock);
	watch->previous = NULL;
	watch->next = list->first;
	if (list->first != NULL)
		list->first->previous = watch;
	list->first = watch;
	pthread_mutex_unlock(&list->lock);
}

void watch_remove(struct watch_list *list, struct watch *watch)
{
	pthread_mutex_lock(&list->lock);
	if (watch->previous != NULL)
		watch->previous->next = watch->next;
	else
		list->first = watch->next;
	if (watch->next != NULL)
		watch->next->previous = watch->previous;
	pthread_mutex_unlock(&list->lock);
}

void watch_wake(struct watch_list *list)
{
	pthread_mutex_lock(&list->lock);
	for (struct watch *watch = list->first; watch != NULL; watch = watch->next)
		watch->wake(watch->context);
	pthread_mutex_unlock(&list->lock);
}

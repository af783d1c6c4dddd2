/*
 * The order of locks (daemon/lock.h), asserted at every lock: linked with --wrap for the functions below. A program
 * ends by abort() with both locks' ranks on standard error when a lock is taken against the order, or when a thread
 * waits on a condition with another lock in hand. A mutex that lock_init did not make (id.c has one) is below all
 * others.
 */
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "daemon/lock.h"

void __real_lock_init(pthread_mutex_t *lock, enum lock_rank rank);
int __real_pthread_mutex_lock(pthread_mutex_t *lock);
int __real_pthread_mutex_unlock(pthread_mutex_t *lock);
int __real_pthread_mutex_destroy(pthread_mutex_t *lock);
int __real_pthread_cond_wait(pthread_cond_t *condition, pthread_mutex_t *lock);
int __real_pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *lock, const struct timespec *until);
void __wrap_lock_init(pthread_mutex_t *lock, enum lock_rank rank);
int __wrap_pthread_mutex_lock(pthread_mutex_t *lock);
int __wrap_pthread_mutex_unlock(pthread_mutex_t *lock);
int __wrap_pthread_mutex_destroy(pthread_mutex_t *lock);
int __wrap_pthread_cond_wait(pthread_cond_t *condition, pthread_mutex_t *lock);
int __wrap_pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *lock, const struct timespec *until);

enum { BUCKETS = 4096, HELD_MAX = 16 };

/* The ranks of all mutexes there are, by address. */
struct known {
	struct known *next;
	const pthread_mutex_t *lock;
	enum lock_rank rank;
};
static struct known *buckets[BUCKETS];
static pthread_rwlock_t buckets_lock = PTHREAD_RWLOCK_INITIALIZER;

/* What this thread holds, in the order of taking. */
static _Thread_local struct {
	const pthread_mutex_t *lock;
	int rank;
} held[HELD_MAX];
static _Thread_local int held_count;

static struct known **place_of(const pthread_mutex_t *lock)
{
	struct known **place = &buckets[((uintptr_t)lock >> 4) % BUCKETS];

	while (*place != NULL && (*place)->lock != lock)
		place = &(*place)->next;
	return place;
}

void __wrap_lock_init(pthread_mutex_t *lock, enum lock_rank rank)
{
	struct known **place, *known = malloc(sizeof(*known));

	if (known == NULL)
		abort();
	*known = (struct known){.lock = lock, .rank = rank};
	pthread_rwlock_wrlock(&buckets_lock);
	place = place_of(lock);
	known->next = *place == NULL ? NULL : (*place)->next;
	free(*place);
	*place = known;
	pthread_rwlock_unlock(&buckets_lock);
	__real_lock_init(lock, rank);
}

int __wrap_pthread_mutex_destroy(pthread_mutex_t *lock)
{
	struct known **place, *known;

	pthread_rwlock_wrlock(&buckets_lock);
	place = place_of(lock);
	known = *place;
	if (known != NULL)
		*place = known->next;
	pthread_rwlock_unlock(&buckets_lock);
	free(known);
	return __real_pthread_mutex_destroy(lock);
}

static int rank_of(const pthread_mutex_t *lock)
{
	struct known *known;
	int rank;

	pthread_rwlock_rdlock(&buckets_lock);
	known = *place_of(lock);
	rank = known == NULL ? LOCK_COUNT : (int)known->rank;
	pthread_rwlock_unlock(&buckets_lock);
	return rank;
}

static void fail(const char *what, int rank, int other)
{
	fprintf(stderr, "lock order: %s: rank %d with rank %d in hand (daemon/lock.h)\n", what, rank, other);
	abort();
}

int __wrap_pthread_mutex_lock(pthread_mutex_t *lock)
{
	int rank = rank_of(lock), code;

	for (int i = 0; i < held_count; i++) {
		if (held[i].rank >= rank)
			fail("taken against the order", rank, held[i].rank);
	}
	if (held_count == HELD_MAX)
		abort();
	code = __real_pthread_mutex_lock(lock);
	held[held_count].lock = lock;
	held[held_count++].rank = rank;
	return code;
}

int __wrap_pthread_mutex_unlock(pthread_mutex_t *lock)
{
	for (int i = held_count - 1; i >= 0; i--) {
		if (held[i].lock != lock)
			continue;
		for (held_count--; i < held_count; i++)
			held[i] = held[i + 1];
		return __real_pthread_mutex_unlock(lock);
	}
	fail("given back by a thread that has not got it", rank_of(lock), -1);
	return 0;
}

static void check_wait(const pthread_mutex_t *lock)
{
	if (held_count != 1 || held[0].lock != lock)
		fail("a wait with another lock in hand", rank_of(lock), held_count == 0 ? -1 : held[0].rank);
}

int __wrap_pthread_cond_wait(pthread_cond_t *condition, pthread_mutex_t *lock)
{
	check_wait(lock);
	return __real_pthread_cond_wait(condition, lock);
}

int __wrap_pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *lock, const struct timespec *until)
{
	check_wait(lock);
	return __real_pthread_cond_timedwait(condition, lock, until);
}

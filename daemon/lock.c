/* Locks: lock.h. The rank is for the programs that assert the order; this one is the plain mutex. */
#include "daemon/lock.h"

void lock_init(pthread_mutex_t *lock, enum lock_rank rank)
{
	(void)rank;
	pthread_mutex_init(lock, NULL);
}

/* The index of SQLite's log in memory: store/log_index.h. */
#include "daemon/store/log_index.h"

#include <sqlite3.h>
#include <stdatomic.h>
#include <stdlib.h>

static int extend_to(struct log_index *index, int count, int size)
{
	void **regions = realloc(index->regions, (size_t)count * sizeof(*regions));

	if (regions == NULL)
		return SQLITE_NOMEM;
	index->regions = regions;
	while (index->count < count) {
		void *region = calloc(1, (size_t)size);

		if (region == NULL)
			return SQLITE_NOMEM;
		regions[index->count++] = region;
	}
	return SQLITE_OK;
}

int log_index_map(struct log_index *index, struct log_index_use *use, int region, int size, bool extend,
		  void volatile **ret)
{
	int result = SQLITE_OK;

	index->connections += !use->in_use;
	use->in_use = true;
	if (region >= index->count && extend)
		result = extend_to(index, region + 1, size);
	*ret = region < index->count ? index->regions[region] : NULL;
	return result;
}

static void unlock(struct log_index *index, struct log_index_use *use, int first, int count)
{
	for (int i = first; i < first + count; i++) {
		const unsigned bit = 1u << i;

		index->shared[i] -= (use->shared & bit) != 0;
		if (use->exclusive & bit)
			index->exclusive[i] = false;
		use->shared &= ~bit;
		use->exclusive &= ~bit;
	}
}

static int lock_shared(struct log_index *index, struct log_index_use *use, int i)
{
	if (use->shared & 1u << i)
		return SQLITE_OK;
	if (index->exclusive[i])
		return SQLITE_BUSY;
	index->shared[i]++;
	use->shared |= 1u << i;
	return SQLITE_OK;
}

int log_index_lock(struct log_index *index, struct log_index_use *use, int first, int count, int flags)
{
	if (flags & SQLITE_SHM_UNLOCK) {
		unlock(index, use, first, count);
		return SQLITE_OK;
	}
	if (flags & SQLITE_SHM_SHARED) /* always one */
		return lock_shared(index, use, first);
	for (int i = first; i < first + count; i++) {
		if (index->exclusive[i] || index->shared[i] > 0)
			return SQLITE_BUSY;
	}
	for (int i = first; i < first + count; i++) {
		index->exclusive[i] = true;
		use->exclusive |= 1u << i;
	}
	return SQLITE_OK;
}

void log_index_barrier(void)
{
	atomic_thread_fence(memory_order_seq_cst);
}

void log_index_leave(struct log_index *index, struct log_index_use *use)
{
	if (!use->in_use)
		return;
	unlock(index, use, 0, LOG_INDEX_LOCKS);
	use->in_use = false;
	if (--index->connections > 0)
		return;
	for (int i = 0; i < index->count; i++)
		free(index->regions[i]);
	free(index->regions);
	index->regions = NULL;
	index->count = 0;
}

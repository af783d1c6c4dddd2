#ifndef CBCT_DAEMON_STORE_LOG_INDEX_H
#define CBCT_DAEMON_STORE_LOG_INDEX_H

#include <stdbool.h>

/*
 * The index of SQLite's log (https://sqlite.org/walformat.html, section 2): which frame has the newest copy of a page,
 * and locks between connections. SQLite itself keeps it in a file NAME-shm that is mapped: on a full disk that file
 * cannot be made, or a write to it ends the process (SIGBUS). All connections of a catalogue are of this process, so
 * here it is plain memory, made anew from the log by whoever opens it first. Results are those that SQLite's xShmMap
 * and xShmLock have to give. Callers hold a lock of theirs, but for log_index_barrier.
 */
enum { LOG_INDEX_LOCKS = 8 }; /* SQLITE_SHM_NLOCK */

struct log_index {
	void **regions; /* [count]; an address stays as long as a connection uses the index */
	int count;
	int connections;
	int shared[LOG_INDEX_LOCKS]; /* connections that hold each lock so */
	bool exclusive[LOG_INDEX_LOCKS];
};

/* What one connection has of it; all zero before the first call. */
struct log_index_use {
	bool in_use;
	unsigned shared, exclusive; /* bits of locks */
};

/* Region number `region` of `size` bytes, NULL where there is none and extend is false. */
int log_index_map(struct log_index *index, struct log_index_use *use, int region, int size, bool extend,
		  void volatile **ret);
/* flags: SQLITE_SHM_...; `count` locks from `first` on. SQLITE_BUSY: another connection holds one. */
int log_index_lock(struct log_index *index, struct log_index_use *use, int first, int count, int flags);
void log_index_barrier(void);
/* The connection closes: its locks go, and with the last connection the index. */
void log_index_leave(struct log_index *index, struct log_index_use *use);

#endif

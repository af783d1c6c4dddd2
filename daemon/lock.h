#ifndef CBCT_DAEMON_LOCK_H
#define CBCT_DAEMON_LOCK_H

#include <pthread.h>

/*
 * The order of the daemon's locks, the whole of it: a thread takes a lock only while all that it holds stand above it
 * in this list. So two of one row are never held together, and nobody waits on a condition with another lock in hand.
 * THREADS.md says what each guards and who takes it. The programs that tests link with tests/lock_order.c end at the
 * first lock that is taken against the order.
 */
enum lock_rank {
	LOCK_UPLOADS,    /* uploads.lock */
	LOCK_SENDINGS,   /* sendings.lock */
	LOCK_CHANGE,     /* jobs.change */
	LOCK_EVENTS,     /* event_ring.lock */
	LOCK_INSERTION,  /* store.insertion_lock */
	LOCK_CATALOGUE,  /* catalogue.locks[] */
	LOCK_SCATTER,    /* stored_scan.scatter_files */
	LOCK_RECORDS,    /* stored_scan.records */
	LOCK_SCANS,      /* store.scans_lock */
	LOCK_SCAN,       /* stored_scan.lock */
	LOCK_JOBS,       /* jobs.lock */
	LOCK_SUPERVISOR, /* supervise.lock */
	LOCK_CALIBRATED, /* calibrations.lock */
	LOCK_DIGESTS,    /* digester.lock */
	LOCK_ENCODED,    /* encoded_copies.lock */
	LOCK_PICTURES,   /* pictures.lock */
	LOCK_SINK,       /* sink.lock */
	LOCK_MAPPINGS,   /* mappings.lock */
	LOCK_VERIFIED,   /* verified.lock */
	LOCK_PAGES,      /* pages.lock */
	LOCK_CHECKPOINT, /* database.checkpoint_lock, of SQLite */
	LOCK_CONNECTOR,  /* database.lock, of PostgreSQL */
	LOCK_UNDONE,     /* store.undone_lock */
	LOCK_CHECKS,     /* store.check_lock */
	LOCK_CARDS,      /* cards.lock */
	LOCK_HOMES,      /* homes.lock */
	LOCK_FEEDER,     /* feeder.lock */
	LOCK_KEEPER,     /* keeper.lock */
	LOCK_WATCHERS,   /* watch_list.lock */
	LOCK_TLS,        /* tls.lock */
	LOCK_AUDIT,      /* audit.lock */
	LOCK_HTTP,       /* http.lock */
	LOCK_CONNECTION, /* connection.lock */
	LOCK_ACCESS,     /* access.lock */
	LOCK_COUNT
};

/* Every mutex of the daemon is made here; pthread_mutex_destroy ends it. */
void lock_init(pthread_mutex_t *lock, enum lock_rank rank);

#endif

#ifndef CBCT_DAEMON_STORE_BACKEND_H
#define CBCT_DAEMON_STORE_BACKEND_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/*
 * A database that is to hold the catalogue is a file daemon/store/NAME.c that exports one struct catalogue_backend,
 * and a row in catalogue_backends[] (store/catalogue.c). The statements come from store/tables.c and
 * store/catalogue.c.
 *
 * Two sessions: all writing goes through SESSION_WRITER, within a transaction, but for the upgrade's look at what is
 * there; SESSION_READER reads what is committed and never waits for the writer. The catalogue holds a lock of each
 * session over every call with it, so that a session is used by one thread at a time. Errors: ERR_NO_SPACE, ERR_BUSY
 * (another program holds the database), ERR_AWAY (its server cannot be reached, once calls are made from several
 * threads; before, the start fails) and ERR_NO_MEMORY may pass; with ERR_IO of the writer the backend has called
 * site->failed, after which nothing more is written; ERR_INTERNAL: a row breaks a rule of its table. A statement that
 * fails may spoil its transaction: the next call is `end` without commit, or ROLLBACK TO a savepoint
 * (catalogue_import).
 *
 * Two of them: sqlite.c, and postgresql.c, which is left out where libpq is not installed.
 */
enum value_type { VALUE_NULL, VALUE_INTEGER, VALUE_REAL, VALUE_TEXT, VALUE_BYTES };
struct value {
	enum value_type type;
	long long integer;
	double real;
	/*
	 * Text ends with 0. It is UTF-8, but a sentence that was cut off may end within a character. Bytes may be NULL
	 * where size is 0.
	 */
	const void *bytes;
	size_t size;
};

/* A row of a result; what it points to lives during the call. Below zero ends the reading, and is returned by run. */
typedef int (*row_function)(void *context, const struct value *values, struct error *err);

enum session { SESSION_WRITER, SESSION_READER, SESSION_COUNT };

/* How a column's type is written. */
struct dialect {
	const char *integer, *real, *text, *bytes; /* 64 bits, double, UTF-8, bytes */
	const char *number, *sequence;             /* COLUMN_NUMBER and COLUMN_SEQUENCE, primary keys */
	const char *clustered;                     /* behind a table that is kept in the order of its primary key */
};

/* The catalogue's place and its hooks; they live longer than the database that was opened with them. */
struct catalogue_site {
	char directory[900];
	char address[1024]; /* of its server, as the user gave it; it may have a password and is never told */
	double timeout;     /* s until a server that says nothing counts as lost */
	void *context;
	void (*failed)(void *context, const char *what); /* what is committed can no longer be trusted to stay */
	bool (*make_room)(void *context);                /* the disk is full: true where there is more room now */
	_Atomic bool damaged;                            /* set by the backend: the catalogue is to be made again */
	_Atomic bool away;                               /* set by the backend: its server cannot be reached just now */
	_Atomic unsigned long losses;                    /* of connections */
};

struct catalogue_backend {
	const char *name; /* alone or before :// in the setting */
	const char *file; /* in the state directory, by which a note in quarantine/ names the catalogue */
	struct dialect dialect;
	/* ERR_INVALID, without a word of the address: it cannot be one. NULL: there is no address. */
	int (*check)(const char *address, struct error *err);
	/*
	 * Changes nothing. *ret_version: 0 where there is no catalogue yet. What does not fit is damaged, and a
	 * failure. *ret_interrupted: a process ended without closing it.
	 */
	int (*look)(struct catalogue_site *site, int *ret_version, bool *ret_interrupted, struct error *err);
	/* Opens or makes it and checks that it is whole. */
	int (*open)(struct catalogue_site *site, void **ret_database, struct error *err);
	/* The start is over and requests come. */
	int (*start)(void *database, struct error *err);
	void (*close)(void *database); /* NULL is fine */
	/* Moves a closed catalogue out of the way, with a note of the reason (store/quarantine.h). */
	int (*set_aside)(const struct catalogue_site *site, const char *why, struct error *err);

	/*
	 * Runs one statement; row may be NULL. sql stays where it is until the database is closed, so that its prepared
	 * form may be found by its address.
	 */
	int (*run)(void *database, enum session session, const char *sql, const struct value *values, int count,
		   row_function row, void *context, struct error *err);
	/* Statements without results, once, by the writer. */
	int (*script)(void *database, const char *sql, struct error *err);
	/* synced: the commit is on the disk when end returns; else a power cut may take it until a later one is. */
	int (*begin)(void *database, bool synced, struct error *err);
	/*
	 * A commit that fails is rolled back. ERR_AWAY: nobody knows. The next `begin` that succeeds is on a connection
	 * that sees what became of it, and then `committed` tells.
	 */
	int (*end)(void *database, bool commit, struct error *err);
	bool (*committed)(void *database); /* NULL where `end` never returns ERR_AWAY */
	/* All that the reader sees from now on is of one moment, or of the present again. */
	int (*freeze)(void *database, bool frozen, struct error *err);

	/* The rest is called in a transaction of the writer, or during the start. */
	int (*set_version)(void *database, int version, struct error *err);
	int (*columns)(void *database, const char *table, row_function name, void *context, struct error *err);
	/*
	 * The highest number that COLUMN_SEQUENCE of a table has given; from now on it gives higher ones than `least`,
	 * and than those given. Rows of STATEMENT_RESTORE bring their numbers, pass_number follows in their
	 * transaction.
	 */
	int (*last_number)(void *database, const char *table, long long *ret_number, struct error *err);
	int (*pass_number)(void *database, const char *table, long long least, struct error *err);
};

#endif

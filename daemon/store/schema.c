/* The tables of the catalogue, and how an older catalogue gets them: db.h. */
#include <stdio.h>

#include "daemon/store/db.h"

/*
 * Step i takes a catalogue of version i to i + 1. Steps are never changed once
 * they were released: add one.
 */
static const char *const migrations[] = {
    "CREATE TABLE scans ("
    " number INTEGER PRIMARY KEY,"
    " id TEXT NOT NULL UNIQUE,"
    " name TEXT NOT NULL,"
    " created REAL NOT NULL,"
    " columns INTEGER NOT NULL,"
    " rows INTEGER NOT NULL,"
    " count INTEGER NOT NULL,"
    " sample TEXT NOT NULL,"
    " quantity TEXT NOT NULL,"
    " air REAL NOT NULL,"
    " flat BLOB," /* SHA-256 of the float32 pixels */
    " dark BLOB);"
    "CREATE TABLE projections (" /* a row: the samples are on the disk */
    " scan INTEGER NOT NULL REFERENCES scans(number) ON DELETE CASCADE,"
    " view INTEGER NOT NULL,"
    " sha256 BLOB NOT NULL,"
    " PRIMARY KEY (scan, view)) WITHOUT ROWID;"
    "CREATE TABLE jobs ("
    " number INTEGER PRIMARY KEY,"
    " id TEXT NOT NULL UNIQUE,"
    " scan TEXT NOT NULL," /* its id; the scan may be gone once the job has ended */
    " state TEXT NOT NULL,"
    " priority TEXT NOT NULL,"
    " ticket INTEGER NOT NULL,"
    " request TEXT NOT NULL,"
    " mu_water REAL NOT NULL,"
    " iterations INTEGER NOT NULL,"
    " idempotency_key TEXT UNIQUE,"
    " request_sha256 BLOB,"
    " cancel_asked INTEGER NOT NULL,"
    " attempts INTEGER NOT NULL,"
    " crashes INTEGER NOT NULL,"
    " checkpoint INTEGER NOT NULL,"
    " backend TEXT NOT NULL,"
    " device TEXT NOT NULL,"
    " plan TEXT NOT NULL,"
    " memory BLOB NOT NULL," /* five little-endian 64-bit numbers of bytes: struct recon_memory */
    " error_code INTEGER NOT NULL,"
    " error_pointer TEXT NOT NULL,"
    " error_text TEXT NOT NULL,"
    " created REAL NOT NULL,"
    " queued REAL NOT NULL,"
    " started REAL NOT NULL,"
    " ended REAL NOT NULL,"
    " seconds BLOB NOT NULL," /* a double for each stage */
    " stage TEXT NOT NULL,"
    " iteration INTEGER NOT NULL,"
    " fraction REAL NOT NULL);"
    "CREATE TABLE volumes ("
    " number INTEGER PRIMARY KEY,"
    " job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,"
    " name TEXT NOT NULL,"
    " stage TEXT NOT NULL,"
    " iteration INTEGER NOT NULL,"
    " nx INTEGER NOT NULL, ny INTEGER NOT NULL, nz INTEGER NOT NULL,"
    " dx REAL NOT NULL, dy REAL NOT NULL, dz REAL NOT NULL,"
    " x0 REAL NOT NULL, y0 REAL NOT NULL, z0 REAL NOT NULL,"
    " bytes INTEGER NOT NULL,"
    " sha256 BLOB NOT NULL,"
    " norm2 REAL, difference2 REAL, tv REAL, minimum REAL, maximum REAL, mean REAL,"
    " not_finite INTEGER NOT NULL,"
    " created REAL NOT NULL,"
    " UNIQUE (job, name));"
    "CREATE TABLE history ("
    " job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,"
    " iteration INTEGER NOT NULL,"
    " residual REAL, change REAL, tv REAL, seconds REAL,"
    " PRIMARY KEY (job, iteration)) WITHOUT ROWID;"
    "CREATE TABLE warnings ("
    " number INTEGER PRIMARY KEY,"
    " job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,"
    " code TEXT NOT NULL,"
    " detail TEXT NOT NULL,"
    " UNIQUE (job, code, detail));"
    "CREATE TABLE events ("
    " number INTEGER PRIMARY KEY AUTOINCREMENT," /* never used twice: clients resume from it */
    " job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,"
    " created REAL NOT NULL,"
    " kind TEXT NOT NULL,"
    " data TEXT NOT NULL);"
    "CREATE INDEX events_of_job ON events (job, number);",
    /* De-duplication key: a restarted job repeats its work, an event with this key is recorded once. NULL: no key. */
    ("ALTER TABLE events ADD COLUMN once TEXT;"
     "CREATE UNIQUE INDEX events_once ON events (job, once);"),
    /* A removed job's events go with it; that it was removed stays, under a number of theirs. */
    ("CREATE TABLE removals ("
     " number INTEGER PRIMARY KEY,"
     " job TEXT NOT NULL);"),
    "ALTER TABLE scans ADD COLUMN defects BLOB;",                      /* SHA-256 of the defect map's bytes */
    "ALTER TABLE scans ADD COLUMN closed INTEGER NOT NULL DEFAULT 0;", /* 1: its projections are those that are there */
    "ALTER TABLE jobs ADD COLUMN basis INTEGER NOT NULL DEFAULT 0;",   /* of its scan, when it ran last */
    /* Idempotency-Key of POST /v1/scans; the SHA-256 is that of the request's body. */
    ("CREATE TABLE scan_keys ("
     " key TEXT PRIMARY KEY,"
     " request_sha256 BLOB NOT NULL,"
     " scan INTEGER NOT NULL REFERENCES scans(number) ON DELETE CASCADE) WITHOUT ROWID;"
     "CREATE INDEX scan_keys_of_scan ON scan_keys (scan);"),
    /* The stamp of the record in the directory, store/record.h. */
    ("ALTER TABLE scans ADD COLUMN stamp INTEGER NOT NULL DEFAULT 0;"
     "ALTER TABLE jobs ADD COLUMN stamp INTEGER NOT NULL DEFAULT 0;"),
    /* The noise and the alpha that TV uses, NULL before they were measured. */
    ("ALTER TABLE jobs ADD COLUMN noise_hu REAL;"
     "ALTER TABLE jobs ADD COLUMN tv_alpha REAL;"),
    "ALTER TABLE volumes ADD COLUMN estimate_mm REAL NOT NULL DEFAULT 0;", /* around metal; 0: there is none */
};
enum { MIGRATIONS = sizeof(migrations) / sizeof(migrations[0]) };

static int catalogue_version(struct store *store, int *ret_version, struct error *err)
{
	struct query query;
	int version = 0;

	query_begin(&query, &store->writer, "PRAGMA user_version", err);
	if (query_row(&query))
		version = sqlite3_column_int(query.statement, 0);
	if (query_end(&query) == 0)
		*ret_version = version;
	return query.code;
}

int store_migrate(struct store *store, bool *ret_fresh, struct error *err)
{
	int version = 0, code = catalogue_version(store, &version, err);
	char number[64];

	if (code != 0)
		return code;
	if (version > MIGRATIONS)
		return error_set(err, ERR_CONFLICT,
				 "the catalogue has version %d, made by a later cbctd; this one knows %d", version,
				 MIGRATIONS);
	*ret_fresh = version == 0;
	for (; version < MIGRATIONS; version++) {
		snprintf(number, sizeof(number), "PRAGMA user_version = %d", version + 1);
		code = store_begin(store, err);
		if (code != 0)
			return code;
		if (sqlite3_exec(store->writer.db, migrations[version], NULL, NULL, NULL) != SQLITE_OK ||
		    sqlite3_exec(store->writer.db, number, NULL, NULL, NULL) != SQLITE_OK)
			code = error_set(err, ERR_IO, "catalogue, step to version %d: %s", version + 1,
					 sqlite3_errmsg(store->writer.db));
		code = store_end(store, code, err);
		if (code != 0)
			return code;
	}
	return 0;
}

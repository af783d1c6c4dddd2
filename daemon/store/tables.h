#ifndef CBCT_DAEMON_STORE_TABLES_H
#define CBCT_DAEMON_STORE_TABLES_H

#include <cjson/cJSON.h>
#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"
#include "daemon/store/backend.h"
#include "daemon/store/catalogue.h"

/*
 * The tables of the catalogue. Each has one list of its columns, and everything else is made from that list: CREATE
 * TABLE, the columns that an older catalogue lacks, INSERT, SELECT, UPDATE, the binding and the reading of a record,
 * and the rows of record.json. A new column is one row here and a higher CATALOGUE_VERSION (store/upgrade.c); it needs
 * a default or may be null.
 *
 * The SQL is what SQLite (3.35 or later) and PostgreSQL have in common: parameters are $1, $2, ... in the order in
 * which they first appear. All functions may be called from any thread.
 */
enum column_type {
	COLUMN_INT,      /* int, unsigned */
	COLUMN_LONG,     /* long long, size_t */
	COLUMN_BOOL,     /* bool: 0 or 1 */
	COLUMN_REAL,     /* double; NaN is NULL */
	COLUMN_TEXT,     /* char[] */
	COLUMN_STRING,   /* char *, owned by the record; NULL is NULL */
	COLUMN_CHOICE,   /* enum: the text names[value] */
	COLUMN_BYTES,    /* uint8_t[]; while the bool at `known` is false NULL, or no bytes where NULL is not allowed */
	COLUMN_NAMED,    /* double[choices]: the text {"fdk": 1.2, ...} by names[], without those that are 0 */
	COLUMN_PARENT,   /* number of the row of the parent's table, which a statement gets as that row's id */
	COLUMN_NUMBER,   /* long long, given by the database */
	COLUMN_SEQUENCE, /* the same, and never given twice */
};

struct column {
	const char *name;
	enum column_type type;
	size_t at, size; /* of the record's member; size 0: the record has none */
	const char *const *names;
	int choices;
	size_t known;
	const char *initial; /* DEFAULT of rows that were there before the column; NULL: none */
	bool nullable, unique;
	bool changes;  /* UPDATE writes it */
	bool assigned; /* SET writes it, alone */
};

enum { COLUMNS_MAX = 56 };

/* The rule of a table for catalogue_put where a row with the same key is there. */
enum put {
	PUT_ADDS,     /* an error */
	PUT_KEEPS,    /* the first row stays */
	PUT_REPLACES, /* the row becomes the new one, in its place */
	PUT_MOVES,    /* the row goes, and the new one has the last place */
};

struct table {
	const char *name;
	const struct column *columns;
	int count;
	size_t size;           /* of a record */
	const char *key;       /* columns that name a row, for ON CONFLICT */
	bool clustered;        /* the key is the primary key */
	const char *unique;    /* columns that are unique together; NULL: none */
	const char *parent;    /* table whose row this one belongs to, and goes with; NULL: none */
	const char *reference; /* the column with the number of that row */
	bool recorded_apart;   /* rows are not in the parent's record.json */
	const char *order;     /* ORDER BY of LIST */
	const char *name_of;   /* column by which TAKE finds a row among its parent's; NULL: none */
	enum put put;
	int kept;          /* rows that are kept, those with the highest keys; 0: all */
	const char *index; /* CREATE INDEX statements; NULL: none */
};
extern const struct table tables[TABLE_COUNT];

enum statement {
	STATEMENT_INSERT,  /* all columns that the database does not give; returns the first column of a new row */
	STATEMENT_RESTORE, /* INSERT with the numbers of COLUMN_SEQUENCE */
	STATEMENT_PUT,     /* INSERT, or the row with this key becomes this one */
	STATEMENT_UPDATE,  /* columns that change, of the row with the id that is the last parameter */
	STATEMENT_LIST,    /* all rows, or those of the parent that is the parameter */
	STATEMENT_GET,     /* LIST of the row with this id */
	STATEMENT_REMOVE,  /* the row with this id, or all rows of this parent */
	STATEMENT_TAKE,    /* the row of this parent with this name_of */
	STATEMENT_TRIM,    /* all rows but the latest of so many */
	STATEMENT_COUNT
};
/* NULL: no memory. The caller frees it; a statement is of use only for a table that has the `id`, name_of or `kept` in
 * it. */
char *table_statement(const struct table *table, enum statement statement);
/* "UPDATE scans SET flat = $1 WHERE id = $2" for column i. */
char *table_assignment(const struct table *table, int column);
/* CREATE TABLE and its indexes. */
char *table_creation(const struct table *table, const struct dialect *dialect);
/* ALTER TABLE ... ADD COLUMN. */
char *table_addition(const struct table *table, const struct column *column, const struct dialect *dialect);

/* True where the statement has a parameter, or a result, for this column. */
bool column_takes_part(const struct column *column, enum statement statement);
bool column_is_text(const struct column *column);

/* store/rows.c */

/* The values of a record's columns; texts and bytes belong to the record, or to the row until row_clear. */
struct row {
	struct value values[COLUMNS_MAX];
	void *owned[COLUMNS_MAX];
	int owned_count;
};
/*
 * The parameters of a statement in their order, for INSERT, RESTORE, PUT and UPDATE; parent: the value of
 * COLUMN_PARENT. Returns how many. ERR_NO_MEMORY below zero; row_clear is the caller's then, too.
 */
int row_of_record(const struct table *table, enum statement statement, const void *record, const struct value *parent,
		  struct row *ret_row, struct error *err);
void row_clear(struct row *row);
/* The parameters of an assignment, but for the id. */
int row_of_column(const struct column *column, const void *record, struct row *ret_row, struct error *err);

/*
 * Fills a zeroed record from a result of LIST. ERR_IO: a value is invalid. On failure too table_clear frees what
 * the record owns.
 */
int record_of_row(const struct table *table, const struct value *values, void *record, struct error *err);
void table_clear(const struct table *table, void *record);

/* A result of LIST as an object: numbers, texts, null, {"hex": ...}; without parent and COLUMN_NUMBER. NULL: no memory.
 */
cJSON *json_of_row(const struct table *table, const struct value *values);
/*
 * The parameters of RESTORE or PUT from such an object; members that are no columns are passed over, columns that are
 * missing take their defaults. ERR_INVALID: one has none, or a value is invalid. `bytes` of all values belong to
 * ret_row (row_clear, on failure too) or to the object.
 */
int row_of_json(const struct table *table, enum statement statement, const cJSON *object, const struct value *parent,
		struct row *ret_row, struct error *err);

cJSON *json_of_value(const struct value *value);
struct value value_integer(long long integer);
struct value value_real(double real);
struct value value_text(const char *text);
struct value value_bytes(const void *bytes, size_t size);

#endif

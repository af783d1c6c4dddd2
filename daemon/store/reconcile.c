/*
 * At the start: the catalogue is held against the directories of scans and jobs. What clients have deleted goes from
 * both (store/deleted.h), but a directory that was put back after that is one like any other; otherwise each directory
 * has what the catalogue needs (store/record.h, proto/sums.h), so
 *
 *   row            record.json               what is done
 *   as the record  as the row                nothing: one look at its time of modification
 *   older          newer                     the row follows: a commit was lost, or an older catalogue was put back
 *   newer          older, missing, damaged   the record is written again
 *   none           whole                     the rows are made: a catalogue that was lost is made again this way
 *   none           missing or damaged        the directory is set aside in quarantine/, with a note
 *   there          no directory at all       a job's is made again; a scan's is not, its row says that it is damaged
 *
 * Making the catalogue again is the same with an empty one. Projections, images and the end of a scan follow
 * projections.sums when the scans are loaded.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/deleted.h"
#include "daemon/store/quarantine.h"
#include "daemon/store/record.h"
#include "proto/clock.h"

struct known {
	char id[ID_SIZE];
	long long stamp;
	bool seen; /* its directory is there, or needs not be */
};

struct reconciliation {
	struct store *store;
	enum record_kind kind;
	struct known *rows; /* [count], by id */
	int count, space;
	bool unsynced; /* records were written that are not on the disk yet */
};

static int compare_known(const void *a, const void *b)
{
	return strcmp(((const struct known *)a)->id, ((const struct known *)b)->id);
}

/* ---- rows ---- */

static int add_known(void *context, const char *id, long long stamp, struct error *err)
{
	struct reconciliation *r = context;
	struct known *rows, *known;
	int space = r->space == 0 ? 1024 : 2 * r->space;

	if (r->count == r->space) {
		rows = realloc(r->rows, (size_t)space * sizeof(*rows));
		if (rows == NULL)
			return error_set_errno(err, ENOMEM, "list of %d rows", space);
		r->rows = rows;
		r->space = space;
	}
	if (!id_valid(id))
		return error_set(err, ERR_IO, "catalogue: the row of %s \"%.64s\" is invalid",
				 record_words[r->kind].kind, id);
	known = &r->rows[r->count++];
	*known = (struct known){.stamp = stamp};
	memcpy(known->id, id, sizeof(known->id));
	return 0;
}

static enum deletion deletion_of(const struct reconciliation *r, const char *id)
{
	char path[1024];

	record_directory(r->store, r->kind, id, path);
	return deleted_find(r->store->deleted, r->kind == RECORD_SCAN ? DELETED_SCAN : DELETED_JOB, id, path);
}

/* A crash came between a deletion and its row, or the catalogue is older than the deletion. */
static int drop_deleted(struct reconciliation *r, struct error *err)
{
	int code = 0;

	for (int i = 0; i < r->count && code == 0; i++) {
		const enum deletion deletion = deletion_of(r, r->rows[i].id);

		if (deletion == DELETION_NONE || deletion == DELETION_OTHER)
			continue;
		log_line(LEVEL_INFO, "%s %s was deleted: its row is removed", record_words[r->kind].kind,
			 r->rows[i].id);
		code = catalogue_remove(r->store->catalogue, r->kind, r->rows[i].id, err);
		r->rows[i].seen = true;
	}
	return code;
}

/* ---- a directory with a row ---- */

static int write_again(struct reconciliation *r, const struct known *known, struct error *err)
{
	r->unsynced = true;
	return record_write_again(r->store, r->kind, known->id, known->stamp, err);
}

static int apply(struct reconciliation *r, const cJSON *record, struct error *err)
{
	int code = record_apply(r->store, r->kind, record, err);

	if (code == 0)
		r->store->repairs.found[r->kind]++;
	return code;
}

/* The row and the record are not of the same writing, as far as the time of modification tells. */
static int settle_difference(struct reconciliation *r, const struct known *known, const char *path, struct error *err)
{
	const char *kind = record_words[r->kind].kind;
	cJSON *record = NULL;
	struct error why = {0};
	long long own;
	int code = record_read(path, r->kind, known->id, &record, &why);

	if (code != 0) {
		if (code != ERR_NOT_FOUND || known->stamp != 0) /* else an earlier cbctd made it */
			log_line(LEVEL_WARNING, "%s %s: %s: it is written again", kind, known->id,
				 code == ERR_NOT_FOUND ? "its " RECORD_FILE " is missing" : why.text);
		return write_again(r, known, err);
	}
	own = record_own_stamp(r->kind, record);
	if (own > known->stamp) {
		log_line(LEVEL_WARNING, "%s %s: its directory is ahead of the catalogue, which follows", kind,
			 known->id);
		code = apply(r, record, &why);
		if (code == ERR_INVALID) {
			/* Such a record was never acknowledged, and must not keep the daemon from starting. */
			log_line(LEVEL_WARNING, "%s %s: %s: its " RECORD_FILE " is written again", kind, known->id,
				 why.text);
			code = write_again(r, known, err);
		} else if (code != 0) {
			*err = why;
		}
	} else if (own < known->stamp) {
		log_line(LEVEL_WARNING, "%s %s: its " RECORD_FILE " is behind the catalogue and written again", kind,
			 known->id);
		code = write_again(r, known, err);
	} else {
		record_touch(r->store, r->kind, known->id, own);
	}
	cJSON_Delete(record);
	return code;
}

/* ---- a directory without a row ---- */

static int set_aside(struct reconciliation *r, const char *id, const char *why, struct error *err)
{
	char path[64];

	snprintf(path, sizeof(path), "%s/%s", record_words[r->kind].table, id);
	r->store->repairs.set_aside++;
	return quarantine_move(r->store->directory, path, why, err);
}

struct contents {
	bool any;        /* but half-written files, and a record that a power cut left empty */
	bool unfinished; /* the directory was being made */
};

static int note_content(void *context, const char *name, struct error *err)
{
	struct contents *contents = context;

	(void)err;
	contents->any |= !name_is_temporary(name) && strcmp(name, RECORD_FILE) != 0;
	contents->unfinished |= strcmp(name, STORE_UNFINISHED) == 0;
	return 0;
}

static int take_in(struct reconciliation *r, const char *id, const char *path, struct error *err)
{
	struct contents contents = {0};
	struct error why = {0};
	cJSON *record = NULL;
	char text[QUARANTINE_WHY_MAX];
	int code = record_read(path, r->kind, id, &record, &why);

	if (code == 0) {
		log_line(LEVEL_WARNING, "%s %s is not in the catalogue: it is added again from its directory%s",
			 record_words[r->kind].kind, id,
			 deletion_of(r, id) == DELETION_OTHER ? ", which was put back after it was deleted" : "");
		code = apply(r, record, &why);
		cJSON_Delete(record);
		if (code != 0 && code != ERR_INVALID)
			*err = why;
		if (code != ERR_INVALID)
			return code;
	} else if (code == ERR_NOT_FOUND || record_empty(r->store, r->kind, id)) {
		if (directory_visit(path, note_content, &contents, err) != 0)
			return err->code;
		/* The process died while the scan was made: no client knows of it. */
		if (!contents.any || contents.unfinished)
			return directory_remove(path, err);
		snprintf(why.text, sizeof(why.text), "it has no " RECORD_FILE);
	}
	snprintf(text, sizeof(text), "the catalogue does not know it, and %s", why.text);
	return set_aside(r, id, text, err);
}

static int look_at_directory(void *context, const char *name, struct error *err)
{
	struct reconciliation *r = context;
	struct known key, *known;
	enum deletion deletion;
	char path[1024];

	if (!id_valid(name))
		return 0; /* not ours */
	record_directory(r->store, r->kind, name, path);
	deletion = deletion_of(r, name);
	if (deletion == DELETION_SAME) {
		log_line(LEVEL_INFO, "%s %s was deleted: its files are removed", record_words[r->kind].kind, name);
		return directory_remove(path, err);
	}
	if (deletion == DELETION_UNKNOWN)
		return set_aside(r, name, "it was deleted, and may have been put back since", err);
	memcpy(key.id, name, sizeof(key.id));
	known = r->count == 0 ? NULL : bsearch(&key, r->rows, (size_t)r->count, sizeof(key), compare_known);
	if (known == NULL)
		return take_in(r, name, path, err);
	known->seen = true;
	if (known->stamp != 0 && record_stamp(r->store, r->kind, name) == known->stamp)
		return 0;
	return settle_difference(r, known, path, err);
}

/* Jobs of an earlier cbctd had a directory only once they ran. */
static int make_directories(struct reconciliation *r, struct error *err)
{
	char path[1024];

	for (int i = 0; i < r->count && r->kind == RECORD_JOB; i++) {
		if (r->rows[i].seen)
			continue;
		if (r->rows[i].stamp != 0)
			log_line(LEVEL_ERROR, "job %s: its directory is gone, with all volumes", r->rows[i].id);
		record_directory(r->store, r->kind, r->rows[i].id, path);
		if (directory_make(path, err) != 0 || write_again(r, &r->rows[i], err) != 0)
			return err->code;
	}
	return 0;
}

static int reconcile_kind(struct store *store, enum record_kind kind, struct error *err)
{
	struct reconciliation r = {.store = store, .kind = kind};
	char path[1024];
	int code = catalogue_stamps(store->catalogue, kind, add_known, &r, err), file;

	snprintf(path, sizeof(path), "%s/%s", store->directory, record_words[kind].table);
	if (code == 0)
		code = drop_deleted(&r, err);
	if (code == 0)
		code = directory_visit(path, look_at_directory, &r, err);
	if (code == 0)
		code = make_directories(&r, err);
	free(r.rows);
	if (code != 0 || !r.unsynced)
		return code;
	file = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
	if (file < 0 || syncfs(file) != 0)
		code = error_set_errno(err, errno, "sync of %s", path);
	if (file >= 0)
		close(file);
	return code;
}

/* ---- what was set aside, and numbers ---- */

/* Whether an entry of quarantine/ is a directory whose place is free and whose record is whole. */
static bool belongs_back(const struct store *store, const struct quarantined *entry, enum record_kind kind,
			 char ret_place[1024])
{
	const char *slash = strchr(entry->from, '/'), *table = record_words[kind].table;
	char path[1200];
	cJSON *record = NULL;
	struct error ignored;

	if (slash == NULL || strncmp(entry->from, table, strlen(table)) != 0 || entry->from + strlen(table) != slash ||
	    !id_valid(slash + 1))
		return false;
	record_directory(store, kind, slash + 1, ret_place);
	snprintf(path, sizeof(path), "%s/quarantine/%s", store->directory, entry->name);
	if (access(ret_place, F_OK) == 0 || record_read(path, kind, slash + 1, &record, &ignored) != 0)
		return false;
	cJSON_Delete(record);
	return true;
}

int store_take_back(struct store *store, struct error *err)
{
	struct quarantined *entries = NULL;
	char place[1024], path[1200];
	int count = 0, code = quarantine_list(store->directory, &entries, &count, err);

	for (int i = 0; i < count && code == 0; i++) {
		for (int kind = 0; kind < RECORD_KINDS && code == 0; kind++) {
			if (!belongs_back(store, &entries[i], kind, place))
				continue;
			snprintf(path, sizeof(path), "%s/quarantine/%s", store->directory, entries[i].name);
			log_line(LEVEL_INFO, "quarantine/%s is whole and goes back to %s", entries[i].name,
				 entries[i].from);
			if (rename(path, place) != 0)
				code = error_set_errno(err, errno, "%s cannot be moved", path);
			else
				code = quarantine_forget(store->directory, entries[i].name, err);
		}
	}
	free(entries);
	return code;
}

/*
 * Numbers of events are never used twice, also where rows were lost: they go on from the milliseconds since 2020, which
 * no catalogue can have counted to.
 */
static int pass_over_events(struct store *store, struct error *err)
{
	return catalogue_pass_events(store->catalogue, (long long)((clock_realtime() - 1577836800.0) * 1e3), err);
}

/* `cbct restore` copies no catalogue, and leaves this file so that its absence is no loss. It counts once. */
static bool was_restored(const struct store *store)
{
	char path[1024];

	snprintf(path, sizeof(path), "%s/restored", store->directory);
	return unlink(path) == 0;
}

int store_reconcile(struct store *store, bool fresh, struct error *err)
{
	const bool restored = fresh && was_restored(store);
	const struct store_repairs *repairs = &store->repairs;
	char why[QUARANTINE_WHY_MAX];
	int code = store_begin(store, err), found;

	if (code != 0)
		return code;
	for (int kind = 0; kind < RECORD_KINDS && code == 0; kind++)
		code = reconcile_kind(store, kind, err);
	found = repairs->found[RECORD_SCAN] + repairs->found[RECORD_JOB];
	if (code == 0 && (found > 0 || store->interrupted))
		code = pass_over_events(store, err);
	code = store_end(store, code, err);
	if (code != 0 || found == 0)
		return code;
	snprintf(why, sizeof(why), "%s: %d scans and %d jobs were found again in their directories",
		 fresh ? "it was missing or empty" : "it was older than what was acknowledged",
		 repairs->found[RECORD_SCAN], repairs->found[RECORD_JOB]);
	log_line(LEVEL_WARNING, "catalogue: %s", why);
	/* A catalogue that was damaged has a note already; and one record may be ahead of the commit that a crash cut
	 * off. */
	return repairs->remade || (!fresh && found == 1) || restored
		   ? 0
		   : quarantine_note(store->directory, catalogue_file(store->catalogue), why, err);
}

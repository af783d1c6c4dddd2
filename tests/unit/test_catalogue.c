/* A catalogue that is lost, emptied, older or damaged takes nothing with it. */
#include <check.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/store/checksum_vfs.h"
#include "daemon/store/deleted.h"
#include "daemon/store/quarantine.h"
#include "proto/scan_directory.h"
#include "tests/unit/state.h"

static struct state state;
static char scan_id[ID_SIZE], job_id[ID_SIZE];

/* A job that has ended, with all that is told of one. */
static void end_job(struct job *job)
{
	const struct job_change start = {.backend = "cpu", .device = "a processor"};
	struct history_row row = {.iteration = 1, .residual = 0.1, .change = 1. / 3, .tv = NAN, .seconds = 1e-3};
	struct volume_record volume = {.name = "final", .stage = "sart", .iteration = 2, .bytes = 256};
	struct job_record record;
	struct error err = {0};

	job_record(job, &record);
	state_set(job, JOB_RUNNING, &start);
	ck_assert_int_eq(job_add_rows(job, &row, 1, &err), 0);
	ck_assert_int_eq(job_add_warning(job, "no_dark", "no \"dark\" image: \xc3\xa4", &err), 0);
	path_fill(state_path(&state, "jobs/%s/final.nii", record.id));
	volume.norms = (struct volume_norms){.norm2 = 0.1, .tv = 1e30, .minimum = -1e-7, .maximum = 2, .mean = 1. / 7};
	volume.created = 1795000000.123456;
	ck_assert_int_eq(job_add_volume(job, &volume, &err), 0);
	state_set(job, JOB_SUCCEEDED, NULL);
	memset(volume.sha256, 0x5a, sizeof(volume.sha256));
	volume.hashed = true;
	ck_assert_int_eq(job_digest_volume(job, &volume, &err), 0);
}

static void set_up(void)
{
	float pixels[12] = {3};
	struct stored_scan *scan;
	struct error err = {0};
	struct job *job;
	bool new;

	state_open(&state);
	scan = state_scan(&state, 6, true);
	memcpy(scan_id, stored_scan_id(scan), sizeof(scan_id));
	state_put(&state, scan, 3, 5, 0xab);
	state_put(&state, scan, 0, 0, 0xcd);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, pixels, &new, &err), 0);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	job = state_post(&state, scan, "urgent");
	end_job(job);
	job_release(job);
	job = state_post(&state, scan, "routine");
	job_release(job);
	stored_scan_release(scan);
}

static void tear_down(void)
{
	state_remove(&state);
}

/* ---- all that is known, as text ---- */

static void print_scans(FILE *out)
{
	struct stored_scan *scans[16];
	struct error err = {0};
	struct scan_facts facts;
	unsigned char flags[64];
	struct sum sum;
	bool more;
	int count;

	ck_assert_int_eq(store_scan_list(state.store, NULL, 16, scans, &count, &more, &err), 0);
	for (int i = 0; i < count; i++) {
		stored_scan_facts(scans[i], &facts);
		stored_scan_received(scans[i], flags);
		fprintf(out, "scan %s \"%s\" %.17g: %d of %d, flat %d closed %d damaged %d\n", stored_scan_id(scans[i]),
			facts.name, facts.created, facts.received, facts.count, facts.image[IMAGE_FLAT], facts.closed,
			facts.damaged);
		for (int k = 0; k < facts.count; k++) {
			if (flags[k] && stored_scan_sum(scans[i], k, &sum))
				fprintf(out, " %d %02x", k, sum.sha256[0]);
		}
		fprintf(out, "\n");
		stored_scan_release(scans[i]);
	}
}

static void print_rows(FILE *out, const char *id)
{
	struct history_row *rows;
	struct volume_record *volumes;
	struct warning_record *warnings;
	struct event_record *events;
	struct error err = {0};
	int count;

	ck_assert_int_eq(store_job_rows(state.store, id, &rows, &count, &err), 0);
	for (int i = 0; i < count; i++)
		fprintf(out, " row %d %.17g %.17g %.17g %.17g\n", rows[i].iteration, rows[i].residual, rows[i].change,
			rows[i].tv, rows[i].seconds);
	free(rows);
	ck_assert_int_eq(store_job_volumes(state.store, id, &volumes, &count, &err), 0);
	for (int i = 0; i < count; i++)
		fprintf(out, " volume %s %s %d %zu %02x %.17g %.17g %.17g %.17g\n", volumes[i].name, volumes[i].stage,
			volumes[i].iteration, volumes[i].bytes, volumes[i].hashed ? volumes[i].sha256[31] : 0,
			volumes[i].norms.norm2, volumes[i].norms.minimum, volumes[i].norms.mean, volumes[i].created);
	free(volumes);
	ck_assert_int_eq(store_job_warnings(state.store, id, &warnings, &count, &err), 0);
	for (int i = 0; i < count; i++)
		fprintf(out, " warning %s %s\n", warnings[i].code, warnings[i].detail);
	free(warnings);
	ck_assert_int_eq(store_job_events(state.store, id, 0, 100, &events, &count, &err), 0);
	for (int i = 0; i < count; i++)
		fprintf(out, " event %lld %s %s\n", events[i].number, events[i].kind, events[i].data);
	event_records_free(events, count);
}

static char *picture(void)
{
	struct job_record *jobs;
	struct error err = {0};
	size_t length;
	char *text;
	FILE *out = open_memstream(&text, &length);
	int count;

	print_scans(out);
	ck_assert_int_eq(store_job_load(state.store, &jobs, &count, &err), 0);
	for (int i = 0; i < count; i++) {
		if (i == 0)
			memcpy(job_id, jobs[i].id, sizeof(job_id));
		fprintf(out, "job %s of %s: %s %s ticket %lld attempts %d on %s %.17g %.17g %.17g %s\n", jobs[i].id,
			jobs[i].scan, job_state_names[jobs[i].state], priority_names[jobs[i].priority], jobs[i].ticket,
			jobs[i].attempts, jobs[i].device, jobs[i].created, jobs[i].started, jobs[i].seconds[STAGE_SAVE],
			jobs[i].request);
		print_rows(out, jobs[i].id);
	}
	job_records_free(jobs, count);
	fclose(out);
	return text;
}

/* ---- files ---- */

static void copy_file(const char *name, const char *to)
{
	char from[1024], *text;
	struct error err = {0};
	size_t length;

	snprintf(from, sizeof(from), "%s", state_path(&state, "%s", name));
	ck_assert_int_eq(file_read(from, 1 << 24, &text, &length, &err), 0);
	ck_assert_int_eq(file_write_durable(state_path(&state, "%s", to), text, length, &err), 0);
	free(text);
}

static void flip(const char *name, off_t at, int bit)
{
	int file = open(state_path(&state, "%s", name), O_RDWR | O_CLOEXEC);
	unsigned char byte;

	ck_assert_int_eq(pread(file, &byte, 1, at), 1);
	byte ^= (unsigned char)(1 << bit);
	ck_assert_int_eq(pwrite(file, &byte, 1, at), 1);
	close(file);
}

static off_t size_of(const char *name)
{
	struct stat status;

	ck_assert_int_eq(stat(state_path(&state, "%s", name), &status), 0);
	return status.st_size;
}

static int quarantined(void)
{
	struct quarantined *entries;
	struct error err = {0};
	int count;

	ck_assert_int_eq(quarantine_list(state.directory, &entries, &count, &err), 0);
	for (int i = 0; i < count; i++) {
		ck_assert(entries[i].from[0] != '\0' && entries[i].why[0] != '\0');
		ck_assert(entries[i].time > 1e9);
	}
	free(entries);
	return count;
}

static void same_picture(char *before)
{
	char *after = picture();

	ck_assert_str_eq(after, before);
	free(after);
	free(before);
}

START_TEST(a_catalogue_that_is_lost_is_made_again)
{
	char *before = picture();
	struct store_repairs repairs;

	state_close(&state);
	if (_i == 0)
		ck_assert_int_eq(unlink(state_path(&state, "%s", state_catalogue())), 0);
	else
		ck_assert_int_eq(truncate(state_path(&state, "%s", state_catalogue()), 0), 0);
	state_reopen(&state);
	store_repairs(state.store, &repairs);
	ck_assert_int_eq(repairs.found[0], 1);
	ck_assert_int_eq(repairs.found[1], 2);
	ck_assert_int_eq(quarantined(), 1);
	same_picture(before);
}
END_TEST

START_TEST(numbers_of_events_are_not_used_again)
{
	long long before = store_last_event(state.store);

	state_close(&state);
	ck_assert_int_eq(unlink(state_path(&state, "%s", state_catalogue())), 0);
	state_reopen(&state);
	ck_assert(store_last_event(state.store) > before);
}
END_TEST

START_TEST(an_older_catalogue_put_back_takes_nothing)
{
	OF_SQLITE();
	struct stored_scan *scan = NULL;
	struct error err = {0};
	struct job *job;
	char *before;

	state_close(&state);
	copy_file("catalogue.sqlite", "older");
	state_reopen(&state);
	ck_assert_int_eq(store_scan_find(state.store, scan_id, &scan, &err), 0);
	job = state_post(&state, scan, "stat");
	end_job(job);
	job_release(job);
	stored_scan_release(scan);
	scan = state_scan(&state, 3, false);
	state_put(&state, scan, 1, 1, 7);
	stored_scan_release(scan);
	before = picture();
	state_close(&state);
	copy_file("older", "catalogue.sqlite");
	state_reopen(&state);
	same_picture(before);
	ck_assert_int_eq(quarantined(), 1);
}
END_TEST

START_TEST(what_was_deleted_does_not_come_back)
{
	OF_SQLITE();
	struct stored_scan *scan = state_scan(&state, 3, false);
	struct error err = {0};
	struct job *job = NULL;
	struct deleted *deleted = NULL;
	char other[ID_SIZE], there[600], *before;
	bool removed;

	memcpy(other, stored_scan_id(scan), sizeof(other));
	stored_scan_release(scan);
	free(picture());
	state_close(&state);
	copy_file("catalogue.sqlite", "older");
	state_reopen(&state);
	ck_assert_int_eq(store_scan_find(state.store, other, &scan, &err), 0);
	ck_assert_int_eq(jobs_delete_scan(state.jobs, scan, &err), 0);
	stored_scan_release(scan);
	ck_assert_int_eq(jobs_find(state.jobs, job_id, &job, &err), 0);
	ck_assert_int_eq(jobs_delete(state.jobs, job, &removed, &err), 0);
	ck_assert(removed);
	job_release(job);
	before = picture();
	state_close(&state);
	/* A crash before the files went, and an older catalogue. */
	snprintf(there, sizeof(there), "%s", state_path(&state, "scans/%s", other));
	ck_assert_int_eq(mkdir(there, 0700), 0);
	path_fill(state_path(&state, "scans/%s/projections.raw", other));
	ck_assert_int_eq(deleted_open(state_path(&state, "."), &deleted, &err), 0);
	ck_assert_int_eq(deleted_add(deleted, DELETED_SCAN, other, there, &err), 0);
	deleted_free(deleted);
	copy_file("older", "catalogue.sqlite");
	state_reopen(&state);
	same_picture(before);
	ck_assert(!path_exists(state_path(&state, "scans/%s", other)));
	ck_assert_int_eq(quarantined(), 0);
}
END_TEST

/* Every part of every page: one bit at a time. */
START_TEST(a_flipped_bit_in_the_catalogue_is_found)
{
	OF_SQLITE();
	enum { TRIES = 24 };
	char *before = picture();
	off_t size;

	for (int i = 0; i < TRIES; i++) {
		state_close(&state);
		size = size_of("catalogue.sqlite");
		flip("catalogue.sqlite", (size * i + size / 2) / TRIES + i * 37 % 100, i % 8);
		state_reopen(&state);
		ck_assert_int_ge(quarantined(), 1);
	}
	same_picture(before);
}
END_TEST

START_TEST(a_catalogue_that_is_cut_off_is_made_again)
{
	OF_SQLITE();
	char *before = picture();

	for (int i = 1; i < 5; i++) {
		state_close(&state);
		ck_assert_int_eq(truncate(state_path(&state, "catalogue.sqlite"), size_of("catalogue.sqlite") * i / 5),
				 0);
		state_reopen(&state);
	}
	same_picture(before);
}
END_TEST

/* As a process that was killed leaves it: the log is there. */
START_TEST(a_damaged_log_takes_nothing)
{
	OF_SQLITE();
	char *before = picture();
	off_t size = size_of("catalogue.sqlite-wal");

	ck_assert_int_gt(size, 100000);
	copy_file("catalogue.sqlite", "killed");
	copy_file("catalogue.sqlite-wal", "killed-wal");
	copy_file("catalogue.sqlite-synced", "killed-synced");
	for (int i = 0; i < 16; i++) {
		state_close(&state);
		copy_file("killed", "catalogue.sqlite");
		copy_file("killed-wal", "catalogue.sqlite-wal");
		copy_file("killed-synced", "catalogue.sqlite-synced");
		if (i < 10)
			flip("catalogue.sqlite-wal", (size * i + 5) / 10, i % 8);
		else if (i < 15)
			ck_assert_int_eq(truncate(state_path(&state, "catalogue.sqlite-wal"), size * (i - 10) / 5 + i),
					 0);
		else
			ck_assert_int_eq(unlink(state_path(&state, "catalogue.sqlite-wal")), 0);
		state_reopen(&state);
	}
	same_picture(before);
}
END_TEST

/* Transactions that only say what is found beside the samples are not synced: a power cut takes them in any order. */
START_TEST(an_end_of_the_log_that_was_not_synced_may_be_lost)
{
	OF_SQLITE();
	static const char *const names[] = {"catalogue.sqlite", "catalogue.sqlite-wal", "catalogue.sqlite-synced"};
	static const char *const copies[] = {"killed", "killed-wal", "killed-synced"};
	struct stored_scan *scan = state_scan(&state, 6, false);
	off_t synced = size_of("catalogue.sqlite-wal");
	char *before;

	for (int i = 1; i < 6; i++)
		state_put(&state, scan, i, i, (unsigned char)i);
	stored_scan_release(scan);
	ck_assert_int_gt(size_of("catalogue.sqlite-wal"), synced + 4 * 4096);
	before = picture();
	for (int i = 0; i < 3; i++)
		copy_file(names[i], copies[i]);
	for (int i = 0; i < 2; i++) {
		state_close(&state);
		for (int j = 0; j < 3; j++)
			copy_file(copies[j], names[j]);
		flip("catalogue.sqlite-wal", i == 0 ? synced + 2000 : synced - 2000, 3);
		state_reopen(&state);
		ck_assert_int_eq(quarantined(), i == 0 ? 0 : 2); /* database and log */
	}
	same_picture(before);
}
END_TEST

START_TEST(damage_while_it_is_open_is_found)
{
	OF_SQLITE();
	struct history_row *rows;
	struct error err = {0};
	int count;

	state_reopen(&state);
	free(picture());
	state_reopen(&state); /* nothing is in memory yet but what a start reads */
	for (off_t at = 4096 + 2000; at < size_of("catalogue.sqlite"); at += 4096)
		flip("catalogue.sqlite", at, 3);
	for (int i = 0; i < 2; i++) {
		int code = store_job_rows(state.store, job_id, &rows, &count, &err);

		if (code == 0)
			free(rows);
		ck_assert_int_eq(code, ERR_IO);
	}
	ck_assert_int_eq(state.failures, 1); /* the process ends, and the next start makes it again */
}
END_TEST

/* What the job's rows and warnings say, if anything; the first warning is that of end_job. */
static void says_the_same_or_nothing(void)
{
	struct warning_record *warnings;
	struct history_row *rows;
	struct error err = {0};
	int count, code = store_job_rows(state.store, job_id, &rows, &count, &err);

	if (code == 0) {
		ck_assert_int_eq(count, 1);
		ck_assert(rows[0].residual == 0.1 && rows[0].change == 1. / 3 && rows[0].seconds == 1e-3);
		free(rows);
	} else {
		ck_assert_int_eq(code, ERR_IO);
	}
	code = store_job_warnings(state.store, job_id, &warnings, &count, &err);
	if (code == 0) {
		ck_assert_str_eq(warnings[0].detail, "no \"dark\" image: \xc3\xa4");
		free(warnings);
	} else {
		ck_assert_int_eq(code, ERR_IO);
	}
}

/* The row that a page had first stands at its end: that is cut off, once of each page. */
START_TEST(a_catalogue_that_is_cut_off_while_it_is_open_says_nothing_else)
{
	OF_SQLITE();
	struct stored_scan *scan;
	struct error err = {0};

	free(picture()); /* which job it is */
	state_close(&state);
	copy_file("catalogue.sqlite", "kept");
	for (off_t page = 4096; page < size_of("kept"); page += 4096) {
		copy_file("kept", "catalogue.sqlite");
		state_reopen(&state);
		/* A commit, behind which the log has the number of pages, and nothing of the job. */
		ck_assert_int_eq(store_scan_find(state.store, scan_id, &scan, &err), 0);
		ck_assert_int_eq(store_scan_pin(state.store, scan, true, &err), 0);
		stored_scan_release(scan);
		ck_assert_int_eq(
		    truncate(state_path(&state, "catalogue.sqlite"), page + PAGES_BYTES - PAGES_RESERVE - 2), 0);
		says_the_same_or_nothing();
		state_close(&state);
	}
	copy_file("kept", "catalogue.sqlite");
	state_reopen(&state);
}
END_TEST

START_TEST(a_record_that_is_lost_is_written_again)
{
	char *before = picture(), name[128];

	snprintf(name, sizeof(name), "jobs/%s/record.json", job_id);
	for (int i = 0; i < 2; i++) {
		ck_assert_int_eq(unlink(state_path(&state, i == 0 ? "jobs/%s/record.json" : "scans/%s/record.json",
						   i == 0 ? job_id : scan_id)),
				 0);
	}
	state_reopen(&state);
	ck_assert_int_gt(size_of(name), 1000);
	state_close(&state);
	ck_assert_int_eq(unlink(state_path(&state, "%s", state_catalogue())), 0);
	state_reopen(&state);
	same_picture(before);
}
END_TEST

START_TEST(what_nobody_knows_is_set_aside_and_can_come_back)
{
	const struct store_options options = state_options(&state);
	char *before = picture(), name[128];
	struct store_repairs repairs;
	struct error err = {0};

	snprintf(name, sizeof(name), "scans/%s/record.json", scan_id);
	state_close(&state);
	copy_file(name, "kept");
	flip(name, 100, 2);
	ck_assert_int_eq(unlink(state_path(&state, "%s", state_catalogue())), 0);
	state_reopen(&state);
	ck_assert(!path_exists(state_path(&state, "scans/%s", scan_id)));
	ck_assert_int_eq(quarantined(), 2); /* that it was lost, and the scan */
	state_close(&state);
	{
		struct quarantined *entries;
		int count;

		ck_assert_int_eq(quarantine_list(state.directory, &entries, &count, &err), 0);
		for (int i = 0; i < count; i++) {
			if (strncmp(entries[i].from, "scans/", 6) != 0)
				continue;
			ck_assert_ptr_nonnull(strstr(entries[i].why, "record.json is damaged"));
			snprintf(name, sizeof(name), "quarantine/%.80s/record.json", entries[i].name);
			copy_file("kept", name);
		}
		free(entries);
	}
	ck_assert_msg(store_rebuild(state.directory, &options, &repairs, &err) == 0, "%s", err.text);
	ck_assert_int_eq(repairs.found[0], 1);
	ck_assert_int_eq(repairs.found[1], 2);
	state_reopen(&state);
	same_picture(before);
}
END_TEST

START_TEST(nobody_else_reads_the_catalogue)
{
	OF_SQLITE();
	struct stat status;

	ck_assert_int_eq(stat(state_path(&state, "catalogue.sqlite"), &status), 0);
	ck_assert_uint_eq(status.st_mode & 0777, 0600);
	ck_assert_int_eq(stat(state_path(&state, "catalogue.sqlite-wal"), &status), 0);
	ck_assert_uint_eq(status.st_mode & 0777, 0600);
	ck_assert_int_eq(stat(state_path(&state, "scans"), &status), 0);
	ck_assert_uint_eq(status.st_mode & 0777, 0700);
	ck_assert(!path_exists(state_path(&state, "catalogue.sqlite-shm")));
}
END_TEST

static void run(sqlite3 *db, const char *sql)
{
	ck_assert_msg(sqlite3_exec(db, sql, NULL, NULL, NULL) == SQLITE_OK, "%s: %s", sql, sqlite3_errmsg(db));
}

static int run_each(void *db, int columns, char **values, char **names)
{
	(void)columns;
	(void)names;
	run(db, values[0]);
	return 0;
}

/* The catalogue's rows in a database as SQLite makes them by itself. */
static void make_plain(const char *path)
{
	char attach[1200];
	sqlite3 *db, *from;

	snprintf(attach, sizeof(attach), "ATTACH '%s' AS old", path);
	ck_assert_int_eq(sqlite3_open(path, &from), SQLITE_OK);
	ck_assert_int_eq(sqlite3_open(state_path(&state, "plain"), &db), SQLITE_OK);
	ck_assert_int_eq(sqlite3_exec(from,
				      "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%'"
				      " ORDER BY type DESC",
				      run_each, db, NULL),
			 SQLITE_OK);
	run(db, attach);
	ck_assert_int_eq(sqlite3_exec(from,
				      "SELECT 'INSERT INTO main.' || name || ' SELECT * FROM old.' || name"
				      " FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'",
				      run_each, db, NULL),
			 SQLITE_OK);
	ck_assert_int_eq(sqlite3_exec(from,
				      "SELECT 'PRAGMA main.user_version = ' || user_version FROM pragma_user_version",
				      run_each, db, NULL),
			 SQLITE_OK);
	run(db, "UPDATE main.jobs SET stamp = 0; UPDATE main.scans SET stamp = 0; PRAGMA main.journal_mode = WAL");
	sqlite3_close(from);
	sqlite3_close(db);
	ck_assert_int_eq(rename(state_path(&state, "plain"), path), 0);
}

/* One of a cbctd before there were checksums and records. */
START_TEST(a_catalogue_of_an_earlier_version_is_taken_over)
{
	OF_SQLITE();
	char *before = picture(), path[1024];
	enum pages_kind kind;
	struct error err = {0};
	int version;

	state_close(&state);
	snprintf(path, sizeof(path), "%s", state_path(&state, "catalogue.sqlite"));
	make_plain(path);
	ck_assert_int_eq(pages_look(path, &kind, &version, &err), 0);
	ck_assert_int_eq(kind, PAGES_PLAIN);
	ck_assert_int_eq(unlink(state_path(&state, "jobs/%s/record.json", job_id)), 0);
	ck_assert_int_eq(unlink(state_path(&state, "scans/%s/record.json", scan_id)), 0);
	state_reopen(&state);
	ck_assert_int_eq(pages_look(path, &kind, &version, &err), 0);
	ck_assert_int_eq(kind, PAGES_CHECKED);
	ck_assert(path_exists(state_path(&state, "jobs/%s/record.json", job_id)));
	ck_assert(path_exists(state_path(&state, "scans/%s/record.json", scan_id)));
	ck_assert_int_eq(quarantined(), 0);
	same_picture(before);
}
END_TEST

Suite *catalogue_suite(void);
Suite *catalogue_suite(void)
{
	Suite *suite = suite_create("catalogue");
	TCase *tests = tcase_create("catalogue");

	tcase_add_checked_fixture(tests, set_up, tear_down);
	tcase_set_timeout(tests, 60);
	tcase_add_loop_test(tests, a_catalogue_that_is_lost_is_made_again, 0, 2);
	tcase_add_test(tests, numbers_of_events_are_not_used_again);
	tcase_add_test(tests, an_older_catalogue_put_back_takes_nothing);
	tcase_add_test(tests, what_was_deleted_does_not_come_back);
	tcase_add_test(tests, a_flipped_bit_in_the_catalogue_is_found);
	tcase_add_test(tests, a_catalogue_that_is_cut_off_is_made_again);
	tcase_add_test(tests, a_damaged_log_takes_nothing);
	tcase_add_test(tests, an_end_of_the_log_that_was_not_synced_may_be_lost);
	tcase_add_test(tests, damage_while_it_is_open_is_found);
	tcase_add_test(tests, a_catalogue_that_is_cut_off_while_it_is_open_says_nothing_else);
	tcase_add_test(tests, a_record_that_is_lost_is_written_again);
	tcase_add_test(tests, what_nobody_knows_is_set_aside_and_can_come_back);
	tcase_add_test(tests, nobody_else_reads_the_catalogue);
	tcase_add_test(tests, a_catalogue_of_an_earlier_version_is_taken_over);
	suite_add_tcase(suite, tests);
	return suite;
}

/* A catalogue of an earlier version says the same after its upgrade; one of a later version is left alone. */
#include <check.h>
#include <inttypes.h>
#include <math.h>
#include <signal.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include "daemon/store/checksum_vfs.h"
#include "daemon/store/upgrade.h"
#include "proto/scan_directory.h"
#include "tests/unit/state.h"

#define OLD "tests/unit/catalogue_10.sql"
#define OLD_RECORD "tests/unit/catalogue_10.record.json"
#define RECORDED_JOB "1m829f9xhyfaw2h7"

static struct state state;

static char *read_text(const char *path)
{
	struct error err = {0};
	size_t length;
	char *text;

	ck_assert_msg(file_read(path, 1 << 24, &text, &length, &err) == 0, "%s", err.text);
	return text;
}

/* ---- the catalogue, without the store ---- */

static struct pages *pages;

static sqlite3 *open_database(void)
{
	int reserve = PAGES_RESERVE;
	struct error err = {0};
	sqlite3 *db;

	ck_assert_int_eq(pages_new(&pages, &err), 0);
	ck_assert_int_eq(sqlite3_open_v2(state_path(&state, "catalogue.sqlite"), &db,
					 SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE, pages_vfs(pages)),
			 SQLITE_OK);
	sqlite3_file_control(db, "main", SQLITE_FCNTL_RESERVE_BYTES, &reserve);
	return db;
}

static void close_database(sqlite3 *db)
{
	sqlite3_close(db);
	pages_free(pages);
}

static void run(sqlite3 *db, const char *sql)
{
	ck_assert_msg(sqlite3_exec(db, sql, NULL, NULL, NULL) == SQLITE_OK, "%.200s: %s", sql, sqlite3_errmsg(db));
}

static void change(const char *sql)
{
	sqlite3 *db = open_database();

	run(db, sql);
	close_database(db);
}

/* Bytes as they are, reals so that they come back the same. */
static void print_column(FILE *out, sqlite3_stmt *row, int column)
{
	const unsigned char *bytes;

	switch (sqlite3_column_type(row, column)) {
	case SQLITE_FLOAT:
		fprintf(out, "%.17g", sqlite3_column_double(row, column));
		break;
	case SQLITE_BLOB:
		bytes = sqlite3_column_blob(row, column);
		for (int i = 0; i < sqlite3_column_bytes(row, column); i++)
			fprintf(out, "%02x", bytes[i]);
		break;
	case SQLITE_NULL:
		fputs("NULL", out);
		break;
	default:
		fputs((const char *)sqlite3_column_text(row, column), out);
	}
}

static char *answer(sqlite3 *db, const char *sql)
{
	size_t length;
	char *text;
	FILE *out = open_memstream(&text, &length);
	sqlite3_stmt *row;

	ck_assert_msg(sqlite3_prepare_v2(db, sql, -1, &row, NULL) == SQLITE_OK, "%s: %s", sql, sqlite3_errmsg(db));
	while (sqlite3_step(row) == SQLITE_ROW) {
		for (int i = 0; i < sqlite3_column_count(row); i++) {
			print_column(out, row, i);
			fputc(i + 1 == sqlite3_column_count(row) ? '\n' : '|', out);
		}
	}
	sqlite3_finalize(row);
	fclose(out);
	return text;
}

/* An empty state directory with the catalogue of the earlier version, and the directories of its jobs. */
static void set_up(void)
{
	char *sql = read_text(OLD);
	sqlite3 *db;

	state_open(&state);
	state_close(&state);
	ck_assert_int_eq(unlink(state_path(&state, "catalogue.sqlite")), 0);
	db = open_database();
	run(db, "PRAGMA page_size = 4096; PRAGMA journal_mode = WAL;");
	run(db, sql);
	free(sql);
	sql = answer(
	    db, "SELECT jobs.id || '/' || coalesce(volumes.name, '') FROM jobs LEFT JOIN volumes ON job = jobs.number");
	for (char *rest = sql, *line; (line = strtok_r(rest, "\n", &rest)) != NULL;) {
		char *slash = strchr(line, '/');

		mkdir(state_path(&state, "jobs/%.16s", line), 0700);
		if (slash[1] != '\0')
			path_fill(state_path(&state, "jobs/%s.nii", line));
	}
	free(sql);
	close_database(db);
}

static void tear_down(void)
{
	state_remove(&state);
}

/* ---- all that is kept, told by the database of the earlier version and by the store ---- */

static const char *const earlier_stages[] = {"load", "fdk", "sart", "tv", "save", "cgls"};

/* Numbers of eight bytes, from hexadecimal digits. */
static uint64_t number_at(const char *hex, int index)
{
	unsigned char bytes[8] = {0};
	uint64_t number;

	for (int i = 0; i < 8 && strlen(hex) >= (size_t)(16 * index + 2 * i + 2); i++) {
		const char digits[3] = {hex[16 * index + 2 * i], hex[16 * index + 2 * i + 1], '\0'};

		bytes[i] = (unsigned char)strtoul(digits, NULL, 16);
	}
	memcpy(&number, bytes, sizeof(number));
	return number;
}

/* memory|seconds of one row in hexadecimal digits, as "memory 1 2 3 4 5 6 load 0.1 fdk 0.2 ...". */
static void print_arrays(FILE *out, char *line)
{
	char *seconds = strchr(line, '|');
	uint64_t bits;
	double number;

	*seconds++ = '\0';
	fprintf(out, "memory");
	for (int i = 0; i < 6; i++)
		fprintf(out, " %" PRIu64, number_at(line, i));
	for (int i = 0; i < 6; i++) {
		bits = number_at(seconds, i);
		memcpy(&number, &bits, sizeof(number));
		fprintf(out, " %s %.17g", earlier_stages[i], number);
	}
	fprintf(out, "\n");
}

static char *arrays_of_database(sqlite3 *db)
{
	char *rows = answer(db, "SELECT memory, seconds FROM jobs ORDER BY id"), *text;
	size_t length;
	FILE *out = open_memstream(&text, &length);

	for (char *rest = rows, *line; (line = strtok_r(rest, "\n", &rest)) != NULL;)
		print_arrays(out, line);
	fclose(out);
	free(rows);
	return text;
}

static void print_numbers(FILE *out, const struct job_record *job)
{
	const struct recon_memory *memory = &job->memory;

	fprintf(out, "memory %zu %zu %zu %zu %zu %zu", memory->projections, memory->volumes, memory->scratch,
		memory->total, memory->available, memory->host);
	for (size_t i = 0; i < sizeof(earlier_stages) / sizeof(earlier_stages[0]); i++) {
		for (int stage = 0; stage < STAGE_COUNT; stage++) {
			if (strcmp(stage_names[stage], earlier_stages[i]) == 0)
				fprintf(out, " %s %.17g", stage_names[stage], job->seconds[stage]);
		}
	}
	fprintf(out, "\n");
}

static char *arrays_of_store(void)
{
	struct job_record *jobs;
	struct error err = {0};
	size_t length;
	char *text;
	FILE *out = open_memstream(&text, &length);
	int count;

	ck_assert_int_eq(store_job_load(state.store, &jobs, &count, &err), 0);
	for (int i = 0; i < count; i++)
		print_numbers(out, &jobs[i]);
	job_records_free(jobs, count);
	fclose(out);
	return text;
}

/* The columns of volumes in version 1; version 10 had one more, later ones have what came since. */
#define FIRST_VOLUMES                                                                                                  \
	"number, job, name, stage, iteration, nx, ny, nz, dx, dy, dz, x0, y0, z0, bytes, sha256, norm2, difference2, " \
	"tv, minimum, maximum, mean, not_finite, created"

/* What did not change its form, but for the stamps of records, which the directories lacked. */
static const char *const unchanged[] = {
    "SELECT number, id, name, created, columns, rows, count, sample, quantity, air, flat, dark, defects, closed FROM "
    "scans"
    " ORDER BY number",
    "SELECT scan, view, sha256 FROM projections ORDER BY scan, view",
    "SELECT key, request_sha256, scan FROM scan_keys",
    "SELECT number, id, scan, state, priority, ticket, request, mu_water, iterations, idempotency_key, request_sha256,"
    " cancel_asked, attempts, crashes, checkpoint, backend, device, plan, error_code, error_pointer, error_text, "
    "created,"
    " queued, started, ended, stage, iteration, fraction, basis, noise_hu, tv_alpha FROM jobs ORDER BY number",
    "SELECT " FIRST_VOLUMES ", estimate_mm FROM volumes ORDER BY number",
    "SELECT * FROM history ORDER BY job, iteration",
    "SELECT * FROM warnings ORDER BY number",
    "SELECT * FROM events ORDER BY number",
    "SELECT * FROM removals",
    "SELECT seq FROM sqlite_sequence",
};
enum { UNCHANGED = sizeof(unchanged) / sizeof(unchanged[0]) };

static void same_text(char *found, const char *wanted)
{
	ck_assert_str_eq(found, wanted);
	free(found);
}

START_TEST(a_catalogue_of_version_10_says_the_same)
{
	sqlite3 *db = open_database();
	char *before[UNCHANGED], *arrays = arrays_of_database(db), *version;

	for (int i = 0; i < UNCHANGED; i++)
		before[i] = answer(db, unchanged[i]);
	/* It has what this is about: seconds without the newest stage, memory without the newest number. */
	same_text(answer(db, "SELECT length(memory), length(seconds) FROM jobs ORDER BY number LIMIT 2"),
		  "40|40\n48|48\n");
	close_database(db);
	state_reopen(&state);
	same_text(arrays_of_store(), arrays);
	state_close(&state);
	db = open_database();
	for (int i = 0; i < UNCHANGED; i++) {
		same_text(answer(db, unchanged[i]), before[i]);
		free(before[i]);
	}
	version = answer(db, "PRAGMA user_version");
	ck_assert_int_eq(atoi(version), CATALOGUE_VERSION);
	free(version);
	same_text(answer(db, "SELECT stage_seconds LIKE '{\"load\":%\"fdk\":%}' FROM jobs WHERE number = 1"), "1\n");
	close_database(db);
	state_reopen(&state); /* once more, from the rows and records that were written */
	same_text(arrays_of_store(), arrays);
	free(arrays);
}
END_TEST

/* Version 1 had neither of these. */
START_TEST(an_older_catalogue_gets_the_columns_that_it_lacks)
{
	sqlite3 *db = open_database();
	char *arrays = arrays_of_database(db), *volumes;
	struct job_record *jobs;
	struct error err = {0};
	int count;

	run(db,
	    "DROP TABLE removals; DROP TABLE scan_keys; DROP INDEX events_once; ALTER TABLE events DROP COLUMN once;"
	    " ALTER TABLE jobs DROP COLUMN basis; ALTER TABLE jobs DROP COLUMN stamp;"
	    " ALTER TABLE jobs DROP COLUMN noise_hu; ALTER TABLE jobs DROP COLUMN tv_alpha;"
	    " ALTER TABLE scans DROP COLUMN defects; ALTER TABLE scans DROP COLUMN closed;"
	    " ALTER TABLE scans DROP COLUMN stamp; ALTER TABLE volumes DROP COLUMN estimate_mm;"
	    " PRAGMA user_version = 1");
	volumes = answer(db, "SELECT " FIRST_VOLUMES ", 0.0 FROM volumes ORDER BY number");
	close_database(db);
	state_reopen(&state);
	same_text(arrays_of_store(), arrays);
	ck_assert_int_eq(store_job_load(state.store, &jobs, &count, &err), 0);
	ck_assert_int_eq(count, 4);
	ck_assert_uint_eq(jobs[0].basis, 0);
	ck_assert(isnan(jobs[0].noise_hu) && isnan(jobs[0].tv_alpha));
	job_records_free(jobs, count);
	state_close(&state);
	db = open_database();
	same_text(answer(db, "SELECT " FIRST_VOLUMES ", estimate_mm FROM volumes ORDER BY number"), volumes);
	same_text(answer(db, "SELECT DISTINCT noise_hu, edge_mm FROM volumes"), "NULL|NULL\n");
	same_text(answer(db, "SELECT DISTINCT defects, closed FROM scans"), "NULL|0\n");
	close_database(db);
	free(arrays);
	free(volumes);
}
END_TEST

/* Digests and keys are bytes; everything else has a name or is a number. */
START_TEST(only_digests_are_bytes)
{
	char sql[512];
	int used = snprintf(sql, sizeof(sql),
			    "SELECT DISTINCT c.name FROM sqlite_master AS t, pragma_table_info(t.name) AS c WHERE "
			    "t.type = 'table' AND c.type = 'BLOB' AND c.name NOT IN ('request_sha256', 'sha256'");
	sqlite3 *db;

	for (int i = 0; i < IMAGE_COUNT; i++)
		used += snprintf(sql + used, sizeof(sql) - (size_t)used, ", '%s'", image_kinds[i].name);
	snprintf(sql + used, sizeof(sql) - (size_t)used, ")");
	state_reopen(&state);
	state_close(&state);
	db = open_database();
	same_text(answer(db, sql), "");
	close_database(db);
}
END_TEST

START_TEST(an_upgraded_catalogue_has_the_columns_of_a_new_one)
{
	static const char columns[] =
	    "SELECT t.name, c.name, c.type, c.\"notnull\" OR t.name = 'removals', c.pk"
	    " FROM sqlite_master AS t, pragma_table_info(t.name) AS c WHERE t.type = 'table' ORDER BY t.name, c.name";
	static const char indexes[] =
	    "SELECT name, tbl_name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
	    " AND name NOT LIKE 'events%' ORDER BY name";
	char *upgraded[2];
	sqlite3 *db;

	state_reopen(&state);
	state_close(&state);
	db = open_database();
	upgraded[0] = answer(db, columns);
	upgraded[1] = answer(db, indexes);
	close_database(db);
	state_remove(&state);
	state_open(&state);
	state_close(&state);
	db = open_database();
	same_text(answer(db, columns), upgraded[0]);
	same_text(answer(db, indexes), upgraded[1]);
	close_database(db);
	free(upgraded[0]);
	free(upgraded[1]);
}
END_TEST

START_TEST(stages_that_come_or_go_leave_the_others_their_seconds)
{
	struct job_record *jobs;
	struct error err = {0};
	int count;

	state_reopen(&state);
	state_close(&state);
	change("UPDATE jobs SET stage_seconds = '{\"a later stage\": 2, \"fdk\": 1.5}'");
	state_reopen(&state);
	ck_assert_int_eq(store_job_load(state.store, &jobs, &count, &err), 0);
	ck_assert_int_eq(count, 4);
	for (int i = 0; i < STAGE_COUNT; i++)
		ck_assert_double_eq(jobs[0].seconds[i], i == STAGE_FDK ? 1.5 : 0);
	job_records_free(jobs, count);
}
END_TEST

/* A later cbctd's, perhaps: the job stays with its reason, the others have theirs as they were posted. */
START_TEST(a_stored_request_that_cannot_be_read_says_why)
{
	const struct job_request *request = NULL;
	struct job *jobs[8];
	struct error err = {0};
	int count;
	bool more;

	state_reopen(&state);
	state_close(&state);
	change("UPDATE jobs SET request = '{\"scan\": \"s\", \"later\": 1}' WHERE id = '" RECORDED_JOB "'");
	state_reopen(&state);
	ck_assert_int_eq(jobs_list(state.jobs, NULL, 8, jobs, &count, &more, &err), 0);
	ck_assert_int_eq(count, 4);
	for (int i = 0; i < count; i++) {
		struct job_record record;

		job_record(jobs[i], &record);
		if (strcmp(record.id, RECORDED_JOB) == 0) {
			ck_assert_int_eq(job_request(jobs[i], &request, &err), ERR_INVALID);
			ck_assert_str_eq(err.pointer, "/later");
		} else {
			ck_assert_int_eq(job_request(jobs[i], &request, &err), 0);
			ck_assert_str_eq(request->scan, record.scan);
		}
		job_release(jobs[i]);
	}
}
END_TEST

START_TEST(a_record_of_version_10_is_read)
{
	sqlite3 *db = open_database();
	char *wanted, *row = answer(db, "SELECT memory, seconds FROM jobs WHERE id = '" RECORDED_JOB "'"), *record;
	struct store_repairs repairs;
	struct error err = {0};
	size_t length;
	FILE *out = open_memstream(&wanted, &length);

	print_arrays(out, row);
	fclose(out);
	free(row);
	close_database(db);
	state_remove(&state);
	state_open(&state);
	state_close(&state);
	ck_assert_int_eq(unlink(state_path(&state, "catalogue.sqlite")), 0);
	ck_assert_int_eq(mkdir(state_path(&state, "jobs/" RECORDED_JOB), 0700), 0);
	path_fill(state_path(&state, "jobs/" RECORDED_JOB "/final.nii"));
	record = read_text(OLD_RECORD);
	ck_assert_int_eq(
	    file_write_durable(state_path(&state, "jobs/" RECORDED_JOB "/record.json"), record, strlen(record), &err),
	    0);
	free(record);
	state_reopen(&state);
	store_repairs(state.store, &repairs);
	ck_assert_int_eq(repairs.found[1], 1);
	ck_assert_int_eq(repairs.set_aside, 0);
	same_text(arrays_of_store(), wanted);
	free(wanted);
}
END_TEST

/* ---- ends in the midst ---- */

static int statements_left;

static int count_statement(unsigned type, void *context, void *statement, void *text)
{
	(void)type;
	(void)context;
	(void)statement;
	(void)text;
	if (statements_left-- == 0)
		kill(getpid(), SIGKILL);
	return 0;
}

static int watch_statements(sqlite3 *db, char **text, const struct sqlite3_api_routines *api)
{
	(void)text;
	(void)api;
	return sqlite3_trace_v2(db, SQLITE_TRACE_STMT, count_statement, NULL);
}

/* A start in a process of its own, which a signal may end; true: it did. */
static bool start_is_killed(int statements, rlim_t file_bytes)
{
	const struct rlimit limit = {file_bytes, file_bytes};
	struct store *store;
	struct error err = {0};
	int status;
	pid_t child = fork();

	ck_assert_int_ge(child, 0);
	if (child == 0) {
		statements_left = statements;
		if (statements >= 0)
			sqlite3_auto_extension((void (*)(void))watch_statements);
		setrlimit(RLIMIT_FSIZE, &limit);
		if (store_open(state.directory, NULL, &store, &err) == 0)
			store_close(store);
		_exit(err.code == 0 ? 0 : 1);
	}
	ck_assert_int_eq(waitpid(child, &status, 0), child);
	ck_assert(WIFSIGNALED(status) || WEXITSTATUS(status) == 0);
	return WIFSIGNALED(status);
}

/* Both forms have the same numbers, and one of them is there as a whole. */
static void expect_old_or_new(const char *arrays)
{
	sqlite3 *db = open_database();
	char *version = answer(db, "PRAGMA user_version");

	if (strcmp(version, "10\n") == 0)
		same_text(arrays_of_database(db), arrays);
	else
		same_text(answer(db, "SELECT count(*), min(json_valid(stage_seconds)) FROM jobs"), "4|1\n");
	free(version);
	close_database(db);
}

START_TEST(a_start_that_is_killed_leaves_the_old_catalogue_or_the_new_one)
{
	sqlite3 *db = open_database();
	char *arrays = arrays_of_database(db);
	int starts = 0;

	close_database(db);
	while (start_is_killed(starts, RLIM_INFINITY)) {
		expect_old_or_new(arrays);
		starts++;
	}
	ck_assert_int_gt(starts, 20); /* the statements of the upgrade alone */
	state_reopen(&state);
	same_text(arrays_of_store(), arrays);
	free(arrays);
}
END_TEST

/* The commit itself: the log may have a part of it. */
START_TEST(a_commit_that_is_cut_off_leaves_the_old_catalogue_or_the_new_one)
{
	sqlite3 *db = open_database();
	char *arrays = arrays_of_database(db);
	rlim_t bytes = 4096;

	close_database(db);
	while (start_is_killed(-1, bytes)) {
		expect_old_or_new(arrays);
		bytes += 2000;
	}
	ck_assert_uint_gt(bytes, 20000); /* that much of a log the upgrade writes */
	state_reopen(&state);
	same_text(arrays_of_store(), arrays);
	free(arrays);
}
END_TEST

/* ---- a later version ---- */

static void refused_untouched(void)
{
	char *before[2] = {NULL, NULL};
	static const char *const names[2] = {"catalogue.sqlite", "catalogue.sqlite-wal"};
	struct stat status[2], now;
	struct error err = {0};
	size_t length[2] = {0}, again;
	char text[128];

	for (int i = 0; i < 2; i++) {
		if (stat(state_path(&state, "%s", names[i]), &status[i]) == 0)
			ck_assert_int_eq(
			    file_read(state_path(&state, "%s", names[i]), 1 << 24, &before[i], &length[i], &err), 0);
	}
	ck_assert_int_eq(store_open(state.directory, NULL, &state.store, &err), ERR_CONFLICT);
	snprintf(text, sizeof(text), "the catalogue has version 4711, made by a later cbctd; this one knows %d",
		 CATALOGUE_VERSION);
	ck_assert_str_eq(err.text, text);
	for (int i = 0; i < 2; i++) {
		char *after = NULL;

		if (before[i] == NULL) {
			ck_assert(!path_exists(state_path(&state, "%s", names[i])));
			continue;
		}
		ck_assert_int_eq(stat(state_path(&state, "%s", names[i]), &now), 0);
		ck_assert_int_eq(now.st_mtim.tv_sec, status[i].st_mtim.tv_sec);
		ck_assert_int_eq(now.st_mtim.tv_nsec, status[i].st_mtim.tv_nsec);
		ck_assert_int_eq(file_read(state_path(&state, "%s", names[i]), 1 << 24, &after, &again, &err), 0);
		ck_assert_uint_eq(again, length[i]);
		ck_assert_mem_eq(after, before[i], again);
		free(after);
		free(before[i]);
	}
}

START_TEST(a_later_catalogue_is_refused_untouched)
{
	change("PRAGMA user_version = 4711");
	refused_untouched();
}
END_TEST

/* The later cbctd was killed: its log alone has the version. */
START_TEST(a_later_log_is_refused_untouched)
{
	pid_t child = fork();
	int status;

	ck_assert_int_ge(child, 0);
	if (child == 0) {
		run(open_database(), "PRAGMA user_version = 4711");
		kill(getpid(), SIGKILL);
	}
	ck_assert_int_eq(waitpid(child, &status, 0), child);
	ck_assert(WIFSIGNALED(status));
	ck_assert(path_exists(state_path(&state, "catalogue.sqlite-wal")));
	refused_untouched();
}
END_TEST

Suite *upgrade_suite(void);
Suite *upgrade_suite(void)
{
	Suite *suite = suite_create("upgrade");
	TCase *tests = tcase_create("upgrade");

	tcase_add_checked_fixture(tests, set_up, tear_down);
	tcase_set_timeout(tests, 60);
	tcase_add_test(tests, a_catalogue_of_version_10_says_the_same);
	tcase_add_test(tests, an_older_catalogue_gets_the_columns_that_it_lacks);
	tcase_add_test(tests, only_digests_are_bytes);
	tcase_add_test(tests, an_upgraded_catalogue_has_the_columns_of_a_new_one);
	tcase_add_test(tests, stages_that_come_or_go_leave_the_others_their_seconds);
	tcase_add_test(tests, a_stored_request_that_cannot_be_read_says_why);
	tcase_add_test(tests, a_record_of_version_10_is_read);
	tcase_add_test(tests, a_start_that_is_killed_leaves_the_old_catalogue_or_the_new_one);
	tcase_add_test(tests, a_commit_that_is_cut_off_leaves_the_old_catalogue_or_the_new_one);
	tcase_add_test(tests, a_later_catalogue_is_refused_untouched);
	tcase_add_test(tests, a_later_log_is_refused_untouched);
	suite_add_tcase(suite, tests);
	return suite;
}

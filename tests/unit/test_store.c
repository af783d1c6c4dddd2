/* What was acknowledged is there after a restart, and nothing else is. */
#include <check.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/store/checksum_vfs.h"
#include "proto/scan_directory.h"
#include "tests/unit/state.h"

static struct state state;

static void set_up(void)
{
	state_open(&state);
}

static void tear_down(void)
{
	state_remove(&state);
}

static struct stored_scan *find(const char *id)
{
	struct stored_scan *scan = NULL;
	struct error err = {0};

	ck_assert_msg(store_scan_find(state.store, id, &scan, &err) == 0, "%s", err.text);
	return scan;
}

static struct scan_facts facts_of(struct stored_scan *scan)
{
	struct scan_facts facts;

	stored_scan_facts(scan, &facts);
	return facts;
}

START_TEST(projections_are_known_again_after_a_restart)
{
	struct stored_scan *scan = state_scan(&state, 10, false);
	unsigned char flags[10];
	struct sum sum;
	uint8_t digest[32];
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 7, 8, 0xab);
	state_put(&state, scan, 0, 0, 0xcd);
	stored_scan_release(scan);
	state_reopen(&state);
	scan = find(id);
	stored_scan_received(scan, flags);
	ck_assert_mem_eq(flags, ((unsigned char[]){1, 0, 0, 0, 0, 0, 0, 1, 1, 0}), 10);
	ck_assert(stored_scan_sum(scan, 8, &sum));
	state_digest(0xab, digest);
	ck_assert_mem_eq(sum.sha256, digest, 32);
	ck_assert(!stored_scan_sum(scan, 9, &sum));
	ck_assert_int_eq(facts_of(scan).received, 3);
	ck_assert(!facts_of(scan).complete);
	ck_assert_str_eq(stored_scan_parsed(scan)->name, "a scan");
	ck_assert_int_eq(stored_scan_parsed(scan)->count, 10);
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_projection_has_one_writer_at_a_time)
{
	struct stored_scan *scan = state_scan(&state, 3, false);
	struct error err = {0};
	enum claim claim;

	ck_assert_int_eq(stored_scan_claim(scan, 1, &claim, &err), 0);
	ck_assert_int_eq(claim, CLAIM_GRANTED);
	ck_assert_int_eq(stored_scan_claim(scan, 1, &claim, &err), 0);
	ck_assert_int_eq(claim, CLAIM_BUSY);
	stored_scan_unclaim(scan, 1);
	state_put(&state, scan, 1, 1, 1);
	ck_assert_int_eq(stored_scan_claim(scan, 1, &claim, &err), 0);
	ck_assert_int_eq(claim, CLAIM_STORED);
	ck_assert_int_eq(stored_scan_claim(scan, 3, &claim, &err), ERR_NOT_FOUND);
	stored_scan_release(scan);
}
END_TEST

START_TEST(the_file_of_the_projections_has_its_full_size_at_once_and_room_with_the_first)
{
	struct stored_scan *scan = state_scan(&state, 10, false);
	struct stat status;
	struct error err = {0};
	int file;

	ck_assert_int_eq(stat(state_path(&state, "scans/%s/projections.raw", stored_scan_id(scan)), &status), 0);
	ck_assert_int_eq(status.st_size, 10 * 4 * 3 * 4);
	ck_assert_int_eq(status.st_blocks, 0);
	ck_assert_uint_eq(store_bytes(state.store, NULL), 0);
	ck_assert_int_eq(stored_scan_open(scan, true, &file, &err), 0);
	ck_assert_int_eq(stored_scan_take_room(scan, file, &err), 0);
	close(file);
	ck_assert_int_eq(stat(state_path(&state, "scans/%s/projections.raw", stored_scan_id(scan)), &status), 0);
	ck_assert_int_eq(status.st_size, 10 * 4 * 3 * 4);
	ck_assert_int_ge(status.st_blocks * 512, status.st_size);
	ck_assert_uint_eq(store_bytes(state.store, "somebody"), 10 * 4 * 3 * 4);
	ck_assert_uint_eq(store_bytes(state.store, "another"), 0);
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_scan_beyond_the_disk_is_refused_before_anything_is_made)
{
	static const char text[] =
	    "{\"name\": \"\", \"detector\": {\"columns\": 4000, \"rows\": 3400, \"pixel_mm\": [1, 1]},"
	    " \"projections\": {\"count\": 20000, \"sample\": \"float32\", \"quantity\": \"line_integral\"},"
	    " \"geometry\": {\"kind\": \"circular\", \"source_to_isocentre_mm\": 6000, \"source_to_detector_mm\": "
	    "11000,"
	    " \"first_angle_deg\": 0, \"angle_step_deg\": 0.018}}";
	struct stored_scan *stored = NULL;
	struct scan *scan = NULL;
	struct error err = {0};
	unsigned long long available = 0;

	ck_assert_msg(scan_parse(text, strlen(text), &scan, &err) == 0, "%s", err.text);
	ck_assert_int_eq(space_free(state.directory, &available, &err), 0);
	if (available > scan_projection_bytes(scan) * 20000ull) {
		printf("SKIP unit a disk of more than a terabyte cannot be too small\n");
	} else {
		ck_assert_int_eq(store_scan_create(state.store, scan, "somebody", NULL, &stored, &err), ERR_NO_SPACE);
		ck_assert_str_eq(err.pointer, "/projections/count");
		ck_assert_ptr_null(stored);
		ck_assert_int_eq(rmdir(state_path(&state, "scans")), 0); /* nothing is in it */
	}
	scan_free(scan);
}
END_TEST

START_TEST(scans_are_listed_newest_first_from_a_cursor)
{
	struct stored_scan *made[5], *listed[5];
	struct error err = {0};
	char after[ID_SIZE];
	bool more;
	int count;

	for (int i = 0; i < 5; i++)
		made[i] = state_scan(&state, 1, false);
	ck_assert_int_eq(store_scan_list(state.store, NULL, 3, listed, &count, &more, &err), 0);
	ck_assert_int_eq(count, 3);
	ck_assert(more);
	for (int i = 0; i < 3; i++) {
		ck_assert_ptr_eq(listed[i], made[4 - i]);
		stored_scan_release(listed[i]);
	}
	/* The cursor may be deleted between two pages. */
	memcpy(after, stored_scan_id(made[2]), sizeof(after));
	ck_assert_int_eq(store_scan_delete(state.store, made[2], &err), 0);
	ck_assert_int_eq(store_scan_list(state.store, after, 3, listed, &count, &more, &err), 0);
	ck_assert_int_eq(count, 2);
	ck_assert(!more);
	for (int i = 0; i < 2; i++) {
		ck_assert_ptr_eq(listed[i], made[1 - i]);
		stored_scan_release(listed[i]);
	}
	for (int i = 0; i < 5; i++)
		stored_scan_release(made[i]);
}
END_TEST

START_TEST(a_deleted_scan_takes_no_more_projections)
{
	struct stored_scan *scan = state_scan(&state, 2, false), *other = NULL;
	struct received_projection late = {.scan = scan, .index = 1, .stored = true};
	struct error err = {0};
	enum claim claim;

	ck_assert_int_eq(stored_scan_claim(scan, 1, &claim, &err), 0);
	ck_assert_int_eq(store_scan_delete(state.store, scan, &err), 0);
	store_scan_remove_files(state.store, stored_scan_id(scan));
	ck_assert_int_eq(store_put_projections(state.store, &late, 1, &err), 0);
	ck_assert(!late.stored);
	ck_assert_int_eq(stored_scan_claim(scan, 0, &claim, &err), ERR_NOT_FOUND);
	ck_assert_int_eq(store_scan_delete(state.store, scan, &err), ERR_NOT_FOUND);
	ck_assert_int_eq(store_scan_find(state.store, stored_scan_id(scan), &other, &err), ERR_NOT_FOUND);
	ck_assert(!path_exists(state_path(&state, "scans/%s", stored_scan_id(scan))));
	stored_scan_release(scan);
}
END_TEST

START_TEST(intensities_are_ready_with_their_flat_image)
{
	struct stored_scan *scan = state_scan(&state, 2, true);
	float flat[12] = {60000}, other[12] = {1};
	struct error err = {0};
	char id[ID_SIZE];
	bool new;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 1, 1);
	ck_assert(facts_of(scan).complete);
	ck_assert(!facts_of(scan).ready);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, flat, &new, &err), 0);
	ck_assert(new);
	ck_assert(facts_of(scan).ready);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, flat, &new, &err), 0);
	ck_assert(!new);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, other, &new, &err), ERR_CONFLICT);
	stored_scan_release(scan);
	state_reopen(&state);
	scan = find(id);
	ck_assert(facts_of(scan).image[IMAGE_FLAT]);
	ck_assert(!facts_of(scan).image[IMAGE_DARK]);
	ck_assert(facts_of(scan).ready);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, other, &new, &err), ERR_CONFLICT);
	stored_scan_release(scan);
}
END_TEST

START_TEST(what_a_crash_left_is_tidied_up)
{
	struct stored_scan *scan = state_scan(&state, 2, true);
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	stored_scan_release(scan);
	path_fill(state_path(&state, "scans/%s/flat.f32.tmp", id));
	path_fill(state_path(&state, "scans/%s/dark.f32", id)); /* its row was never written */
	ck_assert_int_eq(mkdir(state_path(&state, "scans/1m7xy0w9je9g8xvw"), 0700), 0);
	path_fill(state_path(&state, "scans/1m7xy0w9je9g8xvw/projections.raw"));
	ck_assert_int_eq(mkdir(state_path(&state, "jobs/1m7xy0w9je9g8xvw"), 0700), 0);
	ck_assert_int_eq(mkdir(state_path(&state, "scans/somebody-elses"), 0700), 0);
	state_reopen(&state);
	ck_assert(path_exists(state_path(&state, "scans/%s/scan.json", id)));
	ck_assert(!path_exists(state_path(&state, "scans/%s/flat.f32.tmp", id)));
	ck_assert(!path_exists(state_path(&state, "scans/%s/dark.f32", id)));
	ck_assert(!path_exists(state_path(&state, "scans/1m7xy0w9je9g8xvw")));
	ck_assert(!path_exists(state_path(&state, "jobs/1m7xy0w9je9g8xvw")));
	ck_assert(path_exists(state_path(&state, "scans/somebody-elses")));
}
END_TEST

START_TEST(a_lost_catalogue_does_not_take_the_scans_with_it)
{
	struct stored_scan *scan = state_scan(&state, 2, false);
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	stored_scan_release(scan);
	state_close(&state);
	ck_assert_int_eq(unlink(state_path(&state, "%s", state_catalogue())), 0);
	state_reopen(&state);
	ck_assert(path_exists(state_path(&state, "scans/%s/projections.raw", id)));
}
END_TEST

/* The catalogue forgets; no daemon runs. */
static void change_catalogue(const char *statement)
{
	struct pages *pages;
	struct error err = {0};
	sqlite3 *db;

	state_close(&state);
	ck_assert_int_eq(pages_new(&pages, &err), 0);
	ck_assert_int_eq(
	    sqlite3_open_v2(state_path(&state, "catalogue.sqlite"), &db, SQLITE_OPEN_READWRITE, pages_vfs(pages)),
	    SQLITE_OK);
	ck_assert_int_eq(sqlite3_exec(db, statement, NULL, NULL, NULL), SQLITE_OK);
	sqlite3_close(db);
	pages_free(pages);
	state_reopen(&state);
}

/* Until the store's thread has held the scan's files against their checksums. */
static void await_check(struct stored_scan *scan)
{
	for (int i = 0; i < 1000 && !facts_of(scan).checked; i++)
		usleep(10000);
	ck_assert(facts_of(scan).checked);
}

static void flip_bit(const char *path, off_t bit)
{
	int file = open(path, O_RDWR | O_CLOEXEC);
	unsigned char byte;

	ck_assert_int_ge(file, 0);
	ck_assert_int_eq(pread(file, &byte, 1, bit / 8), 1);
	byte ^= (unsigned char)(1 << bit % 8);
	ck_assert_int_eq(pwrite(file, &byte, 1, bit / 8), 1);
	close(file);
}

static int read_projection(struct stored_scan *scan, int index)
{
	float pixels[12];
	struct error err = {0};
	struct sum sum;
	int file, code;

	ck_assert_int_eq(stored_scan_open(scan, false, &file, &err), 0);
	code = stored_scan_read(scan, file, index, pixels, &sum, &err);
	close(file);
	return code;
}

START_TEST(projections_whose_file_is_cut_off_are_missing)
{
	struct stored_scan *scan = state_scan(&state, 4, false);
	unsigned char flags[4];
	struct stat status;
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 2, 1);
	stored_scan_release(scan);
	state_close(&state);
	ck_assert_int_eq(truncate(state_path(&state, "scans/%s/projections.raw", id), 1 * 48 + 2), 0);
	state_reopen(&state);
	scan = find(id);
	await_check(scan);
	stored_scan_received(scan, flags);
	ck_assert_mem_eq(flags, ((unsigned char[]){1, 0, 0, 0}), 4);
	ck_assert_int_eq(facts_of(scan).lost, 2);
	ck_assert_int_eq(stat(state_path(&state, "scans/%s/projections.raw", id), &status), 0);
	ck_assert_int_eq(status.st_size, 4 * 48);
	state_put(&state, scan, 1, 3, 1);
	ck_assert(facts_of(scan).ready);
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_damaged_projection_is_missing_until_it_is_sent_again)
{
	struct stored_scan *scan = state_scan(&state, 4, false);
	unsigned char flags[4];
	struct error err = {0};
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 3, 3, 1);
	state_put(&state, scan, 0, 2, 2);
	ck_assert_int_eq(read_projection(scan, 0), 0);
	flip_bit(state_path(&state, "scans/%s/projections.raw", id), 8 * 48 * 1 + 77);
	ck_assert_int_eq(read_projection(scan, 0), 0);
	ck_assert_int_eq(read_projection(scan, 1), ERR_DAMAGED);
	ck_assert_int_eq(read_projection(scan, 1), ERR_NOT_FOUND);
	for (int starts = 0; starts < 2; starts++) {
		stored_scan_received(scan, flags);
		ck_assert_mem_eq(flags, ((unsigned char[]){1, 0, 1, 1}), 4);
		ck_assert(!facts_of(scan).complete && !facts_of(scan).ready);
		ck_assert_int_eq(facts_of(scan).lost, 1);
		ck_assert_int_eq(stored_scan_leading(scan), 1);
		stored_scan_release(scan);
		state_reopen(&state);
		scan = find(id);
	}
	state_put(&state, scan, 1, 1, 2);
	ck_assert(facts_of(scan).ready);
	ck_assert_int_eq(facts_of(scan).lost, 0);
	ck_assert_int_eq(read_projection(scan, 1), 0);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0); /* nothing to do */
	ck_assert(!facts_of(scan).closed);
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_closed_scan_waits_for_what_was_damaged_and_takes_nothing_else)
{
	struct stored_scan *scan = state_scan(&state, 6, false);
	struct error err = {0};
	enum claim claim;
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 3, 1);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	ck_assert(facts_of(scan).ready);
	flip_bit(state_path(&state, "scans/%s/projections.raw", id), 8 * 48 * 2);
	ck_assert_int_eq(read_projection(scan, 2), ERR_DAMAGED);
	for (int starts = 0; starts < 2; starts++) {
		ck_assert(facts_of(scan).closed && !facts_of(scan).complete);
		ck_assert_int_eq(stored_scan_measured(scan)->count, 4); /* of which one is to come again */
		ck_assert_int_eq(stored_scan_claim(scan, 5, &claim, &err), ERR_CONFLICT);
		ck_assert_int_eq(store_scan_close(state.store, scan, &err), ERR_CONFLICT);
		stored_scan_release(scan);
		state_reopen(&state);
		scan = find(id);
	}
	state_put(&state, scan, 2, 2, 1);
	ck_assert(facts_of(scan).ready);
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_scan_may_be_completed_without_what_was_damaged)
{
	struct stored_scan *scan = state_scan(&state, 6, false);
	struct error err = {0};
	enum claim claim;
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 3, 1);
	flip_bit(state_path(&state, "scans/%s/projections.raw", id), 8 * 48 * 2);
	ck_assert_int_eq(read_projection(scan, 2), ERR_DAMAGED);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	for (int starts = 0; starts < 2; starts++) {
		ck_assert(facts_of(scan).ready);
		ck_assert_int_eq(facts_of(scan).received, 3);
		ck_assert_int_eq(stored_scan_measured(scan)->count, 3);
		ck_assert_int_eq(stored_scan_claim(scan, 2, &claim, &err), ERR_CONFLICT);
		stored_scan_release(scan);
		state_reopen(&state);
		scan = find(id);
	}
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_damaged_image_is_to_be_sent_again)
{
	static const char *const files[IMAGE_COUNT] = {"flat.f32", "dark.f32", "defects.u8"};
	struct stored_scan *scan = state_scan(&state, 2, true);
	unsigned char map[12] = {0, 1};
	float pixels[12] = {3};
	struct error err = {0};
	char id[ID_SIZE];
	bool new;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 1, 1);
	for (int i = 0; i < IMAGE_COUNT; i++)
		ck_assert_int_eq(
		    store_put_image(state.store, scan, i, i == IMAGE_DEFECTS ? (void *)map : pixels, &new, &err), 0);
	for (int i = 0; i < IMAGE_COUNT; i++) {
		const void *image = i == IMAGE_DEFECTS ? (void *)map : pixels;
		unsigned basis = facts_of(scan).basis;

		ck_assert(facts_of(scan).ready);
		ck_assert_int_eq(store_put_image(state.store, scan, i, image, &new, &err), 0);
		ck_assert(!new);
		flip_bit(state_path(&state, "scans/%s/%s", id, files[i]), 20);
		store_scan_suspect(state.store, id);
		await_check(scan);
		for (int starts = 0; starts < 2; starts++) {
			ck_assert(facts_of(scan).lost_image[i]);
			ck_assert(facts_of(scan).complete && !facts_of(scan).convertible && !facts_of(scan).ready);
			ck_assert_uint_eq(facts_of(scan).basis, basis);
			stored_scan_release(scan);
			state_reopen(&state);
			scan = find(id);
			await_check(scan);
		}
		ck_assert_int_eq(store_put_image(state.store, scan, i, image, &new, &err), 0);
		ck_assert(new &&facts_of(scan).ready);
		ck_assert_uint_eq(facts_of(scan).basis, basis);
		flip_bit(state_path(&state, "scans/%s/%s", id, files[i]), 40); /* a PUT looks at the disk */
		ck_assert_int_eq(store_put_image(state.store, scan, i, image, &new, &err), 0);
		ck_assert(new &&facts_of(scan).ready);
	}
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_damaged_document_is_told_and_never_used)
{
	struct stored_scan *scan = state_scan(&state, 2, false), *found = NULL;
	struct error err = {0};
	char id[ID_SIZE], *text;
	size_t length;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	stored_scan_release(scan);
	ck_assert_int_eq(file_read(state_path(&state, "scans/%s/scan.json", id), 100000, &text, &length, &err), 0);
	state_close(&state);
	/* Another number, and JSON all the same. */
	flip_bit(state_path(&state, "scans/%s/scan.json", id), 8 * (strstr(text, "\"count\":2") + 8 - text));
	state_reopen(&state);
	ck_assert_int_eq(store_scan_find(state.store, id, &found, &err), ERR_DAMAGED);
	ck_assert_ptr_nonnull(strstr(err.text, "scan.json"));
	ck_assert_int_eq(store_scan_refer(state.store, id, &found, &err), 0);
	ck_assert_int_eq(store_scan_delete(state.store, found, &err), 0);
	stored_scan_release(found);
	free(text);
}
END_TEST

START_TEST(what_an_earlier_version_stored_is_checked_against_the_catalogue)
{
	OF_SQLITE();
	struct stored_scan *scan = state_scan(&state, 4, true);
	float pixels[12] = {3};
	struct error err = {0};
	unsigned char flags[4];
	struct sum sum;
	char id[ID_SIZE];
	bool new;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 3, 5);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, pixels, &new, &err), 0);
	stored_scan_release(scan);
	state_close(&state);
	ck_assert_int_eq(unlink(state_path(&state, "scans/%s/projections.sums", id)), 0);
	flip_bit(state_path(&state, "scans/%s/projections.raw", id), 8 * 48 * 2 + 3);
	state_reopen(&state);
	scan = find(id);
	await_check(scan);
	stored_scan_received(scan, flags);
	ck_assert_mem_eq(flags, ((unsigned char[]){1, 1, 0, 1}), 4);
	ck_assert(stored_scan_sum(scan, 1, &sum));
	ck_assert_uint_eq(sum.bytes, 48);
	stored_scan_release(scan);
	change_catalogue("DELETE FROM projections; UPDATE scans SET flat = NULL"); /* it has records now */
	scan = find(id);
	ck_assert_int_eq(facts_of(scan).received, 3);
	ck_assert(facts_of(scan).image[IMAGE_FLAT]);
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_state_directory_has_one_daemon)
{
	struct store *second = NULL;
	struct error err = {0};

	ck_assert_int_eq(store_open(state.directory, NULL, &second, &err), ERR_CONFLICT);
	ck_assert_ptr_null(second);
}
END_TEST

/* No file may grow: the log of the catalogue cannot take a commit. */
START_TEST(a_failed_commit_is_final_and_nothing_is_acknowledged)
{
	OF_SQLITE();
	struct stored_scan *scan = state_scan(&state, 3, false);
	struct received_projection late = {.scan = scan, .index = 1};
	struct rlimit limit, small;
	struct error err = {0};
	enum claim claim;
	char id[ID_SIZE];
	int code;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 0, 0, 1);
	ck_assert_int_eq(stored_scan_claim(scan, 1, &claim, &err), 0);
	signal(SIGXFSZ, SIG_IGN);
	ck_assert_int_eq(getrlimit(RLIMIT_FSIZE, &limit), 0);
	small = limit;
	small.rlim_cur = 4096;
	ck_assert_int_eq(setrlimit(RLIMIT_FSIZE, &small), 0);
	code = store_put_projections(state.store, &late, 1, &err);
	ck_assert_int_eq(setrlimit(RLIMIT_FSIZE, &limit), 0);
	ck_assert_int_eq(code, ERR_IO);
	ck_assert_int_eq(state.failures, 1);
	ck_assert_int_eq(facts_of(scan).received, 1);
	/* The disk is well again, but what it holds is not known: still no. */
	ck_assert_int_eq(store_put_projections(state.store, &late, 1, &err), ERR_IO);
	ck_assert_int_eq(store_scan_delete(state.store, scan, &err), ERR_IO);
	ck_assert_int_eq(state.failures, 1);
	stored_scan_unclaim(scan, 1);
	stored_scan_release(scan);
	state_reopen(&state);
	scan = find(id);
	ck_assert_int_eq(facts_of(scan).received, 1);
	state_put(&state, scan, 1, 2, 1);
	ck_assert(facts_of(scan).ready);
	stored_scan_release(scan);
}
END_TEST

static void count_wake(void *context)
{
	++*(int *)context;
}

START_TEST(arrivals_are_told_up_to_the_first_that_is_missing)
{
	struct stored_scan *scan = state_scan(&state, 8, false);
	struct error err;
	char id[ID_SIZE];

	memcpy(id, stored_scan_id(scan), sizeof(id));
	ck_assert_int_eq(stored_scan_leading(scan), 0);
	ck_assert(facts_of(scan).arrived == 0);
	state_put(&state, scan, 5, 6, 1);
	ck_assert_int_eq(stored_scan_leading(scan), 0);
	ck_assert(facts_of(scan).arrived > 0);
	state_put(&state, scan, 0, 1, 1);
	ck_assert_int_eq(stored_scan_leading(scan), 2);
	stored_scan_release(scan);
	state_reopen(&state);
	scan = find(id);
	ck_assert_int_eq(stored_scan_leading(scan), 2);
	state_put(&state, scan, 3, 4, 1);
	ck_assert_int_eq(stored_scan_leading(scan), 2);
	/* Closed, it waits for no other than one that gets lost. */
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	ck_assert_int_eq(stored_scan_leading(scan), 6);
	flip_bit(state_path(&state, "scans/%s/projections.raw", id), 8 * 48 * 4 + 77);
	ck_assert_int_eq(read_projection(scan, 4), ERR_DAMAGED);
	ck_assert_int_eq(stored_scan_leading(scan), 3);
	state_put(&state, scan, 4, 4, 1);
	ck_assert_int_eq(stored_scan_leading(scan), 6);
	stored_scan_release(scan);
}
END_TEST

START_TEST(what_was_acknowledged_is_found_again_beside_its_data)
{
	OF_SQLITE();
	struct stored_scan *scan = state_scan(&state, 10, true);
	float pixels[12] = {3};
	struct error err = {0};
	unsigned char flags[10];
	uint8_t digest[32];
	struct sum sum;
	char id[ID_SIZE];
	bool new;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	state_put(&state, scan, 7, 8, 0xab);
	state_put(&state, scan, 0, 1, 0xcd);
	ck_assert_int_eq(store_put_image(state.store, scan, IMAGE_FLAT, pixels, &new, &err), 0);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	stored_scan_release(scan);
	change_catalogue("DELETE FROM projections WHERE view <> 0; UPDATE projections SET sha256 = zeroblob(32);"
			 "UPDATE scans SET flat = NULL, closed = 0;");
	for (int starts = 0; starts < 2; starts++) { /* and are in the catalogue again */
		scan = find(id);
		stored_scan_received(scan, flags);
		ck_assert_mem_eq(flags, ((unsigned char[]){1, 1, 0, 0, 0, 0, 0, 1, 1, 0}), 10);
		ck_assert(stored_scan_sum(scan, 0, &sum));
		state_digest(0xcd, digest);
		ck_assert_mem_eq(sum.sha256, digest, 32);
		ck_assert_uint_eq(sum.bytes, sizeof(pixels));
		ck_assert(facts_of(scan).image[IMAGE_FLAT] && facts_of(scan).closed && facts_of(scan).ready);
		stored_scan_release(scan);
		state_reopen(&state);
	}
	ck_assert(path_exists(state_path(&state, "scans/%s/flat.f32", id)));
}
END_TEST

START_TEST(a_scan_that_is_closed_is_what_is_there)
{
	struct stored_scan *scan = state_scan(&state, 12, false);
	struct received_projection late = {.scan = scan, .index = 3};
	struct error err = {0};
	enum claim claim;
	char id[ID_SIZE];
	unsigned basis;

	memcpy(id, stored_scan_id(scan), sizeof(id));
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), ERR_CONFLICT); /* nothing is there */
	state_put(&state, scan, 4, 4, 1);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), ERR_CONFLICT);
	state_put(&state, scan, 1, 2, 1);
	ck_assert_int_eq(stored_scan_claim(scan, 3, &claim, &err), 0); /* on its way */
	basis = facts_of(scan).basis;
	ck_assert_ptr_eq(stored_scan_measured(scan), stored_scan_parsed(scan));
	ck_assert_msg(store_scan_close(state.store, scan, &err) == 0, "%s", err.text);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	ck_assert_uint_ne(facts_of(scan).basis, basis);
	/* what was on its way counts no more, what is there stays */
	ck_assert_int_eq(store_put_projections(state.store, &late, 1, &err), 0);
	ck_assert(!late.stored);
	ck_assert_int_eq(stored_scan_claim(scan, 3, &claim, &err), ERR_CONFLICT);
	ck_assert_int_eq(stored_scan_claim(scan, 4, &claim, &err), 0);
	ck_assert_int_eq(claim, CLAIM_STORED);
	for (int again = 0; again < 2; again++) {
		const struct scan *measured = stored_scan_measured(scan), *parsed = stored_scan_parsed(scan);

		ck_assert(facts_of(scan).closed && facts_of(scan).complete && facts_of(scan).ready);
		ck_assert_int_eq(facts_of(scan).received, 3);
		ck_assert_int_eq(parsed->count, 12);
		ck_assert_int_eq(measured->count, 3);
		ck_assert_int_eq(measured->geometry.count, 3);
		ck_assert_mem_eq(measured->projection, ((int[]){1, 2, 4}), 3 * sizeof(int));
		ck_assert_mem_eq(&measured->geometry.views[2], &parsed->geometry.views[4], sizeof(struct view));
		/* 30, 60 and 120 degrees */
		ck_assert_double_eq_tol(measured->orbit.arc, 1.57079633, 1e-6);
		ck_assert_int_eq(stored_scan_claim(scan, 0, &claim, &err), ERR_CONFLICT);
		stored_scan_release(scan);
		if (again == 0)
			state_reopen(&state);
		scan = find(id);
	}
	stored_scan_release(scan);
}
END_TEST

START_TEST(a_scan_that_is_complete_need_not_be_closed)
{
	struct stored_scan *scan = state_scan(&state, 3, false), *single = state_scan(&state, 1, false);
	struct error err = {0};

	state_put(&state, scan, 0, 2, 1);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	ck_assert(!facts_of(scan).closed);
	ck_assert_int_eq(store_scan_close(state.store, single, &err), ERR_CONFLICT);
	state_put(&state, single, 0, 0, 1);
	ck_assert_int_eq(store_scan_close(state.store, single, &err), 0);
	ck_assert_int_eq(store_scan_delete(state.store, scan, &err), 0);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), ERR_NOT_FOUND);
	stored_scan_release(scan);
	stored_scan_release(single);
}
END_TEST

START_TEST(watchers_hear_of_projections_and_of_the_end)
{
	struct stored_scan *scan = state_scan(&state, 8, false);
	int wakes = 0, arrivals = 0;
	struct watch watch = {.wake = count_wake, .context = &wakes};
	struct watch arrivals_watch = {.wake = count_wake, .context = &arrivals};
	struct error err = {0};

	stored_scan_watch(scan, &watch);
	store_watch_arrivals(state.store, &arrivals_watch);
	state_put(&state, scan, 0, 2, 1);
	ck_assert_int_eq(wakes, 1); /* a batch is one piece of news */
	ck_assert_int_eq(arrivals, 1);
	state_put(&state, scan, 5, 5, 1);
	ck_assert_int_eq(wakes, 2);
	ck_assert_int_eq(arrivals, 2);
	ck_assert_int_eq(store_scan_close(state.store, scan, &err), 0);
	ck_assert_int_eq(wakes, 3);
	ck_assert_int_eq(arrivals, 3);
	stored_scan_unwatch(scan, &watch);
	store_unwatch_arrivals(state.store, &arrivals_watch);
	stored_scan_release(scan);
}
END_TEST

Suite *store_suite(void)
{
	Suite *suite = suite_create("store");
	TCase *tests = tcase_create("store");

	tcase_add_checked_fixture(tests, set_up, tear_down);
	tcase_add_test(tests, projections_are_known_again_after_a_restart);
	tcase_add_test(tests, a_projection_has_one_writer_at_a_time);
	tcase_add_test(tests, the_file_of_the_projections_has_its_full_size_at_once_and_room_with_the_first);
	tcase_add_test(tests, a_scan_beyond_the_disk_is_refused_before_anything_is_made);
	tcase_add_test(tests, scans_are_listed_newest_first_from_a_cursor);
	tcase_add_test(tests, a_deleted_scan_takes_no_more_projections);
	tcase_add_test(tests, intensities_are_ready_with_their_flat_image);
	tcase_add_test(tests, what_a_crash_left_is_tidied_up);
	tcase_add_test(tests, a_lost_catalogue_does_not_take_the_scans_with_it);
	tcase_add_test(tests, projections_whose_file_is_cut_off_are_missing);
	tcase_add_test(tests, a_damaged_projection_is_missing_until_it_is_sent_again);
	tcase_add_test(tests, a_closed_scan_waits_for_what_was_damaged_and_takes_nothing_else);
	tcase_add_test(tests, a_scan_may_be_completed_without_what_was_damaged);
	tcase_add_test(tests, a_damaged_image_is_to_be_sent_again);
	tcase_add_test(tests, a_damaged_document_is_told_and_never_used);
	tcase_add_test(tests, what_an_earlier_version_stored_is_checked_against_the_catalogue);
	tcase_add_test(tests, a_state_directory_has_one_daemon);
	tcase_add_test(tests, a_failed_commit_is_final_and_nothing_is_acknowledged);
	tcase_add_test(tests, arrivals_are_told_up_to_the_first_that_is_missing);
	tcase_add_test(tests, what_was_acknowledged_is_found_again_beside_its_data);
	tcase_add_test(tests, a_scan_that_is_closed_is_what_is_there);
	tcase_add_test(tests, a_scan_that_is_complete_need_not_be_closed);
	tcase_add_test(tests, watchers_hear_of_projections_and_of_the_end);
	suite_add_tcase(suite, tests);
	return suite;
}

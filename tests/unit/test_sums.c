/* projections.sums: what is written is read again, and whatever damage does to it is nothing or told. */
#include <check.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "proto/sums.h"

enum { COUNT = 70, BYTES = 48 }; /* more records than are read in one go */

static char directory[64];

static void set_up(void)
{
	struct error err = {0};

	snprintf(directory, sizeof(directory), "/tmp/cbct-sums-XXXXXX");
	ck_assert_ptr_nonnull(mkdtemp(directory));
	ck_assert_msg(sums_create(directory, COUNT, BYTES, &err) == 0, "%s", err.text);
}

static const char *sums_file(void)
{
	static char path[128];

	snprintf(path, sizeof(path), "%s/%s", directory, SUMS_FILE);
	return path;
}

static void tear_down(void)
{
	unlink(sums_file());
	rmdir(directory);
}

static int open_whole(void)
{
	struct error err = {0};
	bool whole;
	int file;

	ck_assert_msg(sums_open(directory, true, COUNT, BYTES, &file, &whole, &err) == 0, "%s", err.text);
	ck_assert(whole);
	return file;
}

static struct sum sum_of(int slot)
{
	struct sum sum = {.crc = 0x01020304u * (unsigned)(slot + 9),
			  .bytes = BYTES,
			  .order = (uint64_t)1 << 40 | (unsigned)(slot + 9),
			  .lost = slot % 2 == 0};

	memset(sum.sha256, slot + 9, sizeof(sum.sha256));
	return sum;
}

static void check_sum(const struct sum *found, int slot)
{
	struct sum expected = sum_of(slot);

	ck_assert_mem_eq(found->sha256, expected.sha256, 32);
	ck_assert_uint_eq(found->crc, expected.crc);
	ck_assert_uint_eq(found->bytes, expected.bytes);
	ck_assert_uint_eq(found->order, expected.order);
	ck_assert_int_eq(found->lost, expected.lost);
}

/* The check value of CRC-32 (ITU-T V.42), and of two pieces as of the whole. */
START_TEST(the_checksum_is_crc_32)
{
	ck_assert_uint_eq(checksum(0, "123456789", 9), 0xcbf43926);
	ck_assert_uint_eq(checksum(checksum(0, "1234", 4), "56789", 5), 0xcbf43926);
}
END_TEST

/* Bit by bit, as the standard has it. */
static uint32_t crc_by_definition(uint32_t before, const uint8_t *bytes, size_t count)
{
	uint32_t crc = ~before;

	for (size_t i = 0; i < count; i++) {
		crc ^= bytes[i];
		for (int bit = 0; bit < 8; bit++)
			crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
	}
	return ~crc;
}

START_TEST(the_checksum_is_the_same_however_much_and_wherever_it_lies)
{
	uint8_t bytes[700];
	uint32_t random = 1;

	for (size_t i = 0; i < sizeof(bytes); i++) {
		random = random * 1664525 + 1013904223;
		bytes[i] = (uint8_t)(random >> 24);
	}
	for (size_t first = 0; first < 17; first++)
		for (size_t count = 0; count + first <= sizeof(bytes); count++) {
			uint32_t before = count % 3 == 0 ? 0 : random * (uint32_t)count;

			ck_assert_uint_eq(checksum(before, bytes + first, count),
					  crc_by_definition(before, bytes + first, count));
		}
	for (size_t count = 0; count <= sizeof(bytes); count += 7)
		ck_assert_uint_eq(checksum_join(checksum(0, bytes, count),
						checksum(0, bytes + count, sizeof(bytes) - count),
						sizeof(bytes) - count),
				  crc_by_definition(0, bytes, sizeof(bytes)));
}
END_TEST

START_TEST(records_are_read_as_they_were_written)
{
	struct sum sums[COUNT - SUMS_SCAN];
	unsigned char states[COUNT - SUMS_SCAN];
	struct error err = {0};
	int file = open_whole();

	for (int slot = SUMS_SCAN; slot < COUNT; slot += 3) {
		struct sum sum = sum_of(slot);

		ck_assert_int_eq(sums_put(file, slot, &sum, &err), 0);
	}
	ck_assert_int_eq(sums_get(file, SUMS_SCAN, COUNT - SUMS_SCAN, BYTES, sums, states, &err), 0);
	for (int i = 0; i < COUNT - SUMS_SCAN; i++) {
		ck_assert_int_eq(states[i], i % 3 == 0 ? SUM_GOOD : SUM_NONE);
		if (i % 3 == 0)
			check_sum(&sums[i], SUMS_SCAN + i);
	}
	ck_assert_int_eq(sums_put(file, SUMS_SCAN, NULL, &err), 0);
	ck_assert_int_eq(sums_get(file, SUMS_SCAN, 1, BYTES, sums, states, &err), 0);
	ck_assert_int_eq(states[0], SUM_NONE);
	close(file);
}
END_TEST

START_TEST(a_flipped_bit_makes_a_record_void)
{
	uint8_t record[SUMS_RECORD_BYTES];
	struct sum sum = sum_of(5), found;

	sum_pack(&sum, 5, record);
	ck_assert_int_eq(sum_unpack(record, 5, &found), SUM_GOOD);
	check_sum(&found, 5);
	ck_assert_int_eq(sum_unpack(record, 6, &found), SUM_DAMAGED); /* copied to another's place */
	for (int bit = 0; bit < 8 * SUMS_RECORD_BYTES; bit++) {
		record[bit / 8] ^= (uint8_t)(1 << bit % 8);
		ck_assert_int_eq(sum_unpack(record, 5, &found), SUM_DAMAGED);
		record[bit / 8] ^= (uint8_t)(1 << bit % 8);
	}
	for (int torn = 1; torn < SUMS_RECORD_BYTES; torn++) { /* its end was not written */
		uint8_t half[SUMS_RECORD_BYTES] = {0};

		memcpy(half, record, (size_t)torn);
		ck_assert_int_eq(sum_unpack(half, 5, &found), SUM_DAMAGED);
	}
}
END_TEST

START_TEST(a_record_of_other_bytes_is_void)
{
	struct sum sum = sum_of(2), found;
	struct error err = {0};
	unsigned char state;
	int file = open_whole();

	ck_assert_int_eq(sums_put(file, 2, &sum, &err), 0);
	ck_assert_int_eq(sums_get(file, 2, 1, BYTES + 4, &found, &state, &err), 0);
	ck_assert_int_eq(state, SUM_DAMAGED);
	ck_assert_int_eq(sums_get(file, 2, 1, 0, &found, &state, &err), 0);
	ck_assert_int_eq(state, SUM_GOOD);
	close(file);
}
END_TEST

START_TEST(a_damaged_line_takes_no_record_with_it)
{
	struct sum sum = sum_of(69), found;
	struct error err = {0};
	unsigned char state;
	bool whole;
	int file = open_whole();

	ck_assert_int_eq(sums_put(file, 69, &sum, &err), 0);
	for (int bit = 0; bit < 8 * SUMS_RECORD_BYTES; bit++) {
		uint8_t byte;
		int again;

		ck_assert_int_eq(pread(file, &byte, 1, bit / 8), 1);
		byte ^= (uint8_t)(1 << bit % 8);
		ck_assert_int_eq(pwrite(file, &byte, 1, bit / 8), 1);
		ck_assert_msg(sums_open(directory, false, COUNT, BYTES, &again, &whole, &err) == 0, "bit %d: %s", bit,
			      err.text);
		ck_assert(!whole);
		ck_assert_int_eq(sums_get(again, 69, 1, BYTES, &found, &state, &err), 0);
		ck_assert_int_eq(state, SUM_GOOD);
		close(again);
		byte ^= (uint8_t)(1 << bit % 8);
		ck_assert_int_eq(pwrite(file, &byte, 1, bit / 8), 1);
	}
	close(file);
}
END_TEST

START_TEST(a_file_that_is_cut_off_has_the_records_before)
{
	struct sum sum = sum_of(3), sums[COUNT];
	unsigned char states[COUNT];
	struct error err = {0};
	bool whole;
	int file = open_whole();

	for (int slot = 3; slot < 5; slot++) {
		sum = sum_of(slot);
		ck_assert_int_eq(sums_put(file, slot, &sum, &err), 0);
	}
	close(file);
	ck_assert_int_eq(truncate(sums_file(), SUMS_FIRST + 4 * SUMS_RECORD_BYTES + 20), 0);
	ck_assert_int_eq(sums_open(directory, false, COUNT, BYTES, &file, &whole, &err), 0);
	ck_assert(!whole);
	ck_assert_int_eq(sums_get(file, 0, COUNT, BYTES, sums, states, &err), 0);
	ck_assert_int_eq(states[3], SUM_GOOD);
	ck_assert_int_eq(states[4], SUM_DAMAGED);
	ck_assert_int_eq(states[5], SUM_NONE);
	close(file);
}
END_TEST

START_TEST(another_scans_file_is_refused)
{
	struct error err = {0};
	bool whole;
	int file;

	ck_assert_int_eq(sums_open(directory, false, COUNT + 1, BYTES, &file, &whole, &err), ERR_INVALID);
	ck_assert_ptr_nonnull(strstr(err.text, "cbctd sums 1: 70 of 48 bytes"));
	ck_assert_int_eq(sums_open(directory, false, COUNT, BYTES + 1, &file, &whole, &err), ERR_INVALID);
	ck_assert_int_eq(unlink(sums_file()), 0);
	ck_assert_int_eq(sums_open(directory, false, COUNT, BYTES, &file, &whole, &err), ERR_NOT_FOUND);
}
END_TEST

Suite *sums_suite(void);
Suite *sums_suite(void)
{
	Suite *suite = suite_create("sums");
	TCase *tests = tcase_create("sums");

	tcase_add_checked_fixture(tests, set_up, tear_down);
	tcase_add_test(tests, the_checksum_is_crc_32);
	tcase_add_test(tests, the_checksum_is_the_same_however_much_and_wherever_it_lies);
	tcase_add_test(tests, records_are_read_as_they_were_written);
	tcase_add_test(tests, a_flipped_bit_makes_a_record_void);
	tcase_add_test(tests, a_record_of_other_bytes_is_void);
	tcase_add_test(tests, a_damaged_line_takes_no_record_with_it);
	tcase_add_test(tests, a_file_that_is_cut_off_has_the_records_before);
	tcase_add_test(tests, another_scans_file_is_refused);
	suite_add_tcase(suite, tests);
	return suite;
}

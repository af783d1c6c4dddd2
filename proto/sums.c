/* Checksums of the files of a scan directory: sums.h. */
#include "proto/sums.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <zlib.h>
#ifdef __x86_64__
#include <wmmintrin.h>
#endif

#include "proto/regular.h"
#include "proto/scan_directory.h"

enum { SLOT_LEAST = SUMS_SCAN, CHECKED_BYTES = SUMS_RECORD_BYTES - 4 };

_Static_assert(SUMS_FIRST + SUMS_RECORD_BYTES * SLOT_LEAST == SUMS_RECORD_BYTES, "the line lies before the first part");

#ifdef __x86_64__
/*
 * The same CRC by carry-less multiplication, four times as fast as zlib's tables: 128 bits of the message, times x to
 * the power of a distance, are as good modulo the polynomial at that distance (Gopal and others, "Fast CRC Computation
 * for Generic Polynomials Using PCLMULQDQ", Intel 2009). The numbers are x^(d+64) and x^d mod P for d = 512 - 32 and
 * 128 - 32 bits, all bit-reflected. What is left in the end are 16 bytes that zlib sums.
 */
enum { FOLD_LEAST = 128 };

__attribute__((target("pclmul"))) static __m128i fold(__m128i part, __m128i by, __m128i next)
{
	__m128i low = _mm_clmulepi64_si128(part, by, 0x00), high = _mm_clmulepi64_si128(part, by, 0x11);

	return _mm_xor_si128(_mm_xor_si128(low, high), next);
}

/* `bytes` is a multiple of 16, at least 64. */
__attribute__((target("pclmul"))) static uint32_t checksum_folded(uint32_t before, const uint8_t *data, size_t bytes)
{
	const __m128i by64 = _mm_set_epi64x(0x1c6e41596, 0x154442bd4), by16 = _mm_set_epi64x(0x0ccaa009e, 0x1751997d0);
	const __m128i *from = (const __m128i *)(const void *)data, *end = from + bytes / 16;
	uint8_t rest[16];
	__m128i x[4];

	for (int i = 0; i < 4; i++)
		x[i] = _mm_loadu_si128(from + i);
	x[0] = _mm_xor_si128(x[0], _mm_cvtsi32_si128((int)~before));
	for (from += 4; end - from >= 4; from += 4) {
		for (int i = 0; i < 4; i++)
			x[i] = fold(x[i], by64, _mm_loadu_si128(from + i));
	}
	for (int i = 1; i < 4; i++)
		x[0] = fold(x[0], by16, x[i]);
	for (; from < end; from++)
		x[0] = fold(x[0], by16, _mm_loadu_si128(from));
	_mm_storeu_si128((__m128i *)(void *)rest, x[0]);
	return (uint32_t)crc32_z(~0u, rest, sizeof(rest)); /* which takes ~0 for a register of zeros */
}
#endif

uint32_t checksum(uint32_t before, const void *data, size_t bytes)
{
#ifdef __x86_64__
	if (bytes >= FOLD_LEAST && __builtin_cpu_supports("pclmul")) {
		size_t whole = bytes & ~(size_t)15;

		before = checksum_folded(before, data, whole);
		data = (const uint8_t *)data + whole;
		bytes -= whole;
	}
#endif
	return (uint32_t)crc32_z(before, data, bytes);
}

uint32_t checksum_join(uint32_t before, uint32_t after, size_t bytes)
{
	return (uint32_t)crc32_combine(before, after, (z_off_t)bytes);
}

/* ---- records ---- */

static void put_little(uint8_t *to, uint64_t value, int bytes)
{
	for (int i = 0; i < bytes; i++)
		to[i] = (uint8_t)(value >> 8 * i);
}

static uint64_t get_little(const uint8_t *from, int bytes)
{
	uint64_t value = 0;

	for (int i = bytes; i-- > 0;)
		value = value << 8 | from[i];
	return value;
}

void sum_pack(const struct sum *sum, int slot, uint8_t ret_record[SUMS_RECORD_BYTES])
{
	memcpy(ret_record, sum->sha256, 32);
	put_little(ret_record + 32, sum->crc, 4);
	put_little(ret_record + 36, (uint32_t)slot, 4);
	put_little(ret_record + 40, sum->bytes, 8);
	put_little(ret_record + 48, sum->order, 8);
	put_little(ret_record + 56, sum->lost, 4);
	put_little(ret_record + CHECKED_BYTES, checksum(0, ret_record, CHECKED_BYTES), 4);
}

enum sum_state sum_unpack(const uint8_t record[SUMS_RECORD_BYTES], int slot, struct sum *ret_sum)
{
	static const uint8_t blank[SUMS_RECORD_BYTES];

	if (memcmp(record, blank, sizeof(blank)) == 0)
		return SUM_NONE;
	if (get_little(record + CHECKED_BYTES, 4) != checksum(0, record, CHECKED_BYTES) ||
	    get_little(record + 36, 4) != (uint32_t)slot)
		return SUM_DAMAGED;
	memcpy(ret_sum->sha256, record, 32);
	ret_sum->crc = (uint32_t)get_little(record + 32, 4);
	ret_sum->bytes = get_little(record + 40, 8);
	ret_sum->order = get_little(record + 48, 8);
	ret_sum->lost = get_little(record + 56, 4) != 0;
	return SUM_GOOD;
}

/* ---- the file ---- */

static void write_line(int count, size_t projection_bytes, char ret_line[SUMS_RECORD_BYTES])
{
	char text[SUMS_RECORD_BYTES];
	int length = snprintf(text, sizeof(text), "cbctd sums 1: %d of %zu bytes", count, projection_bytes);

	memset(ret_line, ' ', SUMS_RECORD_BYTES);
	memcpy(ret_line, text, (size_t)length);
	snprintf(text, sizeof(text), "%08x\n", checksum(0, ret_line, SUMS_RECORD_BYTES - 9));
	memcpy(ret_line + SUMS_RECORD_BYTES - 9, text, 9);
}

static off_t offset_of(int slot)
{
	return SUMS_FIRST + (off_t)SUMS_RECORD_BYTES * slot;
}

static size_t file_bytes(int count)
{
	return (size_t)offset_of(count);
}

int sums_create_file(const char *directory, const char *name, int count, size_t each, const struct sum *first,
		     struct error *err)
{
	/* Zeros that are written, not set aside: each later sync finds its blocks in place. */
	char path[PATH_MAX], *bytes = calloc(1, file_bytes(count));
	int code = bytes == NULL ? error_set_errno(err, ENOMEM, "checksums of %d projections", count)
				 : path_join(path, sizeof(path), directory, name, "", err);

	if (code == 0) {
		write_line(count, each, bytes);
		for (int slot = SUMS_SCAN; first != NULL && slot < count; slot = slot < 0 ? 0 : slot + 1)
			sum_pack(first, slot, (uint8_t *)bytes + offset_of(slot));
		code = file_write_durable(path, bytes, file_bytes(count), err);
	}
	free(bytes);
	return code;
}

int sums_create(const char *directory, int count, size_t projection_bytes, struct error *err)
{
	return sums_create_file(directory, SUMS_FILE, count, projection_bytes, NULL, err);
}

/* Whether this line is a good one, though of other numbers. */
static bool is_line(const char line[SUMS_RECORD_BYTES])
{
	char text[10];

	snprintf(text, sizeof(text), "%08x\n", checksum(0, line, SUMS_RECORD_BYTES - 9));
	return memcmp(line + SUMS_RECORD_BYTES - 9, text, 9) == 0;
}

static int check_line(int file, const char *path, int count, size_t projection_bytes, bool *ret_whole,
		      struct error *err)
{
	char expected[SUMS_RECORD_BYTES], found[SUMS_RECORD_BYTES] = "";
	off_t size = lseek(file, 0, SEEK_END);

	if (size < 0 || pread(file, found, sizeof(found), 0) < 0)
		return error_set_errno(err, errno, "%s cannot be read", path);
	write_line(count, projection_bytes, expected);
	*ret_whole = size == (off_t)file_bytes(count) && memcmp(found, expected, sizeof(found)) == 0;
	if (count == 0 || *ret_whole || !is_line(found) || memcmp(found, expected, sizeof(found)) == 0)
		return 0;
	return error_set(err, ERR_INVALID, "%.150s is of another scan: \"%.54s\", expected %d of %zu bytes", path,
			 found, count, projection_bytes);
}

int sums_open_file(const char *directory, const char *name, bool writing, int count, size_t each, int *ret_file,
		   bool *ret_whole, struct error *err)
{
	char path[PATH_MAX];
	int file, code = path_join(path, sizeof(path), directory, name, "", err);

	if (code != 0)
		return code;
	file = regular_open(path, writing ? O_RDWR : O_RDONLY, 0);
	if (file < 0 && errno == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "%.200s does not exist", path);
	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	code = check_line(file, path, count, each, ret_whole, err);
	if (code != 0)
		close(file);
	else
		*ret_file = file;
	return code;
}

int sums_open(const char *directory, bool writing, int count, size_t projection_bytes, int *ret_file, bool *ret_whole,
	      struct error *err)
{
	return sums_open_file(directory, SUMS_FILE, writing, count, projection_bytes, ret_file, ret_whole, err);
}

int sums_put(int file, int slot, const struct sum *sum, struct error *err)
{
	uint8_t record[SUMS_RECORD_BYTES] = {0};
	ssize_t wrote;

	if (sum != NULL)
		sum_pack(sum, slot, record);
	do {
		wrote = pwrite(file, record, sizeof(record), offset_of(slot));
	} while (wrote < 0 && errno == EINTR);
	if (wrote != (ssize_t)sizeof(record)) /* within one page: all of it or an error */
		return error_set_errno(err, wrote < 0 ? errno : EIO, "checksum of projection %d", slot);
	return 0;
}

/* As many bytes as there are. */
static int read_up_to(int file, uint8_t *ret_to, size_t size, off_t offset, struct error *err)
{
	for (size_t done = 0; done < size;) {
		ssize_t got = pread(file, ret_to + done, size - done, offset + (off_t)done);

		if (got < 0 && errno == EINTR)
			continue;
		if (got < 0)
			return error_set_errno(err, errno, "%s cannot be read", SUMS_FILE);
		if (got == 0)
			return 0;
		done += (size_t)got;
	}
	return 0;
}

int sums_get(int file, int slot, int count, size_t bytes, struct sum *ret_sums, unsigned char *ret_states,
	     struct error *err)
{
	enum { SOME = 64 };
	uint8_t records[SOME * SUMS_RECORD_BYTES];
	int code = 0;

	for (int done = 0; done < count && code == 0; done += SOME) {
		int some = count - done < SOME ? count - done : SOME;

		memset(records, 0, sizeof(records));
		code = read_up_to(file, records, (size_t)some * SUMS_RECORD_BYTES, offset_of(slot + done), err);
		for (int i = 0; i < some && code == 0; i++) {
			struct sum sum;
			enum sum_state state =
			    sum_unpack(records + (size_t)i * SUMS_RECORD_BYTES, slot + done + i, &sum);

			if (state == SUM_GOOD && bytes != 0 && sum.bytes != bytes)
				state = SUM_DAMAGED;
			if (state == SUM_GOOD)
				ret_sums[done + i] = sum;
			ret_states[done + i] = (unsigned char)state;
		}
	}
	return code;
}

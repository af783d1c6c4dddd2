/* Checksums at the end of a file: seal.h. */
#include "proto/seal.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/pulse.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

static int block_count(size_t content)
{
	return (int)((content + SEAL_BLOCK - 1) / SEAL_BLOCK);
}

size_t seal_bytes(size_t content)
{
	return (size_t)block_count(content) * 4 + SEAL_LINE;
}

static void put_little(uint8_t *to, uint32_t value)
{
	for (int i = 0; i < 4; i++)
		to[i] = (uint8_t)(value >> 8 * i);
}

static uint32_t get_little(const uint8_t *from)
{
	return from[0] | (uint32_t)from[1] << 8 | (uint32_t)from[2] << 16 | (uint32_t)from[3] << 24;
}

static void write_line(size_t content, uint32_t table, char ret_line[SEAL_LINE])
{
	char text[SEAL_LINE];
	int length = snprintf(text, sizeof(text), "cbctd seal 1: %zu in %d, %08x", content, SEAL_BLOCK, table);

	memset(ret_line, ' ', SEAL_LINE);
	memcpy(ret_line, text, (size_t)length);
	snprintf(text, sizeof(text), "%08x\n", checksum(0, ret_line, SEAL_LINE - 9));
	memcpy(ret_line + SEAL_LINE - 9, text, 9);
}

void seal_write(const uint32_t *blocks, size_t content, void *ret_end)
{
	uint8_t *end = ret_end;
	int count = block_count(content);
	size_t table = (size_t)count * 4;

	for (int i = 0; i < count; i++)
		put_little(end + 4 * (size_t)i, blocks[i]);
	write_line(content, checksum(0, end, table), (char *)end + table);
}

/* Whether table and line, the last bytes of a file of `size` bytes, are whole. */
static bool is_seal(const uint8_t *table, const char line[SEAL_LINE], size_t content)
{
	char expected[SEAL_LINE];

	write_line(content, checksum(0, table, (size_t)block_count(content) * 4), expected);
	return memcmp(line, expected, SEAL_LINE) == 0;
}

static int read_table(int file, size_t size, const char line[SEAL_LINE], struct seal *ret_seal, struct error *err)
{
	size_t content = ret_seal->content, table = (size_t)block_count(content) * 4;
	uint8_t *bytes = malloc(table + 1);
	int code = 0;

	ret_seal->count = block_count(content);
	ret_seal->blocks = calloc((size_t)ret_seal->count + 1, sizeof(*ret_seal->blocks));
	if (bytes == NULL || ret_seal->blocks == NULL)
		code = error_set_errno(err, ENOMEM, "checksums of %zu bytes", content);
	if (code == 0)
		code = file_read_at(file, bytes, table, size - SEAL_LINE - table, "checksums", err);
	if (code == 0 && !is_seal(bytes, line, content))
		code = error_set(err, ERR_NOT_FOUND, "the file's checksums are damaged");
	for (int i = 0; i < ret_seal->count && code == 0; i++)
		ret_seal->blocks[i] = get_little(bytes + 4 * (size_t)i);
	free(bytes);
	return code;
}

int seal_read(int file, struct seal *ret_seal, struct error *err)
{
	struct seal seal = {0};
	char line[SEAL_LINE + 1] = "";
	struct stat status;
	size_t size;
	int code;

	if (fstat(file, &status) != 0)
		return error_set_errno(err, errno, "a file's checksums");
	size = (size_t)status.st_size;
	if (size < SEAL_LINE)
		return error_set(err, ERR_NOT_FOUND, "the file has no checksums");
	code = file_read_at(file, line, SEAL_LINE, size - SEAL_LINE, "checksums", err);
	if (code != 0)
		return code;
	if (sscanf(line, "cbctd seal 1: %zu in", &seal.content) != 1 || seal.content > size ||
	    seal.content + seal_bytes(seal.content) != size)
		return error_set(err, ERR_NOT_FOUND, "the file has no checksums");
	code = read_table(file, size, line, &seal, err);
	if (code != 0)
		seal_clear(&seal);
	else
		*ret_seal = seal;
	return code;
}

void seal_clear(struct seal *seal)
{
	free(seal->blocks);
	*seal = (struct seal){0};
}

size_t seal_block_bytes(const struct seal *seal, int block)
{
	size_t first = (size_t)block * SEAL_BLOCK;

	return seal->content - first < SEAL_BLOCK ? seal->content - first : SEAL_BLOCK;
}

int seal_first_damaged(const struct seal *seal, const void *content)
{
	int damaged = seal->count;

#pragma omp parallel for schedule(dynamic) reduction(min : damaged)
	for (int block = 0; block < seal->count; block++) {
		const char *bytes = (const char *)content + (size_t)block * SEAL_BLOCK;

		if (checksum(0, bytes, seal_block_bytes(seal, block)) != seal->blocks[block] && block < damaged)
			damaged = block;
		pulse_beat();
	}
	return damaged < seal->count ? damaged : -1;
}

/* ---- making one ---- */

int seal_maker_new(size_t content, struct seal_maker *ret_maker, struct error *err)
{
	struct seal_maker maker = {.room = block_count(content)};

	maker.blocks = calloc((size_t)maker.room + 1, sizeof(*maker.blocks));
	if (maker.blocks == NULL)
		return error_set_errno(err, ENOMEM, "checksums of %zu bytes", content);
	*ret_maker = maker;
	return 0;
}

void seal_maker_add(struct seal_maker *maker, const void *bytes, size_t size)
{
	size_t first = maker->at, end = first + size;
	int from = (int)(first / SEAL_BLOCK), to = block_count(end);

	/* zlib takes bytes at NULL for a wish to begin anew. */
	if (size == 0)
		return;
#pragma omp parallel for schedule(dynamic) if (to - from > 2)
	for (int block = from; block < to; block++) {
		size_t begin = (size_t)block * SEAL_BLOCK, last = begin + SEAL_BLOCK;

		begin = begin > first ? begin : first;
		last = last < end ? last : end;
		maker->blocks[block] =
		    checksum(maker->blocks[block], (const char *)bytes + (begin - first), last - begin);
	}
	maker->at = end;
}

void seal_maker_clear(struct seal_maker *maker)
{
	free(maker->blocks);
	*maker = (struct seal_maker){0};
}

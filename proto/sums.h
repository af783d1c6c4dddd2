#ifndef CBCT_PROTO_SUMS_H
#define CBCT_PROTO_SUMS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/error.h"

/*
 * projections.sums: what the other files of a scan directory must be, so that damage is found by whoever reads them and
 * so that what was acknowledged is known without the catalogue.
 *
 *   bytes 0 .. 63     a line of text: format, version, number of projections, bytes of each, its own check
 *   bytes 64 .. 511   a record for each of the parts below, and room
 *   byte 512 + 64 k   the record of projection k
 *
 * A record has 64 bytes, little-endian: SHA-256 of the bytes [32], their CRC-32 [4], its slot [4], how many bytes they
 * are [8], order of arrival [8], 1 where they were found damaged [4], CRC-32 of the 60 bytes before [4]. All zeros:
 * there is none. Any other record whose check, slot or number of bytes is wrong is torn or damaged and stands for
 * nothing. Records lie within one sector, so a power cut leaves the old one or the new one.
 *
 * A record is written and synced together with the bytes that it describes, before either is acknowledged. So a record
 * that is good says what was acknowledged, and the bytes are checked against it whenever they are read: CRC-32 (zlib's)
 * for speed, SHA-256 where the outside sees it.
 *
 * Any thread; one writer of a record at a time.
 */
#define SUMS_FILE "projections.sums"
#define SUMS_SCATTER_FILE "scatter.sums" /* of images of scatter, proto/scatter_file.h; it has no parts but a mark */

enum { SUMS_RECORD_BYTES = 64, SUMS_FIRST = 512 };

/* Slots of records: projections by their numbers, and these. */
enum sums_part {
	SUMS_SCAN = -7,   /* scan.json */
	SUMS_CLOSED = -3, /* of no bytes: the scan was completed with those projections that are there */
	SUMS_PARTS = 7    /* slots of parts: these, and those of core/scan/image.h between and behind them */
};

struct sum {
	uint8_t sha256[32];
	uint32_t crc;
	uint64_t bytes;
	uint64_t order; /* of arrival: grows within a scan, gaps are fine */
	bool lost;      /* the bytes were found damaged: they are to be sent again */
};

enum sum_state { SUM_NONE, SUM_GOOD, SUM_DAMAGED };

/* CRC-32 of `before` and these bytes behind it; 0 is that of nothing. */
uint32_t checksum(uint32_t before, const void *data, size_t bytes);

/* The CRC-32 of `bytes` bytes with the checksum `after` behind others with `before`. */
uint32_t checksum_join(uint32_t before, uint32_t after, size_t bytes);

/* The file with all records blank, durably; one that was there is replaced. */
int sums_create(const char *directory, int count, size_t projection_bytes, struct error *err);
/* first: the record of each of them, and of slot SUMS_SCAN; NULL: a blank one. */
int sums_create_file(const char *directory, const char *name, int count, size_t each, const struct sum *first,
		     struct error *err);
/*
 * A descriptor, the caller's to close. ERR_NOT_FOUND where there is no file, ERR_INVALID where it is another scan's. A
 * line that is damaged is passed over (*ret_whole false, as when the file is too short): the records check themselves.
 * count 0: not known yet, any line will do.
 */
int sums_open(const char *directory, bool writing, int count, size_t projection_bytes, int *ret_file, bool *ret_whole,
	      struct error *err);
int sums_open_file(const char *directory, const char *name, bool writing, int count, size_t each, int *ret_file,
		   bool *ret_whole, struct error *err);
/* Writes a record and does not sync it; sum NULL: a blank one. */
int sums_put(int file, int slot, const struct sum *sum, struct error *err);
/*
 * Records `slot`, slot + 1, ...; a file that ends before them has none there. `bytes` is what each must be of, 0: any
 * number. ret_sums[i] is set where ret_states[i] (enum sum_state) is SUM_GOOD.
 */
int sums_get(int file, int slot, int count, size_t bytes, struct sum *ret_sums, unsigned char *ret_states,
	     struct error *err);

/* From and to the 64 bytes of a record. */
void sum_pack(const struct sum *sum, int slot, uint8_t ret_record[SUMS_RECORD_BYTES]);
enum sum_state sum_unpack(const uint8_t record[SUMS_RECORD_BYTES], int slot, struct sum *ret_sum);

#endif

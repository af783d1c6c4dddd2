#ifndef CBCT_DAEMON_STORE_LOG_EXTENT_H
#define CBCT_DAEMON_STORE_LOG_EXTENT_H

#include <stdbool.h>
#include <stdint.h>

/*
 * How far SQLite's log is synced. Not every transaction is: those behind the last sync may be gone after a power cut,
 * in any order, and a later one may be there without an earlier one. That is no damage. Those before it may not be
 * gone. So after each sync of the log a file beside it, NAME-synced, gets the log's salts and the number of its frames
 * up to the last transaction that was whole then. The note itself is not synced: an old one promises less than it
 * could.
 *
 * A log is a header of 32 bytes, with two random salts that change whenever it begins anew, and frames of a header of
 * 24 bytes and a page (https://sqlite.org/fileformat2.html, section 4). Callers hold a lock of theirs.
 */
enum { LOG_HEADER = 32, FRAME_HEADER = 24, LOG_SALTS_AT = 16, LOG_SALTS = 8 };

struct log_extent {
	int note; /* descriptor of NAME-synced, -1: not open */
	bool has_salts;
	unsigned char salts[LOG_SALTS];
	long ending; /* the frame whose header ends a transaction and whose page comes next, or -1 */
	long whole;  /* frames up to the last whole transaction that was written since the start */
	long synced; /* ... of which the note says that they are synced */
};

void log_extent_init(struct log_extent *extent);
void log_extent_close(struct log_extent *extent);
/* log: the log's path; header: as it was found, NULL where there is none yet. Again for each connection. */
void log_extent_open(struct log_extent *extent, const char *log, const unsigned char *header);

/* Before the log's header is written: it begins anew. */
void log_extent_begin(struct log_extent *extent, const unsigned char header[LOG_HEADER]);
/*
 * Before the header of a frame is written. A frame of a transaction that is whole is never written again, unless SQLite
 * itself took the transaction back, for want of memory: then the promise must go first. False: it cannot.
 */
bool log_extent_frame(struct log_extent *extent, long frame, const unsigned char header[FRAME_HEADER]);
/* Behind the page of a frame. */
void log_extent_page(struct log_extent *extent, long frame);
/* After a sync of the log that began when the extent was `before`. */
void log_extent_synced(struct log_extent *extent, const struct log_extent *before);

/* The frames that were synced of a log with these salts; 0 where nothing says so. */
long log_extent_read(const char *log, const unsigned char salts[LOG_SALTS]);

/* Numbers in the database's files are big-endian. */
static inline uint32_t big(const unsigned char *bytes)
{
	return (uint32_t)bytes[0] << 24 | (uint32_t)bytes[1] << 16 | (uint32_t)bytes[2] << 8 | bytes[3];
}

static inline void put_big(unsigned char *bytes, uint32_t value)
{
	for (int i = 0; i < 4; i++)
		bytes[i] = (unsigned char)(value >> (24 - 8 * i));
}

#endif

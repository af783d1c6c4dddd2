/* How far SQLite's log is synced, in a file beside it: log_extent.h. */
#include "daemon/store/log_extent.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"
#include "proto/regular.h"
#include "proto/sums.h"

/* The note: mark, salts, number of frames, zeros, CRC-32 of all that. */
enum { NOTE_FRAMES = 12, NOTE_SUM = 20, NOTE = 24 };
static const unsigned char mark[4] = {'C', 'B', 'S', '1'};

static void note_path(const char *log, char ret_path[1100])
{
	const char *end = strstr(log, "-wal");

	snprintf(ret_path, 1100, "%.*s-synced", end == NULL ? (int)strlen(log) : (int)(end - log), log);
}

/* Where it cannot be written, the one that is there promises less, and what it promises holds. */
static bool note_write(const struct log_extent *extent, long frames)
{
	unsigned char note[NOTE] = {0};

	memcpy(note, mark, sizeof(mark));
	memcpy(note + sizeof(mark), extent->salts, LOG_SALTS);
	put_big(note + NOTE_FRAMES, (uint32_t)frames);
	put_big(note + NOTE_SUM, checksum(0, note, NOTE_SUM));
	return extent->note >= 0 && pwrite(extent->note, note, NOTE, 0) == NOTE;
}

void log_extent_init(struct log_extent *extent)
{
	*extent = (struct log_extent){.note = -1, .ending = -1};
}

void log_extent_close(struct log_extent *extent)
{
	if (extent->note >= 0)
		close(extent->note);
	extent->note = -1;
}

void log_extent_open(struct log_extent *extent, const char *log, const unsigned char *header)
{
	char path[1100];

	if (extent->note < 0) {
		note_path(log, path);
		extent->note = regular_open(path, O_RDWR | O_CREAT, 0600);
		if (extent->note < 0)
			log_line(LEVEL_WARNING, "damage of the catalogue's log will not be found: open %s: %s", path,
				 strerror(errno));
	}
	if (!extent->has_salts && header != NULL) {
		memcpy(extent->salts, header + LOG_SALTS_AT, LOG_SALTS);
		extent->has_salts = true;
	}
}

void log_extent_begin(struct log_extent *extent, const unsigned char header[LOG_HEADER])
{
	memcpy(extent->salts, header + LOG_SALTS_AT, LOG_SALTS);
	extent->has_salts = true;
	extent->whole = extent->synced = 0;
	extent->ending = -1;
}

bool log_extent_frame(struct log_extent *extent, long frame, const unsigned char header[FRAME_HEADER])
{
	extent->ending = big(header + 4) != 0 ? frame : -1;
	if (frame < extent->whole)
		extent->whole = frame;
	if (frame >= extent->synced)
		return true;
	extent->synced = frame;
	return note_write(extent, frame) && fdatasync(extent->note) == 0;
}

void log_extent_page(struct log_extent *extent, long frame)
{
	if (frame == extent->ending)
		extent->whole = frame + 1;
}

void log_extent_synced(struct log_extent *extent, const struct log_extent *before)
{
	/* The log may have begun anew meanwhile, or lost frames again. */
	if (before->whole <= extent->synced || before->whole > extent->whole ||
	    memcmp(before->salts, extent->salts, LOG_SALTS) != 0)
		return;
	if (note_write(extent, before->whole))
		extent->synced = before->whole;
}

long log_extent_read(const char *log, const unsigned char salts[LOG_SALTS])
{
	unsigned char note[NOTE];
	char path[1100];
	int file;
	bool fits;

	note_path(log, path);
	file = regular_open(path, O_RDONLY, 0);
	if (file < 0)
		return 0;
	fits = pread(file, note, NOTE, 0) == NOTE && memcmp(note, mark, sizeof(mark)) == 0 &&
	       memcmp(note + sizeof(mark), salts, LOG_SALTS) == 0 &&
	       big(note + NOTE_SUM) == checksum(0, note, NOTE_SUM);
	close(file);
	return fits ? (long)big(note + NOTE_FRAMES) : 0;
}

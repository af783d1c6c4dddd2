/*
 * A VFS with checksums: store/checksum_vfs.h. A database file is written page by page when the log is moved into
 * it, so the checksum is made there, in a copy. Offsets in the log: a header of 32 bytes, then frames of 24 bytes and a
 * page (https://sqlite.org/fileformat2.html, section 4).
 */
#include "daemon/store/checksum_vfs.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/store/log_extent.h"
#include "daemon/store/log_index.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

enum {
	PAGE_SUMMED = PAGES_BYTES - PAGES_RESERVE,
	FRAME = FRAME_HEADER + PAGES_BYTES,
	DATABASE_HEADER = 100,
	HEADER_VERSION = 60 /* in it: PRAGMA user_version */
};
static const unsigned char mark[4] = {'C', 'B', 'P', '1'};

enum kind { KIND_OTHER, KIND_DATABASE, KIND_LOG };

struct pages {
	sqlite3_vfs vfs; /* the first member: SQLite gives its address back */
	char name[40];
	sqlite3_vfs *base; /* constant */
	pthread_mutex_t lock;
	uint64_t *frames; /* [space], guarded by lock: checksum of the page of each frame of the log, with KNOWN */
	size_t space;     /* guarded by lock */
	struct log_extent extent; /* guarded by lock, as the next */
	struct log_index index;
};
static const uint64_t KNOWN = 1ull << 32;

/* An open file; that of the base follows it in memory. */
struct page_file {
	sqlite3_file file;
	struct pages *pages;
	enum kind kind;
	struct log_index_use use;
};

static sqlite3_file *base_of(sqlite3_file *file)
{
	return (sqlite3_file *)(void *)((struct page_file *)(void *)file + 1);
}

/* ---- one page ---- */

/* A page at another place is damaged too. */
static uint32_t page_sum(const unsigned char *page, uint32_t number)
{
	unsigned char bytes[4];

	put_big(bytes, number);
	return checksum(checksum(0, page, PAGE_SUMMED), bytes, sizeof(bytes));
}

static void page_seal(unsigned char *page, uint32_t number)
{
	memcpy(page + PAGE_SUMMED, mark, sizeof(mark));
	put_big(page + PAGE_SUMMED + sizeof(mark), page_sum(page, number));
}

static bool page_fits(const unsigned char *page, uint32_t number)
{
	static const unsigned char zeros[PAGES_BYTES];

	if (memcmp(page + PAGE_SUMMED, mark, sizeof(mark)) == 0)
		return big(page + PAGE_SUMMED + sizeof(mark)) == page_sum(page, number);
	/* A page that was free when the file grew over it has never been written; SQLite takes it for nothing else. */
	return memcmp(page, zeros, sizeof(zeros)) == 0;
}

static bool is_page(int size, sqlite3_int64 offset)
{
	return size == PAGES_BYTES && offset % PAGES_BYTES == 0;
}

/* The frame of the log whose page lies at `offset`, or -1. */
static long frame_at(int size, sqlite3_int64 offset)
{
	sqlite3_int64 first = LOG_HEADER + FRAME_HEADER;

	return size == PAGES_BYTES && offset >= first && (offset - first) % FRAME == 0
		   ? (long)((offset - first) / FRAME)
		   : -1;
}

/* ---- the log's pages ---- */

static int note_frame(struct pages *pages, long frame, const void *page)
{
	size_t space = pages->space == 0 ? 4096 : pages->space;
	int result = SQLITE_OK;
	uint64_t *frames;

	pthread_mutex_lock(&pages->lock);
	while (space <= (size_t)frame)
		space *= 2;
	if (space != pages->space) {
		frames = realloc(pages->frames, space * sizeof(*frames));
		if (frames == NULL) {
			result = SQLITE_IOERR_NOMEM;
		} else {
			memset(frames + pages->space, 0, (space - pages->space) * sizeof(*frames));
			pages->frames = frames;
			pages->space = space;
		}
	}
	if (result == SQLITE_OK)
		pages->frames[frame] = KNOWN | checksum(0, page, PAGES_BYTES);
	pthread_mutex_unlock(&pages->lock);
	return result;
}

/* A log that is recovered is written on. */
static void open_extent(struct pages *pages, const char *log, sqlite3_file *base)
{
	unsigned char header[LOG_HEADER];
	bool known = base->pMethods->xRead(base, header, LOG_HEADER, 0) == SQLITE_OK;

	pthread_mutex_lock(&pages->lock);
	log_extent_open(&pages->extent, log, known ? header : NULL);
	pthread_mutex_unlock(&pages->lock);
}

static bool before_write(struct pages *pages, const unsigned char *bytes, int size, sqlite3_int64 offset)
{
	bool fine = true;

	pthread_mutex_lock(&pages->lock);
	if (size == LOG_HEADER && offset == 0)
		log_extent_begin(&pages->extent, bytes);
	else if (size == FRAME_HEADER && (offset - LOG_HEADER) % FRAME == 0)
		fine = log_extent_frame(&pages->extent, (long)((offset - LOG_HEADER) / FRAME), bytes);
	pthread_mutex_unlock(&pages->lock);
	return fine;
}

static int sync_log(struct pages *pages, sqlite3_file *base, int flags)
{
	struct log_extent before;
	int result;

	pthread_mutex_lock(&pages->lock);
	before = pages->extent;
	pthread_mutex_unlock(&pages->lock);
	result = base->pMethods->xSync(base, flags);
	pthread_mutex_lock(&pages->lock);
	if (result == SQLITE_OK)
		log_extent_synced(&pages->extent, &before);
	pthread_mutex_unlock(&pages->lock);
	return result;
}

static bool frame_fits(struct pages *pages, long frame, const void *page)
{
	uint64_t noted;

	pthread_mutex_lock(&pages->lock);
	noted = (size_t)frame < pages->space ? pages->frames[frame] : 0;
	pthread_mutex_unlock(&pages->lock);
	return noted == 0 || noted == (KNOWN | checksum(0, page, PAGES_BYTES));
}

/* ---- the methods of a file ---- */

static int file_close(sqlite3_file *file)
{
	return base_of(file)->pMethods->xClose(base_of(file));
}

/*
 * SQLite takes what a page lacks at the end of the file for zeros: rows that are gone, or others. That is right of the
 * first page of a file that has none yet alone; pages that were not written to the database are in its log.
 */
static bool is_begin_of_none(sqlite3_file *base, sqlite3_int64 offset)
{
	sqlite3_int64 size = 0;

	return offset == 0 && base->pMethods->xFileSize(base, &size) == SQLITE_OK && size == 0;
}

static int file_read_page(sqlite3_file *file, void *to, int size, sqlite3_int64 offset)
{
	const struct page_file *paged = (const void *)file;
	int result = base_of(file)->pMethods->xRead(base_of(file), to, size, offset);
	bool fits = true;

	if (result == SQLITE_IOERR_SHORT_READ && paged->kind == KIND_DATABASE && is_page(size, offset))
		fits = is_begin_of_none(base_of(file), offset);
	else if (result != SQLITE_OK)
		return result;
	else if (paged->kind == KIND_DATABASE && is_page(size, offset))
		fits = page_fits(to, (uint32_t)(offset / PAGES_BYTES) + 1);
	else if (paged->kind == KIND_LOG && frame_at(size, offset) >= 0)
		fits = frame_fits(paged->pages, frame_at(size, offset), to);
	if (!fits)
		log_line(LEVEL_ERROR, "the catalogue is damaged: %s at byte %lld",
			 paged->kind == KIND_LOG ? "its log" : "its file", (long long)offset);
	return fits ? result : SQLITE_IOERR_DATA;
}

static int file_write_page(sqlite3_file *file, const void *from, int size, sqlite3_int64 offset)
{
	const struct page_file *paged = (const void *)file;
	sqlite3_file *base = base_of(file);
	unsigned char page[PAGES_BYTES];
	int result;

	if (paged->kind == KIND_DATABASE && is_page(size, offset)) {
		memcpy(page, from, sizeof(page));
		page_seal(page, (uint32_t)(offset / PAGES_BYTES) + 1);
		return base->pMethods->xWrite(base, page, size, offset);
	}
	if (paged->kind == KIND_LOG && !before_write(paged->pages, from, size, offset))
		return SQLITE_IOERR_WRITE;
	result = base->pMethods->xWrite(base, from, size, offset);
	if (result == SQLITE_OK && paged->kind == KIND_LOG && frame_at(size, offset) >= 0) {
		result = note_frame(paged->pages, frame_at(size, offset), from);
		pthread_mutex_lock(&paged->pages->lock);
		log_extent_page(&paged->pages->extent, frame_at(size, offset));
		pthread_mutex_unlock(&paged->pages->lock);
	}
	return result;
}

static int file_truncate(sqlite3_file *file, sqlite3_int64 size)
{
	return base_of(file)->pMethods->xTruncate(base_of(file), size);
}

static int file_sync(sqlite3_file *file, int flags)
{
	const struct page_file *paged = (const void *)file;

	if (paged->kind == KIND_LOG)
		return sync_log(paged->pages, base_of(file), flags);
	return base_of(file)->pMethods->xSync(base_of(file), flags);
}

static int file_size(sqlite3_file *file, sqlite3_int64 *ret_size)
{
	return base_of(file)->pMethods->xFileSize(base_of(file), ret_size);
}

static int file_lock(sqlite3_file *file, int level)
{
	return base_of(file)->pMethods->xLock(base_of(file), level);
}

static int file_unlock(sqlite3_file *file, int level)
{
	return base_of(file)->pMethods->xUnlock(base_of(file), level);
}

static int file_check_reserved(sqlite3_file *file, int *ret)
{
	return base_of(file)->pMethods->xCheckReservedLock(base_of(file), ret);
}

static int file_control(sqlite3_file *file, int operation, void *argument)
{
	return base_of(file)->pMethods->xFileControl(base_of(file), operation, argument);
}

static int file_sector(sqlite3_file *file)
{
	return base_of(file)->pMethods->xSectorSize(base_of(file));
}

static int file_device(sqlite3_file *file)
{
	return base_of(file)->pMethods->xDeviceCharacteristics(base_of(file));
}

static int file_shm_map(sqlite3_file *file, int page, int size, int extend, void volatile **ret)
{
	struct page_file *paged = (struct page_file *)(void *)file;
	int result;

	pthread_mutex_lock(&paged->pages->lock);
	result = log_index_map(&paged->pages->index, &paged->use, page, size, extend != 0, ret);
	pthread_mutex_unlock(&paged->pages->lock);
	return result;
}

static int file_shm_lock(sqlite3_file *file, int offset, int count, int flags)
{
	struct page_file *paged = (struct page_file *)(void *)file;
	int result;

	pthread_mutex_lock(&paged->pages->lock);
	result = log_index_lock(&paged->pages->index, &paged->use, offset, count, flags);
	pthread_mutex_unlock(&paged->pages->lock);
	return result;
}

static void file_shm_barrier(sqlite3_file *file)
{
	(void)file;
	log_index_barrier();
}

static int file_shm_unmap(sqlite3_file *file, int remove)
{
	struct page_file *paged = (struct page_file *)(void *)file;

	(void)remove;
	pthread_mutex_lock(&paged->pages->lock);
	log_index_leave(&paged->pages->index, &paged->use);
	pthread_mutex_unlock(&paged->pages->lock);
	return SQLITE_OK;
}

/* Version 2: no mapped reads, which nobody would check. */
static const sqlite3_io_methods methods = {
    .iVersion = 2,
    .xClose = file_close,
    .xRead = file_read_page,
    .xWrite = file_write_page,
    .xTruncate = file_truncate,
    .xSync = file_sync,
    .xFileSize = file_size,
    .xLock = file_lock,
    .xUnlock = file_unlock,
    .xCheckReservedLock = file_check_reserved,
    .xFileControl = file_control,
    .xSectorSize = file_sector,
    .xDeviceCharacteristics = file_device,
    .xShmMap = file_shm_map,
    .xShmLock = file_shm_lock,
    .xShmBarrier = file_shm_barrier,
    .xShmUnmap = file_shm_unmap,
};

static int vfs_open(sqlite3_vfs *vfs, const char *name, sqlite3_file *file, int flags, int *ret_flags)
{
	struct pages *pages = (struct pages *)(void *)vfs;
	struct page_file *paged = (struct page_file *)(void *)file;
	int result = pages->base->xOpen(pages->base, name, base_of(file), flags, ret_flags);

	paged->pages = pages;
	paged->use = (struct log_index_use){.in_use = false};
	paged->kind = flags & SQLITE_OPEN_MAIN_DB ? KIND_DATABASE : flags & SQLITE_OPEN_WAL ? KIND_LOG : KIND_OTHER;
	paged->file.pMethods = result == SQLITE_OK ? &methods : NULL;
	if (result == SQLITE_OK && paged->kind == KIND_LOG)
		open_extent(pages, name, base_of(file));
	return result;
}

/*
 * Pages that SQLite holds in memory have room of their own, which all connections share: 2.2 MB, once. Otherwise malloc
 * gives each, and takes it back at the next checkpoint, among the small blocks of other threads: live memory rose and
 * fell by 190 KB, and towards as many pages as the database has for each connection, so that nobody could tell that
 * from a leak. Where no slot is free the page that was read longest ago goes.
 */
static void hold_pages_apart(void)
{
	enum { PAGE = 4096, SLOTS = 512 };
	int header = 0, slot;
	void *room;

	if (sqlite3_config(SQLITE_CONFIG_PCACHE_HDRSZ, &header) != SQLITE_OK)
		return;
	slot = (PAGE + header + 7) / 8 * 8;
	room = mmap(NULL, (size_t)SLOTS * (size_t)slot, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	/* SQLite refuses once it is in use; then, and without room, malloc goes on to give pages. */
	if (room != MAP_FAILED && sqlite3_config(SQLITE_CONFIG_PAGECACHE, room, slot, (int)SLOTS) != SQLITE_OK)
		munmap(room, (size_t)SLOTS * (size_t)slot);
}

int pages_new(struct pages **ret_pages, struct error *err)
{
	static pthread_once_t once = PTHREAD_ONCE_INIT;
	struct pages *pages = calloc(1, sizeof(*pages));

	if (pages == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	pthread_once(&once, hold_pages_apart);
	pages->base = sqlite3_vfs_find(NULL);
	if (pages->base == NULL) {
		free(pages);
		return error_set(err, ERR_INTERNAL, "SQLite has no VFS");
	}
	/* All else is the base's own, which does not look at the VFS that it is given. */
	pages->vfs = *pages->base;
	snprintf(pages->name, sizeof(pages->name), "cbctd-%p", (void *)pages);
	pages->vfs.zName = pages->name;
	pages->vfs.pNext = NULL;
	pages->vfs.xOpen = vfs_open;
	pages->vfs.szOsFile = (int)sizeof(struct page_file) + pages->base->szOsFile;
	log_extent_init(&pages->extent);
	lock_init(&pages->lock, LOCK_PAGES);
	if (sqlite3_vfs_register(&pages->vfs, 0) != SQLITE_OK) {
		pthread_mutex_destroy(&pages->lock);
		free(pages);
		return error_set(err, ERR_INTERNAL, "SQLite takes no VFS");
	}
	*ret_pages = pages;
	return 0;
}

void pages_free(struct pages *pages)
{
	if (pages == NULL)
		return;
	sqlite3_vfs_unregister(&pages->vfs);
	log_extent_close(&pages->extent);
	pthread_mutex_destroy(&pages->lock);
	free(pages->frames);
	free(pages);
}

const char *pages_vfs(const struct pages *pages)
{
	return pages->name;
}

/* ---- a whole file ---- */

static int open_file(const char *path, int flags, int *ret_file, size_t *ret_size, struct error *err)
{
	int file = open(path, flags | O_CLOEXEC);
	struct stat status;

	*ret_file = -1;
	*ret_size = 0;
	if (file < 0 && errno == ENOENT)
		return 0;
	if (file < 0) { /* rights, descriptors: it may be whole */
		error_set_errno(err, errno, "open %s", path);
		return err->code = ERR_BUSY;
	}
	if (fstat(file, &status) != 0) {
		error_set_errno(err, errno, "%s", path);
		close(file);
		return err->code;
	}
	*ret_file = file;
	*ret_size = (size_t)status.st_size;
	return 0;
}

static int look_at_header(const unsigned char *page, enum pages_kind *ret_kind, struct error *err)
{
	bool marked = memcmp(page + PAGE_SUMMED, mark, sizeof(mark)) == 0;

	if (memcmp(page, "SQLite format 3", 16) != 0)
		return error_set(err, ERR_IO, "the catalogue is no SQLite database any more");
	if (!marked && page[20] == 0) {
		*ret_kind = PAGES_PLAIN;
		return 0;
	}
	if (page[16] << 8 != PAGES_BYTES || page[20] != PAGES_RESERVE || !page_fits(page, 1))
		return error_set(err, ERR_IO, "the first page of the catalogue is damaged");
	*ret_kind = PAGES_CHECKED;
	return 0;
}

int pages_look(const char *path, enum pages_kind *ret_kind, int *ret_version, struct error *err)
{
	unsigned char page[PAGES_BYTES] = {0};
	size_t size;
	int file, code = open_file(path, O_RDONLY, &file, &size, err);

	if (code != 0)
		return code;
	if (size == 0)
		*ret_kind = PAGES_NONE;
	else if (size < sizeof(page))
		code = error_set(err, ERR_IO, "the catalogue has %zu bytes only", size);
	else if (file_read_at(file, page, sizeof(page), 0, path, err) != 0)
		code = err->code;
	else
		code = look_at_header(page, ret_kind, err);
	if (code == 0)
		*ret_version = (int)big(page + HEADER_VERSION);
	if (file >= 0)
		close(file);
	return code;
}

/* Calls `visit` for each page, some hundred pages a system call. */
static int each_page(int file, size_t size, const char *path,
		     int (*visit)(unsigned char *page, uint32_t number, int file, struct error *err), struct error *err)
{
	enum { PAGES_AT_ONCE = 256 };
	unsigned char *pages = malloc((size_t)PAGES_AT_ONCE * PAGES_BYTES);
	size_t count = size / PAGES_BYTES;
	int code = 0;

	if (pages == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	for (size_t first = 0; first < count && code == 0; first += PAGES_AT_ONCE) {
		size_t some = count - first < PAGES_AT_ONCE ? count - first : PAGES_AT_ONCE;

		code = file_read_at(file, pages, some * PAGES_BYTES, first * PAGES_BYTES, path, err);
		for (size_t i = 0; i < some && code == 0; i++)
			code = visit(pages + i * PAGES_BYTES, (uint32_t)(first + i) + 1, file, err);
	}
	free(pages);
	return code;
}

static int check_page(unsigned char *page, uint32_t number, int file, struct error *err)
{
	(void)file;
	return page_fits(page, number)
		   ? 0
		   : error_set(err, ERR_IO, "page %u of the catalogue is damaged", (unsigned)number);
}

int pages_check(const char *path, struct error *err)
{
	unsigned char header[DATABASE_HEADER];
	size_t size;
	int file, code = open_file(path, O_RDONLY, &file, &size, err);

	if (code != 0 || file < 0)
		return code;
	if (size > 0)
		code = file_read_at(file, header, sizeof(header), 0, path, err);
	if (code == 0 && size > 0 && (size_t)big(header + 28) * PAGES_BYTES > size)
		code = error_set(err, ERR_IO, "the catalogue has %zu bytes, its %u pages have more", size,
				 (unsigned)big(header + 28));
	if (code == 0)
		code = each_page(file, size, path, check_page, err);
	close(file);
	return code;
}

static int seal_page(unsigned char *page, uint32_t number, int file, struct error *err)
{
	page_seal(page, number);
	if (pwrite(file, page, PAGES_BYTES, (off_t)(number - 1) * PAGES_BYTES) == PAGES_BYTES)
		return 0;
	return error_set_errno(err, errno, "page %u of the catalogue", (unsigned)number);
}

int pages_seal(const char *path, struct error *err)
{
	size_t size;
	int file, code = open_file(path, O_RDWR, &file, &size, err);

	if (code != 0)
		return code;
	if (file < 0)
		return error_set(err, ERR_IO, "%s was not made", path);
	code = each_page(file, size, path, seal_page, err);
	if (code == 0 && fsync(file) != 0)
		code = error_set_errno(err, errno, "fsync %s", path);
	close(file);
	return code;
}

/* ---- a log that was left behind ---- */

/* SQLite's own checksum, over pairs of words in the order of bytes that the log's header names. */
static void log_sum(uint32_t sum[2], const unsigned char *bytes, size_t size, bool big_endian)
{
	for (size_t i = 0; i < size; i += 8) {
		uint32_t word[2];

		for (int j = 0; j < 2; j++) {
			const unsigned char *at = bytes + i + 4 * (size_t)j;

			word[j] = big_endian
				      ? big(at)
				      : ((uint32_t)at[3] << 24 | (uint32_t)at[2] << 16 | (uint32_t)at[1] << 8 | at[0]);
		}
		sum[0] += word[0] + sum[1];
		sum[1] += word[1] + sum[0];
	}
}

struct log_walk {
	bool big_endian;
	uint32_t sum[2];
	unsigned char salts[LOG_SALTS];
	bool broken;
	long frames, last_commit; /* frames that fit, and those of them up to the last end of a transaction */
	int version;              /* in the last first page among the frames that fit; -1: there was none */
};

static void walk_frame(struct log_walk *walk, const unsigned char *frame, struct log_facts *facts)
{
	bool current = memcmp(frame + 8, walk->salts, sizeof(walk->salts)) == 0;

	if (!walk->broken) {
		log_sum(walk->sum, frame, 8, walk->big_endian);
		log_sum(walk->sum, frame + FRAME_HEADER, PAGES_BYTES, walk->big_endian);
		walk->broken = !current || big(frame + 16) != walk->sum[0] || big(frame + 20) != walk->sum[1];
		walk->frames += !walk->broken;
		if (!walk->broken && big(frame) == 1)
			walk->version = (int)big(frame + FRAME_HEADER + HEADER_VERSION);
		if (!walk->broken && big(frame + 4) != 0) {
			walk->last_commit = walk->frames;
			facts->version = walk->version;
		}
	}
	/* Frames of an earlier round of the log have other salts. */
	if (walk->broken && current && big(frame + 4) != 0)
		facts->commits_lost++;
}

static int walk_log(int file, size_t size, const char *path, struct log_facts *ret, struct error *err)
{
	unsigned char header[LOG_HEADER], *frame;
	struct log_walk walk = {.version = -1};
	uint32_t magic;
	int code = file_read_at(file, header, sizeof(header), 0, path, err);

	if (code != 0)
		return code;
	magic = big(header);
	walk.big_endian = (magic & 1) != 0;
	memcpy(walk.salts, header + LOG_SALTS_AT, LOG_SALTS);
	log_sum(walk.sum, header, 24, walk.big_endian);
	walk.broken = (magic & ~1u) != 0x377f0682 || big(header + 24) != walk.sum[0] || big(header + 28) != walk.sum[1];
	frame = malloc(FRAME);
	if (frame == NULL)
		return error_set_errno(err, ENOMEM, "log of the catalogue");
	for (size_t at = LOG_HEADER; at + FRAME <= size && code == 0; at += FRAME) {
		code = file_read_at(file, frame, FRAME, at, path, err);
		if (code == 0 && at == LOG_HEADER && walk.broken)
			memcpy(walk.salts, frame + 8, sizeof(walk.salts)); /* the header's are not to be trusted */
		if (code == 0)
			walk_frame(&walk, frame, ret);
	}
	free(frame);
	ret->frames = walk.last_commit;
	ret->synced = log_extent_read(path, walk.salts);
	ret->damaged = ret->frames < ret->synced;
	return code;
}

int log_check(const char *path, struct log_facts *ret, struct error *err)
{
	size_t size;
	int file, code = open_file(path, O_RDONLY, &file, &size, err);

	*ret = (struct log_facts){.version = -1};
	if (code != 0 || file < 0)
		return code;
	if (size >= LOG_HEADER)
		code = walk_log(file, size, path, ret, err);
	close(file);
	return code;
}

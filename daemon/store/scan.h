#ifndef CBCT_DAEMON_STORE_SCAN_H
#define CBCT_DAEMON_STORE_SCAN_H

#include "daemon/store/internal.h"
#include "proto/sums.h"

/* Inside of the scans, for store/scan*.c and store/sums*.c only. */
enum progress { MISSING, CLAIMED, STORED };

struct stored_scan {
	/* Constant. */
	struct store *store;
	char id[ID_SIZE];
	char name[SCAN_NAME_BYTES], client[STORE_CLIENT_SIZE];
	double created;
	int columns, rows, count;
	enum sample sample;
	enum quantity quantity;
	double air;
	bool damaged;
	bool gone;            /* its directory was not there at the start: nothing is written for it */
	uint64_t order_floor; /* of arrival: what comes from now on is above it; after the start guarded by lock */

	/* Guarded by store->scans_lock. */
	int references; /* one of them is the array's */
	struct scan *parsed;
	struct scan *measured; /* of a closed one: what of it is there; NULL: all of it, or not parsed */
	bool recent;
	bool has_room; /* on the disk, for all projections, or is just given it: what limits count */
	bool removed;  /* from the array: whoever refers to it now may use its parsed form */

	pthread_mutex_t records; /* held over the opening of projections.sums, and over its mend */

	pthread_mutex_t lock;    /* guards what follows */
	bool room;               /* the disk has it, and no projection needs to ask for it */
	bool returning;          /* the room is being given back: nobody gets a claim meanwhile */
	unsigned char *progress; /* [count], enum progress */
	/*
	 * [count], of those that are stored. `bytes` 0: only the SHA-256 is known, from the catalogue; the record of
	 * projections.sums is missing or damaged, and made again once the samples were found to fit (store/sums.c).
	 */
	struct sum *sums;
	int unchecked;       /* those with `bytes` 0 */
	unsigned char *lost; /* [count]: was stored, was found damaged, and is missing until it is sent again */
	int lost_count;
	unsigned losses; /* since the start: projections that were stored and are not any more */
	int received;
	double asked;   /* monotonic: somebody came with one of them, new or not; 0: not since the start */
	double arrived; /* monotonic: the last of them, 0: before the start */
	enum progress image[IMAGE_COUNT];
	uint8_t image_sha256[IMAGE_COUNT][32];
	bool image_lost[IMAGE_COUNT]; /* as of projections */
	/* Constant: images of scatter that the scan announces. The next three are [scatter_count], two as of
	 * projections. */
	struct scatter_images scatter;
	int scatter_count;
	unsigned char *scatter_progress;
	unsigned char *scatter_lost;   /* 0: it is not */
	unsigned *scatter_other;       /* as scatter_file_states tells it: a part of the scan's basis */
	pthread_mutex_t scatter_files; /* held over each writing to the files of those images, and over their mend */
	bool document_damaged;         /* scan.json */
	bool suspect;                  /* all of its files are to be checked before it is used (store/sums.c) */
	bool pinned;
	bool deleted; /* written in a group of the catalogue too, as the next */
	bool closing; /* takes no new projections */
	bool closed;  /* and that is on the disk */

	struct watch_list watchers;
};

/* The memory of a scan with one reference; NULL: none. */
struct stored_scan *stored_scan_new(struct store *store, int count);
struct stored_scan *stored_scan_free(struct stored_scan *scan); /* returns NULL; NULL is fine */
/* Room in the array for one more, so that the insertion after a commit cannot fail; both with scans_lock held. */
int scans_reserve(struct store *store, struct error *err);
void scans_insert(struct store *store, struct stored_scan *scan);
/* A reference, or NULL where there is no such scan. will_use: its parsed form is worth keeping. */
struct stored_scan *scans_find(struct store *store, const char *id, bool will_use);

/*
 * store/limits.c. ERR_IMPOSSIBLE when a scan of that many bytes is beyond a limit whatever else there is; ERR_LIMIT
 * when the client has as many scans as it may have.
 */
int store_check_size(struct store *store, unsigned long long bytes, struct error *err);
int store_check_scans(struct store *store, const char *client, struct error *err);

bool stored_scan_deleted(struct stored_scan *scan);
/* With the scan's lock held: every projection that it will ever have is there. */
bool stored_scan_complete(const struct stored_scan *scan);
/* The scan of those views alone that present[count] names; the caller's to free. */
int stored_scan_read_measured(struct stored_scan *scan, const unsigned char *present, struct scan **ret_measured,
			      struct error *err);

size_t stored_scan_bytes(const struct stored_scan *scan); /* of one projection */
size_t stored_image_bytes(const struct stored_scan *scan, enum image image);

/* With the scan's lock held: projection `index` is not on the disk any more, and lost. */
void stored_scan_remove(struct stored_scan *scan, int index);
/* A descriptor of projections.sums as it is, for writing; *ret_whole: the file has its size and its line. */
int stored_scan_find_sums(const struct stored_scan *scan, bool *ret_whole, int *ret_file, struct error *err);
/* With the scan's lock held: projection `index` is on the disk, with its row. */
void stored_scan_add(struct stored_scan *scan, int index, const struct sum *sum);

/*
 * At the start, when the scan's rows are loaded and nobody else has the store: reads projections.sums. A record that is
 * good is what was acknowledged, whatever the rows say: the rows follow it. A row without such a record stays, with its
 * SHA-256 only. A file that is missing, short or has a damaged line is made again from the records that are good.
 */
int store_load_sums(struct store *store, struct stored_scan *scan, struct error *err);
/*
 * With scan->records locked: projections.sums anew, from memory, which has what was acknowledged. All of the scan's
 * files are checked then: that gives its parts their records.
 */
int store_make_sums(struct stored_scan *scan, struct error *err);

/*
 * Images of scatter, store/scatter.c: their lists in memory; their files; what is there, from their records, where
 * files that are not whole are made again. Then, with the scan's lock held, whether those are there that a projection
 * needs, and how many there are; all of them are read.
 */
int stored_scan_set_scatter(struct stored_scan *scan, const struct scatter_images *images, struct error *err);
int store_make_scatter(const struct stored_scan *scan, const char *directory, struct error *err);
int store_load_scatter(struct stored_scan *scan, struct error *err);
bool stored_scan_has_scatter(const struct stored_scan *scan, int projection);
void stored_scan_count_scatter(const struct stored_scan *scan, struct scan_scatter *ret);
void store_check_scatter(struct stored_scan *scan);

/* At the start, nobody else has the store: the samples of projections.raw behind its first `size` bytes are lost. */
void stored_scan_lose_behind(struct stored_scan *scan, unsigned long long size);
void stored_scan_lose_image(struct stored_scan *scan, enum image image);
/* The file of the projections has its full size, with zeros for what it does not hold any more. */
int stored_scan_make_room(struct stored_scan *scan, struct error *err);

/* The scan goes on without what was lost, within the transaction that closes it. */
int store_forget_lost(struct stored_scan *scan, struct error *err);

/* A thread that checks the files of scans that are suspect. */
int store_start_checker(struct store *store, struct error *err);
void store_stop_checker(struct store *store);

/*
 * These three write a row of the catalogue, in a group. sha256 of an image NULL: the scan has no such image any more.
 */
int stored_scan_put_row(const struct stored_scan *scan, int index, const uint8_t sha256[32], struct error *err);
int stored_scan_set_image(const struct stored_scan *scan, enum image image, const uint8_t *sha256, struct error *err);
int stored_scan_set_closed(const struct stored_scan *scan, struct error *err);

/* The record of a part of the scan directory, synced: behind its file and before its row. bytes NULL: it has none. */
int store_put_part_sum(struct stored_scan *scan, int part, const void *bytes, size_t size, struct error *err);
/* ERR_DAMAGED: these bytes do not fit the part's record. One without a record is taken as it is. */
int store_check_part(struct stored_scan *scan, enum sums_part part, const void *bytes, size_t size, struct error *err);
/* A stored image is read; ERR_DAMAGED: it does not fit its SHA-256, and is lost now. */
int store_check_image(struct stored_scan *scan, enum image image, struct error *err);
/* ERR_QUOTA when an image that is being written goes beyond a limit of bytes. */
int store_check_image_room(struct stored_scan *scan, enum image image, struct error *err);

#endif

#ifndef CBCT_DAEMON_INTAKE_INTERNAL_H
#define CBCT_DAEMON_INTAKE_INTERNAL_H

#include <openssl/evp.h>
#include <pthread.h>
#include <stdbool.h>

#include "daemon/intake/intake.h"
#include "proto/json.h"
#include "proto/zstream.h"

/*
 * Shared by upload.c (a body's way to the writers), write.c (from there to the disk and the catalogue) and pool.c (the
 * memory between them), and by no other file.
 *
 * uploads.lock guards the queue, the pool and the part of each upload that says so; it is never held over disk work or
 * hashing. request_wake is called under it.
 */

enum { WRITERS = 2 }; /* one hashes while the other syncs */

/* One projection or image between socket and disk; or, without data, the pending commit of what an upload holds. */
struct slot {
	struct slot *next;
	struct upload *upload;
	int index;
	int weight;          /* projections that it stands for */
	size_t size, filled; /* bytes */
	unsigned char *data; /* [size] */
	struct sum sum;
	double parked;  /* since when it waits for a claim, 0: it does not */
	bool committed; /* its claims went back with the commit */
	int code;       /* what became of it, while it is in a writer's hands */
	struct error error;
	enum { SLOT_OPEN, SLOT_WRITTEN, SLOT_CREATED, SLOT_SAME, SLOT_HELD, SLOT_FAILED, SLOT_PARKED } outcome;
};

struct slot_list {
	struct slot *first, **end;
};

/* A projection that is written, but must not count yet. */
struct held {
	int index;
	struct sum sum;
};

struct upload {
	struct uploads *uploads;
	struct stored_scan *scan;
	struct upload_target target;
	int descriptor, sums; /* of projections.raw and .sums, -1 for images */
	size_t slot_bytes;
	uint64_t expected; /* bytes, decoded; for an image at most */

	/* The connection's own. */
	struct slot *filling;
	int next;         /* index that is filled next */
	uint64_t decoded; /* bytes so far */
	uint64_t wire;    /* bytes so far, as sent */
	struct zdecoder *decoder;
	bool decoder_ended;
	EVP_MD_CTX *digest; /* of the bytes as sent; NULL: none was promised */
	uint8_t promised[32];
	bool holds;   /* projections count only when the body's end, or a break, has shown that they are right */
	bool spoiled; /* the body was wrong */

	/* Warnings about an image. They are the writer's until the slot is settled, then the connection's. */
	cJSON *warnings;

	/* Guarded by uploads.lock. */
	struct request *request; /* NULL once it is over */
	int references;          /* the request, and each slot under way */
	int pending;             /* slots under way */
	bool granted;            /* a buffer's bytes are reserved for it */
	struct upload *starved_next;
	bool starved;
	struct upload_outcome outcome;
	struct error error; /* the first failure; code 0: none */
	struct held *held;  /* [held_count], room for all */
	int held_count;
	bool body_ended; /* and was right */
	bool keeps;      /* the connection broke: what is held shall count */
	struct slot commit;
};

struct uploads {
	struct store *store;
	struct uploads_options options;
	pthread_t writers[WRITERS];
	int writer_count;

	pthread_mutex_t lock;
	pthread_cond_t work; /* something was queued, or the end has come */
	bool stop, failed;
	struct slot_list queue, parked;
	unsigned long long releases; /* times that claims came free */
	/*
	 * Batches taken, and those whose commit is over. They are committed in the order in which they were taken, so
	 * that the projections of a body are stored in the body's order: what is reconstructed as it arrives has the
	 * same bits each time.
	 */
	unsigned long long taken, over;
	pthread_cond_t turn; /* `over` has grown */
	struct upload *starved_first, **starved_end;
	size_t used;         /* bytes of slots and grants */
	struct slot *spares; /* all of one size */
	size_t spare_bytes;
	struct uploads_statistics statistics;
};

/* ---- lists of slots, in order ---- */

void slots_init(struct slot_list *list);
void slots_add(struct slot_list *list, struct slot *slot);
struct slot *slots_take(struct slot_list *list); /* NULL: it is empty */

/* ---- the pool; all with uploads.lock held ---- */

bool pool_fits(const struct uploads *uploads, size_t size);
/* Grants buffers to those who have waited longest. */
void pool_feed(struct uploads *uploads);
/* Puts an upload at the end of those who wait, and takes it out of them, wherever it stands. */
void pool_starve(struct upload *upload);
void pool_leave(struct upload *upload);
/* A slot of this size, a spare one if there is; its bytes are counted by the caller. NULL: no memory. */
struct slot *pool_take(struct uploads *uploads, size_t size);
void pool_give_back(struct uploads *uploads, struct slot *slot);
void pool_free(struct uploads *uploads);

/* ---- an upload's life; with uploads.lock held ---- */

/* Claims came free: those who wait for one ask again. */
void uploads_requeue(struct uploads *uploads);
/* Hands a slot to the writers. */
void upload_enqueue(struct upload *upload, struct slot *slot);
/* Once all is written that will be, and may count. */
void upload_commit_held(struct upload *upload);
/* The last one to leave frees it. */
void upload_unreference_and_unlock(struct upload *upload);

/* ---- a scan's images ---- */

size_t upload_image_pixels(const struct scan *scan);
size_t upload_image_bytes(const struct scan *scan, enum image image); /* as it is stored */

#endif

#ifndef CBCT_DAEMON_VOLUMES_ENCODED_H
#define CBCT_DAEMON_VOLUMES_ENCODED_H

#include "daemon/volumes/content.h"
#include "daemon/store/store.h"
#include "daemon/watch.h"

/*
 * Volumes as they are streamed: length and digest known before the first byte
 * goes out, made once for all who want the same, by a few threads of their own.
 * An encoded copy is an unlinked file in the job's directory, unless it is the kept file itself:
 * neither fast nor slow readers cost memory. The last few stay for readers that
 * are behind. Any thread.
 */
struct encoded_copies;
struct encoded; /* counted references */

int encoded_copies_new(struct store *store, int threads, struct encoded_copies **ret_copies, struct error *err);
void encoded_copies_free(struct encoded_copies *copies); /* NULL is fine; all references must be back */

/*
 * The copy of this volume with these options; zstd: as one frame (a format that is
 * packed by itself stays as it is). Returns at once; wake is called when it is made or has failed.
 */
int encoded_get(struct encoded_copies *copies, const char *job, const struct volume_record *volume,
		const struct content_options *options, bool zstd, struct encoded **ret_encoded, struct error *err);
void encoded_release(struct encoded *encoded); /* NULL is fine */
void encoded_watch(struct encoded *encoded, struct watch *watch);
void encoded_unwatch(struct encoded *encoded, struct watch *watch);

struct encoded_facts {
	bool made, failed;
	int descriptor; /* the copy's own, valid while the reference lives */
	uint64_t offset, size;
	uint8_t sha256[32];
};
void encoded_look(struct encoded *encoded, struct encoded_facts *ret);

/* Lets go of what nobody uses of a job's, so that its space is free. */
void encoded_copies_forget(struct encoded_copies *copies, const char *job);

#endif

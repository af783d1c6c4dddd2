#ifndef CBCT_DAEMON_VOLUMES_RENDITION_H
#define CBCT_DAEMON_VOLUMES_RENDITION_H

#include "daemon/volumes/content.h"
#include "daemon/store/store.h"
#include "daemon/watch.h"

/*
 * Volumes as they are streamed: length and digest known before the first byte
 * goes out, made once for all who want the same, by a few threads of their own.
 * What is not the kept file itself is an unlinked file in the job's directory:
 * neither fast nor slow readers cost memory. The last few stay for readers that
 * are behind. Any thread.
 */
struct renditions;
struct rendition; /* counted references */

int renditions_new(struct store *store, int threads, struct renditions **ret_renditions, struct error *err);
void renditions_free(struct renditions *renditions); /* NULL is fine; all references must be back */

/*
 * Of this volume with these options; zstd: as one frame (what is packed by its
 * format always is, in its own way). Returns at once; wake is called when it is made or has failed.
 */
int rendition_get(struct renditions *renditions, const char *job, const struct volume_record *volume,
		  const struct content_options *options, bool zstd, struct rendition **ret_rendition,
		  struct error *err);
void rendition_release(struct rendition *rendition); /* NULL is fine */
void rendition_watch(struct rendition *rendition, struct watch *watch);
void rendition_unwatch(struct rendition *rendition, struct watch *watch);

struct rendition_facts {
	bool made, failed;
	int descriptor; /* the rendition's own, valid while the reference lives */
	uint64_t offset, size;
	uint8_t sha256[32];
};
void rendition_look(struct rendition *rendition, struct rendition_facts *ret);

/* Lets go of what nobody uses of a job's, so that its space is free. */
void renditions_forget(struct renditions *renditions, const char *job);

#endif

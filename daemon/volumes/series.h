#ifndef CBCT_DAEMON_VOLUMES_SERIES_H
#define CBCT_DAEMON_VOLUMES_SERIES_H

#include <sys/types.h>

#include "daemon/volumes/content.h"
#include "proto/dicom.h"

/*
 * The bytes of a volume as DICOM, in order: a ZIP of its slices (stored, PKWARE's APPNOTE 6.3), or one object with all
 * frames. Reads the voxels of `content`, raw int16, which is the caller's and outlives it. One thread at a time.
 */
struct series;

/* ERR_IMPOSSIBLE beyond the 4 GiB that a ZIP and an object can have. */
int series_new(struct content *content, const struct grid *grid, const struct provenance *provenance,
	       const struct dicom_words *words, struct series **ret_series, struct error *err);
void series_free(struct series *series); /* NULL is fine */
/* 0 at the end, -1 where the volume cannot be read. */
ssize_t series_read(struct series *series, void *to, size_t size);

#endif

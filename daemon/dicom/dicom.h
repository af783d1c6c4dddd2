#ifndef CBCT_DAEMON_DICOM_DICOM_H
#define CBCT_DAEMON_DICOM_DICOM_H

#include <cjson/cJSON.h>

#include "core/scan/grid.h"
#include "proto/dicom.h"

/*
 * cbct-dicom: asks an archive whether it answers, or sends it the objects of one volume. A process of its own, since it
 * talks to strangers; what comes of it is a line to the daemon (daemon/sendings/sender.c).
 *
 * Errors: ERR_BUSY: the archive cannot be reached; ERR_CONFLICT, ERR_DAMAGED, ERR_IMPOSSIBLE: of the volume itself, no
 * later attempt would help; any other: the archive answers, but not as it should.
 */

/* The objects of a volume, one for each slice, or one. */
struct object {
	struct dicom_head head;
	bool stored; /* the archive has it, as it says when it is asked */
};
struct objects {
	const char *class; /* SOP class UID */
	int count, planes; /* objects, and slices in each */
	struct object *list;
	int file; /* of the volume */
	size_t start, plane_voxels;
	double mu_water; /* 1/mm */
	struct grid grid;
	struct provenance provenance;
	struct dicom_words words;
};
int objects_open(const cJSON *task, struct objects *ret_objects, struct error *err);
void objects_close(struct objects *objects);
/* A whole object as a file of DICOM (PS3.10), free; *ret_dataset: where the dataset begins. Any thread. */
int object_make(const struct objects *objects, int place, uint8_t **ret_bytes, size_t *ret_size, size_t *ret_dataset,
		struct error *err);
int objects_stored(const struct objects *objects);
/* The object of this SOP Instance UID is stored; others are passed over. */
void objects_mark(struct objects *objects, const char *instance);

/* ---- kinds of archives ---- */
struct archive {
	const char *kind;
	/* Whether it answers. */
	int (*ask)(const cJSON *destination, struct error *err);
	/* Marks all objects that it says it has. */
	int (*find)(const cJSON *destination, struct objects *objects, struct error *err);
	/* Sends those that are not marked. 0: it has acknowledged them, which is no proof. */
	int (*store)(const cJSON *destination, const struct objects *objects, struct error *err);
	/* Asks it to keep them; *ret_committed false: it does not know such a promise. NULL: there is none. */
	int (*commit)(const cJSON *destination, const struct objects *objects, bool *ret_committed, struct error *err);
};
extern const struct archive archive_web;

/* ---- for these ---- */
/* A text of the destination; "" where it is not there. */
const char *destination_text(const cJSON *destination, const char *name);
/* Tells the daemon that `count` objects more were acknowledged. Any thread. */
void report_progress(int count);

#endif

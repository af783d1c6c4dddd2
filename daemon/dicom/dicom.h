#ifndef CBCT_DAEMON_DICOM_DICOM_H
#define CBCT_DAEMON_DICOM_DICOM_H

#include <pthread.h>

#include <cjson/cJSON.h>

#include "core/scan/grid.h"
#include "daemon/dicom/dimse.h"
#include "proto/dicom.h"

/*
 * cbct-dicom: asks an archive whether it answers, sends it the objects of one volume, asks for the worklist, or takes
 * what peers send. A process of its own, since it talks to strangers; what comes of it is a line to the daemon
 * (daemon/sendings/sender.c).
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

/* ---- objects that several threads send ---- */
struct load {
	const cJSON *destination;
	const struct objects *objects;
	pthread_mutex_t lock; /* guards the next two */
	int next;             /* object that nobody has taken yet */
	struct error error;   /* the first */
};
/* The next object that is not stored, which is the caller's to send; -1: none is left, or a thread has failed. */
int load_next(struct load *load);
void load_fail(struct load *load, const struct error *err);
/* Runs `work` in so many threads, this one among them, each with the load as its argument. */
int load_run(const cJSON *destination, const struct objects *objects, int threads, void *(*work)(void *load),
	     struct error *err);

/* ---- kinds of archives ---- */
enum promise { PROMISE_UNKNOWN, PROMISE_ASKED, PROMISE_GIVEN, PROMISE_REFUSED /* with an error */ };

struct archive {
	const char *kind;
	/* Whether it answers. */
	int (*ask)(const cJSON *destination, struct error *err);
	/* Marks all objects that it says it has. ERR_NOT_FOUND: it cannot be asked. */
	int (*find)(const cJSON *destination, struct objects *objects, struct error *err);
	/* Sends those that are not marked. 0: it has acknowledged them, which is no proof. */
	int (*store)(const cJSON *destination, const struct objects *objects, struct error *err);
	/*
	 * Asks it to keep them. PROMISE_UNKNOWN: it knows no such promise; PROMISE_ASKED: its answer comes later, to
	 * the listener. NULL: there is none.
	 */
	int (*commit)(const cJSON *destination, const struct objects *objects, enum promise *ret_promise,
		      struct error *err);
};
extern const struct archive archive_web, archive_network;
/* No archive: it is told of performed procedure steps. */
extern const struct archive archive_step;

/* ---- objects.c, for step.c ---- */
/* Patient and study of a task. */
int task_subject(const cJSON *task, struct subject *ret_subject, struct error *err);

/* ---- network.c, for worklist.c and step.c ---- */
/* The peer of a row of the file of destinations, or of its worklist; the texts are the row's. */
struct dimse_peer row_peer(const cJSON *row);

/* ---- step.c ---- */
/* Tells of a job's step; PROMISE_ASKED: its end is to come. *ret_instances grows by the objects that it names. */
int step_tell(const cJSON *task, int *ret_instances, enum promise *ret_promise, struct error *err);

/* ---- worklist.c, listener.c ---- */
/* Tells the daemon the steps of the worklist, a line {"step": ...} each. */
int worklist_ask(const cJSON *worklist, struct error *err);
/* Takes what peers send until the daemon ends, or an error. */
int listener_run(const cJSON *listening, struct error *err);

/* ---- main.c, for these ---- */
/* A text of the destination; "" where it is not there. */
const char *destination_text(const cJSON *destination, const char *name);
double destination_number(const cJSON *destination, const char *name, double otherwise);
/* Seconds that an answer to so many bytes may take (timeout_s, and a line of 32 KB/s). */
double destination_patience(const cJSON *destination, double bytes);
/* Ends the process, as a failed attempt, unless it is called again within so many seconds. Any thread. */
void patience(double seconds);
/* Sends the daemon a line, and frees the value. Any thread. */
void tell(cJSON *value);
/* Tells the daemon that `count` objects more were acknowledged. Any thread. */
void report_progress(int count);
/* Tells it the UID by which an answer to a request for storage commitment will name it. */
void report_transaction(const char *uid);

#endif

#ifndef CBCT_DAEMON_SENDINGS_SENDINGS_H
#define CBCT_DAEMON_SENDINGS_SENDINGS_H

#include <cjson/cJSON.h>

#include "daemon/jobs/jobs.h"
#include "daemon/watch.h"
#include "proto/send.h"

/*
 * Volumes on their way to archives.
 *
 * A sending is a volume that is to go to a destination; its row in the catalogue belongs to its job. A thread, the
 * sender, has `cbct-dicom` carry out one sending a destination at a time, and a few destinations at once. It is sent
 * once the destination, asked again, has every object of the volume; what only was acknowledged is not sent. After any
 * failure, of the network, the destination, the process or the daemon, another attempt follows, after pauses that grow
 * from `pause` to a quarter of an hour, until `limit` is over. Objects have the same UIDs in every attempt, and those
 * that the destination has already are not sent again.
 *
 * Where the destination knows storage commitment, it is then asked to keep the objects. Its answer comes to the
 * listener, a cbct-dicom process that takes what peers send: the volume is committed, or sent again. Without an answer
 * the request is made again.
 *
 * A destination may be one that is told of performed procedure steps in place of getting volumes. The row of such a
 * step, of each job whose scan is of a step of the worklist, waits where others do: it is told when the job begins,
 * and once the job has ended and all that was to be sent of it has, or has failed, how it ended.
 *
 * Destinations are read from a JSON file, at the start and by sendings_reload.
 *
 * Threads: any, but sendings_open and sendings_close once each.
 */
struct sendings;

struct sendings_options {
	const char *file;    /* of destinations; "": there are none */
	double pause, limit; /* s; limit 0: none */
};

/* ERR_INVALID, ERR_IMPOSSIBLE, ERR_NOT_FOUND, ERR_IO: the file of destinations cannot be used. */
int sendings_open(struct jobs *jobs, const struct sendings_options *options, struct sendings **ret_sendings,
		  struct error *err);
/* What is being sent is begun anew at the next start. NULL is fine. */
void sendings_close(struct sendings *sendings);
/* Reads the file again; where that fails, the destinations stay and the log says why. */
void sendings_reload(struct sendings *sendings);

/* ---- what a job is to send ---- */
/* The list of wishes that jobs get which say nothing; NULL in *ret_text: none. Free. */
int sendings_default(struct sendings *sendings, char **ret_text, struct error *err);
/* ERR_IMPOSSIBLE with a pointer below `base` where a wish's destination is none. */
int sendings_check(struct sendings *sendings, const struct send_wish *wishes, int count, const char *base,
		   struct error *err);
/* The destination that is told of the performed steps of jobs; "": there is none. */
void sendings_step_to(struct sendings *sendings, char ret_name[DESTINATION_NAME_SIZE]);
/* Takes up the sendings that a new job has begun with. */
int sendings_adopt(struct sendings *sendings, struct job *job, struct error *err);
/*
 * Sends volumes of a job, once it has ended. What is on its way already or has arrived stays as it is; what has failed
 * or was stopped begins anew. *ret_new: something is to be done now that was not before. ERR_IMPOSSIBLE: no such
 * destination or volume; ERR_CONFLICT: nobody has said how the patient lies; ERR_NOT_FOUND: the job is removed.
 */
int sendings_ask(struct sendings *sendings, struct job *job, const struct send_wish *wish, bool *ret_new,
		 struct error *err);
/* Stops all that has not ended of a job and a destination. ERR_NOT_FOUND: the job has nothing for it. */
int sendings_stop(struct sendings *sendings, struct job *job, const char *destination, struct error *err);
/* True while something of the job waits to be sent. */
bool sendings_pending(struct sendings *sendings, const char *job);

/* True while it is still to be told how the job's step has ended. */
bool sendings_step_pending(struct sendings *sendings, const char *job);

/* ---- destinations ---- */
/* {"destinations": [...]} with what is known of each now. NULL: no memory. */
cJSON *destinations_document(struct sendings *sendings);
/* Has every destination asked whether it answers; true while one of them is still to be asked. */
void destinations_ask(struct sendings *sendings);
bool destinations_asked(struct sendings *sendings);
/* Woken when one has answered, or could not. */
void destinations_watch(struct sendings *sendings, struct watch *watch);
void destinations_unwatch(struct sendings *sendings, struct watch *watch);

/* ---- the modality worklist ---- */
/* Has it asked. ERR_NOT_FOUND: there is none. */
int worklist_ask(struct sendings *sendings, struct error *err);
/* True while it is still to be asked; destinations_watch's watchers are woken by its answer, too. */
bool worklist_asked(struct sendings *sendings);
/* {"steps": [...], ...} as it was told last. NULL: no memory. */
cJSON *worklist_document(struct sendings *sendings);

struct sendings_statistics {
	long count[SENDING_STATE_COUNT];               /* of those that have not ended */
	double oldest;                                 /* s since the oldest of them was asked for; 0: there is none */
	unsigned long long ended[SENDING_STATE_COUNT]; /* since the start */
	unsigned long long attempts;
};
void sendings_statistics(struct sendings *sendings, struct sendings_statistics *ret);

#endif

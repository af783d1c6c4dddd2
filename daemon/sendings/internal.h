#ifndef CBCT_DAEMON_SENDINGS_INTERNAL_H
#define CBCT_DAEMON_SENDINGS_INTERNAL_H

#include <pthread.h>

#include "daemon/process.h"
#include "daemon/sendings/sendings.h"
#include "proto/dicom.h"
#include "proto/json.h"

/* Shared by the files of this room. */

enum destination_kind {
	DESTINATION_DICOMWEB,
	DESTINATION_DIMSE,
	DESTINATION_MPPS, /* is told of performed procedure steps, and takes no volumes */
	DESTINATION_KIND_COUNT
};

struct destination {
	char name[DESTINATION_NAME_SIZE];
	enum destination_kind kind;
	char rule[SEND_VOLUMES_SIZE]; /* volumes of jobs that say nothing; "": none */
	enum dicom_kind objects;
	double promise_seconds; /* after which an unanswered request for storage commitment is made again */
	char address[320];      /* for people: the URL, or TITLE@HOST:PORT */
	cJSON *row;             /* as the file has it, for cbct-dicom; owned */
	unsigned long
	    edition; /* another one for each row that was ever read: answers belong to the row that was asked */
	/* Whether it answers. */
	bool wanted;           /* it is to be asked */
	bool known, reachable; /* the last answer */
	double checked;        /* seconds since 1970 */
	double checked_at;     /* clock_monotonic */
	char detail[320];      /* why it does not, "" where it does */
};

/* A sending that has not ended. */
struct entry {
	char job[ID_SIZE];
	struct sending_record record;
};

/* Our own application entity, as the file of destinations has it. */
enum { TITLE_SIZE = 17 };
struct application {
	char title[TITLE_SIZE];
	cJSON *listen, *worklist; /* for cbct-dicom, NULL: there is none; owned */
};

enum { TRANSFERS_MOST = 4, TRANSFER_LISTENER = TRANSFERS_MOST, TRANSFER_WORKLIST, TRANSFER_COUNT };
enum { TRANSFER_LINE_MAX = 16384 };
/* A run of cbct-dicom; the sender's own. The first TRANSFERS_MOST send, or ask destinations. */
struct transfer {
	bool runs, over;
	char destination[DESTINATION_NAME_SIZE], job[ID_SIZE], name[SENDING_NAME_SIZE]; /* job "": it only asks */
	unsigned long edition; /* of the destination's row that it was given */
	struct process process;
	int socket;
	double heard; /* clock_monotonic */
	char line[TRANSFER_LINE_MAX];
	size_t filled;
	cJSON *result; /* the last line; NULL: none came */
};

struct worklist {
	bool wanted;     /* it is to be asked */
	double checked;  /* seconds since 1970, 0: never */
	char error[320]; /* "": it has answered */
	cJSON *steps;    /* a list; NULL: it has never answered; owned */
	int nobodys;     /* entries whose patient could not be read */
};

struct sendings {
	struct store *store; /* constant, as the next five */
	struct jobs *jobs;
	char file[1024], program[1024];
	double pause, limit;
	int wake; /* eventfd, of the sender */
	struct watch watch;
	struct watch_list watchers;
	struct transfer transfers[TRANSFER_COUNT]; /* the sender's */
	cJSON *steps;                              /* those of the worklist that have come so far; the sender's */

	pthread_mutex_t lock; /* guards what follows; held over commits of sendings' rows: one change at a time */
	struct destination *destinations;
	int destination_count;
	struct entry *entries; /* in no order */
	int count, space;
	unsigned long long ended[SENDING_STATE_COUNT], attempts;
	bool stop;
	struct application application;
	struct worklist worklist;
	double listen_at;                    /* clock_monotonic: when the listener may start */
	unsigned long editions;              /* how many rows of destinations were read */
	bool listener_stale, worklist_stale; /* the process runs with a row that is no longer in the file */

	pthread_t thread;
	bool has_thread;
};

/* ---- destinations.c ---- */
/* The caller frees with destinations_free and application_free. */
int destinations_read(const char *file, struct destination **ret_destinations, int *ret_count,
		      struct application *ret_application, struct error *err);
void destinations_free(struct destination *destinations, int count);
/* NULL where there is none; the lock is held. */
struct destination *destination_find(const struct sendings *sendings, const char *name);

/* ---- application.c ---- */
/* Reads the members title, listen and worklist of the file. */
void application_read(struct json_reader *reader, struct application *ret);
void application_free(struct application *application);
/* A host, a port, the title of an application entity there, and the files of TLS. */
void application_peer(struct json_reader *reader, char *ret_address, size_t size);
/* Another worklist is to be asked from now on: what the old one told is dropped. The lock is held. */
void worklist_forget(struct sendings *sendings);
/* The path of a file that cbct-dicom, or a program that it starts, will read: one that cannot be read now is refused.
 */
void application_file(struct json_reader *reader, const char *name);
/* The line that the listener or the worklist's process gets, free; NULL: there is none, or no memory. */
char *application_task(const struct sendings *sendings, int transfer);
/* Lines of these processes; the lock is held. */
void application_take(struct sendings *sendings, int transfer, const cJSON *line);
/* One of them has ended; the lock is held. */
void application_ended(struct sendings *sendings, int transfer, const cJSON *result, const char *how);

/* ---- queue.c; the lock is held ---- */
struct entry *entry_find(struct sendings *sendings, const char *job, const char *name);
int entry_add(struct sendings *sendings, const char *job, const struct sending_record *record, struct error *err);
/* Writes the row, then changes the entry: one that has ended goes. ERR_NOT_FOUND: its job is removed, and it goes. */
int entry_change(struct sendings *sendings, struct entry *entry, const struct sending_record *record,
		 struct error *err);
void entry_drop(struct sendings *sendings, struct entry *entry);
/* The entry that waits for the answer to this request for storage commitment; NULL: none. */
struct entry *entry_promised(struct sendings *sendings, const char *transaction);
/* A waiting entry whose job has ended becomes a sending for each volume, or fails. */
int entry_expand(struct sendings *sendings, struct entry *entry, struct job *job, struct error *err);
int entries_load(struct sendings *sendings, struct error *err);

/* ---- step.c: performed procedure steps; the lock is held ---- */
bool entry_is_step(const struct entry *entry);
/* A waiting step has something to tell now. */
bool step_is_due(struct sendings *sendings, const struct entry *entry);
/* The line that cbct-dicom gets, free. */
int step_task_make(struct sendings *sendings, const struct destination *destination, struct job *job,
		   const struct sending_record *sending, char **ret_line, struct error *err);
/* The row after an attempt that was heard; ended: all of the step was told. */
void step_told(const struct entry *entry, bool ended, struct sending_record *record);
/* Begins anew what has failed or was stopped. ERR_IMPOSSIBLE: the job has no step that is told to it. */
int step_again(struct sendings *sendings, struct job *job, const struct send_wish *wish, bool *ret_new,
	       struct error *err);

/* ---- sender.c ---- */
void sender_wake(struct sendings *sendings);
/* Takes the answer to a request for storage commitment; the lock is held. */
void sender_promised(struct sendings *sendings, const char *transaction, int kept, int refused, int reason);
int sender_start(struct sendings *sendings, struct error *err);
void sender_stop(struct sendings *sendings);

/* ---- task.c ---- */
/* What cbct-dicom needs of a volume, for its objects; ERR_NOT_FOUND: it is gone. */
int task_add_volume(struct sendings *sendings, cJSON *task, struct job *job, const char *name, bool verify,
		    struct error *err);
/* The destination's row, with our title. */
void task_add_destination(const struct sendings *sendings, cJSON *task, const struct destination *destination);
/* As the line that it gets, free; the task goes. */
int task_line(cJSON *task, char **ret_line, struct error *err);
/*
 * The line that cbct-dicom gets, free; job and sending NULL: whether the destination answers. ERR_NOT_FOUND,
 * ERR_DAMAGED: the volume. The lock is held.
 */
int task_make(struct sendings *sendings, const struct destination *destination, struct job *job,
	      const struct sending_record *sending, char **ret_line, struct error *err);

#endif

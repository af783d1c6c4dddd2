#ifndef CBCT_DAEMON_SENDINGS_INTERNAL_H
#define CBCT_DAEMON_SENDINGS_INTERNAL_H

#include <pthread.h>

#include "daemon/process.h"
#include "daemon/sendings/sendings.h"

/* Shared by the files of this room. */

enum destination_kind { DESTINATION_DICOMWEB, DESTINATION_KIND_COUNT };

struct destination {
	char name[DESTINATION_NAME_SIZE];
	enum destination_kind kind;
	char rule[SEND_VOLUMES_SIZE]; /* volumes of jobs that say nothing; "": none */
	bool enhanced;
	char address[320]; /* for people: the URL */
	cJSON *row;        /* as the file has it, for cbct-dicom; owned */
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

enum { TRANSFERS_MOST = 4, TRANSFER_LINE_MAX = 4096 };
/* A run of cbct-dicom; the sender's own. */
struct transfer {
	bool runs, over;
	char destination[DESTINATION_NAME_SIZE], job[ID_SIZE], name[SENDING_NAME_SIZE]; /* job "": it only asks */
	struct process process;
	int socket;
	double heard; /* clock_monotonic */
	char line[TRANSFER_LINE_MAX];
	size_t filled;
	cJSON *result; /* the last line; NULL: none came */
};

struct sendings {
	struct store *store; /* constant, as the next five */
	struct jobs *jobs;
	char file[1024], program[1024];
	double pause, limit;
	int wake; /* eventfd, of the sender */
	struct watch watch;
	struct watch_list watchers;
	struct transfer transfers[TRANSFERS_MOST]; /* the sender's */

	pthread_mutex_t lock; /* guards what follows; held over commits of sendings' rows: one change at a time */
	struct destination *destinations;
	int destination_count;
	struct entry *entries; /* in no order */
	int count, space;
	unsigned long long ended[SENDING_STATE_COUNT], attempts;
	bool stop;

	pthread_t thread;
	bool has_thread;
};

/* ---- destinations.c ---- */
/* The caller frees with destinations_free. */
int destinations_read(const char *file, struct destination **ret_destinations, int *ret_count, struct error *err);
void destinations_free(struct destination *destinations, int count);
/* NULL where there is none; the lock is held. */
struct destination *destination_find(const struct sendings *sendings, const char *name);

/* ---- queue.c; the lock is held ---- */
struct entry *entry_find(struct sendings *sendings, const char *job, const char *name);
/* Writes the row, then changes the entry: one that has ended goes. ERR_NOT_FOUND: its job is removed, and it goes. */
int entry_change(struct sendings *sendings, struct entry *entry, const struct sending_record *record,
		 struct error *err);
void entry_drop(struct sendings *sendings, struct entry *entry);
/* A waiting entry whose job has ended becomes a sending for each volume, or fails. */
int entry_expand(struct sendings *sendings, struct entry *entry, struct job *job, struct error *err);
int entries_load(struct sendings *sendings, struct error *err);

/* ---- sender.c ---- */
void sender_wake(struct sendings *sendings);
int sender_start(struct sendings *sendings, struct error *err);
void sender_stop(struct sendings *sendings);

/* ---- task.c ---- */
/*
 * The line that cbct-dicom gets, free; job NULL: whether the destination answers. ERR_NOT_FOUND, ERR_DAMAGED: the
 * volume. The lock is held.
 */
int task_make(struct sendings *sendings, const struct destination *destination, struct job *job, const char *volume,
	      char **ret_line, struct error *err);

#endif

#ifndef CBCT_DAEMON_CALIBRATIONS_INTERNAL_H
#define CBCT_DAEMON_CALIBRATIONS_INTERNAL_H

#include <pthread.h>

#include "daemon/calibrations/calibrations.h"
#include "daemon/process.h"
#include "proto/calibration_files.h"

/* Shared by the files of this room. */

enum calibration_state { CALIBRATION_QUEUED, CALIBRATION_RUNNING, CALIBRATION_SUCCEEDED, CALIBRATION_FAILED };
extern const char *const calibration_state_names[];

struct entry {
	char id[ID_SIZE], scan[ID_SIZE];
	enum calibration_state state;
	int failure;            /* of its result, enum error_code; 0: none */
	double due;             /* CLOCK_MONOTONIC, before which one that is queued is not made */
	double acquired, ended; /* seconds since 1970 */
	char client[STORE_CLIENT_SIZE];
	unsigned long long bytes; /* of its files */
	cJSON *brief;             /* all of the brief document but state and age, owned */
};

struct calibrations {
	struct store *store; /* constant, as the next four */
	char worker[1024];
	int threads;
	long age;
	int wake; /* eventfd, of the calibrator */

	pthread_mutex_t lock;  /* guards what follows */
	struct entry *entries; /* [count], by id */
	int count, space;
	bool stop;

	struct watch_list watchers;
	pthread_t thread;
	bool has_thread;
};

/* ---- library.c ---- */
/* STATE/calibrations/ID, or a file in it. */
void calibration_path(const struct calibrations *calibrations, const char *id, const char *file, char ret_path[1024]);
/* NULL where there is none; the lock is held. */
struct entry *calibration_entry(struct calibrations *calibrations, const char *id);

/* ---- read.c ---- */
/*
 * Reads request and result; of one that has not succeeded the result is NULL where there is none. ERR_DAMAGED: also a
 * file that is gone; ERR_NOT_FOUND: so is the calibration, or it is not in the list yet.
 */
int calibration_read(struct calibrations *calibrations, const char *id, bool succeeded, cJSON **ret_request,
		     cJSON **ret_result, struct error *err);

/*
 * An entry from the files of a calibration, whose request says from now on that there is a result, where there is one.
 * ERR_DAMAGED: also where it says so and there is none. brief is the caller's.
 */
int calibration_load(struct calibrations *calibrations, const char *id, struct entry *ret_entry, struct error *err);

/* ---- document.c ---- */
/* Makes the brief document but for state and age. result may be NULL. NULL: no memory. */
cJSON *calibration_brief(const char *id, const cJSON *request, const cJSON *result, const struct error *failure);
/* Members that are left out of brief documents. */
void calibration_add_rest(cJSON *document, const cJSON *request, const cJSON *result);

/* ---- runner.c ---- */
int calibrator_start(struct calibrations *calibrations, struct error *err);
void calibrator_stop(struct calibrations *calibrations);
void calibrator_wake(struct calibrations *calibrations);

#endif

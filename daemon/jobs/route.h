#ifndef CBCT_DAEMON_JOBS_ROUTE_H
#define CBCT_DAEMON_JOBS_ROUTE_H

#include <stdbool.h>

/*
 * Decisions about devices: which of them a job goes on with when a run of it was lost, and which gets no more jobs.
 * Pure functions, without clocks, sockets or locks. Any thread.
 */
enum {
	ROUTE_DEATHS = 2,    /* runs lost on one device, after which the job leaves it */
	ROUTE_RUNS = 3,      /* runs lost in all, after which a job without another device fails */
	ROUTE_RUNS_MOST = 4, /* the same with others, so that no job takes one device after the other with it */
	DEVICE_FAULTS = 3    /* in a row, without a job that succeeded between them: the device is set aside */
};

enum route {
	ROUTE_SAME,      /* any device that it has not left; the same one where there is no other */
	ROUTE_OTHER,     /* a device that it has not left */
	ROUTE_PROCESSOR, /* the worker that --fallback cpu allows */
	ROUTE_END        /* none: it fails */
};

/* A checkpoint is progress: it makes `deaths` and `runs` begin anew. */
struct route_facts {
	bool device_error; /* the device failed or hung; else a process ended for another reason */
	int deaths;        /* runs lost on this device without a checkpoint between them, this one included */
	int runs;          /* the same on all devices */
	bool other;        /* a device that the job has not left answers */
	bool processor;    /* allowed, and the job is not there yet */
};
enum route route_of(const struct route_facts *facts);

/* s until a device that was set aside is tested again, when `failed` tests have failed. */
double device_test_delay(unsigned failed);

#endif

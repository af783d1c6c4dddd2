#ifndef CBCT_DAEMON_JOBS_SPAWN_H
#define CBCT_DAEMON_JOBS_SPAWN_H

#include <stdbool.h>
#include <stddef.h>

#include "daemon/process.h"

/* One worker process at its start and at its end. */
struct spawn_options {
	const char *worker;  /* path of the program */
	const char *backend; /* "auto", "cuda", "cpu" */
	int device, threads;
	bool test; /* it says hello after its self-test, and not at all when that fails */
	size_t device_memory;
};

struct child {
	struct process process;
	int socket; /* our end of the pair */
};

/*
 * The child has standard output and error of ours, no input, its end of a
 * SOCK_SEQPACKET pair as descriptor 3, and nothing else.
 */
int child_spawn(const struct spawn_options *options, struct child *ret_child, struct error *err);
/* Another host in place of a device: cbct remote. Texts that are "" are not passed on. */
struct spawn_remote {
	const char *program, *host, *claim, *url, *token_file, *authorities;
	double lease; /* s */
};
int child_spawn_remote(const struct spawn_remote *options, struct child *ret_child, struct error *err);
/* After pidfd became readable: collects it, closes both descriptors, says how it ended ("signal 9 (Killed)"). */
void child_reap(struct child *child, char *ret_how, size_t size);

#endif

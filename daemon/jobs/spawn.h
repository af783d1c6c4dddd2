#ifndef CBCT_DAEMON_JOBS_SPAWN_H
#define CBCT_DAEMON_JOBS_SPAWN_H

#include <stddef.h>
#include <sys/types.h>

#include "core/error.h"

/* One worker process at its start and at its end. */
struct spawn_options {
	const char *worker;  /* path of the program */
	const char *backend; /* "auto", "cuda", "cpu" */
	int device, threads;
	size_t device_memory;
};

struct child {
	pid_t pid;
	int pidfd;  /* readable once it has ended */
	int socket; /* our end of the pair */
};

/* Where cbct-worker is when nobody says: beside this program, else by PATH. */
void worker_path(char *ret_path, size_t size);

/*
 * The child has standard output and error of ours, no input, its end of a
 * SOCK_SEQPACKET pair as descriptor 3, and nothing else.
 */
int child_spawn(const struct spawn_options *options, struct child *ret_child, struct error *err);
/* After pidfd became readable: collects it, closes both descriptors, says how it ended ("signal 9 (Killed)"). */
void child_reap(struct child *child, char *ret_how, size_t size);
void child_kill(const struct child *child);

#endif

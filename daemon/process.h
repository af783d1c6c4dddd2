#ifndef CBCT_DAEMON_PROCESS_H
#define CBCT_DAEMON_PROCESS_H

#include <stddef.h>
#include <sys/types.h>

#include "core/error.h"

/* Programs that the daemon starts: their start and their end. Any thread. */
struct process {
	pid_t pid;
	int pidfd; /* readable once it has ended */
};

/*
 * Where the worker is when nobody says: beside this program as cbct-worker-cuda (which a package of its own brings) or
 * cbct-worker, else by PATH.
 */
void worker_path(char *ret_path, size_t size);

/* Where a program of ours is: beside this one, else by PATH. */
void program_path(const char *name, char *ret_path, size_t size);

/*
 * Starts a program with these arguments (the first is its name, the last NULL). It has standard output and error of
 * ours, no input, `descriptor` as its descriptor 3 (-1: none), and nothing else; a terminal's Ctrl-C does not reach it.
 */
enum { PROCESS_DESCRIPTOR = 3 };
int process_start(const char *program, char *const *arguments, int descriptor, struct process *ret_process,
		  struct error *err);
/* Waits for the end; says how it ended ("signal 9 (Killed)"); returns the exit status, or the signal's number,
 * negative. */
int process_reap(struct process *process, char *ret_how, size_t size);
/* What such an end means, in words for a user: of any other than 0. */
const char *process_meaning(int end);
void process_kill(const struct process *process);

#endif

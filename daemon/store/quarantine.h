#ifndef CBCT_DAEMON_STORE_QUARANTINE_H
#define CBCT_DAEMON_STORE_QUARANTINE_H

#include <stdbool.h>

#include "core/error.h"

/*
 * STATE/quarantine/: files that were found in the state directory and cannot be used, each entry NAME with a note
 * NAME.json of where it was, when it was moved and why. The daemon puts things there and never takes them away, but for
 * what a rebuild of the catalogue finds to be whole (store/reconcile.c). An entry may be a note alone: of a catalogue
 * that was not there at all. Whoever runs the machine removes entries, or puts them back, once they were seen to.
 */
enum { QUARANTINE_NAME_MAX = 96, QUARANTINE_WHY_MAX = 400 };

/* Moves STATE/`path`, durably; the note is written first. */
int quarantine_move(const char *state, const char *path, const char *why, struct error *err);
/* A note alone about STATE/`path`. */
int quarantine_note(const char *state, const char *path, const char *why, struct error *err);
/* An entry and its note are gone from here: it was moved back. */
int quarantine_forget(const char *state, const char *name, struct error *err);

struct quarantined {
	char name[QUARANTINE_NAME_MAX];
	char from[QUARANTINE_NAME_MAX]; /* where it was in STATE; "" where the note cannot be read */
	double time;                    /* seconds since 1970, 0: not known */
	char why[QUARANTINE_WHY_MAX];
};
/* Reads the directory: all entries by their names; free the array. */
int quarantine_list(const char *state, struct quarantined **ret_entries, int *ret_count, struct error *err);

#endif

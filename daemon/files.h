#ifndef CBCT_DAEMON_FILES_H
#define CBCT_DAEMON_FILES_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/* Directories of the state: made durably, swept, removed. Any thread. */

/* Made with mode 0700, its parents too, each synced; one that is there already is fine. */
int directory_make(const char *path, struct error *err);
/* Whatever was renamed, made or removed in it is on the disk. */
int directory_sync(const char *path, struct error *err);
/* Removes a directory and the files in it; it has no directories. One that is not there is fine. */
int directory_remove(const char *path, struct error *err);

/*
 * Calls `visit` with each name in a directory but . and .. until it returns
 * non-zero, which is returned. A directory that is not there is an empty one.
 */
int directory_visit(const char *path, int (*visit)(void *context, const char *name, struct error *err), void *context,
		    struct error *err);

/* The name of a file that was being written when the process died. */
bool name_is_temporary(const char *name);

/* Bytes that an unprivileged process may still write where `path` is. */
int space_free(const char *path, unsigned long long *ret_bytes, struct error *err);

/*
 * For texts that leave the machine: each path in `text` that begins with
 * `directory` becomes its last component.
 */
void path_hide(char *text, const char *directory);

#endif

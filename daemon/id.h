#ifndef CBCT_DAEMON_ID_H
#define CBCT_DAEMON_ID_H

#include <stdbool.h>

#include "core/error.h"

/*
 * Names of scans and jobs: 16 characters of lower-case base32 (Crockford's
 * digits, without i l o u). Nine of them are the milliseconds since 1970, seven
 * are random, so that sorting by name sorts by time of making: each is greater
 * than all made before in this process or announced with id_floor. Any thread.
 */
enum { ID_LENGTH = 16, ID_SIZE = ID_LENGTH + 1 };

int id_make(char ret_id[ID_SIZE], struct error *err);
/* Later ids sort behind this one, even when the clock was set back. */
void id_floor(const char *id);
/* Says whether text from outside has the form of an id: then it is safe in a path. */
bool id_valid(const char *id);

#endif

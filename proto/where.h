#ifndef CBCT_PROTO_WHERE_H
#define CBCT_PROTO_WHERE_H

#include <stdbool.h>

#include <cjson/cJSON.h>

#include "core/error.h"

/*
 * The member "where" of a job: on which host it may run. All zero: on any.
 *
 * A host has a name (--fleet-host) and devices. It may run the job where it has the name, and at least so many devices
 * with so much memory each; the job then runs on one with so much memory.
 */
enum { WHERE_HOST_SIZE = 64, WHERE_DEVICES_MOST = 64 };
struct where {
	char host[WHERE_HOST_SIZE]; /* "": any */
	double memory;              /* bytes of a device, a whole number; 0: any */
	long devices;               /* 0: any, as 1 is */
};

/* NULL and null are any. Members that are absent or null leave theirs open. Errors as of a json_reader. */
int where_read(const cJSON *value, const char *base, struct where *ret, struct error *err);
/* With all members, null for what is open; NULL for no memory. */
cJSON *where_json(const struct where *where);
bool where_is_any(const struct where *where);
bool where_same(const struct where *a, const struct where *b);
/* Whether the host of that name, whose devices have memory[count] bytes, may run it. */
bool where_fits(const struct where *where, const char *host, const double *memory, int count);

#endif

#ifndef CBCT_PROTO_LABELS_H
#define CBCT_PROTO_LABELS_H

#include "proto/json.h"

/* The member "labels" of scans and jobs: free texts under names of the client's own, kept and shown. */
enum {
	LABELS_MOST = 32,
	LABEL_NAME_MOST = 64, /* characters of Unicode */
	LABEL_MOST = 256,
	LABELS_TEXT_MAX = 4096 /* bytes of all of them as JSON, its end included */
};

/*
 * Reads {"key": "value", ...} and gives it as compact JSON, owned by the caller, NULL for none; NULL
 * and null are none. ERR_INVALID for another type, an empty name, control characters;
 * ERR_IMPOSSIBLE for too many and too long ones.
 */
int labels_read(const cJSON *value, const char *base, char **ret_text, struct error *err);

#endif

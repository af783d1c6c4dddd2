#ifndef CBCT_CLIENTS_FIT_H
#define CBCT_CLIENTS_FIT_H

#include "clients/cbct/images.h"
#include "proto/json.h"

/* What cbct fit-lag and cbct fit-scatter share. */

/*
 * The mean of a file's images, [row][column], owned by the caller. They must be as large as `like`; all 0 where the
 * path is NULL.
 */
int fit_mean(const char *path, const struct image_options *how, const struct images *like, float **ret_mean,
	     struct error *err);
/* Writes a document's member as JSON, {"name": value}; the value is freed. */
int fit_write(const char *path, const char *name, cJSON *value, struct error *err);

#endif

#ifndef CBCT_PROTO_DETECTOR_H
#define CBCT_PROTO_DETECTOR_H

#include "core/detector.h"
#include "proto/json.h"

/*
 * The members `lag` and `scatter` of a scan's projections. Absent members leave the model as it is; its errors point
 * below the reader's object.
 */
void lag_read(struct json_reader *reader, struct lag_model *ret_model);
void scatter_read(struct json_reader *reader, struct scatter_model *ret_model);

/* The same members from models, as `cbct fit-lag` and `cbct fit-scatter` print them. New values of the caller's. */
cJSON *lag_json(const struct lag_model *model);
cJSON *scatter_json(const struct scatter_model *model);

#endif

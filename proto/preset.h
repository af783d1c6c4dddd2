#ifndef CBCT_PROTO_PRESET_H
#define CBCT_PROTO_PRESET_H

#include <cjson/cJSON.h>

#include "core/error.h"

/*
 * Jobs by their purpose: {"scan": ID, "preset": "fast"}. A preset is a set of stages in numbers, put into the request
 * before it is read, so that the job's document shows them and a later change of the table changes no job that is
 * there. What each is worth: tests/bench/results/presets.txt. No state; any thread.
 */
struct job_preset {
	const char *name;
	const char *help;   /* one plain sentence */
	const char *stages; /* JSON, an object with members of a job's request */
};
enum { JOB_PRESET_COUNT = 6 };
extern const struct job_preset job_presets[JOB_PRESET_COUNT];

/*
 * The request without "preset", and with the preset's stages where it names none of its own, not even with null: a
 * stage of the request stands in place of the whole stage of the preset, any algorithm in place of the preset's.
 * *ret_expanded, the caller's, is NULL where the request has no preset. ERR_INVALID and ERR_IMPOSSIBLE at "/preset";
 * ERR_NO_MEMORY.
 */
int job_preset_expand(const cJSON *request, cJSON **ret_expanded, struct error *err);

#endif

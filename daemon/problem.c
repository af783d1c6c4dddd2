/* The one table of problems: problem.h. */
#include "daemon/problem.h"

#include <assert.h>
#include <stdio.h>
#include <string.h>

#include "core/error.h"

static const struct problem problems[] = {
    {ERR_INVALID, 400, "invalid", "The request is malformed"},
    {ERR_IMPOSSIBLE, 422, "impossible", "The request is well-formed, but cannot be done"},
    {ERR_NOT_FOUND, 404, "not-found", "There is no such thing"},
    {ERR_CONFLICT, 409, "conflict", "The request contradicts what is there"},
    {ERR_TOO_LARGE, 413, "too-large", "The body is longer than allowed"},
    {ERR_NO_MEMORY, 503, "no-memory", "Memory ran out"},
    {ERR_NO_SPACE, 507, "no-space", "The disk is full"},
    {ERR_IO, 500, "io", "Reading or writing failed"},
    {ERR_SYNC, 500, "sync", "The disk failed"},
    {ERR_DEVICE, 500, "device", "The accelerator failed"},
    {ERR_CANCELLED, 503, "cancelled", "The request was given up"},
    {ERR_BUSY, 503, "busy", "Not just now"},
    {ERR_INTERNAL, 500, "internal", "The daemon broke a promise of its own"},
    {ERR_DAMAGED, 500, "damaged", "The disk has damaged what was stored"},
    {ERR_QUOTA, 507, "limit-of-bytes", "There are as many bytes as there may be"},
    {ERR_AWAY, 503, "catalogue-away", "The catalogue's database cannot be reached"},
    {ERR_LIMIT, 429, "limit-reached", "Who asks has as much as one may have"},
    {0, 307, "elsewhere", "Another host of the fleet has it"},
    {0, 401, "unauthorized", "The daemon does not know who asks"},
    {0, 403, "forbidden", "Another role is wanted for this"},
    {0, 403, "foreign-origin", "A page of another site may not do this"},
    {0, 405, "method-not-allowed", "The resource does not know this method"},
    {0, 411, "length-required", "The request needs a body"},
    {0, 412, "precondition-failed", "What is there is not what the request expects"},
    {0, 428, "precondition-required", "The request must say what it expects to be there"},
    {0, 414, "target-too-long", "The request's target is longer than allowed"},
    {0, 415, "unsupported-encoding", "The body's encoding is not known"},
    {0, 415, "unsupported-media-type", "The body is of another type"},
    {0, 416, "range-outside", "The range lies outside of the body"},
    {0, 421, "misdirected", "The request is for another server"},
    {0, 431, "head-too-large", "The request's head is longer than allowed"},
    {0, 505, "version", "The request is in another version of HTTP"},
    {0, 429, "too-many-connections", "Too many connections from this address"},
};
enum { PROBLEM_COUNT = sizeof(problems) / sizeof(problems[0]) };

const struct problem *problem_of_code(int code)
{
	for (int i = 0; i < PROBLEM_COUNT; i++) {
		if (problems[i].code == code && code != 0)
			return &problems[i];
	}
	return problem_of_code(ERR_INTERNAL);
}

const struct problem *problem_named(const char *name)
{
	for (int i = 0; i < PROBLEM_COUNT; i++) {
		if (strcmp(problems[i].name, name) == 0)
			return &problems[i];
	}
	assert(!"a row of problems[]");
	return problem_of_code(ERR_INTERNAL);
}

void problem_add_type(cJSON *document, const struct problem *problem)
{
	char type[64];

	snprintf(type, sizeof(type), "urn:cbctd:problem:%s", problem->name);
	cJSON_AddStringToObject(document, "type", type);
}

#ifndef CBCT_PROTO_PARAMETER_H
#define CBCT_PROTO_PARAMETER_H

#include "core/parameter.h"
#include "proto/json.h"

/* Tables of parameters (core/parameter.h) read from JSON and written as JSON. */

/* The rows of a table that are members of one object of the document. */
struct parameter_set {
	const struct parameter *parameters;
	int count;
	const char *object; /* struct parameter.object of the rows */
	bool counting;      /* only rows that count are members at all; otherwise those too that have no effect */
};

/*
 * Reads the member `name` of the reader's object into the record. What is absent or null is left as it is, unless
 * parameter->presets says that it is required.
 */
void json_parameter(struct json_reader *reader, const struct parameter *parameter, const char *name, void *record);
/* The same for all of the set that are no members of a member. */
void json_parameters(struct json_reader *reader, const struct parameter_set *set, void *record);
/* Reads a whole object, members of members included; other members are refused. `base` is the object's own pointer. */
int parameters_read(const cJSON *value, const char *base, const struct parameter_set *set, void *record,
		    struct error *err);

/* Adds those of the set that count; one that is open is left out. False for no memory. */
bool parameters_add(cJSON *json, const struct parameter_set *set, const void *record);

/*
 * The row itself: pointer, type, required or default, minimum, maximum, count, choices, word, unit, help. `object` as
 * in parameter_pointer; the record has the defaults. The caller's to delete; NULL for no memory.
 */
cJSON *parameter_json(const struct parameter *parameter, const char *object, const void *record);

#endif

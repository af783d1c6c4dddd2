/* The member "where" of a job: where.h. */
#include "proto/where.h"

#include <math.h>
#include <string.h>

#include "proto/json.h"

static const double MEMORY_MOST = 1e15; /* bytes: far above any device, and a whole number in every JSON */

int where_read(const cJSON *value, const char *base, struct where *ret, struct error *err)
{
	static const char letters[] = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.-";
	struct where where = {.memory = 0};
	struct json_reader reader;
	int code;

	*ret = where;
	if (value == NULL || cJSON_IsNull(value))
		return 0;
	json_begin(&reader, value, base, err);
	json_string(&reader, "host", false, where.host, sizeof(where.host));
	json_number(&reader, "memory", false, 0, MEMORY_MOST, &where.memory);
	json_integer(&reader, "devices", false, 1, WHERE_DEVICES_MOST, &where.devices);
	if (where.memory != rint(where.memory))
		json_fail(&reader, ERR_INVALID, "memory", "a whole number of bytes is expected");
	if (json_has(&reader, "host") && (where.host[0] == '\0' || strspn(where.host, letters) != strlen(where.host)))
		json_fail(&reader, ERR_INVALID, "host",
			  "\"%s\" is no name of a host: letters, digits, _ . - are expected", where.host);
	code = json_end(&reader);
	if (code == 0)
		*ret = where;
	return code;
}

cJSON *where_json(const struct where *where)
{
	cJSON *document = cJSON_CreateObject();

	if (document != NULL &&
	    json_add(document, "host", where->host[0] != '\0' ? cJSON_CreateString(where->host) : cJSON_CreateNull()) &&
	    json_add(document, "memory", where->memory > 0 ? cJSON_CreateNumber(where->memory) : cJSON_CreateNull()) &&
	    json_add(document, "devices",
		     where->devices > 0 ? cJSON_CreateNumber((double)where->devices) : cJSON_CreateNull()))
		return document;
	cJSON_Delete(document);
	return NULL;
}

bool where_is_any(const struct where *where)
{
	return where->host[0] == '\0' && !(where->memory > 0) && where->devices == 0;
}

bool where_same(const struct where *a, const struct where *b)
{
	return strcmp(a->host, b->host) == 0 && a->memory == b->memory && a->devices == b->devices;
}

bool where_fits(const struct where *where, const char *host, const double *memory, int count)
{
	int enough = 0;

	if (where->host[0] != '\0' && strcmp(where->host, host) != 0)
		return false;
	if (!(where->memory > 0) && where->devices <= 1)
		return true;
	for (int i = 0; i < count; i++)
		enough += memory[i] >= where->memory;
	return enough >= (where->devices > 1 ? where->devices : 1);
}

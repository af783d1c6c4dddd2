#ifndef CBCT_PROTO_SEND_H
#define CBCT_PROTO_SEND_H

#include "proto/json.h"

/*
 * The member "send" of a job: which of its volumes go to which destinations once it has succeeded. A list of names, or
 * of objects {"to": "pacs", "volumes": "last" | "all" | [5, "fdk", ...]}; without `volumes` the last one.
 */
enum {
	DESTINATION_NAME_MOST = 32,
	DESTINATION_NAME_SIZE = DESTINATION_NAME_MOST + 1,
	SEND_VOLUMES_SIZE = 160,
	SENDS_MOST = 16
};

/* What stands in place of volumes where a destination is told of the job's performed procedure step; no wish of a
 * client. */
#define SEND_STEP "step"

struct send_wish {
	char to[DESTINATION_NAME_SIZE];
	char volumes[SEND_VOLUMES_SIZE]; /* "last", "all", or "fdk,5,10" */
};

/* Reads one wish, a name or an object; base is its pointer. ERR_INVALID, ERR_IMPOSSIBLE. */
int send_wish_read(const cJSON *value, const char *base, struct send_wish *ret_wish, struct error *err);
/*
 * Reads the list and gives it as compact JSON, each wish as an object; owned by the caller. NULL and null: nothing was
 * said, NULL; an empty list is one. ERR_IMPOSSIBLE for two wishes with one destination.
 */
int sends_read(const cJSON *value, const char *base, char **ret_text, struct error *err);
/* The wishes of such a text; NULL: none. Returns how many. */
int sends_parse(const char *text, struct send_wish ret_wishes[SENDS_MOST]);
/* Such a text of `count` wishes; NULL for no memory. */
char *sends_text(const struct send_wish *wishes, int count);
/* `volumes` as it is written in JSON. NULL for no memory. */
cJSON *send_volumes_json(const char *volumes);
/* True where the wish means this volume; `last`: nothing was kept after it. */
bool send_wants(const char *volumes, const char *name, int iteration, bool last);
/* A destination's name: letters, digits, "-", "_" and "."; it stands in paths of the API. */
bool destination_name_valid(const char *name);

#endif

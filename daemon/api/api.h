#ifndef CBCT_DAEMON_API_API_H
#define CBCT_DAEMON_API_API_H

#include "daemon/http/http.h"

/* The door of the API: its table of endpoints, and what the handlers work on. */
struct api {
	struct store *store; /* these are constant while the server runs */
	struct jobs *jobs;
	struct supervise *supervise;
	struct uploads *uploads;
	struct event_ring *events;
	struct mappings *mappings;
	struct encoded_copies *copies;
	struct calibrations *calibrations;
	struct sendings *sendings;
	struct cards *cards;
	struct http *http;
	struct fleet *fleet;   /* NULL: it is in none */
	struct homes *homes;   /* NULL: likewise */
	struct keeper *keeper; /* NULL: everything is kept */
	struct pictures *pictures;
	double max_wait; /* s */
	double started;  /* clock_monotonic */
};

/* Removes what is older than `seconds` (0: nothing), from now on; after all others were started. */
int keeper_start(struct api *api, double seconds, struct keeper **ret_keeper, struct error *err);
void keeper_stop(struct keeper *keeper); /* NULL is fine; before any other is stopped */

/* The threads that draw pictures; before the server starts, and stopped after it. patience: s that one waits for its
 * turn. */
int pictures_start(double patience, struct pictures **ret_pictures, struct error *err);
void pictures_stop(struct pictures *pictures); /* NULL is fine */

/*
 * For struct http_options: what a request names and is not here may be another host's of the fleet. 307 with that
 * host's address then; where it has none, or was not seen, the error says so. True: a reply was set. Never waits.
 */
bool elsewhere_missing(void *context, struct request *request, struct error *err);

/* Every endpoint; their context is a struct api. Ends with method == NULL. */
extern const struct route api_routes[];

#endif

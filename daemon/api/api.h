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
	struct cards *cards;
	struct http *http;
	double max_wait; /* s */
	double started;  /* clock_monotonic */
};

/* Every endpoint; their context is a struct api. Ends with method == NULL. */
extern const struct route api_routes[];

#endif

/* Requests and replies of each route in numbers, for /metrics. */
#include "daemon/http/internal.h"

#include <stdlib.h>

enum { STATUS_FIRST = 100, STATUS_END = 600, STATUS_SLOTS = STATUS_END - STATUS_FIRST + 1 };

/* Counters of one route. A slot for each status, the last for requests that were broken off. */
struct traffic {
	struct {
		atomic_ullong requests, received, sent;
	} slots[STATUS_SLOTS];
	struct histogram seconds;
};

static int route_count(const struct route *routes)
{
	int count = 0;

	while (routes[count].method != NULL)
		count++;
	return count;
}

/* The index of a route; those that found none have the place behind the last one. */
static int route_index(const struct http *http, const struct route *route)
{
	return route != NULL ? (int)(route - http->options.routes) : route_count(http->options.routes);
}

int traffic_new(const struct route *routes, struct traffic **ret_traffic, struct error *err)
{
	struct traffic *traffic = calloc((size_t)route_count(routes) + 1, sizeof(*traffic));

	if (traffic == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for counters");
	*ret_traffic = traffic;
	return 0;
}

void traffic_free(struct traffic *traffic)
{
	free(traffic);
}

void traffic_count(struct http *http, const struct request *request, bool whole)
{
	struct traffic *traffic = &http->traffic[route_index(http, request->route)];
	bool answered = whole && request->status >= STATUS_FIRST && request->status < STATUS_END;
	int slot = answered ? request->status - STATUS_FIRST : STATUS_SLOTS - 1;
	uint64_t sent = request->sent;

	if (whole && request->response_size != UNKNOWN_SIZE && !request_is_head(request))
		sent = request->response_size;
	atomic_fetch_add(&traffic->slots[slot].requests, 1);
	atomic_fetch_add(&traffic->slots[slot].received, request->received);
	atomic_fetch_add(&traffic->slots[slot].sent, sent);
	histogram_add(&traffic->seconds, clock_monotonic() - request->started);
}

void http_traffic(const struct http *http, void (*visit)(void *context, const struct http_traffic *traffic),
		  void *context)
{
	const int count = route_count(http->options.routes);

	for (int i = 0; i <= count; i++) {
		const struct traffic *traffic = &http->traffic[i];

		for (int j = 0; j < STATUS_SLOTS; j++) {
			struct http_traffic one = {.route = i < count ? &http->options.routes[i] : NULL,
						   .status = j < STATUS_SLOTS - 1 ? STATUS_FIRST + j : 0,
						   .requests = atomic_load(&traffic->slots[j].requests)};

			if (one.requests == 0)
				continue;
			one.received = atomic_load(&traffic->slots[j].received);
			one.sent = atomic_load(&traffic->slots[j].sent);
			visit(context, &one);
		}
	}
}

const struct histogram *http_seconds(const struct http *http, const struct route *route)
{
	return &http->traffic[route_index(http, route)].seconds;
}

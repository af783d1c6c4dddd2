/*
 * Requests for what another host of the fleet has: api.h.
 *
 * The answer is a redirection and no relay: what is asked for may be gigabytes, and the client's proof of who it is
 * goes to the host that decides about it. It names the owner, which answers by itself, so that nothing can go round in
 * a circle.
 */
#include <string.h>

#include "daemon/api/internal.h"
#include "daemon/fleet/fleet.h"

bool elsewhere_reply(struct api *api, struct request *request, const char *id, struct error *err)
{
	const char *target = request_target(request);
	struct fleet_host host;
	struct error ignored;

	if (api->homes == NULL || !homes_find(api->homes, id, &host))
		return false;
	if (host.url[0] == '\0') {
		error_set_at(
		    err, ERR_NOT_FOUND, err->pointer,
		    "\"%.40s\" is not here: host %s of the fleet has it, which has no address that others reach. Ask "
		    "it itself",
		    id, host.name);
		return false;
	}
	if (host.away) {
		error_set_at(err, ERR_BUSY, err->pointer,
			     "\"%.40s\" is not here: host %s of the fleet has it, at %s, which was not seen just now",
			     id, host.name, host.url);
		return false;
	}
	if (target[0] != '/' ||
	    request_reply_problem(request, "elsewhere", &ignored, "host %s has \"%.40s\"", host.name, id) != 0)
		return false;
	request_reply_header(request, "Location", "%s%s", host.url, target);
	return true;
}

bool elsewhere_missing(void *context, struct request *request, struct error *err)
{
	return elsewhere_reply(context, request, request_argument(request, 0), err);
}

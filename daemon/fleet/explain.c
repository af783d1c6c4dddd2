/* Why a job waits for a host: internal.h. */
#include <stdio.h>
#include <string.h>

#include "daemon/fleet/internal.h"

static void wanted_text(const struct where *where, char *ret_text, size_t size)
{
	const long devices = where->devices > 1 ? where->devices : 1;
	int length = snprintf(ret_text, size, "%ld device%s", devices, devices > 1 ? "s" : "");

	if (where->memory > 0 && length > 0)
		snprintf(ret_text + length, size - (size_t)length, " of %.0f bytes%s", where->memory,
			 devices > 1 ? " each" : "");
}

static void devices_text(const double *memory, int count, char *ret_text, size_t size)
{
	double most = 0;

	for (int i = 0; i < count; i++)
		most = memory[i] > most ? memory[i] : most;
	if (count == 0)
		snprintf(ret_text, size, "no device");
	else
		snprintf(ret_text, size, "%d device%s of at most %.0f bytes", count, count > 1 ? "s" : "", most);
}

/* What was the matter when a host had claimed a job of this one; `name`: that host alone, "": any. */
static bool trouble_text(struct fleet *fleet, const char *name, char *ret_text, size_t size)
{
	struct host_trouble troubles[TROUBLES_MAX];
	const int count = supervise_troubles(fleet->supervise, troubles);
	int length = 0;

	for (int i = 0; i < count && length < (int)size - 1; i++) {
		if (name[0] != '\0' && strcmp(troubles[i].host, name) != 0)
			continue;
		length += snprintf(ret_text + length, size - (size_t)length,
				   "%shost %s has claimed jobs and cannot be given them: %s", length > 0 ? "; " : "",
				   troubles[i].host, troubles[i].text);
	}
	return length > 0;
}

static void explain_named(struct fleet *fleet, const struct where *where, char *ret_text, size_t size)
{
	char wanted[64], there[64];
	struct fleet_host host;

	wanted_text(where, wanted, sizeof(wanted));
	if (strcmp(where->host, fleet->host) == 0) {
		snprintf(ret_text, size, "this host has not what it wants, %s, and it names no other", wanted);
	} else if (!homes_named(fleet->homes, where->host, &host)) {
		snprintf(ret_text, size, "no host of the fleet has ever been called %s", where->host);
	} else if (host.url[0] == '\0') {
		snprintf(ret_text, size, "host %s takes no jobs: it has no --fleet-address", where->host);
	} else if (host.away) {
		snprintf(ret_text, size, "host %s was last seen %.0f s ago", where->host, host.unseen);
	} else if (!where_fits(where, host.name, host.memory, host.devices)) {
		devices_text(host.memory, host.devices, there, sizeof(there));
		snprintf(ret_text, size, "host %s can never run it as it is: it has %s, and %s are wanted", where->host,
			 there, wanted);
	} else if (!trouble_text(fleet, where->host, ret_text, size)) {
		snprintf(ret_text, size, "host %s has no device free for it yet", where->host);
	}
}

static void explain_any(struct fleet *fleet, const struct where *where, char *ret_text, size_t size)
{
	char wanted[64];
	int takers, fit;

	wanted_text(where, wanted, sizeof(wanted));
	homes_takers(fleet->homes, where, &takers, &fit);
	if (fit == 0)
		snprintf(ret_text, size, "none of the %d hosts that take jobs just now can run it: %s are wanted",
			 takers, wanted);
	else if (!trouble_text(fleet, "", ret_text, size))
		snprintf(ret_text, size, "none of the %d hosts that may run it has a device free for it yet", fit);
}

void fleet_explain(void *context, const struct where *where, bool elsewhere, char *ret_text, size_t size)
{
	struct fleet *fleet = context;

	ret_text[0] = '\0';
	if (!elsewhere)
		trouble_text(fleet, "", ret_text, size);
	else if (!atomic_load(&fleet->is_joined))
		snprintf(ret_text, size, "no device here may run it, and the fleet cannot be reached");
	else if (where->host[0] != '\0')
		explain_named(fleet, where, ret_text, size);
	else
		explain_any(fleet, where, ret_text, size);
}

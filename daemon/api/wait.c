/* Requests that wait until something changes: api/internal.h. */
#include <stdlib.h>

#include "daemon/api/internal.h"

struct waiter {
	void *subject;
	const struct wait_kind *kind;
	struct watch watch;
	double until; /* clock_monotonic */
};

static void wake_request(void *context)
{
	request_wake(context);
}

static void waiter_free(void *state)
{
	struct waiter *waiter = state;

	waiter->kind->leave(waiter->subject, &waiter->watch);
	free(waiter);
}

int wait_read(struct api *api, struct request *request, double initial, double *ret_seconds, struct error *err)
{
	const char *wait = request_query(request, "wait");
	double seconds = initial;

	if (wait == NULL)
		prefer_wait(request_header(request, "Prefer"), &seconds);
	else if (!number_parse(wait, 0, 1e9, &seconds))
		return error_set(err, ERR_INVALID, "wait is \"%.40s\", expected a number of seconds from 0 on", wait);
	*ret_seconds = seconds < api->max_wait ? seconds : api->max_wait;
	return 0;
}

int wait_begin(struct request *request, const struct wait_kind *kind, void *subject, double seconds, struct error *err)
{
	struct waiter *waiter = calloc(1, sizeof(*waiter));

	if (waiter == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to wait");
	waiter->subject = subject;
	waiter->kind = kind;
	waiter->until = clock_monotonic() + seconds;
	waiter->watch = (struct watch){.wake = wake_request, .context = request};
	kind->watch(subject, &waiter->watch);
	request_set_state(request, waiter, waiter_free);
	return 0;
}

void *wait_subject(struct request *request)
{
	const struct waiter *waiter = request_state(request);

	return waiter != NULL ? waiter->subject : NULL;
}

bool wait_goes_on(struct request *request)
{
	const struct waiter *waiter = request_state(request);

	if (clock_monotonic() >= waiter->until || request_stopping(request))
		return false;
	request_wait_until(request, waiter->until);
	return true;
}

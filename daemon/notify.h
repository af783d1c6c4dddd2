#ifndef CBCT_DAEMON_NOTIFY_H
#define CBCT_DAEMON_NOTIFY_H

#include <stddef.h>

#include "core/error.h"

/*
 * What a service manager is told, as systemd has it (sd_notify(3), sd_watchdog_enabled(3)): one datagram of lines
 * NAME=VALUE for each message, to the socket that $NOTIFY_SOCKET names. Without one nobody is told.
 */

/* Reads what the environment says of the service manager, and takes it out: workers are not the service. Once, first.
 */
void notify_open(void);
/* Lines without a newline behind the last: "READY=1\nSTATUS=...". Any thread after notify_open. */
void notify_send(const char *format, ...) __attribute__((format(printf, 1, 2)));

/*
 * Feeds the manager's watchdog from a thread of its own, three times in the time that it has, as long as each check
 * says within that third that its part of the daemon is alive. A part that is not leaves the watchdog hungry, is told
 * in the log, and ends with the daemon when the manager's patience does.
 */
struct feeder;

struct feeder_check {
	const char *part; /* "the catalogue"; NULL ends a list */
	/* Within `seconds` or so; an error says what is wrong. In the feeder's thread. */
	int (*check)(void *context, double seconds, struct error *err);
};
struct feeder_options {
	const struct feeder_check *checks;
	void *context;
	/* One line for STATUS=, without a newline. */
	void (*status)(void *context, char *ret_text, size_t size);
};

/* *ret_feeder stays NULL where no watchdog is asked for. The options are copied, what they point to is not. */
int feeder_start(const struct feeder_options *options, struct feeder **ret_feeder, struct error *err);
/* Waits for a check that is under way. NULL is fine. */
void feeder_stop(struct feeder *feeder);

#endif

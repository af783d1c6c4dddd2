/* The service manager's socket and its watchdog: notify.h. */
#include "daemon/notify.h"

#include <errno.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/clock.h"

static struct sockaddr_un manager; /* constant after notify_open, as are the next two */
static socklen_t manager_size;     /* 0: there is none */
static double patience;            /* s of the manager's watchdog; 0: it has none */

static void take_socket(const char *path)
{
	size_t length = strlen(path);

	/* '@' stands for the zero byte that begins an abstract name. */
	if ((path[0] != '/' && path[0] != '@') || length >= sizeof(manager.sun_path))
		return;
	manager.sun_family = AF_UNIX;
	memcpy(manager.sun_path, path, length);
	if (path[0] == '@')
		manager.sun_path[0] = '\0';
	manager_size = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + length);
}

void notify_open(void)
{
	const char *path = getenv("NOTIFY_SOCKET"), *time = getenv("WATCHDOG_USEC"), *pid = getenv("WATCHDOG_PID");

	if (path != NULL)
		take_socket(path);
	if (time != NULL && (pid == NULL || strtol(pid, NULL, 10) == (long)getpid()))
		patience = 1e-6 * (double)strtoull(time, NULL, 10);
	unsetenv("NOTIFY_SOCKET");
	unsetenv("WATCHDOG_USEC");
	unsetenv("WATCHDOG_PID");
}

void notify_send(const char *format, ...)
{
	char text[512];
	va_list args;
	int length, file;

	if (manager_size == 0)
		return;
	va_start(args, format);
	length = vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	file = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
	if (file < 0 || length < 0 || (size_t)length >= sizeof(text) ||
	    sendto(file, text, (size_t)length, MSG_NOSIGNAL, (const struct sockaddr *)&manager, manager_size) < 0)
		log_line(LEVEL_WARNING, "the service manager cannot be told: %s", strerror(errno));
	if (file >= 0)
		close(file);
}

/* ---- the watchdog ---- */

struct feeder {
	struct feeder_options options; /* constant */
	pthread_t thread;
	pthread_mutex_t lock; /* guards stop */
	pthread_cond_t changed;
	bool stop;
	bool hungry; /* the thread's own: that it is not fed was logged */
};

static bool all_alive(struct feeder *feeder, double seconds)
{
	struct error err;

	for (const struct feeder_check *check = feeder->options.checks; check->part != NULL; check++) {
		if (check->check(feeder->options.context, seconds, &err) == 0)
			continue;
		if (!feeder->hungry)
			log_line(LEVEL_ERROR, "the watchdog is not fed: %s: %s", check->part, err.text);
		feeder->hungry = true;
		notify_send("STATUS=%s: %.200s", check->part, err.text);
		return false;
	}
	if (feeder->hungry)
		log_line(LEVEL_INFO, "the watchdog is fed again");
	feeder->hungry = false;
	return true;
}

static void *feeder_loop(void *context)
{
	struct feeder *feeder = context;
	const double interval = patience / 3;
	bool stop = false;
	char status[256];

	while (!stop) {
		double next = clock_monotonic() + interval;
		const struct timespec until = {(time_t)next, (long)(1e9 * (next - (double)(time_t)next))};

		if (all_alive(feeder, interval)) {
			feeder->options.status(feeder->options.context, status, sizeof(status));
			notify_send("WATCHDOG=1\nSTATUS=%s", status);
		}
		pthread_mutex_lock(&feeder->lock);
		while (!feeder->stop && clock_monotonic() < next)
			pthread_cond_timedwait(&feeder->changed, &feeder->lock, &until);
		stop = feeder->stop;
		pthread_mutex_unlock(&feeder->lock);
	}
	return NULL;
}

int feeder_start(const struct feeder_options *options, struct feeder **ret_feeder, struct error *err)
{
	struct feeder *feeder;
	pthread_condattr_t monotonic;
	int code;

	if (patience <= 0 || manager_size == 0)
		return 0;
	feeder = calloc(1, sizeof(*feeder));
	if (feeder == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the watchdog");
	feeder->options = *options;
	lock_init(&feeder->lock, LOCK_FEEDER);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&feeder->changed, &monotonic);
	pthread_condattr_destroy(&monotonic);
	code = pthread_create(&feeder->thread, NULL, feeder_loop, feeder);
	if (code != 0) {
		pthread_cond_destroy(&feeder->changed);
		pthread_mutex_destroy(&feeder->lock);
		free(feeder);
		return error_set_errno(err, code, "thread for the watchdog");
	}
	*ret_feeder = feeder;
	return 0;
}

void feeder_stop(struct feeder *feeder)
{
	if (feeder == NULL)
		return;
	pthread_mutex_lock(&feeder->lock);
	feeder->stop = true;
	pthread_cond_signal(&feeder->changed);
	pthread_mutex_unlock(&feeder->lock);
	pthread_join(feeder->thread, NULL);
	pthread_cond_destroy(&feeder->changed);
	pthread_mutex_destroy(&feeder->lock);
	free(feeder);
}

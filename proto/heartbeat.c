/* A worker's signs of life: heartbeat.h. */
#include "proto/heartbeat.h"

#include <errno.h>
#include <pthread.h>
#include <signal.h>
#include <stdbool.h>
#include <stdlib.h>
#include <time.h>

#include "core/pulse.h"
#include "proto/message.h"

struct heartbeat {
	int socket;
	pthread_t thread;
	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	double seconds;
	bool stop;
};

/* Sleeps until the next beat is due; false when there is to be none. */
static bool wait_for_beat(struct heartbeat *heartbeat, double *ret_seconds)
{
	struct timespec until;
	bool stop;
	int result = 0;

	clock_gettime(CLOCK_MONOTONIC, &until);
	until.tv_sec += (time_t)HEARTBEAT;
	pthread_mutex_lock(&heartbeat->lock);
	while (!heartbeat->stop && result == 0)
		result = pthread_cond_timedwait(&heartbeat->changed, &heartbeat->lock, &until);
	stop = heartbeat->stop;
	*ret_seconds = heartbeat->seconds;
	pthread_mutex_unlock(&heartbeat->lock);
	return !stop;
}

static void *beat(void *context)
{
	struct heartbeat *heartbeat = context;
	double seconds;

	while (wait_for_beat(heartbeat, &seconds)) {
		struct message message = {.kind = MESSAGE_ALIVE, .steps = pulse_count(), .step_seconds = seconds};
		struct error err;

		/* A daemon that is gone is the main thread's to notice; for want of memory one beat is left out. */
		message_send(heartbeat->socket, &message, &err);
	}
	return NULL;
}

/* Signals are the main thread's. */
static int start_thread(struct heartbeat *heartbeat)
{
	sigset_t all, before;
	int result;

	sigfillset(&all);
	pthread_sigmask(SIG_SETMASK, &all, &before);
	result = pthread_create(&heartbeat->thread, NULL, beat, heartbeat);
	pthread_sigmask(SIG_SETMASK, &before, NULL);
	return result;
}

int heartbeat_start(int socket, struct heartbeat **ret_heartbeat, struct error *err)
{
	struct heartbeat *heartbeat = calloc(1, sizeof(*heartbeat));
	pthread_condattr_t clock;
	int result;

	if (heartbeat == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a heartbeat");
	heartbeat->socket = socket;
	pthread_mutex_init(&heartbeat->lock, NULL);
	pthread_condattr_init(&clock);
	pthread_condattr_setclock(&clock, CLOCK_MONOTONIC);
	pthread_cond_init(&heartbeat->changed, &clock);
	pthread_condattr_destroy(&clock);
	result = start_thread(heartbeat);
	if (result == 0) {
		*ret_heartbeat = heartbeat;
		return 0;
	}
	pthread_cond_destroy(&heartbeat->changed);
	pthread_mutex_destroy(&heartbeat->lock);
	free(heartbeat);
	return error_set_errno(err, result, "thread for a heartbeat");
}

void heartbeat_stop(struct heartbeat *heartbeat)
{
	if (heartbeat == NULL)
		return;
	pthread_mutex_lock(&heartbeat->lock);
	heartbeat->stop = true;
	pthread_cond_signal(&heartbeat->changed);
	pthread_mutex_unlock(&heartbeat->lock);
	pthread_join(heartbeat->thread, NULL);
	pthread_cond_destroy(&heartbeat->changed);
	pthread_mutex_destroy(&heartbeat->lock);
	free(heartbeat);
}

void heartbeat_step(struct heartbeat *heartbeat, double seconds)
{
	pulse_beat();
	pthread_mutex_lock(&heartbeat->lock);
	heartbeat->seconds = seconds;
	pthread_mutex_unlock(&heartbeat->lock);
}

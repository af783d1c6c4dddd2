/* The thread that reads NVIDIA's management library: cards.h. */
#include "daemon/cards.h"

#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "daemon/lock.h"
#include "proto/clock.h"

static const double INTERVAL = 5; /* s between two readings */
static const double OLD = 15;     /* s after which a reading says nothing of now */
static const double STOP = 2;     /* s that the thread has to end */

struct cards {
	pthread_t thread;
	struct nvml *nvml; /* the thread's own; NULL while the driver does not answer */

	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	bool runs, stop;
	struct nvml_card cards[CARDS_MAX];
	int count;
	double read_at; /* monotonic */
};

/* ERR_NOT_FOUND: there is no library, and will be none. */
static int read_all(struct cards *cards)
{
	struct nvml_card fresh[CARDS_MAX];
	struct error err;
	int count;

	if (cards->nvml == NULL && nvml_open(&cards->nvml, &err) != 0)
		return err.code;
	count = nvml_count(cards->nvml);
	count = count < CARDS_MAX ? count : CARDS_MAX;
	for (int i = 0; i < count; i++)
		nvml_read(cards->nvml, i, &fresh[i]);
	pthread_mutex_lock(&cards->lock);
	for (int i = 0; i < count; i++) {
		/* A card that is lost keeps its name. */
		if (!fresh[i].answers && i < cards->count) {
			memcpy(fresh[i].name, cards->cards[i].name, sizeof(fresh[i].name));
			memcpy(fresh[i].uuid, cards->cards[i].uuid, sizeof(fresh[i].uuid));
		}
		cards->cards[i] = fresh[i];
	}
	/* Fewer than before: those that are missing do not answer, and stay to be seen. */
	for (int i = count; i < cards->count; i++)
		cards->cards[i].answers = false;
	cards->count = count > cards->count ? count : cards->count;
	cards->read_at = clock_monotonic();
	pthread_mutex_unlock(&cards->lock);
	return 0;
}

static void *cards_loop(void *context)
{
	struct cards *cards = context;
	struct timespec until;
	double next;
	bool stop = false;

	while (!stop) {
		if (read_all(cards) == ERR_NOT_FOUND)
			break;
		next = clock_monotonic() + INTERVAL;
		until = (struct timespec){(time_t)next, (long)(1e9 * (next - (double)(time_t)next))};
		pthread_mutex_lock(&cards->lock);
		while (!cards->stop && clock_monotonic() < next)
			pthread_cond_timedwait(&cards->changed, &cards->lock, &until);
		stop = cards->stop;
		pthread_mutex_unlock(&cards->lock);
	}
	nvml_close(cards->nvml);
	pthread_mutex_lock(&cards->lock);
	cards->runs = false;
	pthread_cond_signal(&cards->changed);
	pthread_mutex_unlock(&cards->lock);
	return NULL;
}

int cards_start(struct cards **ret_cards, struct error *err)
{
	struct cards *cards = calloc(1, sizeof(*cards));
	pthread_condattr_t monotonic;
	int code;

	if (cards == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the cards");
	lock_init(&cards->lock, LOCK_CARDS);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&cards->changed, &monotonic);
	pthread_condattr_destroy(&monotonic);
	cards->runs = true;
	code = pthread_create(&cards->thread, NULL, cards_loop, cards);
	if (code != 0) {
		pthread_cond_destroy(&cards->changed);
		pthread_mutex_destroy(&cards->lock);
		free(cards);
		return error_set_errno(err, code, "thread for the readings of cards");
	}
	*ret_cards = cards;
	return 0;
}

void cards_stop(struct cards *cards)
{
	bool runs;
	double end = clock_monotonic() + STOP;
	struct timespec until = {(time_t)end, (long)(1e9 * (end - (double)(time_t)end))};

	if (cards == NULL)
		return;
	pthread_mutex_lock(&cards->lock);
	cards->stop = true;
	pthread_cond_signal(&cards->changed);
	while (cards->runs && clock_monotonic() < end)
		pthread_cond_timedwait(&cards->changed, &cards->lock, &until);
	runs = cards->runs;
	pthread_mutex_unlock(&cards->lock);
	if (runs) { /* in a driver that hangs: the process ends without it */
		pthread_detach(cards->thread);
		return;
	}
	pthread_join(cards->thread, NULL);
	pthread_cond_destroy(&cards->changed);
	pthread_mutex_destroy(&cards->lock);
	free(cards);
}

int cards_read(struct cards *cards, struct nvml_card ret_cards[CARDS_MAX])
{
	bool old;
	int count;

	pthread_mutex_lock(&cards->lock);
	count = cards->count;
	memcpy(ret_cards, cards->cards, (size_t)count * sizeof(*ret_cards));
	old = clock_monotonic() - cards->read_at > OLD;
	pthread_mutex_unlock(&cards->lock);
	for (int i = 0; i < count && old; i++)
		ret_cards[i].answers = false;
	return count;
}

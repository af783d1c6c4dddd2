/* Threads that wait for work on their cards: crew.h. */
#include "core/cards/crew.h"

#include <pthread.h>
#include <stdbool.h>
#include <stdlib.h>

#include "core/cards/cards.h"

struct member {
	struct crew *crew;
	int card;
	pthread_t thread;
	int code; /* with the next: of its last work */
	struct error err;
};

struct crew {
	int cards, started;
	struct member member[CARDS_MOST];
	pthread_mutex_t lock; /* guards what follows, and the members' code and err while they work */
	pthread_cond_t begin, end;
	unsigned long round; /* counts the works */
	int busy;            /* members that have not done this one */
	int failed;          /* crew_failed; the caller's thread alone */
	bool stop;
	crew_work *work;
	void *context;
};

static void *member_loop(void *context)
{
	struct member *member = context;
	struct crew *crew = member->crew;
	unsigned long done = 0;

	pthread_mutex_lock(&crew->lock);
	for (;;) {
		crew_work *work;
		void *of;

		while (!crew->stop && crew->round == done)
			pthread_cond_wait(&crew->begin, &crew->lock);
		if (crew->stop)
			break;
		done = crew->round;
		work = crew->work;
		of = crew->context;
		pthread_mutex_unlock(&crew->lock);
		member->code = work(of, member->card, &member->err);
		pthread_mutex_lock(&crew->lock);
		if (--crew->busy == 0)
			pthread_cond_signal(&crew->end);
	}
	pthread_mutex_unlock(&crew->lock);
	return NULL;
}

int crew_new(int cards, struct crew **ret_crew, struct error *err)
{
	struct crew *crew = calloc(1, sizeof(*crew));
	int code = 0;

	if (crew == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the threads of %d cards", cards);
	crew->cards = cards;
	crew->failed = -1;
	pthread_mutex_init(&crew->lock, NULL);
	pthread_cond_init(&crew->begin, NULL);
	pthread_cond_init(&crew->end, NULL);
	for (crew->started = 1; crew->started < cards && code == 0; crew->started += code == 0) {
		struct member *member = &crew->member[crew->started];

		member->crew = crew;
		member->card = crew->started;
		code = pthread_create(&member->thread, NULL, member_loop, member);
	}
	if (code != 0) {
		crew_free(crew);
		return error_set_errno(err, code, "thread for a card");
	}
	*ret_crew = crew;
	return 0;
}

void crew_free(struct crew *crew)
{
	if (crew == NULL)
		return;
	pthread_mutex_lock(&crew->lock);
	crew->stop = true;
	pthread_cond_broadcast(&crew->begin);
	pthread_mutex_unlock(&crew->lock);
	for (int i = 1; i < crew->started; i++)
		pthread_join(crew->member[i].thread, NULL);
	pthread_cond_destroy(&crew->begin);
	pthread_cond_destroy(&crew->end);
	pthread_mutex_destroy(&crew->lock);
	free(crew);
}

int crew_run(struct crew *crew, crew_work *work, void *context, struct error *err)
{
	pthread_mutex_lock(&crew->lock);
	crew->work = work;
	crew->context = context;
	crew->busy = crew->cards - 1;
	crew->round++;
	pthread_cond_broadcast(&crew->begin);
	pthread_mutex_unlock(&crew->lock);
	crew->member[0].code = work(context, 0, &crew->member[0].err);
	pthread_mutex_lock(&crew->lock);
	while (crew->busy > 0)
		pthread_cond_wait(&crew->end, &crew->lock);
	pthread_mutex_unlock(&crew->lock);
	for (int i = 0; i < crew->cards; i++) {
		if (crew->member[i].code < 0) {
			*err = crew->member[i].err;
			if (err->code == ERR_DEVICE && crew->failed < 0)
				crew->failed = i;
			return err->code;
		}
	}
	return 0;
}

int crew_failed(const struct crew *crew)
{
	return crew->failed;
}

/*
 * Pictures are drawn by painters, threads of their own, so that those that answer HTTP never are behind a drawing.
 * There is one painter more than processors, and one client has at most all but one of them: another one's picture
 * begins at once. Who has fewest pictures under way is next, then who came first.
 *
 * A request waits suspended. One whose client has gone is not drawn, or no further: painters look at the socket before
 * they begin and amid a drawing, and what waits is looked at when no more may wait.
 */
#include <pthread.h>
#include <sched.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "daemon/lock.h"

enum {
	PAINTERS_MAX = 9, /* more would wait for the disk that volumes are read from */
	WAITING_MAX = 256,
	WAITING_CLIENT_MAX = WAITING_MAX / 2
};

const char *const picture_end_names[PICTURE_END_COUNT] = {"drawn", "failed", "refused", "gone"};

struct picture {
	struct picture *next; /* of those that wait, the one that came after it */

	/* Constant. */
	struct pictures *owner;
	const struct picture_kind *kind;
	void *subject;
	char client[CLIENT_SIZE];
	double until; /* it waits for its turn */

	/* Guarded by the owner's lock. */
	struct request *request; /* NULL once it is over */
	enum { WAITING, DRAWING, ENDED } state;
	char *png; /* of what has ended; the next two are then its handler's own */
	size_t length;
	struct error error; /* code 0: it was drawn */
};

struct pictures {
	pthread_t painters[PAINTERS_MAX];
	int started;     /* painters; main's own */
	int places;      /* of painters that there are to be; constant, as the next */
	double patience; /* s */

	pthread_mutex_t lock; /* guards what follows; request_wake is called under it */
	pthread_cond_t due;
	struct picture *first;                 /* of those that wait */
	struct picture *drawing[PAINTERS_MAX]; /* by the painter's number; NULL: it has none */
	int numbered;                          /* painters that have their number */
	bool closing;
	struct pictures_statistics statistics;
};

static void picture_free(struct picture *picture)
{
	if (picture->kind->free != NULL)
		picture->kind->free(picture->subject);
	free(picture->subject);
	free(picture->png);
	free(picture);
}

/* ---- those that wait; the lock is held ---- */

static void leave(struct pictures *pictures, struct picture *picture)
{
	struct picture **at = &pictures->first;

	while (*at != picture)
		at = &(*at)->next;
	*at = picture->next;
	pictures->statistics.waiting--;
}

static void end(struct picture *picture, enum picture_end how)
{
	picture->state = ENDED;
	picture->owner->statistics.ended[how]++;
}

static void end_gone(struct picture *picture)
{
	error_set(&picture->error, ERR_CANCELLED, "the client has closed its side before the picture was drawn");
	end(picture, PICTURE_GONE);
}

static void drop_gone(struct pictures *pictures)
{
	struct picture *next;

	for (struct picture *picture = pictures->first; picture != NULL; picture = next) {
		next = picture->next;
		if (!request_peer_gone(picture->request))
			continue;
		leave(pictures, picture);
		end_gone(picture);
		request_wake(picture->request);
	}
}

static int drawn_for(const struct pictures *pictures, const char *client)
{
	int count = 0;

	for (int i = 0; i < pictures->places; i++)
		count += pictures->drawing[i] != NULL && strcmp(pictures->drawing[i]->client, client) == 0;
	return count;
}

/* The one that is next, taken out; NULL: none may begin. */
static struct picture *take_next(struct pictures *pictures)
{
	for (;;) {
		struct picture *best = NULL;
		int least = pictures->places - 1; /* who has as many waits for one of them */

		for (struct picture *picture = pictures->first; picture != NULL && least > 0; picture = picture->next) {
			int count = drawn_for(pictures, picture->client);

			if (count >= least)
				continue;
			least = count;
			best = picture;
		}
		if (best == NULL)
			return NULL;
		leave(pictures, best);
		if (!request_peer_gone(best->request))
			return best;
		end_gone(best);
		request_wake(best->request);
	}
}

static int waiting_for(const struct pictures *pictures, const char *client)
{
	int count = 0;

	for (const struct picture *picture = pictures->first; picture != NULL; picture = picture->next)
		count += strcmp(picture->client, client) == 0;
	return count;
}

static int check_room(struct pictures *pictures, const char *client, struct error *err)
{
	if (pictures->statistics.waiting >= WAITING_MAX || waiting_for(pictures, client) >= WAITING_CLIENT_MAX)
		drop_gone(pictures);
	if (pictures->statistics.waiting >= WAITING_MAX)
		return error_set(err, ERR_BUSY, "%d pictures wait to be drawn, which is the limit", WAITING_MAX);
	if (waiting_for(pictures, client) >= WAITING_CLIENT_MAX)
		return error_set(err, ERR_BUSY, "%d pictures of this client wait to be drawn, which is the limit",
				 WAITING_CLIENT_MAX);
	return 0;
}

/* ---- painters ---- */

bool picture_wanted(void *context)
{
	struct picture *picture = context;
	struct pictures *pictures = picture->owner;
	bool wanted;

	pthread_mutex_lock(&pictures->lock);
	wanted = !pictures->closing && picture->request != NULL && !request_peer_gone(picture->request);
	pthread_mutex_unlock(&pictures->lock);
	return wanted;
}

/* Called and returns with the lock held, which it lets go of while it draws. */
static void paint(struct pictures *pictures, int painter, struct picture *picture)
{
	struct error err = {0};
	char *png = NULL;
	size_t length = 0;
	int code;

	picture->state = DRAWING;
	pictures->drawing[painter] = picture;
	pictures->statistics.drawing++;
	pthread_mutex_unlock(&pictures->lock);
	code = picture->kind->draw(picture->subject, picture, &png, &length, &err);
	pthread_mutex_lock(&pictures->lock);
	pictures->statistics.drawing--;
	pictures->drawing[painter] = NULL;
	picture->png = png;
	picture->length = length;
	picture->error = err;
	if (code == ERR_CANCELLED)
		end_gone(picture);
	else
		end(picture, code == 0 ? PICTURE_DRAWN : PICTURE_FAILED);
	if (picture->request != NULL) {
		request_wake(picture->request);
		return;
	}
	pthread_mutex_unlock(&pictures->lock);
	picture_free(picture);
	pthread_mutex_lock(&pictures->lock);
}

static void *run_painter(void *context)
{
	struct pictures *pictures = context;
	int painter;

	pthread_mutex_lock(&pictures->lock);
	painter = pictures->numbered++;
	while (!pictures->closing) {
		struct picture *picture = take_next(pictures);

		if (picture != NULL)
			paint(pictures, painter, picture);
		else
			pthread_cond_wait(&pictures->due, &pictures->lock);
	}
	pthread_mutex_unlock(&pictures->lock);
	return NULL;
}

/* ---- what main calls ---- */

/* Those of the process's affinity mask. */
static int processors(void)
{
	cpu_set_t set;

	return sched_getaffinity(0, sizeof(set), &set) == 0 ? CPU_COUNT(&set) : PAINTERS_MAX;
}

int pictures_start(double patience, struct pictures **ret_pictures, struct error *err)
{
	const int most = PAINTERS_MAX - 1, wanted = processors();
	struct pictures *pictures = calloc(1, sizeof(*pictures));
	int code = 0;

	if (pictures == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for pictures");
	lock_init(&pictures->lock, LOCK_PICTURES);
	pthread_cond_init(&pictures->due, NULL);
	pictures->patience = patience;
	pictures->places = 1 + (wanted < most ? wanted : most);
	while (code == 0 && pictures->started < pictures->places) {
		code = pthread_create(&pictures->painters[pictures->started], NULL, run_painter, pictures);
		pictures->started += code == 0;
	}
	if (code != 0) {
		pictures_stop(pictures);
		return error_set_errno(err, code, "thread for pictures");
	}
	*ret_pictures = pictures;
	return 0;
}

void pictures_stop(struct pictures *pictures)
{
	if (pictures == NULL)
		return;
	pthread_mutex_lock(&pictures->lock);
	pictures->closing = true;
	pthread_cond_broadcast(&pictures->due);
	pthread_mutex_unlock(&pictures->lock);
	for (int i = 0; i < pictures->started; i++)
		pthread_join(pictures->painters[i], NULL);
	pthread_cond_destroy(&pictures->due);
	pthread_mutex_destroy(&pictures->lock);
	free(pictures);
}

void pictures_statistics(struct pictures *pictures, struct pictures_statistics *ret)
{
	pthread_mutex_lock(&pictures->lock);
	*ret = pictures->statistics;
	pthread_mutex_unlock(&pictures->lock);
}

/* ---- what handlers call ---- */

/* The request is over. */
static void leave_request(void *state)
{
	struct picture *picture = state;
	struct pictures *pictures = picture->owner;
	bool drawing;

	pthread_mutex_lock(&pictures->lock);
	picture->request = NULL;
	drawing = picture->state == DRAWING; /* its painter frees it */
	if (picture->state == WAITING) {
		leave(pictures, picture);
		end_gone(picture);
	}
	pthread_mutex_unlock(&pictures->lock);
	if (!drawing)
		picture_free(picture);
}

/* Takes the subject. */
static struct picture *picture_new(struct pictures *pictures, struct request *request, const struct picture_kind *kind,
				   void *subject)
{
	struct picture *picture = subject != NULL ? calloc(1, sizeof(*picture)) : NULL;

	if (picture == NULL) {
		if (subject != NULL && kind->free != NULL)
			kind->free(subject);
		free(subject);
		return NULL;
	}
	*picture = (struct picture){.owner = pictures,
				    .kind = kind,
				    .subject = subject,
				    .until = clock_monotonic() + pictures->patience,
				    .request = request};
	request_client(request, picture->client);
	return picture;
}

static int enqueue(struct pictures *pictures, struct picture *picture, struct error *err)
{
	struct picture **at = &pictures->first;
	int code;

	pthread_mutex_lock(&pictures->lock);
	code = check_room(pictures, picture->client, err);
	if (code == 0) {
		while (*at != NULL)
			at = &(*at)->next;
		*at = picture;
		pictures->statistics.waiting++;
		pthread_cond_signal(&pictures->due);
	} else {
		end(picture, PICTURE_REFUSED);
	}
	pthread_mutex_unlock(&pictures->lock);
	return code;
}

int picture_begin(struct api *api, struct request *request, const struct picture_kind *kind, void *subject,
		  struct error *err)
{
	struct picture *picture = picture_new(api->pictures, request, kind, subject);

	if (picture == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture");
	request_set_state(request, picture, leave_request);
	request_wait_until(request, picture->until);
	return enqueue(api->pictures, picture, err) == 0 ? HTTP_WAIT : err->code;
}

/* True: the picture has ended, one way or another. */
static bool has_ended(struct picture *picture, struct request *request)
{
	struct pictures *pictures = picture->owner;
	bool ended;

	pthread_mutex_lock(&pictures->lock);
	if (picture->state == WAITING && (clock_monotonic() >= picture->until || request_stopping(request))) {
		leave(pictures, picture);
		if (request_stopping(request))
			error_set(&picture->error, ERR_BUSY, "the daemon ends, and draws nothing more");
		else
			error_set(&picture->error, ERR_BUSY, "%d other pictures are being drawn or wait for it",
				  pictures->statistics.waiting + pictures->statistics.drawing);
		end(picture, PICTURE_REFUSED);
	}
	ended = picture->state == ENDED;
	if (picture->state == WAITING)
		request_wait_until(request, picture->until);
	pthread_mutex_unlock(&pictures->lock);
	return ended;
}

int picture_go_on(struct request *request, struct error *err)
{
	struct picture *picture = request_state(request);
	char *png;

	if (!has_ended(picture, request))
		return HTTP_WAIT;
	if (picture->error.code != 0) {
		*err = picture->error;
		return err->code;
	}
	png = picture->png;
	picture->png = NULL;
	if (request_reply_bytes(request, 200, png, picture->length, err) != 0)
		return err->code;
	picture->kind->headers(picture->subject, request);
	return 0;
}

/* Pixels that do not follow their neighbours over the views: see stuck.h. */
#include "core/correct/stuck.h"

#include <math.h>
#ifdef _OPENMP
#include <omp.h>
#endif
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum {
	ACROSS = 10,
	LOST_ACROSS = 5,
	BESIDE = 3
}; /* pixels of a row: how far one is looked beside, and those that must be well there */
enum { NEIGHBOURS = 8, AWAY = 2, BESIDE_LEAST = 4 }; /* good pixels right beside one that is taken for alone */

static const float MATTERS = 0.03f, APART = 0.1f; /* of the photons, or of the largest line integral below 1 */
static const float BEYOND = 0.1f;                 /* of the root mean square of e */
static const float TIP = 0.1f;                    /* of the mean of e */
static const float STILL = 0.1f, LARGER = 3, WILDER = 9, FARTHER = 3, STEADY = 4, IN_FEW_VIEWS = 0.25f;
static const float CHANGES = 0.05f;              /* of its mean: few counts are alike in all views by rounding */
static const float LOST = 0.35f, LOST_LEAST = 8; /* of the views looked at: share, and number */
static const double MOST = 0.1;                  /* of all pixels */
static const double AXIS_PIXELS = 4;             /* between a ray and the axis */

/*
 * Over the views looked at, [row][column] each, so that many pixels are added at once; p counts from the first view
 * that a pixel is good in, so that rounding leaves no variance.
 */
struct sums {
	float *views; /* those that the pixel is good in */
	float *first, *p, *p2;
	float *e, *e2, *magnitude; /* of e */
	float *beyond2;            /* squares of what p lies beyond all of its neighbours by */
	float *all;                /* the memory of these */
};
enum { SUMS = 8 };

struct stuck {
	const struct linearise *linearise;
	const struct geometry *geometry;
	int views;
	struct sums sums;
	float *values;  /* [row][column], line integrals of a view */
	float *medians; /* [row][column], of each pixel's neighbours in the view */
	float *beyond;  /* [row][column], what the pixel lies beyond all of them by, 0 within their range */
	float *good;    /* [row][column], of the view: 1; 0 where the pixel says nothing */
	bool *some_bad; /* [row], of the view */
	unsigned char *map;
	float largest;         /* line integral */
	bool tells_dead;       /* a pixel that never changes is none of the object's */
	struct beside *beside; /* NULL: the caller's thread does it all */
};

/* The thread that looks at views, and the one view that waits for it or is looked at. */
struct beside {
	pthread_t thread;
	pthread_mutex_t lock;
	pthread_cond_t changed;
	int host_threads; /* those of the caller */
	size_t bytes;     /* of a view */
	void *samples;
	bool waits, ended;
};

static void add_view(struct stuck *stuck, const void *samples);

static void *look_beside(void *argument)
{
	struct stuck *stuck = argument;
	struct beside *beside = stuck->beside;

	backend_host_threads(beside->host_threads);
	pthread_mutex_lock(&beside->lock);
	while (!beside->ended || beside->waits) {
		if (!beside->waits) {
			pthread_cond_wait(&beside->changed, &beside->lock);
			continue;
		}
		pthread_mutex_unlock(&beside->lock);
		add_view(stuck, beside->samples);
		pthread_mutex_lock(&beside->lock);
		beside->waits = false;
		pthread_cond_broadcast(&beside->changed);
	}
	pthread_mutex_unlock(&beside->lock);
	return NULL;
}

static int beside_new(struct stuck *stuck, struct error *err)
{
	const struct geometry *geometry = stuck->geometry;
	struct beside *beside = calloc(1, sizeof(*beside));

	if (beside == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a thread that looks for stuck pixels");
	beside->host_threads = 1;
#ifdef _OPENMP
	beside->host_threads = omp_get_max_threads();
#endif
	beside->bytes = (size_t)geometry->columns * (size_t)geometry->rows * linearise_sample_bytes(stuck->linearise);
	beside->samples = malloc(beside->bytes);
	pthread_mutex_init(&beside->lock, NULL);
	pthread_cond_init(&beside->changed, NULL);
	stuck->beside = beside;
	if (beside->samples == NULL || pthread_create(&beside->thread, NULL, look_beside, stuck) != 0) {
		free(beside->samples);
		free(beside);
		stuck->beside = NULL;
		return error_set(err, ERR_NO_MEMORY, "no memory for a thread that looks for stuck pixels");
	}
	return 0;
}

/* Until the view that was added last has been looked at. */
static void beside_wait(struct beside *beside)
{
	while (beside->waits)
		pthread_cond_wait(&beside->changed, &beside->lock);
}

static void beside_add(struct beside *beside, const void *samples)
{
	pthread_mutex_lock(&beside->lock);
	beside_wait(beside);
	memcpy(beside->samples, samples, beside->bytes);
	beside->waits = true;
	pthread_cond_broadcast(&beside->changed);
	pthread_mutex_unlock(&beside->lock);
}

static void beside_free(struct beside *beside)
{
	if (beside == NULL)
		return;
	pthread_mutex_lock(&beside->lock);
	beside->ended = true;
	pthread_cond_broadcast(&beside->changed);
	pthread_mutex_unlock(&beside->lock);
	pthread_join(beside->thread, NULL);
	pthread_cond_destroy(&beside->changed);
	pthread_mutex_destroy(&beside->lock);
	free(beside->samples);
	free(beside);
}

static void sums_new(struct sums *ret, size_t pixels)
{
	float *all = calloc(SUMS * pixels, sizeof(*all));

	if (all == NULL)
		return;
	*ret = (struct sums){.all = all,
			     .views = all,
			     .first = all + pixels,
			     .p = all + 2 * pixels,
			     .p2 = all + 3 * pixels,
			     .e = all + 4 * pixels,
			     .e2 = all + 5 * pixels,
			     .magnitude = all + 6 * pixels,
			     .beyond2 = all + 7 * pixels};
}

int stuck_new(const struct linearise *linearise, const struct geometry *geometry, bool beside, struct stuck **ret_stuck,
	      struct error *err)
{
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	struct stuck *stuck;
	int code;

	*ret_stuck = NULL;
	if (geometry->count < STUCK_VIEWS_LEAST || geometry->columns <= 2 * AWAY || geometry->rows <= 2 * AWAY)
		return 0;
	stuck = calloc(1, sizeof(*stuck));
	if (stuck == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look for stuck pixels");
	stuck->linearise = linearise;
	stuck->geometry = geometry;
	stuck->views = geometry->count < STUCK_VIEWS ? geometry->count : STUCK_VIEWS;
	sums_new(&stuck->sums, pixels);
	stuck->values = malloc(pixels * sizeof(*stuck->values));
	stuck->medians = malloc(pixels * sizeof(*stuck->medians));
	stuck->beyond = malloc(pixels * sizeof(*stuck->beyond));
	stuck->good = malloc(pixels * sizeof(*stuck->good));
	stuck->some_bad = malloc((size_t)geometry->rows * sizeof(*stuck->some_bad));
	stuck->map = calloc(pixels, 1);
	if (stuck->sums.all == NULL || stuck->values == NULL || stuck->medians == NULL || stuck->beyond == NULL ||
	    stuck->good == NULL || stuck->some_bad == NULL || stuck->map == NULL) {
		stuck_free(stuck);
		return error_set(err, ERR_NO_MEMORY, "no memory to look for stuck pixels in %d x %d", geometry->columns,
				 geometry->rows);
	}
	code = beside ? beside_new(stuck, err) : 0;
	if (code < 0) {
		stuck_free(stuck);
		return code;
	}
	*ret_stuck = stuck;
	return 0;
}

void stuck_free(struct stuck *stuck)
{
	if (stuck == NULL)
		return;
	beside_free(stuck->beside);
	free(stuck->sums.all);
	free(stuck->values);
	free(stuck->medians);
	free(stuck->beyond);
	free(stuck->good);
	free(stuck->some_bad);
	free(stuck->map);
	free(stuck);
}

bool stuck_wants(const struct stuck *stuck, int view)
{
	const long long count = stuck->geometry->count, k = (view * (long long)stuck->views + count - 1) / count;

	return k * count / stuck->views == view;
}

/* A row of the view; what says nothing stands in for its neighbours as the last good pixel before it. */
static void read_row(struct stuck *stuck, const void *samples, int row)
{
	const size_t columns = (size_t)stuck->geometry->columns, from = (size_t)row * columns;
	float last = 0, good = 0;

	for (size_t at = from; at < from + columns; at++) {
		stuck->good[at] = linearise_pixel(stuck->linearise, samples, at, &last) == PIXEL_GOOD ? 1 : 0;
		stuck->values[at] = last;
		good += stuck->good[at];
	}
	stuck->some_bad[row] = good < (float)columns;
}

/* Beside an edge of the detector there is no other side: the neighbours lie along the edge and straight inwards. */
static const int AROUND[NEIGHBOURS][2] = {{-1, -1}, {-1, 0}, {-1, 1}, {0, -1}, {0, 1}, {1, -1}, {1, 0}, {1, 1}};
static const int ALONG[NEIGHBOURS][2] = {{0, -3}, {0, -2}, {0, -1}, {0, 1}, {0, 2}, {0, 3}, {1, 0}, {2, 0}};

static int held(int index, int count)
{
	return index < 0 ? 0 : index < count ? index : count - 1;
}

/* 1: a pixel has no neighbours before it in its row or column; -1: none behind it; 0: both. */
static int edge_at(int index, int count)
{
	return index < AWAY ? 1 : index >= count - AWAY ? -1 : 0;
}

static void neighbours_of(const struct geometry *geometry, int column, int row, size_t ret[NEIGHBOURS])
{
	const int inwards[2] = {edge_at(row, geometry->rows), edge_at(column, geometry->columns)};

	for (int i = 0; i < NEIGHBOURS; i++) {
		int r = AROUND[i][0], c = AROUND[i][1];

		if (inwards[0] != 0) {
			r = inwards[0] * ALONG[i][0];
			c = ALONG[i][1];
		} else if (inwards[1] != 0) {
			r = ALONG[i][1];
			c = inwards[1] * ALONG[i][0];
		}
		ret[i] = (size_t)held(row + AWAY * r, geometry->rows) * (size_t)geometry->columns +
			 (size_t)held(column + AWAY * c, geometry->columns);
	}
}

static void sort(float values[NEIGHBOURS], int count)
{
	for (int i = 1; i < count; i++) {
		const float value = values[i];
		int at = i;

		for (; at > 0 && values[at - 1] > value; at--)
			values[at] = values[at - 1];
		values[at] = value;
	}
}

/* 0 from least to most. */
static inline float beyond_range(float p, float least, float most)
{
	const float below = least - p, above = p - most, beyond = below > above ? below : above;

	return beyond > 0 ? beyond : 0;
}

/*
 * Compares a pixel to its good neighbours, to their median and range; to itself where none is good, which is_stuck
 * takes for no stuck one.
 */
static void compare_to_good(const struct stuck *stuck, int column, int row)
{
	const size_t at = (size_t)row * (size_t)stuck->geometry->columns + (size_t)column;
	size_t near[NEIGHBOURS];
	float values[NEIGHBOURS] = {stuck->values[at]};
	int count = 0;

	neighbours_of(stuck->geometry, column, row, near);
	for (int i = 0; i < NEIGHBOURS; i++)
		if (stuck->good[near[i]] != 0)
			values[count++] = stuck->values[near[i]];
	count = count > 0 ? count : 1;
	sort(values, count);
	stuck->medians[at] = 0.5f * (values[(count - 1) / 2] + values[count / 2]);
	stuck->beyond[at] = beyond_range(stuck->values[at], values[0], values[count - 1]);
}

static inline void exchange(float *low, float *high)
{
	const float a = *low, b = *high;

	*low = a < b ? a : b;
	*high = a > b ? a : b;
}

/*
 * Median of eight values, and what p lies beyond all of them by. The exchanges are those of Batcher's merge sort
 * (Batcher 1968) but those that the middle two and the outermost two do not depend on. They are written out, so that
 * the compiler keeps many pixels' values in registers.
 */
static inline float compare_to_eight(float a, float b, float c, float d, float e, float f, float g, float h, float p,
				     float *ret_beyond)
{
	exchange(&a, &b), exchange(&c, &d), exchange(&e, &f), exchange(&g, &h);
	exchange(&a, &c), exchange(&b, &d), exchange(&e, &g), exchange(&f, &h);
	exchange(&b, &c), exchange(&f, &g);
	exchange(&a, &e), exchange(&b, &f), exchange(&c, &g), exchange(&d, &h);
	exchange(&c, &e), exchange(&d, &f);
	exchange(&d, &e);
	*ret_beyond = beyond_range(p, a, h);
	return 0.5f * (d + e);
}

/* Compares a row's pixels that have neighbours on all sides. */
static void compare_inside(const struct stuck *stuck, int row)
{
	const ptrdiff_t columns = stuck->geometry->columns;
	const float *at = stuck->values + row * columns, *before = at - AWAY * columns, *behind = at + AWAY * columns;
	float *medians = stuck->medians + row * columns, *beyond = stuck->beyond + row * columns;

#pragma omp simd
	for (ptrdiff_t c = AWAY; c < columns - AWAY; c++)
		medians[c] = compare_to_eight(before[c - AWAY], before[c], before[c + AWAY], at[c - AWAY], at[c + AWAY],
					      behind[c - AWAY], behind[c], behind[c + AWAY], at[c], &beyond[c]);
}

/* Again, without the neighbours that say nothing, for those pixels of compare_inside that have such. */
static void compare_beside_bad(const struct stuck *stuck, int row)
{
	const int columns = stuck->geometry->columns;
	const float *at = stuck->good + (size_t)row * (size_t)columns;

	if (!stuck->some_bad[row - AWAY] && !stuck->some_bad[row] && !stuck->some_bad[row + AWAY])
		return;
	for (int column = AWAY; column < columns - AWAY; column++) {
		float good = 0;

		for (int i = 0; i < NEIGHBOURS; i++)
			good += at[AWAY * (AROUND[i][0] * columns + AROUND[i][1]) + column];
		if (good < NEIGHBOURS)
			compare_to_good(stuck, column, row);
	}
}

static void compare_row(const struct stuck *stuck, int row)
{
	const int columns = stuck->geometry->columns;
	const bool inside = edge_at(row, stuck->geometry->rows) == 0;

	if (inside) {
		compare_inside(stuck, row);
		compare_beside_bad(stuck, row);
	}
	for (int column = 0; column < columns; column++)
		if (!inside || edge_at(column, columns) != 0)
			compare_to_good(stuck, column, row);
}

/* Without branches, so that the compiler adds several pixels at once. */
static void add_row(struct stuck *stuck, int row)
{
	const int columns = stuck->geometry->columns;
	const size_t from = (size_t)row * (size_t)columns;
	const float *values = stuck->values + from, *medians = stuck->medians + from, *good = stuck->good + from,
		    *beyond = stuck->beyond + from;
	float *views = stuck->sums.views + from, *first = stuck->sums.first + from, *p = stuck->sums.p + from,
	      *p2 = stuck->sums.p2 + from, *e = stuck->sums.e + from, *e2 = stuck->sums.e2 + from,
	      *magnitude = stuck->sums.magnitude + from, *beyond2 = stuck->sums.beyond2 + from;

#pragma omp simd
	for (int c = 0; c < columns; c++) {
		const float apart = good[c] * (values[c] - medians[c]);
		float moved;

		first[c] += views[c] == 0 ? good[c] * values[c] : 0;
		moved = good[c] * (values[c] - first[c]);
		views[c] += good[c];
		p[c] += moved;
		p2[c] += moved * moved;
		e[c] += apart;
		e2[c] += apart * apart;
		magnitude[c] += fabsf(apart);
		beyond2[c] += good[c] * beyond[c] * beyond[c];
	}
}

static void add_view(struct stuck *stuck, const void *samples)
{
	const int rows = stuck->geometry->rows;
	const size_t pixels = (size_t)rows * (size_t)stuck->geometry->columns;
	float largest = stuck->largest;

#pragma omp parallel
	{
#pragma omp for schedule(static)
		for (int row = 0; row < rows; row++)
			read_row(stuck, samples, row);
#pragma omp for schedule(static)
		for (int row = 0; row < rows; row++) {
			compare_row(stuck, row);
			add_row(stuck, row);
		}
	}
	/* The largest of a sample of the pixels: a stuck one may be the largest of all. */
	for (size_t i = 0; i < pixels; i += pixels / 4096 + 1)
		largest = fmaxf(largest, stuck->values[i]);
	stuck->largest = largest;
}

void stuck_add(struct stuck *stuck, const void *samples)
{
	if (stuck->beside != NULL)
		beside_add(stuck->beside, samples);
	else
		add_view(stuck, samples);
}

/* A pixel's behaviour over the views, from its sums. */
struct behaviour {
	float varies;             /* variance of p */
	float rms, mean, wanders; /* of e: root mean square, mean's magnitude, variance */
	float beyond;             /* root mean square of what p lies beyond all neighbours by */
	float spread;             /* mean |e| squared, in units of the mean square: small where few views make it */
};

static struct behaviour behaviour_of(const struct sums *sums, size_t at)
{
	const float n = fmaxf(sums->views[at], 1), mean = sums->p[at] / n, e = sums->e[at] / n, e2 = sums->e2[at];

	return (struct behaviour){
	    .varies = fmaxf(sums->p2[at] / n - mean * mean, 0),
	    .rms = sqrtf(e2 / n),
	    .beyond = sqrtf(sums->beyond2[at] / n),
	    .mean = fabsf(e),
	    .wanders = fmaxf(e2 / n - e * e, 0),
	    .spread = e2 > 0 ? sums->magnitude[at] * sums->magnitude[at] / (n * e2) : 0,
	};
}

/* True if a pixel's ray passes the axis of the rotation, z, within some pixels in any view looked at. */
static bool is_on_axis(const struct stuck *stuck, int column, int row)
{
	const struct geometry *geometry = stuck->geometry;

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12];

		if (!stuck_wants(stuck, k))
			continue;
		view_matrix(&geometry->views[k], matrix);
		if (!(view_axis_distance(matrix, column, row) > AXIS_PIXELS))
			return true;
	}
	return false;
}

/* True if a pixel was good in half of the views at least. */
static bool is_known(const struct stuck *stuck, size_t at)
{
	return 2 * stuck->sums.views[at] >= (float)stuck->views;
}

static float mean_of(const struct sums *sums, size_t at)
{
	return sums->first[at] + sums->p[at] / fmaxf(sums->views[at], 1);
}

/*
 * True if the good pixels right beside a pixel, all but one, are unlike it, and there are enough to tell: in the mean
 * by at least half of what it differs by from m, or where it wanders, by wandering less than a quarter of that.
 */
static bool is_alone(const struct stuck *stuck, int column, int row, bool wanders)
{
	const int columns = stuck->geometry->columns, rows = stuck->geometry->rows;
	const struct sums *sums = &stuck->sums;
	const size_t own = (size_t)row * (size_t)columns + (size_t)column;
	const float e = sums->e[own] / sums->views[own], least = 0.25f * behaviour_of(sums, own).wanders;
	int like = 0, bad = 0;

	for (int i = 0; i < NEIGHBOURS; i++) {
		const int r = row + AROUND[i][0], c = column + AROUND[i][1];
		const size_t other = (size_t)r * (size_t)columns + (size_t)c;
		float apart;

		if (r < 0 || r >= rows || c < 0 || c >= columns)
			continue;
		if (!is_known(stuck, other)) {
			bad++;
			continue;
		}
		apart = mean_of(sums, own) - mean_of(sums, other);
		like += wanders ? behaviour_of(sums, other).wanders > least
				: !(e > 0 ? apart > 0.5f * e : apart < 0.5f * e);
		/* An object's tip lies between what is beside it and the object. */
		if (!wanders && (e > 0 ? apart < -TIP * e : apart > -TIP * e))
			return false;
	}
	/* Something small that turns near the axis stays on two pixels in turn. */
	return like <= (wanders && is_on_axis(stuck, column, row) ? 0 : 1) && bad <= NEIGHBOURS - BESIDE_LEAST;
}

static bool never_changes(const struct stuck *stuck, size_t at)
{
	return is_known(stuck, at) && stuck->sums.p2[at] == 0;
}

/* True if a pixel has one value in all views, and not air's. */
static bool is_dead(const struct stuck *stuck, size_t at, float whole)
{
	return never_changes(stuck, at) && fabsf(stuck->sums.first[at]) > MATTERS * whole;
}

/* False where many pixels never change: in a scan without noise those in air do not, nor what is round. */
static bool tells_dead_pixels(const struct stuck *stuck)
{
	const size_t pixels = (size_t)stuck->geometry->rows * (size_t)stuck->geometry->columns;
	size_t unchanged = 0;

	for (size_t at = 0; at < pixels; at++)
		unchanged += never_changes(stuck, at);
	return (double)unchanged <= MOST * (double)pixels;
}

/* The share of the views in which a pixel says nothing. */
static float lost_share(const struct stuck *stuck, size_t at)
{
	return 1 - stuck->sums.views[at] / (float)stuck->views;
}

/* True if a pixel says nothing in a quarter as many views as another at most. */
static bool is_well(const struct stuck *stuck, size_t at, size_t own, float whole)
{
	(void)whole;
	return lost_share(stuck, at) <= 0.25f * lost_share(stuck, own);
}

/* True if a pixel shows an object in most views, and changes with it. */
static bool shows_change(const struct stuck *stuck, size_t at, size_t own, float whole)
{
	const float mean = mean_of(&stuck->sums, at), varies = behaviour_of(&stuck->sums, at).varies;

	(void)own;
	return is_known(stuck, at) && mean > MATTERS * whole && mean * mean > varies &&
	       varies > MATTERS * MATTERS * whole * whole && varies > CHANGES * CHANGES * mean * mean;
}

/* True if within so many pixels of its row, on both sides of a pixel, there are three beside each other that are so. */
static bool is_between(const struct stuck *stuck, int column, int row, int within, float whole,
		       bool (*is_so)(const struct stuck *stuck, size_t at, size_t own, float whole))
{
	const size_t own = (size_t)row * (size_t)stuck->geometry->columns + (size_t)column;
	int run = 0;

	for (int step = -1; step <= 1; step += 2) {
		const int room = step < 0 ? column : stuck->geometry->columns - 1 - column;

		run = 0;
		for (int i = 1; i <= room && i <= within && run < BESIDE; i++)
			run = is_so(stuck, own + (size_t)(step * i), own, whole) ? run + 1 : 0;
		if (run < BESIDE)
			return false;
	}
	return true;
}

/*
 * True if a pixel never changes between such as show an object in most views. No object does that, even without noise:
 * a ray passes in some view whatever turns farther from the axis.
 */
static bool is_dead_in_object(const struct stuck *stuck, int column, int row, float whole)
{
	return never_changes(stuck, (size_t)row * (size_t)stuck->geometry->columns + (size_t)column) &&
	       is_between(stuck, column, row, ACROSS, whole, shows_change);
}

static bool says_little(const struct stuck *stuck, size_t at)
{
	return lost_share(stuck, at) >= LOST && (float)stuck->views - stuck->sums.views[at] >= LOST_LEAST &&
	       stuck->sums.views[at] > 0;
}

/*
 * True if a pixel says nothing in many views, as half of its column does, and those on both sides of it in its row
 * seldom do: it died since the flat was taken, and what it says otherwise is noise about the dark. What metal hides for
 * so long is as wide as its path about the axis.
 */
static bool is_lost(const struct stuck *stuck, int column, int row, float whole)
{
	const size_t columns = (size_t)stuck->geometry->columns;
	const int rows = stuck->geometry->rows;
	int like = 0;

	if (!says_little(stuck, (size_t)row * columns + (size_t)column) ||
	    !is_between(stuck, column, row, LOST_ACROSS, whole, is_well))
		return false;
	for (int r = 0; r < rows; r++)
		like += says_little(stuck, (size_t)r * columns + (size_t)column);
	return 2 * like >= rows && !is_on_axis(stuck, column, row);
}

static bool is_stuck(const struct stuck *stuck, int column, int row)
{
	const float whole = fminf(stuck->largest, 1);
	const size_t at = (size_t)row * (size_t)stuck->geometry->columns + (size_t)column;
	const struct behaviour own = behaviour_of(&stuck->sums, at);
	const bool is_beyond = own.beyond > BEYOND * own.rms;
	float varies[NEIGHBOURS], rms[NEIGHBOURS], mean[NEIGHBOURS], wanders[NEIGHBOURS];
	size_t near[NEIGHBOURS];

	if ((stuck->tells_dead && is_dead(stuck, at, whole)) || is_dead_in_object(stuck, column, row, whole) ||
	    is_lost(stuck, column, row, whole))
		return true;
	if (!is_known(stuck, at) || own.rms < MATTERS * whole)
		return false;
	/* A corner has neighbours on one side only. */
	if (edge_at(column, stuck->geometry->columns) != 0 && edge_at(row, stuck->geometry->rows) != 0)
		return false;
	neighbours_of(stuck->geometry, column, row, near);
	for (int i = 0; i < NEIGHBOURS; i++) {
		const struct behaviour other = behaviour_of(&stuck->sums, near[i]);

		const bool known = is_known(stuck, near[i]);

		varies[i] = known ? other.varies : 0;
		rms[i] = known ? other.rms : INFINITY;
		mean[i] = known ? other.mean : INFINITY;
		wanders[i] = known ? other.wanders : INFINITY;
	}
	sort(varies, NEIGHBOURS);
	sort(rms, NEIGHBOURS);
	sort(mean, NEIGHBOURS);
	sort(wanders, NEIGHBOURS);
	if (is_beyond && own.varies < STILL * varies[2] && own.rms > LARGER * rms[NEIGHBOURS / 2])
		return true;
	if (is_beyond && own.wanders > MATTERS * MATTERS * whole * whole &&
	    own.wanders > WILDER * wanders[NEIGHBOURS - 2] && own.spread > IN_FEW_VIEWS &&
	    own.rms > LARGER * rms[NEIGHBOURS - 2] && is_alone(stuck, column, row, true))
		return true;
	return own.mean > APART * whole && own.mean > FARTHER * mean[NEIGHBOURS - 2] &&
	       own.mean * own.mean > STEADY * STEADY * own.wanders && is_alone(stuck, column, row, false) &&
	       !is_on_axis(stuck, column, row);
}

const unsigned char *stuck_find(struct stuck *stuck)
{
	const int columns = stuck->geometry->columns, rows = stuck->geometry->rows;
	size_t count = 0;

	if (stuck->beside != NULL) {
		pthread_mutex_lock(&stuck->beside->lock);
		beside_wait(stuck->beside);
		pthread_mutex_unlock(&stuck->beside->lock);
	}
	stuck->tells_dead = tells_dead_pixels(stuck);
#pragma omp parallel for schedule(dynamic, 16) reduction(+ : count)
	for (int row = 0; row < rows; row++)
		for (int column = 0; column < columns; column++) {
			const size_t at = (size_t)row * (size_t)columns + (size_t)column;

			stuck->map[at] = is_stuck(stuck, column, row);
			count += stuck->map[at];
		}
	return count > 0 && (double)count <= MOST * columns * rows ? stuck->map : NULL;
}

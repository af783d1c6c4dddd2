/* Pixels that do not follow their neighbours over the views: see stuck.h. */
#include "core/correct/stuck_internal.h"

#include <math.h>
#ifdef _OPENMP
#include <omp.h>
#endif
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

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
const int stuck_around[NEIGHBOURS][2] = {{-1, -1}, {-1, 0}, {-1, 1}, {0, -1}, {0, 1}, {1, -1}, {1, 0}, {1, 1}};
static const int ALONG[NEIGHBOURS][2] = {{0, -3}, {0, -2}, {0, -1}, {0, 1}, {0, 2}, {0, 3}, {1, 0}, {2, 0}};

static int held(int index, int count)
{
	return index < 0 ? 0 : index < count ? index : count - 1;
}

int stuck_edge(int index, int count)
{
	return index < AWAY ? 1 : index >= count - AWAY ? -1 : 0;
}

void stuck_neighbours(const struct geometry *geometry, int column, int row, size_t ret[NEIGHBOURS])
{
	const int inwards[2] = {stuck_edge(row, geometry->rows), stuck_edge(column, geometry->columns)};

	for (int i = 0; i < NEIGHBOURS; i++) {
		int r = stuck_around[i][0], c = stuck_around[i][1];

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

void stuck_sort(float values[NEIGHBOURS], int count)
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

	stuck_neighbours(stuck->geometry, column, row, near);
	for (int i = 0; i < NEIGHBOURS; i++)
		if (stuck->good[near[i]] != 0)
			values[count++] = stuck->values[near[i]];
	count = count > 0 ? count : 1;
	stuck_sort(values, count);
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
			good += at[AWAY * (stuck_around[i][0] * columns + stuck_around[i][1]) + column];
		if (good < NEIGHBOURS)
			compare_to_good(stuck, column, row);
	}
}

static void compare_row(const struct stuck *stuck, int row)
{
	const int columns = stuck->geometry->columns;
	const bool inside = stuck_edge(row, stuck->geometry->rows) == 0;

	if (inside) {
		compare_inside(stuck, row);
		compare_beside_bad(stuck, row);
	}
	for (int column = 0; column < columns; column++)
		if (!inside || stuck_edge(column, columns) != 0)
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
const unsigned char *stuck_find(struct stuck *stuck)
{
	const int columns = stuck->geometry->columns, rows = stuck->geometry->rows;
	size_t count = 0;

	if (stuck->beside != NULL) {
		pthread_mutex_lock(&stuck->beside->lock);
		beside_wait(stuck->beside);
		pthread_mutex_unlock(&stuck->beside->lock);
	}
	stuck->tells_dead = stuck_tells_dead(stuck);
#pragma omp parallel for schedule(dynamic, 16) reduction(+ : count)
	for (int row = 0; row < rows; row++)
		for (int column = 0; column < columns; column++) {
			const size_t at = (size_t)row * (size_t)columns + (size_t)column;

			stuck->map[at] = stuck_is(stuck, column, row);
			count += stuck->map[at];
		}
	return count > 0 && (double)count <= STUCK_MOST * columns * rows ? stuck->map : NULL;
}

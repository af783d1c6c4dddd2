/* Views that show nothing: see content.h. */
#include "core/correct/content.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/error.h"

static const double PI = 3.14159265358979323846;

/* The content that vanishes in an empty view. A value other than air's leaves the attenuation, but no structure. */
enum measure { ATTENUATION, STRUCTURE, MEASURES };

static const double FAINT = 0.15, FULL = 0.5, OTHER = 0.25; /* shares of what a quarter of the views exceeds */
static const double CONSTANT = 1e-5;                        /* of a view's mean: its values are the same */
static const double DRIFT = 0.25;                           /* line integral of air, at most, where the tube drifts */
static const double ASIDE = 0.5; /* of half a row, from the median of all views' centres of mass */
/*
 * Degrees. A small object on a circle that reaches `ASIDE` of the field of view turns by 24 degrees at least before it
 * leaves the field, where it is in the field for half of a turn; between two such views that are at most 90 degrees
 * apart it does not leave the field at all. The structure of a body wider than the detector may vanish between views
 * that are nearer to each other, its attenuation does not.
 */
static const double NEAR = 15, SHORT[MEASURES] = {[ATTENUATION] = 91, [STRUCTURE] = 45};
/* Standard deviations by which the spread of the blocks' means exceeds that of noise before it counts as structure. */
static const double SIGNIFICANT = 5;
enum { MOST = 2 };                   /* one view in so many */
static const double OUTSTANDING = 8; /* standard deviations of a pixel */
static const double OFTEN = 0.2;     /* of neighbouring views */

void content_add(struct content_sums *sums, int block, float p)
{
	sums->largest = sums->any ? fmaxf(sums->largest, p) : p;
	sums->any = true;
	sums->sum[block] += (double)p;
	sums->square[block] += (double)p * (double)p;
	sums->count[block]++;
}

/* Mean of a block's samples, 0 where there are too few. */
static double mean_of(const struct content_sums *sums, int block)
{
	return sums->count[block] > 1 ? sums->sum[block] / sums->count[block] : 0;
}

static double centre_of_mass(const struct content_sums *sums, double least)
{
	double mass = 0, moment = 0;

	for (int b = 0; b < CONTENT_BLOCKS * CONTENT_BLOCKS; b++) {
		const double above = sums->count[b] > 1 ? mean_of(sums, b) - least : 0;

		mass += above;
		moment += above * ((b % CONTENT_BLOCKS + 0.5) * 2 / CONTENT_BLOCKS - 1);
	}
	return mass > 0 ? fmax(-1, fmin(1, moment / mass)) : 0;
}

static int compare_values(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

struct view_content content_of(const struct content_sums *sums)
{
	double sum = 0, square = 0, noise = 0, least = INFINITY, between, rounding, blocks_noise;
	double variances[CONTENT_BLOCKS * CONTENT_BLOCKS], of_means[CONTENT_BLOCKS * CONTENT_BLOCKS];
	int blocks = 0;

	for (int b = 0; b < CONTENT_BLOCKS * CONTENT_BLOCKS; b++) {
		const double n = sums->count[b], mean = mean_of(sums, b);

		if (n < 2)
			continue;
		variances[blocks] = fmax(0, sums->square[b] - n * mean * mean) / (n - 1);
		of_means[blocks] = variances[blocks] / n;
		sum += mean;
		square += mean * mean;
		noise += of_means[blocks];
		least = fmin(least, mean);
		blocks++;
	}
	if (blocks < 2)
		return (struct view_content){.plain = false};
	qsort(variances, (size_t)blocks, sizeof(*variances), compare_values);
	qsort(of_means, (size_t)blocks, sizeof(*of_means), compare_values);
	between = fmax(0, square - sum * sum / blocks) / (blocks - 1);
	noise /= blocks;
	rounding = 1e-12 * square / blocks; /* of floats */
	/* The median: a small object in one block is no noise. */
	blocks_noise = of_means[blocks / 2];
	return (struct view_content){
	    .mean = (float)(sum / blocks),
	    .structure = (float)sqrt(fmax(0, between - noise)),
	    .noise = (float)sqrt(noise),
	    .pixel = (float)sqrt(variances[blocks / 2] + rounding),
	    .peak = sums->largest - (float)(sum / blocks),
	    .centre = (float)centre_of_mass(sums, 0),
	    .structure_centre = (float)centre_of_mass(sums, least),
	    /* The variance of a variance of normal values is 2 / (blocks - 1) of its square. */
	    .plain = between <= blocks_noise * (1 + SIGNIFICANT * sqrt(2.0 / (blocks - 1))) + rounding,
	};
}

bool content_shows(const struct view_content *view)
{
	return !view->plain || (double)view->peak > OUTSTANDING * (double)view->pixel;
}

/* ---- the views along the orbit ---- */

struct place {
	double angle; /* radians from the first place on, in the direction of the rotation */
	int view;
};

/* The views that are not to be skipped, in the order of their angles. */
struct ring {
	const struct view_content *views;
	enum measure measure;
	/*
	 * [count], and behind them, where the orbit is a full turn, the first one again: that one shows an object then,
	 * so that no gap goes over the end.
	 */
	struct place *places;
	int count, end;          /* end: count, or count + 1 for a full turn */
	double strength, centre; /* upper quartile, median */
};

static int compare_places(const void *a, const void *b)
{
	const struct place *x = a, *y = b;

	return x->angle != y->angle ? (x->angle > y->angle) - (x->angle < y->angle)
				    : (x->view > y->view) - (x->view < y->view);
}

static const struct view_content *content_at(const struct ring *ring, int place)
{
	return &ring->views[ring->places[place].view];
}

static double strength_at(const struct ring *ring, int place)
{
	const struct view_content *view = content_at(ring, place);

	return ring->measure == STRUCTURE ? (double)view->structure
					  : hypot((double)view->structure, (double)view->mean);
}

static double centre_at(const struct ring *ring, int place)
{
	const struct view_content *view = content_at(ring, place);

	return (double)(ring->measure == STRUCTURE ? view->structure_centre : view->centre);
}

static bool is_faint(const struct ring *ring, int place)
{
	return strength_at(ring, place) + (double)content_at(ring, place)->noise < FAINT * ring->strength;
}

static void find_quantiles(struct ring *ring, double *sorted)
{
	for (int i = 0; i < ring->count; i++)
		sorted[i] = strength_at(ring, i);
	qsort(sorted, (size_t)ring->count, sizeof(*sorted), compare_values);
	ring->strength = sorted[3 * ring->count / 4];
	for (int i = 0; i < ring->count; i++)
		sorted[i] = centre_at(ring, i);
	qsort(sorted, (size_t)ring->count, sizeof(*sorted), compare_values);
	ring->centre = sorted[ring->count / 2];
}

/* Angles counted from a view, through a whole turn. */
static void sort_from(struct ring *ring, const struct orbit *orbit, int view)
{
	for (int i = 0; i < ring->count; i++) {
		const double turn = (orbit->angle[ring->places[i].view] - orbit->angle[view]) * orbit->direction;

		ring->places[i].angle = turn < 0 ? turn + 2 * PI : turn;
	}
	qsort(ring->places, (size_t)ring->count, sizeof(*ring->places), compare_places);
}

static void ring_close(struct ring *ring, const struct orbit *orbit)
{
	int start = 0;

	while (start < ring->count && is_faint(ring, start))
		start++;
	if (start == ring->count)
		return;
	sort_from(ring, orbit, ring->places[start].view);
	ring->places[ring->count] = (struct place){2 * PI, ring->places[0].view};
	ring->end = ring->count + 1;
}

static int ring_make(struct ring *ret_ring, enum measure measure, const struct view_content *views, const bool *skip,
		     const struct orbit *orbit, struct error *err)
{
	struct ring ring = {
	    .views = views, .measure = measure, .places = malloc(((size_t)orbit->count + 1) * sizeof(*ring.places))};
	double *sorted = malloc((size_t)orbit->count * sizeof(*sorted));

	if (sorted == NULL || ring.places == NULL) {
		free(sorted);
		free(ring.places);
		return error_set(err, ERR_NO_MEMORY, "no memory for the order of %d views", orbit->count);
	}
	for (int i = 0; i < orbit->count; i++)
		if (!skip[i])
			ring.places[ring.count++].view = i;
	ring.end = ring.count;
	if (ring.count > 0)
		find_quantiles(&ring, sorted);
	sort_from(&ring, orbit, orbit->first);
	if (!orbit->short_scan)
		ring_close(&ring, orbit);
	free(sorted);
	*ret_ring = ring;
	return 0;
}

/* True if a view shows the object whole, and about where most views have it. */
static bool shows_object(const struct ring *ring, int place)
{
	return !content_at(ring, place)->plain && strength_at(ring, place) >= FULL * ring->strength &&
	       fabs(centre_at(ring, place) - ring->centre) <= ASIDE;
}

/* True if the object is there up to the gap of places first .. last, and from its end on. */
static bool is_abrupt(const struct ring *ring, int first, int last)
{
	const bool has_before = first > 0, has_behind = last + 1 < ring->end;
	const struct place *at = ring->places;

	if ((has_before && !shows_object(ring, first - 1)) || (has_behind && !shows_object(ring, last + 1)))
		return false;
	if (has_before && has_behind && at[last + 1].angle - at[first - 1].angle <= SHORT[ring->measure] * PI / 180)
		return true;
	return (has_before || has_behind) &&
	       (!has_before || at[first].angle - at[first - 1].angle <= NEAR * PI / 180) &&
	       (!has_behind || at[last + 1].angle - at[last].angle <= NEAR * PI / 180);
}

/*
 * True if the mean of a view inside of the gap lies outside of those beside it. A body wider than the detector may look
 * even from one side, and attenuates as it does from the sides beside.
 */
static bool is_other(const struct ring *ring, int first, int last, int place)
{
	const float mean = content_at(ring, place)->mean;
	const float before = content_at(ring, first > 0 ? first - 1 : last + 1)->mean;
	const float behind = content_at(ring, last + 1 < ring->end ? last + 1 : first - 1)->mean;

	return (double)fmaxf(fminf(before, behind) - mean, mean - fmaxf(before, behind)) > OTHER * ring->strength;
}

static void mark_gaps(const struct ring *ring, bool *ret_empty)
{
	for (int first = 0, last; first < ring->count; first = last + 1) {
		last = first;
		if (!is_faint(ring, first))
			continue;
		while (last + 1 < ring->count && is_faint(ring, last + 1))
			last++;
		for (int i = first; i <= last && is_abrupt(ring, first, last); i++)
			if (is_other(ring, first, last, i))
				ret_empty[ring->places[i].view] = true;
	}
}

/* One value all over that is not air's: no view of an object, and none of air that noise or a flat is in. */
static void mark_constants(const struct ring *ring, bool *ret_empty)
{
	for (int i = 0; i < ring->count; i++) {
		const struct view_content *view = content_at(ring, i);

		if (fabs((double)view->mean) > fmax(DRIFT, FAINT * ring->strength) &&
		    (double)view->structure + (double)view->noise < CONSTANT * fabs((double)view->mean))
			ret_empty[ring->places[i].view] = true;
	}
}

int content_find_empty(const struct view_content *views, const bool *skip, const struct orbit *orbit, bool *ret_empty,
		       struct error *err)
{
	int found = 0, bare = 0, all = 0;

	memset(ret_empty, 0, (size_t)orbit->count * sizeof(*ret_empty));
	for (enum measure measure = 0; measure < MEASURES; measure++) {
		struct ring ring = {.count = 0};
		int code = ring_make(&ring, measure, views, skip, orbit, err);

		if (code < 0)
			return code;
		mark_gaps(&ring, ret_empty);
		if (measure == ATTENUATION)
			mark_constants(&ring, ret_empty);
		free(ring.places);
		all = ring.count;
	}
	for (int i = 0; i < orbit->count; i++) {
		found += ret_empty[i];
		bare += ret_empty[i] && views[i].structure == 0 && views[i].noise == 0;
	}
	if (MOST * (found - bare) <= all)
		return found;
	memset(ret_empty, 0, (size_t)orbit->count * sizeof(*ret_empty));
	return 0;
}

/* ---- small objects in scans that look even ---- */

/* A scale's image has half of the columns and rows of the one before; the blocks show what is larger than the last. */
static bool halve_size(int *columns, int *rows)
{
	if (*columns < 2 * CONTENT_BLOCKS || *rows < 2 * CONTENT_BLOCKS)
		return false;
	*columns /= 2;
	*rows /= 2;
	return true;
}

/* Means of 2 x 2 pixels, in place; of the good ones among them. */
static void halve(float *image, int columns, int half_columns, int half_rows)
{
	for (int r = 0; r < half_rows; r++)
		for (int c = 0; c < half_columns; c++) {
			const float *from = image + 2 * ((size_t)r * (size_t)columns + (size_t)c);
			const float four[4] = {from[0], from[1], from[columns], from[columns + 1]};
			float sum = 0;
			int good = 0;

			for (int i = 0; i < 4; i++)
				if (!isnan(four[i])) {
					sum += four[i];
					good++;
				}
			image[(size_t)r * (size_t)half_columns + (size_t)c] = good > 0 ? sum / (float)good : NAN;
		}
}

/* The brightest mean of width x width pixels, by its first pixel; below 0 where several are alike, as in a view of one
 * value. */
static int brightest_of(const float *image, int columns, int rows, int width)
{
	int brightest = -1, alike = 0;
	float most = 0;

	for (int i = 0; i < columns * rows; i++) {
		float sum = 0;

		if (i % columns + width > columns || i / columns + width > rows)
			continue;
		for (int k = 0; k < width * width; k++)
			sum += image[i + k / width * columns + k % width];
		if (isnan(sum))
			continue;
		if (brightest < 0 || sum > most) {
			brightest = i;
			most = sum;
			alike = 1;
		} else {
			alike += sum >= most;
		}
	}
	return alike == 1 ? brightest : -1;
}

void content_search(float *image, int columns, int rows, int ret_brightest[CONTENT_SCALES])
{
	int scale = 0, before;

	ret_brightest[scale++] = brightest_of(image, columns, rows, 1);
	do {
		ret_brightest[scale++] = brightest_of(image, columns, rows, 2);
		before = columns;
		if (!halve_size(&columns, &rows))
			break;
		halve(image, before, columns, rows);
	} while (scale < CONTENT_SCALES);
	for (; scale < CONTENT_SCALES; scale++)
		ret_brightest[scale] = -1;
}

/* How far an object in the field of view moves along a row, and along a column, from one view to the next; step: angle.
 */
static int near_columns(int columns, double step)
{
	return (int)ceil(columns * fmin(0.25, 0.75 * step));
}

static int near_rows(int rows)
{
	return rows >= 32 ? rows / 16 : 1;
}

/* The chance that two of so many places, both anywhere, are at most `apart` from each other. */
static double chance_near(int places, int apart)
{
	const double n = places, d = apart < places - 1 ? apart : places - 1;

	return ((2 * d + 1) * n - d * (d + 1)) / (n * n);
}

/*
 * True if the brightest places of neighbouring views are near to each other more often than by chance, or often in one
 * and the same pixel: the noise of a flat image is the same in all views, and does that more seldom even where it is as
 * strong as that of the views.
 */
static bool stays_near(const struct ring *ring, double step, int scale, int columns, int rows)
{
	const int apart[2] = {near_columns(columns, step), near_rows(rows)};
	const double same = 1.0 / ((double)columns * rows);
	const double chance =
	    (chance_near(columns, apart[0]) * chance_near(rows, apart[1]) - same) / fmax(1 - same, same);
	double pairs = 0, near = 0, alike = 0;

	for (int i = 0; i + 1 < ring->count; i++) {
		const int a = content_at(ring, i)->brightest[scale], b = content_at(ring, i + 1)->brightest[scale];

		if (a < 0 || b < 0)
			continue;
		if (a == b) {
			alike++;
			continue;
		}
		pairs++;
		near += abs(a % columns - b % columns) <= apart[0] && abs(a / columns - b / columns) <= apart[1];
	}
	if (alike > fmax(2, OFTEN * (alike + pairs)))
		return true;
	return near > 1 + pairs * chance + SIGNIFICANT * sqrt(pairs * chance * (1 - chance));
}

int content_is_even(const struct view_content *views, const bool *skip, const struct orbit *orbit, int columns,
		    int rows, bool *ret_even, struct error *err)
{
	struct ring ring;
	bool even = true;
	int code = ring_make(&ring, ATTENUATION, views, skip, orbit, err);

	if (code < 0)
		return code;
	for (int i = 0; i < ring.count && even; i++)
		even = !content_shows(content_at(&ring, i));
	for (int scale = 0; scale < CONTENT_SCALES && even; scale++) {
		/* The first two are both of the view as it is. */
		if (scale > 1 && !halve_size(&columns, &rows))
			break;
		even = !stays_near(&ring, orbit->arc / orbit->count, scale, columns, rows);
	}
	*ret_even = even && ring.count > 0;
	free(ring.places);
	return 0;
}

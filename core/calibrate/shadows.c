/*
 * Shadows of balls in a picture of line integrals.
 *
 * Candidates are found on an image of block means, where a ball is some pixels wide: the image less its grey opening
 * keeps what is narrower than the opening's square, whatever lies behind it, and its local maxima above the noise are
 * judged at full resolution, each by itself. There, a plane through a ring around the shadow is the background; the
 * centroid, the second moment and the height of what is above it are iterated to rest; and the share of the variance
 * that a ball's chord lengths, 2 sqrt(R^2 - d^2), explain tells a ball from a wire, a clip's edge or two balls in one.
 * A detector that blurs leaves a bell of them: which of the two shapes the balls of a scan have, blur.c says.
 */
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

enum { BLOCK_RADIUS = 2 }; /* blocks, at least, of the smallest ball: for its maximum to stand out */
enum { RING_MOST = 1024 }; /* pixels of a ring that are looked at */
enum { BUMPS_MOST = 8192 };
enum { RAYS = 4 };                      /* along either side of a pixel, of small shadows */
static const double RADIUS_FINE = 4;    /* pixels: from there on a chord at a pixel's middle is as good as its mean */
enum { BLOCKS_MEASURED = 5000 };        /* of the image of block means: their median is known to .02 of the noise */
static const double NOISE_FACTOR = 6;   /* a candidate's height, of the noise */
static const double HEIGHT_LEAST = .01; /* line integral: below it nothing is a ball */
static const double WINDOW = 1.25;      /* radius of the window, of the ball's */
static const double LIKENESS_LEAST = .85;
static const double MEDIAN_TO_SIGMA = 1.4826;

struct bump {
	float height;
	int place; /* in the image of block means */
};

struct shadow_finder {
	int columns, rows, block;
	int wide, high; /* of the image of block means */
	int opening;    /* half width of the opening's square, blocks */
	int apart;      /* blocks, from a maximum to another one of the same height */
	/* Radii to begin with, pixels: those expected, and others for where these find no ball. */
	double start[4];
	int expected, starts;
	float *line, *means, *opened, *scratch;
	float *padded; /* the image of block means with the opening's half width around it */
	struct bump bumps[BUMPS_MOST];
	float ring[RING_MOST], spread[RING_MOST];
	float ring_x[RING_MOST], ring_y[RING_MOST];
};

struct shadow_finder *shadow_finder_open(int columns, int rows, const struct shadow_scale *scale)
{
	struct shadow_finder *finder = calloc(1, sizeof(*finder));
	size_t blocks;

	if (finder == NULL)
		return NULL;
	finder->columns = columns;
	finder->rows = rows;
	finder->block = (int)fmax(1, floor(scale->small / BLOCK_RADIUS));
	finder->wide = columns / finder->block;
	finder->high = rows / finder->block;
	finder->opening = 1 + (int)ceil(1.8 * scale->large / finder->block);
	finder->apart = (int)fmax(1, .6 * scale->small / finder->block);
	finder->start[finder->expected++] = scale->large;
	if (scale->large > 1.15 * scale->small)
		finder->start[finder->expected++] = scale->small;
	finder->starts = finder->expected;
	finder->start[finder->starts++] = 1.6 * scale->large;
	finder->start[finder->starts++] = .6 * scale->small;
	blocks = (size_t)finder->wide * (size_t)finder->high;
	finder->line = malloc((size_t)columns * sizeof(float));
	finder->means = malloc((blocks + 1) * sizeof(float));
	finder->opened = malloc((blocks + 1) * sizeof(float));
	finder->scratch = malloc((blocks + 1) * sizeof(float));
	finder->padded = malloc((size_t)(finder->wide + 2 * finder->opening) *
				(size_t)(finder->high + 2 * finder->opening) * sizeof(float));
	if (finder->line == NULL || finder->means == NULL || finder->opened == NULL || finder->scratch == NULL ||
	    finder->padded == NULL)
		return shadow_finder_free(finder);
	return finder;
}

struct shadow_finder *shadow_finder_free(struct shadow_finder *finder)
{
	if (finder == NULL)
		return NULL;
	free(finder->line);
	free(finder->means);
	free(finder->opened);
	free(finder->scratch);
	free(finder->padded);
	free(finder);
	return NULL;
}

static void block_means(struct shadow_finder *finder, const float *image)
{
	const int block = finder->block;
	const float share = 1.0F / (float)(block * block);

	for (int y = 0; y < finder->high; y++) {
		float *line = finder->line;

		memset(line, 0, (size_t)finder->columns * sizeof(*line));
		for (int i = 0; i < block; i++) {
			const float *row = image + (size_t)(y * block + i) * (size_t)finder->columns;
#pragma omp simd
			for (int x = 0; x < finder->columns; x++)
				line[x] += row[x];
		}
		for (int x = 0; x < finder->wide; x++) {
			float sum = 0;

			for (int i = 0; i < block; i++)
				sum += line[x * block + i];
			finder->means[(size_t)y * (size_t)finder->wide + (size_t)x] = sum * share;
		}
	}
}

/* target = min or max of target and source, element by element. */
static void extreme(float *target, const float *source, int count, bool least)
{
	if (least) {
#pragma omp simd
		for (int i = 0; i < count; i++)
			target[i] = source[i] < target[i] ? source[i] : target[i];
	} else {
#pragma omp simd
		for (int i = 0; i < count; i++)
			target[i] = source[i] > target[i] ? source[i] : target[i];
	}
}

/*
 * Each of `rows` becomes the least or greatest of itself and the `reach` below it: over twice as many with each pass,
 * where the last two spans overlap.
 */
static void extend_down(float *image, int columns, int rows, int reach, bool least)
{
	for (int span = 1, step; span <= reach; span += step) {
		step = span < reach + 1 - span ? span : reach + 1 - span;
		for (int y = 0; y + step < rows; y++)
			extreme(image + (size_t)y * (size_t)columns, image + (size_t)(y + step) * (size_t)columns,
				columns, least);
	}
}

/* The same of each element and those behind it in its row. */
static void extend_right(float *row, int columns, int reach, bool least)
{
	for (int span = 1, step; span <= reach; span += step) {
		step = span < reach + 1 - span ? span : reach + 1 - span;
		extreme(row, row + step, columns - step, least);
	}
}

/*
 * The least or greatest value within the opening's half width to either side, along rows and then along columns; over
 * the border nothing counts: the padding around the image is what never wins.
 */
static void slide(struct shadow_finder *finder, const float *from, float *to, bool least)
{
	const int reach = finder->opening, wide = finder->wide, high = finder->high;
	const int across = wide + 2 * reach, down = high + 2 * reach;
	float *padded = finder->padded;

	for (size_t i = 0; i < (size_t)across * (size_t)down; i++)
		padded[i] = least ? INFINITY : -INFINITY;
	for (int y = 0; y < high; y++) {
		float *row = padded + (size_t)(y + reach) * (size_t)across;

		memcpy(row + reach, from + (size_t)y * (size_t)wide, (size_t)wide * sizeof(*row));
		extend_right(row, across, 2 * reach, least);
	}
	extend_down(padded, across, down, 2 * reach, least);
	for (int y = 0; y < high; y++)
		memcpy(to + (size_t)y * (size_t)wide, padded + (size_t)y * (size_t)across, (size_t)wide * sizeof(*to));
}

static int bump_order(const void *a, const void *b)
{
	const struct bump *x = a, *y = b;

	if (x->height != y->height)
		return x->height < y->height ? 1 : -1;
	return (x->place > y->place) - (x->place < y->place);
}

/* The median and the noise, by the median of distances from it, of every n-th block. */
static void measure(struct shadow_finder *finder, const float *blocks, double *ret_median, double *ret_noise)
{
	const int count = finder->wide * finder->high, step = 1 + count / BLOCKS_MEASURED;
	int taken = 0;

	for (int i = 0; i < count; i += step)
		finder->scratch[taken++] = blocks[i];
	*ret_median = select_kth(finder->scratch, taken, taken / 2);
	for (int i = 0; i < taken; i++)
		finder->scratch[i] = fabsf(finder->scratch[i] - (float)*ret_median);
	*ret_noise = MEDIAN_TO_SIGMA * select_kth(finder->scratch, taken, taken / 2);
}

static bool is_highest(const struct shadow_finder *finder, const float *above, int x, int y)
{
	const float height = above[(size_t)y * (size_t)finder->wide + (size_t)x];

	for (int j = -finder->apart; j <= finder->apart; j++)
		for (int i = -finder->apart; i <= finder->apart; i++) {
			float other;

			if (x + i < 0 || x + i >= finder->wide || y + j < 0 || y + j >= finder->high)
				continue;
			other = above[(size_t)(y + j) * (size_t)finder->wide + (size_t)(x + i)];
			if (other > height || (other == height && (j < 0 || (j == 0 && i < 0))))
				return false;
		}
	return true;
}

/* Local maxima above the noise, highest first; `above` is the image of block means less its opening. */
static int find_bumps(struct shadow_finder *finder, const float *above, struct shadow_facts *facts)
{
	float highest = 0;
	double median, least;
	int count = 0;

	measure(finder, above, &median, &facts->noise);
	least = HEIGHT_LEAST + NOISE_FACTOR * facts->noise;
	for (int y = 0; y < finder->high; y++)
		for (int x = 0; x < finder->wide; x++) {
			const float height = above[(size_t)y * (size_t)finder->wide + (size_t)x] - (float)median;

			highest = height > highest ? height : highest;
			if (height > least && count < BUMPS_MOST && is_highest(finder, above, x, y))
				finder->bumps[count++] = (struct bump){.height = height, .place = y * finder->wide + x};
		}
	facts->highest = highest;
	qsort(finder->bumps, (size_t)count, sizeof(*finder->bumps), bump_order);
	return count < SHADOWS_MOST ? count : SHADOWS_MOST;
}

struct plane {
	double at, by_x, by_y; /* at the middle, and for a pixel */
	double noise;
};

static bool fit_plane(struct shadow_finder *finder, int count, struct plane *plane)
{
	double normal[9] = {0}, right[3] = {0}, limit, scale = 0;
	int kept = 0;

	for (int i = 0; i < count; i++) {
		finder->spread[i] = fabsf(finder->ring[i] - (float)(plane->at + plane->by_x * finder->ring_x[i] +
								    plane->by_y * finder->ring_y[i]));
		scale = fmax(scale, fabs(finder->ring_x[i]));
	}
	plane->noise = MEDIAN_TO_SIGMA * select_kth(finder->spread, count, count / 2);
	limit = 3 * plane->noise + 1e-6;
	for (int i = 0; i < count; i++) {
		const double x[3] = {1, finder->ring_x[i] / scale, finder->ring_y[i] / scale};
		const double value = finder->ring[i];

		if (fabs(value - plane->at - plane->by_x * finder->ring_x[i] - plane->by_y * finder->ring_y[i]) > limit)
			continue;
		kept++;
		for (int a = 0; a < 3; a++) {
			right[a] += x[a] * value;
			for (int b = 0; b <= a; b++)
				normal[3 * a + b] += x[a] * x[b];
		}
	}
	if (kept < 8 || dense_cholesky(normal, 3) < 0)
		return false;
	dense_solve(normal, 3, right);
	plane->at = right[0];
	plane->by_x = right[1] / scale;
	plane->by_y = right[2] / scale;
	return true;
}

/*
 * The background of a shadow from a ring around it; false where too little of the ring is on the picture. `known`: the
 * plane is there already, of a ring some pixels aside, and tells what in this one is none of it.
 */
static bool find_background(struct shadow_finder *finder, const float *image, double column, double row, double radius,
			    bool known, struct plane *plane)
{
	const double inner = WINDOW * radius + 1.5, outer = inner + fmax(3, .6 * radius);
	const double area = M_PI * (outer * outer - inner * inner);
	const int step = (int)ceil(sqrt(area / 500));
	int count = 0;

	for (int y = (int)ceil(fmax(0, row - outer)); y < finder->rows && y <= row + outer; y += step)
		for (int x = (int)ceil(fmax(0, column - outer)); x < finder->columns && x <= column + outer;
		     x += step) {
			const double dx = x - column, dy = y - row, distance = dx * dx + dy * dy;

			if (distance < inner * inner || distance > outer * outer || count >= RING_MOST)
				continue;
			finder->ring[count] = finder->spread[count] =
			    image[(size_t)y * (size_t)finder->columns + (size_t)x];
			finder->ring_x[count] = (float)dx;
			finder->ring_y[count++] = (float)dy;
		}
	if (count < 16)
		return false;
	if (known)
		return fit_plane(finder, count, plane);
	*plane = (struct plane){.at = select_kth(finder->spread, count, count / 2)};
	return fit_plane(finder, count, plane) && fit_plane(finder, count, plane);
}

/* Sums over a window of what is above the background. */
struct moments {
	double mass, column, row, second;
};

/* True if a shadow's window is wholly on the picture. */
static bool on_picture(const struct shadow_finder *finder, double column, double row, double radius)
{
	const double window = WINDOW * radius;

	return column >= window && row >= window && column + window <= finder->columns - 1 &&
	       row + window <= finder->rows - 1;
}

static bool take_moments(const struct shadow_finder *finder, const float *image, double column, double row,
			 double radius, const struct plane *plane, struct moments *ret)
{
	const double window = WINDOW * radius;
	struct moments m = {0};

	if (!on_picture(finder, column, row, radius))
		return false;
	for (int y = (int)ceil(row - window); y <= row + window; y++)
		for (int x = (int)ceil(column - window); x <= column + window; x++) {
			const double dx = x - column, dy = y - row, square = dx * dx + dy * dy;
			double value;

			double inside = 1;

			/* The outermost pixels count by the part of them that is inside, or the window's edge moves
			 * the centroid in steps. */
			if (square >= (window + .5) * (window + .5))
				continue;
			if (square > (window - .5) * (window - .5))
				inside = window - sqrt(square) + .5;
			value = inside * (image[(size_t)y * (size_t)finder->columns + (size_t)x] - plane->at -
					  plane->by_x * dx - plane->by_y * dy);
			m.mass += value;
			m.column += value * dx;
			m.row += value * dy;
			m.second += value * square;
		}
	*ret = m;
	return m.mass > 0;
}

/*
 * A ball's chord, 1 in its middle, as the pixel at dx, dy from there has it; and a bell, (1 - d^2)^4 over a disc that
 * is wider so that its second moment is the same: what is left of a chord where a detector blurs by a third of the
 * radius and more.
 */
static void shapes_of(double dx, double dy, double radius, double ret_shapes[SHAPES])
{
	/* <rho^2> of (1 - d^2)^n over a disc is R^2 / (n + 2). */
	static const double narrower = 2.5 / (4 + 2);
	const int rays = radius < RADIUS_FINE ? RAYS : 1;
	double chords = 0, bells = 0;

	for (int i = 0; i < rays * rays; i++) {
		const double x = dx + (i % rays + .5) / rays - .5, y = dy + (i / rays + .5) / rays - .5;
		const double square = (x * x + y * y) / (radius * radius), bell = fmax(0, 1 - narrower * square);

		chords += sqrt(fmax(0, 1 - square));
		bells += bell * bell * bell * bell;
	}
	ret_shapes[SHAPE_CHORDS] = chords / (rays * rays);
	ret_shapes[SHAPE_BELL] = bells / (rays * rays);
}

/* Sums over a window of values, of what each shape has there (1 in the middle), and of what noise adds. */
struct agreement {
	double count, sum, squares, noise;
	double shape[SHAPES], both[SHAPES];
};

static void take_agreement(const struct shadow_finder *finder, const float *image, const struct plane *plane,
			   const struct shadow *shadow, struct agreement *ret)
{
	const double radius = shadow->radius, window = WINDOW * radius, variance = plane->noise * plane->noise;
	struct agreement sums = {0};

	for (int y = (int)ceil(shadow->row - window); y <= shadow->row + window; y++)
		for (int x = (int)ceil(shadow->column - window); x <= shadow->column + window; x++) {
			const double dx = x - shadow->column, dy = y - shadow->row, square = dx * dx + dy * dy;
			double value, shapes[SHAPES];

			if (square > window * window)
				continue;
			shapes_of(dx, dy, radius, shapes);
			value = image[(size_t)y * (size_t)finder->columns + (size_t)x] - plane->at - plane->by_x * dx -
				plane->by_y * dy;
			sums.count++;
			sums.sum += value;
			sums.squares += value * value;
			for (int i = 0; i < SHAPES; i++) {
				sums.shape[i] += shapes[i] * shapes[i];
				sums.both[i] += shapes[i] * value;
			}
			sums.noise += variance * (value > 0 ? exp(value < 8 ? value : 8) : 1);
		}
	*ret = sums;
}

/*
 * The share of the variance that a shape explains. Noise is none of what has to be explained: its variance in a line
 * integral grows with exp(p), as counts go down.
 */
static void judge(const struct shadow_finder *finder, const float *image, const struct plane *plane,
		  struct shadow *shadow)
{
	struct agreement sums;
	double all;

	take_agreement(finder, image, plane, shadow, &sums);
	shadow->height = sums.both[SHAPE_CHORDS] / sums.shape[SHAPE_CHORDS];
	all = sums.squares - sums.sum * sums.sum / sums.count - sums.noise;
	for (int i = 0; i < SHAPES; i++) {
		const double left = fmax(0, sums.squares - sums.both[i] * sums.both[i] / sums.shape[i] - sums.noise);

		shadow->as[i] =
		    all > .25 * (all + sums.noise) && shadow->height > 3 * plane->noise ? 1 - left / all : 0;
	}
	shadow->likeness = shadow->as[SHAPE_CHORDS];
}

/* Lets centre and radius come to rest, beginning with a radius; false where no ball can be. */
static bool settle(struct shadow_finder *finder, const float *image, double start, struct shadow *shadow)
{
	struct plane plane = {0};
	double radius = start;

	for (int i = 0; i < 8; i++) {
		struct moments m;
		double found, shift;

		if (!find_background(finder, image, shadow->column, shadow->row, radius, i > 0, &plane) ||
		    !take_moments(finder, image, shadow->column, shadow->row, radius, &plane, &m) || m.second <= 0)
			return false;
		/* <rho^2> of chord lengths over their disc is 2/5 R^2. */
		found = fmin(1.3 * radius, fmax(.7 * radius, sqrt(2.5 * m.second / m.mass)));
		shift = hypot(m.column, m.row) / m.mass;
		if (shift > radius)
			return false;
		shadow->column += m.column / m.mass;
		shadow->row += m.row / m.mass;
		plane.at += plane.by_x * m.column / m.mass + plane.by_y * m.row / m.mass;
		shift += fabs(found - radius);
		radius = found;
		if (radius < .4 * start || radius > 2.5 * start || radius < .7)
			return false;
		if (i > 1 && shift < .02)
			break;
	}
	if (!on_picture(finder, shadow->column, shadow->row, radius))
		return false;
	shadow->radius = radius;
	judge(finder, image, &plane, shadow);
	return true;
}

/* The shadow at a bump, by the radius to begin with that a ball explains best; false when it is no ball's. */
static bool find_shadow(struct shadow_finder *finder, const float *image, const struct bump *bump,
			struct shadow *ret_shadow)
{
	const double middle = .5 * (finder->block - 1);
	struct shadow best = {.likeness = 0};

	for (int i = 0; i < finder->starts; i++) {
		struct shadow shadow = {.column = bump->place % finder->wide * finder->block + middle,
					.row = bump->place / finder->wide * finder->block + middle};

		if (i >= finder->expected && best.likeness >= LIKENESS_LEAST)
			break;
		if (settle(finder, image, finder->start[i], &shadow) && shadow.likeness > best.likeness)
			best = shadow;
	}
	*ret_shadow = best;
	return fmax(best.as[SHAPE_CHORDS], best.as[SHAPE_BELL]) >= LIKENESS_LEAST;
}

int shadows_find(struct shadow_finder *finder, const float *image, struct shadow *ret_shadows,
		 struct shadow_facts *ret_facts)
{
	const int blocks = finder->wide * finder->high;
	struct shadow_facts facts = {0};
	double spread;
	int count = 0, bumps;

	block_means(finder, image);
	measure(finder, finder->means, &facts.median, &spread);
	slide(finder, finder->means, finder->opened, true);
	slide(finder, finder->opened, finder->opened, false);
	for (int i = 0; i < blocks; i++)
		finder->means[i] -= finder->opened[i];
	bumps = find_bumps(finder, finder->means, &facts);
	facts.candidates = bumps;
	for (int i = 0; i < bumps; i++) {
		struct shadow shadow;

		if (find_shadow(finder, image, &finder->bumps[i], &shadow))
			ret_shadows[count++] = shadow;
	}
	*ret_facts = facts;
	return count;
}

int shadows_keep(struct shadow *shadows, int count, enum shape shape)
{
	int kept = 0;

	for (int i = 0; i < count; i++) {
		const struct shadow *shadow = &shadows[i];
		bool known = shadow->as[shape] < LIKENESS_LEAST;

		for (int j = 0; j < kept && !known; j++)
			known = hypot(shadow->column - shadows[j].column, shadow->row - shadows[j].row) <
				.5 * shadow->radius;
		if (known)
			continue;
		shadows[kept] = *shadow;
		shadows[kept++].likeness = shadow->as[shape];
	}
	return kept;
}

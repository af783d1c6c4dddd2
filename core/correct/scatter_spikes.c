/* Pixels that stand out from an image of scatter: see scatter_spikes.h. */
#include "core/correct/scatter_spikes.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum {
	APART = 2, /* pixels, by which two are never in the same block of 2 x 2 */
	DIRECTIONS = 4,
	PASSES = 4,      /* one spike may hide another */
	NOISE_OF = 4096, /* pixels, at most, that the image's noise is measured on */
	ABOUT = 3,       /* pixels aside that the noise about a pixel, and what it is replaced by, are of */
	AROUND = (2 * ABOUT + 1) * (2 * ABOUT + 1),
	TERMS = 6, /* of a quadratic in the plane */
};
static const float NOISES = 6 * 1.4826F; /* six standard deviations, of the median size of a normal deviate */
static const float BEYOND = 0.154F;      /* of the logarithm: a sixth */
static const float FAINTEST = 0.02F;     /* of the image's median: added to each value, less than that says little */
static const float FAR = 1.35F;

struct picture {
	int columns, rows;
	const float *image;   /* [row][column] */
	float *logs;          /* likewise, of what little there is more */
	unsigned char *spike; /* likewise */
	float faintest;       /* so much */
	float noise;          /* the spread of the deviations from what is expected */
};

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

static float median(float *values, int count)
{
	if (count == 0)
		return 0;
	qsort(values, (size_t)count, sizeof(*values), compare_floats);
	return values[count / 2];
}

/* The pixel is in the image, and no spike. */
static bool is_good(const struct picture *picture, int column, int row)
{
	return column >= 0 && row >= 0 && column < picture->columns && row < picture->rows &&
	       !picture->spike[(size_t)row * (size_t)picture->columns + (size_t)column];
}

static float log_at(const struct picture *picture, int column, int row)
{
	return picture->logs[(size_t)row * (size_t)picture->columns + (size_t)column];
}

/* ---- which ---- */

/* What the pixels along one direction let expect: between both sides, or onwards from the one that is there. */
static bool expect_along(const struct picture *picture, const float *values, int column, int row, const int step[2],
			 float *ret)
{
	const int dc = APART * step[0], dr = APART * step[1];
	const int sign = is_good(picture, column - dc, row - dr) ? -1 : 1;
	const long near = dr * picture->columns + dc, at = (long)row * picture->columns + column;

	if (is_good(picture, column - dc, row - dr) && is_good(picture, column + dc, row + dr))
		*ret = 0.5F * values[at - near] + 0.5F * values[at + near];
	else if (is_good(picture, column + sign * dc, row + sign * dr) &&
		 is_good(picture, column + 2 * sign * dc, row + 2 * sign * dr))
		*ret = 2 * values[at + sign * near] - values[at + 2 * sign * near];
	else
		return false;
	return true;
}

/* What is expected at the pixel of values or of their logarithms; false: nothing can be. */
static bool expect(const struct picture *picture, const float *values, int column, int row, float *ret)
{
	static const int steps[DIRECTIONS][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}};
	float expected[DIRECTIONS];
	int count = 0;

	for (int d = 0; d < DIRECTIONS; d++)
		count += expect_along(picture, values, column, row, steps[d], &expected[count]);
	if (count == 0)
		return false;
	qsort(expected, (size_t)count, sizeof(*expected), compare_floats);
	*ret = 0.5F * expected[(count - 1) / 2] + 0.5F * expected[count / 2];
	return true;
}

/* How far the pixel's logarithm is above what is expected there; 0 where nothing can be. */
static float deviation(const struct picture *picture, int column, int row)
{
	float expected;

	if (!expect(picture, picture->logs, column, row, &expected))
		return 0;
	return log_at(picture, column, row) - expected;
}

/* Its value itself is another one than expected too: where one falls to nothing along a line its logarithm bends. */
static bool is_far(const struct picture *picture, int column, int row)
{
	const float own = picture->image[(size_t)row * (size_t)picture->columns + (size_t)column];
	float expected;

	if (!expect(picture, picture->image, column, row, &expected))
		return false;
	return own > FAR * expected || FAR * own < expected;
}

/* Whether it is above, and below, one that is two pixels away; one that is none, or outside, says nothing. */
static void hold_against(const struct picture *picture, float own, int column, int row, int *above, int *below,
			 int *count)
{
	float other;

	if (!is_good(picture, column, row))
		return;
	other = log_at(picture, column, row);
	*count += 1;
	*above += own > other + BEYOND;
	*below += own < other - BEYOND;
}

/* It is above, or below, all but two of those about it. Those straight beside it come first: few pixels pass them. */
static bool sticks_out(const struct picture *picture, int column, int row)
{
	const float own = log_at(picture, column, row);
	int count = 0, above = 0, below = 0;

	for (int side = -APART; side <= APART; side += 2 * APART) {
		hold_against(picture, own, column + side, row, &above, &below, &count);
		hold_against(picture, own, column, row + side, &above, &below, &count);
	}
	if (above < count - 2 && below < count - 2)
		return false;
	for (int dr = -APART; dr <= APART; dr++)
		for (int dc = -APART; dc <= APART; dc++)
			if ((abs(dr) == APART || abs(dc) == APART) && dr != 0 && dc != 0)
				hold_against(picture, own, column + dc, row + dr, &above, &below, &count);
	return count >= 3 && (above >= count - 2 || below >= count - 2);
}

/* Where a window of ABOUT aside of a place is one of pixels that have others on both sides, as far as there are such.
 */
static int inwards(int at, int count)
{
	const int least = ABOUT + APART, most = count - 1 - least;

	return most < least ? count / 2 : at < least ? least : at > most ? most : at;
}

/* The deviation there says how noisy the image is: it is no spike's, and none from beyond the rim. */
static bool tells_noise(const struct picture *picture, int column, int row)
{
	const bool wide = picture->columns > 2 * APART, high = picture->rows > 2 * APART;

	return is_good(picture, column, row) && (!wide || (column >= APART && column < picture->columns - APART)) &&
	       (!high || (row >= APART && row < picture->rows - APART));
}

/* The median, and the median distance from it: a curved image deviates everywhere, and alike. */
static float spread(float *values, int count, float *ret_median)
{
	const float middle = median(values, count);

	for (int i = 0; i < count; i++)
		values[i] = fabsf(values[i] - middle);
	*ret_median = middle;
	return median(values, count);
}

/* The spread of the deviations about a pixel, and their median. */
static float noise_about(const struct picture *picture, int column, int row, float *ret_median)
{
	const int c0 = inwards(column, picture->columns), r0 = inwards(row, picture->rows);
	float values[AROUND];
	int count = 0;

	for (int r = r0 - ABOUT; r <= r0 + ABOUT; r++)
		for (int c = c0 - ABOUT; c <= c0 + ABOUT; c++)
			if (tells_noise(picture, c, r))
				values[count++] = deviation(picture, c, r);
	return spread(values, count, ret_median);
}

static void measure_noise(struct picture *picture)
{
	const size_t pixels = (size_t)picture->columns * (size_t)picture->rows;
	const size_t step = pixels / NOISE_OF + 1;
	float values[NOISE_OF], middle;
	int count = 0;

	for (size_t at = 0; at < pixels && count < NOISE_OF; at += step) {
		const int column = (int)(at % (size_t)picture->columns), row = (int)(at / (size_t)picture->columns);

		if (tells_noise(picture, column, row))
			values[count++] = deviation(picture, column, row);
	}
	picture->noise = spread(values, count, &middle);
}

static bool is_spike(const struct picture *picture, int column, int row)
{
	float noise, middle;

	if (!sticks_out(picture, column, row) || !is_far(picture, column, row))
		return false;
	noise = fmaxf(picture->noise, noise_about(picture, column, row, &middle));
	/* What goes on to the rim is known less well than what lies between. */
	if (!tells_noise(picture, column, row))
		noise *= 2;
	return fabsf(deviation(picture, column, row) - middle) >= fmaxf((float)SPIKE_LEAST, NOISES * noise);
}

/* Marks spikes beside those that are known, all by the same picture; returns how many are new. */
static size_t find(struct picture *picture, unsigned char *found)
{
	size_t count = 0;

	measure_noise(picture);
#pragma omp parallel for schedule(static) reduction(+ : count)
	for (int row = 0; row < picture->rows; row++)
		for (int column = 0; column < picture->columns; column++) {
			const size_t at = (size_t)row * (size_t)picture->columns + (size_t)column;

			found[at] = is_good(picture, column, row) && is_spike(picture, column, row);
			count += found[at];
		}
	for (size_t at = 0; at < (size_t)picture->columns * (size_t)picture->rows; at++)
		picture->spike[at] |= found[at];
	return count;
}

/* ---- what takes their place ---- */

/* Solves normal equations in place, by elimination with pivots on the diagonal; false where they are singular. */
static bool solve(double matrix[TERMS][TERMS + 1], int terms)
{
	for (int k = 0; k < terms; k++) {
		if (!(matrix[k][k] > 1e-9))
			return false;
		for (int i = 0; i < terms; i++) {
			const double factor = i == k ? 0 : matrix[i][k] / matrix[k][k];

			for (int j = k; j <= TERMS; j++)
				matrix[i][j] -= factor * matrix[k][j];
		}
	}
	return true;
}

/* The value at the pixel of a quadratic, a plane or a constant through the good ones about it; false: there are too
 * few. */
static bool fit_about(const struct picture *picture, int column, int row, int terms, float *ret)
{
	double matrix[TERMS][TERMS + 1] = {{0}};

	for (int dr = -ABOUT; dr <= ABOUT; dr++)
		for (int dc = -ABOUT; dc <= ABOUT; dc++) {
			const double base[TERMS] = {1, dc, dr, dc * dc, dc * dr, dr * dr};
			const double weight = 1.0 / (1 + dc * dc + dr * dr);

			if (!is_good(picture, column + dc, row + dr))
				continue;
			for (int i = 0; i < terms; i++) {
				for (int j = 0; j < terms; j++)
					matrix[i][j] += weight * base[i] * base[j];
				matrix[i][TERMS] += weight * base[i] * (double)log_at(picture, column + dc, row + dr);
			}
		}
	if (!solve(matrix, terms))
		return false;
	*ret = (float)(matrix[0][TERMS] / matrix[0][0]);
	return true;
}

/* The logarithm that takes a spike's place; of nothing where there is no good pixel. */
static float replacement(const struct picture *picture, int column, int row)
{
	static const int terms[] = {TERMS, 3, 1};
	float found = logf(picture->faintest);

	for (int i = 0; i < 3; i++)
		if (fit_about(picture, column, row, terms[i], &found))
			break;
	return found;
}

/* ---- an image ---- */

/* The median of what is more than nothing among pixels `step` apart; 0: there is no such pixel. */
static float level_of(const float *image, size_t pixels, size_t step)
{
	float values[NOISE_OF];
	int count = 0;

	for (size_t i = 0; i < pixels && count < NOISE_OF; i += step)
		if (isfinite(image[i]) && image[i] > 0)
			values[count++] = image[i];
	return count > 0 || step == 1 ? median(values, count) : level_of(image, pixels, 1);
}

static size_t picture_make(struct picture *picture, const float *image)
{
	const size_t pixels = (size_t)picture->columns * (size_t)picture->rows;
	size_t wrong = 0;

#pragma omp parallel for schedule(static) reduction(+ : wrong)
	for (size_t i = 0; i < pixels; i++) {
		picture->spike[i] = !isfinite(image[i]) || image[i] < 0;
		picture->logs[i] = picture->spike[i] ? 0 : logf(image[i] + picture->faintest);
		wrong += picture->spike[i];
	}
	return wrong;
}

/* Returns how many there were. What is as the good ones say was taken for a spike because of one beside it, and is
 * none. */
static size_t replace(const struct picture *picture, float *image)
{
	size_t spikes = 0;

	for (int row = 0; row < picture->rows; row++)
		for (int column = 0; column < picture->columns; column++) {
			const size_t at = (size_t)row * (size_t)picture->columns + (size_t)column;
			float found;

			if (!picture->spike[at])
				continue;
			found = replacement(picture, column, row);
			if (isfinite(image[at]) && image[at] >= 0 &&
			    fabsf(picture->logs[at] - found) < 0.5F * (float)SPIKE_LEAST)
				continue;
			image[at] = fmaxf(0, expf(found) - picture->faintest);
			spikes++;
		}
	return spikes;
}

int scatter_spikes_replace(float *image, int columns, int rows, size_t *ret_spikes, struct error *err)
{
	const size_t pixels = (size_t)columns * (size_t)rows;
	struct picture picture = {.columns = columns, .rows = rows, .image = image};
	unsigned char *marks = calloc(pixels, 2);
	size_t spikes, found = 1;

	picture.logs = malloc(pixels * sizeof(*picture.logs));
	picture.spike = marks;
	if (picture.logs == NULL || marks == NULL) {
		free(picture.logs);
		free(marks);
		return error_set(err, ERR_NO_MEMORY, "no memory for an image of %d x %d", columns, rows);
	}
	picture.faintest = fmaxf(FAINTEST * level_of(image, pixels, pixels / NOISE_OF + 1), 1e-37F);
	spikes = picture_make(&picture, image);
	for (int pass = 0; pass < PASSES && found > 0; pass++) {
		found = find(&picture, marks + pixels);
		spikes += found;
	}
	if (spikes > 0)
		spikes = replace(&picture, image);
	free(picture.logs);
	free(marks);
	*ret_spikes = spikes;
	return 0;
}

/*
 * The noise of projections, where iterations are not to take it for the object.
 *
 * A second difference along a row, p(c) - 2 p(c - 2) + p(c - 4), less the same two rows further on: white noise of
 * variance s^2 makes its variance 12 s^2. Smooth parts of the object cancel along the row, edges that both rows cross
 * cancel between them; every second pixel, since a detector's blur makes neighbours alike. What is left of the object
 * is in some pieces of the rows, and noise is in all of them: the median in a piece and a low quantile of pieces are
 * that of noise. Noise goes with the attenuation, and so does the object, so that quantiles are taken among pieces of
 * like line integrals.
 */
#include "core/correct/projection_noise.h"

#include <math.h>
#include <stdlib.h>

enum { APART = 2, DIFFERENCES = 20, PIECE = DIFFERENCES + 2 * APART, CLASSES = 8, CLASS_LEAST = 16 };
enum { VIEWS = 32, ROWS = 256 /* that are looked at, about */ };

/* Some columns of a row. */
struct piece {
	float mean, variance; /* of p; of its noise */
};

static int by_mean(const void *a, const void *b)
{
	const float x = ((const struct piece *)a)->mean, y = ((const struct piece *)b)->mean;

	return (x > y) - (x < y);
}

static int by_variance(const void *a, const void *b)
{
	const float x = ((const struct piece *)a)->variance, y = ((const struct piece *)b)->variance;

	return (x > y) - (x < y);
}

static int ascending(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

/* `other`: the row that it is compared with, NULL: none. False where less than half of the differences are there. */
static bool measure_piece(const float *p, const float *other, int columns, struct piece *ret_piece)
{
	/* |d| of normal noise of deviation s has the median 0.6745 sqrt(6) s, or of two rows sqrt(12) s. */
	const double median_of_one = 0.6745 * sqrt(other != NULL ? 12 : 6);
	const int most = (columns < PIECE ? columns : PIECE) - 2 * APART;
	float differences[DIFFERENCES];
	double sum = 0;
	int count = 0;

	for (int i = 0; i < most; i++) {
		float d = p[i] - 2 * p[i + APART] + p[i + 2 * APART];

		if (other != NULL)
			d -= other[i] - 2 * other[i + APART] + other[i + 2 * APART];
		if (isfinite(d)) {
			differences[count++] = fabsf(d);
			sum += (double)p[i + APART];
		}
	}
	if (count == 0 || 2 * count < most)
		return false;
	qsort(differences, (size_t)count, sizeof(*differences), ascending);
	ret_piece->mean = (float)(sum / count);
	ret_piece->variance = (float)pow((double)differences[count / 2] / median_of_one, 2);
	return true;
}

/* What has been seen of the projections. */
struct seen {
	struct piece *pieces;
	size_t count;
	double squares, rays; /* the sum of p^2, and of how many */
};

static void look_at_view(const float *view, const struct geometry *geometry, struct seen *seen)
{
	const int columns = geometry->columns, rows = geometry->rows, step = rows / ROWS + 1;

	for (size_t i = 0; i < (size_t)columns * (size_t)rows; i++)
		if (isfinite(view[i])) {
			seen->squares += (double)view[i] * (double)view[i];
			seen->rays++;
		}
	for (int r = 0; r < rows; r += step) {
		/* The last rows are compared with those before them. */
		const int other = r + APART < rows ? r + APART : r - APART;
		const float *row = view + (size_t)r * (size_t)columns;

		for (int c = 0; c == 0 || c + PIECE <= columns; c += DIFFERENCES / 2)
			seen->count +=
			    measure_piece(row + c, other < 0 ? NULL : view + (size_t)other * (size_t)columns + c,
					  columns - c, &seen->pieces[seen->count]);
	}
}

/* The mean over classes of like line integrals of a low quantile of their pieces' variances. */
static double mean_of_classes(struct piece *pieces, size_t count)
{
	/* The quantile of pure noise's variances by such medians is so much of the variance (a simulation's). */
	const double quantile = 0.1, of_noise = 0.5;
	const size_t most = count / CLASS_LEAST, classes = most < CLASSES ? most : CLASSES;
	double sum = 0;

	qsort(pieces, count, sizeof(*pieces), by_mean);
	for (size_t k = 0; k < classes; k++) {
		const size_t first = count * k / classes, own = count * (k + 1) / classes - first;

		qsort(pieces + first, own, sizeof(*pieces), by_variance);
		sum += (double)own * (double)pieces[first + (size_t)(quantile * (double)own)].variance / of_noise;
	}
	return classes > 0 ? sum / (double)count : 0;
}

int noise_of_projections(const struct backend *backend, struct stack *projections, const struct geometry *geometry,
			 struct projection_squares *ret_squares, struct error *err)
{
	const int columns = geometry->columns, rows = geometry->rows, every = geometry->count / VIEWS + 1;
	const size_t looked =
	    (size_t)((geometry->count - 1) / every + 1) * (size_t)((rows - 1) / (rows / ROWS + 1) + 1);
	float *view = malloc(sizeof(*view) * (size_t)columns * (size_t)rows);
	struct seen seen = {.pieces =
				malloc(sizeof(*seen.pieces) * looked * (size_t)(columns / (DIFFERENCES / 2) + 1))};
	int code = 0;

	if (view == NULL || seen.pieces == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the noise of %d views", geometry->count);
	for (int k = 0; k < geometry->count && code == 0; k += every) {
		code = backend->stack_download(projections, k, 1, view, err);
		if (code == 0)
			look_at_view(view, geometry, &seen);
	}
	if (code == 0) {
		const double all = seen.rays > 0 ? seen.squares / seen.rays : 0;

		*ret_squares = (struct projection_squares){
		    .rays = seen.rays, .all = all, .noise = fmin(mean_of_classes(seen.pieces, seen.count), all)};
	}
	free(view);
	free(seen.pieces);
	return code;
}

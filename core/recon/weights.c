/* Statistical weights of rays: see weights.h. */
#include "core/recon/weights.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { PIECE = 16, APART = 2, BENDS = PIECE - 2 * APART }; /* columns; APART: rows, too */
enum { VIEWS_ASKED = 32 };
/* Ranges of p, and pieces that one has at least. */
enum { RANGES = 24, RANGE_LEAST = 20 };
enum { TERMS = 3 };
/* A range's variance is fitted to a share of itself, and of the largest. */
static const double FIT_LEAST = 0.01;

/* ---- the law ---- */

static void terms_at(double p, double ret_terms[TERMS])
{
	ret_terms[0] = 1;
	ret_terms[1] = exp(p);
	ret_terms[2] = p * p;
}

static double law_variance(const struct noise_law *law, double p)
{
	double terms[TERMS], sum = 0;

	terms_at(fmin(fmax(p, 0), law->most), terms);
	for (int i = 0; i < TERMS; i++)
		sum += law->term[i] * terms[i];
	return sum;
}

static int compare_p(const void *a, const void *b)
{
	const struct noise_piece *x = a, *y = b;

	return x->p != y->p ? (x->p > y->p) - (x->p < y->p) : (x->variance > y->variance) - (x->variance < y->variance);
}

static int compare_variance(const void *a, const void *b)
{
	const struct noise_piece *x = a, *y = b;

	return (x->variance > y->variance) - (x->variance < y->variance);
}

/* The pieces between two values of p, by the medians of both. */
struct range {
	double p, variance;
};

static int find_ranges(struct noise_piece *pieces, size_t count, double most, struct range ret_ranges[RANGES])
{
	int found = 0;
	size_t begin = 0;

	for (int i = 0; i < RANGES; i++) {
		size_t end = begin;

		while (end < count && (i == RANGES - 1 || (double)pieces[end].p < most * (i + 1) / RANGES))
			end++;
		if (end - begin >= RANGE_LEAST) {
			const double p = (double)pieces[begin + (end - begin) / 2].p;

			qsort(pieces + begin, end - begin, sizeof(*pieces), compare_variance);
			ret_ranges[found++] =
			    (struct range){.p = p, .variance = (double)pieces[begin + (end - begin) / 2].variance};
		}
		begin = end;
	}
	return found;
}

/*
 * Least squares over the terms whose bits are set, by Gaussian elimination with the largest pivot; false where they
 * cannot be told apart or one of them is negative.
 */
static bool solve(double normal[TERMS][TERMS + 1], unsigned set, double ret_term[TERMS])
{
	double m[TERMS][TERMS + 1];

	for (int i = 0; i < TERMS; i++)
		for (int j = 0; j <= TERMS; j++) {
			const bool in = set >> i & 1 && (j == TERMS || set >> j & 1);

			m[i][j] = in ? normal[i][j] : i == j;
		}
	for (int k = 0; k < TERMS; k++) {
		int pivot = k;

		for (int i = k + 1; i < TERMS; i++)
			pivot = fabs(m[i][k]) > fabs(m[pivot][k]) ? i : pivot;
		if (!(fabs(m[pivot][k]) > 0))
			return false;
		for (int j = 0; j <= TERMS; j++) {
			const double swapped = m[k][j];

			m[k][j] = m[pivot][j];
			m[pivot][j] = swapped;
		}
		for (int i = 0; i < TERMS; i++) {
			const double factor = i == k ? 0 : m[i][k] / m[k][k];

			for (int j = k; j <= TERMS; j++)
				m[i][j] -= factor * m[k][j];
		}
	}
	for (int i = 0; i < TERMS; i++) {
		ret_term[i] = set >> i & 1 ? m[i][TERMS] / m[i][i] : 0;
		if (!(ret_term[i] >= 0))
			return false;
	}
	return true;
}

static double misfit(const struct range *ranges, const double *weights, int count, const double term[TERMS])
{
	double sum = 0;

	for (int i = 0; i < count; i++) {
		double terms[TERMS], rest = ranges[i].variance;

		terms_at(ranges[i].p, terms);
		for (int j = 0; j < TERMS; j++)
			rest -= term[j] * terms[j];
		sum += weights[i] * rest * rest;
	}
	return sum;
}

/* Three terms have seven sets that are not empty: the best of those without a negative term. */
static void fit(const struct range *ranges, int count, struct noise_law *law)
{
	double normal[TERMS][TERMS + 1] = {0}, weights[RANGES], largest = 0, least = DBL_MAX;

	for (int i = 0; i < count; i++)
		largest = fmax(largest, ranges[i].variance);
	for (int i = 0; i < count; i++) {
		double terms[TERMS];

		weights[i] = pow(fmax(ranges[i].variance, FIT_LEAST * largest), -2);
		terms_at(ranges[i].p, terms);
		for (int j = 0; j < TERMS; j++) {
			for (int k = 0; k < TERMS; k++)
				normal[j][k] += weights[i] * terms[j] * terms[k];
			normal[j][TERMS] += weights[i] * terms[j] * ranges[i].variance;
		}
	}
	for (unsigned set = 1; set < 1U << TERMS; set++) {
		double term[TERMS], rest;

		if (!solve(normal, set, term))
			continue;
		rest = misfit(ranges, weights, count, term);
		if (rest < least) {
			least = rest;
			memcpy(law->term, term, sizeof(term));
		}
	}
}

void noise_law_fit(struct noise_piece *pieces, size_t count, struct noise_law *ret_law)
{
	struct noise_law law = {.most = 0};
	struct range ranges[RANGES];
	double largest = 0;
	int found;

	qsort(pieces, count, sizeof(*pieces), compare_p);
	if (count > 0)
		law.most = fmax(0, (double)pieces[count - 1].p);
	found = find_ranges(pieces, count, law.most, ranges);
	for (int i = 0; i < found; i++)
		largest = fmax(largest, ranges[i].variance);
	if (largest > 0)
		fit(ranges, found, &law);
	*ret_law = law;
}

/* ---- pieces ---- */

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

static float bend(const float *p)
{
	return p[0] - 2 * p[APART] + p[2 * APART];
}

/* A piece of a row, held against the row APART behind it, or of a single row alone; false where rays are left out. */
static bool piece_at(const float *p, size_t next, struct noise_piece *ret_piece)
{
	/* |d| of normal noise of deviation s has the median 0.6745 sqrt(6) s, and sqrt(12) for the two rows. */
	const double median_of_one = 0.6745 * sqrt(next > 0 ? 12 : 6);
	float d[BENDS];
	double mean = 0;

	for (int i = 0; i < PIECE; i++)
		mean += (double)p[i] / PIECE;
	for (int i = 0; i < BENDS; i++) {
		d[i] = fabsf(next > 0 ? bend(p + i) - bend(p + next + i) : bend(p + i));
		if (!isfinite(d[i]))
			return false;
	}
	qsort(d, BENDS, sizeof(*d), compare_floats);
	*ret_piece = (struct noise_piece){
	    .p = (float)mean,
	    .variance = (float)pow((double)(d[BENDS / 2 - 1] + d[BENDS / 2]) / 2 / median_of_one, 2),
	};
	return isfinite(mean);
}

static size_t pieces_of_view(const float *view, int columns, int rows, struct noise_piece *ret_pieces)
{
	const bool paired = rows > APART;
	const int last = paired ? rows - APART : rows;
	size_t count = 0;

	for (int r = 0; r < last; r++)
		for (int c = 0; c + PIECE <= columns; c += PIECE)
			count += piece_at(view + (size_t)r * (size_t)columns + c,
					  paired ? (size_t)APART * (size_t)columns : 0, &ret_pieces[count]);
	return count;
}

/* The stack has the projections. */
static int find_law(const struct problem *problem, enum ray_weights kind, struct stack *projections, float *view,
		    struct noise_law *ret_law, struct error *err)
{
	const struct geometry *geometry = problem->geometry;
	const int every = (geometry->count - 1) / VIEWS_ASKED + 1;
	const size_t in_view = (size_t)geometry->rows * (size_t)(geometry->columns / PIECE);
	struct noise_piece *pieces = malloc(sizeof(*pieces) * (in_view * VIEWS_ASKED + 1));
	size_t count = 0;
	int code = pieces == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for the noise of projections") : 0;

	for (int k = 0; k < geometry->count && code == 0; k += every) {
		code = problem->backend->stack_download(projections, k, 1, view, err);
		if (code == 0)
			count += pieces_of_view(view, geometry->columns, geometry->rows, pieces + count);
	}
	if (code == 0)
		noise_law_fit(pieces, count, ret_law);
	if (kind == RAYS_COUNTS)
		memcpy(ret_law->term, (double[TERMS]){0, 1, 0}, sizeof(ret_law->term));
	free(pieces);
	return code;
}

/* ---- weights ---- */

/* The mean of the rays that are there, of 3 x 3 around one. */
static double mean_around(const float *view, int columns, int rows, int c, int r)
{
	double sum = 0;
	int count = 0;

	for (int y = r > 0 ? r - 1 : 0; y <= r + 1 && y < rows; y++)
		for (int x = c > 0 ? c - 1 : 0; x <= c + 1 && x < columns; x++) {
			const float p = view[(size_t)y * (size_t)columns + (size_t)x];

			if (isnan(p))
				continue;
			sum += (double)p;
			count++;
		}
	return count > 0 ? sum / count : 0;
}

static void weigh_view(const struct noise_law *law, const float *view, int columns, int rows, float *ret_weights)
{
	const double largest = fmax(law_variance(law, 0), law_variance(law, law->most)),
		     unit = law_variance(law, law->most / 2);

#pragma omp parallel for schedule(static)
	for (int r = 0; r < rows; r++)
		for (int c = 0; c < columns; c++) {
			const size_t at = (size_t)r * (size_t)columns + (size_t)c;
			const double variance = law_variance(law, mean_around(view, columns, rows, c, r));

			ret_weights[at] = isnan(view[at]) ? 0
					  : largest > 0   ? (float)(unit / fmax(variance, largest / WEIGHTS_RANGE))
							  : 1;
		}
}

int weights_of_rays(const struct problem *problem, enum ray_weights kind, struct stack *ret_weights, struct error *err)
{
	const struct backend *backend = problem->backend;
	const int columns = problem->geometry->columns, rows = problem->geometry->rows;
	const int views = problem->geometry->count;
	const size_t pixels = (size_t)columns * (size_t)rows;
	struct noise_law law = {.most = 0};
	float *view;
	int code;

	if (kind == RAYS_EVEN)
		return backend->stack_fill(ret_weights, views, 1, err);
	view = malloc(2 * pixels * sizeof(*view));
	if (view == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the weights of a view");
	code = backend->stack_axpby(1, problem->projections, NULL, views, 0, ret_weights, err);
	if (code == 0)
		code = find_law(problem, kind, ret_weights, view, &law, err);
	for (int k = 0; k < views && code == 0; k++) {
		code = cancel_check(problem->cancel, err);
		if (code == 0)
			code = backend->stack_download(ret_weights, k, 1, view, err);
		if (code < 0)
			break;
		weigh_view(&law, view, columns, rows, view + pixels);
		code = backend->stack_upload(ret_weights, k, 1, view + pixels, err);
	}
	free(view);
	return code;
}

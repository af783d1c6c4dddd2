/*
 * The shift between two images, by least squares of their difference over the gradients of their mean (Lucas and Kanade
 * 1981), with a turn, a scale and a gain beside it, iteratively reweighted with Tukey's biweight.
 */
#include "core/refine/shift.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "core/refine/detail.h"
#include "core/select.h"

/* The edge's last value, repeated, makes detail as far as BORDER, which may be that of a body wider than the image. */
enum { UNKNOWNS = 5, PASSES = 4, EDGE = 3, BORDER = 8, STRIPS = 4 };
static const double PI = 3.14159265358979323846;
/* Standard deviations of the two Gaussians between which detail counts, bins. */
static const double FINE = 1, COARSE = 2.5;
static const double TUKEY = 4.685, MAD = 1.4826; /* 95 % efficiency; of a normal distribution's median deviation */

/* At a pixel: derivatives of `other` by the unknowns, and the difference of both images. */
struct slope {
	double by[UNKNOWNS + 1];
};

/* Images [row][column] of one view. */
struct pair {
	int columns, rows;
	float *image, *other, *work; /* [rows * columns] each, three of work, of one allocation */
	struct slope *slopes;        /* of the pixels that are not at the edge, row by row */
};

/* ---- what of the detail is unexplained ---- */

static double detail_product(const struct pair *pair, const float *x, const float *y)
{
	double sum = 0;

	for (int row = BORDER; row < pair->rows - BORDER; row++)
		for (int column = BORDER; column < pair->columns - BORDER; column++) {
			const size_t at = (size_t)row * (size_t)pair->columns + (size_t)column;

			sum += (double)x[at] * (double)y[at];
		}
	return sum;
}

/*
 * Mean variance of the noise, by a mask that slopes and bends do not reach (Immerkaer 1996). It is too high by edges,
 * and right where few rays through a thick body have most of the noise, which a median does not see.
 */
static double noise_variance(const struct pair *pair, const float *image)
{
	const int columns = pair->columns;
	double squares = 0;

	for (int row = BORDER; row < pair->rows - BORDER; row++)
		for (int column = BORDER; column < columns - BORDER; column++) {
			const float *p = image + row * columns + column;
			const float masked = 4 * p[0] - 2 * (p[1] + p[-1] + p[columns] + p[-columns]) + p[columns + 1] +
					     p[columns - 1] + p[1 - columns] + p[-columns - 1];

			squares += (double)masked * (double)masked;
		}
	return squares / (36. * (columns - 2 * BORDER) * (pair->rows - 2 * BORDER));
}

/* `image` is the one that pair->image is the detail of. */
static double unexplained_share(const struct pair *pair, const float *image)
{
	/* The integral of the square of a difference of two Gaussians: the part of white noise's variance it keeps. */
	const double kept =
	    (1 / (FINE * FINE) + 1 / (COARSE * COARSE) - 4 / (FINE * FINE + COARSE * COARSE)) / (4 * PI);
	const double pixels = (double)(pair->columns - 2 * BORDER) * (pair->rows - 2 * BORDER);
	double all, common, other, chance;

	if (pair->columns <= 2 * BORDER || pair->rows <= 2 * BORDER)
		return 0;
	all = detail_product(pair, pair->image, pair->image);
	common = detail_product(pair, pair->image, pair->other);
	other = detail_product(pair, pair->other, pair->other);
	chance = noise_variance(pair, image) * kept * pixels;
	if (!(all > 2 * chance) || !(other > 0))
		return 0;
	return fmin(1, fmax(0, all - common * common / other - chance) / (all - chance));
}

/* ---- least squares ---- */

struct normal {
	double rows[UNKNOWNS][UNKNOWNS + 1]; /* of the matrix, each with its right side */
	double squares, weights;             /* of what is left */
};

/* Inverts a symmetric positive definite matrix in place; false where it is none to rounding. */
static bool invert(double matrix[UNKNOWNS][UNKNOWNS])
{
	double wide[UNKNOWNS][2 * UNKNOWNS] = {{0}};

	for (int i = 0; i < UNKNOWNS; i++) {
		memcpy(wide[i], matrix[i], sizeof(matrix[i]));
		wide[i][UNKNOWNS + i] = 1;
	}
	for (int i = 0; i < UNKNOWNS; i++) {
		const double pivot = wide[i][i];

		if (!(pivot > 1e-10 * matrix[i][i]) || !(pivot > 0))
			return false;
		for (int j = 0; j < 2 * UNKNOWNS; j++)
			wide[i][j] /= pivot;
		for (int r = 0; r < UNKNOWNS; r++) {
			const double factor = wide[r][i];

			for (int j = 0; j < 2 * UNKNOWNS && r != i; j++)
				wide[r][j] -= factor * wide[i][j];
		}
	}
	for (int i = 0; i < UNKNOWNS; i++)
		memcpy(matrix[i], wide[i] + UNKNOWNS, sizeof(matrix[i]));
	return true;
}

/* The derivative at a pixel of the mean of both images, by differences of fourth order: detail is few bins wide. */
static double gradient(const struct pair *pair, size_t at, size_t step)
{
	const float *p = pair->image, *q = pair->other;
	const double near = (double)p[at + step] - (double)p[at - step] + (double)q[at + step] - (double)q[at - step];
	const double far =
	    (double)p[at + 2 * step] - (double)p[at - 2 * step] + (double)q[at + 2 * step] - (double)q[at - 2 * step];

	return (8 * near - far) / 24;
}

/* By the shifts, a turn and a scale about the middle, and the gain. */
static void slope_set(const struct pair *pair, int column, int row, struct slope *ret)
{
	const size_t at = (size_t)row * (size_t)pair->columns + (size_t)column;
	const double gx = gradient(pair, at, 1), gy = gradient(pair, at, (size_t)pair->columns);
	const double x = (column - 0.5 * (pair->columns - 1)) / pair->columns;
	const double y = (row - 0.5 * (pair->rows - 1)) / pair->columns;

	ret->by[0] = -gx;
	ret->by[1] = -gy;
	ret->by[2] = y * gx - x * gy;
	ret->by[3] = -x * gx - y * gy;
	ret->by[4] = (double)pair->other[at];
	ret->by[UNKNOWNS] = (double)pair->image[at] - (double)pair->other[at];
}

static void slopes_set(const struct pair *pair)
{
	struct slope *slope = pair->slopes;

	for (int row = EDGE; row < pair->rows - EDGE; row++)
		for (int column = EDGE; column < pair->columns - EDGE; column++)
			slope_set(pair, column, row, slope++);
}

/* The first pixel of a strip; that of the strip behind the last one is the edge. */
static int strip_begin(int strip, int pixels)
{
	return EDGE + (strip * (pixels - 2 * EDGE) + STRIPS - 1) / STRIPS;
}

/* Adds a row's pixels of one strip; what is left of each goes to ret_left. */
static void add_up_strip(const struct slope *slopes, int count, const double unknowns[UNKNOWNS], double cut,
			 struct normal *cell, float *ret_left)
{
	struct normal sums = *cell;

	for (int p = 0; p < count; p++) {
		const struct slope *slope = &slopes[p];
		double left = slope->by[UNKNOWNS], share, weight;

#pragma GCC unroll 5
		for (int i = 0; i < UNKNOWNS; i++)
			left -= slope->by[i] * unknowns[i];
		share = fabs(left) / cut;
		weight = share < 1 ? pow(1 - share * share, 2) : 0;
#pragma GCC unroll 5
		for (int i = 0; i < UNKNOWNS; i++) {
			const double weighted = weight * slope->by[i];

#pragma GCC unroll 6
			for (int j = 0; j <= UNKNOWNS; j++)
				sums.rows[i][j] += weighted * slope->by[j];
		}
		sums.squares += weight * left * left;
		sums.weights += weight;
		ret_left[p] = (float)fabs(left);
	}
	*cell = sums;
}

/*
 * What is left of the difference beyond `cut` has no weight; what is left of each pixel goes to ret_left. cells: of a
 * strip of rows and one of columns.
 */
static int add_up(const struct pair *pair, const double unknowns[UNKNOWNS], double cut,
		  struct normal cells[STRIPS][STRIPS], float *ret_left)
{
	int done = 0;

	memset(cells, 0, STRIPS * STRIPS * sizeof(cells[0][0]));
	for (int down = 0; down < STRIPS; down++)
		for (int row = strip_begin(down, pair->rows); row < strip_begin(down + 1, pair->rows); row++)
			for (int across = 0; across < STRIPS; across++) {
				const int count =
				    strip_begin(across + 1, pair->columns) - strip_begin(across, pair->columns);

				add_up_strip(pair->slopes + done, count, unknowns, cut, &cells[down][across],
					     ret_left + done);
				done += count;
			}
	return done;
}

/* Of all cells but those in strips from `from` to before `to`, of columns (axis 0) or of rows (1). */
static struct normal normal_without(struct normal cells[STRIPS][STRIPS], int axis, int from, int to)
{
	struct normal sums = {.weights = 0};

	for (int cell = 0; cell < STRIPS * STRIPS; cell++) {
		const int row = cell / STRIPS, column = cell % STRIPS, strip = axis == 0 ? column : row;
		const struct normal *of_cell = &cells[row][column];

		if (strip >= from && strip < to)
			continue;
		for (int i = 0; i < UNKNOWNS; i++)
			for (int j = 0; j <= UNKNOWNS; j++)
				sums.rows[i][j] += j > i && j < UNKNOWNS ? of_cell->rows[j][i] : of_cell->rows[i][j];
		sums.squares += of_cell->squares;
		sums.weights += of_cell->weights;
	}
	return sums;
}

/* The unknowns are 0, and the inverse says nothing, where there is no solution. */
static bool solve(const struct normal *normal, double ret_inverse[UNKNOWNS][UNKNOWNS], double ret_unknowns[UNKNOWNS])
{
	memset(ret_unknowns, 0, UNKNOWNS * sizeof(ret_unknowns[0]));
	for (int i = 0; i < UNKNOWNS; i++)
		memcpy(ret_inverse[i], normal->rows[i], UNKNOWNS * sizeof(ret_inverse[i][0]));
	if (!(normal->weights > 0) || !invert(ret_inverse))
		return false;
	for (int i = 0; i < UNKNOWNS; i++)
		for (int j = 0; j < UNKNOWNS; j++)
			ret_unknowns[i] += ret_inverse[i][j] * normal->rows[j][UNKNOWNS];
	return true;
}

/* The jackknife: what the shift would be without each strip, and without each half, in turn. */
static void doubt_by_parts(struct normal cells[STRIPS][STRIPS], const double unknowns[UNKNOWNS],
			   struct image_shift *shift)
{
	for (int axis = 0; axis < 2; axis++)
		for (int parts = 2; parts <= STRIPS; parts += STRIPS - 2) {
			double squares[2] = {0};

			for (int part = 0; part < parts; part++) {
				const int width = STRIPS / parts;
				const struct normal rest =
				    normal_without(cells, axis, part * width, (part + 1) * width);
				double inverse[UNKNOWNS][UNKNOWNS], without[UNKNOWNS];

				solve(&rest, inverse, without);
				for (int a = 0; a < 2; a++)
					squares[a] += pow(without[a] - unknowns[a], 2);
			}
			for (int a = 0; a < 2; a++)
				shift->doubt[a] = fmax(shift->doubt[a], sqrt(squares[a] * (parts - 1) / parts));
		}
}

static bool fit(const struct pair *pair, struct image_shift *ret_shift)
{
	/* A smoothed pixel shares its noise with so many others. */
	const double alike = fmax(1, 4 * acos(-1) * FINE * FINE);
	double inverse[UNKNOWNS][UNKNOWNS], unknowns[UNKNOWNS] = {0}, cut = INFINITY;
	struct normal cells[STRIPS][STRIPS], normal;

	slopes_set(pair);
	for (int pass = 0; pass <= PASSES; pass++) {
		const int count = add_up(pair, unknowns, cut, cells, pair->work);

		normal = normal_without(cells, 0, 0, 0);
		if (!solve(&normal, inverse, unknowns))
			return false;
		cut = TUKEY * MAD * (double)select_kth(pair->work, count, count / 2) + 1e-12;
	}
	for (int a = 0; a < 2; a++) {
		ret_shift->bins[a] = unknowns[a];
		ret_shift->sigma[a] = sqrt(alike * normal.squares / normal.weights * inverse[a][a]);
		ret_shift->doubt[a] = ret_shift->sigma[a];
	}
	doubt_by_parts(cells, unknowns, ret_shift);
	return true;
}

int image_shift_find(const float *image, const float *other, int columns, int rows, struct image_shift *ret_shift,
		     struct error *err)
{
	const size_t pixels = (size_t)columns * (size_t)rows;
	float *all = malloc(5 * pixels * sizeof(*all));
	const struct pair pair = {.columns = columns,
				  .rows = rows,
				  .image = all,
				  .other = all + pixels,
				  .work = all + 2 * pixels,
				  .slopes = malloc(pixels * sizeof(*pair.slopes))};
	bool found;

	if (all == NULL || pair.slopes == NULL) {
		free(all);
		free(pair.slopes);
		return error_set(err, ERR_NO_MEMORY, "no memory for images of %d x %d", columns, rows);
	}
	image_detail(image, columns, rows, FINE, COARSE, pair.work, pair.image);
	image_detail(other, columns, rows, FINE, COARSE, pair.work, pair.other);
	ret_shift->unexplained = unexplained_share(&pair, image);
	found = fit(&pair, ret_shift);
	free(pair.slopes);
	free(all);
	return found;
}

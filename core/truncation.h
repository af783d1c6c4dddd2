#ifndef CBCT_CORE_TRUNCATION_H
#define CBCT_CORE_TRUNCATION_H

/*
 * Rows that a detector too small for the patient has cut off, continued before
 * the ramp: the filter would take the cut for the object's edge and put a bright
 * rim and cups of hundreds of HU into the field of view.
 *
 * The object beyond an edge is modelled as an ellipse (Hsieh et al. 2004 with the
 * curvature from the row itself in place of water's): the square of its line
 * integrals is a parabola,
 *
 *   p^2(x) = a + b x + c x^2,  x in columns outwards from the outermost one.
 *
 * c is that of the parabola fitted to p^2 over all of the row where it is not
 * air; a and b are fitted to the columns beside the edge with that c. b is at
 * most 0, and c at least so steep that the row ends within `extend` columns. The
 * scale of p has no part in it. What it does to the scan of an abdomen cut to
 * the middle 60 % of the detector: the mean error is 87 HU without, 63 with the
 * mirrored rows of Ohnesorge et al. 2000 over half of the row's width, 15 with
 * water's curvature and 3 with this; of an object two thirds larger: 709, 67, 7 and 13.
 *
 * Rows that are cut inside of a shell of bone, or within the bone, are no such parabola: see core/truncation_bone.h.
 *
 * A side is cut off where the mean of its outermost columns is all of
 *
 *   not air     TRUNCATION_SHARE, 5 %, of the photons, above the drift of a tube, or of
 *               the largest p of the view where that is below 1: the rows of a body
 *               that is cut off have more than a tenth of it there;
 *   not its end the line through the outermost columns is not air where it leaves the
 *               detector: an object that ends within an edge of many columns is whole;
 *   not chance  three times the deviation that noise gives to that mean, noise as
 *               estimated from the second differences of the columns beside the edge,
 *               of 16 at least: from fewer it is often too small by chance.
 *
 * So an object of any p is extended alike: an abdomen whose largest p is 4, or
 * 0.0004, is right by 6 HU, by 169 without. Nothing but the view has a part in it,
 * before any weight: the same on every backend and for views in any order. A side
 * where FDK pads the detector (plan_options.pad, displaced) is never extended: its
 * weights end in 0. The extension gets the weight of the outermost column and its
 * own cosine.
 *
 * Also read by nvcc: no libc but <math.h>.
 */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>

#ifdef __CUDACC__
#define TRUNCATION_INLINE static __host__ __device__ inline
#else
#define TRUNCATION_INLINE static inline
#endif

#define TRUNCATION_SHARE 0.05f

/* Columns at an edge whose mean decides, an eighth of all at most, and those that a and b are fitted to. */
TRUNCATION_INLINE int truncation_edge(int columns)
{
	int edge = columns < 32 ? columns / 8 : 4;

	if (edge < 1)
		edge = 1;
	return columns / 64 > edge ? columns / 64 : edge;
}
TRUNCATION_INLINE int truncation_window(int columns)
{
	int window = columns / 16 > 4 ? columns / 16 : 4;

	return window < columns ? window : columns;
}
/* Columns at an edge that noise is estimated from: of a small detector more than those of the fit. */
TRUNCATION_INLINE int truncation_bends(int columns)
{
	const int window = truncation_window(columns) > 16 ? truncation_window(columns) : 16;

	return window < columns ? window : columns;
}

/* The view's largest p is that of about 64 x 64 of its rays: of every so many columns and rows. */
TRUNCATION_INLINE int truncation_stride(int count)
{
	return count > 64 ? count / 64 : 1;
}
TRUNCATION_INLINE float truncation_largest(const float *view, int columns, int rows, size_t column_step,
					   size_t row_step)
{
	float largest = 0;

	for (int r = 0; r < rows; r += truncation_stride(rows))
		for (int c = 0; c < columns; c += truncation_stride(columns)) {
			const float value = view[(size_t)c * column_step + (size_t)r * row_step];

			largest = value > largest ? value : largest;
		}
	return largest;
}
/* Line integrals of at least this are not air. largest: the largest line integral of the view. */
TRUNCATION_INLINE float truncation_level(float largest)
{
	return TRUNCATION_SHARE * (largest < 1 ? largest : 1);
}
/* The same for the mean of many rays, in which there is less noise. */
TRUNCATION_INLINE float truncation_level_of_many(float largest)
{
	return 0.6f * truncation_level(largest);
}
/* True if the edge's mean is within 3 sigma of zero. bends: sum of squared second differences, expectation 6 sigma^2
 * each. */
TRUNCATION_INLINE bool truncation_is_chance(int columns, double sum, double bends)
{
	const int window = truncation_bends(columns);

	return window > 2 && 6 * (window - 2) * sum * sum < 9 * truncation_edge(columns) * bends;
}
/* Means of the outermost columns of a side, a quarter of truncation_edge, and of as many next to them. */
struct truncation_near {
	float outermost, next;
	int columns; /* of either */
};
TRUNCATION_INLINE struct truncation_near truncation_near(const float *p, ptrdiff_t step, int columns)
{
	struct truncation_near near = {0, 0, truncation_edge(columns) >= 4 ? truncation_edge(columns) / 4 : 1};

	for (int i = 0; i < near.columns; i++) {
		near.outermost += p[i * step];
		near.next += p[(columns > 1 ? i + near.columns : 0) * step];
	}
	near.outermost /= (float)near.columns;
	near.next /= (float)near.columns;
	return near;
}
/* The line through both is air where it leaves the detector: p falls there more steeply than any line. */
TRUNCATION_INLINE bool truncation_ends_within(struct truncation_near near, float level)
{
	return !(2 * near.outermost - near.next >= level);
}
/* A side of a row by its outermost column and the way from one to the next. */
TRUNCATION_INLINE bool truncation_is_cut(const float *p, ptrdiff_t step, int columns, float level)
{
	const int edge = truncation_edge(columns), window = truncation_bends(columns);
	double sum = 0, bends = 0;

	for (int i = 0; i < edge; i++)
		sum += (double)p[i * step];
	if (!(sum > 0) || sum < (double)level * edge ||
	    truncation_ends_within(truncation_near(p, step, columns), level))
		return false;
	for (int i = 1; i < window - 1; i++) {
		const double bend = (double)p[(i - 1) * step] - 2 * (double)p[i * step] + (double)p[(i + 1) * step];

		bends += bend * bend;
	}
	return !truncation_is_chance(columns, sum, bends);
}

/* x of a column in the fit of c, -1/2 .. 1/2. */
TRUNCATION_INLINE double truncation_x(int column, int columns)
{
	return ((double)column - 0.5 * (columns - 1)) * (1.0 / columns);
}

/* Over the columns of a row with p >= truncation_level, y = p^2. */
struct truncation_row_sums {
	double n, x, x2, x3, x4, y, xy, x2y;
};
/* Over the truncation_window outermost columns of a side, column i from the edge at x = -i, y = max(p, 0)^2. */
struct truncation_edge_sums {
	double y, xy;
};
/*
 * The extension of a row beyond one of its sides: the ellipse's p^2 = a + b x + c x^2, the shell and the cap of
 * core/truncation_bone.h, which has truncation_value.
 */
struct extension {
	float a, b, c;
	/*
	 * share: how far the shell is believed, 0 .. 1; outline: where it ends, columns beyond the outermost one's
	 * edge; half: half of its width, columns.
	 */
	float share, outline, half;
	float body, bone; /* A and B for columns */
	/* How far the cap is believed, 0 .. 1, and its p^2 = a + b x. */
	float cap, cap_a, cap_b;
	int reach; /* columns beyond the outermost one behind which it is 0 */
};

TRUNCATION_INLINE void truncation_row_add(struct truncation_row_sums *sums, double x, double p)
{
	double y = p * p, x2 = x * x;

	sums->n += 1;
	sums->x += x;
	sums->x2 += x2;
	sums->x3 += x2 * x;
	sums->x4 += x2 * x2;
	sums->y += y;
	sums->xy += x * y;
	sums->x2y += x2 * y;
}

TRUNCATION_INLINE struct extension truncation_fit(int columns, int extend, const struct truncation_row_sums *row,
						  const struct truncation_edge_sums *edge)
{
	const int n = truncation_window(columns);
	/* Sums of i, i^2, i^3 over the window. */
	const double i1 = 0.5 * n * (n - 1), i2 = i1 * (2 * n - 1) / 3, i3 = i1 * i1;
	const double determinant = row->n * (row->x2 * row->x4 - row->x3 * row->x3) -
				   row->x * (row->x * row->x4 - row->x2 * row->x3) +
				   row->x2 * (row->x * row->x3 - row->x2 * row->x2);
	double a = edge->y / n, b = 0, c = 0, flattest, y, xy, spread = n * i2 - i1 * i1;
	struct extension result;

	if (determinant > 1e-9)
		c = (row->n * (row->x2 * row->x2y - row->x3 * row->xy) -
		     row->x * (row->x * row->x2y - row->xy * row->x2) +
		     row->y * (row->x * row->x3 - row->x2 * row->x2)) /
		    determinant / ((double)columns * columns);
	flattest = -a / ((double)extend * extend);
	if (c > flattest)
		c = flattest;
	y = edge->y - c * i2;
	xy = edge->xy + c * i3;
	if (spread > 0)
		b = (n * xy + i1 * y) / spread;
	if (b > 0)
		b = 0;
	a = (y + b * i1) / n;
	result.a = (float)(a > 0 ? a : 0);
	result.b = (float)b;
	result.c = (float)c;
	result.share = result.outline = result.half = result.body = result.bone = 0;
	result.cap = result.cap_a = result.cap_b = 0;
	result.reach = 0;
	return result;
}

#endif

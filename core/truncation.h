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
 * most 0, and c at least so steep that the row ends within `extend` columns. Where
 * p falls so steeply at the very edge that the outline must be near, as within the
 * bone of a skull, a and b are those of the outermost columns. The
 * scale of p has no part in it. What it does to the scan of an abdomen cut to
 * the middle 60 % of the detector: the mean error is 87 HU without, 63 with the
 * mirrored rows of Ohnesorge et al. 2000 over half of the row's width, 15 with
 * water's curvature and 3 with this; of an object two thirds larger: 709, 67, 7 and 13.
 *
 * Rows that are cut inside of a skull, or of another shell of bone, are no such
 * parabola: p rises towards the edge, b would be above 0, and an extension that is
 * level there and ends as the row's curvature says is five times as wide as the
 * bone, which lowers all of the field of view by 100 HU. There the object is
 * modelled as a body in a thin shell with the same outline, xl .. xr: chords through
 * the body are as sqrt(q), those through the shell as 1/sqrt(q) (its thickness over
 * the cosine to its normal),
 *
 *   p(x) = A sqrt(q) + B / sqrt(q),   q = (x - xl) (xr - x),
 *
 * with A and B, both at least 0, by least squares for each of SHELL_OUTLINES^2
 * outlines, the best of them refined by a parabola through its neighbours. How far
 * this shell and not the ellipse is believed, 0 .. 1, follows from how much better it
 * explains the row: see truncation_shell_share. A row of soft tissue, lungs or a pelvis
 * gets 0, and is extended by the ellipse alone. tests/bench/results/truncation.txt
 * has the table of cases and designs.
 *
 * A side is cut off where the mean of its outermost columns is all of
 *
 *   not air     TRUNCATION_SHARE, 5 %, of the photons, above the drift of a tube, or of
 *               the largest p of the view where that is below 1: the rows of a body
 *               that is cut off have more than a tenth of it there;
 *   not its end the line through the outermost columns is not air where it leaves the
 *               detector: an object that ends within an edge of many columns is whole;
 *   not chance  three times the deviation that noise gives to that mean, noise as
 *               estimated from the second differences of the columns beside the edge.
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
/* From the sum over the edge and that of squared second differences, six times the noise's variance each. */
TRUNCATION_INLINE bool truncation_is_chance(int columns, double sum, double bends)
{
	const int window = truncation_window(columns);

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
	const int edge = truncation_edge(columns), window = truncation_window(columns);
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
	return ((double)column - 0.5 * (columns - 1)) / columns;
}

/* Over the columns of a row with p >= truncation_level, y = p^2. */
struct truncation_row_sums {
	double n, x, x2, x3, x4, y, xy, x2y;
};
/* Over the truncation_window outermost columns of a side, column i from the edge at x = -i, y = max(p, 0)^2. */
struct truncation_edge_sums {
	double y, xy;
};
/* The extension of a row beyond one of its sides: the ellipse's p^2 = a + b x + c x^2, and the shell. */
struct extension {
	float a, b, c;
	/*
	 * share: how far the shell is believed, 0 .. 1; outline: where it ends, columns beyond the outermost one's
	 * edge; half: half of its width, columns.
	 */
	float share, outline, half;
	float body, bone; /* A and B for columns */
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

/* 1 where the line through both ends within four times their distance, 0 where it takes twice as many or more. */
TRUNCATION_INLINE double truncation_nearness(struct truncation_near near)
{
	const double fall = (double)near.next - (double)near.outermost;

	if (!(fall > 0))
		return 0;
	return fmin(fmax(2 - (double)near.outermost / (4 * fall), 0.0), 1.0);
}

TRUNCATION_INLINE struct extension truncation_fit(int columns, int extend, const struct truncation_row_sums *row,
						  const struct truncation_edge_sums *edge, struct truncation_near near)
{
	const int n = truncation_window(columns);
	/* Sums of i, i^2, i^3 over the window. */
	const double i1 = 0.5 * n * (n - 1), i2 = i1 * (2 * n - 1) / 3, i3 = i1 * i1;
	const double determinant = row->n * (row->x2 * row->x4 - row->x3 * row->x3) -
				   row->x * (row->x * row->x4 - row->x2 * row->x3) +
				   row->x2 * (row->x * row->x3 - row->x2 * row->x2);
	double a = edge->y / n, b = 0, c = 0, flattest, y, xy, spread = n * i2 - i1 * i1;
	double near_end;
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
	near_end = truncation_nearness(near);
	if (near_end > 0) {
		const double y0 = (double)near.outermost * (double)near.outermost;
		const double fall = (y0 - (double)near.next * (double)near.next) / near.columns;
		const double x0 = -0.5 * (near.columns - 1);

		/* The same parabola's slope at x = 0, through the outermost columns. */
		b += near_end * (fmin(fall + c * near.columns, b) - b);
		a += near_end * (y0 - b * x0 - c * x0 * x0 - a);
	}
	result.a = (float)(a > 0 ? a : 0);
	result.b = (float)b;
	result.c = (float)c;
	result.share = result.outline = result.half = result.body = result.bone = 0;
	return result;
}

/* ---- a body in a shell ---- */

/* Places across the row that the fit looks at, and outlines on either side. */
enum { SHELL_BINS = 64, SHELL_OUTLINES = 14 };

/* Errors of the ellipse, as of truncation_shell_share, between which a shell is looked for at all. */
#define SHELL_ELLIPSE_LEAST 0.0015f
#define SHELL_ELLIPSE_MOST 0.2f

/* Table of all outlines, made once for a plan. Unit: the object's width within the row, x = -1/2 .. 1/2. */
struct shell_table {
	float outline[SHELL_OUTLINES];          /* beyond x = 1/2 */
	float root[SHELL_OUTLINES][SHELL_BINS]; /* sqrt(x + 1/2 + outline), mirrored for the other side */
	float inverse[SHELL_OUTLINES][SHELL_BINS];
};

TRUNCATION_INLINE float shell_x(int bin)
{
	return ((float)bin + 0.5f) / SHELL_BINS - 0.5f;
}

TRUNCATION_INLINE struct shell_table shell_table_make(void)
{
	const double least = 0.015, most = 1;
	struct shell_table table;

	for (int i = 0; i < SHELL_OUTLINES; i++) {
		table.outline[i] = (float)(least * pow(most / least, i / (SHELL_OUTLINES - 1.0)));
		for (int bin = 0; bin < SHELL_BINS; bin++) {
			table.root[i][bin] = sqrtf(shell_x(bin) + 0.5f + table.outline[i]);
			table.inverse[i][bin] = 1 / table.root[i][bin];
		}
	}
	return table;
}

/*
 * Sums over the bins for an outline, and the A and B that fit best. In double: the residuals of neighbouring outlines
 * differ by less than the rounding of such sums in float, which would then choose among them, on each backend another.
 */
struct shell_fit {
	double body, bone; /* A and B */
	double residual;   /* sum of squares */
};
struct shell_sums {
	double rr, ii, pr, pi; /* products of root, inverse and p; root times inverse is 1 */
};

TRUNCATION_INLINE void shell_sums_add(struct shell_sums *sums, double root, double inverse, double p)
{
	sums->rr += root * root;
	sums->ii += inverse * inverse;
	sums->pr += p * root;
	sums->pi += p * inverse;
}

/* square: sum p^2 over the bins. */
TRUNCATION_INLINE struct shell_fit shell_solve(const struct shell_sums *sums, double square)
{
	const double n = SHELL_BINS, determinant = sums->rr * sums->ii - n * n;
	struct shell_fit fit;

	fit.body = (sums->pr * sums->ii - sums->pi * n) / determinant;
	fit.bone = (sums->pi * sums->rr - sums->pr * n) / determinant;
	if (!(fit.bone > 0)) {
		fit.bone = 0;
		fit.body = sums->pr / sums->rr;
	} else if (!(fit.body > 0)) {
		fit.body = 0;
		fit.bone = sums->pi / sums->ii;
	}
	fit.residual = fmax(square - fit.body * sums->pr - fit.bone * sums->pi, 0.0);
	return fit;
}

/* With the outlines i before the first bin and j behind the last one. */
TRUNCATION_INLINE struct shell_fit shell_try(const struct shell_table *table, const float bins[SHELL_BINS],
					     double square, int i, int j)
{
	struct shell_sums sums = {0, 0, 0, 0};

	for (int bin = 0; bin < SHELL_BINS; bin++)
		shell_sums_add(&sums, (double)table->root[i][bin] * (double)table->root[j][SHELL_BINS - 1 - bin],
			       (double)table->inverse[i][bin] * (double)table->inverse[j][SHELL_BINS - 1 - bin],
			       (double)bins[bin]);
	return shell_solve(&sums, square);
}

/* Between the outlines, at the lowest place of the parabola through the residuals of three neighbours. */
TRUNCATION_INLINE float shell_refined(const struct shell_table *table, const double residual[3], int i)
{
	const double bend = residual[0] - 2 * residual[1] + residual[2];
	double step;

	if (i == 0 || i == SHELL_OUTLINES - 1 || !(bend > 0))
		return table->outline[i];
	step = fmin(fmax(0.5 * (residual[0] - residual[2]) / bend, -1.0), 1.0);
	return table->outline[i] * powf(table->outline[1] / table->outline[0], (float)step);
}

TRUNCATION_INLINE float shell_ramp(float value, float none, float all)
{
	return fminf(fmaxf((value - none) / (all - none), 0), 1);
}

/*
 * How far the shell is believed: where the ellipse, p^2 a parabola, does not explain the row, the shell does so within
 * 2 % and better, bone has a share in it as in a skull, and its outline is near. `ellipse` and `shell` are root mean
 * square errors in units of the row's own root mean square; outline is the farther one, in units of the object's width
 * within the row. A wide body's row that is cut far from its outline is as well explained by either.
 */
TRUNCATION_INLINE float truncation_shell_share(float ellipse, float shell, const struct shell_fit *fit, float outline)
{
	const float bone = (float)(fit->bone / (fit->bone + 0.25 * fit->body));

	return shell_ramp(ellipse, SHELL_ELLIPSE_LEAST, 2 * SHELL_ELLIPSE_LEAST) *
	       shell_ramp(ellipse, 1.1f * shell, 1.3f * shell) * (1 - shell_ramp(shell, 0.02f, 0.035f)) *
	       shell_ramp(bone, 0.05f, 0.1f) * (1 - shell_ramp(bone, 0.3f, 0.4f)) *
	       (1 - shell_ramp(outline, 0.2f, 0.35f));
}

/* First column of a bin; the object lies in the columns first .. first + width - 1. Bin SHELL_BINS ends the last. */
TRUNCATION_INLINE int shell_bin_first(int first, int width, int bin)
{
	return first + (int)((long)width * bin / SHELL_BINS);
}
/* The mean of a bin's columns; of a row narrower than the bins, the nearest column. */
TRUNCATION_INLINE float shell_bin(const float *p, ptrdiff_t step, int first, int width, int bin)
{
	const int from = shell_bin_first(first, width, bin), to = shell_bin_first(first, width, bin + 1);
	float sum = p[from * step];

	for (int c = from + 1; c < to; c++)
		sum += p[c * step];
	return sum / (float)(to > from ? to - from : 1);
}

TRUNCATION_INLINE double shell_square(const float bins[SHELL_BINS])
{
	double square = 0;

	for (int bin = 0; bin < SHELL_BINS; bin++)
		square += (double)bins[bin] * (double)bins[bin];
	return square;
}
/* Most rows are explained by the ellipse well enough, or by nothing: those are not tried. */
TRUNCATION_INLINE bool shell_is_tried(float ellipse)
{
	return ellipse > SHELL_ELLIPSE_LEAST && ellipse < SHELL_ELLIPSE_MOST;
}

/* The root mean square error of p where p^2 is the parabola nearest to the bins' squares. */
TRUNCATION_INLINE float shell_ellipse_error(const float bins[SHELL_BINS], double square)
{
	struct truncation_row_sums sums = {0, 0, 0, 0, 0, 0, 0, 0};
	double c, b, a, spread, sum = 0;

	for (int bin = 0; bin < SHELL_BINS; bin++)
		truncation_row_add(&sums, (double)shell_x(bin), (double)bins[bin]);
	/* The bins lie evenly about 0: odd powers cancel. */
	spread = sums.n * sums.x4 - sums.x2 * sums.x2;
	c = (sums.n * sums.x2y - sums.x2 * sums.y) / spread;
	b = sums.xy / sums.x2;
	a = (sums.y - c * sums.x2) / sums.n;
	for (int bin = 0; bin < SHELL_BINS; bin++) {
		const double x = (double)shell_x(bin), y = a + x * (b + c * x);
		const double error = (double)bins[bin] - (y > 0 ? sqrt(y) : 0);

		sum += error * error;
	}
	return (float)sqrt(sum / square);
}

/*
 * The search for the best outlines: first among those that are the same on both sides, then on either side in turn,
 * twice. The k-th candidate of a step replaces `at`.
 */
enum { SHELL_STEPS = 5 };
struct shell_place {
	int at[2];
};
TRUNCATION_INLINE struct shell_place shell_candidate(struct shell_place place, int step, int k)
{
	if (step == 0)
		place.at[0] = place.at[1] = k;
	else
		place.at[(step - 1) % 2] = k;
	return place;
}
TRUNCATION_INLINE struct shell_place shell_search(const struct shell_table *table, const float bins[SHELL_BINS],
						  double square)
{
	struct shell_place place = {{0, 0}};

	for (int step = 0; step < SHELL_STEPS; step++) {
		struct shell_place best = place;
		double least = INFINITY;

		for (int k = 0; k < SHELL_OUTLINES; k++) {
			const struct shell_place next = shell_candidate(place, step, k);
			const double residual = shell_try(table, bins, square, next.at[0], next.at[1]).residual;

			if (residual < least) {
				least = residual;
				best = next;
			}
		}
		place = best;
	}
	return place;
}

/* The shell fitted to a row; share 0: there is none. */
struct shell {
	float share;
	float outlines[2]; /* before the first bin, behind the last one */
	struct shell_fit fit;
};

TRUNCATION_INLINE struct shell shell_make(const struct shell_table *table, const float bins[SHELL_BINS], double square,
					  float ellipse, struct shell_place place)
{
	const int *at = place.at;
	struct shell_sums sums = {0, 0, 0, 0};
	struct shell shell;

	for (int side = 0; side < 2; side++) {
		double residual[3];

		for (int k = -1; k < 2; k++) {
			int i = at[0] + (side == 0 ? k : 0), j = at[1] + (side == 1 ? k : 0);

			i = i < 0 ? 0 : i < SHELL_OUTLINES ? i : SHELL_OUTLINES - 1;
			j = j < 0 ? 0 : j < SHELL_OUTLINES ? j : SHELL_OUTLINES - 1;
			residual[k + 1] = shell_try(table, bins, square, i, j).residual;
		}
		shell.outlines[side] = shell_refined(table, residual, at[side]);
	}
	for (int bin = 0; bin < SHELL_BINS; bin++) {
		const float x = shell_x(bin);
		const double root = sqrt((double)((x + 0.5f + shell.outlines[0]) * (0.5f - x + shell.outlines[1])));

		shell_sums_add(&sums, root, 1 / root, (double)bins[bin]);
	}
	shell.fit = shell_solve(&sums, square);
	shell.share = truncation_shell_share(ellipse, (float)sqrt(shell.fit.residual / square), &shell.fit,
					     fmaxf(shell.outlines[0], shell.outlines[1]));
	return shell;
}

/* A sqrt(q) + B / sqrt(q), t columns beyond the outermost column's edge, below 0 within the row. */
TRUNCATION_INLINE float shell_at(const struct extension *extension, float t)
{
	const float q = (extension->outline - t) * (2 * extension->half - extension->outline + t);

	return q > 0 ? extension->body * sqrtf(q) + extension->bone / sqrtf(q) : 0;
}

/*
 * The shell for one side of a row, 0 before column 0; it is scaled to meet the truncation_window outermost columns,
 * whose sum is `measured`. width: of the object within the row, columns.
 */
TRUNCATION_INLINE void truncation_by_shell(struct extension *extension, const struct shell *shell, int side, int width,
					   float measured, int columns)
{
	const int window = truncation_window(columns);
	float explained = 0, scale;

	extension->share = shell->share;
	extension->outline = shell->outlines[side] * (float)width;
	extension->half = 0.5f * (1 + shell->outlines[0] + shell->outlines[1]) * (float)width;
	extension->body = (float)(shell->fit.body / width);
	extension->bone = (float)(shell->fit.bone * width);
	for (int i = 0; i < window; i++)
		explained += shell_at(extension, -(float)i - 0.5f);
	scale = explained > 0 ? fminf(fmaxf(measured / explained, 1.0f / 3), 3) : 0;
	extension->body *= scale;
	extension->bone *= scale;
}

/* The mean over the column x beyond the outermost one; 1/sqrt(q) is not finite at the outline, but its integral is. */
TRUNCATION_INLINE float shell_value(const struct extension *extension, int x)
{
	const float t = (float)x - 0.5f, middle = extension->outline - extension->half;
	const float from = fminf((t - 0.5f - middle) / extension->half, 1);
	const float to = fminf((t + 0.5f - middle) / extension->half, 1);
	const float q = (extension->outline - t) * (2 * extension->half - extension->outline + t);

	return extension->body * sqrtf(fmaxf(q, 0)) + extension->bone * (asinf(to) - asinf(from));
}

/* The line integral x columns beyond the outermost one; 0 from where the object ends. */
TRUNCATION_INLINE float truncation_value(const struct extension *extension, int x)
{
	float square = extension->a + (float)x * (extension->b + (float)x * extension->c);
	float value = square > 0 ? sqrtf(square) : 0;

	if (extension->share > 0)
		value += extension->share * (shell_value(extension, x) - value);
	return value;
}

#endif

#ifndef CBCT_CORE_TRUNCATION_BONE_H
#define CBCT_CORE_TRUNCATION_BONE_H

/*
 * Truncated rows that end in bone, beside core/truncation.h's ellipse, and the value of a row's extension.
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
 * gets 0, and is extended by the ellipse alone.
 *
 * Rows that are cut within the bone of a shell have a cusp beside the edge, where rays
 * leave what the shell surrounds; those beyond the cusp, the cap, cross bone alone:
 *
 *      p |                   cusp
 *        |   .  .  .  .  .   .
 *        |                 .   .
 *        |   body and shell      .    bone alone: p^2 falls along a line
 *        |                       :.
 *        |_______________________:_.____
 *                   edge of the detector, outline
 *
 * The line through the cap's p^2 ends where the bone does. It is the extension where
 * it ends within a few percent of the detector's width and noise leaves its slope known;
 * the shell is fitted to what lies between the cusps of both sides, cut off or not.
 * Neither depends on how many columns the detector has: the cap is as many as lie beyond the cusp.
 * tests/bench/results/truncation.txt has the table of cases and designs.
 *
 * Also read by nvcc.
 */
#include "core/truncation.h"

/* ---- the cap: what lies beyond the cusp of a shell ---- */

TRUNCATION_INLINE float truncation_ramp(float value, float none, float all)
{
	return fminf(fmaxf((value - none) / (all - none), 0), 1);
}

/* Columns whose mean is one place of the search for a cusp, and columns from the edge that are searched. */
TRUNCATION_INLINE int truncation_cusp_columns(int columns)
{
	return columns < 256 ? 1 : columns / 128;
}
TRUNCATION_INLINE int truncation_cusp_reach(int columns)
{
	return columns / 6;
}

/* A row from one of its sides, inwards from the detector's edge or from the object's outline, and its cusp there. */
struct truncation_end {
	const float *p;  /* outermost sample */
	ptrdiff_t step;  /* from one sample to the next one inwards */
	int count;       /* samples of the object */
	int columns;     /* of the detector */
	float deviation; /* standard deviation of the noise of one sample */
	int cap;         /* samples beyond the cusp; 0: there is none */
	float peak;      /* p at the cusp */
	float drop;      /* how far p falls behind the cusp beyond what noise does, in units of the peak */
	float a, b;      /* p^2 = a + b x beyond the edge, the line through the cap */
	float share;     /* how far that line is believed, 0 .. 1 */
};

/* Columns whose second differences tell the noise. */
TRUNCATION_INLINE int truncation_noise_window(int columns)
{
	return truncation_window(columns) > 8 ? truncation_window(columns) : 8;
}

/* From squared second differences over two windows; the smaller one, since one of them may have a cusp. */
TRUNCATION_INLINE float truncation_deviation(const struct truncation_end *end)
{
	const int window = truncation_noise_window(end->columns);
	double bends[2] = {0, 0};

	for (int k = 0; k < 2; k++)
		for (int i = 1; i < window - 1; i++) {
			const float *at = end->p + (k * window + i) * end->step;
			const double bend = (double)at[-end->step] - 2 * (double)at[0] + (double)at[end->step];

			bends[k] += bend * bend;
		}
	return (float)sqrt(fmin(bends[0], bends[1]) / (6 * (window - 2)));
}

/* The first peak inwards that p falls behind by 2 % of itself and more than noise. */
TRUNCATION_INLINE void truncation_find_cusp(struct truncation_end *end)
{
	const int mean = truncation_cusp_columns(end->columns), most = end->count / 4 - mean;
	const int reach = truncation_cusp_reach(end->columns) < most ? truncation_cusp_reach(end->columns) : most;
	const float noise = 3 * end->deviation / sqrtf((float)mean);
	float peak = 0, deepest = 0;
	double sum = 0;
	int at = 0, last = reach;
	bool behind = false;

	for (int i = 0; i < mean; i++)
		sum += (double)end->p[i * end->step];
	for (int i = 0; i <= last; i++) {
		const float value = (float)(sum / mean);

		sum += (double)end->p[(i + mean) * end->step] - (double)end->p[i * end->step];
		if (!behind && value > peak) {
			peak = value;
			at = i;
		} else if (value < 0.98f * peak - noise && (!behind || value < deepest)) {
			/* The fall is looked at over as many columns as the cap has. */
			if (!behind)
				last = 2 * (at + mean) < i ? i : 2 * (at + mean) < reach ? 2 * (at + mean) : reach;
			deepest = value;
			behind = true;
		}
	}
	if (!behind || at == 0)
		return;
	end->cap = at + mean / 2;
	end->peak = peak;
	end->drop = (peak - noise - deepest) / peak;
}

/* The line through p^2 of the cap; where that does not end near, as bone does, there is no cap. */
TRUNCATION_INLINE void truncation_fit_cap(struct truncation_end *end)
{
	const int n = end->cap > 2 ? end->cap : 2;
	/* Sums of i, i^2 over the cap. */
	const double i1 = 0.5 * n * (n - 1), i2 = i1 * (2 * n - 1) / 3, spread = i2 - i1 * i1 / n;
	double y = 0, xy = 0, a, b, doubt;
	float share;

	for (int i = 0; i < n; i++) {
		const double p = fmax((double)end->p[i * end->step], 0.0);

		y += p * p;
		xy -= i * p * p;
	}
	b = (xy + i1 * y / n) / spread;
	a = (y + b * i1) / n;
	share = b < 0 ? truncation_ramp(end->drop, 0.02f, 0.05f) *
			    (1 - truncation_ramp((float)(-a / b) / (float)end->columns, 0.06f, 0.12f))
		      : 0;
	if (!(share > 0)) {
		end->cap = 0;
		return;
	}
	/* The slope's standard deviation in units of the slope. */
	doubt = 2 * (double)end->peak * (double)end->deviation / sqrt(spread) / -b;
	end->a = (float)a;
	end->b = (float)b;
	end->share = share * (1 - truncation_ramp((float)doubt, 0.3f, 0.6f));
}

/* count: samples from the outermost one to where the object ends on the row's other side. */
TRUNCATION_INLINE struct truncation_end truncation_end_of(const float *p, ptrdiff_t step, int count, int columns)
{
	struct truncation_end end = {p, step, count, columns, 0, 0, 0, 0, 0, 0, 0};

	if (count < 2 * truncation_noise_window(columns))
		return end;
	end.deviation = truncation_deviation(&end);
	truncation_find_cusp(&end);
	if (end.cap > 0)
		truncation_fit_cap(&end);
	return end;
}

/* The extension by the cap of an end that is cut off. */
TRUNCATION_INLINE void truncation_by_cap(struct extension *extension, const struct truncation_end *end)
{
	extension->cap = end->share;
	extension->cap_a = end->a;
	extension->cap_b = end->b;
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

/*
 * How far the shell is believed: where the ellipse, p^2 a parabola, does not explain the row, the shell does so within
 * 2 % and better, bone has a share in it as in a skull, and its outline is near. `ellipse` and `shell` are root mean
 * square errors in units of the row's own root mean square; outline is the farther one, in units of the object's width
 * within the row. A wide body's row that is cut far from its outline is as well explained by either.
 */
TRUNCATION_INLINE float truncation_shell_share(float ellipse, float shell, const struct shell_fit *fit, float outline)
{
	const float bone = (float)(fit->bone / (fit->bone + 0.25 * fit->body));

	return truncation_ramp(ellipse, SHELL_ELLIPSE_LEAST, 2 * SHELL_ELLIPSE_LEAST) *
	       truncation_ramp(ellipse, 1.1f * shell, 1.3f * shell) * (1 - truncation_ramp(shell, 0.02f, 0.035f)) *
	       truncation_ramp(bone, 0.05f, 0.1f) * (1 - truncation_ramp(bone, 0.3f, 0.4f)) *
	       (1 - truncation_ramp(outline, 0.2f, 0.35f));
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

/*
 * The noise's part in the square of a fit's error, in units of the row's mean square; ends: of the row, square: sum
 * over the bins, width: columns in them.
 */
TRUNCATION_INLINE double shell_noise(const struct truncation_end ends[2], double square, int width)
{
	const double variance = 0.5 * ((double)ends[0].deviation * (double)ends[0].deviation +
				       (double)ends[1].deviation * (double)ends[1].deviation);

	return SHELL_BINS * variance / square / (width > SHELL_BINS ? (double)width / SHELL_BINS : 1);
}
TRUNCATION_INLINE float shell_without_noise(double error2, double noise)
{
	return (float)sqrt(fmax(error2 - noise, 0.0));
}

/* The shell fitted to a row; share 0: there is none. */
struct shell {
	float share;
	float outlines[2]; /* before the first bin, behind the last one */
	struct shell_fit fit;
};

/* noise: shell_noise. */
TRUNCATION_INLINE struct shell shell_make(const struct shell_table *table, const float bins[SHELL_BINS], double square,
					  float ellipse, double noise, struct shell_place place)
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
	shell.share = truncation_shell_share(shell_without_noise((double)ellipse * (double)ellipse, noise),
					     shell_without_noise(shell.fit.residual / square, noise), &shell.fit,
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
 * The shell for one side of a row, 0 before column 0; it is scaled to meet the truncation_window outermost columns
 * within the cusp, whose sum is `measured`. cap: columns beyond that; width: of the object within the cusps, columns.
 */
TRUNCATION_INLINE void truncation_by_shell(struct extension *extension, const struct shell *shell, int side, int cap,
					   int width, float measured, int columns)
{
	const int window = truncation_window(columns);
	float explained = 0, scale;

	extension->share = shell->share;
	extension->outline = shell->outlines[side] * (float)width - (float)cap;
	extension->half = 0.5f * (1 + shell->outlines[0] + shell->outlines[1]) * (float)width;
	extension->body = (float)(shell->fit.body / width);
	extension->bone = (float)(shell->fit.bone * width);
	for (int i = cap; i < cap + window; i++)
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
	if (extension->cap > 0)
		value += extension->cap * (sqrtf(fmaxf(extension->cap_a + (float)x * extension->cap_b, 0)) - value);
	return value;
}

#endif

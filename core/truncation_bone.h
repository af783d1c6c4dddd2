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

TRUNCATION_INLINE double truncation_bend2(const struct truncation_end *end, int i)
{
	const float *at = end->p + i * end->step;
	const double bend = (double)at[-end->step] - 2 * (double)at[0] + (double)at[end->step];

	return bend * bend;
}
/* From their sums over two windows; the smaller one, since one of them may have a cusp. */
TRUNCATION_INLINE float truncation_deviation(const double bends[2], int columns)
{
	return (float)sqrt(fmin(bends[0], bends[1]) / (6 * (truncation_noise_window(columns) - 2)));
}

/* Places at which a cusp is looked for, below 0: none. */
TRUNCATION_INLINE int truncation_cusp_last(const struct truncation_end *end)
{
	const int most = end->count / 4 - truncation_cusp_columns(end->columns);

	return truncation_cusp_reach(end->columns) < most ? truncation_cusp_reach(end->columns) : most;
}
/* Noise of the mean at a place: three standard deviations. */
TRUNCATION_INLINE float truncation_cusp_noise(const struct truncation_end *end)
{
	return 3 * end->deviation / sqrtf((float)truncation_cusp_columns(end->columns));
}
/* A mean that falls behind a peak by 2 % of it and more than noise. */
TRUNCATION_INLINE bool truncation_is_behind(float value, float peak, float noise)
{
	return value < 0.98f * peak - noise;
}
/* The fall behind a peak, first seen at `at`, is looked at over as many columns as the cap has: the last of them. */
TRUNCATION_INLINE int truncation_fall_last(int peak_at, int at, int mean, int last)
{
	const int cap = 2 * (peak_at + mean);

	return cap < at ? at : cap < last ? cap : last;
}
TRUNCATION_INLINE void truncation_set_cusp(struct truncation_end *end, int peak_at, float peak, float deepest)
{
	end->cap = peak_at + truncation_cusp_columns(end->columns) / 2;
	end->peak = peak;
	end->drop = (peak - truncation_cusp_noise(end) - deepest) / peak;
}

/* The first peak inwards that p falls behind. */
TRUNCATION_INLINE void truncation_find_cusp(struct truncation_end *end)
{
	const int mean = truncation_cusp_columns(end->columns), reach = truncation_cusp_last(end);
	const float noise = truncation_cusp_noise(end);
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
		} else if (truncation_is_behind(value, peak, noise) && (!behind || value < deepest)) {
			if (!behind)
				last = truncation_fall_last(at, i, mean, reach);
			deepest = value;
			behind = true;
		}
	}
	if (behind && at > 0)
		truncation_set_cusp(end, at, peak, deepest);
}

/* Samples whose p^2 the line through the cap is fitted to; their sums are of p^2 and of -i p^2. */
TRUNCATION_INLINE int truncation_cap_samples(const struct truncation_end *end)
{
	return end->cap > 2 ? end->cap : 2;
}
/* The line through the cap's p^2; where that does not end near, as bone does, there is no cap. */
TRUNCATION_INLINE void truncation_set_cap(struct truncation_end *end, double y, double xy)
{
	const int n = truncation_cap_samples(end);
	/* Sums of i, i^2 over the cap. */
	const double i1 = 0.5 * n * (n - 1), i2 = i1 * (2 * n - 1) / 3, spread = i2 - i1 * i1 / n;
	const double b = (xy + i1 * y / n) / spread, a = (y + b * i1) / n;
	double doubt;
	float share = b < 0 ? truncation_ramp(end->drop, 0.02f, 0.05f) *
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

/* An end whose cusp is still to be found. count: samples from the outermost one to where the object ends on the other
 * side. */
TRUNCATION_INLINE struct truncation_end truncation_end_start(const float *p, ptrdiff_t step, int count, int columns)
{
	struct truncation_end end = {p, step, count, columns, 0, 0, 0, 0, 0, 0, 0};

	return end;
}
/* Too few samples tell nothing of noise. */
TRUNCATION_INLINE bool truncation_end_is_known(const struct truncation_end *end)
{
	return end->count >= 2 * truncation_noise_window(end->columns);
}
TRUNCATION_INLINE struct truncation_end truncation_end_of(const float *p, ptrdiff_t step, int count, int columns)
{
	struct truncation_end end = truncation_end_start(p, step, count, columns);
	const int window = truncation_noise_window(columns);
	double bends[2] = {0, 0}, y = 0, xy = 0;

	if (!truncation_end_is_known(&end))
		return end;
	for (int k = 0; k < 2; k++)
		for (int i = 1; i < window - 1; i++)
			bends[k] += truncation_bend2(&end, k * window + i);
	end.deviation = truncation_deviation(bends, columns);
	truncation_find_cusp(&end);
	if (end.cap == 0)
		return end;
	for (int i = 0; i < truncation_cap_samples(&end); i++) {
		const double sample = fmax((double)p[i * step], 0.0);

		y += sample * sample;
		xy -= i * sample * sample;
	}
	truncation_set_cap(&end, y, xy);
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
	float outline[SHELL_OUTLINES]; /* beyond x = 1/2 */
	/* sqrt(x + 1/2 + outline), mirrored for the other side, and its inverse. */
	double root[SHELL_OUTLINES][SHELL_BINS], inverse[SHELL_OUTLINES][SHELL_BINS];
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
			const float root = sqrtf(shell_x(bin) + 0.5f + table.outline[i]);

			table.root[i][bin] = (double)root;
			table.inverse[i][bin] = (double)(1 / root);
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
		shell_sums_add(&sums, table->root[i][bin] * table->root[j][SHELL_BINS - 1 - bin],
			       table->inverse[i][bin] * table->inverse[j][SHELL_BINS - 1 - bin], (double)bins[bin]);
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

/* The parabola nearest to the squares of the bins, a + x (b + c x), and its squared error for p in one of them. */
struct shell_parabola {
	double a, b, c;
};
TRUNCATION_INLINE struct shell_parabola shell_parabola_of(const struct truncation_row_sums *sums)
{
	/* The bins lie evenly about 0: odd powers cancel. */
	const double spread = sums->n * sums->x4 - sums->x2 * sums->x2;
	struct shell_parabola parabola;

	parabola.c = (sums->n * sums->x2y - sums->x2 * sums->y) / spread;
	parabola.b = sums->xy / sums->x2;
	parabola.a = (sums->y - parabola.c * sums->x2) / sums->n;
	return parabola;
}
TRUNCATION_INLINE double shell_parabola_error(const struct shell_parabola *parabola, int bin, float value)
{
	const double x = (double)shell_x(bin), y = parabola->a + x * (parabola->b + parabola->c * x);
	const double error = (double)value - (y > 0 ? sqrt(y) : 0);

	return error * error;
}
/* The root mean square error of p where p^2 is that parabola. */
TRUNCATION_INLINE float shell_ellipse_error(const float bins[SHELL_BINS], double square)
{
	struct truncation_row_sums sums = {0, 0, 0, 0, 0, 0, 0, 0};
	struct shell_parabola parabola;
	double sum = 0;

	for (int bin = 0; bin < SHELL_BINS; bin++)
		truncation_row_add(&sums, (double)shell_x(bin), (double)bins[bin]);
	parabola = shell_parabola_of(&sums);
	for (int bin = 0; bin < SHELL_BINS; bin++)
		sum += shell_parabola_error(&parabola, bin, bins[bin]);
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

/* The outlines k = 0, 1, 2 about the best one of a side, for shell_refined. */
TRUNCATION_INLINE struct shell_place shell_neighbour(struct shell_place place, int side, int k)
{
	const int at = place.at[side] + k - 1;

	place.at[side] = at < 0 ? 0 : at < SHELL_OUTLINES ? at : SHELL_OUTLINES - 1;
	return place;
}
/* Adds a bin to the sums for refined outlines. */
TRUNCATION_INLINE void shell_refined_add(struct shell_sums *sums, const float outlines[2], int bin, float p)
{
	const float x = shell_x(bin);
	const double root = sqrt((double)((x + 0.5f + outlines[0]) * (0.5f - x + outlines[1])));

	shell_sums_add(sums, root, 1 / root, (double)p);
}
/* The shell of refined outlines. noise: shell_noise. */
TRUNCATION_INLINE struct shell shell_of(const float outlines[2], const struct shell_sums *sums, double square,
					float ellipse, double noise)
{
	struct shell shell;

	shell.outlines[0] = outlines[0];
	shell.outlines[1] = outlines[1];
	shell.fit = shell_solve(sums, square);
	shell.share = truncation_shell_share(shell_without_noise((double)ellipse * (double)ellipse, noise),
					     shell_without_noise(shell.fit.residual / square, noise), &shell.fit,
					     fmaxf(outlines[0], outlines[1]));
	return shell;
}
TRUNCATION_INLINE struct shell shell_make(const struct shell_table *table, const float bins[SHELL_BINS], double square,
					  float ellipse, double noise, struct shell_place place)
{
	struct shell_sums sums = {0, 0, 0, 0};
	float outlines[2];

	for (int side = 0; side < 2; side++) {
		double residual[3];

		for (int k = 0; k < 3; k++) {
			const struct shell_place next = shell_neighbour(place, side, k);

			residual[k] = shell_try(table, bins, square, next.at[0], next.at[1]).residual;
		}
		outlines[side] = shell_refined(table, residual, place.at[side]);
	}
	for (int bin = 0; bin < SHELL_BINS; bin++)
		shell_refined_add(&sums, outlines, bin, bins[bin]);
	return shell_of(outlines, &sums, square, ellipse, noise);
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

/* Columns beside the outline in which 1/sqrt(q) is integrated; farther from it its middle is its mean within 1e-4. */
#define SHELL_NEAR 16

/* The mean over the column x beyond the outermost one; 1/sqrt(q) is not finite at the outline, but its integral is. */
TRUNCATION_INLINE float shell_value(const struct extension *extension, int x)
{
	const float t = (float)x - 0.5f, middle = extension->outline - extension->half;
	float from, to, q;

	if (t < extension->outline - SHELL_NEAR)
		return shell_at(extension, t);
	from = fminf((t - 0.5f - middle) / extension->half, 1);
	to = fminf((t + 0.5f - middle) / extension->half, 1);
	q = (extension->outline - t) * (2 * extension->half - extension->outline + t);
	return extension->body * sqrtf(fmaxf(q, 0)) + extension->bone * (asinf(to) - asinf(from));
}

/* Completes an extension: from where those of its parts that are believed at all are 0, and 2 columns for rounding. */
TRUNCATION_INLINE void truncation_end_extension(struct extension *extension, int extend)
{
	const float a = extension->a, b = extension->b, c = extension->c, most = (float)extend;
	float reach = 0;

	if (extension->share < 1 && extension->cap < 1)
		reach = c < 0 ? (-b - sqrtf(fmaxf(b * b - 4 * a * c, 0))) / (2 * c) : most;
	if (extension->share > 0 && extension->cap < 1)
		reach = fmaxf(reach, extension->outline);
	if (extension->cap > 0)
		reach = fmaxf(reach, -extension->cap_a / extension->cap_b);
	extension->reach = (int)fminf(reach + 2, most);
}

/* The line integral x columns beyond the outermost one; 0 from where the object ends. */
TRUNCATION_INLINE float truncation_value(const struct extension *extension, int x)
{
	float square = extension->a + (float)x * (extension->b + (float)x * extension->c);
	float value = square > 0 ? sqrtf(square) : 0;

	if (x > extension->reach)
		return 0;
	if (extension->share > 0)
		value += extension->share * (shell_value(extension, x) - value);
	if (extension->cap > 0)
		value += extension->cap * (sqrtf(fmaxf(extension->cap_a + (float)x * extension->cap_b, 0)) - value);
	return value;
}

#endif

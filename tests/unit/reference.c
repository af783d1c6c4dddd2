#include "tests/unit/reference.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static size_t voxel_at(const struct grid *grid, int x, int y, int z)
{
	return ((size_t)z * (size_t)grid->size[1] + (size_t)y) * (size_t)grid->size[0] + (size_t)x;
}

/* ---- projection ---- */

/* Bilinear in the slice `i` of the axis `a`, held at the edges; at is in voxels. */
static double slice_sample(const struct grid *grid, const float *volume, int a, int i, const double at[3])
{
	double sum = 0;

	for (int corner = 0; corner < 4; corner++) {
		double weight = 1;
		int voxel[3], bit = 0;

		for (int k = 0; k < 3; k++) {
			double held, upper;
			int low;

			if (k == a) {
				voxel[k] = i;
				continue;
			}
			held = fmin(fmax(at[k], 0), grid->size[k] - 1);
			low = (int)fmin(floor(held), fmax(grid->size[k] - 2, 0));
			upper = held - low;
			voxel[k] = low + (corner >> bit & 1);
			weight *= corner >> bit & 1 ? upper : 1 - upper;
			bit++;
		}
		if (weight > 0)
			sum += weight * (double)volume[voxel_at(grid, voxel[0], voxel[1], voxel[2])];
	}
	return sum;
}

/*
 * The slice's part in the linear interpolation between slices: s from -1 to 1
 * slices away it counts with 1 - |s|, and at[b] has moved by slope s. Between
 * voxels that is a polynomial of the second degree, for which Simpson's rule is exact.
 */
static double slab_sample(const struct grid *grid, const float *volume, int a, int i, const double at[3], double slope)
{
	const int b = a == 0 ? 1 : 0;
	double cut[8] = {-1, 0, 1}, sum = 0;
	int cuts = 3;

	for (double k = ceil(at[b] - fabs(slope)); k <= at[b] + fabs(slope) && slope != 0 && cuts < 8; k++)
		if (fabs((k - at[b]) / slope) < 1)
			cut[cuts++] = (k - at[b]) / slope;
	for (int m = 1; m < cuts; m++)
		for (int n = m; n > 0 && cut[n] < cut[n - 1]; n--) {
			double higher = cut[n - 1];

			cut[n - 1] = cut[n];
			cut[n] = higher;
		}
	for (int m = 1; m < cuts; m++)
		for (int k = 0; k < 3; k++) {
			double s = cut[m - 1] + 0.5 * k * (cut[m] - cut[m - 1]);
			double moved[3] = {at[0], at[1], at[2]};

			moved[b] += slope * s;
			sum += (cut[m] - cut[m - 1]) / 6 * (k == 1 ? 4 : 1) * (1 - fabs(s)) *
			       slice_sample(grid, volume, a, i, moved);
		}
	return sum;
}

double reference_ray(const struct geometry *geometry, const struct grid *grid, int view_index, int column, int row,
		     const float *volume, double *ret_length)
{
	const struct view *view = &geometry->views[view_index];
	double s[3], d[3], enter = -INFINITY, leave = INFINITY, mm = 0, begin, end, sum = 0;
	int a = 0;

	*ret_length = 0;
	for (int i = 0; i < 3; i++) {
		double to = view->pixel0[i] - view->source[i] + column * view->column_step[i] + row * view->row_step[i];

		mm += to * to;
		s[i] = (view->source[i] - grid->origin[i]) / grid->spacing[i];
		d[i] = to / grid->spacing[i];
		if (fabs(d[i]) > fabs(d[a]))
			a = i;
	}
	for (int i = 0; i < 3; i++) {
		double low = (-.5 - s[i]) / d[i], high = (grid->size[i] - .5 - s[i]) / d[i];

		if (fabs(d[i]) < 1e-12) {
			if (s[i] < -.5 || s[i] > grid->size[i] - .5)
				return 0;
			continue;
		}
		enter = fmax(enter, fmin(low, high));
		leave = fmin(leave, fmax(low, high));
	}
	if (enter >= leave)
		return 0;
	begin = fmin(s[a] + enter * d[a], s[a] + leave * d[a]);
	end = fmax(s[a] + enter * d[a], s[a] + leave * d[a]);
	for (int i = 0; i < grid->size[a]; i++) {
		double part = fmin(i + .5, end) - fmax(i - .5, begin), at[3];

		if (part <= 0)
			continue;
		for (int k = 0; k < 3; k++)
			at[k] = s[k] + (i - s[a]) / d[a] * d[k];
		sum += part * slab_sample(grid, volume, a, i, at, d[a == 0 ? 1 : 0] / d[a]);
	}
	*ret_length = (end - begin) * sqrt(mm) / fabs(d[a]);
	return sum * sqrt(mm) / fabs(d[a]);
}

void reference_project(const struct geometry *geometry, const struct grid *grid, int view, const float *volume,
		       float *ret)
{
	double length;

	for (int row = 0; row < geometry->rows; row++)
		for (int column = 0; column < geometry->columns; column++)
			ret[(size_t)row * (size_t)geometry->columns + (size_t)column] =
			    (float)reference_ray(geometry, grid, view, column, row, volume, &length);
}

/* ---- backprojection ---- */

void reference_backproject(const struct geometry *geometry, const struct grid *grid, int view,
			   enum backprojection weight, const float *projection, double *sums, double *cover)
{
	const double isocentre[3] = {0};
	double matrix[12], column, row, distance;

	view_matrix(&geometry->views[view], matrix);
	distance = view_project(matrix, isocentre, &column, &row);
	for (size_t i = 0; i < grid_voxels(grid); i++) {
		const int at[3] = {(int)(i % (size_t)grid->size[0]),
				   (int)(i / (size_t)grid->size[0] % (size_t)grid->size[1]),
				   (int)(i / (size_t)grid->size[0] / (size_t)grid->size[1])};
		double point[3], depth, factor;
		int c, r;

		for (int k = 0; k < 3; k++)
			point[k] = grid->origin[k] + at[k] * grid->spacing[k];
		depth = view_project(matrix, point, &column, &row);
		factor = weight == BACKPROJECT_FDK ? distance / depth * (distance / depth) : 1;
		c = (int)floor(column);
		r = (int)floor(row);
		for (int corner = 0; corner < 4; corner++) {
			int cc = c + (corner & 1), rr = r + (corner >> 1);
			double w = (corner & 1 ? column - c : c + 1 - column) * (corner >> 1 ? row - r : r + 1 - row);

			if (cc < 0 || cc >= geometry->columns || rr < 0 || rr >= geometry->rows)
				continue;
			sums[i] += factor * w * (double)projection[(size_t)rr * (size_t)geometry->columns + (size_t)cc];
			if (cover != NULL)
				cover[i] += w;
		}
	}
}

/* ---- the ramp filter, as the sum that it is ---- */

static double cosine(const struct view *view, int column, int row)
{
	double ray[3], towards[3] = {-view->source[0], -view->source[1], 0};

	for (int i = 0; i < 3; i++)
		ray[i] = view->pixel0[i] - view->source[i] + column * view->column_step[i] + row * view->row_step[i];
	return vec_dot(ray, towards) / vec_norm(ray) / vec_norm(towards);
}

/* The convolution kernel of a response: its inverse transform. */
static double *kernel_of(const float *response, int length)
{
	double *kernel = calloc((size_t)length, sizeof(double));

	for (int n = 0; n < length; n++)
		for (int k = 0; k < length; k++)
			kernel[n] += (double)response[k <= length / 2 ? k : length - k] *
				     cos(2 * M_PI * ((double)k * n / length)) / length;
	return kernel;
}

/* The part of y(x) along x^2 that 1 and x do not hold: the curvature of the parabola nearest to y. */
static double curvature(const double *x, const double *y, int count)
{
	double mean = 0, x2 = 0, x3 = 0, along = 0, norm = 0;

	for (int i = 0; i < count; i++)
		mean += x[i] / count;
	for (int i = 0; i < count; i++) {
		x2 += pow(x[i] - mean, 2);
		x3 += pow(x[i] - mean, 3);
	}
	for (int i = 0; i < count; i++) {
		double t = x[i] - mean, q = t * t - x2 / count - (x2 > 0 ? t * x3 / x2 : 0);

		along += q * y[i];
		norm += q * q;
	}
	return norm > 1e-6 ? along / norm : 0;
}

double reference_not_air(const float *view, size_t pixels)
{
	double largest = 0;

	for (size_t i = 0; i < pixels; i++)
		largest = fmax(largest, (double)view[i]);
	return 0.05 * fmin(largest, 1);
}

/* Of a quarter of the outermost columns that decide, the k-th such stretch from the edge. */
static double side_mean(const float *row, int columns, bool behind, int k)
{
	const int edge = columns / 64 > 4 ? columns / 64 : 4, count = edge / 4;
	double mean = 0;

	for (int i = k * count; i < (k + 1) * count; i++)
		mean += (double)row[behind ? columns - 1 - i : i] / count;
	return mean;
}

bool reference_is_cut(const float *row, int columns, bool behind, double not_air)
{
	const int edge = columns / 64 > 4 ? columns / 64 : 4, wide = columns / 16 > 16 ? columns / 16 : 16;
	const int window = wide < columns ? wide : columns;
	double mean = 0, square = 0;

	for (int i = 0; i < edge; i++)
		mean += (double)row[behind ? columns - 1 - i : i] / edge;
	for (int i = 0; i < window - 2; i++) {
		const float *at = row + (behind ? columns - 3 - i : i);

		square += pow((double)at[0] - 2 * (double)at[1] + (double)at[2], 2) / (window - 2);
	}
	return mean > 0 && mean >= not_air && mean >= 3 * sqrt(square / 6 / edge) &&
	       2 * side_mean(row, columns, behind, 0) - side_mean(row, columns, behind, 1) >= not_air;
}

/* One side of a row that is cut off, by the words of core/truncation.h. */
static void truncation_row(const float *row, int columns, int extend, bool behind, double not_air, double *ret)
{
	const int window = columns / 16 > 4 ? columns / 16 : 4;
	double *x = calloc((size_t)columns, sizeof(double)), *y = calloc((size_t)columns, sizeof(double));
	double mean = 0, mean_x = 0, c, a, b = 0, xx = 0, xy = 0, first = 0;
	int count = 0;

	for (int i = 0; i < columns; i++) {
		double p = (double)row[behind ? columns - 1 - i : i];

		if (p >= not_air) {
			x[count] = -i;
			y[count++] = p * p;
		}
	}
	c = curvature(x, y, count);
	for (int i = 0; i < window; i++)
		first += pow(fmax(0, (double)row[behind ? columns - 1 - i : i]), 2) / window;
	c = fmin(c, -first / ((double)extend * extend));
	for (int i = 0; i < window; i++) {
		double p = fmax(0, (double)row[behind ? columns - 1 - i : i]);

		x[i] = -i;
		y[i] = p * p - c * i * i;
		mean_x += x[i] / window;
		mean += y[i] / window;
	}
	for (int i = 0; i < window; i++) {
		xx += (x[i] - mean_x) * (x[i] - mean_x);
		xy += (x[i] - mean_x) * (y[i] - mean);
	}
	b = fmin(0, xy / xx);
	a = mean - b * mean_x;
	a = fmax(0, a);
	for (int i = 1; i <= extend; i++)
		ret[i - 1] = sqrt(fmax(0, a + b * i + c * i * i));
	free(x);
	free(y);
}

/* A and B of a body in a shell with the outlines o, in units of the width, by least squares; returns the error's
 * square. */
static double fit_shell(const double *p, int bins, const double o[2], double ret[2])
{
	double qq = 0, ii = 0, pq = 0, pi = 0, error = 0;

	for (int k = 0; k < bins; k++) {
		const double x = (k + 0.5) / bins, root = sqrt((x + o[0]) * (1 - x + o[1]));

		qq += root * root;
		ii += 1 / (root * root);
		pq += p[k] * root;
		pi += p[k] / root;
	}
	ret[0] = (pq * ii - pi * bins) / (qq * ii - (double)bins * bins);
	ret[1] = (pi * qq - pq * bins) / (qq * ii - (double)bins * bins);
	if (ret[1] <= 0) {
		ret[0] = pq / qq;
		ret[1] = 0;
	} else if (ret[0] <= 0) {
		ret[0] = 0;
		ret[1] = pi / ii;
	}
	for (int k = 0; k < bins; k++) {
		const double x = (k + 0.5) / bins, root = sqrt((x + o[0]) * (1 - x + o[1]));

		error += pow(p[k] - ret[0] * root - ret[1] / root, 2);
	}
	return error;
}

static double ramp_between(double value, double none, double all)
{
	return fmin(fmax((value - none) / (all - none), 0), 1);
}

/* An end of a row's object: the noise of its samples, and the cap beyond its cusp. */
struct row_end {
	int outermost; /* column */
	double deviation, peak, drop;
	int cap;
	double a, b, share; /* of the line through p^2 of the cap */
};

/* Sample i from an end. */
static double sample_of(const float *row, const struct row_end *end, bool behind, int i)
{
	return (double)row[behind ? end->outermost - i : end->outermost + i];
}

static double noise_of(const float *row, const struct row_end *end, bool behind, int from, int window)
{
	double square = 0;

	for (int i = from + 1; i < from + window - 1; i++)
		square += pow(sample_of(row, end, behind, i - 1) - 2 * sample_of(row, end, behind, i) +
				  sample_of(row, end, behind, i + 1),
			      2) /
			  6 / (window - 2);
	return sqrt(square);
}

static void find_cap(const float *row, int columns, int count, bool behind, struct row_end *end)
{
	const int window = columns / 16 > 8 ? columns / 16 : 8, mean = columns < 256 ? 1 : columns / 128;
	const int reach = columns / 6 < count / 4 - mean ? columns / 6 : count / 4 - mean;
	double *means = calloc((size_t)columns, sizeof(double)), noise, deepest = INFINITY;
	int peak = 0, found = -1;

	if (count < 2 * window)
		goto out;
	end->deviation = fmin(noise_of(row, end, behind, 0, window), noise_of(row, end, behind, window, window));
	noise = 3 * end->deviation / sqrt(mean);
	for (int i = 0; i <= reach; i++)
		for (int k = 0; k < mean; k++)
			means[i] += sample_of(row, end, behind, i + k) / mean;
	for (int i = 0; i <= reach && found < 0; i++) {
		if (means[i] > means[peak])
			peak = i;
		if (means[i] < 0.98 * means[peak] - noise)
			found = i;
	}
	if (found < 0 || peak == 0)
		goto out;
	for (int i = found; i <= reach && (i == found || i <= 2 * (peak + mean)); i++)
		deepest = fmin(deepest, means[i]);
	end->cap = peak + mean / 2;
	end->peak = means[peak];
	end->drop = (means[peak] - noise - deepest) / means[peak];
out:
	free(means);
}

/* The line through p^2 of the cap; none where that does not end near. */
static void fit_cap(const float *row, int columns, bool behind, struct row_end *end)
{
	const int n = end->cap > 2 ? end->cap : 2;
	double mean = 0, mean_x = -(n - 1) / 2.0, xx = 0, xy = 0;

	for (int i = 0; i < n; i++)
		mean += pow(fmax(0, sample_of(row, end, behind, i)), 2) / n;
	for (int i = 0; i < n; i++) {
		xx += pow(-i - mean_x, 2);
		xy += (-i - mean_x) * (pow(fmax(0, sample_of(row, end, behind, i)), 2) - mean);
	}
	end->b = xy / xx;
	end->a = mean - end->b * mean_x;
	if (end->b < 0)
		end->share =
		    ramp_between(end->drop, 0.02, 0.05) * (1 - ramp_between(end->a / -end->b / columns, 0.06, 0.12));
	if (end->share > 0)
		end->share *= 1 - ramp_between(2 * end->peak * end->deviation / sqrt(xx) / -end->b, 0.3, 0.6);
	else
		end->cap = 0;
}

/* The outlines that fit best, of 14 on either side; their share. noise: mean square of it in a bin. */
static double find_shell(const double *p, int bins, double noise, double o[2], double ret[2])
{
	double squares[64], x[64], square = 0, ellipse = 0, fitted, outlines[14], a = 0, b = 0, c, x2 = 0, errors[3];
	int at[2] = {0, 0};

	for (int i = 0; i < 14; i++)
		outlines[i] = 0.015 * pow(1 / 0.015, i / 13.0);
	for (int k = 0; k < bins; k++) {
		x[k] = (k + 0.5) / bins - 0.5;
		squares[k] = p[k] * p[k];
		square += squares[k];
		x2 += x[k] * x[k];
		b += x[k] * squares[k];
	}
	c = curvature(x, squares, bins);
	b /= x2;
	a = (square - c * x2) / bins;
	for (int k = 0; k < bins; k++)
		ellipse += pow(p[k] - sqrt(fmax(0, a + x[k] * (b + c * x[k]))), 2);
	ellipse = sqrt(ellipse / square);
	if (!(ellipse > 0.0015 && ellipse < 0.2))
		return 0;
	for (int step = 0; step < 5; step++) {
		double least = INFINITY;
		int best = 0;

		for (int k = 0; k < 14; k++) {
			const double tried[2] = {outlines[step == 0 || step % 2 == 1 ? k : at[0]],
						 outlines[step % 2 == 0 ? k : at[1]]};
			const double error = fit_shell(p, bins, tried, ret);

			if (error < least) {
				least = error;
				best = k;
			}
		}
		if (step == 0 || step % 2 == 1)
			at[0] = best;
		if (step % 2 == 0)
			at[1] = best;
	}
	for (int side = 0; side < 2; side++) {
		double shift = 0;

		for (int k = -1; k < 2; k++) {
			double tried[2] = {outlines[at[0]], outlines[at[1]]};

			tried[side] = outlines[(int)fmin(fmax(at[side] + k, 0), 13)];
			errors[k + 1] = fit_shell(p, bins, tried, ret);
		}
		if (at[side] > 0 && at[side] < 13 && errors[0] - 2 * errors[1] + errors[2] > 0)
			shift =
			    fmin(fmax((errors[0] - errors[2]) / 2 / (errors[0] - 2 * errors[1] + errors[2]), -1), 1);
		o[side] = outlines[at[side]] * pow(1 / 0.015, shift / 13);
	}
	fitted = sqrt(fmax(0, fit_shell(p, bins, o, ret) / square - noise * bins / square));
	ellipse = sqrt(fmax(0, ellipse * ellipse - noise * bins / square));
	return ramp_between(ellipse, 0.0015, 0.003) * ramp_between(ellipse, 1.1 * fitted, 1.3 * fitted) *
	       (1 - ramp_between(fitted, 0.02, 0.035)) * ramp_between(ret[1] / (ret[1] + ret[0] / 4), 0.05, 0.1) *
	       (1 - ramp_between(ret[1] / (ret[1] + ret[0] / 4), 0.3, 0.4)) *
	       (1 - ramp_between(fmax(o[0], o[1]), 0.2, 0.35));
}

/* The extension of one side moved towards that of a body in a shell and of the bone's cap, where that is what the row
 * shows. */
static void extend_by_bone(const float *row, int columns, int extend, bool behind, const bool cut[2], double not_air,
			   double *ret)
{
	enum { BINS = 64 };
	const int window = columns / 16 > 4 ? columns / 16 : 4;
	double p[BINS] = {0}, o[2] = {0}, fit[2], share, noise, measured = 0, explained = 0, half, outline;
	struct row_end ends[2] = {{.outermost = 0}, {.outermost = columns - 1}};
	int width;

	while (!cut[0] && ends[0].outermost < columns - 1 && (double)row[ends[0].outermost] < not_air)
		ends[0].outermost++;
	while (!cut[1] && ends[1].outermost > ends[0].outermost && (double)row[ends[1].outermost] < not_air)
		ends[1].outermost--;
	width = ends[1].outermost - ends[0].outermost + 1;
	for (int side = 0, count = width; side < 2; side++) {
		find_cap(row, columns, count, side == 1, &ends[side]);
		if (ends[side].cap > 0)
			fit_cap(row, columns, side == 1, &ends[side]);
		width -= ends[side].cap;
	}
	for (int k = 0; k < BINS; k++) {
		const int from = ends[0].outermost + ends[0].cap + width * k / BINS,
			  to = ends[0].outermost + ends[0].cap + width * (k + 1) / BINS;

		for (int c = from; c < to || c == from; c++)
			p[k] += (double)row[c] / (to > from ? to - from : 1);
	}
	noise = (pow(ends[0].deviation, 2) + pow(ends[1].deviation, 2)) / 2 / fmax(1, (double)width / BINS);
	share = find_shell(p, BINS, noise, o, fit);
	half = (1 + o[0] + o[1]) / 2 * width;
	outline = o[behind] * width - ends[behind].cap;
	for (int i = ends[behind].cap; i < ends[behind].cap + window && share > 0; i++) {
		const double q = (outline + i + 0.5) * (2 * half - outline - i - 0.5);

		measured += sample_of(row, &ends[behind], behind, i);
		explained += q > 0 ? fit[0] / width * sqrt(q) + fit[1] * width / sqrt(q) : 0;
	}
	for (int i = 1; i <= extend && share > 0; i++) {
		const double q = (outline - i + 0.5) * (2 * half - outline + i - 0.5), middle = outline - half;
		const double from = fmin(1, (i - 1 - middle) / half), to = fmin(1, (i - middle) / half);
		const double shell = fit[0] / width * sqrt(fmax(0, q)) + fit[1] * width * (asin(to) - asin(from));

		ret[i - 1] += share * (fmin(fmax(measured / explained, 1. / 3), 3) * shell - ret[i - 1]);
	}
	for (int i = 1; i <= extend; i++)
		ret[i - 1] += ends[behind].share * (sqrt(fmax(0, ends[behind].a + ends[behind].b * i)) - ret[i - 1]);
}

void reference_filter(const struct plan_options *options, int view, const float *projection, float *ret)
{
	const struct geometry *geometry = options->geometry;
	const int columns = geometry->columns, wide = options->pad[0] + columns + options->pad[1];
	const int extend = options->extend;
	double *kernels[2] = {kernel_of(options->filter_response, filter_length(wide)), NULL};
	double *line = calloc((size_t)(columns + 2 * extend), sizeof(double));
	double *beyond = calloc((size_t)extend + 1, sizeof(double));
	const double not_air = reference_not_air(projection, (size_t)columns * (size_t)geometry->rows);

	if (extend > 0)
		kernels[1] = kernel_of(options->extended_response, filter_length(wide + extend));
	for (int row = 0; row < geometry->rows; row++) {
		const float *from = projection + (size_t)row * (size_t)columns;
		bool extended = false, cut[2] = {false, false};

		for (int side = 0; side < 2 && extend > 0; side++)
			cut[side] = options->pad[side] == 0 && reference_is_cut(from, columns, side == 1, not_air);
		for (int c = -extend; c < columns + extend; c++)
			line[c + extend] = c >= 0 && c < columns ? (double)from[c] : 0;
		for (int side = 0; side < 2 && extend > 0; side++) {
			if (!cut[side])
				continue;
			truncation_row(from, columns, extend, side == 1, not_air, beyond);
			extend_by_bone(from, columns, extend, side == 1, cut, not_air, beyond);
			extended = true;
			for (int i = 0; i < extend; i++)
				line[side == 1 ? extend + columns + i : extend - 1 - i] = beyond[i];
		}
		for (int to = 0; to < wide; to++) {
			double sum = 0;

			for (int c = -extend; c < columns + extend; c++) {
				int nearest = c < 0 ? 0 : c < columns ? c : columns - 1;

				if (line[c + extend] != 0)
					sum += kernels[extended][abs(to - options->pad[0] - c)] *
					       cosine(&geometry->views[view], c, row) *
					       (double)options
						   ->column_weights[(size_t)view * (size_t)columns + (size_t)nearest] *
					       line[c + extend];
			}
			ret[(size_t)row * (size_t)wide + (size_t)to] = (float)sum;
		}
	}
	free(beyond);
	free(line);
	free(kernels[0]);
	free(kernels[1]);
}

/* ---- SART ---- */

/* Corrections of one view; what they are made from is added to sums. */
static void corrections(const struct geometry *geometry, const struct grid *grid, int view, const float *measured,
			const float *volume, float *ret, struct iteration_sums *sums)
{
	const double least = RAY_LENGTH_LEAST * fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);

	for (int row = 0; row < geometry->rows; row++) {
		for (int column = 0; column < geometry->columns; column++) {
			const size_t at = (size_t)row * (size_t)geometry->columns + (size_t)column;
			double length, integral = reference_ray(geometry, grid, view, column, row, volume, &length);
			double difference = (double)measured[at] - integral;

			if (isnan(measured[at])) { /* RAY_LEFT_OUT */
				ret[at] = 0;
				continue;
			}
			sums->residual2 += difference * difference;
			sums->projection2 += (double)measured[at] * (double)measured[at];
			ret[at] = length >= least ? (float)(difference / length) : 0;
		}
	}
}

struct iteration_sums reference_sart(const struct geometry *geometry, const struct grid *grid,
				     const struct sart_options *options, const float *projections, float *volume)
{
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows, voxels = grid_voxels(grid);
	float *correction = malloc(pixels * sizeof(float));
	double *sums = malloc(voxels * sizeof(double)), *cover = malloc(voxels * sizeof(double));
	struct iteration_sums ret = {0};

	for (int s = 0; s < options->subsets.count; s++) {
		memset(sums, 0, voxels * sizeof(double));
		memset(cover, 0, voxels * sizeof(double));
		for (int i = options->subsets.start[s]; i < options->subsets.start[s + 1]; i++) {
			int view = options->subsets.order[i];

			corrections(geometry, grid, view, projections + (size_t)view * pixels, volume, correction,
				    &ret);
			reference_backproject(geometry, grid, view, BACKPROJECT_PLAIN, correction, sums, cover);
		}
		for (size_t i = 0; i < voxels; i++) {
			if (cover[i] == 0)
				continue;
			volume[i] = (float)((double)volume[i] + options->relaxation * sums[i] / cover[i]);
			if (options->nonnegative && volume[i] < 0)
				volume[i] = 0;
		}
	}
	free(cover);
	free(sums);
	free(correction);
	return ret;
}

/* ---- total variation ---- */

static void differences(const struct grid *grid, const double *u, int x, int y, int z, double ret[3])
{
	const int at[3] = {x, y, z};
	const double least = fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	const double here = u[voxel_at(grid, x, y, z)];

	for (int i = 0; i < 3; i++) {
		int next[3] = {x, y, z};

		next[i]++;
		ret[i] = at[i] + 1 < grid->size[i]
			     ? least / grid->spacing[i] * (u[voxel_at(grid, next[0], next[1], next[2])] - here)
			     : 0;
	}
}

double reference_variation(const struct grid *grid, const double *u)
{
	double sum = 0, d[3];

	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				differences(grid, u, x, y, z, d);
				sum += vec_norm(d);
			}
	return sum;
}

void reference_tv_gradient(const struct grid *grid, const struct tv_options *options, double epsilon, float *volume)
{
	const double least = fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	const size_t voxels = grid_voxels(grid);
	double *u = malloc(voxels * sizeof(double)), *f = malloc(voxels * sizeof(double));
	double(*p)[3] = malloc(voxels * sizeof(*p));

	for (size_t i = 0; i < voxels; i++)
		f[i] = u[i] = (double)volume[i] / options->unit;
	for (int step = 0; step < options->iterations; step++) {
		for (int z = 0; z < grid->size[2]; z++)
			for (int y = 0; y < grid->size[1]; y++)
				for (int x = 0; x < grid->size[0]; x++) {
					double d[3], norm;
					size_t i = voxel_at(grid, x, y, z);

					differences(grid, u, x, y, z, d);
					norm = sqrt(vec_dot(d, d) + epsilon * epsilon);
					for (int k = 0; k < 3; k++)
						p[i][k] = norm > 0 ? d[k] / norm : 0;
				}
		for (int z = 0; z < grid->size[2]; z++)
			for (int y = 0; y < grid->size[1]; y++)
				for (int x = 0; x < grid->size[0]; x++) {
					const size_t i = voxel_at(grid, x, y, z);
					double flow = 0;

					for (int k = 0; k < 3; k++) {
						int before[3] = {x, y, z};
						double weight = least / grid->spacing[k];

						before[k]--;
						flow += weight * p[i][k];
						if (before[k] >= 0)
							flow -= weight *
								p[voxel_at(grid, before[0], before[1], before[2])][k];
					}
					u[i] += options->step * (flow - options->alpha * (u[i] - f[i]));
				}
	}
	for (size_t i = 0; i < voxels; i++)
		volume[i] = (float)(u[i] * options->unit);
	free(p);
	free(f);
	free(u);
}

double reference_objective(const struct grid *grid, const struct tv_options *options, const float *volume,
			   const float *start)
{
	const size_t voxels = grid_voxels(grid);
	double *u = malloc(voxels * sizeof(double)), fidelity = 0, variation;

	for (size_t i = 0; i < voxels; i++) {
		double away = ((double)volume[i] - (double)start[i]) / options->unit;

		u[i] = (double)volume[i] / options->unit;
		fidelity += away * away;
	}
	variation = reference_variation(grid, u);
	free(u);
	return variation + options->alpha / 2 * fidelity;
}

/*
 * E w as a matrix, a row for each entry of E that lies inside of the grid: E_aa at a voxel with neighbours on both
 * sides along a, E_ab between four voxels. w_a of a voxel without a neighbour behind it along a is no variable: its
 * column stays empty.
 */
struct bend_row {
	size_t column[4];
	double factor[4];
	int count, kind; /* kind: index into the six of a voxel */
	size_t voxel;
};

static bool has_behind(const struct grid *grid, const int at[3], int axis)
{
	return at[axis] + 1 < grid->size[axis];
}

/* Adds factor times the difference of w_a to the next voxel along b. */
static void add_difference(const struct grid *grid, struct bend_row *row, const int at[3], int a, int b, double factor)
{
	int next[3] = {at[0], at[1], at[2]};

	next[b]++;
	row->column[row->count] = 3 * voxel_at(grid, next[0], next[1], next[2]) + (size_t)a;
	row->factor[row->count++] = factor;
	row->column[row->count] = 3 * voxel_at(grid, at[0], at[1], at[2]) + (size_t)a;
	row->factor[row->count++] = -factor;
}

static size_t bend_rows(const struct grid *grid, struct bend_row *rows)
{
	const double least = fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	size_t count = 0;

	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++)
				for (int a = 0; a < 3; a++)
					for (int b = a; b < 3; b++) {
						int at[3] = {x, y, z};
						struct bend_row row = {.kind = a == b ? a : 2 + a + b,
								       .voxel = voxel_at(grid, x, y, z)};

						if (!has_behind(grid, at, a) || !has_behind(grid, at, b) ||
						    (a == b && at[a] == 0))
							continue;
						at[a] -= a == b;
						if (a == b) {
							add_difference(grid, &row, at, a, a, least / grid->spacing[a]);
						} else {
							add_difference(grid, &row, at, a, b,
								       least / grid->spacing[b] / 2);
							add_difference(grid, &row, at, b, a,
								       least / grid->spacing[a] / 2);
						}
						rows[count++] = row;
					}
	return count;
}

/* E w of each voxel, [voxel][6]; the last three count twice in the norm. */
static void bend(const struct bend_row *rows, size_t count, const double *w, double *ret)
{
	for (size_t i = 0; i < count; i++) {
		double sum = 0;

		for (int k = 0; k < rows[i].count; k++)
			sum += rows[i].factor[k] * w[rows[i].column[k]];
		ret[6 * rows[i].voxel + (size_t)rows[i].kind] = sum;
	}
}

static double bend_norm(const double e[6])
{
	return sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2] + 2 * (e[3] * e[3] + e[4] * e[4] + e[5] * e[5]));
}

/* sum |g - w| + TGV_BEND sum |E w|; e is worked in. */
static double slopes_cost(const struct bend_row *rows, size_t count, size_t voxels, const double *g, const double *w,
			  double *e)
{
	double sum = 0;

	memset(e, 0, 6 * voxels * sizeof(double));
	bend(rows, count, w, e);
	for (size_t i = 0; i < voxels; i++) {
		double d[3];

		for (int k = 0; k < 3; k++)
			d[k] = g[3 * i + (size_t)k] - w[3 * i + (size_t)k];
		sum += vec_norm(d) + TGV_BEND * bend_norm(e + 6 * i);
	}
	return sum;
}

/* w - g drawn towards 0 by tau, the prox of |w - g|; *ahead becomes 2 w' - w. */
static void draw(const double *g, double tau, const double *move, double *w, double *ahead)
{
	double d[3], length;

	for (int k = 0; k < 3; k++)
		d[k] = w[k] - tau * move[k] - g[k];
	length = vec_norm(d);
	for (int k = 0; k < 3; k++) {
		const double value = g[k] + (length > tau ? d[k] * (1 - tau / length) : 0);

		ahead[k] = 2 * value - w[k];
		w[k] = value;
	}
}

/* The least of slopes_cost over w: primal-dual steps whose primal part is the prox of |g - w| itself. */
static double least_slopes_cost(const struct grid *grid, const double *g)
{
	enum { STEPS = 600, EVERY = 50 };
	const size_t voxels = grid_voxels(grid);
	const double tau = 1, sigma = 1 / (13 * tau);
	struct bend_row *rows = malloc(6 * voxels * sizeof(*rows));
	const size_t count = bend_rows(grid, rows);
	double *w = calloc(3 * voxels, sizeof(double)), *ahead = calloc(3 * voxels, sizeof(double));
	double *q = calloc(6 * voxels, sizeof(double)), *e = calloc(6 * voxels, sizeof(double));
	double *move = malloc(3 * voxels * sizeof(double)), least = INFINITY;

	for (int step = 0; step <= STEPS; step++) {
		if (step % EVERY == 0)
			least = fmin(least, slopes_cost(rows, count, voxels, g, w, e));
		bend(rows, count, ahead, e);
		for (size_t i = 0; i < voxels; i++) {
			double norm;

			for (int k = 0; k < 6; k++)
				q[6 * i + (size_t)k] += sigma * e[6 * i + (size_t)k];
			norm = fmax(1, bend_norm(q + 6 * i) / TGV_BEND);
			for (int k = 0; k < 6; k++)
				q[6 * i + (size_t)k] /= norm;
		}
		memset(move, 0, 3 * voxels * sizeof(double));
		for (size_t i = 0; i < count; i++)
			for (int k = 0; k < rows[i].count; k++)
				move[rows[i].column[k]] += (rows[i].kind < 3 ? 1 : 2) * rows[i].factor[k] *
							   q[6 * rows[i].voxel + (size_t)rows[i].kind];
		for (size_t i = 0; i < voxels; i++)
			draw(g + 3 * i, tau, move + 3 * i, w + 3 * i, ahead + 3 * i);
	}
	free(move);
	free(e);
	free(q);
	free(ahead);
	free(w);
	free(rows);
	return least;
}

double reference_generalised_objective(const struct grid *grid, const struct tv_options *options, const float *volume,
				       const float *start)
{
	const size_t voxels = grid_voxels(grid);
	double *u = malloc(voxels * sizeof(double)), *g = malloc(3 * voxels * sizeof(double)), fidelity = 0, cost;

	for (size_t i = 0; i < voxels; i++) {
		double away = ((double)volume[i] - (double)start[i]) / options->unit;

		u[i] = (double)volume[i] / options->unit;
		fidelity += away * away;
	}
	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++)
				differences(grid, u, x, y, z, g + 3 * voxel_at(grid, x, y, z));
	cost = least_slopes_cost(grid, g);
	free(g);
	free(u);
	return cost + options->alpha / 2 * fidelity;
}

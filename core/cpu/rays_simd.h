#ifndef CBCT_CORE_RAYS_SIMD_H
#define CBCT_CORE_RAYS_SIMD_H

/*
 * Where rays run through the grid, in voxels: what the projection
 * (project_simd.c) and its transpose (matched_simd.c) must see alike, to the
 * last bit, to be a pair.
 */
#include "core/cpu/simd.h"

/* Rays of neighbouring pixels, one a lane, each with its own dominant axis a and the two others b < c. */
struct rays {
	int axis[LANES];
	float begin[LANES], end[LANES];       /* along a, in slices; begin >= end: misses the grid */
	float b[LANES], c[LANES];             /* where the ray crosses the middle slice, in voxels */
	float b_slope[LANES], c_slope[LANES]; /* voxels a slice */
	float step[LANES];                    /* mm a slice */
};

/*
 * Choice among three values, one for each axis: of_a that of the axis a, of_b and of_c those of the two others b < c.
 */
static inline double of_a(int a, double x, double y, double z)
{
	return a == 0 ? x : a == 1 ? y : z;
}

static inline double of_b(int a, double x, double y)
{
	return a == 0 ? y : x;
}

static inline double of_c(int a, double y, double z)
{
	return a == 2 ? y : z;
}

/* Rays to the pixels of a line: direction + lane step from the source, in voxels; all lanes at once, in vectors. */
static inline void rays_set(const struct plan *plan, const double source[3], const double direction[3],
			    const double step[3], int lanes, struct rays *ret)
{
	const int *size = plan->grid.size;
	const double *spacing = plan->grid.spacing, *s = source;
	double d[3][LANES], enter[LANES], leave[LANES];

	for (int l = 0; l < LANES; l++) { /* those behind the last repeat it */
		enter[l] = -INFINITY;
		leave[l] = INFINITY;
		for (int i = 0; i < 3; i++)
			d[i][l] = direction[i] + (l < lanes ? l : lanes - 1) * step[i];
	}
	/* source + t d lies in the grid from t = enter to leave */
	for (int i = 0; i < 3; i++) {
		for (int l = 0; l < LANES; l++) {
			const bool across = fabs(d[i][l]) < 1e-12;
			const double inverse = 1 / d[i][l];
			const double to_low = (-.5 - s[i]) * inverse, to_high = (size[i] - .5 - s[i]) * inverse;
			const double first = to_low < to_high ? to_low : to_high;
			const double last = to_low < to_high ? to_high : to_low;
			const double never = s[i] < -.5 || s[i] > size[i] - .5 ? -INFINITY : leave[l];

			enter[l] = across || enter[l] > first ? enter[l] : first;
			leave[l] = across ? never : leave[l] < last ? leave[l] : last;
		}
	}
	for (int l = 0; l < LANES; l++) {
		const double x = d[0][l], y = d[1][l], z = d[2][l];
		const int flat = fabs(y) > fabs(x), a = fabs(z) > fabs(flat ? y : x) ? 2 : flat;
		const double s_a = of_a(a, s[0], s[1], s[2]), d_a = of_a(a, x, y, z), inverse = 1 / d_a;
		const double b_slope = of_b(a, x, y) * inverse, c_slope = of_c(a, y, z) * inverse;
		const double to_middle = of_a(a, size[0] / 2, size[1] / 2, size[2] / 2) - s_a;
		const double at_enter = s_a + enter[l] * d_a, at_leave = s_a + leave[l] * d_a;
		const double mm2 = x * spacing[0] * (x * spacing[0]) + y * spacing[1] * (y * spacing[1]) +
				   z * spacing[2] * (z * spacing[2]);

		ret->axis[l] = leave[l] > enter[l] ? a : -1;
		ret->begin[l] = (float)(d_a > 0 ? at_enter : at_leave);
		ret->end[l] = (float)(d_a > 0 ? at_leave : at_enter);
		ret->b_slope[l] = (float)b_slope;
		ret->c_slope[l] = (float)c_slope;
		ret->b[l] = (float)(of_b(a, s[0], s[1]) + to_middle * b_slope);
		ret->c[l] = (float)(of_c(a, s[1], s[2]) + to_middle * c_slope);
		ret->step[l] = (float)(sqrt(mm2) * fabs(inverse));
	}
}

/* Index of the lower of two neighbours and the weight of the upper one, held at the ends of 0 .. size - 1. */
static inline vf neighbours(vf position, int size, vf *ret_upper)
{
	vf at = vf_clamp(position, vf_all(0), vf_all((float)(size - 1)));
	vf low = vf_min(vf_floor(at), vf_all((float)(size > 1 ? size - 2 : 0)));

	*ret_upper = at - low;
	return low;
}

/* kink(y) of project_simd.c, for slope = |b_slope| and its inverse. */
static inline vf kink(vf y, vf slope, vf inverse)
{
	vf part = vf_max(1 - vf_max(y, -y) * inverse, vf_all(0));

	return slope * (1 / 6.f) * part * part * part;
}

static const float SLOPE_LEAST = 1e-6f; /* below that there is no wandering, and its inverse stays finite */

/*
 * Weights of the four voxels j - 1 .. j + 2 across, held at 0 .. last, in a slice that is crossed at `at` with that
 * slope. Returns j.
 */
static inline int parts_across(double at, double slope, int last, float ret_part[4])
{
	const double wander = fabs(slope), held = at < 0 ? 0 : at > last ? last : at;
	const int j = (int)held < last ? (int)held : last > 0 ? last - 1 : 0;
	const double right = held - j;
	double kinks[2];

	for (int k = 0; k < 2; k++) {
		double inside = 1 - fabs(at - j - k) / fmax(wander, SLOPE_LEAST);

		kinks[k] = inside > 0 ? wander / 6 * inside * inside * inside : 0;
	}
	ret_part[0] = (float)kinks[0];
	ret_part[1] = (float)(1 - right - 2 * kinks[0] + kinks[1]);
	ret_part[2] = (float)(right + kinks[0] - 2 * kinks[1]);
	ret_part[3] = (float)kinks[1];
	return j;
}

/* Narrows *first .. *last to the slices i where low <= at + slope (i - middle) <= high. */
static inline void narrow(double at, double slope, int middle, double low, double high, int *first, int *last)
{
	double begin, end;

	if (fabs(slope) < 1e-9) {
		if (at < low || at > high)
			*last = *first - 1;
		return;
	}
	begin = ceil((slope > 0 ? low - at : high - at) / slope) + middle;
	end = floor((slope > 0 ? high - at : low - at) / slope) + middle;
	if (begin > *first)
		*first = begin > *last ? *last + 1 : (int)begin;
	if (end < *last)
		*last = end < *first ? *first - 1 : (int)end;
}

/* ---- untilted ---- */

/* The plane of rays to one column. Slices are counted along a, the axis in which all of them are fastest. */
struct fan {
	int a, b;                 /* x and y, or y and x */
	double enter, leave;      /* along a, where the plane meets the grid's sides */
	double source_a, inverse; /* slice i is q = (i - source_a) * inverse of the way to the detector */
	double source_b, direction_b;
	double source_z, direction_z, row_z; /* height at q: source_z + q (direction_z + row * row_z) */
	double across2;                      /* mm^2, of the way to the detector across z */
};

static inline void fan_set(const struct plan *plan, const struct cpu_view *view, int column, struct fan *ret)
{
	double d[3], mm2[2];

	for (int i = 0; i < 3; i++)
		d[i] = view->pixel0[i] + column * view->column_step[i];
	for (int i = 0; i < 2; i++)
		mm2[i] = d[i] * d[i] * plan->grid.spacing[i] * plan->grid.spacing[i];
	ret->a = fabs(d[1]) > fabs(d[0]);
	ret->b = 1 - ret->a;
	ret->source_a = view->source[ret->a];
	ret->inverse = 1 / d[ret->a];
	ret->source_b = view->source[ret->b];
	ret->direction_b = d[ret->b];
	ret->source_z = view->source[2];
	ret->direction_z = d[2];
	ret->row_z = view->row_step[2];
	ret->across2 = mm2[0] + mm2[1];
	ret->enter = -.5;
	ret->leave = plan->grid.size[ret->a] - .5;
	if (fabs(d[ret->b]) > 1e-12) {
		double low = ret->source_a + (-.5 - ret->source_b) / (ret->inverse * d[ret->b]);
		double high =
		    ret->source_a + (plan->grid.size[ret->b] - .5 - ret->source_b) / (ret->inverse * d[ret->b]);

		ret->enter = fmax(ret->enter, fmin(low, high));
		ret->leave = fmin(ret->leave, fmax(low, high));
	} else if (ret->source_b < -.5 || ret->source_b > plan->grid.size[ret->b] - .5) {
		ret->leave = ret->enter;
	}
}

#endif

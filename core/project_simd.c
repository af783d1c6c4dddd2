/*
 * Line integrals by Joseph's method (IEEE Trans. Med. Imaging 1, 1982): along
 * the axis on which the ray advances fastest, counted in voxels, one bilinear
 * sample in every slice. The object ends half a voxel beyond the outer centres,
 * with the outer values held there. The first and last slices count with the
 * part of them that lies between the ray's entry and exit, so that the weights
 * of a ray add up to its length inside the grid.
 */
#include "core/cpu.h"
#include "core/simd.h"

/* Rays of neighbouring pixels, one a lane, each with its own dominant axis a and the two others b < c. */
struct rays {
	int axis[LANES];
	float begin[LANES], end[LANES];       /* along a, in slices; begin >= end: misses the grid */
	float b[LANES], c[LANES];             /* where the ray crosses the middle slice, in voxels */
	float b_slope[LANES], c_slope[LANES]; /* voxels a slice */
	float step[LANES];                    /* mm a slice */
};

static const int others[3][2] = {{1, 2}, {0, 2}, {0, 1}};

/* Clips the ray to the grid: source + t direction, from t = *enter to *leave. */
static void ray_clip(const struct plan *plan, const double source[3], const double direction[3], double *ret_enter,
		     double *ret_leave)
{
	double enter = -INFINITY, leave = INFINITY;

	for (int i = 0; i < 3; i++) {
		double low = -.5 - source[i], high = plan->grid.size[i] - .5 - source[i];

		if (fabs(direction[i]) < 1e-12) {
			if (low > 0 || high < 0)
				leave = -INFINITY;
			continue;
		}
		low /= direction[i];
		high /= direction[i];
		enter = fmax(enter, fmin(low, high));
		leave = fmin(leave, fmax(low, high));
	}
	*ret_enter = enter;
	*ret_leave = leave;
}

static void ray_set(const struct plan *plan, const struct cpu_view *view, int column, int row, int lane,
		    struct rays *ret)
{
	double d[3], enter, leave, mm2 = 0, middle;
	int a = 0, b, c;

	for (int i = 0; i < 3; i++) {
		double mm;

		d[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
		mm = d[i] * plan->grid.spacing[i];
		mm2 += mm * mm;
	}
	for (int i = 1; i < 3; i++)
		if (fabs(d[i]) > fabs(d[a]))
			a = i;
	b = others[a][0];
	c = others[a][1];
	middle = plan->grid.size[a] / 2;
	ray_clip(plan, view->source, d, &enter, &leave);
	ret->axis[lane] = leave > enter ? a : -1;
	ret->begin[lane] = (float)(view->source[a] + (d[a] > 0 ? enter : leave) * d[a]);
	ret->end[lane] = (float)(view->source[a] + (d[a] > 0 ? leave : enter) * d[a]);
	ret->b_slope[lane] = (float)(d[b] / d[a]);
	ret->c_slope[lane] = (float)(d[c] / d[a]);
	ret->b[lane] = (float)(view->source[b] + (middle - view->source[a]) * d[b] / d[a]);
	ret->c[lane] = (float)(view->source[c] + (middle - view->source[a]) * d[c] / d[a]);
	ret->step[lane] = (float)(sqrt(mm2) / fabs(d[a]));
}

/*
 * The lanes of one axis; the others, and those that miss the grid, follow an
 * active lane with no weight, which keeps all indices close together.
 */
static bool rays_select(const struct rays *rays, int axis, struct rays *ret)
{
	int active = -1;

	for (int l = 0; l < LANES; l++)
		if (rays->axis[l] == axis)
			active = l;
	if (active < 0)
		return false;
	for (int l = 0; l < LANES; l++) {
		bool on = rays->axis[l] == axis;
		int from = on ? l : active;

		ret->begin[l] = on ? rays->begin[l] : 1e9f;
		ret->end[l] = on ? rays->end[l] : -1e9f;
		ret->b[l] = rays->b[from];
		ret->c[l] = rays->c[from];
		ret->b_slope[l] = rays->b_slope[from];
		ret->c_slope[l] = rays->c_slope[from];
	}
	return true;
}

/* Index of the lower of two neighbours and the weight of the upper one, held at the ends of 0 .. size - 1. */
static inline vi neighbours(vf position, int size, vf *ret_upper)
{
	vf at = vf_clamp(position, vf_all(0), vf_all((float)(size - 1)));
	vf low = vf_min(vf_floor(at), vf_all((float)(size > 1 ? size - 2 : 0)));

	*ret_upper = at - low;
	return vi_from(low);
}

struct axes {
	int slices, b_size, c_size;
	size_t slice, b_stride; /* floats */
	int c_stride;           /* 1, then pairs are gathered; or any */
};

/* Sum over the slices of weight * sample; per lane. */
static inline vf march(const struct rays *rays, const struct axes *axes, const float *volume)
{
	const vf begin = vf_load(rays->begin), end = vf_load(rays->end);
	const vf b0 = vf_load(rays->b), c0 = vf_load(rays->c);
	const vf b_slope = vf_load(rays->b_slope), c_slope = vf_load(rays->c_slope);
	const int b_next = axes->b_size > 1 ? (int)axes->b_stride : 0;
	const int c_next = axes->c_size > 1 ? axes->c_stride : 0;
	int first = (int)floorf(vf_lowest(begin) + .5f), last = (int)ceilf(vf_highest(end) - .5f);
	vf sum = vf_all(0);

	first = first < 0 ? 0 : first;
	last = last > axes->slices - 1 ? axes->slices - 1 : last;
	for (int i = first; i <= last; i++) {
		const float along = (float)(i - axes->slices / 2);
		vf weight = vf_min(vf_all((float)i + .5f), end) - vf_max(vf_all((float)i - .5f), begin);
		vf fb, fc, v00, v01, v10, v11;
		vi b = neighbours(b0 + along * b_slope, axes->b_size, &fb);
		vi c = neighbours(c0 + along * c_slope, axes->c_size, &fc);
		const float *slice = volume + (size_t)i * axes->slice + (size_t)b[0] * axes->b_stride +
				     (size_t)c[0] * (size_t)axes->c_stride;
		vi index = (b - b[0]) * (int)axes->b_stride + (c - c[0]) * axes->c_stride;

		if (axes->c_stride == 1) {
			vf_gather_pair(slice, index, &v00, &v01);
			vf_gather_pair(slice + b_next, index, &v10, &v11);
		} else {
			v00 = vf_gather(slice, index);
			v01 = vf_gather(slice + c_next, index);
			v10 = vf_gather(slice + b_next, index);
			v11 = vf_gather(slice + b_next + c_next, index);
		}
		v00 += fc * (v01 - v00);
		v10 += fc * (v11 - v10);
		v00 += fb * (v10 - v00);
		sum += vf_max(weight, vf_all(0)) * v00;
	}
	return sum;
}

static void project_rays(const struct plan *plan, const struct rays *rays, const float *volume, float *ret,
			 float *ret_length)
{
	const int *size = plan->grid.size;
	const struct axes axes[3] = {
	    {size[0], size[1], size[2], plan->row, plan->plane, 1},
	    {size[1], size[0], size[2], plan->plane, plan->row, 1},
	    {size[2], size[0], size[1], 1, plan->row, (int)plan->plane},
	};
	const vf step = vf_load(rays->step);
	vf sum = vf_all(0), length = vf_all(0);

	for (int a = 0; a < 3; a++) {
		struct rays selected;

		if (!rays_select(rays, a, &selected))
			continue;
		length += vf_max(vf_load(selected.end) - vf_load(selected.begin), vf_all(0));
		if (a < 2)
			sum += march(&selected, &axes[a], volume);
		else
			sum += march(&selected, &axes[2], volume);
	}
	vf_store(ret, sum * step);
	vf_store(ret_length, length * step);
}

static void project_general(const struct plan *plan, int view_index, int column, int count, const float *volume,
			    float *ret, float *ret_length, float *scratch)
{
	const struct cpu_view *view = &plan->view[view_index];
	const int lanes_along = plan->along_rows ? plan->rows : count;
	const int lines = plan->along_rows ? count : plan->rows;
	const size_t lane_stride = plan->along_rows ? 1 : (size_t)plan->rows;
	const size_t line_stride = plan->along_rows ? (size_t)plan->rows : 1;

	(void)scratch;
	for (int line = 0; line < lines; line++) {
		for (int first = 0; first < lanes_along; first += LANES) {
			struct rays rays;
			float sum[LANES], length[LANES];
			size_t at = (size_t)line * line_stride + (size_t)first * lane_stride;

			for (int l = 0; l < LANES; l++) {
				int i = first + l < lanes_along ? first + l : lanes_along - 1;

				ray_set(plan, view, column + (plan->along_rows ? line : i), plan->along_rows ? i : line,
					l, &rays);
			}
			project_rays(plan, &rays, volume, sum, length);
			for (int l = 0; l < LANES && first + l < lanes_along; l++) {
				ret[at + (size_t)l * lane_stride] = sum[l];
				ret_length[at + (size_t)l * lane_stride] = length[l];
			}
		}
	}
}

void SIMD_NAME(project)(const struct plan *plan, int view, int column, int count, const float *volume, float *ret,
			float *ret_length, float *scratch)
{
	project_general(plan, view, column, count, volume, ret, ret_length, scratch);
}

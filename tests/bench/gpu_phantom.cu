/*
 * Projections that are made on the card, where they would take longer to bring than to reconstruct: exact integrals of
 * ellipsoids, in double, apart from the backend's own projection in every line.
 */
#include "kernels/internal.cuh"
#include "tests/bench/gpu_phantom.h"

enum { PARTS_MOST = 12 };

/* Where an ellipsoid is the unit ball: the place `at` becomes (axis . (at - centre)) for each of the three. */
struct ball {
	double axis[3][3], centre[3], density;
};
struct phantom_job {
	struct ball balls[PARTS_MOST];
	int count, columns, rows, pitch;
	double source[3], pixel0[3], column_step[3], row_step[3];
	float *to;
};

static __global__ void __launch_bounds__(256) integrate(const __grid_constant__ phantom_job job)
{
	const int column = blockIdx.x * 64 + threadIdx.x, row = blockIdx.y * 4 + threadIdx.y;
	double d[3], length2 = 0, sum = 0;

	if (column >= job.columns || row >= job.rows)
		return;
	for (int i = 0; i < 3; i++) {
		d[i] = job.pixel0[i] + column * job.column_step[i] + row * job.row_step[i] - job.source[i];
		length2 += d[i] * d[i];
	}
	for (int k = 0; k < job.count; k++) {
		const struct ball &ball = job.balls[k];
		double ss = 0, sd = 0, dd = 0;

		for (int i = 0; i < 3; i++) {
			double s = 0, e = 0;

			for (int j = 0; j < 3; j++) {
				s += ball.axis[i][j] * (job.source[j] - ball.centre[j]);
				e += ball.axis[i][j] * d[j];
			}
			ss += s * s;
			sd += s * e;
			dd += e * e;
		}
		/* The chord of the unit ball, in units of d. */
		double inside = sd * sd - dd * (ss - 1);
		if (inside > 0)
			sum += ball.density * 2 * sqrt(inside) / dd;
	}
	job.to[(size_t)row * job.pitch + column] = (float)(sum * sqrt(length2));
}

static int describe(const struct phantom *phantom, phantom_job *job, struct error *err)
{
	if (phantom->count > PARTS_MOST)
		return error_set(err, ERR_INVALID, "%d parts of a phantom, at most %d", phantom->count, PARTS_MOST);
	job->count = phantom->count;
	for (int k = 0; k < phantom->count; k++) {
		const struct ellipsoid *part = &phantom->parts[k];
		const double c = cos(part->angle), s = sin(part->angle);
		const double turned[3][3] = {{c, s, 0}, {-s, c, 0}, {0, 0, 1}};

		if (part->shape != SHAPE_ELLIPSOID)
			return error_set(err, ERR_INVALID, "a part of the phantom is no ellipsoid");
		job->balls[k].density = part->density;
		for (int i = 0; i < 3; i++) {
			job->balls[k].centre[i] = part->centre[i];
			for (int j = 0; j < 3; j++)
				job->balls[k].axis[i][j] = turned[i][j] / part->semi_axes[i];
		}
	}
	return 0;
}

int gpu_phantom_project(const struct phantom *phantom, const struct geometry *geometry, const int *views,
			const int *slots, int count, struct stack *to, struct error *err)
{
	struct device *device = to->device;
	phantom_job job = {};

	TRY(describe(phantom, &job, err));
	TRY(device_enter(device, err));
	job.columns = to->shape.columns;
	job.rows = to->shape.rows;
	job.pitch = to->shape.pitch;
	for (int i = 0; i < count; i++) {
		const struct view *view = &geometry->views[views[i]];

		for (int k = 0; k < 3; k++) {
			job.source[k] = view->source[k];
			job.pixel0[k] = view->pixel0[k];
			job.column_step[k] = view->column_step[k];
			job.row_step[k] = view->row_step[k];
		}
		job.to = to->data + (size_t)slots[i] * to->shape.slot;
		integrate<<<dim3(divide_up(job.columns, 64), divide_up(job.rows, 4)), dim3(64, 4), 0, device->stream>>>(
		    job);
		LAUNCHED();
	}
	return mark_used(device, to->used, err);
}

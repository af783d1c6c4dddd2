/*
 * The algebra of iterative methods on volumes and stacks. The bits do not depend
 * on the number of threads: dots add up each plane or slot in one thread, and then
 * those in their order.
 */
#include "core/algebra.h"
#include "core/cpu/cpu.h"

/* Floats of a plane along y that belong to voxels; those behind them, up to volume.plane, do not. */
static size_t plane_floats(const struct volume *volume)
{
	return volume->row * (size_t)volume->size[0];
}
static float *plane(const struct volume *volume, int y)
{
	return volume->data + (size_t)y * volume->plane;
}

static size_t slot_floats(const struct stack *stack)
{
	return (size_t)stack->columns * (size_t)stack->rows;
}
static float *slot(const struct stack *stack, const int *slots, int i)
{
	return stack->data + slot_floats(stack) * (size_t)(slots != NULL ? slots[i] : i);
}

int cpu_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < y->size[1]; i++)
		algebra_axpby(plane_floats(y), (float)a, plane(x, i), (float)b, plane(y, i));
	return 0;
}

int cpu_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
		    struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		algebra_axpby(slot_floats(y), (float)a, slot(x, slots, i), (float)b, slot(y, NULL, i));
	return 0;
}

int cpu_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
		   struct error *err)
{
	double sum = 0;

	(void)err;
#pragma omp parallel for ordered num_threads(plan->device->threads) schedule(static, 1)
	for (int i = 0; i < y->size[1]; i++) {
		const double part = algebra_dot(plane_floats(y), plane(x, i), plane(y, i));

#pragma omp ordered
		sum += part;
	}
	*ret_sum = sum;
	return 0;
}

int cpu_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y, int count,
		  double *ret_sum, struct error *err)
{
	double sum = 0;

	(void)err;
#pragma omp parallel for ordered num_threads(plan->device->threads) schedule(static, 1)
	for (int i = 0; i < count; i++) {
		const float *xs = slot(x, NULL, i), *ys = slot(y, NULL, i);
		const double part = w == NULL ? algebra_dot(slot_floats(y), xs, ys)
					      : algebra_weighted_dot(slot_floats(y), slot(w, NULL, i), xs, ys);

#pragma omp ordered
		sum += part;
	}
	*ret_sum = sum;
	return 0;
}

int cpu_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < y->size[1]; i++)
		algebra_divide(plane_floats(y), plane(x, i), (float)least, plane(y, i));
	return 0;
}

int cpu_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		algebra_divide(slot_floats(y), slot(x, NULL, i), (float)least, slot(y, NULL, i));
	return 0;
}

int cpu_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		algebra_multiply(slot_floats(y), slot(x, NULL, i), slot(y, NULL, i));
	return 0;
}

int cpu_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < y->size[1]; i++)
		algebra_maximum(plane_floats(y), (float)a, plane(x, i), plane(y, i));
	return 0;
}

int cpu_stack_fill(struct stack *y, int count, float value, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		algebra_fill(slot_floats(y), value, slot(y, NULL, i));
	return 0;
}

int cpu_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		algebra_mask(slot_floats(y), slot(x, slots, i), slot(y, NULL, i));
	return 0;
}

int cpu_stack_average(struct stack *y, int at, const double width[2], struct stack *work, struct error *err)
{
	float *to = slot(y, NULL, at), *between = slot(work, NULL, 0);

	(void)err;
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int r = 0; r < y->rows; r++)
		for (int c = 0; c < y->columns; c++)
			between[(size_t)c * (size_t)y->rows + (size_t)r] =
			    algebra_mean_around(to + r, y->columns, (size_t)y->rows, c, width[0]);
#pragma omp parallel for num_threads(y->device->threads) schedule(static)
	for (int c = 0; c < y->columns; c++)
		for (int r = 0; r < y->rows; r++)
			to[(size_t)c * (size_t)y->rows + (size_t)r] =
			    algebra_mean_around(between + (size_t)c * (size_t)y->rows, y->rows, 1, r, width[1]);
	return 0;
}

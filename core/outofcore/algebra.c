/*
 * The algebra of iterative methods on volumes and stacks in the host's memory,
 * where they lie: taking them to the device would cost more than it saves. Dots
 * add up each slice or slot in one thread, and then those in their order.
 */
#include "core/algebra.h"
#include "core/outofcore/internal.h"

static float *slice(const struct volume *volume, int z)
{
	return volume->data + (size_t)z * volume->slice;
}
static float *slot(const struct stack *stack, const int *slots, int i)
{
	return stack->data + stack->pixels * (size_t)(slots != NULL ? slots[i] : i);
}

int outofcore_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err)
{
	(void)err;
	y->is_zero = false;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < y->size[2]; i++)
		algebra_axpby(y->slice, (float)a, slice(x, i), (float)b, slice(y, i));
	return 0;
}

int outofcore_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
			  struct error *err)
{
	(void)err;
	y->by = NULL;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++)
		algebra_axpby(y->pixels, (float)a, slot(x, slots, i), (float)b, slot(y, NULL, i));
	return 0;
}

int outofcore_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
			 struct error *err)
{
	double sum = 0;

	(void)plan;
	(void)err;
#pragma omp parallel for ordered schedule(static, 1)
	for (int i = 0; i < y->size[2]; i++) {
		const double part = algebra_dot(y->slice, slice(x, i), slice(y, i));

#pragma omp ordered
		sum += part;
	}
	*ret_sum = sum;
	return 0;
}

int outofcore_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y,
			int count, double *ret_sum, struct error *err)
{
	double sum = 0;

	(void)plan;
	(void)err;
#pragma omp parallel for ordered schedule(static, 1)
	for (int i = 0; i < count; i++) {
		const float *xs = slot(x, NULL, i), *ys = slot(y, NULL, i);
		const double part = w == NULL ? algebra_dot(y->pixels, xs, ys)
					      : algebra_weighted_dot(y->pixels, slot(w, NULL, i), xs, ys);

#pragma omp ordered
		sum += part;
	}
	*ret_sum = sum;
	return 0;
}

int outofcore_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err)
{
	(void)err;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < y->size[2]; i++)
		algebra_divide(y->slice, slice(x, i), (float)least, slice(y, i));
	return 0;
}

int outofcore_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err)
{
	(void)err;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++)
		algebra_divide(y->pixels, slot(x, NULL, i), (float)least, slot(y, NULL, i));
	return 0;
}

int outofcore_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err)
{
	(void)err;
	y->by = NULL;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++)
		algebra_multiply(y->pixels, slot(x, NULL, i), slot(y, NULL, i));
	return 0;
}

int outofcore_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err)
{
	(void)err;
	y->is_zero = false;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < y->size[2]; i++)
		algebra_maximum(y->slice, (float)a, slice(x, i), slice(y, i));
	return 0;
}

int outofcore_stack_fill(struct stack *y, int count, float value, struct error *err)
{
	(void)err;
	y->by = NULL;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++)
		algebra_fill(y->pixels, value, slot(y, NULL, i));
	return 0;
}

int outofcore_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err)
{
	(void)err;
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++)
		algebra_mask(y->pixels, slot(x, slots, i), slot(y, NULL, i));
	return 0;
}

int outofcore_stack_average(struct stack *y, int at, const double width[2], struct stack *work, struct error *err)
{
	float *to = slot(y, NULL, at), *between = slot(work, NULL, 0);

	(void)err;
#pragma omp parallel for schedule(static)
	for (int r = 0; r < y->rows; r++)
		for (int c = 0; c < y->columns; c++)
			between[(size_t)r * (size_t)y->columns + (size_t)c] =
			    algebra_mean_around(to + (size_t)r * (size_t)y->columns, y->columns, 1, c, width[0]);
#pragma omp parallel for schedule(static)
	for (int c = 0; c < y->columns; c++)
		for (int r = 0; r < y->rows; r++)
			to[(size_t)r * (size_t)y->columns + (size_t)c] =
			    algebra_mean_around(between + c, y->rows, (size_t)y->columns, r, width[1]);
	return 0;
}

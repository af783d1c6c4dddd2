/*
 * The ramp filter of FDK: rows are weighted, transformed, multiplied with the
 * response and transformed back. The response is real and even, so two rows go
 * through one complex transform as its real and imaginary parts and come out as
 * they went in. KissFFT (BSD) does the transforms; it allocates nothing as long
 * as input and output differ and the length has the factors 2, 3 and 5 only.
 */
#include "core/cpu.h"

#include <kissfft/kiss_fft.h>
#include <stdlib.h>
#include <string.h>

/* Rows that are neighbours in memory and are filtered together: one cache line of floats. */
enum { ROWS = 16, PAIRS = ROWS / 2 };

struct filter_engine {
	const struct geometry *geometry; /* borrowed, as are the weights */
	const float *column_weights;     /* [view][column] */
	int length;
	int pad, wide; /* zero columns before column 0; columns of a filtered row */
	kiss_fft_cfg forward, inverse;
	float *response;       /* [length], all frequencies, 1 / length included */
	kiss_fft_cpx *buffers; /* [threads][2][PAIRS][stride] */
	size_t stride;
};

/* Away from multiples of 4 KiB, where all pairs would share the same sets of the cache. */
static size_t buffer_stride(int length)
{
	return (size_t)length + 8;
}

static size_t buffers_count(int length, int threads)
{
	return (size_t)threads * 2 * PAIRS * buffer_stride(length);
}

size_t filter_engine_bytes(const struct plan_options *options, int threads)
{
	int length = filter_length(options->pad[0] + options->geometry->columns + options->pad[1]);
	size_t transform = 0;

	kiss_fft_alloc(length, 0, NULL, &transform);
	return sizeof(struct filter_engine) + 2 * transform + (size_t)length * sizeof(float) +
	       buffers_count(length, threads) * sizeof(kiss_fft_cpx);
}

int filter_engine_new(const struct plan_options *options, int threads, struct filter_engine **ret_engine,
		      struct error *err)
{
	struct filter_engine *engine = calloc(1, sizeof(*engine));
	int length = filter_length(options->pad[0] + options->geometry->columns + options->pad[1]);

	if (engine == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the ramp filter");
	engine->geometry = options->geometry;
	engine->column_weights = options->column_weights;
	engine->length = length;
	engine->pad = options->pad[0];
	engine->wide = options->pad[0] + options->geometry->columns + options->pad[1];
	engine->stride = buffer_stride(length);
	engine->forward = kiss_fft_alloc(length, 0, NULL, NULL);
	engine->inverse = kiss_fft_alloc(length, 1, NULL, NULL);
	engine->response = malloc((size_t)length * sizeof(float));
	engine->buffers = calloc(buffers_count(length, threads), sizeof(kiss_fft_cpx));
	if (engine->forward == NULL || engine->inverse == NULL || engine->response == NULL || engine->buffers == NULL) {
		filter_engine_free(engine);
		return error_set(err, ERR_NO_MEMORY, "no memory for the ramp filter of %d samples", length);
	}
	for (int i = 0; i < length; i++)
		engine->response[i] = options->filter_response[i <= length / 2 ? i : length - i] / (float)length;
	*ret_engine = engine;
	return 0;
}

void filter_engine_free(struct filter_engine *engine)
{
	if (engine == NULL)
		return;
	kiss_fft_free(engine->forward);
	kiss_fft_free(engine->inverse);
	free(engine->response);
	free(engine->buffers);
	free(engine);
}

/* Unit vector from the source to the rotation axis, the source's own z kept; to the isocentre from on the axis. */
static void axis_direction(const struct view *view, double ret_direction[3])
{
	const double *s = view->source;
	double across = hypot(s[0], s[1]), length = across > 0 ? across : fabs(s[2]);

	ret_direction[0] = length > 0 ? -s[0] / length : 0;
	ret_direction[1] = length > 0 ? -s[1] / length : 0;
	ret_direction[2] = across > 0 || length == 0 ? 0 : -s[2] / length;
}

/*
 * weight * cos(gamma) of rows row .. row + ROWS - 1 in one column:
 * cos(gamma) = (ray . direction) / |ray|, the ray a + r v from the source.
 */
static void column_cosines(const struct view *view, const double direction[3], int column, int row, float weight,
			   float ret_weights[ROWS])
{
	float along, along_step, square, square_step, square_step2;
	double a[3];

	for (int i = 0; i < 3; i++)
		a[i] = view->pixel0[i] - view->source[i] + column * view->column_step[i] + row * view->row_step[i];
	along = (float)vec_dot(a, direction) * weight;
	along_step = (float)vec_dot(view->row_step, direction) * weight;
	square = (float)vec_dot(a, a);
	square_step = (float)(2 * vec_dot(a, view->row_step));
	square_step2 = (float)vec_dot(view->row_step, view->row_step);
	for (int i = 0; i < ROWS; i++) {
		float r = (float)i;

		ret_weights[i] = (along + r * along_step) / sqrtf(square + r * (square_step + r * square_step2));
	}
}

/* Rows row .. row + count - 1 of one view. */
static void filter_rows(const struct filter_engine *engine, int view, int columns, int rows, int row, int count,
			const float *from, float *to, kiss_fft_cpx *buffers)
{
	const size_t stride = engine->stride;
	kiss_fft_cpx *in = buffers, *out = buffers + PAIRS * stride;
	const int pairs = (count + 1) / 2;
	double direction[3];

	axis_direction(&engine->geometry->views[view], direction);
	for (int c = 0; c < columns; c++) {
		float weights[ROWS], values[ROWS] = {0};

		memcpy(values, from + (size_t)c * (size_t)rows + (size_t)row, (size_t)count * sizeof(float));
		column_cosines(&engine->geometry->views[view], direction, c, row,
			       engine->column_weights[(size_t)view * (size_t)columns + (size_t)c], weights);
		for (int i = 0; i < ROWS; i++)
			values[i] *= weights[i];
		for (int i = 0; i < PAIRS; i++)
			in[(size_t)i * stride + (size_t)(engine->pad + c)] =
			    (kiss_fft_cpx){values[2 * i], values[2 * i + 1]};
	}
	for (int i = 0; i < pairs; i++) {
		kiss_fft_cpx *row_in = in + (size_t)i * stride, *row_out = out + (size_t)i * stride;

		memset(row_in, 0, (size_t)engine->pad * sizeof(*row_in));
		memset(row_in + engine->pad + columns, 0,
		       (size_t)(engine->length - engine->pad - columns) * sizeof(*row_in));
		kiss_fft(engine->forward, row_in, row_out);
		for (int k = 0; k < engine->length; k++) {
			row_out[k].r *= engine->response[k];
			row_out[k].i *= engine->response[k];
		}
		kiss_fft(engine->inverse, row_out, row_in);
	}
	for (int c = 0; c < engine->wide; c++) {
		float values[ROWS];

		for (int i = 0; i < pairs; i++) {
			values[2 * i] = in[(size_t)i * stride + (size_t)c].r;
			values[2 * i + 1] = in[(size_t)i * stride + (size_t)c].i;
		}
		memcpy(to + (size_t)c * (size_t)rows + (size_t)row, values, (size_t)count * sizeof(float));
	}
}

int cpu_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
	       struct stack *to, struct error *err)
{
	const struct filter_engine *engine = plan->filter;
	const int blocks = (plan->rows + ROWS - 1) / ROWS;

	if (engine == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without FDK");
	if (to->columns != plan->wide)
		return error_set(err, ERR_INTERNAL, "%d columns to filter into instead of %d", to->columns, plan->wide);
	if (count > to->slots)
		return error_set(err, ERR_INTERNAL, "%d views to filter into a stack of %d slots", count, to->slots);
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
	for (int job = 0; job < count * blocks; job++) {
		const int i = job / blocks, row = job % blocks * ROWS, left = plan->rows - row;
		kiss_fft_cpx *buffers = engine->buffers + (size_t)cpu_thread() * 2 * PAIRS * engine->stride;

		filter_rows(engine, views[i], plan->columns, plan->rows, row, left < ROWS ? left : ROWS,
			    stack_slot(from, slots != NULL ? slots[i] : views[i]),
			    to->data + (size_t)i * (size_t)plan->wide * (size_t)plan->rows, buffers);
	}
	return 0;
}

int cpu_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err)
{
	(void)err;
	for (int side = 0; side < 2; side++)
		ret_rows[side] = plan->extended[side];
	return 0;
}

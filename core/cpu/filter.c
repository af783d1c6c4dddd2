/*
 * The ramp filter of FDK: rows are weighted, transformed, multiplied with the
 * response and transformed back. The response is real and even, so two rows go
 * through one complex transform as its real and imaginary parts and come out as
 * they went in. KissFFT (BSD) does the transforms; it allocates nothing as long
 * as input and output differ and the length has the factors 2, 3 and 5 only.
 */
#include "core/cpu/cpu.h"
#include "core/truncation_bone.h"

#include <kissfft/kiss_fft.h>
#include <stdlib.h>
#include <string.h>

/* Rows that are neighbours in memory and are filtered together: one cache line of floats. */
enum { ROWS = 16, PAIRS = ROWS / 2 };

/* Transforms of one length. */
struct transform {
	int length;
	kiss_fft_cfg forward, inverse;
	float *response; /* [length], all frequencies, 1 / length included */
};

struct filter_engine {
	const struct geometry *geometry; /* borrowed, as are the weights */
	const float *column_weights;     /* [view][column] */
	struct rotation_axis axis;       /* plan_options.axis */
	int pad, wide;                   /* zero columns before column 0; columns of a filtered row */
	int extend;                      /* columns that truncated rows get on either side */
	bool sides[2];                   /* that may be extended */
	struct shell_table shells;       /* of core/truncation_bone.h */
	float *levels;                   /* [view] truncation_level, or NULL without extend */
	struct transform plain, extended;
	kiss_fft_cpx *buffers; /* [threads][2][PAIRS][stride] */
	size_t stride;
};

static int wide_columns(const struct plan_options *options)
{
	return options->pad[0] + options->geometry->columns + options->pad[1];
}

/*
 * Floats from a buffer to the next: the longest transform's, away from multiples of 4 KiB, where all pairs would share
 * the same sets of the cache.
 */
static size_t buffer_stride(const struct plan_options *options)
{
	return (size_t)filter_length(wide_columns(options) + options->extend) + 8;
}

static size_t buffers_count(const struct plan_options *options, int threads)
{
	return (size_t)threads * 2 * PAIRS * buffer_stride(options);
}

/* KissFFT's tables are made where they are to lie. */
static kiss_fft_cfg fft_walk(int length, int inverse, struct arena *arena)
{
	size_t bytes = 0;
	void *memory;

	kiss_fft_alloc(length, inverse, NULL, &bytes);
	memory = cpu_take(arena, bytes);
	return memory != NULL ? kiss_fft_alloc(length, inverse, memory, &bytes) : NULL;
}

static void transform_walk(struct transform *transform, int length, const float *response, struct arena *arena)
{
	transform->length = length;
	transform->forward = fft_walk(length, 0, arena);
	transform->inverse = fft_walk(length, 1, arena);
	transform->response = cpu_take_floats(arena, (size_t)length);
	for (int i = 0; transform->response != NULL && i < length; i++)
		transform->response[i] = response[i <= length / 2 ? i : length - i] / (float)length;
}

struct filter_engine *filter_engine_walk(const struct plan_options *options, int threads, struct arena *arena)
{
	const int wide = wide_columns(options);
	struct filter_engine measured, *taken = cpu_take(arena, sizeof(*taken));
	struct filter_engine *engine = taken != NULL ? taken : &measured;

	*engine = (struct filter_engine){
	    .geometry = options->geometry,
	    .column_weights = options->column_weights,
	    .axis = options->axis,
	    .pad = options->pad[0],
	    .wide = wide,
	    .extend = options->extend,
	    .sides = {options->extend > 0 && options->pad[0] == 0, options->extend > 0 && options->pad[1] == 0},
	    .shells = shell_table_make(),
	    .stride = buffer_stride(options),
	};
	transform_walk(&engine->plain, filter_length(wide), options->filter_response, arena);
	if (engine->extend > 0) {
		transform_walk(&engine->extended, filter_length(wide + engine->extend), options->extended_response,
			       arena);
		engine->levels = cpu_take_floats(arena, (size_t)options->geometry->count);
	}
	engine->buffers = cpu_take(arena, buffers_count(options, threads) * sizeof(*engine->buffers));
	return taken;
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

/* ---- extension of truncated rows, see core/truncation.h ---- */

/* A view, [column][row], and ROWS rows of it or fewer. */
struct rows {
	const float *view;
	int columns, rows;
	int first, count;
	float level; /* of the view */
};

/* Extensions of each row of a group, before column 0 and behind the last one. */
struct extensions {
	bool truncated[2][ROWS];
	struct extension edge[2][ROWS];
};

/* Column i from an edge, the group's first row. */
static const float *at_edge(const struct rows *rows, int side, int i)
{
	const int column = side == 0 ? i : rows->columns - 1 - i;

	return rows->view + (size_t)column * (size_t)rows->rows + (size_t)rows->first;
}

/* Marks the rows that are cut off at an edge; returns true if any is. */
static bool find_truncated(const struct filter_engine *engine, const struct rows *rows, struct extensions *ret)
{
	bool any = false;

	memset(ret->truncated, 0, sizeof(ret->truncated));
	for (int side = 0; side < 2; side++)
		for (int r = 0; r < rows->count && engine->sides[side]; r++) {
			ret->truncated[side][r] =
			    truncation_is_cut(at_edge(rows, side, 0) + r, side == 0 ? rows->rows : -rows->rows,
					      rows->columns, rows->level);
			any = any || ret->truncated[side][r];
		}
	return any;
}

/* Both ends of the object of row r of a group. */
static void find_ends(const struct rows *rows, int r, const struct extensions *extensions, struct truncation_end ret[2])
{
	const float *p = at_edge(rows, 0, 0) + r;
	const ptrdiff_t step = rows->rows;
	int first = 0, last = rows->columns - 1, count;

	while (!extensions->truncated[0][r] && first < last && p[first * step] < rows->level)
		first++;
	while (!extensions->truncated[1][r] && last > first && p[last * step] < rows->level)
		last--;
	count = last - first + 1;
	ret[0] = truncation_end_of(p + first * step, step, count, rows->columns);
	ret[1] = truncation_end_of(p + last * step, -step, count, rows->columns);
}

/* The shell around the object between the cusps of both ends; share 0 where there is none. width: of that, columns. */
static struct shell find_shell(const struct filter_engine *engine, const struct truncation_end ends[2], int width)
{
	const float *p = ends[0].p + ends[0].cap * ends[0].step;
	float bins[SHELL_BINS], ellipse;
	double square;

	for (int bin = 0; bin < SHELL_BINS; bin++)
		bins[bin] = shell_bin(p, ends[0].step, 0, width, bin);
	square = shell_square(bins);
	ellipse = shell_ellipse_error(bins, square);
	if (!shell_is_tried(ellipse))
		return (struct shell){.share = 0};
	return shell_make(&engine->shells, bins, square, ellipse, shell_noise(ends, square, width),
			  shell_search(&engine->shells, bins, square));
}

/* Shells and caps of the rows that are cut off. */
static void fit_bone(const struct filter_engine *engine, const struct rows *rows, struct extensions *ret)
{
	for (int r = 0; r < rows->count; r++) {
		struct truncation_end ends[2];
		struct shell shell;
		int width;

		if (!ret->truncated[0][r] && !ret->truncated[1][r])
			continue;
		find_ends(rows, r, ret, ends);
		width = ends[0].count - ends[0].cap - ends[1].cap;
		shell = find_shell(engine, ends, width);
		for (int side = 0; side < 2; side++) {
			const struct truncation_end *end = &ends[side];
			float measured = 0;

			if (!ret->truncated[side][r])
				continue;
			for (int i = 0; i < truncation_window(rows->columns); i++)
				measured += end->p[(end->cap + i) * end->step];
			if (shell.share > 0)
				truncation_by_shell(&ret->edge[side][r], &shell, side, end->cap, width, measured,
						    rows->columns);
			truncation_by_cap(&ret->edge[side][r], end);
			truncation_end_extension(&ret->edge[side][r], engine->extend);
		}
	}
}

static void fit_extensions(const struct filter_engine *engine, const struct rows *rows, struct extensions *ret)
{
	struct truncation_row_sums sums[ROWS] = {{0}};

	for (int c = 0; c < rows->columns; c++) {
		const float *values = at_edge(rows, 0, c);
		const double x = truncation_x(c, rows->columns);

		for (int r = 0; r < rows->count; r++)
			if (values[r] >= rows->level)
				truncation_row_add(&sums[r], x, (double)values[r]);
	}
	for (int side = 0; side < 2; side++) {
		struct truncation_edge_sums edges[ROWS] = {{0}};

		for (int i = 0; i < truncation_window(rows->columns); i++) {
			const float *values = at_edge(rows, side, i);

			for (int r = 0; r < rows->count; r++) {
				const double p = values[r] > 0 ? (double)values[r] : 0;

				edges[r].y += p * p;
				edges[r].xy -= i * p * p;
			}
		}
		for (int r = 0; r < rows->count; r++)
			if (ret->truncated[side][r])
				ret->edge[side][r] = truncation_fit(rows->columns, engine->extend, &sums[r], &edges[r]);
	}
}

/* Writes the extension of one side into the buffers of all pairs; column -1 is the last of the buffer. */
static void write_extension(const struct filter_engine *engine, int view, const struct rows *rows, int side,
			    const struct extensions *extensions, kiss_fft_cpx *in)
{
	const int outermost = side == 0 ? 0 : rows->columns - 1;
	const float weight = engine->column_weights[(size_t)view * (size_t)rows->columns + (size_t)outermost];
	double direction[3];

	axis_direction(engine->geometry->views[view].source, &engine->axis, direction);
	for (int x = 1; x <= engine->extend; x++) {
		const int column = side == 0 ? -x : outermost + x;
		const int at = engine->pad + column + (column < 0 ? engine->extended.length : 0);
		float weights[ROWS], values[ROWS] = {0};

		column_cosines(&engine->geometry->views[view], direction, column, rows->first, weight, weights);
		for (int r = 0; r < rows->count; r++)
			if (extensions->truncated[side][r])
				values[r] = weights[r] * truncation_value(&extensions->edge[side][r], x);
		for (int i = 0; i < PAIRS; i++)
			in[(size_t)i * engine->stride + (size_t)at] = (kiss_fft_cpx){values[2 * i], values[2 * i + 1]};
	}
}

/* ---- the filter ---- */

/* Rows times their weights into the buffers of their pairs, from `pad` on. */
static void weight_rows(const struct filter_engine *engine, int view, const struct rows *rows, kiss_fft_cpx *in)
{
	const struct view *from = &engine->geometry->views[view];
	double direction[3];

	axis_direction(from->source, &engine->axis, direction);
	for (int c = 0; c < rows->columns; c++) {
		float weights[ROWS], values[ROWS] = {0};

		memcpy(values, at_edge(rows, 0, c), (size_t)rows->count * sizeof(float));
		column_cosines(from, direction, c, rows->first,
			       engine->column_weights[(size_t)view * (size_t)rows->columns + (size_t)c], weights);
		for (int i = 0; i < ROWS; i++)
			values[i] *= weights[i];
		for (int i = 0; i < PAIRS; i++)
			in[(size_t)i * engine->stride + (size_t)(engine->pad + c)] =
			    (kiss_fft_cpx){values[2 * i], values[2 * i + 1]};
	}
}

/* Rows row .. row + count - 1 of one view; adds the rows that were extended on either side. */
static void filter_rows(const struct filter_engine *engine, int view, const struct rows *rows, float *to,
			kiss_fft_cpx *buffers, size_t extended[2])
{
	const size_t stride = engine->stride;
	kiss_fft_cpx *in = buffers, *out = buffers + PAIRS * stride;
	const int pairs = (rows->count + 1) / 2;
	const struct transform *transform = &engine->plain;
	struct extensions extensions;

	weight_rows(engine, view, rows, in);
	if (find_truncated(engine, rows, &extensions))
		transform = &engine->extended;
	for (int i = 0; i < pairs; i++) {
		kiss_fft_cpx *row = in + (size_t)i * stride;

		memset(row, 0, (size_t)engine->pad * sizeof(*row));
		memset(row + engine->pad + rows->columns, 0,
		       (size_t)(transform->length - engine->pad - rows->columns) * sizeof(*row));
	}
	if (transform == &engine->extended) {
		fit_extensions(engine, rows, &extensions);
		fit_bone(engine, rows, &extensions);
		for (int side = 0; side < 2; side++) {
			if (engine->sides[side])
				write_extension(engine, view, rows, side, &extensions, in);
			for (int r = 0; r < rows->count; r++)
				extended[side] += extensions.truncated[side][r];
		}
	}
	for (int i = 0; i < pairs; i++) {
		kiss_fft_cpx *row_in = in + (size_t)i * stride, *row_out = out + (size_t)i * stride;

		kiss_fft(transform->forward, row_in, row_out);
		for (int k = 0; k < transform->length; k++) {
			row_out[k].r *= transform->response[k];
			row_out[k].i *= transform->response[k];
		}
		kiss_fft(transform->inverse, row_out, row_in);
	}
	for (int c = 0; c < engine->wide; c++) {
		float values[ROWS];

		for (int i = 0; i < pairs; i++) {
			values[2 * i] = in[(size_t)i * stride + (size_t)c].r;
			values[2 * i + 1] = in[(size_t)i * stride + (size_t)c].i;
		}
		memcpy(to + (size_t)c * (size_t)rows->rows + (size_t)rows->first, values,
		       (size_t)rows->count * sizeof(float));
	}
}

static void find_levels(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count)
{
	const size_t rows = (size_t)plan->rows;

#pragma omp parallel for num_threads(plan->device->threads)
	for (int i = 0; i < count; i++) {
		const float *view = stack_slot(from, slots != NULL ? slots[i] : views[i]);

		plan->filter->levels[views[i]] =
		    truncation_level(truncation_largest(view, plan->columns, plan->rows, rows, 1));
	}
}

int cpu_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
	       struct stack *to, struct error *err)
{
	const struct filter_engine *engine = plan->filter;
	const int blocks = (plan->rows + ROWS - 1) / ROWS;
	size_t extended[2] = {0};

	if (engine == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without FDK");
	if (to->columns != plan->wide)
		return error_set(err, ERR_INTERNAL, "%d columns to filter into instead of %d", to->columns, plan->wide);
	if (count > to->slots)
		return error_set(err, ERR_INTERNAL, "%d views to filter into a stack of %d slots", count, to->slots);
	if (engine->extend > 0)
		find_levels(plan, from, slots, views, count);
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic) reduction(+ : extended[:2])
	for (int job = 0; job < count * blocks; job++) {
		const int i = job / blocks, row = job % blocks * ROWS, left = plan->rows - row;
		const struct rows rows = {
		    .view = stack_slot(from, slots != NULL ? slots[i] : views[i]),
		    .columns = plan->columns,
		    .rows = plan->rows,
		    .first = row,
		    .count = left < ROWS ? left : ROWS,
		    .level = engine->extend > 0 ? engine->levels[views[i]] : 0,
		};

		filter_rows(engine, views[i], &rows, to->data + (size_t)i * (size_t)plan->wide * (size_t)plan->rows,
			    engine->buffers + (size_t)cpu_thread() * 2 * PAIRS * engine->stride, extended);
		pulse_beat();
	}
	for (int side = 0; side < 2; side++)
		plan->extended[side] += extended[side];
	return 0;
}

int cpu_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err)
{
	(void)err;
	for (int side = 0; side < 2; side++)
		ret_rows[side] = plan->extended[side];
	return 0;
}

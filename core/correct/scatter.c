/* Scattered radiation in one view from kernels, of a body, or as a constant: see scatter.h. */
#include "core/correct/scatter.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { STEPS = 12, BODY_STEPS = 4 }; /* after which t has settled to 1e-3 where two thirds of T are scatter */
/* The logarithm of a body's S over that of t, where t changes everywhere; steps of the search go by it. */
static const float FOLLOWS = 0.4f;
static const float T_LEAST = 1e-6f;       /* a transmission below which p says nothing */
static const double DARKEST_SHARE = 0.05; /* of the cells */

/* Cells along one axis of the detector. */
struct axis {
	int cells, pixels;
	double pitch; /* mm */
	int *first;   /* [cells + 1], pixels */
	/* [pixels]: the cell before each pixel, and the share of the next one in what is interpolated there. */
	int *before;
	float *share;
};

struct scatter {
	struct scatter_model model;
	struct axis across, along;
	/* [kernel][to][from]: shares of a cell's scatter that reach another cell. */
	float *rows[SCATTER_KERNELS_MOST], *columns[SCATTER_KERNELS_MOST];
	double width[SCATTER_KERNELS_MOST];                             /* that these were made for */
	struct scatter_field *field;                                    /* of a body, in place of kernels */
	float *total, *primary, *estimate, *source, *between, *blurred; /* [cells] each, of one allocation */
	float *log_primary, *sorted;
};

static size_t cells_of(const struct scatter *scatter)
{
	return (size_t)scatter->across.cells * (size_t)scatter->along.cells;
}

/* In pixels, the centre of pixel 0 being 0. */
static double cell_centre(const struct axis *axis, int cell)
{
	return 0.5 * (axis->first[cell] + axis->first[cell + 1] - 1);
}

/* Beyond the outer centres the values are held. */
static void interpolation_make(struct axis *axis)
{
	for (int pixel = 0, cell = 0; pixel < axis->pixels; pixel++) {
		double low, high;

		while (cell + 2 < axis->cells && pixel >= cell_centre(axis, cell + 1))
			cell++;
		low = cell_centre(axis, cell);
		high = cell + 1 < axis->cells ? cell_centre(axis, cell + 1) : low + 1;
		axis->before[pixel] = cell;
		axis->share[pixel] = cell + 1 < axis->cells ? (float)fmin(1, fmax(0, (pixel - low) / (high - low))) : 0;
	}
}

static int axis_open(struct axis *axis, int pixels, double pitch, int most)
{
	const int each = (pixels + most - 1) / most;

	axis->cells = (pixels + each - 1) / each;
	axis->pixels = pixels;
	axis->pitch = pitch;
	axis->first = malloc((size_t)(axis->cells + 1) * sizeof(*axis->first));
	axis->before = malloc((size_t)pixels * sizeof(*axis->before));
	axis->share = malloc((size_t)pixels * sizeof(*axis->share));
	if (axis->first == NULL || axis->before == NULL || axis->share == NULL)
		return ERR_NO_MEMORY;
	for (int i = 0; i <= axis->cells; i++)
		axis->first[i] = (int)((long long)i * pixels / axis->cells);
	interpolation_make(axis);
	return 0;
}

static void axis_clear(struct axis *axis)
{
	free(axis->first);
	free(axis->before);
	free(axis->share);
}

/* The share of a Gaussian about the cell `from` that a point amid the cell `to` gets of each mm, times from's width. */
static void shares_make(const struct axis *axis, double width_mm, float *ret_shares)
{
	const double scale = axis->pitch / (width_mm * M_SQRT2);

	for (int to = 0; to < axis->cells; to++)
		for (int from = 0; from < axis->cells; from++) {
			const double at = cell_centre(axis, to);
			const double low = (axis->first[from] - 0.5 - at) * scale;
			const double high = (axis->first[from + 1] - 0.5 - at) * scale;

			ret_shares[to * axis->cells + from] = (float)(0.5 * (erf(high) - erf(low)));
		}
}

static void kernel_make(struct scatter *scatter, int k, double width_mm)
{
	shares_make(&scatter->across, width_mm, scatter->rows[k]);
	shares_make(&scatter->along, width_mm, scatter->columns[k]);
	scatter->width[k] = width_mm;
}

static int scatter_allocate(struct scatter *scatter, struct error *err)
{
	const size_t cells = cells_of(scatter), across = (size_t)scatter->across.cells;
	const size_t along = (size_t)scatter->along.cells;
	float *all = calloc(8 * cells, sizeof(*all));
	bool lacks = all == NULL;

	scatter->total = all;
	for (int k = 0; k < scatter->model.count && !lacks; k++) {
		scatter->rows[k] = malloc(across * across * sizeof(float));
		scatter->columns[k] = malloc(along * along * sizeof(float));
		lacks = scatter->rows[k] == NULL || scatter->columns[k] == NULL;
	}
	if (lacks)
		return error_set(err, ERR_NO_MEMORY, "no memory for the scatter in %zu cells", cells);
	scatter->primary = all + cells;
	scatter->estimate = all + 2 * cells;
	scatter->source = all + 3 * cells;
	scatter->between = all + 4 * cells;
	scatter->blurred = all + 5 * cells;
	scatter->log_primary = all + 6 * cells;
	scatter->sorted = all + 7 * cells;
	return 0;
}

static int field_open(struct scatter *scatter, const struct scatter_beam *beam)
{
	const int pixels[2] = {scatter->across.pixels, scatter->along.pixels};
	const int cells[2] = {scatter->across.cells, scatter->along.cells};

	scatter->field = scatter_field_new(beam, pixels, cells);
	return scatter->field == NULL ? ERR_NO_MEMORY : 0;
}

int scatter_new(const struct scatter_model *model, int columns, int rows, const struct scatter_beam *beam,
		struct scatter **ret_scatter, struct error *err)
{
	const int most = model->body.amplitude > 0 ? SCATTER_BODY_CELLS : SCATTER_CELLS;
	struct scatter *scatter = calloc(1, sizeof(*scatter));
	int code = ERR_NO_MEMORY;

	if (scatter != NULL) {
		scatter->model = *model;
		code = axis_open(&scatter->across, columns, beam->pixel_mm[0], most);
		if (code == 0)
			code = axis_open(&scatter->along, rows, beam->pixel_mm[1], most);
		if (code == 0 && model->body.amplitude > 0)
			code = field_open(scatter, beam);
	}
	code = code < 0 ? error_set(err, code, "no memory for the scatter of %d x %d pixels", columns, rows)
			: scatter_allocate(scatter, err);
	if (code < 0) {
		scatter_free(scatter);
		return code;
	}
	for (int k = 0; k < model->count; k++)
		kernel_make(scatter, k, model->kernels[k].width_mm);
	*ret_scatter = scatter;
	return 0;
}

void scatter_free(struct scatter *scatter)
{
	if (scatter == NULL)
		return;
	for (int k = 0; k < SCATTER_KERNELS_MOST; k++) {
		free(scatter->rows[k]);
		free(scatter->columns[k]);
	}
	scatter_field_free(scatter->field);
	axis_clear(&scatter->across);
	axis_clear(&scatter->along);
	free(scatter->total);
	free(scatter);
}

void scatter_cells(const struct scatter *scatter, int *ret_across, int *ret_along)
{
	*ret_across = scatter->across.cells;
	*ret_along = scatter->along.cells;
}

/* ---- means over cells ---- */

/* Gives cells that are no number what the nearest one before them has, or behind them, `step` apart. */
static void fill_line(float *line, int count, int step)
{
	for (int i = 1; i < count; i++)
		if (isnan(line[i * step]))
			line[i * step] = line[(i - 1) * step];
	for (int i = count - 2; i >= 0; i--)
		if (isnan(line[i * step]))
			line[i * step] = line[(i + 1) * step];
}

void scatter_means(const struct scatter *scatter, const float *image, bool gaps, float *ret_cells)
{
	const struct axis *across = &scatter->across, *along = &scatter->along;

#pragma omp parallel for schedule(static)
	for (int j = 0; j < along->cells; j++) {
		double sum[SCATTER_CELLS] = {0};
		int good[SCATTER_CELLS] = {0};

		for (int row = along->first[j]; row < along->first[j + 1]; row++)
			for (int i = 0; i < across->cells; i++)
				for (int column = across->first[i]; column < across->first[i + 1]; column++) {
					const float value =
					    image[(size_t)row * (size_t)across->pixels + (size_t)column];

					sum[i] += isnan(value) ? 0 : (double)value;
					good[i] += !isnan(value);
				}
		for (int i = 0; i < across->cells; i++)
			ret_cells[j * across->cells + i] = good[i] > 0 ? (float)(sum[i] / good[i]) : NAN;
		if (!gaps)
			fill_line(ret_cells + j * across->cells, across->cells, 1);
	}
	if (gaps)
		return;
	for (int i = 0; i < across->cells; i++)
		fill_line(ret_cells + i, along->cells, across->cells);
	for (size_t i = 0; i < cells_of(scatter); i++)
		ret_cells[i] = isnan(ret_cells[i]) ? 0 : ret_cells[i];
}

/* ---- convolution ---- */

/* [to][from] times a line of `from`s for each of the lines: result[line][to]. */
static void rows_blur(const float *shares, int cells, const float *from, int lines, float *ret)
{
	for (int line = 0; line < lines; line++)
		for (int to = 0; to < cells; to++) {
			float sum = 0;

			for (int i = 0; i < cells; i++)
				sum += shares[to * cells + i] * from[line * cells + i];
			ret[line * cells + to] = sum;
		}
}

static void columns_blur(const float *shares, int cells, const float *from, int across, float *ret)
{
	memset(ret, 0, (size_t)cells * (size_t)across * sizeof(*ret));
	for (int to = 0; to < cells; to++)
		for (int i = 0; i < cells; i++) {
			const float share = shares[to * cells + i];

			for (int c = 0; c < across; c++)
				ret[to * across + c] += share * from[i * across + c];
		}
}

/* The scatter's source convolved with kernel k. */
static void blur(struct scatter *scatter, int k)
{
	rows_blur(scatter->rows[k], scatter->across.cells, scatter->source, scatter->along.cells, scatter->between);
	columns_blur(scatter->columns[k], scatter->along.cells, scatter->between, scatter->across.cells,
		     scatter->blurred);
}

/* S of a primary, by kernels or of a body. */
static void scatter_of_primary(struct scatter *scatter, const struct scatter_model *model, const float *primary,
			       float *ret_scatter)
{
	const size_t cells = cells_of(scatter);
	float *p = scatter->log_primary;

	for (size_t i = 0; i < cells; i++) {
		p[i] = primary[i] < 1 ? -logf(fmaxf(primary[i], T_LEAST)) : 0;
		ret_scatter[i] = 0;
	}
	if (scatter->field != NULL)
		scatter_field_of(scatter->field, &model->body, p, ret_scatter);
	for (int k = 0; k < model->count; k++) {
		const struct scatter_kernel *kernel = &model->kernels[k];
		const float asymmetry = (float)kernel->asymmetry, power = (float)kernel->power;
		const float exponent = 1 + (float)kernel->exponent - asymmetry;

		if (scatter->width[k] != kernel->width_mm)
			kernel_make(scatter, k, kernel->width_mm);
		for (size_t i = 0; i < cells; i++)
			scatter->source[i] =
			    p[i] > 0 ? (float)kernel->amplitude * expf(-exponent * p[i]) * powf(p[i], power) : 0;
		blur(scatter, k);
		for (size_t i = 0; i < cells; i++)
			ret_scatter[i] += expf(-asymmetry * p[i]) * scatter->blurred[i];
	}
}

/* ---- one view ---- */

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

/* The same everywhere; cells that are black, as behind a shutter, are not the densest part of an object. */
static void estimate_constant(struct scatter *scatter)
{
	const size_t cells = cells_of(scatter);
	const double fraction = scatter->model.fraction;
	size_t black = 0, count;
	double sum = 0;

	memcpy(scatter->sorted, scatter->total, cells * sizeof(float));
	qsort(scatter->sorted, cells, sizeof(float), compare_floats);
	while (black + 1 < cells && !(scatter->sorted[black] > T_LEAST))
		black++;
	count = (size_t)ceil(DARKEST_SHARE * (double)(cells - black));
	for (size_t i = 0; i < count; i++)
		sum += (double)scatter->sorted[black + i];
	for (size_t i = 0; i < cells; i++)
		scatter->estimate[i] = (float)(sum / (double)count * fraction / (1 + fraction));
}

/*
 * A body's S is smooth and goes along with t where t changes everywhere. A step that is as if it always did finds t
 * where most of the total is scatter; a step as for kernels would go on for long there.
 */
static void find_field(struct scatter *scatter, const struct scatter_model *model, const float *total,
		       float *ret_scatter)
{
	const size_t cells = cells_of(scatter);
	float *primary = scatter->primary;

	for (int step = 0; step < BODY_STEPS; step++) {
		scatter_of_primary(scatter, model, primary, ret_scatter);
		for (size_t i = 0; i < cells; i++) {
			const float sum = primary[i] + ret_scatter[i];
			const float power = sum / (primary[i] + FOLLOWS * ret_scatter[i]);

			primary[i] = fmaxf(T_LEAST, primary[i] * powf(fmaxf(total[i], T_LEAST) / sum, power));
		}
	}
}

void scatter_of_total(struct scatter *scatter, const struct scatter_model *model, const float *total,
		      float *ret_scatter)
{
	const size_t cells = cells_of(scatter);
	float *primary = scatter->primary;

	for (size_t i = 0; i < cells; i++)
		primary[i] = fmaxf(total[i], T_LEAST);
	if (scatter->field != NULL) {
		find_field(scatter, model, total, ret_scatter);
		return;
	}
	for (int step = 0; step < STEPS; step++) {
		scatter_of_primary(scatter, model, primary, ret_scatter);
		for (size_t i = 0; i < cells; i++)
			primary[i] =
			    fmaxf(T_LEAST, fmaxf(total[i], T_LEAST) * primary[i] / (primary[i] + ret_scatter[i]));
	}
	for (size_t i = 0; i < cells; i++)
		ret_scatter[i] = fmaxf(0, total[i] - primary[i]);
}

void scatter_estimate(struct scatter *scatter, const float *total, double air)
{
	const size_t cells = cells_of(scatter);

	scatter_means(scatter, total, false, scatter->total);
	for (size_t i = 0; i < cells; i++)
		scatter->total[i] /= (float)air;
	if (scatter->model.fraction > 0)
		estimate_constant(scatter);
	else
		scatter_of_total(scatter, &scatter->model, scatter->total, scatter->estimate);
	for (size_t i = 0; i < cells; i++) {
		scatter->total[i] *= (float)air;
		scatter->estimate[i] *= (float)air;
	}
}

double scatter_share(const struct scatter *scatter)
{
	double scattered = 0, all = 0;

	for (size_t i = 0; i < cells_of(scatter); i++) {
		scattered += (double)scatter->estimate[i];
		all += (double)scatter->total[i];
	}
	return all > 0 ? scattered / all : 0;
}

void scatter_row(const struct scatter *scatter, int row, float *ret_row)
{
	const struct axis *across = &scatter->across, *along = &scatter->along;
	const float down = along->share[row];
	const float *first = scatter->estimate + (size_t)along->before[row] * (size_t)across->cells;
	const float *second = down > 0 ? first + across->cells : first;
	float line[SCATTER_CELLS + 1] = {0};

	for (int i = 0; i < across->cells; i++)
		line[i] = first[i] + down * (second[i] - first[i]);
	for (int column = 0; column < across->pixels; column++) {
		const float *cell = line + across->before[column];

		ret_row[column] = cell[0] + across->share[column] * (cell[1] - cell[0]);
	}
}

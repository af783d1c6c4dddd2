/*
 * Raw samples to line integrals in one pass, turned to [column][row]:
 *
 *   p  = -ln((I - dark) / (a (flat - dark))),  a the view's own air (1 without an air region),
 *   p' = hardening[0] + hardening[1] p + hardening[2] p^2 + ...
 *
 * Pixels that say nothing, and those of the map, are replaced from the nearest
 * good ones in their row and column.
 */
#include "core/cpu/cpu.h"

#include <stdlib.h>

/* A sample as a line integral; `air` is that of the view. */
static enum pixel_kind linear(const struct linearise *options, float sample, size_t at, float saturation, float air,
			      float *ret)
{
	enum pixel_kind kind = PIXEL_GOOD;
	float p = sample, sum = 0;

	if (linearise_mapped(options, at)) {
		*ret = 0;
		return PIXEL_MAPPED;
	}
	if (options->quantity == QUANTITY_INTENSITY) {
		kind = linearise_transmission(options, sample, at, saturation, &p);
		p = -logf(p / air);
	}
	if (options->hardening_count > 0) {
		for (int k = options->hardening_count - 1; k >= 0; k--)
			sum = sum * p + (float)options->hardening[k];
		p = sum;
	}
	if (kind == PIXEL_GOOD && !isfinite(p))
		kind = PIXEL_NOT_FINITE;
	*ret = kind == PIXEL_GOOD ? p : 0;
	return kind;
}

/* The view's air: the mean transmission of its air region's good pixels; 0 where it has none. */
static double air_of(const struct plan *plan, const void *samples)
{
	const struct linearise *options = &plan->linearise;
	const int *region = options->air_region;
	const float saturation = linearise_saturation(options);
	double sum = 0;
	size_t good = 0;

	for (int row = region[1]; row <= region[3]; row++) {
		for (int column = region[0]; column <= region[2]; column++) {
			const size_t at = (size_t)row * (size_t)plan->columns + (size_t)column;
			float value;

			if (linearise_mapped(options, at))
				continue;
			if (linearise_transmission(options, linearise_sample(options, samples, at), at, saturation,
						   &value) != PIXEL_GOOD)
				continue;
			sum += (double)value;
			good++;
		}
	}
	return good > 0 ? sum / (double)good : 0;
}

/* Rows row .. row + count - 1 of one view; adds up each kind of pixel. */
static void linearise_rows(struct plan *plan, const void *samples, int row, int count, float air, float *ret_view,
			   size_t kinds[PIXEL_KINDS])
{
	const struct linearise *options = &plan->linearise;
	const float saturation = linearise_saturation(options);
	const size_t rows = (size_t)plan->rows;

	for (int column = 0; column < plan->columns; column++) {
		for (int r = row; r < row + count; r++) {
			const size_t from = (size_t)r * (size_t)plan->columns + (size_t)column;
			const size_t to = (size_t)column * rows + (size_t)r;
			const enum pixel_kind kind = linear(options, linearise_sample(options, samples, from), from,
							    saturation, air, &ret_view[to]);

			plan->defective[to] = kind != PIXEL_GOOD;
			kinds[kind]++;
		}
	}
}

/*
 * Where the nearest good pixels lie, for a walk through the columns in order:
 * for each row the last good column before this one and the first behind it.
 * Each is looked for from where the last search ended, so that a walk takes as
 * many looks as there are pixels, however many are bad.
 */
struct nearest {
	int *before, *behind; /* [rows], columns; -1 and the number of columns: none */
	int above, below;     /* rows of this column, likewise */
};

static void nearest_column(const struct plan *plan, int column, struct nearest *nearest)
{
	const unsigned char *map = plan->defective + (size_t)column * (size_t)plan->rows;

	for (int row = 0; column > 0 && row < plan->rows; row++)
		if (!map[row - plan->rows])
			nearest->before[row] = column - 1;
	nearest->above = nearest->below = -1;
}

static void nearest_pixel(const struct plan *plan, int column, int row, struct nearest *nearest)
{
	const unsigned char *map = plan->defective + (size_t)column * (size_t)plan->rows;
	int *behind = &nearest->behind[row];

	if (*behind <= column)
		for (*behind = column + 1; *behind < plan->columns; ++*behind)
			if (!plan->defective[(size_t)*behind * (size_t)plan->rows + (size_t)row])
				break;
	if (nearest->below <= row)
		for (nearest->below = row + 1; nearest->below < plan->rows; nearest->below++)
			if (!map[nearest->below])
				break;
}

/* The mean of the nearest good pixels in row and column, weighted by 1 / distance; false: there is none. */
static bool replacement(const struct plan *plan, const float *view, int column, int row, const struct nearest *nearest,
			float *ret)
{
	const int at[4][2] = {{nearest->before[row], row},
			      {nearest->behind[row], row},
			      {column, nearest->above},
			      {column, nearest->below}};
	float sum = 0, weights = 0;

	for (int i = 0; i < 4; i++) {
		const int c = at[i][0], r = at[i][1];

		if (c < 0 || c >= plan->columns || r < 0 || r >= plan->rows)
			continue;
		const float weight = 1 / (float)(abs(c - column) + abs(r - row));

		sum += weight * view[(size_t)c * (size_t)plan->rows + (size_t)r];
		weights += weight;
	}
	if (weights > 0)
		*ret = sum / weights;
	return weights > 0;
}

/* Replaces the defects that have a good pixel in their row or column; returns how many have none. */
static size_t replace_once(struct plan *plan, float *view)
{
	enum { WHOLE, DEFECTIVE, REPLACED };
	const size_t pixels = (size_t)plan->columns * (size_t)plan->rows;
	struct nearest nearest = {.before = (int *)plan->scratch, .behind = (int *)plan->scratch + plan->rows};
	size_t left = 0;

	for (int row = 0; row < plan->rows; row++)
		nearest.before[row] = nearest.behind[row] = -1;
	for (int column = 0; column < plan->columns; column++) {
		nearest_column(plan, column, &nearest);
		for (int row = 0; row < plan->rows; row++) {
			const size_t at = (size_t)column * (size_t)plan->rows + (size_t)row;

			if (plan->defective[at] == WHOLE) {
				nearest.above = row;
				continue;
			}
			nearest_pixel(plan, column, row, &nearest);
			if (replacement(plan, view, column, row, &nearest, &view[at]))
				plan->defective[at] = REPLACED;
			else
				left++;
		}
	}
	for (size_t i = 0; i < pixels; i++)
		plan->defective[i] = plan->defective[i] == DEFECTIVE ? DEFECTIVE : WHOLE;
	return left;
}

/*
 * Replaced pixels count as good from the next pass on. After the first one the row and the column of any good pixel are
 * whole, so the second reaches all the rest; without a good pixel all stays 0, air.
 */
static void replace_defects(struct plan *plan, float *view)
{
	if (replace_once(plan, view) > 0)
		replace_once(plan, view);
}

static void count_defects(struct defect_counts *counts, const size_t kinds[PIXEL_KINDS])
{
	counts->mapped += kinds[PIXEL_MAPPED];
	counts->not_finite += kinds[PIXEL_NOT_FINITE];
	counts->saturated += kinds[PIXEL_SATURATED];
	counts->zero += kinds[PIXEL_ZERO];
	counts->blank += kinds[PIXEL_GOOD] == 0;
}

static void count_air(struct defect_counts *counts, float air)
{
	if (!(air > 0)) {
		counts->no_air++;
		return;
	}
	if (air < counts->air_least || counts->air_least == 0)
		counts->air_least = air;
	if (air > counts->air_most)
		counts->air_most = air;
}

int cpu_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		  struct defect_counts *counts, struct error *err)
{
	enum { BLOCK = 16 };
	const size_t pixels = (size_t)plan->columns * (size_t)plan->rows;
	const size_t sample = linearise_sample_bytes(&plan->linearise);
	const int rows = plan->rows;

	for (int i = 0; i < count; i++) {
		const char *view = (const char *)samples + (size_t)i * pixels * sample;
		size_t kinds[PIXEL_KINDS] = {0};
		float *slot, air = 1;

		if (slots[i] < 0 || slots[i] >= to->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], to->slots);
		slot = to->data + (size_t)slots[i] * pixels;
		if (plan->linearise.has_air_region) {
			air = (float)air_of(plan, view);
			count_air(counts, air);
			air = air > 0 ? air : 1;
		}
#pragma omp parallel for num_threads(plan->device->threads) reduction(+ : kinds[:PIXEL_KINDS])
		for (int row = 0; row < rows; row += BLOCK)
			linearise_rows(plan, view, row, rows - row < BLOCK ? rows - row : BLOCK, air, slot, kinds);
		if (kinds[PIXEL_GOOD] < pixels)
			replace_defects(plan, slot);
		count_defects(counts, kinds);
	}
	return 0;
}

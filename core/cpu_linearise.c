/*
 * Raw samples to line integrals, p = -ln((I - dark) / (flat - dark)), turned to
 * [column][row]; pixels that say nothing are replaced from the nearest good ones
 * in their row and column.
 */
#include "core/cpu.h"

#include <stdlib.h>

/* A sample as a line integral; NAN for a defect. */
static float linear(const struct linearise *options, float sample, float flat, float dark, float saturation)
{
	float above, range;

	if (options->quantity == QUANTITY_LINE_INTEGRAL)
		return isfinite(sample) ? sample : NAN;
	above = sample - dark;
	range = flat - dark;
	if (!(above > 0) || !(range > 0) || !(sample < saturation) || !isfinite(range))
		return NAN;
	return -logf(above / range);
}

static float saturation_of(const struct linearise *options)
{
	if (options->saturation > 0)
		return (float)options->saturation;
	return options->sample == SAMPLE_UINT16 ? 65535 : INFINITY;
}

/* Rows row .. row + count - 1 of one view; returns the number of defects. */
static size_t linearise_rows(struct plan *plan, const void *samples, int row, int count, float *ret_view)
{
	const struct linearise *options = &plan->linearise;
	const float saturation = saturation_of(options);
	const size_t rows = (size_t)plan->rows;
	size_t defects = 0;

	for (int column = 0; column < plan->columns; column++) {
		for (int r = row; r < row + count; r++) {
			const size_t from = (size_t)r * (size_t)plan->columns + (size_t)column;
			const size_t to = (size_t)column * rows + (size_t)r;
			const float sample = options->sample == SAMPLE_UINT16 ? ((const uint16_t *)samples)[from]
									      : ((const float *)samples)[from];
			const float flat = options->flat != NULL ? options->flat[from] : (float)options->air;
			const float dark = options->dark != NULL ? options->dark[from] : 0;
			const float p = linear(options, sample, flat, dark, saturation);
			const bool defective = !isfinite(p);

			ret_view[to] = defective ? 0 : p;
			plan->defective[to] = defective;
			defects += defective;
		}
	}
	return defects;
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
	enum { GOOD, DEFECTIVE, REPLACED };
	const size_t pixels = (size_t)plan->columns * (size_t)plan->rows;
	struct nearest nearest = {.before = (int *)plan->scratch, .behind = (int *)plan->scratch + plan->rows};
	size_t left = 0;

	for (int row = 0; row < plan->rows; row++)
		nearest.before[row] = nearest.behind[row] = -1;
	for (int column = 0; column < plan->columns; column++) {
		nearest_column(plan, column, &nearest);
		for (int row = 0; row < plan->rows; row++) {
			const size_t at = (size_t)column * (size_t)plan->rows + (size_t)row;

			if (plan->defective[at] == GOOD) {
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
		plan->defective[i] = plan->defective[i] == DEFECTIVE ? DEFECTIVE : GOOD;
	return left;
}

/*
 * What was replaced counts as good from the next pass on. After the first one
 * the row and the column of any good pixel are whole, so the second reaches all
 * the rest; without a good pixel all stays 0, air.
 */
static void replace_defects(struct plan *plan, float *view)
{
	if (replace_once(plan, view) > 0)
		replace_once(plan, view);
}

int cpu_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		  size_t *defects, struct error *err)
{
	enum { BLOCK = 16 };
	const size_t pixels = (size_t)plan->columns * (size_t)plan->rows;
	const size_t sample = plan->linearise.sample == SAMPLE_UINT16 ? sizeof(uint16_t) : sizeof(float);

	for (int i = 0; i < count; i++) {
		const char *view = (const char *)samples + (size_t)i * pixels * sample;
		size_t found = 0;
		float *slot;

		if (slots[i] < 0 || slots[i] >= to->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], to->slots);
		slot = to->data + (size_t)slots[i] * pixels;
#pragma omp parallel for num_threads(plan->device->threads) reduction(+ : found)
		for (int row = 0; row < plan->rows; row += BLOCK)
			found +=
			    linearise_rows(plan, view, row, plan->rows - row < BLOCK ? plan->rows - row : BLOCK, slot);
		if (found > 0)
			replace_defects(plan, slot);
		*defects += found;
	}
	return 0;
}

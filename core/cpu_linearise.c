/*
 * Raw samples to line integrals, p = -ln((I - dark) / (flat - dark)), turned to
 * [column][row]; pixels that say nothing are replaced from the nearest good ones
 * in their row and column.
 */
#include "core/cpu.h"

#include <string.h>

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

/* Adds what the nearest good pixel in one direction says: weight 1 / distance. */
static void look(const struct plan *plan, const float *view, int column, int row, int column_step, int row_step,
		 float *sum, float *weights)
{
	const size_t rows = (size_t)plan->rows;
	int c = column + column_step, r = row + row_step, distance = 1;

	for (; c >= 0 && c < plan->columns && r >= 0 && r < plan->rows; c += column_step, r += row_step, distance++) {
		size_t at = (size_t)c * rows + (size_t)r;

		if (plan->defective[at])
			continue;
		*sum += view[at] / (float)distance;
		*weights += 1 / (float)distance;
		return;
	}
}

/*
 * Replaces what has a good pixel in its row or column; those replaced are good
 * from the next pass on. After the first pass the row and the column of any good
 * pixel are whole, so the second one reaches all the rest.
 */
static void replace_defects(struct plan *plan, float *view, size_t defects)
{
	enum { GOOD, DEFECTIVE, REPLACED };
	const size_t pixels = (size_t)plan->columns * (size_t)plan->rows;

	if (defects == pixels)
		return; /* nothing to go by: air */
	for (int pass = 0; pass < 2; pass++) {
		for (int column = 0; column < plan->columns; column++) {
			for (int row = 0; row < plan->rows; row++) {
				const size_t at = (size_t)column * (size_t)plan->rows + (size_t)row;
				float sum = 0, weights = 0;

				if (plan->defective[at] != DEFECTIVE)
					continue;
				look(plan, view, column, row, -1, 0, &sum, &weights);
				look(plan, view, column, row, 1, 0, &sum, &weights);
				look(plan, view, column, row, 0, -1, &sum, &weights);
				look(plan, view, column, row, 0, 1, &sum, &weights);
				if (weights > 0) {
					view[at] = sum / weights;
					plan->defective[at] = REPLACED;
				}
			}
		}
		for (size_t i = 0; i < pixels; i++)
			plan->defective[i] = plan->defective[i] == DEFECTIVE ? DEFECTIVE : GOOD;
	}
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
			replace_defects(plan, slot, found);
		*defects += found;
	}
	return 0;
}

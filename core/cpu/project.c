/* Forward projection on the CPU: blocks of detector columns of one view are handed out to the threads. */
#include "core/cpu/cpu.h"

int column_blocks(const struct plan *plan)
{
	return (plan->columns + BLOCK_COLUMNS - 1) / BLOCK_COLUMNS;
}

int cpu_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		struct error *err)
{
	const int blocks = column_blocks(plan);

	if (count > to->slots)
		return error_set(err, ERR_INTERNAL, "%d views to project into a stack of %d slots", count, to->slots);
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
	for (int job = 0; job < count * blocks; job++) {
		const int slot = job / blocks, column = job % blocks * BLOCK_COLUMNS;
		const int left = plan->columns - column, columns = left < BLOCK_COLUMNS ? left : BLOCK_COLUMNS;
		float *lengths = plan_scratch(plan);
		float *scratch = lengths + (size_t)BLOCK_COLUMNS * (size_t)plan->rows;

		plan->device->kernels->project(plan, views[slot], column, columns, from->data,
					       to->data + ((size_t)slot * (size_t)plan->columns + (size_t)column) *
							      (size_t)plan->rows,
					       lengths, scratch);
		pulse_beat();
	}
	return 0;
}

/* Steps over all views at once, which algorithms without subsets share: core/recon/algorithm.h. */
#include <math.h>

#include "core/recon/algorithm.h"

int problem_project(const struct problem *problem, const struct volume *x, struct stack *y, struct error *err)
{
	int code = cancel_check(problem->cancel, err);

	return code == 0 ? problem->backend->project(problem->plan, x, problem->views, problem->geometry->count, y, err)
			 : code;
}

int problem_backproject(const struct problem *problem, const struct stack *x, struct volume *y, struct error *err)
{
	int code = cancel_check(problem->cancel, err);

	return code == 0 ? problem->backend->backproject(problem->plan, x, problem->views, problem->geometry->count,
							 BACKPROJECT_PLAIN, y, err)
			 : code;
}

double problem_shortest(const struct problem *problem)
{
	const double *mm = problem->grid->spacing;

	return fmin(fmin(mm[0], mm[1]), mm[2]);
}

int problem_divide_by_lengths(const struct problem *problem, struct stack *lengths, struct stack *weights,
			      struct error *err)
{
	const struct backend *backend = problem->backend;
	int code = backend->volume_fill(problem->before, 1, err);

	if (code == 0)
		code = problem_project(problem, problem->before, lengths, err);
	return code == 0 ? backend->stack_divide(lengths, RAY_LENGTH_LEAST * problem_shortest(problem),
						 problem->geometry->count, weights, err)
			 : code;
}

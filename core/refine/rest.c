/* Where the object is shown: see rest.h. */
#include "core/refine/rest.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* The middles of a box's faces have its second moments. */
enum { POINTS = 6 };

struct stand {
	const struct path *path;
	const struct path_view *views;
	int count;
	double points[POINTS][3];
};

/* Where the views that a common motion moves have the points, less where the told ones do: mm on the detector. */
static void departures(const struct stand *stand, const double common[PATH_NUMBERS], double *ret)
{
	struct path path = *stand->path;

	memcpy(path.common, common, sizeof(path.common));
	for (int v = 0; v < stand->count; v++) {
		const struct view *told = &stand->views[v].view;
		double motion[PATH_NUMBERS], there[12], here[12];
		struct view moved;

		path_motion(&path, stand->views[v].at, told, motion);
		moved = view_of_moved(told, motion);
		view_matrix(told, there);
		view_matrix(&moved, here);
		for (int i = 0; i < POINTS; i++) {
			double a[2], b[2];

			view_project(there, stand->points[i], &a[0], &a[1]);
			view_project(here, stand->points[i], &b[0], &b[1]);
			*ret++ = (b[0] - a[0]) * vec_norm(told->column_step);
			*ret++ = (b[1] - a[1]) * vec_norm(told->row_step);
		}
	}
}

/* Solves a x = b for a symmetric positive matrix by Gauss's elimination; both are overwritten. */
static void solve(double a[PATH_NUMBERS][PATH_NUMBERS], double b[PATH_NUMBERS])
{
	for (int k = 0; k < PATH_NUMBERS; k++)
		for (int i = k + 1; i < PATH_NUMBERS; i++) {
			const double factor = a[i][k] / a[k][k];

			for (int j = k; j < PATH_NUMBERS; j++)
				a[i][j] -= factor * a[k][j];
			b[i] -= factor * b[k];
		}
	for (int k = PATH_NUMBERS - 1; k >= 0; k--) {
		for (int j = k + 1; j < PATH_NUMBERS; j++)
			b[k] -= a[k][j] * b[j];
		b[k] /= a[k][k];
	}
}

/* A step of Gauss and Newton with differences for derivatives; each: [1 + PATH_NUMBERS][count] to work in. */
static void step(const struct stand *stand, double *each, int count, double common[PATH_NUMBERS])
{
	static const double BY = 1e-4;
	double squares[PATH_NUMBERS][PATH_NUMBERS], right[PATH_NUMBERS];

	for (int i = 0; i <= PATH_NUMBERS; i++) {
		double shifted[PATH_NUMBERS];

		memcpy(shifted, common, sizeof(shifted));
		if (i > 0)
			shifted[i - 1] += BY;
		departures(stand, shifted, each + (size_t)i * (size_t)count);
	}
	for (int i = 0; i < PATH_NUMBERS; i++) {
		const double *mine = each + (size_t)(i + 1) * (size_t)count;

		right[i] = 0;
		for (int j = 0; j < PATH_NUMBERS; j++)
			squares[i][j] = 0;
		for (int r = 0; r < count; r++) {
			right[i] -= (mine[r] - each[r]) / BY * each[r];
			for (int j = 0; j < PATH_NUMBERS; j++)
				squares[i][j] += (mine[r] - each[r]) / BY *
						 (each[(size_t)(j + 1) * (size_t)count + (size_t)r] - each[r]) / BY;
		}
	}
	solve(squares, right);
	for (int i = 0; i < PATH_NUMBERS; i++)
		common[i] += right[i];
}

int path_rest(struct path *path, const struct path_view *views, int count, const struct grid *shown, struct error *err)
{
	enum { STEPS = 6 };
	struct stand stand = {.path = path, .views = views, .count = count};
	const int residuals = 2 * POINTS * count;
	double *each = malloc((1 + PATH_NUMBERS) * (size_t)residuals * sizeof(*each)), common[PATH_NUMBERS];

	if (each == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int i = 0; i < POINTS; i++)
		for (int a = 0; a < 3; a++) {
			const double half = 0.5 * shown->size[a] * shown->spacing[a];

			stand.points[i][a] = shown->origin[a] + half - 0.5 * shown->spacing[a] +
					     (i / 2 != a   ? 0
					      : i % 2 == 0 ? -half
							   : half);
		}
	memcpy(common, path->common, sizeof(common));
	for (int i = 0; i < STEPS; i++)
		step(&stand, each, residuals, common);
	memcpy(path->common, common, sizeof(common));
	free(each);
	return 0;
}

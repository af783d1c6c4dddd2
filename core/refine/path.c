/* Smooth paths of rigid motions: see path.h. */
#include "core/refine/path.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

void path_open(struct path *ret_path, bool of_views, double length, int knots)
{
	*ret_path = (struct path){.of_views = of_views, .length = length, .knots = knots};
}

static double spline(double from_knot)
{
	const double t = fabs(from_knot);

	if (t >= 2)
		return 0;
	return t < 1 ? 2. / 3 - t * t + t * t * t / 2 : (2 - t) * (2 - t) * (2 - t) / 6;
}

/* Where on the scale of the knots' indices: the first and the last knot stand outside of the sweep. */
static double on_knots(const struct path *path, double at)
{
	return 1 + at / path->length * (path->knots - 3);
}

void path_at(const struct path *path, double at, double ret_numbers[PATH_NUMBERS])
{
	const double u = on_knots(path, at);

	memset(ret_numbers, 0, PATH_NUMBERS * sizeof(*ret_numbers));
	for (int k = 0; k < path->knots; k++) {
		const double share = spline(u - k);

		for (int i = 0; i < PATH_NUMBERS && share > 0; i++)
			ret_numbers[i] += share * path->numbers[k][i];
	}
}

/* A uniform spline's knots at half the distance (Lane and Riesenfeld 1980). */
void path_double(struct path *path)
{
	struct path fine = *path;

	fine.knots = 2 * path->knots - 3;
	if (fine.knots > PATH_KNOTS_MOST)
		return;
	for (int k = 0; k < fine.knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++) {
			const int at = (k + 1) / 2;

			/* Knot 1 stays where it is; even ones are new, between two. */
			fine.numbers[k][i] =
			    k % 2 == 0
				? (path->numbers[at][i] + path->numbers[at + 1][i]) / 2
				: (path->numbers[at - 1][i] + 6 * path->numbers[at][i] + path->numbers[at + 1][i]) / 8;
		}
	*path = fine;
}

double path_size(const struct path *path)
{
	enum { PLACES = 256 };
	double squares = 0;

	for (int i = 0; i < PLACES; i++) {
		double numbers[PATH_NUMBERS];

		path_at(path, path->length * i / (PLACES - 1), numbers);
		for (int a = 0; a < PATH_NUMBERS; a++)
			squares += path->of_views && a == 2 ? 0 : numbers[a] * numbers[a] / PLACES;
	}
	return sqrt(squares);
}

void view_axes(const struct view *view, double ret_axes[3][3])
{
	memcpy(ret_axes[0], view->column_step, sizeof(ret_axes[0]));
	memcpy(ret_axes[1], view->row_step, sizeof(ret_axes[1]));
	vec_cross(ret_axes[0], ret_axes[1], ret_axes[2]);
	for (int i = 0; i < 3; i++) {
		const double length = vec_norm(ret_axes[i]);

		for (int a = 0; a < 3; a++)
			ret_axes[i][a] /= length;
	}
}

static void to_world(const struct path *path, double axes[3][3], const double numbers[PATH_NUMBERS],
		     double ret_world[PATH_NUMBERS])
{
	memcpy(ret_world, numbers, PATH_NUMBERS * sizeof(*ret_world));
	for (int i = 0; i < PATH_NUMBERS && path->of_views; i++) {
		const int of = i < 3 ? 0 : 3;

		ret_world[i] = 0;
		for (int a = 0; a < 3; a++)
			ret_world[i] += axes[a][i - of] * numbers[of + a];
	}
}

/* Turns x back about the vector `turn` by its length (Rodrigues 1840). */
static void turn_back(const double turn[3], const double x[3], double ret[3])
{
	const double angle = vec_norm(turn), s = angle > 0 ? -sin(angle) / angle : -1;
	const double c = angle > 0 ? (1 - cos(angle)) / (angle * angle) : 0.5;
	double once[3], twice[3];

	vec_cross(turn, x, once);
	vec_cross(turn, once, twice);
	for (int a = 0; a < 3; a++)
		ret[a] = x[a] + s * once[a] + c * twice[a];
}

/* Turns one behind another: the vector of rotation that both together are (Rodrigues 1840). */
static void turn_both(const double last[3], const double first[3], double ret[3])
{
	double parts[2][4], axis[3], sine, cosine, length;

	for (int i = 0; i < 2; i++) {
		const double *turn = i == 0 ? last : first, angle = vec_norm(turn);

		parts[i][3] = cos(angle / 2);
		for (int a = 0; a < 3; a++)
			parts[i][a] = (angle > 0 ? sin(angle / 2) / angle : 0.5) * turn[a];
	}
	vec_cross(parts[0], parts[1], axis);
	for (int a = 0; a < 3; a++)
		axis[a] += parts[0][3] * parts[1][a] + parts[1][3] * parts[0][a];
	cosine = parts[0][3] * parts[1][3] - vec_dot(parts[0], parts[1]);
	sine = vec_norm(axis);
	length = sine > 0 ? 2 * atan2(sine, cosine) / sine : 2;
	for (int a = 0; a < 3; a++)
		ret[a] = length * axis[a];
}

void path_motion(const struct path *path, double at, const struct view *view, double ret_motion[PATH_NUMBERS])
{
	double numbers[PATH_NUMBERS], axes[3][3], world[PATH_NUMBERS], back[3], common[3], shift[3];

	path_at(path, at, numbers);
	view_axes(view, axes);
	to_world(path, axes, numbers, world);
	for (int a = 0; a < 3; a++) {
		world[3 + a] *= PATH_TURN_UNIT;
		back[a] = -world[3 + a];
		common[a] = path->common[3 + a] * PATH_TURN_UNIT;
	}
	turn_back(back, path->common, shift);
	for (int a = 0; a < 3; a++)
		ret_motion[a] = world[a] + shift[a];
	turn_both(world + 3, common, ret_motion + 3);
}

struct view view_of_moved(const struct view *view, const double motion[PATH_NUMBERS])
{
	double source[3], pixel0[3];
	struct view ret;

	for (int a = 0; a < 3; a++) {
		source[a] = view->source[a] - motion[a];
		pixel0[a] = view->pixel0[a] - motion[a];
	}
	turn_back(motion + 3, source, ret.source);
	turn_back(motion + 3, pixel0, ret.pixel0);
	turn_back(motion + 3, view->column_step, ret.column_step);
	turn_back(motion + 3, view->row_step, ret.row_step);
	return ret;
}

/* ---- a step ---- */

struct equations {
	int size;
	double *matrix, *right; /* [size][size], [size] */
};

/* Standard deviations, mm and hundredths of a radian: what all views share may be large. */
static const double COMMON_EXPECTED = 10;
/* The residual, the path's numbers, and those that all views share. */
enum { ALL = 1 + 2 * PATH_NUMBERS, COMMON = 1 + PATH_NUMBERS };

/* M' products M, where M takes numbers of the path, and common ones, to those of the world; [0] is the residual's. */
static void turn_products(const struct path *path, double axes[3][3], const double *products, double ret[ALL][ALL])
{
	enum { WORLD = 1 + PATH_NUMBERS };
	double m[WORLD][ALL] = {{0}}, full[WORLD][WORLD], half[WORLD][ALL] = {{0}};

	m[0][0] = 1;
	for (int i = 0; i < PATH_NUMBERS; i++) {
		double one[PATH_NUMBERS] = {0}, world[PATH_NUMBERS];

		one[i] = 1;
		to_world(path, axes, one, world);
		for (int a = 0; a < PATH_NUMBERS; a++)
			m[a + 1][i + 1] = world[a];
		m[i + 1][COMMON + i] = 1;
	}
	for (int i = 0, at = 0; i < WORLD; i++)
		for (int j = 0; j <= i; j++)
			full[i][j] = full[j][i] = products[at++];
	for (int i = 0; i < WORLD; i++)
		for (int j = 0; j < ALL; j++)
			for (int k = 0; k < WORLD; k++)
				half[i][j] += full[i][k] * m[k][j];
	for (int i = 0; i < ALL; i++)
		for (int j = 0; j < ALL; j++) {
			ret[i][j] = 0;
			for (int k = 0; k < WORLD; k++)
				ret[i][j] += m[k][i] * half[k][j];
		}
}

/* Adds that the numbers about the view's axes are expected to be small; `now` are the path's numbers. */
static void expect_small(const struct path *path, double axes[3][3], const double sigma[PATH_NUMBERS],
			 const double now[PATH_NUMBERS], double products[ALL][ALL])
{
	for (int i = 0; i < PATH_NUMBERS; i++)
		for (int j = 0; j < PATH_NUMBERS; j++) {
			const int of = i < 3 ? 0 : 3;
			double weight = 0;

			if ((i < 3) != (j < 3))
				continue;
			for (int a = 0; a < 3; a++) {
				const double x = path->of_views ? a == i - of : axes[a][i - of];
				const double y = path->of_views ? a == j - of : axes[a][j - of];

				weight += x * y / (sigma[of + a] * sigma[of + a]);
			}
			products[i + 1][j + 1] += weight;
			products[i + 1][0] -= weight * now[j];
		}
}

/* Unknowns that a view's motion is made of: six at `row`, of which the view has a share, and their first product. */
struct part {
	int row, product;
	double share;
};

/* At most four knots' and the common one. */
enum { PARTS_MOST = 5 };

static int parts_of(const struct path *path, double at, struct part ret[PARTS_MOST])
{
	const double u = on_knots(path, at);
	int count = 0;

	for (int k = 0; k < path->knots; k++)
		if (spline(u - k) > 0)
			ret[count++] = (struct part){PATH_NUMBERS * k, 1, spline(u - k)};
	if (path->of_views)
		ret[count++] = (struct part){PATH_NUMBERS * path->knots, COMMON, 1};
	return count;
}

static void add_view(const struct path *path, const struct path_view *view, const double sigma[PATH_NUMBERS],
		     struct equations *equations)
{
	double axes[3][3], now[PATH_NUMBERS], products[ALL][ALL];
	struct part parts[PARTS_MOST];
	const int count = parts_of(path, view->at, parts);

	path_at(path, view->at, now);
	view_axes(&view->view, axes);
	turn_products(path, axes, view->products, products);
	expect_small(path, axes, sigma, now, products);
	for (int a = 0; a < count; a++)
		for (int i = 0; i < PATH_NUMBERS; i++) {
			const struct part *mine = &parts[a];
			double *row = equations->matrix + (mine->row + i) * equations->size;

			equations->right[mine->row + i] += mine->share * products[mine->product + i][0];
			for (int b = 0; b < count; b++)
				for (int j = 0; j < PATH_NUMBERS; j++)
					row[parts[b].row + j] += mine->share * parts[b].share *
								 products[mine->product + i][parts[b].product + j];
		}
}

/* By Cholesky's factors; a number that no view says anything of stays as it is. The right side becomes the solution. */
static void solve(struct equations *equations)
{
	const int n = equations->size;
	double *a = equations->matrix, *x = equations->right;

	for (int j = 0; j < n; j++) {
		double root;

		for (int k = 0; k < j; k++)
			for (int i = j; i < n; i++)
				a[i * n + j] -= a[i * n + k] * a[j * n + k];
		root = a[j * n + j] > 1e-12 ? sqrt(a[j * n + j]) : INFINITY;
		for (int i = j + 1; i < n; i++)
			a[i * n + j] /= root;
		a[j * n + j] = root;
	}
	for (int i = 0; i < n; i++) {
		for (int k = 0; k < i; k++)
			x[i] -= a[i * n + k] * x[k];
		x[i] /= a[i * n + i];
	}
	for (int i = n - 1; i >= 0; i--) {
		for (int k = i + 1; k < n; k++)
			x[i] -= a[k * n + i] * x[k];
		x[i] /= a[i * n + i];
	}
}

/* What all views share is where the object lies, which no scan tells. */
static void take_mean_off(struct path *path, const struct path_view *views, int count)
{
	double mean[PATH_NUMBERS] = {0}, numbers[PATH_NUMBERS];

	for (int v = 0; v < count; v++) {
		path_at(path, views[v].at, numbers);
		for (int i = 0; i < PATH_NUMBERS; i++)
			mean[i] += numbers[i] / count;
	}
	for (int k = 0; k < path->knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++)
			path->numbers[k][i] -= mean[i];
}

/* The mean over the views in use of the way across a view's columns and rows, along its beam. */
static void mean_beam(const struct path_view *views, int count, double ret_mean[3])
{
	double axes[3][3];
	int used = 0;

	memset(ret_mean, 0, 3 * sizeof(*ret_mean));
	for (int v = 0; v < count; v++)
		used += views[v].used;
	for (int v = 0; v < count; v++) {
		view_axes(&views[v].view, axes);
		for (int a = 0; a < 3 && views[v].used; a++)
			ret_mean[a] += axes[2][a] / used;
	}
}

/*
 * Adds that an object is expected to be no nearer to the source in all views, `nearer` mm: that would be a larger
 * object, in the same images. A shift of it that the views share is none along their beams' mean.
 */
static void expect_size(const struct path *path, const struct path_view *views, int count, double nearer,
			struct equations *equations)
{
	double mean[3], along[PATH_NUMBERS * PATH_KNOTS_MOST] = {0}, now = 0, weight;
	int used = 0;

	mean_beam(views, count, mean);
	for (int v = 0; v < count; v++) {
		const double u = on_knots(path, views[v].at);
		double axes[3][3];

		if (!views[v].used)
			continue;
		used++;
		view_axes(&views[v].view, axes);
		for (int k = 0; k < path->knots; k++)
			for (int a = 0; a < 3; a++)
				along[PATH_NUMBERS * k + a] += spline(u - k) * (axes[2][a] - mean[a]);
	}
	weight = 1 / (nearer * nearer * (used > 0 ? used : 1));
	for (int k = 0; k < path->knots; k++)
		for (int a = 0; a < 3; a++)
			now += along[PATH_NUMBERS * k + a] * path->numbers[k][a];
	for (int i = 0; i < PATH_NUMBERS * path->knots; i++) {
		equations->right[i] -= weight * now * along[i];
		for (int j = 0; j < PATH_NUMBERS * path->knots; j++)
			equations->matrix[i * equations->size + j] += weight * along[i] * along[j];
	}
}

int path_step(struct path *path, const struct path_view *views, int count, const double sigma[PATH_NUMBERS],
	      double nearer, double factor, struct error *err)
{
	struct equations equations = {.size = PATH_NUMBERS * (path->knots + path->of_views)};
	const size_t size = (size_t)equations.size;

	equations.matrix = calloc(size * (size + 1), sizeof(double));
	if (equations.matrix == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d unknowns of a path", equations.size);
	equations.right = equations.matrix + size * size;
	for (int v = 0; v < count; v++)
		if (views[v].used)
			add_view(path, &views[v], sigma, &equations);
	expect_size(path, views, count, nearer, &equations);
	for (int i = 0; i < PATH_NUMBERS && path->of_views; i++) {
		const int row = PATH_NUMBERS * path->knots + i;

		equations.matrix[row * equations.size + row] += 1 / (COMMON_EXPECTED * COMMON_EXPECTED);
		equations.right[row] -= path->common[i] / (COMMON_EXPECTED * COMMON_EXPECTED);
	}
	solve(&equations);
	for (int i = 0; i < PATH_NUMBERS && path->of_views; i++)
		path->common[i] += factor * equations.right[PATH_NUMBERS * path->knots + i];
	for (int k = 0; k < path->knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++)
			path->numbers[k][i] += factor * equations.right[PATH_NUMBERS * k + i];
	free(equations.matrix);
	if (!path->of_views)
		take_mean_off(path, views, count);
	return 0;
}

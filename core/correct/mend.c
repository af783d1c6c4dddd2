/* Views made whole from those that see the same rays: see mend.h. */
#include "core/correct/mend.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { AT_ONCE = 8 }; /* views that are made whole in one pass over the others */
static const double PI = 3.14159265358979323846;
/* Degrees, at most, between the two views that a ray lies between, and that a view does. */
static const double GAP = 10, BESIDE = 20;

/* The good views by the angle of their sources. */
struct good_views {
	int *views; /* [count], owned */
	int count;
};

/* For each column of a view, the two good views between whose sources its ray leaves the circle of the sources. */
struct partners {
	int view[2];  /* below 0: there are none */
	double share; /* of the second */
};

struct whole {
	const struct mend_tools *tools;
	struct good_views good;
	struct partners *partners; /* [AT_ONCE][columns] */
	float *values, *known;     /* [AT_ONCE][rows][columns]: sums of shares of line integrals, and of shares */
	float *view;               /* [rows][columns] */
};

struct mend_area mend_area_of(const struct step *step, int columns, int rows)
{
	const int pixels[2] = {columns, rows};
	struct mend_area area;

	for (int a = 0; a < 2; a++) {
		area.first[a] = (int)floor(fmax(0, step->first[a] - step->border) * pixels[a]);
		area.end[a] = (int)ceil(fmin(1, step->end[a] + step->border) * pixels[a]);
	}
	return area;
}

static int good_views_make(struct good_views *ret, const struct mend_tools *tools, struct error *err)
{
	const struct orbit *orbit = tools->orbit;

	ret->count = 0;
	ret->views = malloc((size_t)orbit->count * sizeof(*ret->views));
	if (ret->views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the order of %d views", orbit->count);
	for (int i = 0; i < orbit->count; i++) {
		int at = ret->count;

		if (tools->bad[i])
			continue;
		for (; at > 0 && orbit->angle[ret->views[at - 1]] > orbit->angle[i]; at--)
			ret->views[at] = ret->views[at - 1];
		ret->views[at] = i;
		ret->count++;
	}
	return 0;
}

/* The good views before and behind an angle, where they are that near to each other, in degrees. */
static struct partners partners_at(const struct whole *whole, double angle, double gap)
{
	const struct good_views *good = &whole->good;
	const double *angles = whole->tools->orbit->angle;
	int low = 0, high = good->count;
	double from, to;
	struct partners partners = {.view = {-1, -1}};

	if (good->count < 2)
		return partners;
	while (low < high) {
		const int middle = (low + high) / 2;

		if (angles[good->views[middle]] <= angle)
			low = middle + 1;
		else
			high = middle;
	}
	partners.view[0] = good->views[(low + good->count - 1) % good->count];
	partners.view[1] = good->views[low % good->count];
	from = angles[partners.view[0]] - (low == 0 ? 2 * PI : 0);
	to = angles[partners.view[1]] + (low == good->count ? 2 * PI : 0);
	if (to - from > gap * PI / 180)
		return (struct partners){.view = {-1, -1}};
	partners.share = to > from ? (angle - from) / (to - from) : 0;
	return partners;
}

/* The unit vector of a pixel's ray from the source, in the world. */
static void ray_of(const struct view *view, double column, double row, double ret[3])
{
	double length;

	for (int a = 0; a < 3; a++)
		ret[a] = view->pixel0[a] + column * view->column_step[a] + row * view->row_step[a] - view->source[a];
	length = vec_norm(ret);
	for (int a = 0; a < 3; a++)
		ret[a] /= length;
}

/* Part of the length of a ray from the source to the place that is nearest to the axis. */
static double way_to_axis(const struct orbit *orbit, const struct view *view, const double ray[3])
{
	const double *x = orbit->frame[0], *y = orbit->frame[1];
	const double along[2] = {vec_dot(ray, x), vec_dot(ray, y)};

	return -(vec_dot(view->source, x) * along[0] + vec_dot(view->source, y) * along[1]) /
	       (along[0] * along[0] + along[1] * along[1]);
}

/* Where the ray through the middle of a column leaves the circle of the sources: twice as far as the axis is. */
static double leaves_at(const struct orbit *orbit, const struct view *view, int column, int rows)
{
	double ray[3], way, angle, place[2];

	ray_of(view, column, 0.5 * (rows - 1), ray);
	way = 2 * way_to_axis(orbit, view, ray);
	for (int a = 0; a < 2; a++)
		place[a] = vec_dot(view->source, orbit->frame[a]) + way * vec_dot(ray, orbit->frame[a]);
	angle = atan2(place[1], place[0]);
	return angle < 0 ? angle + 2 * PI : angle;
}

static bool is_partner(const struct whole *whole, int count, int view)
{
	const int columns = whole->tools->geometry->columns;

	for (int i = 0; i < count * columns; i++)
		if (whole->partners[i].view[0] == view || whole->partners[i].view[1] == view)
			return true;
	return false;
}

/* Between pixels; NAN beyond the detector. */
static float value_at(const float *view, int columns, int rows, double column, double row)
{
	const int c = (int)floor(column), r = (int)floor(row);
	const float u = (float)(column - c), v = (float)(row - r);
	const float *at = view + (long long)r * columns + c;

	if (!(column >= 0 && row >= 0 && column <= columns - 1 && row <= rows - 1))
		return NAN;
	if (c == columns - 1 || r == rows - 1)
		return view[(long long)(row + 0.5) * columns + (int)(column + 0.5)];
	return (1 - v) * ((1 - u) * at[0] + u * at[1]) + v * ((1 - u) * at[columns] + u * at[columns + 1]);
}

/* Adds what a good view, whole->view, says of a view to be made whole, the i-th. */
static void add_partner(const struct whole *whole, int i, int view, const double matrix[12], int partner)
{
	const struct geometry *geometry = whole->tools->geometry;
	const int columns = geometry->columns, rows = geometry->rows;
	const struct partners *partners = whole->partners + (size_t)i * (size_t)columns;
	const size_t from = (size_t)i * (size_t)columns * (size_t)rows;

#pragma omp parallel for schedule(static)
	for (int r = 0; r < rows; r++)
		for (int c = 0; c < columns; c++) {
			const size_t at = from + (size_t)r * (size_t)columns + (size_t)c;
			const int which = partners[c].view[1] == partner;
			const double share = which ? partners[c].share : 1 - partners[c].share;
			double ray[3], place[3], way, column, row;
			float value;

			if (partners[c].view[which] != partner)
				continue;
			ray_of(&geometry->views[view], c, r, ray);
			way = way_to_axis(whole->tools->orbit, &geometry->views[view], ray);
			for (int a = 0; a < 3; a++)
				place[a] = geometry->views[view].source[a] + way * ray[a];
			if (!(view_project(matrix, place, &column, &row) > 0))
				continue;
			value = value_at(whole->view, columns, rows, column, row);
			if (isnan(value))
				continue;
			whole->values[at] += (float)share * value;
			whole->known[at] += (float)share;
		}
}

/* What the rays that run the other way say of up to AT_ONCE views; a sum of shares below 1: nothing. */
static int look_opposite(const struct whole *whole, const int *views, int count, struct error *err)
{
	const struct mend_tools *tools = whole->tools;
	const struct geometry *geometry = tools->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	int code = 0;

	memset(whole->values, 0, AT_ONCE * pixels * sizeof(*whole->values));
	memset(whole->known, 0, AT_ONCE * pixels * sizeof(*whole->known));
	for (int i = 0; i < count; i++)
		for (int c = 0; c < geometry->columns; c++)
			whole->partners[i * geometry->columns + c] = partners_at(
			    whole, leaves_at(tools->orbit, &geometry->views[views[i]], c, geometry->rows), GAP);
	for (int k = 0; k < whole->good.count && code == 0; k++) {
		const int partner = whole->good.views[k];
		double matrix[12];

		if (!is_partner(whole, count, partner))
			continue;
		code = cancel_check(tools->cancel, err);
		if (code == 0)
			code = tools->backend->stack_download(tools->projections, partner, 1, whole->view, err);
		view_matrix(&geometry->views[partner], matrix);
		for (int i = 0; i < count && code == 0; i++)
			add_partner(whole, i, views[i], matrix, partner);
	}
	return code;
}

static void whole_clear(struct whole *whole)
{
	free(whole->good.views);
	free(whole->partners);
	free(whole->values);
	free(whole->known);
	free(whole->view);
}

size_t mend_bytes(int columns, int rows)
{
	const size_t pixels = (size_t)columns * (size_t)rows;

	return (2 * AT_ONCE + 1) * pixels * sizeof(float) + AT_ONCE * (size_t)columns * sizeof(struct partners);
}

static int whole_open(struct whole *whole, const struct mend_tools *tools, struct error *err)
{
	const size_t columns = (size_t)tools->geometry->columns, pixels = columns * (size_t)tools->geometry->rows;
	int code;

	*whole = (struct whole){.tools = tools};
	code = good_views_make(&whole->good, tools, err);
	whole->partners = malloc(AT_ONCE * columns * sizeof(*whole->partners));
	whole->values = malloc(AT_ONCE * pixels * sizeof(*whole->values));
	whole->known = malloc(AT_ONCE * pixels * sizeof(*whole->known));
	whole->view = malloc(pixels * sizeof(*whole->view));
	if (code == 0 &&
	    (whole->partners == NULL || whole->values == NULL || whole->known == NULL || whole->view == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory to make views whole");
	if (code < 0)
		whole_clear(whole);
	return code;
}

/* True where the sum of shares is all there is, but for rounding. */
static bool is_known(float shares)
{
	return shares > 0.999f;
}

/* The share of the view behind a run in what lies between its sides, by the angles. */
static float share_of(const struct orbit *orbit, const struct step *step, int view)
{
	double from = (orbit->angle[view] - orbit->angle[step->sides[0]]) * orbit->direction;
	double all = (orbit->angle[step->sides[1]] - orbit->angle[step->sides[0]]) * orbit->direction;

	from += from < 0 ? 2 * PI : 0;
	all += all < 0 ? 2 * PI : 0;
	return all > 0 ? (float)(from / all) : 0.5f;
}

/* Gives the pixels of a part that the opposite rays do not know what the views on both sides of the run show. */
static int take_sides(const struct whole *whole, const struct step *step, int view, const struct mend_area *area,
		      float *values, const float *known, size_t *ret_opposite, struct error *err)
{
	const struct mend_tools *tools = whole->tools;
	const int columns = tools->geometry->columns;
	const float share = share_of(tools->orbit, step, view);
	int code = 0;

	*ret_opposite = 0;
	for (int side = 0; side < 2 && code == 0; side++) {
		const float own = side == 0 ? 1 - share : share;

		code = tools->backend->stack_download(tools->projections, step->sides[side], 1, whole->view, err);
		for (int r = area->first[1]; r < area->end[1] && code == 0; r++)
			for (int c = area->first[0]; c < area->end[0]; c++) {
				const size_t at = (size_t)r * (size_t)columns + (size_t)c;

				if (is_known(known[at]))
					*ret_opposite += (size_t)side;
				else
					values[at] = (side == 0 ? 0 : values[at]) + own * whole->view[at];
			}
	}
	return code;
}

static int put_part(const struct whole *whole, int view, const float *values, const struct mend_area *area,
		    struct error *err)
{
	const struct mend_tools *tools = whole->tools;
	const size_t columns = (size_t)tools->geometry->columns;
	int code = tools->backend->stack_download(tools->projections, view, 1, whole->view, err);

	for (int r = area->first[1]; r < area->end[1]; r++)
		memcpy(whole->view + (size_t)r * columns + area->first[0],
		       values + (size_t)r * columns + area->first[0],
		       (size_t)(area->end[0] - area->first[0]) * sizeof(*values));
	return code == 0 ? tools->backend->stack_upload(tools->projections, view, 1, whole->view, err) : code;
}

int mend_parts(const struct mend_tools *tools, const struct step *steps, const int *views, int count,
	       double *ret_opposite, struct error *err)
{
	const struct geometry *geometry = tools->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	size_t opposite = 0, all = 0;
	struct whole whole;
	int code = whole_open(&whole, tools, err);

	if (code < 0)
		return code;
	for (int from = 0; from < count && code == 0; from += AT_ONCE) {
		const int some = count - from < AT_ONCE ? count - from : AT_ONCE;

		code = look_opposite(&whole, views + from, some, err);
		for (int i = 0; i < some && code == 0; i++) {
			const int view = views[from + i];
			const struct mend_area area = mend_area_of(&steps[view], geometry->columns, geometry->rows);
			float *values = whole.values + (size_t)i * pixels;
			size_t known;

			code = take_sides(&whole, &steps[view], view, &area, values, whole.known + (size_t)i * pixels,
					  &known, err);
			if (code == 0)
				code = put_part(&whole, view, values, &area, err);
			opposite += known;
			all += (size_t)(area.end[0] - area.first[0]) * (size_t)(area.end[1] - area.first[1]);
		}
	}
	whole_clear(&whole);
	*ret_opposite = all > 0 ? (double)opposite / (double)all : 0;
	return code;
}

int mend_views(const struct mend_tools *tools, const int *views, int count, bool *ret_there, struct error *err)
{
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)tools->geometry->rows;
	struct whole whole;
	int code = whole_open(&whole, tools, err);

	if (code < 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		const struct partners sides = partners_at(&whole, tools->orbit->angle[views[i]], BESIDE);

		ret_there[i] = sides.view[0] >= 0;
		memset(whole.values, 0, pixels * sizeof(*whole.values));
		for (int side = 0; side < 2 && ret_there[i] && code == 0; side++) {
			const float own = (float)(side == 0 ? 1 - sides.share : sides.share);

			code = tools->backend->stack_download(tools->projections, sides.view[side], 1, whole.view, err);
			for (size_t at = 0; at < pixels && code == 0; at++)
				whole.values[at] += own * whole.view[at];
		}
		if (code == 0 && ret_there[i])
			code = tools->backend->stack_upload(tools->projections, views[i], 1, whole.values, err);
		if (code == 0)
			code = cancel_check(tools->cancel, err);
	}
	whole_clear(&whole);
	return code;
}

static bool has_from(const struct step *step)
{
	return step->kind == STEP_MISPLACED && step->from >= 0;
}

/* Moves projections along a chain that ends at a view, or around a cycle; marks those that are in place. */
static int move_chain(const struct mend_tools *tools, const struct step *steps, int view, float *values, float *held,
		      bool *done, struct error *err)
{
	const struct backend *backend = tools->backend;
	int code = backend->stack_download(tools->projections, view, 1, held, err), to = view;

	while (code == 0 && has_from(&steps[to]) && steps[to].from != view) {
		code = backend->stack_download(tools->projections, steps[to].from, 1, values, err);
		if (code == 0)
			code = backend->stack_upload(tools->projections, to, 1, values, err);
		done[to] = true;
		to = steps[to].from;
	}
	if (code == 0 && has_from(&steps[to])) {
		code = backend->stack_upload(tools->projections, to, 1, held, err);
		done[to] = true;
	}
	return code;
}

int mend_places(const struct mend_tools *tools, const struct step *steps, struct error *err)
{
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)tools->geometry->rows;
	const size_t views = (size_t)tools->orbit->count;
	float *values = malloc(2 * pixels * sizeof(*values));
	bool *done = calloc(views, sizeof(*done)), *taken = calloc(views, sizeof(*taken));
	int code = 0;

	if (values == NULL || done == NULL || taken == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the order of %zu views", views);
	for (size_t i = 0; i < views && code == 0; i++)
		if (has_from(&steps[i]))
			taken[steps[i].from] = true;
	/* Chains begin where nobody takes the projection from; what is left then are cycles. */
	for (int cycles = 0; cycles < 2; cycles++)
		for (size_t i = 0; i < views && code == 0; i++)
			if (has_from(&steps[i]) && !done[i] && (cycles > 0 || !taken[i]))
				code = move_chain(tools, steps, (int)i, values, values + pixels, done, err);
	free(values);
	free(done);
	free(taken);
	return code;
}

int mend_level(const struct mend_tools *tools, int view, float level, struct error *err)
{
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)tools->geometry->rows;
	float *values = malloc(pixels * sizeof(*values));
	int code;

	if (values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	code = tools->backend->stack_download(tools->projections, view, 1, values, err);
	for (size_t i = 0; i < pixels && code == 0; i++)
		values[i] -= level;
	if (code == 0)
		code = tools->backend->stack_upload(tools->projections, view, 1, values, err);
	free(values);
	return code;
}

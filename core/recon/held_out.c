/* Views that a volume is held against: held_out.h. */
#include "core/recon/held_out.h"

#include <math.h>
#include <stdlib.h>

struct held_out {
	size_t pixels;   /* of a view */
	int all, chosen; /* views of the scan, and those of them that have no part in the volume */
	int *order;      /* [all], owned: views in the order of the arc */
	bool *has;       /* [all], owned: the view was chosen */
	int count;       /* of the chosen ones, those that show something, */
	int beside;      /* and of views beside them that had a part */
	int *views;      /* [2 chosen], owned: the one, and behind them the other */
	float *copies;   /* [2 chosen][row][column], owned: their line integrals */
	float *room;     /* [HELD_OUT_SLOTS][row][column], owned */
};

/* One view of twenty, and at least one. */
static int count_of(int views)
{
	const int count = (int)lrint(HELD_OUT_SHARE * views);

	return count > 1 ? count : 1;
}

size_t held_out_bytes(const struct geometry *geometry)
{
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;

	return (2 * (size_t)count_of(geometry->count) + HELD_OUT_SLOTS) * pixels * sizeof(float);
}

/* ---- the choice ---- */

/* A view, and where it stands: radians of the arc, from its first view on. */
struct place {
	double along;
	int view;
};

static int by_place(const void *a, const void *b)
{
	const struct place *x = a, *y = b;

	return x->along != y->along ? (x->along > y->along) - (x->along < y->along) : x->view - y->view;
}

static int order_views(const struct orbit *orbit, int *ret_order, struct error *err)
{
	const double sense = orbit->direction < 0 ? -1 : 1, first = orbit->angle[orbit->first];
	struct place *places = malloc((size_t)orbit->count * sizeof(*places));

	if (places == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", orbit->count);
	for (int view = 0; view < orbit->count; view++)
		places[view] = (struct place){fmod(sense * (orbit->angle[view] - first) + 4 * M_PI, 2 * M_PI), view};
	qsort(places, (size_t)orbit->count, sizeof(*places), by_place);
	for (int i = 0; i < orbit->count; i++)
		ret_order[i] = places[i].view;
	free(places);
	return 0;
}

static int allocate(struct held_out *held_out, struct error *err)
{
	const size_t bytes = held_out->pixels * sizeof(float), chosen = (size_t)held_out->chosen;

	held_out->order = malloc((size_t)held_out->all * sizeof(*held_out->order));
	held_out->has = calloc((size_t)held_out->all, sizeof(*held_out->has));
	held_out->views = malloc(2 * chosen * sizeof(*held_out->views));
	held_out->copies = malloc(2 * chosen * bytes);
	held_out->room = malloc(HELD_OUT_SLOTS * bytes);
	if (held_out->order == NULL || held_out->has == NULL || held_out->views == NULL || held_out->copies == NULL ||
	    held_out->room == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views that are held out", held_out->chosen);
	return 0;
}

int held_out_new(const struct orbit *orbit, const struct geometry *geometry, struct held_out **ret_held_out,
		 struct error *err)
{
	struct held_out *held_out;
	int code;

	if (geometry->count < 3)
		return 0;
	held_out = calloc(1, sizeof(*held_out));
	if (held_out == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for views that are held out");
	held_out->pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	held_out->all = geometry->count;
	held_out->chosen = count_of(geometry->count);
	code = allocate(held_out, err);
	if (code == 0)
		code = order_views(orbit, held_out->order, err);
	if (code < 0) {
		held_out_free(held_out);
		return code;
	}
	/* The middles of equal parts of the arc: a short scan's first and last views count for little. */
	for (int i = 0; i < held_out->chosen; i++)
		held_out->has[held_out->order[(2L * i + 1) * held_out->all / (2L * held_out->chosen)]] = true;
	*ret_held_out = held_out;
	return 0;
}

void held_out_free(struct held_out *held_out)
{
	if (held_out == NULL)
		return;
	free(held_out->order);
	free(held_out->has);
	free(held_out->views);
	free(held_out->copies);
	free(held_out->room);
	free(held_out);
}

bool held_out_has(const struct held_out *held_out, int view)
{
	return held_out != NULL && held_out->has[view];
}

const int *held_out_views(const struct held_out *held_out, int *ret_count)
{
	*ret_count = held_out->count;
	return held_out->views;
}

/* ---- the residuals ---- */

static bool is_among(const int *views, int count, int view)
{
	for (int i = 0; i < count; i++)
		if (views[i] == view)
			return true;
	return false;
}

/* Chooses among views that show something; of those beside a chosen one the next in the order, or else the last. */
static void settle(struct held_out *held_out, const int *blank, int blanks)
{
	int *beside = held_out->views + held_out->chosen;

	held_out->count = held_out->beside = 0;
	for (int i = 0; i < held_out->all; i++) {
		const int view = held_out->order[i];

		if (is_among(blank, blanks, view))
			continue;
		if (held_out->has[view])
			held_out->views[held_out->count++] = view;
		else if (held_out->beside < held_out->count)
			beside[held_out->beside++] = view;
	}
	for (int i = 0; i < held_out->beside; i++)
		held_out->views[held_out->count + i] = beside[i];
}

int held_out_take(struct held_out *held_out, const struct backend *backend, struct stack *projections, const int *blank,
		  int blanks, struct error *err)
{
	int code = 0;

	settle(held_out, blank, blanks);
	for (int i = 0; i < held_out->count + held_out->beside && code == 0; i++)
		code = backend->stack_download(projections, held_out->views[i], 1,
					       held_out->copies + (size_t)i * held_out->pixels, err);
	return code;
}

/* || p - A v || / || p || over the views of these indices. */
static int residual_of(const struct held_out *held_out, const struct backend *backend, struct plan *plan,
		       const struct volume *volume, struct stack *work, int first, int end, double *ret_residual,
		       struct error *err)
{
	double off = 0, all = 0;
	int code = 0;

	for (int i = first; i < end && code == 0; i += HELD_OUT_SLOTS) {
		const int count = end - i < HELD_OUT_SLOTS ? end - i : HELD_OUT_SLOTS;
		const float *measured = held_out->copies + (size_t)i * held_out->pixels;

		code = backend->project(plan, volume, held_out->views + i, count, work, err);
		if (code == 0)
			code = backend->stack_download(work, 0, count, held_out->room, err);
		for (size_t k = 0; k < (size_t)count * held_out->pixels && code == 0; k++) {
			const double p = (double)measured[k], d = p - (double)held_out->room[k];

			off += d * d;
			all += p * p;
		}
	}
	if (code == 0)
		*ret_residual = all > 0 ? sqrt(off / all) : off > 0;
	return code;
}

int held_out_measure(const struct held_out *held_out, const struct backend *backend, struct plan *plan,
		     struct volume *volume, struct stack *work, struct volume_support *ret_support, struct error *err)
{
	const int count = held_out != NULL ? held_out->count : 0, all = count > 0 ? count + held_out->beside : 0;
	double held = NAN, used = NAN;
	int code = 0;

	if (count > 0)
		code = residual_of(held_out, backend, plan, volume, work, 0, count, &held, err);
	if (code == 0 && all > count)
		code = residual_of(held_out, backend, plan, volume, work, count, all, &used, err);
	if (code < 0)
		return code;
	ret_support->held_out = count;
	ret_support->held_residual = held;
	ret_support->used_residual = used;
	return 0;
}

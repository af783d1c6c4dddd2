/* What a refinement was found from, and what it says of each view: see refine.h. */
#include "core/refine/refine.h"

#include <math.h>
#include <string.h>

static const double PI = 3.14159265358979323846;

double refine_place(const struct orbit *orbit, int view)
{
	const double turn = (orbit->angle[view] - orbit->angle[orbit->first]) * (orbit->direction < 0 ? -1 : 1);

	return turn < -1e-9 ? turn + 2 * PI : fmax(0, turn);
}

void refine_change(enum refine_kind kind, const struct view *view, const double motion[PATH_NUMBERS],
		   double ret_change[PATH_NUMBERS])
{
	/* What moves with the arm and stood at the isocentre. */
	const struct view origin = {.source = {0}}, moved = view_of_moved(&origin, motion);
	double axes[3][3];

	if (kind == REFINE_MOTION) {
		memcpy(ret_change, motion, PATH_NUMBERS * sizeof(*ret_change));
	} else {
		view_axes(view, axes);
		for (int a = 0; a < 3; a++) {
			ret_change[a] = vec_dot(axes[a], moved.source);
			ret_change[3 + a] = -vec_dot(axes[a], motion + 3);
		}
	}
	for (int a = 3; a < PATH_NUMBERS; a++)
		ret_change[a] *= 180 / PI;
}

/* FNV-1a (Fowler, Noll and Vo), of 64 bits. */
static uint64_t hash(uint64_t before, const void *data, size_t size)
{
	const unsigned char *bytes = data;

	for (size_t i = 0; i < size; i++)
		before = (before ^ bytes[i]) * 1099511628211u;
	return before;
}

uint64_t refine_basis(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water)
{
	const struct geometry *geometry = &reduced->geometry;
	const size_t count = (size_t)geometry->count, bins = (size_t)geometry->columns * (size_t)geometry->rows;
	uint64_t basis = hash(14695981039346656037u, &kind, sizeof(kind));

	basis = hash(basis, &mu_water, sizeof(mu_water));
	basis = hash(basis, geometry->views, count * sizeof(*geometry->views));
	basis = hash(basis, reduced->views, count * sizeof(*reduced->views));
	basis = hash(basis, reduced->known, count * sizeof(*reduced->known));
	basis = hash(basis, reduced->projections, count * bins * sizeof(*reduced->projections));
	return hash(basis, orbit->angle, (size_t)orbit->count * sizeof(*orbit->angle));
}

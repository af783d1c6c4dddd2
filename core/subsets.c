/*
 * Ordered subsets of the views (Wang and Jiang, J. X-Ray Sci. Tech. 12, 2004): which
 * views make a subset, and in which order the subsets are taken.
 *
 * The order decides how fast it converges, since neighbouring views nearly
 * repeat each other. The views are sorted by angle and visited with a stride
 * close to the golden section of their number and coprime to it, so that each
 * falls into the widest gap that those before it left (Koehler, A projection
 * access scheme for iterative reconstruction based on the golden section, IEEE
 * NSS 2004), for any number of views, without a search.
 */
#include "core/subsets.h"

#include <math.h>
#include <stdlib.h>

static int greatest_common_divisor(int a, int b)
{
	while (b != 0) {
		int rest = a % b;

		a = b;
		b = rest;
	}
	return a;
}

/* The stride next to count / golden ratio that visits all of count places. */
static int golden_stride(int count)
{
	int wanted = (int)lround(count * 0.6180339887498949);

	for (int away = 0; away < count; away++) {
		if (wanted - away > 0 && greatest_common_divisor(count, wanted - away) == 1)
			return wanted - away;
		if (greatest_common_divisor(count, wanted + away) == 1)
			return wanted + away;
	}
	return 1;
}

struct place {
	double along; /* radians from the beginning of the arc, in its sense */
	int view;
};

static int place_compare(const void *left, const void *right)
{
	const struct place *a = left, *b = right;

	if (a->along != b->along)
		return a->along < b->along ? -1 : 1;
	return a->view - b->view;
}

/* Views by their place along the arc; the angle where a short scan begins must not fall into its middle. */
static void sort_views(const struct orbit *orbit, struct place *ret_places)
{
	const double turn = 6.283185307179586;
	int direction = orbit->direction < 0 ? -1 : 1;

	for (int i = 0; i < orbit->count; i++) {
		double along = fmod(direction * (orbit->angle[i] - orbit->angle[orbit->first]), turn);

		ret_places[i] = (struct place){.along = along < 0 ? along + turn : along, .view = i};
	}
	qsort(ret_places, (size_t)orbit->count, sizeof(*ret_places), place_compare);
}

int subsets_make(struct subsets *ret_subsets, const struct orbit *orbit, int count, struct error *err)
{
	int views = orbit->count, code = 0, filled = 0, stride = golden_stride(count);
	struct place *places = malloc(sizeof(*places) * (size_t)views);
	struct subsets subsets = {
	    .count = count,
	    .order = malloc(sizeof(int) * (size_t)views),
	    .start = malloc(sizeof(int) * ((size_t)count + 1)),
	};

	if (places == NULL || subsets.order == NULL || subsets.start == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d subsets of %d views", count, views);
		goto out;
	}
	sort_views(orbit, places);
	for (int s = 0; s < count; s++) {
		int first = (int)((long)s * stride % count);

		subsets.start[s] = filled;
		for (int i = first; i < views; i += count)
			subsets.order[filled++] = places[i].view;
	}
	subsets.start[count] = filled;
	*ret_subsets = subsets;
out:
	free(places);
	if (code < 0)
		subsets_clear(&subsets);
	return code;
}

void subsets_clear(struct subsets *subsets)
{
	free(subsets->order);
	free(subsets->start);
	*subsets = (struct subsets){0};
}

int subsets_count(int subsets, int views)
{
	const int usual = 10;

	if (subsets == SUBSETS_VIEWS)
		return views;
	if (subsets == SUBSETS_DEFAULT)
		return views < usual ? views : usual;
	return subsets;
}

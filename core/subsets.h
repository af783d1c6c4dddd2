#ifndef CBCT_CORE_SUBSETS_H
#define CBCT_CORE_SUBSETS_H

#include "core/error.h"
#include "core/scan/orbit.h"

#ifdef __cplusplus
extern "C" {
#endif

/* An order of all views, cut into subsets: subset s is order[start[s]] .. order[start[s+1] - 1]. */
struct subsets {
	int count;
	int *order; /* [views] */
	int *start; /* [count + 1] */
};

enum { SUBSETS_DEFAULT = 0, SUBSETS_VIEWS = -1 }; /* 10 or as many as there are views; an update after each view */

/* The number of subsets that SUBSETS_DEFAULT and SUBSETS_VIEWS stand for; any other number is itself. */
int subsets_count(int subsets, int views);
/*
 * `count` (1 .. views) ordered subsets, each of every count-th view along the
 * arc, so that each is spread over all of it; sizes differ by one at most. They
 * are ordered so that each is far in angle from those before it. The same orbit
 * gives the same order. Free with subsets_clear.
 */
int subsets_make(struct subsets *ret_subsets, const struct orbit *orbit, int count, struct error *err);
void subsets_clear(struct subsets *subsets);

/* Views of the largest one. */
static inline int subsets_largest(const struct subsets *subsets)
{
	int most = 0;

	for (int i = 0; i < subsets->count; i++)
		if (subsets->start[i + 1] - subsets->start[i] > most)
			most = subsets->start[i + 1] - subsets->start[i];
	return most;
}

#ifdef __cplusplus
}
#endif

#endif

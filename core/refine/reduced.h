#ifndef CBCT_CORE_REDUCED_H
#define CBCT_CORE_REDUCED_H

#include <stdbool.h>

#include "core/scan/orbit.h"

/*
 * A scan in bins of pixels and with some of its views, small enough that what is found out of it costs a small part of
 * the reconstruction. One thread at a time.
 */
struct reduced {
	struct geometry geometry; /* of the bins, its views in the order of the angle; owned */
	int *views;               /* [geometry.count], their numbers in the scan; owned */
	int *index;               /* [views of the scan], of a view among them, or -1; owned */
	float *projections;       /* [geometry.count][row][column], line integrals, 0 where not known; owned */
	bool *known;              /* [geometry.count], the view has come and is not left out; owned */
	int columns, rows, all;   /* of the scan: pixels, views */
	int pixels_of_a_bin[2];   /* along columns and rows */
};

/* At most `views` views spread evenly over the orbit, and at most `bins` bins along either side of the detector. */
int reduced_open(struct reduced *ret_reduced, const struct geometry *geometry, const struct orbit *orbit, int views,
		 int bins, struct error *err);
/* The same views in bins of two by two of these. */
int reduced_halve(const struct reduced *reduced, struct reduced *ret_half, struct error *err);
void reduced_clear(struct reduced *reduced);

/* Bytes of the host's memory that reduced_open takes. */
size_t reduced_bytes(const struct geometry *geometry, int views, int bins);

/* Returns the side of a bin at the isocentre, mm: the geometric mean of its two sides. */
double reduced_bin(const struct reduced *reduced, const struct orbit *orbit);
/* True if the view is one of those that are kept. */
bool reduced_wants(const struct reduced *reduced, int view);
/* Takes a view's line integrals, [row][column] of the scan; those that are not finite leave the view out. */
void reduced_take(struct reduced *reduced, int view, const float *projection);
/* Leaves out a view of the scan, whether it is one of those that are kept or not. */
void reduced_leave_out(struct reduced *reduced, int view);

#endif

#ifndef CBCT_CORE_ALTERNATION_H
#define CBCT_CORE_ALTERNATION_H

#include "core/backend.h"

/*
 * Alternation from slice to slice that no view sees.
 *
 * Where a detector's rows are as far apart as the slices and lie on the borders between them, a ray is the mean of two
 * slices. Errors of opposite signs in neighbouring slices then cancel in every ray, and nothing holds them back: a flat
 * end or an edge along z, which no such means can explain, excites them, and they spread inwards with every iteration,
 * to the object's own density (tests/bench/results/denoise.txt). FDK, which interpolates between the rows, has none.
 * Beams of some width see more of it, the farther from the middle of the cone: the rows of different views pass a
 * place at different heights.
 *
 * The visibility of alternation at a place is the mean square, over views and the rows that pass within a slice's
 * height, of 1 - 2 |s|, s being the row's distance from the slice's centre in slices: what linear interpolation between
 * alternating slices has there. Rows nearer to the centre count more, 1 - |s|. It is 1 where rows lie on slices, 1/3
 * where they lie anywhere, 0 where all lie on borders.
 *
 *   A = (-1, 2, -1) / 4 of V along z,  w = 1 for a visibility up to ALTERNATION_UNSEEN, 0 from ALTERNATION_SEEN on
 *       and the least of that in three slices in a row: what alternates takes as many
 *   a = the least of |A| in three slices in a row where A changes its sign twice, else 0: an edge has none
 *   V' = V - w A where w a exceeds 40 HU in the mean over the body of some slice; else V' = V, to the bit
 *
 * Only volumes that are kept have V'; the iterate goes on as it is. All of it is found from the geometry, before the
 * start. One thread at a time.
 */
#define ALTERNATION_UNSEEN 0.12
#define ALTERNATION_SEEN 0.25

struct alternation;

struct alternation_report {
	bool much;        /* the volume was changed */
	int slices;       /* that were */
	double amplitude; /* the most of a slice's mean of w a over the body, 1/mm */
};

/* Returns how visible alternation is at a place of the grid, in voxels; 1 where no view sees the place, or rows and
 * slices differ in height. */
double alternation_visibility(const struct geometry *geometry, const struct grid *grid, const double place[3]);

/* Bytes of the host's memory, at most. */
size_t alternation_bytes(const struct grid *grid);
/* *ret_alternation stays NULL where views see all alternation. mu_water in 1/mm. */
int alternation_new(const struct grid *grid, const struct geometry *geometry, double mu_water,
		    struct alternation **ret_alternation, struct error *err);
void alternation_free(struct alternation *alternation); /* NULL is fine */

/* V becomes V'. The caller keeps a copy of V. */
int alternation_show(struct alternation *alternation, const struct backend *backend, struct volume *volume,
		     struct alternation_report *ret_report, struct error *err);

#endif

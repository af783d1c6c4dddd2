#ifndef CBCT_CORE_CORRECT_SCATTER_H
#define CBCT_CORE_CORRECT_SCATTER_H

#include <stdbool.h>

#include "core/correct/scatter_body.h"
#include "core/detector.h"
#include "core/error.h"

/*
 * Scattered radiation in one view, estimated on a coarse grid of cells.
 *
 * With t the primary's transmission and p = -ln t, the cell m gets
 *
 *   S(m) = sum over kernels of exp(-c p(m)) sum over m' of A t(m') exp(-(a - c) p(m')) p(m')^b G(m - m')
 *
 * with A the amplitude, a the exponent, b the power, c the asymmetry and G a Gaussian of integral 1 over the plane of
 * the detector. t exp(-a p) p^b is the light that is scattered in the pencil of the beam at m' and comes out again;
 * where the object is thicker at m than at m', less of it comes out (asymmetric kernels: Sun and Star-Lack 2010, who
 * have a linear factor of the thickness, which may be negative). The sum over m' is one along rows and one along
 * columns. Outside of the detector there is no beam. The primary itself is what is sought: t <- T t / (t + S(t)) from
 * the total T, which is exact at once where S goes with t.
 *
 * With a body in place of kernels S(t) is what scatter_body.h says, and the cells are fewer.
 *
 * With a fraction in place of kernels S is the same all over the detector: that fraction of the primary in the darkest
 * twentieth of the cells.
 */
enum { SCATTER_CELLS = 64 }; /* along a row or a column, at most */

struct scatter;

/* The model is copied. Of the beam kernels want the pixels' pitches alone. */
int scatter_new(const struct scatter_model *model, int columns, int rows, const struct scatter_beam *beam,
		struct scatter **ret_scatter, struct error *err);
void scatter_free(struct scatter *scatter); /* NULL is fine */

/*
 * total: [row][column], what a pixel counts against what it counts in the flat image; NaN for one that says nothing.
 * air: what it counts in this view's air. Allocates nothing; the same bits for any number of threads.
 */
void scatter_estimate(struct scatter *scatter, const float *total, double air);
/* Writes the estimate for the pixels of a row, in the units of `total`. */
void scatter_row(const struct scatter *scatter, int row, float *ret_row);
/* The estimate's share of all that was counted. */
double scatter_share(const struct scatter *scatter);

/* For fits: the number of cells, an image's means over them, [cell row][cell column], and S of such a total. */
void scatter_cells(const struct scatter *scatter, int *ret_across, int *ret_along);
/* Means of the pixels that are numbers. A cell without any has what the nearest one in its row has, or NaN if `gaps`.
 */
void scatter_means(const struct scatter *scatter, const float *image, bool gaps, float *ret_cells);
/* The model may be another one than that of scatter_new, with as many kernels, or a body as that had. */
void scatter_of_total(struct scatter *scatter, const struct scatter_model *model, const float *total,
		      float *ret_scatter);

#endif

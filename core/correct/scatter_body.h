#ifndef CBCT_CORE_CORRECT_SCATTER_BODY_H
#define CBCT_CORE_CORRECT_SCATTER_BODY_H

#include <stdbool.h>

#include "core/detector.h"
#include "core/error.h"
#include "core/scan/geometry.h"

/*
 * Scattered radiation of a body of water about the isocentre that is as thick along each ray as the primary says.
 *
 * On the way of each ray through the body the light that has come so far is scattered once and leaves the body on a
 * straight way to the detector. Of that way half h is before its middle and half behind. The middle is the isocentre
 * where the body is thickest, H before and behind it, and beside that nearer to the source by (H^2 - h^2) over the
 * distance from the source to the isocentre, as it is in an ellipsoid:
 *
 *   S(m) = sum over rays m' sum along the ray of A (1 + b q(m')) exp(-in) mu ds w(angle) exp(-out) / light in air at m
 *
 * with A the amplitude, b `multiple`, q the mean of p = -ln t about m' (a Gaussian of 120 mm in the body, within the
 * bounds of the detector), in and out the line integrals up to the place and from it to m, and w = 3 (1 + cos^2) / 16
 * pi as free electrons scatter light (Thomson), against the solid angle. b makes up for light that is scattered more
 * than once: there is the more of it the larger the body. All else is geometry, which is why what was fitted on small
 * bodies holds for large ones. The loss of energy, a grid and what the detector counts of it are A's.
 */

/* Where the detector and the body are, seen from the source. */
struct scatter_beam {
	double pixel_mm[2]; /* pitches along a row and along a column */
	double detector_mm; /* source to detector, along its normal */
	double body_mm;     /* source to the middle of the body, along the same */
	double centre[2];   /* column and row at which the normal through the source meets the detector */
};

/* As it is in a view, whose columns and rows are exchanged if `turned`. */
struct scatter_beam scatter_beam_of(const struct view *view, bool turned);
/* ERR_IMPOSSIBLE where the isocentre does not lie between source and detector in all views. */
int scatter_body_check(const struct geometry *geometry, struct error *err);

enum { SCATTER_BODY_CELLS = 32 }; /* along a row or a column, at most */

struct scatter_field;

/* For so many columns and rows, in cells of which p is given. NULL: no memory. */
struct scatter_field *scatter_field_new(const struct scatter_beam *beam, const int pixels[2], const int cells[2]);
void scatter_field_free(struct scatter_field *field); /* NULL is fine */

/* p: [cell row][cell column]; ret the same, against air. The same bits for any number of threads. */
void scatter_field_of(struct scatter_field *field, const struct scatter_body *body, const float *p, float *ret);

#endif

#ifndef CBCT_CORE_OUTLIERS_H
#define CBCT_CORE_OUTLIERS_H

#include <stdbool.h>

#include "core/correct/content.h"

/*
 * Views that do not follow those beside them along the orbit: the tube gave another dose for some pulses, a part of
 * the detector was not read out, an image lies some pixels aside, or is the one before once more. An object, whatever
 * its shape, changes from view to view; such a view differs from the good ones on both sides, which are like each
 * other.
 *
 *   dark     More than 8 % of the samples say nothing, and on both sides less than a quarter of that. What metal hides
 *            grows and shrinks from view to view.
 *   level    All blocks of the detector, those of air and those of the object alike, differ from what lies between
 *            both sides by about the same line integral, which is at least .1 and four times what the sides differ by.
 *   shifted  The profile along rows or columns lies aside: moved by so many pixels it is what it should be, to a
 * sixteenth of the squared difference, and the difference is 16 times (squared) that of the sides. The path of a point
 * about the axis turns back at its ends, by 1 - cos of the angle to either side; a shift is more. Only of objects that
 * end within the detector.
 *
 *   frozen   The profile is that of the view before to the last bit, where most views differ from the one before by
 * more than rounding.
 *
 * Up to OUTLIERS_RUN such views may stand together, within 30 degrees from side to side, more than four within 25, and
 * a third of all at most can be left out.
 */
enum { OUTLIERS_RUN = 10, OUTLIERS_SAMPLES = CONTENT_BLOCKS * CONTENT_SAMPLES };

/* A view in means of about 4096 of its line integrals; NAN where half of those say nothing, or there are none. */
struct view_profile {
	float block[CONTENT_BLOCKS * CONTENT_BLOCKS]; /* [row of blocks][column of blocks] */
	float along[2][OUTLIERS_SAMPLES];             /* along the rows, [0], and the columns, [1] */
	float noise;                                  /* of a block's mean, and about that of the others */
	float unusable;                               /* share of the view's samples, without those of the map */
};

/* The sums of a profile; zero before the first sample. */
struct profile_sums {
	double sum[2][OUTLIERS_SAMPLES];
	int good[2][OUTLIERS_SAMPLES], all[2][OUTLIERS_SAMPLES], all_of_block[CONTENT_BLOCKS * CONTENT_BLOCKS];
};
/* A sample in this column and row of those that are looked at; p NAN for one that says nothing. */
void profile_add(struct profile_sums *sums, int column, int row, int block, float p);
struct view_profile profile_of(const struct profile_sums *sums, const struct content_sums *blocks, float noise,
			       double unusable);

enum outlier_kind {
	OUTLIER_NONE,
	OUTLIER_DARK,
	OUTLIER_LEVEL,
	OUTLIER_SHIFTED,
	OUTLIER_FROZEN,
	OUTLIER_MISPLACED,
	OUTLIER_KINDS
};
struct outlier {
	enum outlier_kind kind;
	/* Share of the samples that say nothing; line integral; share of the detector's width or height, signed; 1; 1.
	 */
	float amount;
};

/*
 * Fills ret_outliers [count of the orbit]; `skip` marks views to pass over. Returns how many there are, 0 where they
 * are too many to be left out; ERR_NO_MEMORY.
 */
int outliers_find(const struct view_profile *views, const bool *skip, const struct orbit *orbit,
		  struct outlier *ret_outliers, struct error *err);

/*
 * True if a view differs from an earlier good one in a way that outliers_find may tell once all views are there. gap:
 * how many views later it is; earlier: the good one before that, or NULL.
 */
bool outliers_suspect(const struct view_profile *view, const struct view_profile *good, int gap,
		      const struct view_profile *earlier);

#endif

#ifndef CBCT_CORE_CONTENT_H
#define CBCT_CORE_CONTENT_H

#include <stdbool.h>

#include "core/scan/orbit.h"

/*
 * What a view shows, in numbers. About 4096 of its line integrals are sorted into CONTENT_BLOCKS x CONTENT_BLOCKS
 * blocks of the detector, and the spread of the blocks' means is held against what the noise within the blocks makes of
 * it. A view with a closed shutter, without the patient, or with one value everywhere has no more spread than that.
 */
enum { CONTENT_BLOCKS = 8, CONTENT_SAMPLES = 8 }; /* along each axis: blocks, and pixels of a block that are sampled */
enum { CONTENT_SCALES = 8 };                      /* at which a small object is looked for, most */

struct view_content {
	float mean;      /* of the blocks' means; a line integral, as the following */
	float structure; /* standard deviation of the blocks' means, without the part that noise has in it */
	float noise;     /* that part */
	float pixel;     /* noise of a single pixel */
	float peak;      /* the largest sample less the mean */
	/* Centres of mass along the rows, -1 (first column) to 1 (last column), of all and of what exceeds the least
	 * block. */
	float centre, structure_centre;
	bool plain; /* the spread is that of noise alone */
	/*
	 * Of content_search, where it was called: the brightest pixel of the whole view, [0], the brightest mean of
	 * 2 x 2 pixels, [1], and of 2 x 2 means of 2 x 2 pixels, of 4 x 4 and so on; its row times the columns of that
	 * scale plus its column, or below 0 where none is brightest.
	 */
	int brightest[CONTENT_SCALES];
};

/* The sums of one view; zero before the first sample. */
struct content_sums {
	double sum[CONTENT_BLOCKS * CONTENT_BLOCKS], square[CONTENT_BLOCKS * CONTENT_BLOCKS];
	int count[CONTENT_BLOCKS * CONTENT_BLOCKS];
	float largest; /* sample, where there is any */
	bool any;
};
/* block: row of blocks times CONTENT_BLOCKS, plus column of blocks. */
void content_add(struct content_sums *sums, int block, float p);
struct view_content content_of(const struct content_sums *sums);

/*
 * Marks the views that show nothing where their neighbours along the orbit show an object. The attenuation, or the
 * structure alone where a view has one value other than air's, is with its noise below 15 % of what a quarter of all
 * views exceeds, so that a scan that is mostly noise has none; the mean lies outside of those of the views beside the
 * gap; and the object vanishes between one view and the next. It does so where the view beside the gap has at least
 * half of that strength, about where most views have it, and the gap is short: an object that leaves the detector as
 * the arm turns, or a plate that is seen face on, fades from view to view. `skip` marks views to pass over. Marks none
 * where they would be more than half of the views, not counting those that have one value to the bit. Returns how many;
 * ERR_NO_MEMORY.
 */
int content_find_empty(const struct view_content *views, const bool *skip, const struct orbit *orbit, bool *ret_empty,
		       struct error *err);

/* True if a view shows structure, or a sampled pixel that stands out of the noise. */
bool content_shows(const struct view_content *view);
/* Looks at every line integral of a view, NAN for a defect; `image`, [row][column], is worked in. */
void content_search(float *image, int columns, int rows, int ret_brightest[CONTENT_SCALES]);
/*
 * *ret_even: no view that is not to be skipped shows anything, and neither do all of them together: a small or faint
 * object is often the brightest place of a view, and lies near to itself in the next view along the orbit, whereas
 * noise has its brightest place anywhere. All of those views must have been searched where content_shows of none is
 * true; columns, rows: of the detector. ERR_NO_MEMORY.
 */
int content_is_even(const struct view_content *views, const bool *skip, const struct orbit *orbit, int columns,
		    int rows, bool *ret_even, struct error *err);

#endif

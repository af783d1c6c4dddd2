#ifndef CBCT_CORE_STEPS_H
#define CBCT_CORE_STEPS_H

#include "core/correct/outliers.h"

/*
 * Runs of views of any length that lie aside (order.h), or in which all of the detector, or a band of it from edge to
 * edge with straight borders, gives another signal than before and behind: the tube gave another dose, or a part of the
 * detector was dark or was read out with another gain. Such a run begins and ends from one view to the next, at most 10
 * degrees apart, and what an object does between two views is little beside that.
 *
 * Bands with another signal, and views of another dose, step by one line integral (bands.h); dark bands of a quarter to
 * three quarters of the columns or rows have no good sample any more, in all blocks at once, where those beside them
 * have. What metal hides has no such border. The run of a band turns by 120 degrees at most, or by 60 where metal may
 * hide it; views of another dose are half of all at most.
 */
enum step_kind { STEP_NONE, STEP_LEVEL, STEP_PART, STEP_ASIDE, STEP_MISPLACED };

struct step {
	enum step_kind kind;
	double first[2], end[2]; /* of the part, 0 to 1 of the detector's width and height */
	double border;           /* as much beside it may be the part's, too */
	int sides[2];            /* the good views before and behind the run */
	float level;             /* line integral; INFINITY: the part has no good sample */
	int from;                /* of STEP_MISPLACED: the view whose samples belong here; -1: none */
};

struct view_strips; /* core/correct/narrow.h */

/* True if a part, or all of the view, can be had from other projections, where those are kept. */
bool steps_can_mend(const struct step *step);

/*
 * Fills ret_steps [count of the orbit]; `skip` marks views to pass over. strips: [views], of a detector of so many
 * pixels, columns and rows; NULL: no narrow bands are looked for. Returns how many views are in runs, 0 where
 * they are more than half of all; ERR_NO_MEMORY.
 */
int steps_find(const struct view_profile *views, const struct view_strips *strips, const int pixels[2],
	       const bool *skip, const struct orbit *orbit, struct step *ret_steps, struct error *err);

/*
 * The level of a STEP_LEVEL by the blocks that are air in the good views on both sides. False where fewer than four
 * are, or what they say is not the step.
 */
bool steps_air(const struct view_profile *views, const struct step *step, int view, float *ret_level);

#endif

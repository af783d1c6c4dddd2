#ifndef CBCT_CORE_STEPS_H
#define CBCT_CORE_STEPS_H

#include "core/correct/outliers.h"

/*
 * Runs of views of any length in which all of the detector, or a part of it that reaches from one edge to the next,
 * gives another signal than before and behind: the tube gave another dose, or a part of the detector was dark or was
 * read out with another gain. Such a run begins and ends from one view to the next, and what an object does between two
 * views is little beside that: all blocks of the part step by the same line integral, or have no good sample any more,
 * the other ones do not, and behind the run all step back by as much. Views at most 10 degrees apart are held against
 * each other, and the part is calm otherwise: before the run, in it and behind it, its blocks change by a quarter
 * of the step at most. A body that comes into the picture or leaves it changes the blocks by
 * different values, one after the other, and what metal hides has no straight border from edge to edge.
 *
 * The part is a band of a quarter to three quarters of the columns or rows at an edge of the detector, with a straight
 * border, and its run turns by 120 degrees at most, or 60 where it goes dark; all of the detector may step for half of
 * the views.
 */
enum step_kind { STEP_NONE, STEP_LEVEL, STEP_PART };

struct step {
	enum step_kind kind;
	int first[2], end[2]; /* blocks of the part, along rows and columns: first .. end - 1 */
	int sides[2];         /* the good views before and behind the run */
	float level;          /* line integral; INFINITY: the part has no good sample */
};

/*
 * Fills ret_steps [count of the orbit]; `skip` marks views to pass over. Returns how many views are in runs, 0 where
 * they are more than half of all; ERR_NO_MEMORY.
 */
int steps_find(const struct view_profile *views, const bool *skip, const struct orbit *orbit, struct step *ret_steps,
	       struct error *err);

/*
 * The level of a STEP_LEVEL by the blocks that are air in the good views on both sides. False where fewer than four
 * are, or what they say is not the step.
 */
bool steps_air(const struct view_profile *views, const struct step *step, int view, float *ret_level);

#endif

/*
 * The check of the geometry as a row of corrections[]: it corrects nothing, and holds the views against each other
 * once all have come (core/refine/agreement.h). It works in the host's memory and on its processor, whatever the device
 * is: the scan is small by then.
 */
#include <math.h>
#include <stdlib.h>

#include "core/correct/correction.h"
#include "core/correct/input.h"
#include "core/refine/agreement.h"

/* Less than this is nothing that is worth a number. */
static const double UNSEEN_MM = 0.005;

struct state {
	struct reduced reduced;
	float *view; /* [row][column] of the scan, on its way into bins */
};

static void close_row(void *opaque)
{
	struct state *state = opaque;

	if (state == NULL)
		return;
	reduced_clear(&state->reduced);
	free(state->view);
	free(state);
}

/* Without a state there is nothing to check. */
static int open_row(const struct correction_job *job, void **ret_state, struct error *err)
{
	const size_t pixels = (size_t)job->geometry->columns * (size_t)job->geometry->rows;
	struct state *state;
	int code;

	if (!agreement_is_possible(job->geometry, job->orbit))
		return 0;
	state = calloc(1, sizeof(*state));
	if (state == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the check of the geometry");
	code = reduced_open(&state->reduced, job->geometry, job->orbit, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST, err);
	state->view = malloc(pixels * sizeof(*state->view));
	if (code == 0 && state->view == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a view");
	if (code < 0)
		close_row(state);
	else
		*ret_state = state;
	return code;
}

static int bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	struct reduced reduced;
	size_t working = 0;
	int code;

	if (!agreement_is_possible(ask->geometry, ask->orbit))
		return 0;
	code = reduced_open(&reduced, ask->geometry, ask->orbit, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST, err);
	if (code < 0)
		return code;
	code = agreement_bytes(&reduced, &working, err);
	bytes->aside += working + reduced_bytes(ask->geometry, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST) +
			(size_t)ask->geometry->columns * (size_t)ask->geometry->rows * sizeof(float);
	reduced_clear(&reduced);
	return code;
}

static int take_view(const struct correction_job *job, void *opaque, const struct correction_view *view,
		     struct error *err)
{
	struct state *state = opaque;
	int code;

	if (state == NULL || !reduced_wants(&state->reduced, view->view))
		return 0;
	code = job->backend->stack_download(view->to, view->slot, 1, state->view, err);
	if (code == 0)
		reduced_take(&state->reduced, view->view, state->view);
	return code;
}

/* Views that opposite ones contradict, whatever the object is. */
static bool tell_opposite(const struct correction_job *job, const struct agreement *agreement, double bin)
{
	const struct opposite_rays *rays = &agreement->rays;
	const double given = sqrt(rays->square[OPPOSITE_GIVEN]);

	if (opposite_rays_other_way(rays))
		warning_tell(
		    job->warnings, "other_direction",
		    "line integrals of the %d rays that two views share differ by %.2g (root mean square) as the "
		    "geometry "
		    "says, and by %.2g if the arm turned the other way or the columns of the projections are mirrored",
		    rays->pairs[OPPOSITE_GIVEN], given,
		    sqrt(fmin(rays->square[OPPOSITE_OTHER_WAY], rays->square[OPPOSITE_MIRRORED])));
	else if (opposite_rays_displaced(rays))
		warning_tell(job->warnings, "geometry_wrong",
			     "line integrals of the %d rays that two views share differ by %.2g (root mean square) as "
			     "the geometry says, and by %.2g if the detector is displaced to the other side",
			     rays->pairs[OPPOSITE_GIVEN], given, sqrt(rays->square[OPPOSITE_OTHER_SIDE]));
	else if (agreement_is_aside(agreement, bin))
		warning_tell(job->warnings, "geometry_wrong",
			     "line integrals of the %d rays that two views share differ by %.2g (root mean square) as "
			     "the geometry says, and by %.2g if all detectors stand aside by %.3g mm at the isocentre, "
			     "along %ss",
			     rays->pairs[OPPOSITE_GIVEN], given, sqrt(rays->least), rays->aside * bin,
			     job->input->turned ? "column" : "row");
	else
		return false;
	return true;
}

static void tell(const struct correction_job *job, const struct agreement *agreement, double bin)
{
	const enum agreement_grade grade = agreement_grade(agreement, bin);

	if (grade == AGREEMENT_GOOD || tell_opposite(job, agreement, bin))
		return;
	if (agreement->mm < UNSEEN_MM) {
		warning_tell(job->warnings, "geometry_wrong",
			     "%.0f %% of a view's detail is not where the others show it (median of %d views), and no "
			     "shift of the views explains that: what some views show may be wrong, or the geometry be "
			     "off by much",
			     100 * agreement->unexplained, agreement->measured);
		return;
	}
	warning_tell(job->warnings, grade == AGREEMENT_WRONG ? "geometry_wrong" : "geometry_doubtful",
		     "views lie aside of what the others show by %.2g mm at the isocentre (root mean square over %d "
		     "views; %.2g mm "
		     "is what noise and the object's own detail make uncertain); view %d is farthest off, by %.2g mm; "
		     "%.0f %% of a "
		     "view's detail is not where the others show it (more than a few percent: the geometry may be off "
		     "by more than "
		     "these mm)",
		     agreement->mm, agreement->measured, agreement->sigma_mm, agreement->worst, agreement->worst_mm,
		     100 * agreement->unexplained);
}

/*
 * An order of the views that is not the true one breaks all up. What is known is how often it comes and goes while it
 * does: a ventilator that stops half way has the same frequency.
 */
static void tell_breathing(const struct correction_job *job, const struct agreement *agreement, double bin)
{
	const struct breathing *breathing = &agreement->breathing;
	const struct hill *hill = &breathing->all;

	if (!breathing_is_told(breathing) || opposite_rays_other_way(&agreement->rays) ||
	    opposite_rays_displaced(&agreement->rays) || agreement_is_aside(agreement, bin))
		return;
	if (breathing->uneven.share > hill->share)
		hill = &breathing->uneven;
	warning_tell(
	    job->warnings, "breathing",
	    "what a row of the detector shows comes and goes, all along the sweep or for a part of it, as often as "
	    "about %.0f times in a whole one, by %.2g %% (root mean square over all of it), %.2g times what is "
	    "slower and %.2g times the noise there: no object at rest does that, unless the arm shakes as often "
	    "along its axis",
	    hill->times_in_sweep, 100 * hill->share, hill->times, hill->share / hill->noise);
}

/* Where air is seen the level there says it (input_rows.c). */
static void tell_drift(const struct correction_job *job, const struct opposite_rays *rays)
{
	if (job->input->off > 0 || !opposite_rays_drift(rays))
		return;
	warning_tell(
	    job->warnings, "air_level",
	    "line integrals of the %d rays that two views share differ by %.2g (root mean square), and by %.2g "
	    "if the tube's output %s by %.0f %% from the first projection to the last. Nothing of that is taken "
	    "out; an air_region makes up for it where air is seen",
	    rays->pairs[OPPOSITE_GIVEN], sqrt(rays->square[OPPOSITE_GIVEN]),
	    sqrt(rays->square[OPPOSITE_GIVEN] * rays->drift_share / rays->share[OPPOSITE_GIVEN]),
	    rays->drift > 0 ? "falls" : "rises", 100 * fabs(exp(-rays->drift) - 1));
}

static int warn(const struct correction_job *job, void *opaque, struct error *err)
{
	struct state *state = opaque;
	struct agreement agreement;
	int code;

	if (state == NULL)
		return 0;
	for (int i = 0; i < job->input->counts.blank; i++)
		reduced_leave_out(&state->reduced, job->input->blank[i]);
	for (int i = 0; i < job->input->mended_count; i++)
		if (steps_can_mend(&job->input->steps[job->input->mended[i]]))
			reduced_leave_out(&state->reduced, job->input->mended[i]);
	code = agreement_measure(&state->reduced, job->cancel, &agreement, err);
	if (code < 0)
		return code;
	tell(job, &agreement, reduced_bin(&state->reduced, job->orbit));
	tell_drift(job, &agreement.rays);
	tell_breathing(job, &agreement, reduced_bin(&state->reduced, job->orbit));
	if (agreement_is_known(&agreement)) {
		job->agreement->mm = agreement.mm;
		job->agreement->sigma_mm = agreement.sigma_mm;
		job->agreement->unexplained = agreement.unexplained;
		job->agreement->views = agreement.measured;
	}
	agreement_clear(&agreement);
	return 0;
}

extern const struct correction correction_agreement;
const struct correction correction_agreement = {
    .name = "agreement",
    .summary = "projections are held against each other, and a geometry that does not fit them is told",
    .times = 1U << CORRECT_LINE_INTEGRALS,
    .needs = NEEDS_WHOLE_IMAGES,
    .bytes = bytes,
    .open = open_row,
    .close = close_row,
    .view = take_view,
    .warn = warn,
    .warns_late = true,
};

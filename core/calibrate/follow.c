/*
 * Poses that are none of this sweep's. Many phantoms look the same, ball for ball, from another side or upside down, so
 * that a pose of no residual may be on the wrong side of the phantom; and where a view does not show all of a phantom's
 * circles, those that it shows may be taken for the next ones. The nominal geometry tells some of these, and the run of
 * the views the others, which differ by a ball's or a circle's step: an arm sags smoothly, and does not leap.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/calibrate/internal.h"

static const double NOMINAL_MOST = 45 * M_PI / 180; /* between anything of a view and its nominal place */
static const double DISTANCE_MOST = 2;              /* times the nominal, or the other way about */
static const double LEAP_MOST = 5 * M_PI / 180;     /* of a source, against the view before */
/* Of a detector: balls near to a plane tell little of its turns, and less where one is not where it is drawn. */
static const double TWIST_MOST = 45 * M_PI / 180;

/* A view's pose as the arm has it: turned back by its nominal source's angle about the arm's axis. */
struct stance {
	struct pose pose;
	int view, run; /* run: which the view goes on with */
};

/* Views that follow each other, whatever is between them. */
struct follow {
	const struct stance *last;
	int count;
};

static double angle_between(const double a[3], const double b[3])
{
	double across[3];

	vec_cross(a, b, across);
	return atan2(vec_norm(across), vec_dot(a, b));
}

/* By which angle a turn has one's axes stand as the other's. */
static double twist_between(const struct pose *a, const struct pose *b)
{
	double trace = 0;

	for (int i = 0; i < 3; i++)
		trace += vec_dot(a->axes[i], b->axes[i]);
	return acos(fmax(-1, fmin(1, .5 * (trace - 1))));
}

static bool beyond(double ratio)
{
	return !(ratio <= DISTANCE_MOST && ratio >= 1 / DISTANCE_MOST);
}

/* Writes what stands in no place that a view of this nominal one could have; "" for a view that could be. */
static void hold_nominal(const struct pose *found, const struct pose *nominal, char *why, size_t size)
{
	const double degree = M_PI / 180, side = angle_between(found->source, nominal->source);
	const double twist = twist_between(found, nominal);
	const double aside =
	    atan(hypot(found->detector[0] - nominal->detector[0], found->detector[1] - nominal->detector[1]) /
		 nominal->detector[2]);
	const double source = vec_norm(found->source) / vec_norm(nominal->source);
	const double detector = found->detector[2] / nominal->detector[2];

	why[0] = '\0';
	if (side > NOMINAL_MOST)
		snprintf(why, size, "its source would stand %.0f degrees from the nominal place, expected at most %.0f",
			 side / degree, NOMINAL_MOST / degree);
	else if (twist > NOMINAL_MOST)
		snprintf(why, size, "its detector would be turned by %.0f degrees, expected at most %.0f",
			 twist / degree, NOMINAL_MOST / degree);
	else if (aside > NOMINAL_MOST)
		snprintf(why, size,
			 "its detector would stand %.0f degrees aside of the nominal place, expected at most %.0f",
			 aside / degree, NOMINAL_MOST / degree);
	else if (beyond(source) || beyond(detector))
		snprintf(why, size,
			 "its source would stand %.2f times as far from the isocentre, and %.2f times from the "
			 "detector, as the nominal one",
			 source, detector);
}

/* Puts a view to the run that it goes on with, or begins one: of those so far, the one that has most views. */
static void go_on(struct stance *stance, struct follow *runs, int *count)
{
	int own = *count;

	for (int r = 0; r < *count; r++) {
		const struct pose *last = &runs[r].last->pose;

		if (angle_between(last->source, stance->pose.source) <= LEAP_MOST &&
		    twist_between(last, &stance->pose) <= TWIST_MOST &&
		    (own == *count || runs[r].count > runs[own].count))
			own = r;
	}
	if (own == *count)
		runs[(*count)++] = (struct follow){0};
	runs[own].last = stance;
	runs[own].count++;
	stance->run = own;
}

/* Refuses the views beside the longest run. The stances are in the order of the sweep. */
static void hold_run(struct calibration *calibration, struct stance *stances, int count, struct follow *runs)
{
	int run_count = 0, longest = 0;

	for (int i = 0; i < count; i++)
		go_on(&stances[i], runs, &run_count);
	for (int r = 1; r < run_count; r++)
		longest = runs[r].count > runs[longest].count ? r : longest;
	for (int i = 0; i < count; i++) {
		struct calibrated_view *view = &calibration->views[stances[i].view];

		if (stances[i].run == longest)
			continue;
		view->used = false;
		snprintf(view->refused, sizeof(view->refused),
			 "its source and detector do not follow those of the %d views that follow each other, of %d: "
			 "expected within %.0f and %.0f degrees of the view before",
			 runs[longest].count, count, LEAP_MOST * 180 / M_PI, TWIST_MOST * 180 / M_PI);
	}
}

int follow_refuse(struct calibration *calibration, const struct calibrate_request *request, double turn,
		  struct error *err)
{
	struct station *stations = stations_of(request->nominal);
	struct stance *stances = malloc((size_t)calibration->count * sizeof(*stances));
	struct follow *runs = malloc((size_t)calibration->count * sizeof(*runs));
	int count = 0, code = 0, first;
	struct axis axis;

	if (stations == NULL || stances == NULL || runs == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);
	if (code == 0)
		code = axis_of(calibration, request->nominal, &axis, err);
	first = code == 0 ? first_station(stations, calibration->count) : 0;
	for (int n = 0; n < calibration->count && code == 0; n++) {
		const int i = (first + n) % calibration->count, k = stations[i].view;
		struct calibrated_view *view = &calibration->views[k];
		struct pose nominal;

		if (!view->used)
			continue;
		stances[count] = (struct stance){.view = k};
		pose_of_view(&stances[count].pose, &view->view);
		pose_of_view(&nominal, &request->nominal->views[k]);
		pose_turn(&nominal, -turn); /* the phantom turned one way is the arm turned the other */
		hold_nominal(&stances[count].pose, &nominal, view->refused, sizeof(view->refused));
		view->used = view->refused[0] == '\0';
		pose_turn_about(&stances[count].pose, &axis, -stations[i].angle);
		count += view->used;
	}
	if (code == 0 && count > 0)
		hold_run(calibration, stances, count, runs);
	free(stations);
	free(stances);
	free(runs);
	return code;
}

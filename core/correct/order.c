/* Views that lie aside: see order.h. */
#include "core/correct/order.h"

#include <math.h>
#include <stdlib.h>

#include "core/error.h"
#include "core/select.h"

enum { SAMPLES = OUTLIERS_SAMPLES, AROUND = 8, TREND = 3, QUARTERS = 4 };

static const double APART = 16, EXPLAINED = 1.0 / 16, FAINT = 0.03; /* of squares; of a profile's root mean square */
static const double SHIFT = 1.25, ALIKE = 0.75;                     /* samples */
static const float AIR = 0.1f;                                      /* of a profile's largest value */
enum { MOST = 3 };                                                  /* one view in so many */

/* What lies between a view and the next. */
struct pair {
	double change; /* mean square of the profile's change beyond what the pairs around it change by */
	float shift;   /* samples that explain it; 0: none does */
	bool jumps;
};

static bool has_pair(const struct ring *ring, int place)
{
	return ring_is_near(ring, place);
}

static int samples_of(const float *profile)
{
	int samples = SAMPLES;

	while (samples > 0 && isnan(profile[samples - 1]))
		samples--;
	return samples;
}

/* The profile of the view behind a place as those around the pair let it be expected. */
static void expect(const struct ring *ring, int place, int axis, float ret[SAMPLES])
{
	const float *from = ring_view(ring, place)->along[axis];

	for (int i = 0; i < SAMPLES; i++) {
		float values[2 * TREND];
		int count = 0;

		for (int k = -TREND; k <= TREND; k++) {
			float own;

			if (k == 0 || !has_pair(ring, place + k))
				continue;
			own =
			    ring_view(ring, place + k + 1)->along[axis][i] - ring_view(ring, place + k)->along[axis][i];
			if (!isnan(own))
				values[count++] = own;
		}
		ret[i] = from[i] + select_median(values, count);
	}
}

static double power_of(const float *profile, int samples)
{
	const float none[SAMPLES] = {0};

	return profile_apart(profile, none, samples, 0, (samples + 1) / 2);
}

static bool ends_in_air(const float *profile, int samples)
{
	float most = 0;

	for (int i = 0; i < samples; i++)
		most = fmaxf(most, profile[i]); /* NAN is never the larger */
	return samples > 0 && profile[0] <= AIR * most && profile[samples - 1] <= AIR * most;
}

static void look_at_pair(const struct ring *ring, int place, int axis, struct pair *ret)
{
	const float *to;
	float expected[SAMPLES];
	int samples;

	*ret = (struct pair){.change = NAN};
	if (!has_pair(ring, place))
		return;
	to = ring_view(ring, place + 1)->along[axis];
	samples = samples_of(to);
	expect(ring, place, axis, expected);
	ret->change = profile_apart(to, expected, samples, 0, (samples + 1) / 2);
}

/* The usual change of the pairs around a place. */
static double usual_change(const struct ring *ring, const struct pair *pairs, int place)
{
	float values[2 * AROUND];
	int count = 0;

	for (int k = -AROUND; k <= AROUND; k++) {
		const int at = (place + k + ring->count) % ring->count;

		if (k != 0 && has_pair(ring, place + k) && isfinite(pairs[at].change))
			values[count++] = (float)pairs[at].change;
	}
	return count > 0 ? (double)select_median(values, count) : INFINITY;
}

static void find_shift(const struct ring *ring, int place, int axis, struct pair *pairs)
{
	struct pair *pair = &pairs[place];
	const struct view_profile *from = ring_view(ring, place), *to = ring_view(ring, place + 1);
	const int samples = isnan(pair->change) ? 0 : samples_of(to->along[axis]);
	float expected[SAMPLES];
	double best = INFINITY;

	if (samples == 0 || !isfinite(pair->change) ||
	    pair->change < APART * (usual_change(ring, pairs, place) + 2 * pow((double)to->noise, 2)) ||
	    pair->change < FAINT * FAINT * power_of(to->along[axis], samples))
		return;
	pair->jumps = true;
	if (!ends_in_air(from->along[axis], samples) || !ends_in_air(to->along[axis], samples))
		return;
	expect(ring, place, axis, expected);
	for (int s = -QUARTERS * samples / 4; s <= QUARTERS * samples / 4; s++) {
		const double left =
		    profile_apart(to->along[axis], expected, samples, s / (double)QUARTERS, (samples + 1) / 2);

		if (left < best) {
			best = left;
			pair->shift = (float)s / QUARTERS;
		}
	}
	if (best > EXPLAINED * pair->change || fabsf(pair->shift) < (float)SHIFT)
		pair->shift = 0;
}

struct marking {
	const struct ring *ring;
	float share; /* of the width or height */
	struct step *ret_steps;
};

static int mark(void *context, int before, int last)
{
	const struct marking *marking = context;
	const struct ring *ring = marking->ring;
	const int run = (last - before + ring->count) % ring->count;

	if (MOST * run > ring->count)
		return 0;
	for (int k = 0; k <= run + 1; k++)
		if (k > 0 && k <= run && marking->ret_steps[ring_place(ring, before + k)->view].kind != STEP_NONE)
			return 0;
	for (int k = 1; k <= run; k++)
		marking->ret_steps[ring_place(ring, (before + k) % ring->count)->view] =
		    (struct step){.kind = STEP_ASIDE, .level = marking->share};
	return run;
}

/* Marks the views whose shift, of one size, added up from pair to pair is not that of most. steps: [count], work. */
static int mark_shifted(const struct ring *ring, const struct pair *pairs, int first, int axis, float *steps,
			struct step *ret_steps)
{
	const float shift = pairs[first].shift;
	const int samples = samples_of(ring_view(ring, first)->along[axis]);

	for (int place = 0; place < ring->count; place++) {
		const struct pair *pair = &pairs[place];

		steps[place] = pair->jumps ? NAN : 0;
		if (pair->shift != 0 && fabs(fabs((double)pair->shift) - fabs((double)shift)) <= ALIKE)
			steps[place] = pair->shift;
	}
	return ring_runs(ring, steps, mark, &(struct marking){ring, fabsf(shift) / (float)samples, ret_steps});
}

int order_find_shifts(const struct ring *ring, struct step *ret_steps, struct error *err)
{
	struct pair *pairs = malloc((size_t)ring->count * sizeof(*pairs));
	float *steps = malloc((size_t)ring->count * sizeof(*steps));
	int found = 0, code = 0;

	if (pairs == NULL || steps == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the steps of %d views", ring->count);
	for (int axis = 0; axis < 2 && code == 0; axis++) {
		for (int place = 0; place < ring->count; place++)
			look_at_pair(ring, place, axis, &pairs[place]);
		for (int place = 0; place < ring->count; place++)
			find_shift(ring, place, axis, pairs);
		for (int place = 0; place < ring->count; place++)
			if (pairs[place].shift != 0)
				found += mark_shifted(ring, pairs, place, axis, steps, ret_steps);
	}
	free(pairs);
	free(steps);
	return code < 0 ? code : found;
}

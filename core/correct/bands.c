/* Bands of the detector with another signal: see bands.h. */
#include "core/correct/bands.h"

#include <math.h>
#include <stdlib.h>

#include "core/error.h"
#include "core/select.h"

enum { SIDE = CONTENT_BLOCKS, BLOCKS = SIDE * SIDE, SAMPLES = OUTLIERS_SAMPLES };
enum { AROUND = 3 };                        /* pairs of views on either side that tell what the object does */
enum { NARROW = 16, WIDE_MOST = 6 };        /* a band has one sample in so many at least, and so many blocks at most */
enum { BETWEEN = 2 };                       /* samples at a border */
enum { BANDS_MOST = 16 };                   /* that are looked for */
enum { WHOLE_LEAST = 6, WHOLE_KNOWN = 16 }; /* blocks of a band, and of the detector, that are known */
enum { MOST = 2 };                          /* one view in so many of another dose */

static const double PI = 3.14159265358979323846;
static const double WIDE = 120;                       /* degrees from one side of a run to the other, at most */
static const float LEAST = 0.2f, LEAST_WHOLE = 0.15f; /* line integrals */
static const float INSIDE = 0.3f, BESIDE = 0.3f;      /* of the step: samples of the profile, at most, */
static const float STRAYS = 0.05f;                    /* but for this share of them, */
static const float STRAY = 0.6f;                      /* which are within this */
static const float AGREE = 0.25f, QUIET = 0.25f, MOST_BLOCKS = 0.85f;
static const float NOISE = 3;     /* standard deviations of a mean */
static const float ALIKE = 0.25f; /* of the step: two steps of one band */
static const float LEFT = 0.25f;  /* of the step, by which air may be off */

/* What a view has more than the one before, and what is known of it. */
struct change {
	float along[SAMPLES], block[BLOCKS]; /* NAN: unknown */
	float noise;
};

/* A band that steps between a place and the next. */
struct band_step {
	int axis, first, end, samples; /* across it: samples first .. end - 1 of so many */
	float step;                    /* 0: none */
};

/* What the object does between two views is told by the pairs of views around them. */
enum trend { TREND_BESIDE, TREND_AROUND, TREND_NONE, TRENDS };

static bool has_pair(const struct ring *ring, int place)
{
	return ring_view(ring, place) != NULL && ring_view(ring, place + 1) != NULL;
}

/* Of a sample across the band, or a block where `axis` is 2, what a pair changes by without the band's own step. */
static float change_at(const struct ring *ring, int place, int axis, int i, const struct band_step *band,
		       const float *steps)
{
	const struct view_profile *a = ring_view(ring, place), *b = ring_view(ring, place + 1);
	const int index = (place + ring->count) % ring->count;
	int at, low, high;

	if (axis < 2 && (band == NULL || axis != band->axis))
		return b->along[axis][i] - a->along[axis][i];
	if (band == NULL)
		return b->block[i] - a->block[i];
	if (axis < 2)
		return b->along[axis][i] - a->along[axis][i] - (i >= band->first && i < band->end ? steps[index] : 0);
	at = band->axis == 0 ? i % SIDE : i / SIDE;
	low = at * band->samples > band->first * SIDE ? at * band->samples : band->first * SIDE;
	high = (at + 1) * band->samples < band->end * SIDE ? (at + 1) * band->samples : band->end * SIDE;
	return b->block[i] - a->block[i] - (high > low ? steps[index] * (float)(high - low) / (float)band->samples : 0);
}

static float usual_change(const struct ring *ring, int place, int axis, int i, enum trend trend,
			  const struct band_step *band, const float *steps)
{
	const int around = trend == TREND_BESIDE ? 1 : AROUND;
	float values[2 * AROUND];
	int count = 0;

	for (int k = -around; k <= around && trend != TREND_NONE; k++) {
		float own;

		if (k == 0 || !has_pair(ring, place + k))
			continue;
		own = change_at(ring, place + k, axis, i, band, steps);
		if (!isnan(own))
			values[count++] = own;
	}
	return select_median(values, count);
}

/* steps: of this band in all pairs, as far as they are known; NULL: none. */
static void make_change(const struct ring *ring, int place, int axis, enum trend trend, const struct band_step *band,
			const float *steps, struct change *ret)
{
	const struct view_profile *from = ring_view(ring, place), *to = ring_view(ring, place + 1);

	for (int i = 0; i < SAMPLES; i++)
		ret->along[i] = change_at(ring, place, axis, i, NULL, NULL) -
				usual_change(ring, place, axis, i, trend, band, steps);
	for (int b = 0; b < BLOCKS; b++)
		ret->block[b] =
		    change_at(ring, place, 2, b, NULL, NULL) - usual_change(ring, place, 2, b, trend, band, steps);
	ret->noise = hypotf(from->noise, to->noise);
}

static int samples_of(const struct ring *ring, int place, int axis)
{
	const float *a = ring_view(ring, place)->along[axis], *b = ring_view(ring, place + 1)->along[axis];
	int samples = SAMPLES;

	while (samples > 0 && isnan(a[samples - 1]) && isnan(b[samples - 1]))
		samples--;
	return samples;
}

/* The band that explains most of the squares of the profile's change. */
static bool fit_band(const float *along, int samples, int *ret_first, int *ret_end)
{
	const int least = samples / NARROW > 2 ? samples / NARROW : 2;
	double sums[SAMPLES + 1] = {0}, best = 0;
	int counts[SAMPLES + 1] = {0};

	for (int i = 0; i < samples; i++) {
		sums[i + 1] = sums[i] + (isnan(along[i]) ? 0 : (double)along[i]);
		counts[i + 1] = counts[i] + !isnan(along[i]);
	}
	for (int first = 0; first + least <= samples; first++)
		for (int end = first + least; end <= samples && end - first <= WIDE_MOST * samples / SIDE; end++) {
			const double sum = sums[end] - sums[first];
			const int count = counts[end] - counts[first];

			if (2 * count >= end - first && sum * sum > best * count) {
				best = sum * sum / count;
				*ret_first = first;
				*ret_end = end;
			}
		}
	return best > 0;
}

static bool is_box(const float *along, int samples, int first, int end, float step)
{
	const float size = fabsf(step);
	int strays = 0;

	for (int i = 0; i < samples; i++) {
		const bool within = i >= first && i < end;
		const float off = fabsf(within ? along[i] - step : along[i]);

		if (isnan(along[i])) {
			if (!within)
				return false;
			continue;
		}
		if (abs(i - first) < BETWEEN || abs(i - end) < BETWEEN)
			continue;
		if (off > STRAY * size)
			return false;
		strays += off > (within ? INSIDE : BESIDE) * size;
	}
	return strays <= STRAYS * samples;
}

static bool are_blocks_alike(const struct change *change, const struct band_step *band)
{
	const float size = fabsf(band->step);
	const float tolerance = fminf(fmaxf(AGREE * size, NOISE * change->noise), 0.5f * size);
	int within = 0, agree = 0, beside = 0, quiet = 0;

	for (int b = 0; b < BLOCKS; b++) {
		const int at = band->axis == 0 ? b % SIDE : b / SIDE;
		const int from = at * band->samples, to = (at + 1) * band->samples; /* in SIDE-ths of a sample */

		if (isnan(change->block[b]))
			continue;
		if (from >= band->first * SIDE && to <= band->end * SIDE) {
			within++;
			agree += fabsf(change->block[b] - band->step) <= tolerance;
		} else if (to <= band->first * SIDE || from >= band->end * SIDE) {
			beside++;
			quiet += fabsf(change->block[b]) <= fmaxf(QUIET * size, NOISE * change->noise);
		}
	}
	return within >= WHOLE_LEAST && agree >= MOST_BLOCKS * within && quiet >= 0.95f * beside;
}

static float median_within(const float *along, int first, int end)
{
	float values[SAMPLES];
	int count = 0;

	for (int i = first; i < end; i++)
		if (!isnan(along[i]))
			values[count++] = along[i];
	return select_median(values, count);
}

static bool is_whole(const struct band_step *band)
{
	return band->end - band->first == band->samples;
}

/* The median of what the blocks step by. */
static float step_of_blocks(const float *blocks)
{
	float values[BLOCKS];
	int count = 0;

	for (int b = 0; b < BLOCKS; b++)
		if (!isnan(blocks[b]))
			values[count++] = blocks[b];
	return count >= WHOLE_KNOWN ? select_median(values, count) : 0;
}

/* All of the detector may step at a place. */
static bool find_whole(const struct ring *ring, int place, enum trend trend, struct band_step *ret)
{
	struct change change;
	struct band_step band = {.samples = SIDE, .end = SIDE};

	make_change(ring, place, 0, trend, NULL, NULL, &change);
	band.step = step_of_blocks(change.block);
	if (fabsf(band.step) < LEAST_WHOLE || !are_blocks_alike(&change, &band))
		return false;
	*ret = band;
	return true;
}

/* A band that may step at a place: its borders are looked for. */
static bool find_seed(const struct ring *ring, int place, int axis, enum trend trend, struct band_step *ret)
{
	struct change change;
	struct band_step band = {.axis = axis, .samples = samples_of(ring, place, axis)};

	make_change(ring, place, axis, trend, NULL, NULL, &change);
	if (band.samples < SIDE || !fit_band(change.along, band.samples, &band.first, &band.end))
		return false;
	band.step = median_within(change.along, band.first, band.end);
	if (fabsf(band.step) < LEAST || !is_box(change.along, band.samples, band.first, band.end, band.step) ||
	    !are_blocks_alike(&change, &band))
		return false;
	*ret = band;
	return true;
}

/* What the samples within a border step more than those beside it; NAN where they are not known. */
static float contrast_of(const struct ring *ring, int place, const struct band_step *band)
{
	const int borders[2] = {band->first, band->end};
	double sum = 0;
	int count = 0;

	if (is_whole(band)) {
		struct change change;

		make_change(ring, place, 0, TREND_NONE, NULL, NULL, &change);
		return step_of_blocks(change.block);
	}
	for (int side = 0; side < 2; side++)
		for (int k = 1; k <= 3; k++) {
			const int in = side == 0 ? borders[0] + k : borders[1] - 1 - k;
			const int out = side == 0 ? borders[0] - 1 - k : borders[1] + k;
			float own;

			if (out < 0 || out >= band->samples || in < band->first || in >= band->end)
				continue;
			own = change_at(ring, place, band->axis, in, NULL, NULL) -
			      change_at(ring, place, band->axis, out, NULL, NULL);
			if (isnan(own))
				continue;
			sum += (double)own;
			count++;
		}
	return count > 0 ? (float)(sum / count) : NAN;
}

/* A pair beside one that steps may look as if it did the other way. */
static float size_near(const struct ring *ring, int place, const struct band_step *band)
{
	float size = 0;

	for (int k = -1; k <= 1; k++)
		if (has_pair(ring, place + k))
			size = fmaxf(size, fabsf(contrast_of(ring, place + k, band))); /* NAN is never the larger */
	return size;
}

static bool is_step(const struct ring *ring, int place, const struct band_step *band, const float *steps, float *ret)
{
	for (int trend = 0; trend < TRENDS; trend++) {
		struct change change;
		struct band_step own = *band;

		make_change(ring, place, band->axis, (enum trend)trend, band, steps, &change);
		own.step =
		    is_whole(band) ? step_of_blocks(change.block) : median_within(change.along, band->first, band->end);
		if (fabsf(fabsf(own.step) - fabsf(band->step)) <= ALIKE * fabsf(band->step) &&
		    (is_whole(band) || is_box(change.along, band->samples, band->first, band->end, own.step)) &&
		    are_blocks_alike(&change, &own)) {
			*ret = own.step;
			return true;
		}
	}
	return false;
}

/* The steps of a band in all pairs of views; 0: none; NAN: there may be one. steps: [count], work. */
static void find_steps(const struct ring *ring, const struct band_step *band, float *steps, float *ret_steps)
{
	const float size = fabsf(band->step);

	for (int place = 0; place < ring->count; place++) {
		const float own = has_pair(ring, place) ? contrast_of(ring, place, band) : NAN;

		steps[place] = fabsf(own) > 0.5f * size ? copysignf(size, own) : 0;
	}
	for (int place = 0; place < ring->count; place++) {
		ret_steps[place] = 0;
		if (steps[place] != 0 && !is_step(ring, place, band, steps, &ret_steps[place]))
			ret_steps[place] = NAN;
	}
}

/*
 * True if the views of a run are brighter at the detector's edge, and most show air there: what they lack, such as a
 * table's board that is seen from its side, has left the detector for a while.
 */
static bool has_left(const struct ring *ring, const struct band_step *band, int place, int run, float level)
{
	const int edge = band->first < BETWEEN ? 0 : band->samples - 1;
	int air = 0;

	if (is_whole(band) || level >= 0 || (band->first >= BETWEEN && band->end + BETWEEN <= band->samples))
		return false;
	for (int k = 1; k <= run; k++)
		air += fabsf(ring_view(ring, (place + k) % ring->count)->along[band->axis][edge]) <= -LEFT * level;
	return 2 * air > run;
}

/* Marks the views behind a place up to another one, where they turn by no more than is wanted and are free. */
static int mark_run(const struct ring *ring, const struct band_step *band, int place, int end, const float *steps,
		    struct step *ret_steps)
{
	const int count = (end - place + ring->count) % ring->count;
	const double n = band->samples;
	struct step step = {
	    .kind = is_whole(band) ? STEP_LEVEL : STEP_PART, .end = {1, 1}, .border = is_whole(band) ? 0 : BETWEEN / n};

	if (is_whole(band) ? MOST * count >= ring->count : ring_turn(ring, place, end + 1) > WIDE * PI / 180)
		return 0;
	for (int k = 1; k <= count; k++)
		if (ret_steps[ring_place(ring, (place + k) % ring->count)->view].kind != STEP_NONE)
			return 0;
	step.first[band->axis] = band->first / n;
	step.end[band->axis] = band->end / n;
	step.sides[0] = ring_place(ring, place)->view;
	step.sides[1] = ring_place(ring, (end + 1) % ring->count)->view;
	step.level = 0.5f * (steps[place] - steps[end]);
	if (has_left(ring, band, place, count, step.level))
		return 0;
	for (int k = 1; k <= count; k++)
		ret_steps[ring_place(ring, (place + k) % ring->count)->view] = step;
	return count;
}

/* What mark_run needs beside the ends of a run. */
struct marking {
	const struct ring *ring;
	const struct band_step *band;
	const float *steps;
	struct step *ret_steps;
};

static int mark(void *context, int place, int end)
{
	const struct marking *marking = context;

	return mark_run(marking->ring, marking->band, place, end, marking->steps, marking->ret_steps);
}

static bool is_known(const struct band_step *bands, int count, const struct band_step *band)
{
	for (int i = 0; i < count; i++)
		if (bands[i].axis == band->axis && abs(bands[i].first - band->first) <= BETWEEN &&
		    abs(bands[i].end - band->end) <= BETWEEN)
			return true;
	return false;
}

int bands_find(const struct ring *ring, struct step *ret_steps, struct error *err)
{
	float *steps = malloc(2 * (size_t)ring->count * sizeof(*steps));
	struct band_step known[BANDS_MOST];
	int found = 0, count = 0;

	if (steps == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the steps of %d views", ring->count);
	for (int place = 0; place < ring->count; place++)
		for (int i = 0; i < 3 * TRENDS && count < BANDS_MOST && ring_is_near(ring, place); i++) {
			struct band_step band;

			if (!(i < TRENDS ? find_whole(ring, place, (enum trend)i, &band)
					 : find_seed(ring, place, i / TRENDS - 1, (enum trend)(i % TRENDS), &band)) ||
			    is_known(known, count, &band))
				continue;
			known[count++] = band;
			band.step = size_near(ring, place, &band);
			if (band.step < (is_whole(&band) ? LEAST_WHOLE : LEAST))
				continue;
			find_steps(ring, &band, steps, steps + ring->count);
			found += ring_runs(ring, steps + ring->count, mark,
					   &(struct marking){ring, &band, steps + ring->count, ret_steps});
		}
	free(steps);
	return found;
}

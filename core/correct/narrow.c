/* Narrow bands of the detector with another signal: see narrow.h. */
#include "core/correct/narrow.h"

#include <math.h>
#include <stdlib.h>

#include "core/error.h"
#include "core/select.h"

enum { STRIPS = NARROW_STRIPS, SAMPLES = NARROW_SAMPLES };
enum { PIXELS_LEAST = 16 };
enum { WIDTH_LEAST = 2, WIDEST = 4 }; /* samples; one in so many */
enum { EDGE = 4, EDGE_VIEWS = 3 };    /* samples from the detector's edge within which a band has so many views */
enum { BORDER = 1 };                  /* samples at a border that may be of either side */
enum { BESIDE = 4 };                  /* samples on either side that a band stands out of, at least */
enum { AROUND = 3 };                  /* pairs of views on either side that tell what the object does */
enum { SEEDS = 3, BANDS_MOST = 24 };  /* of a pair; in all */
enum { STRIPS_LEAST = 5 };            /* known ones of a band */

static const double PI = 3.14159265358979323846;
static const double WIDE = 120; /* degrees from one side of a run to the other, at most */
/*
 * Line integrals. Four columns in a fifth of the views make 10 HU by the least. What is less than sure is a band that
 * is darker, and not at the edge: what an object does there is more, and a plate that is away for some views, brighter.
 */
static const float LEAST = 0.12f, SURE = 0.25f;
static const float WITHIN = 0.3f;        /* of the step: how far samples of a band may be off it, */
static const float NEAR_BY = 0.3f;       /* those next to it off what lies between its sides, */
static const float FAR_OFF = 0.6f;       /* and as many others off nothing */
static const float STRAYS = 0.1f;        /* share of those beside the band that may be more than NEAR_BY */
static const float SHARP = 0.6f;         /* of the step: from one side of a border to the other, at least */
static const float LOST = 0.3f;          /* of what the band has got, in what lies beside */
static const float STRIPS_ALIKE = 0.35f; /* of the step */
static const float ALIKE = 0.25f;        /* of the step: two steps of one band */
static const float NOISE = 3;            /* standard deviations */
/* In standard deviations of a sample, the median of what samples are off the mean of both neighbours by. */
static const float MEDIAN = 0.6745f * 1.2247f;
static const float NOISY = 0.15f; /* of the step: noise times NOISE, at most */

static int samples_of(int pixels)
{
	return pixels < SAMPLES ? pixels : SAMPLES;
}

/* The mean of a strip's lines at a pixel across the bands of an axis; NAN where they all say nothing. */
static float look_at_strip(const struct linearise *linearise, const void *samples, const int pixels[2], int axis,
			   int strip, int pixel)
{
	float sum = 0;
	int good = 0;

	for (int i = 0; i < NARROW_LINES; i++) {
		const long long lines = pixels[1 - axis], at = 2 * (strip * NARROW_LINES + i) + 1;
		const int line = (int)(at * lines / (2 * STRIPS * NARROW_LINES));
		const int row = axis == 0 ? line : pixel, column = axis == 0 ? pixel : line;
		float p = 0;

		if (linearise_pixel(linearise, samples, (size_t)row * (size_t)pixels[0] + (size_t)column, &p) !=
		    PIXEL_GOOD)
			continue;
		sum += p;
		good++;
	}
	return good > 0 ? sum / (float)good : NAN;
}

void narrow_look(const struct linearise *linearise, const void *samples, const int pixels[2], float log_air,
		 struct view_strips *ret_strips)
{
	for (int axis = 0; axis < 2; axis++)
		for (int strip = 0; strip < STRIPS; strip++)
			for (int i = 0; i < samples_of(pixels[axis]); i++) {
				const long long at = (2LL * i + 1) * pixels[axis] / (2 * samples_of(pixels[axis]));

				ret_strips->p[axis][strip][i] =
				    log_air + look_at_strip(linearise, samples, pixels, axis, strip, (int)at);
			}
}

struct search {
	const struct ring *ring;
	const struct view_strips *strips; /* [views] */
	int axis, samples;
	float *mean;  /* [count][SAMPLES]: of a view's strips */
	float *steps; /* [count] */
	struct step *ret_steps;
};

struct band {
	int first, end; /* samples */
	float step;
};

/* What a pair of views changes by, without what the pairs around it change by. */
struct change {
	float mean[SAMPLES];
	float noise; /* of it */
};

enum trend { TREND_NONE, TREND_AROUND, TRENDS };

static const float *mean_at(const struct search *search, int place)
{
	const int count = search->ring->count;

	return search->mean + (size_t)((place + count) % count) * SAMPLES;
}

static bool has_pair(const struct ring *ring, int place)
{
	return ring_view(ring, place) != NULL && ring_view(ring, place + 1) != NULL;
}

static const struct view_strips *strips_at(const struct search *search, int place)
{
	return &search->strips[ring_place(search->ring, place)->view];
}

static void make_means(const struct search *search)
{
	for (int place = 0; place < search->ring->count; place++) {
		const struct view_strips *strips = strips_at(search, place);
		float *mean = search->mean + (size_t)place * SAMPLES;

		for (int i = 0; i < search->samples; i++) {
			float sum = 0;
			int known = 0;

			for (int s = 0; s < STRIPS; s++)
				if (!isnan(strips->p[search->axis][s][i])) {
					sum += strips->p[search->axis][s][i];
					known++;
				}
			mean[i] = known >= STRIPS_LEAST ? sum / (float)known : NAN;
		}
	}
}

static float median_of(const float *values, int first, int end)
{
	float known[SAMPLES];
	int count = 0;

	for (int i = first; i < end; i++)
		if (!isnan(values[i]))
			known[count++] = values[i];
	return count > 0 ? select_median(known, count) : NAN;
}

/* By what neighbouring samples differ; edges of an object are few of them. */
static float noise_of(const float *values, int samples)
{
	float apart[SAMPLES];
	int count = 0;

	for (int i = 1; i + 1 < samples; i++) {
		const float own = values[i] - 0.5f * (values[i - 1] + values[i + 1]);

		if (!isnan(own))
			apart[count++] = fabsf(own);
	}
	return count > 0 ? select_kth(apart, count, count / 2) / MEDIAN : 0;
}

static void make_change(const struct search *search, int place, enum trend trend, struct change *ret)
{
	const struct ring *ring = search->ring;
	const float *from = mean_at(search, place), *to = mean_at(search, place + 1);
	float level;

	for (int i = 0; i < search->samples; i++) {
		float usual[2 * AROUND];
		int count = 0;

		for (int k = -AROUND; k <= AROUND && trend == TREND_AROUND; k++) {
			float own;

			if (k == 0 || !has_pair(ring, place + k))
				continue;
			own = mean_at(search, place + k + 1)[i] - mean_at(search, place + k)[i];
			if (!isnan(own))
				usual[count++] = own;
		}
		ret->mean[i] = to[i] - from[i] - select_median(usual, count);
	}
	/* Another dose is no matter here. */
	level = median_of(ret->mean, 0, search->samples);
	for (int i = 0; i < search->samples; i++)
		ret->mean[i] -= level;
	ret->noise = noise_of(ret->mean, search->samples);
}

/* The mean of a profile over samples; NAN where fewer than half of them are known. */
static float mean_of(const float *values, int first, int end)
{
	float sum = 0;
	int count = 0;

	for (int i = first; i < end; i++)
		if (!isnan(values[i])) {
			sum += values[i];
			count++;
		}
	return count > 0 && 2 * count >= end - first ? sum / (float)count : NAN;
}

/* What lies beside a band, on the first or the second side; NAN: nothing. */
static float beside(const float *values, int samples, const struct band *band, int side)
{
	const int width = band->end - band->first, wide = width > BESIDE ? width : BESIDE;
	const int first = side == 0 ? band->first - BORDER - wide : band->end + BORDER;
	const int end = side == 0 ? band->first - BORDER : band->end + BORDER + wide;

	return mean_of(values, first > 0 ? first : 0, end < samples ? end : samples);
}

/* What a band has more than what lies beside it. */
static float contrast(const float *values, int samples, const struct band *band)
{
	const int margin = band->end - band->first > 2 * BORDER + 1 ? BORDER : 0;
	const float in = mean_of(values, band->first + margin, band->end - margin);
	const float left = beside(values, samples, band, 0), right = beside(values, samples, band, 1);

	if (isnan(left))
		return in - right;
	return in - (isnan(right) ? left : 0.5f * (left + right));
}

/* True if as many samples as the band has step nearly as much elsewhere. */
static bool has_other(const struct change *change, int samples, const struct band *band)
{
	const int width = band->end - band->first;
	float sum = 0;
	int count = 0;

	for (int i = 0; i < samples; i++) {
		const int out = i - width;

		if (i >= band->first - BORDER && i < band->end + BORDER) {
			sum = 0;
			count = 0;
			continue;
		}
		sum += isnan(change->mean[i]) ? 0 : change->mean[i];
		if (++count > width) {
			sum -= isnan(change->mean[out]) ? 0 : change->mean[out];
			count--;
		}
		if (count == width && fabsf(sum) > FAR_OFF * fabsf(band->step) * (float)width)
			return true;
	}
	return false;
}

/* True if the change begins and ends from one sample to the next, or within one at the border of a wider band; at the
 * detector's edge it has no border. */
static bool is_sharp(const struct change *change, int samples, const struct band *band)
{
	const int apart = band->end - band->first > 3 ? 1 : 0;

	for (int side = 0; side < 2; side++) {
		const int in = side == 0 ? band->first + apart : band->end - 1 - apart;
		const int out = side == 0 ? band->first - 1 - apart : band->end + apart;

		if (side == 0 ? band->first == 0 : band->end == samples)
			continue;
		if ((change->mean[in] - change->mean[out < 0         ? 0
						     : out < samples ? out
								     : samples - 1]) /
			band->step <
		    SHARP)
			return false;
	}
	return true;
}

/* True if samples are those of a band that steps, and of nothing else that does as much. */
static bool is_box(const struct change *change, int samples, const struct band *band)
{
	const float size = fabsf(band->step), noise = NOISE * change->noise;
	const float left = beside(change->mean, samples, band, 0), right = beside(change->mean, samples, band, 1);
	const float ends[2] = {isnan(left) ? right : left, isnan(right) ? left : right};
	const int width = band->end - band->first, wide = width > BESIDE ? width : BESIDE;
	float lost = 0;
	int strays = 0;

	if (noise > NOISY * size || !is_sharp(change, samples, band))
		return false;
	for (int i = 0; i < samples; i++) {
		const float own = change->mean[i];
		const bool within = i >= band->first && i < band->end;
		const bool at_border = abs(i - band->first) < BORDER || abs(i + 1 - band->end) < BORDER;
		float off, share;

		if (isnan(own))
			continue;
		/* A border may lie within a sample. */
		if ((width > 3 && within && at_border) ||
		    (!within && i >= band->first - BORDER && i < band->end + BORDER)) {
			if (own * copysignf(1, band->step) < -NEAR_BY * size - noise)
				return false;
			continue;
		}
		share = ((float)i - (float)band->first) / (float)width;
		off = ends[0] + fminf(1, fmaxf(0, share)) * (ends[1] - ends[0]);
		if (within && fabsf(own - off - band->step) > WITHIN * size + noise)
			return false;
		if (within)
			continue;
		if (i >= band->first - wide && i < band->end + wide && fabsf(own - off) > NEAR_BY * size + noise)
			return false;
		strays += fabsf(own) > NEAR_BY * size + noise;
		lost -= own * copysignf(1, band->step);
	}
	return (float)strays <= STRAYS * (float)samples && !has_other(change, samples, band) &&
	       lost < LOST * size * (float)width + noise * sqrtf((float)samples);
}

/* True if all strips along the band step as much. */
static bool are_strips_alike(const struct search *search, int place, const struct band *band, float change_noise)
{
	const struct view_strips *from = strips_at(search, place), *to = strips_at(search, place + 1);
	const float noise = change_noise * sqrtf((float)STRIPS / (float)(band->end - band->first));
	const float size = fabsf(band->step), tolerance = fminf(STRIPS_ALIKE * size + NOISE * noise, 0.7f * size);
	int known = 0, alike = 0;

	for (int s = 0; s < STRIPS; s++) {
		float change[SAMPLES], own;

		for (int i = 0; i < search->samples; i++)
			change[i] = to->p[search->axis][s][i] - from->p[search->axis][s][i];
		own = contrast(change, search->samples, band);
		if (isnan(own))
			continue;
		known++;
		alike += fabsf(own - band->step) <= tolerance;
	}
	return known >= STRIPS_LEAST && alike >= known - 1;
}

static bool is_step(const struct search *search, int place, const struct band *band, float *ret)
{
	for (int trend = 0; trend < TRENDS; trend++) {
		struct change change;
		struct band own = *band;

		make_change(search, place, (enum trend)trend, &change);
		own.step = contrast(change.mean, search->samples, band);
		if (fabsf(fabsf(own.step) - fabsf(band->step)) <= ALIKE * fabsf(band->step) &&
		    is_box(&change, search->samples, &own) && are_strips_alike(search, place, &own, change.noise)) {
			*ret = own.step;
			return true;
		}
	}
	return false;
}

/* Sums over a change, for means over any of its samples. */
struct sums {
	float sum[SAMPLES + 1];
	int count[SAMPLES + 1];
};

static float mean_between(const struct sums *sums, int first, int end)
{
	const int count = sums->count[end] - sums->count[first];

	return count > 0 && 2 * count >= end - first ? (sums->sum[end] - sums->sum[first]) / (float)count : NAN;
}

/* As contrast, of a change. */
static float contrast_between(const struct sums *sums, int samples, const struct band *band)
{
	const int width = band->end - band->first, wide = width > BESIDE ? width : BESIDE;
	const int left = band->first - BORDER, right = band->end + BORDER;
	const float in = mean_between(sums, band->first, band->end);
	const float before = left > 0 ? mean_between(sums, left > wide ? left - wide : 0, left) : NAN;
	const float behind =
	    right < samples ? mean_between(sums, right, right + wide < samples ? right + wide : samples) : NAN;

	if (isnan(before))
		return in - behind;
	return in - (isnan(behind) ? before : 0.5f * (before + behind));
}

/* Keeps a band among those that stand out most, none of which lie over each other. */
static void keep_seed(struct band seeds[SEEDS], float scores[SEEDS], const struct band *band)
{
	const float score = band->step * band->step * (float)(band->end - band->first);
	int at = 0;

	for (int i = 1; i < SEEDS; i++)
		at = scores[i] < scores[at] ? i : at;
	for (int i = 0; i < SEEDS; i++)
		if (scores[i] > 0 && seeds[i].first < band->end && seeds[i].end > band->first)
			at = i;
	if (score > scores[at]) {
		scores[at] = score;
		seeds[at] = *band;
	}
}

/*
 * What enters at the detector's edge for a moment may be an object, and what is away for a moment as well: there a band
 * steps in more views than that, and has lost signal.
 */
static bool is_at_edge(const struct band *band, int samples)
{
	return band->first < EDGE || band->end + EDGE > samples;
}

/* The bands that stand out most of a change; a step of 0: none. */
static void find_seeds(const struct change *change, int samples, struct band ret_seeds[SEEDS])
{
	float scores[SEEDS] = {0};
	struct sums sums = {.count = {0}};

	for (int i = 0; i < SEEDS; i++)
		ret_seeds[i] = (struct band){0, 0, 0};
	for (int i = 0; i < samples; i++) {
		sums.sum[i + 1] = sums.sum[i] + (isnan(change->mean[i]) ? 0 : change->mean[i]);
		sums.count[i + 1] = sums.count[i] + !isnan(change->mean[i]);
	}
	for (int first = 0; first + WIDTH_LEAST <= samples; first++)
		for (int end = first + WIDTH_LEAST; end <= samples && WIDEST * (end - first) <= samples; end++) {
			struct band band = {first, end, 0};

			if (!(fabsf(mean_between(&sums, first, end)) >= 0.5f * LEAST))
				continue;
			band.step = contrast_between(&sums, samples, &band);
			/* Little lies beside it there: what does is no band because that one is. */
			if (is_at_edge(&band, samples) && mean_between(&sums, first, end) / band.step < 0.5f)
				continue;
			if (fabsf(band.step) >= (is_at_edge(&band, samples) ? SURE : LEAST))
				keep_seed(ret_seeds, scores, &band);
		}
}

/* The steps of a band in all pairs of views; 0: none; NAN: there may be one. */
static void find_steps(const struct search *search, const struct band *band, float *ret_steps)
{
	for (int place = 0; place < search->ring->count; place++) {
		struct change change;
		float own;

		ret_steps[place] = 0;
		if (!has_pair(search->ring, place))
			continue;
		make_change(search, place, TREND_NONE, &change);
		own = contrast(change.mean, search->samples, band);
		if (isnan(own) || fabsf(own) <= 0.5f * fabsf(band->step))
			continue;
		if (!is_step(search, place, band, &ret_steps[place]))
			ret_steps[place] = NAN;
	}
}

/* What mark needs beside the ends of a run. */
struct marking {
	const struct search *search;
	const struct band *band;
};

/* Marks the views behind a place up to another one, where they turn by no more than is wanted and are free. */
static int mark(void *context, int before, int last)
{
	const struct marking *marking = context;
	const struct search *search = marking->search;
	const struct ring *ring = search->ring;
	const int run = (last - before + ring->count) % ring->count;
	struct step step = {.kind = STEP_PART, .end = {1, 1}, .border = (BORDER + 0.5) / search->samples};

	if (ring_turn(ring, before, (last + 1) % ring->count) > WIDE * PI / 180)
		return 0;
	for (int k = 1; k <= run; k++)
		if (search->ret_steps[ring_place(ring, (before + k) % ring->count)->view].kind != STEP_NONE)
			return 0;
	step.first[search->axis] = marking->band->first / (double)search->samples;
	step.end[search->axis] = marking->band->end / (double)search->samples;
	step.sides[0] = ring_place(ring, before)->view;
	step.sides[1] = ring_place(ring, (last + 1) % ring->count)->view;
	step.level = 0.5f * (search->steps[before] - search->steps[last]);
	if (step.level < 0 && fabsf(marking->band->step) < SURE)
		return 0;
	for (int k = 1; k <= run; k++)
		search->ret_steps[ring_place(ring, (before + k) % ring->count)->view] = step;
	return run;
}

static bool is_known(const struct band *bands, int count, const struct band *band)
{
	for (int i = 0; i < count; i++)
		if (abs(bands[i].first - band->first) <= BORDER && abs(bands[i].end - band->end) <= BORDER)
			return true;
	return false;
}

/* How many views of a run are darker; far below 0: they are brighter. */
static int count_views(void *context, int before, int last)
{
	const struct marking *marking = context;
	const int count = marking->search->ring->count;

	return marking->search->steps[before] > 0 ? (last - before + count) % count : -count;
}

/* The runs of bands that may step at a place and were not looked at yet. */
static int look_at(const struct search *search, int place, enum trend trend, struct band *known, int *ret_count)
{
	struct band seeds[SEEDS];
	struct change change;
	int found = 0;

	make_change(search, place, trend, &change);
	find_seeds(&change, search->samples, seeds);
	for (int i = 0; i < SEEDS && *ret_count < BANDS_MOST; i++) {
		const struct band *band = &seeds[i];

		if (band->step == 0 || is_known(known, *ret_count, band) || !is_box(&change, search->samples, band) ||
		    !are_strips_alike(search, place, band, change.noise))
			continue;
		known[(*ret_count)++] = *band;
		find_steps(search, band, search->steps);
		if (is_at_edge(band, search->samples) &&
		    ring_runs(search->ring, search->steps, count_views, &(struct marking){search, band}) < EDGE_VIEWS)
			continue;
		found += ring_runs(search->ring, search->steps, mark, &(struct marking){search, band});
	}
	return found;
}

int narrow_find(const struct ring *ring, const struct view_strips *strips, const int pixels[2], struct step *ret_steps,
		struct error *err)
{
	const size_t count = (size_t)ring->count;
	float *work = malloc(count * (SAMPLES + 1) * sizeof(*work));
	int found = 0;

	if (work == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the profiles of %d views", ring->count);
	for (int axis = 0; axis < 2; axis++) {
		const struct search search = {
		    ring, strips, axis, samples_of(pixels[axis]), work, work + count * SAMPLES, ret_steps};
		struct band known[BANDS_MOST];
		int bands = 0;

		if (pixels[0] < PIXELS_LEAST || pixels[1] < PIXELS_LEAST)
			continue;
		make_means(&search);
		for (int place = 0; place < ring->count; place++)
			for (int trend = 0; trend < TRENDS && ring_is_near(ring, place); trend++)
				found += look_at(&search, place, (enum trend)trend, known, &bands);
	}
	free(work);
	return found;
}

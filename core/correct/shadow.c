/* Edges of the detector in shadow: see shadow.h. */
#include "core/correct/shadow.h"

#include <math.h>
#include <stdlib.h>

#include "core/correct/round.h"

enum { LINES = 4 }; /* of a segment that are looked at, most */
enum { COUNT_LEAST = 16, LIT_LEAST = 8 };

/* A line integral that stands for no light at all, one that noise may change by any amount, and that of an object. */
static const float NO_LIGHT = 10, STARVED = 5, OBJECT = 0.5F;
static const float SHARE = 0.3F, ALLOWANCE = 0.05F; /* of the step */
static const float SHARP = 0.6F;                    /* of the largest fall that a penumbra has between two bins */
static const float PENUMBRA = 0.05F, PENUMBRA_LEAST = 0.02F;
static const double WIDEST = 0.4, VIEWS = 0.85, FULL = 0.25, LESS = 0.3;
/* Of the step: how far rings about the axis may be from the profile, and how much more it falls beyond a shell's cusp.
 */
static const double RINGS = 0.15, CUSP = 0.5;

/* Profiles across one direction. */
struct profiles {
	int pixels, lines;  /* along the profile, and across it */
	size_t step, line;  /* samples from a pixel to the next, and from a line to the next */
	int bins, segments; /* bins of a profile */
	double axis;        /* bin of the image of the rotation's axis; NAN where that is not along the lines */
	double *distances;  /* [bins + 1], of the rays at the bins' edges from the axis, mm, below 0 on one side */
	float *values;      /* [view][bin][segment], line integrals; NAN where nothing is good */
};

struct shadow {
	const struct linearise *linearise;
	struct profiles profiles[2]; /* across columns, across rows */
	int most, views;
};

/* The first of `count` things that belongs to part i of `parts`. */
static int part_begin(int i, int parts, int count)
{
	return (int)((long long)i * count / parts);
}

/* Where along columns (0) or rows (1) the image of z lies at the isocentre, pixels; NAN where it runs along them. */
static double axis_pixel(const struct geometry *geometry, int direction)
{
	static const double isocentre[3] = {0}, above[3] = {0, 0, 1};
	double sum = 0;

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12], at[2], beside[2];

		view_matrix(&geometry->views[k], matrix);
		if (!(view_project(matrix, isocentre, &at[0], &at[1]) > 0) ||
		    !(view_project(matrix, above, &beside[0], &beside[1]) > 0) ||
		    fabs(beside[direction] - at[direction]) >= fabs(beside[1 - direction] - at[1 - direction]))
			return NAN;
		sum += at[direction];
	}
	return sum / geometry->count;
}

/* How far the rays at a place along columns (0) or rows (1) pass the axis on the detector's middle line, mm. */
static double axis_distance(const struct geometry *geometry, int direction, double pixel)
{
	const double place[2] = {direction == 0 ? pixel : 0.5 * (geometry->columns - 1),
				 direction == 1 ? pixel : 0.5 * (geometry->rows - 1)};
	double sum = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];
		double way[2];

		for (int i = 0; i < 2; i++)
			way[i] = view->pixel0[i] + place[0] * view->column_step[i] + place[1] * view->row_step[i] -
				 view->source[i];
		sum += (view->source[0] * way[1] - view->source[1] * way[0]) / hypot(way[0], way[1]);
	}
	return sum / geometry->count;
}

static struct profiles profiles_of(int pixels, int lines, size_t step, size_t line)
{
	return (struct profiles){.pixels = pixels,
				 .lines = lines,
				 .step = step,
				 .line = line,
				 .bins = pixels < SHADOW_BINS ? pixels : SHADOW_BINS,
				 .segments = lines < SHADOW_SEGMENTS ? lines : SHADOW_SEGMENTS};
}

int shadow_new(const struct linearise *linearise, const struct geometry *geometry, int views,
	       struct shadow **ret_shadow, struct error *err)
{
	const size_t columns = (size_t)geometry->columns;
	struct shadow *shadow;

	*ret_shadow = NULL;
	if (geometry->columns < COUNT_LEAST || geometry->rows < COUNT_LEAST)
		return 0;
	shadow = calloc(1, sizeof(*shadow));
	if (shadow == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look for shadows");
	shadow->linearise = linearise;
	shadow->most = views;
	shadow->profiles[0] = profiles_of(geometry->columns, geometry->rows, 1, columns);
	shadow->profiles[1] = profiles_of(geometry->rows, geometry->columns, columns, 1);
	for (int axis = 0; axis < 2; axis++) {
		struct profiles *profiles = &shadow->profiles[axis];

		profiles->axis = (axis_pixel(geometry, axis) + 0.5) * profiles->bins / profiles->pixels - 0.5;
		profiles->values = calloc((size_t)views * (size_t)profiles->bins * (size_t)profiles->segments,
					  sizeof(*profiles->values));
		profiles->distances = calloc((size_t)profiles->bins + 1, sizeof(*profiles->distances));
		if (profiles->values == NULL || profiles->distances == NULL) {
			shadow_free(shadow);
			return error_set(err, ERR_NO_MEMORY, "no memory to look for shadows");
		}
		for (int bin = 0; bin <= profiles->bins; bin++)
			profiles->distances[bin] =
			    axis_distance(geometry, axis, part_begin(bin, profiles->bins, profiles->pixels) - 0.5);
	}
	*ret_shadow = shadow;
	return 0;
}

void shadow_free(struct shadow *shadow)
{
	if (shadow == NULL)
		return;
	for (int axis = 0; axis < 2; axis++) {
		free(shadow->profiles[axis].values);
		free(shadow->profiles[axis].distances);
	}
	free(shadow);
}

/* ---- profiles ---- */

/* The transmission of a pixel, or its line integral where the samples are such; NAN where it says nothing. */
static float value_of(const struct linearise *linearise, const void *samples, size_t at)
{
	const float sample = linearise_sample(linearise, samples, at);
	enum pixel_kind kind;
	float transmission;

	if (linearise_mapped(linearise, at))
		return NAN;
	if (linearise->quantity == QUANTITY_LINE_INTEGRAL)
		return isfinite(sample) ? sample : NAN;
	kind = linearise_transmission(linearise, sample, at, linearise_saturation(linearise), &transmission);
	return kind == PIXEL_GOOD || kind == PIXEL_ZERO ? transmission : NAN;
}

/* The line integral of the mean over a bin in a segment. */
static float bin_value(const struct linearise *linearise, const struct profiles *profiles, const void *samples, int bin,
		       int segment)
{
	const int from = part_begin(bin, profiles->bins, profiles->pixels);
	const int to = part_begin(bin + 1, profiles->bins, profiles->pixels);
	const int first = part_begin(segment, profiles->segments, profiles->lines);
	const int all = part_begin(segment + 1, profiles->segments, profiles->lines) - first;
	const int lines = all < LINES ? all : LINES;
	double sum = 0;
	int good = 0;

	for (int i = 0; i < lines; i++) {
		const size_t line = (size_t)(first + part_begin(i, lines, all)) * profiles->line;

		for (int pixel = from; pixel < to; pixel++) {
			const float value = value_of(linearise, samples, line + (size_t)pixel * profiles->step);

			if (isnan(value))
				continue;
			sum += (double)value;
			good++;
		}
	}
	if (good == 0)
		return NAN;
	if (linearise->quantity == QUANTITY_LINE_INTEGRAL)
		return fminf((float)(sum / good), NO_LIGHT);
	return sum > 0 ? fminf((float)-log(sum / good), NO_LIGHT) : NO_LIGHT;
}

void shadow_add(struct shadow *shadow, const void *samples)
{
	if (shadow->views == shadow->most)
		return;
	for (int axis = 0; axis < 2; axis++) {
		const struct profiles *profiles = &shadow->profiles[axis];
		float *values =
		    profiles->values + (size_t)shadow->views * (size_t)profiles->bins * (size_t)profiles->segments;

#pragma omp parallel for schedule(static)
		for (int bin = 0; bin < profiles->bins; bin++)
			for (int segment = 0; segment < profiles->segments; segment++)
				values[(size_t)bin * (size_t)profiles->segments + (size_t)segment] =
				    bin_value(shadow->linearise, profiles, samples, bin, segment);
	}
	shadow->views++;
}

/* ---- one edge of the detector ---- */

/* Profiles as they are met from one of the detector's edges inwards. */
struct edge {
	const struct profiles *profiles;
	int views;
	bool behind; /* the last column or row is met first */
	float *work; /* [views][segments] */
};

static float edge_value(const struct edge *edge, int view, int bin, int segment)
{
	const struct profiles *profiles = edge->profiles;
	const int at = edge->behind ? profiles->bins - 1 - bin : bin;

	return profiles->values[((size_t)view * (size_t)profiles->bins + (size_t)at) * (size_t)profiles->segments +
				(size_t)segment];
}

static int compare(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

/*
 * The quantile over views and segments of a bin, less that of the bin `bright` where this is not below 0; -INFINITY
 * where most have neither.
 */
static float quantile_of(const struct edge *edge, int dark, int bright, int first, int end, double quantile)
{
	int count = 0;

	for (int view = 0; view < edge->views; view++)
		for (int segment = first; segment < end; segment++) {
			const float less = bright < 0 ? 0 : edge_value(edge, view, bright, segment);
			const float value = edge_value(edge, view, dark, segment) - less;

			if (!isnan(value))
				edge->work[count++] = value;
		}
	if (2 * count < edge->views * (end - first))
		return -INFINITY;
	qsort(edge->work, (size_t)count, sizeof(*edge->work), compare);
	return edge->work[(int)(quantile * count)];
}

struct border {
	int bins;       /* in shadow; 0: none */
	int first, end; /* segments that have it */
	float step;
};

/* How often a segment's views have a step: all of it, less of it where an object may be in the way, or anything. */
struct tally {
	int full, less, known;
};

/*
 * True if a segment has the step in nearly all views, which are added to *tally. A step is less where the object begins
 * at the border; where it is less in all views both sides lie in a shadow of the other direction, if in any.
 */
static bool segment_has(const struct edge *edge, int dark, int bright, int segment, float step, struct tally *tally)
{
	const float tolerance = SHARE * step + ALLOWANCE;
	struct tally own = {0};
	int good = 0;

	for (int view = 0; view < edge->views; view++) {
		const float d = edge_value(edge, view, dark, segment);
		const float fall = d - edge_value(edge, view, bright, segment);
		const bool is_full = fabsf(fall - step) <= tolerance || (fall > step && d >= STARVED);
		const bool is_less = !is_full && d >= step - tolerance && fall >= -tolerance && fall <= step;

		own.known += !isnan(fall);
		own.full += is_full;
		own.less += is_less && d > step + tolerance;
		good += is_full || is_less;
	}
	if (2 * own.known < edge->views || good < VIEWS * own.known || own.less >= VIEWS * own.known)
		return false;
	tally->known += own.known;
	tally->full += own.full;
	tally->less += own.less;
	return true;
}

/* True if a step is there in a run of segments over the middle. */
static bool border_has(const struct edge *edge, int dark, int bright, float step, struct border *ret)
{
	const int segments = edge->profiles->segments, middle = segments / 2;
	struct tally tally = {0};

	*ret = (struct border){.first = middle, .end = middle, .step = step};
	if (!(step >= SHADOW_LEAST))
		return false;
	while (ret->end < segments && segment_has(edge, dark, bright, ret->end, step, &tally))
		ret->end++;
	while (ret->first > 0 && segment_has(edge, dark, bright, ret->first - 1, step, &tally))
		ret->first--;
	return 2 * (ret->end - ret->first) >= segments && tally.full >= FULL * tally.known &&
	       tally.less <= LESS * tally.known;
}

/* The step is what most views have, or, where the object's outline is at the border, the shadow with air behind it. */
static bool border_at(const struct edge *edge, int dark, int bright, struct border *ret)
{
	const int first = edge->profiles->segments / 4, end = edge->profiles->segments - first;

	return border_has(edge, dark, bright, quantile_of(edge, dark, bright, first, end, 0.5), ret) ||
	       border_has(edge, dark, bright, quantile_of(edge, dark, -1, first, end, 1 - VIEWS), ret);
}

/* True if nearly all values of the bins outwards of one are dark as well: the light is none of the object's. */
static bool reaches_edge(const struct edge *edge, int dark, const struct border *border)
{
	const float least = border->step - SHARE * border->step - ALLOWANCE;

	for (int bin = 0; bin < dark; bin++) {
		int known = 0, good = 0;

		for (int view = 0; view < edge->views; view++)
			for (int segment = border->first; segment < border->end; segment++) {
				const float value = edge_value(edge, view, bin, segment);

				known += !isnan(value);
				good += value >= least;
			}
		if (good < VIEWS * known)
			return false;
	}
	return true;
}

/*
 * True if the values hardly change as far again on either side of the border, and the detector's edge is no nearer than
 * that to more than two bins of it. Where they go on, it is no edge but the slope of a plate that is seen from above,
 * or of the wall of a tube around the field.
 */
static bool stands_alone(const struct edge *edge, int dark, int length, const struct border *border)
{
	const int inwards = dark + 2 * length, outwards = dark - length;
	/* Half as much where nothing is seen outwards of it. */
	const float most = (outwards < 0 ? 0.5F : 1) * SHARE * border->step;

	return (inwards >= edge->profiles->bins ||
		quantile_of(edge, dark + length, inwards, border->first, border->end, 0.5) <= most) &&
	       (outwards < 0 ? length <= 2
			     : quantile_of(edge, outwards, dark, border->first, border->end, 0.5) <= most);
}

/*
 * True if the light grows over the border's bins as behind the edge of a collimator, by equal parts of it or more at
 * once. Of a deep shadow the first of them takes most of the line integral; a disc that is seen nearly edge on takes
 * equal parts of that.
 */
static bool is_an_edge(const struct edge *edge, int dark, int length, const struct border *border)
{
	const float least = SHARP * logf(1 + (expf(border->step) - 1) / (float)length);

	for (int bin = dark; bin < dark + length; bin++)
		if (quantile_of(edge, bin, bin + 1, border->first, border->end, VIEWS) >= least)
			return true;
	return length == 1;
}

/* The mean over all views of the border's segments; NAN where nothing is good. */
static double mean_of(const struct edge *edge, int bin, const struct border *border)
{
	double sum = 0;
	int count = 0;

	for (int view = 0; view < edge->views; view++)
		for (int segment = border->first; segment < border->end; segment++) {
			const float value = edge_value(edge, view, bin, segment);

			if (isnan(value))
				continue;
			sum += (double)value;
			count++;
		}
	return count > 0 ? sum / count : NAN;
}

/* True if rings about the axis have these means from the detector's edge inwards, so many on this side of the axis. */
static bool rings_have(const struct edge *edge, const double *means, int bins, double most)
{
	double *edges = malloc((size_t)(2 * bins + 1) * sizeof(*edges)), *values = edges + bins + 1, differ = INFINITY;

	if (edges == NULL)
		return false;
	for (int i = 0; i <= bins; i++)
		edges[i] = fabs(edge->profiles->distances[edge->behind ? edge->profiles->bins - bins + i : bins - i]);
	for (int i = 0; i < bins; i++)
		values[i] = means[bins - 1 - i];
	if (!round_nearest(edges, values, bins, &differ))
		differ = INFINITY;
	free(edges);
	return differ <= most;
}

/*
 * True if the step is the cusp of a shell about the axis that the detector cuts: rings about the axis explain the
 * profile, as they do the mean of all views of whatever turns once, and outwards of it, where the rays cross the shell
 * alone, it falls more steeply than within. Behind a collimator it goes on as it does beside it.
 */
static bool is_a_shell(const struct edge *edge, int dark, int length, const struct border *border)
{
	const int within = dark + length, inwards = within + dark;
	const double axis = edge->behind ? edge->profiles->bins - 1 - edge->profiles->axis : edge->profiles->axis;
	const int bins = (int)floor(axis + 0.5); /* whole ones on this side */
	double means[SHADOW_BINS] = {0}, step;

	if (dark == 0 || inwards >= bins || bins > edge->profiles->bins)
		return false;
	for (int bin = 0; bin < bins; bin++)
		means[bin] = mean_of(edge, bin, border);
	step = means[dark] - means[within];
	for (int bin = 0; bin < bins; bin++)
		if (isnan(means[bin]))
			return false;
	return means[dark] - means[0] - (means[inwards] - means[within]) >= CUSP * step &&
	       rings_have(edge, means, bins, RINGS * step);
}

/*
 * True if the step is the object's. It is where the object has it once more as far on the other side of the axis, and
 * not as the border of a shadow that comes from the other edge: the rays there are those of the opposite views, and
 * what the object has at one place of all profiles it has at both, a collimator at one. It is, too, where it is that of
 * a shell, which may well be cut on both sides alike, or seen on one alone.
 */
static bool is_of_the_object(const struct edge *edge, int dark, int length, const struct border *border)
{
	const int bins = edge->profiles->bins;
	const double axis = edge->behind ? bins - 1 - edge->profiles->axis : edge->profiles->axis;
	const double further = bins - 1 - 2 * axis; /* from the other edge than the border from its own */
	struct edge other = *edge;

	other.behind = !edge->behind;
	if (!(fabs(further) < bins))
		return false;
	for (int more = 0; more < 2; more++) {
		const int twin = dark + (int)floor(further) + more;
		struct border found;

		if (twin >= 0 && twin + length < bins &&
		    border_has(&other, twin, twin + length, border->step, &found) &&
		    !reaches_edge(&other, twin, &found))
			return true;
	}
	return is_a_shell(edge, dark, length, border);
}

/* The bins of the shadow's border that are partly in shadow are taken for shadow. */
static int penumbra_end(const struct edge *edge, int bins, const struct border *border)
{
	const float least = fmaxf(PENUMBRA * border->step, PENUMBRA_LEAST);

	for (int more = 0; more < 8 && bins + 1 < edge->profiles->bins; more++, bins++)
		if (!(quantile_of(edge, bins, bins + 1, border->first, border->end, 0.5) > least))
			break;
	return bins;
}

static struct border find_border(const struct edge *edge)
{
	const int most = (int)(WIDEST * edge->profiles->bins);
	struct border best = {0};

	for (int length = 1; length <= 4 && best.bins == 0; length *= 2)
		for (int dark = 0; dark + length <= most; dark++) {
			struct border border;

			if (!border_at(edge, dark, dark + length, &border) || border.step <= best.step ||
			    !reaches_edge(edge, dark, &border) || !stands_alone(edge, dark, length, &border) ||
			    !is_an_edge(edge, dark, length, &border) || is_of_the_object(edge, dark, length, &border))
				continue;
			border.bins = penumbra_end(edge, dark + length, &border);
			if (border.bins <= most)
				best = border;
		}
	return best;
}

/* ---- all edges ---- */

static bool reaches_segment(const struct border borders[2], const struct profiles *across, int segment, int segments)
{
	/* A segment's lines are the other direction's pixels. */
	const double from = (double)segment / segments, to = (double)(segment + 1) / segments;

	return borders[0].bins > from * across->bins || across->bins - borders[1].bins < to * across->bins;
}

/* Drops borders that leave segments out which are in no shadow of the other direction; true if there were any. */
static bool drop_partial(const struct shadow *shadow, struct border borders[2][2])
{
	bool dropped = false;

	for (int axis = 0; axis < 2; axis++)
		for (int side = 0; side < 2; side++) {
			struct border *border = &borders[axis][side];
			const int segments = shadow->profiles[axis].segments;
			bool whole = true;

			for (int segment = 0; segment < segments && border->bins > 0; segment++)
				whole = whole && ((segment >= border->first && segment < border->end) ||
						  reaches_segment(borders[1 - axis], &shadow->profiles[1 - axis],
								  segment, segments));
			if (border->bins == 0 || whole)
				continue;
			*border = (struct border){0};
			dropped = true;
		}
	return dropped;
}

/* True if an object is seen beside the shadows. */
static bool shows_object(const struct shadow *shadow, struct border borders[2][2])
{
	const struct profiles *profiles = &shadow->profiles[0];

	for (int view = 0; view < shadow->views; view++)
		for (int bin = borders[0][0].bins; bin < profiles->bins - borders[0][1].bins; bin++)
			for (int segment = 0; segment < profiles->segments; segment++)
				if (!reaches_segment(borders[1], &shadow->profiles[1], segment, profiles->segments) &&
				    profiles->values[((size_t)view * (size_t)profiles->bins + (size_t)bin) *
							 (size_t)profiles->segments +
						     (size_t)segment] >= OBJECT)
					return true;
	return false;
}

int shadow_find(const struct shadow *shadow, struct shadow_found *ret_found, struct error *err)
{
	struct shadow_found found = {.views = shadow->views, .least = INFINITY};
	struct border borders[2][2];
	float *work = malloc((size_t)(shadow->views > 0 ? shadow->views : 1) * SHADOW_SEGMENTS * sizeof(*work));
	bool any = false, room = true;

	if (work == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look for shadows");
	for (int axis = 0; axis < 2; axis++)
		for (int side = 0; side < 2; side++) {
			const struct edge edge = {&shadow->profiles[axis], shadow->views, side == 1, work};

			borders[axis][side] = find_border(&edge);
		}
	free(work);
	while (drop_partial(shadow, borders))
		;
	for (int axis = 0; axis < 2; axis++) {
		const struct profiles *profiles = &shadow->profiles[axis];

		for (int side = 0; side < 2; side++) {
			const struct border *border = &borders[axis][side];
			const int pixels = side == 0 ? part_begin(border->bins, profiles->bins, profiles->pixels)
						     : profiles->pixels - part_begin(profiles->bins - border->bins,
										     profiles->bins, profiles->pixels);

			if (border->bins == 0)
				continue;
			*(side == 0 ? &found.before[axis] : &found.behind[axis]) = pixels;
			found.least = fminf(found.least, border->step);
			found.most = fmaxf(found.most, border->step);
			any = true;
		}
		room = room && profiles->pixels - found.before[axis] - found.behind[axis] >= LIT_LEAST;
	}
	if (!any || !room || !shows_object(shadow, borders))
		return 0;
	*ret_found = found;
	return 1;
}

/* Single samples of single views that are wrong: see impulses.h. */
#include "core/correct/impulses.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "core/error.h"
#include "core/select.h"

enum { RING = 2, SIDE = 2 * RING + 1, AROUND = SIDE * SIDE - 1, AROUND_LEAST = 8, NEXT = 8, NEXT_LEAST = 3 };
enum { PIXELS_LEAST = 16 };
static const float LEAST = 0.7f, SPREADS = 6, NEXT_SPREADS = 2; /* line integral; of all around, of the next ones */
static const float FACTOR = 1.6f, APART = 0.47f;                /* a first look: of counts; of line integrals */
static const float MAD = 1.4826f;
static const double NEAR = 10; /* degrees to the views on both sides, at most */
enum { ALONE = 3 };            /* pixels */
enum { ROWS = 3 };             /* that an object goes from a view to the next, at most */
/* Of an impulse: a spot; how far it is off all that is near by in the views beside. Of a spot's largest. */
static const float SPOT = 0.4f, BEYOND = 0.5f, EVEN = 0.5f;

/* Values about a place, those of the next pixels first; returns how many of both are known. */
struct around {
	float values[AROUND];
	int next, all;
};

typedef float (*value_of)(const void *context, int column, int row);

static struct around look_around(value_of value, const void *context, int column, int row)
{
	struct around around = {.next = 0};

	for (int distance = 1; distance <= RING; distance++) {
		for (int r = -distance; r <= distance; r++)
			for (int c = -distance; c <= distance; c++) {
				float p;

				if (abs(r) != distance && abs(c) != distance)
					continue;
				p = value(context, column + c, row + r);
				if (!isnan(p))
					around.values[around.all++] = p;
			}
		around.next = distance == 1 ? around.all : around.next;
	}
	return around;
}

/* True if a value is far off all around it; one of the next pixels may be wrong as well. */
static bool is_off(const struct around *around, float own)
{
	float sorted[AROUND], apart[AROUND], median, spread, next;

	if (around->next < NEXT_LEAST || around->all < AROUND_LEAST)
		return false;
	for (int i = 0; i < around->all; i++)
		sorted[i] = around->values[i];
	median = select_median(sorted, around->all);
	if (!(fabsf(own - median) > LEAST))
		return false;
	for (int i = 0; i < around->all; i++)
		apart[i] = fabsf(around->values[i] - median);
	next = select_kth(apart, around->next, around->next - 2);
	spread = MAD * select_median(apart, around->all);
	return fabsf(own - median) > fmaxf(SPREADS * spread, NEXT_SPREADS * next);
}

/* ---- the look at the samples ---- */

struct look {
	const struct linearise *linearise;
	const void *samples;
	int columns, rows;
};

static float line_integral(const void *context, int column, int row)
{
	const struct look *look = context;
	float p = NAN;

	if (column < 0 || row < 0 || column >= look->columns || row >= look->rows)
		return NAN;
	return linearise_pixel(look->linearise, look->samples, (size_t)row * (size_t)look->columns + (size_t)column,
			       &p) == PIXEL_GOOD
		   ? p
		   : NAN;
}

/* A row as it is, without the dark. */
static void take_row(const struct look *look, int row, float *ret)
{
	const size_t from = (size_t)row * (size_t)look->columns;
	const float *dark = look->linearise->quantity == QUANTITY_INTENSITY ? look->linearise->image[IMAGE_DARK] : NULL;

	if (look->linearise->sample == SAMPLE_UINT16) {
		const uint16_t *samples = (const uint16_t *)look->samples + from;

#pragma omp simd
		for (int c = 0; c < look->columns; c++)
			ret[c] = samples[c];
	} else {
		const float *samples = (const float *)look->samples + from;

#pragma omp simd
		for (int c = 0; c < look->columns; c++)
			ret[c] = samples[c];
	}
	if (dark == NULL)
		return;
#pragma omp simd
	for (int c = 0; c < look->columns; c++)
		ret[c] -= dark[from + (size_t)c];
}

static inline int is_beyond(float own, float left, float right, float factor, float apart)
{
	const float more = factor * own + apart;

	return ((own > factor * left + apart) & (own > factor * right + apart)) | ((more < left) & (more < right));
}

/* Marks what stands out of both neighbours in its row; returns whether anything does. */
static bool stand_out(const struct look *look, const float *row, unsigned char *ret)
{
	const bool counts = look->linearise->quantity == QUANTITY_INTENSITY;
	const float factor = counts ? FACTOR : 1, apart = counts ? 0 : APART;
	const int last = look->columns - 1;
	int any = 0;

	/* At both ends the one neighbour counts. */
	ret[0] = (unsigned char)is_beyond(row[0], row[1], row[1], factor, apart);
	ret[last] = (unsigned char)is_beyond(row[last], row[last - 1], row[last - 1], factor, apart);
#pragma omp simd reduction(| : any)
	for (int c = 1; c < last; c++) {
		const int beyond = is_beyond(row[c], row[c - 1], row[c + 1], factor, apart);

		ret[c] = (unsigned char)beyond;
		any |= beyond;
	}
	any |= ret[0] | ret[last];
	return any != 0;
}

/* The most that a view's may be. */
static int impulses_most(int columns, int rows)
{
	const int share = (int)((size_t)columns * (size_t)rows / IMPULSES_PIXELS);

	return share > IMPULSES_FEW ? share : IMPULSES_FEW;
}

/* Appends the impulses of a row; false where they are too many. found: [impulses_most]. */
static bool look_at_row(const struct look *look, int row, const unsigned char *marks, int *found, int *ret_count)
{
	for (int c = 0; c < look->columns; c++) {
		const float own = marks[c] ? line_integral(look, c, row) : NAN;
		struct around around;

		if (isnan(own))
			continue;
		around = look_around(line_integral, look, c, row);
		if (!is_off(&around, own))
			continue;
		if (*ret_count == impulses_most(look->columns, look->rows))
			return false;
		found[(*ret_count)++] = row * look->columns + c;
	}
	return true;
}

/* Marks the rows in which anything stands out; false without memory. */
static bool find_rows(const struct look *look, bool *ret_rows)
{
	const size_t columns = (size_t)look->columns;
	int failed = 0;

#pragma omp parallel reduction(| : failed)
	{
		float *row = malloc(columns * (sizeof(*row) + 1));

		failed = row == NULL;
#pragma omp for schedule(static)
		for (int r = 0; r < look->rows; r++) {
			if (row == NULL)
				continue;
			take_row(look, r, row);
			ret_rows[r] = stand_out(look, row, (unsigned char *)(row + columns));
		}
		free(row);
	}
	return !failed;
}

int impulses_look(const struct linearise *linearise, const void *samples, const int pixels[2],
		  struct view_impulses *ret_impulses, struct error *err)
{
	const struct look look = {linearise, samples, pixels[0], pixels[1]};
	const size_t columns = (size_t)pixels[0], rows = (size_t)pixels[1];
	int *found = NULL, count = 0;
	float *row = NULL;
	bool *some = NULL, few = true;

	*ret_impulses = (struct view_impulses){0};
	if (pixels[0] < PIXELS_LEAST || pixels[1] < PIXELS_LEAST)
		return 0;
	row = malloc(columns * (sizeof(*row) + 1));
	some = malloc(rows * sizeof(*some));
	found = malloc((size_t)impulses_most(pixels[0], pixels[1]) * sizeof(*found));
	if (row == NULL || some == NULL || found == NULL || !find_rows(&look, some)) {
		free(row);
		free(some);
		free(found);
		return error_set(err, ERR_NO_MEMORY, "no memory for the rows of %d x %d pixels", pixels[0], pixels[1]);
	}
	for (int r = 0; r < pixels[1] && few; r++) {
		unsigned char *marks = (unsigned char *)(row + columns);

		if (!some[r])
			continue;
		take_row(&look, r, row);
		stand_out(&look, row, marks);
		few = look_at_row(&look, r, marks, found, &count);
	}
	free(row);
	free(some);
	if (few && count > 0) {
		ret_impulses->pixels = malloc((size_t)count * sizeof(*ret_impulses->pixels));
		if (ret_impulses->pixels == NULL) {
			free(found);
			return error_set(err, ERR_NO_MEMORY, "no memory for %d samples", count);
		}
		memcpy(ret_impulses->pixels, found, (size_t)count * sizeof(*found));
		ret_impulses->count = count;
	}
	free(found);
	return 0;
}

/* ---- mending ---- */

struct picture {
	const float *values;
	int columns, rows;
	int wide; /* columns that an object goes from here to the view that is looked at, at most */
	const struct view_impulses *impulses;
};

static float value_in(const void *context, int column, int row)
{
	const struct picture *picture = context;

	if (column < 0 || row < 0 || column >= picture->columns || row >= picture->rows)
		return NAN;
	return picture->values[(size_t)row * (size_t)picture->columns + (size_t)column];
}

static float median_around(const struct picture *picture, int column, int row)
{
	struct around around = look_around(value_in, picture, column, row);

	return select_median(around.values, around.all);
}

/* What nine pixels have more than those around them, where these are alike beside it; else 0. */
static float spot_at(const struct picture *picture, int column, int row)
{
	struct around around = look_around(value_in, picture, column, row);
	const int outer = around.all - around.next;
	float sorted[AROUND], apart[AROUND], median, sum, most;

	if (outer < NEXT)
		return 0;
	for (int i = 0; i < outer; i++)
		sorted[i] = around.values[around.next + i];
	median = select_median(sorted, outer);
	for (int i = 0; i < outer; i++)
		apart[i] = fabsf(around.values[around.next + i] - median);
	sum = value_in(picture, column, row) - median;
	most = fabsf(sum);
	for (int i = 0; i < around.next; i++) {
		sum += around.values[i] - median;
		most = fmaxf(most, fabsf(around.values[i] - median));
	}
	return select_kth(apart, outer, outer - 3) < EVEN * most ? sum : 0;
}

/* False where spot_at is below `least`, times `sign`, whatever the median around is: it is no less than the least. */
static bool may_be_spot(const struct picture *picture, int column, int row, float sign, float least)
{
	const float *middle = picture->values + (ptrdiff_t)row * picture->columns + column;
	float sum = 0, low = INFINITY;

	if (column < RING || row < RING || column >= picture->columns - RING || row >= picture->rows - RING)
		return true;
	for (int r = -RING; r <= RING; r++)
		for (int c = -RING; c <= RING; c++) {
			const float value = sign * middle[(ptrdiff_t)r * picture->columns + c];

			if (abs(r) < RING && abs(c) < RING)
				sum += value;
			else
				low = fminf(low, value);
		}
	return !(sum - (NEXT + 1) * low < least);
}

/* Of one that is marked as none, too. */
static int pixel_of(int pixel)
{
	return pixel < 0 ? ~pixel : pixel;
}

/* True if the pixel, or one next to it where `wide`, stands out of its surroundings itself. */
static bool stands_out(const struct view_impulses *impulses, int columns, int column, int row, int wide)
{
	for (int i = 0; i < impulses->count; i++) {
		const int at = pixel_of(impulses->pixels[i]);

		if (abs(at % columns - column) <= wide && abs(at / columns - row) <= wide)
			return true;
	}
	return false;
}

/* How a view beside shows near by as much as a sample, or a spot of its size: by what stands out itself, or not. */
enum shown { SHOWN_NOT, SHOWN_OUT, SHOWN };
static enum shown shows(const struct picture *picture, int column, int row, float own, float size)
{
	const float sign = copysignf(1, size);
	enum shown shown = SHOWN_NOT;

	for (int r = row - ROWS; r <= row + ROWS; r++)
		for (int c = column - picture->wide; c <= column + picture->wide; c++) {
			const float value = value_in(picture, c, r);
			const bool near = sign * (own - value) < BEYOND * sign * size;

			if (isnan(value) || (!near && (!may_be_spot(picture, c, r, sign, SPOT * sign * size) ||
						       sign * spot_at(picture, c, r) < SPOT * sign * size)))
				continue;
			if (!stands_out(picture->impulses, picture->columns, c, r, near ? 0 : 1))
				return SHOWN;
			shown = SHOWN_OUT;
		}
	return shown;
}

/* The good views on both sides, and the angles to them; -1: none. */
static void find_sides(const struct mend_tools *tools, int view, int ret_sides[2], double ret_ways[2])
{
	const double turn = 2 * acos(-1);

	for (int side = 0; side < 2; side++) {
		ret_sides[side] = -1;
		ret_ways[side] = turn;
	}
	for (int i = 0; i < tools->orbit->count; i++) {
		double way = tools->orbit->angle[i] - tools->orbit->angle[view];

		if (i == view || tools->bad[i])
			continue;
		for (int side = 0; side < 2; side++, way = -way) {
			const double own = way < 0 ? way + turn : way;

			if (own < ret_ways[side]) {
				ret_ways[side] = own;
				ret_sides[side] = i;
			}
		}
	}
}

/* A view, and the good ones on both sides of it that are near, [3]. */
static int take_pictures(const struct mend_tools *tools, int view, const struct view_impulses *impulses, float *values,
			 struct picture ret[3], int *ret_count, struct error *err)
{
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	const double across = 0.5 * tools->orbit->field_of_view / tools->orbit->pixel_at_isocentre[0];
	int views[3] = {view}, count = 1, sides[2], code = 0;
	double ways[3] = {0}, both[2];

	find_sides(tools, view, sides, both);
	for (int side = 0; side < 2; side++)
		if (sides[side] >= 0 && both[side] <= NEAR * acos(-1) / 180) {
			views[count] = sides[side];
			ways[count++] = both[side];
		}
	for (int i = 0; i < count && code == 0; i++) {
		float *to = values + (size_t)i * (size_t)columns * (size_t)rows;

		ret[i] = (struct picture){to, columns, rows, 1 + (int)ceil(fmin(columns, 2 * across * ways[i])),
					  &impulses[views[i]]};
		code = tools->backend->stack_download(tools->projections, views[i], 1, to, err);
	}
	*ret_count = count;
	return code;
}

/* False if more than one other one is near by: what stands in a line, as a plate that is seen from its edge, is no
 * impulse. */
static bool is_alone(const struct view_impulses *impulses, int columns, int at)
{
	int near = 0;

	for (int i = 0; i < impulses->count; i++) {
		const int other = pixel_of(impulses->pixels[i]);

		near += abs(other % columns - at % columns) <= ALONE && abs(other / columns - at / columns) <= ALONE;
	}
	return near <= 2;
}

/* True for one that the views beside show, or that cannot be held against two of them. pictures: of the view first. */
static bool is_of_object(const struct picture *pictures, int count, const struct view_impulses *impulses, int which)
{
	const int columns = pictures[0].columns, at = impulses->pixels[which];
	const int column = at % columns, row = at / columns;
	const float value = pictures[0].values[at], size = value - median_around(&pictures[0], column, row);
	bool stays = count < 3 || !is_alone(impulses, columns, at);
	int out = 0;

	for (int k = 1; k < count && !stays; k++) {
		const enum shown shown = shows(&pictures[k], column, row, value, size);

		out += shown == SHOWN_OUT;
		stays = shown == SHOWN || out == 2;
	}
	return stays;
}

int impulses_check(const struct mend_tools *tools, int view, struct view_impulses *impulses, struct error *err)
{
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	const struct view_impulses *own = &impulses[view];
	float *values = malloc(3 * (size_t)columns * (size_t)rows * sizeof(*values));
	struct picture pictures[3];
	bool *none;
	int count = 0, code;

	if (values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for three views");
	code = take_pictures(tools, view, impulses, values, pictures, &count, err);
	none = malloc((size_t)own->count * sizeof(*none));
	if (code == 0 && none == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d samples", own->count);
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < (code == 0 ? own->count : 0); i++)
		none[i] = is_of_object(pictures, count, own, i);
	for (int i = 0; i < own->count && code == 0; i++)
		if (none[i])
			own->pixels[i] = ~own->pixels[i];
	free(none);
	free(values);
	return code;
}

void impulses_keep(struct view_impulses *impulses)
{
	int count = 0;

	for (int i = 0; i < impulses->count; i++)
		if (impulses->pixels[i] >= 0)
			impulses->pixels[count++] = impulses->pixels[i];
	impulses->count = count;
}

int impulses_mend(const struct mend_tools *tools, int view, const struct view_impulses *impulses, struct error *err)
{
	const struct backend *backend = tools->backend;
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	float *values = malloc((size_t)columns * (size_t)rows * sizeof(*values));
	float *right = malloc((size_t)impulses->count * sizeof(*right));
	const struct picture own = {.values = values, .columns = columns, .rows = rows};
	int code;

	if (values == NULL || right == NULL) {
		free(values);
		free(right);
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	}
	code = backend->stack_download(tools->projections, view, 1, values, err);
	for (int i = 0; i < impulses->count && code == 0; i++)
		right[i] = median_around(&own, impulses->pixels[i] % columns, impulses->pixels[i] / columns);
	for (int i = 0; i < impulses->count && code == 0; i++)
		values[impulses->pixels[i]] = right[i];
	if (code == 0)
		code = backend->stack_upload(tools->projections, view, 1, values, err);
	free(right);
	free(values);
	return code;
}

/* Pixels whose gain differs from the flat image's in all views: see rings.h. */
#include "core/correct/rings.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/select.h"

enum {
	DIRECTIONS = 4,
	REACH = 2,  /* pixels that a direction looks away */
	AROUND = 3, /* pixels to each side of one that s is of */
	WINDOW = (2 * AROUND + 1) * (2 * AROUND + 1),
	KNOWN_LEAST = 8, /* of these, for an s */
	BLOCK = 16,      /* columns that are gathered at once: a line of the cache */
	PASSES_MOST = 8,
	AGREE = 3 /* directions */
};
static const int STEPS[DIRECTIONS][2] = {{0, 1}, {1, 0}, {1, 1}, {1, -1}}; /* row, column */

static const size_t STRIP_BYTES = 48 << 20;
static const double OUTER = 0.4;                /* share of the views that each end of the sorted r leaves out */
static const double BELOW = 0.75;               /* share of the pixels around that are below s */
static const float TIMES = 3.5F, LEAST = 2e-4F; /* of s; line integral */
static const float LARGEST = 0.1F;              /* line integral */
static const float HALF = 0.5F;                 /* of the error, that a direction has */
static const float UNEXPLAINED = 0.3F;          /* root mean square of what is left around, in errors */
static const double MANY = 0.1;                 /* of all pixels */
static const double AXIS_PIXELS = 3;

/* Rows of all views: [view][row][column], with REACH more at each side, beyond the detector too. */
struct strip {
	int first, rows, row_most; /* of the detector, without the rows around; row_most: for as many there is room */
	int columns, views;        /* columns: of the detector */
	float *values;
};

struct rings {
	const struct linearise *linearise;
	const struct geometry *geometry;
	float *r[DIRECTIONS];   /* R of the views alone, [row][column]; NAN: not known */
	float *best;            /* [row][column], errors that are believed, 0 elsewhere */
	float *errors;          /* [row][column], the caller's */
	unsigned char *changed; /* [row][column], what is to be judged again */
};

static int rows_of_strip(int columns, int rows, int views)
{
	const size_t row = (size_t)(columns + 2 * REACH) * (size_t)views * sizeof(float);
	const size_t most = STRIP_BYTES / row;

	return most < 2 * REACH + 1 ? 1 : most - 2 * REACH > (size_t)rows ? rows : (int)most - 2 * REACH;
}

static size_t strip_values(int columns, int strip_rows, int views)
{
	return (size_t)(columns + 2 * REACH) * (size_t)(strip_rows + 2 * REACH) * (size_t)views;
}

size_t rings_bytes(int columns, int rows, int views)
{
	const size_t pixels = (size_t)columns * (size_t)rows;

	return strip_values(columns, rows_of_strip(columns, rows, views), views) * sizeof(float) +
	       pixels * ((DIRECTIONS + 3) * sizeof(float) + 1);
}

/* ---- R ---- */

/* Beyond its ends a line goes on as straight as it came: what one step out says is twice the end less one step in. */
static void extend(float *end, ptrdiff_t outwards)
{
	for (ptrdiff_t i = 1; i <= REACH; i++)
		end[i * outwards] = 2 * end[0] - end[-i * outwards];
}

/* The row `i` beyond an end of the detector, where the strip has it. */
static void extend_rows(float *values, const struct strip *strip, ptrdiff_t wide, int end, int i)
{
	const float *last = values + (end - strip->first + REACH) * wide, *within = last - i * wide;
	const int row = end + i - strip->first;
	float *beyond = values + (row + REACH) * wide;

	if (row < -REACH || row >= strip->rows + REACH)
		return;
	for (ptrdiff_t c = 0; c < wide; c++)
		beyond[c] = 2 * last[c] - within[c];
}

/* One view's rows of the strip, and those around it. */
static int read_view(const struct rings *rings, const struct rings_source *source, const struct strip *strip, int view,
		     void *samples, struct error *err)
{
	const struct linearise *linearise = rings->linearise;
	const ptrdiff_t columns = strip->columns, wide = columns + 2 * REACH;
	const int rows = rings->geometry->rows;
	const int from = strip->first < REACH ? 0 : strip->first - REACH;
	const int to = strip->first + strip->rows + REACH > rows ? rows : strip->first + strip->rows + REACH;
	float *values = strip->values + (ptrdiff_t)view * (strip->row_most + 2 * REACH) * wide;
	int code = source->read(source->context, view, from, to - from, samples, err);

	if (code < 0)
		return code;
	for (int row = from; row < to; row++) {
		float *line = values + (row - strip->first + REACH) * wide + REACH;
		const size_t at = (size_t)row * (size_t)columns;
		/* The samples begin with row `from`, the images with the detector's first. */
		const char *whole =
		    (const char *)samples - (size_t)from * (size_t)columns * linearise_sample_bytes(linearise);

		for (ptrdiff_t c = 0; c < columns; c++)
			if (linearise_pixel(linearise, whole, at + (size_t)c, &line[c]) != PIXEL_GOOD ||
			    (linearise->stuck != NULL && linearise->stuck[at + (size_t)c]))
				line[c] = NAN;
		extend(line, -1);
		extend(line + columns - 1, 1);
	}
	for (int i = 1; i <= REACH; i++) {
		extend_rows(values, strip, wide, 0, -i);
		extend_rows(values, strip, wide, rows - 1, i);
	}
	return 0;
}

static int read_strip(const struct rings *rings, const struct rings_source *source, const struct strip *strip,
		      struct error *err)
{
	const size_t bytes =
	    (size_t)strip->columns * (size_t)(strip->row_most + 2 * REACH) * linearise_sample_bytes(rings->linearise);
	int code = 0;

#pragma omp parallel
	{
		char *samples = malloc(bytes);
		struct error own;

#pragma omp for schedule(dynamic)
		for (int view = 0; view < strip->views; view++) {
			int mine = samples == NULL ? error_set(&own, ERR_NO_MEMORY, "no memory for rows of a view")
						   : read_view(rings, source, strip, view, samples, &own);

			pulse_beat();
			if (mine < 0) {
#pragma omp critical(rings_error)
				if (code == 0) {
					code = mine;
					*err = own;
				}
			}
		}
		free(samples);
	}
	return code;
}

/* Of the finite ones of `count` values, which are reordered; NAN where they are less than half. */
static float middle_mean(float *values, int count)
{
	int known = 0, outer;
	double sum = 0;

	for (int i = 0; i < count; i++)
		if (isfinite(values[i]))
			values[known++] = values[i];
	if (2 * known < count)
		return NAN;
	outer = (int)(OUTER * known);
	select_kth(values, known, outer);
	select_kth(values + outer, known - outer, known - 1 - 2 * outer);
	for (int i = outer; i < known - outer; i++)
		sum += (double)values[i];
	return (float)(sum / (known - 2 * outer));
}

/* R of some columns of a row of the strip; room: [DIRECTIONS][BLOCK][view]. */
static void measure_block(const struct rings *rings, const struct strip *strip, int row, int column, float *room)
{
	const ptrdiff_t wide = strip->columns + 2 * REACH;
	const int count = strip->columns - column < BLOCK ? strip->columns - column : BLOCK;
	const size_t views = (size_t)strip->views;

	for (size_t view = 0; view < views; view++) {
		const float *at = strip->values +
				  ((ptrdiff_t)view * (strip->row_most + 2 * REACH) + row + REACH) * wide + REACH +
				  column;

		for (int d = 0; d < DIRECTIONS; d++) {
			const ptrdiff_t step = STEPS[d][0] * wide + STEPS[d][1];

			for (int c = 0; c < count; c++)
				room[((size_t)d * BLOCK + (size_t)c) * views + view] =
				    at[c] -
				    (4 * (at[c + step] + at[c - step]) - (at[c + 2 * step] + at[c - 2 * step])) / 6;
		}
	}
	for (int d = 0; d < DIRECTIONS; d++)
		for (int c = 0; c < count; c++)
			rings->r[d][(size_t)(strip->first + row) * (size_t)strip->columns + (size_t)(column + c)] =
			    middle_mean(room + ((size_t)d * BLOCK + (size_t)c) * views, strip->views);
}

static int measure_strip(const struct rings *rings, const struct strip *strip, struct error *err)
{
	const int across = (strip->columns + BLOCK - 1) / BLOCK;
	bool failed = false;

#pragma omp parallel
	{
		float *room = malloc((size_t)DIRECTIONS * BLOCK * (size_t)strip->views * sizeof(*room));

#pragma omp for schedule(dynamic)
		for (int i = 0; i < strip->rows * across; i++) {
			pulse_beat();
			if (room != NULL) {
				measure_block(rings, strip, i / across, i % across * BLOCK, room);
			} else {
#pragma omp atomic write
				failed = true;
			}
		}
		free(room);
	}
	return failed ? error_set(err, ERR_NO_MEMORY, "no memory to look for rings") : 0;
}

static int measure(const struct rings *rings, const struct rings_source *source, const struct cancel *cancel,
		   struct error *err)
{
	const struct geometry *geometry = rings->geometry;
	struct strip strip = {.columns = geometry->columns, .views = geometry->count};
	int code = 0;

	strip.row_most = rows_of_strip(geometry->columns, geometry->rows, geometry->count);
	strip.values = malloc(strip_values(strip.columns, strip.row_most, strip.views) * sizeof(*strip.values));
	if (strip.values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for rows of %d views", strip.views);
	for (; strip.first < geometry->rows && code == 0; strip.first += strip.rows) {
		strip.rows =
		    geometry->rows - strip.first < strip.row_most ? geometry->rows - strip.first : strip.row_most;
		code = cancel_check(cancel, err);
		if (code == 0)
			code = read_strip(rings, source, &strip, err);
		if (code == 0)
			code = measure_strip(rings, &strip, err);
	}
	free(strip.values);
	return code;
}

/* ---- errors from R ---- */

/* Of a pixel, or as extend has it beyond the detector. */
static float error_at(const struct rings *rings, int row, int column)
{
	const int rows = rings->geometry->rows, columns = rings->geometry->columns;
	const int end_row = row < 0 ? 0 : row >= rows ? rows - 1 : row;
	const int end_column = column < 0 ? 0 : column >= columns ? columns - 1 : column;

	if (end_row != row)
		return 2 * error_at(rings, end_row, column) - error_at(rings, 2 * end_row - row, column);
	if (end_column != column)
		return 2 * error_at(rings, row, end_column) - error_at(rings, row, 2 * end_column - column);
	return rings->errors[(size_t)row * (size_t)columns + (size_t)column];
}

/* R without what the errors found so far make of it. */
static float rest_of(const struct rings *rings, int d, int row, int column)
{
	const int y = STEPS[d][0], x = STEPS[d][1];

	return rings->r[d][(size_t)row * (size_t)rings->geometry->columns + (size_t)column] -
	       (error_at(rings, row, column) -
		(4 * (error_at(rings, row + y, column + x) + error_at(rings, row - y, column - x)) -
		 (error_at(rings, row + 2 * y, column + 2 * x) + error_at(rings, row - 2 * y, column - 2 * x))) /
		    6);
}

/* s of a direction; INFINITY where too few pixels around are known. */
static float usual(const struct rings *rings, int d, int row, int column)
{
	const struct geometry *geometry = rings->geometry;
	float values[WINDOW];
	int count = 0;

	for (int r = row - AROUND; r <= row + AROUND; r++)
		for (int c = column - AROUND; c <= column + AROUND; c++) {
			float rest;

			if (r < 0 || r >= geometry->rows || c < 0 || c >= geometry->columns ||
			    (r == row && c == column))
				continue;
			rest = rest_of(rings, d, r, c);
			if (isfinite(rest))
				values[count++] = fabsf(rest);
		}
	return count < KNOWN_LEAST ? INFINITY : select_kth(values, count, (int)(BELOW * (count - 1))) + LEAST / 4;
}

/* The error of a pixel by what is known so far; 0 where none is believed. */
static float judge(const struct rings *rings, int row, int column)
{
	float rest[DIRECTIONS], least = INFINITY, weights = 0, error = 0;
	int agree = 0;

	for (int d = 0; d < DIRECTIONS; d++) {
		rest[d] = rest_of(rings, d, row, column);
		if (!isfinite(rest[d]))
			return 0;
	}
	/* Most pixels end here, before an s is asked for. */
	for (int d = 0; d < DIRECTIONS; d++)
		agree += fabsf(rest[d]) > HALF * LEAST;
	if (agree < AGREE)
		return 0;
	for (int d = 0; d < DIRECTIONS; d++) {
		const float s = usual(rings, d, row, column), weight = 1 / (s * s);

		least = fminf(least, s);
		weights += weight;
		error += weight * rest[d];
	}
	if (!(weights > 0))
		return 0;
	error /= weights;
	agree = 0;
	for (int d = 0; d < DIRECTIONS; d++)
		agree += error > 0 ? rest[d] > HALF * error : rest[d] < HALF * error;
	return fabsf(error) > TIMES * least && fabsf(error) > LEAST && fabsf(error) < LARGEST && agree >= AGREE ? error
														: 0;
}

/* True if a pixel's ray passes the axis of the rotation, z, within a pixel in half of the views. */
static bool is_on_axis(const struct geometry *geometry, int row, int column)
{
	int near = 0;

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12];

		view_matrix(&geometry->views[k], matrix);
		near += !(view_axis_distance(matrix, column, row) > AXIS_PIXELS);
	}
	return 2 * near >= geometry->count;
}

/* True if none within reach is larger. */
static bool is_largest(const struct rings *rings, int row, int column)
{
	const struct geometry *geometry = rings->geometry;
	const float own = fabsf(rings->best[(size_t)row * (size_t)geometry->columns + (size_t)column]);

	for (int r = row - REACH; r <= row + REACH; r++)
		for (int c = column - REACH; c <= column + REACH; c++)
			if (r >= 0 && r < geometry->rows && c >= 0 && c < geometry->columns &&
			    fabsf(rings->best[(size_t)r * (size_t)geometry->columns + (size_t)c]) > own)
				return false;
	return true;
}

/* What is within reach of a pixel's error, or of an s that has it. */
static void mark_around(const struct rings *rings, int row, int column)
{
	const struct geometry *geometry = rings->geometry;
	const int reach = REACH + AROUND;

	for (int r = row - reach; r <= row + reach; r++)
		for (int c = column - reach; c <= column + reach; c++)
			if (r >= 0 && r < geometry->rows && c >= 0 && c < geometry->columns)
				rings->changed[(size_t)r * (size_t)geometry->columns + (size_t)c] = 1;
}

static void judge_changed(const struct rings *rings)
{
	const int rows = rings->geometry->rows, columns = rings->geometry->columns;

#pragma omp parallel for schedule(dynamic)
	for (int row = 0; row < rows; row++) {
		for (int column = 0; column < columns; column++) {
			const size_t at = (size_t)row * (size_t)columns + (size_t)column;

			if (rings->changed[at])
				rings->best[at] = judge(rings, row, column);
		}
		pulse_beat();
	}
	memset(rings->changed, 0, (size_t)rows * (size_t)columns);
}

/* Takes the errors that are the largest of their neighbourhood; returns how many. */
static size_t take(const struct rings *rings)
{
	const int rows = rings->geometry->rows, columns = rings->geometry->columns;
	size_t taken = 0;

	for (int row = 0; row < rows; row++)
		for (int column = 0; column < columns; column++) {
			const size_t at = (size_t)row * (size_t)columns + (size_t)column;

			if (rings->best[at] == 0 || !is_largest(rings, row, column) ||
			    is_on_axis(rings->geometry, row, column))
				continue;
			rings->errors[at] += rings->best[at];
			mark_around(rings, row, column);
			taken++;
		}
	return taken;
}

/* True if what the errors leave unexplained around a pixel is small beside its own error, in all directions together.
 */
static bool is_explained(const struct rings *rings, int row, int column)
{
	const struct geometry *geometry = rings->geometry;
	const float own = rings->errors[(size_t)row * (size_t)geometry->columns + (size_t)column];
	float square = 0;
	int count = 0;

	for (int r = row - REACH; r <= row + REACH; r++)
		for (int c = column - REACH; c <= column + REACH; c++)
			for (int d = 0; d < DIRECTIONS; d++) {
				const float rest = r < 0 || r >= geometry->rows || c < 0 || c >= geometry->columns
						       ? NAN
						       : rest_of(rings, d, r, c);

				if (isfinite(rest)) {
					square += rest * rest;
					count++;
				}
			}
	return square <= UNEXPLAINED * UNEXPLAINED * own * own * (float)count;
}

/* Gives errors up that an edge leaves behind which no turn moves, until those that stay explain what is around them. */
static void give_up(const struct rings *rings)
{
	const int rows = rings->geometry->rows, columns = rings->geometry->columns;
	size_t given;

	do {
		given = 0;
		for (int row = 0; row < rows; row++)
			for (int column = 0; column < columns; column++) {
				float *own = &rings->errors[(size_t)row * (size_t)columns + (size_t)column];

				if (*own != 0 && !is_explained(rings, row, column)) {
					*own = 0;
					given++;
				}
			}
		pulse_beat();
	} while (given > 0);
}

static int solve(const struct rings *rings, const struct cancel *cancel, struct error *err)
{
	int code = 0;

	memset(rings->changed, 1, (size_t)rings->geometry->rows * (size_t)rings->geometry->columns);
	for (int pass = 0; pass < PASSES_MOST && code == 0; pass++) {
		code = cancel_check(cancel, err);
		judge_changed(rings);
		if (take(rings) == 0)
			break;
	}
	give_up(rings);
	return code;
}

static struct rings_found sum_up(float *errors, size_t pixels)
{
	struct rings_found found = {0};
	double square = 0;

	for (size_t i = 0; i < pixels; i++) {
		found.pixels += errors[i] != 0;
		square += (double)errors[i] * (double)errors[i];
	}
	if ((double)found.pixels > MANY * (double)pixels) {
		memset(errors, 0, pixels * sizeof(*errors));
		return (struct rings_found){0};
	}
	found.rms = found.pixels > 0 ? sqrt(square / (double)found.pixels) : 0;
	return found;
}

int rings_find(const struct linearise *linearise, const struct geometry *geometry, const struct rings_source *source,
	       const struct cancel *cancel, float *ret_errors, struct rings_found *ret_found, struct error *err)
{
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	struct rings rings = {.linearise = linearise, .geometry = geometry, .errors = ret_errors};
	float *all;
	int code = 0;

	memset(ret_errors, 0, pixels * sizeof(*ret_errors));
	*ret_found = (struct rings_found){0};
	if (geometry->count < RINGS_VIEWS_LEAST || geometry->columns < RINGS_SIDE_LEAST ||
	    geometry->rows < RINGS_SIDE_LEAST)
		return 0;
	all = malloc((DIRECTIONS + 1) * pixels * sizeof(*all));
	rings.changed = malloc(pixels);
	if (all == NULL || rings.changed == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory to look for rings");
	for (int d = 0; d < DIRECTIONS; d++)
		rings.r[d] = all == NULL ? NULL : all + (size_t)d * pixels;
	rings.best = all == NULL ? NULL : all + DIRECTIONS * pixels;
	if (code == 0)
		code = measure(&rings, source, cancel, err);
	if (code == 0)
		code = solve(&rings, cancel, err);
	if (code == 0)
		*ret_found = sum_up(ret_errors, pixels);
	free(rings.changed);
	free(all);
	return code;
}

float *rings_flat(const struct linearise *linearise, const float *errors, size_t pixels)
{
	float *flat = malloc(pixels * sizeof(*flat));

	for (size_t i = 0; i < pixels && flat != NULL; i++) {
		const float dark = linearise_counts(linearise, IMAGE_DARK, i, 0);

		flat[i] = dark + (linearise_counts(linearise, IMAGE_FLAT, i, linearise->air) - dark) * expf(-errors[i]);
	}
	return flat;
}

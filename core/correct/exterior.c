/* The exterior, all matter outside of the grid, is taken out of the projections: see exterior.h. */
#include "core/correct/exterior.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/air.h"
#include "core/truncation.h"
#include "core/correct/exterior_rows.h"
#include "core/correct/exterior_views.h"

/* Rows of a view, and which of their ends say nothing: sides that FDK pads, and those in the shadow of what is dense.
 */
struct ends_known {
	const int *pad;
	const struct metal *dense;
	int view;
};

/* One view on the host, [row][column]: line integrals as measured, through w and through w on the recipe's grid. */
struct projection {
	int steps;
	const struct exterior_rows *seen;
	bool between; /* rows between those of seen count as truncated */
	const struct view *view;
	int columns, rows;
	struct ends_known known;
	const struct faces *faces; /* of w; NULL: FDK is too poor for that */
	float *measured;
	float largest;                   /* truncation_largest of it */
	float air;                       /* air_level of it */
	const float *explained, *inside; /* inside NULL: nothing lies outside of the grid */
	double *smooth;                  /* to work in */
};

/* Ends that the tube alone keeps from 0 are none of a truncated row. */
static bool is_truncated(const struct ends_known *known, int at, const float *row, int columns, float largest,
			 float air)
{
	const float level = truncation_level(largest) + fmaxf(air, 0);
	bool covered[2];

	metal_edges_of(known->dense, known->view, at, columns, covered);
	return (known->pad[0] == 0 && !covered[0] && truncation_is_cut(row, 1, columns, level)) ||
	       (known->pad[1] == 0 && !covered[1] && truncation_is_cut(row + columns - 1, -1, columns, level));
}

/* The columns of a window whose rays are not left out, and sums over them of columns and e. */
struct stretch {
	int first, last;
	double count, columns, squares, sum, moment;
};

/* Takes a column in (share 1) or out again (-1). */
static void stretch_add(struct stretch *stretch, const float *measured, const float *explained, int column, int share)
{
	const double e = (double)measured[column] - (double)explained[column];

	if (isnan(measured[column]))
		return;
	stretch->count += share;
	stretch->columns += share * column;
	stretch->squares += (double)share * column * column;
	stretch->sum += share * e;
	stretch->moment += share * column * e;
}

/* The straight line nearest to e in the window, at a column. */
static double line_at(const struct stretch *stretch, int column)
{
	const double n = fmax(1, stretch->count), middle = stretch->columns / n;
	const double spread = stretch->squares - middle * stretch->columns;
	const double slope = stretch->count > 1 ? (stretch->moment - middle * stretch->sum) / spread : 0;

	return stretch->sum / n + slope * (column - middle);
}

/* Smooths the difference of a measured row and the one that w explains. */
static void smooth_row(const float *measured, const float *explained, double *ret, int columns)
{
	const int reach = columns / EXTERIOR_PART > 2 ? columns / EXTERIOR_PART : 2;
	struct stretch stretch = {.first = 0, .last = -1};

	for (int c = 0; c < columns; c++) {
		for (; stretch.last < columns - 1 && stretch.last < c + reach; stretch.last++)
			stretch_add(&stretch, measured, explained, stretch.last + 1, 1);
		for (; stretch.first < c - reach; stretch.first++)
			stretch_add(&stretch, measured, explained, stretch.first, -1);
		ret[c] = isnan(measured[c]) ? 0 : line_at(&stretch, c);
	}
}

static struct exterior_rows subtract_row(const struct projection *of, int row)
{
	const size_t at = (size_t)row * (size_t)of->columns;
	const float *explained = of->explained + at, *inside = of->inside != NULL ? of->inside + at : NULL;
	float *measured = of->measured + at;
	double *smooth = of->smooth + at, outside = 0;
	struct exterior_rows found = {0};

	if (of->steps & EXTERIOR_BEYOND && of->between && row >= of->seen->first && row <= of->seen->last)
		found.truncated = 1;
	else if (of->steps & EXTERIOR_BEYOND)
		found.truncated = is_truncated(&of->known, row, measured, of->columns, of->largest, of->air);
	if (found.truncated == 0 && of->steps & EXTERIOR_OUTSIDE && of->faces != NULL &&
	    faces_row_counts_outside(of->faces, of->view, of->columns, row, measured, explained, of->largest))
		found.outside = 1;
	if (found.truncated + found.outside > 0) {
		smooth_row(measured, explained, smooth, of->columns);
		for (int c = 0; c < of->columns; c++)
			measured[c] = (float)((double)measured[c] - smooth[c]);
	}
	for (int c = 0; c < of->columns && inside != NULL; c++) {
		outside += fabs((double)explained[c] - (double)inside[c]);
		measured[c] -= explained[c] - inside[c];
	}
	if (outside > 0 && outside >= (double)truncation_level_of_many(of->largest) * of->columns)
		found.outside = 1;
	return found;
}

/* Step 3 of exterior.h. reach: rows to either side; 0 where all of the smooth difference is taken. */
static void hold_view(const struct projection *of, int reach, struct exterior_rows *rows)
{
	const int first = of->seen->first > 0 ? of->seen->first : 0;
	const int last = of->seen->last < of->rows - 1 ? of->seen->last : of->rows - 1;
	const ptrdiff_t columns = of->columns;

#pragma omp parallel for schedule(static)
	for (int r = first; r <= last; r++)
		smooth_row(of->measured + r * columns, of->explained + r * columns, of->smooth + r * columns,
			   of->columns);
#pragma omp parallel for schedule(static)
	for (int r = first; r <= last; r++) {
		const int from = r - reach > first ? r - reach : first, to = r + reach < last ? r + reach : last;

		for (ptrdiff_t c = 0; c < columns; c++) {
			double taken = of->smooth[r * columns + c], sum = 0;

			for (int k = from; k <= to && reach > 0; k++)
				sum += of->smooth[k * columns + c];
			taken -= sum / (to - from + 1);
			of->measured[r * columns + c] = (float)((double)of->measured[r * columns + c] - taken);
		}
	}
	rows->truncated += (size_t)(last - first + 1);
}

static void subtract_view(const struct projection *of, struct exterior_rows *rows)
{
	size_t truncated = 0, outside = 0;

#pragma omp parallel for schedule(static) reduction(+ : truncated, outside)
	for (int r = 0; r < of->rows; r++) {
		const struct exterior_rows found = subtract_row(of, r);

		truncated += found.truncated;
		outside += found.outside;
	}
	rows->truncated += truncated;
	rows->outside += outside;
}

/* The rows of one view. */
static struct exterior_rows look_at_rows(const struct exterior_volume_options *options, int view, const float *measured)
{
	const struct geometry *geometry = options->geometry;
	const int columns = geometry->columns, rows = geometry->rows;
	const float largest = truncation_largest(measured, columns, rows, 1, (size_t)columns);
	const float air = air_level(measured, columns, rows, truncation_edge(columns), largest, NULL);
	const struct outside_rows outside =
	    outside_rows(options->grid, &geometry->views[view], columns, rows, measured);
	const struct ends_known known = {options->orbit->pad, options->dense, view};
	struct exterior_rows found = {.beside = outside.beside,
				      .outside = outside.beside + outside.ends,
				      .certain = outside.certain,
				      .first = rows,
				      .last = -1};

	for (int r = 0; r < rows; r++)
		if (is_truncated(&known, r, measured + (size_t)r * (size_t)columns, columns, largest, air)) {
			found.truncated++;
			found.first = r < found.first ? r : found.first;
			found.last = r;
		}
	return found;
}

/* A place on the field of view's rim moves over so many of a detector's rows while the arm turns. */
static int rows_around(const struct orbit *orbit, int rows)
{
	return (int)ceil(orbit->field_of_view / 2 / orbit->source_radius * rows / 2);
}

int exterior_look(const struct exterior_volume_options *options, struct exterior_rows *ret_rows, struct error *err)
{
	const int all = options->geometry->rows, around = rows_around(options->orbit, all);
	size_t truncated = 0, outside = 0, beside = 0, certain = 0;
	int first = all, last = -1;
	struct exterior_rows found;
	struct exterior_views views;
	int code = exterior_views_open(&views, options, err);

	if (code < 0)
		return code;
	while (exterior_views_next(&views, &code, err)) {
#pragma omp parallel for schedule(static) reduction(+ : truncated, outside, beside, certain) reduction(min : first)                     \
    reduction(max : last)
		for (int i = 0; i < views.here; i++) {
			const struct exterior_rows rows = look_at_rows(options, exterior_views_index(&views, i),
								       views.images + (size_t)i * views.pixels);

			truncated += rows.truncated;
			outside += rows.outside;
			beside += rows.beside;
			certain += rows.certain;
			first = rows.first < first ? rows.first : first;
			last = rows.last > last ? rows.last : last;
		}
	}
	exterior_views_close(&views);
	found = (struct exterior_rows){.truncated = truncated,
				       .outside = outside,
				       .beside = beside,
				       .certain = certain,
				       .first = first - (last >= 0 ? around : 0),
				       .last = last + (last >= 0 ? around : 0),
				       .to_ends = first == 0 && last == all - 1};
	if (code == 0 && found.outside == 0)
		code = exterior_volume_may_go_on(options, &found.possible, err);
	if (code == 0)
		*ret_rows = found;
	return code;
}

/* Views first .. first + count - 1 through the volume, to the host. */
static int project(const struct exterior_volume_options *options, struct plan *plan, const struct volume *volume,
		   int first, int count, struct stack *batch, float *ret, struct error *err)
{
	int views[EXTERIOR_VOLUME_VIEWS], code;

	for (int i = 0; i < count; i++)
		views[i] = first + i;
	code = options->backend->project(plan, volume, views, count, batch, err);
	return code < 0 ? code : options->backend->stack_download(batch, 0, count, ret, err);
}

int exterior_subtract(const struct exterior_volume *exterior, const struct exterior_volume_options *options, int steps,
		      const struct exterior_rows *seen, struct volume *work, struct exterior_rows *ret_rows,
		      struct error *err)
{
	const struct backend *backend = options->backend;
	const struct geometry *geometry = options->geometry;
	const int all = geometry->count, slots = all < EXTERIOR_VOLUME_VIEWS ? all : EXTERIOR_VOLUME_VIEWS;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows, most = (size_t)slots * pixels;
	float *measured = malloc(most * sizeof(float)), *explained = malloc(most * sizeof(float)), *inside = NULL;
	double *smooth = malloc(pixels * sizeof(double));
	struct exterior_rows found = {0};
	struct faces faces = {0};
	struct stack *batch = NULL;
	const bool within = (steps & EXTERIOR_WITHIN) != 0;
	bool enough = measured != NULL && explained != NULL && smooth != NULL;
	int code = 0;

	if (exterior->goes_on && steps & EXTERIOR_OUTSIDE) {
		inside = malloc(most * sizeof(float));
		enough = enough && inside != NULL;
	}
	if (!enough)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views of %d x %d pixels", slots,
				 geometry->columns, geometry->rows);
	if (code == 0 && !within)
		code = faces_make(&faces, backend, exterior->volume, &exterior->grid, err);
	/* Beside truncated rows w's slices are finer by far, and FDK's means are held to in the end. */
	if (code == 0 && inside != NULL)
		code = options->fine_slices ? exterior_volume_sample(exterior, options->grid, work, err)
					    : exterior_volume_means(exterior, options->grid, work, err);
	if (code == 0)
		code = backend->stack_new(options->device, geometry->columns, geometry->rows, slots, &batch, err);
	/* Several at a time: a pass over the volume costs as much as some views do. */
	for (int first = 0; first < all && code == 0; first += slots) {
		const int count = all - first < slots ? all - first : slots;

		code = project(options, within ? options->plan : exterior->plan, within ? work : exterior->volume,
			       first, count, batch, explained, err);
		if (code == 0 && inside != NULL)
			code = project(options, options->plan, work, first, count, batch, inside, err);
		if (code == 0)
			code = backend->stack_download(options->projections, first, count, measured, err);
		for (int i = 0; i < count && code == 0; i++) {
			const size_t at = (size_t)i * pixels;
			const float largest = truncation_largest(measured + at, geometry->columns, geometry->rows, 1,
								 (size_t)geometry->columns);
			const struct projection projection = {
			    .steps = steps,
			    .seen = seen,
			    .between = options->truncated,
			    .view = &geometry->views[first + i],
			    .columns = geometry->columns,
			    .rows = geometry->rows,
			    .known = {options->orbit->pad, options->dense, first + i},
			    .faces = options->poor || within ? NULL : &faces,
			    .measured = measured + at,
			    .largest = largest,
			    .air = air_level(measured + at, geometry->columns, geometry->rows,
					     truncation_edge(geometry->columns), largest, NULL),
			    .explained = explained + at,
			    .inside = inside != NULL ? inside + at : NULL,
			    .smooth = smooth,
			};

			if (within)
				hold_view(&projection, exterior->reach, &found);
			else
				subtract_view(&projection, &found);
		}
		if (code == 0)
			code = backend->stack_upload(options->projections, first, count, measured, err);
	}
	if (code == 0)
		*ret_rows = found;
	backend->stack_free(batch);
	faces_clear(&faces);
	free(measured);
	free(explained);
	free(inside);
	free(smooth);
	return code;
}

/* Blends w into the values by the share, 1 - seen, that not all views see. */
static void mix(const float *seen, const float *w, float *values, size_t count)
{
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < count; i++)
		values[i] += (1 - seen[i]) * (w[i] - values[i]);
}

int exterior_start(const struct exterior_volume *exterior, const struct exterior_volume_options *options,
		   struct volume *work, struct volume *volume, struct error *err)
{
	const struct backend *backend = options->backend;
	const struct grid *grid = options->grid;
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];
	float *seen = malloc(pixels * sizeof(float)), *w = malloc(pixels * sizeof(float));
	float *values = malloc(pixels * sizeof(float));
	int code = 0;

	if (seen == NULL || w == NULL || values == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for three slices");
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		if (options->poor)
			memset(seen, 0, pixels * sizeof(float));
		else if (exterior_volume_seen(exterior, grid, z, seen))
			continue;
		code = backend->volume_download(work, z, 1, w, err);
		if (code == 0)
			code = backend->volume_download(volume, z, 1, values, err);
		if (code == 0) {
			mix(seen, w, values, pixels);
			code = backend->volume_put(volume, z, 1, values, err);
		}
	}
	free(seen);
	free(w);
	free(values);
	return code;
}

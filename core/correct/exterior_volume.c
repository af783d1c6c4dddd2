/* The object in and around the recipe's grid, coarsely: see exterior.h. */
#include "core/correct/exterior_volume.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/coarse.h"
#include "core/correct/exterior_views.h"
#include "core/truncation.h"

/* The centre of a voxel, mm. */
struct place {
	double at[3];
};

static struct place place_of(const struct grid *grid, int x, int y, int z)
{
	return (struct place){{grid->origin[0] + x * grid->spacing[0], grid->origin[1] + y * grid->spacing[1],
			       grid->origin[2] + z * grid->spacing[2]}};
}

static struct plan_options plan_options_of(const struct exterior_volume_options *options, const struct grid *grid,
					   const struct fdk_weights *weights)
{
	struct plan_options plan = {
	    .geometry = options->geometry,
	    .grid = grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = weights->columns,
	    .filter_response = weights->response,
	    .pad = {options->orbit->pad[0], options->orbit->pad[1]},
	    .extend = weights->extend,
	    .extended_response = weights->extended,
	    .axis = weights->axis,
	    .resident = 1, /* what is filtered in one go takes the most room, and the volume is small */
	    .lender = options->plan,
	    .no_samples = true,
	};

	return plan;
}

static struct coarse_options coarse_options_of(const struct exterior_volume_options *options, const struct grid *grid)
{
	return (struct coarse_options){
	    .backend = options->backend,
	    .device = options->device,
	    .geometry = options->geometry,
	    .orbit = options->orbit,
	    .blank = options->blank,
	    .blanks = options->blanks,
	    .grid = grid,
	    .from_zero = options->poor,
	    .lender = options->plan,
	    .dense = options->dense,
	    .cancel = options->cancel,
	};
}

static size_t larger(size_t a, size_t b)
{
	return a > b ? a : b;
}

/* Memory of a job that turns out to be inside_only or truncated, or not, as the options say. */
static int bytes_of(const struct exterior_volume_options *options, struct exterior_volume_bytes *ret_bytes,
		    struct error *err)
{
	const struct backend *backend = options->backend;
	const struct geometry *geometry = options->geometry;
	const int *pad = options->orbit->pad, wide = pad[0] + geometry->columns + pad[1];
	const int slots = geometry->count < EXTERIOR_VOLUME_VIEWS ? geometry->count : EXTERIOR_VOLUME_VIEWS;
	float some = 0; /* stands for the weights: only whether there are any is asked here */
	const struct fdk_weights weights = {
	    .columns = &some, .response = &some, .extended = &some, .extend = geometry->columns};
	struct coarse_options coarse_options;
	struct coarse_bytes coarse = {0};
	struct grid grid;
	struct plan_options plan;
	struct plan_bytes bytes;
	size_t own;
	int code;

	exterior_volume_grid(options, &grid);
	plan = plan_options_of(options, &grid, &weights);
	coarse_options = coarse_options_of(options, &grid);
	code = backend->plan_bytes(options->device, &plan, &bytes, err);
	if (code == 0 && !options->inside_only)
		code = coarse_bytes(&coarse_options, &coarse, err);
	if (code < 0)
		return code;
	own = bytes.volumes + bytes.scratch - bytes.block + bytes.raw;
	ret_bytes->borrowed = larger(bytes.block, coarse.borrowed);
	ret_bytes->host = 0;
	/* Filtered views; when those are gone, the coarse SART; when that has ended, projected views. */
	ret_bytes->device =
	    own + larger(backend->stack_bytes(options->device, wide, geometry->rows, slots), coarse.device);
	/* Out of core, the device is free again after each operation, and the host holds the volume. */
	if (bytes.host > 0) {
		ret_bytes->device = larger(own, coarse.device);
		ret_bytes->host = grid_voxels(&grid) * sizeof(float) + coarse.host;
	}
	return 0;
}

int exterior_volume_bytes(const struct exterior_volume_options *options, struct exterior_volume_bytes *ret_bytes,
			  struct error *err)
{
	enum { OTHERS, INSIDE_ONLY, TRUNCATED, KINDS };
	struct exterior_volume_bytes most = {0};
	int code = 0;

	for (int kind = 0; kind < KINDS && code == 0; kind++) {
		struct exterior_volume_options one = *options;
		struct exterior_volume_bytes bytes;

		one.inside_only = kind == INSIDE_ONLY;
		one.truncated = kind == TRUNCATED;
		one.fine_slices = kind != OTHERS;
		code = bytes_of(&one, &bytes, err);
		if (code < 0)
			break;
		most = (struct exterior_volume_bytes){
		    .device = larger(most.device, bytes.device),
		    .borrowed = larger(most.borrowed, bytes.borrowed),
		    .host = larger(most.host, bytes.host),
		};
	}
	if (code == 0)
		*ret_bytes = most;
	return code;
}

/* ---- what FDK cannot know ---- */

/* Columns whose sums run down the rows together: their floats lie side by side. */
enum { COLUMNS_TOGETHER = 32, ROWS_TOGETHER = 8 };

/* Sums along `count` rows, side by side: each sum waits for the one before it. */
static void sum_along_rows(const float *from, float *ret, int count, int columns, int reach)
{
	double sums[ROWS_TOGETHER] = {0};

	for (int c = -reach; c < columns; c++)
		for (int r = 0; r < count; r++) {
			const size_t at = (size_t)r * (size_t)columns;

			if (c + reach < columns)
				sums[r] += (double)from[at + (size_t)(c + reach)];
			if (c - reach - 1 >= 0)
				sums[r] -= (double)from[at + (size_t)(c - reach - 1)];
			if (c >= 0)
				ret[at + (size_t)c] = (float)sums[r];
		}
}

/* Sums along the columns first .. first + count - 1. */
static void sum_along_columns(const float *from, float *ret, int columns, int rows, int first, int count, int reach)
{
	double sums[COLUMNS_TOGETHER] = {0};

	for (int r = -reach; r < rows; r++) {
		const float *enters = from + (size_t)(r + reach) * (size_t)columns + first;
		const float *leaves = from + (ptrdiff_t)(r - reach - 1) * columns + first;

		for (int c = 0; c < count && r + reach < rows; c++)
			sums[c] += (double)enters[c];
		for (int c = 0; c < count && r - reach - 1 >= 0; c++)
			sums[c] -= (double)leaves[c];
		for (int c = 0; c < count && r >= 0; c++)
			ret[(size_t)r * (size_t)columns + (size_t)(first + c)] = (float)sums[c];
	}
}

/* Sums over the pixels up to `reach` away along both axes, in place; `work` is another image. */
static void box_sums(float *image, int columns, int rows, int reach, float *work)
{
	for (int r = 0; r < rows; r += ROWS_TOGETHER)
		sum_along_rows(image + (size_t)r * (size_t)columns, work + (size_t)r * (size_t)columns,
			       rows - r < ROWS_TOGETHER ? rows - r : ROWS_TOGETHER, columns, reach);
	for (int c = 0; c < columns; c += COLUMNS_TOGETHER)
		sum_along_columns(work, image, columns, rows, c,
				  columns - c < COLUMNS_TOGETHER ? columns - c : COLUMNS_TOGETHER, reach);
}

/* Findings of the views in each voxel. */
struct look {
	bool *seen;  /* on the rows of all views; as of struct exterior_volume; NULL: not asked for */
	bool *met;   /* on the detector of one; NULL: not asked for */
	bool *empty; /* some view sees it through air; owned */
};

/* A view as voxels are held against it. */
struct shadow {
	double matrix[12];
	int columns, rows;
	const float *matter; /* [row][column]: 0 where all around is air; NULL: the view is blank */
};

/* True if a line of voxels along x lies beyond the rows as a whole: its row changes one way along it. */
static bool misses_rows(const struct shadow *shadow, const struct grid *grid, int y, int z)
{
	double column, row[2];

	for (int end = 0; end < 2; end++)
		view_project(shadow->matrix, place_of(grid, end ? grid->size[0] - 1 : 0, y, z).at, &column, &row[end]);
	return (row[0] < 1 && row[1] < 1) || (row[0] > shadow->rows - 2 && row[1] > shadow->rows - 2);
}

/* The next voxel of the line from x on that the view can say more of; the line's end where there is none. */
static int next_of_line(const struct look *look, const struct grid *grid, size_t line, int x)
{
	const bool *found = look->empty + line + x;

	if (look->seen == NULL)
		found = memchr(found, false, (size_t)(grid->size[0] - x));
	return found != NULL ? (int)(found - (look->empty + line)) : grid->size[0];
}

static void look_along(const struct look *look, const struct grid *grid, const struct shadow *shadow, int y, int z)
{
	const int columns = shadow->columns, rows = shadow->rows;
	/* From the middle of the outermost row outwards FDK has ever less of a view, unless there is no other row. */
	const double beyond = rows > 1 ? 0 : 0.5;
	const size_t line = grid_voxel(grid, 0, y, z);

	if (look->seen == NULL && misses_rows(shadow, grid, y, z))
		return;
	for (int x = next_of_line(look, grid, line, 0); x < grid->size[0]; x = next_of_line(look, grid, line, x + 1)) {
		const struct place place = place_of(grid, x, y, z);
		const size_t at = line + (size_t)x;
		double column, row;

		if (look->seen != NULL && look->empty[at] && !look->seen[at])
			continue; /* the view can say no more of it */
		view_project(shadow->matrix, place.at, &column, &row);
		if (look->seen != NULL && (row < -beyond || row > rows - 1 + beyond))
			look->seen[at] = false;
		if (!(column >= 1 && row >= 1 && column <= columns - 2 && row <= rows - 2))
			continue;
		if (look->met != NULL)
			look->met[at] = true;
		/* Halves are rounded up: of what is 1 or more, the same pixel as lround's, without a call. */
		if (!look->empty[at] &&
		    shadow->matter[(size_t)(row + 0.5) * (size_t)columns + (size_t)(column + 0.5)] < 0.5f)
			look->empty[at] = true;
	}
}

static bool is_blank(const float *measured, size_t pixels)
{
	for (size_t i = 0; i < pixels; i++)
		if (measured[i] != 0)
			return false;
	return true;
}

static bool is_inside(const struct grid *grid, const double place[3])
{
	for (int i = 0; i < 3; i++)
		if (fabs((place[i] - grid->origin[i]) / grid->spacing[i] - 0.5 * (grid->size[i] - 1)) >
		    0.5 * grid->size[i])
			return false;
	return true;
}

/* Outwards from the middle: what not all views see becomes what is next to it, but for what is empty. */
static void hold_ends(struct exterior_volume *s, const bool *empty)
{
	const int *size = s->grid.size;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < size[1]; y++)
		for (int end = 0; end < 2; end++)
			for (int i = size[2] / 2; i < size[2]; i++)
				for (int x = 0; x < size[0]; x++) {
					const int z = end ? i : size[2] - 1 - i, inner = end ? z - 1 : z + 1;
					const size_t at = grid_voxel(&s->grid, x, y, z);

					if (s->seen[at] || inner < 0 || inner >= size[2])
						continue;
					s->voxels[at] = empty[at] ? 0 : s->voxels[grid_voxel(&s->grid, x, y, inner)];
				}
}

/* Keeps those voxels of the FDK volume that are known, on the host, blank views made up for. */
static void keep_what_is_known(struct exterior_volume *s, const struct exterior_volume_options *options,
			       const bool *empty)
{
	size_t kept = 0;

	if (!options->inside_only)
		hold_ends(s, empty);
	if (options->truncated)
		exterior_volume_hold_rim(s, options->orbit, empty);
#pragma omp parallel for schedule(static) reduction(+ : kept)
	for (int z = 0; z < s->grid.size[2]; z++)
		for (int y = 0; y < s->grid.size[1]; y++)
			for (int x = 0; x < s->grid.size[0]; x++) {
				const size_t at = grid_voxel(&s->grid, x, y, z);
				const struct place place = place_of(&s->grid, x, y, z);
				const bool inside = is_inside(options->grid, place.at);

				if (!inside &&
				    (empty[at] || !(options->truncated || orbit_is_in_view(options->orbit, place.at))))
					s->voxels[at] = 0;
				s->voxels[at] *= (float)options->factor;
				kept += !inside && s->voxels[at] != 0;
			}
	s->goes_on = kept > 0;
	if (options->poor && !options->inside_only) {
		memset(s->voxels, 0, grid_voxels(&s->grid) * sizeof(float));
		s->goes_on = true;
	}
}

/* `measured` becomes where the object is with what lies up to a voxel and a half around it; `work` is another image. */
static struct shadow shadow_make(const struct exterior_volume_options *options, const struct grid *grid, int view,
				 float *measured, float *work)
{
	const struct geometry *geometry = options->geometry;
	const int columns = geometry->columns, rows = geometry->rows;
	const size_t pixels = (size_t)columns * (size_t)rows;
	const double size = fmax(fmax(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	const double pixel = fmin(options->orbit->pixel_at_isocentre[0], options->orbit->pixel_at_isocentre[1]);
	const int reach = (int)fmin(ceil(1.5 * size / pixel), columns > rows ? columns : rows);
	const float level = truncation_level_of_many(truncation_largest(measured, columns, rows, 1, (size_t)columns));
	struct shadow shadow = {.columns = columns, .rows = rows};

	if (is_blank(measured, pixels))
		return shadow;
	view_matrix(&geometry->views[view], shadow.matrix);
	/* Means of nine pixels against noise. */
	box_sums(measured, columns, rows, 1, work);
	for (size_t i = 0; i < pixels; i++)
		measured[i] = measured[i] > 0 && measured[i] >= 9 * level;
	box_sums(measured, columns, rows, reach, work);
	shadow.matter = measured;
	return shadow;
}

/* Voxels whose shadow in any view is air are empty, those whose shadow misses the rows of one are not seen. */
static int look_at_views(const struct look *look, const struct grid *grid,
			 const struct exterior_volume_options *options, struct error *err)
{
	struct exterior_views views;
	struct shadow *shadows = NULL;
	float *work = NULL;
	int code = exterior_views_open(&views, options, err);

	if (code < 0)
		return code;
	shadows = malloc((size_t)views.together * sizeof(*shadows));
	work = malloc((size_t)views.together * views.pixels * sizeof(*work));
	if (shadows == NULL || work == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the shadows of %d views", views.together);
	while (code == 0 && exterior_views_next(&views, &code, err)) {
#pragma omp parallel
		{
#pragma omp for schedule(static)
			for (int i = 0; i < views.here; i++)
				shadows[i] = shadow_make(options, grid, exterior_views_index(&views, i),
							 views.images + (size_t)i * views.pixels,
							 work + (size_t)i * views.pixels);
#pragma omp for collapse(2) schedule(dynamic, 16)
			for (int z = 0; z < grid->size[2]; z++)
				for (int y = 0; y < grid->size[1]; y++)
					for (int i = 0; i < views.here; i++)
						if (shadows[i].matter != NULL)
							look_along(look, grid, &shadows[i], y, z);
		}
	}
	exterior_views_close(&views);
	free(shadows);
	free(work);
	return code;
}

/* Voxels that are not asked for are empty from the beginning. */
static void leave_inside_away(const struct exterior_volume_options *options, const struct grid *grid, bool *ret_empty)
{
#pragma omp parallel for schedule(static)
	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				const struct place place = place_of(grid, x, y, z);

				ret_empty[grid_voxel(grid, x, y, z)] =
				    is_inside(options->grid, place.at) || !orbit_is_in_view(options->orbit, place.at);
			}
}

int exterior_volume_may_go_on(const struct exterior_volume_options *options, bool *ret_possible, struct error *err)
{
	struct look look = {0};
	struct grid grid;
	size_t possible = 0;
	int code;

	exterior_volume_grid(options, &grid);
	look.met = calloc(grid_voxels(&grid), sizeof(bool));
	look.empty = malloc(grid_voxels(&grid) * sizeof(bool));
	if (look.met == NULL || look.empty == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", grid_voxels(&grid));
	} else {
		leave_inside_away(options, &grid, look.empty);
		code = look_at_views(&look, &grid, options, err);
	}
	for (size_t i = 0; i < grid_voxels(&grid) && code == 0; i++)
		possible += look.met[i] && !look.empty[i];
	free(look.met);
	free(look.empty);
	if (code == 0)
		*ret_possible = possible > 0;
	return code;
}

/* ---- making ---- */

static int run_fdk(struct exterior_volume *s, const struct exterior_volume_options *options, struct error *err)
{
	struct fdk fdk = {0};
	int code = fdk_open(&fdk, s->backend, options->device, s->plan, options->geometry, s->weights.pad, err);

	for (int view = 0; view < options->geometry->count && code == 0; view++) {
		code = cancel_check(options->cancel, err);
		if (code == 0)
			code = fdk_add(&fdk, view, view, options->projections, s->volume, err);
	}
	if (code == 0)
		code = fdk_flush(&fdk, options->projections, s->volume, err);
	fdk_clear(&fdk);
	return code;
}

int exterior_volume_make(struct exterior_volume *s, const struct exterior_volume_options *options, struct error *err)
{
	const struct backend *backend = options->backend;
	const struct orbit *orbit = options->orbit;
	struct plan_options plan;
	struct look look;
	int code;

	*s = (struct exterior_volume){.backend = backend};
	exterior_volume_grid(options, &s->grid);
	/* The filter is as sharp as the voxels can hold: an exterior smeared over the grid's faces would be missed
	 * inside. */
	code = fdk_weights_make(&s->weights, orbit, options->geometry, WINDOW_RAM_LAK,
				fmin(1, orbit->pixel_at_isocentre[0] / fmax(s->grid.spacing[0], s->grid.spacing[1])),
				true, err);
	if (code < 0)
		return code;
	s->voxels = malloc(grid_voxels(&s->grid) * sizeof(float));
	s->seen = malloc(grid_voxels(&s->grid) * sizeof(bool));
	look = (struct look){.seen = s->seen, .empty = calloc(grid_voxels(&s->grid), sizeof(bool))};
	if (s->voxels == NULL || s->seen == NULL || look.empty == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", grid_voxels(&s->grid));
	else
		memset(s->seen, true, grid_voxels(&s->grid) * sizeof(bool));
	plan = plan_options_of(options, &s->grid, &s->weights);
	if (code == 0)
		code = backend->plan_new(options->device, &plan, &s->plan, err);
	if (code == 0)
		code = backend->volume_new(options->device, &s->grid, &s->volume, err);
	if (code == 0)
		code = backend->volume_fill(s->volume, 0, err);
	if (code == 0)
		code = run_fdk(s, options, err);
	if (code == 0)
		code = backend->filter_extended(s->plan, s->truncated, err);
	if (code == 0)
		code = backend->volume_download(s->volume, 0, s->grid.size[2], s->voxels, err);
	if (code == 0)
		code = look_at_views(&look, &s->grid, options, err);
	if (code == 0) {
		keep_what_is_known(s, options, look.empty);
		code = backend->volume_upload(s->volume, s->voxels, err);
	}
	free(look.empty);
	if (code < 0)
		exterior_volume_clear(s);
	return code;
}

int exterior_volume_fit(struct exterior_volume *s, const struct exterior_volume_options *options, struct error *err)
{
	const struct coarse_options coarse = coarse_options_of(options, &s->grid);
	int code = coarse_sart(&coarse, options->projections, s->volume, err);

	return code < 0 ? code : s->backend->volume_download(s->volume, 0, s->grid.size[2], s->voxels, err);
}

/* The axis along which a place lies beyond the grid's faces, the farthest where there are more; -1: it lies inside. */
static int axis_outside(const struct grid *grid, const double place[3])
{
	double farthest = 0;
	int axis = -1;

	for (int i = 0; i < 3; i++) {
		const double beyond = fabs(place[i] - grid->origin[i] - 0.5 * (grid->size[i] - 1) * grid->spacing[i]) -
				      0.5 * grid->size[i] * grid->spacing[i];

		if (beyond > farthest) {
			farthest = beyond;
			axis = i;
		}
	}
	return axis;
}

/* Mean of the 3 x 3 voxels around one, across an axis: a body that goes on beyond a face has neighbours there, noise
 * has none. */
static double mean_across(const struct exterior_volume *s, const int at[3], int axis)
{
	const int a = (axis + 1) % 3, b = (axis + 2) % 3, *size = s->grid.size;
	double sum = 0;

	for (int i = -1; i <= 1; i++)
		for (int j = -1; j <= 1; j++) {
			int near[3] = {at[0], at[1], at[2]};

			near[a] = (int)fmin(fmax(at[a] + i, 0), size[a] - 1);
			near[b] = (int)fmin(fmax(at[b] + j, 0), size[b] - 1);
			sum += (double)s->voxels[grid_voxel(&s->grid, near[0], near[1], near[2])];
		}
	return sum / 9;
}

bool exterior_volume_has_outside(const struct exterior_volume *s, const struct grid *grid)
{
	/* Share of the object's density: 0.15 where a cylinder ends with the grid, 0.27 where it ends 0.4 mm beyond,
	 * then more. */
	const double density = 0.25;
	const size_t least = 9; /* voxels, those of one mean: noise makes next to none, small things have few */
	double squares = 0, sum = 0;
	size_t count = 0;

	for (size_t i = 0; i < grid_voxels(&s->grid); i++) {
		squares += (double)s->voxels[i] * (double)s->voxels[i];
		sum += fabs((double)s->voxels[i]);
	}
	for (int z = 0; z < s->grid.size[2]; z++)
		for (int y = 0; y < s->grid.size[1]; y++)
			for (int x = 0; x < s->grid.size[0]; x++) {
				const struct place place = place_of(&s->grid, x, y, z);
				const int axis = axis_outside(grid, place.at), at[3] = {x, y, z};

				count += axis >= 0 && mean_across(s, at, axis) * sum >= density * squares;
			}
	return squares > 0 && count >= least;
}

void exterior_volume_leave_device(struct exterior_volume *s)
{
	s->backend->volume_free(s->volume);
	s->backend->plan_free(s->plan);
	fdk_weights_clear(&s->weights);
	free(s->seen);
	s->volume = NULL;
	s->plan = NULL;
	s->seen = NULL;
}

void exterior_volume_clear(struct exterior_volume *s)
{
	if (s->backend == NULL)
		return;
	exterior_volume_leave_device(s);
	free(s->voxels);
	free(s->within);
	*s = (struct exterior_volume){0};
}

/*
 * The plan: which kernels a geometry and a grid allow, what memory they take,
 * and the views in the form that the kernels read.
 */
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "kernels/internal.cuh"

/* ---- which kernels ---- */

enum { LAYERS_MOST = 2048 };                      /* of a layered array, on every card */
enum { SIDE_MOST = 32768 };                       /* its width and height */
enum { BATCH_LEAN = 16 };                         /* of BATCH_MOST, with little memory */
static const double SMALL = 1 << 20;              /* voxels times views below which launches take longer than samples */
static const size_t RAW_BYTES = (size_t)16 << 20; /* of the buffer of raw samples, */
enum { RAW_PART = 16 };                           /* and of all views at most the 16th part */
static const int WARPS_ENOUGH = 16384;            /* of rays through the grid, to fill the card without cutting them */

static int at_most(int count, int most)
{
	return count < most ? count : most;
}

static size_t at_least(size_t bytes, size_t least)
{
	return bytes > least ? bytes : least;
}

/* Columns of a filtered projection. */
static int wide_columns(const struct plan_options *options)
{
	return options->pad[0] + options->geometry->columns + options->pad[1];
}

/* Projections that are on the device at a time. */
static int resident_views(const struct plan_options *options)
{
	int count = options->geometry->count;

	return options->resident > 0 && options->resident < count ? options->resident : count;
}

/* The corner of the box, half a voxel beyond the outer centres or on them, mm. */
static void corner_of(const struct grid *grid, int corner, double beyond, double ret[3])
{
	for (int i = 0; i < 3; i++)
		ret[i] = grid->origin[i] + grid->spacing[i] * (corner >> i & 1 ? grid->size[i] - 1 + beyond : -beyond);
}

/* Every view sees the whole grid: all corners fall well inside of the detector, so all voxels do. */
static bool is_covered(const struct geometry *geometry, const struct grid *grid)
{
	const double margin = 1e-2; /* pixels, above what float32 may err */

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12], point[3], column, row;

		view_matrix(&geometry->views[k], matrix);
		for (int corner = 0; corner < 8; corner++) {
			corner_of(grid, corner, 0, point);
			if (!(view_project(matrix, point, &column, &row) > 0) || column < margin || row < margin ||
			    column > geometry->columns - 1 - margin || row > geometry->rows - 1 - margin)
				return false;
		}
	}
	return true;
}

bool cuda_sart_covered(const struct plan_options *options)
{
	return !options->matched && is_covered(options->geometry, options->grid);
}

/*
 * Some ray runs closer to z than to x and y. A raster of pixels is looked at; the
 * margin covers the rays in between, as long as a view is less than 60 degrees wide.
 */
static bool has_z_rays(const struct geometry *geometry, const struct grid *grid)
{
	const int steps = 16;
	const double margin = 0.9;

	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];

		for (int i = 0; i <= steps * (steps + 2); i++) {
			double c = (geometry->columns - 1.0) * (i % (steps + 1)) / steps, d[3];
			double r = (geometry->rows - 1.0) * (i / (steps + 1)) / steps;

			for (int a = 0; a < 3; a++)
				d[a] = fabs(view->pixel0[a] - view->source[a] + c * view->column_step[a] +
					    r * view->row_step[a]) /
				       grid->spacing[a];
			if (d[2] >= margin * fmax(d[0], d[1]))
				return true;
		}
	}
	return false;
}

/* The rows' step aside for a step along z; the most of it that the projection by rows allows. */
static double lean_of(const struct view *view)
{
	return hypot(view->row_step[0], view->row_step[1]) / fabs(view->row_step[2]);
}
static const double LEAN_MOST = 0.02;

/* Columns that neighbours along z are aside of each other on the detector, for each row that they are apart; about. */
static double columns_aside(const struct geometry *geometry)
{
	double most = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];

		most = fmax(most, 1.5 * lean_of(view) * vec_norm(view->row_step) / vec_norm(view->column_step));
	}
	return most;
}
/* Rows that a thread of the backprojection by rows reaches from its middle, at most. */
enum { BACK_ROWS_MOST = 24 };

/*
 * Smallest and largest distance, in voxels along z, of the rays of neighbouring
 * rows where they cross the grid: the magnification varies with the depth, which is
 * extreme at corners, and with the rise of the rays where rows lean.
 */
static void row_spacing(const struct geometry *geometry, const struct grid *grid, double *ret_least, double *ret_most,
			int *ret_sign)
{
	double least = INFINITY, most = 0;
	int up = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];
		double matrix[12], point[3], column, row, near = INFINITY, far = 0, lean = 0;

		view_matrix(view, matrix);
		for (int corner = 0; corner < 4; corner++) {
			double c = corner & 1 ? geometry->columns - 1 : 0, r = corner & 2 ? geometry->rows - 1 : 0,
			       rise;
			double depth;

			for (int i = 0; i < 3; i++)
				point[i] = view->pixel0[i] + c * view->column_step[i] + r * view->row_step[i];
			depth = view_project(matrix, point, &column, &row);
			near = fmin(near, depth);
			far = fmax(far, depth);
			rise = fabs(point[2] - view->source[2]) /
			       hypot(point[0] - view->source[0], point[1] - view->source[1]);
			lean = fmax(lean, 1.5 * rise * lean_of(view));
		}
		up += view->row_step[2] > 0 ? 1 : -1;
		for (int corner = 0; corner < 4; corner++) {
			double depth, step = fabs(view->row_step[2]) / grid->spacing[2];

			corner_of(grid, corner, 0.5, point);
			depth = view_project(matrix, point, &column, &row);
			least = fmin(least, depth / far * step * (1 - lean));
			most = fmax(most, depth / near * step * (1 + lean));
		}
	}
	*ret_least = least;
	*ret_most = most;
	*ret_sign = abs(up) == geometry->count ? (up > 0 ? 1 : -1) : 0;
}

/* Choices stand in the order of preference: the more neighbours for a common value, the better. */
struct neighbours_choice {
	enum neighbours kind;
	int count;
};
static const neighbours_choice forward_neighbours[] = {
    {NEIGHBOURS_TWOS, 6}, {NEIGHBOURS_THIRDS, 6}, {NEIGHBOURS_EVEN, 6}, {NEIGHBOURS_EVEN, 5}, {NEIGHBOURS_NARROW, 6},
    {NEIGHBOURS_EVEN, 4}, {NEIGHBOURS_CLOSE, 4},  {NEIGHBOURS_EVEN, 3}, {NEIGHBOURS_EVEN, 0}};
static const neighbours_choice back_neighbours[] = {{NEIGHBOURS_TWOS, 5},   {NEIGHBOURS_EVEN, 6}, {NEIGHBOURS_EVEN, 5},
						    {NEIGHBOURS_NARROW, 5}, {NEIGHBOURS_WIDE, 5}, {NEIGHBOURS_EVEN, 4},
						    {NEIGHBOURS_WIDE, 4},   {NEIGHBOURS_EVEN, 3}, {NEIGHBOURS_EVEN, 0}};

/*
 * True if all neighbours find their values at this spacing: as the kernels place them, each lies
 * 0 .. 1 above the first of its own, and the lowest is up to one value above that.
 */
static bool neighbours_hold(neighbours_choice choice, double spacing)
{
	const double margin = 1e-4; /* float32 */
	double e = spacing - neighbours_spacing(choice.kind),
	       lowest = neighbours_lowest(choice.kind, choice.count, (float)e);

	for (int k = 0; k < choice.count; k++) {
		double above = k * e + neighbours_offset(choice.kind, k) - lowest;

		if (above < -margin || above > 1 - margin)
			return false;
	}
	return true;
}

/* The spread of the neighbours' places is a convex function of the spacing: what holds at both ends, holds between. */
static neighbours_choice choose_neighbours(const neighbours_choice *choices, double least, double most)
{
	while (choices->count > 0 && !(neighbours_hold(*choices, least) && neighbours_hold(*choices, most)))
		choices++;
	return *choices;
}

/*
 * geometry_is_untilted speaks of the rays to the detector; a backprojection's
 * samples reach one pixel beyond, which is far on a detector of one, and FDK's the padding.
 */
static bool is_untilted(const struct plan_options *options)
{
	const struct geometry *geometry = options->geometry;
	const double pixels = 1e-3;

	for (int k = 0; k < geometry->count; k++) {
		const double *u = geometry->views[k].column_step, *v = geometry->views[k].row_step;

		if (fabs(u[2]) * (wide_columns(options) + 1) > pixels * vec_norm(v) ||
		    hypot(v[0], v[1]) * (geometry->rows + 1) > pixels * vec_norm(u))
			return false;
	}
	return true;
}

/* The same for the matched backprojection, which leaves the columns' lean out: to what float32 rounds. */
static bool is_upright(const struct geometry *geometry)
{
	const double pixels = 1e-6;

	for (int k = 0; k < geometry->count; k++) {
		const double *u = geometry->views[k].column_step, *v = geometry->views[k].row_step;

		if (fabs(u[2]) * geometry->columns > pixels * vec_norm(v) ||
		    hypot(v[0], v[1]) * geometry->rows > pixels * vec_norm(u))
			return false;
	}
	return true;
}

/* All of the grid is well before the source: places on the detector can be told by quotients. */
static bool is_before_source(const struct geometry *geometry, const struct grid *grid)
{
	const double least = 0.05; /* of the isocentre's depth */
	const double isocentre[3] = {0, 0, 0};

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12], point[3], column, row, depth;

		view_matrix(&geometry->views[k], matrix);
		depth = view_project(matrix, isocentre, &column, &row);
		for (int corner = 0; corner < 8; corner++) {
			corner_of(grid, corner, 2, point);
			if (!(view_project(matrix, point, &column, &row) > least * depth) || !(depth > 0))
				return false;
		}
	}
	return true;
}

/* How far the rows lean, in voxels. */
static double lean_in_voxels(const struct plan_options *options)
{
	const double *spacing = options->grid->spacing;
	double lean = 0;

	for (int k = 0; k < options->geometry->count; k++)
		lean = fmax(lean, lean_of(&options->geometry->views[k]));
	return lean * spacing[2] / fmin(spacing[0], spacing[1]);
}

static enum matched choose_matched(const struct plan_options *options, bool z_rays)
{
	if (z_rays || !is_before_source(options->geometry, options->grid))
		return MATCHED_ANY;
	if (is_upright(options->geometry))
		return MATCHED_UPRIGHT;
	return 1.5 * lean_in_voxels(options) * (LEANING_RUN + 2) < 0.95 ? MATCHED_LEANING : MATCHED_TILTED;
}

static void choose_rows(const struct plan_options *options, struct plan_shape *shape)
{
	const struct geometry *geometry = options->geometry;
	double least, most;
	neighbours_choice choice;
	int sign;

	shape->untilted = is_untilted(options);
	if (!shape->untilted && !(shape->halves && lean_in_voxels(options) < LEAN_MOST))
		return;
	row_spacing(geometry, options->grid, &least, &most, &sign);
	shape->untilted = shape->untilted && sign != 0;
	if (sign == 0)
		return;
	shape->rows_down = sign < 0;
	if (!shape->z_rays) {
		choice = choose_neighbours(forward_neighbours, least, most);
		shape->forward_neighbours = choice.kind;
		shape->forward_rows = choice.count;
		shape->rows_apart = shape->forward_rows == 0 && shape->halves;
		if (shape->rows_apart)
			shape->forward_rows = ROWS_APART;
	}
	/* Seen from the detector the same spacing is upside down. */
	if (!shape->untilted && !(columns_aside(geometry) * BACK_ROWS_MOST < 1))
		return;
	shape->back_pairs = shape->halves;
	choice = choose_neighbours(back_neighbours, 1 / most, 1 / least);
	shape->back_neighbours = choice.kind;
	shape->back_voxels = choice.count;
}

/* Warps of `rows` by 32 rays that meet the grid, in the view with most. */
static int view_warps(const struct geometry *geometry, const struct grid *grid, int rows)
{
	int most = 0;

	for (int k = 0; rows > 0 && k < geometry->count; k++) {
		struct shadow shadow = shadow_of(geometry, grid, k);
		int warps = divide_up(shadow.end_column - shadow.first_column, 32) *
			    divide_up(shadow.end_row - shadow.first_row, rows);

		most = warps > most ? warps : most;
	}
	return most;
}

static int lean_or(enum thrift thrift, int most)
{
	return thrift == THRIFT_LEAN ? at_most(most, BATCH_LEAN) : most;
}

/* Views of a subset whose corrections are made in one go. */
static int corrected_at_once(enum thrift thrift, int subset)
{
	bool in_parts = thrift >= THRIFT_2_PARTS && thrift < THRIFT_LEAN;

	return lean_or(thrift, in_parts ? divide_up(subset, thrift - THRIFT_2_PARTS + 2) : subset);
}

static struct plan_shape shape_of(const struct plan_options *options, enum thrift thrift)
{
	const struct geometry *geometry = options->geometry;
	const struct grid *grid = options->grid;
	struct plan_shape shape = {};
	int most = grid->size[0] > grid->size[1] ? grid->size[0] : grid->size[1];
	bool fits = most <= LAYERS_MOST && grid->size[2] <= SIDE_MOST;

	if (options->sart != NULL)
		shape.subset = subsets_largest(&options->sart->subsets);
	shape.z_rays = has_z_rays(geometry, grid);
	shape.is_small = (double)grid_voxels(grid) * geometry->count < SMALL;
	shape.matched = choose_matched(options, shape.z_rays);
	/* The matched pair is in float: upright with the projection by rows, else with the general one. */
	shape.halves = !options->reference_precision && !shape.is_small && !options->matched;
	choose_rows(options, &shape);
	if (shape.is_small)
		shape.back_voxels = 0;
	if (shape.is_small || (options->matched && shape.matched < MATCHED_UPRIGHT))
		shape.forward_rows = 0;
	shape.view_warps = view_warps(geometry, grid, shape.forward_rows);
	shape.textures = thrift != THRIFT_LEAN && !shape.is_small && !options->reference_precision && fits &&
			 wide_columns(options) <= SIDE_MOST && geometry->rows <= SIDE_MOST;
	shape.thrift = thrift;
	/* Beside what SART takes FDK has no more than it will ask for. */
	shape.batch = at_most(resident_views(options),
			      lean_or(thrift, shape.subset > 0 ? fdk_batch_most(geometry->count) : BATCH_MOST));
	shape.indexed = columns_shape_make(grid->size).floats < (size_t)1 << 31;
	/* Slices that are laid out once an iteration cost little, and their rays less. */
	shape.few_views = shape.subset > 0 && options->sart->subsets.count > 1 &&
			  (long)shape.view_warps * shape.subset < WARPS_ENOUGH;
	shape.copied = shape.indexed && shape.halves && shape.forward_rows > 0 && !shape.rows_apart &&
		       geometry->columns <= SIDE_MOST && geometry->rows <= SIDE_MOST;
	shape.covered = cuda_sart_covered(options);
	shape.views_at_once = at_most(geometry->count, lean_or(thrift, VIEWS_AT_ONCE));
	if (options->column_weights != NULL) {
		shape.plain = filter_choose(wide_columns(options));
		if (options->extend > 0)
			shape.extended = filter_choose(wide_columns(options) + options->extend);
	}
	return shape;
}

/* ---- what memory ---- */

static size_t pixels_of(const struct plan *plan)
{
	return (size_t)plan->stack.columns * (size_t)plan->stack.rows;
}

static bool needs_arrays_back(const struct plan *plan)
{
	const struct plan_options *options = &plan->options;
	/* FDK needs no arrays for rows that lean, plain sums do. */
	bool sums = plan->shape.correction > 0 || options->together > 0 ||
		    (options->sart == NULL && options->column_weights == NULL);

	return plan->shape.textures && !back_by_pairs(plan, false) && (plan->shape.back_voxels == 0 || sums);
}
/* Textures hold zeros beyond an array's sides: one cannot serve stacks of two widths. */
static bool needs_filtered_array(const struct plan *plan)
{
	return needs_arrays_back(plan) && plan->shape.back_voxels == 0 && plan->filtered.columns > plan->stack.columns;
}
static size_t pairs_bytes(const struct plan *plan, int views)
{
	struct pairs_shape pairs = pairs_shape_make(plan->filtered.columns, plan->filtered.rows);

	return (pairs.slot * (size_t)views + 2 * pairs.before) *
	       (plan->shape.back_pairs ? sizeof(float) : sizeof(float2));
}

static size_t ones_bytes(const struct plan *plan)
{
	struct pairs_shape pairs = pairs_shape_make(plan->stack.columns, plan->stack.rows);

	if (!back_by_pairs(plan, false) || !plan->shape.back_pairs || plan->options.matched)
		return 0;
	return (pairs.slot + 2 * pairs.before) * sizeof(float);
}

/* Views of a batch that is laid out anew for the backprojection. */
static int views_laid_out(const struct plan *plan)
{
	int views = plan->shape.batch, subset = plan->shape.correction;

	if (plan->options.together > subset)
		subset = plan->options.together;
	/*
	 * Pairs of float take twice a stack's room: a batch must do. Else all of a subset is taken, to need no sums
	 * aside; the matched projector's corrections are not laid out.
	 */
	if ((plan->shape.back_voxels == 0 || plan->shape.back_pairs) && subset > views && !plan->options.matched)
		views = subset;
	if (plan->shape.thrift == THRIFT_HALVES)
		views = divide_up(views, 2);
	return at_most(views, plan->shape.views_at_once);
}

static void describe_raw(struct plan *plan)
{
	const struct plan_options *options = &plan->options;
	const struct geometry *geometry = options->geometry;
	int part = at_most(divide_up(geometry->count, RAW_PART), resident_views(options));

	plan->raw_views = 1;
	plan->raw_bytes = pixels_of(plan) * linearise_sample_bytes(&options->linearise);
	if (plan->raw_bytes < RAW_BYTES)
		plan->raw_views = (int)(RAW_BYTES / plan->raw_bytes);
	plan->raw_views = options->no_samples ? 0 : at_most(plan->raw_views, part);
}

/* The bytes of the block that the stages use in turn. */
static void describe_scratch(struct plan *plan)
{
	const struct plan_options *options = &plan->options;

	if (!options->no_projection && !plan->shape.is_small)
		plan->slices_bytes = (plan->along_x.floats + plan->along_y.floats) * sizeof(float);
	if (plan->strategy != NULL)
		plan->slices_bytes = at_least(plan->slices_bytes, plan->strategy->scratch_bytes(plan));
	plan->scratch_bytes = at_least(plan->slices_bytes, tv_scratch_bytes(options));
	plan->scratch_bytes = at_least(plan->scratch_bytes, filter_scratch_bytes(plan, plan->scratch_bytes));
	plan->scratch_bytes = at_least(plan->scratch_bytes, matched_scratch_bytes(plan));
	plan->scratch_bytes = at_least(plan->scratch_bytes, options->lends);
}

/* The views that are corrected and laid out at a time, and the arrays for them. */
static void describe_batches(struct plan *plan)
{
	struct plan_shape *shape = &plan->shape;

	if (shape->back_voxels > 0 || needs_arrays_back(plan))
		shape->views_at_once = views_laid_out(plan);
	shape->pairs_at_once =
	    back_by_pairs(plan, false) ? shape->views_at_once : at_most(shape->batch, shape->views_at_once);
	if (needs_arrays_back(plan))
		plan->projections = layered_make(plan->stack.columns, plan->stack.rows, shape->views_at_once);
	if (needs_filtered_array(plan))
		plan->filtered_array = layered_make(plan->filtered.columns, plan->filtered.rows, shape->batch);
}

static void plan_describe(struct plan *plan, const struct plan_options *options, enum thrift thrift)
{
	const struct geometry *geometry = options->geometry;
	const struct grid *grid = options->grid;
	struct plan_shape *shape = &plan->shape;
	const int *size = grid->size;
	bool by_subset;

	plan->options = *options;
	*shape = shape_of(options, thrift);
	for (int i = 0; i < 3; i++) {
		plan->grid.size[i] = size[i];
		plan->grid.spacing[i] = (float)grid->spacing[i];
	}
	plan->along_x = slices_shape_make(size[0], size[2], size[1], shape->forward_rows > 0);
	plan->along_y = slices_shape_make(size[1], size[2], size[0], shape->forward_rows > 0);
	plan->columns = columns_shape_make(size);
	plan->stack = stack_shape_make(geometry->columns, geometry->rows, 1);
	plan->filtered = stack_shape_make(wide_columns(options), geometry->rows, 1);
	plan->strategy = strategy_choose(plan);
	by_subset = plan->strategy != NULL && !plan->strategy->by_view;
	shape->correction = by_subset ? corrected_at_once(thrift, shape->subset) : 0;
	shape->parts = by_subset && shape->correction < shape->subset;
	shape->view_rows = copies_view_rows(plan);
	describe_scratch(plan);
	if (plan->strategy != NULL)
		plan->partial_count = strategy_partials(plan);
	describe_batches(plan);
	describe_raw(plan);
}

static bool needs_work(const struct plan *plan)
{
	int subset = plan->shape.correction > plan->options.together ? plan->shape.correction : plan->options.together;

	return plan->shape.parts || (subset > plan->shape.views_at_once && !plan->options.matched);
}
static bool needs_coverage(const struct plan *plan)
{
	return plan->shape.correction > 0 && !plan->shape.covered;
}

/* What a part of an iteration needs that several devices share. */
static void shared_walk(struct plan *plan, struct arena *arena)
{
	take(arena, &plan->rays_partial, rays_partials(plan));
	if (plan->options.together == 0)
		return;
	if (!plan->shape.covered)
		take(arena, &plan->ones, ones_bytes(plan));
	if (needs_work(plan))
		take(arena, &plan->work, grid_voxels(plan->options.grid));
}

/* SART's part of the plan's memory: column sums, numerators, squares, and that of its strategy. */
static void sart_walk(struct plan *plan, struct arena *arena)
{
	const size_t voxels = grid_voxels(plan->options.grid);

	take(arena, &plan->in_order, (size_t)plan->options.geometry->count);
	take(arena, &plan->partial, plan->partial_count);
	if (needs_coverage(plan)) {
		take(arena, &plan->coverage, voxels);
		take(arena, &plan->ones, ones_bytes(plan));
	}
	if (needs_work(plan))
		take(arena, &plan->work, voxels);
	plan->strategy->walk(plan, arena);
}

/*
 * Everything that a plan holds on the device, but for the block of scratch, which may be another plan's, and the
 * layered arrays, which the driver lays out.
 */
static void plan_walk(struct plan *plan, struct arena *arena)
{
	const size_t views = (size_t)plan->options.geometry->count;

	take(arena, &plan->geometry, views);
	take(arena, &plan->views, views);
	take(arena, &plan->slots, views);
	take(arena, &plan->reduce, reduce_count());
	take(arena, &plan->most, MOST_COUNT);
	take(arena, &plan->matrices, VIEWS_AT_ONCE * 12);
	if (plan->shape.back_voxels > 0)
		take(arena, &plan->pairs, pairs_bytes(plan, plan->shape.pairs_at_once));
	linearise_walk(plan, arena);
	if (plan->strategy != NULL)
		sart_walk(plan, arena);
	else if (plan->options.no_projection || plan->options.together > 0)
		shared_walk(plan, arena);
	if (plan->options.column_weights != NULL)
		filter_walk(plan, arena);
}

static struct plan_bytes bytes_of(const struct plan_options *options, enum thrift thrift)
{
	struct plan plan = {};
	struct plan_bytes bytes = {};
	struct arena arena = {};

	plan_describe(&plan, options, thrift);
	plan_walk(&plan, &arena);
	bytes.volumes = cuda_volume_bytes(options->grid) * (options->sart != NULL ? 2 : 1);
	bytes.raw = plan.raw_bytes * (size_t)plan.raw_views;
	bytes.block = plan.scratch_bytes;
	bytes.scratch =
	    plan.scratch_bytes + arena.used - bytes.raw + plan.projections.bytes + plan.filtered_array.bytes;
	return bytes;
}

/* A job's bound: seven volumes, ten with the proximal method's, 21 with TGV's, and three stacks. */
static size_t most_bytes(const struct plan_options *options)
{
	const struct geometry *geometry = options->geometry;
	static const int volumes[TV_METHOD_COUNT] = {7, 10, 21};

	return sizeof(float) *
	       ((size_t)volumes[options->tv != NULL ? options->tv->method : 0] * grid_voxels(options->grid) +
		3 * (size_t)geometry->columns * (size_t)geometry->rows * (size_t)geometry->count);
}

static bool is_borrowed(const struct plan_options *options, size_t block)
{
	return options->lender != NULL && options->lender->scratch_bytes >= block;
}

/*
 * The least thrift with which the job fits the device and its bound. Where nothing fits that, for
 * the tables of a small job alone take more, as much as is worth it.
 */
static enum thrift choose_thrift(const struct device *device, const struct plan_options *options)
{
	size_t most = options->unbounded ? SIZE_MAX : most_bytes(options),
	       room = device != NULL ? device->limit - device->used : SIZE_MAX, least = 0;
	enum thrift best = THRIFT_LEAN;

	for (int thrift = THRIFT_NONE; thrift <= THRIFT_LEAN; thrift++) {
		struct plan_bytes bytes = bytes_of(options, (enum thrift)thrift);
		size_t all =
		    options->beside + bytes.volumes + bytes.scratch + bytes.raw +
		    cuda_stack_bytes(options->geometry->columns, options->geometry->rows, resident_views(options));

		if (is_borrowed(options, bytes.block))
			all -= bytes.block;
		if (all > room)
			continue;
		if (all <= most)
			return (enum thrift)thrift;
		if (least == 0 || all < least / 16 * 15) {
			least = all;
			best = (enum thrift)thrift;
		}
	}
	return best;
}

int cuda_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		    struct error *err)
{
	(void)err;
	*ret_bytes = bytes_of(options, choose_thrift(device, options));
	return 0;
}

/* ---- making it ---- */

/* World to voxels counted from the grid's centre. */
static void to_voxels(const struct grid *grid, const double point[3], bool is_place, double ret[3])
{
	for (int i = 0; i < 3; i++) {
		double centre = grid->origin[i] + 0.5 * (grid->size[i] - 1) * grid->spacing[i];

		ret[i] = (point[i] - (is_place ? centre : 0)) / grid->spacing[i];
	}
}

struct shadow shadow_of(const struct geometry *geometry, const struct grid *grid, int index)
{
	const struct shadow all = {0, geometry->columns, 0, geometry->rows};
	const double margin = 2; /* pixels, far above what float32 may err */
	double matrix[12], low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
	const int most[2] = {geometry->columns, geometry->rows};
	int first[2], end[2];

	view_matrix(&geometry->views[index], matrix);
	for (int corner = 0; corner < 8; corner++) {
		double point[3], at[2];

		corner_of(grid, corner, 0.5, point);
		if (!(view_project(matrix, point, &at[0], &at[1]) > 0))
			return all; /* the grid is around the source */
		for (int i = 0; i < 2; i++) {
			low[i] = fmin(low[i], at[i]);
			high[i] = fmax(high[i], at[i]);
		}
	}
	for (int i = 0; i < 2; i++) {
		first[i] = (int)fmin(fmax(floor(low[i] - margin), 0), most[i]);
		end[i] = (int)fmin(fmax(ceil(high[i] + margin) + 1, 0), most[i]);
	}
	return {first[0], end[0], first[1], end[1]};
}

static struct device_view view_make(const struct plan_options *options, int index)
{
	const struct geometry *geometry = options->geometry;
	const struct grid *grid = options->grid;
	const struct view *view = &geometry->views[index];
	const double isocentre[3] = {0, 0, 0};
	double source[3], ray[3], forms[3][3], matrix[12], depth, column, row, central[3];
	struct device_view result = {};

	to_voxels(grid, view->source, true, source);
	for (int i = 0; i < 3; i++)
		result.source[i] = (float)source[i];
	for (int i = 0; i < 3; i++)
		ray[i] = view->pixel0[i] + 0.5 * (geometry->columns - 1) * view->column_step[i] +
			 0.5 * (geometry->rows - 1) * view->row_step[i] - view->source[i];
	to_voxels(grid, ray, false, forms[0]);
	to_voxels(grid, view->column_step, false, forms[1]);
	to_voxels(grid, view->row_step, false, forms[2]);
	for (int k = 0; k < 3; k++) {
		double moment[3];

		vec_cross(source, forms[k], moment);
		for (int i = 0; i < 3; i++) {
			result.direction[i][k] = (float)forms[k][i];
			result.moment[i][k] = (float)moment[i];
		}
	}
	view_matrix(view, matrix);
	depth = view_project(matrix, isocentre, &column, &row);
	if (!(depth > 0))
		depth = 1; /* the isocentre is behind the source: there is no FDK weight then, any scale will do */
	for (int r = 0; r < 3; r++) {
		double offset = matrix[4 * r + 3];

		for (int i = 0; i < 3; i++) {
			offset += matrix[4 * r + i] * grid->origin[i];
			result.matrix[r][i] = (float)(matrix[4 * r + i] * grid->spacing[i] / depth);
		}
		result.matrix[r][3] = (float)(offset / depth);
	}
	result.shadow = shadow_of(geometry, grid, index);
	axis_direction(view->source, &options->axis, central);
	for (int i = 0; i < 3; i++)
		result.central[i] = (float)central[i];
	return result;
}

/* Uploads the views in this order; NULL: by their numbers. */
static int upload_views(struct plan *plan, const int *order, struct device_view *to, struct error *err)
{
	int count = plan->options.geometry->count;
	size_t bytes = (size_t)count * sizeof(struct device_view);
	struct device_view *views = (struct device_view *)malloc(bytes);
	cudaError_t status;

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int i = 0; i < count; i++)
		views[i] = view_make(&plan->options, order != NULL ? order[i] : i);
	status = cudaMemcpy(to, views, bytes, cudaMemcpyHostToDevice);
	free(views);
	return status == cudaSuccess ? 0 : cuda_error(err, status, "uploading the geometry");
}

static int prepare_sart(struct plan *plan, struct error *err)
{
	TRY(upload_views(plan, plan->options.sart->subsets.order, plan->in_order, err));
	CUDA_TRY(cudaEventCreateWithFlags(&plan->projected, cudaEventDisableTiming));
	CUDA_TRY(cudaEventCreateWithFlags(&plan->summed, cudaEventDisableTiming));
	plan->coverage_subset = -1;
	return plan->strategy->prepare(plan, err);
}

static int prepare_scratch(struct plan *plan, struct error *err)
{
	struct plan *lender = plan->options.lender;

	if (is_borrowed(&plan->options, plan->scratch_bytes)) {
		plan->lender = lender;
		plan->scratch = lender->scratch;
		return 0;
	}
	TRY(device_allocate(plan->device, plan->scratch_bytes, (void **)&plan->scratch, err));
	CUDA_TRY(cudaMemsetAsync(plan->scratch, 0, plan->scratch_bytes, plan->device->stream));
	return 0;
}

static int plan_allocate(struct plan *plan, struct error *err)
{
	struct arena arena = {};

	if (plan->options.column_weights != NULL)
		TRY(filter_new(plan, err));
	plan_walk(plan, &arena);
	TRY(device_allocate(plan->device, arena.used, (void **)&plan->memory, err));
	plan->memory_bytes = arena.used;
	arena = {plan->memory, 0};
	plan_walk(plan, &arena);
	TRY(prepare_scratch(plan, err));
	TRY(layered_new(plan->device, &plan->projections, err));
	return layered_new(plan->device, &plan->filtered_array, err);
}

static int plan_prepare(struct plan *plan, struct error *err)
{
	size_t count = (size_t)plan->options.geometry->count;

	TRY(device_enter(plan->device, err));
	plan->views_host = (int *)malloc(count * sizeof(int));
	if (plan->views_host == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan of %zu views", count);
	TRY(plan_allocate(plan, err));
	TRY(upload_views(plan, NULL, plan->geometry, err));
	TRY(linearise_prepare(plan, err));
	if (plan->ones != NULL)
		TRY(layout_ones(plan, err));
	if (plan->strategy != NULL)
		TRY(prepare_sart(plan, err));
	if (plan->filter != NULL)
		TRY(filter_prepare(plan, err));
	/* Copies by cudaMemcpy may still be on their way, on a stream that the others do not wait for. */
	CUDA_TRY(cudaStreamSynchronize(cudaStreamLegacy));
	return device_wait(plan->device, err);
}

static struct plan *owner_of_scratch(struct plan *plan)
{
	return plan->lender != NULL ? plan->lender : plan;
}

int plan_begin_slices(struct plan *plan, struct error *err)
{
	struct plan *owner = owner_of_scratch(plan);

	if (owner->slices_of != plan)
		CUDA_TRY(cudaMemsetAsync(plan->scratch, 0, plan->slices_bytes, plan->device->stream));
	owner->slices_of = plan;
	return 0;
}

void plan_end_slices(struct plan *plan)
{
	owner_of_scratch(plan)->slices_of = NULL;
}

static const char *const neighbours_names[] = {"",        ", two a row", ", wide",       ", narrow",
					       ", close", ", thirds",    ", three a row"};
static const char *const forward_names[] = {"",        ", two a voxel", ", wide",         ", narrow",
					    ", close", ", thirds",      ", three a voxel"};

/* The rows of the tables that were chosen, and what they go by. */
static void summarise(struct plan *plan)
{
	const struct plan_shape *shape = &plan->shape;
	const bool fdk = plan->options.column_weights != NULL;
	char rows[64] = "", back[96] = "", saves[32] = "";

	if (shape->forward_rows > 0)
		snprintf(rows, sizeof(rows), ", %s, %d rows a thread%s", shape->untilted ? "untilted" : "near untilted",
			 shape->forward_rows, shape->rows_apart ? "" : forward_names[shape->forward_neighbours]);
	if (shape->back_voxels > 0)
		snprintf(back, sizeof(back), ", %s, %d voxels a window%s",
			 shape->untilted ? "untilted" : "near untilted", shape->back_voxels,
			 neighbours_names[shape->back_neighbours]);
	if (shape->thrift != THRIFT_NONE)
		snprintf(
		    saves, sizeof(saves), "%s%d views at a time; ", shape->thrift == THRIFT_LEAN ? "lean, " : "",
		    at_most(shape->views_at_once, shape->correction > 0 ? shape->correction : shape->views_at_once));
	snprintf(plan->summary, sizeof(plan->summary), "%sforward %s%s; back %s%s%s%s; %s%s%s", saves,
		 projector_name(plan), rows, backprojector_name(plan, false), fdk ? ", FDK's " : "",
		 fdk ? backprojector_name(plan, true) : "", back,
		 shape->plain.fused > 0 ? "fused filter"
		 : shape->plain.fft > 0 ? "cuFFT"
					: "no filter",
		 plan->strategy != NULL ? "; SART " : "", plan->strategy != NULL ? plan->strategy->name : "");
}

int cuda_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan, struct error *err)
{
	struct plan *plan;
	int code;

	plan = (struct plan *)calloc(1, sizeof(*plan));
	if (plan == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan");
	plan->device = device;
	plan_describe(plan, options, choose_thrift(device, options));
	code = plan_prepare(plan, err);
	if (code < 0) {
		cuda_plan_free(plan);
		return code;
	}
	summarise(plan);
	*ret_plan = plan;
	return 0;
}

void cuda_plan_free(struct plan *plan)
{
	struct device *device;

	if (plan == NULL)
		return;
	device = plan->device;
	cudaSetDevice(device->index);
	cudaStreamSynchronize(device->copy);
	cudaStreamSynchronize(device->stream);
	backproject_forget(device);
	if (plan->recorded != NULL)
		cudaGraphExecDestroy(plan->recorded);
	if (plan->projected != NULL)
		cudaEventDestroy(plan->projected);
	if (plan->summed != NULL)
		cudaEventDestroy(plan->summed);
	if (plan->sampled != 0)
		cudaDestroyTextureObject(plan->sampled);
	filter_free(plan->filter);
	layered_free(device, &plan->projections);
	layered_free(device, &plan->filtered_array);
	if (plan->lender != NULL)
		plan_end_slices(plan);
	else
		device_release(device, plan->scratch, plan->scratch_bytes);
	device_release(device, plan->memory, plan->memory_bytes);
	free(plan->views_host);
	free(plan);
}

const char *cuda_plan_summary(const struct plan *plan)
{
	return plan->summary;
}

int cuda_plan_batch(const struct plan *plan)
{
	return plan->shape.batch;
}

/* ---- lists of views ---- */

int plan_check_views(const struct plan *plan, const int *views, int count, const struct stack_shape *shape,
		     const struct stack *stack, int slots, struct error *err)
{
	int all = plan->options.geometry->count;

	if (count < 0 || count > all)
		return error_set(err, ERR_INTERNAL, "%d views at once, there are %d", count, all);
	if (stack->shape.columns != shape->columns || stack->shape.rows != shape->rows || stack->slots < slots)
		return error_set(err, ERR_INTERNAL, "a stack of %d projections of %d x %d, expected %d of %d x %d",
				 stack->slots, stack->shape.columns, stack->shape.rows, slots, shape->columns,
				 shape->rows);
	for (int i = 0; i < count; i++)
		if (views[i] < 0 || views[i] >= all)
			return error_set(err, ERR_INTERNAL, "view %d of %d", views[i], all);
	return 0;
}

int plan_set_views(struct plan *plan, const int *views, int count, struct error *err)
{
	size_t bytes = (size_t)count * sizeof(int);

	TRY(device_enter(plan->device, err));
	if (count <= plan->views_held && memcmp(views, plan->views_host, bytes) == 0)
		return 0;
	memcpy(plan->views_host, views, bytes);
	plan->views_held = count;
	plan->views_list++;
	/* From pageable memory: it has been read when the call returns. */
	CUDA_TRY(cudaMemcpyAsync(plan->views, views, bytes, cudaMemcpyHostToDevice, plan->device->stream));
	return 0;
}

int plan_set_slots(struct plan *plan, const int *slots, int count, const struct stack *from, struct error *err)
{
	for (int i = 0; i < count; i++)
		if (slots[i] < 0 || slots[i] >= from->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], from->slots);
	CUDA_TRY(cudaMemcpyAsync(plan->slots, slots, (size_t)count * sizeof(int), cudaMemcpyHostToDevice,
				 plan->device->stream));
	return 0;
}

/*
 * What a job has on each card, beside its volumes and stacks: the plans of the backend below for a card's slab and for
 * the rows of the detector that see it, and what the exchange works in.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/cards/internal.h"
#include "core/fdk.h"

/*
 * Bytes of a card's stack for a batch of views, of which there are two: SIRT of 512^3 and 1024^3 takes its views in one
 * go, which saves passes over the slab. A fixed number, so that the batches and the bits do not go by what is free.
 */
static const size_t BATCH_BYTES = (size_t)1100 << 20;

static struct grid grid_of_slices(const struct grid *grid, int first, int count)
{
	struct grid part = *grid;

	part.size[2] = count;
	part.origin[2] += first * grid->spacing[2];
	return part;
}

/* The grid of the plans that know no slab: one voxel in the whole's centre. */
static struct grid one_voxel(const struct grid *grid)
{
	struct grid one = *grid;

	for (int i = 0; i < 3; i++) {
		one.origin[i] += 0.5 * (grid->size[i] - 1) * grid->spacing[i];
		one.size[i] = 1;
	}
	return one;
}

/* ---- the rows that see a slab ---- */

/* Rows of one view that see the grid and a voxel around it. False: some of it lies beside or behind the source. */
static bool rows_of_view(const struct view *view, const struct grid *grid, double *low, double *high)
{
	double matrix[12];

	view_matrix(view, matrix);
	for (int corner = 0; corner < 8; corner++) {
		double point[3], column, row;

		for (int i = 0; i < 3; i++)
			point[i] = grid->origin[i] + grid->spacing[i] * (corner >> i & 1 ? grid->size[i] : -1);
		if (!(view_project(matrix, point, &column, &row) > 0))
			return false;
		*low = fmin(*low, row);
		*high = fmax(*high, row);
	}
	return true;
}

/* Rows of the detector that see the grid in some view, with a margin of pixels for their interpolation. */
static void rows_seen(const struct geometry *geometry, const struct grid *grid, int *ret_first, int *ret_count)
{
	const int margin = 2, least = 8;
	double low = INFINITY, high = -INFINITY;
	int first, end;

	for (int i = 0; i < geometry->count; i++) {
		if (!rows_of_view(&geometry->views[i], grid, &low, &high)) {
			low = -INFINITY;
			high = INFINITY;
		}
	}
	low = fmin(fmax(0, floor(low) - margin), geometry->rows - 1);
	high = fmin(geometry->rows, ceil(high) + margin + 1);
	/* Where no view sees it, one row at that end: neighbouring slabs leave no row between theirs. */
	first = (int)low;
	end = low < high ? (int)high : first + 1;
	while (end - first < least && (first > 0 || end < geometry->rows)) {
		first -= first > 0;
		end += end < geometry->rows;
	}
	*ret_first = first;
	*ret_count = end - first;
}

/* The geometry of some rows of the detector. */
static int crop(struct geometry *ret_geometry, const struct geometry *geometry, int row, int rows, struct error *err)
{
	int code = geometry_copy(ret_geometry, geometry, err);

	if (code < 0)
		return code;
	ret_geometry->rows = rows;
	for (int i = 0; i < geometry->count; i++)
		for (int k = 0; k < 3; k++)
			ret_geometry->views[i].pixel0[k] += row * geometry->views[i].row_step[k];
	return 0;
}

/* ---- the walk over what lies on a card ---- */

/* A walk makes every piece or adds up the bytes, so that the estimate and the allocation come from the same lines. */
struct walk {
	const struct backend *backend;
	struct device *card;
	bool measures, plans; /* plans: they are made or measured, too */
	size_t beside;        /* bytes on the card, but for the plans */
	size_t volumes, rest;
};

static int walk_plan(struct walk *walk, struct plan_options *options, struct plan **ret_plan, struct error *err)
{
	struct plan_bytes bytes;
	int code;

	if (!walk->plans)
		return 0;
	options->beside = walk->beside;
	options->unbounded = true;
	if (!walk->measures)
		return walk->backend->plan_new(walk->card, options, ret_plan, err);
	code = walk->backend->plan_bytes(walk->card, options, &bytes, err);
	if (code < 0)
		return code;
	/* plan_bytes counts an iterate, too. */
	walk->volumes += bytes.volumes - walk->backend->volume_bytes(walk->card, options->grid);
	walk->rest += bytes.scratch + bytes.raw;
	return 0;
}

static int walk_volume(struct walk *walk, const struct grid *grid, struct volume **ret_volume, struct error *err)
{
	if (!walk->measures)
		return walk->backend->volume_new(walk->card, grid, ret_volume, err);
	walk->volumes += walk->backend->volume_bytes(walk->card, grid);
	return 0;
}

static int walk_stack(struct walk *walk, int columns, int rows, int slots, struct stack **ret_stack, struct error *err)
{
	if (slots == 0)
		return 0;
	if (!walk->measures)
		return walk->backend->stack_new(walk->card, columns, rows, slots, ret_stack, err);
	walk->rest += walk->backend->stack_bytes(walk->card, columns, rows, slots);
	return 0;
}

/* Options that all plans of the backend below have in common: nothing is linearised, filtered or smoothed. */
static struct plan_options plain_options(const struct plan *plan, const struct geometry *geometry,
					 const struct grid *grid, int resident)
{
	struct plan_options options = plan->options;

	options.geometry = geometry;
	options.grid = grid;
	options.linearise = (struct linearise){.sample = SAMPLE_FLOAT32};
	options.column_weights = options.filter_response = options.extended_response = NULL;
	options.pad[0] = options.pad[1] = options.extend = 0;
	options.sart = NULL;
	options.tv = NULL;
	options.lender = NULL;
	options.lends = 0;
	options.no_samples = true;
	options.resident = resident;
	return options;
}

static bool has_fdk(const struct plan *plan)
{
	return plan->options.column_weights != NULL;
}

static int pad_of(const struct plan *plan)
{
	return plan->options.pad[0] + plan->options.pad[1];
}

static int walk_intake(struct plan *plan, int c, struct walk *walk, struct error *err)
{
	const struct plan_options *all = &plan->options;
	struct plan_options options =
	    plain_options(plan, all->geometry, &plan->one, all->resident > 0 ? all->resident : plan->filter_batch);

	options.linearise = all->linearise;
	options.no_samples = all->no_samples;
	options.column_weights = all->column_weights;
	options.filter_response = all->filter_response;
	memcpy(options.pad, all->pad, sizeof(options.pad));
	options.extend = all->extend;
	options.extended_response = all->extended_response;
	options.no_projection = true;
	return walk_plan(walk, &options, &plan->card[c].intake, err);
}

/* Plans of the slab, what projects through it, and what TV smooths. */
static int walk_slab(struct plan *plan, int c, struct walk *walk, struct error *err)
{
	const struct plan_options *all = &plan->options;
	struct card_plan *card = &plan->card[c];
	struct plan_options options = plain_options(plan, &card->geometry, &card->grid, 2 * plan->batch);
	int code;

	if (has_fdk(plan)) {
		options.column_weights = all->column_weights;
		options.filter_response = all->filter_response;
		memcpy(options.pad, all->pad, sizeof(options.pad));
	}
	options.together = all->sart != NULL ? batch_of(plan, subsets_largest(&all->sart->subsets)) : 0;
	options.no_projection = true; /* `between` projects */
	code = walk_plan(walk, &options, &card->slab, err);
	if (code == 0 && (!all->no_projection || all->matched)) {
		options = plain_options(plan, &card->geometry, &card->between_grid, 2 * plan->batch);
		code = walk_plan(walk, &options, &card->between, err);
		if (code == 0)
			code = walk_volume(walk, &card->between_grid, &card->padded, err);
	}
	if (code == 0 && all->tv != NULL) {
		options = plain_options(plan, &card->geometry, &card->tv_grid, 1);
		options.tv = all->tv;
		options.no_projection = true;
		code = walk_plan(walk, &options, &card->tv, err);
		if (code == 0)
			code = walk_volume(walk, &card->tv_grid, &card->smoothed, err);
	}
	if (code == 0 && all->sart != NULL)
		code = walk_volume(walk, &card->grid, &card->sums, err);
	return code == 0 && all->sart != NULL && !card->covered ? walk_volume(walk, &card->grid, &card->coverage, err)
								: code;
}

static int walk_stacks(struct plan *plan, int c, struct walk *walk, struct error *err)
{
	const int columns = plan->options.geometry->columns, rows = plan->options.geometry->rows;
	struct card_plan *card = &plan->card[c];
	const bool wide = has_fdk(plan) && pad_of(plan) > 0, plain = !plan->options.no_projection || !wide;
	int code = 0;

	for (int i = 0; i < 2 && code == 0 && c < plan->parts; i++) {
		if (plain)
			code = walk_stack(walk, columns, card->geometry.rows, plan->batch, &card->in[i], err);
		if (code == 0 && wide)
			code = walk_stack(walk, columns + pad_of(plan), card->geometry.rows, plan->batch,
					  &card->wide[i], err);
	}
	if (code == 0)
		code = walk_stack(walk, columns, rows, plan->filter_batch, &card->taken, err);
	return code == 0 && c < plan->parts && plan->options.sart != NULL
		   ? walk_stack(walk, columns, card->geometry.rows, plan->options.geometry->count, &card->measured, err)
		   : code;
}

static int walk_card(struct plan *plan, int c, struct walk *walk, struct error *err)
{
	int code = walk_intake(plan, c, walk, err);

	if (code == 0 && c < plan->parts)
		code = walk_slab(plan, c, walk, err);
	return code == 0 ? walk_stacks(plan, c, walk, err) : code;
}

/* Bytes on the card beside its plans: its share of the job's volumes and stacks, and the pieces of the walk. */
static int bytes_beside(struct plan *plan, int c, size_t *ret_bytes, struct error *err)
{
	const struct device *device = plan->device;
	const struct plan_options *options = &plan->options;
	const struct geometry *geometry = options->geometry;
	const int resident = options->resident > 0 ? options->resident : geometry->count;
	struct walk walk = {.backend = device->backend, .card = device->card[c], .measures = true};
	int code = walk_card(plan, c, &walk, err);

	*ret_bytes = walk.volumes + walk.rest +
		     (options->beside + backend_cards.stack_bytes(device, geometry->columns, geometry->rows, resident) +
		      backend_cards.volume_bytes(device, options->grid) * (options->sart != NULL ? 2 : 1)) /
			 (size_t)device->count;
	return code;
}

/* ---- the plan ---- */

/*
 * Steps of TV from exchange to exchange. Each costs a slice more on either side; by eight, slabs of 128 slices work on
 * an eighth more, and what is passed takes little beside them. Where state cannot be passed they are all steps.
 */
static int tv_steps_of(const struct device *device, const struct tv_options *tv)
{
	const int most = 8;

	if (tv == NULL)
		return 0;
	if (tv->method == TV_GENERALISED || device->backend->tv_pass == NULL)
		return tv->iterations;
	return tv->iterations < most ? tv->iterations : most;
}

static int describe_card(struct plan *plan, int c, const int *first, struct error *err)
{
	const struct plan_options *options = &plan->options;
	const struct grid *grid = options->grid;
	struct card_plan *card = &plan->card[c];
	const int nz = grid->size[2], halo = plan->tv_steps;
	const int end = first[c + 1], above = end < nz, tv_end = end + halo < nz ? end + halo : nz;
	struct plan_options slab;
	int rows, code;

	if (c >= plan->parts)
		return 0;
	card->below = first[c] > 0;
	card->grid = grid_of_slices(grid, first[c], end - first[c]);
	card->between_grid = grid_of_slices(grid, first[c] - card->below, end - first[c] + card->below + above);
	card->tv_first = first[c] > halo ? first[c] - halo : 0;
	card->tv_grid = grid_of_slices(grid, card->tv_first, tv_end - card->tv_first);
	rows_seen(options->geometry, &card->between_grid, &card->row, &rows);
	/* Neighbours see common rows, so that what has been seen before is in one piece. */
	card->counted_before[0] = plan->seen[0] - card->row;
	card->counted_before[1] = plan->seen[1] - card->row;
	if (c == 0 || card->row < plan->seen[0])
		plan->seen[0] = card->row;
	if (c == 0 || card->row + rows > plan->seen[1])
		plan->seen[1] = card->row + rows;
	code = crop(&card->geometry, options->geometry, card->row, rows, err);
	if (code < 0 || options->sart == NULL || plan->device->backend->sart_covered == NULL)
		return code;
	slab = plain_options(plan, &card->geometry, &card->grid, 1);
	card->covered = plan->device->backend->sart_covered(&slab);
	return 0;
}

static int plan_describe(struct plan *plan, struct device *device, const struct plan_options *options,
			 struct error *err)
{
	const struct geometry *geometry = options->geometry;
	/* SART takes a subset in one go, if it can; all else goes by halves at least. */
	const int nz = options->grid->size[2], all = geometry->count,
		  count = options->sart != NULL ? all : (all + 1) / 2;
	int first[CARDS_MOST + 1], rows = 1, code = 0;
	size_t slot;

	plan->device = device;
	plan->options = *options;
	plan->covered = -1;
	plan->tv_steps = tv_steps_of(device, options->tv);
	plan->one = one_voxel(options->grid);
	plan->parts = nz < device->count ? nz : device->count;
	slabs_cut(device, nz, first);
	for (int c = 0; c < device->count && code == 0; c++) {
		code = describe_card(plan, c, first, err);
		rows = plan->card[c].geometry.rows > rows ? plan->card[c].geometry.rows : rows;
	}
	slot = (size_t)(geometry->columns + pad_of(plan)) * (size_t)rows * sizeof(float);
	plan->batch = (size_t)count * slot <= BATCH_BYTES ? count : BATCH_BYTES < slot ? 1 : (int)(BATCH_BYTES / slot);
	plan->filter_batch = has_fdk(plan) ? fdk_batch_most(geometry->count) : 0;
	/* FDK alone has no more than it filters. */
	if (options->no_projection && has_fdk(plan) && plan->filter_batch < plan->batch)
		plan->batch = plan->filter_batch;
	return code;
}

static void plan_clear(struct plan *plan)
{
	const struct backend *backend = plan->device->backend;

	for (int c = 0; c < plan->device->count; c++) {
		struct card_plan *card = &plan->card[c];

		for (int i = 0; i < 2; i++) {
			backend->stack_free(card->in[i]);
			backend->stack_free(card->wide[i]);
		}
		backend->stack_free(card->taken);
		backend->stack_free(card->measured);
		backend->volume_free(card->sums);
		backend->volume_free(card->coverage);
		backend->volume_free(card->smoothed);
		backend->volume_free(card->padded);
		backend->plan_free(card->tv);
		backend->plan_free(card->between);
		backend->plan_free(card->slab);
		backend->plan_free(card->intake);
		geometry_clear(&card->geometry);
	}
	free(plan->places);
	free(plan->lists);
	free(plan->host);
}

/* What the job takes of each card is counted as many times as there are cards: the largest. */
int cards_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		     struct error *err)
{
	const size_t volume = backend_cards.volume_bytes(device, options->grid);
	struct plan plan = {0};
	struct plan_bytes most = {0};
	int code = plan_describe(&plan, device, options, err);

	for (int c = 0; c < device->count && code == 0; c++) {
		struct walk walk = {
		    .backend = device->backend, .card = device->card[c], .measures = true, .plans = true};

		code = bytes_beside(&plan, c, &walk.beside, err);
		if (code == 0)
			code = walk_card(&plan, c, &walk, err);
		most.volumes = walk.volumes > most.volumes ? walk.volumes : most.volumes;
		most.scratch = walk.rest > most.scratch ? walk.rest : most.scratch;
	}
	plan_clear(&plan);
	if (code < 0)
		return code;
	most.volumes = most.volumes * (size_t)device->count + volume * (options->sart != NULL ? 2 : 1);
	most.scratch *= (size_t)device->count;
	*ret_bytes = most;
	return 0;
}

/* The lists that name views and slots, and what goes through the host. */
static int allocate_lists(struct plan *plan, struct error *err)
{
	const struct plan_options *options = &plan->options;
	const size_t count = (size_t)options->geometry->count, cards = (size_t)plan->device->count;
	const size_t slice = (size_t)options->grid->size[0] * (size_t)options->grid->size[1];
	const size_t view = (size_t)(options->geometry->columns + pad_of(plan)) * (size_t)options->geometry->rows;
	const size_t floats = 2 * (plan->device->connected || view < slice ? slice : view);

	plan->places = malloc(count * sizeof(*plan->places));
	plan->lists = malloc(3 * count * cards * sizeof(*plan->lists));
	plan->host = malloc(floats * cards * sizeof(*plan->host));
	if (plan->places == NULL || plan->lists == NULL || plan->host == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the plan of %zu cards", cards);
	for (size_t c = 0; c < cards; c++) {
		plan->card[c].host = plan->host + floats * c;
		plan->card[c].from = plan->lists + 3 * count * c;
		plan->card[c].to = plan->card[c].from + count;
		plan->card[c].views = plan->card[c].to + count;
	}
	return 0;
}

static int make_card(void *context, int c, struct error *err)
{
	struct plan *plan = context;
	struct walk walk = {.backend = plan->device->backend, .card = plan->device->card[c], .plans = true};
	int code = bytes_beside(plan, c, &walk.beside, err);

	return code == 0 ? walk_card(plan, c, &walk, err) : code;
}

static void summarise(struct plan *plan)
{
	const struct backend *backend = plan->device->backend;
	const struct card_plan *card = &plan->card[0];
	int most = 0;

	for (int c = 0; c < plan->parts; c++)
		most = plan->card[c].geometry.rows > most ? plan->card[c].geometry.rows : most;
	snprintf(plan->summary, sizeof(plan->summary),
		 "%d cards%s: slabs of %d slices, seen by %d of %d rows, %d views at a time; %.150s",
		 plan->device->count, plan->device->connected ? "" : " through the host", card->grid.size[2], most,
		 plan->options.geometry->rows, plan->batch,
		 backend->plan_summary(card->between != NULL ? card->between : card->slab));
}

int cards_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan, struct error *err)
{
	struct plan *plan = calloc(1, sizeof(*plan));
	int code;

	if (plan == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan");
	code = plan_describe(plan, device, options, err);
	if (code == 0)
		code = allocate_lists(plan, err);
	if (code == 0)
		code = crew_run(device->crew, make_card, plan, err);
	if (code < 0) {
		cards_plan_free(plan);
		return code;
	}
	summarise(plan);
	*ret_plan = plan;
	return 0;
}

void cards_plan_free(struct plan *plan)
{
	if (plan == NULL)
		return;
	plan_clear(plan);
	free(plan);
}

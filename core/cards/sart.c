/*
 * One SART iteration (core/recon/sart.c has the formula) on several cards. Each has the rows of all measured
 * projections that see its slab. For each subset it projects its slab onto them, adds what the other cards have of the
 * same rows, which are few, corrects the rays, and updates its slab from them. So nothing is exchanged but the rows
 * that two slabs share.
 */
#include <math.h>

#include "core/cards/internal.h"

struct update {
	struct plan *plan;
	const struct stack *projections;
	struct volume *volume;
	const int *views; /* of the subset */
	int count;
	int first, now; /* of them: those in hand */
	int before;     /* views of the iteration before the subset */
	struct iteration_sums sums[CARDS_MOST];
};

static const struct backend *below(const struct update *update)
{
	return update->plan->device->backend;
}

/* ---- the measured rows ---- */

static int take_measured(void *context, int c, struct error *err)
{
	const struct update *update = context;
	const struct plan *plan = update->plan;
	const struct device *device = plan->device;
	const struct card_plan *card = &plan->card[c];
	int code = 0;

	for (int s = 0; s < device->count && c < plan->parts && code == 0; s++) {
		const struct passage passage = {
		    .from = update->projections->part[s],
		    .to = card->measured,
		    .columns = plan->options.geometry->columns,
		    .from_rows = plan->options.geometry->rows,
		    .to_rows = card->geometry.rows,
		    .from_row = card->row,
		    .rows = card->geometry.rows,
		    .host = plan->host,
		};
		int count = 0;

		for (int v = 0; v < plan->options.geometry->count; v++) {
			if (slot_card(device, v) != s)
				continue;
			card->from[count] = slot_place(device, v);
			card->to[count++] = v;
		}
		code = cards_pass(device, &passage, card->from, card->to, count, err);
	}
	return code;
}

/* Rows that see no slab have residuals, too. */
static int square_unseen(void *context, int c, struct error *err)
{
	struct update *update = context;
	const struct plan *plan = update->plan;
	const int count = slots_on(plan->device, plan->options.geometry->count, c);

	update->sums[c].residual2 = 0;
	return count == 0 ? 0
			  : below(update)->sart_squares(plan->card[c].intake, update->projections->part[c], count,
							plan->seen, &update->sums[c].residual2, err);
}

static int bring_measured(struct update *update, struct error *err)
{
	struct plan *plan = update->plan;
	struct device *device = plan->device;
	int code;

	if (plan->measured == update->projections->written)
		return 0;
	plan->measured = 0;
	code = cards_exchange(device, take_measured, update, err);
	if (code == 0)
		code = crew_run(device->crew, square_unseen, update, err);
	if (code < 0)
		return code;
	plan->unseen = 0;
	for (int c = 0; c < device->count; c++)
		plan->unseen += update->sums[c].residual2;
	plan->measured = update->projections->written;
	return 0;
}

/* ---- a subset ---- */

static int project_views(void *context, int c, struct error *err)
{
	const struct update *update = context;
	struct plan *plan = update->plan;
	struct card_plan *card = &plan->card[c];
	int code;

	if (c >= plan->parts)
		return 0;
	/* The volume between slices of zeros stays what it is from batch to batch, but for the matched pair. */
	code = update->first == 0 || plan->options.matched ? slab_enter(plan, c, update->volume->part[c], err) : 0;
	return code == 0 ? below(update)->project(card->between, card->padded, update->views + update->first,
						  update->now, card->in[0], err)
			 : code;
}

/* The slab's rays and what the others have of their rows. */
static int join_views(void *context, int c, struct error *err)
{
	const struct update *update = context;
	const struct plan *plan = update->plan;
	const struct card_plan *card = &plan->card[c];
	const int columns = plan->options.geometry->columns, rows = card->geometry.rows;
	struct passage passage = {.from = card->in[0],
				  .to = card->in[1],
				  .columns = columns,
				  .from_rows = rows,
				  .to_rows = rows,
				  .rows = rows,
				  .host = plan->host};
	int code;

	if (c >= plan->parts)
		return 0;
	for (int i = 0; i < update->now; i++)
		card->to[i] = i;
	code = cards_pass(plan->device, &passage, card->to, card->to, update->now, err);
	for (int s = 0; s < plan->parts && code == 0; s++) {
		const struct card_plan *other = &plan->card[s];
		const int low = other->row > card->row ? other->row : card->row;
		const int end = card->row + rows, other_end = other->row + other->geometry.rows;

		passage.from = other->in[0];
		passage.from_rows = other->geometry.rows;
		passage.from_row = low - other->row;
		passage.to_row = low - card->row;
		passage.rows = (end < other_end ? end : other_end) - low;
		passage.add = true;
		if (s != c)
			code = cards_pass(plan->device, &passage, card->to, card->to, update->now, err);
	}
	return code;
}

/* Column sums, as the backprojection of ones. */
static int cover_slab(const struct update *update, int c, struct error *err)
{
	struct plan *plan = update->plan;
	struct card_plan *card = &plan->card[c];
	int code;

	if (plan->covered >= 0)
		return 0;
	if (!goes_between(plan, BACKPROJECT_PLAIN))
		return below(update)->sart_coverage(card->slab, update->views, update->count, card->coverage, err);
	code = below(update)->sart_coverage(card->between, update->views, update->count, card->padded, err);
	return code == 0 ? slab_leave(plan, c, card->coverage, err) : code;
}

/* Adds the backprojection of the views in hand to the slab's sums. */
static int add_sums(const struct update *update, int c, struct error *err)
{
	struct plan *plan = update->plan;
	struct card_plan *card = &plan->card[c];
	const int *views = update->views + update->first;
	int code = update->first == 0 ? below(update)->volume_fill(card->sums, 0, err) : 0;

	if (code < 0)
		return code;
	if (!goes_between(plan, BACKPROJECT_PLAIN))
		return below(update)->backproject(card->slab, card->in[1], views, update->now, BACKPROJECT_PLAIN,
						  card->sums, err);
	/* The transpose of the projection adds to slices beyond the slab, too, which are other cards' to work out. */
	code = slab_enter(plan, c, card->sums, err);
	if (code == 0)
		code = below(update)->backproject(card->between, card->in[1], views, update->now, BACKPROJECT_PLAIN,
						  card->padded, err);
	return code == 0 ? slab_leave(plan, c, card->sums, err) : code;
}

static double least_of(const struct plan *plan)
{
	const double *mm = plan->options.grid->spacing;

	return plan->options.matched ? COLUMN_SUM_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]) : 0;
}

/* A subset of one batch in one go where the backend can. */
static bool goes_at_once(const struct update *update)
{
	return below(update)->sart_take != NULL && !update->plan->options.matched &&
	       update->count <= batch_of(update->plan, update->count);
}

static int take_views(void *context, int c, struct error *err)
{
	struct update *update = context;
	struct plan *plan = update->plan;
	struct card_plan *card = &plan->card[c];
	const struct backend *backend = below(update);
	struct volume *volume = update->volume->part[c];
	const bool last = update->first + update->now == update->count, at_once = goes_at_once(update);
	struct sart_options options = *plan->options.sart;
	int code;

	if (c >= plan->parts)
		return 0;
	code = backend->sart_correct(card->slab, &card->geometry, plan->options.grid, card->measured,
				     update->views + update->first, update->now, card->counted_before,
				     update->before + update->first, card->in[1], err);
	if (code == 0 && !at_once)
		code = add_sums(update, c, err);
	if (code < 0 || !last)
		return code;
	if (!card->covered)
		code = cover_slab(update, c, err);
	if (code < 0)
		return code;
	if (at_once)
		return backend->sart_take(card->slab, plan->options.sart, least_of(plan), card->in[1], update->views,
					  update->count, card->coverage, volume, err);
	if (card->covered)
		options.relaxation /= update->count;
	return backend->sart_update(&options, least_of(plan), card->sums, card->coverage, volume, err);
}

static int join_and_take_views(void *context, int c, struct error *err)
{
	int code = join_views(context, c, err);

	return code == 0 ? take_views(context, c, err) : code;
}

static int take_subset(struct update *update, const struct cancel *cancel, struct error *err)
{
	struct plan *plan = update->plan;
	struct device *device = plan->device;
	int code = 0;

	for (update->first = 0; update->first < update->count && code == 0; update->first += update->now) {
		const int left = update->count - update->first;

		update->now = batch_of(plan, left);
		code = cancel_check(cancel, err);
		if (code == 0)
			code = crew_run(device->crew, project_views, update, err);
		if (code == 0 && device->connected) {
			code = crew_run(device->crew, join_and_take_views, update, err);
		} else if (code == 0) {
			code = cards_exchange(device, join_views, update, err);
			if (code == 0)
				code = crew_run(device->crew, take_views, update, err);
		}
	}
	return code;
}

static int sum_squares(void *context, int c, struct error *err)
{
	struct update *update = context;
	const struct plan *plan = update->plan;

	update->sums[c] = (struct iteration_sums){0};
	return c >= plan->parts ? 0
				: below(update)->sart_sums(plan->card[c].slab, update->before, &update->sums[c], err);
}

int cards_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		       const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	const struct sart_options *sart = plan->options.sart;
	struct update update = {.plan = plan, .projections = projections, .volume = volume};
	struct iteration_sums sums = {0};
	int code;

	if (sart == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without SART");
	code = bring_measured(&update, err);
	for (int s = 0; s < sart->subsets.count && code == 0; s++) {
		update.views = sart->subsets.order + sart->subsets.start[s];
		update.count = sart->subsets.start[s + 1] - sart->subsets.start[s];
		if (update.count == 0)
			continue;
		code = take_subset(&update, cancel, err);
		update.before += update.count;
		/* With one subset the column sums are made once. */
		plan->covered = code == 0 && sart->subsets.count == 1 ? s : -1;
	}
	if (code == 0)
		code = crew_run(plan->device->crew, sum_squares, &update, err);
	if (code < 0)
		return code;
	sums.residual2 = sums.projection2 = plan->unseen;
	for (int c = 0; c < plan->device->count; c++) {
		sums.residual2 += update.sums[c].residual2;
		sums.projection2 += update.sums[c].projection2;
	}
	*ret_sums = sums;
	return 0;
}

/*
 * One SART iteration (core/recon/sart.c has the formula) on several cards: for each subset the projections of the
 * volume, collected where the measured ones lie and corrected there, their backprojection through the slabs, and each
 * slab's update.
 */
#include <math.h>

#include "core/cards/internal.h"

struct update {
	struct plan *plan;
	const struct stack *projections;
	struct volume *volume;
	const int *views;
	int count;
	struct iteration_sums sums[CARDS_MOST];
};

/* A subset's corrections lie where the views do, one after the other. */
static void place_rays(struct plan *plan, const int *views, int count)
{
	int on[CARDS_MOST] = {0};

	for (int i = 0; i < count; i++) {
		const int c = slot_card(plan->device, views[i]);

		plan->places[i] = (struct place){c, on[c]++};
	}
}

static int correct_rays(void *context, int c, struct error *err)
{
	struct update *update = context;
	struct plan *plan = update->plan;
	struct card_plan *card = &plan->card[c];
	int count = 0;

	update->sums[c] = (struct iteration_sums){0};
	for (int i = 0; i < update->count; i++) {
		if (plan->places[i].card != c)
			continue;
		card->from[count] = slot_place(plan->device, update->views[i]);
		card->views[count++] = update->views[i];
	}
	return count == 0
		   ? 0
		   : plan->device->backend->sart_correct(card->intake, plan->options.geometry, plan->options.grid,
							 update->projections->part[c], card->from, card->views, count,
							 card->rays, &update->sums[c], err);
}

static int clear_sums(void *context, int c, struct error *err)
{
	const struct plan *plan = ((struct update *)context)->plan;

	return c < plan->parts ? plan->device->backend->volume_fill(plan->card[c].sums, 0, err) : 0;
}

/* Column sums, as the backprojection of ones. */
static int cover_slab(void *context, int c, struct error *err)
{
	const struct update *update = context;
	struct plan *plan = update->plan;
	const struct backend *backend = plan->device->backend;
	struct card_plan *card = &plan->card[c];
	int code;

	if (c >= plan->parts)
		return 0;
	if (!goes_between(plan, BACKPROJECT_PLAIN))
		return backend->sart_coverage(card->slab, update->views, update->count, card->coverage, err);
	code = backend->sart_coverage(card->between, update->views, update->count, card->padded, err);
	return code == 0 ? slab_leave(plan, c, card->coverage, err) : code;
}

static int update_slab(void *context, int c, struct error *err)
{
	const struct update *update = context;
	const struct plan *plan = update->plan;
	const struct backend *backend = plan->device->backend;
	const struct card_plan *card = &plan->card[c];
	const double *mm = plan->options.grid->spacing;
	const double least = plan->options.matched ? COLUMN_SUM_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]) : 0;

	return c >= plan->parts ? 0
				: backend->sart_update(plan->options.sart, least, card->sums, card->coverage,
						       update->volume->part[c], err);
}

static int take_subset(struct update *update, const struct cancel *cancel, struct iteration_sums *sums,
		       struct error *err)
{
	struct plan *plan = update->plan;
	struct device *device = plan->device;
	struct stack *rays[CARDS_MOST];
	struct volume *to[CARDS_MOST];
	int code;

	for (int c = 0; c < device->count; c++) {
		rays[c] = plan->card[c].rays;
		to[c] = plan->card[c].sums;
	}
	place_rays(plan, update->views, update->count);
	code = project_through(plan, update->volume, update->views, update->count, rays, cancel, err);
	if (code == 0)
		code = crew_run(device->crew, correct_rays, update, err);
	if (code == 0)
		code = crew_run(device->crew, clear_sums, update, err);
	if (code == 0)
		code =
		    backproject_through(plan, rays, update->views, update->count, BACKPROJECT_PLAIN, to, cancel, err);
	if (code == 0 && plan->covered < 0)
		code = cards_exchange(device, cover_slab, update, err);
	if (code == 0)
		code = crew_run(device->crew, update_slab, update, err);
	for (int c = 0; c < device->count && code == 0; c++) {
		sums->residual2 += update->sums[c].residual2;
		sums->projection2 += update->sums[c].projection2;
	}
	return code;
}

int cards_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		       const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	const struct sart_options *sart = plan->options.sart;
	struct iteration_sums sums = {0};
	int code = 0;

	if (sart == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without SART");
	for (int s = 0; s < sart->subsets.count && code == 0; s++) {
		struct update update = {
		    .plan = plan,
		    .projections = projections,
		    .volume = volume,
		    .views = sart->subsets.order + sart->subsets.start[s],
		    .count = sart->subsets.start[s + 1] - sart->subsets.start[s],
		};

		if (update.count == 0)
			continue;
		code = take_subset(&update, cancel, &sums, err);
		/* With one subset the column sums are made once. */
		plan->covered = code == 0 && sart->subsets.count == 1 ? s : -1;
	}
	if (code == 0)
		*ret_sums = sums;
	return code;
}

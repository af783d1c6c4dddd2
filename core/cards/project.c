/*
 * Line integrals, filtered views, forward and backprojection on several cards: cards.h. A projection is the sum of
 * those through the slabs, each between two slices of zeros, as out of core (core/outofcore/project.c).
 *
 * Cards do not wait for each other's batches but where they read them: two stacks take turns.
 */
#include "core/cards/internal.h"

void place_slots(struct plan *plan, int count)
{
	for (int i = 0; i < count; i++)
		plan->places[i] = (struct place){slot_card(plan->device, i), slot_place(plan->device, i)};
}

/* A call in hand, and the views of its batch. */
struct pass {
	struct plan *plan;
	const int *views;
	int count;
	struct stack *const *parts; /* [card], where the views lie */
	struct volume *const *to;   /* [card] */
	const struct volume *from;
	enum backprojection weight;
	int first, now, half;
};

/* The next batch; false: there is none. */
static bool pass_next(struct pass *pass)
{
	const int batch = batch_of(pass->plan, pass->count), left = pass->count - pass->first - pass->now;

	pass->first += pass->now;
	pass->half = 1 - pass->half;
	pass->now = left < batch ? left : batch;
	return left > 0;
}

/* Views of the batch that lie on card `on`: their numbers in it, and their slots there. */
static int list_views(const struct pass *pass, int on, int *ret_numbers, int *ret_slots)
{
	int count = 0;

	for (int k = 0; k < pass->now; k++) {
		const struct place *place = &pass->plan->places[pass->first + k];

		if (place->card != on)
			continue;
		ret_numbers[count] = k;
		ret_slots[count++] = place->slot;
	}
	return count;
}

/* ---- forward ---- */

int slab_enter(struct plan *plan, int c, const struct volume *from, struct error *err)
{
	struct card_plan *card = &plan->card[c];

	return cards_pass_slices(plan->device, from, 0, card->padded, card->below, card->grid.size[2], card->host, err);
}

int slab_leave(struct plan *plan, int c, struct volume *to, struct error *err)
{
	struct card_plan *card = &plan->card[c];
	int code =
	    cards_pass_slices(plan->device, card->padded, card->below, to, 0, card->grid.size[2], card->host, err);

	return code == 0 ? plan->device->backend->volume_fill(card->padded, 0, err) : code;
}

/* Zeros for the sums, and the slab between its slices of zeros. */
static int begin_projection(void *context, int c, struct error *err)
{
	const struct pass *pass = context;
	struct plan *plan = pass->plan;
	int slots = 0, code = 0;

	for (int i = 0; i < pass->count; i++)
		slots += plan->places[i].card == c;
	if (slots > 0)
		code = plan->device->backend->stack_fill(pass->parts[c], slots, 0, err);
	return code == 0 && c < plan->parts ? slab_enter(plan, c, pass->from->part[c], err) : code;
}

static int project_batch(void *context, int c, struct error *err)
{
	const struct pass *pass = context;
	struct card_plan *card = &pass->plan->card[c];

	return c >= pass->plan->parts
		   ? 0
		   : pass->plan->device->backend->project(card->between, card->padded, pass->views + pass->first,
							  pass->now, card->in[pass->half], err);
}

/* Adds the rows of all slabs to the views that lie here, in the order of the slabs. */
static int collect_batch(void *context, int c, struct error *err)
{
	const struct pass *pass = context;
	const struct plan *plan = pass->plan;
	const struct card_plan *card = &plan->card[c];
	const int count = list_views(pass, c, card->from, card->to);
	int code = 0;

	for (int s = 0; s < plan->parts && code == 0; s++) {
		const struct card_plan *slab = &plan->card[s];
		const struct passage passage = {
		    .from = slab->in[pass->half],
		    .to = pass->parts[c],
		    .columns = plan->options.geometry->columns,
		    .from_rows = slab->geometry.rows,
		    .to_rows = plan->options.geometry->rows,
		    .to_row = slab->row,
		    .rows = slab->geometry.rows,
		    .add = true,
		    .host = plan->host,
		};

		code = cards_pass(plan->device, &passage, card->from, card->to, count, err);
	}
	return code;
}

int project_through(struct plan *plan, const struct volume *from, const int *views, int count,
		    struct stack *const parts[], const struct cancel *cancel, struct error *err)
{
	struct pass pass = {.plan = plan, .views = views, .count = count, .parts = parts, .from = from};
	struct device *device = plan->device;
	int code;

	if (plan->options.no_projection)
		return error_set(err, ERR_INTERNAL, "the plan was made without forward projection");
	code = cards_exchange(device, begin_projection, &pass, err);
	while (code == 0 && pass_next(&pass)) {
		code = cancel_check(cancel, err);
		if (code == 0)
			code = crew_run(device->crew, project_batch, &pass, err);
		if (code == 0)
			code = cards_exchange(device, collect_batch, &pass, err);
	}
	return code;
}

int cards_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		  struct error *err)
{
	if (count > to->slots || count > plan->options.geometry->count)
		return error_set(err, ERR_INTERNAL, "%d views into a stack of %d", count, to->slots);
	place_slots(plan, count);
	stack_written(to);
	return project_through(plan, from, views, count, to->part, NULL, err);
}

/* ---- back ---- */

static struct stack *stack_in(const struct pass *pass, int c)
{
	const struct card_plan *card = &pass->plan->card[c];

	return pass->weight == BACKPROJECT_FDK && card->wide[0] != NULL ? card->wide[pass->half] : card->in[pass->half];
}

/* Columns of the stacks that are backprojected. */
static int columns_in(const struct pass *pass)
{
	const struct plan_options *options = &pass->plan->options;

	return options->geometry->columns + (pass->weight == BACKPROJECT_FDK ? options->pad[0] + options->pad[1] : 0);
}

/* Takes the rows that see the slab, of all views of the batch. */
static int spread_batch(void *context, int c, struct error *err)
{
	const struct pass *pass = context;
	const struct plan *plan = pass->plan;
	const struct card_plan *card = &plan->card[c];
	int code = 0;

	for (int s = 0; s < plan->device->count && c < plan->parts && code == 0; s++) {
		const struct passage passage = {
		    .from = pass->parts[s],
		    .to = stack_in(pass, c),
		    .columns = columns_in(pass),
		    .from_rows = plan->options.geometry->rows,
		    .to_rows = card->geometry.rows,
		    .from_row = card->row,
		    .rows = card->geometry.rows,
		    .host = plan->host,
		};
		const int count = list_views(pass, s, card->to, card->from);

		code = cards_pass(plan->device, &passage, card->from, card->to, count, err);
	}
	return code;
}

static int backproject_batch(void *context, int c, struct error *err)
{
	const struct pass *pass = context;
	const struct card_plan *card = &pass->plan->card[c];
	const bool between = goes_between(pass->plan, pass->weight);

	return c >= pass->plan->parts
		   ? 0
		   : pass->plan->device->backend->backproject(between ? card->between : card->slab, stack_in(pass, c),
							      pass->views + pass->first, pass->now, pass->weight,
							      between ? card->padded : pass->to[c], err);
}

/* The transpose of the projection adds to slices beyond the slab, too, which are other cards' to work out. */
static int enter_between(void *context, int c, struct error *err)
{
	const struct pass *pass = context;

	return c < pass->plan->parts ? slab_enter(pass->plan, c, pass->to[c], err) : 0;
}

static int leave_between(void *context, int c, struct error *err)
{
	const struct pass *pass = context;

	return c < pass->plan->parts ? slab_leave(pass->plan, c, pass->to[c], err) : 0;
}

int backproject_through(struct plan *plan, struct stack *const parts[], const int *views, int count,
			enum backprojection weight, struct volume *const to[], const struct cancel *cancel,
			struct error *err)
{
	struct pass pass = {.plan = plan, .views = views, .count = count, .parts = parts, .to = to, .weight = weight};
	struct device *device = plan->device;
	const bool between = goes_between(plan, weight);
	int code = between ? cards_exchange(device, enter_between, &pass, err) : 0;

	while (code == 0 && pass_next(&pass)) {
		code = cancel_check(cancel, err);
		if (code == 0)
			code = cards_exchange(device, spread_batch, &pass, err);
		if (code == 0)
			code = crew_run(device->crew, backproject_batch, &pass, err);
	}
	return code == 0 && between ? cards_exchange(device, leave_between, &pass, err) : code;
}

int cards_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		      enum backprojection weight, struct volume *to, struct error *err)
{
	const bool fdk = weight == BACKPROJECT_FDK;

	if (fdk ? plan->options.column_weights == NULL : plan->card[0].in[0] == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without this backprojection");
	if (count > from->slots || count > plan->options.geometry->count)
		return error_set(err, ERR_INTERNAL, "%d views from a stack of %d", count, from->slots);
	place_slots(plan, count);
	return backproject_through(plan, from->part, views, count, weight, to->part, NULL, err);
}

/* ---- what works on single projections ---- */

int cards_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		    struct defect_counts *counts, struct error *err)
{
	const struct device *device = plan->device;
	const size_t bytes = (size_t)to->columns * (size_t)to->rows * linearise_sample_bytes(&plan->options.linearise);
	int code = 0;

	stack_written(to);
	for (int i = 0; i < count && code == 0; i++) {
		int c, place;

		if (slots[i] < 0 || slots[i] >= to->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], to->slots);
		c = slot_card(device, slots[i]);
		place = slot_place(device, slots[i]);
		code = device->backend->linearise(plan->card[c].intake, (const char *)samples + (size_t)i * bytes, 1,
						  &place, to->part[c], counts, err);
	}
	return code;
}

struct filtering {
	struct plan *plan;
	const struct stack *from;
	const int *slots, *views;
	int count;
	struct stack *to;
};

static int slot_from(const struct filtering *filtering, int i)
{
	return filtering->slots != NULL ? filtering->slots[i] : filtering->views[i];
}

/* True if all that card c filters lies there. */
static bool lies_there(const struct filtering *filtering, int c)
{
	const struct device *device = filtering->plan->device;

	for (int i = 0; i < filtering->count; i++)
		if (slot_card(device, i) == c && slot_card(device, slot_from(filtering, i)) != c)
			return false;
	return true;
}

/* Brings views to the card that filters them. */
static int take_views(void *context, int c, struct error *err)
{
	const struct filtering *filtering = context;
	struct plan *plan = filtering->plan;
	const struct geometry *geometry = plan->options.geometry;
	const struct device *device = plan->device;
	struct card_plan *card = &plan->card[c];
	int code = 0;

	if (lies_there(filtering, c))
		return 0;
	if (filtering->count > plan->filter_batch)
		return error_set(err, ERR_INTERNAL, "%d views to filter at once, at most %d", filtering->count,
				 plan->filter_batch);
	for (int s = 0; s < device->count && code == 0; s++) {
		const struct passage passage = {
		    .from = filtering->from->part[s],
		    .to = card->taken,
		    .columns = geometry->columns,
		    .from_rows = geometry->rows,
		    .to_rows = geometry->rows,
		    .rows = geometry->rows,
		    .host = plan->host,
		};
		int count = 0, number = 0;

		for (int i = 0; i < filtering->count; i++) {
			if (slot_card(device, i) != c)
				continue;
			if (slot_card(device, slot_from(filtering, i)) == s) {
				card->from[count] = slot_place(device, slot_from(filtering, i));
				card->to[count++] = number;
			}
			number++;
		}
		code = cards_pass(device, &passage, card->from, card->to, count, err);
	}
	return code;
}

static int filter_views(void *context, int c, struct error *err)
{
	const struct filtering *filtering = context;
	const struct device *device = filtering->plan->device;
	struct card_plan *card = &filtering->plan->card[c];
	const bool there = lies_there(filtering, c);
	int count = 0;

	for (int i = 0; i < filtering->count; i++) {
		if (slot_card(device, i) != c)
			continue;
		card->from[count] = there ? slot_place(device, slot_from(filtering, i)) : count;
		card->views[count++] = filtering->views[i];
	}
	return count == 0 ? 0
			  : device->backend->filter(card->intake, there ? filtering->from->part[c] : card->taken,
						    card->from, card->views, count, filtering->to->part[c], err);
}

int cards_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		 struct stack *to, struct error *err)
{
	struct filtering filtering = {plan, from, slots, views, count, to};
	int code;

	if (plan->options.column_weights == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without FDK");
	if (count > to->slots || count > plan->options.geometry->count)
		return error_set(err, ERR_INTERNAL, "%d views into a stack of %d", count, to->slots);
	stack_written(to);
	code = cards_exchange(plan->device, take_views, &filtering, err);
	return code == 0 ? crew_run(plan->device->crew, filter_views, &filtering, err) : code;
}

int cards_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err)
{
	size_t sum[2] = {0};

	for (int c = 0; c < plan->device->count; c++) {
		size_t rows[2];
		int code = plan->device->backend->filter_extended(plan->card[c].intake, rows, err);

		if (code < 0)
			return code;
		sum[0] += rows[0];
		sum[1] += rows[1];
	}
	ret_rows[0] = sum[0];
	ret_rows[1] = sum[1];
	return 0;
}

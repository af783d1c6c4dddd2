/* The algebra of iterative methods on several cards, each on its own slices and slots; dots add up in their order. */
#include <stdlib.h>

#include "core/cards/internal.h"

/* An operation and what it works on. */
struct operands {
	double a, b;
	float value;
	const struct volume *vx;
	struct volume *vy;
	const struct stack *w, *x;
	struct stack *y;
	int count;
	struct plan *plan;
	double sums[CARDS_MOST];
};

/* ---- volumes ---- */

static const struct backend *below(const struct operands *operands)
{
	return (operands->vy != NULL ? operands->vy->device : operands->y->device)->backend;
}

static int run_volumes(crew_work *work, struct operands *operands, struct error *err)
{
	return crew_run(operands->vy->device->crew, work, operands, err);
}

static int volume_fill(void *context, int c, struct error *err)
{
	const struct operands *o = context;

	return o->vy->part[c] == NULL ? 0 : below(o)->volume_fill(o->vy->part[c], o->value, err);
}

static int volume_copy(void *context, int c, struct error *err)
{
	const struct operands *o = context;

	return o->vy->part[c] == NULL ? 0 : below(o)->volume_copy(o->vy->part[c], o->vx->part[c], err);
}

static int volume_axpby(void *context, int c, struct error *err)
{
	const struct operands *o = context;

	return o->vy->part[c] == NULL ? 0 : below(o)->volume_axpby(o->a, o->vx->part[c], o->b, o->vy->part[c], err);
}

static int volume_divide(void *context, int c, struct error *err)
{
	const struct operands *o = context;

	return o->vy->part[c] == NULL ? 0 : below(o)->volume_divide(o->vx->part[c], o->a, o->vy->part[c], err);
}

static int volume_maximum(void *context, int c, struct error *err)
{
	const struct operands *o = context;

	return o->vy->part[c] == NULL ? 0 : below(o)->volume_maximum(o->a, o->vx->part[c], o->vy->part[c], err);
}

int cards_volume_fill(struct volume *volume, float value, struct error *err)
{
	return run_volumes(volume_fill, &(struct operands){.value = value, .vy = volume}, err);
}

int cards_volume_copy(struct volume *to, const struct volume *from, struct error *err)
{
	return run_volumes(volume_copy, &(struct operands){.vx = from, .vy = to}, err);
}

int cards_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err)
{
	return run_volumes(volume_axpby, &(struct operands){.a = a, .b = b, .vx = x, .vy = y}, err);
}

int cards_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err)
{
	return run_volumes(volume_divide, &(struct operands){.a = least, .vx = x, .vy = y}, err);
}

int cards_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err)
{
	return run_volumes(volume_maximum, &(struct operands){.a = a, .vx = x, .vy = y}, err);
}

/* ---- stacks: the first `count` slots, of which each card has its first ones ---- */

static int run_stacks(crew_work *work, struct operands *operands, struct error *err)
{
	stack_written(operands->y);
	return crew_run(operands->y->device->crew, work, operands, err);
}

static int stack_axpby(void *context, int c, struct error *err)
{
	const struct operands *o = context;
	const int count = slots_on(o->y->device, o->count, c);

	return count == 0 ? 0 : below(o)->stack_axpby(o->a, o->x->part[c], NULL, count, o->b, o->y->part[c], err);
}

static int stack_mask(void *context, int c, struct error *err)
{
	const struct operands *o = context;
	const int count = slots_on(o->y->device, o->count, c);

	return count == 0 ? 0 : below(o)->stack_mask(o->x->part[c], NULL, count, o->y->part[c], err);
}

static int stack_divide(void *context, int c, struct error *err)
{
	const struct operands *o = context;
	const int count = slots_on(o->y->device, o->count, c);

	return count == 0 ? 0 : below(o)->stack_divide(o->x->part[c], o->a, count, o->y->part[c], err);
}

static int stack_multiply(void *context, int c, struct error *err)
{
	const struct operands *o = context;
	const int count = slots_on(o->y->device, o->count, c);

	return count == 0 ? 0 : below(o)->stack_multiply(o->x->part[c], count, o->y->part[c], err);
}

static int stack_fill(void *context, int c, struct error *err)
{
	const struct operands *o = context;
	const int count = slots_on(o->y->device, o->count, c);

	return count == 0 ? 0 : below(o)->stack_fill(o->y->part[c], count, o->value, err);
}

/*
 * Slots of x in the order of y's, in a stack of its own through the host. No algorithm's loop asks for it: what names
 * slots is the plain form of SART, which others are held against.
 */
static int gather(const struct stack *x, const int *slots, int count, struct stack **ret_stack, struct error *err)
{
	float *slot = malloc((size_t)x->columns * (size_t)x->rows * sizeof(*slot));
	struct stack *stack = NULL;
	int code = slot == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a projection") : 0;

	if (code == 0)
		code = backend_cards.stack_new(x->device, x->columns, x->rows, count, &stack, err);
	for (int i = 0; i < count && code == 0; i++) {
		code = backend_cards.stack_download((struct stack *)(void *)x, slots[i], 1, slot, err);
		if (code == 0)
			code = backend_cards.stack_upload(stack, i, 1, slot, err);
	}
	free(slot);
	if (code < 0)
		backend_cards.stack_free(stack);
	else
		*ret_stack = stack;
	return code;
}

/* An operation that takes slots of x, all of which may lie on other cards than y's. */
static int run_gathered(crew_work *work, struct operands *operands, const int *slots, struct error *err)
{
	struct stack *gathered = NULL;
	int code;

	if (slots == NULL)
		return run_stacks(work, operands, err);
	code = gather(operands->x, slots, operands->count, &gathered, err);
	operands->x = gathered;
	if (code == 0)
		code = run_stacks(work, operands, err);
	backend_cards.stack_free(gathered);
	return code;
}

int cards_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
		      struct error *err)
{
	struct operands operands = {.a = a, .b = b, .x = x, .y = y, .count = count};

	return run_gathered(stack_axpby, &operands, slots, err);
}

int cards_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err)
{
	struct operands operands = {.x = x, .y = y, .count = count};

	return run_gathered(stack_mask, &operands, slots, err);
}

int cards_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err)
{
	return run_stacks(stack_divide, &(struct operands){.a = least, .x = x, .y = y, .count = count}, err);
}

int cards_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err)
{
	return run_stacks(stack_multiply, &(struct operands){.x = x, .y = y, .count = count}, err);
}

int cards_stack_fill(struct stack *y, int count, float value, struct error *err)
{
	return run_stacks(stack_fill, &(struct operands){.value = value, .y = y, .count = count}, err);
}

int cards_stack_average(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err)
{
	const struct device *device = y->device;
	const int c = slot_card(device, slot);

	stack_written(y);
	stack_written(work);
	return device->backend->stack_average(y->part[c], slot_place(device, slot), width, work->part[c], err);
}

/* ---- dots ---- */

static int volume_dot(void *context, int c, struct error *err)
{
	struct operands *o = context;

	o->sums[c] = 0;
	return o->vy->part[c] == NULL
		   ? 0
		   : below(o)->volume_dot(o->plan->card[c].slab, o->vx->part[c], o->vy->part[c], &o->sums[c], err);
}

static int stack_dot(void *context, int c, struct error *err)
{
	struct operands *o = context;
	const int count = slots_on(o->y->device, o->count, c);

	o->sums[c] = 0;
	return count == 0 ? 0
			  : below(o)->stack_dot(o->plan->card[c].intake, o->w != NULL ? o->w->part[c] : NULL,
						o->x->part[c], o->y->part[c], count, &o->sums[c], err);
}

static double total(const struct operands *operands, int cards)
{
	double sum = 0;

	for (int c = 0; c < cards; c++)
		sum += operands->sums[c];
	return sum;
}

int cards_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
		     struct error *err)
{
	struct operands operands = {.plan = plan, .vx = x, .vy = (struct volume *)(void *)y};
	int code = run_volumes(volume_dot, &operands, err);

	if (code == 0)
		*ret_sum = total(&operands, plan->device->count);
	return code;
}

int cards_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y, int count,
		    double *ret_sum, struct error *err)
{
	struct operands operands = {.plan = plan, .w = w, .x = x, .y = (struct stack *)(void *)y, .count = count};
	int code = crew_run(y->device->crew, stack_dot, &operands, err);

	if (code == 0)
		*ret_sum = total(&operands, plan->device->count);
	return code;
}

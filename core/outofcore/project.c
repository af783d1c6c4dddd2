/*
 * Forward and backprojection through slabs.
 *
 * A projection is the sum of those through the slabs, each between two slices of
 * zeros: linear interpolation of the volume is the sum of the interpolations of
 * its slabs between zeros, and a ray that enters or leaves a slab's box does
 * so where that is zero. At the ends of the volume there are no such slices, and
 * edge values are held as they are in the whole.
 *
 * The next batch is copied to the device while one is worked on, and the slab
 * before this one comes back in pieces in between.
 */
#include <string.h>

#include "core/outofcore/internal.h"

static int at_most(int count, int most)
{
	return count < most ? count : most;
}

/* Slots first .. first + count - 1 into a stack on the device; *ret_there is the one that has them. */
static int upload_batch(struct plan *plan, const struct slab *slab, struct transfer *transfer, int half,
			const struct stack *from, int first, int count, struct stack **ret_there, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	struct stack *in = transfer->in[half];
	int code = 0;

	if (from->by == NULL && transfer->filtered != NULL)
		in = transfer->filtered;
	*ret_there = in;
	if (from->by == NULL)
		return backend->stack_upload(in, 0, count, from->data + from->pixels * (size_t)first, err);
	for (int i = 0; i < count && code == 0; i++)
		code = backend->stack_upload(
		    in, i, 1, from->source->data + from->source->pixels * (size_t)from->from[first + i], err);
	*ret_there = transfer->filtered;
	return code < 0 ? code
			: backend->filter(slab->plan, in, plan->identity, from->views + first, count,
					  transfer->filtered, err);
}

/* Slices of a slab on the device that have not come back yet. */
struct drain {
	struct slab slab;
	int done;
};

/* Up to so many slices more. */
static int drain_some(struct plan *plan, struct drain *drain, int slices, struct volume *to, struct error *err)
{
	int count = at_most(slices, drain->slab.count - drain->done), code;

	if (drain->slab.volume == NULL || count == 0)
		return 0;
	code = plan->device->backend->volume_download(drain->slab.volume, drain->slab.below + drain->done, count,
						      to->data + to->slice * (size_t)(drain->slab.first + drain->done),
						      err);
	drain->done += count;
	return code;
}

static int drain_all(struct plan *plan, struct drain *drain, struct volume *to, struct error *err)
{
	int code = drain_some(plan, drain, drain->slab.count, to, err);

	slab_close(plan, &drain->slab);
	return code;
}

/* Backprojects all batches into one slab, while the slab before it is copied back. */
static int fill_slab(struct plan *plan, struct slab *slab, struct transfer *transfer, const struct stack *from,
		     const int *views, int count, enum backprojection weight, struct drain *drain, struct volume *to,
		     struct error *err)
{
	const struct backend *backend = plan->device->backend;
	int batches = (count + plan->batch - 1) / plan->batch, code = 0;
	int piece = (drain->slab.count + batches) / (batches > 0 ? batches : 1);

	if (!to->is_zero)
		code = backend->volume_put(slab->volume, slab->below, slab->count,
					   to->data + to->slice * (size_t)slab->first, err);
	for (int b = 0; b < batches && code == 0; b++) {
		int first = b * plan->batch, now = at_most(plan->batch, count - first);
		struct stack *there;

		code = upload_batch(plan, slab, transfer, b % 2, from, first, now, &there, err);
		if (code == 0)
			code = backend->backproject(slab->plan, there, views + first, now, weight, slab->volume, err);
		if (code == 0)
			code = drain_some(plan, drain, piece, to, err);
	}
	return code;
}

int outofcore_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
			  enum backprojection weight, struct volume *to, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	enum purpose purpose = weight == BACKPROJECT_FDK ? FOR_FDK : FOR_SUMS;
	struct drain drain = {.done = 0};
	struct transfer transfer;
	int code;

	if (plan->slices[purpose] == 0)
		return error_set(err, ERR_INTERNAL, "the plan was made without this backprojection");
	code = transfer_open(plan, purpose, &transfer, err);
	for (int z = 0; z < to->size[2] && code == 0; z += plan->slices[purpose]) {
		struct slab slab;

		code = slab_open(plan, purpose, z, &slab, err);
		if (code < 0)
			break;
		code = fill_slab(plan, &slab, &transfer, from, views, count, weight, &drain, to, err);
		if (code == 0)
			code = drain_all(plan, &drain, to, err);
		backend->plan_free(slab.plan);
		slab.plan = NULL;
		if (code < 0)
			slab_close(plan, &slab);
		else
			drain = (struct drain){.slab = slab};
		/* There is room for two slabs of FDK's purpose only. */
		if (code == 0 && purpose != FOR_FDK)
			code = drain_all(plan, &drain, to, err);
	}
	if (code == 0)
		code = drain_all(plan, &drain, to, err);
	slab_close(plan, &drain.slab);
	transfer_close(plan, &transfer);
	to->is_zero = false;
	return code;
}

/* ---- forward ---- */

static void add(float *to, const float *from, size_t pixels, int count)
{
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++)
		for (size_t p = (size_t)i * pixels; p < ((size_t)i + 1) * pixels; p++)
			to[p] += from[p];
}

/* A batch that the device has projected: the first slab's are the sums so far, the others are added. */
static int collect(struct plan *plan, const struct slab *slab, struct stack *in, int first, int count, struct stack *to,
		   struct error *err)
{
	float *sums = to->data + to->pixels * (size_t)first;
	int code = plan->device->backend->stack_download(in, 0, count, slab->first == 0 ? sums : plan->partial, err);

	if (code == 0 && slab->first > 0)
		add(sums, plan->partial, to->pixels, count);
	return code;
}

static int project_slab(struct plan *plan, struct slab *slab, struct transfer *transfer, const struct volume *from,
			const int *views, int count, struct stack *to, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	int code = backend->volume_put(slab->volume, slab->below, slab->count,
				       from->data + from->slice * (size_t)slab->first, err);

	for (int first = 0, b = 0; first < count && code == 0; first += plan->batch, b++) {
		int now = at_most(plan->batch, count - first);

		code = backend->project(slab->plan, slab->volume, views + first, now, transfer->in[b % 2], err);
		if (code == 0 && b > 0)
			code =
			    collect(plan, slab, transfer->in[(b - 1) % 2], first - plan->batch, plan->batch, to, err);
		if (code == 0 && first + now == count)
			code = collect(plan, slab, transfer->in[b % 2], first, now, to, err);
	}
	return code;
}

int outofcore_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		      struct error *err)
{
	struct transfer transfer;
	int code;

	if (plan->slices[FOR_SUMS] == 0)
		return error_set(err, ERR_INTERNAL, "the plan was made without forward projection");
	to->by = NULL;
	code = transfer_open(plan, FOR_SUMS, &transfer, err);
	for (int z = 0; z < from->size[2] && code == 0; z += plan->slices[FOR_SUMS]) {
		struct slab slab;

		code = slab_open(plan, FOR_SUMS, z, &slab, err);
		if (code < 0)
			break;
		code = project_slab(plan, &slab, &transfer, from, views, count, to, err);
		slab_close(plan, &slab);
	}
	transfer_close(plan, &transfer);
	return code;
}

/* ---- stacks that were only noted ---- */

int outofcore_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err)
{
	struct plan *plan = stack->by;
	struct transfer transfer;
	struct slab slab;
	int code;

	if (slot < 0 || count < 0 || slot > stack->slots - count)
		return error_set(err, ERR_INTERNAL, "slots %d to %d of %d", slot, slot + count - 1, stack->slots);
	if (plan == NULL) {
		memcpy(ret_to, stack->data + stack->pixels * (size_t)slot,
		       stack->pixels * (size_t)count * sizeof(float));
		return 0;
	}
	code = transfer_open(plan, FOR_FDK, &transfer, err);
	if (code < 0)
		return code;
	code = slab_open(plan, FOR_FDK, 0, &slab, err);
	for (int done = 0; done < count && code == 0; done += plan->batch) {
		int now = at_most(plan->batch, count - done);
		struct stack *there;

		code = upload_batch(plan, &slab, &transfer, 0, stack, slot + done, now, &there, err);
		if (code == 0)
			code = plan->device->backend->stack_download(there, 0, now,
								     ret_to + stack->pixels * (size_t)done, err);
	}
	slab_close(plan, &slab);
	transfer_close(plan, &transfer);
	return code;
}

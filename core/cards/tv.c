/*
 * TV and norms on several cards. A step of TV reaches one voxel, so a slab with some slices on either side comes out as
 * it would within the whole after as many steps. Then these slices are taken anew from the cards that have them, with
 * all that the method knows of them, so that the whole has the bits of one card.
 */
#include <math.h>
#include <stdatomic.h>

#include "core/cards/internal.h"

/* One card asks the caller whether to go on, in the caller's thread; the others hear of it. */
struct smoothing {
	struct plan *plan;
	struct volume *volume;
	const struct tv_options *options;
	const struct cancel *cancel;
	atomic_bool cancelled;
	int done, now; /* steps, and those in hand */
};

static bool ask(void *context)
{
	struct smoothing *smoothing = context;

	if (smoothing->cancel != NULL && smoothing->cancel->asked != NULL &&
	    smoothing->cancel->asked(smoothing->cancel->context))
		atomic_store(&smoothing->cancelled, true);
	return atomic_load(&smoothing->cancelled);
}

static bool hear(void *context)
{
	struct smoothing *smoothing = context;

	return atomic_load(&smoothing->cancelled);
}

/* The slices low .. high - 1 of the whole volume that belong to slab s and are smoothed on this card; none if not
 * below. */
static void shared_slices(const struct smoothing *smoothing, const struct card_plan *card, int s, int *ret_low,
			  int *ret_high)
{
	const int *first = smoothing->volume->first, end = card->tv_first + card->tv_grid.size[2];

	*ret_low = first[s] > card->tv_first ? first[s] : card->tv_first;
	*ret_high = first[s + 1] < end ? first[s + 1] : end;
}

/* Takes the slab and the slices beside it from the cards that have them. */
static int take_slices(void *context, int c, struct error *err)
{
	const struct smoothing *smoothing = context;
	const struct plan *plan = smoothing->plan;
	const struct card_plan *card = &plan->card[c];
	int code = 0;

	for (int s = 0; s < plan->parts && c < plan->parts && code == 0; s++) {
		int low, high;

		shared_slices(smoothing, card, s, &low, &high);
		code = cards_pass_slices(plan->device, smoothing->volume->part[s], low - smoothing->volume->first[s],
					 card->smoothed, low - card->tv_first, high - low, plan->host, err);
	}
	return code;
}

static int smooth(void *context, int c, struct error *err)
{
	struct smoothing *smoothing = context;
	const struct plan *plan = smoothing->plan;
	const struct backend *backend = plan->device->backend;
	const struct card_plan *card = &plan->card[c];
	const struct cancel cancel = {.asked = c == 0 ? ask : hear, .context = smoothing};

	if (c >= plan->parts)
		return 0;
	if (smoothing->now == smoothing->options->iterations)
		return backend->tv(card->tv, card->smoothed, smoothing->options, &cancel, err);
	return backend->tv_steps(card->tv, card->smoothed, smoothing->options, smoothing->done, smoothing->now, &cancel,
				 err);
}

/* Takes the slices beside the slab again, as they have become where they belong. */
static int take_steps(void *context, int c, struct error *err)
{
	const struct smoothing *smoothing = context;
	const struct plan *plan = smoothing->plan;
	const struct card_plan *card = &plan->card[c];
	int code = 0;

	for (int s = 0; s < plan->parts && c < plan->parts && code == 0; s++) {
		const struct card_plan *other = &plan->card[s];
		int low, high;

		shared_slices(smoothing, card, s, &low, &high);
		if (s != c && low < high)
			code = plan->device->backend->tv_pass(other->tv, other->smoothed, low - other->tv_first,
							      card->tv, card->smoothed, low - card->tv_first,
							      high - low, smoothing->options, smoothing->done, err);
	}
	return code;
}

static int put_slab(void *context, int c, struct error *err)
{
	const struct smoothing *smoothing = context;
	const struct plan *plan = smoothing->plan;
	const struct card_plan *card = &plan->card[c];

	return c >= plan->parts
		   ? 0
		   : cards_pass_slices(plan->device, card->smoothed, smoothing->volume->first[c] - card->tv_first,
				       smoothing->volume->part[c], 0, card->grid.size[2], plan->host, err);
}

int cards_tv(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	     struct error *err)
{
	struct smoothing smoothing = {.plan = plan, .volume = volume, .options = options, .cancel = cancel};
	struct device *device = plan->device;
	int code;

	if (plan->options.tv == NULL || options->iterations > plan->options.tv->iterations)
		return error_set(err, ERR_INTERNAL, "the plan was made without this TV");
	code = cards_exchange(device, take_slices, &smoothing, err);
	while (code == 0 && smoothing.done < options->iterations) {
		const int left = options->iterations - smoothing.done;

		smoothing.now = left < plan->tv_steps ? left : plan->tv_steps;
		code = crew_run(device->crew, smooth, &smoothing, err);
		smoothing.done += smoothing.now;
		if (code == 0 && smoothing.done < options->iterations)
			code = cards_exchange(device, take_steps, &smoothing, err);
	}
	return code == 0 ? cards_exchange(device, put_slab, &smoothing, err) : code;
}

/* ---- norms ---- */

struct measuring {
	struct plan *plan;
	const struct volume *volume, *other;
	double unit;
	struct volume_norms norms[CARDS_MOST];
};

static int measure_slab(void *context, int c, struct error *err)
{
	struct measuring *measuring = context;
	const struct plan *plan = measuring->plan;
	const struct volume *other = measuring->other;

	return c >= plan->parts ? 0
				: plan->device->backend->norms(plan->card[c].slab, measuring->volume->part[c],
							       other != NULL ? other->part[c] : NULL, measuring->unit,
							       &measuring->norms[c], err);
}

/* Sum over a slab's last slice of |grad v| with the difference to the next slab's first, less that without. */
static double variation_between(const struct grid *grid, const float *slice, const float *next)
{
	const double *mm = grid->spacing, least = fmin(fmin(mm[0], mm[1]), mm[2]);
	const float wx = (float)(least / mm[0]), wy = (float)(least / mm[1]), wz = (float)(least / mm[2]);
	const int nx = grid->size[0], ny = grid->size[1];
	double sum = 0;

	for (int y = 0; y < ny; y++)
		for (int x = 0; x < nx; x++) {
			const size_t at = (size_t)y * (size_t)nx + (size_t)x;
			const float v = slice[at], dx = x + 1 < nx ? wx * (slice[at + 1] - v) : 0;
			const float dy = y + 1 < ny ? wy * (slice[at + (size_t)nx] - v) : 0, dz = wz * (next[at] - v);

			if (isfinite(v))
				sum += (double)sqrtf(dx * dx + dy * dy + dz * dz) - (double)sqrtf(dx * dx + dy * dy);
		}
	return sum;
}

static int add_variation(struct plan *plan, const struct volume *volume, int c, double *variation, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	const int last = volume->first[c + 1] - volume->first[c] - 1;
	float *slice = plan->host, *next = slice + (size_t)volume->size[0] * (size_t)volume->size[1];
	int code = backend->volume_download(volume->part[c], last, 1, slice, err);

	if (code == 0)
		code = backend->volume_download(volume->part[c + 1], 0, 1, next, err);
	if (code == 0)
		*variation += variation_between(plan->options.grid, slice, next);
	return code;
}

/* Adds a slab's norms; `mean` holds a sum. */
static void add_norms(struct volume_norms *to, const struct volume_norms *from, size_t voxels)
{
	const double finite = (double)(voxels - from->not_finite);

	to->norm2 += from->norm2;
	to->difference2 += from->difference2;
	to->tv += from->tv;
	to->mean += from->mean * finite;
	to->not_finite += from->not_finite;
	if (finite > 0) {
		to->minimum = fmin(to->minimum, from->minimum);
		to->maximum = fmax(to->maximum, from->maximum);
	}
}

int cards_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
		struct volume_norms *ret_norms, struct error *err)
{
	struct measuring measuring = {.plan = plan, .volume = volume, .other = other, .unit = unit};
	struct volume_norms norms = {.minimum = INFINITY, .maximum = -INFINITY};
	double between = 0, finite;
	int code = crew_run(plan->device->crew, measure_slab, &measuring, err);

	for (int c = 0; c < plan->parts && code == 0; c++)
		add_norms(&norms, &measuring.norms[c], grid_voxels(&plan->card[c].grid));
	for (int c = 0; c + 1 < plan->parts && code == 0 && unit > 0; c++)
		code = add_variation(plan, volume, c, &between, err);
	if (code < 0)
		return code;
	finite = (double)(grid_voxels(plan->options.grid) - norms.not_finite);
	norms.tv += unit > 0 ? between / unit : 0;
	norms.mean = finite > 0 ? norms.mean / finite : 0;
	if (finite == 0)
		norms.minimum = norms.maximum = 0;
	*ret_norms = norms;
	return 0;
}

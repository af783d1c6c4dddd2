/* The table of corrections, and what goes over it: see correction.h. */
#include "core/correct/correction.h"

#include <stdlib.h>
#include <string.h>

#include "core/correct/counts.h"
#include "core/correct/exterior_volume.h"
#include "core/correct/input.h"
#include "core/correct/metal.h"

extern const struct correction correction_lag, correction_scatter, correction_flat_dark, correction_air_region,
    correction_hardening, correction_defects, correction_samples, correction_truncation, correction_exterior,
    correction_blank_views, correction_metal, correction_dense, correction_averaging, correction_agreement,
    correction_left_out, correction_within;

/*
 * In the order in which they run. The detector's lag is of all that it has counted, scatter too. Defects of the map are
 * known before an air region's mean is taken, and hardening is that of line integrals. The exterior goes before what
 * leaves rays out, which it could not see through. Blank views are made up for before metal is looked for. Pixels are
 * averaged when the rays that are left out are known. The means of truncated rows are FDK's in the end, whatever was
 * done to them. The check of the geometry changes nothing.
 */
const struct correction *const corrections[CORRECTION_COUNT] = {
    &correction_lag,        &correction_scatter,   &correction_flat_dark,   &correction_defects,
    &correction_air_region, &correction_hardening, &correction_samples,     &correction_truncation,
    &correction_dense,      &correction_exterior,  &correction_blank_views, &correction_metal,
    &correction_left_out,   &correction_averaging, &correction_within,      &correction_agreement,
};

static bool is_wanted(const struct correction *row, const struct recipe *recipe, const struct linearise *linearise)
{
	return row->wanted == NULL || row->wanted(recipe, linearise);
}

static bool chain_has(const struct correction_chain *chain, int i)
{
	return is_wanted(corrections[i], chain->job.recipe, &chain->input->linearise);
}

bool corrections_need(const struct recipe *recipe, const struct linearise *linearise, unsigned int needs)
{
	for (int i = 0; i < CORRECTION_COUNT; i++)
		if ((corrections[i]->needs & needs) != 0 && is_wanted(corrections[i], recipe, linearise))
			return true;
	return false;
}

double corrections_work(const struct recipe *recipe, const struct linearise *linearise)
{
	double work = 0;

	for (int i = 0; i < CORRECTION_COUNT; i++)
		work += is_wanted(corrections[i], recipe, linearise) ? corrections[i]->work : 0;
	return work;
}

int corrections_check(const struct linearise *linearise, const struct geometry *geometry, struct error *err)
{
	int code = 0;

	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->check != NULL)
			code = corrections[i]->check(linearise, geometry, err);
	return code;
}

int corrections_slots(const struct recipe *recipe, const struct linearise *linearise, const struct geometry *geometry)
{
	int most = 0;

	for (int i = 0; i < CORRECTION_COUNT; i++) {
		const struct correction *row = corrections[i];
		const int slots = row->slots != NULL && is_wanted(row, recipe, linearise) ? row->slots(geometry) : 0;

		most = slots > most ? slots : most;
	}
	return most;
}

int corrections_bytes(const struct correction_ask *ask, const struct linearise *linearise,
		      struct correction_bytes *ret_bytes, struct error *err)
{
	struct correction_bytes bytes = {0};
	int code = 0;

	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->bytes != NULL && is_wanted(corrections[i], ask->recipe, linearise))
			code = corrections[i]->bytes(ask, &bytes, err);
	if (code == 0)
		*ret_bytes = bytes;
	return code;
}

int corrections_open(struct correction_chain *ret_chain, const struct correction_job *job, struct input *input,
		     struct error *err)
{
	int code = 0;

	*ret_chain = (struct correction_chain){.job = *job, .input = input};
	ret_chain->job.dense = calloc(1, sizeof(*ret_chain->job.dense));
	ret_chain->job.exterior = calloc(1, sizeof(*ret_chain->job.exterior));
	if (ret_chain->job.dense == NULL || ret_chain->job.exterior == NULL) {
		corrections_close(ret_chain);
		return error_set(err, ERR_NO_MEMORY, "no memory for what corrections share");
	}
	if (counts_wanted(&input->given)) {
		ret_chain->counts = malloc(input->pixels * sizeof(float));
		if (ret_chain->counts == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for the counts of a view");
	}
	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->open != NULL && chain_has(ret_chain, i))
			code = corrections[i]->open(&ret_chain->job, &ret_chain->state[i], err);
	if (code < 0)
		corrections_close(ret_chain);
	return code;
}

void corrections_close(struct correction_chain *chain)
{
	for (int i = 0; i < CORRECTION_COUNT; i++)
		if (corrections[i]->close != NULL)
			corrections[i]->close(chain->state[i]);
	memset(chain->state, 0, sizeof(chain->state));
	free(chain->counts);
	chain->counts = NULL;
	free(chain->job.dense);
	chain->job.dense = NULL;
	if (chain->job.exterior != NULL)
		exterior_volume_clear(chain->job.exterior);
	free(chain->job.exterior);
	chain->job.exterior = NULL;
}

/* Corrects the counts of a view, chain->counts. */
static int correct_counts(struct correction_chain *chain, const void *samples, int view, struct error *err)
{
	const struct input *input = chain->input;
	int code = 0;

	counts_take(&input->given, samples, input->pixels, chain->counts);
	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->counts != NULL && chain_has(chain, i))
			code = corrections[i]->counts(&chain->job, chain->state[i], view, chain->counts, err);
	counts_give(&input->given, samples, input->pixels, chain->counts);
	return code;
}

int corrections_take(struct correction_chain *chain, const void *samples, int view, int slot, struct stack *to,
		     struct error *err)
{
	const struct defect_counts before = chain->input->counts;
	struct correction_view taken = {.view = view, .slot = slot, .to = to, .before = &before};
	int code = 0;

	input_look_at_bytes(chain->input, samples);
	samples = input_bin(chain->input, samples);
	if (chain->counts != NULL) {
		code = correct_counts(chain, samples, view, err);
		samples = chain->counts;
	}
	if (code == 0)
		code = input_take(chain->input, chain->job.backend, chain->job.plan, samples, view, slot, to,
				  &taken.samples, err);

	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->view != NULL && chain_has(chain, i))
			code = corrections[i]->view(&chain->job, chain->state[i], &taken, err);
	return code;
}

int corrections_apply(struct correction_chain *chain, enum correction_time time, bool *ret_changed, struct error *err)
{
	int code = 0;

	*ret_changed = false;
	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++) {
		const struct correction *row = corrections[i];

		if ((row->times & 1U << time) != 0 && row->apply != NULL && chain_has(chain, i))
			code = row->apply(&chain->job, chain->state[i], time, ret_changed, err);
	}
	return code;
}

int corrections_warn(struct correction_chain *chain, bool late, struct error *err)
{
	int code = 0;

	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->warn != NULL && corrections[i]->warns_late == late && chain_has(chain, i))
			code = corrections[i]->warn(&chain->job, chain->state[i], err);
	return code;
}

int corrections_show(struct correction_chain *chain, double *ret_estimate_mm, struct error *err)
{
	int code = 0;

	*ret_estimate_mm = 0;
	for (int i = 0; i < CORRECTION_COUNT && code == 0; i++)
		if (corrections[i]->show != NULL && chain_has(chain, i))
			code = corrections[i]->show(&chain->job, chain->state[i], ret_estimate_mm, err);
	return code;
}

void corrections_mark(const struct correction_chain *chain, struct correction_marks *marks)
{
	for (int i = 0; i < CORRECTION_COUNT; i++)
		if (corrections[i]->mark != NULL && chain_has(chain, i))
			corrections[i]->mark(&chain->job, chain->state[i], marks);
}

void corrections_draw_dense(const struct correction_chain *chain, int view, bool *ret_image)
{
	const struct geometry *geometry = chain->job.geometry;
	const struct metal *dense = chain->job.dense;

	memset(ret_image, 0, (size_t)geometry->columns * (size_t)geometry->rows * sizeof(*ret_image));
	for (size_t i = 0; i < dense->traces_count; i++) {
		const struct metal_trace *trace = &dense->traces[i];

		for (int c = trace->first; trace->view == view && c <= trace->last; c++)
			ret_image[(ptrdiff_t)trace->row * geometry->columns + c] = true;
	}
}

int corrections_hide(struct correction_chain *chain, struct error *err)
{
	int code = 0;

	for (int i = CORRECTION_COUNT - 1; i >= 0 && code == 0; i--)
		if (corrections[i]->hide != NULL && chain_has(chain, i))
			code = corrections[i]->hide(&chain->job, chain->state[i], err);
	return code;
}

/* The row that keeps what it has found; NULL where the job has none. */
static const struct correction *finder(const struct correction_chain *chain, int *ret_index)
{
	for (int i = 0; i < CORRECTION_COUNT; i++)
		if (corrections[i]->found != NULL && chain_has(chain, i)) {
			*ret_index = i;
			return corrections[i];
		}
	return NULL;
}

const void *corrections_found(const struct correction_chain *chain, size_t *ret_bytes)
{
	int index;
	const struct correction *row = finder(chain, &index);

	*ret_bytes = 0;
	return row != NULL ? row->found(chain->state[index], ret_bytes) : NULL;
}

int corrections_resume(struct correction_chain *chain, const void *bytes, size_t size, struct error *err)
{
	int index;
	const struct correction *row = finder(chain, &index);

	if (row == NULL)
		return error_set(err, ERR_INVALID, "%zu bytes of a correction that the job has not", size);
	return row->resume(&chain->job, chain->state[index], bytes, size, err);
}

/* Metal as a correction: see metal.c. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/blank.h"
#include "core/correct/input.h"
#include "core/correct/metal_whole.h"

static bool wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->metal.on;
}

/* What volumes are weighed with, and the volume of the whole field of view. */
static int bytes_of(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	bytes->host += metal_doubt_bytes(&ask->recipe->grid);
	return metal_whole_bytes(ask, bytes, err);
}

static int open_metal(const struct correction_job *job, void **ret_state, struct error *err)
{
	(void)err;
	*ret_state = job->dense;
	return 0;
}

static void close_metal(void *state)
{
	if (state != NULL)
		metal_clear(state);
}

struct metal_tools metal_tools_of(const struct correction_job *job)
{
	return (struct metal_tools){
	    .backend = job->backend,
	    .plan = job->plan,
	    .fdk = job->fdk,
	    .projections = job->projections,
	    .batch = job->batch,
	    .slots = metal_slots(job->geometry),
	    .volume = job->work,
	    .geometry = job->geometry,
	    .grid = &job->recipe->grid,
	    .mu_water = job->recipe->mu_water,
	    .input = job->input,
	    .pixel = fmax(job->orbit->pixel_at_isocentre[0], job->orbit->pixel_at_isocentre[1]),
	    .cancel = job->cancel,
	};
}

/* ---- samples without counts ---- */

/* True if a sample is not above the dark, where the detector could have counted. */
static bool has_no_counts(const struct input *input, const void *samples, size_t at)
{
	float p;

	return linearise_pixel(&input->linearise, samples, at, &p) == PIXEL_ZERO;
}

/* Notes the view's samples without counts; how many there are to *ret_count. */
static int note_dark(const struct input *input, const void *samples, int columns, int view, struct metal *metal,
		     size_t *ret_count, struct error *err)
{
	const int rows = (int)(input->pixels / (size_t)columns);
	size_t count = 0;
	int code = 0;

	for (int row = 0; row < rows && code == 0; row++)
		for (int first = 0, last; first < columns && code == 0; first = last + 1) {
			const size_t at = (size_t)row * (size_t)columns;

			last = first;
			if (!has_no_counts(input, samples, at + (size_t)first))
				continue;
			while (last + 1 < columns && has_no_counts(input, samples, at + (size_t)last + 1))
				last++;
			count += (size_t)(last - first + 1);
			code = metal_note_dark(metal, view, row, first, last, err);
		}
	*ret_count = count;
	return code;
}

/* In a shadow of at least this share of the view's largest line integral a sample without counts is no dead pixel. */
static const float SHADOW = 0.5f;

/*
 * Where a shadow has no counts, its line integrals are above all that was
 * measured, and linearise has bridged them from the shadow's rim: metal would hardly be found.
 */
static int darken(const struct input *input, const struct backend *backend, const void *samples, int slot,
		  struct stack *to, struct error *err)
{
	float *view = malloc(input->pixels * sizeof(float)), largest = 0;
	int code;

	if (view == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	code = backend->stack_download(to, slot, 1, view, err);
	for (size_t i = 0; i < input->pixels && code == 0; i++)
		largest = fmaxf(largest, view[i]);
	for (size_t i = 0; i < input->pixels && code == 0; i++)
		if (view[i] >= SHADOW * largest && has_no_counts(input, samples, i))
			view[i] = largest;
	if (code == 0)
		code = backend->stack_upload(to, slot, 1, view, err);
	free(view);
	return code;
}

/* Samples without counts are noted: a shadow of metal may have them. */
static int take_view(const struct correction_job *job, void *state, const struct correction_view *view,
		     struct error *err)
{
	const struct input *input = job->input;
	size_t dark = 0;
	int code;

	if (input->linearise.quantity != QUANTITY_INTENSITY || input->counts.zero == view->before->zero ||
	    input->counts.blank > view->before->blank)
		return 0;
	code = note_dark(input, view->samples, job->geometry->columns, view->view, state, &dark, err);
	return code < 0 || dark == 0 ? code : darken(input, job->backend, view->samples, view->slot, view->to, err);
}

/* ---- the FDK volume ---- */

static double threshold_of(const struct correction_job *job)
{
	return job->recipe->mu_water * (1 + job->recipe->metal.threshold_hu / 1000);
}

/* The traces of metal in the grid, which is listed, and of what lies outside, where the body goes on there. */
static int find_traces(const struct correction_job *job, struct metal *metal, struct metal_whole *whole,
		       struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	int code = metal->voxels_count > 0 ? metal_find_traces(metal, &tools, err) : 0;

	return code < 0 ? code : metal_whole_make(whole, job, metal, threshold_of(job), err);
}

static int fill_traces(const struct correction_job *job, struct metal *metal, struct metal_whole *whole,
		       struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);

	return whole->there ? metal_replace(metal, &whole->list, &whole->tools, err)
			    : metal_replace(metal, metal, &tools, err);
}

/* Metal's shadows out of the projections, and of the FDK of those and the one before what is better at each place. */
static int replace(const struct correction_job *job, struct metal *metal, struct metal_whole *whole, bool *ret_changed,
		   struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	struct metal_doubt doubt = {0};
	int code = metal_doubt_make(&doubt, metal, &tools, job->volume, whole->there ? &whole->tools : &tools,
				    whole->there ? &whole->list : metal, err);

	if (code == 0)
		code = fill_traces(job, metal, whole, err);
	if (code == 0)
		code = metal_fdk(&tools, job->volume, err);
	if (code == 0)
		code = blank_make_up(job, job->volume, ret_changed, err);
	if (code == 0)
		code = metal_doubt_blend(&doubt, metal, &tools, job->volume, err);
	metal_doubt_clear(&doubt);
	*ret_changed = true;
	return code;
}

static void warn_of_metal(const struct correction_job *job, const struct metal *metal)
{
	const struct geometry *geometry = job->geometry;
	const double samples = (double)geometry->count * (double)geometry->columns * (double)geometry->rows;
	const double hu = job->recipe->metal.threshold_hu, share = 100 * (double)metal->replaced / samples;

	if (metal->voxels_count == 0 && metal->traces_count == 0)
		warning_tell(job->warnings, "no_metal",
			     "nothing in the FDK volume has %g HU or more: no metal was taken out", hu);
	else if (metal->voxels_count == 0)
		warning_tell(job->warnings, "metal",
			     "nothing in the grid is metal, of %g HU or more, but something outside of it is: %zu "
			     "samples (%.3g %%) in %d projections were replaced from what lies beside them, and are "
			     "left out of SART",
			     hu, metal->replaced, share, metal->views);
	else
		warning_tell(job->warnings, "metal",
			     "%zu voxels (%.3g %%) are metal: of %g HU or more, or at least half of that beside them; "
			     "%zu samples (%.3g %%) in %d projections were replaced from what lies beside them, and "
			     "are left out of SART: values within %d mm of metal are estimates",
			     metal->found, 100 * (double)metal->found / (double)grid_voxels(&job->recipe->grid), hu,
			     metal->replaced, share, metal->views, METAL_ESTIMATE_MM);
}

/* The metal of the FDK volume out of the projections, and the FDK of those. */
static int take_out(const struct correction_job *job, struct metal *metal, bool *ret_changed, struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	struct metal_whole whole = {0};
	int code = metal_find(metal, &tools, job->volume, threshold_of(job), err);

	if (code == 0)
		code = find_traces(job, metal, &whole, err);
	if (code == 0 && metal->voxels_count + metal->traces_count > 0)
		code = replace(job, metal, &whole, ret_changed, err);
	if (code == 0)
		warn_of_metal(job, metal);
	metal_whole_clear(&whole);
	return code;
}

/* In a resumed run: the projections become what they were. */
static int take_out_again(const struct correction_job *job, struct metal *metal, struct error *err)
{
	struct metal_whole whole = {0};
	int code = find_traces(job, metal, &whole, err);

	if (code == 0 && metal->voxels_count + metal->traces_count > 0)
		code = fill_traces(job, metal, &whole, err);
	metal_whole_clear(&whole);
	return code;
}

static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	struct metal *metal = state;

	if (time == CORRECT_AFTER_FDK)
		return take_out(job, metal, ret_changed, err);
	if (time == CORRECT_RESUMED)
		return take_out_again(job, metal, err);
	if (metal->traces_count == 0)
		return 0;
	*job->left_out_dense = *job->outside;
	return metal_leave_out(metal, &tools, err);
}

/* ---- volumes that are kept, runs that go on ---- */

static int show(const struct correction_job *job, void *state, double *ret_estimate_mm, struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	struct metal *metal = state;

	if (metal->voxels_count == 0)
		return 0;
	*ret_estimate_mm = METAL_ESTIMATE_MM;
	return metal_show(metal, &tools, job->volume, err);
}

static int hide(const struct correction_job *job, void *state, struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	struct metal *metal = state;

	return metal->voxels_count == 0 ? 0 : metal_hide(metal, &tools, job->volume, err);
}

/* Voxels x[0] .. x[1] of a row. */
struct metal_run {
	int x[2], y, z;
	size_t count; /* entries of the list */
};

/* The run that begins with an entry of the list, which is in order. */
static struct metal_run run_at(const struct metal *metal, size_t i, int columns)
{
	const struct metal_voxel *voxel = &metal->voxels[i];
	const uint32_t row = (uint32_t)columns;
	struct metal_run run = {.y = (int)(voxel->at / row), .z = (int)voxel->z, .count = 1};

	while (i + run.count < metal->voxels_count && voxel[run.count].z == voxel->z &&
	       voxel[run.count].at == voxel->at + run.count && voxel[run.count].at % row != 0)
		run.count++;
	run.x[0] = (int)(voxel->at % row);
	run.x[1] = run.x[0] + (int)run.count - 1;
	return run;
}

/* Marks what lies in a slice within METAL_ESTIMATE_MM of a run whose own slice is dz mm away. */
static void mark_around(const struct grid *grid, const struct metal_run *run, double dz, unsigned char *slice)
{
	const double *mm = grid->spacing, square = (double)METAL_ESTIMATE_MM * METAL_ESTIMATE_MM - dz * dz;
	const int reach = square >= 0 ? (int)(sqrt(square) / mm[1]) : -1;

	for (int y = run->y - reach < 0 ? 0 : run->y - reach; y <= run->y + reach && y < grid->size[1]; y++) {
		const int half = (int)(sqrt(fmax(0, square - pow((y - run->y) * mm[1], 2))) / mm[0]);
		const int first = run->x[0] - half < 0 ? 0 : run->x[0] - half;
		const int last = run->x[1] + half < grid->size[0] ? run->x[1] + half : grid->size[0] - 1;

		memset(slice + grid_voxel(grid, first, y, 0), 1, (size_t)(last - first + 1));
	}
}

static void mark(const struct correction_job *job, const void *state, struct correction_marks *marks)
{
	const struct grid *grid = &job->recipe->grid;
	const struct metal *metal = state;
	struct metal_run run;

	for (size_t i = 0; i < metal->voxels_count; i += run.count) {
		run = run_at(metal, i, grid->size[0]);
		for (int k = 0; k < marks->count; k++)
			mark_around(grid, &run, (run.z - marks->slices[k]) * grid->spacing[2],
				    marks->marked + grid_voxel(grid, 0, 0, k));
	}
	marks->metal += metal->found;
}

static const void *found(const void *state, size_t *ret_bytes)
{
	const struct metal *metal = state;

	*ret_bytes = metal->voxels_count * sizeof(*metal->voxels);
	return metal->voxels;
}

static int resume(const struct correction_job *job, void *state, const void *bytes, size_t size, struct error *err)
{
	return metal_put(state, &job->recipe->grid, bytes, size, err);
}

extern const struct correction correction_metal;
const struct correction correction_metal = {
    .name = "metal",
    .summary = "metal's shadows are replaced by what they would be without, and left out of the iterations",
    .times =
	1U << CORRECT_LINE_INTEGRALS | 1U << CORRECT_AFTER_FDK | 1U << CORRECT_BEFORE_ITERATING | 1U << CORRECT_RESUMED,
    .needs = NEEDS_WHOLE_IMAGES | NEEDS_ALL_VIEWS | NEEDS_VOLUME,
    .work = 14,
    .wanted = wanted,
    .slots = metal_slots,
    .bytes = bytes_of,
    .open = open_metal,
    .close = close_metal,
    .view = take_view,
    .apply = apply,
    .show = show,
    .hide = hide,
    .mark = mark,
    .found = found,
    .resume = resume,
};

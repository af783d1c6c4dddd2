/*
 * Rays through what is very dense are left out of SART: a screw, a rod, a plate in the grid, where metal is not asked
 * for.
 *
 * Voxels make a blur of its edges. What is left of p - A v along a ray beside it is large, and an iteration spreads
 * that over all of the ray: streaks, more with each iteration, where FDK's window has fewer. Without these rays what is
 * dense stays as FDK has it, and the others mend its streaks. tests/bench/results/dense.txt has the figures and what
 * else was tried.
 *
 * Dense are voxels of DENSE times water's attenuation or more, in the volume that the iterations begin with, and what
 * belongs to the same object (metal_find). The list of them is what a run that goes on gets.
 *
 * What is as dense outside of the grid is found in the model of the exterior (dense_outside.c), which lies between the
 * two rows here: one finds, the other leaves out.
 */
#include <stdlib.h>

#include "core/correct/dense.h"

/*
 * An object that is dense itself, with more than this share of dense voxels among those of half of water and more,
 * keeps its rays: without them iterations would be left with nothing.
 */
static const double FEW = 0.1, OBJECT = 0.5;
/*
 * What more than this share of all rays pass is bone, such as a skull or a femur, and keeps its rays too, unless its
 * dense voxels have SURELY times water's attenuation in the mean: iterations mend what FDK has of bone, and metal
 * seldom has as little. The model of the exterior is FDK without a window, whose values are higher by about UNWINDOWED,
 * and too coarse for a wall of bone to be seen as even: there less of the rays are too many.
 */
static const double RAYS_MOST = 0.2, RAYS_MOST_OUTSIDE = 0.1, SURELY = 3.7, UNWINDOWED = 1.15;
/*
 * A voxel stands on a plateau if all of the six one width of FDK's blur away have so much of its value; blurred metal
 * falls faster. Of wires, rods, screws and rails 0 to .07 of the dense voxels do, of femurs and plastic .25 to 1.
 */
static const float PLATEAU = 0.8f;
static const double PLATEAU_SHARE = 0.15;
enum { SLOTS = 4 }; /* that views are projected in */

static bool wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->fdk.on && !recipe->metal.on && recipe->algorithm != NULL;
}

static int slots_of(const struct geometry *geometry)
{
	return geometry->count < SLOTS ? geometry->count : SLOTS;
}

static int bytes_of(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	const struct geometry *geometry = ask->geometry;
	const int slots = slots_of(geometry);

	(void)err;
	if (!ask->subsets)
		return 0;
	bytes->device += ask->backend->stack_bytes(ask->device, geometry->columns, geometry->rows, slots);
	bytes->host += (size_t)slots * (size_t)geometry->columns * (size_t)geometry->rows * sizeof(float);
	return 0;
}

static int open_dense(const struct correction_job *job, void **ret_state, struct error *err)
{
	(void)err;
	*ret_state = job->dense;
	return 0;
}

static void close_dense(void *state)
{
	if (state != NULL)
		metal_clear(state);
}

static int find_traces(const struct correction_job *job, struct metal *dense, struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct metal_tools tools = metal_tools_of(job);
	int code;

	if (dense->voxels_count == 0)
		return 0;
	tools.slots = slots_of(geometry);
	tools.batch = NULL;
	code = job->backend->stack_new(job->device, geometry->columns, geometry->rows, tools.slots, &tools.batch, err);
	if (code == 0)
		code = metal_find_traces(dense, &tools, err);
	job->backend->stack_free(tools.batch);
	return code;
}

/* Without any voxel of at least `least` the volume need not come to the host. */
static int has_any(const struct correction_job *job, double least, bool *ret_any, struct error *err)
{
	const struct backend *backend = job->backend;
	double above = 0;
	int code = backend->volume_fill(job->work, (float)least, err);

	if (code == 0)
		code = backend->volume_axpby(1, job->volume, -1, job->work, err);
	if (code == 0)
		code = backend->volume_maximum(0, job->work, job->work, err);
	if (code == 0)
		code = backend->volume_dot(job->plan, job->work, job->work, &above, err);
	if (code == 0)
		*ret_any = above > 0;
	return code;
}

void dense_add(struct dense_count *to, const float *values, size_t count, double mu_water)
{
	const float body = (float)(OBJECT * mu_water), dense = (float)(DENSE_LEAST * mu_water);

	for (size_t i = 0; i < count; i++) {
		to->object += values[i] >= body;
		if (values[i] >= dense) {
			to->dense++;
			to->mean += (double)values[i];
		}
	}
}

void dense_counted(struct dense_count *count)
{
	count->mean = count->dense > 0 ? count->mean / (double)count->dense : 0;
}

bool dense_is_most(const struct dense_count *count)
{
	return (double)count->dense > FEW * (double)count->object;
}

static int count_dense(const struct correction_job *job, struct dense_count *ret_count, struct error *err)
{
	const struct grid *grid = &job->recipe->grid;
	const size_t slice = (size_t)grid->size[0] * (size_t)grid->size[1];
	float *values = malloc(slice * sizeof(*values));
	struct dense_count count = {0};
	int code = values != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a slice of %zu voxels", slice);

	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		code = job->backend->volume_download(job->volume, z, 1, values, err);
		if (code == 0)
			dense_add(&count, values, slice, job->recipe->mu_water);
	}
	free(values);
	dense_counted(&count);
	if (code == 0)
		*ret_count = count;
	return code;
}

/* The value that the list has at a place, 0: it is not in the list. */
static float value_at(const struct metal *metal, uint32_t z, uint32_t at)
{
	size_t low = 0, high = metal->voxels_count;

	while (low < high) {
		const size_t middle = low + (high - low) / 2;
		const struct metal_voxel *voxel = &metal->voxels[middle];

		if (voxel->z < z || (voxel->z == z && voxel->at < at))
			low = middle + 1;
		else
			high = middle;
	}
	return low < metal->voxels_count && metal->voxels[low].z == z && metal->voxels[low].at == at
		   ? metal->voxels[low].value
		   : 0;
}

/* What goes on beyond the grid is taken to go on evenly. */
static bool is_on_plateau(const struct metal *metal, const struct metal_tools *tools, const struct metal_voxel *voxel)
{
	const struct grid *grid = tools->grid;
	const int nx = grid->size[0];
	const int place[3] = {(int)voxel->at % nx, (int)voxel->at / nx, (int)voxel->z};

	for (int side = 0; side < 6; side++) {
		const int axis = side / 2;
		const double blur = fmax(tools->pixel, grid->spacing[axis]);
		const int away = (int)lround(blur / grid->spacing[axis]);
		int to[3] = {place[0], place[1], place[2]};

		to[axis] += side % 2 ? away : -away;
		if (to[axis] >= 0 && to[axis] < grid->size[axis] &&
		    value_at(metal, (uint32_t)to[2], (uint32_t)(to[1] * nx + to[0])) < PLATEAU * voxel->value)
			return false;
	}
	return true;
}

/* True if what is dense in the list is wide and even, and not as dense as metal. */
static bool is_even(const struct metal *metal, const struct metal_tools *tools)
{
	const float least = (float)(DENSE_LEAST * tools->mu_water), most = (float)(DENSE_EVEN * tools->mu_water);
	size_t dense = 0, even = 0;

#pragma omp parallel for schedule(static) reduction(+ : dense, even)
	for (size_t i = 0; i < metal->voxels_count; i++) {
		const struct metal_voxel *voxel = &metal->voxels[i];

		if (!(voxel->value >= least))
			continue;
		dense++;
		even += voxel->value < most && is_on_plateau(metal, tools, voxel);
	}
	return dense > 0 && (double)even > PLATEAU_SHARE * (double)dense;
}

int dense_find(struct metal *dense, const struct metal_tools *tools, struct volume *from, struct error *err)
{
	int code = metal_find(dense, tools, from, DENSE_LEAST * tools->mu_water, err);

	if (code < 0 || !is_even(dense, tools))
		return code;
	metal_clear(dense);
	return metal_find(dense, tools, from, DENSE_EVEN * tools->mu_water, err);
}

/* The list is empty where nothing is dense, and where too much of the object is, or where that is no metal. */
static int find(const struct correction_job *job, struct metal *dense, struct dense_count *ret_count, struct error *err)
{
	const struct metal_tools tools = metal_tools_of(job);
	const double least = DENSE_LEAST * job->recipe->mu_water;
	bool does = false;
	int code = has_any(job, least, &does, err);

	if (code == 0 && does)
		code = count_dense(job, ret_count, err);
	if (code < 0 || !does || dense_is_most(ret_count))
		return code;
	return dense_find(dense, &tools, job->volume, err);
}

/* Of all rays, those that pass what is dense. */
static double share_of(const struct geometry *geometry, const struct metal *dense)
{
	return (double)dense->replaced / ((double)geometry->count * (double)geometry->columns * (double)geometry->rows);
}

bool dense_passes_too_many(const struct dense_count *count, const struct metal *dense, const struct geometry *geometry,
			   double mu_water, bool windowed)
{
	const double surely = windowed ? SURELY : UNWINDOWED * SURELY;
	const double most = windowed ? RAYS_MOST : RAYS_MOST_OUTSIDE;

	return share_of(geometry, dense) > most && count->mean < surely * mu_water;
}

static void tell_left_out(const struct correction_job *job, const struct metal *dense)
{
	const double hu = 1000 * (DENSE_LEAST - 1), share = 100 * share_of(job->geometry, dense);

	if (dense->found > 0)
		warning_tell(job->warnings, "rays_left_out",
			     "%zu voxels have at least %g HU or belong to such: iterations leave out the %.3g %% of "
			     "the rays that pass them%s",
			     dense->found, hu, share, dense->filled ? ", or what is as dense outside of the grid" : "");
	else
		warning_tell(job->warnings, "rays_left_out",
			     "something outside of the grid has at least %g HU: iterations leave out the %.3g %% of "
			     "the rays that pass it",
			     hu, share);
}

static int leave_out(const struct correction_job *job, struct metal *dense, struct error *err)
{
	struct metal_tools tools = metal_tools_of(job);
	int code = 0;

	if (dense->traces_count == 0)
		return 0;
	tools.slots = slots_of(job->geometry);
	*job->left_out_dense = true;
	/* The start has the model of the exterior where few views see, and no metal is in that. */
	if (*job->iteration == 0 && dense->filled)
		code = metal_show(dense, &tools, job->volume, err);
	if (code == 0 && *job->iteration == 0)
		tell_left_out(job, dense);
	return code == 0 ? metal_leave_out(dense, &tools, err) : code;
}

static void tell_kept(const struct correction_job *job, const struct dense_count *count)
{
	warning_tell(
	    job->warnings, "very_dense",
	    "%zu voxels have at least %g HU, %.3g %% of those of the object, and %.0f HU in the mean: too many, or too "
	    "wide and even for metal, or too many rays pass them, to leave those rays out of the iterations",
	    count->dense, 1000 * (DENSE_LEAST - 1), 100 * (double)count->dense / (double)count->object,
	    1000 * (count->mean / job->recipe->mu_water - 1));
}

/* Least squares ask for all rays; only SART's steps keep what no ray passes. */
static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	const bool first = *job->iteration == 0;
	struct dense_count count = {0};
	int code = 0;

	(void)time;
	(void)ret_changed;
	if (!job->subsets)
		return 0;
	if (first)
		code = find(job, state, &count, err);
	if (code == 0)
		code = find_traces(job, state, err);
	/* A run that goes on has the list of what was left out, or none. */
	if (code == 0 && first && dense_passes_too_many(&count, state, job->geometry, job->recipe->mu_water, true))
		metal_clear(state);
	if (code == 0 && count.dense > 0 && ((const struct metal *)state)->traces_count == 0)
		tell_kept(job, &count);
	return code;
}

static int apply_left_out(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
			  struct error *err)
{
	(void)state;
	(void)time;
	(void)ret_changed;
	return job->subsets ? leave_out(job, job->dense, err) : 0;
}

static const void *found(const void *state, size_t *ret_bytes)
{
	const struct metal *dense = state;

	*ret_bytes = dense->voxels_count * sizeof(*dense->voxels);
	return dense->voxels;
}

static int resume(const struct correction_job *job, void *state, const void *bytes, size_t size, struct error *err)
{
	return metal_put(state, &job->recipe->grid, bytes, size, err);
}

extern const struct correction correction_dense;
const struct correction correction_dense = {
    .name = "dense",
    .summary = "rays through what is very dense are found, where metal is not taken out",
    .times = 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_WHOLE_IMAGES | NEEDS_ALL_VIEWS | NEEDS_VOLUME,
    .wanted = wanted,
    .bytes = bytes_of,
    .open = open_dense,
    .close = close_dense,
    .apply = apply,
    .found = found,
    .resume = resume,
};

extern const struct correction correction_left_out;
const struct correction correction_left_out = {
    .name = "left out",
    .summary = "rays through what is very dense are left out of the iterations",
    .times = 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_WHOLE_IMAGES | NEEDS_ALL_VIEWS | NEEDS_VOLUME,
    .wanted = wanted,
    .apply = apply_left_out,
};

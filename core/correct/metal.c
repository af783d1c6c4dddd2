/*
 * Metal: what it swallows is not in the projections, and its streaks cover the
 * rest of the volume. So its shadows are replaced by what they would be without:
 *
 *  1. Metal in the FDK volume: voxels of at least the threshold, and beside them voxels of at
 *     least half of it; of both those that have half of the highest value near them, so that an
 *     object keeps its width and is whole where it comes near the threshold; and a quarter
 *     of the highest value further away, where streaks are as bright as faint metal.
 *  2. Its projection, wider by a pixel on all sides, gives its traces; samples without
 *     counts that touch a trace belong to it.
 *  3. Each trace is interpolated linearly along the row and along the column (after
 *     Kalender, Hebel and Ebersberger, Radiology 164, 1987, who have the row only), the
 *     nearer ends count more, and FDK gives a volume with few streaks. A screw's shadow is
 *     long in one direction and narrow in the other.
 *  4. That volume, with air and soft tissue made even, bone left and water for the
 *     metal, is the prior: its projection knows the edges that a straight line
 *     cannot (normalised interpolation: Meyer et al., Med. Phys. 37, 2010). Now the
 *     difference to it is interpolated:    p' = P + line(p - P)
 *     in the trace. Where Meyer divides by the prior, a grid smaller than the
 *     object would be missing in P; a difference lets the lines make up for it.
 *  5. FDK and step 4 again, PASSES times in all: each prior is cleaner than the one
 *     before it, and may keep fainter bone.
 *
 * In a grid smaller than the body steps 1 to 5 are of another one, of all of the field of view, but for the traces of
 * what lies in the grid (metal_whole.h): a prior that ends with the grid, and metal cut by its sides, made iterations
 * up to twelve times as wrong as without the stage.
 *
 * The better of this volume and the first one is chosen place by place
 * (metal_blend.c): a faint or thin object's shadow has photons enough. tests/bench/results/metal.txt
 * has the table of what else was tried.
 *
 * The metal itself is put back into every volume that is kept, and with it its rim:
 * around the metal all that the first FDK showed above the volume, since the
 * traces take the metal's blur away as well. Steps 2 to 5 use the list of voxels only
 * and take the views in the order of their numbers: the same list gives the same
 * bits, also in a resumed run. SART leaves the traces' rays out.
 */
#include "core/correct/metal_internal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

void metal_clear(struct metal *metal)
{
	free(metal->voxels);
	free(metal->beneath);
	free(metal->traces);
	free(metal->dark);
	*metal = (struct metal){0};
}

size_t metal_slice_voxels(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1];
}

/* ---- lists ---- */

void *metal_grown(void *items, size_t size, size_t count, size_t *room)
{
	size_t wanted = *room > 0 ? 2 * *room : 1024;
	void *more;

	if (count < *room)
		return items;
	more = wanted > SIZE_MAX / 2 / size ? NULL : realloc(items, wanted * size);
	if (more != NULL)
		*room = wanted;
	return more;
}

int metal_put(struct metal *metal, const struct grid *grid, const void *bytes, size_t count, struct error *err)
{
	const size_t voxels = count / sizeof(struct metal_voxel), slice = metal_slice_voxels(grid);
	struct metal_voxel *list;

	if (count % sizeof(struct metal_voxel) != 0 || voxels > grid_voxels(grid))
		return error_set(err, ERR_INVALID, "%zu bytes are no list of voxels of metal", count);
	list = malloc(count + 1);
	if (list == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu voxels of metal", voxels);
	memcpy(list, bytes, count);
	for (size_t i = 0; i < voxels; i++) {
		bool later =
		    i == 0 || list[i].z > list[i - 1].z || (list[i].z == list[i - 1].z && list[i].at > list[i - 1].at);

		if (list[i].z >= (uint32_t)grid->size[2] || list[i].at >= slice || !later || list[i].kind > METAL_RIM ||
		    !isfinite(list[i].value)) {
			free(list);
			return error_set(err, ERR_INVALID, "the list of voxels of metal is none of this grid");
		}
	}
	free(metal->voxels);
	metal->voxels = list;
	metal->voxels_count = voxels;
	metal->found = 0;
	for (size_t i = 0; i < voxels; i++)
		metal->found += list[i].kind == METAL_CORE;
	return 0;
}

/* ---- slice by slice ---- */

int metal_change_slices(struct metal *metal, const struct metal_tools *tools, struct volume *volume,
			metal_change *change, double value, struct error *err)
{
	float *slice = malloc(metal_slice_voxels(tools->grid) * sizeof(float));
	int code = 0;

	if (slice == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	for (size_t i = 0; i < metal->voxels_count && code == 0;) {
		const int z = (int)metal->voxels[i].z;

		code = tools->backend->volume_download(volume, z, 1, slice, err);
		if (code < 0)
			break;
		for (; i < metal->voxels_count && (int)metal->voxels[i].z == z; i++)
			slice[metal->voxels[i].at] = change(metal, i, slice[metal->voxels[i].at], value);
		code = tools->backend->volume_put(volume, z, 1, slice, err);
	}
	free(slice);
	return code;
}

static float set_core(struct metal *metal, size_t i, float there, double value)
{
	return metal->voxels[i].kind == METAL_CORE ? (float)value : there;
}

/* Soft tissue where the metal is; bone that the volume shows there stays. */
static float at_least_in_core(struct metal *metal, size_t i, float there, double value)
{
	return metal->voxels[i].kind == METAL_CORE ? fmaxf(there, (float)value) : there;
}

static float show(struct metal *metal, size_t i, float there, double value)
{
	const struct metal_voxel *voxel = &metal->voxels[i];

	(void)value;
	metal->beneath[i] = there;
	return voxel->kind == METAL_CORE ? voxel->value : fmaxf(there, voxel->value);
}

static float hide(struct metal *metal, size_t i, float there, double value)
{
	(void)there;
	(void)value;
	return metal->beneath[i];
}

int metal_show(struct metal *metal, const struct metal_tools *tools, struct volume *volume, struct error *err)
{
	if (metal->beneath == NULL)
		metal->beneath = malloc((metal->voxels_count + 1) * sizeof(float));
	if (metal->beneath == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", metal->voxels_count);
	return metal_change_slices(metal, tools, volume, show, 0, err);
}

int metal_hide(struct metal *metal, const struct metal_tools *tools, struct volume *volume, struct error *err)
{
	return metal_change_slices(metal, tools, volume, hide, 0, err);
}

/* ---- its traces ---- */

/* Way through the mask that makes a shadow, in voxels: less lies within the pixels that are added on all sides. */
static const double SHADOW_LEAST = 0.5;
/* Pixels that are added on all sides: what half a voxel covers, or one. */
static int trace_margin(const struct metal_tools *tools)
{
	const double *mm = tools->grid->spacing, voxel = fmin(fmin(mm[0], mm[1]), mm[2]);

	return (int)fmin(fmax(lround(0.5 * voxel / tools->pixel), 1), 3);
}

struct shadow {
	const float *through; /* [row][column], mm through the mask */
	int columns, rows, margin;
	float least;
	const struct metal_trace *dark; /* of the view: samples without counts; in order */
	size_t dark_count;
};

static bool is_shadow(const struct shadow *shadow, int column, int row)
{
	const int m = shadow->margin;

	for (int r = row - m; r <= row + m; r++)
		for (int c = column - m; c <= column + m; c++)
			if (r >= 0 && r < shadow->rows && c >= 0 && c < shadow->columns &&
			    shadow->through[(size_t)r * (size_t)shadow->columns + (size_t)c] > shadow->least)
				return true;
	return false;
}

/* Marks the row's pixels in the metal's shadow, and the stretches without counts that touch them. */
static void mark_row(const struct shadow *shadow, int row, bool *ret_marks)
{
	for (int c = 0; c < shadow->columns; c++)
		ret_marks[c] = is_shadow(shadow, c, row);
	for (size_t i = 0; i < shadow->dark_count; i++) {
		const struct metal_trace *dark = &shadow->dark[i];
		const int low = dark->first > 0 ? dark->first - 1 : 0;
		const int high = dark->last + 1 < shadow->columns ? dark->last + 1 : dark->last;
		bool touches = false;

		if (dark->row != row)
			continue;
		for (int c = low; c <= high; c++)
			touches = touches || ret_marks[c];
		for (int c = dark->first; touches && c <= dark->last; c++)
			ret_marks[c] = true;
	}
}

static int add_traces(struct metal *metal, int view, int row, int columns, const bool *marks, struct error *err)
{
	for (int first = 0, last; first < columns; first = last + 1) {
		struct metal_trace *more;

		last = first;
		if (!marks[first])
			continue;
		while (last + 1 < columns && marks[last + 1])
			last++;
		more = metal_grown(metal->traces, sizeof(*more), metal->traces_count, &metal->traces_room);
		if (more == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu traces", metal->traces_count);
		metal->traces = more;
		more[metal->traces_count++] = (struct metal_trace){view, row, first, last};
		metal->replaced += (size_t)(last - first + 1);
	}
	return 0;
}

/* ---- samples without counts ---- */

int metal_note_dark(struct metal *metal, int view, int row, int first, int last, struct error *err)
{
	struct metal_trace *more = metal_grown(metal->dark, sizeof(*more), metal->dark_count, &metal->dark_room);

	if (more == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu samples without counts",
				 metal->dark_count);
	metal->dark = more;
	more[metal->dark_count++] = (struct metal_trace){view, row, first, last};
	return 0;
}

/* ---- lines over them ---- */

/* The column is searched so many times as far as the row's ends are: what lies beyond has no weight. */
enum { COLUMN_SEARCH = 4 };

/* Pixels beside a trace, in one direction from one of its own. */
struct flank {
	double place, value; /* means, the place in pixels from the trace's own, >= 1 */
	int nearest;         /* pixels from that one to the first; 0: there is none */
};

/* Finds the flank of the trace from pixel (column, row) in a direction, no further than `most` pixels away. */
static struct flank flank_of(const struct metal_view *of, int column, int row, int dx, int dy, int most)
{
	struct flank flank = {0};
	int pixels = 0;

	for (int away = 1; away <= most || pixels > 0; away++) {
		const int c = column + away * dx, r = row + away * dy;
		const size_t at = (size_t)r * (size_t)of->columns + (size_t)c;

		if (of->air_beyond && pixels == 0 && (c < 0 || c >= of->columns))
			return (struct flank){.place = away, .nearest = away};
		if (c < 0 || c >= of->columns || r < 0 || r >= of->rows)
			break;
		if (of->trace[at] && pixels == 0)
			continue;
		if (of->trace[at] || pixels == METAL_FLANK || (dy != 0 && !metal_is_whole(of, c, r)))
			break;
		flank.place += away;
		flank.value += (double)of->values[at] - (of->prior != NULL ? (double)of->prior[at] : 0);
		flank.nearest = pixels++ == 0 ? away : flank.nearest;
	}
	if (pixels > 0) {
		flank.place /= pixels;
		flank.value /= pixels;
	}
	return flank;
}

/*
 * The line between two flanks, at 0; *ret_weight is the inverse square of the
 * distance of its ends, taken as resistors side by side, 0 without any. One flank
 * alone is held, and counts as if the other were as far.
 */
static double line_between(const struct flank *before, const struct flank *behind, double *ret_weight)
{
	double inverse;

	*ret_weight = 0;
	if (before->nearest == 0 && behind->nearest == 0)
		return 0;
	if (before->nearest == 0 || behind->nearest == 0) {
		const struct flank *only = before->nearest == 0 ? behind : before;

		inverse = 0.5 / only->nearest;
		*ret_weight = inverse * inverse;
		return only->value;
	}
	inverse = 1. / before->nearest + 1. / behind->nearest;
	*ret_weight = inverse * inverse;
	return (before->value * behind->place + behind->value * before->place) / (before->place + behind->place);
}

/*
 * Without a prior a column may lead from the object to the air beyond its end,
 * and nothing shows where between them the object ends: such a column counts the less, the less its ends agree.
 */
static double evenness(const struct flank *before, const struct flank *behind)
{
	const double part = 0.5;

	if (before->nearest == 0 || behind->nearest == 0)
		return 1;
	return fmax(0, 1 - fabs(before->value - behind->value) /
			       fmax(part * fmax(fabs(before->value), fabs(behind->value)), 1e-6));
}

void metal_fill_view(const struct metal_view *of)
{
	for (int row = 0; row < of->rows; row++)
		for (int column = 0; column < of->columns; column++) {
			const size_t at = (size_t)row * (size_t)of->columns + (size_t)column;
			struct flank left, right, above, below;
			double along, across, weights[2];
			int near;

			if (!of->trace[at])
				continue;
			left = flank_of(of, column, row, -1, 0, of->columns);
			right = flank_of(of, column, row, 1, 0, of->columns);
			near = left.nearest > right.nearest ? left.nearest : right.nearest;
			near = near > 0 ? COLUMN_SEARCH * near : of->rows;
			above = flank_of(of, column, row, 0, -1, near);
			below = flank_of(of, column, row, 0, 1, near);
			along = line_between(&left, &right, &weights[0]);
			across = line_between(&above, &below, &weights[1]);
			if (of->prior == NULL && weights[0] > 0)
				weights[1] *= evenness(&above, &below);
			if (weights[0] + weights[1] > 0) /* otherwise there is nothing but metal to go by */
				of->values[at] =
				    (float)((weights[0] * along + weights[1] * across) / (weights[0] + weights[1]) +
					    (of->prior != NULL ? (double)of->prior[at] : 0));
		}
}

/* Share of the length that a ray would have in a grid without ends along z, from which on the ray is whole. */
static const double WHOLE = 0.97;

bool metal_is_whole(const struct metal_view *of, int column, int row)
{
	struct grid endless;

	if (of->grid == NULL)
		return true;
	endless = *of->grid;
	endless.spacing[2] = 1e6;
	endless.origin[2] -= 0.5e6 * (endless.size[2] - 1);
	return grid_ray_length(of->grid, of->view, column, row) >=
	       WHOLE * grid_ray_length(&endless, of->view, column, row);
}

/* ---- batch by batch ---- */

int metal_project_batch(const struct metal_tools *tools, const struct volume *volume, const struct metal_batch *batch,
			struct error *err)
{
	int *views = malloc((size_t)batch->count * sizeof(*views)), code = cancel_check(tools->cancel, err);

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", batch->count);
	for (int i = 0; i < batch->count; i++)
		views[i] = batch->first + i;
	if (code == 0)
		code = tools->backend->project(tools->plan, volume, views, batch->count, tools->batch, err);
	if (code == 0)
		code = tools->backend->stack_download(tools->batch, 0, batch->count, batch->shadow, err);
	free(views);
	return code;
}

/* The batch's traces as a picture of slot i. */
static bool *draw_traces(const struct metal *metal, const struct metal_tools *tools, const struct metal_batch *batch,
			 int i)
{
	const size_t columns = (size_t)tools->geometry->columns, pixels = columns * (size_t)tools->geometry->rows;
	const size_t first = metal_traces_from(metal->traces, metal->traces_count, batch->first + i);
	const size_t end = metal_traces_from(metal->traces, metal->traces_count, batch->first + i + 1);
	bool *trace = batch->trace + (size_t)i * pixels;

	memset(trace, 0, pixels * sizeof(*trace));
	for (size_t k = first; k < end; k++)
		for (int c = metal->traces[k].first; c <= metal->traces[k].last; c++)
			trace[(size_t)metal->traces[k].row * columns + (size_t)c] = true;
	return trace;
}

/* Treatments of a view that has traces. */
enum treatment { TRACE, FILL, FILL_OVER_PRIOR, FILL_TO_AIR, LEAVE_OUT };

static void treat_view(const struct metal_tools *tools, const struct metal_batch *batch, int i,
		       enum treatment treatment, const bool *trace)
{
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	const size_t pixels = (size_t)columns * (size_t)rows;
	const struct metal_view of = {
	    .columns = columns,
	    .rows = rows,
	    .values = batch->views + (size_t)i * pixels,
	    .prior =
		treatment == FILL_OVER_PRIOR || treatment == FILL_TO_AIR ? batch->shadow + (size_t)i * pixels : NULL,
	    .trace = trace,
	    .air_beyond = treatment == FILL_TO_AIR,
	    .grid = tools->grid,
	    .view = &tools->geometry->views[batch->first + i],
	};

	if (treatment != LEAVE_OUT)
		metal_fill_view(&of);
	for (size_t k = 0; treatment == LEAVE_OUT && k < pixels; k++)
		if (trace[k])
			of.values[k] = RAY_LEFT_OUT;
}

/* The batch's projections with their traces filled or left out; FILL_OVER_PRIOR: `shadow` is the prior's projection. */
static int treat_batch(const struct metal *metal, const struct metal_tools *tools, const struct metal_batch *batch,
		       enum treatment treatment, struct error *err)
{
	const size_t all = metal->traces_count;
	int code;

	if (metal_traces_from(metal->traces, all, batch->first) ==
	    metal_traces_from(metal->traces, all, batch->first + batch->count))
		return 0;
	code = tools->backend->stack_download(tools->projections, batch->first, batch->count, batch->views, err);
	if (code < 0)
		return code;
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < batch->count; i++)
		treat_view(tools, batch, i, treatment, draw_traces(metal, tools, batch, i));
	return tools->backend->stack_upload(tools->projections, batch->first, batch->count, batch->views, err);
}

static int trace_batch(struct metal *metal, const struct metal_tools *tools, const struct metal_batch *batch,
		       struct error *err)
{
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	const size_t pixels = (size_t)columns * (size_t)rows;
	const double *mm = tools->grid->spacing;
	int code = 0;

	for (int i = 0; i < batch->count && code == 0; i++) {
		const size_t before = metal->traces_count;
		const size_t dark = metal_traces_from(metal->dark, metal->dark_count, batch->first + i);
		const struct shadow shadow = {
		    .through = batch->shadow + (size_t)i * pixels,
		    .columns = columns,
		    .rows = rows,
		    .margin = trace_margin(tools),
		    .least = (float)(SHADOW_LEAST * fmin(fmin(mm[0], mm[1]), mm[2])),
		    .dark = metal->dark + dark,
		    .dark_count = metal_traces_from(metal->dark, metal->dark_count, batch->first + i + 1) - dark,
		};
		bool *marks = batch->trace + (size_t)i * pixels;

		if (input_is_absent(tools->input, batch->first + i))
			continue;
#pragma omp parallel for schedule(static)
		for (int row = 0; row < rows; row++)
			mark_row(&shadow, row, marks + (size_t)row * (size_t)columns);
		for (int row = 0; row < rows && code == 0; row++)
			code = add_traces(metal, batch->first + i, row, columns, marks + (size_t)row * (size_t)columns,
					  err);
		metal->views += metal->traces_count > before;
	}
	return code;
}

/* Over all views: TRACE finds the traces of the mask in the volume to work in, FILL_OVER_PRIOR has the prior there. */
static int treat_all(struct metal *metal, const struct metal_tools *tools, enum treatment treatment, struct error *err)
{
	const int all = tools->geometry->count;
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)tools->geometry->rows;
	const size_t slots = (size_t)tools->slots;
	struct metal_batch batch = {.shadow = malloc(slots * pixels * sizeof(float)),
				    .views = malloc(slots * pixels * sizeof(float)),
				    .trace = malloc(slots * pixels * sizeof(bool))};
	int code = 0;

	if (batch.shadow == NULL || batch.views == NULL || batch.trace == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %zu projections", 2 * slots);
	for (; batch.first < all && code == 0; batch.first += batch.count) {
		batch.count = all - batch.first < tools->slots ? all - batch.first : tools->slots;
		if (treatment != FILL && treatment != LEAVE_OUT)
			code = metal_project_batch(tools, tools->volume, &batch, err);
		if (code == 0 && treatment == TRACE)
			code = trace_batch(metal, tools, &batch, err);
		if (code == 0 && treatment != TRACE)
			code = treat_batch(metal, tools, &batch, treatment, err);
	}
	free(batch.shadow);
	free(batch.views);
	free(batch.trace);
	return code;
}

int metal_leave_out(struct metal *metal, const struct metal_tools *tools, struct error *err)
{
	return treat_all(metal, tools, LEAVE_OUT, err);
}

int metal_fdk(const struct metal_tools *tools, struct volume *to, struct error *err)
{
	int code = tools->backend->volume_fill(to, 0, err);

	for (int view = 0; view < tools->geometry->count && code == 0; view++) {
		code = cancel_check(tools->cancel, err);
		if (code == 0)
			code = fdk_add(tools->fdk, view, view, tools->projections, to, err);
	}
	return code < 0 ? code : fdk_flush(tools->fdk, tools->projections, to, err);
}

/* ---- the prior ---- */

/*
 * HU of what is made even in the prior. A voxel keeps nothing of its value up to the first and all of it from the
 * second on, and between them a growing part; the other way round for soft tissue, from where on what is lighter is
 * water. Streaks of the first volume reach higher than those of the later ones. What is filled before the model of the
 * exterior is fitted keeps foam, wood and lung, too: a board between two rails of metal lies in both of their traces,
 * and air or water in its place is in every ray that passes it outside of the grid.
 */
struct levels {
	double air[2], soft[2], bone[2];
};
static const struct levels FIRST = {{-500, -500}, {-500, -500}, {400, 400}};
static const struct levels LATER = {{-500, -500}, {-500, -500}, {150, 300}};
static const struct levels FILLING = {{-850, -700}, {-300, -150}, {400, 400}};
enum { PASSES = 4 };

/* (1 2 1)/4 along x and along y, outer values held. */
static void smooth_slice(const struct grid *grid, const float *from, float *scratch, float *ret)
{
	const int nx = grid->size[0], ny = grid->size[1];

	for (int y = 0; y < ny; y++) {
		const float *row = from + (size_t)y * (size_t)nx;

		for (int x = 0; x < nx; x++)
			scratch[(size_t)y * (size_t)nx + (size_t)x] =
			    .25f * (row[x > 0 ? x - 1 : 0] + 2 * row[x] + row[x + 1 < nx ? x + 1 : x]);
	}
	for (int y = 0; y < ny; y++) {
		const float *row = scratch + (size_t)y * (size_t)nx;
		const float *above = y > 0 ? row - nx : row, *below = y + 1 < ny ? row + nx : row;

		for (int x = 0; x < nx; x++)
			ret[(size_t)y * (size_t)nx + (size_t)x] = .25f * (above[x] + 2 * row[x] + below[x]);
	}
}

/* From one value to another while hu goes from the first level to the second. */
static double between(const double level[2], double hu, double from, double to)
{
	if (hu <= level[0])
		return from;
	return hu >= level[1] ? to : from + (hu - level[0]) / (level[1] - level[0]) * (to - from);
}

static void classify(const struct grid *grid, double mu_water, const struct levels *levels, const float *before,
		     const float *here, const float *behind, float *ret)
{
	for (size_t i = 0; i < metal_slice_voxels(grid); i++) {
		const double value = .25 * ((double)before[i] + 2 * (double)here[i] + (double)behind[i]);
		const double hu = 1000 * (value / mu_water - 1);
		const double light = between(levels->air, hu, 0, value);

		ret[i] = (float)between(levels->bone, hu, between(levels->soft, hu, light, mu_water), value);
	}
}

/* The volume to work in becomes the prior, but for the metal. */
static int make_prior(const struct metal_tools *tools, const struct levels *levels, struct error *err)
{
	const struct grid *grid = tools->grid;
	const size_t slice = metal_slice_voxels(grid);
	const int nz = grid->size[2];
	float *ring = malloc(5 * slice * sizeof(float)), *raw, *scratch;
	int code = 0;

	if (ring == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for five slices of %zu voxels", slice);
	raw = ring + 3 * slice;
	scratch = ring + 4 * slice;
	for (int z = -1; z < nz && code == 0; z++) { /* z is made when z + 1 has been read and smoothed */
		if (z + 1 < nz)
			code = tools->backend->volume_download(tools->volume, z + 1, 1, raw, err);
		if (code == 0 && z + 1 < nz)
			smooth_slice(grid, raw, scratch, ring + (size_t)((z + 1) % 3) * slice);
		if (code == 0 && z >= 0) {
			const float *here = ring + (size_t)(z % 3) * slice;

			classify(grid, tools->mu_water, levels, z > 0 ? ring + (size_t)((z - 1) % 3) * slice : here,
				 here, z + 1 < nz ? ring + (size_t)((z + 1) % 3) * slice : here, raw);
			code = tools->backend->volume_put(tools->volume, z, 1, raw, err);
		}
		if (code == 0)
			code = cancel_check(tools->cancel, err);
	}
	free(ring);
	return code;
}

static float set(struct metal *metal, size_t i, float there, double value)
{
	(void)metal;
	(void)i;
	(void)there;
	return (float)value;
}

int metal_fill(struct metal *metal, struct metal *without, const struct metal_tools *tools, struct error *err)
{
	int code = make_prior(tools, &FILLING, err);

	if (code == 0)
		code = metal_change_slices(without, tools, tools->volume, set, 0, err);
	metal->filled = true;
	return code == 0 ? treat_all(metal, tools, FILL_TO_AIR, err) : code;
}

int metal_find_traces(struct metal *metal, const struct metal_tools *tools, struct error *err)
{
	int code = tools->backend->volume_fill(tools->volume, 0, err);

	metal->traces_count = metal->replaced = 0;
	metal->views = 0;
	if (metal->dark_count > 0)
		qsort(metal->dark, metal->dark_count, sizeof(*metal->dark), metal_compare_traces);
	if (code == 0)
		code = metal_change_slices(metal, tools, tools->volume, set_core, 1, err);
	return code < 0 ? code : treat_all(metal, tools, TRACE, err);
}

int metal_replace(struct metal *metal, struct metal *list, const struct metal_tools *tools, struct error *err)
{
	int code = treat_all(metal, tools, FILL, err);

	for (int pass = 0; pass < PASSES && code == 0; pass++) {
		code = metal_fdk(tools, tools->volume, err);
		if (code == 0)
			code = make_prior(tools, pass == 0 ? &FIRST : &LATER, err);
		if (code == 0)
			code = metal_change_slices(list, tools, tools->volume, at_least_in_core, tools->mu_water, err);
		if (code == 0)
			code = treat_all(metal, tools, FILL_OVER_PRIOR, err);
	}
	return code;
}

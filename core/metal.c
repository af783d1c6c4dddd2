/*
 * Metal: what it swallows is not in the projections, and its streaks cover the
 * rest of the volume. So its shadows are replaced by what they would be without:
 *
 *  1. what has at least the threshold in the FDK volume is metal;
 *  2. its projection, a pixel wider all around, gives its traces;
 *  3. in each row a straight line leads over each trace (Kalender, Hebel and
 *     Ebersberger, Radiology 164, 1987), and FDK gives a volume with few streaks;
 *  4. that one, with air and soft tissue made even, bone left and water for the
 *     metal, is the prior: its projection knows the edges that a straight line
 *     cannot (Meyer et al., Med. Phys. 37, 2010). The line now leads over the
 *     difference to it:    p' = P + line(p - P)
 *     in the trace. Where Meyer divides by the prior, a grid smaller than the
 *     object would be missing in P; a difference lets the line make up for it.
 *
 * The metal itself is put back into every volume that is kept. Steps 2 to 4 use
 * the list of voxels only and take the views in the order of their numbers: the
 * same list gives the same bits, also when a run goes on later.
 */
#include "core/metal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

void metal_clear(struct metal *metal)
{
	free(metal->voxels);
	free(metal->traces);
	*metal = (struct metal){0};
}

static int check_cancelled(const struct metal_tools *tools, struct error *err)
{
	const struct cancel *cancel = tools->cancel;

	if (cancel != NULL && cancel->asked(cancel->context))
		return error_set(err, ERR_CANCELLED, "cancelled");
	return 0;
}

static size_t slice_voxels(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1];
}

/* `items` with room for one more than `count`; as it was where there is no memory. */
static void *grown(void *items, size_t size, size_t count, size_t *room)
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

/* ---- where it is ---- */

/* One of the six beside it has the threshold too: noise stands alone. */
static bool is_metal(const struct grid *grid, const float *const slices[3], size_t at, float threshold)
{
	const int nx = grid->size[0], ny = grid->size[1], x = (int)(at % (size_t)nx), y = (int)(at / (size_t)nx);
	const float *slice = slices[1];

	if (!(slice[at] >= threshold))
		return false;
	return (x > 0 && slice[at - 1] >= threshold) || (x + 1 < nx && slice[at + 1] >= threshold) ||
	       (y > 0 && slice[at - (size_t)nx] >= threshold) || (y + 1 < ny && slice[at + (size_t)nx] >= threshold) ||
	       (slices[0] != NULL && slices[0][at] >= threshold) || (slices[2] != NULL && slices[2][at] >= threshold);
}

static int find_in_slice(struct metal *metal, const struct grid *grid, const float *const slices[3], int z,
			 float threshold, size_t *room, struct error *err)
{
	for (size_t at = 0; at < slice_voxels(grid); at++) {
		struct metal_voxel *more;

		if (!is_metal(grid, slices, at, threshold))
			continue;
		more = grown(metal->voxels, sizeof(*more), metal->voxels_count, room);
		if (more == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu voxels of metal",
					 metal->voxels_count);
		metal->voxels = more;
		more[metal->voxels_count++] = (struct metal_voxel){(uint32_t)z, (uint32_t)at, slices[1][at]};
	}
	return 0;
}

int metal_find(struct metal *metal, const struct metal_tools *tools, struct volume *from, double threshold,
	       struct error *err)
{
	const struct grid *grid = tools->grid;
	const size_t slice = slice_voxels(grid);
	const int nz = grid->size[2];
	float *ring = malloc(3 * slice * sizeof(float)); /* slices z - 1, z, z + 1, each at its number modulo 3 */
	size_t room = 0;
	int code = 0;

	if (ring == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for three slices of %zu voxels", slice);
	code = tools->backend->volume_download(from, 0, 1, ring, err);
	for (int z = 0; z < nz && code == 0; z++) {
		const float *const slices[3] = {z > 0 ? ring + (size_t)((z - 1) % 3) * slice : NULL,
						ring + (size_t)(z % 3) * slice,
						z + 1 < nz ? ring + (size_t)((z + 1) % 3) * slice : NULL};

		if (z + 1 < nz)
			code =
			    tools->backend->volume_download(from, z + 1, 1, ring + (size_t)((z + 1) % 3) * slice, err);
		if (code == 0)
			code = find_in_slice(metal, grid, slices, z, (float)threshold, &room, err);
		if (code == 0)
			code = check_cancelled(tools, err);
	}
	free(ring);
	return code;
}

int metal_put(struct metal *metal, const struct grid *grid, const void *bytes, size_t count, struct error *err)
{
	const size_t voxels = count / sizeof(struct metal_voxel), slice = slice_voxels(grid);
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

		if (list[i].z >= (uint32_t)grid->size[2] || list[i].at >= slice || !later || !isfinite(list[i].value)) {
			free(list);
			return error_set(err, ERR_INVALID, "the list of voxels of metal is none of this grid");
		}
	}
	free(metal->voxels);
	metal->voxels = list;
	metal->voxels_count = voxels;
	return 0;
}

/* ---- slice by slice ---- */

/* For each slice with metal: download, change it at its voxels, put it back. `change` may change the list as well. */
static int change_slices(struct metal *metal, const struct metal_tools *tools, struct volume *volume,
			 void (*change)(struct metal_voxel *voxel, float *at, double value), double value,
			 struct error *err)
{
	float *slice = malloc(slice_voxels(tools->grid) * sizeof(float));
	int code = 0;

	if (slice == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	for (size_t i = 0; i < metal->voxels_count && code == 0;) {
		const int z = (int)metal->voxels[i].z;

		code = tools->backend->volume_download(volume, z, 1, slice, err);
		if (code < 0)
			break;
		for (; i < metal->voxels_count && (int)metal->voxels[i].z == z; i++)
			change(&metal->voxels[i], &slice[metal->voxels[i].at], value);
		code = tools->backend->volume_put(volume, z, 1, slice, err);
	}
	free(slice);
	return code;
}

static void exchange(struct metal_voxel *voxel, float *at, double value)
{
	const float there = *at;

	(void)value;
	*at = voxel->value;
	voxel->value = there;
}

static void set(struct metal_voxel *voxel, float *at, double value)
{
	(void)voxel;
	*at = (float)value;
}

int metal_exchange(struct metal *metal, const struct metal_tools *tools, struct volume *volume, struct error *err)
{
	return change_slices(metal, tools, volume, exchange, 0, err);
}

/* ---- its traces ---- */

/* Way through the mask that makes a shadow, in voxels: less lies within the pixel that is added all around. */
static const double SHADOW_LEAST = 0.5;

static bool is_dark(const float *shadow, int columns, int rows, int column, int row, float least)
{
	for (int r = row - 1; r <= row + 1; r++)
		for (int c = column - 1; c <= column + 1; c++)
			if (r >= 0 && r < rows && c >= 0 && c < columns &&
			    shadow[(size_t)r * (size_t)columns + (size_t)c] > least)
				return true;
	return false;
}

static int trace_row(struct metal *metal, int view, int row, const float *shadow, const struct metal_tools *tools,
		     struct error *err)
{
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	const double *mm = tools->grid->spacing;
	const float least = (float)(SHADOW_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]));

	for (int first = 0; first < columns; first++) {
		struct metal_trace *more;
		int last;

		if (!is_dark(shadow, columns, rows, first, row, least))
			continue;
		for (last = first; last + 1 < columns && is_dark(shadow, columns, rows, last + 1, row, least);)
			last++;
		more = grown(metal->traces, sizeof(*more), metal->traces_count, &metal->traces_room);
		if (more == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu traces", metal->traces_count);
		metal->traces = more;
		more[metal->traces_count++] = (struct metal_trace){view, row, first, last};
		metal->replaced += (size_t)(last - first + 1);
		first = last;
	}
	return 0;
}

/* ---- rows without them ---- */

/*
 * Pixels on either side of a trace whose mean the line starts from: one alone
 * would draw its noise over the trace, with more the line starts too far away.
 */
enum { FLANK = 2 };

struct flank {
	double place, value; /* of the mean of its pixels */
	int pixels;
};

/* Up to FLANK pixels from `from` on in the direction `step`, as far as `end`, excluded. */
static struct flank flank_of(const float *row, const float *prior, int from, int step, int end)
{
	struct flank flank = {0};

	for (int c = from; flank.pixels < FLANK && c != end; c += step, flank.pixels++) {
		flank.place += c;
		flank.value += (double)row[c] - (prior != NULL ? (double)prior[c] : 0);
	}
	if (flank.pixels > 0) {
		flank.place /= flank.pixels;
		flank.value /= flank.pixels;
	}
	return flank;
}

bool metal_fill_row(float *row, const float *prior, int columns, const struct metal_trace *traces, size_t count)
{
	if (count == 1 && traces[0].first == 0 && traces[0].last == columns - 1)
		return false;
	for (size_t i = 0; i < count; i++) {
		const int first = traces[i].first, last = traces[i].last;
		const int before = i > 0 ? traces[i - 1].last : -1;
		const int behind = i + 1 < count ? traces[i + 1].first : columns;
		struct flank left = flank_of(row, prior, first - 1, -1, before);
		struct flank right = flank_of(row, prior, last + 1, 1, behind);

		if (left.pixels == 0) /* at the detector's edge: held */
			left = (struct flank){right.place - 1, right.value, 0};
		else if (right.pixels == 0)
			right = (struct flank){left.place + 1, left.value, 0};
		for (int c = first; c <= last; c++) {
			const double part = (c - left.place) / (right.place - left.place);

			row[c] = (float)(left.value + part * (right.value - left.value) +
					 (prior != NULL ? (double)prior[c] : 0));
		}
	}
	return true;
}

/* A row that is all trace: a line from the next rows above and below that are not, as they are now. */
static void fill_from_rows(float *view, const float *prior, int columns, int rows, int row, const bool *whole)
{
	int above = row, below = row;

	while (above >= 0 && whole[above])
		above--;
	while (below < rows && whole[below])
		below++;
	if (above < 0 && below >= rows) /* nothing but metal: there is nothing to go by */
		return;
	for (int c = 0; c < columns; c++) {
		const size_t at = (size_t)row * (size_t)columns + (size_t)c;
		const size_t over = (size_t)(above < 0 ? below : above) * (size_t)columns + (size_t)c;
		const size_t under = (size_t)(below >= rows ? above : below) * (size_t)columns + (size_t)c;
		const double part = above < 0 || below >= rows ? 0 : (double)(row - above) / (below - above);
		const double from = (double)view[over] - (prior != NULL ? (double)prior[over] : 0);
		const double to = (double)view[under] - (prior != NULL ? (double)prior[under] : 0);

		view[at] = (float)(from + part * (to - from) + (prior != NULL ? (double)prior[at] : 0));
	}
}

/* `whole` [rows] is scratch. */
static void fill_view(float *view, const float *prior, int columns, int rows, const struct metal_trace *traces,
		      size_t count, bool *whole)
{
	memset(whole, 0, (size_t)rows * sizeof(*whole));
	for (size_t i = 0, next; i < count; i = next) {
		const size_t at = (size_t)traces[i].row * (size_t)columns;

		for (next = i; next < count && traces[next].row == traces[i].row;)
			next++;
		whole[traces[i].row] =
		    !metal_fill_row(view + at, prior != NULL ? prior + at : NULL, columns, &traces[i], next - i);
	}
	for (int row = 0; row < rows; row++)
		if (whole[row])
			fill_from_rows(view, prior, columns, rows, row, whole);
}

/* ---- batch by batch ---- */

/* Views first .. first + count - 1 of the volume to work in; the host's buffers are [slots][row][column]. */
struct batch {
	int first, count;
	float *shadow; /* the volume's projections */
	float *views;  /* those of the scan */
	bool *whole;   /* [slots][rows] */
};

static int project_batch(const struct metal_tools *tools, const struct batch *batch, struct error *err)
{
	int *views = malloc((size_t)batch->count * sizeof(*views)), code = check_cancelled(tools, err);

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", batch->count);
	for (int i = 0; i < batch->count; i++)
		views[i] = batch->first + i;
	if (code == 0)
		code = tools->backend->project(tools->plan, tools->volume, views, batch->count, tools->batch, err);
	if (code == 0)
		code = tools->backend->stack_download(tools->batch, 0, batch->count, batch->shadow, err);
	free(views);
	return code;
}

/* First of the traces of this view or a later one. */
static size_t traces_from(const struct metal *metal, int view)
{
	size_t low = 0, high = metal->traces_count;

	while (low < high) {
		const size_t middle = low + (high - low) / 2;

		if (metal->traces[middle].view < view)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

/* The batch's projections with their traces filled; with_prior: `shadow` is the prior's projection. */
static int fill_batch(const struct metal *metal, const struct metal_tools *tools, const struct batch *batch,
		      bool with_prior, struct error *err)
{
	const int columns = tools->geometry->columns, rows = tools->geometry->rows;
	const size_t pixels = (size_t)columns * (size_t)rows;
	int code;

	if (traces_from(metal, batch->first) == traces_from(metal, batch->first + batch->count))
		return 0;
	code = tools->backend->stack_download(tools->projections, batch->first, batch->count, batch->views, err);
	if (code < 0)
		return code;
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < batch->count; i++) {
		const size_t first = traces_from(metal, batch->first + i),
			     end = traces_from(metal, batch->first + i + 1);

		fill_view(batch->views + (size_t)i * pixels, with_prior ? batch->shadow + (size_t)i * pixels : NULL,
			  columns, rows, metal->traces + first, end - first, batch->whole + (size_t)i * (size_t)rows);
	}
	return tools->backend->stack_upload(tools->projections, batch->first, batch->count, batch->views, err);
}

static int trace_batch(struct metal *metal, const struct metal_tools *tools, const struct batch *batch,
		       struct error *err)
{
	const int rows = tools->geometry->rows;
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)rows;
	int code = 0;

	for (int i = 0; i < batch->count && code == 0; i++) {
		const size_t before = metal->traces_count;

		for (int row = 0; row < rows && code == 0; row++)
			code = trace_row(metal, batch->first + i, row, batch->shadow + (size_t)i * pixels, tools, err);
		metal->views += metal->traces_count > before;
	}
	return code;
}

/* Over all views: with the mask in the volume, finds the traces and fills them; with the prior, fills them. */
static int fill_all(struct metal *metal, const struct metal_tools *tools, bool with_prior, struct error *err)
{
	const int all = tools->geometry->count, rows = tools->geometry->rows;
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)rows, slots = (size_t)tools->slots;
	struct batch batch = {.shadow = malloc(slots * pixels * sizeof(float)),
			      .views = malloc(slots * pixels * sizeof(float)),
			      .whole = malloc(slots * (size_t)rows * sizeof(bool))};
	int code = 0;

	if (batch.shadow == NULL || batch.views == NULL || batch.whole == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %zu projections", 2 * slots);
	for (; batch.first < all && code == 0; batch.first += batch.count) {
		batch.count = all - batch.first < tools->slots ? all - batch.first : tools->slots;
		code = project_batch(tools, &batch, err);
		if (code == 0 && !with_prior)
			code = trace_batch(metal, tools, &batch, err);
		if (code == 0)
			code = fill_batch(metal, tools, &batch, with_prior, err);
	}
	free(batch.shadow);
	free(batch.views);
	free(batch.whole);
	return code;
}

int metal_fdk(const struct metal_tools *tools, struct volume *to, struct error *err)
{
	int code = tools->backend->volume_fill(to, 0, err);

	for (int view = 0; view < tools->geometry->count && code == 0; view++) {
		code = check_cancelled(tools, err);
		if (code == 0)
			code = fdk_add(tools->fdk, view, view, tools->projections, to, err);
	}
	return code < 0 ? code : fdk_flush(tools->fdk, tools->projections, to, err);
}

/* ---- the prior ---- */

/* HU below which a voxel is air, and from which it is bone; streaks of the first volume stay between them. */
static const double AIR_HU = -500, BONE_HU = 400;

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

static void classify(const struct grid *grid, double mu_water, const float *before, const float *here,
		     const float *behind, float *ret)
{
	const float air = (float)(mu_water * (1 + AIR_HU / 1000)), bone = (float)(mu_water * (1 + BONE_HU / 1000));

	for (size_t i = 0; i < slice_voxels(grid); i++) {
		const float value = .25f * (before[i] + 2 * here[i] + behind[i]);

		ret[i] = value < air ? 0 : value < bone ? (float)mu_water : value;
	}
}

/* The volume to work in becomes the prior, but for the metal. */
static int make_prior(const struct metal_tools *tools, struct error *err)
{
	const struct grid *grid = tools->grid;
	const size_t slice = slice_voxels(grid);
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

			classify(grid, tools->mu_water, z > 0 ? ring + (size_t)((z - 1) % 3) * slice : here, here,
				 z + 1 < nz ? ring + (size_t)((z + 1) % 3) * slice : here, raw);
			code = tools->backend->volume_put(tools->volume, z, 1, raw, err);
		}
		if (code == 0)
			code = check_cancelled(tools, err);
	}
	free(ring);
	return code;
}

int metal_replace(struct metal *metal, const struct metal_tools *tools, struct error *err)
{
	int code = tools->backend->volume_fill(tools->volume, 0, err);

	metal->traces_count = metal->replaced = 0;
	metal->views = 0;
	if (code == 0)
		code = change_slices(metal, tools, tools->volume, set, 1, err);
	if (code == 0)
		code = fill_all(metal, tools, false, err);
	if (code == 0)
		code = metal_fdk(tools, tools->volume, err);
	if (code == 0)
		code = make_prior(tools, err);
	if (code == 0)
		code = change_slices(metal, tools, tools->volume, set, tools->mu_water, err);
	if (code == 0)
		code = fill_all(metal, tools, true, err);
	return code;
}

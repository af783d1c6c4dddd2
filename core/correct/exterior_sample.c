/* The exterior's coarse volume read by linear interpolation, for its own rim and on the recipe's grid: see
 * exterior_volume.h. */
#include "core/correct/exterior_volume.h"

#include <math.h>
#include <stdlib.h>

/* Between which two places of an axis a position lies, held beyond the outer ones, and how near to the second. */
static float between(const struct grid *grid, int axis, double place, int ret[2])
{
	const double at = fmin(fmax((place - grid->origin[axis]) / grid->spacing[axis], 0), grid->size[axis] - 1);

	ret[0] = (int)at;
	ret[1] = ret[0] + 1 < grid->size[axis] ? ret[0] + 1 : ret[0];
	return (float)(at - ret[0]);
}

/* The eight voxels around a place and their weights. */
struct corners {
	size_t at[8];
	float weight[8];
};

static struct corners corners_of(const struct grid *grid, const double place[3])
{
	struct corners corners;
	int at[3][2];
	const float part[3] = {between(grid, 0, place[0], at[0]), between(grid, 1, place[1], at[1]),
			       between(grid, 2, place[2], at[2])};

	for (int i = 0; i < 8; i++) {
		const int a = i & 1, b = i >> 1 & 1, c = i >> 2;

		corners.at[i] = grid_voxel(grid, at[0][a], at[1][b], at[2][c]);
		corners.weight[i] =
		    (a ? part[0] : 1 - part[0]) * (b ? part[1] : 1 - part[1]) * (c ? part[2] : 1 - part[2]);
	}
	return corners;
}

/* The same around a voxel of another grid. */
static struct corners corners_of_voxel(const struct grid *grid, const struct grid *of, int x, int y, int z)
{
	const double place[3] = {of->origin[0] + x * of->spacing[0], of->origin[1] + y * of->spacing[1],
				 of->origin[2] + z * of->spacing[2]};

	return corners_of(grid, place);
}

static float value_at(const struct exterior_volume *s, const struct corners *corners)
{
	float sum = 0;

	for (int i = 0; i < 8; i++)
		sum += corners->weight[i] * s->voxels[corners->at[i]];
	return sum;
}

/* The voxel's value beside the field of view; *ret_beside is false where it lies in that. No voxel read is beside it.
 */
static float held(const struct exterior_volume *s, const struct orbit *orbit, double place[3], bool *ret_beside)
{
	const double radius = orbit->field_of_view / 2;
	const double rim = radius - 1.5 * fmax(s->grid.spacing[0], s->grid.spacing[1]);
	const double from_axis = orbit_from_axis(orbit, place);
	const double part = (from_axis - radius) / (EXTERIOR_MARGIN * radius);
	double from[3];
	struct corners corners;

	*ret_beside = from_axis > radius;
	if (from_axis <= radius || part >= 1)
		return 0;
	orbit_from_centre(orbit, place, from);
	for (int i = 0; i < 3; i++)
		place[i] += (rim / from_axis - 1) * (from[0] * orbit->frame[0][i] + from[1] * orbit->frame[1][i]);
	corners = corners_of(&s->grid, place);
	return value_at(s, &corners) * (float)(0.5 + 0.5 * cos(M_PI * part));
}

void exterior_volume_hold_rim(struct exterior_volume *s, const struct orbit *orbit, const bool *empty)
{
	const struct grid *grid = &s->grid;

	/* A field of view of a few coarse voxels has no whole sums within its rim. */
	if (orbit->field_of_view < 6 * fmax(grid->spacing[0], grid->spacing[1]))
		return;
#pragma omp parallel for schedule(static)
	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				const size_t at = grid_voxel(grid, x, y, z);
				double place[3] = {grid->origin[0] + x * grid->spacing[0],
						   grid->origin[1] + y * grid->spacing[1],
						   grid->origin[2] + z * grid->spacing[2]};
				bool beside;
				const float value = held(s, orbit, place, &beside);

				if (!beside)
					continue;
				s->seen[at] = false;
				s->voxels[at] = empty[at] ? 0 : value;
			}
}

/* (b, 1 - 2 b, b) along a line of voxels, in place, outer values held. */
static void smooth_line(float *line, int count, size_t stride, float b)
{
	float before = line[0];

	for (int i = 0; i < count; i++) {
		float *here = line + (size_t)i * stride;
		const float is = *here, next = i + 1 < count ? here[stride] : is;

		*here = b * (before + (1 / b - 2) * is + next);
		before = is;
	}
}

static void smooth_axis(struct exterior_volume *s, int axis, float b)
{
	const int *count = s->grid.size, first = axis == 0 ? 1 : 0, second = axis == 2 ? 1 : 2;
	const size_t stride[3] = {1, (size_t)count[0], (size_t)count[0] * (size_t)count[1]};

#pragma omp parallel for schedule(static)
	for (int j = 0; j < count[second]; j++)
		for (int i = 0; i < count[first]; i++)
			smooth_line(s->voxels + (size_t)j * stride[second] + (size_t)i * stride[first], count[axis],
				    stride[axis], b);
}

/* A quarter is (1 2 1) / 4; what is wider is taken several times. */
static const double MOST = 0.25;

void exterior_volume_smooth(struct exterior_volume *s, double share)
{
	for (int axis = 0; axis < 3 && share > 0; axis++)
		smooth_axis(s, axis, (float)(share * MOST));
}

void exterior_volume_mean(struct exterior_volume *s, const double variances[3])
{
	for (int axis = 0; axis < 3; axis++) {
		const double b = variances[axis] / (2 * pow(s->grid.spacing[axis], 2));
		const int times = (int)ceil(b / MOST);

		for (int i = 0; i < times; i++)
			smooth_axis(s, axis, (float)(b / times));
	}
}

void exterior_volume_slice(const struct exterior_volume *s, const struct grid *grid, int z, float *ret_slice)
{
#pragma omp parallel for schedule(static)
	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const struct corners corners = corners_of_voxel(&s->grid, grid, x, y, z);

			ret_slice[(size_t)y * (size_t)grid->size[0] + (size_t)x] = value_at(s, &corners);
		}
}

int exterior_volume_sample(const struct exterior_volume *s, const struct grid *grid, struct volume *to,
			   struct error *err)
{
	float *slice = malloc((size_t)grid->size[0] * (size_t)grid->size[1] * sizeof(float));
	int code = 0;

	if (slice == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		exterior_volume_slice(s, grid, z, slice);
		code = s->backend->volume_put(to, z, 1, slice, err);
	}
	free(slice);
	return code;
}

/* ---- means over the recipe's voxels ---- */

/* How voxels read w along an axis: `taps` of its values from first[i] on. */
struct reading {
	int taps;
	int *first;    /* [voxels], owned */
	float *weight; /* [voxels][taps], owned */
};

static void reading_clear(struct reading *reading)
{
	free(reading->first);
	free(reading->weight);
}

/* Places of a voxel along an axis, and e, in the square of its width. */
static int places_of(const struct grid *own, const struct grid *grid, int axis, double *ret_excess)
{
	const double part = own->spacing[axis] / grid->spacing[axis];
	/* A part of a millionth is rounding. */
	const int places = (int)ceil(1 / part - 1e-6);

	*ret_excess = places > 1 ? part * part / 6 - 1. / (12. * places * places) : 0;
	return places > 1 ? places : 1;
}

static double place_within(const struct grid *grid, int axis, int voxel, int place, int places)
{
	return grid->origin[axis] + (voxel + (place + 0.5) / places - 0.5) * grid->spacing[axis];
}

/* Adds w's value at a place to what a voxel reads, by this share. */
static void weigh_place(const struct grid *own, int axis, double place, float share, int first, float *weight)
{
	int at[2];
	const float part = between(own, axis, place, at);

	weight[at[0] - first] += (1 - part) * share;
	weight[at[1] - first] += part * share;
}

/* u of a voxel: R, less what those to both sides have more. */
static void weigh_voxel(const struct grid *own, const struct grid *grid, int axis, int voxel, struct reading *reading)
{
	const bool outermost = voxel == 0 || voxel == grid->size[axis] - 1;
	const int least = own->size[axis] - reading->taps;
	float *weight = reading->weight + (size_t)voxel * (size_t)reading->taps;
	double excess;
	const int places = places_of(own, grid, axis, &excess), beside = excess > 0;

	if (reading->first[voxel] > least)
		reading->first[voxel] = least;
	if (outermost)
		weigh_place(own, axis, place_within(grid, axis, voxel, 0, 1), 1, reading->first[voxel], weight);
	for (int k = 0; k < places * (2 * beside + 1) && !outermost; k++) {
		const int side = k / places - beside;

		weigh_place(own, axis, place_within(grid, axis, voxel + side, k % places, places),
			    (float)((side == 0 ? 1 + excess : -excess / 2) / places), reading->first[voxel], weight);
	}
}

/* Readings of all voxels along an axis. */
static int read_axis(const struct grid *own, const struct grid *grid, int axis, struct reading *ret, struct error *err)
{
	const int voxels = grid->size[axis];
	double excess;
	const int places = places_of(own, grid, axis, &excess), beside = excess > 0;
	int at[2];

	ret->first = malloc((size_t)voxels * sizeof(*ret->first));
	for (int i = 0; i < voxels && ret->first != NULL; i++) {
		between(own, axis, place_within(grid, axis, i + beside, places - 1, places), at);
		ret->first[i] = at[1];
		between(own, axis, place_within(grid, axis, i - beside, 0, places), at);
		ret->taps = ret->first[i] - at[0] >= ret->taps ? ret->first[i] - at[0] + 1 : ret->taps;
		ret->first[i] = at[0];
	}
	ret->weight = calloc((size_t)voxels * (size_t)ret->taps, sizeof(*ret->weight));
	if (ret->first == NULL || ret->weight == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the weights of %d voxels", voxels);
	for (int i = 0; i < voxels; i++)
		weigh_voxel(own, grid, axis, i, ret);
	return 0;
}

/* What a slice is worked in: w along z; that along y, too; and the slice. */
struct means_work {
	float *plane, *lines, *slice; /* [y][x] of w; [recipe's y][x of w]; [recipe's y][x], owned as one */
};

/* Sums of `taps` rows, `apart` floats from each other. */
static void sum_rows(const float *rows, size_t apart, const float *weight, int taps, int columns, float *ret)
{
	for (int x = 0; x < columns; x++) {
		float sum = 0;

		for (int k = 0; k < taps; k++)
			sum += weight[k] * rows[(size_t)k * apart + (size_t)x];
		ret[x] = sum;
	}
}

static void read_slice(const struct exterior_volume *s, const struct grid *grid, const struct reading axes[3], int z,
		       const struct means_work *work)
{
	const struct reading *along = &axes[0], *across = &axes[1], *up = &axes[2];
	const int columns = s->grid.size[0], rows = s->grid.size[1];
	const float *slices = s->voxels + grid_voxel(&s->grid, 0, 0, up->first[z]);
	const size_t row = (size_t)columns;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		sum_rows(slices + (size_t)y * row, row * (size_t)rows, up->weight + (size_t)z * (size_t)up->taps,
			 up->taps, columns, work->plane + (size_t)y * row);
#pragma omp parallel for schedule(static)
	for (int y = 0; y < grid->size[1]; y++) {
		float *line = work->lines + (size_t)y * row;

		sum_rows(work->plane + (size_t)across->first[y] * row, row,
			 across->weight + (size_t)y * (size_t)across->taps, across->taps, columns, line);
		for (int x = 0; x < grid->size[0]; x++)
			sum_rows(line + along->first[x], 1, along->weight + (size_t)x * (size_t)along->taps,
				 along->taps, 1, work->slice + (size_t)y * (size_t)grid->size[0] + (size_t)x);
	}
}

int exterior_volume_means(const struct exterior_volume *s, const struct grid *grid, struct volume *to,
			  struct error *err)
{
	const size_t own = (size_t)s->grid.size[0], rows = (size_t)grid->size[1];
	struct reading axes[3] = {{0}, {0}, {0}};
	struct means_work work = {
	    .plane =
		malloc((own * (size_t)s->grid.size[1] + own * rows + (size_t)grid->size[0] * rows) * sizeof(float)),
	};
	int code = 0;

	if (work.plane == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	} else {
		work.lines = work.plane + own * (size_t)s->grid.size[1];
		work.slice = work.lines + own * rows;
	}
	for (int axis = 0; axis < 3 && code == 0; axis++)
		code = read_axis(&s->grid, grid, axis, &axes[axis], err);
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		read_slice(s, grid, axes, z, &work);
		code = s->backend->volume_put(to, z, 1, work.slice, err);
	}
	for (int axis = 0; axis < 3; axis++)
		reading_clear(&axes[axis]);
	free(work.plane);
	return code;
}

bool exterior_volume_seen(const struct exterior_volume *s, const struct grid *grid, int z, float *ret_slice)
{
	bool all = true;

#pragma omp parallel for schedule(static) reduction(&& : all)
	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const struct corners corners = corners_of_voxel(&s->grid, grid, x, y, z);
			float sum = 0;

			for (int i = 0; i < 8; i++)
				sum += corners.weight[i] * (float)s->seen[corners.at[i]];
			ret_slice[(size_t)y * (size_t)grid->size[0] + (size_t)x] = sum;
			all = all && sum >= 1;
		}
	return all;
}

/* Rows of the projections that count what lies outside of the grid: see exterior_rows.h. */
#include "core/correct/exterior_rows.h"

#include <math.h>
#include <stdlib.h>

#include "core/select.h"
#include "core/truncation.h"

enum {
	LOOKED_AT = 64, /* rays of a row, or rows of a view */
	SHARE = 32,     /* one ray in so many makes the row one that counts it */
	END = 16,       /* columns at an end of a row */
	APART = 2       /* since a detector's blur makes neighbours alike */
};

static const double OPEN_DENSITY = 0.25, OPEN_EXCESS = 0.02;

static int stride_of(int columns)
{
	return columns > LOOKED_AT ? columns / LOOKED_AT : 1;
}

/* The i-th of about LOOKED_AT rows, the outermost ones among them. */
static int row_looked_at(int i, int rows)
{
	const int looked_at = rows < LOOKED_AT ? rows : LOOKED_AT;

	return looked_at > 1 ? (int)((long long)i * (rows - 1) / (looked_at - 1)) : 0;
}

/* The two axes that lie in a face across `axis`, the faster one in memory first. */
static void axes_of(int axis, int ret[2])
{
	ret[0] = axis == 0 ? 1 : 0;
	ret[1] = axis == 2 ? 1 : 2;
}

static bool is_open(const struct faces *faces, const struct grid_passage *passage, int end)
{
	const struct grid *grid = faces->grid;
	const int axis = passage->axis[end];
	const double middle = grid->origin[axis] + 0.5 * (grid->size[axis] - 1) * grid->spacing[axis];
	int axes[2], index[2];

	axes_of(axis, axes);
	for (int i = 0; i < 2; i++) {
		const double at = (passage->point[end][axes[i]] - grid->origin[axes[i]]) / grid->spacing[axes[i]];

		index[i] = (int)fmin(fmax(round(at), 0), grid->size[axes[i]] - 1);
	}
	return faces->open[2 * axis + (passage->point[end][axis] > middle)]
			  [(size_t)index[1] * (size_t)grid->size[axes[0]] + (size_t)index[0]];
}

bool faces_row_counts_outside(const struct faces *faces, const struct view *view, int columns, int row,
			      const float *measured, const float *explained, float largest)
{
	const double level = (double)truncation_level_of_many(largest);
	int looked_at = 0, missed = 0, open = 0;
	double beside = 0, all = 0, excess = 0;

	for (int column = 0; column < columns; column += stride_of(columns)) {
		const struct grid_passage passage = grid_passage(faces->grid, view, column, row);

		looked_at++;
		if (passage.missed) {
			missed++;
			beside += (double)measured[column];
		} else if (is_open(faces, &passage, 0) || is_open(faces, &passage, 1)) {
			open++;
			all += (double)measured[column];
			excess += (double)measured[column] - (double)explained[column];
		}
	}
	if (open * SHARE > looked_at && excess > 0 && excess >= level * open && excess >= OPEN_EXCESS * all)
		return true;
	return missed * SHARE > looked_at && beside > 0 && beside >= level * missed;
}

/*
 * The deviation of noise in a view, by the lower quarter of second differences at both ends of its rows, where the
 * object is in few.
 */
static double noise_beside(const float *measured, int columns, int rows)
{
	/* A quarter of |d| of normal noise of deviation s is below 0.3186 sqrt(6) s. */
	const double quarter_of_one = 0.3186 * sqrt(6);
	const int looked_at = rows < LOOKED_AT ? rows : LOOKED_AT, quarter = columns / 4;
	const int least = quarter > 2 * APART ? quarter : 2 * APART + 1, end = least < END ? least : END;
	float bends[LOOKED_AT * 2 * END];
	int count = 0;

	if (columns < end)
		return 0;
	for (int i = 0; i < looked_at; i++)
		for (int side = 0; side < 2; side++) {
			const float *p =
			    measured + (size_t)row_looked_at(i, rows) * (size_t)columns + (side ? columns - end : 0);

			for (int c = 0; c + 2 * APART < end; c++)
				bends[count++] = fabsf(p[c] - 2 * p[c + APART] + p[c + 2 * APART]);
		}
	return (double)select_kth(bends, count, count / 4) / quarter_of_one;
}

/* Rays of a row. */
struct rays {
	int count;
	double sum;
};

static void rays_add(struct rays *rays, double value)
{
	rays->sum += value;
	rays->count++;
}

static bool rays_reach(const struct rays *rays, double level)
{
	return rays->sum > 0 && rays->sum >= level * rays->count;
}

/* More than noise makes of their mean in any of the thousands of rows of a scan. */
static double rays_chance(const struct rays *rays, double noise)
{
	const double deviations = 5;

	return deviations * noise / sqrt(fmax(1, rays->count));
}

struct outside_rows outside_rows(const struct grid *grid, const struct view *view, int columns, int rows,
				 const float *measured)
{
	const int looked_at = rows < LOOKED_AT ? rows : LOOKED_AT;
	const double level =
	    (double)truncation_level_of_many(truncation_largest(measured, columns, rows, 1, (size_t)columns));
	const double noise = noise_beside(measured, columns, rows);
	struct outside_rows found = {0};

	for (int i = 0; i < looked_at; i++) {
		const int row = row_looked_at(i, rows);
		struct rays missed = {0}, passed = {0};
		bool beside, ends;

		for (int column = 0; column < columns; column += stride_of(columns)) {
			const struct grid_passage passage = grid_passage(grid, view, column, row);
			const double p = (double)measured[(size_t)row * (size_t)columns + (size_t)column];

			if (passage.missed)
				rays_add(&missed, p);
			else if (passage.axis[0] == 2 || passage.axis[1] == 2)
				rays_add(&passed, p);
		}
		beside = rays_reach(&missed, level);
		ends = (row == 0 || row == rows - 1) && rays_reach(&passed, level);
		found.beside += beside;
		found.ends += ends;
		found.certain += (beside && rays_reach(&missed, rays_chance(&missed, noise))) ||
				 (ends && rays_reach(&passed, rays_chance(&passed, noise)));
	}
	return found;
}

/* The outermost layers, and the density of what is in the volume. */
static int read_faces(const struct backend *backend, struct volume *volume, const struct grid *grid, float *slice,
		      float *const ret_face[6], double *ret_density, struct error *err)
{
	const size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1];
	double squares = 0, sum = 0;

	for (int z = 0; z < grid->size[2]; z++) {
		const size_t along_x = (size_t)z * ny, along_y = (size_t)z * nx;
		const int code = backend->volume_download(volume, z, 1, slice, err);

		if (code < 0)
			return code;
		for (size_t y = 0; y < ny; y++) {
			ret_face[0][along_x + y] = slice[y * nx];
			ret_face[1][along_x + y] = slice[y * nx + nx - 1];
		}
		for (size_t x = 0; x < nx; x++) {
			ret_face[2][along_y + x] = slice[x];
			ret_face[3][along_y + x] = slice[(ny - 1) * nx + x];
		}
		for (size_t i = 0; i < nx * ny; i++) {
			if (z == 0)
				ret_face[4][i] = slice[i];
			if (z == grid->size[2] - 1)
				ret_face[5][i] = slice[i];
			squares += (double)slice[i] * (double)slice[i];
			sum += fabs((double)slice[i]);
		}
	}
	*ret_density = sum > 0 ? squares / sum : INFINITY;
	return 0;
}

static void find_open(const float *face, int width, int height, double density, bool *ret)
{
#pragma omp parallel for schedule(static)
	for (int j = 0; j < height; j++)
		for (int i = 0; i < width; i++) {
			double sum = 0;
			int count = 0;

			for (int b = j - FACE_REACH; b <= j + FACE_REACH; b++)
				for (int a = i - FACE_REACH; a <= i + FACE_REACH; a++)
					if (b >= 0 && b < height && a >= 0 && a < width) {
						sum += (double)face[(size_t)b * (size_t)width + (size_t)a];
						count++;
					}
			ret[(size_t)j * (size_t)width + (size_t)i] = sum >= OPEN_DENSITY * density * count;
		}
}

int faces_make(struct faces *ret_faces, const struct backend *backend, struct volume *volume, const struct grid *grid,
	       struct error *err)
{
	struct faces faces = {.grid = grid};
	float *slice = malloc(sizeof(float) * (size_t)grid->size[0] * (size_t)grid->size[1]), *face[6] = {NULL};
	bool enough = slice != NULL;
	double density;
	int code = 0, axes[2];

	for (int i = 0; i < 6; i++) {
		axes_of(i / 2, axes);
		const size_t voxels = (size_t)grid->size[axes[0]] * (size_t)grid->size[axes[1]];

		face[i] = malloc(sizeof(float) * voxels);
		faces.open[i] = malloc(sizeof(bool) * voxels);
		enough = enough && face[i] != NULL && faces.open[i] != NULL;
	}
	if (!enough)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the faces of the grid");
	if (code == 0)
		code = read_faces(backend, volume, grid, slice, face, &density, err);
	for (int i = 0; i < 6 && code == 0; i++) {
		axes_of(i / 2, axes);
		find_open(face[i], grid->size[axes[0]], grid->size[axes[1]], density, faces.open[i]);
	}
	for (int i = 0; i < 6; i++)
		free(face[i]);
	free(slice);
	if (code < 0)
		faces_clear(&faces);
	else
		*ret_faces = faces;
	return code;
}

void faces_clear(struct faces *faces)
{
	for (int i = 0; i < 6; i++)
		free(faces->open[i]);
	*faces = (struct faces){0};
}

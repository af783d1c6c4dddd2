/* Rows of the projections that count what lies outside of the grid: see exterior_rows.h. */
#include "core/correct/exterior_rows.h"

#include <math.h>
#include <stdlib.h>

#include "core/truncation.h"

enum {
	LOOKED_AT = 64, /* rays of a row, or rows of a view */
	SHARE = 32      /* one ray in so many makes the row one that counts it */
};

static const double OPEN_DENSITY = 0.25, OPEN_EXCESS = 0.02;

static int stride_of(int columns)
{
	return columns > LOOKED_AT ? columns / LOOKED_AT : 1;
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

struct outside_rows outside_rows(const struct grid *grid, const struct view *view, int columns, int rows,
				 const float *measured)
{
	const int looked_at = rows < LOOKED_AT ? rows : LOOKED_AT;
	const double level =
	    (double)truncation_level_of_many(truncation_largest(measured, columns, rows, 1, (size_t)columns));
	size_t beside = 0, ends = 0;

	for (int i = 0; i < looked_at; i++) {
		const int row = looked_at > 1 ? (int)((long long)i * (rows - 1) / (looked_at - 1)) : 0;
		int missed = 0, passed = 0;
		double missed_sum = 0, passed_sum = 0;

		for (int column = 0; column < columns; column += stride_of(columns)) {
			const struct grid_passage passage = grid_passage(grid, view, column, row);
			const double p = (double)measured[(size_t)row * (size_t)columns + (size_t)column];

			if (passage.missed) {
				missed++;
				missed_sum += p;
			} else if (passage.axis[0] == 2 || passage.axis[1] == 2) {
				passed++;
				passed_sum += p;
			}
		}
		beside += missed_sum > 0 && missed_sum >= level * missed;
		ends += (row == 0 || row == rows - 1) && passed_sum > 0 && passed_sum >= level * passed;
	}
	return (struct outside_rows){beside, ends};
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

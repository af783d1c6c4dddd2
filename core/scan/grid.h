#ifndef CBCT_CORE_GRID_H
#define CBCT_CORE_GRID_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"
#include "core/scan/geometry.h"

/* A box of voxels, data as [z][y][x] float32. Voxel (i, j, k) has its centre at origin + (i, j, k) * spacing. */
struct grid {
	int size[3];       /* nx, ny, nz */
	double spacing[3]; /* mm */
	double origin[3];  /* mm, centre of voxel 0,0,0 */
};

enum { GRID_SIZE_MAX = 8192 };

static inline size_t grid_voxels(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1] * (size_t)grid->size[2];
}

static inline size_t grid_voxel(const struct grid *grid, int x, int y, int z)
{
	return ((size_t)z * (size_t)grid->size[1] + (size_t)y) * (size_t)grid->size[0] + (size_t)x;
}

/* Centred on the isocentre. */
void grid_centre(struct grid *grid);

/* Sizes 1..GRID_SIZE_MAX, spacing positive, all finite. Pointers relative to the grid ("/size/0", "/spacing_mm/1",
 * "/origin_mm/2"). */
int grid_check(const struct grid *grid, struct error *err);

/*
 * ERR_IMPOSSIBLE when a source lies inside the grid (half a voxel beyond the
 * outer centres included) or a part of it beside or behind a source.
 */
int grid_check_geometry(const struct grid *grid, const struct geometry *geometry, struct error *err);

/* Finds where a line meets the grid's box, half a voxel beyond the outer centres. */
struct grid_passage {
	bool missed;
	int axis[2]; /* that it comes in and goes out across */
	double point[2][3];
};
/* The line from the source through a pixel's centre. */
struct grid_passage grid_passage(const struct grid *grid, const struct view *view, int column, int row);
/* mm of it that lie inside of the grid. */
double grid_ray_length(const struct grid *grid, const struct view *view, int column, int row);

#endif

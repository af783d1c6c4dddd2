#ifndef CBCT_CORE_PHANTOM_H
#define CBCT_CORE_PHANTOM_H

#include "core/scan/geometry.h"
#include "core/scan/grid.h"

/*
 * Ellipsoids, elliptic cylinders and boxes with exact line integrals: the
 * independent truth that every reconstruction is held against. Densities add
 * where shapes overlap.
 */
enum shape { SHAPE_ELLIPSOID, SHAPE_CYLINDER, SHAPE_BOX };

struct ellipsoid {
	enum shape shape;
	double semi_axes[3]; /* mm; a cylinder's third is its half length along z; a box's are half sides */
	double centre[3];    /* mm */
	double angle;        /* radians, turned about z, counter-clockwise seen from +z */
	double density;      /* 1/mm, added */
};

struct phantom {
	int count;
	struct ellipsoid *parts; /* [count], owned */
};

/*
 * By name: "shepp-logan" (Kak and Slaney's 3D head, densities 2, -.98, ...),
 * "head" (its high-contrast form, 1, -.8, -.2 ...), "ball" of radius 1, "cylinder"
 * of radius and half length 1, "disc" (the same, .05 half length), "asymmetric"
 * (small parts of different densities off-centre in x, y and z inside an ellipsoid
 * that fits into radius .9, so that mirrored or swapped axes show). `scale` mm is
 * the unit of lengths, `density` 1/mm multiplies the densities. phantom_names ends
 * with NULL. ERR_INVALID for an unknown name, a scale that is not positive, or
 * numbers that are not finite.
 */
extern const char *const phantom_names[];
int phantom_named(struct phantom *ret_phantom, const char *name, double scale, double density, struct error *err);
void phantom_clear(struct phantom *phantom);
void phantom_move(struct phantom *phantom, const double shift[3]);

/* Integral along the line from a to b (mm, the segment between them), dimensionless. */
double phantom_line_integral(const struct phantom *phantom, const double a[3], const double b[3]);
double phantom_density(const struct phantom *phantom, const double point[3]);

/* One view, [row][column]; OpenMP over rows. */
void phantom_project(const struct phantom *phantom, const struct geometry *geometry, int view, float *ret_projection);
/* [z][y][x]; each voxel the mean of samples^3 points. */
void phantom_voxelise(const struct phantom *phantom, const struct grid *grid, int samples, float *ret_volume);

/*
 * Line integrals of a voxel object [z][y][x] by fine ray sampling, nearest or
 * trilinear, at most `step` mm apart; the object ends half a voxel beyond the
 * outer centres. Deliberately not the reconstruction's projector. OpenMP over rows.
 */
enum sampling { SAMPLE_NEAREST, SAMPLE_TRILINEAR };
void volume_project_fine(const float *volume, const struct grid *grid, const struct geometry *geometry, int view,
			 enum sampling sampling, double step, float *ret_projection);

#endif

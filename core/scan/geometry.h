#ifndef CBCT_CORE_GEOMETRY_H
#define CBCT_CORE_GEOMETRY_H

#include "core/error.h"

/*
 * Where source and detector stood in each view.
 *
 * World frame in mm, right-handed, isocentre at the origin, z the rotation
 * axis. Circular orbits, angle lists and 3x4 matrices all become the one
 * vector form below on entry; nothing after that knows which it was. All of it
 * is double; a geometry is const once made and may be read by any thread.
 *
 * Pixel centres are the integers: the point of column c, row r is
 * pixel0 + c column_step + r row_step.
 */
struct view {
	double source[3];      /* mm */
	double pixel0[3];      /* mm, centre of column 0, row 0 */
	double column_step[3]; /* mm from one column to the next: the detector's u */
	double row_step[3];    /* mm from one row to the next: the detector's v */
};

struct geometry {
	int columns, rows;  /* of the detector, pixels */
	int count;          /* views */
	struct view *views; /* [count], owned */
};

/* A circular orbit, as the contract writes it. */
struct circular {
	double source_to_isocentre, source_to_detector; /* mm */
	double pixel[2];                                /* mm, along u and v */
	double detector_offset[2];                      /* mm, moves the detector along +u and +v */
	double source_offset[2];                        /* mm, moves the source along +u and +v */
};

enum { VIEWS_MAX = 20000, DETECTOR_MAX = 16384 };

/*
 * Each of these allocates ret->views (free with geometry_clear) and checks the
 * result: finite, source not on the detector's plane, steps not parallel.
 * Errors point into the geometry's JSON ("/matrices/3").
 */
int geometry_circular(struct geometry *ret_geometry, int columns, int rows, int count, const struct circular *orbit,
		      const double *angles /* [count], radians */, struct error *err);
/*
 * P = [M | p4] takes (x, y, z, 1) in mm to w (column, row, 1), any scale and
 * sign. S = -M^-1 p4; the columns of M^-1 are t (u, v, D - S), with t fixed by
 * |u| = pixel_mm[0].
 */
int geometry_matrices(struct geometry *ret_geometry, int columns, int rows, int count,
		      const double *matrices /* [count][12] */, const double pixel_mm[2], struct error *err);
int geometry_views(struct geometry *ret_geometry, int columns, int rows, int count, const struct view *views,
		   struct error *err);
int geometry_copy(struct geometry *ret_geometry, const struct geometry *geometry, struct error *err);
/* Makes the geometry of the same detector read out the other way: its columns are rows, and its rows columns. */
int geometry_exchange(struct geometry *ret_geometry, const struct geometry *geometry, struct error *err);
void geometry_clear(struct geometry *geometry);

/* Blocks of `size` pixels that become one, as many as the detector holds; the first begins at pixel `first`. */
struct pixel_blocks {
	int size[2], first[2], count[2]; /* along columns and rows */
};
/*
 * Blocks of n x n pixels, of n x 1 on a detector of one row. Pixels that no block takes are left out, half of them at
 * each side. The count is 0 where the detector is smaller than a block.
 */
struct pixel_blocks geometry_blocks(const struct geometry *geometry, int n);
/* Makes the geometry of the detector whose pixels are these blocks; ERR_IMPOSSIBLE where there are none. */
int geometry_bin(struct geometry *ret_geometry, const struct geometry *geometry, int n, struct error *err);

/* Column step for row step. */
void view_exchange(struct view *view);

/*
 * The 3x4 matrix of a view, row by row, scaled so that w is the depth in mm:
 * the distance from the source along the detector's normal, positive in front.
 * With D = pixel0, u = column_step, v = row_step, w = D - S:
 * A = [(v x w)^T; (w x u)^T; (u x v)^T], P = [A | -A S] / |u x v|, sign for w > 0 at the detector.
 */
void view_matrix(const struct view *view, double ret_matrix[12]);

/* Depth of a point and its pixel coordinates; the depth may be <= 0, then the pixel means nothing. */
double view_project(const double matrix[12], const double point[3], double *ret_column, double *ret_row);

/* Pixels between a pixel and the image of z, the axis of the rotation, in the view of this matrix; NAN: there is none.
 */
double view_axis_distance(const double matrix[12], double column, double row);

/* A rotation axis: a place on it, mm, and its unit vector, z where that is all 0. All 0: z through the origin. */
struct rotation_axis {
	double at[3], along[3];
};

/* Unit vector from a source straight across to the axis; from on the axis to its place, and from there 0. */
void axis_direction(const double source[3], const struct rotation_axis *axis, double ret_direction[3]);

/*
 * True when every detector row is across z and every column along z, the
 * source's rays to one column thus share their x and y: the fast kernels'
 * case. Tolerance: the error over the whole detector is below 1e-3 pixel.
 */
int geometry_is_untilted(const struct geometry *geometry);

/* ---- small vectors, used all over core ---- */
static inline double vec_dot(const double a[3], const double b[3])
{
	return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
static inline void vec_cross(const double a[3], const double b[3], double ret[3])
{
	ret[0] = a[1] * b[2] - a[2] * b[1];
	ret[1] = a[2] * b[0] - a[0] * b[2];
	ret[2] = a[0] * b[1] - a[1] * b[0];
}
double vec_norm(const double a[3]);

#endif

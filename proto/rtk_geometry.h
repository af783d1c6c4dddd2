#ifndef CBCT_PROTO_RTK_GEOMETRY_H
#define CBCT_PROTO_RTK_GEOMETRY_H

#include <stdbool.h>
#include <stddef.h>

#include "core/scan/geometry.h"

/*
 * The geometry files of RTK (the Reconstruction Toolkit, openrtk.org):
 * RTKThreeDCircularGeometry, version 3 (2 is a part of it), both ways.
 *
 * RTK's world turns about y, ours about z: (x, y, z) of ours = (z, x, y) of RTK's,
 * and the gantry angle stays the same. RTK places the detector in mm; which pixel
 * is where says the stack of images beside it (Origin, Spacing and direction of
 * the MetaImage).
 */

/* One <Projection>, as the file has it: mm and degrees. */
struct rtk_projection {
	double gantry_angle, out_of_plane_angle, in_plane_angle;
	double source_to_isocentre, source_to_detector; /* a distance to the detector of 0 means parallel rays */
	double source_offset[2], projection_offset[2];  /* x, y */
	bool has_matrix;
	double matrix[12]; /* (x, y, z, 1) of RTK's world to w (u, v, 1), u and v in mm on the detector */
};

struct rtk_geometry {
	int count;
	struct rtk_projection *projections; /* [count], owned */
	bool collimated;                    /* collimation was given; it has no meaning for the geometry */
};

/* Where the pixels of a stack lie on RTK's detector: (u, v) = origin + column column_step + row row_step, mm. */
struct rtk_stack {
	double origin[2], column_step[2], row_step[2];
};

/* Which of the two descriptions in a file counts. */
enum rtk_trust {
	RTK_BOTH,       /* they must agree to RTK_AGREEMENT */
	RTK_PARAMETERS, /* matrices are not looked at */
	RTK_MATRICES,   /* parameters are not looked at */
	RTK_TRUST_COUNT
};
extern const char *const rtk_trust_names[RTK_TRUST_COUNT]; /* "both", "parameters", "matrices" */
#define RTK_AGREEMENT 0.05 /* pixels: more than rounded numbers make, less than a picture shows */

enum { RTK_BYTES_MAX = 64 << 20 };

/*
 * Reads a file's text. What an element says holds for its projection and all that
 * follow, as in RTK; a matrix for its own only. ERR_INVALID with the line for
 * what is not well-formed, not known, not a number or not finite, and for entities,
 * which could grow beyond any memory; ERR_IMPOSSIBLE for a cylindrical detector
 * and more than VIEWS_MAX projections; ERR_TOO_LARGE beyond RTK_BYTES_MAX.
 */
int rtk_geometry_parse(const char *text, size_t length, struct rtk_geometry *ret_geometry, struct error *err);
void rtk_geometry_clear(struct rtk_geometry *geometry);

/*
 * Vectors in our world; free with geometry_clear. ERR_CONFLICT names the view
 * whose matrix is farthest from its parameters and by how many pixels.
 */
int rtk_geometry_views(const struct rtk_geometry *from, const struct rtk_stack *stack, int columns, int rows,
		       enum rtk_trust trust, struct geometry *ret_geometry, struct error *err);

/*
 * The other way: parameters and matrices for any views with rectangular pixels of
 * one size; the stack's origin is the detector's centre and what is left over goes
 * into the projection offsets. ERR_IMPOSSIBLE names the view that RTK's parameters
 * cannot express: skewed pixels, a pitch or handedness that changes, beyond
 * `tolerance` pixels at the far end of the detector.
 */
int rtk_geometry_from_views(const struct geometry *from, double tolerance, struct rtk_geometry *ret_geometry,
			    struct rtk_stack *ret_stack, struct error *err);

/* The file's text, to be freed with free, NULL for no memory. What is the same for all stands once, as RTK writes it.
 */
char *rtk_geometry_print(const struct rtk_geometry *geometry, size_t *ret_length);

#endif

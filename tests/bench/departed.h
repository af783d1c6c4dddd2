#ifndef CBCT_TESTS_DEPARTED_H
#define CBCT_TESTS_DEPARTED_H

#include "core/refine/refine.h"
#include "tests/bench/bodies.h"
#include "tests/unit/arm.h"

/*
 * Scans of bodies (bodies.h) by an arm that sags, or of one that moves meanwhile, told of with the circle's geometry;
 * what the refinement (core/refine/refine.h) makes of them, and how far a geometry is off: in mm between where points
 * lie and where it has them, and in HU of its FDK volume.
 */
enum departed_motion {
	MOTION_NONE,
	MOTION_NOD,    /* a head's, about the neck, by 3 degrees and 3 mm within a tenth of the sweep */
	MOTION_DRIFT,  /* a hand's, about the wrist, by 3 mm and 2 degrees, all the time */
	MOTION_TURN,   /* about its long axis by 3 degrees, and 3 mm, within a tenth of the sweep */
	MOTION_JERK,   /* by 3 degrees and 3 mm, and back within a tenth of the sweep */
	MOTION_TREMOR, /* to and fro by .5 mm and .3 degrees, 25 times: 5 Hz in a sweep of 5 s */
};

struct departure {
	const char *name;
	enum refine_kind kind;
	double sag, jitter; /* the arm's (arm.h) */
	enum departed_motion motion;
	double photons; /* in a pixel of the open beam; 0: no noise */
	double aside;   /* of the detector, along its columns: a share of its width */
};

struct departed {
	struct body body;
	struct arm arm;
	struct geometry truth, said; /* as the object was seen, and as the scan says */
	float *projections;          /* [view][row][column], line integrals */
};

/* A detector of 379 x 296 mm with so many columns; arc: degrees. Close it, whatever is returned. */
int departed_open(struct departed *scan, const struct departure *departure, enum kind kind, int seed, int columns,
		  int count, double arc, struct error *err);
void departed_close(struct departed *scan);

/* What is found of it. ret_seconds: of all processors together, and of the clock on the wall. */
int departed_refine(const struct departed *scan, enum refine_kind kind, const struct backend *backend,
		    const struct refine_reference *reference, struct geometry *ret_geometry,
		    struct refinement *ret_refinement, double ret_seconds[2], struct error *err);

/*
 * Root mean square distance at the isocentre between where points lie and where `said` has them, moved as a whole so
 * that it is least: no scan tells where the object lay. ret_motion: by what it is moved.
 */
int departed_compare(const struct geometry *truth, const struct geometry *said, double *ret_mm,
		     double ret_motion[PATH_NUMBERS], struct error *err);
/* The same between two geometries as they are; NAN without memory. */
double departed_distance(const struct geometry *a, const struct geometry *b);
/*
 * Root mean square error, HU, of the FDK volume of at most so many voxels a side by a geometry that is moved as a
 * whole: within the body but for its metal, in every other voxel along each axis.
 */
int departed_error(const struct backend *backend, const struct departed *scan, const struct geometry *geometry,
		   const double motion[PATH_NUMBERS], int voxels, double *ret_hu, struct error *err);

#endif

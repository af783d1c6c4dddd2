#ifndef CBCT_TESTS_ARM_H
#define CBCT_TESTS_ARM_H

#include <stdint.h>

#include "core/calibrate/calibrate.h"

/*
 * A C-arm that sags, and the pictures that it takes of balls: chord lengths through balls and a cylinder, ray by ray,
 * from nothing of the project but its struct view.
 */
struct arm {
	int columns, rows, count; /* views */
	double pixel;             /* mm */
	double first, step;       /* radians */
	double sag;               /* 1: as measured by Daly and others (2008); 0: a circle */
	double jitter;            /* mm, source and detector, another one in each view */
	unsigned seed;
};

/* The true view, and the circle's. */
struct view arm_view(const struct arm *arm, int view);
struct view arm_nominal(const struct arm *arm, int view);
/* All nominal views; free with geometry_clear. */
int arm_nominal_geometry(const struct arm *arm, struct geometry *ret_geometry, struct error *err);

/* What is in the picture. */
struct target {
	const struct balls *balls;
	double ball;         /* 1/mm, attenuation */
	double body, radius; /* 1/mm and mm, of a cylinder about z */
	int missing;         /* of every so-many-th ball nothing is there; 0: all are */
	bool metal;          /* a clip of metal and a cable */
	double photons;      /* for each pixel in air; 0: no noise */
	double blur;         /* pixels, by which the rays of a pixel reach further than its side, with several rays */
	int rays;            /* along either side of a pixel, whose intensities it adds up; 0: one through its middle */
};

/* Line integrals of a view, [row][column]. */
void arm_picture(const struct arm *arm, const struct target *target, int view, float *ret_picture);

/* Pictures of a target as `calibrate` asks for them: arm_image with a struct arm_scene as its context. */
struct arm_scene {
	struct arm arm;
	struct target target;
};
int arm_image(void *context, int view, float *ret_image, struct error *err);
/* Calibrates an arm from such pictures, or others, and a drawing. */
int arm_calibrate(const struct arm *arm, calibrate_image *image, void *context, const struct balls *drawing,
		  bool adjust_balls, struct calibration *ret_calibration, struct error *err);
/* RMS distance, pixels, between where a view and the true one see 27 points of the volume. */
double arm_wrong(const struct arm *arm, int view, const struct view *found);

#endif

#ifndef CBCT_CLIENTS_OBJECT_H
#define CBCT_CLIENTS_OBJECT_H

#include "clients/cbct/volume_input.h"
#include "core/scan/phantom.h"

/* The object of a simulation: an analytic phantom, a phantom of balls, or a voxel volume. */
struct object_options {
	int phantom;       /* an index into phantom_names, or unset */
	const char *balls; /* file of a phantom as proto/calibration.h reads it */
	const char *volume;
	double scale, density; /* of the phantom: mm and 1/mm */
	double shift[3];       /* mm */
	int sampling;          /* of the volume: enum sampling */
	double step;           /* mm between samples along a ray; NaN: half of the smallest spacing */
	struct volume_options file;
};
extern const struct option object_phantom_rows[], object_volume_rows[];
#define OBJECT_OPTIONS_DEFAULTS                                                                                        \
	{                                                                                                              \
		.phantom = OPTION_UNSET_CHOICE, .scale = 100, .density = 0.02, .sampling = SAMPLE_TRILINEAR,           \
		.step = OPTION_UNSET_NUMBER, .file = VOLUME_OPTIONS_DEFAULTS                                           \
	}

struct object {
	struct phantom phantom; /* count 0: it is the volume */
	struct grid grid;
	float *voxels; /* 1/mm */
	enum sampling sampling;
	double step;
};

int object_open(const struct object_options *options, struct object *ret_object, struct error *err);
void object_close(struct object *object);

/* Exact line integrals of a phantom, fine ray sampling of a volume; [row][column]. */
void object_project(const struct object *object, const struct geometry *geometry, int view, float *ret_projection);

#endif

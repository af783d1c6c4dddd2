#ifndef CBCT_CLIENTS_IMPORT_GEOMETRY_H
#define CBCT_CLIENTS_IMPORT_GEOMETRY_H

#include <cjson/cJSON.h>

#include "clients/cbct/images.h"
#include "proto/patient.h"

/* Where source and detector stood for images of other tools: what the command line says, or the images themselves. */
struct import_geometry {
	const char *rtk, *matrices, *astra, *angles; /* files, at most one of them */
	int trust;                                   /* enum rtk_trust */
	double first_angle, angle_step;              /* degrees; step NaN: not given */
	bool clockwise, radians;
	const char *patient; /* a position or "unknown"; NULL: as the images say */
	double first_pixel;  /* what the matrices call the centre of the first column and row */
	double pixel[2];     /* mm; NaN: from the images */
	double source_to_isocentre, source_to_detector; /* mm; NaN: not given */
	double detector_offset[2], source_offset[2];    /* mm */
};
extern const struct option import_geometry_rows[];
#define IMPORT_GEOMETRY_DEFAULTS                                                                                       \
	{                                                                                                              \
		.angle_step = OPTION_UNSET_NUMBER, .pixel = {OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER},                \
		.source_to_isocentre = OPTION_UNSET_NUMBER, .source_to_detector = OPTION_UNSET_NUMBER                  \
	}

/*
 * Members "detector" and "geometry" of a scan's document for these images, the
 * caller's, and how the patient lies. ERR_INVALID where views are missing or too many, ERR_USAGE where
 * nothing tells a distance or the angles.
 */
int import_geometry(const struct import_geometry *options, const struct images *images, cJSON **ret_detector,
		    cJSON **ret_geometry, struct patient *ret_patient, struct error *err);

#endif

#ifndef CBCT_CLIENTS_SETUP_H
#define CBCT_CLIENTS_SETUP_H

#include "clients/cbct/options.h"
#include "proto/scan.h"

/* Where source and detector of a simulated scan stand: from numbers, or from another scan's document. */
struct setup_options {
	const char *scan, *name;
	long views, columns, rows;
	double arc, first_angle; /* degrees */
	bool clockwise;
	double pixel[2];
	double source_to_isocentre, source_to_detector; /* mm */
	double detector_offset[2], source_offset[2];
	double wobble; /* mm */
	long wobble_seed;
	int sag;       /* an index into its names, or unset */
	double jitter; /* mm */
	int kind;      /* enum setup_kind */
	int patient;   /* enum patient_position, or unset */
};
extern const struct option setup_rows[];
#define SETUP_OPTIONS_DEFAULTS                                                                                         \
	{                                                                                                              \
		.name = "simulated", .views = 180, .columns = 256, .rows = 256, .arc = 360, .pixel = {1.6, 1.6},       \
		.source_to_isocentre = 620, .source_to_detector = 1100, .wobble_seed = 1, .sag = OPTION_UNSET_CHOICE,  \
		.patient = OPTION_UNSET_CHOICE                                                                         \
	}

/*
 * The document of POST /v1/scans and what it means. `projections` are its
 * members sample, quantity and air without count, which is filled in.
 * A full turn has its last view one step before the first; any other arc has a
 * view at both ends. Sag and jitter are of the arm alone: a circular document knows nothing of them, and
 * (*ret_scan)->geometry is then where the views truly stand.
 */
int setup_scan(const struct setup_options *options, cJSON *projections, struct scan **ret_scan, struct error *err);

#endif

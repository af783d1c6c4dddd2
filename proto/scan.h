#ifndef CBCT_PROTO_SCAN_H
#define CBCT_PROTO_SCAN_H

#include "core/backend.h"
#include "core/scan/orbit.h"
#include "proto/subject.h"
#include "proto/json.h"
#include "proto/patient.h"

enum { SCAN_NAME_MOST = 255 }; /* characters */
#define SCAN_NAME_BYTES TEXT_BYTES(SCAN_NAME_MOST)

/* A scan as it is posted: what the detector and the orbit are, not the samples themselves. */
struct scan {
	char name[SCAN_NAME_BYTES];
	double pixel_mm[2];
	int count; /* projections */
	enum sample sample;
	enum quantity quantity;
	double air;        /* counts; 0 = not given: a flat image must come */
	double saturation; /* counts; 0 = the sample type's own */
	bool has_air_region;
	int air_region[4]; /* first column, first row, last column, last row */
	double hardening[HARDENING_MOST];
	int hardening_count;          /* coefficients, 0: none */
	struct lag_model lag;         /* count 0: none */
	struct scatter_model scatter; /* neither kernels, nor a fraction, a body or images: none */
	struct patient patient;       /* how the patient lies */
	struct subject subject;       /* who that is, and the study */
	struct geometry geometry;
	struct orbit orbit;
	int *projection; /* [count], owned, after scan_reduce: the number of each view's projection; NULL: its own */
	cJSON *document; /* as posted, checked: members name, patient, study, source, labels, detector, projections,
			    geometry */
};

extern const char *const sample_names[2];   /* "float32", "uint16" */
extern const char *const quantity_names[2]; /* "line_integral", "intensity" */

/*
 * Where a geometry of the kind "calibration" comes from. find: the views for `scan`, of which detector and projections
 * are read, whose sources stand at `angles` [count], radians (NULL: as they were calibrated); adds what is to be told
 * to ret_notes, a list of {"code", "detail"}. Allocates ret_geometry->views. Its errors point into the scan's document.
 */
struct scan_calibrations {
	void *context;
	int (*find)(void *context, const char *id, const struct scan *scan, const double *angles,
		    struct geometry *ret_geometry, cJSON *ret_notes, struct error *err);
};

/* Reads and checks the document of POST /v1/scans. Free with scan_free. */
int scan_parse(const char *text, size_t length, struct scan **ret_scan, struct error *err);
/* The same where calibrations are known by their ids: the document gets the matrices of the one that it names. */
int scan_parse_calibrated(const char *text, size_t length, const struct scan_calibrations *calibrations,
			  struct scan **ret_scan, struct error *err);
void scan_free(struct scan *scan);

/*
 * Leaves the views whose projection is present, flags [count], in their order:
 * count, geometry and orbit are then theirs, so that arc, weights and subsets
 * are those of what was measured. For a scan that has not been reduced before;
 * unchanged on failure. ERR_INVALID when none is present.
 */
int scan_reduce(struct scan *scan, const unsigned char *present, struct error *err);

size_t sample_bytes(enum sample sample);
size_t scan_projection_bytes(const struct scan *scan); /* columns * rows * sample */
/* The scan's struct linearise, all of it but the images; it borrows from the scan. */
struct linearise scan_linearise(const struct scan *scan);

/* Every scalar parameter of the document as parameter_json has it (proto/parameter.h). NULL for no memory. */
cJSON *scan_parameters_json(void);

/* `derived` and `warnings` of the reply, new cJSON values of the caller's. */
cJSON *scan_derived(const struct scan *scan);
cJSON *scan_warnings(const struct scan *scan);

#endif

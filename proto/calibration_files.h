#ifndef CBCT_PROTO_CALIBRATION_FILES_H
#define CBCT_PROTO_CALIBRATION_FILES_H

#include "proto/calibration.h"

/*
 * The directory of one of the daemon's calibrations:
 *
 *   request.json  {"scan": id, "arm", "phantom": {...}, "adjust_balls", "created", "acquired": seconds since
 *                 1970, "sweep": the document of the scan}: what to do, written by the daemon; again, with "runs", for
 *                 each process that ended without a result; and again, with "made": true, once there is a result
 *   result.json   {"ended", "error": null} and the members of calibration_json; or
 *                 {"ended", "error": {"code": enum error_code, "detail", "pointer"}}: written by cbct-worker, or by the
 *                 daemon where no process comes to an end
 *
 * Of a calibration that a job has refined (proto/refinement.h) the request has "job" in place of the phantom,
 * and the result "geometry" alone: the daemon writes both.
 *
 * Request and result end with their checksums (proto/seal.h). A directory without a result is a calibration that is
 * still to be made, or a damaged one where the request says that it was.
 */
#define CALIBRATION_REQUEST "request.json"
#define CALIBRATION_RESULT "result.json"
#define CALIBRATION_MADE "made"
#define CALIBRATION_RUNS "runs"

/* Whole or not at all, as file_write_durable. */
int sealed_write(const char *path, const cJSON *document, struct error *err);
/* The same without checksums. */
int unsealed_write(const char *path, const cJSON *document, struct error *err);
/* ERR_NOT_FOUND where there is no file, ERR_DAMAGED where it does not fit its checksums. Free with cJSON_Delete. */
int sealed_read(const char *path, cJSON **ret_document, struct error *err);

/*
 * Calibrates as request.json says, from the scan's directory, and writes result.json, with the error where the pictures
 * do not fit. Fails where no result could be written.
 */
int calibration_run(const char *directory, const char *scan_directory, struct error *err);

/* A finished calibration, read again from both documents; pointers are owned. Free with calibrated_clear. */
struct calibrated {
	struct scan *sweep; /* the scan of the phantom: nominal geometry, detector */
	double acquired;    /* when that scan was made, seconds since 1970 */
	struct geometry geometry;
	int between;        /* views that were not used: they have places between their neighbours' */
	struct balls balls; /* none: a job has refined it, and there was no phantom */
};
int calibrated_read(const cJSON *request, const cJSON *result, struct calibrated *ret, struct error *err);
void calibrated_clear(struct calibrated *calibrated);

/* Radians by which a phantom may stand turned about z against its drawing without a word: 3 degrees. */
#define CALIBRATED_TURN_MOST (3 * 3.14159265358979 / 180)

/*
 * The views of another scan by a calibration. angles: [count] of its sources, radians; NULL: those of the calibrated
 * sweep, view by view. Allocates ret_geometry->views, for the scan's own detector. Adds to ret_notes, a list, what is
 * to be told: {"code", "detail"} of warnings. ERR_IMPOSSIBLE for another count without angles and for angles beyond the
 * sweep; errors point into the geometry's document.
 */
int calibrated_views(const struct calibrated *calibrated, const struct scan *scan, const double *angles,
		     struct geometry *ret_geometry, cJSON *ret_notes, struct error *err);

/*
 * A view's samples as a picture, with a circle where the calibration has each ball. samples: of the scan's type,
 * [row][column]. Allocates *ret_png (free).
 */
int calibrated_picture(const struct calibrated *calibrated, int view, const void *samples, char **ret_png,
		       size_t *ret_length, struct error *err);

#endif

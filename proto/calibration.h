#ifndef CBCT_PROTO_CALIBRATION_H
#define CBCT_PROTO_CALIBRATION_H

#include "core/calibrate/calibrate.h"
#include "proto/json.h"
#include "proto/scan_directory.h"

/*
 * Calibrations between files and core/calibrate: phantoms of balls as JSON, a scan directory as pictures, and the
 * result as a document.
 *
 *   {"balls_mm": [[x, y, z, diameter], ...]}
 *   {"kind": "circles", "circles": 2, "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 3.2,
 *    "first_angle_deg": 0, "shift_deg": 15}
 *   {"kind": "helix", "balls": 40, "diameter_mm": 110, "pitch_mm": 40, "angle_step_deg": 24, "first_angle_deg": 0,
 *    "ball_mm": 3, "large_ball_mm": 5, "code": "1101001..."}
 */

/* Reads a phantom; free with balls_clear. Errors point into the phantom. */
int balls_read(const cJSON *phantom, struct balls *ret_balls, struct error *err);
int balls_parse(const char *text, size_t length, struct balls *ret_balls, struct error *err);

/*
 * Calibrates from a scan directory with the geometry of its scan.json as the nominal one; every projection must be
 * there, and fit its checksum where there are some (ERR_DAMAGED). ERR_IMPOSSIBLE for intensities without their air.
 * Free with calibration_clear.
 */
int calibration_from_directory(const struct scan_files *files, const struct balls *balls, bool adjust_balls,
			       struct calibration *ret_calibration, struct error *err);

/*
 * The document of a calibration: residuals, balls found, views refused and why, and `geometry`, matrices that may stand
 * in a scan's document. NULL for no memory; the caller's to delete.
 */
cJSON *calibration_json(const struct calibration *calibration);
/*
 * What is doubtful of a calibration, by the numbers of its document: a list of {"code", "detail"} of warnings
 * (core/warning.h), the caller's to delete.
 */
cJSON *calibration_doubts(const cJSON *json);
/* The `geometry` of a scan document, kind "matrices". */
cJSON *matrices_json(const struct view *views, int count);

#endif

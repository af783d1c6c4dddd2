#ifndef CBCT_PROTO_PATIENT_H
#define CBCT_PROTO_PATIENT_H

#include <stdbool.h>

#include "proto/json.h"

/*
 * How the patient lies in the world: the member "patient" of scans and jobs.
 *
 * The world is fixed to the table. For HFS (head first, supine: DICOM's Patient
 * Position, PS3.3 C.7.3.1.1.2) its +x, +y and +z are the patient's left, back and
 * head, so +y points down to the table and the head lies towards +z. The letters
 * of the other positions say which end comes first (feet first: towards +z) and
 * what lies below: S the back, P the front, DL the left side, DR the right side.
 *
 * The patient's own coordinates are DICOM's LPS: mm to the left, the back
 * (posterior) and the head (superior).
 */
enum patient_position {
	PATIENT_HFS,
	PATIENT_HFP,
	PATIENT_FFS,
	PATIENT_FFP,
	PATIENT_HFDL,
	PATIENT_HFDR,
	PATIENT_FFDL,
	PATIENT_FFDR,
	PATIENT_POSITION_COUNT
};
extern const char *const patient_position_names[PATIENT_POSITION_COUNT + 1]; /* "HFS" ... NULL */

struct patient {
	bool known;
	int position;          /* enum patient_position; -1: given as a matrix, or not known */
	double rotation[3][3]; /* [patient's axis][world's axis], det 1; the unit matrix where not known */
	double offset[3];      /* mm: the isocentre in the patient's coordinates */
};
extern const struct patient patient_unknown;

struct patient patient_in(enum patient_position position);

/*
 * Reads {"position": "HFP"} or {"world_to_patient": [16 numbers, row by row]};
 * NULL and null are unknown. The matrix takes (x, y, z, 1) of the world to the
 * patient's mm and must be rigid: ERR_IMPOSSIBLE otherwise, a mirror included.
 * Within what a few printed digits leave of a rotation, the nearest one is taken.
 */
int patient_read(const cJSON *value, const char *base, struct patient *ret_patient, struct error *err);
/* The same from a reader that is asked for other members, too; *ret_patient stays as it is where neither is given. */
void patient_members(struct json_reader *reader, bool required, struct patient *ret_patient);
/* The same member, NULL for no memory; null where not known. Reads back to the same patient. */
cJSON *patient_json(const struct patient *patient);
bool patient_same(const struct patient *a, const struct patient *b);

/* World to patient, mm. */
void patient_point(const struct patient *patient, const double world[3], double ret[3]);
void patient_direction(const struct patient *patient, const double world[3], double ret[3]);

/*
 * For directions axes[i] of three axes at right angles: which of the patient's axes
 * (0 left, 1 posterior, 2 superior) each lies along, forwards or backwards; each of
 * them once, the clearest first.
 */
void axes_nearest(double axes[3][3], int ret_nearest[3]);

/*
 * Where the sides of the patient lie that the world's axis points to (negative:
 * away from): "L", "R", "P", "A", "S" or "I"; in between up to three of them, the
 * nearest first. Neutral where not known: "+x", "-x" ...
 */
enum { PATIENT_LETTERS_MAX = 8 };
void patient_letters(const struct patient *patient, int axis, bool negative, char ret_letters[PATIENT_LETTERS_MAX]);
/* The same of any direction of length 1 in the world; not known: the ends of the axes that it points to, "+x-z". */
void patient_letters_towards(const struct patient *patient, const double world[3],
			     char ret_letters[PATIENT_LETTERS_MAX]);
/* {"x": "L", "y": "P", "z": "S"}, the letters of the world's three axes; null where not known. */
cJSON *patient_axes_json(const struct patient *patient);

#endif

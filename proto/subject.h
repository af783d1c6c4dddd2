#ifndef CBCT_PROTO_SUBJECT_H
#define CBCT_PROTO_SUBJECT_H

#include <stdbool.h>
#include <stdint.h>

#include "proto/json.h"

/*
 * The patient and the study of a scan: members of "patient" and "study" in a scan's document, in DICOM's words
 * (PS3.3 C.7.1.1 and C.7.2.1) and within the limits of DICOM's value representations (PS3.5 6.2), so that all that is
 * accepted can be written. Dates are YYYY-MM-DD, times HH:MM:SS.
 *
 * A job has those of its scan, copied when it is posted. Errors, logs and metrics never contain a value.
 */
enum subject_field { /* up to STUDY_UID: those that tell one patient and study from another */
		     PATIENT_NAME,
		     PATIENT_ID,
		     PATIENT_BIRTH_DATE,
		     PATIENT_SEX,
		     STUDY_UID,
		     STUDY_ID,
		     STUDY_ACCESSION_NUMBER,
		     STUDY_DESCRIPTION,
		     STUDY_REFERRING_PHYSICIAN,
		     STUDY_DATE,
		     STUDY_TIME,
		     STUDY_STEP_ID, /* of the worklist: Scheduled Procedure Step ID, Requested Procedure ID */
		     STUDY_PROCEDURE_ID,
		     SUBJECT_COUNT
};

enum { UID_MOST = 64 /* characters */ };
#define UID_EXPECTED "a UID is expected: at most 64 characters, numbers with dots between them"
/* PS3.5 9.1: not empty, components without leading zeros. */
bool uid_valid(const char *text);

enum { SUBJECT_MOST = 3 * 64 + 2 }; /* characters of the longest, a name of three component groups */

struct subject {
	char text[SUBJECT_COUNT][TEXT_BYTES(SUBJECT_MOST)]; /* UTF-8; "": not told */
};

struct subject_row {
	const char *object, *name; /* "patient", "birth_date" */
	char vr[3];                /* DICOM's value representation */
	uint16_t group, element;   /* DICOM's tag */
};
extern const struct subject_row subject_rows[SUBJECT_COUNT];

/*
 * Asks the reader of "patient" or "study" (`object`) for its members. ERR_INVALID for what is no such value,
 * ERR_IMPOSSIBLE for a date or time that no calendar or clock has. An empty text is not told.
 */
void subject_members(struct json_reader *reader, const char *object, struct subject *ret_subject);
/* True where a member of the object ("patient", "study"; NULL: of either) is told. */
bool subject_known(const struct subject *subject, const char *object);
/* {"patient": {...}, "study": {...}} of what is told. NULL for no memory. */
cJSON *subject_json(const struct subject *subject);
/* The text of that; "" is nothing told. */
int subject_parse(const char *text, struct subject *ret_subject, struct error *err);

/* The value as DICOM writes it: dates and times without separators. */
void subject_value(const struct subject *subject, enum subject_field field, char ret[TEXT_BYTES(SUBJECT_MOST)]);
/* Takes a value in DICOM's form, blanks around it dropped; false, and not told, where it is none. */
bool subject_take(struct subject *subject, enum subject_field field, const char *value);

#endif

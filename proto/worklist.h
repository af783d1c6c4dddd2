#ifndef CBCT_PROTO_WORKLIST_H
#define CBCT_PROTO_WORKLIST_H

#include "proto/subject.h"

/*
 * An entry of the modality worklist (PS3.4 annex K): a scheduled step, with the patient and the study as a scan's
 * document has them, so that a scan takes both as they are.
 */
enum { WORKLIST_MOST = 500 }; /* entries */

enum worklist_field {
	STEP_ID,
	STEP_PROCEDURE, /* Requested Procedure ID */
	STEP_DESCRIPTION,
	STEP_DATE,
	STEP_TIME,
	STEP_MODALITY,
	STEP_STATION,   /* AE title */
	STEP_PERFORMER, /* Scheduled Performing Physician's Name */
	STEP_FIELD_COUNT
};

/*
 * The entry of values as a peer has sent them, in UTF-8 or not; NULL and "": not told. A value that is none is left
 * out, and named in "not_read". NULL for no memory, or where a value that tells one patient or study from another is
 * not read: such an entry is nobody's. The study gets its step_id and procedure_id of the fields.
 */
cJSON *worklist_step(const char *const field[STEP_FIELD_COUNT], const char *const subject[STUDY_STEP_ID]);

#endif

/* The modality worklist (PS3.4 annex K): who is to be examined. dicom.h */
#include <string.h>
#include <time.h>

#include "daemon/dicom/dicom.h"
#include "proto/worklist.h"

_Static_assert((int)STEP_FIELDS == (int)STEP_FIELD_COUNT && (int)STUDY_STEP_ID <= (int)STEP_SUBJECT_MOST,
	       "dimse.h has its room");

static void found(void *context, const struct dimse_step *step)
{
	cJSON *line = cJSON_CreateObject(), *entry = worklist_step(step->field, step->subject);

	(void)context;
	/* One whose patient cannot be read is counted and not shown. */
	json_add(line, "step", entry != NULL ? entry : cJSON_CreateNull());
	tell(line);
}

static void day(time_t time, char ret[9])
{
	struct tm parts;

	localtime_r(&time, &parts);
	strftime(ret, 9, "%Y%m%d", &parts);
}

int worklist_ask(const cJSON *worklist, struct error *err)
{
	const struct dimse_peer peer = row_peer(worklist);
	uint16_t tags[STUDY_STEP_ID][2]; /* of the entry itself; its step has fields of its own */
	char from[9], to[9];
	const time_t now = time(NULL);
	struct dimse_query query = {.from = from,
				    .to = to,
				    .modality = destination_text(worklist, "modality"),
				    .station = destination_text(worklist, "station"),
				    .subject = (const uint16_t(*)[2])tags,
				    .subject_count = STUDY_STEP_ID,
				    .most = WORKLIST_MOST};
	struct dimse *dimse = NULL;
	int code;

	if (!dimse_built())
		return error_set(err, ERR_IMPOSSIBLE,
				 "this cbct-dicom was built without DCMTK (libdcmtk-dev): it has no worklist");
	for (int i = 0; i < STUDY_STEP_ID; i++) {
		tags[i][0] = subject_rows[i].group;
		tags[i][1] = subject_rows[i].element;
	}
	day(now, from);
	day(now + 86400 * ((time_t)destination_number(worklist, "days", 1) - 1), to);
	patience(2 * peer.seconds);
	code = dimse_open(&peer, DIMSE_WORKLIST, NULL, &dimse, err);
	if (code == 0)
		code = dimse_worklist(dimse, &query, found, NULL, err);
	if (dimse != NULL)
		dimse_close(dimse);
	return code;
}

#ifndef CBCT_DAEMON_VOLUMES_DICOM_H
#define CBCT_DAEMON_VOLUMES_DICOM_H

#include "daemon/id.h"
#include "proto/format.h"
#include "proto/subject.h"

/*
 * A volume as DICOM (PS3.3): CT Image Storage, one object for each slice across z, in a ZIP; or one Enhanced CT Image
 * with a frame for each slice. int16 Hounsfield units; rows along the world's x, columns along y; Image Position and
 * Orientation (Patient) from how the patient lies. Explicit VR little endian, UTF-8.
 *
 * UIDs are made from a hash of what they name (PS3.5 B.2, root 2.25): the same volume has the same ones whenever and
 * by whichever daemon it is written, another grid or another placement of the patient has others.
 */

/* Words of a DICOM file that the volume's own file does not have. */
struct dicom_words {
	struct subject subject;
	int position; /* enum patient_position for a volume whose file says of none; -1: not given */
	bool enhanced;
	char volume[32]; /* "final" */
	double created;  /* s since 1970 */
};

/*
 * How the patient lies: as the file says, or as asked for where the file says nothing. ERR_CONFLICT where neither
 * says it, since slices without a side are no CT images, and where the request contradicts the file.
 */
int dicom_patient(const struct dicom_words *words, const struct patient *told, struct patient *ret_patient,
		  struct error *err);

/* An object without its pixels; bytes is the caller's (free). */
struct dicom_head {
	uint8_t *bytes;
	size_t size;
	char instance[65]; /* SOP Instance UID */
};
/* The head of slice z, or of all slices (enhanced). `pixels` bytes of pixels follow it. ERR_NO_MEMORY. */
int dicom_head(const struct dicom_words *words, const struct grid *grid, const struct provenance *provenance, int z,
	       size_t pixels, struct dicom_head *ret_head, struct error *err);

#endif

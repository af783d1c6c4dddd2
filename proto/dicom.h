#ifndef CBCT_PROTO_DICOM_H
#define CBCT_PROTO_DICOM_H

#include "proto/format.h"
#include "proto/subject.h"

/*
 * A volume as DICOM (PS3.3): CT Image Storage, one object for each slice across z, in a ZIP; or one Enhanced CT Image
 * or X-Ray 3D Angiographic Image with a frame for each slice. int16 Hounsfield units; rows along the world's x, columns
 * along y; Image Position and Orientation (Patient) from how the patient lies. Explicit VR little endian, UTF-8.
 *
 * UIDs are made from a hash of what they name (PS3.5 B.2, root 2.25): the same volume has the same ones whenever and
 * by whichever daemon it is written, another grid or another placement of the patient has others.
 */

/* What a volume becomes; each name is one of the API. */
enum dicom_kind {
	DICOM_SLICES,   /* CT Image Storage, an object for each slice */
	DICOM_ENHANCED, /* Enhanced CT Image Storage */
	DICOM_XRAY_3D,  /* X-Ray 3D Angiographic Image Storage: what C-arms write */
	DICOM_KIND_COUNT
};
extern const char *const dicom_kind_names[DICOM_KIND_COUNT + 1]; /* and NULL */
/* The SOP class of its objects, and how PS3.6 calls it. */
const char *dicom_class(enum dicom_kind kind);
const char *dicom_class_name(enum dicom_kind kind);

/* Words of a DICOM file that the volume's own file does not have. */
struct dicom_words {
	struct subject subject;
	int position; /* enum patient_position for a volume whose file says of none; -1: not given */
	enum dicom_kind kind;
	cJSON *source;   /* proto/source.h, of the words' owner; NULL: the projections were no objects */
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
	char instance[65], series[65], study[65]; /* their UIDs */
};
#define DICOM_EXPLICIT_LITTLE_ENDIAN "1.2.840.10008.1.2.1"
/* UID of this program: a UUID as a number, by the rule of the root 2.25; and its version. */
#define DICOM_IMPLEMENTATION "2.25.208437269145863218905713340955731662842"
#define DICOM_IMPLEMENTATION_VERSION "CBCTD"

/* The Modality Performed Procedure Step of a job: the same one however often it is told. */
void dicom_step_uid(const char *job, char ret_uid[65]);

/* The head of slice z, or of all slices (the other kinds). `pixels` bytes of pixels follow it. ERR_NO_MEMORY. */
int dicom_head(const struct dicom_words *words, const struct grid *grid, const struct provenance *provenance, int z,
	       size_t pixels, struct dicom_head *ret_head, struct error *err);

#endif

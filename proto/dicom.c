/* DICOM objects of a volume: dicom.h. Numbers of the standard are those of PS3.3 2023. */
#include "proto/dicom.h"

#include <math.h>
#include <openssl/sha.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { UID_SIZE = 65, DS_SIZE = 17 /* characters of a decimal string, and its end */ };
static const uint32_t undefined = 0xffffffff; /* length */
/* Frames are derived: an Enhanced CT tells tube and exposure of an original one, which a scan does not know. */
static const char frame_type[] = "DERIVED\\PRIMARY\\VOLUME\\NONE";

int dicom_patient(const struct dicom_words *words, const struct patient *told, struct patient *ret_patient,
		  struct error *err)
{
	if (!told->known && words->position < 0)
		return error_set(
		    err, ERR_CONFLICT,
		    "nobody has said how the patient lies, and a CT image must say it: give the job or the "
		    "scan a patient");
	if (told->known && words->position >= 0 && told->position != words->position)
		return error_set(err, ERR_CONFLICT, "position is %s, but the volume's patient lies %s",
				 patient_position_names[words->position],
				 told->position >= 0 ? patient_position_names[told->position] : "by a matrix");
	*ret_patient = told->known ? *told : patient_in((enum patient_position)words->position);
	return 0;
}

const char *const dicom_kind_names[DICOM_KIND_COUNT + 1] = {"slices", "enhanced", "xray-3d", NULL};

static const struct {
	const char *uid, *name;
} classes[DICOM_KIND_COUNT] = {
    [DICOM_SLICES] = {"1.2.840.10008.5.1.4.1.1.2", "CT Image Storage"},
    [DICOM_ENHANCED] = {"1.2.840.10008.5.1.4.1.1.2.1", "Enhanced CT Image Storage"},
    [DICOM_XRAY_3D] = {"1.2.840.10008.5.1.4.1.1.13.1.1", "X-Ray 3D Angiographic Image Storage"},
};

const char *dicom_class(enum dicom_kind kind)
{
	return classes[kind].uid;
}

const char *dicom_class_name(enum dicom_kind kind)
{
	return classes[kind].name;
}

/* ---- UIDs ---- */

/* The first 128 bits of the hash as a decimal number; version and variant bits make them a UUID (RFC 9562, 5.8). */
__attribute__((format(printf, 2, 3))) static void make_uid(char ret[UID_SIZE], const char *format, ...)
{
	uint8_t hash[SHA256_DIGEST_LENGTH];
	char text[1024], digits[40];
	int at = sizeof(digits) - 1, rest;
	bool more = true;
	va_list args;

	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	SHA256((const uint8_t *)text, strlen(text), hash);
	hash[6] = (uint8_t)((hash[6] & 0x0f) | 0x80);
	hash[8] = (uint8_t)((hash[8] & 0x3f) | 0x80);
	/* Digits from the last on: a division by ten at a time. */
	for (digits[at] = '\0'; more; digits[--at] = (char)('0' + rest)) {
		more = false;
		rest = 0;
		for (int i = 0; i < 16; i++) {
			rest = 256 * rest + hash[i];
			hash[i] = (uint8_t)(rest / 10);
			rest %= 10;
			more = more || hash[i] != 0;
		}
	}
	snprintf(ret, UID_SIZE, "2.25.%s", digits + at);
}

void dicom_step_uid(const char *job, char ret_uid[65])
{
	make_uid(ret_uid, "cbctd step %s", job);
}

/* ---- elements ---- */

struct object {
	uint8_t *bytes;
	size_t size, space;
	bool failed; /* no memory */
};

static void put_bytes(struct object *o, const void *bytes, size_t size)
{
	if (o->size + size > o->space) {
		size_t space = 2 * o->space + size + 4096;
		uint8_t *grown = realloc(o->bytes, space);

		if (grown == NULL) {
			o->failed = true;
			return;
		}
		o->bytes = grown;
		o->space = space;
	}
	memcpy(o->bytes + o->size, bytes, size);
	o->size += size;
}

static void put16(struct object *o, unsigned value)
{
	put_bytes(o, (const uint8_t[]){(uint8_t)value, (uint8_t)(value >> 8)}, 2);
}

static void put32(struct object *o, uint32_t value)
{
	put16(o, value & 0xffff);
	put16(o, value >> 16);
}

/* Tag, value representation and length: those of long values have two bytes more, PS3.5 7.1.2. */
static void put_head(struct object *o, uint32_t tag, const char *vr, uint32_t length)
{
	put16(o, tag >> 16);
	put16(o, tag & 0xffff);
	put_bytes(o, vr, 2);
	if (strstr("OB OW SQ", vr) != NULL) {
		put16(o, 0);
		put32(o, length);
	} else {
		put16(o, length);
	}
}

/* Values have an even length: UIDs are padded with a zero, other texts with a blank. */
static void put_text(struct object *o, uint32_t tag, const char *vr, const char *text)
{
	const size_t length = strlen(text);

	put_head(o, tag, vr, (uint32_t)(length + length % 2));
	put_bytes(o, text, length);
	if (length % 2 != 0)
		put_bytes(o, strcmp(vr, "UI") == 0 ? "" : " ", 1);
}

__attribute__((format(printf, 4, 5))) static void put_format(struct object *o, uint32_t tag, const char *vr,
							     const char *format, ...)
{
	char text[256];
	va_list args;

	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	put_text(o, tag, vr, text);
}

static void put_short(struct object *o, uint32_t tag, unsigned value)
{
	put_head(o, tag, "US", 2);
	put16(o, value);
}

static void put_long(struct object *o, uint32_t tag, uint32_t value)
{
	put_head(o, tag, "UL", 4);
	put32(o, value);
}

/* As many digits as 16 characters hold. */
static void decimal(double value, char ret[DS_SIZE])
{
	char text[40];
	int digits = 15;

	do
		snprintf(text, sizeof(text), "%.*g", digits--, value + 0.0);
	while (strlen(text) >= DS_SIZE);
	memcpy(ret, text, strlen(text) + 1);
}

static void put_decimals(struct object *o, uint32_t tag, int count, const double *values)
{
	char text[6 * DS_SIZE + 1] = "", one[DS_SIZE];
	size_t used = 0;

	for (int i = 0; i < count; i++) {
		decimal(values[i], one);
		used += (size_t)snprintf(text + used, sizeof(text) - used, "%s%s", i > 0 ? "\\" : "", one);
	}
	put_text(o, tag, "DS", text);
}

static void put_decimal(struct object *o, uint32_t tag, double value)
{
	put_decimals(o, tag, 1, &value);
}

/* A sequence and its items end where they say so: no lengths have to be known beforehand. */
static void begin_sequence(struct object *o, uint32_t tag)
{
	put_head(o, tag, "SQ", undefined);
}

static void put_delimiter(struct object *o, unsigned element, uint32_t length)
{
	put16(o, 0xfffe);
	put16(o, element);
	put32(o, length);
}

static void begin_item(struct object *o)
{
	put_delimiter(o, 0xe000, undefined);
}

static void end_item(struct object *o)
{
	put_delimiter(o, 0xe00d, 0);
}

static void end_sequence(struct object *o)
{
	put_delimiter(o, 0xe0dd, 0);
}

/* A sequence of one item begins. */
static void begin_group(struct object *o, uint32_t tag)
{
	begin_sequence(o, tag);
	begin_item(o);
}

static void end_group(struct object *o)
{
	end_item(o);
	end_sequence(o);
}

static void put_subject(struct object *o, const struct subject *subject, enum subject_field field)
{
	const struct subject_row *row = &subject_rows[field];
	char value[TEXT_BYTES(SUBJECT_MOST)];

	subject_value(subject, field, value);
	put_text(o, (uint32_t)row->group << 16 | row->element, row->vr, value);
}

/* ---- modules ---- */

/* The attributes that the objects of a volume share, and the place of this one. */
struct instance {
	const struct dicom_words *words;
	const struct grid *grid;
	const struct provenance *provenance;
	struct patient patient;
	int z;
	double row[3], column[3], position[3]; /* LPS */
	char date[9], time[7], now[22];        /* DA, TM, DT: of the volume, at the daemon's place */
	char study[UID_SIZE], series[UID_SIZE], frame[UID_SIZE], instance[UID_SIZE], dimensions[UID_SIZE],
	    event[UID_SIZE];
};

static bool is_multiframe(const struct instance *image)
{
	return image->words->kind != DICOM_SLICES;
}

static void name_all(struct instance *image)
{
	const struct provenance *p = image->provenance;
	const struct grid *g = image->grid;
	const char *study = image->words->subject.text[STUDY_UID];
	char place[512];
	size_t used = 0;

	/* The frame of reference goes by the patient's coordinates and the place of the voxels in them. */
	for (int i = 0; i < 3; i++)
		used += (size_t)snprintf(place + used, sizeof(place) - used, "%.9f %.9f %.9f %.9f ",
					 image->patient.rotation[i][0] + 0.0, image->patient.rotation[i][1] + 0.0,
					 image->patient.rotation[i][2] + 0.0, image->patient.offset[i] + 0.0);
	make_uid(image->study, "cbctd study %s", p->scan);
	if (study[0] != '\0')
		snprintf(image->study, UID_SIZE, "%.64s", study);
	make_uid(image->frame, "cbctd frame %s %s", p->scan, place);
	make_uid(image->series, "cbctd series %s %s %s %s %d %d %d %s", image->study, p->job, image->words->volume,
		 dicom_kind_names[image->words->kind], g->size[0], g->size[1], g->size[2], place);
	make_uid(image->instance, "cbctd instance %s %d", image->series, image->z);
	make_uid(image->event, "cbctd event %s", p->scan);
	make_uid(image->dimensions, "cbctd dimensions %s", image->series);
}

static void place(struct instance *image)
{
	const struct grid *grid = image->grid;
	const double axes[2][3] = {{1, 0, 0}, {0, 1, 0}};
	const double first[3] = {grid->origin[0], grid->origin[1], grid->origin[2] + image->z * grid->spacing[2]};

	patient_direction(&image->patient, axes[0], image->row);
	patient_direction(&image->patient, axes[1], image->column);
	patient_point(&image->patient, first, image->position);
}

static void date(struct instance *image)
{
	const time_t created = (time_t)image->words->created;
	struct tm when;

	localtime_r(&created, &when);
	strftime(image->date, sizeof(image->date), "%Y%m%d", &when);
	strftime(image->time, sizeof(image->time), "%H%M%S", &when);
	strftime(image->now, sizeof(image->now), "%Y%m%d%H%M%S", &when);
}

/* Adds a part behind what the text has, where there is room for all of it. */
static void add_part(char *text, size_t size, const char *before, const char *part)
{
	const size_t length = strlen(text);

	if (part != NULL && part[0] != '\0' && length + strlen(before) + strlen(part) < size)
		snprintf(text + length, size - length, "%s%s", before, part);
}

/*
 * "SART iteration 5 of cbctd 1.0.0, from cone-beam projections; recipe {...}; digests", as much of it as fits the 1024
 * characters of ST: half a recipe is none.
 */
static void put_derivation(struct object *o, const struct instance *image)
{
	const struct provenance *p = image->provenance;
	char *recipe = p->recipe != NULL ? provenance_text(p->recipe) : NULL, text[1025];

	snprintf(text, sizeof(text), "reconstructed from cone-beam projections: %s, iteration %d; %s", p->stage,
		 p->iteration, p->program);
	add_part(text, sizeof(text), " of commit ", p->commit);
	/* A backslash separates values elsewhere, here it is as good as any. */
	add_part(text, sizeof(text), "; recipe ", recipe);
	add_part(text, sizeof(text), "; projections ", p->projections_digest);
	add_part(text, sizeof(text), "; scan ", p->scan_digest);
	free(recipe);
	put_text(o, 0x00082111, "ST", text);
}

static void put_meta(struct object *o, const struct instance *image, const char *class)
{
	static const uint8_t preamble[128];
	size_t at;
	uint32_t length;

	put_bytes(o, preamble, sizeof(preamble));
	put_bytes(o, "DICM", 4);
	put_long(o, 0x00020000, 0);
	at = o->size;
	put_head(o, 0x00020001, "OB", 2);
	put_bytes(o, "\0\1", 2);
	put_text(o, 0x00020002, "UI", class);
	put_text(o, 0x00020003, "UI", image->instance);
	put_text(o, 0x00020010, "UI", DICOM_EXPLICIT_LITTLE_ENDIAN);
	put_text(o, 0x00020012, "UI", DICOM_IMPLEMENTATION);
	put_text(o, 0x00020013, "SH", DICOM_IMPLEMENTATION_VERSION);
	length = (uint32_t)(o->size - at);
	for (int i = 0; i < 4 && !o->failed; i++)
		o->bytes[at - 4 + (size_t)i] = (uint8_t)(length >> 8 * i);
}

/* ---- what it was made from: PS3.3 C.7.6.16.2.6 and table 10-3 ---- */

static void put_code(struct object *o, uint32_t tag, const char *value, const char *scheme, const char *meaning)
{
	begin_group(o, tag);
	put_text(o, 0x00080100, "SH", value);
	put_text(o, 0x00080102, "SH", scheme);
	put_text(o, 0x00080104, "LO", meaning);
	end_group(o);
}

/* Each object in an item of its own, with the purpose of the reference where it stands for pixels. */
static void put_references(struct object *o, const struct instance *image, uint32_t tag, bool purpose)
{
	const cJSON *source = image->words->source, *instance;
	const char *class = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(source, "class"));

	begin_sequence(o, tag);
	cJSON_ArrayForEach(instance, cJSON_GetObjectItemCaseSensitive(source, "instances"))
	{
		begin_item(o);
		put_text(o, 0x00081150, "UI", class);
		put_text(o, 0x00081155, "UI", instance->valuestring);
		if (purpose)
			put_code(o, 0x0040a170, "121322", "DCM", "Source image for image processing operation");
		end_item(o);
	}
	end_sequence(o);
}

/* Derivation Image, of all frames. */
static void put_derivation_group(struct object *o, const struct instance *image)
{
	const bool iterative = image->provenance->iteration > 0;

	begin_group(o, 0x00089124);
	put_references(o, image, 0x00082112, true);
	put_code(o, 0x00089215, iterative ? "113963" : "113962", "DCM",
		 iterative ? "Iterative Reconstruction" : "Filtered Back Projection");
	end_group(o);
}

/* The series of the references, which an object with frames must tell. */
static void put_source_series(struct object *o, const struct instance *image, uint32_t instances)
{
	begin_group(o, 0x00081115);
	put_references(o, image, instances, false);
	put_text(o, 0x0020000e, "UI",
		 cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(image->words->source, "series")));
	end_group(o);
}

/* Source Image Evidence (C.8.15.2 of Enhanced CT); X-Ray 3D has Common Instance Reference (C.12.2) in its place. */
static void put_evidence(struct object *o, const struct instance *image)
{
	begin_group(o, 0x00089154);
	put_source_series(o, image, 0x00081199);
	put_text(o, 0x0020000d, "UI", image->study);
	end_group(o);
}

static void put_identification(struct object *o, const struct instance *image, const char *class)
{
	const bool enhanced = is_multiframe(image);

	put_text(o, 0x00080005, "CS", "ISO_IR 192");
	put_text(o, 0x00080008, "CS", enhanced ? frame_type : "ORIGINAL\\PRIMARY\\AXIAL");
	put_text(o, 0x00080012, "DA", image->date);
	put_text(o, 0x00080013, "TM", image->time);
	put_text(o, 0x00080016, "UI", class);
	put_text(o, 0x00080018, "UI", image->instance);
	put_subject(o, &image->words->subject, STUDY_DATE);
	put_text(o, 0x00080021, "DA", image->date);
	put_text(o, 0x00080023, "DA", image->date);
	if (image->words->kind == DICOM_ENHANCED)
		put_text(o, 0x0008002a, "DT", image->now);
	put_subject(o, &image->words->subject, STUDY_TIME);
	put_text(o, 0x00080031, "TM", image->time);
	put_text(o, 0x00080033, "TM", image->time);
	put_subject(o, &image->words->subject, STUDY_ACCESSION_NUMBER);
	put_text(o, 0x00080060, "CS", image->words->kind == DICOM_XRAY_3D ? "XA" : "CT");
	put_text(o, 0x00080070, "LO", "cbctd");
	put_subject(o, &image->words->subject, STUDY_REFERRING_PHYSICIAN);
	put_subject(o, &image->words->subject, STUDY_DESCRIPTION);
	put_format(o, 0x0008103e, "LO", "CBCT %.20s %.16s", image->words->volume, image->provenance->stage);
	put_text(o, 0x00081090, "LO", "cbctd");
	if (image->words->kind == DICOM_XRAY_3D && image->words->source != NULL)
		put_source_series(o, image, 0x0008114a);
	put_derivation(o, image);
	if (!enhanced && image->words->source != NULL)
		put_references(o, image, 0x00082112, true);
	if (image->words->kind == DICOM_ENHANCED && image->words->source != NULL)
		put_evidence(o, image);
	if (enhanced) {
		put_text(o, 0x00089205, "CS", "MONOCHROME");
		put_text(o, 0x00089206, "CS", "VOLUME");
		put_text(o, 0x00089207, "CS", "NONE");
	}
	put_subject(o, &image->words->subject, PATIENT_NAME);
	put_subject(o, &image->words->subject, PATIENT_ID);
	put_subject(o, &image->words->subject, PATIENT_BIRTH_DATE);
	put_subject(o, &image->words->subject, PATIENT_SEX);
}

/* Numbers of series tell a job's volumes apart in lists: that of the hash, made short. */
static int series_number(const struct instance *image)
{
	return atoi(image->series + strlen(image->series) - 6) % 100000 + 1;
}

static void put_relationship(struct object *o, const struct instance *image)
{
	char sentence[400];
	double orientation[6];

	put_text(o, 0x0020000d, "UI", image->study);
	put_text(o, 0x0020000e, "UI", image->series);
	put_subject(o, &image->words->subject, STUDY_ID);
	put_format(o, 0x00200011, "IS", "%d", series_number(image));
	if (!is_multiframe(image))
		put_text(o, 0x00200012, "IS", "1");
	put_format(o, 0x00200013, "IS", "%d", image->z + 1);
	if (!is_multiframe(image)) {
		memcpy(orientation, image->row, sizeof(image->row));
		memcpy(orientation + 3, image->column, sizeof(image->column));
		put_decimals(o, 0x00200032, 3, image->position);
		put_decimals(o, 0x00200037, 6, orientation);
	}
	put_text(o, 0x00200052, "UI", image->frame);
	if (!is_multiframe(image))
		put_text(o, 0x00200060, "CS", ""); /* left or right of a paired part: not told */
	put_text(o, 0x00201040, "LO", "");
	provenance_sentence(image->provenance, "HU", sentence, sizeof(sentence));
	put_text(o, 0x00204000, "LT", sentence);
}

/* From fat to bone: a viewer that is told none takes the first slice's own, which is of air. */
static void put_window(struct object *o)
{
	put_text(o, 0x00281050, "DS", "400");
	put_text(o, 0x00281051, "DS", "2000");
}

static void put_matrix(struct object *o, const struct instance *image)
{
	put_short(o, 0x00280002, 1);
	put_text(o, 0x00280004, "CS", "MONOCHROME2");
	if (is_multiframe(image))
		put_format(o, 0x00280008, "IS", "%d", image->grid->size[2]);
	put_short(o, 0x00280010, (unsigned)image->grid->size[1]);
	put_short(o, 0x00280011, (unsigned)image->grid->size[0]);
	if (!is_multiframe(image))
		put_decimals(o, 0x00280030, 2, (const double[]){image->grid->spacing[1], image->grid->spacing[0]});
	put_short(o, 0x00280100, 16);
	put_short(o, 0x00280101, 16);
	put_short(o, 0x00280102, 15);
	put_short(o, 0x00280103, 1);
	put_text(o, 0x00280301, "CS", "NO");
	if (!is_multiframe(image)) {
		put_window(o);
		put_text(o, 0x00281052, "DS", "0");
		put_text(o, 0x00281053, "DS", "1");
		put_text(o, 0x00281054, "LO", "HU");
	}
	put_text(o, 0x00282110, "CS", "00");
}

/* What was asked for, where the scan is of a step of the worklist: Request Attributes Sequence. */
static void put_request(struct object *o, const struct subject *subject)
{
	if (subject->text[STUDY_STEP_ID][0] == '\0' || subject->text[STUDY_PROCEDURE_ID][0] == '\0')
		return;
	begin_group(o, 0x00400275);
	put_subject(o, subject, STUDY_STEP_ID);
	put_subject(o, subject, STUDY_PROCEDURE_ID);
	end_group(o);
}

/* ---- Enhanced CT, PS3.3 A.38.1, X-Ray 3D Angiographic, A.53: what all frames share, and where each lies ---- */

static void put_frame_type(struct object *o, uint32_t tag)
{
	begin_group(o, tag);
	put_text(o, 0x00089007, "CS", frame_type);
	put_text(o, 0x00089205, "CS", "MONOCHROME");
	put_text(o, 0x00089206, "CS", "VOLUME");
	put_text(o, 0x00089207, "CS", "NONE");
	end_group(o);
}

static void put_shared_groups(struct object *o, const struct instance *image)
{
	const struct grid *grid = image->grid;
	double orientation[6];

	memcpy(orientation, image->row, sizeof(image->row));
	memcpy(orientation + 3, image->column, sizeof(image->column));
	begin_group(o, 0x52009229);
	if (image->words->source != NULL)
		put_derivation_group(o, image);
	if (image->words->kind == DICOM_ENHANCED) {
		put_frame_type(o, 0x00189329); /* CT Image Frame Type */
		begin_group(o, 0x00189477);    /* Irradiation Event Identification: the scan is one */
		put_text(o, 0x00083010, "UI", image->event);
		end_group(o);
	} else {
		put_frame_type(o, 0x00189504); /* X-Ray 3D Frame Type */
	}
	begin_group(o, 0x00209071); /* Frame Anatomy: not known which */
	begin_group(o, 0x00082218);
	put_text(o, 0x00080100, "SH", "38266002");
	put_text(o, 0x00080102, "SH", "SCT");
	put_text(o, 0x00080104, "LO", "Entire body");
	end_group(o);
	put_text(o, 0x00209072, "CS", "U");
	end_group(o);
	begin_group(o, 0x00209116); /* Plane Orientation */
	put_decimals(o, 0x00200037, 6, orientation);
	end_group(o);
	begin_group(o, 0x00289110); /* Pixel Measures */
	put_decimal(o, 0x00180050, grid->spacing[2]);
	put_decimal(o, 0x00180088, grid->spacing[2]);
	put_decimals(o, 0x00280030, 2, (const double[]){grid->spacing[1], grid->spacing[0]});
	end_group(o);
	begin_group(o, 0x00289132); /* Frame VOI LUT */
	put_window(o);
	end_group(o);
	begin_group(o, 0x00289145); /* Pixel Value Transformation */
	put_text(o, 0x00281052, "DS", "0");
	put_text(o, 0x00281053, "DS", "1");
	put_text(o, 0x00281054, "LO", "HU");
	end_group(o);
	end_group(o);
}

static void put_frame(struct object *o, const struct instance *image, int z)
{
	struct instance frame = *image;

	frame.z = z;
	place(&frame);
	begin_item(o);
	begin_group(o, 0x00209111); /* Frame Content */
	put_text(o, 0x00209056, "SH", "1");
	put_long(o, 0x00209057, (uint32_t)z + 1);
	put_head(o, 0x00209157, "UL", 8);
	put32(o, 1);
	put32(o, (uint32_t)z + 1);
	end_group(o);
	begin_group(o, 0x00209113); /* Plane Position */
	put_decimals(o, 0x00200032, 3, frame.position);
	end_group(o);
	end_item(o);
}

static void put_index(struct object *o, const struct instance *image, uint32_t pointer, const char *label)
{
	begin_item(o);
	put_text(o, 0x00209164, "UI", image->dimensions);
	put_head(o, 0x00209165, "AT", 4);
	put16(o, pointer >> 16);
	put16(o, pointer & 0xffff);
	put_head(o, 0x00209167, "AT", 4);
	put16(o, 0x0020);
	put16(o, 0x9111);
	put_text(o, 0x00209421, "LO", label);
	end_item(o);
}

static void put_dimensions(struct object *o, const struct instance *image)
{
	begin_group(o, 0x00209221);
	put_text(o, 0x00209164, "UI", image->dimensions);
	end_group(o);
	begin_sequence(o, 0x00209222);
	put_index(o, image, 0x00209056, "Stack ID");
	put_index(o, image, 0x00209057, "In-Stack Position");
	end_sequence(o);
}

static void put_acquisition(struct object *o, const struct instance *image)
{
	if (!is_multiframe(image)) {
		put_decimal(o, 0x00180050, image->grid->spacing[2]);
		put_text(o, 0x00180060, "DS", "");
		put_decimal(o, 0x00180088, image->grid->spacing[2]);
	}
	if (is_multiframe(image))
		put_text(o, 0x00181000, "LO", "not told"); /* the arm's number, which may not be empty here */
	put_text(o, 0x00181020, "LO", image->provenance->program);
	put_text(o, 0x00185100, "CS",
		 image->patient.position >= 0 ? patient_position_names[image->patient.position] : "");
	if (is_multiframe(image))
		put_text(o, 0x00189004, "CS", "PRODUCT");
}

int dicom_head(const struct dicom_words *words, const struct grid *grid, const struct provenance *provenance, int z,
	       size_t pixels, struct dicom_head *ret_head, struct error *err)
{
	const char *class = dicom_class(words->kind);
	struct instance image = {.words = words, .grid = grid, .provenance = provenance, .z = z};
	struct object o = {0};

	if (dicom_patient(words, &provenance->patient, &image.patient, err) != 0)
		return err->code;
	name_all(&image);
	place(&image);
	date(&image);
	put_meta(&o, &image, class);
	put_identification(&o, &image, class);
	put_acquisition(&o, &image);
	put_relationship(&o, &image);
	if (is_multiframe(&image))
		put_dimensions(&o, &image);
	put_matrix(&o, &image);
	put_request(&o, &words->subject);
	if (is_multiframe(&image)) {
		begin_sequence(&o, 0x00400555); /* Acquisition Context: none */
		end_sequence(&o);
		put_text(&o, 0x20500020, "CS", "IDENTITY");
		put_shared_groups(&o, &image);
		begin_sequence(&o, 0x52009230);
		for (int i = 0; i < grid->size[2]; i++)
			put_frame(&o, &image, i);
		end_sequence(&o);
	}
	put_head(&o, 0x7fe00010, "OW", (uint32_t)pixels);
	if (o.failed) {
		free(o.bytes);
		return error_set(err, ERR_NO_MEMORY, "no memory for a DICOM object");
	}
	*ret_head = (struct dicom_head){.bytes = o.bytes, .size = o.size};
	memcpy(ret_head->instance, image.instance, sizeof(ret_head->instance));
	memcpy(ret_head->series, image.series, sizeof(ret_head->series));
	memcpy(ret_head->study, image.study, sizeof(ret_head->study));
	return 0;
}

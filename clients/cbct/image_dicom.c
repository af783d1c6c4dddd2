/*
 * DICOM X-ray angiography (XA) and Enhanced XA, one frame or many, through the
 * programs of DCMTK (BSD licence): dcm2xml tells the attributes, dcmdjpeg,
 * dcmdjpls and dcmdrle undo a compression, dcmdump writes the pixels as they are.
 *
 * XA: Positioner Primary and Secondary Angle, and their increments, which are one
 * step for all frames or each frame's offset from the first (C.8.7.5.1.3). Enhanced
 * XA: the same attributes in the functional groups, shared or of each frame. Patient
 * Position (0018,5100) and Patient Orientation (0020,0020) are the file's, and so
 * are patient and study.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <expat.h>

#include "clients/cbct/images.h"
#include "clients/cbct/tool.h"
#include "proto/patient.h"
#include "proto/scan_directory.h"

/* Numbers that belong to an object, or in Enhanced XA to each frame. */
enum number { PRIMARY, SECONDARY, TO_DETECTOR, TO_ISOCENTRE, SLOPE, INTERCEPT, SIGN, NUMBER_COUNT };

struct dicom_values {
	double number[NUMBER_COUNT]; /* NaN: not told */
	double spacing[2];           /* row spacing, column spacing */
};

enum { TEXT_MAX = 1 << 20, INCREMENTS_MAX = VIEWS_MAX, RELATIONSHIP_MAX = 16 };

struct dicom {
	/* attributes */
	char transfer_syntax[80];
	long columns, rows, frames, bits, bits_stored, is_signed, samples;
	char relationship[RELATIONSHIP_MAX]; /* of the pixels to the intensity: "LIN", "LOG", "DISP" */
	bool mirrored;
	int patient;            /* enum patient_position, -1: not told */
	char towards[2];        /* sides of the patient, 0: not told */
	struct subject subject; /* of patient and study */
	struct image_source source;
	struct dicom_values object; /* of the file itself, or of the functional groups that frames share */
	struct dicom_values *frame; /* [frames], Enhanced XA */
	double *increments[2];      /* primary, secondary */
	int increment_count[2];

	/* pixels */
	char directory[64]; /* for the programs' files, "" before */
	const char *path;   /* of the file itself; the caller's */
	char *own_path;
	int file;     /* the pixels, -1 before they are wanted */
	size_t bytes; /* of a frame */
	unsigned char *image;
};

/* ---- attributes ---- */

struct reader {
	XML_Parser parser;
	struct dicom *dicom;
	int depth;   /* of sequences around */
	int group;   /* depth at which the functional groups began, 0 outside */
	bool shared; /* in the shared ones */
	int frame;   /* of the per-frame ones, -1 before the first */
	char tag[16];
	bool in_element;
	char *text;
	size_t length;
	int code;
	struct error *err;
};

static const struct {
	const char *tag;
	enum number number;
} numbers[] = {
    {"0018,1510", PRIMARY},      {"0018,1511", SECONDARY}, {"0018,1110", TO_DETECTOR}, {"0018,1111", TO_ISOCENTRE},
    {"0018,9402", TO_ISOCENTRE}, {"0028,1053", SLOPE},     {"0028,1052", INTERCEPT},   {"0028,1041", SIGN},
};

static const struct {
	const char *tag;
	size_t offset; /* of a long */
} counts[] = {
    {"0028,0011", offsetof(struct dicom, columns)},     {"0028,0010", offsetof(struct dicom, rows)},
    {"0028,0008", offsetof(struct dicom, frames)},      {"0028,0100", offsetof(struct dicom, bits)},
    {"0028,0101", offsetof(struct dicom, bits_stored)}, {"0028,0103", offsetof(struct dicom, is_signed)},
    {"0028,0002", offsetof(struct dicom, samples)},
};

static void fail(struct reader *reader, int code, const char *text)
{
	if (reader->code == 0)
		reader->code = error_set(reader->err, code, "(%s): %s", reader->tag, text);
	XML_StopParser(reader->parser, XML_FALSE);
}

/* Numbers with backslashes between; how many, -1 for what is none. */
static int multiple(const char *text, int most, double *ret)
{
	int count = 0;

	for (;;) {
		char *end;
		double value = strtod(text, &end);

		if (end == text || !isfinite(value) || count == most)
			return -1;
		ret[count++] = value;
		end += strspn(end, " ");
		if (*end == '\0')
			return count;
		if (*end != '\\')
			return -1;
		text = end + 1;
	}
}

static void read_increments(struct reader *reader, int which)
{
	struct dicom *dicom = reader->dicom;
	double *values = malloc(INCREMENTS_MAX * sizeof(*values));
	int count = values != NULL ? multiple(reader->text, INCREMENTS_MAX, values) : 0;

	if (count < 1) {
		free(values);
		fail(reader, ERR_INVALID, "angle increments are expected");
		return;
	}
	free(dicom->increments[which]);
	dicom->increments[which] = values;
	dicom->increment_count[which] = count;
}

/* Where the value of this element goes: the file's or the shared values, or those of a frame; NULL: nowhere. */
static struct dicom_values *values_here(struct reader *reader)
{
	struct dicom *dicom = reader->dicom;

	if (reader->depth == 0 || reader->shared)
		return &dicom->object;
	if (reader->group > 0 && reader->frame >= 0 && reader->frame < dicom->frames)
		return &dicom->frame[reader->frame];
	return NULL;
}

static void read_number(struct reader *reader, enum number number)
{
	struct dicom_values *values = values_here(reader);

	if (values != NULL && multiple(reader->text, 1, &values->number[number]) != 1)
		fail(reader, ERR_INVALID, "a number is expected");
}

/* Reads the patient's position on a table; a patient in a chair has none. */
static void read_patient_position(struct dicom *dicom, const char *text)
{
	for (int i = 0; i < PATIENT_POSITION_COUNT; i++)
		if (strcmp(text, patient_position_names[i]) == 0)
			dicom->patient = i;
}

/* "L\\F" or "LP\\FA": the nearest side comes first. */
static void read_patient_orientation(struct dicom *dicom, const char *text)
{
	const char *behind = strchr(text, '\\');

	if (behind == NULL || strchr("LRAPHF", text[0]) == NULL || behind[1] == '\0' ||
	    strchr("LRAPHF", behind[1]) == NULL)
		return;
	dicom->towards[0] = text[0];
	dicom->towards[1] = behind[1];
}

/* Patient and study; a value that DICOM itself would not have there is left out, and told without being shown. */
static void read_subject(struct reader *reader)
{
	for (int i = 0; i < SUBJECT_COUNT; i++) {
		const struct subject_row *row = &subject_rows[i];
		char tag[16];

		snprintf(tag, sizeof(tag), "%04x,%04x", row->group, row->element);
		if (strcmp(tag, reader->tag) == 0 &&
		    !subject_take(&reader->dicom->subject, (enum subject_field)i, reader->text))
			fprintf(stderr, "note: (%s) is no value of the %s's %s, and is left out\n", tag, row->object,
				row->name);
	}
}

/* UIDs of the object; one that is none is not told. */
static void read_source(struct reader *reader)
{
	struct image_source *source = &reader->dicom->source;
	const struct {
		const char *tag;
		char *to;
	} uids[] = {{"0008,0016", source->class}, {"0008,0018", source->instance}, {"0020,000e", source->series}};

	for (size_t i = 0; i < sizeof(uids) / sizeof(uids[0]); i++)
		if (strcmp(reader->tag, uids[i].tag) == 0 && uid_valid(reader->text))
			snprintf(uids[i].to, UID_MOST + 1, "%s", reader->text);
}

/* Reads an element of the file itself, outside of any sequence. */
static void read_top(struct reader *reader)
{
	struct dicom *dicom = reader->dicom;

	for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++) {
		double value;

		if (strcmp(reader->tag, counts[i].tag) != 0)
			continue;
		if (multiple(reader->text, 1, &value) != 1 || value < 0 || value > 1e6 || value != rint(value))
			fail(reader, ERR_INVALID, "a whole number is expected");
		else if (dicom->frame != NULL)
			fail(reader, ERR_INVALID, "it stands behind the functional groups");
		else
			*(long *)((char *)dicom + counts[i].offset) = (long)value;
	}
	read_subject(reader);
	read_source(reader);
	if (strcmp(reader->tag, "0018,1520") == 0)
		read_increments(reader, 0);
	else if (strcmp(reader->tag, "0018,1521") == 0)
		read_increments(reader, 1);
	else if (strcmp(reader->tag, "0018,5100") == 0)
		read_patient_position(dicom, reader->text);
	else if (strcmp(reader->tag, "0020,0020") == 0)
		read_patient_orientation(dicom, reader->text);
}

static void read_value(struct reader *reader)
{
	struct dicom *dicom = reader->dicom;
	struct dicom_values *values = values_here(reader);
	double number;

	if (reader->length == 0)
		return; /* known to be unknown */
	if (reader->depth == 0)
		read_top(reader);
	for (size_t i = 0; i < sizeof(numbers) / sizeof(numbers[0]) && reader->code == 0; i++)
		if (strcmp(reader->tag, numbers[i].tag) == 0)
			read_number(reader, numbers[i].number);
	if (values == NULL)
		return;
	if (strcmp(reader->tag, "0018,1164") == 0 && multiple(reader->text, 2, values->spacing) != 2)
		fail(reader, ERR_INVALID, "two distances of pixels are expected");
	else if (strcmp(reader->tag, "0028,1040") == 0)
		snprintf(dicom->relationship, sizeof(dicom->relationship), "%s", reader->text);
	else if (strcmp(reader->tag, "0018,7034") == 0 && strcmp(reader->text, "NO") != 0)
		dicom->mirrored = true;
	else if (strcmp(reader->tag, "0018,7032") == 0 && multiple(reader->text, 1, &number) == 1 && number != 0)
		dicom->mirrored = true;
}

static const char *attribute(const char **attributes, const char *name)
{
	for (; attributes[0] != NULL; attributes += 2)
		if (strcmp(attributes[0], name) == 0)
			return attributes[1];
	return "";
}

/* The groups come behind the number of frames (0028,0008): elements are sorted by their tags. */
static void begin_groups(struct reader *reader, bool shared)
{
	struct dicom *dicom = reader->dicom;

	reader->group = reader->depth;
	reader->shared = shared;
	reader->frame = -1;
	if (shared || dicom->frame != NULL)
		return;
	if (dicom->frames < 1 || dicom->frames > VIEWS_MAX) {
		fail(reader, ERR_IMPOSSIBLE, "a number of frames from 1 to 20000 is expected");
		return;
	}
	dicom->frame = malloc((size_t)dicom->frames * sizeof(*dicom->frame));
	if (dicom->frame == NULL) {
		fail(reader, ERR_NO_MEMORY, "no memory for its frames");
		return;
	}
	for (long k = 0; k < dicom->frames; k++)
		dicom->frame[k] = dicom->object;
}

static void XMLCALL start_element(void *context, const char *name, const char **attributes)
{
	struct reader *reader = context;

	if (strcmp(name, "data-set") == 0) {
		snprintf(reader->dicom->transfer_syntax, sizeof(reader->dicom->transfer_syntax), "%s",
			 attribute(attributes, "xfer"));
	} else if (strcmp(name, "sequence") == 0) {
		snprintf(reader->tag, sizeof(reader->tag), "%s", attribute(attributes, "tag"));
		reader->depth++;
		if (reader->depth == 1 && strcmp(reader->tag, "5200,9229") == 0)
			begin_groups(reader, true);
		else if (reader->depth == 1 && strcmp(reader->tag, "5200,9230") == 0)
			begin_groups(reader, false);
	} else if (strcmp(name, "item") == 0) {
		if (reader->group == reader->depth)
			reader->frame++;
	} else if (strcmp(name, "element") == 0) {
		snprintf(reader->tag, sizeof(reader->tag), "%s", attribute(attributes, "tag"));
		reader->in_element = true;
		reader->length = 0;
	}
}

static void XMLCALL add_text(void *context, const char *text, int length)
{
	struct reader *reader = context;

	/* No list of angles is as long: the text is of another kind. */
	if (!reader->in_element || (size_t)length >= TEXT_MAX - reader->length)
		return;
	memcpy(reader->text + reader->length, text, (size_t)length);
	reader->length += (size_t)length;
}

static void XMLCALL end_element(void *context, const char *name)
{
	struct reader *reader = context;

	if (reader->code != 0)
		return;
	if (strcmp(name, "element") == 0) {
		reader->text[reader->length] = '\0';
		read_value(reader);
		reader->in_element = false;
	} else if (strcmp(name, "sequence") == 0) {
		if (reader->depth == reader->group) {
			reader->group = 0;
			reader->shared = false;
		}
		reader->depth--;
	}
}

static int parse_attributes(struct dicom *dicom, const char *xml, size_t length, struct error *err)
{
	struct reader reader = {.dicom = dicom, .err = err, .frame = -1, .text = malloc(TEXT_MAX)};

	/* dcm2xml names the encoding that it converted from. */
	reader.parser = XML_ParserCreate("UTF-8");
	if (reader.parser == NULL || reader.text == NULL) {
		reader.code = error_set(err, ERR_NO_MEMORY, "no memory for attributes");
		goto out;
	}
	XML_SetUserData(reader.parser, &reader);
	XML_SetElementHandler(reader.parser, start_element, end_element);
	XML_SetCharacterDataHandler(reader.parser, add_text);
	if (XML_Parse(reader.parser, xml, (int)length, 1) != XML_STATUS_OK && reader.code == 0)
		reader.code = error_set(err, ERR_INVALID, "dcm2xml's text is no XML: %s",
					XML_ErrorString(XML_GetErrorCode(reader.parser)));
out:
	if (reader.parser != NULL)
		XML_ParserFree(reader.parser);
	free(reader.text);
	return reader.code;
}

static int read_attributes(struct dicom *dicom, struct error *err)
{
	/* Texts up to 1 MB: that of 20000 increments; a name in letters of no declared set is let through. */
	const char *const arguments[] = {
	    "dcm2xml", "--quiet",           "--max-read-length", "1024", "--charset-assume",
	    "latin-1", "--convert-to-utf8", dicom->path,         NULL};
	char *xml = NULL;
	size_t length = 0;
	int code = tool_run(arguments, "dcmtk", &xml, &length, err);

	if (code == 0)
		code = parse_attributes(dicom, xml, length, err);
	free(xml);
	return code;
}

/* ---- what they mean ---- */

static int pixel_type_of(const struct dicom *dicom, enum pixel_type *ret, struct error *err)
{
	if (dicom->samples > 1 || (dicom->bits != 8 && dicom->bits != 16 && dicom->bits != 32))
		return error_set(err, ERR_INVALID, "%ld samples of %ld bits a pixel, one of 8, 16 or 32 is expected",
				 dicom->samples, dicom->bits);
	if (dicom->is_signed && dicom->bits_stored != dicom->bits)
		return error_set(err, ERR_INVALID, "signed pixels of %ld in %ld bits are not read", dicom->bits_stored,
				 dicom->bits);
	if (dicom->bits == 8)
		*ret = dicom->is_signed ? PIXEL_INT8 : PIXEL_UINT8;
	else if (dicom->bits == 16)
		*ret = dicom->is_signed ? PIXEL_INT16 : PIXEL_UINT16;
	else
		*ret = dicom->is_signed ? PIXEL_INT32 : PIXEL_UINT32;
	return 0;
}

/* Whether counts grow with the beam: a linear relationship of the sign 1, or nothing said. */
static int check_intensity(const struct dicom *dicom, const char **ret_intensity, struct error *err)
{
	static const char *const known[] = {"LIN", "LOG", "DISP"};

	if (dicom->object.number[SIGN] == -1)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "Pixel Intensity Relationship Sign is -1: pixels that fall with the beam are not read");
	*ret_intensity = "";
	for (size_t i = 0; i < sizeof(known) / sizeof(known[0]); i++)
		if (strcmp(dicom->relationship, known[i]) == 0)
			*ret_intensity = known[i];
	return 0;
}

/* A frame's angle: in the functional groups its own, else the first and the increments. */
static int frame_angle(const struct dicom *dicom, int k, int which, double *ret, struct error *err)
{
	enum number number = which == 0 ? PRIMARY : SECONDARY;
	const struct dicom_values *values = dicom->frame != NULL ? &dicom->frame[k] : &dicom->object;
	int count = dicom->increment_count[which];

	*ret = values->number[number];
	if (dicom->frame != NULL || count == 0)
		return 0;
	if (count != 1 && count != dicom->frames)
		return error_set(err, ERR_INVALID, "%d angle increments for %ld frames, one or as many are expected",
				 count, dicom->frames);
	*ret += count == 1 ? k * dicom->increments[which][0] : dicom->increments[which][k];
	return 0;
}

static int find_positions(struct image_file *file, const struct dicom *dicom, struct error *err)
{
	int code = 0;

	file->positions = calloc((size_t)file->count, sizeof(*file->positions));
	if (file->positions == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d positions", file->count);
	for (int k = 0; k < file->count && code == 0; k++) {
		const struct dicom_values *values = dicom->frame != NULL ? &dicom->frame[k] : &dicom->object;
		struct image_position *position = &file->positions[k];

		code = frame_angle(dicom, k, 0, &position->primary, err);
		if (code == 0)
			code = frame_angle(dicom, k, 1, &position->secondary, err);
		if (isnan(position->secondary))
			position->secondary = 0;
		position->source_to_detector = values->number[TO_DETECTOR];
		position->source_to_isocentre = values->number[TO_ISOCENTRE];
		position->patient = dicom->patient;
		/* The first frame gives the direction; the others are turned from it. */
		if (k == 0)
			memcpy(position->towards, dicom->towards, sizeof(position->towards));
	}
	return code;
}

static int understand(struct image_file *file, const struct dicom *dicom, struct error *err)
{
	const struct dicom_values *values = dicom->frame != NULL ? &dicom->frame[0] : &dicom->object;
	int code;

	file->columns = dicom->columns <= DETECTOR_MAX ? (int)dicom->columns : 0;
	file->rows = dicom->rows <= DETECTOR_MAX ? (int)dicom->rows : 0;
	file->count = dicom->frames > VIEWS_MAX ? 0 : (int)dicom->frames;
	file->subject = dicom->subject;
	file->source = dicom->source;
	if (file->columns < 1 || file->rows < 1 || file->count < 1)
		return error_set(err, ERR_INVALID, "a DICOM file of %ld x %ld pixels and %ld frames", dicom->columns,
				 dicom->rows, dicom->frames);
	/* Row spacing comes first: the distance from one row to the next. */
	file->pixel[0] = values->spacing[1];
	file->pixel[1] = values->spacing[0];
	code = pixel_type_of(dicom, &file->type, err);
	if (code == 0)
		code = check_intensity(dicom, &file->intensity, err);
	if (code == 0)
		code = find_positions(file, dicom, err);
	return code;
}

static bool dicom_recognise(const unsigned char *head, size_t length)
{
	return length >= 132 && memcmp(head + 128, "DICM", 4) == 0;
}

/* Every file is removed: dcmdump writes one for each piece that it finds. */
static void remove_files(struct dicom *dicom)
{
	DIR *directory = dicom->directory[0] != '\0' ? opendir(dicom->directory) : NULL;
	const struct dirent *entry;

	while (directory != NULL && (entry = readdir(directory)) != NULL)
		unlinkat(dirfd(directory), entry->d_name, 0);
	if (directory == NULL)
		return;
	closedir(directory);
	rmdir(dicom->directory);
	dicom->directory[0] = '\0';
}

static void dicom_close(struct image_file *file)
{
	struct dicom *dicom = file->state;

	if (dicom == NULL)
		return;
	if (dicom->file >= 0)
		close(dicom->file);
	remove_files(dicom);
	free(dicom->increments[0]);
	free(dicom->increments[1]);
	free(dicom->frame);
	free(dicom->own_path);
	free(dicom->image);
	free(dicom);
}

static int dicom_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct dicom *dicom = calloc(1, sizeof(*dicom));
	int code;

	(void)options;
	if (dicom == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a DICOM file");
	file->state = dicom;
	dicom->file = -1;
	dicom->patient = -1;
	dicom->frames = 1;
	dicom->samples = 1;
	for (int i = 0; i < NUMBER_COUNT; i++)
		dicom->object.number[i] = NAN;
	dicom->object.spacing[0] = dicom->object.spacing[1] = NAN;
	/* A name that begins with a dash would be an option. */
	if (asprintf(&dicom->own_path, "%s%s", path[0] == '/' ? "" : "./", path) < 0) {
		dicom->own_path = NULL;
		return error_set(err, ERR_NO_MEMORY, "no memory for a path");
	}
	dicom->path = dicom->own_path;
	code = read_attributes(dicom, err);
	if (code == 0)
		code = understand(file, dicom, err);
	if (code == 0 && dicom->mirrored)
		fprintf(stderr,
			"note: the images of %s were turned or mirrored when they were stored; they are taken as they "
			"are (--flip-columns and --flip-rows mirror them)\n",
			path);
	return code;
}

/* ---- pixels ---- */

/* The program that undoes a transfer syntax, NULL where none is needed. */
static int decoder_of(const char *transfer_syntax, const char **ret_program, struct error *err)
{
	static const struct {
		const char *uid, *program;
	} decoders[] = {
	    {"1.2.840.10008.1.2.5", "dcmdrle"},     {"1.2.840.10008.1.2.4.50", "dcmdjpeg"},
	    {"1.2.840.10008.1.2.4.51", "dcmdjpeg"}, {"1.2.840.10008.1.2.4.53", "dcmdjpeg"},
	    {"1.2.840.10008.1.2.4.55", "dcmdjpeg"}, {"1.2.840.10008.1.2.4.57", "dcmdjpeg"},
	    {"1.2.840.10008.1.2.4.70", "dcmdjpeg"}, {"1.2.840.10008.1.2.4.80", "dcmdjpls"},
	    {"1.2.840.10008.1.2.4.81", "dcmdjpls"}, {"1.2.840.10008.1.2", NULL},
	    {"1.2.840.10008.1.2.1", NULL},          {"1.2.840.10008.1.2.2", NULL},
	    {"1.2.840.10008.1.2.1.99", NULL},
	};

	for (size_t i = 0; i < sizeof(decoders) / sizeof(decoders[0]); i++)
		if (strcmp(transfer_syntax, decoders[i].uid) == 0) {
			*ret_program = decoders[i].program;
			return 0;
		}
	return error_set(err, ERR_IMPOSSIBLE, "the transfer syntax %.70s is not read: JPEG, JPEG-LS, RLE and none are",
			 transfer_syntax);
}

static int make_directory(struct dicom *dicom, struct error *err)
{
	const char *base = getenv("TMPDIR");

	if (base == NULL || strlen(base) > sizeof(dicom->directory) - 20)
		base = "/tmp";
	snprintf(dicom->directory, sizeof(dicom->directory), "%s/cbct-dicom-XXXXXX", base);
	if (mkdtemp(dicom->directory) == NULL) {
		dicom->directory[0] = '\0';
		return error_set_errno(err, errno, "no temporary directory in %s", base);
	}
	return 0;
}

/* dcmdump writes the pixels of NAME as NAME.0.raw; a link gives the file a name of ours. */
static int extract(struct dicom *dicom, char ret_path[128], struct error *err)
{
	const char *const dump[] = {"dcmdump", "--quiet", "--write-pixel", dicom->directory, ret_path, NULL};
	const char *program = NULL;
	char plain[96], in[96], whole[PATH_MAX];
	int code = decoder_of(dicom->transfer_syntax, &program, err);

	if (code == 0)
		code = make_directory(dicom, err);
	if (code != 0)
		return code;
	snprintf(plain, sizeof(plain), "%s/plain.dcm", dicom->directory);
	snprintf(in, sizeof(in), "%s/in.dcm", dicom->directory);
	if (realpath(dicom->path, whole) == NULL || symlink(whole, in) != 0)
		return error_set_errno(err, errno, "%s", dicom->path);
	if (program != NULL) {
		const char *const decode[] = {program, "--quiet", in, plain, NULL};

		code = tool_run(decode, "dcmtk", NULL, NULL, err);
	}
	snprintf(ret_path, 128, "%s", program != NULL ? plain : in);
	if (code == 0)
		code = tool_run(dump, "dcmtk", NULL, NULL, err);
	snprintf(ret_path, 128, "%s.0.raw", program != NULL ? plain : in);
	return code;
}

static int open_pixels(struct image_file *file, struct error *err)
{
	struct dicom *dicom = file->state;
	size_t expected;
	struct stat status;
	char path[128];
	int code = extract(dicom, path, err);

	if (code != 0)
		return code;
	dicom->bytes = (size_t)file->columns * (size_t)file->rows * pixel_bytes(file->type);
	expected = dicom->bytes * (size_t)file->count;
	dicom->file = open(path, O_RDONLY | O_CLOEXEC);
	if (dicom->file < 0 || fstat(dicom->file, &status) != 0)
		return error_set(err, ERR_INVALID, "it has no pixels");
	/* An odd number of bytes is padded. */
	if ((size_t)status.st_size < expected)
		return error_set(err, ERR_INVALID, "%zu bytes of pixels, %zu are expected", (size_t)status.st_size,
				 expected);
	remove_files(dicom);
	dicom->image = malloc(dicom->bytes);
	return dicom->image != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for %zu bytes", dicom->bytes);
}

static int dicom_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	struct dicom *dicom = file->state;
	const struct dicom_values *values = dicom->frame != NULL ? &dicom->frame[index] : &dicom->object;
	size_t pixels = (size_t)file->columns * (size_t)file->rows;
	double slope = isnan(values->number[SLOPE]) ? 1 : values->number[SLOPE];
	double intercept = isnan(values->number[INTERCEPT]) ? 0 : values->number[INTERCEPT];
	int code = dicom->image == NULL ? open_pixels(file, err) : 0;

	if (code == 0)
		code = file_read_at(dicom->file, dicom->image, dicom->bytes, (size_t)index * dicom->bytes, "the pixels",
				    err);
	if (code != 0)
		return code;
	pixels_to_float(dicom->image, file->type, false, pixels, ret_pixels);
	for (size_t i = 0; i < pixels && (slope != 1 || intercept != 0); i++)
		ret_pixels[i] = (float)(slope * (double)ret_pixels[i] + intercept);
	return 0;
}

const struct image_format image_dicom = {"DICOM", dicom_recognise, dicom_open, dicom_read, dicom_close};

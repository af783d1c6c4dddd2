/*
 * Volume files: NIfTI-1 (Cox et al. 2004), MetaImage, NRRD and raw. Headers are
 * written byte by byte, so they are the same on any machine; the voxels behind
 * them are the same bytes in every format.
 */
#include "proto/format.h"

#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/nifti.h"

const char *const volume_type_names[VOLUME_TYPE_COUNT] = {"float32", "int16"};

size_t volume_type_bytes(enum volume_type type)
{
	return type == VOLUME_INT16 ? 2 : 4;
}

static inline int16_t hounsfield(float mu, double scale)
{
	const double low = -32768, high = 32767;
	double hu = mu * scale - 1000;

	hu = hu > low ? hu : low; /* NaN compares false */
	hu = hu < high ? hu : high;
	return (int16_t)((int)(hu + (0.5 - low)) + (int)low);
}

static inline __attribute__((always_inline)) void to_hu(const float *mu, size_t count, double scale, int16_t *ret_hu)
{
	enum { BLOCK = 256 }; /* a constant number of turns is what lets gcc vectorise at -O2 */
	size_t done = 0;

	for (; done + BLOCK <= count; done += BLOCK) {
		for (size_t i = 0; i < BLOCK; i++)
			ret_hu[done + i] = hounsfield(mu[done + i], scale);
	}
	for (; done < count; done++)
		ret_hu[done] = hounsfield(mu[done], scale);
}

static void to_hu_base(const float *mu, size_t count, double scale, int16_t *ret_hu)
{
	to_hu(mu, count, scale, ret_hu);
}

#ifdef __x86_64__
/* Four and eight at a time in place of two; without contracted products, so that the bits are the same. */
static __attribute__((target("avx2"))) void to_hu_avx2(const float *mu, size_t count, double scale, int16_t *ret_hu)
{
	to_hu(mu, count, scale, ret_hu);
}

static __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,prefer-vector-width=512"))) void
to_hu_avx512(const float *mu, size_t count, double scale, int16_t *ret_hu)
{
	to_hu(mu, count, scale, ret_hu);
}

static bool has_avx512(void)
{
	return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
	       __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
}
#endif

void volume_to_hu(const float *mu, size_t count, double mu_water, int16_t *ret_hu)
{
#ifdef __x86_64__
	if (has_avx512()) {
		to_hu_avx512(mu, count, 1000 / mu_water, ret_hu);
		return;
	}
	if (__builtin_cpu_supports("avx2")) {
		to_hu_avx2(mu, count, 1000 / mu_water, ret_hu);
		return;
	}
#endif
	to_hu_base(mu, count, 1000 / mu_water, ret_hu);
}

/* Files of a patient of whom nothing is known have the axes of one who lies HFS, and say that it is not known. */
static const struct patient *placed(const struct provenance *provenance)
{
	return provenance->patient.known ? &provenance->patient : &patient_unknown;
}

/* ---- NIfTI ---- */

const char *const volume_units[VOLUME_TYPE_COUNT] = {"1/mm", "HU"};

static void put16(uint8_t *at, int value)
{
	at[0] = (uint8_t)(value & 0xff);
	at[1] = (uint8_t)(value >> 8 & 0xff);
}

static void put32(uint8_t *at, uint32_t value)
{
	for (int i = 0; i < 4; i++)
		at[i] = (uint8_t)(value >> 8 * i);
}

static void put_float(uint8_t *at, double value)
{
	float number = (float)value;
	uint32_t bits;

	memcpy(&bits, &number, sizeof(bits));
	put32(at, bits);
}

/*
 * The quaternion (a, b, c, d), a >= 0, of a rotation: its largest component from the
 * diagonal, the others from differences and sums across it (Shepperd 1978).
 */
static void quaternion_of(double m[3][3], double ret[4])
{
	double square[4] = {1 + m[0][0] + m[1][1] + m[2][2], 1 + m[0][0] - m[1][1] - m[2][2],
			    1 - m[0][0] + m[1][1] - m[2][2], 1 - m[0][0] - m[1][1] + m[2][2]};
	/* 4 times the product of each two components. */
	double product[4][4] = {{0, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]},
				{0, 0, m[0][1] + m[1][0], m[0][2] + m[2][0]},
				{0, 0, 0, m[1][2] + m[2][1]}};
	int largest = 0;
	double sign;

	for (int i = 1; i < 4; i++)
		if (square[i] > square[largest])
			largest = i;
	for (int i = 0; i < 4; i++) {
		int low = i < largest ? i : largest, high = i < largest ? largest : i;

		ret[i] = i == largest ? sqrt(square[i]) / 2 : product[low][high] / (2 * sqrt(square[largest]));
	}
	sign = ret[0] < 0 ? -1 : 1;
	for (int i = 0; i < 4; i++)
		ret[i] = sign * ret[i] + 0.0; /* no negative zeros */
}

/* Voxels to mm, twice: as a matrix (sform), and as a quaternion (qform). */
static void put_place(uint8_t *h, const struct grid *grid, const struct patient *patient)
{
	/* NIfTI's world is RAS: x and y are DICOM's turned round, half a turn about z. */
	static const double turn[3] = {-1, -1, 1};
	double rotation[3][3], quaternion[4], origin[3];

	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			rotation[i][j] = turn[i] * patient->rotation[i][j] + 0.0;
	quaternion_of(rotation, quaternion);
	patient_point(patient, grid->origin, origin);
	put_float(h + NIFTI_PIXDIM, 1); /* qfac: the turn is no mirror */
	put16(h + NIFTI_QFORM_CODE, 1); /* scanner coordinates */
	put16(h + NIFTI_SFORM_CODE, 1);
	for (int i = 0; i < 3; i++) {
		put_float(h + NIFTI_PIXDIM + 4 * (i + 1), grid->spacing[i]);
		put_float(h + NIFTI_QUATERN + 4 * i, quaternion[i + 1]);
		put_float(h + NIFTI_QOFFSET + 4 * i, turn[i] * origin[i] + 0.0);
		for (int j = 0; j < 3; j++)
			put_float(h + NIFTI_SROW + 16 * i + 4 * j, rotation[i][j] * grid->spacing[j]);
		put_float(h + NIFTI_SROW + 16 * i + 12, turn[i] * origin[i] + 0.0);
	}
}

/* Without the recipe where there is no room for it: half a text is no JSON. */
static int put_extension(uint8_t *h, const struct provenance *provenance, const char *unit, struct error *err)
{
	const size_t room = NIFTI_VOXELS - NIFTI_EXTENSION_TEXT;
	cJSON *json = provenance_json(provenance, unit);
	char *text = provenance_text(json);
	int code = 0;

	if (text != NULL && strlen(text) > room) {
		free(text);
		cJSON_DeleteItemFromObjectCaseSensitive(json, "recipe");
		text = provenance_text(json);
	}
	h[NIFTI_EXTENDER] = 1;
	put32(h + NIFTI_EXTENSION, NIFTI_VOXELS - NIFTI_EXTENSION);
	put32(h + NIFTI_EXTENSION + 4, NIFTI_ECODE_COMMENT);
	if (text == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a header");
	else
		memcpy(h + NIFTI_EXTENSION_TEXT, text, strlen(text));
	free(text);
	cJSON_Delete(json);
	return code;
}

static int nifti_header(const struct grid *grid, enum volume_type type, const struct provenance *provenance,
			uint8_t ret_header[FORMAT_HEADER_MAX], size_t *ret_length, struct error *err)
{
	uint8_t *h = ret_header;

	memset(h, 0, NIFTI_VOXELS);
	put32(h + NIFTI_SIZEOF_HDR, NIFTI_HEADER);
	put16(h + NIFTI_DIM, 3);
	for (int i = 0; i < 7; i++)
		put16(h + NIFTI_DIM + 2 * (i + 1), i < 3 ? grid->size[i] : 1);
	put16(h + NIFTI_DATATYPE, type == VOLUME_INT16 ? 4 : 16);
	put16(h + NIFTI_BITPIX, 8 * (int)volume_type_bytes(type));
	put_float(h + NIFTI_VOX_OFFSET, NIFTI_VOXELS);
	put_float(h + NIFTI_SCL_SLOPE, 1);
	h[NIFTI_XYZT_UNITS] = 2; /* mm */
	provenance_sentence(provenance, volume_units[type], (char *)h + NIFTI_DESCRIP, 80);
	put_place(h, grid, placed(provenance));
	memcpy(h + NIFTI_MAGIC, "n+1", 4);
	*ret_length = NIFTI_VOXELS;
	return put_extension(h, provenance, volume_units[type], err);
}

/* ---- text headers ---- */

struct header_text {
	char *text;
	size_t length;
};

__attribute__((format(printf, 2, 3))) static void line(struct header_text *h, const char *format, ...)
{
	va_list args;
	int length;

	va_start(args, format);
	length = vsnprintf(h->text + h->length, FORMAT_HEADER_MAX - h->length, format, args);
	va_end(args);
	if (length > 0)
		h->length += (size_t)length;
}

static void comment(struct header_text *h, const char *before, const struct provenance *provenance, const char *unit)
{
	char sentence[200]; /* MetaIO has room for 255 */

	provenance_sentence(provenance, unit, sentence, sizeof(sentence));
	line(h, "%s%s\n", before, sentence);
}

static void three(struct header_text *h, const char *before, const double numbers[3], const char *between,
		  const char *after)
{
	char text[3][NUMBER_TEXT_MAX];

	for (int i = 0; i < 3; i++)
		number_print(numbers[i], text[i]);
	line(h, "%s%s%s%s%s%s%s", before, text[0], between, text[1], between, text[2], after);
}

/*
 * Writes one key a line: a text as JSON writes it, without its quotes, anything else as
 * JSON. MetaIO reads 500 bytes of a line and loses what lies behind a longer one,
 * so that a longer value is left out; none is but what nobody would write by hand.
 */
static int key_line(struct header_text *h, const char *prefix, const cJSON *value, bool nrrd, struct error *err)
{
	const size_t most = 400, reserve = 1024; /* for the fields behind */
	char *text = provenance_text(value);
	size_t length = text != NULL ? strlen(text) : 0, quote = cJSON_IsString(value) ? 1 : 0;

	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a header");
	if (length > 2 * quote && length <= most && h->length + 2 * most + reserve < FORMAT_HEADER_MAX) {
		line(h, "%s%s%s", prefix, value->string, nrrd ? ":=" : " = ");
		/* A backslash begins an escape of NRRD's own. */
		for (size_t i = quote; i < length - quote; i++)
			line(h, nrrd && text[i] == '\\' ? "\\%c" : "%c", text[i]);
		line(h, "\n");
	}
	free(text);
	return 0;
}

/* Writes the whole provenance as keys: cbct_job, cbct_recipe_fdk ... */
static int keys(struct header_text *h, const struct provenance *provenance, const char *unit, bool nrrd,
		struct error *err)
{
	cJSON *json = provenance_json(provenance, unit);
	const cJSON *member;
	int code = json == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a header") : 0;

	cJSON_ArrayForEach(member, json)
	{
		bool recipe = strcmp(member->string, "recipe") == 0;

		for (const cJSON *part = recipe ? member->child : member; part != NULL && code == 0;
		     part = recipe ? part->next : NULL)
			code = key_line(h, recipe ? "cbct_recipe_" : "cbct_", part, nrrd, err);
	}
	cJSON_Delete(json);
	return code;
}

/* The directions of the voxels' axes in the patient's mm, LPS, and the centre of the first voxel. */
static void directions(const struct grid *grid, const struct patient *patient, double ret_axes[3][3],
		       double ret_origin[3])
{
	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			ret_axes[i][j] = patient->rotation[j][i];
	patient_point(patient, grid->origin, ret_origin);
}

/* MetaImage names where the axes come from: right, anterior and inferior are DICOM's left, posterior, superior. */
static void anatomical_orientation(struct header_text *h, double axes[3][3])
{
	static const char from[3][2] = {{'R', 'L'}, {'A', 'P'}, {'I', 'S'}};
	int nearest[3];

	axes_nearest(axes, nearest);
	line(h, "AnatomicalOrientation = ");
	for (int i = 0; i < 3; i++)
		line(h, "%c", from[nearest[i]][axes[i][nearest[i]] < 0]);
	line(h, "\n");
}

static int mha_header(const struct grid *grid, enum volume_type type, const struct provenance *provenance,
		      uint8_t ret_header[FORMAT_HEADER_MAX], size_t *ret_length, struct error *err)
{
	struct header_text h = {.text = (char *)ret_header};
	double axes[3][3], origin[3];
	int code;

	directions(grid, placed(provenance), axes, origin);
	line(&h, "ObjectType = Image\nNDims = 3\n");
	comment(&h, "Comment = ", provenance, volume_units[type]);
	code = keys(&h, provenance, volume_units[type], false, err);
	line(&h, "BinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\nTransformMatrix =");
	for (int i = 0; i < 3; i++)
		three(&h, " ", axes[i], " ", i < 2 ? "" : "\n");
	three(&h, "Offset = ", origin, " ", "\n");
	line(&h, "CenterOfRotation = 0 0 0\n");
	anatomical_orientation(&h, axes);
	three(&h, "ElementSpacing = ", grid->spacing, " ", "\n");
	line(&h, "DimSize = %d %d %d\n", grid->size[0], grid->size[1], grid->size[2]);
	line(&h, "ElementType = %s\nElementDataFile = LOCAL\n", type == VOLUME_INT16 ? "MET_SHORT" : "MET_FLOAT");
	*ret_length = h.length;
	return code;
}

static int nrrd_header(const struct grid *grid, enum volume_type type, const struct provenance *provenance,
		       uint8_t ret_header[FORMAT_HEADER_MAX], size_t *ret_length, struct error *err)
{
	struct header_text h = {.text = (char *)ret_header};
	double axes[3][3], origin[3];
	int code;

	directions(grid, placed(provenance), axes, origin);
	line(&h, "NRRD0004\n");
	comment(&h, "# ", provenance, volume_units[type]);
	line(&h, "type: %s\ndimension: 3\nspace: left-posterior-superior\n", type == VOLUME_INT16 ? "short" : "float");
	line(&h, "sizes: %d %d %d\nspace directions:", grid->size[0], grid->size[1], grid->size[2]);
	for (int i = 0; i < 3; i++) {
		for (int j = 0; j < 3; j++)
			axes[i][j] *= grid->spacing[i];
		three(&h, " (", axes[i], ",", ")");
	}
	line(&h, "\nkinds: domain domain domain\nendian: little\nencoding: raw\n");
	three(&h, "space origin: (", origin, ",", ")\n");
	line(&h, "space units: \"mm\" \"mm\" \"mm\"\n");
	code = keys(&h, provenance, volume_units[type], true, err);
	line(&h, "\n");
	*ret_length = h.length;
	return code;
}

static int raw_header(const struct grid *grid, enum volume_type type, const struct provenance *provenance,
		      uint8_t ret_header[FORMAT_HEADER_MAX], size_t *ret_length, struct error *err)
{
	(void)grid, (void)type, (void)provenance, (void)ret_header, (void)err;
	*ret_length = 0;
	return 0;
}

const struct volume_format volume_formats[] = {
    {"nifti", ".nii", "application/x-nifti", false, nifti_header},
    {"nifti.gz", ".nii.gz", "application/gzip", true, nifti_header},
    {"mha", ".mha", "application/x-metaimage", false, mha_header},
    {"nrrd", ".nrrd", "application/x-nrrd", false, nrrd_header},
    {"raw", ".raw", "application/octet-stream", false, raw_header},
    {NULL, NULL, NULL, false, NULL},
};

const struct volume_format *volume_format_find(const char *name)
{
	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		if (strcmp(format->name, name) == 0)
			return format;
	}
	return NULL;
}

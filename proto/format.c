/*
 * Volume files: NIfTI-1 (Cox et al. 2004), MetaImage, NRRD and raw. Headers are
 * written byte by byte, so they are the same on any machine; the voxels behind
 * them are the same bytes in every format.
 */
#include "proto/format.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "proto/header.h"
#include "proto/json.h"
#include "proto/metaimage.h"
#include "proto/spool.h"

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
/* Four at a time in place of two; without contracted products, so that the bits are the same. */
static __attribute__((target("avx2"))) void to_hu_avx2(const float *mu, size_t count, double scale, int16_t *ret_hu)
{
	to_hu(mu, count, scale, ret_hu);
}
#endif

void volume_to_hu(const float *mu, size_t count, double mu_water, int16_t *ret_hu)
{
#ifdef __x86_64__
	if (__builtin_cpu_supports("avx2")) {
		to_hu_avx2(mu, count, 1000 / mu_water, ret_hu);
		return;
	}
#endif
	to_hu_base(mu, count, 1000 / mu_water, ret_hu);
}

/* ---- NIfTI ---- */

/* Offsets in the 348 bytes of nifti1.h's struct nifti_1_header. */
enum {
	NIFTI_SIZEOF_HDR = 0,
	NIFTI_DIM = 40,
	NIFTI_DATATYPE = 70,
	NIFTI_BITPIX = 72,
	NIFTI_PIXDIM = 76,
	NIFTI_VOX_OFFSET = 108,
	NIFTI_SCL_SLOPE = 112,
	NIFTI_SCL_INTER = 116,
	NIFTI_XYZT_UNITS = 123,
	NIFTI_DESCRIP = 148,
	NIFTI_QFORM_CODE = 252,
	NIFTI_SFORM_CODE = 254,
	NIFTI_QUATERN = 256,
	NIFTI_QOFFSET = 268,
	NIFTI_SROW = 280,
	NIFTI_MAGIC = 344,
	NIFTI_HEADER = 348,
	NIFTI_VOXELS = 352 /* four bytes say that no extension follows */
};

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

static size_t nifti_header(const struct grid *grid, enum volume_type type, const char *description,
			   uint8_t ret_header[FORMAT_HEADER_MAX])
{
	/* NIfTI's world is RAS: x and y are DICOM's turned round, half a turn about z. */
	static const double turn[3] = {-1, -1, 1};
	uint8_t *h = ret_header;

	memset(h, 0, NIFTI_VOXELS);
	put32(h + NIFTI_SIZEOF_HDR, NIFTI_HEADER);
	put16(h + NIFTI_DIM, 3);
	for (int i = 0; i < 7; i++)
		put16(h + NIFTI_DIM + 2 * (i + 1), i < 3 ? grid->size[i] : 1);
	put16(h + NIFTI_DATATYPE, type == VOLUME_INT16 ? 4 : 16);
	put16(h + NIFTI_BITPIX, 8 * (int)volume_type_bytes(type));
	put_float(h + NIFTI_PIXDIM, 1); /* qfac: the turn is no mirror */
	put_float(h + NIFTI_VOX_OFFSET, NIFTI_VOXELS);
	put_float(h + NIFTI_SCL_SLOPE, 1);
	h[NIFTI_XYZT_UNITS] = 2; /* mm */
	snprintf((char *)h + NIFTI_DESCRIP, 80, "%s", description);
	put16(h + NIFTI_QFORM_CODE, 1); /* scanner coordinates */
	put16(h + NIFTI_SFORM_CODE, 1);
	put_float(h + NIFTI_QUATERN + 8, 1); /* (a, b, c, d) = (0, 0, 0, 1): half a turn about z */
	for (int i = 0; i < 3; i++) {
		put_float(h + NIFTI_PIXDIM + 4 * (i + 1), grid->spacing[i]);
		put_float(h + NIFTI_QOFFSET + 4 * i, turn[i] * grid->origin[i]);
		put_float(h + NIFTI_SROW + 16 * i + 4 * i, turn[i] * grid->spacing[i]);
		put_float(h + NIFTI_SROW + 16 * i + 12, turn[i] * grid->origin[i]);
	}
	memcpy(h + NIFTI_MAGIC, "n+1", 4);
	return NIFTI_VOXELS;
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

/* A description may not end the line that it stands in. */
static void comment(struct header_text *h, const char *before, const char *description)
{
	char clean[200];
	size_t length = 0;

	for (; description[length] != '\0' && length < sizeof(clean) - 1; length++)
		clean[length] = (unsigned char)description[length] < 0x20 ? ' ' : description[length];
	clean[length] = '\0';
	if (length > 0)
		line(h, "%s%s\n", before, clean);
}

static void three(struct header_text *h, const char *before, const double numbers[3], const char *between,
		  const char *after)
{
	char text[3][NUMBER_TEXT_MAX];

	for (int i = 0; i < 3; i++)
		number_print(numbers[i], text[i]);
	line(h, "%s%s%s%s%s%s%s", before, text[0], between, text[1], between, text[2], after);
}

static size_t mha_header(const struct grid *grid, enum volume_type type, const char *description,
			 uint8_t ret_header[FORMAT_HEADER_MAX])
{
	struct header_text h = {.text = (char *)ret_header};

	line(&h, "ObjectType = Image\nNDims = 3\n");
	comment(&h, "Comment = ", description);
	line(&h, "BinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n");
	line(&h, "TransformMatrix = 1 0 0 0 1 0 0 0 1\n");
	three(&h, "Offset = ", grid->origin, " ", "\n");
	/* MetaImage names where the axes come from: right, anterior and inferior are DICOM's left, posterior, superior.
	 */
	line(&h, "CenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\n");
	three(&h, "ElementSpacing = ", grid->spacing, " ", "\n");
	line(&h, "DimSize = %d %d %d\n", grid->size[0], grid->size[1], grid->size[2]);
	line(&h, "ElementType = %s\nElementDataFile = LOCAL\n", type == VOLUME_INT16 ? "MET_SHORT" : "MET_FLOAT");
	return h.length;
}

static size_t nrrd_header(const struct grid *grid, enum volume_type type, const char *description,
			  uint8_t ret_header[FORMAT_HEADER_MAX])
{
	struct header_text h = {.text = (char *)ret_header};

	line(&h, "NRRD0004\n");
	comment(&h, "# ", description);
	line(&h, "type: %s\ndimension: 3\nspace: left-posterior-superior\n", type == VOLUME_INT16 ? "short" : "float");
	line(&h, "sizes: %d %d %d\nspace directions:", grid->size[0], grid->size[1], grid->size[2]);
	for (int i = 0; i < 3; i++) {
		double direction[3] = {0, 0, 0};

		direction[i] = grid->spacing[i];
		three(&h, " (", direction, ",", ")");
	}
	line(&h, "\nkinds: domain domain domain\nendian: little\nencoding: raw\n");
	three(&h, "space origin: (", grid->origin, ",", ")\n");
	line(&h, "space units: \"mm\" \"mm\" \"mm\"\n\n");
	return h.length;
}

static size_t raw_header(const struct grid *grid, enum volume_type type, const char *description,
			 uint8_t ret_header[FORMAT_HEADER_MAX])
{
	(void)grid, (void)type, (void)description, (void)ret_header;
	return 0;
}

const struct volume_format volume_formats[] = {
    {"nifti", ".nii", "application/x-nifti", nifti_header},
    {"mha", ".mha", "application/x-metaimage", mha_header},
    {"nrrd", ".nrrd", "application/x-nrrd", nrrd_header},
    {"raw", ".raw", "application/octet-stream", raw_header},
    {NULL, NULL, NULL, NULL},
};

const struct volume_format *volume_format_find(const char *name)
{
	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		if (strcmp(format->name, name) == 0)
			return format;
	}
	return NULL;
}

/* ---- reading ---- */

/* What the other formats call the types that they share. */
static const struct {
	int nifti;
	const char *nrrd, *nrrd_too;
} type_names[PIXEL_TYPE_COUNT] = {
    [PIXEL_UINT8] = {2, "unsigned char", "uint8"},      [PIXEL_INT8] = {256, "signed char", "int8"},
    [PIXEL_UINT16] = {512, "unsigned short", "uint16"}, [PIXEL_INT16] = {4, "short", "int16"},
    [PIXEL_UINT32] = {768, "unsigned int", "uint32"},   [PIXEL_INT32] = {8, "int", "int32"},
    [PIXEL_FLOAT32] = {16, "float", "float"},           [PIXEL_FLOAT64] = {64, "double", "double"},
};

/* What a header told. */
struct layout {
	int size[3];
	double direction[3][3]; /* of axis i in LPS mm, spacing included */
	double origin[3];       /* LPS mm, centre of the first voxel in the file */
	enum pixel_type type;
	double slope, offset; /* value = slope * stored + offset */
	size_t start;         /* of the voxels in the file */
};

static int get16(const uint8_t *at)
{
	return (int16_t)(at[0] | at[1] << 8);
}

static double get_float(const uint8_t *at)
{
	uint32_t bits = at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
	float number;

	memcpy(&number, &bits, sizeof(number));
	return number;
}

/* Rows of the RAS matrix: from sform, else from qform's quaternion, else the plain spacing (the standard's methods). */
static void nifti_matrix(const uint8_t *h, double ret_rows[3][4])
{
	double b = get_float(h + NIFTI_QUATERN), c = get_float(h + NIFTI_QUATERN + 4);
	double d = get_float(h + NIFTI_QUATERN + 8), a = sqrt(fmax(0, 1 - b * b - c * c - d * d));
	double turn[3][3] = {{a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)},
			     {2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)},
			     {2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c}};
	bool sform = get16(h + NIFTI_SFORM_CODE) > 0, qform = get16(h + NIFTI_QFORM_CODE) > 0;
	double mirror = get_float(h + NIFTI_PIXDIM) < 0 ? -1 : 1;

	for (int i = 0; i < 3; i++) {
		for (int j = 0; j < 3; j++) {
			double spacing = get_float(h + NIFTI_PIXDIM + 4 * (j + 1)) * (j == 2 ? mirror : 1);

			if (sform)
				ret_rows[i][j] = get_float(h + NIFTI_SROW + 16 * i + 4 * j);
			else
				ret_rows[i][j] = qform ? turn[i][j] * spacing : (i == j) * fabs(spacing);
		}
		ret_rows[i][3] = 0;
		if (sform)
			ret_rows[i][3] = get_float(h + NIFTI_SROW + 16 * i + 12);
		else if (qform)
			ret_rows[i][3] = get_float(h + NIFTI_QOFFSET + 4 * i);
	}
}

static int read_nifti(const uint8_t *h, struct layout *ret, struct error *err)
{
	double rows[3][4];
	int type = get16(h + NIFTI_DATATYPE), dimensions = get16(h + NIFTI_DIM), found = -1;

	if (get16(h + NIFTI_SIZEOF_HDR) != NIFTI_HEADER)
		return error_set(err, ERR_INVALID, "NIfTI of the other byte order is not read");
	for (int i = 0; i < PIXEL_TYPE_COUNT; i++) {
		if (type_names[i].nifti == type)
			found = i;
	}
	if (found < 0)
		return error_set(err, ERR_INVALID, "NIfTI datatype %d is not read", type);
	if (dimensions < 1 || dimensions > 7)
		return error_set(err, ERR_INVALID, "NIfTI with %d dimensions", dimensions);
	for (int i = 0; i < dimensions; i++) {
		int size = get16(h + NIFTI_DIM + 2 * (i + 1));

		if (i < 3)
			ret->size[i] = size;
		else if (size > 1)
			return error_set(err, ERR_INVALID, "NIfTI with more than three dimensions");
	}
	nifti_matrix(h, rows);
	for (int axis = 0; axis < 3; axis++) {
		ret->direction[axis][0] = -rows[0][axis];
		ret->direction[axis][1] = -rows[1][axis];
		ret->direction[axis][2] = rows[2][axis];
		ret->origin[axis] = axis < 2 ? -rows[axis][3] : rows[axis][3];
	}
	ret->type = (enum pixel_type)found;
	ret->start = (size_t)fmin(fmax(get_float(h + NIFTI_VOX_OFFSET), NIFTI_HEADER), 1e9);
	if (get_float(h + NIFTI_SCL_SLOPE) != 0) {
		ret->slope = get_float(h + NIFTI_SCL_SLOPE);
		ret->offset = get_float(h + NIFTI_SCL_INTER);
	}
	return 0;
}

static int want_numbers(const char *key, const char *text, int count, double *ret, struct error *err)
{
	double numbers[16];

	if (header_numbers(text, 16, numbers) != count)
		return error_set(err, ERR_INVALID, "%.60s: %d numbers are expected", key, count);
	memcpy(ret, numbers, (size_t)count * sizeof(*ret));
	return 0;
}

static int want_size(const char *key, const char *text, int ret_size[3], struct error *err)
{
	double numbers[3];
	int code = want_numbers(key, text, 3, numbers, err);

	for (int i = 0; i < 3 && code == 0; i++) {
		if (!(numbers[i] >= 1 && numbers[i] <= GRID_SIZE_MAX))
			return error_set(err, ERR_INVALID, "%.60s: %g voxels, 1 to %d are expected", key, numbers[i],
					 GRID_SIZE_MAX);
		ret_size[i] = (int)numbers[i];
	}
	return code;
}

static int read_mha(const char *text, size_t length, struct layout *ret, struct error *err)
{
	struct metaimage image;
	int code = metaimage_parse(text, length, &image, err);

	if (code != 0)
		return code;
	if (image.dimensions != 3)
		return error_set(err, ERR_INVALID, "MetaImage: NDims is %d, a volume has 3", image.dimensions);
	if (image.compressed)
		return header_refuse("CompressedData", "True", err);
	if (image.big_endian)
		return header_refuse("BinaryDataByteOrderMSB", "True", err);
	if (strcmp(image.data_file, "LOCAL") != 0)
		return header_refuse("ElementDataFile", image.data_file, err);
	for (int i = 0; i < 3; i++) {
		if (image.size[i] > GRID_SIZE_MAX)
			return error_set(err, ERR_INVALID, "DimSize: %d voxels, 1 to %d are expected", image.size[i],
					 GRID_SIZE_MAX);
		ret->size[i] = image.size[i];
		ret->origin[i] = image.origin[i];
		for (int j = 0; j < 3; j++)
			ret->direction[i][j] = image.direction[i][j] * image.spacing[i];
	}
	ret->type = image.type;
	ret->start = image.length;
	return 0;
}

static int read_nrrd_line(const char *key, const char *value, struct layout *ret, bool *ras, struct error *err)
{
	double spacing[3];
	int code;

	if (strcmp(key, "dimension") == 0 && strcmp(value, "3") != 0)
		return header_refuse(key, value, err);
	if ((strcmp(key, "encoding") == 0 && strcmp(value, "raw") != 0) ||
	    (strcmp(key, "endian") == 0 && strcmp(value, "little") != 0) || strcmp(key, "data file") == 0 ||
	    strcmp(key, "byte skip") == 0 || strcmp(key, "line skip") == 0)
		return header_refuse(key, value, err);
	if (strcmp(key, "sizes") == 0)
		return want_size(key, value, ret->size, err);
	if (strcmp(key, "space directions") == 0)
		return want_numbers(key, value, 9, ret->direction[0], err);
	if (strcmp(key, "space origin") == 0)
		return want_numbers(key, value, 3, ret->origin, err);
	if (strcmp(key, "spacings") == 0) {
		code = want_numbers(key, value, 3, spacing, err);
		for (int i = 0; i < 3 && code == 0; i++)
			ret->direction[i][i] = spacing[i];
		return code;
	}
	if (strcmp(key, "space") == 0) {
		*ras = strcmp(value, "right-anterior-superior") == 0 || strcmp(value, "RAS") == 0;
		if (!*ras && strcmp(value, "left-posterior-superior") != 0 && strcmp(value, "LPS") != 0)
			return header_refuse(key, value, err);
	}
	if (strcmp(key, "type") == 0) {
		for (int i = 0; i < PIXEL_TYPE_COUNT; i++) {
			if (strcmp(value, type_names[i].nrrd) == 0 || strcmp(value, type_names[i].nrrd_too) == 0) {
				ret->type = (enum pixel_type)i;
				return 0;
			}
		}
		return header_refuse(key, value, err);
	}
	return 0;
}

static int read_nrrd(const char *text, size_t length, struct layout *ret, struct error *err)
{
	char row[512];
	bool ras = false;

	header_line(text, length, &ret->start, row, sizeof(row)); /* the magic */
	while (header_line(text, length, &ret->start, row, sizeof(row))) {
		char *colon = strstr(row, ": ");
		int code = 0;

		if (row[0] == '\0') {
			for (int i = 0; i < 2 && ras; i++) {
				ret->origin[i] *= -1;
				for (int axis = 0; axis < 3; axis++)
					ret->direction[axis][i] *= -1;
			}
			return 0;
		}
		if (row[0] != '#' && colon != NULL) {
			*colon = '\0';
			code = read_nrrd_line(row, colon + 2, ret, &ras, err);
		}
		if (code != 0)
			return code;
	}
	return error_set(err, ERR_INVALID, "NRRD: the header does not end");
}

static int read_header(const uint8_t *head, size_t length, struct layout *ret, struct grid *grid, struct error *err)
{
	const char *text = (const char *)head;

	*ret = (struct layout){
	    .direction = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, .type = PIXEL_FLOAT32, .slope = 1, .size = {1, 1, 1}};
	if (length >= NIFTI_HEADER && memcmp(head + NIFTI_MAGIC, "n+1", 4) == 0)
		return read_nifti(head, ret, err);
	if (length >= 5 && memcmp(head, "NRRD0", 5) == 0)
		return read_nrrd(text, length, ret, err);
	if (metaimage_recognise(head, length))
		return read_mha(text, length, ret, err);
	if (grid->size[0] < 1)
		return error_set(err, ERR_INVALID, "neither NIfTI, MetaImage nor NRRD, and no grid for a raw volume");
	for (int i = 0; i < 3; i++) {
		ret->size[i] = grid->size[i];
		ret->direction[i][i] = grid->spacing[i];
		ret->origin[i] = grid->origin[i];
	}
	return 0;
}

/* The grid of the volume once its axes run along +x, +y and +z, and which of them must be turned round for that. */
static int layout_grid(const struct layout *layout, struct grid *ret_grid, bool ret_flip[3], struct error *err)
{
	const double skew = 1e-4; /* of the spacing: what single precision and a rounded quaternion leave */

	for (int i = 0; i < 3; i++) {
		double along = layout->direction[i][i];

		for (int j = 0; j < 3; j++) {
			if (j != i && !(fabs(layout->direction[i][j]) <= skew * fabs(along)))
				return error_set(err, ERR_INVALID, "the volume's axes do not lie along x, y and z");
		}
		ret_flip[i] = along < 0;
		ret_grid->size[i] = layout->size[i];
		ret_grid->spacing[i] = fabs(along);
		ret_grid->origin[i] = layout->origin[i] + (along < 0 ? along * (layout->size[i] - 1) : 0);
	}
	return grid_check(ret_grid, err);
}

/* Row after row, each to its place. */
static int read_voxels(int file, const char *path, const struct layout *layout, const struct grid *grid,
		       const bool flip[3], float *ret_voxels, struct error *err)
{
	size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1], nz = (size_t)grid->size[2];
	size_t bytes = pixel_bytes(layout->type), plane = nx * ny * bytes;
	uint8_t *slice = malloc(plane);
	float *stored = malloc(nx * sizeof(*stored));
	int code = 0;

	if (slice == NULL || stored == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a slice of %zu bytes", plane);
	for (size_t z = 0; z < nz && code == 0; z++) {
		size_t to_z = flip[2] ? nz - 1 - z : z;

		code = file_read_at(file, slice, plane, layout->start + z * plane, path, err);
		for (size_t y = 0; y < ny && code == 0; y++) {
			size_t to_y = flip[1] ? ny - 1 - y : y;
			float *row = ret_voxels + (to_z * ny + to_y) * nx;

			pixels_to_float(slice + y * nx * bytes, layout->type, false, nx, stored);
			for (size_t x = 0; x < nx; x++)
				row[flip[0] ? nx - 1 - x : x] =
				    (float)(layout->slope * (double)stored[x] + layout->offset);
		}
	}
	free(slice);
	free(stored);
	return code;
}

/* The size is compared before anything is allocated: a header can promise anything. */
static int check_length(const char *path, const struct stat *status, const struct layout *layout,
			const struct grid *grid, struct error *err)
{
	size_t expected = layout->start + grid_voxels(grid) * pixel_bytes(layout->type);

	if ((size_t)status->st_size < expected)
		return error_set(err, ERR_INVALID, "%.200s: %zu bytes, at least %zu are expected", path,
				 (size_t)status->st_size, expected);
	return 0;
}

int volume_read(const char *path, struct grid *grid, float **ret_voxels, struct error *err)
{
	int file = open(path, O_RDONLY | O_CLOEXEC), code;
	uint8_t head[4096];
	struct layout layout;
	struct grid found;
	struct stat status;
	bool flip[3];
	float *voxels = NULL;

	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	if (fstat(file, &status) != 0) {
		code = error_set_errno(err, errno, "%s cannot be read", path);
		goto out;
	}
	if ((size_t)status.st_size < sizeof(head))
		memset(head, 0, sizeof(head));
	code = file_read_at(file, head, (size_t)status.st_size < sizeof(head) ? (size_t)status.st_size : sizeof(head),
			    0, path, err);
	if (code == 0)
		code = read_header(head, sizeof(head), &layout, grid, err);
	if (code == 0)
		code = layout_grid(&layout, &found, flip, err);
	if (code == 0)
		code = check_length(path, &status, &layout, &found, err);
	if (code != 0)
		goto out;
	voxels = malloc(grid_voxels(&found) * sizeof(*voxels));
	code = voxels == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", grid_voxels(&found))
			      : read_voxels(file, path, &layout, &found, flip, voxels, err);
	if (code == 0) {
		*grid = found;
		*ret_voxels = voxels;
		voxels = NULL;
	}
out:
	free(voxels);
	close(file);
	return code;
}

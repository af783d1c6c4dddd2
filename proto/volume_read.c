/*
 * Volume files read back: NIfTI-1, MetaImage, NRRD, raw, and what gzip made of
 * them. What is not read right is refused by name.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include <zlib.h>

#include "core/scan/geometry.h"
#include "proto/format.h"
#include "proto/header.h"
#include "proto/metaimage.h"
#include "proto/nifti.h"
#include "proto/pixel.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"

enum { HEAD_BYTES = 1 << 16 }; /* what lies behind them is no header */

/* The other formats' names for the types that they share. */
static const struct {
	int nifti;
	const char *nrrd, *nrrd_too;
} type_names[PIXEL_TYPE_COUNT] = {
    [PIXEL_UINT8] = {2, "unsigned char", "uint8"},      [PIXEL_INT8] = {256, "signed char", "int8"},
    [PIXEL_UINT16] = {512, "unsigned short", "uint16"}, [PIXEL_INT16] = {4, "short", "int16"},
    [PIXEL_UINT32] = {768, "unsigned int", "uint32"},   [PIXEL_INT32] = {8, "int", "int32"},
    [PIXEL_FLOAT32] = {16, "float", "float"},           [PIXEL_FLOAT64] = {64, "double", "double"},
};

/* The contents of a header. */
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

/* The rotation of the quaternion (a, b, c, d); a is what the others leave of a length of 1. */
static void nifti_rotation(const uint8_t *h, double ret[3][3])
{
	double b = get_float(h + NIFTI_QUATERN), c = get_float(h + NIFTI_QUATERN + 4);
	double d = get_float(h + NIFTI_QUATERN + 8), length2 = b * b + c * c + d * d, a = sqrt(1 - length2);

	/* Half a turn, as far as single precision tells: the limit of the standard's own nifti1_io.c. */
	if (1 - length2 < 1e-7) {
		double length = sqrt(length2);

		a = 0;
		b /= length;
		c /= length;
		d /= length;
	}
	memcpy(ret,
	       (double[3][3]){{a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)},
			      {2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)},
			      {2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c}},
	       9 * sizeof(double));
}

/* Rows of the RAS matrix: from sform, else from qform's quaternion, else the plain spacing (the standard's methods). */
static void nifti_matrix(const uint8_t *h, double ret_rows[3][4])
{
	double turn[3][3];
	bool sform = get16(h + NIFTI_SFORM_CODE) > 0, qform = get16(h + NIFTI_QFORM_CODE) > 0;
	double mirror = get_float(h + NIFTI_PIXDIM) < 0 ? -1 : 1;

	nifti_rotation(h, turn);
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

static int read_header(const uint8_t *head, size_t length, struct layout *ret, const struct grid *grid,
		       struct error *err)
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

/* Where the file's axes go: axis f of the file is axis to[f] of the volume, the other way round where flip[f]. */
struct turn {
	int to[3];
	bool flip[3];
};

/* Axes at right angles: the volume's are theirs, each forwards along the patient's axis that it is nearest to. */
static int layout_turn(const struct layout *layout, struct turn *ret_turn, double ret_axes[3][3], bool *ret_oblique,
		       struct error *err)
{
	const double skew = 1e-4; /* what single precision and a rounded quaternion leave */
	double unit[3][3];

	*ret_oblique = false;
	for (int f = 0; f < 3; f++) {
		double length = vec_norm(layout->direction[f]);

		for (int j = 0; j < 3; j++)
			unit[f][j] = layout->direction[f][j] / length;
		if (!(length > 0))
			return error_set(err, ERR_INVALID, "a voxel spacing of %g mm", length);
	}
	axes_nearest(unit, ret_turn->to);
	for (int f = 0; f < 3; f++) {
		int o = ret_turn->to[f];

		if (!(fabs(vec_dot(unit[f], unit[(f + 1) % 3])) <= skew))
			return error_set(err, ERR_INVALID, "the volume's axes are not at right angles");
		ret_turn->flip[f] = unit[f][o] < 0;
		for (int j = 0; j < 3; j++) {
			*ret_oblique |= j != o && !(fabs(unit[f][j]) <= skew);
			ret_axes[o][j] = unit[f][j] * (ret_turn->flip[f] ? -1 : 1);
		}
	}
	for (int o = 0; o < 3 && !*ret_oblique; o++)
		for (int j = 0; j < 3; j++)
			ret_axes[o][j] = o == j;
	return 0;
}

/* The grid of the volume once it is turned, its origin counted along its own axes. */
static int layout_grid(const struct layout *layout, const struct turn *turn, double axes[3][3], struct grid *ret_grid,
		       struct error *err)
{
	for (int f = 0; f < 3; f++) {
		int o = turn->to[f];
		double spacing = vec_norm(layout->direction[f]);

		ret_grid->size[o] = layout->size[f];
		ret_grid->spacing[o] = spacing;
		ret_grid->origin[o] =
		    vec_dot(layout->origin, axes[o]) - (turn->flip[f] ? spacing * (layout->size[f] - 1) : 0);
	}
	return grid_check(ret_grid, err);
}

/* ---- files, compressed by gzip or not ---- */

struct source {
	gzFile file; /* reads plain files as well */
	const char *path;
	size_t stored; /* bytes on the disk */
};

static int source_open(const char *path, struct source *ret, struct error *err)
{
	int file = regular_open(path, O_RDONLY, 0);
	struct stat status;

	*ret = (struct source){.path = path};
	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	if (fstat(file, &status) == 0 && S_ISREG(status.st_mode))
		ret->file = gzdopen(file, "rb");
	if (ret->file == NULL) {
		close(file);
		return error_set(err, ERR_IO, "%.200s cannot be read", path);
	}
	gzbuffer(ret->file, 1 << 17);
	ret->stored = (size_t)status.st_size;
	return 0;
}

/* As many as there are, up to `size`. */
static int source_read(const struct source *source, void *to, size_t size, size_t *ret_got, struct error *err)
{
	const size_t most = 1 << 30; /* of one call to zlib */
	size_t done = 0;

	while (done < size) {
		int got = gzread(source->file, (char *)to + done, (unsigned)(size - done < most ? size - done : most)),
		    number;

		if (got < 0)
			return error_set(err, ERR_INVALID, "%.200s cannot be read: %s", source->path,
					 gzerror(source->file, &number));
		if (got == 0)
			break;
		done += (size_t)got;
	}
	*ret_got = done;
	return 0;
}

static int source_read_all(const struct source *source, void *to, size_t size, struct error *err)
{
	size_t got = 0;
	int code = source_read(source, to, size, &got, err);

	if (code == 0 && got < size)
		code = error_set(err, ERR_INVALID, "%.200s: it ends %zu bytes before the last voxel", source->path,
				 size - got);
	return code;
}

/* The checksum behind the data is looked at when all has been read. */
static int source_end(const struct source *source, struct error *err)
{
	char more;
	size_t got;

	return gzdirect(source->file) ? 0 : source_read(source, &more, 1, &got, err);
}

/* The size is compared before anything is allocated: a header can promise anything. */
static int check_length(const struct source *source, const struct layout *layout, const struct grid *grid,
			struct error *err)
{
	const size_t deflate_most = 1032; /* bytes of a byte */
	size_t expected = layout->start + grid_voxels(grid) * pixel_bytes(layout->type);
	size_t most = gzdirect(source->file) ? source->stored : source->stored * deflate_most;

	if (most < expected)
		return error_set(err, ERR_INVALID, "%.200s: %zu bytes, at least %zu are expected", source->path,
				 source->stored, gzdirect(source->file) ? expected : expected / deflate_most);
	return 0;
}

/* Row after row, each voxel to its place. */
static int read_voxels(const struct source *source, const struct layout *layout, const struct grid *grid,
		       const struct turn *turn, float *ret_voxels, struct error *err)
{
	const size_t strides[3] = {1, (size_t)grid->size[0], (size_t)grid->size[0] * (size_t)grid->size[1]};
	size_t n[3], stride[3], first[3], bytes = pixel_bytes(layout->type);
	uint8_t *slice;
	float *stored;
	int code = 0;

	for (int f = 0; f < 3; f++) {
		n[f] = (size_t)layout->size[f];
		stride[f] = strides[turn->to[f]];
		first[f] = turn->flip[f] ? (n[f] - 1) * stride[f] : 0;
		stride[f] = turn->flip[f] ? 0 - stride[f] : stride[f]; /* modulo 2^64, as the sums below */
	}
	slice = malloc(n[0] * n[1] * bytes);
	stored = malloc(n[0] * sizeof(*stored));
	if (slice == NULL || stored == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a slice of %zu bytes", n[0] * n[1] * bytes);
	for (size_t z = 0; z < n[2] && code == 0; z++) {
		code = source_read_all(source, slice, n[0] * n[1] * bytes, err);
		for (size_t y = 0; y < n[1] && code == 0; y++) {
			size_t at = first[0] + first[1] + y * stride[1] + first[2] + z * stride[2];

			pixels_to_float(slice + y * n[0] * bytes, layout->type, false, n[0], stored);
			for (size_t x = 0; x < n[0]; x++)
				ret_voxels[at + x * stride[0]] =
				    (float)(layout->slope * (double)stored[x] + layout->offset);
		}
	}
	free(slice);
	free(stored);
	return code == 0 ? source_end(source, err) : code;
}

/* The beginning of the file, and what it says; `grid` is that of a raw one. */
static int read_head(const struct source *source, const struct grid *grid, struct layout *ret_layout, struct error *err)
{
	uint8_t *head = calloc(1, HEAD_BYTES);
	size_t got;
	int code = head == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a header") : 0;

	if (code == 0)
		code = source_read(source, head, HEAD_BYTES, &got, err);
	if (code == 0)
		code = read_header(head, HEAD_BYTES, ret_layout, grid, err);
	free(head);
	if (code == 0 && gzseek(source->file, (z_off_t)ret_layout->start, SEEK_SET) < 0)
		code = error_set(err, ERR_INVALID, "%.200s ends before its voxels", source->path);
	return code;
}

int volume_read(const char *path, struct grid *grid, double ret_axes[3][3], float **ret_voxels, struct error *err)
{
	struct source source;
	struct layout layout;
	struct turn turn;
	struct grid found;
	double axes[3][3];
	bool oblique = false;
	float *voxels = NULL;
	int code = source_open(path, &source, err);

	if (code != 0)
		return code;
	code = read_head(&source, grid, &layout, err);
	if (code == 0)
		code = layout_turn(&layout, &turn, axes, &oblique, err);
	if (code == 0 && oblique && ret_axes == NULL)
		code = error_set(err, ERR_INVALID, "the volume's axes do not lie along x, y and z");
	if (code == 0)
		code = layout_grid(&layout, &turn, axes, &found, err);
	if (code == 0)
		code = check_length(&source, &layout, &found, err);
	if (code != 0)
		goto out;
	voxels = malloc(grid_voxels(&found) * sizeof(*voxels));
	code = voxels == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", grid_voxels(&found))
			      : read_voxels(&source, &layout, &found, &turn, voxels, err);
	if (code == 0) {
		*grid = found;
		*ret_voxels = voxels;
		voxels = NULL;
		if (ret_axes != NULL)
			memcpy(ret_axes, axes, sizeof(axes));
	}
out:
	free(voxels);
	gzclose(source.file);
	return code;
}

/* ---- files of our own ---- */

static int own_extension(const uint8_t head[NIFTI_VOXELS], struct provenance *ret_provenance, struct error *err)
{
	const char *text = (const char *)head + NIFTI_EXTENSION_TEXT;
	size_t length = strnlen(text, NIFTI_VOXELS - NIFTI_EXTENSION_TEXT);
	cJSON *json = NULL;
	int code = json_parse(text, length, &json, err);

	if (code == 0)
		code = provenance_read(json, ret_provenance, err);
	cJSON_Delete(json);
	return code;
}

int volume_own_start(int file, const char *path, const struct grid *grid, size_t *ret_start, struct error *err)
{
	uint8_t head[NIFTI_PLAIN] = {0};
	struct stat status;
	double start;
	int code = 0;

	if (fstat(file, &status) != 0)
		return error_set_errno(err, errno, "%s cannot be read", path);
	if ((size_t)status.st_size >= sizeof(head))
		code = file_read_at(file, head, sizeof(head), 0, path, err);
	if (code != 0)
		return code;
	start = get_float(head + NIFTI_VOX_OFFSET);
	if (memcmp(head + NIFTI_MAGIC, "n+1", 4) != 0 || (start != NIFTI_PLAIN && start != NIFTI_VOXELS) ||
	    (size_t)status.st_size < (size_t)start + grid_voxels(grid) * sizeof(float))
		return error_set(err, ERR_INVALID,
				 "%.200s is damaged: its header or its length is not that of its volume", path);
	*ret_start = (size_t)start;
	return 0;
}

int volume_own_head(int file, const char *path, const struct grid *grid, size_t *ret_start,
		    struct provenance *ret_provenance, struct error *err)
{
	struct provenance provenance = {.patient = patient_unknown};
	uint8_t head[NIFTI_VOXELS];
	size_t start = 0;
	int code = volume_own_start(file, path, grid, &start, err);

	if (code == 0 && start == NIFTI_VOXELS) {
		code = file_read_at(file, head, sizeof(head), 0, path, err);
		if (code == 0)
			code = own_extension(head, &provenance, err);
		if (code != 0 && code != ERR_NO_MEMORY && code != ERR_IO)
			code = error_set(err, ERR_INVALID, "%.200s is damaged: its header cannot be read", path);
	}
	if (code != 0)
		return code;
	*ret_start = start;
	*ret_provenance = provenance;
	return 0;
}

/* A kept volume as a file of any format: content.h. */
#include "daemon/volumes/content.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/volumes/series.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"
#include "proto/zstream.h"

enum {
	CHUNK = 16384,            /* voxels converted at a time: fits the first two levels of cache */
	STREAM_BLOCK = 256 << 10, /* bytes given to the encoder at a time */
	STREAM_LEVEL = 1          /* higher ones cost 2 to 4 times the time for a few percent */
};

struct content {
	int descriptor;
	struct grid grid, scaled; /* of the file, and as it is sent */
	int factor[3];            /* voxels averaged along each axis */
	struct content_options options;
	struct provenance provenance; /* of DICOM; empty otherwise */
	uint8_t header[FORMAT_HEADER_MAX];
	size_t header_size;
	size_t start;   /* of the voxels in the file */
	bool as_stored; /* the header is that of the file */
	size_t voxel_bytes;
	float *rows;          /* [factor[1]][nx], for means */
	float voxels[CHUNK];  /* a piece of the scaled volume, 1/mm */
	int16_t units[CHUNK]; /* the same in HU */
	uint8_t *plane;       /* of the scaled volume in HU: [y][x] low bytes, [y][x] high ones; NULL: not wanted */
	int64_t plane_z;      /* -1: none yet */
};

static void scale_grid(struct content *content, int scale)
{
	struct grid *to = &content->scaled;
	const struct grid *from = &content->grid;

	*to = *from;
	for (int axis = 0; axis < 3; axis++) {
		/* A single slice stays one. */
		int factor = scale < from->size[axis] ? scale : from->size[axis];

		content->factor[axis] = factor;
		to->size[axis] = (from->size[axis] + factor - 1) / factor;
		to->spacing[axis] = from->spacing[axis] * factor;
		to->origin[axis] = from->origin[axis] + 0.5 * (factor - 1) * from->spacing[axis];
	}
}

static size_t plane_voxels(const struct content *content)
{
	return (size_t)content->scaled.size[0] * (size_t)content->scaled.size[1];
}

bool content_is_plain(const struct content *content)
{
	return content->options.type == VOLUME_FLOAT32 && content->options.scale == 1;
}

static int read_file(const struct content *content, uint64_t offset, void *to, size_t size)
{
	while (size > 0) {
		ssize_t got = pread(content->descriptor, to, size, (off_t)offset);

		if (got < 0 && errno == EINTR)
			continue;
		if (got <= 0)
			return -1;
		to = (char *)to + got;
		offset += (uint64_t)got;
		size -= (size_t)got;
	}
	return 0;
}

/* The origin is what the file itself says: the scan may be gone. */
static int make_header(struct content *content, const char *path, struct error *err)
{
	const struct content_options *options = &content->options;
	struct provenance provenance = {0};
	struct patient patient;
	uint8_t stored[VOLUME_FILE_OFFSET];
	int code = volume_own_head(content->descriptor, path, &content->grid, &content->start, &provenance, err);

	if (code != 0)
		return code;
	code = options->format->header(&content->scaled, options->type, &provenance, content->header,
				       &content->header_size, err);
	if (code == 0 && options->dicom && dicom_patient(&options->words, &provenance.patient, &patient, err) != 0) {
		const struct error cause = *err;

		/* Who asks for a volume can tell it; who sends one cannot. */
		code = cause.code;
		if (options->words.position < 0)
			error_set(err, code, "%s, or ask with position=HFS, or whichever it is", cause.text);
	}
	if (code == 0 && options->dicom)
		content->provenance = provenance;
	else
		provenance_clear(&provenance);
	/* A file from before there were extensions is sent with a header of today. */
	content->as_stored = code == 0 && content_is_plain(content) && options->format == volume_formats &&
			     content->start == content->header_size && content->header_size == sizeof(stored) &&
			     read_file(content, 0, stored, sizeof(stored)) == 0 &&
			     memcmp(stored, content->header, sizeof(stored)) == 0;
	return code;
}

bool content_is_packed(const struct content_options *options)
{
	return options->shuffled || options->dicom || options->format->gzip;
}

int content_open(const char *path, const struct grid *grid, const struct content_options *options,
		 struct content **ret_content, struct error *err)
{
	struct content *content = calloc(1, sizeof(*content));

	if (content == NULL) {
		cJSON_Delete(options->words.source);
		return error_set(err, ERR_NO_MEMORY, "no memory to read a volume");
	}
	content->grid = *grid;
	content->options = *options;
	content->voxel_bytes = volume_type_bytes(options->type);
	scale_grid(content, options->scale);
	content->descriptor = regular_open(path, O_RDONLY, 0);
	content->rows = malloc((size_t)content->factor[1] * (size_t)grid->size[0] * sizeof(float));
	content->plane_z = -1;
	if (options->shuffled)
		content->plane = malloc(2 * plane_voxels(content));
	if (content->descriptor < 0 || content->rows == NULL || (options->shuffled && content->plane == NULL)) {
		if (content->descriptor < 0 && errno == ENOENT) /* removed since its row was read */
			error_set(err, ERR_NOT_FOUND, "the volume is not there any more");
		else
			error_set_errno(err, errno, "open a volume");
		content_close(content);
		return err->code;
	}
	if (make_header(content, path, err) != 0) {
		content_close(content);
		return err->code;
	}
	*ret_content = content;
	return 0;
}

void content_close(struct content *content)
{
	if (content == NULL)
		return;
	if (content->descriptor >= 0)
		close(content->descriptor);
	free(content->rows);
	free(content->plane);
	provenance_clear(&content->provenance);
	cJSON_Delete(content->options.words.source);
	free(content);
}

uint64_t content_size(const struct content *content)
{
	return content->header_size + (uint64_t)grid_voxels(&content->scaled) * content->voxel_bytes;
}

int content_descriptor(const struct content *content, uint64_t *ret_offset)
{
	/* The file is a NIfTI; without its header it is raw. */
	if (!content_is_plain(content) || (!content->as_stored && content->header_size != 0))
		return -1;
	*ret_offset = content->header_size != 0 ? 0 : content->start;
	return fcntl(content->descriptor, F_DUPFD_CLOEXEC, 0);
}

static size_t smaller(size_t a, size_t b)
{
	return a < b ? a : b;
}

/* Part of a row of means: voxels x .. x + count - 1 of row (y, z). */
static int read_means(struct content *content, size_t x, size_t y, size_t z, size_t count, float *to)
{
	const int *factor = content->factor, *size = content->grid.size;
	size_t nx = (size_t)size[0], ny = (size_t)size[1], nz = (size_t)size[2], wx = (size_t)factor[0];
	size_t first_y = y * (size_t)factor[1], rows = smaller((size_t)factor[1], ny - first_y);
	size_t first_z = z * (size_t)factor[2], planes = smaller((size_t)factor[2], nz - first_z);

	memset(to, 0, count * sizeof(*to));
	for (size_t dz = 0; dz < planes; dz++) {
		uint64_t first = ((first_z + dz) * ny + first_y) * nx;

		if (read_file(content, content->start + first * sizeof(float), content->rows,
			      rows * nx * sizeof(float)) != 0)
			return -1;
		for (size_t dy = 0; dy < rows; dy++) {
			const float *row = content->rows + dy * nx;

			for (size_t i = 0; i < count; i++) {
				size_t end = smaller((x + i + 1) * wx, nx);

				for (size_t from = (x + i) * wx; from < end; from++)
					to[i] += row[from];
			}
		}
	}
	for (size_t i = 0; i < count; i++)
		to[i] /= (float)(planes * rows * smaller(wx, nx - (x + i) * wx));
	return 0;
}

/* Voxels first .. first + count - 1 of the scaled volume. */
static int read_voxels(struct content *content, uint64_t first, size_t count, float *to)
{
	size_t nx = (size_t)content->scaled.size[0], ny = (size_t)content->scaled.size[1];

	if (content->options.scale == 1)
		return read_file(content, content->start + first * sizeof(float), to, count * sizeof(float));
	while (count > 0) {
		size_t x = first % nx, y = first / nx % ny, z = first / nx / ny;
		size_t part = nx - x < count ? nx - x : count;

		if (read_means(content, x, y, z, part, to) != 0)
			return -1;
		first += part;
		to += part;
		count -= part;
	}
	return 0;
}

/* Bytes of the voxels, `offset` counted from the first. */
static ssize_t read_converted(struct content *content, uint64_t offset, char *to, size_t size)
{
	size_t bytes = content->voxel_bytes, part;

	for (size_t done = 0; done < size; done += part) {
		uint64_t first = (offset + done) / bytes;
		size_t skip = (size_t)((offset + done) % bytes);
		size_t count = smaller((skip + size - done + bytes - 1) / bytes, CHUNK);
		int16_t *units = content->units;

		part = smaller(count * bytes - skip, size - done);
		if (read_voxels(content, first, count, content->voxels) != 0)
			return -1;
		if (content->options.type == VOLUME_FLOAT32) {
			memcpy(to + done, (const char *)content->voxels + skip, part);
			continue;
		}
		if (part == count * bytes && (uintptr_t)(to + done) % sizeof(*units) == 0)
			units = (int16_t *)(void *)(to + done);
		volume_to_hu(content->voxels, count, content->options.mu_water, units);
		if (units == content->units)
			memcpy(to + done, (const char *)units + skip, part);
	}
	return (ssize_t)size;
}

/* The bytes apart. */
static void shuffle(const int16_t *restrict units, size_t count, uint8_t *restrict low, uint8_t *restrict high)
{
	enum { TURNS = 256 }; /* a constant number of them is what lets gcc vectorise at -O2 */
	size_t done = 0;

	for (; done + TURNS <= count; done += TURNS) {
		for (size_t i = 0; i < TURNS; i++)
			low[done + i] = (uint8_t)units[done + i];
		for (size_t i = 0; i < TURNS; i++)
			high[done + i] = (uint8_t)((uint16_t)units[done + i] >> 8);
	}
	for (; done < count; done++) {
		low[done] = (uint8_t)units[done];
		high[done] = (uint8_t)((uint16_t)units[done] >> 8);
	}
}

static int load_plane(struct content *content, uint64_t z)
{
	size_t count = plane_voxels(content), part;

	content->plane_z = -1;
	for (size_t done = 0; done < count; done += part) {
		part = smaller(CHUNK, count - done);
		if (read_voxels(content, z * count + done, part, content->voxels) != 0)
			return -1;
		volume_to_hu(content->voxels, part, content->options.mu_water, content->units);
		shuffle(content->units, part, content->plane + done, content->plane + count + done);
	}
	content->plane_z = (int64_t)z;
	return 0;
}

static ssize_t read_shuffled(struct content *content, uint64_t offset, uint8_t *to, size_t size)
{
	size_t bytes = 2 * plane_voxels(content), part;

	for (size_t done = 0; done < size; done += part) {
		uint64_t z = (offset + done) / bytes;
		size_t at = (size_t)((offset + done) % bytes);

		part = smaller(bytes - at, size - done);
		if (content->plane_z != (int64_t)z && load_plane(content, z) != 0)
			return -1;
		memcpy(to + done, content->plane + at, part);
	}
	return (ssize_t)size;
}

static ssize_t read_body(struct content *content, uint64_t offset, void *to, size_t size)
{
	if (content->options.shuffled)
		return read_shuffled(content, offset, to, size);
	if (content_is_plain(content))
		return read_file(content, content->start + offset, to, size);
	return read_converted(content, offset, to, size);
}

ssize_t content_read(struct content *content, uint64_t offset, void *to, size_t size)
{
	uint64_t whole = content_size(content);
	size_t head = 0;

	if (offset >= whole)
		return 0;
	if (size > whole - offset)
		size = (size_t)(whole - offset);
	if (offset < content->header_size) {
		head = content->header_size - (size_t)offset;
		if (head > size)
			head = size;
		memcpy(to, content->header + offset, head);
	}
	if (size > head && read_body(content, offset + head - content->header_size, (char *)to + head, size - head) < 0)
		return -1;
	return (ssize_t)size;
}

/* ---- compressed on the way ---- */

struct content_stream {
	struct content *content;
	struct zencoder *encoder;
	struct series *series; /* in place of the encoder */
	uint64_t offset;       /* of the content, read so far */
	size_t filled, used;
	bool ended;
	char block[STREAM_BLOCK];
};

/* Of whichever coding the options ask for. */
static int encoder_new(const struct content_options *options, int workers, struct zencoder **ret_encoder,
		       struct error *err)
{
	int code;

	if (options->format->gzip)
		return gzip_encoder_new(STREAM_LEVEL, ret_encoder, err);
	code = zencoder_new(STREAM_LEVEL, workers, ret_encoder, err);
	/* Whole units of noise hardly repeat: a wider search costs a quarter more for a hundredth of the bytes. */
	if (code == 0 && options->type == VOLUME_INT16)
		code = zencoder_look_near(*ret_encoder, err);
	return code;
}

int content_stream_new(struct content *content, int workers, struct content_stream **ret_stream, struct error *err)
{
	struct content_stream *stream = malloc(sizeof(*stream));

	if (stream == NULL) {
		content_close(content);
		return error_set(err, ERR_NO_MEMORY, "no memory to compress a volume");
	}
	*stream = (struct content_stream){.content = content};
	if (content->options.dicom ? series_new(content, &content->scaled, &content->provenance,
						&content->options.words, &stream->series, err) != 0
				   : encoder_new(&content->options, workers, &stream->encoder, err) != 0) {
		content_stream_free(stream);
		return err->code;
	}
	*ret_stream = stream;
	return 0;
}

void content_stream_free(struct content_stream *stream)
{
	if (stream == NULL)
		return;
	series_free(stream->series);
	content_close(stream->content);
	zencoder_free(stream->encoder);
	free(stream);
}

static int refill(struct content_stream *stream)
{
	ssize_t got = content_read(stream->content, stream->offset, stream->block, sizeof(stream->block));

	if (got < 0)
		return -1;
	stream->offset += (uint64_t)got;
	stream->filled = (size_t)got;
	stream->used = 0;
	return 0;
}

ssize_t content_stream_read(struct content_stream *stream, void *to, size_t size)
{
	size_t made = 0;
	struct error err;

	if (stream->series != NULL)
		return series_read(stream->series, to, size);
	/* The encoder gathers input before it gives anything; 0 would mean the end. */
	while (made == 0 && !stream->ended) {
		size_t consumed = 0, produced = 0;
		bool last;

		if (stream->used == stream->filled && refill(stream) != 0)
			return -1;
		last = stream->offset == content_size(stream->content);
		if (zencoder_step(stream->encoder, stream->block + stream->used, stream->filled - stream->used,
				  &consumed, last, to, size, &produced, &stream->ended, &err) != 0)
			return -1;
		stream->used += consumed;
		made += produced;
	}
	return (ssize_t)made;
}

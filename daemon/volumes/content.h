#ifndef CBCT_DAEMON_VOLUMES_CONTENT_H
#define CBCT_DAEMON_VOLUMES_CONTENT_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/types.h>

#include "proto/dicom.h"
#include "proto/format.h"

/*
 * A kept volume (NAME.nii, float32) as a file of any format, type and scale,
 * made while it is read and readable from any byte on. One thread at a time.
 */
struct content;

struct content_options {
	const struct volume_format *format;
	enum volume_type type;
	bool shuffled; /* raw int16 with bytes sorted: of each plane z the low bytes [y][x], then the high ones */
	bool dicom;    /* raw int16 as a ZIP of DICOM slices or one object; words tells the rest */
	struct dicom_words words; /* words.source is the content's, from content_open on, also where that fails */
	int scale;       /* 1: as it is; s: each voxel the mean of s x s x s, at the far ends of what is there */
	double mu_water; /* 1/mm, for Hounsfield units */
};
enum { CONTENT_SCALE_MAX = 16 };

/* Compressed or packed by what it is: no encoding is put over that, and it is a stream. */
bool content_is_packed(const struct content_options *options);

int content_open(const char *path, const struct grid *grid, const struct content_options *options,
		 struct content **ret_content, struct error *err);
void content_close(struct content *content); /* NULL is fine */

uint64_t content_size(const struct content *content);
/* Whether its voxels are the file's, byte for byte. */
bool content_is_plain(const struct content *content);
/* Fills `size` bytes from `offset` on, fewer at the end; -1 when the file cannot be read. */
ssize_t content_read(struct content *content, uint64_t offset, void *to, size_t size);

/* Where the content stands as it is in a file: a descriptor of the caller's own and its offset; -1 when it does not. */
int content_descriptor(const struct content *content, uint64_t *ret_offset);

/*
 * The content as one zstd frame, or as the gzip stream or the DICOM that its format is, in order; as content_read
 * otherwise. Takes the content, on failure too. workers: as of zencoder_new.
 */
struct content_stream;
int content_stream_new(struct content *content, int workers, struct content_stream **ret_stream, struct error *err);
void content_stream_free(struct content_stream *stream);
ssize_t content_stream_read(struct content_stream *stream, void *to, size_t size);

#endif

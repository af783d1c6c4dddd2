/*
 * Zstandard (RFC 8878) in pieces, for Content-Encoding: zstd, and gzip (RFC 1952) for files. The decoder
 * refuses frames whose window is beyond 8 MiB (RFC 9659), so that a sender
 * cannot choose how much memory we hold.
 */
#include "proto/zstream.h"

#include <limits.h>
#include <stdlib.h>
#define ZLIB_CONST /* next_in points to const */
#include <zlib.h>
#include <zstd.h>

enum {
	WINDOW_LOG_MAX = 23, /* 8 MiB */
	JOB_BYTES =
	    512 << 10 /* that one thread is given, the least there is: an encoder then holds 5 MB in place of 17 */
};

struct zdecoder {
	ZSTD_DCtx *context;
	bool ended;
};

struct zencoder {
	ZSTD_CCtx *context; /* NULL: gzip */
	z_stream gzip;
};

int zdecoder_new(struct zdecoder **ret_decoder, struct error *err)
{
	struct zdecoder *decoder = calloc(1, sizeof(*decoder));

	if (decoder == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a zstd decoder");
	decoder->context = ZSTD_createDCtx();
	if (decoder->context == NULL ||
	    ZSTD_isError(ZSTD_DCtx_setParameter(decoder->context, ZSTD_d_windowLogMax, WINDOW_LOG_MAX))) {
		zdecoder_free(decoder);
		return error_set(err, ERR_NO_MEMORY, "no memory for a zstd decoder");
	}
	*ret_decoder = decoder;
	return 0;
}

void zdecoder_free(struct zdecoder *decoder)
{
	if (decoder == NULL)
		return;
	ZSTD_freeDCtx(decoder->context);
	free(decoder);
}

int zdecoder_step(struct zdecoder *decoder, const void *in, size_t in_size, size_t *ret_consumed, void *out,
		  size_t out_size, size_t *ret_produced, bool *ret_ended, struct error *err)
{
	ZSTD_inBuffer input = {in, in_size, 0};
	ZSTD_outBuffer output = {out, out_size, 0};
	size_t hint = ZSTD_decompressStream(decoder->context, &output, &input);

	if (ZSTD_isError(hint))
		return error_set(err, ERR_INVALID, "the zstd data cannot be decoded: %s", ZSTD_getErrorName(hint));
	*ret_consumed = input.pos;
	*ret_produced = output.pos;
	/* A call that moves nothing asks for the next frame's header: that is no end, but none is lost either. */
	if (input.pos > 0 || output.pos > 0)
		decoder->ended = hint == 0;
	*ret_ended = decoder->ended;
	return 0;
}

int zencoder_new(int level, int workers, struct zencoder **ret_encoder, struct error *err)
{
	struct zencoder *encoder = calloc(1, sizeof(*encoder));

	if (encoder == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a zstd encoder");
	encoder->context = ZSTD_createCCtx();
	if (encoder->context == NULL ||
	    ZSTD_isError(ZSTD_CCtx_setParameter(encoder->context, ZSTD_c_compressionLevel, level)) ||
	    ZSTD_isError(ZSTD_CCtx_setParameter(encoder->context, ZSTD_c_checksumFlag, 1))) {
		zencoder_free(encoder);
		return error_set(err, ERR_NO_MEMORY, "no memory for a zstd encoder");
	}
	/* A library that was built without threads refuses, and does it all in ours. */
	if (workers > 0) {
		ZSTD_CCtx_setParameter(encoder->context, ZSTD_c_nbWorkers, workers);
		ZSTD_CCtx_setParameter(encoder->context, ZSTD_c_jobSize, JOB_BYTES);
	}
	*ret_encoder = encoder;
	return 0;
}

int zencoder_look_near(struct zencoder *encoder, struct error *err)
{
	enum { WINDOW_LOG = 17 /* 128 KiB: a block, the least that costs nothing */, HASH_LOG = 12 /* 16 KiB */ };

	if (ZSTD_isError(ZSTD_CCtx_setParameter(encoder->context, ZSTD_c_windowLog, WINDOW_LOG)) ||
	    ZSTD_isError(ZSTD_CCtx_setParameter(encoder->context, ZSTD_c_hashLog, HASH_LOG)))
		return error_set(err, ERR_INTERNAL, "zstd encoder: its window cannot be set");
	return 0;
}

void zencoder_free(struct zencoder *encoder)
{
	if (encoder == NULL)
		return;
	if (encoder->context == NULL)
		deflateEnd(&encoder->gzip);
	ZSTD_freeCCtx(encoder->context);
	free(encoder);
}

int gzip_encoder_new(int level, struct zencoder **ret_encoder, struct error *err)
{
	const int window_bits = 15 + 16; /* the largest, and gzip's wrapping */
	struct zencoder *encoder = calloc(1, sizeof(*encoder));

	if (encoder == NULL ||
	    deflateInit2(&encoder->gzip, level, Z_DEFLATED, window_bits, 8, Z_DEFAULT_STRATEGY) != Z_OK) {
		free(encoder);
		return error_set(err, ERR_NO_MEMORY, "no memory for a gzip encoder");
	}
	*ret_encoder = encoder;
	return 0;
}

static int gzip_step(z_stream *stream, const void *in, size_t in_size, size_t *ret_consumed, bool last, void *out,
		     size_t out_size, size_t *ret_produced, bool *ret_ended, struct error *err)
{
	unsigned given = in_size < UINT_MAX ? (unsigned)in_size : UINT_MAX;
	unsigned room = out_size < UINT_MAX ? (unsigned)out_size : UINT_MAX;
	int status;

	stream->next_in = (const Bytef *)in;
	stream->avail_in = given;
	stream->next_out = out;
	stream->avail_out = room;
	status = deflate(stream, last && given == in_size ? Z_FINISH : Z_NO_FLUSH);
	if (status != Z_OK && status != Z_STREAM_END && status != Z_BUF_ERROR) /* the last: there was nothing to do */
		return error_set(err, ERR_INTERNAL, "gzip encoder: status %d", status);
	*ret_consumed = given - stream->avail_in;
	*ret_produced = room - stream->avail_out;
	*ret_ended = status == Z_STREAM_END;
	return 0;
}

int zencoder_step(struct zencoder *encoder, const void *in, size_t in_size, size_t *ret_consumed, bool last, void *out,
		  size_t out_size, size_t *ret_produced, bool *ret_ended, struct error *err)
{
	ZSTD_inBuffer input = {in, in_size, 0};
	ZSTD_outBuffer output = {out, out_size, 0};
	size_t left;

	if (encoder->context == NULL)
		return gzip_step(&encoder->gzip, in, in_size, ret_consumed, last, out, out_size, ret_produced,
				 ret_ended, err);
	left = ZSTD_compressStream2(encoder->context, &output, &input, last ? ZSTD_e_end : ZSTD_e_continue);
	if (ZSTD_isError(left))
		return error_set(err, ERR_NO_MEMORY, "zstd encoder: %s", ZSTD_getErrorName(left));
	*ret_consumed = input.pos;
	*ret_produced = output.pos;
	*ret_ended = last && left == 0;
	return 0;
}

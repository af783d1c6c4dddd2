#ifndef CBCT_PROTO_ZSTREAM_H
#define CBCT_PROTO_ZSTREAM_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/* Content-Encoding: zstd, in pieces. One thread at a time. Window limited to 8 MiB as RFC 9659 asks. */
struct zdecoder;
int zdecoder_new(struct zdecoder **ret_decoder, struct error *err);
void zdecoder_free(struct zdecoder *decoder);
/*
 * Consumes from in, produces into out; both counts come back. *ret_ended at the
 * end of a frame; more frames may follow, so a body is whole when it holds after
 * the body's last byte. Go on while input is left or the output was filled.
 */
int zdecoder_step(struct zdecoder *decoder, const void *in, size_t in_size, size_t *ret_consumed, void *out,
		  size_t out_size, size_t *ret_produced, bool *ret_ended, struct error *err);

struct zencoder;
/* Another coding through the same steps: one gzip member (RFC 1952), without name and time, so that the same input
 * gives the same bytes. */
int gzip_encoder_new(int level, struct zencoder **ret_encoder, struct error *err);
/*
 * workers: threads of its own that compress while more is given, 0 none. The
 * frame depends on there being any, not on how many: with one, the same input in
 * the same pieces gives the same bytes as with two, for 2 to 3 MB less.
 */
int zencoder_new(int level, int workers, struct zencoder **ret_encoder, struct error *err);
/* Before the first step, of zstd: looks for repetitions only as far back as the nearest caches hold. */
int zencoder_look_near(struct zencoder *encoder, struct error *err);
void zencoder_free(struct zencoder *encoder);
/* last: no input after this; call until *ret_ended. */
int zencoder_step(struct zencoder *encoder, const void *in, size_t in_size, size_t *ret_consumed, bool last, void *out,
		  size_t out_size, size_t *ret_produced, bool *ret_ended, struct error *err);

#endif

#ifndef CBCT_PROTO_DIGEST_H
#define CBCT_PROTO_DIGEST_H

#include <stddef.h>
#include <stdint.h>

#include "proto/scan.h"

/*
 * SHA-256 digests as RFC 9530 writes them in Content-Digest, "sha-256=:BASE64:". Those below say what a volume was made
 * from (proto/provenance.h); anybody can compute them again.
 */
enum { DIGEST_BYTES = 32, DIGEST_TEXT_MAX = 64 };

/*
 * The library of digests prepares itself at its first use, once: where it gets no memory then, it has failed for good
 * in this process, and crashes where it is used all the same. So programs that last call this before there is any work.
 */
int digest_prepare(struct error *err);

void digest_text(const uint8_t sha256[DIGEST_BYTES], char ret_text[DIGEST_TEXT_MAX]);

/*
 * Digest of what a scan's document says of the measurement: its text as json_print writes it, without the members name,
 * labels, patient and study, which change no voxel and would tell something of the patient.
 */
int digest_scan(const struct scan *scan, char ret_text[DIGEST_TEXT_MAX], struct error *err);
/*
 * Digest over the projections' digests, [count][32] in the order of their numbers; 32 zero bytes stand for a projection
 * that the scan was completed without.
 */
int digest_projections(const uint8_t *sha256, int count, char ret_text[DIGEST_TEXT_MAX], struct error *err);
/* Digest of a recipe's text as json_print writes it. */
int digest_recipe(const cJSON *recipe, char ret_text[DIGEST_TEXT_MAX], struct error *err);

#endif

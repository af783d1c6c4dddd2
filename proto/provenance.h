#ifndef CBCT_PROTO_PROVENANCE_H
#define CBCT_PROTO_PROVENANCE_H

#include "core/scan/image.h"
#include "proto/digest.h"
#include "proto/scan.h"
#include "proto/version.h"

/* Where a volume comes from: what its file says beside the voxels. Texts that are "" are left out. */
struct provenance {
	struct patient patient;
	char program[40]; /* "cbctd 1.0.0", that made the voxels */
	char stage[16];   /* of the job that made it: "fdk", "sart" ... */
	int iteration;    /* with a stage only */
	char job[64], scan[64];
	char scan_name[SCAN_NAME_BYTES];
	char commit[64];               /* of the program's sources */
	char backend[16], device[128]; /* that computed the voxels */
	/* Digests of what the voxels were computed from (proto/digest.h), those of images as of their stored bytes. */
	char scan_digest[DIGEST_TEXT_MAX], projections_digest[DIGEST_TEXT_MAX], recipe_digest[DIGEST_TEXT_MAX];
	char image_digest[IMAGE_COUNT][DIGEST_TEXT_MAX];
	char scatter_digest[DIGEST_TEXT_MAX]; /* over those of the images of scatter */
	cJSON *recipe;                        /* as resolved; owned, or NULL */
};
#define CBCTD_PROGRAM "cbctd " CBCT_VERSION
#define CBCT_PROGRAM "cbct " CBCT_VERSION

void provenance_clear(struct provenance *provenance);

/*
 * The members of a file's description: program, unit, stage, iteration, job, scan,
 * scan_name, commit, backend, device, scan_digest, projections_digest, recipe_digest, images (name: digest),
 * left_right ("known", "not known"), patient, world_to_patient, recipe.
 * NULL for no memory. `unit` is of the voxels: "1/mm", "HU".
 */
cJSON *provenance_json(const struct provenance *provenance, const char *unit);
/* The other way round, strict in what says where left is; a member that is missing is not told. */
int provenance_read(const cJSON *json, struct provenance *ret_provenance, struct error *err);

/* "1/mm, left and right are not known, sart iteration 5, job ...": as many of these as there is room for. */
void provenance_sentence(const struct provenance *provenance, const char *unit, char *ret_text, size_t size);

/*
 * What the file of a volume says of where it comes from, whichever of our formats it has: NIfTI's extension, the keys
 * cbct_... of MetaImage and NRRD, also where gzip has packed it. ERR_INVALID where it says nothing. provenance_clear.
 * *ret_hu: its voxels are Hounsfield units, otherwise 1/mm.
 */
int provenance_of_file(const char *path, struct provenance *ret_provenance, bool *ret_hu, struct error *err);

/* JSON text with everything beyond ASCII as \uXXXX, for headers that know no other characters; free. */
char *provenance_text(const cJSON *json);

#endif

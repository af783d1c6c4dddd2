#ifndef CBCT_CLIENTS_IMPORT_VALUES_H
#define CBCT_CLIENTS_IMPORT_VALUES_H

#include <cjson/cJSON.h>

#include "clients/cbct/images.h"
#include "proto/scan.h"

/* The meaning of the numbers in images: the command line tells it, or they are looked at. */
struct import_values {
	int quantity, sample; /* enum quantity, enum sample, or unset */
	double air;           /* counts; NaN: not given */
	double saturation;    /* counts; NaN: not given */
	double air_region[4]; /* first column and row, last column and row; NaN: none */
	const char *flat, *dark, *defects;
	const char *hardening; /* "C0,C1,C2": p' = C0 + C1 p + C2 p^2 ..., NULL: none */
	const char *correct;   /* a file of members of projections, from cbct fit-...; NULL: none */
	double scale, bias;    /* a value is scale * stored + bias */
};
extern const struct option import_value_rows[];
#define IMPORT_VALUES_DEFAULTS                                                                                         \
	{                                                                                                              \
		.quantity = OPTION_UNSET_CHOICE, .sample = OPTION_UNSET_CHOICE, .air = OPTION_UNSET_NUMBER,            \
		.saturation = OPTION_UNSET_NUMBER, .air_region = {OPTION_UNSET_NUMBER}, .scale = 1                     \
	}

/* Member "projections" of a scan's document; the caller's. Looks through all images where it must. */
int import_values(const struct import_values *options, struct images *images, cJSON **ret_projections,
		  struct error *err);

/* Image `index` as the scan's samples; `pixels` is scratch of as many floats. ERR_IMPOSSIBLE for counts beyond uint16.
 */
int import_samples(const struct import_values *options, struct images *images, int index, enum sample sample,
		   float *pixels, void *ret_samples, struct error *err);

/* The mean of the images at `path`, which must be as large as the projections; [row][column]. */
int import_mean(const struct import_values *options, const struct image_options *how, const char *path,
		const struct images *like, float *ret_mean, struct error *err);

/* Where the image at `path` is not zero; raw ones are bytes. [row][column], 0 or 1. */
int import_defects(const struct image_options *how, const char *path, const struct images *like,
		   unsigned char *ret_defects, struct error *err);

#endif

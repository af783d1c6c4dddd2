/* Checks of a scan's images of its detector: see images.h. */
#include "core/correct/images.h"

#include <math.h>
#include <stdint.h>

#include "core/correct/defects.h"

/* A dark as far below 0, as a share of the flat, is no remainder of a subtracted offset. */
static const float NEGATIVE = 0.05f;
/* A dark above this share of the flat has light in it. */
static const float LIT = 0.5f;
/* A share of the flat's pixels at the largest number that some count of bits can hold. */
static const double FULL = 0.01;

/* A dark image whose flat is still to come. */
static int check_dark(const struct linearise *linearise, size_t pixels, struct error *err)
{
	size_t bad = 0;

	for (size_t i = 0; i < pixels; i++)
		bad += linearise_mapped(linearise, i) || !isfinite(linearise_counts(linearise, IMAGE_DARK, i, 0));
	if (2 * bad <= pixels)
		return 0;
	return error_set(err, ERR_IMPOSSIBLE,
			 "the dark image is not finite, or the pixel a defect of the map, in %.3g %% of the pixels: "
			 "half of them can be at most",
			 100 * (double)bad / (double)pixels);
}

int images_check(const struct linearise *linearise, int columns, int rows, const struct warning_sink *sink,
		 struct error *err)
{
	struct defect_map map;
	int code;

	if (linearise->image[IMAGE_DARK] != NULL && linearise->image[IMAGE_FLAT] == NULL && !(linearise->air > 0))
		return check_dark(linearise, (size_t)columns * (size_t)rows, err);
	code = defect_map_make(&map, linearise, columns, rows, err);
	if (code < 0)
		return code;
	defect_map_warn(&map, columns, rows, sink);
	defect_map_clear(&map);
	return 0;
}

/* The share of the flat's pixels that have the largest number of 8 bits or more, where that is the flat's maximum. */
static double full_share(const struct linearise *linearise, size_t pixels, float *ret_most)
{
	float most = 0;
	size_t full = 0;

	for (size_t i = 0; i < pixels; i++)
		most = fmaxf(most, linearise_counts(linearise, IMAGE_FLAT, i, 0));
	for (size_t i = 0; i < pixels; i++)
		full += linearise_counts(linearise, IMAGE_FLAT, i, 0) >= most;
	*ret_most = most;
	for (int bits = 8; bits <= 32; bits++)
		if (most == (float)(((uint64_t)1 << bits) - 1))
			return (double)full / (double)pixels;
	return 0;
}

void images_warn(const struct linearise *linearise, int columns, int rows, const struct warning_sink *sink)
{
	const size_t pixels = (size_t)columns * (size_t)rows;
	const bool has_flat = linearise->image[IMAGE_FLAT] != NULL;
	size_t negative = 0, lit = 0;
	float most;
	double share = 0;

	if (!has_flat && !(linearise->air > 0))
		return;
	for (size_t i = 0; linearise->image[IMAGE_DARK] != NULL && i < pixels; i++) {
		const float flat = fabsf(linearise_counts(linearise, IMAGE_FLAT, i, linearise->air));
		const float dark = linearise_counts(linearise, IMAGE_DARK, i, 0);

		negative += dark < -NEGATIVE * flat;
		lit += dark > LIT * flat;
	}
	if (2 * negative > pixels)
		warning_tell(
		    sink, "implausible_images",
		    "the dark image is below 0 by more than %g %% of the flat in %.3g %% of the pixels: all that "
		    "is measured becomes thinner by it, which is right only for counts that have a sign",
		    100 * (double)NEGATIVE, 100 * (double)negative / (double)pixels);
	if (2 * lit > pixels)
		warning_tell(
		    sink, "implausible_images",
		    "the dark image has more than %g %% of the flat in %.3g %% of the pixels: was there light?",
		    100 * (double)LIT, 100 * (double)lit / (double)pixels);
	if (has_flat)
		share = full_share(linearise, pixels, &most);
	if (share > FULL)
		warning_tell(
		    sink, "implausible_images",
		    "the flat image has the value %.10g, the largest of its kind, in %.3g %% of the pixels: is it "
		    "saturated?",
		    (double)most, 100 * share);
}

#ifndef CBCT_CORE_CORRECT_BINNING_H
#define CBCT_CORE_CORRECT_BINNING_H

#include "core/correct/defects.h"
#include "core/linearise.h"
#include "core/scan/geometry.h"

/*
 * Blocks of n x n pixels taken as one, on the host, before anything else happens to a view: everything behind goes by
 * the geometry of geometry_bin, as if the detector had such pixels.
 *
 * Counts are summed before the logarithm: the block's transmission is sum (I - dark) / sum (flat - dark) over its good
 * pixels, which few photons do not bias as the mean of their logarithms would be, and its sample is the one that has
 * this transmission between the means of dark and flat. Line integrals are averaged. Defects that map, images or stuck
 * pixels show are left out of a block, and so are samples that are saturated or not finite; a block of defects alone is
 * in the map itself, and one without a good sample is a defect of that view.
 */
struct binning {
	int n;             /* 1: views and images pass as they are, and nothing is owned */
	int columns, rows; /* of the detector */
	struct pixel_blocks blocks;
	struct defect_map found; /* among the detector's pixels, owned; empty where n is 1 */
	struct linearise given;  /* of the samples as they come, with that map where n is not 1 */
	struct linearise binned; /* of what binning_view returns; its images are owned */
	void *image[IMAGE_COUNT];
	float *view; /* [row][column] of blocks, owned */
};

/* How binned samples become line integrals: float32, with the saturation that there was. The images are the given ones.
 */
struct linearise binning_linearise(const struct linearise *linearise, int n);

/*
 * geometry is that of the detector as it is; linearise's images are borrowed. An air region becomes that of the blocks
 * within it, or of those it touches where it holds none. ERR_IMPOSSIBLE where most pixels are defects. Free with
 * binning_clear.
 */
int binning_open(struct binning *ret_binning, const struct linearise *linearise, const struct geometry *geometry, int n,
		 struct error *err);
void binning_clear(struct binning *binning);

/* The samples of a view as binning->binned describes them: valid until the next call. The same bits for any number of
 * threads. */
const void *binning_view(struct binning *binning, const void *samples);

#endif

#ifndef CBCT_CORE_NOISE_H
#define CBCT_CORE_NOISE_H

#include "core/correct/projection_noise.h"
#include "core/recon/recon.h"

/*
 * How noisy a volume is, and how strong its edges are (struct volume_noise), and the
 * balance of TV that follows from them. For core/ only.
 */

/* Slices that noise_measure looks at, at most: those in the middle of the volume. */
enum { NOISE_SLICES = 24 };

/*
 * Measures the noise of a volume's middle slices. All is 0 where nothing stands out of the background.
 * mu_water in 1/mm: what is metal beside it
 * is left out. sharp: 0 .. 1, how far the volume has edges as sharp as voxels, so that beside metal most places may
 * have one. The same voxels give the same bits, for any number of threads.
 */
int noise_measure(const struct backend *backend, struct volume *volume, const struct grid *grid, double mu_water,
		  double sharp, struct volume_noise *ret_noise, struct error *err);

/* Measures the noise of slices [z][y][x] in the host's memory. */
int noise_of_slices(const float *slices, const int size[3], double mu_water, double sharp,
		    struct volume_noise *ret_noise, struct error *err);

/*
 * Where voxels span more than 1.2 pixels, bone as thin as they are is in most places of a small head, and looks like
 * noise there. Noise of the projections, told beside the object, bounds it: true where so much was found beside the
 * contrast that it is worth a look at them; and the noise with that bound, for projections whose noise has this
 * variance and FDK whose filter has this response (filter.h, of a row of `length`).
 */
bool noise_is_doubtful(const struct volume_noise *noise, const struct recipe *recipe, const struct orbit *orbit);
struct volume_noise noise_bounded(const struct volume_noise *noise, const struct orbit *orbit, double variance,
				  const float *response, int length);

enum noise_stage { NOISE_OF_FDK, NOISE_OF_SART };
/*
 * The alpha of TV_PROXIMAL and TV_GENERALISED behind FDK or behind each SART iteration, in the recipe's gray levels and
 * of its strength; the recipe is resolved. INFINITY: no TV.
 */
double noise_alpha(const struct volume_noise *noise, const struct recipe *recipe, const struct orbit *orbit,
		   enum noise_stage stage);
/*
 * How far TV with these settings can move a voxel, in 1/mm, roughly: the minimisers by 1 / alpha, explicit steps by
 * their sum at most.
 */
double noise_reach(const struct tv_options *options);

#endif

#ifndef CBCT_CORE_RECON_INTERNAL_H
#define CBCT_CORE_RECON_INTERNAL_H

#include "core/fdk.h"
#include "core/recon/recon.h"

/* What recon.c and recon_plan.c share. */

/* Whether all projections are kept on the device, and not a batch of FDK's at a time. */
bool keeps_projections(const struct recipe *recipe);
/* Whether the recipe's algorithm is the backend's own update over ordered subsets. */
bool has_subsets(const struct recipe *recipe);

/* The recipe is resolved; everything that the options point to is the caller's. */
struct plan_options plan_options(const struct recipe *recipe, const struct geometry *geometry,
				 const struct linearise *linearise, const struct fdk_weights *weights,
				 const struct sart_options *sart);
/* Free with subsets_clear(&ret_sart->subsets). */
int sart_options_make(struct sart_options *ret_sart, const struct recipe *recipe, const struct orbit *orbit,
		      struct error *err);

/*
 * What the job takes, and on what: *ret_outofcore stays NULL where it fits as a
 * whole, otherwise it is the out-of-core device and the memory what that takes.
 */
int choose_device(const struct backend *backend, struct device *device, struct plan_options *options,
		  const struct recipe *recipe, const struct orbit *orbit, struct recon_memory *ret_memory,
		  struct device **ret_outofcore, struct error *err);

/*
 * The orbit, and the geometry that all goes by: FDK filters along the rows, so that
 * a detector that lies on its side has its rows and columns exchanged, in
 * *ret_upright. That stays as it is for any other.
 */
int stand_up(const struct geometry **geometry, struct geometry *ret_upright, struct orbit *ret_orbit,
	     struct error *err);

#endif

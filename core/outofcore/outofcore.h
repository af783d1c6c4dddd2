#ifndef CBCT_CORE_OUTOFCORE_H
#define CBCT_CORE_OUTOFCORE_H

#include "core/backend.h"

/*
 * A backend made of another one, for jobs that its device is too small for:
 * volumes and projections lie in the host's memory and go through the device in
 * slabs of slices and batches of views, copies beside work. The operations are
 * those of backend.h with two differences: `filter` only notes what is to be
 * filtered, `backproject` does it batch by batch (so its source must stay as it is
 * until then), and plan_batch is all views, so that FDK goes through the slabs once.
 *
 * plan_bytes takes as many slabs as the free memory of the device asks for and
 * says in `host` what the host must have. Results differ from those of the whole
 * by rounding only: a ray's integral is the sum of those through the slabs, each
 * between slices of zeros, for linear interpolation is linear.
 */
extern const struct backend backend_outofcore; /* count and open are NULL: outofcore_open */

/* Backend and device are borrowed; close with backend_outofcore.close, which leaves the other device open. */
int outofcore_open(const struct backend *backend, struct device *device, struct device **ret_device, struct error *err);

#endif

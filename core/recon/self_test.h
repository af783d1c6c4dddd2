#ifndef CBCT_CORE_RECON_SELF_TEST_H
#define CBCT_CORE_RECON_SELF_TEST_H

#include "core/backend.h"

/*
 * Tries a device: FDK and two iterations of a ball from its exact line integrals, twice. ERR_DEVICE with the numbers
 * where the two volumes differ in a bit, or the ball has not the density that it was made with; or the error that the
 * device gave. Takes some MiB and a fraction of a second. One thread.
 */
int device_self_test(const struct backend *backend, struct device *device, struct error *err);

#endif

#ifndef CBCT_CORE_FDK_H
#define CBCT_CORE_FDK_H

#include "core/backend.h"

/* The FDK stage of core/recon/recon.c, and nobody else's. */

/* Weights and responses that the backend's `filter` needs beside the projections. */
struct fdk_weights {
	float *columns;            /* [view][column], owned */
	float *response;           /* [length/2 + 1], owned */
	int pad[2];                /* orbit.pad */
	struct rotation_axis axis; /* plan_options.axis */
	int extend;                /* plan_options.extend */
	float *extended;           /* its response, owned; NULL without */
};

/* Free with fdk_weights_clear. */
int fdk_weights_make(struct fdk_weights *ret_weights, const struct orbit *orbit, const struct geometry *geometry,
		     enum window window, double cutoff, bool extend, struct error *err);
void fdk_weights_clear(struct fdk_weights *weights);

/*
 * The most views of a scan that are filtered and backprojected in one go; memory is counted with it before there is a
 * plan to ask. By 32 views the pass over the volume that a batch costs is long hidden behind the samples it takes; of
 * few views a batch is a quarter, for the memory that it takes, but at least 8. A backend that defers its filter (out
 * of core) takes all views in one go: its pass is over the host's memory.
 */
static inline int fdk_batch_most(int views)
{
	const int most = 32, least = 8, quarter = (views + 3) / 4;
	const int batch = quarter < least ? least : quarter < most ? quarter : most;

	return batch < views ? batch : views;
}

struct fdk {
	const struct backend *backend;
	struct plan *plan;      /* borrowed */
	struct stack *filtered; /* [batch][row][padded column], owned */
	int batch;              /* views in one go */
	int pending;            /* views that wait for their batch to be full */
	int *views, *slots;     /* [batch], of those, and where they lie; owned */
};

/* Views in one go for this plan and this many views; plan NULL: the most for any plan. */
int fdk_batch(const struct backend *backend, const struct plan *plan, int views);
int fdk_open(struct fdk *ret_fdk, const struct backend *backend, struct device *device, struct plan *plan,
	     const struct geometry *geometry, const int pad[2], struct error *err);
void fdk_clear(struct fdk *fdk);
/* Bytes that fdk_open takes of the device's memory, at most. */
size_t fdk_bytes(const struct backend *backend, const struct device *device, const struct geometry *geometry,
		 const int pad[2]);

/* Takes the view that lies in this slot of `from`; when the batch is full, fdk_flush. */
int fdk_add(struct fdk *fdk, int view, int slot, const struct stack *from, struct volume *to, struct error *err);
/* Filters what is pending and adds it to the volume. */
int fdk_flush(struct fdk *fdk, const struct stack *from, struct volume *to, struct error *err);

#endif

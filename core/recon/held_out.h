#ifndef CBCT_CORE_RECON_HELD_OUT_H
#define CBCT_CORE_RECON_HELD_OUT_H

#include "core/recon/recon.h"
#include "core/scan/orbit.h"

/*
 * Views that a volume is held against and that had no part in it.
 *
 * The residual of the views that made a volume falls with every iteration, whether the volume comes nearer to the
 * object or to their noise. One view of twenty, HELD_OUT_SHARE, spread evenly over the arc, is left out of FDK and of
 * the iterations like a view that shows nothing; what the volume says of it is a forecast. Where its residual is no
 * larger than that of the views beside it, which were used, the volume explains the object; where it is larger, the
 * volume fits noise or streaks, or the views contradict each other, as when the patient moved.
 *
 * Both residuals are || p - A v || / || p || of the volume as it is kept, against line integrals as FDK takes them:
 * what later corrections take out of the projections, such as matter outside of the grid, is in both. Projecting a
 * tenth of the views for each kept volume is what it costs, and a twentieth of the data: noise rises by 2.6 percent.
 */
#define HELD_OUT_SHARE 0.05
enum { HELD_OUT_SLOTS = 16 /* views that are projected in one go */ };

struct held_out;

/* Chooses the views. *ret_held_out stays NULL where the scan has fewer than three. */
int held_out_new(const struct orbit *orbit, const struct geometry *geometry, struct held_out **ret_held_out,
		 struct error *err);
void held_out_free(struct held_out *held_out); /* NULL is fine */
/* Bytes of the host's memory, at most. */
size_t held_out_bytes(const struct geometry *geometry);
/* True if the view has no part in the volume; false for NULL. */
bool held_out_has(const struct held_out *held_out, int view);

/*
 * Once all views have come: views that show nothing, blank[blanks], are held against no volume. Copies the line
 * integrals of the others, and those of as many views beside them, from a stack with a slot for each view.
 */
int held_out_take(struct held_out *held_out, const struct backend *backend, struct stack *projections, const int *blank,
		  int blanks, struct error *err);
/* The views that volumes are held against, behind held_out_take, and how many. */
const int *held_out_views(const struct held_out *held_out, int *ret_count);
/* Sets all of *ret_support but the shares. work: a stack of HELD_OUT_SLOTS slots. */
int held_out_measure(const struct held_out *held_out, const struct backend *backend, struct plan *plan,
		     struct volume *volume, struct stack *work, struct volume_support *ret_support, struct error *err);

#endif

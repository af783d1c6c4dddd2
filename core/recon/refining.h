#ifndef CBCT_CORE_REFINING_H
#define CBCT_CORE_REFINING_H

#include "core/recipe.h"
#include "core/refine/refine.h"

/* The views of a job that refines its geometry, in bins, until all have come. */
struct refining;

/* *ret_refining stays NULL where the recipe does not ask for it, or the scan has too few views or pixels. */
int refining_new(const struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit,
		 struct refining **ret_refining, struct error *err);
void refining_free(struct refining *refining); /* NULL is fine */
/* The memory that it takes, 0 where the recipe does not ask for it. */
int refining_bytes(const struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit,
		   const struct refine_device *on, struct refine_bytes *ret_bytes, struct error *err);
/* Takes a view's line integrals. NULL is fine. */
int refining_take(struct refining *refining, const struct backend *backend, struct stack *from, int slot, int view,
		  struct error *err);
/* Leaves views out that show nothing: once all have come. NULL is fine. */
void refining_leave_out(struct refining *refining, const int *blank, int blanks);
/* Of what the motions will be found from: refine_basis. */
uint64_t refining_basis(const struct refining *refining, const struct recipe *recipe, const struct orbit *orbit);
/* Finds the motions. */
int refining_find(const struct refining *refining, const struct recipe *recipe, const struct orbit *orbit,
		  const struct refine_device *on, const struct refine_reference *reference,
		  const struct refine_watch *watch, struct refinement *ret_refinement, struct error *err);
/* What that takes, in FDKs of the whole scan, roughly; 0 for NULL. */
int refining_work(const struct refining *refining, const struct grid *grid, int views, double *ret_work,
		  struct error *err);

#endif

/* Views on their way to the refinement of the geometry: see refining.h. */
#include "core/recon/refining.h"

#include <stdlib.h>

struct refining {
	enum refine_kind kind;
	bool is_referred;
	struct reduced reduced;
	float *view; /* [row][column], on its way into bins */
};

static bool is_wanted(const struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit)
{
	return (recipe->refine.geometry || recipe->refine.motion) &&
	       refine_is_possible(geometry, orbit, recipe->refine.reference[0] != '\0');
}

int refining_new(const struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit,
		 struct refining **ret_refining, struct error *err)
{
	struct refining *refining;
	int code;

	if (!is_wanted(recipe, geometry, orbit))
		return 0;
	refining = calloc(1, sizeof(*refining));
	if (refining == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to refine a geometry");
	refining->is_referred = recipe->refine.reference[0] != '\0';
	refining->kind = recipe->refine.motion ? REFINE_MOTION : REFINE_GEOMETRY;
	code = reduced_open(&refining->reduced, geometry, orbit, REFINE_VIEWS_MOST, REFINE_BINS_MOST, err);
	refining->view = malloc((size_t)geometry->columns * (size_t)geometry->rows * sizeof(float));
	if (code == 0 && refining->view == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a view");
	if (code < 0)
		refining_free(refining);
	else
		*ret_refining = refining;
	return code;
}

void refining_free(struct refining *refining)
{
	if (refining == NULL)
		return;
	reduced_clear(&refining->reduced);
	free(refining->view);
	free(refining);
}

int refining_bytes(const struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit,
		   const struct refine_device *on, struct refine_bytes *ret_bytes, struct error *err)
{
	struct refine_bytes bytes = {0};
	struct reduced reduced;
	int code;

	*ret_bytes = bytes;
	if (!is_wanted(recipe, geometry, orbit))
		return 0;
	code = reduced_open(&reduced, geometry, orbit, REFINE_VIEWS_MOST, REFINE_BINS_MOST, err);
	if (code < 0)
		return code;
	code = refine_bytes(&reduced, on, &bytes, err);
	if (recipe->refine.reference[0] != '\0')
		bytes.aside += REFERENCE_BYTES;
	bytes.aside += reduced_bytes(geometry, REFINE_VIEWS_MOST, REFINE_BINS_MOST) +
		       (size_t)geometry->columns * (size_t)geometry->rows * sizeof(float);
	if (code == 0)
		*ret_bytes = bytes;
	reduced_clear(&reduced);
	return code;
}

int refining_take(struct refining *refining, const struct backend *backend, struct stack *from, int slot, int view,
		  struct error *err)
{
	int code;

	if (refining == NULL || !reduced_wants(&refining->reduced, view))
		return 0;
	code = backend->stack_download(from, slot, 1, refining->view, err);
	if (code == 0)
		reduced_take(&refining->reduced, view, refining->view);
	return code;
}

void refining_leave_out(struct refining *refining, const int *blank, int blanks)
{
	for (int i = 0; i < blanks && refining != NULL; i++)
		reduced_leave_out(&refining->reduced, blank[i]);
}

uint64_t refining_basis(const struct refining *refining, const struct recipe *recipe, const struct orbit *orbit)
{
	return refine_basis(&refining->reduced, orbit, refining->kind, recipe->mu_water);
}

int refining_find(const struct refining *refining, const struct recipe *recipe, const struct orbit *orbit,
		  const struct refine_device *on, const struct refine_reference *reference,
		  const struct refine_watch *watch, struct refinement *ret_refinement, struct error *err)
{
	return refine_find(&refining->reduced, orbit, refining->kind, recipe->mu_water, on, reference, watch,
			   ret_refinement, err);
}

int refining_work(const struct refining *refining, const struct grid *grid, int views, double *ret_work,
		  struct error *err)
{
	double updates = 0;
	int code = refining == NULL
		       ? 0
		       : refine_work(&refining->reduced, refining->kind, refining->is_referred, &updates, err);

	if (code == 0)
		*ret_work = updates / ((double)grid_voxels(grid) * views);
	return code;
}

/* What a volume that is kept has, and the iterate has not: slices, the rim and the means, each by its own file. */
#include "core/recon/internal.h"
#include "core/recon/thin.h"
#include "core/recon/warn.h"

static int measure(struct recon *recon, struct volume_norms *ret_norms, struct error *err)
{
	return recon->backend->norms(recon->plan, recon->volume, NULL, recon->recipe.tv.options.unit, ret_norms, err);
}

/* An iterate without what alternates from slice to slice unseen; `before`, which no iteration reads, has the iterate.
 */
static int show_smoothed(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	struct alternation_report report = {0};
	int code;

	if (recon->alternation == NULL || recon->iteration == 0)
		return 0;
	code = recon->backend->volume_copy(recon->before, recon->volume, err);
	if (code == 0)
		code = alternation_show(recon->alternation, recon->backend, recon->volume, &report, err);
	recon->smoothed = report.much;
	if (code == 0 && report.much)
		code = measure(recon, norms, err);
	if (code == 0 && recon->ended)
		warn_alternation(&recon->warnings, &recon->recipe, &report);
	return code;
}

/* An iterate of slices thinner than rows are apart, without the rows; `before`, which no iteration reads, has the
 * iterate. */
static int show_thick(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	const double width = thin_width(&recon->recipe, &recon->orbit);
	int code = 0;

	if (width == 0 || recon->iteration == 0)
		return 0;
	if (recon->alternation == NULL)
		code = recon->backend->volume_copy(recon->before, recon->volume, err);
	if (code == 0)
		code = thin_show(width, recon->backend, recon->before, recon->volume, &recon->recipe.grid, err);
	recon->smoothed = true;
	if (code == 0)
		code = measure(recon, norms, err);
	if (code == 0 && recon->ended)
		warn_thin(&recon->warnings, width);
	return code;
}

/* The rim of the field of view as it is kept; `before`, which no iteration reads, has the iterate. */
static int show_rim(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	bool changed = false;
	int code = 0;

	if (rim_state_bytes(recon->rim) == 0 || recon->iteration == 0)
		return 0;
	if (recon->alternation == NULL && !recon->smoothed)
		code = recon->backend->volume_copy(recon->before, recon->volume, err);
	if (code == 0)
		code = rim_show(recon->rim, recon->backend, recon->volume, &changed, err);
	recon->smoothed = recon->smoothed || changed;
	return code == 0 && changed ? measure(recon, norms, err) : code;
}

/* An iterate as near to its start as it has to be; `before`, which no iteration reads, has the iterate. */
static int show_restrained(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	struct restraint_report report = {0};
	int code = 0;

	if (restraint_state_bytes(recon->restraint) == 0 || recon->iteration == 0)
		return 0;
	if (recon->alternation == NULL && !recon->smoothed)
		code = recon->backend->volume_copy(recon->before, recon->volume, err);
	if (code == 0)
		code = restraint_show(recon->restraint, recon->backend, recon->volume,
				      recon->left_out_dense ? &recon->corrections : NULL, &report, err);
	recon->smoothed = recon->smoothed || report.changed;
	if (code == 0 && report.changed)
		code = measure(recon, norms, err);
	if (code == 0 && recon->ended)
		warn_restraint(&recon->warnings, &recon->recipe, &report);
	return code;
}

/* An iterate with FDK's means over voxels; `before`, which no iteration reads, has the iterate. */
static int show_means(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	int code = 0;

	if (!means_there(recon->means) || recon->left_out_dense || recon->iteration == 0)
		return 0;
	if (recon->alternation == NULL && !recon->smoothed)
		code = recon->backend->volume_copy(recon->before, recon->volume, err);
	if (code == 0)
		code = means_show(recon->means, recon->volume, err);
	recon->smoothed = true;
	return code == 0 ? measure(recon, norms, err) : code;
}

/* An iterate without stripes that FDK has none of; `before`, which no iteration reads, has the iterate. */
static int show_stripes(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	struct stripes_report report = {0};
	int code = 0;

	if (recon->stripes == NULL || recon->iteration == 0)
		return 0;
	if (recon->alternation == NULL && !recon->smoothed)
		code = recon->backend->volume_copy(recon->before, recon->volume, err);
	if (code == 0)
		code = stripes_show(recon->stripes, recon->backend, recon->volume, &report, err);
	recon->smoothed = recon->smoothed || report.changed;
	if (code == 0 && report.changed)
		code = measure(recon, norms, err);
	if (code == 0 && recon->ended)
		warn_stripes(&recon->warnings, &recon->recipe, &report);
	return code;
}

/* The end slices of an iterate as they are kept; the last one's are told of where they are uncertain. */
static int show_ends(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	struct ends_report report = {0};
	int code = 0;

	if (recon->ends != NULL && recon->iteration > 0)
		code = ends_show(recon->ends, recon->backend, recon->volume, &report, err);
	if (code == 0 && report.changed)
		code = measure(recon, norms, err);
	if (code == 0 && recon->ended)
		warn_ends(&recon->warnings, &recon->recipe, &report);
	return code;
}

int recon_show(struct recon *recon, struct volume_norms *norms, struct error *err)
{
	int code = show_smoothed(recon, norms, err);

	if (code == 0)
		code = show_thick(recon, norms, err);
	if (code == 0)
		code = show_restrained(recon, norms, err);
	if (code == 0)
		code = show_means(recon, norms, err);
	if (code == 0)
		code = show_rim(recon, norms, err);
	if (code == 0)
		code = show_stripes(recon, norms, err);
	return code == 0 ? show_ends(recon, norms, err) : code;
}

int recon_hide(struct recon *recon, struct error *err)
{
	int code = corrections_hide(&recon->corrections, err);

	if (code == 0 && recon->ends != NULL)
		code = ends_hide(recon->ends, recon->backend, recon->volume, err);
	if (code == 0 && recon->smoothed)
		code = recon->backend->volume_copy(recon->volume, recon->before, err);
	recon->smoothed = false;
	return code;
}

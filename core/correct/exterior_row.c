/* The exterior as a correction: see exterior.h. */
#include <math.h>

#include "core/correct/blank.h"
#include "core/correct/dense.h"
#include "core/correct/exterior.h"
#include "core/correct/input.h"
#include "core/correct/truncated.h"

struct exterior_volume_options exterior_options_of(const struct correction_job *job)
{
	return (struct exterior_volume_options){
	    .backend = job->backend,
	    .device = job->device,
	    .geometry = job->geometry,
	    .orbit = job->orbit,
	    .grid = &job->recipe->grid,
	    .plan = job->plan,
	    .projections = job->projections,
	    .factor = blank_factor(job),
	    .blank = job->input->blank,
	    .blanks = job->input->counts.blank,
	    .poor = !orbit_fdk_is_sound(job->orbit),
	    .dense = job->dense,
	    .cancel = job->cancel,
	};
}

static bool wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->algorithm != NULL;
}

static int bytes_of(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	const struct exterior_volume_options options = {.backend = ask->backend,
							.device = ask->device,
							.geometry = ask->geometry,
							.orbit = ask->orbit,
							.grid = &ask->recipe->grid};
	struct exterior_volume_bytes own;
	int code = exterior_volume_bytes(&options, &own, err);

	if (code < 0)
		return code;
	bytes->device += own.device;
	bytes->borrowed += own.borrowed;
	bytes->host += own.host;
	if (ask->recipe->fdk.on && orbit_fdk_is_sound(ask->orbit))
		bytes->aside += grid_voxels(&ask->recipe->grid) * sizeof(float);
	return 0;
}

/* The steps of exterior.h, which change the projections; *ret_rows are those concerned, *ret_taken: so is what lies
 * outside of the grid. */
static int subtract(const struct correction_job *job, const struct exterior_volume_options *options,
		    const struct exterior_rows *seen, struct exterior_volume *exterior, struct exterior_rows *ret_rows,
		    bool *ret_taken, struct error *err)
{
	const struct recipe *recipe = job->recipe;
	struct exterior_rows rows = {0};
	int steps = EXTERIOR_OUTSIDE | (recipe->fdk.extend ? EXTERIOR_BEYOND : 0), code = 0;

	if (seen->truncated > 0 && recipe->fdk.on && !options->poor)
		code = exterior_within_make(exterior, options, seen,
					    !job->orbit->arc_too_short && job->dense->traces_count == 0, job->fdk,
					    job->work, err);
	if (code == 0 && exterior->goes_on && seen->truncated > 0 && !options->poor) {
		code = exterior_subtract(exterior, options, EXTERIOR_BEYOND, seen, job->work, &rows, err);
		steps = EXTERIOR_OUTSIDE;
	}
	if (code == 0 && exterior->goes_on)
		code = exterior_volume_fit(exterior, options, err);
	/* Of few photons rows count one by chance. What is only possible is left alone where the fit does not find it.
	 */
	if (code == 0 && seen->certain == 0 && seen->truncated == 0 &&
	    !(exterior->goes_on && exterior_volume_has_outside(exterior, options->grid)))
		steps = 0;
	if (code < 0 || steps == 0) {
		*ret_rows = rows;
		return code;
	}
	code = exterior_subtract(exterior, options, steps, seen, job->work, &rows, err);
	*ret_taken = exterior->goes_on;
	/* What the model has beside the field of view, and where not all views see, may all be in the grid. */
	if (code == 0 && !exterior->goes_on && options->truncated)
		code = exterior_volume_sample(exterior, options->grid, job->work, err);
	/* Iterations without FDK start from zero. */
	if (code == 0 && (exterior->goes_on || options->truncated) && recipe->fdk.on && *job->iteration == 0)
		code = exterior_start(exterior, options, job->work, job->volume, err);
	if (code == 0 && exterior->within != NULL)
		code = exterior_within_fill(exterior, options->grid, err);
	if (code == 0)
		*ret_rows = rows;
	return code;
}

static void warn_of_outside(const struct correction_job *job, size_t rows)
{
	const double all = (double)job->geometry->count * job->geometry->rows;

	if (rows > 0)
		warning_tell(
		    job->warnings, "outside_grid",
		    "the object goes on outside of the grid: what the projections show of that was taken out of %.3g "
		    "%% of the %ss for SART",
		    100 * (double)rows / all, truncated_row_name(job));
}

/* The distance of the grid's farthest side from the axis, mm. */
static double reach_of(const struct grid *grid, const struct orbit *orbit)
{
	double farthest = 0;

	for (int side = 0; side < 4; side++) {
		const int axis = side / 2;
		double place[3];

		for (int a = 0; a < 3; a++)
			place[a] = grid->origin[a] + grid->spacing[a] * (grid->size[a] - 1) / 2;
		place[axis] += (side % 2 ? 0.5 : -0.5) * grid->spacing[axis] * grid->size[axis];
		farthest = fmax(farthest, orbit_from_axis(orbit, place));
	}
	return farthest;
}

static bool ends_with_view(const struct grid *grid, const struct orbit *orbit)
{
	const double beyond = 1.04;

	return reach_of(grid, orbit) <= beyond * orbit->field_of_view / 2;
}

/*
 * Where the object goes on beside the field of view and the grid does, too, iterations from zero spread the object over
 * all of the grid that a ray meets. Those that begin with FDK have it in its place from the first one on
 * (tests/bench/results/truncation.txt).
 */
static void warn_of_zero(const struct correction_job *job)
{
	const struct grid *grid = &job->recipe->grid;

	if (!ends_with_view(grid, job->orbit))
		warning_tell(
		    job->warnings, "faint_from_zero",
		    "the object reaches beyond the detector, and the grid (%.4g mm from the axis) beyond the "
		    "field of view (%.4g mm): iterations from zero put a part of the object there, and HU "
		    "within are wrong by some tens to hundreds. Begin with the FDK volume (\"fdk\": {}), or end "
		    "the grid with the field of view",
		    reach_of(grid, job->orbit), job->orbit->field_of_view / 2);
}

/* What the projections show of the exterior: which rows count it, and the model of it that they ask for. */
static int look(const struct correction_job *job, struct exterior_volume_options *options,
		struct exterior_rows *ret_seen, struct error *err)
{
	const bool sound = !options->poor, fdk = job->recipe->fdk.on;
	struct exterior_rows seen;
	int code = exterior_look(options, &seen, err);

	if (code < 0)
		return code;
	/* Rows that are cut off may be wanted as they are; what lies outside of the grid is another matter. */
	if (!job->recipe->fdk.extend) {
		seen.truncated = 0;
		seen.last = -1;
	}
	/* From zero, iterations take too long to fill what is held beside the field of view where the grid has that. */
	options->truncated = seen.truncated > 0 && sound && fdk;
	options->fine_slices = seen.truncated > 0 && sound;
	/*
	 * An object may end inside of the grid: FDK's blur beyond its faces is none of the object. One that truncates
	 * rows up to both ends goes on beyond them, though no ray that is seen may leave the grid.
	 */
	options->inside_only = seen.outside == 0 && !seen.possible && !(options->truncated && seen.to_ends);
	options->truncated = options->truncated && !options->inside_only;
	*ret_seen = seen;
	return 0;
}

static bool shows_nothing(const struct exterior_rows *seen)
{
	return seen->truncated + seen->outside == 0 && !seen->possible;
}

/* The model of the exterior without what is very dense; *ret_seen may show nothing then, and there is none. */
static int make(const struct correction_job *job, struct exterior_volume_options *options,
		struct exterior_volume *exterior, struct exterior_rows *ret_seen, struct error *err)
{
	bool filled = false;
	int code = exterior_volume_make(exterior, options, err);

	if (code == 0 && !options->poor)
		code = dense_take_outside(job, exterior, &filled, err);
	if (code < 0 || !filled)
		return code;
	exterior_volume_clear(exterior);
	code = look(job, options, ret_seen, err);
	return code == 0 && !shows_nothing(ret_seen) ? exterior_volume_make(exterior, options, err) : code;
}

/* Slices with places that not all views see have begun with the model of the exterior there, and not with FDK alone. */
static int renew_unseen(const struct correction_job *job, struct error *err)
{
	const struct grid *grid = &job->recipe->grid;
	int unseen[2], code = orbit_unseen_slices(job->orbit, job->geometry, grid, unseen, err);

	if (code == 0)
		code = job->wide(job->wide_context, 0, unseen[0], err);
	return code == 0 ? job->wide(job->wide_context, grid->size[2] - unseen[1], unseen[1], err) : code;
}

/*
 * The exterior is found from the projections alone, so that a run that goes on from an iterate gives the same bits.
 * `work` holds the iterate before the iteration, which the first iteration writes anyway.
 */
static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	const bool sound = orbit_fdk_is_sound(job->orbit), fdk = job->recipe->fdk.on;
	struct exterior_volume_options options = exterior_options_of(job);
	struct exterior_volume *exterior = job->exterior;
	struct exterior_rows seen, rows = {0};
	bool taken = false;
	int code = look(job, &options, &seen, err);

	(void)state;
	(void)time;
	(void)ret_changed;
	if (code < 0 || shows_nothing(&seen))
		return code;
	if (!sound && !fdk && seen.truncated > 0)
		warning_tell(job->warnings, "truncated",
			     "the object reaches beyond the detector, and FDK of this orbit is too poor to take that "
			     "out of the projections: SART piles it up in the grid");
	if (!sound && !fdk && seen.outside == 0 && !seen.possible)
		return 0;
	code = make(job, &options, exterior, &seen, err);
	if (code < 0 || shows_nothing(&seen)) {
		exterior_volume_clear(exterior);
		return code;
	}
	if (options.truncated && *job->iteration == 0)
		code = job->wide(job->wide_context, 0, options.grid->size[2], err);
	if (code == 0)
		code = subtract(job, &options, &seen, exterior, &rows, &taken, err);
	if (code == 0 && options.truncated && *job->iteration == 0)
		code = renew_unseen(job, err);
	if (code == 0 && !fdk && sound && job->recipe->fdk.extend &&
	    truncated_warn(job, exterior->truncated, job->geometry->columns))
		warn_of_zero(job);
	if (code == 0 && options.truncated)
		*job->settled = fmin(*job->settled, EXTERIOR_SETTLED);
	if (rows.outside + rows.truncated > 0)
		*job->outside = true;
	/* Beside truncated rows others are taken for such by chance, of few photons, and what is taken out of them is
	 * noise.
	 */
	if (code == 0 && (seen.certain > 0 || exterior_volume_has_outside(exterior, options.grid)))
		warn_of_outside(job, rows.outside);
	if (code == 0 && (taken || exterior->within != NULL))
		exterior_volume_leave_device(exterior);
	else
		exterior_volume_clear(exterior);
	return code;
}

extern const struct correction correction_exterior;
const struct correction correction_exterior = {
    .name = "exterior",
    .summary = "what lies outside of the grid is taken out of the projections before an iteration sees them",
    .times = 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_WHOLE_IMAGES | NEEDS_ALL_VIEWS,
    .wanted = wanted,
    .bytes = bytes_of,
    .apply = apply,
};

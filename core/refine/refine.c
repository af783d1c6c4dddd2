/* Registration of the views with a volume of the others, in turn with its reconstruction: see refine.h. */
#include "core/refine/refine.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/refine/registration.h"

enum { VIEWS_LEAST = 48, BINS_LEAST = 24, LEVELS = 2, BINS_COARSE = REFINE_BINS_MOST / 2 };
static const double PI = 3.14159265358979323846;
static const double ARC_LEAST = 2.8;   /* radians */
static const double KNOTS_APART = 0.7; /* radians, at first */
/* What an iteration with TV, and a step of the path, take, in FDKs of the bins: for the progress bar. */
enum { ITERATION_WORK = 5, STEP_WORK = 10 };
/*
 * Iterations before the first step; steps with the same knots; how often these are doubled; and over how many bins what
 * the volume lacks is alike (registration_options).
 */
static const struct schedule {
	int warm, steps, doublings;
	double alike;
} schedules[REFINE_KINDS][LEVELS] =
    {
	[REFINE_GEOMETRY] = {{4, 5, 1, 400}, {2, 5, 0, 400}},
	[REFINE_MOTION] = {{4, 5, 2, 100}, {2, 5, 0, 100}},
},
  alone = {4, 5, 2, 100}, /* of a scan that has few bins */
    referred[LEVELS] = {{0, 4, 1, 100}, {0, 4, 0, 100}};
/*
 * What a path must reach to be kept: the share by which held-out views are explained better, the share of these views
 * that are, and the path's size in bins. Of 17 paths that were found where nothing is to be found one passed the first,
 * by a tenth (tests/bench/results/refine.txt).
 */
static const double BETTER[REFINE_KINDS] = {[REFINE_GEOMETRY] = .003, [REFINE_MOTION] = .02};
static const double BETTER_VIEWS = 0.65, SIZE_LEAST = 0.055;
/*
 * And how much alike a reference's detail must be: a volume of another object leaves the views explained better in some
 * place, too.
 */
static const double ALIKE_LEAST = 0.7;

struct run {
	const struct refine_watch *watch;
	double work_all, work_done, unit; /* updates of a voxel by a view; unit: of one FDK of the level */
	double *squares[2]; /* [views], of held-out ones: what is unexplained without motion, and with it */
	const struct refine_reference *reference;
	struct grid grid;  /* of the coarser level's volumes, */
	float *volumes[2]; /* without motion and with it; NULL on the first level */
};

bool refine_is_possible(const struct geometry *geometry, const struct orbit *orbit, bool is_referred)
{
	return geometry->count >= (is_referred ? VIEWS_LEAST / 2 : VIEWS_LEAST) && geometry->columns >= BINS_LEAST &&
	       geometry->rows >= BINS_LEAST && orbit->arc >= (is_referred ? ARC_LEAST / 2 : ARC_LEAST) &&
	       orbit->field_of_view > 0 && (is_referred || !orbit->displaced);
}

double refine_place(const struct orbit *orbit, int view)
{
	const double turn = (orbit->angle[view] - orbit->angle[orbit->first]) * (orbit->direction < 0 ? -1 : 1);

	return turn < -1e-9 ? turn + 2 * PI : fmax(0, turn);
}

void refine_change(enum refine_kind kind, const struct view *view, const double motion[PATH_NUMBERS],
		   double ret_change[PATH_NUMBERS])
{
	/* What moves with the arm and stood at the isocentre. */
	const struct view origin = {.source = {0}}, moved = view_of_moved(&origin, motion);
	double axes[3][3];

	if (kind == REFINE_MOTION) {
		memcpy(ret_change, motion, PATH_NUMBERS * sizeof(*ret_change));
	} else {
		view_axes(view, axes);
		for (int a = 0; a < 3; a++) {
			ret_change[a] = vec_dot(axes[a], moved.source);
			ret_change[3 + a] = -vec_dot(axes[a], motion + 3);
		}
	}
	for (int a = 3; a < PATH_NUMBERS; a++)
		ret_change[a] *= 180 / PI;
}

/* FNV-1a (Fowler, Noll and Vo), of 64 bits. */
static uint64_t hash(uint64_t before, const void *data, size_t size)
{
	const unsigned char *bytes = data;

	for (size_t i = 0; i < size; i++)
		before = (before ^ bytes[i]) * 1099511628211u;
	return before;
}

uint64_t refine_basis(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water)
{
	const struct geometry *geometry = &reduced->geometry;
	const size_t count = (size_t)geometry->count, bins = (size_t)geometry->columns * (size_t)geometry->rows;
	uint64_t basis = hash(14695981039346656037u, &kind, sizeof(kind));

	basis = hash(basis, &mu_water, sizeof(mu_water));
	basis = hash(basis, geometry->views, count * sizeof(*geometry->views));
	basis = hash(basis, reduced->views, count * sizeof(*reduced->views));
	basis = hash(basis, reduced->known, count * sizeof(*reduced->known));
	basis = hash(basis, reduced->projections, count * bins * sizeof(*reduced->projections));
	return hash(basis, orbit->angle, (size_t)orbit->count * sizeof(*orbit->angle));
}

/* ---- levels ---- */

/* The last level has the bins that are there, the first one those of twice their size, where they are many enough. */
static int levels_of(const struct reduced *reduced)
{
	const int columns = reduced->geometry.columns, rows = reduced->geometry.rows;

	return (columns > BINS_COARSE || rows > BINS_COARSE) && columns >= 2 * BINS_LEAST && rows >= 2 * BINS_LEAST
		   ? LEVELS
		   : 1;
}

static const struct schedule *schedule_of(const struct reduced *reduced, int level, enum refine_kind kind,
					  bool is_referred)
{
	if (is_referred)
		return &referred[level];
	return levels_of(reduced) == 1 ? &alone : &schedules[kind][level];
}

static struct registration_options options_of(const struct reduced *reduced, const struct reduced *half, int level,
					      enum refine_kind kind, bool is_referred)
{
	const struct geometry *geometry = &reduced->geometry;
	const bool is_coarse = level + 1 < levels_of(reduced);
	const bool is_fine = geometry->columns > BINS_COARSE || geometry->rows > BINS_COARSE;

	return (struct registration_options){.reduced = is_coarse ? half : reduced,
					     .kind = kind,
					     .mu_water = 1,
					     .alike = schedule_of(reduced, level, kind, is_referred)->alike,
					     .referred = is_referred,
					     .bins = is_fine && !is_coarse ? REFINE_BINS_MOST : BINS_COARSE};
}

/* FDKs of a level. */
static int work_of(const struct schedule *schedule, bool is_referred)
{
	const int steps = schedule->steps * (1 + schedule->doublings);

	return (is_referred ? 0 : 2 * (schedule->warm + steps) * ITERATION_WORK) + steps * STEP_WORK;
}

int refine_bytes(const struct reduced *reduced, const struct refine_device *on, struct refine_bytes *ret_bytes,
		 struct error *err)
{
	struct refine_bytes bytes = {0};
	struct reduced half = {0};
	int code = reduced_halve(reduced, &half, err);

	for (int level = 0; level < levels_of(reduced) && code == 0; level++) {
		struct registration_options options = options_of(reduced, &half, level, REFINE_GEOMETRY, false);

		options.on = on;
		options.empty = options.wide = true;
		code = registration_add_bytes(&options, &bytes, err);
	}
	if (code == 0)
		*ret_bytes = bytes;
	reduced_clear(&half);
	return code;
}

/* Of all levels; empty: the views have not come yet. */
static int count_updates(const struct reduced *reduced, const struct reduced *half, enum refine_kind kind,
			 bool is_referred, bool empty, double *ret_updates, struct error *err)
{
	double updates = 0;
	int code = 0;

	for (int level = 0; level < levels_of(reduced) && code == 0; level++) {
		struct registration_options options = options_of(reduced, half, level, kind, is_referred);
		double one = 0;

		options.empty = empty;
		code = registration_updates(&options, &one, err);
		updates += work_of(schedule_of(reduced, level, kind, is_referred), is_referred) * one;
	}
	if (code == 0)
		*ret_updates = updates;
	return code;
}

int refine_work(const struct reduced *reduced, enum refine_kind kind, bool is_referred, double *ret_updates,
		struct error *err)
{
	struct reduced half = {0};
	int code = reduced_halve(reduced, &half, err);

	if (code == 0)
		code = count_updates(reduced, &half, kind, is_referred, true, ret_updates, err);
	reduced_clear(&half);
	return code;
}

/* ---- one level ---- */

static void tell_work(struct run *run, int fdks)
{
	run->work_done += fdks * run->unit;
	if (run->watch != NULL && run->watch->progress != NULL)
		run->watch->progress(run->watch->context, run->work_done / run->work_all);
}

static int iterate(struct run *run, struct registration *fit, int count, struct error *err)
{
	int code = 0;

	for (int i = 0; i < count && code == 0; i++) {
		code = registration_iterate(fit, err);
		tell_work(run, ITERATION_WORK);
	}
	return code;
}

/* As many iterations as with a path that is looked for, from the coarser level's volume on. */
static int run_still(struct run *run, struct registration *fit, const struct schedule *schedule, double *ret_sum,
		     struct error *err)
{
	int code = registration_place(fit, NULL, err);

	if (code == 0)
		code = registration_start(fit, &run->grid, run->volumes[0], err);
	if (code == 0)
		code = iterate(run, fit, schedule->warm + schedule->steps * (1 + schedule->doublings), err);
	return code == 0 ? registration_measure(fit, run->squares[0], ret_sum, err) : code;
}

/* Steps of the path, and between them iterations of the volume where that is no reference. */
static int follow_path(struct run *run, struct registration *fit, const struct schedule *schedule, struct path *path,
		       struct error *err)
{
	int code = 0;

	for (int doubled = 0; doubled <= schedule->doublings && code == 0; doubled++) {
		if (doubled > 0)
			path_double(path);
		for (int i = 0; i < schedule->steps && code == 0; i++) {
			code = registration_step(fit, path, err);
			tell_work(run, STEP_WORK);
			if (code == 0)
				code = registration_place(fit, path, err);
			if (code == 0 && run->reference == NULL)
				code = iterate(run, fit, 1, err);
		}
	}
	return code;
}

static int run_moved(struct run *run, struct registration *fit, const struct schedule *schedule, struct path *path,
		     double *ret_sum, struct error *err)
{
	int code = registration_place(fit, path, err);

	if (code == 0)
		code = registration_start(fit, &run->grid, run->volumes[1], err);
	if (code == 0)
		code = iterate(run, fit, schedule->warm, err);
	if (code == 0)
		code = follow_path(run, fit, schedule, path, err);
	return code == 0 ? registration_measure(fit, run->squares[1], ret_sum, err) : code;
}

/* The same steps with a reference, which is there from the beginning. */
static int run_referred(struct run *run, struct registration *fit, const struct schedule *schedule,
			struct refinement *refinement, double ret_sums[2], struct error *err)
{
	struct path *path = &refinement->path;
	int code = registration_place(fit, NULL, err);

	if (code == 0)
		code = registration_refer(fit, run->reference, err);
	if (code == 0)
		code = registration_measure(fit, run->squares[0], &ret_sums[0], err);
	if (code == 0)
		code = registration_place(fit, path, err);
	if (code == 0)
		code = follow_path(run, fit, schedule, path, err);
	if (code == 0)
		code = registration_measure(fit, run->squares[1], &ret_sums[1], err);
	return code == 0 ? registration_alike(fit, &refinement->alike, err) : code;
}

static int keep_volume(struct run *run, struct registration *fit, int which, struct error *err)
{
	free(run->volumes[which]);
	run->volumes[which] = registration_keep_volume(fit, err);
	return run->volumes[which] == NULL ? err->code : 0;
}

/* From the volumes of the level before, and for the next one. */
static int run_alone(struct run *run, struct registration *fit, const struct schedule *schedule, bool last,
		     struct refinement *refinement, double ret_sums[2], struct error *err)
{
	int code = run_still(run, fit, schedule, &ret_sums[0], err);

	if (code == 0 && !last)
		code = keep_volume(run, fit, 0, err);
	if (code == 0)
		code = run_moved(run, fit, schedule, &refinement->path, &ret_sums[1], err);
	if (code == 0 && !last)
		code = keep_volume(run, fit, 1, err);
	run->grid = fit->grid;
	return code;
}

/* What all views share is a motion where the reference says where the object lies. */
static double size_of(const struct registration *fit, const struct refinement *refinement)
{
	const double size = path_size(&refinement->path);
	double squares = size * size;

	for (int i = 0; i < PATH_NUMBERS && fit->referred; i++)
		squares += refinement->path.common[i] * refinement->path.common[i];
	return sqrt(squares);
}

/* Whether what a path explains better of the held-out views is worth it. bin: mm at the isocentre. */
static void judge(const struct registration *fit, double *const squares[2], const double sums[2], double bin,
		  struct refinement *refinement)
{
	const double values = registration_bins(fit);

	refinement->held_out = fit->held_count;
	refinement->held_before = sqrt(sums[0] / values);
	refinement->held_after = sqrt(sums[1] / values);
	refinement->better = 0;
	for (int i = 0; i < fit->held_count; i++)
		refinement->better += squares[1][i] < squares[0][i];
	refinement->accepted = refinement->held_after < refinement->held_before * (1 - BETTER[fit->kind]) &&
			       refinement->better >= BETTER_VIEWS * fit->held_count &&
			       size_of(fit, refinement) > SIZE_LEAST * bin &&
			       (!fit->referred || refinement->alike > ALIKE_LEAST);
}

static int run_level(struct run *run, const struct registration_options *options, const struct schedule *schedule,
		     bool last, struct refinement *refinement, struct error *err)
{
	struct registration fit;
	double sums[2] = {0};
	int code = registration_open(&fit, options, err);

	if (code < 0)
		return code;
	run->unit = (double)grid_voxels(&fit.grid) * fit.geometry.count;
	if (fit.held_count == 0 || fit.used_count < (fit.referred ? VIEWS_LEAST / 3 : VIEWS_LEAST / 2))
		goto out;
	code = fit.referred ? run_referred(run, &fit, schedule, refinement, sums, err)
			    : run_alone(run, &fit, schedule, last, refinement, sums, err);
	if (code == 0 && last)
		judge(&fit, run->squares, sums, sqrt(fit.orbit.pixel_at_isocentre[0] * fit.orbit.pixel_at_isocentre[1]),
		      refinement);
out:
	registration_clear(&fit);
	return code;
}

/* ---- the whole ---- */

static int open_run(struct run *run, const struct reduced *reduced, struct reduced *half, enum refine_kind kind,
		    const struct refine_reference *reference, const struct refine_watch *watch, struct error *err)
{
	int code = reduced_halve(reduced, half, err);

	*run = (struct run){.watch = watch, .reference = reference};
	if (code == 0)
		code = count_updates(reduced, half, kind, reference != NULL, false, &run->work_all, err);
	for (int i = 0; i < 2 && code == 0; i++) {
		run->squares[i] = malloc((size_t)reduced->geometry.count * sizeof(double));
		if (run->squares[i] == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", reduced->geometry.count);
	}
	return code;
}

static void close_run(struct run *run)
{
	for (int i = 0; i < 2; i++) {
		free(run->squares[i]);
		free(run->volumes[i]);
	}
}

/* A path of no motion. */
static struct path open_path(const struct orbit *orbit, enum refine_kind kind)
{
	double length = 0;
	struct path path;
	int knots;

	for (int i = 0; i < orbit->count; i++)
		length = fmax(length, refine_place(orbit, i));
	knots = 3 + (int)ceil(length / KNOTS_APART);
	path_open(&path, kind == REFINE_GEOMETRY, length, knots < PATH_KNOTS_MOST ? knots : PATH_KNOTS_MOST);
	return path;
}

int refine_find(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water,
		const struct refine_device *on, const struct refine_reference *reference,
		const struct refine_watch *watch, struct refinement *ret_refinement, struct error *err)
{
	struct refinement refinement = {.path = open_path(orbit, kind),
					.basis = refine_basis(reduced, orbit, kind, mu_water)};
	const int levels = levels_of(reduced);
	struct reduced half = {0};
	struct run run;
	int code = open_run(&run, reduced, &half, kind, reference, watch, err);

	for (int level = 0; level < levels && code == 0; level++) {
		struct registration_options options = options_of(reduced, &half, level, kind, reference != NULL);

		options.on = on;
		options.orbit = orbit;
		options.mu_water = mu_water;
		options.watch = watch;
		code = run_level(&run, &options, schedule_of(reduced, level, kind, reference != NULL),
				 level + 1 == levels, &refinement, err);
	}
	if (!refinement.accepted)
		refinement.path = open_path(orbit, kind);
	close_run(&run);
	reduced_clear(&half);
	if (code == 0)
		*ret_refinement = refinement;
	return code;
}

/* Registration of the views with a volume of the others, in turn with its reconstruction: see refine.h. */
#include "core/refine/refine.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/refine/registration.h"
#include "core/refine/rest.h"

enum { VIEWS_LEAST = 48, BINS_LEAST = 24, LEVELS = 2, BINS_COARSE = REFINE_BINS_MOST / 2 };
static const double ARC_LEAST = 2.8;   /* radians */
static const double KNOTS_APART = 0.7; /* radians, at first */
/* What an iteration with TV, and a step of the path, take, in FDKs of the bins: for the progress bar. */
enum { ITERATION_WORK = 5, STEP_WORK = 10 };
enum { OWN_ITERATIONS = 6 }; /* of the scan's own volume, which is asked about a reference's path */
enum { TRIES_MOST = 3 };
/*
 * Iterations before the first step; steps with the same knots; how often these are doubled; and over how many bins what
 * the volume lacks is alike (registration_step): of several that are tried held-out views have the choice, and the next
 * level has the same. What a leg lacks beside its screws is alike over far more bins than what a head does.
 */
static const struct schedule {
	int warm, steps, doublings;
	double alike[TRIES_MOST]; /* 0: as on the level before, or no more of them */
} schedules[REFINE_KINDS][LEVELS] =
    {
	[REFINE_GEOMETRY] = {{4, 5, 1, {400}}, {2, 5, 0, {0}}},
	[REFINE_MOTION] = {{4, 5, 2, {100, 400, 1600}}, {2, 5, 0, {0}}},
},
  alone = {4, 5, 2, {100}}, /* of a scan that has few bins: the geometry */
    referred[LEVELS] = {{0, 4, 1, {100}}, {0, 4, 0, {100}}};
/*
 * What a path must reach to be kept: the share by which held-out views are explained better, the share of these views
 * that are, of a path without a reference, too, and the path's size in bins. Of 17 paths that were found where nothing
 * is to be found one passed the first, by a tenth; of 24 others one did, with 10 of 15 views, and its image was worse
 * by .2 HU (tests/bench/results/refine.txt).
 */
static const double BETTER[REFINE_KINDS] = {[REFINE_GEOMETRY] = .003, [REFINE_MOTION] = .02};
static const double BETTER_VIEWS = 0.65, BETTER_ALONE = 0.7, SIZE_LEAST = 0.055;
/*
 * And how much alike a reference's detail must be: a volume of another object leaves the views explained better in some
 * place, too.
 */
static const double ALIKE_LEAST = 0.7;
/*
 * And by which share the scan's own volume may explain held-out views worse with a reference's path than without. Other
 * objects' volumes that are alike enough made it .5 to 10 % worse where nothing was to be found, the object's own up to
 * .23 %, which is noise.
 */
static const double OWN_WORSE = 0.003;

struct run {
	const struct refine_watch *watch;
	double work_all, work_done, unit; /* updates of a voxel by a view; unit: of one FDK of the level */
	/* [views], of held-out ones: what is unexplained without motion, with it, and with the path that is tried */
	double *squares[3];
	const struct refine_reference *reference;
	struct grid grid;  /* of the coarser level's volumes, */
	float *volumes[2]; /* without motion and with it; NULL on the first level */
	size_t voxels[2];  /* in these */
	struct refinement *refinement;
	double sums[3];            /* of squares[] */
	struct path best;          /* of the level: the path that squares[1] are of, */
	double alike;              /* and what it was found with */
	const struct path *placed; /* as the level's views stand; NULL: as the scan says */
	int at, reached;           /* steps so far, and those that an earlier run has made */
};

bool refine_is_possible(const struct geometry *geometry, const struct orbit *orbit, bool is_referred)
{
	return geometry->count >= (is_referred ? VIEWS_LEAST / 2 : VIEWS_LEAST) && geometry->columns >= BINS_LEAST &&
	       geometry->rows >= BINS_LEAST && orbit->arc >= (is_referred ? ARC_LEAST / 2 : ARC_LEAST) &&
	       orbit->field_of_view > 0 && (is_referred || !orbit->displaced);
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
	return levels_of(reduced) == 1 && kind == REFINE_GEOMETRY ? &alone : &schedules[kind][level];
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
					     .referred = is_referred,
					     .bins = is_fine && !is_coarse ? REFINE_BINS_MOST : BINS_COARSE};
}

/* Paths that are looked for on a level. */
static int tries_of(const struct schedule *schedule)
{
	int tries = 1;

	while (tries < TRIES_MOST && schedule->alike[tries] > 0)
		tries++;
	return tries;
}

/* FDKs of a level. */
static int work_of(const struct schedule *schedule, bool is_referred)
{
	const int steps = schedule->steps * (1 + schedule->doublings), tries = tries_of(schedule);

	return (is_referred ? 0 : (1 + tries) * (schedule->warm + steps) * ITERATION_WORK) + tries * steps * STEP_WORK;
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
		if (is_referred && level == 0)
			updates += 2 * OWN_ITERATIONS * ITERATION_WORK * one;
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

/* ---- what has been reached ---- */

/* A change of what the bytes mean, or of the steps, is another version. */
#define STATE_NAME "cbctd refining 3"
struct state_head {
	char name[24];
	struct refinement refinement;
	double sums[3], alike;
	struct path best;
	int at, views;
	size_t voxels[3]; /* of the level before without motion and with it, and of the level's own volume */
};

static size_t state_bytes(const struct state_head *head)
{
	return sizeof(*head) + 3 * (size_t)head->views * sizeof(double) +
	       (head->voxels[0] + head->voxels[1] + head->voxels[2]) * sizeof(float);
}

static int keep_state(struct run *run, struct registration *fit, struct error *err)
{
	const size_t squares = (size_t)fit->reduced->geometry.count * sizeof(double);
	struct state_head head;
	int code = 0;

	memset(&head, 0, sizeof(head));
	memcpy(head.name, STATE_NAME, sizeof(STATE_NAME));
	head.refinement = *run->refinement;
	memcpy(head.sums, run->sums, sizeof(head.sums));
	head.alike = run->alike;
	head.best = run->best;
	head.at = run->at;
	head.views = fit->reduced->geometry.count;
	for (int i = 0; i < 2; i++)
		head.voxels[i] = run->volumes[i] != NULL ? run->voxels[i] : 0;
	if (!fit->referred) {
		head.voxels[2] = grid_voxels(&fit->grid);
		code = fit->backend->volume_download(fit->volume, 0, fit->grid.size[2], fit->voxels, err);
	}
	if (code < 0)
		return code;
	return run->watch->keep->keep(run->watch->keep->context,
				      &(struct refine_state){{{&head, sizeof(head)},
							      {run->squares[0], squares},
							      {run->squares[1], squares},
							      {run->squares[2], squares},
							      {run->volumes[0], head.voxels[0] * sizeof(float)},
							      {run->volumes[1], head.voxels[1] * sizeof(float)},
							      {fit->voxels, head.voxels[2] * sizeof(float)}}},
				      err);
}

/* The steps that an earlier run has made with the same views; 0: there is none that can be gone on from. */
static int steps_made(const struct run *run, int views)
{
	const struct refine_keep *keep = run->watch == NULL ? NULL : run->watch->keep;
	struct state_head head;

	if (keep == NULL || keep->state == NULL || keep->bytes < sizeof(head))
		return 0;
	memcpy(&head, keep->state, sizeof(head));
	return memcmp(head.name, STATE_NAME, sizeof(STATE_NAME)) == 0 && head.views == views &&
		       head.refinement.basis == run->refinement->basis && state_bytes(&head) == keep->bytes
		   ? head.at
		   : 0;
}

/* Whether the volumes are of the grids of this level and the one before. */
static bool fits_grids(const struct run *run, const struct registration *fit, const struct state_head *head)
{
	const struct grid *before = run->grid.size[0] > 0 ? &run->grid : &fit->grid;
	bool fits = head->voxels[2] == (fit->referred ? 0 : grid_voxels(&fit->grid));

	for (int i = 0; i < 2; i++)
		fits = fits && (head->voxels[i] == 0 || head->voxels[i] == grid_voxels(before));
	return fits;
}

/* Takes up where an earlier run has left off. ERR_DAMAGED: it was none of these views. */
static int take_up(struct run *run, struct registration *fit, struct error *err)
{
	const char *from = run->watch->keep->state;
	struct state_head head;
	int code = 0;

	memcpy(&head, from, sizeof(head));
	from += sizeof(head);
	if (!fits_grids(run, fit, &head))
		return error_set(err, ERR_DAMAGED, "what a refinement has reached is of another grid");
	*run->refinement = head.refinement;
	memcpy(run->sums, head.sums, sizeof(run->sums));
	run->alike = head.alike;
	run->best = head.best;
	for (int i = 0; i < 3; i++, from += (size_t)head.views * sizeof(double))
		memcpy(run->squares[i], from, (size_t)head.views * sizeof(double));
	for (int i = 0; i < 2; i++) {
		free(run->volumes[i]);
		run->voxels[i] = head.voxels[i];
		run->volumes[i] = head.voxels[i] > 0 ? malloc(head.voxels[i] * sizeof(float)) : NULL;
		if (head.voxels[i] > 0 && run->volumes[i] == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", head.voxels[i]);
		if (head.voxels[i] > 0)
			memcpy(run->volumes[i], from, head.voxels[i] * sizeof(float));
		from += head.voxels[i] * sizeof(float);
	}
	if (!fit->referred)
		code = fit->backend->volume_upload(fit->volume, (const float *)(const void *)from, err);
	return code == 0 ? registration_place(fit, run->placed, err) : code;
}

/* ---- one level ---- */

static void tell_work(struct run *run, int fdks)
{
	run->work_done += fdks * run->unit;
	if (run->watch != NULL && run->watch->progress != NULL)
		run->watch->progress(run->watch->context, run->work_done / run->work_all);
}

static int place(struct run *run, struct registration *fit, const struct path *path, struct error *err)
{
	run->placed = path;
	return registration_place(fit, path, err);
}

/* Counts a step; true where an earlier run has made it, and what it has reached there, or later, will be taken up. */
static bool is_made(struct run *run)
{
	return ++run->at <= run->reached;
}

/* True once all that an earlier run has made is behind. */
static bool is_caught_up(const struct run *run)
{
	return run->at >= run->reached;
}

/* Behind each step. */
static int end_step(struct run *run, struct registration *fit, int fdks, struct error *err)
{
	const struct refine_watch *watch = run->watch;
	bool yields;
	int code = 0;

	tell_work(run, fdks);
	if (run->at == run->reached)
		return take_up(run, fit, err);
	if (run->at < run->reached || watch == NULL)
		return 0;
	yields = watch->yield != NULL && watch->yield(watch->context);
	if (watch->keep != NULL && watch->keep->due(watch->keep->context, yields))
		code = keep_state(run, fit, err);
	return code == 0 && yields ? error_set(err, ERR_BUSY, "yielded while the geometry was refined") : code;
}

static int iterate(struct run *run, struct registration *fit, int count, struct error *err)
{
	int code = 0;

	for (int i = 0; i < count && code == 0; i++) {
		if (!is_made(run))
			code = registration_iterate(fit, err);
		if (code == 0)
			code = end_step(run, fit, ITERATION_WORK, err);
	}
	return code;
}

/* What the held-out views do not show: [0] without motion, [1] with it, [2] with what is tried. */
static int measure(struct run *run, struct registration *fit, int which, struct error *err)
{
	return is_caught_up(run) ? registration_measure(fit, run->squares[which], &run->sums[which], err) : 0;
}

/* As many iterations as with a path that is looked for, from the coarser level's volume on. */
static int run_still(struct run *run, struct registration *fit, const struct schedule *schedule, struct error *err)
{
	int code = place(run, fit, NULL, err);

	if (code == 0)
		code = registration_start(fit, &run->grid, run->volumes[0], err);
	if (code == 0)
		code = iterate(run, fit, schedule->warm + schedule->steps * (1 + schedule->doublings), err);
	return code == 0 ? measure(run, fit, 0, err) : code;
}

/* Steps of the path, and between them iterations of the volume where that is no reference. */
static int follow_path(struct run *run, struct registration *fit, const struct schedule *schedule, const double *alike,
		       struct error *err)
{
	struct path *path = &run->refinement->path;
	int code = 0;

	for (int doubled = 0; doubled <= schedule->doublings && code == 0; doubled++) {
		if (doubled > 0)
			path_double(path);
		for (int i = 0; i < schedule->steps && code == 0; i++) {
			if (!is_made(run)) {
				code = registration_step(fit, path, *alike, err);
				if (code == 0)
					code = place(run, fit, path, err);
			}
			if (code == 0)
				code = end_step(run, fit, STEP_WORK, err);
			if (code == 0 && run->reference == NULL)
				code = iterate(run, fit, 1, err);
		}
	}
	return code;
}

/* From the coarser level's volume on, or from nothing. */
static int run_moved(struct run *run, struct registration *fit, const struct schedule *schedule, const double *alike,
		     struct error *err)
{
	int code = place(run, fit, &run->refinement->path, err);

	if (code == 0)
		code = registration_start(fit, &run->grid, run->grid.size[0] > 0 ? run->volumes[1] : NULL, err);
	if (code == 0)
		code = iterate(run, fit, schedule->warm, err);
	if (code == 0)
		code = follow_path(run, fit, schedule, alike, err);
	return code == 0 ? measure(run, fit, 2, err) : code;
}

/* The same steps with a reference, which is there from the beginning. */
static int run_referred(struct run *run, struct registration *fit, const struct schedule *schedule, struct error *err)
{
	struct refinement *refinement = run->refinement;
	int code = place(run, fit, NULL, err);

	if (code == 0)
		code = registration_refer(fit, run->reference, err);
	if (code == 0)
		code = measure(run, fit, 0, err);
	if (code == 0)
		code = place(run, fit, &refinement->path, err);
	if (code == 0)
		code = follow_path(run, fit, schedule, schedule->alike, err);
	if (code == 0)
		code = measure(run, fit, 1, err);
	return code == 0 && is_caught_up(run) ? registration_alike(fit, &refinement->alike, err) : code;
}

static int keep_volume(struct run *run, struct registration *fit, int which, struct error *err)
{
	if (!is_caught_up(run))
		return 0;
	free(run->volumes[which]);
	run->voxels[which] = grid_voxels(&fit->grid);
	run->volumes[which] = registration_keep_volume(fit, err);
	return run->volumes[which] == NULL ? err->code : 0;
}

/* How many held-out views are explained better in one way than in another. */
static int count_better(const double *squares, const double *others, int count)
{
	int better = 0;

	for (int i = 0; i < count; i++)
		better += squares[i] < others[i];
	return better;
}

/*
 * The first path of a level is kept, or one that explains held-out views better than those before, and most of them: a
 * single view has a say in the sum that is none.
 */
static int keep_better(struct run *run, struct registration *fit, bool first, double alike, bool last,
		       struct error *err)
{
	double *const squares = run->squares[1];

	if (!is_caught_up(run))
		return 0;
	if (!first && (run->sums[2] >= run->sums[1] ||
		       count_better(run->squares[2], squares, fit->held_count) < BETTER_VIEWS * fit->held_count))
		return 0;
	run->squares[1] = run->squares[2];
	run->squares[2] = squares;
	run->sums[1] = run->sums[2];
	run->best = run->refinement->path;
	run->alike = alike;
	return last ? 0 : keep_volume(run, fit, 1, err);
}

/* From the volumes of the level before, and for the next one. */
static int run_alone(struct run *run, struct registration *fit, const struct schedule *schedule, bool last,
		     struct error *err)
{
	struct path *path = &run->refinement->path;
	int code = run_still(run, fit, schedule, err);
	const struct path start = *path;

	if (code == 0 && !last)
		code = keep_volume(run, fit, 0, err);
	for (int i = 0; i < tries_of(schedule) && code == 0; i++) {
		/* An earlier run's is taken up in between. */
		const double *alike = schedule->alike[i] > 0 ? &schedule->alike[i] : &run->alike;

		*path = start;
		code = run_moved(run, fit, schedule, alike, err);
		if (code == 0)
			code = keep_better(run, fit, i == 0, *alike, last, err);
	}
	if (is_caught_up(run))
		*path = run->best;
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

/* Whether what a path explains better of the held-out views is worth it. */
static void judge(const struct run *run, const struct registration *fit)
{
	const double bin = sqrt(fit->orbit.pixel_at_isocentre[0] * fit->orbit.pixel_at_isocentre[1]);
	struct refinement *refinement = run->refinement;
	const double values = registration_bins(fit);

	refinement->held_out = fit->held_count;
	refinement->held_before = sqrt(run->sums[0] / values);
	refinement->held_after = sqrt(run->sums[1] / values);
	refinement->better = count_better(run->squares[1], run->squares[0], fit->held_count);
	refinement->accepted = refinement->held_after < refinement->held_before * (1 - BETTER[fit->kind]) &&
			       refinement->better >= (fit->referred ? BETTER_VIEWS : BETTER_ALONE) * fit->held_count &&
			       size_of(fit, refinement) > SIZE_LEAST * bin &&
			       (!fit->referred || refinement->alike > ALIKE_LEAST);
}

/* Without a reference nothing says where the object lies: it is shown where the told geometry has it. */
static int let_rest(const struct registration *fit, int bins, struct refinement *refinement, struct error *err)
{
	struct grid shown;

	orbit_covering_grid(&fit->orbit, &fit->reduced->geometry, bins, &shown);
	return path_rest(&refinement->path, fit->views, fit->geometry.count, &shown, err);
}

static int run_level(struct run *run, const struct registration_options *options, const struct schedule *schedule,
		     bool last, struct error *err)
{
	struct registration fit;
	int code = registration_open(&fit, options, err);

	if (code < 0)
		return code;
	run->unit = (double)grid_voxels(&fit.grid) * fit.geometry.count;
	if (fit.held_count == 0 || fit.used_count < (fit.referred ? VIEWS_LEAST / 3 : VIEWS_LEAST / 2))
		goto out;
	code = fit.referred ? run_referred(run, &fit, schedule, err) : run_alone(run, &fit, schedule, last, err);
	if (code == 0 && is_caught_up(run) && last) {
		judge(run, &fit);
		if (!fit.referred && fit.kind == REFINE_GEOMETRY)
			code = let_rest(&fit, options->bins, run->refinement, err);
	}
out:
	registration_clear(&fit);
	return code;
}

/*
 * What the scan's own volume says of a reference's path: views that are held out beside volumes of the others, as the
 * scan has them and as the path moves them.
 */
static int ask_scan(struct run *run, const struct registration_options *options, struct error *err)
{
	struct refinement *refinement = run->refinement;
	struct registration fit;
	int code = registration_open(&fit, options, err);

	if (code < 0)
		return code;
	run->unit = (double)grid_voxels(&fit.grid) * fit.geometry.count;
	for (int i = 0; i < 2 && code == 0; i++) {
		code = place(run, &fit, i == 0 ? NULL : &refinement->path, err);
		if (code == 0)
			code = registration_start(&fit, NULL, NULL, err);
		if (code == 0)
			code = iterate(run, &fit, OWN_ITERATIONS, err);
		if (code == 0)
			code = measure(run, &fit, i, err);
		if (code == 0 && is_caught_up(run))
			*(i == 0 ? &refinement->own_before : &refinement->own_after) =
			    sqrt(run->sums[i] / registration_bins(&fit));
	}
	/* Held-out views of a displaced detector share next to nothing with those across, and cannot tell. */
	if (code == 0 && !fit.orbit.displaced && !(refinement->own_after <= refinement->own_before * (1 + OWN_WORSE)))
		refinement->accepted = false;
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
	for (int i = 0; i < 3 && code == 0; i++) {
		run->squares[i] = calloc((size_t)reduced->geometry.count, sizeof(double));
		if (run->squares[i] == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", reduced->geometry.count);
	}
	return code;
}

static void close_run(struct run *run)
{
	for (int i = 0; i < 3; i++)
		free(run->squares[i]);
	for (int i = 0; i < 2; i++)
		free(run->volumes[i]);
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

/* With `reached` steps of an earlier run. */
static int find_path(struct run *run, const struct reduced *reduced, const struct reduced *half,
		     const struct orbit *orbit, enum refine_kind kind, double mu_water, const struct refine_device *on,
		     struct error *err)
{
	const bool is_referred = run->reference != NULL;
	const int levels = levels_of(reduced);
	int code = 0;

	for (int step = 0; step < levels + is_referred && code == 0; step++) {
		const bool asks = step == levels;
		const int level = asks ? 0 : step;
		struct registration_options options = options_of(reduced, half, level, kind, is_referred && !asks);

		options.on = on;
		options.orbit = orbit;
		options.mu_water = mu_water;
		options.watch = run->watch;
		code = asks ? ask_scan(run, &options, err)
			    : run_level(run, &options, schedule_of(reduced, level, kind, is_referred),
					level + 1 == levels, err);
	}
	return code;
}

/* From where an earlier run has left off, if `goes_on`; *ret_went: there was such a run. */
static int find(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water,
		const struct refine_device *on, const struct refine_reference *reference,
		const struct refine_watch *watch, bool goes_on, bool *ret_went, struct refinement *ret_refinement,
		struct error *err)
{
	struct refinement refinement = {.path = open_path(orbit, kind),
					.basis = refine_basis(reduced, orbit, kind, mu_water)};
	struct reduced half = {0};
	struct run run;
	int code = open_run(&run, reduced, &half, kind, reference, watch, err);

	run.refinement = &refinement;
	run.reached = code == 0 && goes_on ? steps_made(&run, reduced->geometry.count) : 0;
	*ret_went = run.reached > 0;
	if (code == 0)
		code = find_path(&run, reduced, &half, orbit, kind, mu_water, on, err);
	if (!refinement.accepted)
		refinement.path = open_path(orbit, kind);
	close_run(&run);
	reduced_clear(&half);
	if (code == 0)
		*ret_refinement = refinement;
	return code;
}

int refine_find(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water,
		const struct refine_device *on, const struct refine_reference *reference,
		const struct refine_watch *watch, struct refinement *ret_refinement, struct error *err)
{
	bool went;
	int code = find(reduced, orbit, kind, mu_water, on, reference, watch, true, &went, ret_refinement, err);

	/* Nothing else here says damaged. */
	return code == ERR_DAMAGED && went
		   ? find(reduced, orbit, kind, mu_water, on, reference, watch, false, &went, ret_refinement, err)
		   : code;
}

/* Registration of the views with a volume of the others, in turn with its reconstruction: see refine.h. */
#include "core/refine/refine.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "core/refine/detail.h"
#include "core/select.h"

enum { VIEWS_LEAST = 48, BINS_LEAST = 24, HELD_OUT = 8, SUBSETS = 10, EDGE = 4, IMAGES = 1 + PATH_NUMBERS };
/* Iterations before the first step; steps with the same knots; how often these are doubled. */
enum { WARM = 4, STEPS = 5, DOUBLINGS = 2, TV_STEPS = 30 };
/* What an iteration with TV, and a step of the path, take, in FDKs of the bins: for the progress bar. */
enum { ITERATION_WORK = 5, STEP_WORK = 10 };
enum { ALL_STEPS = STEPS * (DOUBLINGS + 1) }; /* and as many iterations behind the first, still and moved */
enum { ALL_WORK = 2 * (WARM + ALL_STEPS) * ITERATION_WORK + ALL_STEPS * STEP_WORK };
static const double PI = 3.14159265358979323846;
static const double ARC_LEAST = 2.8;                        /* radians */
static const double KNOTS_APART = 0.7;                      /* radians, at first */
static const double FINE = 1, COARSE = 4, COARSE_CUT = 2.5; /* bins; COARSE_CUT of a body wider than the detector */
static const double FACTOR = 1.5;                           /* of a step: the volume follows each */
static const double TV_ALPHA = 0.05;
static const double MAD = 1.4826;
/* The residual is no noise but what the volume lacks, alike over far more than a smoothed bin's neighbours. */
static const double ALIKE = 100;
static const double WIDE = 1.6, CUT_SHARE = 0.1;
/* Held-out views are explained better by at least this share, and so many of them. */
static const double BETTER = 0.02, BETTER_VIEWS = 0.65;
/* Standard deviations about a view's columns, rows and beam: mm, and hundredths of a radian. */
static const double EXPECTED[REFINE_KINDS][PATH_NUMBERS] = {
    [REFINE_GEOMETRY] = {1, 1, .05, .1, .1, 2},
    [REFINE_MOTION] = {2, 2, 1, 4, 4, 5},
};

struct fit {
	const struct reduced *reduced;
	const struct refine_watch *watch;
	int work_done; /* of ALL_WORK */
	enum refine_kind kind;
	struct geometry geometry; /* of the bins, as the path moves it */
	struct grid grid;
	struct orbit orbit; /* of the bins */
	struct sart_options sart;
	struct tv_options tv;
	double coarse;
	struct device *device;
	struct plan *plan; /* of `geometry` */
	struct stack *measured, *made;
	struct volume *volume, *work;
	float *voxels, *derived; /* of the grid */
	float *images;           /* [IMAGES][view][row][column]: the residual, and derivatives */
	float *scratch;          /* [threads][4][row][column] */
	struct path_view *views; /* [geometry.count] */
	int *used, *held;        /* numbers of views */
	int used_count, held_count;
	double
	    *unexplained; /* [DOUBLINGS + 2][geometry.count], squares of held-out views: without motion, and with it */
};

bool refine_is_possible(const struct geometry *geometry, const struct orbit *orbit)
{
	return geometry->count >= VIEWS_LEAST && geometry->columns >= BINS_LEAST && geometry->rows >= BINS_LEAST &&
	       orbit->arc >= ARC_LEAST && orbit->field_of_view > 0;
}

double refine_place(const struct orbit *orbit, int view)
{
	const double turn = (orbit->angle[view] - orbit->angle[orbit->first]) * (orbit->direction < 0 ? -1 : 1);

	return turn < -1e-9 ? turn + 2 * PI : fmax(0, turn);
}

static int host_threads(void)
{
#ifdef _OPENMP
	return omp_get_max_threads();
#else
	return 1;
#endif
}

static size_t pixels_of(const struct fit *fit)
{
	return (size_t)fit->geometry.columns * (size_t)fit->geometry.rows;
}

static double *unexplained_at(const struct fit *fit, int level)
{
	return fit->unexplained + (size_t)level * (size_t)fit->geometry.count;
}

/* ---- opening ---- */

/* True if a body goes on beside the detector: its outer columns show a share of what all do. */
static bool is_cut(const struct reduced *reduced)
{
	const int columns = reduced->geometry.columns, rows = reduced->geometry.rows;
	double outer = 0, all = 0;

	for (long i = 0; i < (long)reduced->geometry.count * rows; i++) {
		const float *row = reduced->projections + i * columns;

		outer += (double)row[0] + (double)row[columns - 1];
		for (int c = 0; c < columns; c++)
			all += (double)row[c];
	}
	return outer / 2 > CUT_SHARE * all / columns;
}

static void choose_grid(struct fit *fit)
{
	struct grid wide;
	struct error err;

	orbit_covering_grid(&fit->orbit, &fit->geometry, REFINE_BINS_MOST, &fit->grid);
	fit->coarse = COARSE;
	if (!is_cut(fit->reduced))
		return;
	fit->coarse = COARSE_CUT;
	wide = fit->grid;
	for (int a = 0; a < 2; a++) {
		wide.size[a] = (int)(WIDE * wide.size[a]);
		wide.origin[a] -= 0.5 * (wide.size[a] - fit->grid.size[a]) * wide.spacing[a];
	}
	if (grid_check_geometry(&wide, &fit->geometry, &err) == 0)
		fit->grid = wide;
}

static struct plan_options plan_options_of(const struct fit *fit)
{
	return (struct plan_options){.geometry = &fit->geometry,
				     .grid = &fit->grid,
				     .linearise = {.sample = SAMPLE_FLOAT32},
				     .sart = &fit->sart,
				     .tv = &fit->tv,
				     .no_samples = true};
}

static int describe(struct fit *fit, const struct reduced *reduced, struct error *err)
{
	int code;

	*fit = (struct fit){.reduced = reduced};
	code = geometry_copy(&fit->geometry, &reduced->geometry, err);
	if (code == 0)
		code = orbit_analyse(&fit->orbit, &fit->geometry, err);
	if (code < 0)
		return code;
	choose_grid(fit);
	fit->sart = (struct sart_options){.relaxation = 1, .nonnegative = true};
	fit->tv = (struct tv_options){.method = TV_PROXIMAL, .alpha = TV_ALPHA, .iterations = TV_STEPS, .unit = 1};
	return subsets_make(&fit->sart.subsets, &fit->orbit, SUBSETS, err);
}

static void fit_clear(struct fit *fit)
{
	const struct backend *backend = &backend_cpu;

	backend->volume_free(fit->volume);
	backend->volume_free(fit->work);
	backend->stack_free(fit->measured);
	backend->stack_free(fit->made);
	backend->plan_free(fit->plan);
	backend->close(fit->device);
	subsets_clear(&fit->sart.subsets);
	orbit_clear(&fit->orbit);
	geometry_clear(&fit->geometry);
	free(fit->voxels);
	free(fit->images);
	free(fit->views);
	free(fit->used);
	free(fit->unexplained);
}

/* Floats of voxels, derived; of images and scratch. */
static void count_floats(const struct fit *fit, size_t *ret_voxels, size_t *ret_images)
{
	*ret_voxels = 2 * grid_voxels(&fit->grid);
	*ret_images = ((size_t)IMAGES * (size_t)fit->geometry.count + 4 * (size_t)host_threads()) * pixels_of(fit);
}

int refine_bytes(const struct reduced *reduced, size_t *ret_bytes, struct error *err)
{
	const struct backend *backend = &backend_cpu;
	struct plan_bytes bytes = {0};
	struct fit fit;
	int code = describe(&fit, reduced, err);

	if (code == 0) {
		const struct plan_options options = plan_options_of(&fit);

		code = backend->plan_bytes(NULL, &options, &bytes, err);
	}
	if (code == 0) {
		size_t voxels, images;

		count_floats(&fit, &voxels, &images);
		*ret_bytes =
		    bytes.volumes + bytes.scratch + bytes.raw + (voxels + images) * sizeof(float) +
		    2 * backend->volume_bytes(NULL, &fit.grid) +
		    2 * backend->stack_bytes(NULL, fit.geometry.columns, fit.geometry.rows, fit.geometry.count);
	}
	fit_clear(&fit);
	return code;
}

int refine_work(const struct reduced *reduced, double *ret_fdks, double *ret_updates, struct error *err)
{
	struct fit fit;
	int code = describe(&fit, reduced, err);

	if (code == 0) {
		*ret_fdks = ALL_WORK;
		*ret_updates = (double)grid_voxels(&fit.grid) * fit.geometry.count;
	}
	fit_clear(&fit);
	return code;
}

static int allocate(struct fit *fit, struct error *err)
{
	const struct geometry *geometry = &fit->geometry;
	const struct backend *backend = &backend_cpu;
	const size_t count = (size_t)geometry->count;
	size_t voxels, images;
	int code;

	count_floats(fit, &voxels, &images);
	fit->voxels = malloc(voxels * sizeof(float));
	fit->images = malloc(images * sizeof(float));
	fit->views = calloc(count, sizeof(*fit->views));
	fit->used = malloc(2 * count * sizeof(*fit->used));
	fit->unexplained = calloc((DOUBLINGS + 2) * count, sizeof(double));
	if (fit->voxels == NULL || fit->images == NULL || fit->views == NULL || fit->used == NULL ||
	    fit->unexplained == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to refine %d views", geometry->count);
	fit->derived = fit->voxels + voxels / 2;
	fit->scratch = fit->images + IMAGES * count * pixels_of(fit);
	fit->held = fit->used + count;
	code = backend->open(0, &(struct device_options){.threads = host_threads()}, &fit->device, err);
	if (code == 0)
		code = backend->stack_new(fit->device, geometry->columns, geometry->rows, geometry->count, &fit->made,
					  err);
	if (code == 0)
		code = backend->stack_new(fit->device, geometry->columns, geometry->rows, geometry->count,
					  &fit->measured, err);
	if (code == 0)
		code = backend->volume_new(fit->device, &fit->grid, &fit->volume, err);
	return code == 0 ? backend->volume_new(fit->device, &fit->grid, &fit->work, err) : code;
}

/* Views that are held out, or not known, have no rays in the volume. */
static int share_views_out(struct fit *fit, const struct orbit *orbit, struct error *err)
{
	const struct reduced *reduced = fit->reduced;
	const size_t pixels = pixels_of(fit);
	int known = 0, code = 0;

	for (size_t i = 0; i < pixels; i++)
		fit->scratch[i] = RAY_LEFT_OUT;
	for (int k = 0; k < fit->geometry.count && code == 0; k++) {
		const bool held = reduced->known[k] && known++ % HELD_OUT == HELD_OUT / 2;
		const float *view = reduced->projections + (size_t)k * pixels;
		struct path_view *mine = &fit->views[k];

		*mine = (struct path_view){.used = reduced->known[k] && !held,
					   .at = refine_place(orbit, reduced->views[k]),
					   .view = reduced->geometry.views[k]};
		if (held)
			fit->held[fit->held_count++] = k;
		if (mine->used)
			fit->used[fit->used_count++] = k;
		code = backend_cpu.stack_upload(fit->measured, k, 1, mine->used ? view : fit->scratch, err);
	}
	return code;
}

/* ---- the volume ---- */

/* Moves the views as the path says, NULL: not at all. */
static int place_views(struct fit *fit, const struct path *path, struct error *err)
{
	const struct plan_options options = plan_options_of(fit);

	for (int k = 0; k < fit->geometry.count; k++) {
		double motion[PATH_NUMBERS] = {0};

		if (path != NULL)
			path_motion(path, fit->views[k].at, &fit->views[k].view, motion);
		fit->geometry.views[k] = view_of_moved(&fit->views[k].view, motion);
	}
	backend_cpu.plan_free(fit->plan);
	fit->plan = NULL;
	return backend_cpu.plan_new(fit->device, &options, &fit->plan, err);
}

static void tell_work(struct fit *fit, int work)
{
	fit->work_done += work;
	if (fit->watch->progress != NULL)
		fit->watch->progress(fit->watch->context, (double)fit->work_done / ALL_WORK);
}

static int iterate(struct fit *fit, struct error *err)
{
	const struct cancel *cancel = fit->watch->cancel;
	struct iteration_sums sums;
	int code = backend_cpu.sart_iterate(fit->plan, fit->measured, fit->volume, cancel, &sums, err);

	if (code == 0)
		code = backend_cpu.tv(fit->plan, fit->volume, &fit->tv, cancel, err);
	tell_work(fit, ITERATION_WORK);
	return code;
}

/* ---- views beside the volume's projections ---- */

/* Projects a volume along these views, into image `image`. */
static int project(struct fit *fit, const struct volume *volume, const int *views, int count, int image,
		   struct error *err)
{
	const size_t pixels = pixels_of(fit);
	float *to = fit->images + (size_t)image * (size_t)fit->geometry.count * pixels;
	int code = backend_cpu.project(fit->plan, volume, views, count, fit->made, err);

	for (int i = 0; i < count && code == 0; i++)
		code = backend_cpu.stack_download(fit->made, i, 1, to + (size_t)views[i] * pixels, err);
	return code;
}

/* Image 0 becomes what the volume does not explain of these views. */
static int find_residuals(struct fit *fit, const int *views, int count, struct error *err)
{
	const size_t pixels = pixels_of(fit);
	int code = project(fit, fit->volume, views, count, 0, err);

	for (int i = 0; i < count && code == 0; i++) {
		const float *measured = fit->reduced->projections + (size_t)views[i] * pixels;
		float *to = fit->images + (size_t)views[i] * pixels;

		for (size_t j = 0; j < pixels; j++)
			to[j] = measured[j] - to[j];
	}
	return code;
}

/* A difference of the volume along `axis` at a voxel, per mm, negative: that by a shift of the object. */
static double slope(const struct grid *grid, const float *voxels, const int at[3], int axis)
{
	const size_t steps[3] = {1, (size_t)grid->size[0], (size_t)grid->size[0] * (size_t)grid->size[1]};
	const float *voxel = voxels + grid_voxel(grid, at[0], at[1], at[2]);
	const bool low = at[axis] > 0, high = at[axis] + 1 < grid->size[axis];
	const double before = low ? (double)voxel[-(ptrdiff_t)steps[axis]] : (double)*voxel;
	const double behind = high ? (double)voxel[steps[axis]] : (double)*voxel;

	return low || high ? (before - behind) / (grid->spacing[axis] * (low + high)) : 0;
}

/* fit->derived becomes the derivative of fit->voxels by number `number` about the world's axes. */
static void derive(struct fit *fit, int number)
{
	const struct grid *grid = &fit->grid;
	const int axis = number % 3, next = (axis + 1) % 3, last = (axis + 2) % 3;

#pragma omp parallel for schedule(static)
	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				const int at[3] = {x, y, z};
				double value;

				if (number < 3) {
					value = slope(grid, fit->voxels, at, axis);
				} else {
					/* A point that is turned about the axis moves by axis x point. */
					const double p = grid->origin[next] + at[next] * grid->spacing[next];
					const double q = grid->origin[last] + at[last] * grid->spacing[last];

					value = 0.01 * (p * slope(grid, fit->voxels, at, last) -
							q * slope(grid, fit->voxels, at, next));
				}
				fit->derived[grid_voxel(grid, x, y, z)] = (float)value;
			}
}

static void keep_detail(const struct fit *fit, float *image, float *scratch)
{
	image_detail(image, fit->geometry.columns, fit->geometry.rows, FINE, fit->coarse, scratch, image);
}

static int thread_number(void)
{
#ifdef _OPENMP
	return omp_get_thread_num();
#else
	return 0;
#endif
}

/* The view's squares and products, weighted, over the residual's variance. */
static void add_up_view(struct fit *fit, int view)
{
	const int columns = fit->geometry.columns, rows = fit->geometry.rows;
	const size_t pixels = pixels_of(fit), apart = (size_t)fit->geometry.count * pixels;
	float *images = fit->images + (size_t)view * pixels;
	float *scratch = fit->scratch + 4 * pixels * (size_t)thread_number();
	double *products = fit->views[view].products, weights = 0, cut;
	int count = 0;

	memset(products, 0, PATH_PRODUCTS * sizeof(*products));
	for (int i = 0; i < IMAGES; i++)
		keep_detail(fit, images + (size_t)i * apart, scratch);
	for (int row = EDGE; row < rows - EDGE; row++)
		for (int column = EDGE; column < columns - EDGE; column++)
			scratch[count++] = fabsf(images[row * columns + column]);
	cut = 3 * MAD * (double)select_kth(scratch, count, count / 2) + 1e-9;
	for (int row = EDGE; row < rows - EDGE; row++)
		for (int column = EDGE; column < columns - EDGE; column++) {
			const float *pixel = images + row * columns + column;
			double value[IMAGES], weight;
			int at = 0;

			for (int i = 0; i < IMAGES; i++)
				value[i] = (double)pixel[(size_t)i * apart];
			weight = 1 / (1 + value[0] * value[0] / (cut * cut));
			weights += weight;
			for (int i = 0; i < IMAGES; i++)
				for (int j = 0; j <= i; j++)
					products[at++] += weight * value[i] * value[j];
		}
	weights /= ALIKE * products[0] + 1e-12;
	for (int i = 0; i < PATH_PRODUCTS; i++)
		products[i] *= weights;
}

/* One step of the path, from the volume as it is. */
static int step(struct fit *fit, struct path *path, struct error *err)
{
	const struct backend *backend = &backend_cpu;
	int code = find_residuals(fit, fit->used, fit->used_count, err);

	if (code == 0)
		code = backend->volume_download(fit->volume, 0, fit->grid.size[2], fit->voxels, err);
	for (int i = 0; i < PATH_NUMBERS && code == 0; i++) {
		derive(fit, i);
		code = backend->volume_upload(fit->work, fit->derived, err);
		if (code == 0)
			code = project(fit, fit->work, fit->used, fit->used_count, i + 1, err);
		if (code == 0)
			code = cancel_check(fit->watch->cancel, err);
	}
	if (code < 0)
		return code;
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < fit->used_count; i++) {
		add_up_view(fit, fit->used[i]);
		pulse_beat();
	}
	tell_work(fit, STEP_WORK);
	return path_step(path, fit->views, fit->geometry.count, EXPECTED[fit->kind], FACTOR, err);
}

/* Squares of the detail of each held-out view that the volume does not explain, and their sum. */
static int measure_held_out(struct fit *fit, double *ret_squares, double *ret_sum, struct error *err)
{
	const int columns = fit->geometry.columns, rows = fit->geometry.rows;
	int code = find_residuals(fit, fit->held, fit->held_count, err);

	*ret_sum = 0;
	for (int i = 0; i < fit->held_count && code == 0; i++) {
		float *image = fit->images + (size_t)fit->held[i] * pixels_of(fit);

		keep_detail(fit, image, fit->scratch);
		ret_squares[i] = 0;
		for (int row = EDGE; row < rows - EDGE; row++)
			for (int column = EDGE; column < columns - EDGE; column++)
				ret_squares[i] += pow((double)image[row * columns + column], 2);
		*ret_sum += ret_squares[i];
	}
	return code;
}

/* ---- the whole ---- */

/* What held-out views show unexplained without any motion, behind each level's iterations. */
static int run_still(struct fit *fit, double ret_sums[DOUBLINGS + 1], struct error *err)
{
	int code = place_views(fit, NULL, err);

	if (code == 0)
		code = backend_cpu.volume_fill(fit->volume, 0, err);
	for (int i = 0; i < WARM && code == 0; i++)
		code = iterate(fit, err);
	for (int level = 0; level <= DOUBLINGS && code == 0; level++) {
		for (int i = 0; i < STEPS && code == 0; i++)
			code = iterate(fit, err);
		if (code == 0)
			code = measure_held_out(fit, unexplained_at(fit, level), &ret_sums[level], err);
	}
	return code;
}

/* Keeps the path where it explains the held-out views better. */
static void judge(const struct fit *fit, const struct path *path, int level, double still, double moved, double *best,
		  struct refinement *refinement)
{
	const int values = (fit->geometry.columns - 2 * EDGE) * (fit->geometry.rows - 2 * EDGE) * fit->held_count;
	const double share = still > 0 ? sqrt(moved / still) : 1;
	const double *before = unexplained_at(fit, level), *after = unexplained_at(fit, DOUBLINGS + 1);
	int better = 0;

	for (int i = 0; i < fit->held_count; i++)
		better += after[i] < before[i];
	if (!(share < *best * (1 - BETTER)) || better < BETTER_VIEWS * fit->held_count)
		return;
	*best = share;
	refinement->path = *path;
	refinement->accepted = true;
	refinement->held_before = sqrt(still / values);
	refinement->held_after = sqrt(moved / values);
	refinement->better = better;
}

static int run(struct fit *fit, double length, struct refinement *refinement, struct error *err)
{
	const int knots = 3 + (int)ceil(length / KNOTS_APART);
	double still[DOUBLINGS + 1], best = 1;
	struct path path;
	int code = run_still(fit, still, err);

	path_open(&path, fit->kind == REFINE_GEOMETRY, length, knots < PATH_KNOTS_MOST ? knots : PATH_KNOTS_MOST);
	refinement->path = path;
	refinement->held_out = fit->held_count;
	if (code == 0)
		code = place_views(fit, NULL, err);
	if (code == 0)
		code = backend_cpu.volume_fill(fit->volume, 0, err);
	for (int i = 0; i < WARM && code == 0; i++)
		code = iterate(fit, err);
	for (int level = 0; level <= DOUBLINGS && code == 0; level++) {
		double moved = INFINITY;

		for (int i = 0; i < STEPS && code == 0; i++) {
			code = step(fit, &path, err);
			if (code == 0)
				code = place_views(fit, &path, err);
			if (code == 0)
				code = iterate(fit, err);
		}
		if (code == 0)
			code = measure_held_out(fit, unexplained_at(fit, DOUBLINGS + 1), &moved, err);
		if (code == 0)
			judge(fit, &path, level, still[level], moved, &best, refinement);
		path_double(&path);
	}
	return code;
}

int refine_find(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water,
		const struct refine_watch *watch, struct refinement *ret_refinement, struct error *err)
{
	struct refinement refinement = {.held_out = 0};
	struct fit fit;
	double length = 0;
	int code = describe(&fit, reduced, err);

	fit.watch = watch;
	fit.kind = kind;
	fit.tv.unit = mu_water / 1000;
	if (code == 0)
		code = allocate(&fit, err);
	if (code == 0)
		code = share_views_out(&fit, orbit, err);
	for (int i = 0; i < orbit->count; i++)
		length = fmax(length, refine_place(orbit, i));
	path_open(&refinement.path, kind == REFINE_GEOMETRY, length, 4);
	if (code == 0 && fit.held_count > 0 && fit.used_count >= VIEWS_LEAST / 2)
		code = run(&fit, length, &refinement, err);
	fit_clear(&fit);
	if (code == 0)
		*ret_refinement = refinement;
	return code;
}

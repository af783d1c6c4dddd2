/* One level of the refinement: see registration.h. */
#include "core/refine/registration.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "core/refine/detail.h"
#include "core/select.h"

enum { HELD_OUT = 8, SUBSETS = 10, EDGE = 4, IMAGES = REGISTRATION_IMAGES, TV_STEPS = 30 };
static const double FINE = 1, COARSE = 4, COARSE_CUT = 2.5; /* bins; COARSE_CUT of a body wider than the detector */
static const double FACTOR = 1.5;                           /* of a step: the volume follows each */
static const double FACTOR_REFERRED = 1;                    /* a reference does not */
static const double TV_ALPHA = 0.05;
static const double MAD = 1.4826;
/* What a body that goes on outside of the grid makes of `alike`. */
static const double ALIKE_CUT = 4;
static const double WIDE = 1.6, CUT_SHARE = 0.1;
/* Standard deviations about a view's columns, rows and beam: mm, and hundredths of a radian. */
static const double EXPECTED[REFINE_KINDS][PATH_NUMBERS] = {
    [REFINE_GEOMETRY] = {1, 1, .05, .1, .1, 2},
    [REFINE_MOTION] = {2, 2, 1, 4, 4, 5},
};

/* How much nearer to the source an object that moves may be, in the mean over the views: mm. A reference tells. */
static const double NEARER = 0.05;

/* A reference tells a tilt from a turn of the object, so that both may be larger. */
static const double EXPECTED_REFERRED[REFINE_KINDS][PATH_NUMBERS] = {
    [REFINE_GEOMETRY] = {2, 2, .5, 1, 1, 2},
    [REFINE_MOTION] = {2, 2, 2, 4, 4, 5},
};

static int host_threads(void)
{
#ifdef _OPENMP
	return omp_get_max_threads();
#else
	return 1;
#endif
}

static size_t pixels_of(const struct registration *fit)
{
	return (size_t)fit->geometry.columns * (size_t)fit->geometry.rows;
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

static void choose_grid(struct registration *fit, int bins)
{
	struct grid wide;
	struct error err;

	orbit_covering_grid(&fit->orbit, &fit->geometry, bins, &fit->grid);
	if (!fit->cut)
		return;
	wide = fit->grid;
	for (int a = 0; a < 2; a++) {
		wide.size[a] = (int)(WIDE * wide.size[a]);
		wide.origin[a] -= 0.5 * (wide.size[a] - fit->grid.size[a]) * wide.spacing[a];
	}
	if (grid_check_geometry(&wide, &fit->geometry, &err) == 0)
		fit->grid = wide;
}

static struct plan_options plan_options_of(const struct registration *fit)
{
	return (struct plan_options){.geometry = &fit->geometry,
				     .grid = &fit->grid,
				     .linearise = {.sample = SAMPLE_FLOAT32},
				     .sart = &fit->sart,
				     .tv = &fit->tv,
				     .reference_precision = true,
				     .no_samples = true};
}

static int describe(struct registration *fit, const struct registration_options *options, struct error *err)
{
	const struct reduced *reduced = options->reduced;
	int code;

	*fit = (struct registration){.reduced = reduced,
				     .backend = options->on == NULL ? NULL : options->on->backend,
				     .device = options->on == NULL ? NULL : options->on->device,
				     .kind = options->kind,
				     .watch = options->watch,
				     .referred = options->referred,
				     .cut = options->empty ? options->wide : is_cut(reduced)};
	code = geometry_copy(&fit->geometry, &reduced->geometry, err);
	if (code == 0)
		code = orbit_analyse(&fit->orbit, &fit->geometry, err);
	if (code < 0)
		return code;
	choose_grid(fit, options->bins);
	fit->sart = (struct sart_options){.relaxation = 1, .nonnegative = true};
	fit->tv = (struct tv_options){
	    .method = TV_PROXIMAL, .alpha = TV_ALPHA, .iterations = TV_STEPS, .unit = options->mu_water / 1000};
	return subsets_make(&fit->sart.subsets, &fit->orbit, SUBSETS, err);
}

void registration_clear(struct registration *fit)
{
	const struct backend *backend = fit->backend;

	if (backend != NULL) {
		backend->volume_free(fit->volume);
		backend->volume_free(fit->work);
		backend->stack_free(fit->measured);
		backend->stack_free(fit->made);
		backend->plan_free(fit->plan);
	}
	subsets_clear(&fit->sart.subsets);
	orbit_clear(&fit->orbit);
	geometry_clear(&fit->geometry);
	free(fit->voxels);
	free(fit->images);
	free(fit->views);
	free(fit->used);
}

/* Floats of voxels, derived; of images and scratch. */
static void count_floats(const struct registration *fit, size_t *ret_voxels, size_t *ret_images)
{
	*ret_voxels = 2 * grid_voxels(&fit->grid);
	*ret_images = ((size_t)IMAGES * (size_t)fit->geometry.count + 4 * (size_t)host_threads()) * pixels_of(fit);
}

int registration_add_bytes(const struct registration_options *options, struct refine_bytes *bytes, struct error *err)
{
	const struct backend *backend = options->on->backend;
	struct device *device = options->on->device;
	struct plan_bytes more = {0};
	struct registration fit;
	int code = describe(&fit, options, err);

	if (code == 0) {
		const struct plan_options plan = plan_options_of(&fit);

		code = backend->plan_bytes(device, &plan, &more, err);
	}
	if (code == 0) {
		const int columns = fit.geometry.columns, rows = fit.geometry.rows, count = fit.geometry.count;
		size_t voxels, images;

		/* Both volumes are the plan's own count: an iterate and its copy. */
		bytes->device +=
		    more.volumes + more.scratch + more.raw + 2 * backend->stack_bytes(device, columns, rows, count);
		bytes->host += more.host + (size_t)count * pixels_of(&fit) * sizeof(float);
		count_floats(&fit, &voxels, &images);
		bytes->aside += (voxels + images) * sizeof(float);
	}
	registration_clear(&fit);
	return code;
}

int registration_updates(const struct registration_options *options, double *ret_updates, struct error *err)
{
	struct registration fit;
	int code = describe(&fit, options, err);

	if (code == 0)
		*ret_updates = (double)grid_voxels(&fit.grid) * fit.geometry.count;
	registration_clear(&fit);
	return code;
}

static int allocate(struct registration *fit, struct error *err)
{
	const struct geometry *geometry = &fit->geometry;
	const struct backend *backend = fit->backend;
	const size_t count = (size_t)geometry->count;
	size_t voxels, images;
	int code;

	count_floats(fit, &voxels, &images);
	fit->voxels = malloc(voxels * sizeof(float));
	fit->images = malloc(images * sizeof(float));
	fit->views = calloc(count, sizeof(*fit->views));
	fit->used = malloc(2 * count * sizeof(*fit->used));
	if (fit->voxels == NULL || fit->images == NULL || fit->views == NULL || fit->used == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to refine %d views", geometry->count);
	fit->derived = fit->voxels + voxels / 2;
	fit->scratch = fit->images + IMAGES * count * pixels_of(fit);
	fit->held = fit->used + count;
	code = backend->stack_new(fit->device, geometry->columns, geometry->rows, geometry->count, &fit->made, err);
	if (code == 0)
		code = backend->stack_new(fit->device, geometry->columns, geometry->rows, geometry->count,
					  &fit->measured, err);
	if (code == 0)
		code = backend->volume_new(fit->device, &fit->grid, &fit->volume, err);
	return code == 0 ? backend->volume_new(fit->device, &fit->grid, &fit->work, err) : code;
}

/* Views that are held out, or not known, have no rays in the volume. */
static int share_views_out(struct registration *fit, const struct orbit *orbit, struct error *err)
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
		code = fit->backend->stack_upload(fit->measured, k, 1, mine->used ? view : fit->scratch, err);
	}
	return code;
}

int registration_open(struct registration *ret_fit, const struct registration_options *options, struct error *err)
{
	struct registration fit;
	int code = describe(&fit, options, err);

	if (code == 0)
		code = allocate(&fit, err);
	if (code == 0)
		code = share_views_out(&fit, options->orbit, err);
	if (code < 0)
		registration_clear(&fit);
	else
		*ret_fit = fit;
	return code;
}

/* ---- the volume ---- */

/* Moves the views as the path says, NULL: not at all. */
int registration_place(struct registration *fit, const struct path *path, struct error *err)
{
	const struct plan_options options = plan_options_of(fit);

	for (int k = 0; k < fit->geometry.count; k++) {
		double motion[PATH_NUMBERS] = {0};

		if (path != NULL)
			path_motion(path, fit->views[k].at, &fit->views[k].view, motion);
		fit->geometry.views[k] = view_of_moved(&fit->views[k].view, motion);
	}
	fit->backend->plan_free(fit->plan);
	fit->plan = NULL;
	return fit->backend->plan_new(fit->device, &options, &fit->plan, err);
}

int registration_iterate(struct registration *fit, struct error *err)
{
	const struct cancel *cancel = fit->watch == NULL ? NULL : fit->watch->cancel;
	struct iteration_sums sums;
	int code = fit->backend->sart_iterate(fit->plan, fit->measured, fit->volume, cancel, &sums, err);

	if (code == 0)
		code = fit->backend->tv(fit->plan, fit->volume, &fit->tv, cancel, err);
	return code;
}

/* ---- views beside the volume's projections ---- */

/* Projects a volume along these views, into image `image`. */
static int project(struct registration *fit, const struct volume *volume, const int *views, int count, int image,
		   struct error *err)
{
	float *to = fit->images + (size_t)image * (size_t)fit->geometry.count * pixels_of(fit);
	int code = fit->backend->project(fit->plan, volume, views, count, fit->made, err);

	return code == 0 ? fit->backend->stack_download(fit->made, 0, count, to, err) : code;
}

/* Image 0 becomes what the volume does not explain of these views. */
static int find_residuals(struct registration *fit, const int *views, int count, struct error *err)
{
	const size_t pixels = pixels_of(fit);
	int code = project(fit, fit->volume, views, count, 0, err);

	for (int i = 0; i < count && code == 0; i++) {
		const float *measured = fit->reduced->projections + (size_t)views[i] * pixels;
		float *to = fit->images + (size_t)i * pixels;

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
static void derive(struct registration *fit, int number)
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

static void keep_detail(const struct registration *fit, float *image, float *scratch)
{
	image_detail(image, fit->geometry.columns, fit->geometry.rows, FINE, fit->cut ? COARSE_CUT : COARSE, scratch,
		     image);
}

static int thread_number(void)
{
#ifdef _OPENMP
	return omp_get_thread_num();
#else
	return 0;
#endif
}

/* Squares and products of the i-th of the views in use, weighted, over the residual's variance. */
static void add_up_view(struct registration *fit, int used, double alike)
{
	const int columns = fit->geometry.columns, rows = fit->geometry.rows;
	const size_t pixels = pixels_of(fit), apart = (size_t)fit->geometry.count * pixels;
	float *images = fit->images + (size_t)used * pixels;
	float *scratch = fit->scratch + 4 * pixels * (size_t)thread_number();
	double *products = fit->views[fit->used[used]].products, weights = 0, cut;
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
	weights /= alike * (fit->cut ? ALIKE_CUT : 1) * products[0] + 1e-12;
	for (int i = 0; i < PATH_PRODUCTS; i++)
		products[i] *= weights;
}

/* One step of the path, from the volume as it is. */
int registration_step(struct registration *fit, struct path *path, double alike, struct error *err)
{
	const struct backend *backend = fit->backend;
	int code = find_residuals(fit, fit->used, fit->used_count, err);

	if (code == 0)
		code = backend->volume_download(fit->volume, 0, fit->grid.size[2], fit->voxels, err);
	for (int i = 0; i < PATH_NUMBERS && code == 0; i++) {
		derive(fit, i);
		code = backend->volume_upload(fit->work, fit->derived, err);
		if (code == 0)
			code = project(fit, fit->work, fit->used, fit->used_count, i + 1, err);
		if (code == 0)
			code = cancel_check(fit->watch == NULL ? NULL : fit->watch->cancel, err);
	}
	if (code < 0)
		return code;
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < fit->used_count; i++) {
		add_up_view(fit, i, alike);
		pulse_beat();
	}
	return path_step(path, fit->views, fit->geometry.count,
			 fit->referred ? EXPECTED_REFERRED[fit->kind] : EXPECTED[fit->kind],
			 fit->referred || fit->kind != REFINE_MOTION ? INFINITY : NEARER,
			 fit->referred ? FACTOR_REFERRED : FACTOR, err);
}

/* Squares of the detail of each held-out view that the volume does not explain, and their sum. */
int registration_measure(struct registration *fit, double *ret_squares, double *ret_sum, struct error *err)
{
	const int columns = fit->geometry.columns, rows = fit->geometry.rows;
	int code = find_residuals(fit, fit->held, fit->held_count, err);

	*ret_sum = 0;
	for (int i = 0; i < fit->held_count && code == 0; i++) {
		float *image = fit->images + (size_t)i * pixels_of(fit);

		keep_detail(fit, image, fit->scratch);
		ret_squares[i] = 0;
		for (int row = EDGE; row < rows - EDGE; row++)
			for (int column = EDGE; column < columns - EDGE; column++)
				ret_squares[i] += pow((double)image[row * columns + column], 2);
		*ret_sum += ret_squares[i];
	}
	return code;
}

int registration_alike(struct registration *fit, double *ret_alike, struct error *err)
{
	const int columns = fit->geometry.columns, rows = fit->geometry.rows;
	const size_t pixels = pixels_of(fit), apart = (size_t)fit->geometry.count * pixels;
	double products = 0, squares = 0;
	int code = project(fit, fit->volume, fit->held, fit->held_count, 1, err);

	for (int i = 0; i < fit->held_count && code == 0; i++) {
		const float *residual = fit->images + (size_t)i * pixels;
		float *made = fit->images + apart + (size_t)i * pixels;

		keep_detail(fit, made, fit->scratch);
		for (int row = EDGE; row < rows - EDGE; row++)
			for (int column = EDGE; column < columns - EDGE; column++) {
				const double value = (double)made[row * columns + column];

				products += value * (double)residual[row * columns + column];
				squares += value * value;
			}
	}
	if (code == 0)
		*ret_alike = squares > 0 ? 1 + products / squares : 0;
	return code;
}

double registration_bins(const struct registration *fit)
{
	return (double)(fit->geometry.columns - 2 * EDGE) * (fit->geometry.rows - 2 * EDGE) * fit->held_count;
}

/* ---- from one level to the next ---- */

float *registration_keep_volume(struct registration *fit, struct error *err)
{
	float *voxels = malloc(grid_voxels(&fit->grid) * sizeof(float));

	if (voxels == NULL)
		error_set(err, ERR_NO_MEMORY, "no memory for a volume of %d voxels a side", fit->grid.size[0]);
	else if (fit->backend->volume_download(fit->volume, 0, fit->grid.size[2], voxels, err) < 0) {
		free(voxels);
		voxels = NULL;
	}
	return voxels;
}

/* Where index `at` of a grid lies along another one: the voxel below, and the share of the one above. */
static int voxel_below(const struct grid *to, const struct grid *from, int axis, int at, double *ret_share)
{
	const double mm = to->origin[axis] + at * to->spacing[axis] - from->origin[axis];
	const double place = fmin(fmax(mm / from->spacing[axis], 0), from->size[axis] - 1);
	const int below = place < from->size[axis] - 1 ? (int)place : from->size[axis] - 2;

	*ret_share = place - below;
	return below;
}

/* fit->voxels becomes `voxels` of another grid, along one row. */
static void interpolate_row(struct registration *fit, const struct grid *grid, const float *voxels, int y, int z)
{
	double share[3];
	const int below_y = voxel_below(&fit->grid, grid, 1, y, &share[1]);
	const int below_z = voxel_below(&fit->grid, grid, 2, z, &share[2]);

	for (int x = 0; x < fit->grid.size[0]; x++) {
		const int below_x = voxel_below(&fit->grid, grid, 0, x, &share[0]);
		double sum = 0;

		for (int i = 0; i < 8; i++) {
			double weight = 1;

			for (int a = 0; a < 3; a++)
				weight *= i >> a & 1 ? share[a] : 1 - share[a];
			sum += weight * (double)voxels[grid_voxel(grid, below_x + (i & 1), below_y + (i >> 1 & 1),
								  below_z + (i >> 2 & 1))];
		}
		fit->voxels[grid_voxel(&fit->grid, x, y, z)] = (float)sum;
	}
}

int registration_start(struct registration *fit, const struct grid *grid, const float *voxels, struct error *err)
{
	if (voxels == NULL)
		return fit->backend->volume_fill(fit->volume, 0, err);
#pragma omp parallel for schedule(static)
	for (int z = 0; z < fit->grid.size[2]; z++)
		for (int y = 0; y < fit->grid.size[1]; y++)
			interpolate_row(fit, grid, voxels, y, z);
	return fit->backend->volume_upload(fit->volume, fit->voxels, err);
}

/* Trilinear at a point, mm; 0 beyond the outermost voxels. */
static double reference_at(const struct refine_reference *reference, const double point[3])
{
	const struct grid *grid = &reference->grid;
	double share[3], sum = 0;
	int below[3];

	for (int a = 0; a < 3; a++) {
		const double place = (point[a] - grid->origin[a]) / grid->spacing[a];

		if (!(place >= 0 && place <= grid->size[a] - 1))
			return 0;
		below[a] = place < grid->size[a] - 1 ? (int)place : grid->size[a] - 2;
		share[a] = place - below[a];
	}
	for (int i = 0; i < 8; i++) {
		double weight = 1;

		for (int a = 0; a < 3; a++)
			weight *= i >> a & 1 ? share[a] : 1 - share[a];
		sum += weight * (double)reference->voxels[grid_voxel(grid, below[0] + (i & 1), below[1] + (i >> 1 & 1),
								     below[2] + (i >> 2 & 1))];
	}
	return sum;
}

/* Eight places within each voxel stand for all of it. */
static void refer_row(struct registration *fit, const struct refine_reference *reference, int y, int z)
{
	const struct grid *grid = &fit->grid;

	for (int x = 0; x < grid->size[0]; x++) {
		const int at[3] = {x, y, z};
		double sum = 0;

		for (int i = 0; i < 8; i++) {
			double point[3];

			for (int a = 0; a < 3; a++)
				point[a] = grid->origin[a] + (at[a] + ((i >> a & 1) - 0.5) / 2) * grid->spacing[a];
			sum += reference_at(reference, point) / 8;
		}
		fit->voxels[grid_voxel(grid, x, y, z)] = (float)sum;
	}
}

int registration_refer(struct registration *fit, const struct refine_reference *reference, struct error *err)
{
#pragma omp parallel for schedule(static)
	for (int z = 0; z < fit->grid.size[2]; z++) {
		for (int y = 0; y < fit->grid.size[1]; y++)
			refer_row(fit, reference, y, z);
		pulse_beat();
	}
	return fit->backend->volume_upload(fit->volume, fit->voxels, err);
}

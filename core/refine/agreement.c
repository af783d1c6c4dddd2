/* Views beside the reprojection of the other ones: see agreement.h. */
#include "core/refine/agreement.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "core/fdk.h"
#include "core/refine/shift.h"

/* Half of fewer views than WHOLE_LEAST is not the object; of fewer than VIEWS_LEAST few share a ray. */
enum { HALVES = 2, WHOLE_LEAST = 64, VIEWS_LEAST = 32, BINS_LEAST = 24, MEASURED_LEAST = 24 };
static const double ARC_LEAST = 2.8; /* radians; a shorter arc's volume is too far from the object */
/* Bins at the isocentre, and sigmas, from which on the geometry is doubtful; bins from which on it is wrong. */
static const double DOUBTFUL = 0.09, BEYOND_SIGMA = 2, WRONG = 0.15;
/*
 * Bins below which nothing is said where truncation or half of a displaced detector's views make as much: what is
 * beyond the detector leaves short scans of exact circles .34 bins aside, small balls beside the axis up to .11.
 */
static const double CUT_SHORT = 0.5, DISPLACED = 0.15;
/*
 * What the shifts are of their doubts where views stand elsewhere, and the share that they are of what opposite rays
 * say of all detectors. Truncation and the faces of plates move parts of a view only: of 447 scans that fit those that
 * are cut reached 2.1, others 1.7. A flat that is off by 10 % along the columns moves the mean by .08 of what it
 * makes opposite rays say.
 */
static const double FIRM = 1.75, FIRM_CUT = 2.2, ASIDE_LEAST = 0.15;
/* The unexplained share from which on the geometry is wrong: what fits stays below .3, truncated and noisy or not. */
static const double UNEXPLAINED = 0.4;
/* radians. FDK's volume is none of the object's where rows lean by more: what fits has an unexplained share of .85 at 6
 * degrees, of less than .3 at 4.5. */
static const double LEANING_ROWS = 4 * M_PI / 180;

/* The reconstruction of half of the views, and of all of them. */
struct half {
	struct orbit orbit;
	struct grid grid;
	struct fdk_weights weights;
	struct plan *plan;
	struct fdk fdk;
	struct stack *measured, *made;               /* of all views, and of half of them */
	struct volume *volume, *whole, *own[HALVES]; /* of a half's views, of all, of each half's */
	const struct reduced *reduced;
	struct device *device;
	const struct cancel *cancel;
};

bool agreement_is_possible(const struct geometry *geometry, const struct orbit *orbit)
{
	return geometry->count >= VIEWS_LEAST && geometry->columns >= BINS_LEAST && geometry->rows >= BINS_LEAST &&
	       orbit->arc >= ARC_LEAST && orbit->field_of_view > 0;
}

static int half_of(int count)
{
	return (count + 1) / HALVES;
}

static struct plan_options plan_options_of(const struct half *half)
{
	struct plan_options options = {
	    .geometry = &half->reduced->geometry,
	    .grid = &half->grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = half->weights.columns,
	    .filter_response = half->weights.response,
	    .pad = {half->weights.pad[0], half->weights.pad[1]},
	    .extend = half->weights.extend,
	    .extended_response = half->weights.extended,
	    .axis = half->weights.axis,
	    .no_samples = true,
	};

	return options;
}

static int describe(struct half *half, const struct reduced *reduced, struct error *err)
{
	const struct geometry *geometry = &reduced->geometry;
	int code;

	*half = (struct half){.reduced = reduced};
	code = orbit_analyse(&half->orbit, geometry, err);
	if (code < 0)
		return code;
	orbit_covering_grid(&half->orbit, geometry, AGREEMENT_BINS_MOST, &half->grid);
	return fdk_weights_make(&half->weights, &half->orbit, geometry, WINDOW_HANN, 1, true, err);
}

static void half_clear(struct half *half)
{
	const struct backend *backend = &backend_cpu;

	backend->volume_free(half->volume);
	backend->volume_free(half->whole);
	for (int i = 0; i < HALVES; i++)
		backend->volume_free(half->own[i]);
	backend->stack_free(half->measured);
	backend->stack_free(half->made);
	fdk_clear(&half->fdk);
	backend->plan_free(half->plan);
	fdk_weights_clear(&half->weights);
	orbit_clear(&half->orbit);
	backend->close(half->device);
}

int agreement_bytes(const struct reduced *reduced, size_t *ret_bytes, struct error *err)
{
	const struct geometry *geometry = &reduced->geometry;
	const struct backend *backend = &backend_cpu;
	struct plan_bytes bytes = {0};
	struct half half;
	int code = describe(&half, reduced, err);

	if (code == 0) {
		const struct plan_options plan = plan_options_of(&half);

		code = backend->plan_bytes(NULL, &plan, &bytes, err);
	}
	if (code == 0)
		*ret_bytes =
		    (size_t)geometry->count * (size_t)geometry->columns * (size_t)geometry->rows * sizeof(float) +
		    breathing_bytes(reduced) + bytes.volumes + bytes.scratch + bytes.raw +
		    (2 + HALVES) * backend->volume_bytes(NULL, &half.grid) +
		    fdk_bytes(backend, NULL, geometry, half.weights.pad) +
		    backend->stack_bytes(NULL, geometry->columns, geometry->rows, geometry->count) +
		    backend->stack_bytes(NULL, geometry->columns, geometry->rows, half_of(geometry->count));
	half_clear(&half);
	return code;
}

/* The threads that the caller's other work on the host is shared among. */
static int host_threads(void)
{
#ifdef _OPENMP
	return omp_get_max_threads();
#else
	return 1;
#endif
}

static int open_half(struct half *half, struct error *err)
{
	const struct geometry *geometry = &half->reduced->geometry;
	const struct backend *backend = &backend_cpu;
	const struct plan_options plan = plan_options_of(half);
	int code = backend->open(0, &(struct device_options){.threads = host_threads()}, &half->device, err);

	if (code == 0)
		code = backend->plan_new(half->device, &plan, &half->plan, err);
	if (code == 0)
		code = fdk_open(&half->fdk, backend, half->device, half->plan, geometry, half->weights.pad, err);
	if (code == 0)
		code = backend->stack_new(half->device, geometry->columns, geometry->rows, geometry->count,
					  &half->measured, err);
	if (code == 0)
		code = backend->stack_new(half->device, geometry->columns, geometry->rows, half_of(geometry->count),
					  &half->made, err);
	if (code == 0)
		code = backend->volume_new(half->device, &half->grid, &half->volume, err);
	for (int i = 0; i < HALVES && code == 0; i++)
		code = backend->volume_new(half->device, &half->grid, &half->own[i], err);
	return code == 0 ? backend->volume_new(half->device, &half->grid, &half->whole, err) : code;
}

/* A volume made of all views but those of one half, from what half->measured holds. */
static int reconstruct(struct half *half, int without, struct volume *to, struct error *err)
{
	const struct backend *backend = &backend_cpu;
	const int count = half->reduced->geometry.count;
	int code = backend->volume_fill(to, 0, err);

	for (int k = 0; k < count && code == 0; k++) {
		if (k % HALVES != without && half->reduced->known[k])
			code = fdk_add(&half->fdk, k, k, half->measured, to, err);
		if (code == 0)
			code = cancel_check(half->cancel, err);
	}
	if (code == 0)
		code = fdk_flush(&half->fdk, half->measured, to, err);
	/* The weights are those of all views. */
	return code == 0 ? backend->volume_axpby(HALVES, to, 0, to, err) : code;
}

/*
 * The volumes that the halves of the views make of what they measured, own[without], and half->whole of all of them,
 * whose projections then take the place of what was measured; views: work.
 */
static int reconstruct_measured(struct half *half, int *views, struct error *err)
{
	const struct geometry *geometry = &half->reduced->geometry;
	const struct backend *backend = &backend_cpu;
	int code = backend->volume_fill(half->whole, 0, err);

	for (int without = 0; without < HALVES && code == 0; without++) {
		code = reconstruct(half, without, half->own[without], err);
		if (code == 0)
			code = backend->volume_axpby(1.0 / HALVES, half->own[without], 1, half->whole, err);
	}
	for (int k = 0; k < geometry->count; k++)
		views[k] = k;
	return code == 0 ? backend->project(half->plan, half->whole, views, geometry->count, half->measured, err)
			 : code;
}

/*
 * Reprojects the views of one half: from what the others made of the measured ones, and the whole volume less what the
 * others make of its projections, in one go since projections add up.
 */
static int reproject(struct half *half, int which, int *views, int *ret_count, struct error *err)
{
	const struct backend *backend = &backend_cpu;
	int code = reconstruct(half, which, half->volume, err);

	*ret_count = 0;
	for (int k = which; k < half->reduced->geometry.count; k += HALVES)
		views[(*ret_count)++] = k;
	if (code == 0)
		code = backend->volume_axpby(1, half->own[which], -1, half->volume, err);
	if (code == 0)
		code = backend->volume_axpby(1, half->whole, 1, half->volume, err);
	return code == 0 ? backend->project(half->plan, half->volume, views, *ret_count, half->made, err) : code;
}

/* What the others make of each view, [view][row][column]; views: work. */
static int predict(struct half *half, int *views, float *made, struct error *err)
{
	const struct geometry *geometry = &half->reduced->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	int code = reconstruct_measured(half, views, err);

	for (int which = 0; which < HALVES && code == 0; which++) {
		int count;

		code = reproject(half, which, views, &count, err);
		for (int i = 0; i < count && code == 0; i++)
			code = backend_cpu.stack_download(half->made, i, 1, made + (size_t)views[i] * pixels, err);
	}
	return code;
}

static int compare_views(const struct half *half, const float *made, struct view_agreement *ret_views,
			 struct error *err)
{
	const struct reduced *reduced = half->reduced;
	const struct geometry *geometry = &reduced->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	int failed = 0;

#pragma omp parallel for schedule(dynamic) reduction(min : failed)
	for (int k = 0; k < geometry->count; k++) {
		struct view_agreement *view = &ret_views[k];
		struct image_shift shift;
		struct error why;
		const int found = !reduced->known[k] ? 0
						     : image_shift_find(reduced->projections + (size_t)k * pixels,
									made + (size_t)k * pixels, geometry->columns,
									geometry->rows, &shift, &why);

		failed = found < failed ? found : failed;
		pulse_beat();
		if (found <= 0)
			continue;
		view->measured = true;
		view->unexplained = shift.unexplained;
		for (int a = 0; a < 2; a++) {
			view->shift[a] = shift.bins[a] * half->orbit.pixel_at_isocentre[a];
			view->sigma[a] = shift.sigma[a] * half->orbit.pixel_at_isocentre[a];
			view->doubt[a] = shift.doubt[a] * half->orbit.pixel_at_isocentre[a];
		}
	}
	return failed < 0 ? error_set(err, failed, "no memory to compare views of %d x %d bins", geometry->columns,
				      geometry->rows)
			  : 0;
}

/* The least share that half of the measured views do not exceed. */
static double median_unexplained(const struct agreement *agreement, int count)
{
	for (int k = 0; k < count; k++) {
		const struct view_agreement *view = &agreement->views[k];
		int below = 0, equal = 0;

		for (int i = 0; i < count && view->measured; i++) {
			const struct view_agreement *other = &agreement->views[i];

			below += other->measured && other->unexplained < view->unexplained;
			equal += other->measured && other->unexplained == view->unexplained;
		}
		if (view->measured && 2 * below < agreement->measured && 2 * (below + equal) >= agreement->measured)
			return view->unexplained;
	}
	return 0;
}

static void find_means(struct agreement *agreement, int views)
{
	for (int k = 0; k < views; k++)
		agreement->measured += agreement->views[k].measured;
	for (int k = 0; k < views; k++)
		for (int a = 0; a < 2 && agreement->views[k].measured; a++)
			agreement->mean[a] += agreement->views[k].shift[a] / agreement->measured;
}

/* What the shifts along an axis are of what parts of the views doubt. */
static void summarise_axis(struct agreement *agreement, int views, int axis, double shared)
{
	double squares = 0, doubts = 0;

	for (int k = 0; k < views; k++) {
		const struct view_agreement *view = &agreement->views[k];

		if (!view->measured)
			continue;
		squares += pow(view->shift[axis] - shared, 2);
		doubts += pow(view->doubt[axis], 2);
	}
	if (doubts > 0)
		agreement->firm = fmax(agreement->firm, sqrt(squares / doubts));
}

/*
 * Views that all lie aside along the rows by the same are those of an object that stands elsewhere; along columns they
 * are those of detectors aside, which opposite rays see better.
 */
static void summarise(struct agreement *agreement, const struct reduced *reduced)
{
	const double shared[2] = {opposite_rays_against_mean(&agreement->rays) ? agreement->mean[0] : 0,
				  agreement->mean[1]};
	double squares = 0, sigmas = 0;

	for (int k = 0; k < reduced->geometry.count; k++) {
		const struct view_agreement *view = &agreement->views[k];
		const double square = pow(view->shift[0] - shared[0], 2) + pow(view->shift[1] - shared[1], 2);

		if (!view->measured)
			continue;
		squares += square;
		sigmas += pow(view->sigma[0], 2) + pow(view->sigma[1], 2);
		if (sqrt(square) > agreement->worst_mm) {
			agreement->worst_mm = sqrt(square);
			agreement->worst = reduced->views[k];
		}
	}
	if (agreement->measured == 0)
		return;
	agreement->mm = sqrt(fmax(0, squares - sigmas) / agreement->measured);
	agreement->sigma_mm = sqrt(sigmas / agreement->measured);
	agreement->unexplained = median_unexplained(agreement, reduced->geometry.count);
	for (int a = 0; a < 2; a++)
		summarise_axis(agreement, reduced->geometry.count, a, shared[a]);
}

/* The rays that opposite views share, as the geometry says and as the shifts do. */
static int compare_opposite(const struct reduced *reduced, const struct orbit *orbit, struct agreement *agreement,
			    struct error *err)
{
	double(*shifts)[2] = calloc((size_t)reduced->geometry.count, sizeof(*shifts));
	int code;

	if (shifts == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the shifts of %d views", reduced->geometry.count);
	for (int k = 0; k < reduced->geometry.count; k++)
		for (int a = 0; a < 2; a++)
			shifts[k][a] = agreement->views[k].shift[a] / orbit->pixel_at_isocentre[a];
	code = opposite_rays_compare(reduced, orbit->frame[2], (const double(*)[2])shifts,
				     agreement->mean[0] / orbit->pixel_at_isocentre[0], &agreement->rays, err);
	free(shifts);
	return code;
}

/* True if the object goes beyond the first or the last column on more rows than those of a table or an arm. */
static bool is_cut(const struct reduced *reduced)
{
	const double outside = 0.1, few = 0.05; /* of the largest line integral, of the rows */
	const int columns = reduced->geometry.columns;
	const size_t rows = (size_t)reduced->geometry.count * (size_t)reduced->geometry.rows;
	float most = 0;
	size_t cut = 0;

	for (size_t i = 0; i < rows * (size_t)columns; i++)
		most = fmaxf(most, reduced->projections[i]);
	for (size_t i = 0; i < rows; i++) {
		const float *row = reduced->projections + i * (size_t)columns;

		cut += (double)fmaxf(row[0], row[columns - 1]) > outside * (double)most;
	}
	return (double)cut > few * (double)rows;
}

/* Holds the views against what the others make of them; views, made: work. */
static int compare_with_volume(struct half *half, int *views, float *made, struct agreement *agreement,
			       struct error *err)
{
	const struct reduced *reduced = half->reduced;
	int code = open_half(half, err);

	if (code == 0)
		code = backend_cpu.stack_upload(half->measured, 0, reduced->geometry.count, reduced->projections, err);
	if (code == 0)
		code = predict(half, views, made, err);
	if (code == 0)
		code = compare_views(half, made, agreement->views, err);
	if (code == 0)
		find_means(agreement, reduced->geometry.count);
	return code == 0 ? breathing_measure(reduced, made, !half->orbit.short_scan, &agreement->breathing, err) : code;
}

int agreement_measure(const struct reduced *reduced, const struct cancel *cancel, struct agreement *ret_agreement,
		      struct error *err)
{
	const struct geometry *geometry = &reduced->geometry;
	const size_t count = (size_t)geometry->count, pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	struct agreement agreement = {.views = calloc(count, sizeof(*agreement.views))};
	float *made = malloc(count * pixels * sizeof(*made));
	int *views = malloc(count * sizeof(*views));
	struct half half;
	int code = describe(&half, reduced, err);

	if (code == 0 && (agreement.views == NULL || made == NULL || views == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views in bins", geometry->count);
	half.cancel = cancel;
	if (code == 0 && geometry->count >= WHOLE_LEAST && half.orbit.tilt < LEANING_ROWS)
		code = compare_with_volume(&half, views, made, &agreement, err);
	if (code == 0)
		code = compare_opposite(reduced, &half.orbit, &agreement, err);
	if (code == 0) {
		summarise(&agreement, reduced);
		agreement.cut = is_cut(reduced);
		agreement.short_scan = half.orbit.short_scan;
		agreement.displaced = half.orbit.displaced;
	}
	half_clear(&half);
	free(made);
	free(views);
	if (code < 0)
		agreement_clear(&agreement);
	else
		*ret_agreement = agreement;
	return code;
}

bool agreement_is_known(const struct agreement *agreement)
{
	return agreement->measured >= MEASURED_LEAST;
}

bool agreement_is_aside(const struct agreement *agreement, double bin)
{
	const double aside = agreement->rays.aside * bin, mean = agreement->mean[0];

	return opposite_rays_aside(&agreement->rays) ||
	       (agreement_is_known(agreement) && opposite_rays_near_aside(&agreement->rays) && aside * mean > 0 &&
		fabs(mean) > fmax(ASIDE_LEAST * fabs(aside), DOUBTFUL * bin));
}

enum agreement_grade agreement_grade(const struct agreement *agreement, double bin)
{
	/* mm^2 is the mean square without that of sigma. */
	const double raw = hypot(agreement->mm, agreement->sigma_mm);
	const double least = agreement->cut && agreement->short_scan ? CUT_SHORT
			     : agreement->displaced                  ? DISPLACED
								     : DOUBTFUL;

	if (opposite_rays_other_way(&agreement->rays))
		return AGREEMENT_OTHER_WAY;
	if (opposite_rays_displaced(&agreement->rays) || agreement_is_aside(agreement, bin) ||
	    (agreement_is_known(agreement) && agreement->unexplained > UNEXPLAINED && !agreement->cut))
		return AGREEMENT_WRONG;
	if (!agreement_is_known(agreement) || agreement->mm < least * bin || raw < BEYOND_SIGMA * agreement->sigma_mm ||
	    opposite_rays_against_shifts(&agreement->rays) ||
	    (agreement->firm < (agreement->cut ? FIRM_CUT : FIRM) && !opposite_rays_shifted(&agreement->rays)))
		return AGREEMENT_GOOD;
	return agreement->mm < WRONG * bin ? AGREEMENT_DOUBTFUL : AGREEMENT_WRONG;
}

void agreement_clear(struct agreement *agreement)
{
	free(agreement->views);
	*agreement = (struct agreement){0};
}

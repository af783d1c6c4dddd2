/*
 * What tube, object and detector add to the counts: lag, from a convolution in time that is written down here, and
 * scatter, from a Monte Carlo simulation (montecarlo.h); what is left of both in volumes, and fits of their models.
 */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/lag.h"
#include "core/correct/scatter_body.h"
#include "core/correct/scatter_images.h"
#include "core/correct/scatter_spikes.h"
#include "core/fit/hardening.h"
#include "core/fit/lag.h"
#include "tests/unit/exposures.h"
#include "tests/unit/scene.h"

Suite *detector_suite(void);

static const double WATER = 0.0192, AIR = 50000, DARK = 300;

static struct recipe fdk_on(int nx, int nz, double spacing)
{
	struct grid grid = grid_of(nx, nx, nz, spacing, spacing, spacing);
	struct recipe recipe = recipe_on(&grid);

	recipe.fdk.on = true;
	return recipe;
}

static double hu(double attenuation)
{
	return 1000 * attenuation / WATER;
}

/* ---- lag ---- */

enum { COLUMNS = 72, ROWS = 40, PIXELS = COLUMNS * ROWS, VIEWS = 120 };
static const struct orbit_spec orbit = {COLUMNS, ROWS, VIEWS, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 3};
static const struct lag_model LAG = {4, {{0.012, 1.2}, {0.009, 6}, {0.006, 25}, {0.003, 120}}}; /* 3 % in all */

/* A body far off the axis, so that its edges sweep over the detector, with bone. */
static void make_scene(struct scene *ret)
{
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {40, 55, 60}, .centre = {15, -10, 0}, .density = WATER},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {12, 10, 30}, .centre = {35, 5, 0}, .density = WATER},
	};
	struct phantom phantom = {.count = 2, .parts = parts};

	scene_orbit(ret, &orbit);
	scene_add(ret, &phantom);
}

/*
 * Counts with what the detector keeps of all earlier frames, summed frame by frame: of a signal x, (1 - r) r^(k-1) of
 * each share comes k frames later.
 */
static float *counts_with_lag(const struct scene *scene, const struct lag_model *lag, bool dark)
{
	float *counts = malloc(sizeof(float) * PIXELS * VIEWS);
	double response[VIEWS] = {1}; /* frames after a signal of 1 */

	ck_assert_ptr_nonnull(counts);
	for (int k = 0; k < VIEWS; k++)
		for (int n = 0; n < lag->count; n++) {
			const double r = exp(-1 / lag->terms[n].frames);

			response[k] += lag->terms[n].share * (k == 0 ? -1 : (1 - r) * pow(r, k - 1));
		}
	for (int i = 0; i < PIXELS; i++) {
		double signal[VIEWS];

		for (int view = 0; view < VIEWS; view++) {
			double sum = dark ? DARK : 0;

			signal[view] = AIR * exp(-(double)scene->projections[view * PIXELS + i]);
			for (int before = 0; before <= view; before++)
				sum += response[view - before] * signal[before];
			counts[view * PIXELS + i] = (float)sum;
		}
	}
	return counts;
}

static double largest_difference(const float *a, const float *b, size_t count)
{
	double most = 0;

	for (size_t i = 0; i < count; i++)
		most = fmax(most, fabs((double)a[i] - (double)b[i]));
	return most;
}

START_TEST(lag_of_three_percent_leaves_no_ghost)
{
	const struct recipe recipe = fdk_on(48, 20, 3.2);
	struct outcome ideal = {0}, with = {0}, without = {0};
	float dark[PIXELS], flat[PIXELS];
	struct scene scene;
	float *counts;

	make_scene(&scene);
	run(&scene, &recipe, &ideal);
	counts = counts_with_lag(&scene, &LAG, true);
	for (int i = 0; i < PIXELS; i++) {
		dark[i] = (float)DARK;
		flat[i] = (float)(AIR + DARK);
	}
	with.samples = without.samples = counts;
	with.linearise = without.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
								.quantity = QUANTITY_INTENSITY,
								.image[IMAGE_FLAT] = flat,
								.image[IMAGE_DARK] = dark};
	with.linearise.lag = &LAG;
	run(&scene, &recipe, &without);
	run(&scene, &recipe, &with);
	/* Floats lie between the two; a voxel of the ghost is 5 HU at most, and was 20. */
	ck_assert_double_gt(hu(largest_difference(without.last, ideal.last, grid_voxels(&ideal.grid))), 15);
	ck_assert_double_lt(hu(largest_difference(with.last, ideal.last, grid_voxels(&ideal.grid))), 5);
	free(counts);
	outcome_clear(&ideal);
	outcome_clear(&with);
	outcome_clear(&without);
	scene_clear(&scene);
}
END_TEST

/* Pixels that say nothing stay what they were, in kind and number. */
START_TEST(corrected_counts_keep_their_defects)
{
	const struct recipe recipe = fdk_on(24, 10, 6.4);
	const struct scatter_model constant = {.fraction = 0.2};
	struct outcome plain = {0}, corrected = {0};
	uint16_t *samples = malloc(sizeof(uint16_t) * PIXELS * VIEWS);
	struct scene scene;

	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = (uint16_t)(AIR * exp(-(double)scene.projections[i]));
	samples[5 * PIXELS + 700] = 0;
	samples[6 * PIXELS + 701] = 65535;
	samples[7 * PIXELS + 702] = 65535;
	plain.samples = corrected.samples = samples;
	plain.linearise = corrected.linearise =
	    (struct linearise){.sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = AIR};
	corrected.linearise.lag = &LAG;
	corrected.linearise.scatter = &constant;
	run(&scene, &recipe, &plain);
	run(&scene, &recipe, &corrected);
	ck_assert_ptr_nonnull(strstr(plain.warnings, "3 samples"));
	ck_assert_ptr_nonnull(strstr(plain.warnings, "1 not above the dark, 2 saturated, 0 not finite"));
	ck_assert_ptr_nonnull(strstr(corrected.warnings, strstr(plain.warnings, "defects: ")));
	ck_assert_ptr_nonnull(strstr(corrected.warnings, "scatter_constant: "));
	outcome_clear(&plain);
	outcome_clear(&corrected);
	scene_clear(&scene);
	free(samples);
}
END_TEST

/* Of counts that are no number in half of every projection, too, whatever takes scatter or lag off the others. */
START_TEST(counts_that_are_no_number_are_told_so)
{
	const struct recipe recipe = fdk_on(24, 10, 6.4);
	const struct scatter_model models[] = {
	    {.fraction = 0.2}, {.count = 1, .kernels = {{.amplitude = 0.1, .power = 1, .width_mm = 100}}}};
	const struct lag_model *lags[] = {&LAG, NULL, NULL};
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS);
	struct outcome got = {.samples = samples};
	struct scene scene;

	ck_assert_ptr_nonnull(samples);
	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = i % COLUMNS < COLUMNS / 2 ? NAN : (float)(AIR * exp(-(double)scene.projections[i]));
	got.linearise = (struct linearise){.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR};
	got.linearise.lag = lags[_i];
	got.linearise.scatter = _i > 0 ? &models[_i - 1] : NULL;
	run(&scene, &recipe, &got);
	ck_assert_ptr_nonnull(strstr(got.warnings, "(50 %) in 120 projections"));
	ck_assert_ptr_nonnull(strstr(got.warnings, "0 not above the dark, 0 saturated, 172800 not finite"));
	outcome_clear(&got);
	scene_clear(&scene);
	free(samples);
}
END_TEST

START_TEST(lag_wants_views_in_the_order_of_time)
{
	const struct recipe recipe = fdk_on(24, 10, 6.4);
	struct outcome outcome = {0};
	struct scene scene;
	int order[VIEWS];

	make_scene(&scene);
	for (int i = 0; i < VIEWS; i++)
		order[i] = i < 2 ? 1 - i : i;
	outcome.order = order;
	outcome.linearise =
	    (struct linearise){.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR, .lag = &LAG};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_CONFLICT);
	ck_assert_str_eq(outcome.err.text, "projection 0 came behind projection 1: lag is of their order");
	outcome_clear(&outcome);
	outcome = (struct outcome){.linearise = {.sample = SAMPLE_FLOAT32, .lag = &LAG}};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_INVALID);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* A steady signal is the same before and behind frames that are missing, also before the first one. */
START_TEST(lag_bridges_missing_frames)
{
	const int first = _i == 0 ? 0 : 40, missing = 7;
	struct lag *lag = NULL;
	struct error err;
	double traps[4] = {0}, x = 1000;

	ck_assert_int_eq(lag_new(&LAG, 1, &lag, &err), 0);
	for (int k = 0; k < 90; k++) {
		double y = x;
		float signal;

		for (int n = 0; n < 4; n++) {
			const double r = exp(-1 / LAG.terms[n].frames);

			y += (1 - r) * traps[n] - LAG.terms[n].share * x;
			traps[n] = r * traps[n] + LAG.terms[n].share * x;
		}
		signal = (float)y;
		if (k < first || (k >= 60 && k < 60 + missing))
			continue;
		lag_take(lag, k, &signal);
		/* Frames that are missing are taken for as bright as the next one is with its lag. */
		ck_assert_double_eq_tol((double)signal, x, first == 0 && k < 60 ? 1e-3 : 0.003 * x);
	}
	lag_free(lag);
}
END_TEST

/* Frames before and behind the end of the beam, with the noise of a mean over many pixels. */
START_TEST(lag_is_fitted_from_the_end_of_the_beam)
{
	enum { FRAMES = 400, ON = 150 };
	double signal[FRAMES], traps[4] = {0};
	struct lag_fit fit;
	struct error err;

	for (int k = 0; k < FRAMES; k++) {
		const double x = k < ON ? 20000 : 0;

		signal[k] = x;
		for (int n = 0; n < 4; n++) {
			const double r = exp(-1 / LAG.terms[n].frames);

			signal[k] += (1 - r) * traps[n] - LAG.terms[n].share * x;
			traps[n] = r * traps[n] + LAG.terms[n].share * x;
		}
		signal[k] += 0.05 * sin(12.9898 * k * k);
	}
	ck_assert_msg(lag_fit(signal, FRAMES, ON, &fit, &err) == 0, "%s", err.text);
	ck_assert_double_lt(fit.left, 0.02 * fit.without);
	/* The terms are not unique, their response to a pulse is: the first frames of it, and all of the first 50. */
	for (int k = 1; k <= 50; k += 7) {
		double wanted = 0, got = 0;

		for (int n = 0; n < 4; n++)
			wanted += LAG.terms[n].share * (1 - exp(-1 / LAG.terms[n].frames)) *
				  exp(-(k - 1) / LAG.terms[n].frames);
		for (int n = 0; n < fit.model.count; n++)
			got += fit.model.terms[n].share * (1 - exp(-1 / fit.model.terms[n].frames)) *
			       exp(-(k - 1) / fit.model.terms[n].frames);
		ck_assert_double_eq_tol(got, wanted, 0.05 * wanted + 2e-6);
	}
	ck_assert_int_eq(lag_fit(signal, FRAMES, ON + 5, &fit, &err), ERR_IMPOSSIBLE);
	ck_assert_int_eq(lag_fit(signal, FRAMES, ON - 5, &fit, &err), ERR_IMPOSSIBLE);
	ck_assert_int_eq(lag_fit(signal, ON + 4, ON, &fit, &err), ERR_IMPOSSIBLE);
	for (int k = ON; k < FRAMES; k++)
		signal[k] = 0;
	ck_assert_int_eq(lag_fit(signal, FRAMES, ON, &fit, &err), ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(strstr(err.text, "there is no lag"));
}
END_TEST

/* ---- scatter ---- */

static const struct scatter_beam BEAM = {{4, 4}, 1100, 620, {49.5, 37.5}};
enum { ANGLES = 8, TURNS = 96 };
static const struct orbit_spec scattering = {WIDE, HIGH, TURNS, {620, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 3.75};

static struct geometry some_views(int count)
{
	struct orbit_spec spec = scattering;
	struct scene scene;

	spec.views = count;
	spec.step_deg = 360.0 / count;
	scene_orbit(&scene, &spec);
	free(scene.projections);
	return scene.geometry;
}

static void expose_all(int photons, int first, struct scatter_exposure ret[FITTED])
{
	struct geometry geometry = some_views(1);

	exposures_make(&geometry, photons, first, ret);
	geometry_clear(&geometry);
}

static void fit_scatter(const struct scatter_exposure exposures[FITTED], double scale, int kernels,
			struct scatter_fit *ret)
{
	struct error err;

	ck_assert_msg(exposures_fit(exposures, &BEAM, scale, kernels, ret, &err) == 0, "%s", err.text);
}

/* Scatter of some angles, [angle][cell]. */
static float *scatter_of(const struct phantom *phantom)
{
	struct geometry geometry = some_views(ANGLES);
	float *cells = malloc(sizeof(float) * ANGLES * CELLS);

	ck_assert_ptr_nonnull(cells);
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < ANGLES; i++)
		exposed_scatter(phantom, &geometry, i, 2500, 11, cells + (ptrdiff_t)i * CELLS);
	geometry_clear(&geometry);
	return cells;
}

/* Counts with scatter, between two of its angles. */
static float *counts_with_scatter(const struct scene *scene, const float *cells, double scale)
{
	float *counts = malloc(sizeof(float) * WIDE * HIGH * TURNS);

	ck_assert_ptr_nonnull(counts);
	for (int view = 0; view < TURNS; view++) {
		const double at = (double)view * ANGLES / TURNS;
		const int before = (int)at;
		const float *first = cells + before * CELLS;
		const float *second = cells + (before + 1) % ANGLES * CELLS;

		for (int i = 0; i < WIDE * HIGH; i++) {
			const int pixel = view * WIDE * HIGH + i;
			const double scatter = (1 - (at - before)) * cell_value(first, i % WIDE, i / WIDE) +
					       (at - before) * cell_value(second, i % WIDE, i / WIDE);

			counts[pixel] = (float)(AIR * (exp(-(double)scene->projections[pixel]) + scale * scatter));
		}
	}
	return counts;
}

/* The mean error in flat parts, HU. */
static double flat_error(const struct exposed_body *patient, const struct outcome *got, const struct outcome *ideal)
{
	double sum = 0;

	for (int i = 0; i < 4; i++)
		sum += hu(mean_near(got->last, &got->grid, patient->flat[i], patient->radius) -
			  mean_near(ideal->last, &ideal->grid, patient->flat[i], patient->radius)) /
		       4;
	return sum;
}

/* Objects that nothing was fitted on; whether a kernel takes their scatter off, and a model of a body. */
static const struct corrected {
	int body;
	bool by_kernel, by_body;
} corrected[] = {{EXPOSED_HEAD, true, false}, {EXPOSED_THIGH, true, true}, {EXPOSED_HEAD, false, true}};

/*
 * What is left in the flat parts of a scan with so much scatter, against the scan without; by one kernel, or a body. A
 * body is tried at the last level alone, where most is left.
 */
static void correct(const struct corrected *of, const struct scatter_exposure exposures[FITTED])
{
	const struct exposed_body *patient = &exposed_bodies[of->body];
	const double ratios[] = {0.2, 0.5, 1};
	const struct recipe recipe = fdk_on(52, 16, 4);
	const int amid = HIGH / 2 * WIDE + WIDE / 2;
	struct outcome ideal = {0};
	struct scene scene;
	float *cells = scatter_of(&patient->phantom);

	scene_orbit(&scene, &scattering);
	scene_add(&scene, &patient->phantom);
	run(&scene, &recipe, &ideal);
	for (int r = of->by_kernel ? 0 : 2; r < 3; r++) {
		const double primary = exp(-(double)scene.projections[amid]);
		const double scale = ratios[r] * primary / cell_value(cells, WIDE / 2, HIGH / 2);
		float *counts = counts_with_scatter(&scene, cells, scale);
		struct outcome without = {.samples = counts};
		double was;

		without.linearise =
		    (struct linearise){.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR};
		run(&scene, &recipe, &without);
		was = flat_error(patient, &without, &ideal);
		ck_assert_double_lt(was, -40);
		for (int kernels = r == 2 && of->by_body ? 0 : 1; kernels <= of->by_kernel; kernels++) {
			struct outcome with = {.samples = counts, .linearise = without.linearise};
			struct scatter_fit fit;
			double left;

			fit_scatter(exposures, scale, kernels, &fit);
			with.linearise.scatter = &fit.model;
			run(&scene, &recipe, &with);
			left = flat_error(patient, &with, &ideal);
			printf("%s, scatter of %.0f %% of the primary: %.1f HU without, %.1f HU with %s\n",
			       patient->name, 100 * ratios[r], was, left, kernels > 0 ? "a kernel" : "a body");
			ck_assert_msg(fabs(left) < 20, "%s, %.0f %%: %.1f HU are left of %.1f", patient->name,
				      100 * ratios[r], left, was);
			outcome_clear(&with);
		}
		outcome_clear(&without);
		free(counts);
	}
	outcome_clear(&ideal);
	scene_clear(&scene);
	free(cells);
}

/*
 * Scatter of 20, 50 and 100 % of the primary amid the first view, taken off with kernels, and a body, that were fitted
 * on other objects, of the same beam.
 */
START_TEST(scatter_is_taken_off_objects_that_its_model_was_not_fitted_on)
{
	struct scatter_exposure exposures[FITTED];

	expose_all(2500, 0, exposures);
	correct(&corrected[_i], exposures);
	exposures_clear(exposures);
}
END_TEST

static const int large[] = {EXPOSED_ABDOMEN, EXPOSED_PELVIS};

/*
 * A body that was fitted on bottles takes the scatter off far larger ones, in a wider beam over other distances: a
 * tenth of it is left at most amid them. A kernel leaves a third.
 */
START_TEST(a_body_holds_for_larger_ones_and_other_distances)
{
	enum { PITCH = 6, PHOTONS = 40000 };
	const struct scatter_beam beam = {{PITCH, PITCH}, 1500, 1000, {49.5, 37.5}};
	const struct orbit_spec spec = {WIDE, HIGH, 1, {1000, 1500, {PITCH, PITCH}, {0, 0}, {0, 0}}, 0, 1};
	struct scatter_exposure exposures[FITTED];
	struct scatter_fit fit;

	expose_all(10000, BOTTLES, exposures);
	fit_scatter(exposures, 1, 0, &fit);
	for (int body = 0; body < 2; body++) {
		const struct phantom *phantom = &exposed_bodies[large[body]].phantom;
		float cells[CELLS], total[WIDE * HIGH], line[WIDE];
		struct scatter *scatter;
		struct scene scene;
		struct error err;
		double most = 0;

		scene_orbit(&scene, &spec);
		scene_add(&scene, phantom);
		exposed_scatter(phantom, &scene.geometry, 0, PHOTONS, 5, cells);
		for (int i = 0; i < WIDE * HIGH; i++)
			total[i] = (float)(exp(-(double)scene.projections[i]) + cell_value(cells, i % WIDE, i / WIDE));
		ck_assert_int_eq(scatter_new(&fit.model, WIDE, HIGH, &beam, &scatter, &err), 0);
		scatter_estimate(scatter, total, 1);
		for (int row = HIGH / 4; row <= 3 * HIGH / 4; row += HIGH / 4) {
			scatter_row(scatter, row, line);
			for (int column = WIDE / 2 - 15; column <= WIDE / 2 + 15; column += 5) {
				const double wrong = cell_value(cells, column, row);

				most = fmax(most, fabs((double)line[column] / wrong - 1));
			}
		}
		printf("scatter of %.2f of the primary amid it: off by %.3f of it at most\n",
		       cell_value(cells, WIDE / 2, HIGH / 2) *
			   exp((double)scene.projections[HIGH / 2 * WIDE + WIDE / 2]),
		       most);
		ck_assert_double_lt(most, 0.1);
		scatter_free(scatter);
		scene_clear(&scene);
	}
	exposures_clear(exposures);
}
END_TEST

/* Semi-axes, along the beam and across it, of cylinders of water as high as the beam. */
static const struct {
	double along, across;
} cylinders[] = {{55, 55}, {80, 80}, {100, 130}, {130, 100}};

/* The way through a cylinder from a place onwards: beginning and end, from there, of the line towards a direction. */
static bool within_cylinder(int c, const double from[3], const double to[3], double ret[2])
{
	const double weight[2] = {1 / pow(cylinders[c].along, 2), 1 / pow(cylinders[c].across, 2)};
	double square = 0, both = 0, rest = -1;

	for (int i = 0; i < 2; i++) {
		square += weight[i] * to[i] * to[i];
		both += weight[i] * from[i] * to[i];
		rest += weight[i] * from[i] * from[i];
	}
	if (both * both < square * rest)
		return false;
	for (int i = 0; i < 2; i++)
		ret[i] = (-both + (i == 0 ? -1 : 1) * sqrt(both * both - square * rest)) / square;
	return true;
}

/*
 * Light that electrons at rest (Thomson) scatter once, summed over the body in cubes; the source on the x axis. At a
 * pixel so many mm aside of the detector's middle, against air there.
 */
static double scattered_once(int c, const struct scatter_beam *beam, const double field[2], double aside)
{
	enum { CUBE = 5 };
	const double pixel[3] = {beam->body_mm - beam->detector_mm, aside, 0}, source[3] = {beam->body_mm, 0, 0};
	const double ray = hypot(beam->detector_mm, aside);
	double sum = 0;

	for (double x = CUBE / 2.0 - cylinders[c].along; x < cylinders[c].along; x += CUBE)
		for (double y = CUBE / 2.0 - cylinders[c].across; y < cylinders[c].across; y += CUBE)
			for (double z = CUBE / 2.0 - field[1]; z < field[1]; z += CUBE) {
				const double at[3] = {x, y, z}, scale = beam->detector_mm / (beam->body_mm - x);
				double in[3], out[3], ends[2], far, near, cosine, light;

				if (pow(x / cylinders[c].along, 2) + pow(y / cylinders[c].across, 2) > 1 ||
				    fabs(y) * scale > field[0] || fabs(z) * scale > field[1])
					continue;
				for (int i = 0; i < 3; i++) {
					in[i] = at[i] - source[i];
					out[i] = pixel[i] - at[i];
				}
				near = vec_norm(in);
				far = vec_norm(out);
				for (int i = 0; i < 3; i++) {
					in[i] /= near;
					out[i] /= far;
				}
				cosine = vec_dot(in, out);
				ck_assert(within_cylinder(c, at, in, ends));
				light = exp(WATER * ends[0]) / (near * near);
				ck_assert(within_cylinder(c, at, out, ends));
				sum += light * exp(-WATER * ends[1]) * (1 + cosine * cosine) * -out[0] / (far * far);
			}
	return sum * pow(CUBE, 3) * WATER * 3 / (16 * M_PI) * pow(ray, 3) / beam->detector_mm;
}

/*
 * What a body scatters once is known: the model has it to 3 % behind and beside small and large ones, deep and wide
 * ones. Rays diverge, so that they meet a round body nearer to the source beside its middle than amid it.
 */
START_TEST(light_that_is_scattered_once_is_that_of_the_whole_body)
{
	enum { CELLS = 32, HIGH_CELLS = 24, FINE = 4 };
	const double width = 16, field[2] = {CELLS / 2 * width, HIGH_CELLS / 2 * width};
	const struct scatter_beam beam = {{width, width}, 1100, 620, {(CELLS - 1) / 2.0, (HIGH_CELLS - 1) / 2.0}};
	const int cells[2] = {CELLS, HIGH_CELLS};
	const struct scatter_body body = {.amplitude = 1};
	const double source[3] = {beam.body_mm, 0, 0};
	struct scatter_field *model = scatter_field_new(&beam, cells, cells);
	float p[CELLS * HIGH_CELLS], got[CELLS * HIGH_CELLS];

	ck_assert_ptr_nonnull(model);
	for (int cell = 0; cell < CELLS * HIGH_CELLS; cell++) {
		double mean = 0;

		for (int i = 0; i < FINE * FINE; i++) {
			const double u = (cell % CELLS + (i % FINE + 0.5) / FINE) * width - field[0];
			const double v =
			    ((double)(cell / CELLS) + ((double)(i / FINE) + 0.5) / FINE) * width - field[1];
			const double ray = sqrt(u * u + v * v + beam.detector_mm * beam.detector_mm);
			const double to[3] = {-beam.detector_mm / ray, u / ray, v / ray};
			double ends[2];

			mean += within_cylinder(_i, source, to, ends) ? exp(-WATER * (ends[1] - ends[0])) : 1;
		}
		p[cell] = (float)-log(mean / (FINE * FINE));
	}
	scatter_field_of(model, &body, p, got);
	for (int column = CELLS / 2; column < CELLS; column += 3) {
		const double aside = (column + 0.5) * width - field[0];
		const double wanted = scattered_once(_i, &beam, field, aside);
		const double found = (double)got[HIGH_CELLS / 2 * CELLS + column];

		printf("%.0f mm aside: %.5f of air, %.5f by the model\n", aside, wanted, found);
		ck_assert_double_lt(fabs(found / wanted - 1), 0.03);
	}
	scatter_field_free(model);
}
END_TEST

/* A detector that passes through the origin has no room for a body before it, as views or as matrices. */
START_TEST(a_body_has_no_room_before_a_detector_through_the_origin)
{
	enum { VIEWS = 12 };
	const double pixel_mm[2] = {2.54, 2.54};
	double matrices[12 * VIEWS];
	struct view views[VIEWS];
	struct geometry geometry;
	struct error err = {0};

	for (int k = 0; k < VIEWS; k++) {
		const double angle = 2 * M_PI * k / VIEWS, aside = pixel_mm[0] * 149 / 2, down = pixel_mm[1] * 119 / 2;

		views[k] = (struct view){.source = {620 * cos(angle), 620 * sin(angle), 0},
					 .pixel0 = {aside * sin(angle), -aside * cos(angle), -down},
					 .column_step = {-pixel_mm[0] * sin(angle), pixel_mm[0] * cos(angle), 0},
					 .row_step = {0, 0, pixel_mm[1]}};
		view_matrix(&views[k], matrices + 12 * k);
	}
	ck_assert_int_eq(geometry_views(&geometry, 150, 120, VIEWS, views, &err), 0);
	ck_assert_int_eq(scatter_body_check(&geometry, &err), ERR_IMPOSSIBLE);
	geometry_clear(&geometry);
	for (int k = 0; k < VIEWS; k++) {
		ck_assert_int_eq(geometry_matrices(&geometry, 150, 120, 1, matrices + 12 * k, pixel_mm, &err), 0);
		ck_assert_msg(scatter_body_check(&geometry, &err) == ERR_IMPOSSIBLE, "view %d", k);
		geometry_clear(&geometry);
	}
}
END_TEST

/* ---- images of scatter ---- */

enum { COARSE = 4, EVERY = 10, IMAGES_MOST = TURNS };
static const struct scatter_model IMAGES = {.images = {WIDE / COARSE, HIGH / COARSE, EVERY}};

/* Images of a scan's scatter, in memory. */
struct given_images {
	int projections[IMAGES_MOST];
	float *pixels;
	size_t each; /* floats */
	struct scatter_source source;
};

static int read_given(void *context, int at, float *ret_image, struct error *err)
{
	const struct given_images *given = context;

	(void)err;
	memcpy(ret_image, given->pixels + (size_t)at * given->each, given->each * sizeof(float));
	return 0;
}

/* Means of COARSE x COARSE pixels of what scatter adds to the counts, in those projections that have an image. */
static void make_images(const struct scene *scene, const float *counts, struct given_images *ret)
{
	const struct scatter_images *images = &IMAGES.images;
	const int count = scatter_images_count(images, TURNS);

	ret->each = (size_t)images->columns * (size_t)images->rows;
	ret->pixels = calloc((size_t)count * ret->each, sizeof(float));
	ck_assert_ptr_nonnull(ret->pixels);
	for (int k = 0; k < count; k++) {
		const int view = scatter_image_projection(images, TURNS, k);

		ret->projections[k] = view;
		for (int i = 0; i < WIDE * HIGH; i++) {
			const int pixel = view * WIDE * HIGH + i;
			const size_t at = (size_t)(i / WIDE / COARSE * images->columns + i % WIDE / COARSE);

			ret->pixels[(size_t)k * ret->each + at] +=
			    (float)((double)counts[pixel] - AIR * exp(-(double)scene->projections[pixel])) /
			    (COARSE * COARSE);
		}
	}
	ret->source = (struct scatter_source){
	    .context = ret, .projections = ret->projections, .count = count, .read = read_given};
}

static struct linearise with_images(const struct given_images *given)
{
	return (struct linearise){.sample = SAMPLE_FLOAT32,
				  .quantity = QUANTITY_INTENSITY,
				  .air = AIR,
				  .scatter = &IMAGES,
				  .scatter_source = &given->source};
}

/* Images of every tenth view, of 25 x 19 pixels, where scatter is 20, 50 and 100 % of the primary amid the first view.
 */
START_TEST(scatter_is_taken_off_by_coarse_images_of_some_views)
{
	const struct exposed_body *patient = &exposed_bodies[0];
	const double ratios[] = {0.2, 0.5, 1};
	const struct recipe recipe = fdk_on(52, 16, 4);
	const int amid = HIGH / 2 * WIDE + WIDE / 2;
	float *cells = scatter_of(&patient->phantom);
	struct outcome ideal = {0};
	struct scene scene;

	scene_orbit(&scene, &scattering);
	scene_add(&scene, &patient->phantom);
	run(&scene, &recipe, &ideal);
	for (int r = 0; r < 3; r++) {
		const double primary = exp(-(double)scene.projections[amid]);
		const double scale = ratios[r] * primary / cell_value(cells, WIDE / 2, HIGH / 2);
		float *counts = counts_with_scatter(&scene, cells, scale);
		struct outcome with = {.samples = counts};
		struct given_images given;
		double left;

		make_images(&scene, counts, &given);
		with.linearise = with_images(&given);
		run(&scene, &recipe, &with);
		left = flat_error(patient, &with, &ideal);
		printf("%s, scatter of %.0f %% of the primary: %.2f HU with images\n", patient->name, 100 * ratios[r],
		       left);
		ck_assert_msg(fabs(left) < 8, "%s, %.0f %%: %.1f HU are left", patient->name, 100 * ratios[r], left);
		ck_assert_ptr_null(strstr(with.warnings, "scatter_"));
		outcome_clear(&with);
		free(given.pixels);
		free(counts);
	}
	outcome_clear(&ideal);
	scene_clear(&scene);
	free(cells);
}
END_TEST

static int plane(void *context, int at, float *ret_image, struct error *err)
{
	const struct scatter_images *images = &IMAGES.images;

	(void)context;
	(void)err;
	for (int i = 0; i < images->columns * images->rows; i++)
		ret_image[i] = (float)(100 * at + COARSE * (i % images->columns) + 2 * COARSE * (i / images->columns));
	return 0;
}

/* The mean over n pixels of how far each is from the first centre of an image's pixels, as far as the last. */
static double mean_place(int first, int n, double most)
{
	double sum = 0;

	for (int i = first; i < first + n; i++)
		sum += fmin(fmax(i + 0.5 - 0.5 * COARSE, 0), most);
	return sum / n;
}

/* A plane that grows with the number stays one, on pixels and on blocks of them, up to the outermost centres. */
START_TEST(images_of_scatter_are_linear_in_between)
{
	const int numbers[] = {10, 20, 40}, detector[] = {WIDE, HIGH}, n = _i + 1;
	const struct scatter_source source = {.projections = numbers, .count = 3, .read = plane};
	const struct pixel_blocks blocks = {{n, n}, {_i, 0}, {WIDE / n - 1, HIGH / n}};
	/* Projections and what 100 times the image's place becomes, also backwards and beyond the first and the last.
	 */
	const double wanted[][2] = {{10, 0}, {15, 50}, {35, 175}, {40, 200}, {3, 0}, {90, 200}, {22, 110}};
	struct scatter_stack *stack;
	struct error err;
	float row[WIDE];

	ck_assert_int_eq(scatter_stack_new(&IMAGES.images, &source, &blocks, detector, &stack, &err), 0);
	for (size_t k = 0; k < sizeof(wanted) / sizeof(wanted[0]); k++) {
		ck_assert_int_eq(scatter_stack_take(stack, (int)wanted[k][0], &err), 0);
		for (int r = 0; r < blocks.count[1]; r++) {
			const double y = mean_place(r * n, n, HIGH - COARSE);

			scatter_stack_row(stack, r, row);
			for (int c = 0; c < blocks.count[0]; c++) {
				const double x = mean_place(_i + c * n, n, WIDE - COARSE);

				ck_assert_double_eq_tol((double)row[c], wanted[k][1] + x + 2 * y, 1e-3);
			}
		}
	}
	scatter_stack_free(stack);
	ck_assert_int_eq(
	    scatter_stack_new(&IMAGES.images, &(struct scatter_source){.count = 0}, &blocks, detector, &stack, &err),
	    ERR_IMPOSSIBLE);
}
END_TEST

/* Every projection has one, or knows between which two it lies, whatever their numbers. */
START_TEST(images_of_scatter_are_numbered)
{
	for (int projections = 1; projections < 30; projections++)
		for (int every = 1; every < 35; every++) {
			const struct scatter_images images = {8, 6, every};
			int found = 0;

			for (int k = 0; k < projections; k++) {
				const int image = scatter_image_of(&images, projections, k);

				ck_assert_int_eq(image >= 0, k % every == 0 || k == projections - 1);
				if (image < 0)
					continue;
				ck_assert_int_eq(image, found++);
				ck_assert_int_eq(scatter_image_projection(&images, projections, image), k);
			}
			ck_assert_int_eq(found, scatter_images_count(&images, projections));
		}
	ck_assert_int_eq(scatter_images_count(&(struct scatter_images){0}, 9), 0);
}
END_TEST

/* Pixels of the detector that no two have alike in an image of as many: a block has their mean, as it has of counts. */
static int rough(void *context, int at, float *ret_image, struct error *err)
{
	(void)context, (void)at, (void)err;
	for (int i = 0; i < WIDE * HIGH; i++)
		ret_image[i] = 100 + (float)(i * 7919 % 31);
	return 0;
}

START_TEST(a_block_has_the_mean_scatter_of_its_pixels)
{
	const int number = 0, detector[] = {WIDE, HIGH}, n = 2 + _i;
	const struct scatter_images images = {WIDE, HIGH, 1};
	const struct scatter_source source = {.projections = &number, .count = 1, .read = rough};
	const struct pixel_blocks blocks = {{n, n}, {1, 0}, {(WIDE - 1) / n, HIGH / n}};
	float fine[WIDE * HIGH], row[WIDE];
	struct scatter_stack *stack;
	struct error err;

	rough(NULL, 0, fine, &err);
	ck_assert_int_eq(scatter_stack_new(&images, &source, &blocks, detector, &stack, &err), 0);
	ck_assert_int_eq(scatter_stack_take(stack, 0, &err), 0);
	for (int r = 0; r < blocks.count[1]; r++) {
		scatter_stack_row(stack, r, row);
		for (int c = 0; c < blocks.count[0]; c++) {
			double sum = 0;

			for (int i = 0; i < n * n; i++)
				sum += (double)fine[(r * n + i / n) * WIDE + 1 + c * n + i % n];
			ck_assert_double_eq_tol((double)row[c], sum / (n * n), 1e-3);
		}
	}
	scatter_stack_free(stack);
}
END_TEST

enum { SPIKED_WIDE = 16, SPIKED_HIGH = 10, SPIKED = SPIKED_WIDE * SPIKED_HIGH };

/* Broad scatter that is steeper on one side, with noise of that share. */
static void make_broad(double noise, float *ret)
{
	unsigned state = 7;

	for (int i = 0; i < SPIKED; i++) {
		const double x = (i % SPIKED_WIDE + 0.5) / SPIKED_WIDE - 0.5,
			     y = (i / SPIKED_WIDE + 0.5) / SPIKED_HIGH - 0.5;
		double deviate = -6;

		for (int k = 0; k < 12; k++) {
			state = state * 1664525U + 1013904223U;
			deviate += (double)state / 4294967296.0;
		}
		ret[i] = (float)(5000 * (1 + 0.4 * x + 0.3 * y) * exp(-(x * x + y * y) / 0.5) * (1 + noise * deviate));
	}
}

/* A pixel or a block of 2 x 2, twice as much, and at the rim three times, up to all that a number holds, or nothing,
 * negative or no number: all are found, nothing else is, and what takes their place is near what was there. */
START_TEST(spikes_in_images_of_scatter_are_replaced)
{
	const float factors[] = {2, 3, 5, 1e34F, 0.3F, 0, -1, NAN};
	const double noises[] = {0, 0.03};
	float good[SPIKED], image[SPIKED];
	struct error err;
	double worst = 0;

	make_broad(noises[_i], good);
	for (int size = 1; size <= 2; size++)
		for (size_t f = 0; f < sizeof(factors) / sizeof(factors[0]); f++)
			for (int at = 0; at < SPIKED; at++) {
				const int c = at % SPIKED_WIDE, r = at / SPIKED_WIDE;
				/* At the rim twice as much may be a slope. */
				const int rim = factors[f] == 2 || factors[f] == 0.3F ? 2 : 0;
				size_t found;

				if (c + size > SPIKED_WIDE - rim || r + size > SPIKED_HIGH - rim || c < rim || r < rim)
					continue;
				memcpy(image, good, sizeof(image));
				for (int i = 0; i < size * size; i++)
					image[at + i / size * SPIKED_WIDE + i % size] *= factors[f];
				ck_assert_int_eq(scatter_spikes_replace(image, SPIKED_WIDE, SPIKED_HIGH, &found, &err),
						 0);
				ck_assert_msg(found == (size_t)(size * size),
					      "%zu spikes at %d, %d of size %d, times %g", found, c, r, size,
					      (double)factors[f]);
				for (int i = 0; i < SPIKED; i++)
					worst = fmax(worst, fabs((double)image[i] / (double)good[i] - 1));
			}
	printf("noise %.2f: what takes a spike's place is off by at most %.3f of it\n", noises[_i], worst);
	ck_assert_double_lt(worst, 0.05 + 5 * noises[_i]);
}
END_TEST

/* Noise, a shadow with a sharp rim, a slope to nothing, and one pixel: no spikes, and the bits stay. */
START_TEST(images_of_scatter_without_spikes_stay)
{
	float image[SPIKED], before[SPIKED];
	struct error err;
	size_t found;

	make_broad(_i == 0 ? 0.1 : _i == 1 ? 0.3 : 0, image);
	for (int i = 0; i < SPIKED; i++) {
		if (_i == 2 && (i % SPIKED_WIDE < 3 || i / SPIKED_WIDE > 7))
			image[i] = 0;
		if (_i == 3)
			image[i] = (float)(i % SPIKED_WIDE + 2 * (i / SPIKED_WIDE));
		if (_i == 4)
			image[i] *= expf(-0.4F * (float)(i % SPIKED_WIDE));
		if (_i == 5)
			image[i] = 0;
	}
	memcpy(before, image, sizeof(image));
	ck_assert_int_eq(
	    scatter_spikes_replace(image, _i == 6 ? 1 : SPIKED_WIDE, _i == 6 ? 1 : SPIKED_HIGH, &found, &err), 0);
	ck_assert_uint_eq(found, 0);
	ck_assert_mem_eq(image, before, sizeof(image));
}
END_TEST

/* Images that want nearly all of the signal, or in a unit that no count has; one that is empty amid others, and one in
 * another unit than that 19 degrees before it, or 38 degrees before and behind it: told. */
START_TEST(images_of_scatter_that_cannot_be_are_told)
{
	const struct recipe recipe = fdk_on(20, 8, 10);
	const float factors[] = {3e-5F, 40, 0, 4, 0.25F};
	const char *const told[] = {
	    "scatter_faint: ", "scatter_exceeds: ", "scatter_uneven: ", "scatter_uneven: ", "scatter_uneven: "};
	float cells[ANGLES * CELLS], *counts;
	struct outcome with = {0};
	struct given_images given;
	struct scene scene;

	scene_orbit(&scene, &scattering);
	scene_add(&scene, &exposed_bodies[1].phantom);
	for (int i = 0; i < ANGLES * CELLS; i++)
		cells[i] = 0.05F;
	counts = counts_with_scatter(&scene, cells, 1);
	make_images(&scene, counts, &given);
	for (size_t i = 0; i < given.each * (size_t)given.source.count; i++)
		if (_i < 2 || (int)(i / given.each) == (_i == 3 ? given.source.count - 1 : 3))
			given.pixels[i] *= factors[_i];
	with.samples = counts;
	with.linearise = with_images(&given);
	run(&scene, &recipe, &with);
	ck_assert_msg(strstr(with.warnings, told[_i]) != NULL, "%s is not told: %s", told[_i], with.warnings);
	ck_assert_int_eq(strstr(with.warnings, "scatter_uneven: ") != NULL, _i >= 2);
	outcome_clear(&with);
	scene_clear(&scene);
	free(given.pixels);
	free(counts);
}
END_TEST

/* ---- both, on their way through a reconstruction ---- */

static const struct scatter_model KERNEL = {.count = 1, .kernels = {{0.35, 0.1, 1.8, 290, 0.27}}};

/* Columns and rows exchanged. */
static float *exchanged(const float *images, int count, int columns, int rows)
{
	float *turned = malloc(sizeof(float) * (size_t)(columns * rows * count));

	ck_assert_ptr_nonnull(turned);
	for (int i = 0; i < columns * rows * count; i++) {
		const int image = i / (columns * rows), at = i % (columns * rows);

		turned[image * columns * rows + at % columns * rows + at / columns] = images[i];
	}
	return turned;
}

/* A detector that lies on its side: its rows stand where columns stood, and the volume is the same. */
START_TEST(a_turned_detector_is_corrected_alike)
{
	const struct recipe recipe = fdk_on(32, 12, 5);
	struct outcome upright = {0}, lying = {0};
	struct scene scene, turned = {0};
	float *counts, *turned_counts;
	struct error err;

	make_scene(&scene);
	counts = counts_with_lag(&scene, &LAG, false);
	turned_counts = exchanged(counts, VIEWS, COLUMNS, ROWS);
	ck_assert_int_eq(geometry_exchange(&turned.geometry, &scene.geometry, &err), 0);
	upright.samples = counts;
	lying.samples = turned_counts;
	upright.linearise = lying.linearise = (struct linearise){
	    .sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR, .lag = &LAG, .scatter = &KERNEL};
	run(&scene, &recipe, &upright);
	run(&turned, &recipe, &lying);
	ck_assert_double_lt(relative_error(lying.last, upright.last, grid_voxels(&upright.grid)), 1e-5);
	outcome_clear(&upright);
	outcome_clear(&lying);
	geometry_clear(&turned.geometry);
	scene_clear(&scene);
	free(counts);
	free(turned_counts);
}
END_TEST

/* Scatter goes with the tube's output: a tube that drifts leaves no trace where there is an air region. */
START_TEST(scatter_follows_each_views_own_air)
{
	const struct recipe recipe = fdk_on(32, 12, 5);
	struct outcome steady = {0}, drifting = {0};
	float *counts = malloc(sizeof(float) * PIXELS * VIEWS), *drifted = malloc(sizeof(float) * PIXELS * VIEWS);
	struct scene scene;

	ck_assert(counts != NULL && drifted != NULL);
	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++) {
		counts[i] = (float)(AIR * (exp(-(double)scene.projections[i]) + 0.03));
		drifted[i] = counts[i] * (1 - 0.4f * (float)(i / PIXELS) / VIEWS);
	}
	steady.samples = counts;
	drifting.samples = drifted;
	steady.linearise = drifting.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
								   .quantity = QUANTITY_INTENSITY,
								   .air = AIR,
								   .has_air_region = true,
								   .air_region = {0, 0, 2, ROWS - 1},
								   .scatter = &KERNEL};
	run(&scene, &recipe, &steady);
	run(&scene, &recipe, &drifting);
	ck_assert_double_lt(relative_error(drifting.last, steady.last, grid_voxels(&steady.grid)), 1e-3);
	outcome_clear(&steady);
	outcome_clear(&drifting);
	scene_clear(&scene);
	free(counts);
	free(drifted);
}
END_TEST

/* A run that goes on from an iterate gets the same projections, lag and all: the same bits. */
START_TEST(counts_are_corrected_again_in_a_run_that_goes_on)
{
	struct recipe recipe = fdk_on(24, 8, 6.5);
	struct outcome whole = {0}, first = {.yield_at = 2}, second = {0};
	struct scene scene;
	float *counts;

	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 4;
	make_scene(&scene);
	counts = counts_with_lag(&scene, &LAG, false);
	whole.samples = first.samples = second.samples = counts;
	whole.linearise = first.linearise = second.linearise = (struct linearise){
	    .sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR, .lag = &LAG, .scatter = &KERNEL};
	run(&scene, &recipe, &whole);
	scene_run(&scene, &recipe, &first);
	ck_assert_int_eq(first.code, ERR_BUSY);
	outcome_resume(&second, &first);
	run(&scene, &recipe, &second);
	ck_assert_mem_eq(second.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	outcome_clear(&second);
	outcome_clear(&first);
	outcome_clear(&whole);
	scene_clear(&scene);
	free(counts);
}
END_TEST

/* Steps of water as a beam of three energies hardens in them: the polynomial makes them straight. */
START_TEST(hardening_is_fitted_from_steps_of_water)
{
	const double share[] = {0.3, 0.5, 0.2}, attenuation[] = {0.0268, 0.0206, 0.0171};
	struct hardening_point points[12];
	struct hardening_fit fit;
	struct error err;
	double start = 0;

	for (int i = 0; i < 12; i++) {
		double left = 0;

		points[i].length = 20.0 * (i + 1);
		for (int e = 0; e < 3; e++)
			left += share[e] * exp(-attenuation[e] * points[i].length);
		points[i].p = -log(left);
	}
	for (int e = 0; e < 3; e++)
		start += share[e] * attenuation[e];
	ck_assert_msg(hardening_fit(points, 12, 3, 0, &fit, &err) == 0, "%s", err.text);
	ck_assert_int_eq(fit.count, 4);
	ck_assert_double_eq(fit.coefficients[0], 0);
	/* The beam's attenuation before it hardens, from steps that begin at 20 mm. */
	ck_assert_double_eq_tol(fit.attenuation, start, 0.03 * start);
	ck_assert_double_lt(fit.rms, 0.05 * fit.rms_without);
	/* A given attenuation, and steps between those of the fit. */
	ck_assert_int_eq(hardening_fit(points, 12, 3, 0.0192, &fit, &err), 0);
	for (double length = 30; length < 240; length += 20) {
		double left = 0, p = 0;

		for (int e = 0; e < 3; e++)
			left += share[e] * exp(-attenuation[e] * length);
		for (int k = 3; k >= 0; k--)
			p = p * -log(left) + fit.coefficients[k];
		ck_assert_double_eq_tol(p, 0.0192 * length, 0.004 * 0.0192 * length);
	}
	ck_assert_int_eq(hardening_fit(points, 3, 3, 0, &fit, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.text, "3 different lengths, a polynomial of degree 3 needs 4");
	points[4].p = -1;
	ck_assert_int_eq(hardening_fit(points, 12, 3, 0, &fit, &err), ERR_INVALID);
	ck_assert_str_eq(err.text, "point 4: a line integral of -1 behind 100 mm, both must be above 0");
}
END_TEST

/* Points on a straight line, but for noise. */
START_TEST(a_polynomial_that_is_of_no_use_is_refused)
{
	struct hardening_point points[12];
	struct hardening_fit fit;
	struct error err;

	for (int i = 0; i < 12; i++)
		points[i] = (struct hardening_point){20.0 * (i + 1), 0.02 * 20 * (i + 1) + (i % 2 ? 0.003 : -0.003)};
	ck_assert_int_eq(hardening_fit(points, 12, 2, 0.0192, &fit, &err), ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(strstr(err.text, "no hardening is seen"));
	ck_assert_int_eq(hardening_fit(points, 12, 1, 0.0192, &fit, &err), 0);
	ck_assert_double_eq_tol(fit.coefficients[1], 0.96, 1e-3);
	ck_assert_double_eq_tol(fit.rms, fit.rms_without, 1e-3 * fit.rms);
}
END_TEST

/* A signal that swings behind the end of the beam, and one that rises. */
START_TEST(a_lag_that_is_none_is_told)
{
	enum { FRAMES = 100, ON = 40 };
	double signal[FRAMES];
	struct lag_fit fit;
	struct error err;

	for (int k = 0; k < FRAMES; k++)
		signal[k] = k < ON ? 10000 : 2 + 40 * sin(2.9 * k);
	ck_assert_int_eq(lag_fit(signal, FRAMES, ON, &fit, &err), ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(strstr(err.text, "no sum of exponentials"));
	for (int k = 0; k < FRAMES; k++)
		signal[k] = k < ON ? 10000 : 40 + 0.5 * (k - ON);
	ck_assert_int_eq(lag_fit(signal, FRAMES, ON, &fit, &err), 0);
	ck_assert_msg(strstr(fit.at_limits, "of term 0") != NULL, "%s", fit.at_limits);
}
END_TEST

/*
 * Scatter that is the same all over the detector, so that a kernel's width ends at what it may be; and one that is
 * below 0, so that taking nothing off is best.
 */
START_TEST(a_fit_that_ends_at_its_limits_says_so)
{
	enum { PLATES = 4 };
	const double strong = _i == 0 ? 0.2 : -1e-5;
	float *all = malloc(sizeof(float) * 2 * PLATES * WIDE * HIGH);
	struct scatter_exposure exposures[PLATES];
	struct scatter_fit fit;
	struct error err;
	int code;

	ck_assert_ptr_nonnull(all);
	for (int i = 0; i < PLATES; i++) {
		float *total = all + (size_t)(2 * i) * WIDE * HIGH, *scatter = total + WIDE * HIGH;
		const double p = 0.5 * (i + 1);

		for (int k = 0; k < WIDE * HIGH; k++) {
			scatter[k] = (float)(strong * p * exp(-p));
			total[k] = (float)exp(-p) + scatter[k];
		}
		exposures[i] = (struct scatter_exposure){total, scatter};
	}
	code = scatter_fit(exposures, PLATES, WIDE, HIGH, &BEAM, _i == 0, &fit, &err);
	if (_i == 0) {
		ck_assert_msg(code == 0, "%s", err.text);
		ck_assert_msg(strstr(fit.at_limits, "width_mm 550") != NULL, "%s", fit.at_limits);
	} else {
		ck_assert_int_eq(code, ERR_IMPOSSIBLE);
		ck_assert_ptr_nonnull(strstr(err.text, "with the scatter left in"));
	}
	free(all);
}
END_TEST

Suite *detector_suite(void)
{
	Suite *suite = suite_create("detector");
	TCase *lag = tcase_create("lag"), *scatter = tcase_create("scatter"), *fits = tcase_create("fits");
	TCase *images = tcase_create("images"), *once = tcase_create("scattered once"), *longer = tcase_create("long");

	tcase_set_timeout(lag, 120);
	tcase_add_test(lag, lag_of_three_percent_leaves_no_ghost);
	tcase_add_test(lag, corrected_counts_keep_their_defects);
	tcase_add_loop_test(lag, counts_that_are_no_number_are_told_so, 0, 3);
	tcase_add_test(lag, lag_wants_views_in_the_order_of_time);
	tcase_add_loop_test(lag, lag_bridges_missing_frames, 0, 2);
	tcase_add_test(lag, lag_is_fitted_from_the_end_of_the_beam);
	tcase_add_test(lag, a_turned_detector_is_corrected_alike);
	tcase_add_test(lag, scatter_follows_each_views_own_air);
	tcase_add_test(lag, counts_are_corrected_again_in_a_run_that_goes_on);
	suite_add_tcase(suite, lag);
	tcase_set_timeout(scatter, 600);
	tcase_set_timeout(longer, 600);
	tcase_set_tags(longer, "long");
	tcase_add_loop_test(longer, scatter_is_taken_off_objects_that_its_model_was_not_fitted_on, 2, 3);
	suite_add_tcase(suite, longer);
	tcase_add_loop_test(scatter, scatter_is_taken_off_objects_that_its_model_was_not_fitted_on, 0, 2);
	tcase_add_test(scatter, a_body_holds_for_larger_ones_and_other_distances);
	suite_add_tcase(suite, scatter);
	tcase_set_timeout(once, 120);
	tcase_add_loop_test(once, light_that_is_scattered_once_is_that_of_the_whole_body, 0, 4);
	tcase_add_test(once, a_body_has_no_room_before_a_detector_through_the_origin);
	suite_add_tcase(suite, once);
	tcase_set_timeout(images, 120);
	tcase_add_test(images, scatter_is_taken_off_by_coarse_images_of_some_views);
	tcase_add_loop_test(images, images_of_scatter_are_linear_in_between, 0, 3);
	tcase_add_test(images, images_of_scatter_are_numbered);
	tcase_add_loop_test(images, a_block_has_the_mean_scatter_of_its_pixels, 0, 2);
	tcase_add_loop_test(images, spikes_in_images_of_scatter_are_replaced, 0, 2);
	tcase_add_loop_test(images, images_of_scatter_without_spikes_stay, 0, 7);
	tcase_add_loop_test(images, images_of_scatter_that_cannot_be_are_told, 0, 5);
	suite_add_tcase(suite, images);
	tcase_add_test(fits, hardening_is_fitted_from_steps_of_water);
	tcase_add_test(fits, a_polynomial_that_is_of_no_use_is_refused);
	tcase_add_test(fits, a_lag_that_is_none_is_told);
	tcase_add_loop_test(fits, a_fit_that_ends_at_its_limits_says_so, 0, 2);
	tcase_set_timeout(fits, 120);
	suite_add_tcase(suite, fits);
	return suite;
}

/* Pixels that do not follow their neighbours over the views (core/correct/stuck.h), and objects that look like some. */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/rings.h"
#include "core/correct/stuck.h"
#include "tests/unit/scene.h"

Suite *stuck_suite(void);

enum { COLUMNS = 96, ROWS = 64, PIXELS = COLUMNS * ROWS, VIEWS = 72, PARTS_MOST = 8 };
static const double FLAT = 60000;

/* What is scanned. */
enum object { HEAD, CENTRED, CENTRED_SHORT, METAL, BEADS, EDGES, NOTHING, OBJECTS };
static const char *const names[] = {"head",  "centred cylinder", "centred rod that ends", "metal", "beads",
				    "boxes", "nothing"};
static const struct ellipsoid objects[OBJECTS][PARTS_MOST] = {
    [HEAD] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {36, 44, 50}, .density = .045},
	      {.shape = SHAPE_ELLIPSOID, .semi_axes = {32, 40, 46}, .density = -.025},
	      {.shape = SHAPE_ELLIPSOID, .semi_axes = {6, 9, 8}, .centre = {12, -15, 6}, .density = -.01}},
    [CENTRED] = {{.shape = SHAPE_CYLINDER, .semi_axes = {30, 30, 200}, .density = .03},
		 {.shape = SHAPE_CYLINDER, .semi_axes = {29, 29, 200}, .density = -.01},
		 {.shape = SHAPE_CYLINDER, .semi_axes = {1, 1, 200}, .density = .2}},
    [CENTRED_SHORT] = {{.shape = SHAPE_CYLINDER, .semi_axes = {8, 8, 15}, .density = .04},
		       {.shape = SHAPE_ELLIPSOID, .semi_axes = {1, 1, 1}, .centre = {0, 0, 25}, .density = .3}},
    [METAL] = {{.shape = SHAPE_CYLINDER, .semi_axes = {35, 30, 40}, .density = .02},
	       {.shape = SHAPE_CYLINDER, .semi_axes = {1.5, 1.5, 18}, .centre = {14, 3, 5}, .density = .6},
	       {.shape = SHAPE_BOX, .semi_axes = {2, 12, 2}, .centre = {-10, -4, -8}, .density = .6}},
    [BEADS] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {.8, .8, .8}, .centre = {25, 3, 9}, .density = .5},
	       {.shape = SHAPE_ELLIPSOID, .semi_axes = {.8, .8, .8}, .centre = {3, -1, -9}, .density = .5},
	       {.shape = SHAPE_ELLIPSOID, .semi_axes = {.6, .6, .6}, .centre = {0, 1.5, 0}, .density = .5},
	       {.shape = SHAPE_ELLIPSOID, .semi_axes = {30, 25, 28}, .density = .02}},
    [EDGES] = {{.shape = SHAPE_BOX, .semi_axes = {20, 30, 20}, .centre = {5, 0, 0}, .density = .02},
	       {.shape = SHAPE_BOX, .semi_axes = {2, 2, 30}, .centre = {-22, 10, 0}, .density = .1},
	       {.shape = SHAPE_BOX, .semi_axes = {20, 30, .4}, .centre = {5, 0, 0}, .density = .1}},
};

static unsigned random_state;
static double uniform(void)
{
	random_state = random_state * 1664525u + 1013904223u;
	return (random_state >> 8) / 16777216.0;
}

/* Counts of one view, [row][column]; photons 0: exact. */
static void make_view(const struct scene *scene, int view, double photons, bool integers, void *ret)
{
	for (size_t i = 0; i < PIXELS; i++) {
		const double share = exp(-(double)scene->projections[(size_t)view * PIXELS + i]);
		double normal = -6, counts = FLAT * share;

		for (int k = 0; k < 12 && photons > 0; k++)
			normal += uniform();
		if (photons > 0)
			counts = fmax(FLAT / photons, counts + normal * FLAT * sqrt(share / photons));
		if (integers)
			((uint16_t *)ret)[i] = (uint16_t)lround(counts);
		else
			((float *)ret)[i] = (float)counts;
	}
}

/* How a pixel may be wrong: still at 70 % of the flat, at its own noise there, or at random between. */
enum fault { FINE, STILL, NOISY, FLICKERS, FAULTS };

static void spoil(enum fault fault, const bool *faulty, double photons, bool integers, void *samples)
{
	for (size_t i = 0; i < PIXELS; i++) {
		double counts = 0.7 * FLAT;

		if (!faulty[i] || fault == FINE)
			continue;
		if (fault == NOISY && photons > 0)
			counts += FLAT * sqrt(0.7 / photons) * (uniform() - 0.5) * 3.46;
		if (fault == FLICKERS)
			counts = FLAT * (0.05 + 0.9 * uniform());
		if (integers)
			((uint16_t *)samples)[i] = (uint16_t)lround(counts);
		else
			((float *)samples)[i] = (float)counts;
	}
}

struct trial {
	enum object object;
	enum fault fault;
	double photons;
	bool integers, line_integrals;
	double arc;  /* degrees */
	bool mapped; /* 2 % of the pixels and two columns hold anything, and the scan's map says so */
	bool beside; /* looked at by a thread of its own */
};

/* Runs it; counts the faulty pixels that were found, all faulty ones, and pixels that were found and are none. */
static void run_trial(const struct trial *trial, size_t ret[3])
{
	const struct orbit_spec spec = {COLUMNS,           ROWS, VIEWS, {620, 1100, {2, 2}, {0, 0}, {0, 0}}, 0,
					trial->arc / VIEWS};
	struct linearise linearise = {.sample = trial->integers ? SAMPLE_UINT16 : SAMPLE_FLOAT32,
				      .quantity = trial->line_integrals ? QUANTITY_LINE_INTEGRAL : QUANTITY_INTENSITY,
				      .air = FLAT};
	struct phantom phantom = {.parts = (struct ellipsoid *)objects[trial->object]};
	bool *faulty = calloc(PIXELS, sizeof(*faulty));
	unsigned char *mapped = calloc(PIXELS, 1);
	void *samples = malloc(PIXELS * sizeof(float));
	const unsigned char *map;
	struct stuck *stuck;
	struct scene scene;
	struct error err;

	random_state = 7;
	while (phantom.count < PARTS_MOST && phantom.parts[phantom.count].semi_axes[0] > 0)
		phantom.count++;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (size_t i = 0; i < PIXELS; i++)
		faulty[i] = trial->fault != FINE && uniform() < 0.01;
	for (size_t i = 0; i < PIXELS && trial->mapped; i++)
		mapped[i] = uniform() < 0.02 || i % COLUMNS / 2 == 15;
	if (trial->mapped)
		linearise.image[IMAGE_DEFECTS] = mapped;
	ck_assert_int_eq(stuck_new(&linearise, &scene.geometry, trial->beside, &stuck, &err), 0);
	ck_assert_ptr_nonnull(stuck);
	for (int view = 0; view < VIEWS; view++) {
		if (!stuck_wants(stuck, view))
			continue;
		make_view(&scene, view, trial->photons, trial->integers, samples);
		spoil(trial->fault, faulty, trial->photons, trial->integers, samples);
		for (size_t i = 0; i < PIXELS && trial->mapped; i++)
			if (mapped[i])
				((float *)samples)[i] = (float)(FLAT / 2);
		for (size_t i = 0; i < PIXELS && trial->line_integrals; i++)
			((float *)samples)[i] = -logf(((float *)samples)[i] / (float)FLAT);
		stuck_add(stuck, samples);
	}
	map = stuck_find(stuck);
	ret[0] = ret[1] = ret[2] = 0;
	for (size_t i = 0; i < PIXELS; i++) {
		const bool found = map != NULL && map[i];

		ret[0] += found && faulty[i];
		ret[1] += faulty[i] && !mapped[i];
		ret[2] += found && (!faulty[i] || mapped[i]);
	}
	stuck_free(stuck);
	free(mapped);
	free(samples);
	free(faulty);
	scene_clear(&scene);
}

static const double photons_of[] = {0, 1e3, 2e4, 1e6};

/* All objects, without noise and with much, on a full turn and a short scan, counts and line integrals. */
START_TEST(an_object_is_no_stuck_pixel)
{
	for (int object = 0; object < OBJECTS; object++)
		for (int form = 0; form < 4; form++) {
			const struct trial trial = {.object = (enum object)object,
						    .photons = photons_of[_i],
						    .integers = form == 1,
						    .line_integrals = form == 2,
						    .arc = form == 3 ? 200 : 360};
			size_t found[3];

			run_trial(&trial, found);
			ck_assert_msg(found[2] == 0, "%s, %g photons, form %d: %zu pixels", names[object],
				      trial.photons, form, found[2]);
		}
}
END_TEST

/* A number of its own for each call. */
static double between(double least, double most)
{
	return least + (most - least) * uniform();
}

/* One or two ellipsoids, cylinders or boxes, thin or thick, long or short, centred or not, for a field of view. */
static int random_parts(double field, double height, struct ellipsoid ret_parts[2])
{
	static const enum shape shapes[] = {SHAPE_ELLIPSOID, SHAPE_CYLINDER, SHAPE_BOX};
	const int count = uniform() < 0.5 ? 1 : 2;

	for (int k = 0; k < count; k++) {
		const double size = between(.1, 1.2) * field, aside = between(0, .35) * field, where = between(0, 6.28);
		const bool centred = uniform() < .3, round = uniform() < .3, is_long = uniform() < .4;

		ret_parts[k] = (struct ellipsoid){
		    .shape = shapes[(int)between(0, 2.999)],
		    .semi_axes = {size, round ? size : size * between(.2, 1),
				  is_long ? 500 : between(.2, 1.5) * height},
		    .centre = {centred ? 0 : aside * cos(where), centred ? 0 : aside * sin(where),
			       between(-.3, .3) * height},
		    .angle = between(0, 3.14),
		    .density = between(.01, .04),
		};
	}
	return count;
}

/* Exact line integrals of smooth objects on pixels of any size: an edge, a tip or an axis is no stuck pixel. */
START_TEST(no_pixel_size_makes_stuck_pixels)
{
	random_state = (unsigned)_i + 1;
	for (int scan = 0; scan < 100; scan++) {
		const int columns = (int)between(6, 96), rows = (int)between(5, 48), views = (int)between(8, 120);
		const double pixel = between(1, 300. / columns), radius = between(400, 800);
		const double arc = uniform() < .6 ? 360 : between(180, 240);
		const struct orbit_spec spec = {
		    columns, rows, views, {radius, 1100, {pixel, pixel}, {0, 0}, {0, 0}}, between(0, 360), arc / views};
		const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
		const size_t pixels = (size_t)columns * (size_t)rows;
		struct ellipsoid parts[2];
		struct phantom phantom = {.parts = parts};
		struct stuck *stuck;
		struct scene scene;
		struct error err;

		phantom.count = random_parts(radius * sin(atan(columns * pixel / 2200)), rows * pixel * .27, parts);
		scene_orbit(&scene, &spec);
		scene_add(&scene, &phantom);
		ck_assert_int_eq(stuck_new(&linearise, &scene.geometry, false, &stuck, &err), 0);
		ck_assert_ptr_nonnull(stuck);
		for (int view = 0; view < views; view++)
			if (stuck_wants(stuck, view))
				stuck_add(stuck, scene.projections + (size_t)view * pixels);
		ck_assert_msg(stuck_find(stuck) == NULL, "scan %d: %d views of %d x %d pixels of %.1f mm, %g degrees",
			      scan, views, columns, rows, pixel, arc);
		stuck_free(stuck);
		scene_clear(&scene);
	}
}
END_TEST

enum { SMALL_COLUMNS = 49, SMALL_ROWS = 33, SMALL_VIEWS = 40, SMALL = SMALL_COLUMNS * SMALL_ROWS };

/*
 * What is found in a scan of a few parts, line integrals with that noise; `spoiled` pixels hold `value` in all views,
 * or where that is NAN, nothing in half of the views, and noise in the others.
 */
static size_t find_in_arc(struct ellipsoid *parts, int count, double arc, double noise, const bool *spoiled,
			  float value)
{
	const struct orbit_spec spec = {
	    SMALL_COLUMNS, SMALL_ROWS, SMALL_VIEWS, {600, 1000, {2, 2}, {0, 0}, {0, 0}}, 0, arc / SMALL_VIEWS};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct phantom phantom = {.parts = parts, .count = count};
	const unsigned char *map;
	struct stuck *stuck;
	struct scene scene;
	struct error err;
	size_t found = 0;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	ck_assert_int_eq(stuck_new(&linearise, &scene.geometry, false, &stuck, &err), 0);
	for (int view = 0; view < SMALL_VIEWS; view++) {
		float *values = scene.projections + (size_t)view * SMALL;

		for (size_t i = 0; i < SMALL; i++)
			values[i] = spoiled == NULL || !spoiled[i]
					? values[i] + (float)(noise * (uniform() + uniform() + uniform() - 1.5) * 2)
				    : isnan(value) && uniform() < 0.5 ? 9 + (float)uniform()
								      : value;
		if (stuck_wants(stuck, view))
			stuck_add(stuck, values);
	}
	map = stuck_find(stuck);
	for (size_t i = 0; i < SMALL && map != NULL; i++)
		found += map[i];
	stuck_free(stuck);
	scene_clear(&scene);
	return found;
}

static size_t find_in_small(struct ellipsoid *parts, int count, double noise, const bool *spoiled, float value)
{
	return find_in_arc(parts, count, 360, noise, spoiled, value);
}

/* Its shadow stays on two pixels in turn, and each of them does what the other does not. */
START_TEST(a_bead_near_the_axis_is_no_stuck_pixel)
{
	random_state = 3;
	for (int bead = 0; bead < 40; bead++) {
		const double apart = between(.4, 4.5), where = between(0, 6.28), z = between(-12, 12);
		struct ellipsoid parts[2] = {
		    {.shape = SHAPE_CYLINDER, .semi_axes = {20, 20, 200}, .density = .02},
		    {.shape = SHAPE_ELLIPSOID,
		     .semi_axes = {.8, .8, .8},
		     .centre = {apart * cos(where), apart * sin(where), z},
		     .density = bead % 2 ? .4 : .12},
		};
		const size_t found = find_in_small(parts, 2, bead % 3 ? 0 : .01, NULL, 0);

		ck_assert_msg(found == 0, "%zu pixels: a bead %.2f mm off the axis, at %.1f mm", found, apart, z);
	}
}
END_TEST

/* Amid a short scan it stays on one pixel for a quarter of the views and more. */
START_TEST(a_bead_that_turns_back_is_no_stuck_pixel)
{
	random_state = 5;
	for (int bead = 0; bead < 200; bead++) {
		const double apart = between(5, 13), where = between(1, 2.6);
		struct ellipsoid part = {
		    .shape = SHAPE_ELLIPSOID,
		    .semi_axes = {between(.3, 1.2), between(.3, 1.2), between(.3, 1.2)},
		    .centre = {apart * cos(where), apart * sin(where), 1.2 * (int)between(-9, 9)},
		    .density = .08,
		};
		const size_t found = find_in_arc(&part, 1, bead % 2 ? 200 : 240, bead % 3 ? 0 : .003, NULL, 0);

		ck_assert_msg(found == 0, "%zu pixels: bead %d, %.2f mm off the axis", found, bead, apart);
	}
}
END_TEST

/* Bars in a ring about the axis, a polygon: the shadows of its two sides stay on a pixel each, whose own they are. */
START_TEST(a_coil_about_the_axis_is_no_stuck_pixel)
{
	for (int row = -2; row <= 2; row++)
		for (int form = 0; form < 4; form++) {
			enum { BARS = 12 };
			const double height = (row + .25 * form) * 1.2, radius = 25 + 1.1 * form;
			struct ellipsoid parts[BARS + 1] = {
			    {.shape = SHAPE_ELLIPSOID, .semi_axes = {18, 15, 14}, .density = .02}};
			size_t found;

			for (int k = 0; k < BARS; k++)
				parts[k + 1] = (struct ellipsoid){
				    .shape = SHAPE_BOX,
				    .semi_axes = {.5, 5.5, .5},
				    .centre = {radius * cos(k * M_PI / 6), radius * sin(k * M_PI / 6), height},
				    .angle = k * M_PI / 6,
				    .density = .17};
			found = find_in_small(parts, BARS + 1, 0, NULL, 0);
			ck_assert_msg(found == 0, "%zu pixels: %.2f mm about the axis, at %.2f mm", found, radius,
				      height);
		}
}
END_TEST

/*
 * Nothing else holds one value in all views: a dead column, a dead row, a dead patch, but for what is beside the body
 * where there is no noise; and nothing else says nothing in half of the views.
 */
START_TEST(pixels_that_never_change_are_found_together)
{
	enum { COLUMN, ROW, PATCH };
	static const struct {
		int kind;
		float value;
		double noise, share; /* of the pixels that are found at least */
	} rows[] = {{COLUMN, .6f, .01, .85}, {ROW, .6f, .01, .85},    {PATCH, .6f, .01, .85},
		    {COLUMN, .6f, 0, .85},   {COLUMN, 0, 0, .85},     {PATCH, 0, 0, 1},
		    {PATCH, .6f, 0, 1},      {COLUMN, NAN, .01, .85}, {COLUMN, NAN, 0, .85}};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {20, 16, 200}, .centre = {3, 2, 0}, .density = .02}};
	bool spoiled[SMALL];
	size_t all = 0, found;

	for (int i = 0; i < SMALL; i++) {
		const int column = i % SMALL_COLUMNS, row = i / SMALL_COLUMNS;

		spoiled[i] = rows[_i].kind == COLUMN ? column == 17
			     : rows[_i].kind == ROW  ? row == 12
						     : abs(column - 30) <= 2 && abs(row - 15) <= 2;
		all += spoiled[i];
	}
	found = find_in_small(parts, 1, rows[_i].noise, spoiled, rows[_i].value);
	ck_assert_msg(found <= all && (double)found >= rows[_i].share * (double)all, "%zu of %zu", found, all);
}
END_TEST

/*
 * 1 % of the pixels, but for corners, the axis where nothing moves, and what noise hides. Beside a faulty pixel one may
 * be taken for another.
 */
START_TEST(a_pixel_that_does_not_follow_is_found)
{
	for (int object = 0; object < OBJECTS; object++)
		for (int fault = STILL; fault < FAULTS; fault++) {
			const struct trial trial = {.object = (enum object)object,
						    .fault = (enum fault)fault,
						    .photons = photons_of[_i],
						    .integers = _i == 2,
						    .arc = 360};
			size_t found[3];

			run_trial(&trial, found);
			ck_assert_msg((double)found[0] >= (trial.photons == 1e3 ? 0.65 : 0.75) * (double)found[1],
				      "%s, %g photons, fault %d: %zu of %zu", names[object], trial.photons, fault,
				      found[0], found[1]);
			ck_assert_msg(found[2] <= 2, "%s, %g photons, fault %d: %zu wrong", names[object],
				      trial.photons, fault, found[2]);
		}
}
END_TEST

/* A map that is right makes no pixel beside its own a stuck one; most of those farther away are found. */
START_TEST(a_neighbour_of_mapped_pixels_is_judged_by_good_ones)
{
	for (int object = 0; object < OBJECTS; object++)
		for (int fault = FINE; fault < FAULTS; fault++) {
			const struct trial trial = {.object = (enum object)object,
						    .fault = (enum fault)fault,
						    .photons = photons_of[_i],
						    .arc = 360,
						    .mapped = true};
			size_t found[3];

			run_trial(&trial, found);
			ck_assert_msg((double)found[0] >= (trial.photons == 1e3 ? 0.5 : 0.6) * (double)found[1],
				      "%s, %g photons, fault %d: %zu of %zu", names[object], trial.photons, fault,
				      found[0], found[1]);
			ck_assert_msg(found[2] <= (fault == FINE ? 0 : 2), "%s, %g photons, fault %d: %zu wrong",
				      names[object], trial.photons, fault, found[2]);
		}
}
END_TEST

/* The buffer of a view is used again for the next one at once; what is found is the same. */
START_TEST(a_thread_of_its_own_finds_the_same)
{
	struct trial trial = {.object = 0, .fault = FINE + 1, .photons = 1e5, .arc = 360};
	size_t found[3], beside[3];

	run_trial(&trial, found);
	trial.beside = true;
	run_trial(&trial, beside);
	ck_assert_uint_gt(found[0], 0);
	ck_assert_mem_eq(found, beside, sizeof(found));
}
END_TEST

START_TEST(a_look_that_is_given_up_leaves_nothing_behind)
{
	const struct orbit_spec spec = {COLUMNS, ROWS, VIEWS, {620, 1100, {2, 2}, {0, 0}, {0, 0}}, 0, 360. / VIEWS};
	struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL};
	float *samples = calloc(PIXELS, sizeof(*samples));
	struct stuck *stuck;
	struct scene scene;
	struct error err;

	scene_orbit(&scene, &spec);
	for (int added = 0; added < 3; added++) {
		ck_assert_int_eq(stuck_new(&linearise, &scene.geometry, true, &stuck, &err), 0);
		for (int i = 0; i < added; i++)
			stuck_add(stuck, samples);
		stuck_free(stuck);
	}
	free(samples);
	scene_clear(&scene);
}
END_TEST

/* ---- errors of gain (core/correct/rings.h) ---- */

enum { DRIFT_COLUMNS = 256, DRIFT_ROWS = 160, DRIFT_PIXELS = DRIFT_COLUMNS * DRIFT_ROWS };

struct drift {
	enum object object;
	double photons; /* 0: no noise */
	int views;
	double arc;   /* degrees */
	double share; /* of the pixels whose gain is a per cent too large or too small */
	bool counts;  /* with a flat and a dark image, in place of line integrals */
};

/* Samples as they come, of all views. */
struct drifted {
	const struct geometry *geometry;
	float *samples; /* [view][row][column] */
	int reads;
};

static int read_rows(void *context, int view, int first, int rows, void *to, struct error *err)
{
	struct drifted *drifted = context;
	const size_t columns = (size_t)drifted->geometry->columns;

	(void)err;
	ck_assert(first >= 0 && rows > 0 && first + rows <= drifted->geometry->rows);
	memcpy(to, drifted->samples + ((size_t)view * (size_t)drifted->geometry->rows + (size_t)first) * columns,
	       (size_t)rows * columns * sizeof(float));
#pragma omp atomic
	drifted->reads++;
	return 0;
}

static int fail_to_read(void *context, int view, int first, int rows, void *to, struct error *err)
{
	(void)context;
	(void)first;
	(void)rows;
	(void)to;
	return view == 17 ? error_set(err, ERR_IO, "gone") : 0;
}

/*
 * Splitmix64 (Steele and others 2014): the linear generator above repeats itself from view to view where a view has a
 * power of two of samples.
 */
static uint64_t even_state;
static double even(void)
{
	uint64_t z = even_state += 0x9e3779b97f4a7c15u;

	z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
	z = (z ^ z >> 27) * 0x94d049bb133111ebu;
	return (double)((z ^ z >> 31) >> 11) / 9007199254740992.0;
}

static const float DARK_COUNTS = 300;

static float count_of(double integral, double photons)
{
	const double share = exp(-integral);
	double normal = -6;

	for (int k = 0; k < 12 && photons > 0; k++)
		normal += even();
	return (float)(FLAT * fmax(share + (photons > 0 ? normal * sqrt(share / photons) : 0), 1e-6));
}

/* The exact scan of what was asked for last is kept: drifts of the same object follow each other. */
static void make_drift_scene(const struct drift *drift, const struct orbit_spec *spec, struct scene *ret_scene)
{
	static struct scene kept;
	static struct drift of;
	struct phantom phantom = {.parts = (struct ellipsoid *)objects[drift->object]};

	if (kept.projections == NULL || of.object != drift->object || of.views != drift->views ||
	    of.arc != drift->arc) {
		while (phantom.count < PARTS_MOST && phantom.parts[phantom.count].semi_axes[0] > 0)
			phantom.count++;
		scene_clear(&kept);
		scene_orbit(&kept, spec);
		scene_add(&kept, &phantom);
		of = *drift;
	}
	scene_orbit(ret_scene, spec);
	memcpy(ret_scene->projections, kept.projections, sizeof(float) * DRIFT_PIXELS * (size_t)drift->views);
}

/* Root mean squares of the errors, of what is left of them, and of what was found where there is none. */
static void run_drift(const struct drift *drift, double ret[3], size_t *ret_false)
{
	const struct orbit_spec spec = {DRIFT_COLUMNS,
					DRIFT_ROWS,
					drift->views,
					{620, 1100, {.75, .75}, {0, 0}, {0, 0}},
					0,
					drift->arc / drift->views};
	float *images = malloc(2 * DRIFT_PIXELS * sizeof(*images)), *flat = images, *dark = images + DRIFT_PIXELS;
	float *errors = malloc(DRIFT_PIXELS * sizeof(*errors)), *mended;
	double *added = calloc(DRIFT_PIXELS, sizeof(*added));
	struct linearise linearise = {.sample = SAMPLE_FLOAT32,
				      .quantity = drift->counts ? QUANTITY_INTENSITY : QUANTITY_LINE_INTEGRAL};
	struct drifted drifted = {0};
	const struct rings_source source = {read_rows, &drifted};
	struct rings_found found;
	struct scene scene;
	struct error err;

	even_state = 11;
	make_drift_scene(drift, &spec, &scene);
	for (size_t i = 0; i < DRIFT_PIXELS; i++) {
		added[i] = even() < drift->share ? -log(1 + (even() < .5 ? .01 : -.01)) : 0;
		flat[i] = (float)(FLAT * (.8 + .4 * even())) + DARK_COUNTS;
		dark[i] = DARK_COUNTS;
	}
	for (int view = 0; view < drift->views; view++)
		for (size_t i = 0; i < DRIFT_PIXELS; i++) {
			float *p = scene.projections + (size_t)view * DRIFT_PIXELS + i;
			const double share = (double)count_of((double)*p, drift->photons) / FLAT;

			*p = drift->counts ? DARK_COUNTS + (flat[i] - DARK_COUNTS) * (float)(share * exp(-added[i]))
					   : (float)(-log(share) + added[i]);
		}
	if (drift->counts) {
		linearise.image[IMAGE_FLAT] = flat;
		linearise.image[IMAGE_DARK] = dark;
	}
	drifted.geometry = &scene.geometry;
	drifted.samples = scene.projections;
	ck_assert_int_eq(rings_find(&linearise, &scene.geometry, &source, NULL, errors, &found, &err), 0);
	ck_assert_int_ge(drifted.reads, drift->views);
	mended = rings_flat(&linearise, errors, DRIFT_PIXELS);
	ret[0] = ret[1] = ret[2] = 0;
	*ret_false = 0;
	for (size_t i = 0; i < DRIFT_PIXELS; i++) {
		const double e = (double)errors[i];

		ret[0] += added[i] * added[i] / DRIFT_PIXELS;
		ret[1] += (e - added[i]) * (e - added[i]) / DRIFT_PIXELS;
		ret[2] += added[i] == 0 ? e * e / DRIFT_PIXELS : 0;
		*ret_false += added[i] == 0 && e != 0;
		if (drift->counts)
			ck_assert_double_eq_tol(log((double)((flat[i] - DARK_COUNTS) / (mended[i] - DARK_COUNTS))), e,
						2e-6);
	}
	for (int i = 0; i < 3; i++)
		ret[i] = sqrt(ret[i]);
	free(mended);
	free(added);
	free(errors);
	free(images);
	scene_clear(&scene);
}

/*
 * A fifth of the errors at most is left, a quarter behind noise, of a full turn or a short scan; a sixth is the pixels
 * whose rays pass the axis, which are left alone.
 */
START_TEST(errors_of_gain_are_found)
{
	for (int form = 0; form < 4; form++) {
		const struct drift drift = {.object = HEAD,
					    .photons = _i * 2e4,
					    .views = 360,
					    .arc = form == 3 ? 200 : 360,
					    .share = form == 2 ? .02 : .005,
					    .counts = form == 1};
		double rms[3];
		size_t wrong;

		run_drift(&drift, rms, &wrong);
		ck_assert_msg(rms[1] <= (_i == 0 ? .2 : .25) * rms[0],
			      "%g photons, form %d: %.3f of the errors are left", drift.photons, form, rms[1] / rms[0]);
	}
}
END_TEST

/* Edges, tips, beads and metal, on the axis and aside, on full turns and short scans, with noise and without. */
START_TEST(an_object_is_no_error_of_gain)
{
	for (int object = 0; object < OBJECTS; object++)
		for (int noise = 0; noise < 2; noise++) {
			const struct drift drift = {.object = (enum object)object,
						    .photons = noise * 2e4,
						    .views = _i == 1 ? 64 : 120,
						    .arc = _i == 1 ? 200 : 360};
			double rms[3];
			size_t wrong;

			run_drift(&drift, rms, &wrong);
			ck_assert_msg(wrong <= 1, "%s, %g photons, form %d: %zu pixels", names[object], drift.photons,
				      _i, wrong);
		}
}
END_TEST

/* Full width at half maximum of the one wire in FDK's volume: the mean along x and y, mm. */
static double width_of_wire(const struct scene *scene, const double at[3])
{
	enum { SIDE = 41 };
	const double spacing = .1;
	struct recipe recipe;
	struct outcome outcome = {0};
	struct grid grid = grid_of(SIDE, SIDE, 1, spacing, spacing, spacing);
	const float *slice;
	double width = 0;
	int peak = 0;

	for (int a = 0; a < 3; a++)
		grid.origin[a] = at[a] - grid.size[a] / 2 * spacing;
	recipe = recipe_on(&grid);
	recipe.fdk.on = true;
	run(scene, &recipe, &outcome);
	slice = outcome_volume(&outcome, "final");
	for (int i = 0; i < SIDE * SIDE; i++)
		peak = slice[i] > slice[peak] ? i : peak;
	for (int axis = 0; axis < 2; axis++)
		for (int way = -1; way <= 1; way += 2) {
			const int stride = way * (axis == 0 ? 1 : SIDE);
			const float half = slice[peak] / 2;
			int i = peak;

			while (slice[i] > half) {
				ck_assert(i + stride >= 0 && i + stride < SIDE * SIDE);
				i += stride;
			}
			width += spacing / 2 *
				 ((double)(i - peak) / stride -
				  (double)((half - slice[i]) / (slice[i - stride] - slice[i])));
		}
	outcome_clear(&outcome);
	return width;
}

/* Behind the mending of errors, or of none, a wire is as wide as without errors, within a per cent. */
START_TEST(a_wire_stays_as_thin_as_it_is)
{
	static const double at[3] = {21, 6, 0};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {40, 34, 200}, .density = .02},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {.4, .4, 20}, .centre = {at[0], at[1], at[2]}, .density = .5},
	};
	const struct phantom phantom = {.count = 2, .parts = parts};
	const struct orbit_spec spec = {
	    DRIFT_COLUMNS, DRIFT_ROWS / 4, 240, {620, 1100, {.75, .75}, {0, 0}, {0, 0}}, 0, 1.5};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL};
	const size_t pixels = DRIFT_PIXELS / 4;
	float *errors = malloc(pixels * sizeof(*errors));
	struct drifted drifted;
	const struct rings_source source = {read_rows, &drifted};
	struct rings_found found;
	struct scene scene;
	struct error err;
	double before, after;
	size_t wrong = 0;

	even_state = 11;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	before = width_of_wire(&scene, at);
	for (size_t i = 0; i < pixels && _i == 1; i++) {
		const float error = even() < .005 ? -logf(even() < .5 ? 1.01f : .99f) : 0;

		wrong += error != 0;
		for (int view = 0; view < spec.views; view++)
			scene.projections[(size_t)view * pixels + i] += error;
	}
	drifted = (struct drifted){.geometry = &scene.geometry, .samples = scene.projections};
	ck_assert_int_eq(rings_find(&linearise, &scene.geometry, &source, NULL, errors, &found, &err), 0);
	if (_i == 1)
		ck_assert_uint_gt(3 * found.pixels, 2 * wrong);
	for (size_t i = 0; i < pixels * (size_t)spec.views; i++)
		scene.projections[i] -= errors[i % pixels];
	after = width_of_wire(&scene, at);
	ck_assert_msg(fabs(after / before - 1) < .01, "%.4f mm, mended %.4f mm, %zu pixels", before, after,
		      found.pixels);
	free(errors);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_view_that_cannot_be_read_is_told)
{
	const struct orbit_spec spec = {COLUMNS, ROWS, VIEWS, {620, 1100, {2, 2}, {0, 0}, {0, 0}}, 0, 360. / VIEWS};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL};
	const struct rings_source source = {fail_to_read, NULL};
	float *errors = malloc(PIXELS * sizeof(*errors));
	struct rings_found found;
	struct scene scene;
	struct error err;

	scene_orbit(&scene, &spec);
	ck_assert_int_eq(rings_find(&linearise, &scene.geometry, &source, NULL, errors, &found, &err), ERR_IO);
	ck_assert_str_eq(err.text, "gone");
	/* Too few views are not read at all. */
	scene.geometry.count = RINGS_VIEWS_LEAST - 1;
	ck_assert_int_eq(rings_find(&linearise, &scene.geometry, &source, NULL, errors, &found, &err), 0);
	ck_assert_uint_eq(found.pixels, 0);
	scene.geometry.count = VIEWS;
	free(errors);
	scene_clear(&scene);
}
END_TEST

Suite *stuck_suite(void)
{
	Suite *suite = suite_create("stuck");
	TCase *tests = tcase_create("tests"), *wires = tcase_create("wires"), *longer = tcase_create("long");

	tcase_set_timeout(tests, 0);
	tcase_add_loop_test(tests, an_object_is_no_stuck_pixel, 0, 4);
	tcase_add_loop_test(tests, no_pixel_size_makes_stuck_pixels, 0, 2);
	tcase_add_test(tests, a_bead_near_the_axis_is_no_stuck_pixel);
	tcase_add_test(tests, a_bead_that_turns_back_is_no_stuck_pixel);
	tcase_add_test(tests, a_coil_about_the_axis_is_no_stuck_pixel);
	tcase_add_loop_test(tests, pixels_that_never_change_are_found_together, 0, 9);
	tcase_add_loop_test(tests, a_pixel_that_does_not_follow_is_found, 0, 4);
	tcase_add_loop_test(tests, a_neighbour_of_mapped_pixels_is_judged_by_good_ones, 0, 4);
	tcase_add_test(tests, a_thread_of_its_own_finds_the_same);
	tcase_add_test(tests, a_look_that_is_given_up_leaves_nothing_behind);
	tcase_set_timeout(longer, 0);
	tcase_set_tags(longer, "long");
	tcase_add_loop_test(longer, errors_of_gain_are_found, 0, 1);
	tcase_add_loop_test(tests, errors_of_gain_are_found, 1, 2);
	tcase_add_loop_test(longer, an_object_is_no_error_of_gain, 0, 1);
	tcase_add_loop_test(tests, an_object_is_no_error_of_gain, 1, 2);
	tcase_add_test(tests, a_view_that_cannot_be_read_is_told);
	suite_add_tcase(suite, tests);
	tcase_set_timeout(wires, 0);
	tcase_add_loop_test(wires, a_wire_stays_as_thin_as_it_is, 0, 2);
	suite_add_tcase(suite, wires);
	suite_add_tcase(suite, longer);
	return suite;
}

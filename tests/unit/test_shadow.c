/* Edges of the detector that lie in shadow in all views (core/correct/shadow.h), and objects that look like some. */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/backend.h"
#include "core/correct/shadow.h"
#include "tests/unit/scene.h"

Suite *shadow_suite(void);

enum { COLUMNS = 80, ROWS = 48, PIXELS = COLUMNS * ROWS, VIEWS = 32, PARTS_MOST = 6 };
static const float FLAT = 60000;

/*
 * HEAD ends within the detector, WIDE nowhere; DISCS are seen edge on, as wide as the detector; the PLATE that a body
 * stands on is wider than the field and seen from above, the TUBE's wall lies just outside of it; a ROD stands in a
 * PIPE; the outside of the SHELLS, within the first of which the detector ends in the bone, lies beyond it.
 */
enum object {
	HEAD,
	WIDE,
	DISCS,
	METAL,
	FLAT_END,
	PLATE,
	TUBE,
	NEAR_TUBE,
	TUBE_ASIDE,
	BROAD_DISC,
	ROD_IN_PIPE,
	CUT_SHELL,
	CUT_SHELL_ASIDE,
	CUT_BOTTLE,
	OBJECTS
};
static const char *const names[] = {
    "head",          "wide body", "discs",       "metal",      "wide body that ends in the middle",
    "plate",         "tube",      "tube nearer", "tube aside", "disc",
    "rod in a pipe", "shell",     "shell aside", "bottle",
};
static const struct ellipsoid objects[OBJECTS][PARTS_MOST] = {
    [HEAD] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {72, 84, 110}, .density = .035},
	      {.shape = SHAPE_ELLIPSOID, .semi_axes = {66, 78, 104}, .density = -.016},
	      {.shape = SHAPE_ELLIPSOID, .semi_axes = {9, 7, 9}, .centre = {0, -45, -18}, .density = -.018}},
    [WIDE] = {{.shape = SHAPE_CYLINDER, .semi_axes = {150, 95, 250}, .density = .018},
	      {.shape = SHAPE_ELLIPSOID, .semi_axes = {40, 30, 25}, .centre = {-40, 10, 0}, .density = .004},
	      {.shape = SHAPE_CYLINDER, .semi_axes = {18, 15, 200}, .centre = {0, 50, 0}, .density = .012}},
    [DISCS] = {{.shape = SHAPE_CYLINDER, .semi_axes = {125, 100, 250}, .density = .0185},
	       {.shape = SHAPE_CYLINDER, .semi_axes = {70, 60, 4}, .centre = {0, 0, 30}, .density = .06},
	       {.shape = SHAPE_CYLINDER, .semi_axes = {70, 65, 3}, .centre = {0, 0, -32}, .density = .09}},
    [METAL] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {70, 80, 100}, .density = .02},
	       {.shape = SHAPE_CYLINDER, .semi_axes = {4, 4, 200}, .centre = {135, 0, 0}, .density = .4},
	       {.shape = SHAPE_BOX, .semi_axes = {140, 2, 200}, .centre = {0, 100, 0}, .density = .2}},
    [FLAT_END] = {{.shape = SHAPE_CYLINDER, .semi_axes = {200, 200, 100}, .centre = {0, 0, -104}, .density = .019}},
    [PLATE] = {{.shape = SHAPE_CYLINDER, .semi_axes = {60, 60, 30}, .density = .02},
	       {.shape = SHAPE_CYLINDER, .semi_axes = {200, 200, 60}, .centre = {0, 0, -90}, .density = .02}},
    [TUBE] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {72, 84, 110}, .density = .02},
	      {.shape = SHAPE_CYLINDER, .semi_axes = {130, 130, 400}, .density = .04},
	      {.shape = SHAPE_CYLINDER, .semi_axes = {122, 122, 400}, .density = -.04}},
    [NEAR_TUBE] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {72, 84, 110}, .density = .02},
		   {.shape = SHAPE_CYLINDER, .semi_axes = {115, 115, 400}, .density = .08},
		   {.shape = SHAPE_CYLINDER, .semi_axes = {112, 112, 400}, .density = -.08}},
    [TUBE_ASIDE] = {{.shape = SHAPE_ELLIPSOID, .semi_axes = {72, 84, 110}, .density = .02},
		    {.shape = SHAPE_CYLINDER, .semi_axes = {130, 130, 400}, .centre = {15, 0, 0}, .density = .04},
		    {.shape = SHAPE_CYLINDER, .semi_axes = {122, 122, 400}, .centre = {15, 0, 0}, .density = -.04}},
    [ROD_IN_PIPE] = {{.shape = SHAPE_CYLINDER, .semi_axes = {54, 54, 80}, .density = .0192},
		     {.shape = SHAPE_CYLINDER, .semi_axes = {40, 40, 80}, .density = -.0192},
		     {.shape = SHAPE_CYLINDER, .semi_axes = {16, 16, 80}, .density = .0205}},
    [CUT_SHELL] = {{.shape = SHAPE_CYLINDER, .semi_axes = {114, 114, 250}, .density = .0384},
		   {.shape = SHAPE_CYLINDER, .semi_axes = {103, 103, 250}, .density = -.0192}},
    [CUT_SHELL_ASIDE] =
	{{.shape = SHAPE_CYLINDER, .semi_axes = {114, 114, 250}, .centre = {1, 0, 0}, .density = .0384},
	 {.shape = SHAPE_CYLINDER, .semi_axes = {103, 103, 250}, .centre = {1, 0, 0}, .density = -.0192}},
    [CUT_BOTTLE] = {{.shape = SHAPE_CYLINDER, .semi_axes = {118, 118, 250}, .density = .0384},
		    {.shape = SHAPE_CYLINDER, .semi_axes = {104, 104, 250}, .density = -.0192},
		    {.shape = SHAPE_CYLINDER, .semi_axes = {20, 20, 250}, .centre = {30, 0, 0}, .density = .006}},
    [BROAD_DISC] = {{.shape = SHAPE_CYLINDER, .semi_axes = {60, 60, 50}, .density = .0192},
		    {.shape = SHAPE_CYLINDER, .semi_axes = {300, 300, 12}, .centre = {0, 0, -62}, .density = .0192}},
};

static unsigned random_state;
static double uniform(void)
{
	random_state = random_state * 1664525u + 1013904223u;
	return (random_state >> 8) / 16777216.0;
}

/* Pixels at each side that let only this share of the light through. */
struct leaf {
	int before[2], behind[2];
	double share;
};

static bool is_behind(const struct leaf *leaf, int column, int row)
{
	return column < leaf->before[0] || column >= COLUMNS - leaf->behind[0] || row < leaf->before[1] ||
	       row >= ROWS - leaf->behind[1];
}

/* Counts, or their line integrals. */
static void make_view(const struct scene *scene, int view, const struct leaf *leaf, double photons, bool integrals,
		      float *ret)
{
	for (size_t i = 0; i < PIXELS; i++) {
		const double through = is_behind(leaf, (int)(i % COLUMNS), (int)(i / COLUMNS)) ? leaf->share : 1;
		const double share = through * exp(-(double)scene->projections[(size_t)view * PIXELS + i]);
		double normal = -6;

		for (int k = 0; k < 12; k++)
			normal += uniform();
		ret[i] = (float)fmax(0, FLAT * (share + normal * sqrt((share + 1e-5) / photons)));
		if (integrals)
			ret[i] = -logf(fmaxf(ret[i], 1) / FLAT);
	}
}

/* Whether there is a shadow on a detector that is displaced by so many mm; line integrals where `integrals`. */
static int find(enum object object, const struct leaf *leaf, double displaced, double photons, double arc,
		bool integrals, struct shadow_found *ret_found)
{
	const struct orbit_spec spec = {COLUMNS, ROWS,       VIEWS, {620, 1100, {5, 5}, {displaced, 0}, {0, 0}},
					7,       arc / VIEWS};
	struct linearise linearise = {.quantity = integrals ? QUANTITY_LINE_INTEGRAL : QUANTITY_INTENSITY,
				      .air = (double)FLAT};
	struct phantom phantom = {.parts = (struct ellipsoid *)objects[object]};
	float *samples = malloc(PIXELS * sizeof(*samples));
	struct shadow *shadow;
	struct scene scene;
	struct error err;
	int code;

	backend_host_threads(1);
	random_state = 11;
	while (phantom.count < PARTS_MOST && phantom.parts[phantom.count].semi_axes[0] > 0)
		phantom.count++;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	ck_assert_int_eq(shadow_new(&linearise, &scene.geometry, VIEWS, &shadow, &err), 0);
	ck_assert_ptr_nonnull(shadow);
	for (int view = 0; view < VIEWS; view++) {
		make_view(&scene, view, leaf, photons, integrals, samples);
		shadow_add(shadow, samples);
	}
	code = shadow_find(shadow, ret_found, &err);
	ck_assert_int_ge(code, 0);
	shadow_free(shadow);
	free(samples);
	scene_clear(&scene);
	return code;
}

static const double photons_of[] = {3e3, 1e5};

/* Objects that a collimator stands before: exactly the pixels behind it are found, whatever it lets through. */
START_TEST(a_shadow_is_found_to_the_pixel)
{
	static const struct leaf leaves[] = {
	    {{14, 0}, {14, 0}, .3}, {{14, 0}, {14, 0}, 0}, {{2, 0}, {0, 0}, .1},   {{1, 0}, {3, 0}, .5},
	    {{0, 10}, {0, 9}, .02}, {{0, 0}, {0, 4}, .5},  {{10, 6}, {9, 7}, .05}, {{10, 6}, {9, 7}, 0},
	};
	static const enum object seen[] = {HEAD, WIDE, METAL, ROD_IN_PIPE};
	const struct leaf *leaf = &leaves[_i];

	for (size_t k = 0; k < sizeof(seen) / sizeof(*seen); k++)
		for (int noise = 0; noise < 2; noise++)
			for (int integrals = 0; integrals < 2; integrals++) {
				struct shadow_found found = {0};
				const int code = find(seen[k], leaf, 0, photons_of[noise], noise == 0 ? 200 : 360,
						      integrals == 1, &found);

				ck_assert_msg(code == 1 &&
						  memcmp(found.before, leaf->before, sizeof(found.before)) == 0 &&
						  memcmp(found.behind, leaf->behind, sizeof(found.behind)) == 0,
					      "%s, %g photons, leaf %d: columns %d %d, rows %d %d", names[seen[k]],
					      photons_of[noise], _i, found.before[0], found.behind[0], found.before[1],
					      found.behind[1]);
			}
}
END_TEST

/* Nothing is found without a shadow, nor where all that is seen is one. */
START_TEST(an_object_is_no_shadow)
{
	static const struct leaf none = {{0, 0}, {0, 0}, 1};

	for (int noise = 0; noise < 2; noise++)
		for (int integrals = 0; integrals < 2; integrals++) {
			struct shadow_found found;

			ck_assert_msg(find((enum object)_i, &none, 0, photons_of[noise], noise == 0 ? 200 : 360,
					   integrals == 1, &found) == 0,
				      "%s, %g photons: columns %d %d, rows %d %d", names[_i], photons_of[noise],
				      found.before[0], found.behind[0], found.before[1], found.behind[1]);
		}
}
END_TEST

/*
 * A detector that is displaced sees what looks the same from all sides end once on either side of the axis: it is no
 * shadow. A collimator is, on the near side of the axis as on the far one, and whatever it stands before.
 */
START_TEST(a_displaced_detector_sees_an_object_on_both_sides_of_the_axis)
{
	static const struct leaf none = {{0, 0}, {0, 0}, 1},
				 leaves[] = {{{6, 0}, {0, 0}, .3}, {{0, 0}, {5, 0}, .3}, {{12, 0}, {4, 5}, .05}};
	static const double displaced[] = {60, 90, 120, -90};
	struct shadow_found found;

	for (int integrals = 0; integrals < 2; integrals++) {
		for (int object = 0; object < OBJECTS; object++)
			ck_assert_msg(
			    find((enum object)object, &none, displaced[_i], 1e6, 360, integrals == 1, &found) == 0,
			    "%s: columns %d %d, rows %d %d", names[object], found.before[0], found.behind[0],
			    found.before[1], found.behind[1]);
		for (size_t i = 0; i < sizeof(leaves) / sizeof(*leaves); i++)
			ck_assert_msg(find(ROD_IN_PIPE, &leaves[i], displaced[_i], 1e6, 360, integrals == 1, &found) ==
					      1 &&
					  memcmp(found.before, leaves[i].before, sizeof(found.before)) == 0 &&
					  memcmp(found.behind, leaves[i].behind, sizeof(found.behind)) == 0,
				      "leaf %zu: columns %d %d, rows %d %d", i, found.before[0], found.behind[0],
				      found.before[1], found.behind[1]);
	}
}
END_TEST

Suite *shadow_suite(void)
{
	Suite *suite = suite_create("shadow");
	TCase *tests = tcase_create("shadow");

	tcase_set_timeout(tests, 60);
	tcase_add_loop_test(tests, a_shadow_is_found_to_the_pixel, 0, 8);
	tcase_add_loop_test(tests, an_object_is_no_shadow, 0, OBJECTS);
	tcase_add_loop_test(tests, a_displaced_detector_sees_an_object_on_both_sides_of_the_axis, 0, 4);
	suite_add_tcase(suite, tests);
	return suite;
}

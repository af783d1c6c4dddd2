/* Views that show nothing (core/correct/content.h) are told and left out, and views of an object are none of them. */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/content.h"
#include "core/correct/narrow.h"
#include "core/correct/steps.h"
#include "tests/unit/data.h"
#include "tests/unit/scene.h"

Suite *content_suite(void);

enum { COLUMNS = 48, ROWS = 32, PIXELS = COLUMNS * ROWS, VIEWS = 60, EVERY = 15, FIRST = 7 };
static const double AIR = 50000;

static unsigned random_state;
static double normal(void)
{
	double sum = -6;

	for (int k = 0; k < 12; k++) {
		random_state = random_state * 1664525u + 1013904223u;
		sum += (random_state >> 8) / 16777216.0;
	}
	return sum;
}

/* ---- the search itself ---- */

/* What the detector shows less of from view to view, or the other side of, is an object; a sudden gap is none. */
START_TEST(a_gap_among_views_of_an_object_is_found)
{
	enum { COUNT = 24 };
	static const struct {
		const char *structure; /* a digit for each view, tenths */
		double step, noise;    /* degrees; line integral */
		const char *empty;
	} rows[] = {
	    {"999999990999999999999999", 15, .02, "000000001000000000000000"},
	    {"999999990999999999999999", 15, .2, "000000000000000000000000"}, /* mostly noise */
	    {"099999999999999999999900", 15, 0, "100000000000000000000011"},  /* over the end of a full turn */
	    {"009999999999999999999990", 8, 0, "110000000000000000000001"},   /* at the ends of an arc */
	    {"999999641001469999999999", 15, 0, "000000000000000000000000"},  /* leaves and comes back */
	    {"999999900000000999999999", 15, 0, "000000000000000000000000"},  /* away for 120 degrees */
	    {"999999900000000999999999", 8, 0, "000000011111111000000000"},
	    {"000000000000000000000000", 15, .02, "000000000000000000000000"},
	    {"090909090909090909090909", 15, .02, "101010101010101010101010"}, /* every second pulse */
	    {"009009009009009009009009", 5, .02, "000000000000000000000000"},  /* too many */
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		const struct orbit_spec spec = {
		    8, 8, COUNT, {600, 1100, {10, 10}, {0, 0}, {0, 0}}, 30, _i ? -rows[i].step : rows[i].step};
		struct view_content views[COUNT];
		const bool skip[COUNT] = {false};
		bool empty[COUNT];
		struct scene scene;
		struct orbit orbit;
		struct error err;
		int found = 0;

		scene_orbit(&scene, &spec);
		ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
		for (int k = 0; k < COUNT; k++) {
			const float value = (float)(rows[i].structure[k] - '0') / 10;

			views[k] = (struct view_content){.structure = value,
							 .mean = value,
							 .noise = (float)rows[i].noise,
							 .plain = (double)value <= rows[i].noise};
			found += rows[i].empty[k] == '1';
		}
		ck_assert_int_eq(content_find_empty(views, skip, &orbit, empty, &err), found);
		for (int k = 0; k < COUNT; k++)
			ck_assert_msg(empty[k] == (rows[i].empty[k] == '1'), "row %zu, view %d", i, k);
		orbit_clear(&orbit);
		scene_clear(&scene);
	}
}
END_TEST

/* ---- views between two steps ---- */

/* What a pixel at column u, row v, 0 to 1, shows at an angle: an ellipsoid that lies aside of the axis, in air. */
static float body_at(double u, double v, double angle)
{
	const double x = (u - 0.5 - 0.08 * cos(angle)) / (0.3 + 0.08 * cos(2 * angle)), y = (v - 0.5) / 0.7;
	const double inside = 1 - x * x - y * y;

	return inside > 0 ? (float)(4 * sqrt(inside)) : 0;
}

/* A band of blocks from this column and row on that gives another signal, by so much; INFINITY: none. */
struct band {
	int first[2], end[2];
	double step;
};

/* aside: of the detector's width. */
static struct view_profile profile_at(double angle, const struct band *band, double share, double aside)
{
	enum { SAMPLES = OUTLIERS_SAMPLES, EACH = CONTENT_SAMPLES };
	struct profile_sums sums = {0};
	struct content_sums blocks = {0};
	int nothing = 0;

	for (int r = 0; r < SAMPLES; r++)
		for (int c = 0; c < SAMPLES; c++) {
			const int block = r / EACH * CONTENT_BLOCKS + c / EACH;
			float p = body_at((c + 0.5) / SAMPLES - aside, (r + 0.5) / SAMPLES, angle);

			if (share > 0 && c / EACH >= band->first[0] && c / EACH < band->end[0] &&
			    r / EACH >= band->first[1] && r / EACH < band->end[1])
				p = isinf(band->step) ? NAN : p + (float)(share * band->step);
			nothing += isnan(p);
			profile_add(&sums, c, r, block, p);
			if (!isnan(p)) {
				blocks.sum[block] += (double)p;
				blocks.count[block]++;
			}
		}
	return profile_of(&sums, &blocks, 0.01f, (double)nothing / (SAMPLES * SAMPLES));
}

#define LEFT_HALF                                                                                                      \
	{0, 0},                                                                                                        \
	{                                                                                                              \
		4, 8                                                                                                   \
	}
#define ALL_OF_IT                                                                                                      \
	{0, 0},                                                                                                        \
	{                                                                                                              \
		8, 8                                                                                                   \
	}
/* A run of views between two steps is found at its very ends, and what is no such run is not. */
START_TEST(views_between_two_steps_are_found)
{
	static const struct {
		struct band band;
		double apart; /* degrees; a full turn */
		int first, count, found;
		double ramp; /* share of the step in the first and the last view of the run */
	} rows[] = {
	    {{ALL_OF_IT, .69}, 3, 40, 30, 30, 1},   /* half of the dose */
	    {{ALL_OF_IT, -.69}, 3, 100, 40, 40, 1}, /* twice, over the end of the turn */
	    {{ALL_OF_IT, .69}, 3, 40, 70, 50, 1},   /* the fewer ones are told */
	    {{ALL_OF_IT, .1}, 3, 40, 30, 0, 1},     /* less than is told */
	    {{LEFT_HALF, 4.6}, 3, 40, 12, 12, 1},   /* a hundredth of the signal */
	    {{LEFT_HALF, 4.6}, 4, 61, 18, 18, 1},   /* over 76 degrees */
	    {{LEFT_HALF, 4.6}, 3, 40, 1, 1, 1},
	    {{LEFT_HALF, 4.6}, 3, 20, 41, 0, 1},       /* over 126 degrees */
	    {{{0, 0}, {8, 2}, 2}, 3, 30, 10, 10, 1},   /* a quarter of the rows */
	    {{{0, 0}, {8, 2}, .69}, 3, 30, 10, 10, 1}, /* with half of the signal */
	    {{{6, 0}, {8, 8}, -2}, 3, 30, 10, 10, 1},  /* a quarter of the columns */
	    {{{3, 0}, {5, 8}, 2}, 3, 30, 10, 10, 1},   /* a band that lies within */
	    {{{4, 0}, {6, 8}, .69}, 4, 30, 18, 18, 1}, /* with half of the signal */
	    {{{0, 3}, {8, 4}, .69}, 4, 30, 1, 1, 1},   /* an eighth of the rows of one view */
	    {{{4, 0}, {6, 8}, .1}, 4, 30, 18, 0, 1},
	    {{LEFT_HALF, .1}, 3, 40, 12, 0, 1},
	    {{LEFT_HALF, INFINITY}, 3, 40, 12, 12, 1},
	    {{LEFT_HALF, INFINITY}, 3, 40, 24, 24, 1}, /* over 75 degrees */
	    {{LEFT_HALF, INFINITY}, 3, 40, 41, 0, 1},  /* over 126 degrees */
	    {{{2, 0}, {5, 8}, INFINITY}, 3, 40, 12, 12, 1},
	    {{ALL_OF_IT, .69}, 12, 5, 6, 0, 1},   /* views that are too far apart */
	    {{LEFT_HALF, 4.6}, 3, 40, 12, 0, .4}, /* comes and goes */
	    {{ALL_OF_IT, 0}, 3, 0, 0, 0, 1},
	};
	const int views = (int)lround(360 / rows[_i].apart);
	const struct orbit_spec spec = {8, 8, views, {600, 1100, {10, 10}, {0, 0}, {0, 0}}, 30, rows[_i].apart};
	struct view_profile *profiles = calloc((size_t)views, sizeof(*profiles));
	struct step *steps = calloc((size_t)views, sizeof(*steps));
	bool *skip = calloc((size_t)views, sizeof(*skip));
	struct scene scene;
	struct orbit orbit;
	struct error err;

	scene_orbit(&scene, &spec);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	for (int i = 0; i < views; i++) {
		const int place = (i - rows[_i].first + views) % views;
		const bool is_in = place < rows[_i].count, at_end = place == 0 || place == rows[_i].count - 1;

		profiles[i] = profile_at((30 + i * rows[_i].apart) * acos(-1) / 180, &rows[_i].band,
					 !is_in   ? 0
					 : at_end ? rows[_i].ramp
						  : 1,
					 0);
	}
	ck_assert_int_eq(steps_find(profiles, NULL, NULL, skip, &orbit, steps, &err), rows[_i].found);
	for (int i = 0; i < views && rows[_i].found > 0 && 2 * rows[_i].count <= views; i++) {
		const bool is_in = (i - rows[_i].first + views) % views < rows[_i].count;

		ck_assert_msg((steps[i].kind != STEP_NONE) == is_in, "row %d: view %d", _i, i);
		if (!is_in)
			continue;
		for (int a = 0; a < 2; a++) {
			ck_assert_double_eq_tol(steps[i].first[a], rows[_i].band.first[a] / 8.0, 1e-9);
			ck_assert_double_eq_tol(steps[i].end[a], rows[_i].band.end[a] / 8.0, 1e-9);
		}
		if (!isinf(rows[_i].band.step))
			ck_assert_float_eq_tol(steps[i].level, (float)rows[_i].band.step,
					       .1f * fabsf((float)rows[_i].band.step));
	}
	orbit_clear(&orbit);
	scene_clear(&scene);
	free(profiles);
	free(steps);
	free(skip);
}
END_TEST

/* Bands of a few columns or rows of a detector of 300 x 200 pixels are found at their very ends; two rods that turn
 * with the body, or the edge of a plate, are none. */
START_TEST(narrow_bands_are_found)
{
	static const struct {
		int axis, first, end; /* pixels */
		double step, apart;   /* degrees; a full turn */
		int view, count, found;
		double rods; /* line integral */
	} rows[] = {
	    {0, 120, 126, .69, 4, 20, 1, 1, 0},   /* half of the signal in one view */
	    {0, 120, 126, .69, 4, 80, 18, 18, 0}, /* over the end of the turn */
	    {0, 230, 233, 2.3, 4, 30, 10, 10, 0},
	    {0, 150, 180, -.5, 4, 30, 10, 10, 0}, /* a tenth of the columns, brighter */
	    {0, 120, 126, .69, 4, 20, 4, 4, .3},  /* beside rods */
	    {1, 90, 93, .69, 4, 20, 1, 1, 0},
	    {1, 40, 60, .36, 4, 30, 18, 18, 0},
	    {1, 90, 93, 2.3, 6, 20, 18, 18, 1.5},
	    {0, 0, 6, .69, 4, 20, 18, 18, 0}, /* at the detector's edge */
	    {0, 296, 300, 2.3, 4, 30, 4, 4, 0},
	    {0, 3, 10, .69, 4, 80, 18, 18, 0},
	    {1, 197, 200, 2.3, 4, 30, 18, 18, .3},
	    {0, 0, 6, .69, 4, 20, 1, 0, 0},      /* an object may have entered there for a moment, */
	    {0, 0, 6, -2.3, 4, 20, 10, 0, 0},    /* or been away */
	    {0, 120, 126, .1, 4, 20, 18, 0, 0},  /* less than is told */
	    {0, 120, 126, .69, 4, 20, 40, 0, 0}, /* over 160 degrees */
	    {0, 120, 126, .69, 12, 20, 4, 0, 0}, /* views that are too far apart */
	    {0, 0, 0, 0, 2, 0, 0, 0, 4},
	    {0, 0, 0, 0, 4, 0, 0, 0, 4},
	    {0, 0, 0, 0, 8, 0, 0, 0, 4},
	    {0, 120, 126, .223, 4, 20, 18, 18, 0}, /* a fifth too low */
	    {1, 90, 93, .223, 4, 80, 18, 18, 0},
	};
	enum { WIDE = 300, HIGH = 200 };
	const int views = (int)lround(360 / rows[_i].apart), pixels[2] = {WIDE, HIGH};
	const struct orbit_spec spec = {8, 8, views, {600, 1100, {10, 10}, {0, 0}, {0, 0}}, 30, rows[_i].apart};
	const struct band none = {{0, 0}, {0, 0}, 0};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct view_profile *profiles = calloc((size_t)views, sizeof(*profiles));
	struct view_strips *strips = calloc((size_t)views, sizeof(*strips));
	struct step *steps = calloc((size_t)views, sizeof(*steps));
	bool *skip = calloc((size_t)views, sizeof(*skip));
	float *view = malloc(sizeof(*view) * WIDE * HIGH);
	struct scene scene;
	struct orbit orbit;
	struct error err;

	scene_orbit(&scene, &spec);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	random_state = (unsigned)_i;
	for (int i = 0; i < views; i++) {
		const double angle = (30 + i * rows[_i].apart) * acos(-1) / 180;
		const bool is_in = (i - rows[_i].view + views) % views < rows[_i].count;

		for (int at = 0; at < WIDE * HIGH; at++) {
			const int place[2] = {at % WIDE, at / WIDE}, across = place[rows[_i].axis];
			double p =
			    (double)body_at((place[0] + .5) / WIDE, (place[1] + .5) / HIGH, angle) + .02 * normal();

			for (int rod = 0; rod < 2; rod++)
				p += fabs(place[0] - WIDE * (.5 + (.1 + .15 * rod) * sin(angle + rod))) < 4 - rod
					 ? rows[_i].rods
					 : 0;
			/* a plate of 60 pixels by 3 */
			p += fabs(place[0] - WIDE * (.5 + .2 * cos(angle))) < fmax(1.5, 30 * fabs(sin(angle)))
				 ? .2 * rows[_i].rods * 3 / fmax(3, 60 * fabs(sin(angle)))
				 : 0;
			view[at] =
			    (float)(p +
				    (is_in && across >= rows[_i].first && across < rows[_i].end ? rows[_i].step : 0));
		}
		profiles[i] = profile_at(angle, &none, 0, 0);
		narrow_look(&linearise, view, pixels, 0, &strips[i]);
	}
	ck_assert_int_eq(steps_find(profiles, strips, pixels, skip, &orbit, steps, &err), rows[_i].found);
	for (int i = 0; i < views && rows[_i].found > 0; i++) {
		const double size = pixels[rows[_i].axis];

		ck_assert_msg((steps[i].kind == STEP_PART) == ((i - rows[_i].view + views) % views < rows[_i].count),
			      "row %d: view %d", _i, i);
		if (steps[i].kind == STEP_NONE)
			continue;
		ck_assert_double_eq_tol(steps[i].first[rows[_i].axis] * size, rows[_i].first, 1.5);
		ck_assert_double_eq_tol(steps[i].end[rows[_i].axis] * size, rows[_i].end, 1.5);
		ck_assert_double_eq_tol((double)steps[i].level, rows[_i].step, .1 * fabs(rows[_i].step));
	}
	orbit_clear(&orbit);
	scene_clear(&scene);
	free(profiles);
	free(strips);
	free(steps);
	free(skip);
	free(view);
}
END_TEST

/* Runs that lie aside are found at their very ends; slow ways, small ones, and those of a body beyond the detector are
 * none. */
START_TEST(runs_of_views_that_lie_aside_are_found)
{
	static const struct {
		double apart, aside; /* degrees, a full turn; of the detector's width */
		int first, count, slow, found;
	} rows[] = {
	    {4, .06, 32, 4, 0, 4}, {4, -.06, 49, 18, 0, 18}, {4, -.06, 80, 18, 0, 18},
	    {6, .06, 20, 1, 0, 1}, {4, .06, 30, 40, 0, 0}, /* too many to be left out */
	    {4, .01, 32, 4, 0, 0}, {4, .06, 32, 18, 8, 0}, /* comes and goes within eight views */
	    {12, .06, 5, 6, 0, 0},                         /* views that are too far apart */
	    {4, 0, 0, 0, 0, 0},
	};
	const int views = (int)lround(360 / rows[_i].apart);
	const struct orbit_spec spec = {8, 8, views, {600, 1100, {10, 10}, {0, 0}, {0, 0}}, 30, rows[_i].apart};
	const struct band none = {{0, 0}, {0, 0}, 0};
	struct view_profile *profiles = calloc((size_t)views, sizeof(*profiles));
	struct step *steps = calloc((size_t)views, sizeof(*steps));
	bool *skip = calloc((size_t)views, sizeof(*skip));
	struct scene scene;
	struct orbit orbit;
	struct error err;

	scene_orbit(&scene, &spec);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	for (int i = 0; i < views; i++) {
		const int place = (i - rows[_i].first + views) % views, last = rows[_i].count - 1 - place;
		const double part = rows[_i].slow > 0 ? fmin(1, (fmin(place, last) + 1) / rows[_i].slow) : 1;

		profiles[i] = profile_at((30 + i * rows[_i].apart) * acos(-1) / 180, &none, 0,
					 place < rows[_i].count ? part * rows[_i].aside : 0);
	}
	ck_assert_int_eq(steps_find(profiles, NULL, NULL, skip, &orbit, steps, &err), rows[_i].found);
	for (int i = 0; i < views && rows[_i].found > 0; i++)
		ck_assert_msg((steps[i].kind == STEP_ASIDE) == ((i - rows[_i].first + views) % views < rows[_i].count),
			      "row %d: view %d", _i, i);
	orbit_clear(&orbit);
	scene_clear(&scene);
	free(profiles);
	free(steps);
	free(skip);
}
END_TEST

/* ---- whole reconstructions ---- */

enum kind { NO_OBJECT, VALUE, NOISY_VALUE, SHUTTER, DARK_LEVEL };
enum { TRIES = 10 };

/* A sample of a view that shows nothing, in counts. */
static double sample_of(enum kind kind)
{
	switch (kind) {
	case NO_OBJECT:
		return AIR * (1 + 0.01 * normal());
	case VALUE:
		return 0.4 * AIR;
	case NOISY_VALUE:
		return AIR * (0.4 + 0.004 * normal());
	case SHUTTER:
		return 10 * normal();
	default:
		return 300 + 5 * normal();
	}
}

static double error_of(const struct scene *scene, const struct recipe *recipe, const float *samples, const float *truth,
		       const char *told)
{
	struct outcome outcome = {.samples = samples,
				  .linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR}};
	double error;

	run(scene, recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, told) != NULL, "%s", outcome.warnings);
	ck_assert_msg(strstr(outcome.warnings, "no_object") == NULL, "%s", outcome.warnings);
	ck_assert_msg(strstr(outcome.warnings, "truncated: ") == NULL, "%s", outcome.warnings);
	error = relative_error(outcome.last, truth, grid_voxels(&outcome.grid));
	outcome_clear(&outcome);
	return error;
}

/*
 * Four of 60 views that show nothing: the result is that of the same views without a good pixel, which are known to be
 * left out. FDK alone keeps no projections and takes the mean of such a view out again, but not its noise.
 */
START_TEST(views_that_show_nothing_are_told_and_left_out)
{
	static const struct orbit_spec spec = {COLUMNS, ROWS, VIEWS, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 6};
	static const struct {
		enum kind kind;
		const struct algorithm *algorithm; /* NULL: FDK alone */
	} tries[TRIES] = {
	    {NO_OBJECT, NULL},
	    {VALUE, NULL},
	    {NOISY_VALUE, NULL},
	    {SHUTTER, NULL},
	    {DARK_LEVEL, NULL},
	    {NO_OBJECT, &algorithm_sart},
	    {NOISY_VALUE, &algorithm_sart},
	    {SHUTTER, &algorithm_sart},
	    {NO_OBJECT, &algorithm_cgls},
	    {NOISY_VALUE, &algorithm_cgls},
	};
	struct ellipsoid balls[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {38, 38, 32}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {8, 8, 8}, .centre = {14, 6, 4}, .density = 0.02},
	};
	const struct phantom phantom = {.count = 2, .parts = balls};
	const struct grid grid = grid_of(24, 24, 16, 3.6, 3.6, 3.6);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS), *truth = malloc(sizeof(float) * grid_voxels(&grid));
	double without, error;

	recipe.fdk.on = true;
	recipe.algorithm = tries[_i].algorithm;
	recipe.iterate.iterations = 2;
	random_state = (unsigned)_i;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	phantom_voxelise(&phantom, &grid, 3, truth);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = i / PIXELS % EVERY == FIRST
				 ? 0
				 : (float)(AIR * exp(-(double)scene.projections[i]) * (1 + 0.01 * normal()));
	without = error_of(&scene, &recipe, samples, truth, "blank_views: 4 projections have no good pixel");
	for (int i = 0; i < PIXELS * VIEWS; i++)
		if (i / PIXELS % EVERY == FIRST)
			samples[i] = (float)sample_of(tries[_i].kind);
	error = error_of(&scene, &recipe, samples, truth,
			 "blank_views: 4 projections show nothing, the first of them is 7");
	ck_assert_msg(error < 1.02 * without, "%.4f, %.4f without the views", error, without);
	scene_clear(&scene);
	free(samples);
	free(truth);
}
END_TEST

/* A sample of a view of this kind from those of the right views; `last`: the one before, of those that are right. */
enum outlying { HALF_DARK, HALF_DOSE, MORE_DOSE, ASIDE_IN_ROWS, ASIDE_IN_COLUMNS, FROZEN, OUTLYING };
static double outlying_sample(enum outlying kind, const float *right, const float *last, int at)
{
	const int column = at % COLUMNS, row = at / COLUMNS;

	switch (kind) {
	case HALF_DARK:
		return column < COLUMNS / 2 ? 0 : (double)right[at];
	case HALF_DOSE:
		return 0.5 * (double)right[at];
	case MORE_DOSE:
		return 1.3 * (double)right[at];
	case ASIDE_IN_ROWS:
		return column < 5 ? AIR : (double)right[at - 5];
	case ASIDE_IN_COLUMNS:
		return row < 5 ? AIR : (double)right[at - 5 * COLUMNS];
	default:
		return (double)last[at];
	}
}

/*
 * Four of 60 views, two and two beside each other, that are dark in one half, taken with another dose, aside by some
 * pixels or copies of the one before: told, and the result is that of the same views without a good pixel, or where
 * they are made whole no more than 3 % worse.
 */
START_TEST(views_that_do_not_follow_are_told_and_left_out)
{
	static const struct orbit_spec spec = {COLUMNS, ROWS, VIEWS, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 6};
	static const char *const told[OUTLYING] = {"dark_parts: 4 projections, the first of them is 7",
						   "dose_steps: 4 projections, the first of them is 7",
						   "dose_steps: 4 projections, the first of them is 7",
						   "shifted_views: 4 projections, the first of them is 7",
						   "shifted_views: 4 projections, the first of them is 7",
						   "frozen_views: 4 projections, the first of them is 7"};
	static const bool outlies[VIEWS] = {[7] = true, [8] = true, [30] = true, [31] = true};
	struct ellipsoid balls[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {38, 34, 26}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {8, 8, 8}, .centre = {14, 6, 4}, .density = 0.02},
	};
	const struct phantom phantom = {.count = 2, .parts = balls};
	const struct grid grid = grid_of(24, 24, 16, 3.6, 3.6, 3.6);
	const bool made_whole = _i >= OUTLYING && _i % OUTLYING <= MORE_DOSE;
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	float *right = malloc(sizeof(float) * PIXELS * VIEWS), *truth = malloc(sizeof(float) * grid_voxels(&grid));
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS);
	double without, error;

	recipe.fdk.on = true;
	recipe.algorithm = _i >= OUTLYING ? &algorithm_sart : NULL;
	recipe.iterate.iterations = 2;
	random_state = (unsigned)_i;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	phantom_voxelise(&phantom, &grid, 3, truth);
	for (int i = 0; i < PIXELS * VIEWS; i++) {
		right[i] = (float)(AIR * exp(-(double)scene.projections[i]) * (1 + 0.01 * normal()));
		samples[i] = outlies[i / PIXELS] ? 0 : right[i];
	}
	without = error_of(&scene, &recipe, samples, truth, "blank_views: 4 projections have no good pixel");
	for (int i = 0, last = 0; i < PIXELS * VIEWS; i++) {
		const int view = i / PIXELS;

		last = outlies[view] ? last : view;
		if (outlies[view])
			samples[i] = (float)outlying_sample(_i % OUTLYING, right + view * PIXELS, right + last * PIXELS,
							    i % PIXELS);
	}
	error = error_of(&scene, &recipe, samples, truth, told[_i % OUTLYING]);
	ck_assert_msg(error < (made_whole ? 1.03 : 1.02) * without, "%.4f, %.4f without the views", error, without);
	scene_clear(&scene);
	free(samples);
	free(right);
	free(truth);
}
END_TEST

/* Of 60 views, line integrals, two of three have no value but 0: an acquisition that was filled up. */
START_TEST(most_views_may_be_zero)
{
	static const struct orbit_spec spec = {COLUMNS, ROWS, VIEWS, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 6};
	struct ellipsoid body = {
	    .shape = SHAPE_ELLIPSOID, .semi_axes = {38, 34, 26}, .centre = {2, -3, 1}, .density = 0.02};
	const struct phantom phantom = {.count = 1, .parts = &body};
	const struct grid grid = grid_of(24, 24, 16, 3.6, 3.6, 3.6);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {.threads = 1};
	struct scene scene;

	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		if (i / PIXELS % 3 != 0)
			scene.projections[i] = 0;
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "blank_views: 40 projections show nothing, the first of them is 1: ") !=
			  NULL,
		      "%s", outcome.warnings);
	ck_assert_double_eq_tol(mean_near(outcome.last, &grid, (const double[]){2, -3, 1}, 12), 0.02, 4e-4);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* Warnings that must not be there: of views that show nothing or do not follow, and of a scan that shows nothing. */
static void expect_silence(const struct scene *scene, const struct linearise *linearise, const char *name)
{
	static const char *const codes[] = {"blank_views",   "no_object",    "dark_parts",     "dose_steps",
					    "shifted_views", "frozen_views", "misplaced_views"};
	const struct grid grid = grid_of(8, 8, scene->geometry.rows > 1 ? 8 : 1, 5, 5, 5);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {.threads = 1, .linearise = *linearise};

	recipe.fdk.on = true;
	run(scene, &recipe, &outcome);
	for (size_t i = 0; i < sizeof(codes) / sizeof(*codes); i++)
		ck_assert_msg(strstr(outcome.warnings, codes[i]) == NULL, "%s: %s", name, outcome.warnings);
	outcome_clear(&outcome);
}

static const struct {
	const char *name;
	int rows, views;
	double step, offset;         /* degrees; of the detector along its rows, mm */
	double photons, drift;       /* 0: exact; of air's line integral */
	struct ellipsoid objects[2]; /* a density of 0: none */
} scans[] = {
    {"a ball far off-centre", 32, 60, 6, 0, 1e5, 0, {{SHAPE_ELLIPSOID, {9, 9, 9}, {45, 20, 0}, 0, .02}}},
    {"a ball that leaves the detector", 32, 60, 6, 0, 1e5, 0, {{SHAPE_ELLIPSOID, {6, 6, 6}, {62, 0, 0}, 0, .02}}},
    {"the same on an arc", 32, 50, -4, 0, 0, 0, {{SHAPE_ELLIPSOID, {6, 6, 6}, {55, 20, 0}, 0, .02}}},
    {"one row", 1, 60, 6, 0, 1e4, 0, {{SHAPE_CYLINDER, {35, 25, 9}, {10, 5, 0}, 0, .02}}},
    {"a body wider than the detector", 32, 60, 6, 0, 1e5, 0, {{SHAPE_CYLINDER, {140, 80, 90}, {20, 0, 0}, 0, .02}}},
    {"a plate wider than the detector", 32, 40, 5, 0, 1e5, 0, {{SHAPE_BOX, {120, 6, 90}, {0, 10, 0}, .3, .02}}},
    {"a thin plate", 32, 90, 4, 0, 1e5, 0, {{SHAPE_BOX, {40, 2.5, 30}, {0, 10, 0}, .3, .02}}},
    {"an arc with few views", 32, 7, 28, 0, 1e5, 0, {{SHAPE_BOX, {30, 8, 20}, {20, 10, 0}, 0, .02}}},
    {"three views", 32, 3, 60, 0, 0, 0, {{SHAPE_ELLIPSOID, {10, 30, 10}, {20, 0, 0}, 0, .02}}},
    {"a tube that drifts", 32, 60, 6, 0, 1e5, .2, {{SHAPE_ELLIPSOID, {20, 14, 12}, {30, 0, 0}, 0, .02}}},
    {"a displaced detector", 32, 60, 6, 60, 1e5, 0, {{SHAPE_ELLIPSOID, {60, 40, 30}, {0, 0, 0}, 0, .02}}},
    {"few photons", 32, 60, 6, 0, 500, 0, {{SHAPE_ELLIPSOID, {40, 12, 30}, {0, 0, 0}, 0, .002}}},
    {"two beads",
     32,
     60,
     6,
     0,
     1e5,
     0,
     {{SHAPE_ELLIPSOID, {4, 4, 4}, {20, 0, 0}, 0, .05}, {SHAPE_ELLIPSOID, {4, 4, 4}, {-25, 9, 8}, 0, .05}}},
};

START_TEST(no_view_of_an_object_is_taken_for_nothing)
{
	const struct orbit_spec spec = {
	    COLUMNS, scans[_i].rows, scans[_i].views, {600, 1100, {4, 4}, {scans[_i].offset, 0}, {0, 0}},
	    20,      scans[_i].step};
	struct ellipsoid objects[2];
	const struct phantom phantom = {.count = 2, .parts = objects};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct scene scene;

	memcpy(objects, scans[_i].objects, sizeof(objects));
	objects[1].shape = SHAPE_ELLIPSOID;
	for (int k = 0; k < 3; k++)
		objects[1].semi_axes[k] = objects[1].semi_axes[k] > 0 ? objects[1].semi_axes[k] : 1;
	random_state = (unsigned)_i;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int i = 0; i < COLUMNS * scans[_i].rows * scans[_i].views; i++) {
		const double p = (double)scene.projections[i], photons = scans[_i].photons;
		const double seen = photons > 0 ? exp(-p) + sqrt(exp(-p) / photons) * normal() : exp(-p);

		scene.projections[i] =
		    (float)(-log(fmax(seen, 1e-4)) + scans[_i].drift * sin(i / (COLUMNS * scans[_i].rows) * .3));
	}
	expect_silence(&scene, &linearise, scans[_i].name);
	scene_clear(&scene);
}
END_TEST

/* Measured scans. */
START_TEST(measured_views_all_show_something)
{
	static const struct {
		const char *name;
		int columns, rows, views, skipped; /* skipped: images before the first view */
		double first, step;                /* degrees */
		struct circular circular;
	} data[] = {
	    {"htc_tb_real.f32.zst", 560, 1, 549, 0, 27, .5, {410.66, 553.74, {.2, .2}, {0, 0}, {0, 0}}},
	    {"htc_solid_disc_real.f32.zst", 560, 1, 61, 0, 181, .5, {410.66, 553.74, {.2, .2}, {0, 0}, {0, 0}}},
	    {"ctsimu_tetra_raw.f32.zst", 150, 150, 21, 4, 0, 18, {300, 400, {1.3, 1.3}, {0, 0}, {0, 0}}},
	};
	const struct orbit_spec spec = {data[_i].columns,  data[_i].rows,  data[_i].views,
					data[_i].circular, data[_i].first, data[_i].step};
	const size_t pixels = (size_t)data[_i].columns * (size_t)data[_i].rows;
	float *values = data_f32(data[_i].name, pixels * (size_t)(data[_i].views + data[_i].skipped));
	struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct scene scene;

	if (values == NULL)
		return;
	if (data[_i].skipped > 0) {
		linearise.quantity = QUANTITY_INTENSITY;
		linearise.image[IMAGE_DARK] = values;
		linearise.image[IMAGE_FLAT] = values + pixels;
	}
	scene_orbit(&scene, &spec);
	memcpy(scene.projections, values + pixels * (size_t)data[_i].skipped,
	       pixels * (size_t)data[_i].views * sizeof(*values));
	expect_silence(&scene, &linearise, data[_i].name);
	scene_clear(&scene);
	free(values);
}
END_TEST

/* Nothing but air, as counts or line integrals, with much noise or none; a bead of a few pixels is an object. */
START_TEST(a_scan_of_air_is_told)
{
	static const struct orbit_spec spec = {COLUMNS, ROWS, 30, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 12};
	struct ellipsoid bead = {.shape = SHAPE_ELLIPSOID, .semi_axes = {3, 3, 3}, .centre = {9, 0, 3}, .density = .02};
	const struct phantom phantom = {.count = 1, .parts = &bead};
	const double noises[] = {0, .001, .05};
	const struct grid grid = grid_of(8, 8, 8, 5, 5, 5);
	const bool counts = _i % 2 != 0, has_bead = _i >= 6;
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {.threads = 1};
	struct scene scene;

	recipe.fdk.on = true;
	random_state = (unsigned)_i;
	scene_orbit(&scene, &spec);
	if (has_bead)
		scene_add(&scene, &phantom);
	for (int i = 0; i < PIXELS * 30; i++) {
		const double share = exp(-(double)scene.projections[i]) * (1 + noises[_i / 2 % 3] * normal());

		scene.projections[i] = (float)(counts ? AIR * share : -log(share));
	}
	if (counts)
		outcome.linearise =
		    (struct linearise){.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = AIR};
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "no_object: ") != NULL ||
		       strstr(outcome.warnings, "nothing but air in the scan") != NULL) == !has_bead,
		      "%d: %s", _i, outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/*
 * A small or faint object shows in all views together: a ball of 2 mm of twice water and of water in noise, off the
 * axis and on it, on a coarse detector and on one where most pixels are not sampled. Views of air whose flat image is
 * as noisy as they are show nothing.
 */
START_TEST(a_faint_object_in_every_view_is_no_air)
{
	static const struct {
		int fine;
		double density, x, noise, flat;
	} rows[] = {{1, .027, 5, .007, 0},    {1, .0135, 5, .007, 0}, {1, .0135, 0, .007, 0}, {4, .027, 5, .02, 0},
		    {4, .0135, 5, .02, .005}, {1, 0, 0, .007, .007},  {4, 0, 0, .02, .02},    {4, 0, 0, .2, 0}};
	const int fine = rows[_i].fine, columns = 47 * fine, lines = 31 * fine, views = 40;
	const struct orbit_spec spec = {columns, lines, views, {600, 1000, {2.0 / fine, 2.0 / fine}, {0, 0}, {0, 0}},
					0,       9};
	struct ellipsoid ball = {.shape = SHAPE_ELLIPSOID,
				 .semi_axes = {1, 1, 1},
				 .centre = {rows[_i].x, rows[_i].x * .6, 0},
				 .density = rows[_i].density};
	const struct phantom phantom = {.count = 1, .parts = &ball};
	const struct grid grid = grid_of(8, 8, 8, 5, 5, 5);
	const size_t pixels = (size_t)columns * (size_t)lines;
	double *flat = malloc(pixels * sizeof(*flat));
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {.threads = 1};
	struct scene scene;

	ck_assert_ptr_nonnull(flat);
	recipe.fdk.on = true;
	random_state = (unsigned)_i;
	for (size_t i = 0; i < pixels; i++)
		flat[i] = rows[_i].flat * normal();
	scene_orbit(&scene, &spec);
	if (rows[_i].density > 0)
		scene_add(&scene, &phantom);
	for (size_t i = 0; i < pixels * (size_t)views; i++)
		scene.projections[i] += (float)(flat[i % pixels] + rows[_i].noise * normal());
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "truncated: ") == NULL, "%d: %s", _i, outcome.warnings);
	ck_assert_msg((strstr(outcome.warnings, "no_object: ") != NULL) == !(rows[_i].density > 0), "%d: %s", _i,
		      outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(flat);
}
END_TEST

/*
 * A board that leaves a displaced detector at its edge, for four views in which it is seen from its side; pixels are
 * means of 2 x 2 rays.
 */
START_TEST(a_board_that_leaves_the_detector_for_a_while_is_no_dark_part)
{
	enum { WIDE = 56, HIGH = 40, TURN = 67, FINE = 2 };
	static const struct orbit_spec spec = {
	    WIDE, HIGH, TURN, {620, 1100, {4.571, 4.571}, {-41.343, 0}, {0, 0}}, 89.115, 360. / TURN};
	static const struct orbit_spec finer = {
	    FINE * WIDE, FINE * HIGH, TURN, {620, 1100, {2.2855, 2.2855}, {-41.343, 0}, {0, 0}}, 89.115, 360. / TURN};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID,
	     .semi_axes = {44.58, 40.12, 64.56},
	     .centre = {-1.4, -1.94, .84},
	     .density = 0.0192},
	    {.shape = SHAPE_BOX, .semi_axes = {162.15, 4.33, 174.77}, .centre = {0, -72.01, 0}, .density = 0.010374},
	};
	const struct phantom phantom = {.count = 2, .parts = parts};
	const struct grid grid = grid_of(16, 16, 4, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene, rays;

	scene_orbit(&scene, &spec);
	scene_orbit(&rays, &finer);
	scene_add(&rays, &phantom);
	for (int i = 0; i < TURN * HIGH * WIDE; i++) {
		double sum = 0;

		for (int k = 0; k < FINE * FINE; k++)
			sum += exp(-(double)rays.projections[(FINE * (i / WIDE) + k / FINE) * FINE * WIDE +
							     FINE * (i % WIDE) + k % FINE]);
		scene.projections[i] = (float)-log(sum / (FINE * FINE));
	}
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "dark_parts: ") == NULL, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&rays);
	scene_clear(&scene);
}
END_TEST

Suite *content_suite(void)
{
	Suite *suite = suite_create("content");
	TCase *search = tcase_create("search"), *tests = tcase_create("content");

	tcase_set_timeout(search, 60);
	tcase_set_timeout(tests, 60);
	tcase_add_loop_test(search, a_gap_among_views_of_an_object_is_found, 0, 2);
	tcase_add_loop_test(search, views_between_two_steps_are_found, 0, 23);
	tcase_add_loop_test(search, narrow_bands_are_found, 0, 22);
	tcase_add_loop_test(search, runs_of_views_that_lie_aside_are_found, 0, 9);
	tcase_add_loop_test(tests, views_that_show_nothing_are_told_and_left_out, 0, TRIES);
	tcase_add_loop_test(tests, views_that_do_not_follow_are_told_and_left_out, 0, 2 * OUTLYING);
	tcase_add_test(tests, most_views_may_be_zero);
	tcase_add_loop_test(tests, no_view_of_an_object_is_taken_for_nothing, 0,
			    (int)(sizeof(scans) / sizeof(scans[0])));
	tcase_add_loop_test(tests, measured_views_all_show_something, 0, 3);
	tcase_add_loop_test(tests, a_scan_of_air_is_told, 0, 10);
	tcase_add_loop_test(tests, a_faint_object_in_every_view_is_no_air, 0, 8);
	tcase_add_test(search, a_board_that_leaves_the_detector_for_a_while_is_no_dark_part);
	suite_add_tcase(suite, search);
	suite_add_tcase(suite, tests);
	return suite;
}

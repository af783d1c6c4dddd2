/* Views whose shadows leave their poses open, and poses that fit them nearly: calibration view by view. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "proto/calibration.h"
#include "tests/unit/arm.h"

Suite *calibrate_views_suite(void);

static const struct arm arm_coarse = {.columns = 200,
				      .rows = 160,
				      .count = 20,
				      .pixel = 1.9,
				      .first = .3,
				      .step = 2 * M_PI / 20,
				      .sag = 1,
				      .jitter = .05,
				      .seed = 1};
static const struct ball_circles circles = {
    .circles = 2, .balls = 11, .diameter = 110, .distance = 90, .ball = 5, .first = .2, .shift = M_PI / 11};

/* What is seen of the phantom in some views: the balls of its first circle alone. */
static int take_planes(void *context, int view, int every, float *ret_image, struct error *err)
{
	struct arm_scene scene = *(const struct arm_scene *)context;
	const struct balls half = {.count = circles.balls, .ball = scene.target.balls->ball};

	if (view % every == 0 && view > 0)
		scene.target.balls = &half;
	return arm_image(&scene, view, ret_image, err);
}

static int take_a_plane(void *context, int view, float *ret_image, struct error *err)
{
	return take_planes(context, view, 10, ret_image, err);
}

static int take_many_planes(void *context, int view, float *ret_image, struct error *err)
{
	return take_planes(context, view, 3, ret_image, err);
}

/* Any source along a curve sees the balls of a plane where they are, the others of the phantom wherever it likes. */
START_TEST(a_view_of_balls_in_a_plane_is_refused)
{
	struct arm_scene scene = {.arm = arm_coarse};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&balls, &circles, &err) == 0);
	scene.target = (struct target){.balls = &balls, .ball = .4, .photons = 20000, .rays = 3};
	ck_assert_msg(arm_calibrate(&scene.arm, take_a_plane, &scene, &balls, false, &calibration, &err) == 0, "%s",
		      err.text);
	for (int k = 0; k < calibration.count; k++) {
		const struct calibrated_view *view = &calibration.views[k];

		ck_assert_msg(view->used == (k != 10), "view %d: %s", k, view->refused);
		ck_assert_double_le(arm_wrong(&scene.arm, k, &view->view), k == 10 ? 1 : .1);
	}
	ck_assert_str_eq(calibration.views[10].refused,
			 "the 11 balls that it shows lie nearly in a plane, which does not determine its pose");
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/* Poses fit them as well as any: it is not said that they do not. */
START_TEST(too_many_views_that_fit_are_told_so)
{
	struct arm_scene scene = {.arm = arm_coarse};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&balls, &circles, &err) == 0);
	scene.target = (struct target){.balls = &balls, .ball = .4, .rays = 1};
	ck_assert_int_eq(arm_calibrate(&scene.arm, take_many_planes, &scene, &balls, false, &calibration, &err),
			 ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "6 of 20 views cannot be used, expected at most 25 %, though poses fit them to "
				       "0.") == err.text,
		      "%s", err.text);
	balls_clear(&balls);
}
END_TEST

/* Of three circles most views show the one in the middle alone. */
START_TEST(views_of_one_circle_are_told_so)
{
	const struct ball_circles high = {
	    .circles = 3, .balls = 8, .diameter = 70, .distance = 26, .ball = 2.5, .shift = .196};
	struct arm_scene scene = {
	    .arm = {.columns = 160, .rows = 72, .count = 12, .pixel = .9, .step = 2 * M_PI / 12, .sag = .5}};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&balls, &high, &err) == 0);
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_int_eq(arm_calibrate(&scene.arm, arm_image, &scene, &balls, false, &calibration, &err),
			 ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "the 8 balls that it shows lie nearly in a plane") != NULL, "%s", err.text);
	balls_clear(&balls);
}
END_TEST

/* Eleven balls of two sizes, half of them in pairs: a pose that turns the detector and shifts it fits them nearly. */
static const struct ball pairs_of_balls[] = {
    {{4.9, -54.7, -39.2}, 4.8}, {{6.3, -48.5, -40.8}, 4.8}, {{-28.7, -22.7, -8.1}, 3.5}, {{29, 4.5, 9.5}, 3.5},
    {{26, -.6, 9.7}, 3.5},      {{13.4, 29.6, 39.7}, 4.8},  {{7.6, 30.6, 42.8}, 4.8},    {{23.2, -33.6, -36.3}, 3.5},
    {{19, 48.9, -37.7}, 4.8},   {{17, 49.9, -32.7}, 4.8},   {{32.5, -22.3, -30.1}, 4.8}};
enum { PAIRED = sizeof(pairs_of_balls) / sizeof(*pairs_of_balls) };

/* Of the two poses the one that fits better is the view's own. */
START_TEST(a_pose_that_fits_nearly_is_not_taken)
{
	struct ball copy[PAIRED];
	const struct balls balls = {.count = PAIRED, .ball = copy};
	struct arm_scene scene = {.arm = arm_coarse};
	struct calibration calibration;
	struct error err = {0};

	memcpy(copy, pairs_of_balls, sizeof(copy));
	scene.arm = (struct arm){.columns = 177,
				 .rows = 148,
				 .count = 24,
				 .pixel = 2.1,
				 .first = .7 * (_i + 1),
				 .step = -200 * M_PI / 180 / 23,
				 .sag = 1.5,
				 .jitter = 1,
				 .seed = (unsigned)_i + 1};
	scene.target = (struct target){.balls = &balls, .ball = .6, .photons = 100000, .rays = 3};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &balls, false, &calibration, &err) == 0, "%s",
		      err.text);
	for (int k = 0; k < calibration.count; k++)
		ck_assert_msg(calibration.views[k].used, "view %d: %s", k, calibration.views[k].refused);
	for (int k = 0; k < calibration.count; k++)
		ck_assert_msg(arm_wrong(&scene.arm, k, &calibration.views[k].view) <= .15,
			      "view %d is wrong by %.3f pixels, with a residual of %.3f", k,
			      arm_wrong(&scene.arm, k, &calibration.views[k].view), calibration.views[k].rms);
	calibration_clear(&calibration);
}
END_TEST

/*
 * Nine of them, with shadows some hundredths of a pixel off: from a detector that is turned and a source that is too
 * far away, which fit nearly as well, the pose is found that is also found from the true one.
 */
START_TEST(a_pose_is_found_down_a_long_valley)
{
	static const int shown[] = {0, 1, 2, 3, 4, 5, 6, 7, 10};
	enum { SHOWN = sizeof(shown) / sizeof(*shown) };
	const double pixel_mm[2] = {2.1, 2.1};
	const struct arm arm = {.columns = 177, .rows = 148, .count = 36, .pixel = 2.1, .step = M_PI / 18, .sag = 1};
	struct ball copy[PAIRED];
	const struct balls balls = {.count = PAIRED, .ball = copy};
	int others = 0;

	memcpy(copy, pairs_of_balls, sizeof(copy));
	for (int k = 0; k < arm.count; k++) {
		const struct view truth = arm_view(&arm, k);
		struct pair pairs[SHOWN] = {{0}};
		struct pose pose, best;
		double least, rms;

		pose_of_view(&best, &truth);
		pose = best;
		for (int i = 0; i < SHOWN; i++) {
			pairs[i].ball = shown[i];
			pose_shadow(&best, pixel_mm, &copy[shown[i]], pairs[i].pixel);
			pairs[i].pixel[0] += .03 * sin(12.9898 * i + 78.233 * k);
			pairs[i].pixel[1] += .03 * sin(39.3468 * i + 11.135 * k);
		}
		least = pose_fit(&best, pixel_mm, &balls, pairs, SHOWN);
		for (int a = 0; a < 3; a++)
			pose.source[a] *= 1.2;
		pose.detector[2] *= 1.2;
		pose_step(&pose, (const double[9]){[4] = 6 * M_PI / 180});
		rms = pose_fit(&pose, pixel_mm, &balls, pairs, SHOWN);
		others += rms > 1.001 * least;
	}
	/* A few begin nearer to another pose, with a least residual of its own. */
	ck_assert_int_le(others, 2);
}
END_TEST

/*
 * As few balls as a phantom may have. In some views two of them touch: six that stand clear make no pose, and those
 * that touch are fitted together with them.
 */
START_TEST(eight_balls_are_enough_in_all_views)
{
	static const struct ball eight[] = {{{56.1, -19, 33.4}, 5.1},    {{11.1, -42.2, 28.1}, 5.1},
					    {{31.2, 38.6, -34.2}, 5.1},  {{-5.7, -49.4, 45.9}, 5.1},
					    {{8.6, -12.9, -3.1}, 5.1},   {{21.3, 25.3, -1.2}, 5.1},
					    {{-31.7, -20.3, -8.4}, 5.1}, {{-33.9, 4.6, 0.3}, 5.1}};
	struct ball copy[8];
	const struct balls balls = {.count = 8, .ball = copy};
	struct arm_scene scene = {.arm = arm_coarse};
	struct calibration calibration;
	struct error err = {0};

	memcpy(copy, eight, sizeof(copy));
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000, .rays = 3};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &balls, false, &calibration, &err) == 0, "%s",
		      err.text);
	for (int k = 0; k < calibration.count; k++)
		ck_assert_msg(calibration.views[k].used, "view %d: %s", k, calibration.views[k].refused);
	calibration_clear(&calibration);
}
END_TEST

/* Three times two pictures beside each other in which nothing is. */
static bool in_a_gap(int view)
{
	return view < 30 && (view % 10 == 7 || view % 10 == 8);
}

static int take_with_a_gap(void *context, int view, float *ret_image, struct error *err)
{
	struct arm_scene scene = *(const struct arm_scene *)context;

	if (in_a_gap(view))
		scene.target.ball = 0;
	return arm_image(&scene, view, ret_image, err);
}

/* Those views stand between their neighbours, and the others tell how far that is from where they stood. */
START_TEST(what_poses_between_neighbours_are_worth_is_told)
{
	struct arm_scene scene = {.arm = arm_coarse};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};
	double off, pixels, squares = 0;

	scene.arm.count = 40;
	scene.arm.step = 5 * M_PI / 180;
	scene.arm.jitter = _i == 0 ? .1 : 1;
	ck_assert(balls_circles(&balls, &circles, &err) == 0);
	scene.target = (struct target){.balls = &balls, .ball = .4};
	ck_assert_msg(arm_calibrate(&scene.arm, take_with_a_gap, &scene, &balls, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_int_eq(calibration.used, 34);
	for (int k = 0; k < 30; k++)
		if (in_a_gap(k))
			squares += pow(arm_wrong(&scene.arm, k, &calibration.views[k].view), 2);
	off = sqrt(squares / 6);
	/* Six views say how far such views are off, but for a factor of two. */
	ck_assert_msg(calibration.between >= .5 * off && calibration.between <= 2 * off,
		      "told: %.3f pixels, views are off by %.3f", calibration.between, off);
	pixels = calibration.between_isocentre / scene.arm.pixel * 1100 / 620;
	ck_assert_double_eq_tol(pixels, calibration.between, .05 * calibration.between);
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/* What the phantom has and the drawing has not, or the other way about; `beside`: mm along x, off the picture. */
static const struct {
	const char *what, *told;
	int drawn, lacks; /* index of a ball that the drawing, that the phantom has not; -1: none */
	double beside;
} presences[] = {
    {"right", NULL, -1, -1, 0},
    {"balls outside of the picture", NULL, -1, -1, 60},
    {"a ball more in the drawing",
     "ball 5 of the drawing (counted from 0) is not where the drawing has it, in 14 views that would show it alone: "
     "the drawing "
     "may have more balls than the phantom",
     -1, 5, 0},
    {"a ball less in the drawing",
     "views, are of no ball of the drawing: the drawing may have fewer balls than the phantom", 5, -1, 0},
    {"another ball in the drawing", "are of no ball of the drawing: the drawing may have other balls than the phantom",
     14, 5, 0},
};

static void leave_out(struct balls *balls, int ball)
{
	if (ball >= 0)
		balls->ball[ball] = balls->ball[--balls->count];
}

START_TEST(a_ball_more_or_less_is_told)
{
	struct arm_scene scene = {.arm = arm_coarse};
	struct ball_circles few = circles;
	struct balls balls, drawing;
	struct calibration calibration;
	cJSON *document, *doubts;
	const cJSON *doubt;
	const char *told = NULL;
	struct error err = {0};

	few.balls = 8;
	few.shift = M_PI / 8;
	ck_assert(balls_circles(&balls, &few, &err) == 0);
	ck_assert(balls_circles(&drawing, &few, &err) == 0);
	for (int b = 0; b < balls.count; b++)
		balls.ball[b].centre[0] += presences[_i].beside;
	leave_out(&balls, presences[_i].lacks);
	leave_out(&drawing, presences[_i].drawn);
	scene.target = (struct target){.balls = &balls, .ball = .4, .photons = 20000, .rays = 3};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s: %s",
		      presences[_i].what, err.text);
	document = calibration_json(&calibration);
	doubts = calibration_doubts(document);
	cJSON_ArrayForEach(doubt, doubts)
	{
		ck_assert_str_eq(cJSON_GetObjectItem(doubt, "code")->valuestring, "calibration_balls");
		told = cJSON_GetObjectItem(doubt, "detail")->valuestring;
	}
	ck_assert_msg((told != NULL) == (presences[_i].told != NULL) &&
			  (told == NULL || strstr(told, presences[_i].told) != NULL),
		      "%s: %s", presences[_i].what, told != NULL ? told : "nothing told");
	cJSON_Delete(document);
	cJSON_Delete(doubts);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/*
 * Two circles near to each other that are seen edge-on, a little beside their place: a third of the shadows stands
 * clear. Few views begin from the nominal geometry; each that does gives its neighbours a beginning, until all are
 * found, each on its own side of the phantom, which looks the same from many.
 */
static const struct {
	struct ball_circles circles;
	int count;
	double first;
	unsigned seed;
} flat[] = {
    {{.circles = 2, .balls = 14, .diameter = 106, .distance = 19, .ball = 5.7, .shift = M_PI / 14}, 19, 2.7, 4},
};

static void tilt_and_shift(struct ball *ball, double tilt, const double shift[3])
{
	const double x = ball->centre[0], z = ball->centre[2];

	ball->centre[0] = cos(tilt) * x - sin(tilt) * z + shift[0];
	ball->centre[1] += shift[1];
	ball->centre[2] = sin(tilt) * x + cos(tilt) * z + shift[2];
}

START_TEST(views_of_a_flat_phantom_begin_from_their_neighbours)
{
	struct arm_scene scene = {.arm = {.columns = 171,
					  .rows = 145,
					  .count = flat[_i].count,
					  .pixel = 2.2,
					  .first = flat[_i].first,
					  .step = 240 * M_PI / 180 / (flat[_i].count - 1),
					  .sag = 1.5,
					  .jitter = .3,
					  .seed = flat[_i].seed}};
	const double shift[3] = {4, -3, 3};
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&drawing, &flat[_i].circles, &err) == 0);
	ck_assert(balls_circles(&balls, &flat[_i].circles, &err) == 0);
	for (int b = 0; b < balls.count; b++)
		tilt_and_shift(&balls.ball[b], .02, shift);
	scene.target = (struct target){.balls = &balls, .ball = .6, .photons = 20000, .rays = 3};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_int_eq(calibration.used, calibration.count);
	for (int k = 0; k < calibration.count; k++)
		for (int b = 0; b < balls.count; b++) {
			const struct view truth = arm_view(&scene.arm, k);
			double is[2], found[2];

			ball_shadow(&truth, &balls.ball[b], is);
			ball_shadow(&calibration.views[k].view, &drawing.ball[b], found);
			ck_assert_msg(hypot(is[0] - found[0], is[1] - found[1]) <= .2,
				      "view %d, ball %d: at %.2f %.2f, expected %.2f %.2f", k, b, found[0], found[1],
				      is[0], is[1]);
		}
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/* The normals of three sources each are x, -x and y, whose median is no direction. */
START_TEST(sources_about_no_axis_have_that_of_the_drawing)
{
	static const double places[][3] = {{0, 0, 0},   {0, 0, 0},   {0, 0, 0},    {0, 600, 0}, {0, 600, 0},
					   {0, 0, 600}, {0, 0, 600}, {0, 0, -600}, {600, 0, 0}};
	struct source sources[9];
	struct axis axis;
	struct error err;

	for (int i = 0; i < 9; i++) {
		sources[i] = (struct source){.angle = .5 * i};
		memcpy(sources[i].place, places[i], sizeof(sources[i].place));
	}
	ck_assert_int_eq(arm_axis(sources, 9, &axis, &err), 0);
	for (int i = 0; i < 3; i++)
		for (int a = 0; a < 3; a++)
			ck_assert_double_eq(axis.frame[i][a], i == a);
	ck_assert(isfinite(axis.at[0]) && isfinite(axis.at[1]));
}
END_TEST

/* Two circles as they are drawn, and as they stand: leaning by `tilt`, radians, and moved. */
static void draw_and_move(struct balls *ret_drawing, struct balls *ret_balls, double tilt, const double shift[3])
{
	struct error err;

	ck_assert(balls_circles(ret_drawing, &circles, &err) == 0);
	ck_assert(balls_circles(ret_balls, &circles, &err) == 0);
	for (int b = 0; b < ret_balls->count; b++)
		tilt_and_shift(&ret_balls->ball[b], tilt, shift);
}

/* A phantom that stands beside the axis and leans: its neighbours turn about the arm's axis, not about the drawing's.
 */
START_TEST(a_phantom_may_stand_beside_the_axis_and_lean)
{
	static const double shift[3] = {35, -10, 3};
	struct arm_scene scene = {.arm = arm_coarse};
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	draw_and_move(&drawing, &balls, .12, shift);
	scene.target = (struct target){.balls = &balls, .ball = .4, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_int_eq(calibration.used, calibration.count);
	ck_assert_double_le(calibration.between, 2);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/* Of a helix that leans by 14 degrees all views are found: to either side, wherever it is turned. */
START_TEST(a_helix_that_leans_is_found)
{
	static const char code[] = "10001000100000000101";
	enum { COUNT = sizeof(code) - 1 };
	static const double shift[3] = {6, -4, 3};
	bool large[COUNT];
	struct ball_helix helix = {
	    .balls = COUNT, .diameter = 100, .pitch = 60, .step = 25 * M_PI / 180, .ball = {3.2, 4.8}, .large = large};
	struct arm_scene scene = {
	    .arm = {.columns = 250, .rows = 200, .count = 16, .pixel = 1.5, .step = 2 * M_PI / 16, .sag = .5}};
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	for (int b = 0; b < COUNT; b++)
		large[b] = code[b] == '1';
	ck_assert(balls_helix(&drawing, &helix, &err) == 0);
	helix.first = _i * 1.3;
	ck_assert(balls_helix(&balls, &helix, &err) == 0);
	for (int b = 0; b < COUNT; b++)
		tilt_and_shift(&balls.ball[b], (_i % 2 == 0 ? 14 : -14) * M_PI / 180, shift);
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_int_eq(calibration.used, calibration.count);
	ck_assert_double_le(calibration.rms, .1);
	ck_assert_double_lt(fabs(remainder(calibration.turn - helix.first, 2 * M_PI)), .1);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/*
 * Over a short arc the sources are all nearer to a phantom that stands beside the axis, or farther from it: that tells
 * nothing of its scale.
 */
START_TEST(a_phantom_beside_the_axis_of_a_short_arc_has_its_scale)
{
	static const double shift[3] = {-40, 0, 0};
	struct arm_scene scene = {.arm = arm_coarse};
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	draw_and_move(&drawing, &balls, 0, shift);
	scene.arm.count = 16;
	scene.arm.first = -75 * M_PI / 180;
	scene.arm.step = 10 * M_PI / 180;
	scene.target = (struct target){.balls = &balls, .ball = .4, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_int_eq(calibration.used, calibration.count);
	ck_assert_msg(fabs(calibration.distance_ratio - 1) < .01, "%.4f within %.4f", calibration.distance_ratio,
		      calibration.distance_error);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/*
 * Like circles one above the other, of which those at an end are partly or wholly beside the picture: those that a view
 * shows could be the next ones as well. What all views show tells, or that it is not known is told.
 */
static const struct {
	int circles, balls, count;
	double distance, height; /* of the circles; mm, of the phantom's middle */
	double found, other;     /* mm: of the place that is taken, from where it stood; of another from there */
	const char *told[2];     /* of balls, of the height; NULL: nothing */
} heights[] = {
    {.circles = 4, .balls = 6, .distance = 12, .height = -4, .count = 28},
    {.circles = 3, .balls = 6, .distance = 22, .height = 0, .count = 30},
    {.circles = 4,
     .balls = 8,
     .distance = 15,
     .height = 22,
     .count = 17,
     .told = {"16 of the drawing's 32 balls, 16, 17, 18, "}},
    {.circles = 4,
     .balls = 8,
     .distance = 15,
     .height = 10,
     .count = 17,
     .found = 15,
     .other = -15,
     .told = {"8 of the drawing's 32 balls, 0, 1, 2, 3, 4, 5, 6, 7 (counted from 0), ", "15.0 mm lower along z"}},
};

START_TEST(of_like_circles_each_is_taken_for_itself)
{
	const struct ball_circles like = {.circles = heights[_i].circles,
					  .balls = heights[_i].balls,
					  .diameter = 60,
					  .distance = heights[_i].distance,
					  .ball = 3};
	struct arm_scene scene = {.arm = {.columns = 200,
					  .rows = 116,
					  .count = heights[_i].count,
					  .pixel = .7,
					  .step = 2 * M_PI / heights[_i].count,
					  .sag = 1}};
	struct balls balls, drawing;
	struct calibration calibration;
	cJSON *document, *doubts;
	const cJSON *doubt;
	const char *told[2] = {NULL};
	struct error err = {0};

	ck_assert(balls_circles(&drawing, &like, &err) == 0);
	ck_assert(balls_circles(&balls, &like, &err) == 0);
	for (int b = 0; b < balls.count; b++)
		balls.ball[b].centre[2] += heights[_i].height;
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	for (int k = 0; k < calibration.count; k++) {
		struct view *view = &calibration.views[k].view;

		view->source[2] += heights[_i].height - heights[_i].found;
		view->pixel0[2] += heights[_i].height - heights[_i].found;
		if (calibration.views[k].used)
			ck_assert_msg(arm_wrong(&scene.arm, k, view) <= 1, "view %d is wrong by %.1f pixels", k,
				      arm_wrong(&scene.arm, k, view));
	}
	ck_assert_double_eq_tol(calibration.rival_height, heights[_i].other, 1e-6);
	document = calibration_json(&calibration);
	doubts = calibration_doubts(document);
	cJSON_ArrayForEach(doubt, doubts)
	{
		const char *code = cJSON_GetObjectItem(doubt, "code")->valuestring;
		const int of = strcmp(code, "calibration_height") == 0;

		ck_assert(of || strcmp(code, "calibration_balls") == 0);
		told[of] = cJSON_GetObjectItem(doubt, "detail")->valuestring;
	}
	for (int i = 0; i < 2; i++)
		ck_assert_msg((told[i] != NULL) == (heights[_i].told[i] != NULL) &&
				  (told[i] == NULL || strstr(told[i], heights[_i].told[i]) != NULL),
			      "%s", told[i] != NULL ? told[i] : "nothing told");
	cJSON_Delete(document);
	cJSON_Delete(doubts);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/*
 * Among many balls, half a step further others are near to nearly as many shadows: the phantom is found turned as it
 * stood by what poses explain.
 */
START_TEST(a_phantom_of_many_balls_is_found_turned_as_it_stood)
{
	enum { VIEWS = 28 };
	const double turn = -8.5 * M_PI / 180, beside[3] = {2.8, 1.8, -1.3};
	struct ball_circles dense = {
	    .circles = 5, .balls = 7, .diameter = 40.8, .distance = 8, .ball = 1.87, .shift = M_PI / 7};
	struct arm_scene scene = {.arm = {.columns = 200,
					  .rows = 116,
					  .count = VIEWS,
					  .pixel = .7,
					  .step = 200 * M_PI / 180 / (VIEWS - 1),
					  .sag = 1,
					  .jitter = .2,
					  .seed = 1}};
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&drawing, &dense, &err) == 0);
	dense.first = turn;
	ck_assert(balls_circles(&balls, &dense, &err) == 0);
	for (int b = 0; b < balls.count; b++)
		for (int a = 0; a < 3; a++)
			balls.ball[b].centre[a] += beside[a];
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_double_eq_tol(calibration.turn, turn, .02);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/* A panel that is higher in some views, or rises from the first to the last: rows of a higher picture. */
static const struct raised {
	struct ball_circles like;
	int rows, count;       /* of the panel; views */
	double arc;            /* degrees */
	int by, first, behind; /* rows; views that are higher, all: the panel rises */
	int used;              /* at least; 0: too few for a calibration */
} raised[] = {
    /* On either side of the jump views are nearer to those of the other side a circle aside, and are not used so. */
    {{5, 6, 60, 8, 2, 0, 0}, 80, 24, 220, 15, 11, 24, 0},
    /* The lowest circle leaves the picture as the highest comes: nothing tells whether the panel or the phantom did. */
    {{3, 8, 70, 24, 2.5, 0, 0}, 100, 24, 360, 43, 12, 15, 21},
    /* All balls stay on the picture and tell. */
    {{3, 8, 70, 12, 2.5, 0, .196}, 90, 24, 200, 12, 14, 24, 20},
    /* Where a full turn ends it does not go on with where it began. */
    {{5, 6, 70, 20, 2.5, 0, 0}, 100, 24, 360, 86, 0, 24, 19},
};

struct raised_scene {
	struct arm_scene scene; /* of the higher picture */
	const struct raised *raised;
};

static int lower_row(const struct raised *raised, int view)
{
	if (raised->behind - raised->first == raised->count)
		return raised->by * view / (raised->count - 1);
	return view >= raised->first && view < raised->behind ? raised->by : 0;
}

static int take_raised(void *context, int view, float *ret_image, struct error *err)
{
	struct raised_scene *of = context;
	const size_t columns = (size_t)of->scene.arm.columns, rows = (size_t)of->scene.arm.rows;
	float *whole = malloc(columns * rows * sizeof(*whole));
	int code;

	ck_assert_ptr_nonnull(whole);
	code = arm_image(&of->scene, view, whole, err);
	memcpy(ret_image, whole + columns * (size_t)lower_row(of->raised, view),
	       columns * (size_t)of->raised->rows * sizeof(*whole));
	free(whole);
	return code;
}

/* Like circles, some beside the picture: no view is used that may as well stand a circle aside. */
START_TEST(like_circles_are_told_apart_where_the_panel_jumps)
{
	const struct raised *own = &raised[_i];
	struct raised_scene of = {.scene.arm = {.columns = 180,
						.rows = own->rows + own->by,
						.count = own->count,
						.pixel = .9,
						.step = own->arc * M_PI / 180 / (own->count - (own->arc < 360)),
						.sag = 1},
				  .raised = own};
	struct arm panel = of.scene.arm;
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};
	int code;

	panel.rows = own->rows;
	ck_assert(balls_circles(&balls, &own->like, &err) == 0);
	of.scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	code = arm_calibrate(&panel, take_raised, &of, &balls, false, &calibration, &err);
	ck_assert_msg((code == 0) == (own->used > 0), "%s", err.text);
	if (code < 0)
		ck_assert_ptr_nonnull(strstr(err.text, "views cannot be used"));
	for (int k = 0; k < calibration.count && code == 0; k++) {
		struct view *view = &calibration.views[k].view;

		/* The pose of the higher picture. */
		for (int a = 0; a < 3; a++)
			view->pixel0[a] -= lower_row(own, k) * view->row_step[a];
		if (calibration.views[k].used)
			ck_assert_msg(arm_wrong(&of.scene.arm, k, view) <= 1, "view %d is wrong by %.1f pixels", k,
				      arm_wrong(&of.scene.arm, k, view));
	}
	if (code == 0) {
		ck_assert_int_ge(calibration.used, own->used);
		calibration_clear(&calibration);
	}
	balls_clear(&balls);
}
END_TEST

/* Where the panel jumps, a helix' code tells each view's place: all are used. */
START_TEST(a_code_tells_where_a_helix_stands_behind_a_jump)
{
	static const char code[] = "10001000100000000101";
	enum { COUNT = sizeof(code) - 1 };
	static const struct raised jump = {.rows = 160, .count = 14, .by = 14, .first = 4, .behind = 9};
	bool large[COUNT];
	const struct ball_helix helix = {
	    .balls = COUNT, .diameter = 80, .pitch = 45, .step = 25 * M_PI / 180, .ball = {3.2, 4.8}, .large = large};
	struct raised_scene of = {.scene.arm = {.columns = 200,
						.rows = jump.rows + jump.by,
						.count = jump.count,
						.pixel = 1.1,
						.step = 2 * M_PI / jump.count,
						.sag = 1},
				  .raised = &jump};
	struct arm panel = of.scene.arm;
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	panel.rows = jump.rows;
	for (int b = 0; b < COUNT; b++)
		large[b] = code[b] == '1';
	ck_assert(balls_helix(&balls, &helix, &err) == 0);
	of.scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_msg(arm_calibrate(&panel, take_raised, &of, &balls, false, &calibration, &err) == 0, "%s", err.text);
	for (int k = 0; k < calibration.count; k++) {
		struct view *view = &calibration.views[k].view;

		ck_assert_msg(calibration.views[k].used, "view %d: %s", k, calibration.views[k].refused);
		for (int a = 0; a < 3; a++)
			view->pixel0[a] -= lower_row(&jump, k) * view->row_step[a];
		ck_assert_msg(arm_wrong(&of.scene.arm, k, view) <= .2, "view %d is wrong by %.1f pixels", k,
			      arm_wrong(&of.scene.arm, k, view));
	}
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/* A bar hides the highest of the circles in some views: only the balls of the others are there. */
enum { FIRST_HIDDEN = 5, BEHIND_HIDDEN = 9 };
static bool is_hidden(int view)
{
	return view >= FIRST_HIDDEN && view < BEHIND_HIDDEN;
}

static int take_behind_a_bar(void *context, int view, float *ret_image, struct error *err)
{
	struct arm_scene scene = *(const struct arm_scene *)context;
	const struct balls lower = {.count = scene.target.balls->count - 8, .ball = scene.target.balls->ball};

	if (is_hidden(view))
		scene.target.balls = &lower;
	return arm_image(&scene, view, ret_image, err);
}

/*
 * Without the highest of like circles a view looks as one a circle further along the axis, where that circle is beside
 * the picture: no view is used from there.
 */
START_TEST(a_circle_behind_a_bar_moves_no_view)
{
	const struct ball_circles like = {.circles = 3, .balls = 8, .diameter = 70, .distance = 18, .ball = 2.5};
	struct arm_scene scene = {
	    .arm = {.columns = 160, .rows = 120, .count = 18, .pixel = .9, .step = 200 * M_PI / 180 / 17, .sag = 1}};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&balls, &like, &err) == 0);
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, take_behind_a_bar, &scene, &balls, false, &calibration, &err) == 0,
		      "%s", err.text);
	for (int k = 0; k < calibration.count; k++) {
		const struct calibrated_view *view = &calibration.views[k];

		ck_assert_msg(view->used || is_hidden(k), "view %d: %s", k, view->refused);
		if (view->used)
			ck_assert_msg(arm_wrong(&scene.arm, k, &view->view) <= .2, "view %d is wrong by %.1f pixels", k,
				      arm_wrong(&scene.arm, k, &view->view));
	}
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/*
 * A few balls of another size tell how a phantom stood that is turned by more than half a step: by where the balls are
 * it looks the same a step further.
 */
START_TEST(balls_of_another_size_tell_how_a_phantom_stood)
{
	enum { VIEWS = 20 };
	struct ball_circles dense = {
	    .circles = 2, .balls = 12, .diameter = 90, .distance = 45, .ball = 3, .shift = M_PI / 12};
	struct arm_scene scene = {
	    .arm = {.columns = 200, .rows = 116, .count = VIEWS, .pixel = 1.1, .step = 2 * M_PI / VIEWS, .sag = 1}};
	const double turn = 18 * M_PI / 180;
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&drawing, &dense, &err) == 0);
	dense.first = turn;
	ck_assert(balls_circles(&balls, &dense, &err) == 0);
	for (int b = 2; b < 24; b += 9)
		drawing.ball[b].diameter = balls.ball[b].diameter = 4.5;
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_msg(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err) == 0, "%s",
		      err.text);
	ck_assert_double_eq_tol(calibration.turn, turn, .02);
	ck_assert_double_eq(calibration.rival_turn, 0);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/* A helix whose code tells top from bottom is not calibrated upside down, where its shadows lie as well. */
START_TEST(a_helix_upside_down_is_refused)
{
	static const char code[] = "10001000100000000101";
	enum { COUNT = sizeof(code) - 1 };
	bool large[COUNT];
	const struct ball_helix helix = {
	    .balls = COUNT, .diameter = 80, .pitch = 45, .step = 25 * M_PI / 180, .ball = {3.2, 4.8}, .large = large};
	struct arm_scene scene = {
	    .arm = {.columns = 200, .rows = 160, .count = 16, .pixel = 1.1, .step = 2 * M_PI / 16, .sag = 1}};
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	for (int b = 0; b < COUNT; b++)
		large[b] = code[b] == '1';
	ck_assert(balls_helix(&drawing, &helix, &err) == 0);
	ck_assert(balls_helix(&balls, &helix, &err) == 0);
	for (int b = 0; b < COUNT; b++)
		for (int a = 1; a < 3; a++)
			balls.ball[b].centre[a] *= -1;
	scene.target = (struct target){.balls = &balls, .ball = .5, .photons = 20000};
	ck_assert_int_eq(arm_calibrate(&scene.arm, arm_image, &scene, &drawing, false, &calibration, &err),
			 ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "or stands upside down") != NULL, "%s", err.text);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/* Of balls of two sizes, all shadows wider than drawn are explained; of two that are exchanged neither is. */
START_TEST(sizes_are_held_against_each_other)
{
	static const double wide = 1.25, pixel_mm[2] = {1.1, 1.1};
	const struct arm arm = {.columns = 200, .rows = 116, .count = 1, .pixel = 1.1, .step = 1};
	struct ball_circles dense = {.circles = 2, .balls = 7, .diameter = 90, .distance = 45, .ball = 3, .shift = .3};
	struct shadow shadows[14];
	struct work work = {.shadows = shadows, .count = 14};
	struct geometry nominal;
	struct calibration calibration = {.count = 1};
	const struct calibrate_request request = {.nominal = &nominal, .pixel_mm = pixel_mm};
	const struct run run = {
	    .request = &request, .calibration = &calibration, .works = &work, .least = 3, .most = 4.05};
	struct balls *balls = &calibration.balls;
	struct pose pose;
	struct error err = {0};

	ck_assert(arm_nominal_geometry(&arm, &nominal, &err) == 0);
	ck_assert(balls_circles(balls, &dense, &err) == 0);
	pose_of_view(&pose, &nominal.views[0]);
	for (int b = 0; b < 14; b++) {
		double pixel[2];

		balls->ball[b].diameter = b % 3 == 0 ? run.most : run.least;
		shadows[b].radius = wide * pose_shadow(&pose, pixel_mm, &balls->ball[b], pixel);
		shadows[b].column = pixel[0];
		shadows[b].row = pixel[1];
		shadows[b].likeness = 1;
	}
	ck_assert_int_eq(presence_unexplained(&run, 0, &pose), 0);
	balls->ball[3].diameter = run.least;
	balls->ball[4].diameter = run.most;
	ck_assert_int_eq(presence_unexplained(&run, 0, &pose), 2);
	balls_clear(balls);
	geometry_clear(&nominal);
}
END_TEST

Suite *calibrate_views_suite(void)
{
	Suite *suite = suite_create("calibrate_views");
	TCase *tests = tcase_create("calibrate_views");

	tcase_set_timeout(tests, 120);
	tcase_add_test(tests, a_view_of_balls_in_a_plane_is_refused);
	tcase_add_test(tests, too_many_views_that_fit_are_told_so);
	tcase_add_test(tests, views_of_one_circle_are_told_so);
	tcase_add_test(tests, eight_balls_are_enough_in_all_views);
	tcase_add_loop_test(tests, a_pose_that_fits_nearly_is_not_taken, 0, 3);
	tcase_add_loop_test(tests, what_poses_between_neighbours_are_worth_is_told, 0, 2);
	tcase_add_loop_test(tests, a_ball_more_or_less_is_told, 0, sizeof(presences) / sizeof(*presences));
	tcase_add_loop_test(tests, views_of_a_flat_phantom_begin_from_their_neighbours, 0,
			    sizeof(flat) / sizeof(*flat));
	tcase_add_test(tests, sources_about_no_axis_have_that_of_the_drawing);
	tcase_add_test(tests, a_phantom_may_stand_beside_the_axis_and_lean);
	tcase_add_loop_test(tests, a_helix_that_leans_is_found, 0, 4);
	tcase_add_test(tests, a_phantom_beside_the_axis_of_a_short_arc_has_its_scale);
	tcase_add_test(tests, a_pose_is_found_down_a_long_valley);
	tcase_add_test(tests, a_phantom_of_many_balls_is_found_turned_as_it_stood);
	tcase_add_loop_test(tests, of_like_circles_each_is_taken_for_itself, 0, sizeof(heights) / sizeof(*heights));
	tcase_add_loop_test(tests, like_circles_are_told_apart_where_the_panel_jumps, 0,
			    sizeof(raised) / sizeof(*raised));
	tcase_add_test(tests, a_code_tells_where_a_helix_stands_behind_a_jump);
	tcase_add_test(tests, a_circle_behind_a_bar_moves_no_view);
	tcase_add_test(tests, a_helix_upside_down_is_refused);
	tcase_add_test(tests, sizes_are_held_against_each_other);
	tcase_add_test(tests, balls_of_another_size_tell_how_a_phantom_stood);
	suite_add_tcase(suite, tests);
	return suite;
}

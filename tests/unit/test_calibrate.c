/* Calibration from balls (core/calibrate), of an arm that sags, with pictures of exact chord lengths. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "proto/calibration.h"
#include "tests/unit/arm.h"

Suite *calibrate_suite(void);

static const struct arm arm_sagging = {.columns = 620,
				       .rows = 480,
				       .count = 18,
				       .pixel = .616,
				       .first = -.3,
				       .step = 20 * M_PI / 180,
				       .sag = 1,
				       .jitter = .05,
				       .seed = 1};
static const struct ball_circles circles = {
    .circles = 2, .balls = 12, .diameter = 110, .distance = 90, .ball = 3.2, .first = .2, .shift = .26};

static int run(struct arm_scene *scene, const struct balls *balls, bool adjust, struct calibration *ret_calibration,
	       struct error *err)
{
	return arm_calibrate(&scene->arm, arm_image, scene, balls, adjust, ret_calibration, err);
}

/*
 * By how much a point is misplaced in the volume, mm: where the rays of the true views through it come nearest to each
 * other once found views say how they run, against where it is. Rays as lines: the point of least squares.
 */
static double misplacement(const struct arm *arm, const struct calibration *calibration, const double point[3])
{
	double normal[3][3] = {{0}}, right[3] = {0}, det[4];

	for (int k = 0; k < calibration->count; k++) {
		const struct view truth = arm_view(arm, k), *found = &calibration->views[k].view;
		double matrix[12], column, row, way[3];

		view_matrix(&truth, matrix);
		view_project(matrix, point, &column, &row);
		for (int i = 0; i < 3; i++)
			way[i] = found->pixel0[i] + column * found->column_step[i] + row * found->row_step[i] -
				 found->source[i];
		for (int i = 0; i < 3; i++)
			for (int j = 0; j < 3; j++) {
				const double across = (i == j) - way[i] * way[j] / vec_dot(way, way);

				normal[i][j] += across;
				right[i] += across * found->source[j];
			}
	}
	for (int c = 0; c < 4; c++) {
		double m[3][3];

		memcpy(m, normal, sizeof(m));
		for (int i = 0; i < 3 && c > 0; i++)
			m[i][c - 1] = right[i];
		det[c] = m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) -
			 m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
			 m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
	}
	return sqrt(pow(det[1] / det[0] - point[0], 2) + pow(det[2] / det[0] - point[1], 2) +
		    pow(det[3] / det[0] - point[2], 2));
}

/* The largest misplacement over points of the volume. */
static double worst_misplacement(const struct arm *arm, const struct calibration *calibration)
{
	double worst = 0;

	for (int i = 0; i < 27; i++) {
		const double point[3] = {(i % 3 - 1) * 40, (i / 3 % 3 - 1) * 40, (i / 9 - 1) * 40};

		worst = fmax(worst, misplacement(arm, calibration, point));
	}
	return worst;
}

/* RMS distance, pixels, between where found and true views see points of the volume. */
static double reprojection(const struct arm *arm, const struct calibration *calibration)
{
	double squares = 0;

	for (int k = 0; k < calibration->count; k++)
		squares += pow(arm_wrong(arm, k, &calibration->views[k].view), 2);
	return sqrt(squares / calibration->count);
}

/* All views are used, and residual, poses and volume are as true as asked for. */
static void assert_found(const char *what, const struct arm *arm, const struct calibration *calibration,
			 double residual)
{
	for (int k = 0; k < calibration->count; k++)
		ck_assert_msg(calibration->views[k].used, "%s: view %d: %s", what, k, calibration->views[k].refused);
	ck_assert_int_eq(calibration->used, calibration->count);
	ck_assert_msg(calibration->rms <= residual, "%s: residual of %.3f pixels", what, calibration->rms);
	ck_assert_msg(reprojection(arm, calibration) <= residual, "%s: views are wrong by %.3f pixels", what,
		      reprojection(arm, calibration));
	ck_assert_msg(worst_misplacement(arm, calibration) <= .1, "%s: the volume is wrong by %.3f mm", what,
		      worst_misplacement(arm, calibration));
}

/* A large ball far off the middle: its shadow's centroid, summed up over fine pixels, against the formula for it. */
START_TEST(the_centroid_of_an_ellipse_is_known)
{
	const struct arm arm = {
	    .columns = 1400, .rows = 1400, .count = 1, .pixel = .2, .sag = 1, .first = .4, .seed = 1};
	const double pixel_mm[2] = {arm.pixel, arm.pixel}, place[3] = {-5, 50, 45};
	struct ball ball = {.diameter = 40};
	const struct balls balls = {.count = 1, .ball = &ball};
	const struct target target = {.balls = &balls, .ball = 1};
	const struct view view = arm_view(&arm, 0);
	float *picture = malloc((size_t)arm.columns * (size_t)arm.rows * sizeof(*picture));
	double mass = 0, sums[2] = {0}, centre[2], modelled[2];
	struct pose pose;

	ball.centre[0] = cos(arm.first) * place[0] - sin(arm.first) * place[1];
	ball.centre[1] = sin(arm.first) * place[0] + cos(arm.first) * place[1];
	ball.centre[2] = place[2];
	arm_picture(&arm, &target, 0, picture);
	for (int i = 0; i < arm.columns * arm.rows; i++) {
		mass += picture[i];
		sums[0] += (double)picture[i] * (i % arm.columns);
		sums[1] += (double)picture[i] * (i / arm.columns);
	}
	pose_of_view(&pose, &view);
	ck_assert_double_ge(pose_shadow(&pose, pixel_mm, &ball, modelled), 100);
	pose_project(&pose, pixel_mm, ball.centre, centre);
	ck_assert_double_ge(hypot(sums[0] / mass - centre[0], sums[1] / mass - centre[1]), .4);
	ck_assert_double_le(hypot(sums[0] / mass - modelled[0], sums[1] / mass - modelled[1]), .01);
	free(picture);
}
END_TEST

/* A row each: what is in the pictures, and what is asked of the result. */
static const struct {
	const char *what;
	double photons, residual; /* pixels */
	int missing;
	bool metal;
} rows[] = {
    {"no noise", 0, .1, 0, false},
    {"20,000 photons", 20000, .2, 0, false},
    {"five balls missing, a clip and a cable", 20000, .2, 5, true},
};

START_TEST(finds_views_of_a_sagging_arm)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_circles(&balls, &circles, &err) == 0);
	scene.target = (struct target){.balls = &balls,
				       .ball = .8,
				       .body = .02,
				       .radius = 62,
				       .missing = rows[_i].missing,
				       .metal = rows[_i].metal,
				       .photons = rows[_i].photons};
	ck_assert_msg(run(&scene, &balls, false, &calibration, &err) == 0, "%s: %s", rows[_i].what, err.text);
	assert_found(rows[_i].what, &scene.arm, &calibration, rows[_i].residual);
	ck_assert_double_eq_tol(calibration.diameter_ratio, 1, .03);
	ck_assert_double_eq_tol(calibration.turn, 0, .01);
	ck_assert_int_eq(calibration.views[3].balls >= 12, 1);
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/* A phantom away from the axis: in a third of the views half of its balls are outside of the picture. */
START_TEST(finds_views_that_see_half_of_the_balls)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};
	int half = 0;

	ck_assert(balls_circles(&balls, &circles, &err) == 0);
	for (int b = 0; b < balls.count; b++)
		balls.ball[b].centre[0] += 122;
	scene.target = (struct target){.balls = &balls, .ball = .8, .photons = 20000};
	ck_assert_msg(run(&scene, &balls, false, &calibration, &err) == 0, "%s", err.text);
	for (int k = 0; k < calibration.count; k++)
		half += calibration.views[k].balls <= balls.count / 2;
	ck_assert_int_ge(half, calibration.count / 3);
	assert_found("half of the balls", &scene.arm, &calibration, .2);
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/* Which warnings tell of a drawing that may be wrong. */
static void expect_doubts(const char *what, const struct calibration *calibration, bool scale, bool shape)
{
	cJSON *document = calibration_json(calibration), *doubts = calibration_doubts(document);
	const cJSON *doubt;
	bool told[2] = {false, false};

	cJSON_ArrayForEach(doubt, doubts)
	{
		const char *code = cJSON_GetObjectItem(doubt, "code")->valuestring;

		told[0] = told[0] || strcmp(code, "calibration_scale") == 0;
		told[1] = told[1] || strcmp(code, "calibration_shape") == 0;
	}
	ck_assert_msg(
	    told[0] == scale && told[1] == shape,
	    "%s: scale %s, shape %s (diameters %.4f +- %.4f, distances %.4f, residual %.3f mm, %.3f explained)", what,
	    told[0] ? "told" : "not told", told[1] ? "told" : "not told", calibration->diameter_ratio,
	    calibration->diameter_error, calibration->distance_ratio, calibration->rms_isocentre,
	    calibration->explained);
	cJSON_Delete(document);
	cJSON_Delete(doubts);
}

/*
 * Panels of coarse pixels, each of which adds up the intensities of 25 rays: shadows of 2 to 4 pixels, most of which
 * touch or cover others'. The last phantom has half of its balls in pairs, 6.4 mm from centre to centre.
 */
static const struct {
	const char *what;
	int columns, rows, views, balls; /* of each circle */
	double pixel, ball, blur, body;
	bool pairs;
} coarse[] = {
    {"balls of 6 mm", 150, 120, 13, 12, 2.54, 6, 0, 0, false},
    {"balls of 3.2 mm", 150, 120, 13, 12, 2.54, 3.2, 0, 0, false},
    {"balls of 3.2 mm in a body", 150, 120, 16, 12, 2.54, 3.2, 0, .02, false},
    {"a detector that blurs", 150, 120, 14, 9, 2.54, 5, .8, .02, false},
    {"few balls", 150, 120, 13, 8, 2.54, 4, 0, 0, false},
    {"pairs of balls", 200, 160, 16, 12, 1.9, 4, 0, 0, true},
};

START_TEST(shadows_that_touch_are_told_apart)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct ball_circles drawn = circles;
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};

	drawn.balls = coarse[_i].balls;
	drawn.ball = coarse[_i].ball;
	drawn.first = 0;
	drawn.shift = M_PI / drawn.balls;
	ck_assert(balls_circles(&balls, &drawn, &err) == 0);
	for (int b = 0; b < balls.count && coarse[_i].pairs; b += 4)
		for (int a = 0; a < 3; a++)
			balls.ball[b + 1].centre[a] = balls.ball[b].centre[a] + (a == 2 ? 3 : b % 8 == 0 ? 4 : -4);
	scene.arm.columns = coarse[_i].columns;
	scene.arm.rows = coarse[_i].rows;
	scene.arm.pixel = coarse[_i].pixel;
	scene.arm.count = coarse[_i].views;
	scene.arm.first = 0;
	scene.arm.step = 2 * M_PI / scene.arm.count;
	scene.target = (struct target){.balls = &balls,
				       .ball = .6,
				       .body = coarse[_i].body,
				       .radius = 62,
				       .photons = 20000,
				       .blur = coarse[_i].blur,
				       .rays = 5};
	ck_assert_msg(run(&scene, &balls, false, &calibration, &err) == 0, "%s: %s", coarse[_i].what, err.text);
	assert_found(coarse[_i].what, &scene.arm, &calibration, .1);
	/* A right drawing has the right diameters, whatever a pixel's side and the detector's blur add: nothing is
	 * told. */
	ck_assert_msg(fabs(calibration.diameter_ratio - 1) <= .015, "%s: diameters of %.4f", coarse[_i].what,
		      calibration.diameter_ratio);
	expect_doubts(coarse[_i].what, &calibration, false, false);
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

/*
 * Balls of 4.7 pixels that let 9 % through, behind a detector that blurs by .8 and 1.3 pixels (standard deviation of a
 * square). Their shadows are no chords any more: they are found all the same, all of them, and nothing is told. Where
 * the drawing is wrong as well, the reason names the blur.
 */
static const struct {
	const char *what;
	double blur, density, distance;
} blurred[] = {
    {"by half of a radius", 3.7, .6, 1},
    {"and another drawing", 3.7, .6, 1.3},
    {"of balls that let more through", 3.7, .3, 1},
    {"a little", 2, .6, 1},
};
enum { BLURRED = sizeof(blurred) / sizeof(*blurred), LONG_BLURRED = 2 };

START_TEST(balls_that_a_detector_blurs_are_found)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct ball_circles drawn = circles;
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};
	int code;

	drawn.ball = 4;
	ck_assert(balls_circles(&balls, &drawn, &err) == 0);
	drawn.distance *= blurred[_i].distance;
	ck_assert(balls_circles(&drawing, &drawn, &err) == 0);
	scene.arm.columns = 200;
	scene.arm.rows = 160;
	scene.arm.pixel = 1.5;
	scene.arm.count = 10;
	scene.arm.step = 2 * M_PI / scene.arm.count;
	scene.target = (struct target){
	    .balls = &balls, .ball = blurred[_i].density, .photons = 20000, .blur = blurred[_i].blur, .rays = 3};
	code = run(&scene, &drawing, false, &calibration, &err);
	if (blurred[_i].distance == 1) {
		ck_assert_msg(code == 0, "%s: %s", blurred[_i].what, err.text);
		assert_found(blurred[_i].what, &scene.arm, &calibration, .1);
		expect_doubts(blurred[_i].what, &calibration, false, false);
		ck_assert_double_eq(calibration.rival_height, 0);
		calibration_clear(&calibration);
	} else {
		ck_assert_int_eq(code, ERR_IMPOSSIBLE);
		ck_assert_msg(strncmp(err.text, "the balls look blurred by about 1", 33) == 0, "%s", err.text);
	}
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/* The upper half of a picture is blurred, as if by something before it: of one circle of two no shadow has chords. */
static int take_half_blurred(void *context, int view, float *ret_image, struct error *err)
{
	struct arm_scene scene = *(const struct arm_scene *)context;
	const size_t half = (size_t)scene.arm.columns * (size_t)scene.arm.rows / 2;
	float *sharp = malloc(2 * half * sizeof(*sharp));
	int code;

	ck_assert_ptr_nonnull(sharp);
	code = arm_image(&scene, view, ret_image, err);
	scene.target.blur = 0;
	if (code == 0)
		code = arm_image(&scene, view, sharp, err);
	memcpy(ret_image + half, sharp + half, half * sizeof(*sharp));
	free(sharp);
	return code;
}

/* Views of one circle look the same a circle aside, where the other is beside the picture: none is used. */
START_TEST(no_view_is_used_a_circle_aside)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct ball_circles is = circles;
	struct balls balls;
	struct calibration calibration;
	struct error err = {0};
	int code;

	is.ball = 4;
	ck_assert(balls_circles(&balls, &is, &err) == 0);
	scene.arm.columns = 254;
	scene.arm.rows = 197;
	scene.arm.pixel = 1.5;
	scene.arm.count = 10;
	scene.arm.sag = .1;
	scene.arm.step = 2 * M_PI / scene.arm.count;
	scene.target = (struct target){.balls = &balls, .ball = .6, .photons = 20000, .blur = 2.6, .rays = 3};
	code = arm_calibrate(&scene.arm, take_half_blurred, &scene, &balls, false, &calibration, &err);
	for (int k = 0; k < calibration.count && code == 0; k++)
		ck_assert_msg(!calibration.views[k].used || arm_wrong(&scene.arm, k, &calibration.views[k].view) <= 1,
			      "view %d is wrong by %.1f pixels", k,
			      arm_wrong(&scene.arm, k, &calibration.views[k].view));
	ck_assert_int_eq(code, ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "the 12 balls that it shows lie nearly in a plane") != NULL, "%s", err.text);
	balls_clear(&balls);
}
END_TEST

/*
 * Drawings that are wrong by 2 %, of 8 balls a circle in 15 views. One of another scale leaves no residual, whatever it
 * is: the balls know of it where these are as drawn, the nominal distances always. One of another shape leaves a
 * residual.
 */
static const struct {
	const char *what;
	double diameter, distance, ball;
	bool scale, shape, balls_know;
} drawings[] = {
    {"right", 1, 1, 1, false, false, false},
    {"all but the balls too large", 1.02, 1.02, 1, true, false, true},
    {"all but the balls too small", .98, .98, 1, true, false, true},
    {"all too large", 1.02, 1.02, 1.02, true, false, false},
    {"all too small", .98, .98, .98, true, false, false},
    {"circles too large", 1.02, 1, 1, true, true, false},
    {"circles too far apart", 1, 1.02, 1, true, true, false},
};

START_TEST(a_drawing_that_is_wrong_by_two_percent_is_told)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct ball_circles is = circles, drawn;
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};
	double off;

	is.balls = 8;
	is.ball = 6;
	is.shift = 20 * M_PI / 180;
	drawn = is;
	drawn.diameter *= drawings[_i].diameter;
	drawn.distance *= drawings[_i].distance;
	drawn.ball *= drawings[_i].ball;
	ck_assert(balls_circles(&balls, &is, &err) == 0);
	ck_assert(balls_circles(&drawing, &drawn, &err) == 0);
	scene.arm.columns = 150;
	scene.arm.rows = 120;
	scene.arm.pixel = 2.54;
	scene.arm.count = 15;
	scene.arm.step = 2 * M_PI / 15;
	scene.target = (struct target){.balls = &balls, .ball = .6, .photons = 20000, .rays = 5};
	ck_assert_msg(run(&scene, &drawing, false, &calibration, &err) == 0, "%s: %s", drawings[_i].what, err.text);
	expect_doubts(drawings[_i].what, &calibration, drawings[_i].scale, drawings[_i].shape);
	off = fabs(calibration.diameter_ratio - 1);
	if (drawings[_i].balls_know)
		ck_assert_msg(off > calibration.diameter_error, "%s: diameters of %.4f +- %.4f", drawings[_i].what,
			      calibration.diameter_ratio, calibration.diameter_error);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/*
 * A right drawing of a phantom that lies 13 mm from the axis, away from the side of a short sweep's sources: these
 * stand 1.1 % further from it than from the axis, which is no scale. One of another scale is told there, too.
 */
START_TEST(a_phantom_beside_the_axis_is_of_no_other_scale)
{
	const double scale = _i == 0 ? 1 : 1.02, turn = .3;
	struct arm_scene scene = {.arm = arm_sagging};
	struct ball_circles is = circles, drawn = circles;
	struct balls balls, drawing;
	struct calibration calibration;
	struct error err = {0};

	is.ball = drawn.ball = 6;
	drawn.diameter *= scale;
	drawn.distance *= scale;
	drawn.ball *= scale;
	ck_assert(balls_circles(&balls, &is, &err) == 0);
	ck_assert(balls_circles(&drawing, &drawn, &err) == 0);
	scene.arm.columns = 200;
	scene.arm.rows = 160;
	scene.arm.pixel = 1.9;
	scene.arm.count = 21;
	scene.arm.step = 10 * M_PI / 180;
	scene.arm.first = turn - 100 * M_PI / 180;
	for (int b = 0; b < balls.count; b++) {
		balls.ball[b].centre[0] -= 13 * cos(turn);
		balls.ball[b].centre[1] -= 13 * sin(turn);
	}
	scene.target = (struct target){.balls = &balls, .ball = .6, .photons = 20000, .rays = 5};
	ck_assert_msg(run(&scene, &drawing, false, &calibration, &err) == 0, "%s", err.text);
	ck_assert_double_lt(fabs(calibration.distance_ratio / scale - 1), .005);
	expect_doubts(_i == 0 ? "right" : "2 % too large", &calibration, _i == 1, false);
	calibration_clear(&calibration);
	balls_clear(&balls);
	balls_clear(&drawing);
}
END_TEST

/*
 * Two balls whose shadows cover each other, nearer and nearer: the pose has both half a pixel aside, and each place
 * that is told is where the ball's shadow is. Where nearly all of one is in the other none may be told, and a third
 * beside them, alone, always is.
 */
START_TEST(shadows_that_cover_each_other_are_fitted_together)
{
	const struct arm arm = {.columns = 60, .rows = 60, .count = 1, .pixel = 2.54, .sag = 0, .seed = 3};
	const double pixel_mm[2] = {arm.pixel, arm.pixel}, apart = .5 * (8 - _i);
	struct ball ball[] = {
	    {{0, 0, 0}, 6}, {{0, apart, .3 * apart}, 6}, {{0, -20, 18}, 6}}; /* mm, across the view's rays */
	const struct balls balls = {.count = 3, .ball = ball};
	const struct target target = {.balls = &balls, .ball = .6, .photons = 20000, .rays = 8};
	const struct view truth = arm_view(&arm, 0);
	struct match_view view = {.columns = arm.columns, .rows = arm.rows};
	float image[60 * 60];
	struct pair pairs[3];
	struct pose pose, aside;
	int count, known = 0;

	arm_picture(&arm, &target, 0, image);
	pose_of_view(&pose, &truth);
	aside = pose;
	aside.detector[0] += .5 * arm.pixel;
	count = touching_fit(&view, image, &aside, pixel_mm, &balls, pairs);
	for (int i = 0; i < count; i++) {
		double pixel[2];

		pose_shadow(&pose, pixel_mm, &ball[pairs[i].ball], pixel);
		ck_assert_msg(hypot(pixel[0] - pairs[i].pixel[0], pixel[1] - pairs[i].pixel[1]) <= .15,
			      "%.1f mm apart, ball %d: at %.2f %.2f, expected %.2f %.2f", apart, pairs[i].ball,
			      pairs[i].pixel[0], pairs[i].pixel[1], pixel[0], pixel[1]);
		known += pairs[i].ball < 2;
	}
	ck_assert_int_eq(count - known, 1);
	if (apart >= 2)
		ck_assert_int_eq(known, 2);
}
END_TEST

/* Puts a phantom down beside its place: turned about z, then about x, then moved. */
static void put_down(struct balls *balls, double turn, double tilt, const double shift[3])
{
	for (int b = 0; b < balls->count; b++) {
		double *c = balls->ball[b].centre;
		const double x = cos(turn) * c[0] - sin(turn) * c[1], y = sin(turn) * c[0] + cos(turn) * c[1];
		const double z = c[2];

		c[0] = x + shift[0];
		c[1] = cos(tilt) * y - sin(tilt) * z + shift[1];
		c[2] = sin(tilt) * y + cos(tilt) * z + shift[2];
	}
}

/*
 * Phantoms that look the same a ball further on, put down some degrees and millimetres beside their place: each view
 * that is used has every ball where it stands, and the turn is that of the phantom, not a ball further.
 */
static const struct {
	struct arm arm;
	struct ball_circles circles; /* or */
	struct ball_helix helix;
	double turn, tilt, shift[3];
} beside[] = {
    {.arm = {.first = 4.6461, .step = -.628319, .sag = 1.036, .jitter = .032, .seed = 36},
     .circles = {.circles = 2, .balls = 9, .diameter = 104.9, .distance = 56, .ball = 3, .first = 3.109, .shift = .2},
     .turn = .0403,
     .tilt = .0246,
     .shift = {-4.7, .6, -8.8}},
    {.arm = {.first = 3.17783, .step = -.628319, .sag = 1.2716, .jitter = .023, .seed = 34},
     .helix = {.balls = 22, .diameter = 101.6, .pitch = 47.15, .first = -.736, .step = .356, .ball = {2.51, 2.51}},
     .turn = .0942,
     .tilt = -.067,
     .shift = {-4.2, 3.9, 2.4}},
};

START_TEST(a_phantom_beside_its_place_is_taken_for_no_other)
{
	struct arm_scene scene = {.arm = beside[_i].arm};
	struct balls drawing, standing;
	struct calibration calibration;
	struct error err = {0};

	scene.arm.columns = arm_sagging.columns;
	scene.arm.rows = arm_sagging.rows;
	scene.arm.pixel = arm_sagging.pixel;
	scene.arm.count = 10;
	if (beside[_i].helix.balls > 0)
		ck_assert(balls_helix(&drawing, &beside[_i].helix, &err) == 0);
	else
		ck_assert(balls_circles(&drawing, &beside[_i].circles, &err) == 0);
	ck_assert(balls_copy(&standing, drawing.ball, drawing.count, &err) == 0);
	put_down(&standing, beside[_i].turn, beside[_i].tilt, beside[_i].shift);
	scene.target = (struct target){.balls = &standing, .ball = .7, .photons = 20000};
	ck_assert_msg(run(&scene, &drawing, false, &calibration, &err) == 0, "%s", err.text);
	ck_assert_double_eq_tol(calibration.turn, beside[_i].turn, .02);
	/* A helix that is a ball further along itself lacks one at its end, and has another at its other end. */
	ck_assert((fabs(calibration.rival_turn) > .2) == (beside[_i].circles.balls > 0));
	for (int k = 0; k < calibration.count; k++)
		for (int b = 0; b < drawing.count && calibration.views[k].used; b++) {
			const struct view truth = arm_view(&scene.arm, k);
			double is[12], found[12], pixel[4];

			view_matrix(&truth, is);
			view_matrix(&calibration.views[k].view, found);
			view_project(is, standing.ball[b].centre, &pixel[0], &pixel[1]);
			view_project(found, drawing.ball[b].centre, &pixel[2], &pixel[3]);
			ck_assert_msg(hypot(pixel[0] - pixel[2], pixel[1] - pixel[3]) < .2,
				      "view %d, ball %d: at %.2f %.2f, expected %.2f %.2f", k, b, pixel[2], pixel[3],
				      pixel[0], pixel[1]);
		}
	calibration_clear(&calibration);
	balls_clear(&drawing);
	balls_clear(&standing);
}
END_TEST

/* A view as the same pictures have it from where a phantom looks the same: turned about z, or half a turn about a line.
 */
static void look_from_elsewhere(struct view *view, double turn, bool over, double line)
{
	double *vectors[] = {view->source, view->pixel0, view->column_step, view->row_step};

	for (int i = 0; i < 4; i++) {
		double *v = vectors[i];
		const double x = v[0], y = v[1], along = x * cos(line) + y * sin(line);

		v[0] = over ? 2 * along * cos(line) - x : cos(turn) * x - sin(turn) * y;
		v[1] = over ? 2 * along * sin(line) - y : sin(turn) * x + cos(turn) * y;
		v[2] = over ? -v[2] : v[2];
	}
}

/* The arm's nominal geometry, and its views as they are, all used. */
static void use_views(const struct arm *arm, struct geometry *ret_nominal, struct calibrated_view *ret_views)
{
	struct error err = {0};

	ck_assert_msg(arm_nominal_geometry(arm, ret_nominal, &err) == 0, "%s", err.text);
	for (int k = 0; k < arm->count; k++)
		ret_views[k] = (struct calibrated_view){.view = arm_view(arm, k), .used = true};
}

/*
 * Two circles of 16 balls, each between two of the other's, look the same half a turn about lines between them, and a
 * ball further on. Views that have no residual there are refused, alone, before or after the first and side by side,
 * and none that stands where the arm does.
 */
START_TEST(a_view_from_another_side_of_the_phantom_is_refused)
{
	enum { VIEWS = 30 };
	const double step = M_PI / 8, pixel_mm[2] = {2.47, 2.47};
	const struct arm arm = {.columns = 147,
				.rows = 127,
				.count = VIEWS,
				.pixel = 2.47,
				.first = 4.12,
				.step = 240 * M_PI / 180 / (VIEWS - 1),
				.sag = 1.5,
				.jitter = 1,
				.seed = 5};
	const struct {
		int view;
		double turn;
		bool over;
	} elsewhere[] = {{0, -step, false}, {1, -step, false}, {8, 0, true},      {12, 0, true},
			 {13, step, false}, {14, step, false}, {15, step, false}, {29, M_PI, false}};
	struct geometry nominal;
	struct calibrated_view views[VIEWS] = {{.used = true}};
	struct calibration calibration = {.count = VIEWS, .views = views};
	const struct calibrate_request request = {.nominal = &nominal, .pixel_mm = pixel_mm};
	bool refused[VIEWS] = {false};
	struct error err = {0};

	use_views(&arm, &nominal, views);
	for (size_t i = 0; i < sizeof(elsewhere) / sizeof(*elsewhere); i++) {
		struct view *view = &views[elsewhere[i].view].view;

		/* View 8 from its own side, the detector upside down; view 12 from wherever the line has it. */
		look_from_elsewhere(view, elsewhere[i].turn, elsewhere[i].over,
				    elsewhere[i].view == 8 ? atan2(view->source[1], view->source[0]) : 1.5 * step);
		refused[elsewhere[i].view] = true;
	}
	ck_assert_msg(follow_refuse(&calibration, &request, 0, &err) == 0, "%s", err.text);
	for (int k = 0; k < VIEWS; k++)
		ck_assert_msg(views[k].used == !refused[k] && (views[k].refused[0] != '\0') == refused[k],
			      "view %d is %s: %s", k, views[k].used ? "used" : "refused", views[k].refused);
	geometry_clear(&nominal);
}
END_TEST

/* A short sweep over the angle of 180 degrees whose ends stand 15 degrees further apart than the nominal ones. */
START_TEST(the_ends_of_a_short_sweep_follow_no_view)
{
	enum { VIEWS = 30 };
	const double pixel_mm[2] = {2.47, 2.47};
	const struct arm arm = {.columns = 147,
				.rows = 127,
				.count = VIEWS,
				.pixel = 2.47,
				.first = 2,
				.step = 200 * M_PI / 180 / (VIEWS - 1),
				.sag = 1,
				.seed = 5};
	struct geometry nominal;
	struct calibrated_view views[VIEWS];
	struct calibration calibration = {.count = VIEWS, .views = views};
	const struct calibrate_request request = {.nominal = &nominal, .pixel_mm = pixel_mm};
	struct error err = {0};

	use_views(&arm, &nominal, views);
	for (int k = 0; k < VIEWS; k++)
		look_from_elsewhere(&views[k].view, (k - VIEWS / 2) * .5 * M_PI / 180, false, 0);
	ck_assert_msg(follow_refuse(&calibration, &request, 0, &err) == 0, "%s", err.text);
	for (int k = 0; k < VIEWS; k++)
		ck_assert_msg(views[k].used, "view %d: %s", k, views[k].refused);
	geometry_clear(&nominal);
}
END_TEST

START_TEST(a_code_that_reads_the_same_backwards_is_refused)
{
	/* 01101001110010110100: backwards, and 3 places on, all of it. */
	static const bool palindrome[20] = {0, 1, 1, 0, 1, 0, 0, 1, 1, 1, 0, 0, 1, 0, 1, 1, 0, 1, 0, 0};
	const struct ball_helix helix = {
	    .balls = 20, .diameter = 110, .pitch = 40, .step = .628, .ball = {3, 5}, .large = palindrome};
	struct balls balls = {0};
	struct error err = {0};

	ck_assert_int_eq(balls_helix(&balls, &helix, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.pointer, "/code");
}
END_TEST

/* Balls of two sizes on a helix tell by themselves how the phantom was turned. */
START_TEST(the_code_of_two_sizes_finds_a_phantom_however_it_is_turned)
{
	static const bool large[40] = {1, 1, 0, 1, 0, 0, 1, 1, 1, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0,
				       1, 0, 1, 0, 0, 1, 1, 0, 1, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 1};
	const double turn = 100 * M_PI / 180;
	const struct ball_helix helix = {
	    .balls = 40, .diameter = 110, .pitch = 40, .step = .42, .ball = {3, 5}, .large = large};
	struct arm_scene scene = {.arm = arm_sagging};
	struct balls drawing, standing;
	struct calibration calibration;
	struct error err = {0};

	ck_assert(balls_helix(&drawing, &helix, &err) == 0);
	ck_assert(balls_copy(&standing, drawing.ball, drawing.count, &err) == 0);
	for (int b = 0; b < standing.count; b++) {
		const double *from = drawing.ball[b].centre;

		standing.ball[b].centre[0] = cos(turn) * from[0] - sin(turn) * from[1];
		standing.ball[b].centre[1] = sin(turn) * from[0] + cos(turn) * from[1];
	}
	scene.target = (struct target){.balls = &standing, .ball = .5, .photons = 20000};
	ck_assert_msg(run(&scene, &standing, false, &calibration, &err) == 0, "%s", err.text);
	assert_found("as drawn", &scene.arm, &calibration, .2);
	calibration_clear(&calibration);
	/* The result's world is the drawing's: views turn back with the phantom. */
	ck_assert_msg(run(&scene, &drawing, false, &calibration, &err) == 0, "%s", err.text);
	ck_assert_double_eq_tol(calibration.turn, turn, .01);
	ck_assert_double_eq(calibration.rival_turn, 0);
	ck_assert_int_eq(calibration.used, calibration.count);
	ck_assert_double_le(calibration.rms, .2);
	calibration_clear(&calibration);
	balls_clear(&drawing);
	balls_clear(&standing);
}
END_TEST

/* Balls up to .08 mm from their drawing: adjusted, residual and balls come nearer to the truth. */
START_TEST(adjusting_the_balls_takes_errors_of_machining_out)
{
	struct arm_scene scene = {.arm = arm_sagging};
	struct balls drawing, machined;
	struct calibration plain, adjusted;
	struct error err = {0};

	ck_assert(balls_circles(&drawing, &circles, &err) == 0);
	ck_assert(balls_copy(&machined, drawing.ball, drawing.count, &err) == 0);
	for (int b = 0; b < machined.count; b++)
		for (int a = 0; a < 3; a++)
			machined.ball[b].centre[a] += .08 * sin(12.9898 * b + 78.233 * a + 1);
	scene.target = (struct target){.balls = &machined, .ball = .8, .photons = 20000};
	ck_assert_msg(run(&scene, &drawing, false, &plain, &err) == 0, "%s", err.text);
	ck_assert_msg(run(&scene, &drawing, true, &adjusted, &err) == 0, "%s", err.text);
	ck_assert_double_ge(plain.rms, .1);
	ck_assert_double_le(adjusted.rms, .06);
	ck_assert_double_ge(adjusted.adjusted_rms, .03);
	ck_assert_double_le(worst_misplacement(&scene.arm, &adjusted), .1);
	calibration_clear(&plain);
	calibration_clear(&adjusted);
	balls_clear(&drawing);
	balls_clear(&machined);
}
END_TEST

/* Views between, by angle, are those of the arm there; beyond the sweep there are none. */
START_TEST(views_between_calibrated_ones_are_the_arms)
{
	struct arm arm = arm_sagging, other = arm_sagging;
	struct geometry nominal, between;
	struct view views[64];
	double angles[40], worst = 0;
	struct error err = {0};

	arm.jitter = other.jitter = 0;
	arm.count = 50;
	arm.step = 4 * M_PI / 180;
	other.count = 40;
	other.step = 49.0 / 39 * arm.step;
	ck_assert(arm_nominal_geometry(&arm, &nominal, &err) == 0);
	for (int k = 0; k < arm.count; k++)
		views[k] = arm_view(&arm, k);
	for (int k = 0; k < other.count; k++)
		angles[k] = other.first + (other.count - 1 - k) * other.step;
	ck_assert_msg(calibration_between(&between, &nominal, views, angles, other.count, &err) == 0, "%s", err.text);
	for (int k = 0; k < other.count; k++) {
		const struct view truth = arm_view(&other, other.count - 1 - k);
		const double point[3] = {30, -20, 40};
		double a[12], b[12], pixel[4];

		view_matrix(&truth, a);
		view_matrix(&between.views[k], b);
		view_project(a, point, &pixel[0], &pixel[1]);
		view_project(b, point, &pixel[2], &pixel[3]);
		worst = fmax(worst, hypot(pixel[0] - pixel[2], pixel[1] - pixel[3]));
	}
	ck_assert_double_le(worst, .05);
	geometry_clear(&between);
	angles[7] += M_PI;
	ck_assert_int_eq(calibration_between(&between, &nominal, views, angles, other.count, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "view 7 stands at") != NULL, "%s", err.text);
	geometry_clear(&nominal);
}
END_TEST

/* What pictures can be that no calibration comes of, and what it is told by. */
enum fault { WRONG_PHANTOM, WRONG_DIAMETER, EMPTY, COUNTS, WRONG_SCALE };
static const struct {
	enum fault fault;
	const char *words;
} faults[] = {
    {WRONG_PHANTOM, "do not fit this phantom, and no pose could be fitted to any of them: the best"},
    {WRONG_DIAMETER, "(4.7"},
    {EMPTY, "shadows of a ball are in a view, expected 7 or more"},
    {COUNTS, "no line integral: these are counts without their air"},
    {WRONG_SCALE, "times as far from the axis"},
};

static int take_counts(void *context, int view, float *ret_image, struct error *err)
{
	const struct arm_scene *scene = context;
	const int code = arm_image(context, view, ret_image, err);

	for (int i = 0; i < scene->arm.columns * scene->arm.rows; i++)
		ret_image[i] = 60000 * expf(-ret_image[i]);
	return code;
}

START_TEST(pictures_that_do_not_fit_are_refused_with_their_numbers)
{
	struct ball_circles given = circles;
	struct arm_scene scene = {.arm = arm_sagging};
	struct balls balls, asked;
	struct geometry nominal;
	struct calibration calibration = {0};
	struct error err = {0};
	const double pixel_mm[2] = {arm_sagging.pixel, arm_sagging.pixel};
	struct calibrate_request request = {
	    .nominal = &nominal, .pixel_mm = pixel_mm, .balls = &asked, .image = arm_image, .context = &scene};

	scene.arm.count = 9;
	scene.arm.step *= 2;
	scene.target = (struct target){.balls = &balls, .ball = .8, .body = .02, .radius = 62, .photons = 20000};
	switch (faults[_i].fault) {
	case WRONG_PHANTOM:
		given.balls = 10;
		given.distance = 70;
		break;
	case WRONG_DIAMETER:
		given.ball = 4.7;
		break;
	case EMPTY:
		scene.target.ball = 0;
		break;
	case COUNTS:
		request.image = take_counts;
		break;
	case WRONG_SCALE:
		given.diameter *= 1.12;
		given.distance *= 1.12;
		given.ball *= 1.12;
		break;
	}
	ck_assert(balls_circles(&balls, faults[_i].fault == WRONG_DIAMETER ? &given : &circles, &err) == 0);
	ck_assert(balls_circles(&asked, faults[_i].fault == WRONG_DIAMETER ? &circles : &given, &err) == 0);
	ck_assert(arm_nominal_geometry(&scene.arm, &nominal, &err) == 0);
	ck_assert_int_eq(calibrate(&calibration, &request, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, faults[_i].words) != NULL, "%s", err.text);
	if (faults[_i].fault == WRONG_PHANTOM) {
		const char *told = strstr(err.text, " leaves a residual of ");
		double pixels;
		int over;

		ck_assert_ptr_ne(told, NULL);
		ck_assert_int_eq(
		    sscanf(told, " leaves a residual of %lf pixels over %d balls; view 0:", &pixels, &over), 2);
		ck_assert(pixels > 1 && over >= 7 && over <= 20); /* a pose that fits leaves a tenth of that */
	}
	ck_assert_ptr_eq(calibration.views, NULL);
	geometry_clear(&nominal);
	balls_clear(&balls);
	balls_clear(&asked);
}
END_TEST

/* One view whose arm was pushed: it alone is refused, and gets the pose between its neighbours'. */
static int take_pushed(void *context, int view, float *ret_image, struct error *err)
{
	struct arm_scene scene = *(const struct arm_scene *)context;

	if (view == 9)
		scene.arm.first += 1.5 * M_PI / 180;
	return arm_image(&scene, view, ret_image, err);
}

/* _i: whether the balls' places are adjusted, too, which the view has no part in. */
START_TEST(a_view_that_does_not_follow_its_neighbours_is_refused)
{
	struct arm_scene scene = {.arm = arm_sagging};
	const double pixel_mm[2] = {scene.arm.pixel, scene.arm.pixel};
	struct balls balls;
	struct geometry nominal;
	struct calibration calibration;
	struct error err = {0};
	const struct calibrate_request request = {.nominal = &nominal,
						  .pixel_mm = pixel_mm,
						  .balls = &balls,
						  .image = take_pushed,
						  .context = &scene,
						  .adjust_balls = _i == 1};

	scene.arm.count = 40;
	scene.arm.step = 2 * M_PI / 180;
	scene.target = (struct target){.balls = &balls, .ball = .8};
	ck_assert(balls_circles(&balls, &circles, &err) == 0);
	ck_assert(arm_nominal_geometry(&scene.arm, &nominal, &err) == 0);
	ck_assert_msg(calibrate(&calibration, &request, &err) == 0, "%s", err.text);
	ck_assert_int_eq(calibration.used, 39);
	ck_assert(!calibration.views[9].used);
	ck_assert_msg(strstr(calibration.views[9].refused, "from where the neighbouring views have them") != NULL, "%s",
		      calibration.views[9].refused);
	ck_assert_double_le(reprojection(&scene.arm, &calibration), .3);
	geometry_clear(&nominal);
	calibration_clear(&calibration);
	balls_clear(&balls);
}
END_TEST

START_TEST(phantoms_that_determine_no_view_are_refused)
{
	struct ball line[9], plane[9];
	struct balls balls;
	struct error err = {0};

	for (int i = 0; i < 9; i++) {
		line[i] = (struct ball){.centre = {10 * i, 5 * i, 2}, .diameter = 3};
		plane[i] = (struct ball){.centre = {10 * i, 7 * (i * i % 9), 2}, .diameter = 3};
	}
	ck_assert_int_eq(balls_copy(&balls, line, 3, &err), ERR_INVALID);
	ck_assert_str_eq(err.text, "a phantom of 3 balls, expected 8 to 512");
	ck_assert_int_eq(balls_copy(&balls, line, 9, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "all balls lie on a line: their places spread by 28.9, ") != NULL, "%s",
		      err.text);
	ck_assert_int_eq(balls_copy(&balls, plane, 9, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "all balls lie in a plane") != NULL, "%s", err.text);
	plane[4].centre[2] = NAN;
	ck_assert_int_eq(balls_copy(&balls, plane, 9, &err), ERR_INVALID);
	ck_assert_str_eq(err.pointer, "/balls_mm/4");
	plane[4].centre[2] = 30;
	plane[5] = plane[4];
	ck_assert_int_eq(balls_copy(&balls, plane, 9, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.pointer, "/balls_mm/5");
	ck_assert_msg(strstr(err.text, "inside of another ball") != NULL, "%s", err.text);
}
END_TEST

Suite *calibrate_suite(void)
{
	Suite *suite = suite_create("calibrate");
	TCase *tests = tcase_create("calibrate"), *longer = tcase_create("long");

	tcase_set_timeout(tests, 120);
	tcase_set_timeout(longer, 120);
	tcase_set_tags(longer, "long");
	tcase_add_loop_test(tests, finds_views_of_a_sagging_arm, 0, sizeof(rows) / sizeof(*rows));
	tcase_add_test(tests, the_centroid_of_an_ellipse_is_known);
	tcase_add_test(tests, finds_views_that_see_half_of_the_balls);
	tcase_add_loop_test(tests, shadows_that_touch_are_told_apart, 0, sizeof(coarse) / sizeof(*coarse));
	tcase_add_loop_test(tests, balls_that_a_detector_blurs_are_found, 0, BLURRED - LONG_BLURRED);
	tcase_add_loop_test(longer, balls_that_a_detector_blurs_are_found, BLURRED - LONG_BLURRED, BLURRED);
	tcase_add_test(tests, no_view_is_used_a_circle_aside);
	tcase_add_loop_test(tests, a_drawing_that_is_wrong_by_two_percent_is_told, 0,
			    sizeof(drawings) / sizeof(*drawings));
	tcase_add_loop_test(tests, a_phantom_beside_the_axis_is_of_no_other_scale, 0, 2);
	tcase_add_loop_test(tests, shadows_that_cover_each_other_are_fitted_together, 0, 8);
	tcase_add_loop_test(tests, a_phantom_beside_its_place_is_taken_for_no_other, 0,
			    sizeof(beside) / sizeof(*beside));
	tcase_add_test(tests, the_ends_of_a_short_sweep_follow_no_view);
	tcase_add_test(tests, a_view_from_another_side_of_the_phantom_is_refused);
	tcase_add_test(tests, a_code_that_reads_the_same_backwards_is_refused);
	tcase_add_test(tests, the_code_of_two_sizes_finds_a_phantom_however_it_is_turned);
	tcase_add_test(tests, adjusting_the_balls_takes_errors_of_machining_out);
	tcase_add_test(tests, views_between_calibrated_ones_are_the_arms);
	tcase_add_loop_test(tests, pictures_that_do_not_fit_are_refused_with_their_numbers, 0,
			    sizeof(faults) / sizeof(*faults));
	tcase_add_loop_test(tests, a_view_that_does_not_follow_its_neighbours_is_refused, 0, 2);
	tcase_add_test(tests, phantoms_that_determine_no_view_are_refused);
	suite_add_tcase(suite, tests);
	suite_add_tcase(suite, longer);
	return suite;
}

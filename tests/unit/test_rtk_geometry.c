/* RTK's geometry files: the documentation's own numbers, round trips over all kinds of orbits, and what is refused. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/rtk_geometry.h"

/* Of vectors of a thousand mm after a decomposition into angles and back: what the issue asks for. */
static const double EXACT = 1e-10;

enum { COLUMNS = 64, ROWS = 48, VIEWS = 25 };

static const struct rtk_stack unit_stack = {{-31.5, -23.5}, {1, 0}, {0, 1}};

/* A whole file around what stands in it. */
static const char *file_of(const char *inside)
{
	static char text[8192];

	snprintf(text, sizeof(text),
		 "<?xml version=\"1.0\"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version=\"3\">\n%s"
		 "</RTKThreeDCircularGeometry>\n",
		 inside);
	return text;
}

static void parse(const char *text, struct rtk_geometry *ret)
{
	struct error err = {0};

	ck_assert_msg(rtk_geometry_parse(text, strlen(text), ret, &err) == 0, "%s", err.text);
}

static void assert_vector(const double *got, const double *expected, double tolerance, const char *what, int view)
{
	for (int i = 0; i < 3; i++)
		ck_assert_msg(fabs(got[i] - expected[i]) <= tolerance,
			      "%s of view %d: (%.15g, %.15g, %.15g), expected "
			      "(%.15g, %.15g, %.15g)",
			      what, view, got[0], got[1], got[2], expected[0], expected[1], expected[2]);
}

static void assert_same_views(const struct geometry *got, const struct geometry *expected, double tolerance)
{
	ck_assert_int_eq(got->count, expected->count);
	for (int k = 0; k < got->count; k++) {
		const struct view *a = &got->views[k], *b = &expected->views[k];

		assert_vector(a->source, b->source, tolerance, "source", k);
		assert_vector(a->pixel0, b->pixel0, tolerance, "pixel0", k);
		assert_vector(a->column_step, b->column_step, tolerance, "column step", k);
		assert_vector(a->row_step, b->row_step, tolerance, "row step", k);
	}
}

/* ---- the documentation's example ---- */

static const char example[] = "<SourceToIsocenterDistance>1000</SourceToIsocenterDistance>\n"
			      "<SourceToDetectorDistance>1536</SourceToDetectorDistance>\n"
			      "<Projection><GantryAngle>271.847274780273</GantryAngle>\n"
			      "<ProjectionOffsetX>-117.056503295898</ProjectionOffsetX>\n"
			      "<ProjectionOffsetY>-1.01195001602173</ProjectionOffsetY>\n"
			      "<Matrix> -166.5093078829 0 -1531.42837748039 -117056.503295898\n"
			      "-1.01142410874151 -1536 0.0326206557691505 -1011.95001602173\n"
			      "-0.999480303105996 0 0.0322354417240802 -1000 </Matrix></Projection>\n";

START_TEST(the_documented_matrix_and_parameters_agree)
{
	struct rtk_geometry rtk;
	struct geometry by_parameters, by_matrix;
	struct error err = {0};

	parse(file_of(example), &rtk);
	ck_assert_int_eq(rtk.count, 1);
	ck_assert_msg(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_BOTH, &by_parameters, &err) == 0, "%s",
		      err.text);
	ck_assert_msg(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_MATRICES, &by_matrix, &err) == 0, "%s",
		      err.text);
	/* The example's numbers have 15 digits, the largest of them six before the point. */
	assert_same_views(&by_matrix, &by_parameters, 1e-8);
	geometry_clear(&by_parameters);
	geometry_clear(&by_matrix);
	rtk_geometry_clear(&rtk);
}
END_TEST

/* At gantry angle g the source stands at our angle g; u and v are ours. */
START_TEST(a_plain_circle_is_ours)
{
	const struct circular orbit = {
	    .source_to_isocentre = 600, .source_to_detector = 1200, .pixel = {1, 1}, .detector_offset = {7, -3}};
	const double angles[2] = {30 * M_PI / 180, 275 * M_PI / 180};
	struct geometry ours, theirs;
	struct rtk_geometry rtk;
	struct error err = {0};

	parse(file_of("<SourceToIsocenterDistance>600</SourceToIsocenterDistance>"
		      "<SourceToDetectorDistance>1200</SourceToDetectorDistance>"
		      "<Projection><GantryAngle>30</GantryAngle><ProjectionOffsetX>7</ProjectionOffsetX>"
		      "<ProjectionOffsetY>-3</ProjectionOffsetY></Projection>"
		      "<Projection><Angle>275</Angle></Projection>"),
	      &rtk);
	ck_assert_int_eq(geometry_circular(&ours, COLUMNS, ROWS, 2, &orbit, angles, &err), 0);
	ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_BOTH, &theirs, &err), 0);
	assert_same_views(&theirs, &ours, EXACT);
	geometry_clear(&ours);
	geometry_clear(&theirs);
	rtk_geometry_clear(&rtk);
}
END_TEST

/*
 * Worked by hand from RTK's text. In plane: the detector's columns go from x towards y of RTK, our y towards z.
 * Out of plane, counter-clockwise seen from +x: the source goes from z down to -y of RTK, our x down to -z.
 */
START_TEST(angles_turn_as_documented)
{
	const double s = sqrt(0.5);
	const struct {
		const char *name;
		int degrees;
		double source[3], column[3], row[3];
	} turns[] = {
	    {"GantryAngle", 45, {600 * s, 600 * s, 0}, {-s, s, 0}, {0, 0, 1}},
	    {"InPlaneAngle", 90, {600, 0, 0}, {0, 0, 1}, {0, -1, 0}},
	    {"OutOfPlaneAngle", 45, {600 * s, 0, -600 * s}, {0, 1, 0}, {s, 0, s}},
	};

	for (size_t i = 0; i < sizeof(turns) / sizeof(turns[0]); i++) {
		char text[400];
		struct rtk_geometry rtk;
		struct geometry views;
		struct error err = {0};

		snprintf(
		    text, sizeof(text),
		    "<SourceToIsocenterDistance>600</SourceToIsocenterDistance>"
		    "<SourceToDetectorDistance>1200</SourceToDetectorDistance><Projection><%s>%d</%s></Projection>",
		    turns[i].name, turns[i].degrees, turns[i].name);
		parse(file_of(text), &rtk);
		ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_BOTH, &views, &err), 0);
		assert_vector(views.views[0].source, turns[i].source, EXACT, turns[i].name, 0);
		assert_vector(views.views[0].column_step, turns[i].column, EXACT, turns[i].name, 0);
		assert_vector(views.views[0].row_step, turns[i].row, EXACT, turns[i].name, 0);
		geometry_clear(&views);
		rtk_geometry_clear(&rtk);
	}
}
END_TEST

START_TEST(values_hold_until_they_change)
{
	struct rtk_geometry rtk;

	parse(file_of("<SourceToIsocenterDistance>600</SourceToIsocenterDistance>"
		      "<SourceToDetectorDistance>1200</SourceToDetectorDistance><InPlaneAngle>1</InPlaneAngle>"
		      "<Projection><GantryAngle>1</GantryAngle><SourceOffsetX>5</SourceOffsetX></Projection>"
		      "<Projection><gantryangle>2</gantryangle><outofplaneangle>-3</outofplaneangle>"
		      "<SourceToIsocenterDistance>601</SourceToIsocenterDistance></Projection>"
		      "<Projection><GantryAngle>3</GantryAngle><SourceOffsetX>0</SourceOffsetX>"
		      "<CollimationUInf>40</CollimationUInf></Projection>"),
	      &rtk);
	ck_assert_int_eq(rtk.count, 3);
	for (int k = 0; k < 3; k++) {
		const struct rtk_projection *p = &rtk.projections[k];

		ck_assert_double_eq(p->gantry_angle, k + 1);
		ck_assert_double_eq(p->source_to_isocentre, k < 1 ? 600 : 601);
		ck_assert_double_eq(p->source_to_detector, 1200);
		ck_assert_double_eq(p->source_offset[0], k < 2 ? 5 : 0);
		ck_assert_double_eq(p->in_plane_angle, 1);
		ck_assert_double_eq(p->out_of_plane_angle, k < 1 ? 0 : -3);
		ck_assert(!p->has_matrix);
	}
	ck_assert(rtk.collimated);
	rtk_geometry_clear(&rtk);
}
END_TEST

/* ---- round trips ---- */

static double uniform(unsigned long long *seed, double from, double to)
{
	*seed = *seed * 6364136223846793005ULL + 1442695040888963407ULL;
	return from + (to - from) * (double)(*seed >> 11) / 9007199254740992.0;
}

static void turn(double vector[3], int axis, double angle)
{
	int i = (axis + 1) % 3, j = (axis + 2) % 3;
	double x = vector[i], y = vector[j];

	vector[i] = cos(angle) * x - sin(angle) * y;
	vector[j] = sin(angle) * x + cos(angle) * y;
}

/* The whole arm about an axis of the world, or the detector alone about its centre. */
static void turn_view(struct view *view, int axis, double angle, int detector_only)
{
	double centre[3];

	for (int i = 0; i < 3; i++)
		centre[i] =
		    view->pixel0[i] + 0.5 * (COLUMNS - 1) * view->column_step[i] + 0.5 * (ROWS - 1) * view->row_step[i];
	turn(view->column_step, axis, angle);
	turn(view->row_step, axis, angle);
	if (!detector_only) {
		turn(view->source, axis, angle);
		turn(centre, axis, angle);
	}
	for (int i = 0; i < 3; i++)
		view->pixel0[i] =
		    centre[i] - 0.5 * (COLUMNS - 1) * view->column_step[i] - 0.5 * (ROWS - 1) * view->row_step[i];
}

static void flip_rows(struct view *view)
{
	for (int i = 0; i < 3; i++) {
		view->pixel0[i] += (ROWS - 1) * view->row_step[i];
		view->row_step[i] = -view->row_step[i];
	}
}

static void flip_columns(struct view *view)
{
	for (int i = 0; i < 3; i++) {
		view->pixel0[i] += (COLUMNS - 1) * view->column_step[i];
		view->column_step[i] = -view->column_step[i];
	}
}

static void none(struct view *view, int k)
{
	(void)view;
	(void)k;
}
static void tilt_arm(struct view *view, int k)
{
	(void)k;
	turn_view(view, 0, 0.3, 0);
	turn_view(view, 1, -0.2, 0);
}
static void tilt_detector(struct view *view, int k)
{
	(void)k;
	turn_view(view, 0, 0.1, 1);
	turn_view(view, 1, 0.15, 1);
	turn_view(view, 2, -0.05, 1);
}
static void on_its_side(struct view *view, int k)
{
	double u[3], v[3];

	(void)k;
	memcpy(u, view->column_step, sizeof(u));
	memcpy(v, view->row_step, sizeof(v));
	for (int i = 0; i < 3; i++) {
		view->column_step[i] = v[i] * vec_norm(u) / vec_norm(v);
		view->row_step[i] = -u[i] * vec_norm(v) / vec_norm(u);
	}
}
static void rows_down(struct view *view, int k)
{
	(void)k;
	flip_rows(view);
}
static void columns_back(struct view *view, int k)
{
	(void)k;
	flip_columns(view);
}
static void upside_down(struct view *view, int k)
{
	(void)k;
	flip_rows(view);
	flip_columns(view);
}
/* Every view on its own, as calibrated arms are, far more than any arm sags. */
static void wander(struct view *view, int k)
{
	unsigned long long seed = 77 + (unsigned long long)k * 1000003;

	for (int i = 0; i < 3; i++) {
		view->source[i] += uniform(&seed, -20, 20);
		view->pixel0[i] += uniform(&seed, -40, 40);
		turn_view(view, i, uniform(&seed, -0.4, 0.4), 1);
		turn_view(view, i, uniform(&seed, -0.4, 0.4), 0);
	}
}
/* The source on the axis of rotation: the gantry angle means nothing there. */
static void from_below(struct view *view, int k)
{
	(void)k;
	turn_view(view, 1, M_PI / 2, 0);
}

static const struct orbit_row {
	const char *name;
	struct circular orbit;
	double first, step; /* degrees */
	void (*change)(struct view *view, int k);
} orbits[] = {
    {"plain", {620, 1100, {0.8, 0.8}, {0, 0}, {0, 0}}, 0, 14.4, none},
    {"clockwise, short, from 200 degrees", {620, 1100, {0.8, 0.5}, {0, 0}, {0, 0}}, 200, -8, none},
    {"detector and source moved", {620, 1100, {0.8, 0.5}, {-31.7, 12.3}, {2.25, -1.125}}, 33.3, 14.4, none},
    {"detector before the isocentre", {900, 450, {0.3, 0.3}, {0, 0}, {0, 0}}, 5, 7, none},
    {"arm tilted", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 14.4, tilt_arm},
    {"detector tilted", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 14.4, tilt_detector},
    {"detector on its side", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 14.4, on_its_side},
    {"rows down", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 14.4, rows_down},
    {"columns back", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 14.4, columns_back},
    {"upside down", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 14.4, upside_down},
    {"wandering", {750, 1199, {0.616, 0.616}, {0, 0}, {0, 0}}, 10, 8, wander},
    {"from below", {620, 1100, {0.8, 0.5}, {3, 4}, {1, 2}}, 0, 0, from_below},
};
enum { ORBIT_COUNT = sizeof(orbits) / sizeof(orbits[0]) };

static void make_orbit(const struct orbit_row *row, struct geometry *ret)
{
	struct error err = {0};
	struct circular orbit = row->orbit;
	double angles[VIEWS];

	/* The isocentre must lie before the source; a detector nearer than that is ours to move. */
	for (int k = 0; k < VIEWS; k++)
		angles[k] = (row->first + k * row->step) * M_PI / 180;
	if (orbit.source_to_detector < orbit.source_to_isocentre)
		orbit.source_to_detector = orbit.source_to_isocentre;
	ck_assert_msg(geometry_circular(ret, COLUMNS, ROWS, VIEWS, &orbit, angles, &err) == 0, "%s: %s", row->name,
		      err.text);
	for (int k = 0; k < VIEWS; k++) {
		double nearer = 1 - row->orbit.source_to_detector / orbit.source_to_detector;

		for (int i = 0; i < 3; i++)
			ret->views[k].pixel0[i] += nearer * ret->views[k].source[i];
		row->change(&ret->views[k], k);
	}
}

START_TEST(views_come_back_from_the_file)
{
	const struct orbit_row *row = &orbits[_i];
	struct geometry ours, back;
	struct rtk_geometry written, read;
	struct rtk_stack stack;
	struct error err = {0};
	size_t length = 0;
	char *text;

	make_orbit(row, &ours);
	ck_assert_msg(rtk_geometry_from_views(&ours, 1e-6, &written, &stack, &err) == 0, "%s: %s", row->name, err.text);
	text = rtk_geometry_print(&written, &length);
	ck_assert_ptr_nonnull(text);
	ck_assert_msg(rtk_geometry_parse(text, length, &read, &err) == 0, "%s: %s", row->name, err.text);
	for (int trust = 0; trust < RTK_TRUST_COUNT; trust++) {
		ck_assert_msg(rtk_geometry_views(&read, &stack, COLUMNS, ROWS, (enum rtk_trust)trust, &back, &err) == 0,
			      "%s: %s", row->name, err.text);
		assert_same_views(&back, &ours, EXACT);
		geometry_clear(&back);
	}
	free(text);
	rtk_geometry_clear(&written);
	rtk_geometry_clear(&read);
	geometry_clear(&ours);
}
END_TEST

START_TEST(what_is_the_same_stands_once_and_short)
{
	struct geometry ours;
	struct rtk_geometry rtk;
	struct rtk_stack stack;
	struct error err = {0};
	size_t length;
	char *text, *at;

	make_orbit(&orbits[2], &ours);
	ck_assert_int_eq(rtk_geometry_from_views(&ours, 1e-6, &rtk, &stack, &err), 0);
	text = rtk_geometry_print(&rtk, &length);
	at = strstr(text, "<SourceToIsocenterDistance>620</SourceToIsocenterDistance>");
	ck_assert_ptr_nonnull(at);
	ck_assert_ptr_null(strstr(at + 1, "<SourceToIsocenterDistance>"));
	ck_assert_ptr_nonnull(strstr(text, "<ProjectionOffsetX>-31.7</ProjectionOffsetX>"));
	ck_assert_ptr_nonnull(strstr(text, "<SourceOffsetY>-1.125</SourceOffsetY>"));
	ck_assert_ptr_nonnull(strstr(text, "<GantryAngle>47.7</GantryAngle>"));
	ck_assert_ptr_null(strstr(text, "InPlaneAngle"));
	ck_assert_ptr_null(strstr(text, "OutOfPlaneAngle"));
	free(text);
	rtk_geometry_clear(&rtk);
	geometry_clear(&ours);
}
END_TEST

START_TEST(a_stack_may_be_turned_and_moved)
{
	/* The same detector told by a stack whose rows run down and whose origin is elsewhere. */
	const struct rtk_stack turned = {{-31.5 + 10, 23.5 - 4}, {1, 0}, {0, -1}};
	struct rtk_geometry rtk;
	struct geometry plain, other;
	struct error err = {0};

	parse(file_of(example), &rtk);
	for (int trust = RTK_PARAMETERS; trust <= RTK_MATRICES; trust++) {
		ck_assert_int_eq(
		    rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, (enum rtk_trust)trust, &plain, &err), 0);
		ck_assert_int_eq(rtk_geometry_views(&rtk, &turned, COLUMNS, ROWS, (enum rtk_trust)trust, &other, &err),
				 0);
		for (int i = 0; i < 3; i++) {
			const struct view *a = &plain.views[0], *b = &other.views[0];

			ck_assert_double_eq_tol(
			    b->pixel0[i], a->pixel0[i] + 10 * a->column_step[i] + (47 - 4) * a->row_step[i], 1e-8);
			ck_assert_double_eq_tol(b->row_step[i], -a->row_step[i], 1e-10);
			ck_assert_double_eq_tol(b->source[i], a->source[i], 1e-8);
		}
		geometry_clear(&plain);
		geometry_clear(&other);
	}
	rtk_geometry_clear(&rtk);
}
END_TEST

/* ---- what is refused ---- */

START_TEST(contradictions_name_view_and_size)
{
	struct rtk_geometry rtk;
	struct geometry views;
	struct error err = {0};
	char text[2000];

	/* The second view's detector offset was changed by 2.5 mm by hand, its matrix forgotten. */
	snprintf(text, sizeof(text), "%s%s", example, example);
	memcpy(strstr(text + sizeof(example), "-117.056503295898"), "-119.556503295898", 17);
	parse(file_of(text), &rtk);
	ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_BOTH, &views, &err), ERR_CONFLICT);
	ck_assert_msg(strstr(err.text, "view 1: ") != NULL && strstr(err.text, "2.5 pixels, 2.5 mm") != NULL &&
			  strstr(err.text, "0 other") != NULL,
		      "%s", err.text);
	ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_PARAMETERS, &views, &err), 0);
	geometry_clear(&views);
	ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_MATRICES, &views, &err), 0);
	geometry_clear(&views);
	rtk_geometry_clear(&rtk);
}
END_TEST

static const struct refusal {
	const char *text; /* of a whole file, or what stands in one when it begins with a space */
	const char *said;
} refusals[] = {
    {"", "no XML"},
    {"<RTKThreeDCircularGeometry version=\"3\">", "no XML"},
    {"<Other version=\"3\"/>", "<Other>"},
    {"<RTKThreeDCircularGeometry version=\"1\"/>", "version 1"},
    {"<RTKThreeDCircularGeometry/>", "version none"},
    {" ", "no <Projection>"},
    {" <GantryAngel>3</GantryAngel>", "<GantryAngel> is not known"},
    {" <Projection><Projection/></Projection>", "<Projection> is not known in a projection"},
    {" <Projection><GantryAngle><b>3</b></GantryAngle></Projection>", "too deep"},
    {" <Projection><GantryAngle>nan</GantryAngle></Projection>", "\"nan\" is no number"},
    {" <Projection><GantryAngle>3 4</GantryAngle></Projection>", "2 numbers, 1 is expected"},
    {" <Projection><GantryAngle></GantryAngle></Projection>", "0 numbers"},
    {" <Projection><GantryAngle>3mm</GantryAngle></Projection>", "\"3mm\""},
    {" <Projection><SourceOffsetX>1e30</SourceOffsetX></Projection>", "1e30"},
    {" <Projection><Matrix>1 2 3</Matrix></Projection>", "3 numbers, 12 are expected"},
    {" <RadiusCylindricalDetector>1536</RadiusCylindricalDetector><Projection/>", "RadiusCylindricalDetector is 1536"},
    {"<!DOCTYPE RTKGEOMETRY [<!ENTITY a \"1\"><!ENTITY b \"&a;&a;&a;\">]>"
     "<RTKThreeDCircularGeometry version=\"3\"/>",
     "entity a"},
};
enum { REFUSAL_COUNT = sizeof(refusals) / sizeof(refusals[0]) };

START_TEST(broken_files_are_refused_with_a_reason)
{
	const struct refusal *row = &refusals[_i];
	const char *text = row->text[0] == ' ' ? file_of(row->text) : row->text;
	struct rtk_geometry rtk = {.count = -1};
	struct error err = {0};
	int code = rtk_geometry_parse(text, strlen(text), &rtk, &err);

	ck_assert_msg(code < 0 && code == err.code, "%s", text);
	ck_assert_msg(strstr(err.text, row->said) != NULL, "\"%s\" in: %s", row->said, err.text);
	ck_assert_int_eq(rtk.count, -1);
}
END_TEST

START_TEST(impossible_geometries_are_refused)
{
	const struct rtk_stack flat = {{0, 0}, {1, 0}, {2, 0}};
	struct rtk_geometry rtk;
	struct geometry views;
	struct error err = {0};

	parse(file_of("<Projection><SourceToIsocenterDistance>600</SourceToIsocenterDistance></Projection>"), &rtk);
	ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_BOTH, &views, &err), ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(strstr(err.text, "parallel"));
	ck_assert_int_eq(rtk_geometry_views(&rtk, &unit_stack, COLUMNS, ROWS, RTK_MATRICES, &views, &err), ERR_INVALID);
	ck_assert_ptr_nonnull(strstr(err.text, "no <Matrix>"));
	rtk_geometry_clear(&rtk);
	parse(file_of(example), &rtk);
	ck_assert_int_lt(rtk_geometry_views(&rtk, &flat, COLUMNS, ROWS, RTK_BOTH, &views, &err), 0);
	rtk_geometry_clear(&rtk);
}
END_TEST

START_TEST(detectors_beyond_the_parameters_are_refused)
{
	struct geometry ours;
	struct rtk_geometry rtk;
	struct rtk_stack stack;
	struct error err = {0};
	struct view good;

	make_orbit(&orbits[0], &ours);
	good = ours.views[3];
	for (int i = 0; i < 3; i++)
		ours.views[3].row_step[i] += 0.001 * good.column_step[i];
	ck_assert_int_eq(rtk_geometry_from_views(&ours, 1e-6, &rtk, &stack, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "view 3: its pixels are skewed by 0.048") != NULL, "%s", err.text);
	ck_assert_int_eq(rtk_geometry_from_views(&ours, 0.1, &rtk, &stack, &err), 0);
	rtk_geometry_clear(&rtk);
	ours.views[3] = good;
	for (int i = 0; i < 3; i++)
		ours.views[3].row_step[i] *= 1.01;
	ck_assert_int_eq(rtk_geometry_from_views(&ours, 1e-6, &rtk, &stack, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "pitch of 0.808 mm along the rows, view 0 has 0.8") != NULL, "%s", err.text);
	ours.views[3] = good;
	flip_rows(&ours.views[3]);
	ck_assert_int_eq(rtk_geometry_from_views(&ours, 1e-6, &rtk, &stack, &err), ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(err.text, "view 3 is mirrored") != NULL, "%s", err.text);
	geometry_clear(&ours);
}
END_TEST

Suite *rtk_geometry_suite(void);

Suite *rtk_geometry_suite(void)
{
	Suite *suite = suite_create("rtk_geometry");
	TCase *tests = tcase_create("files");

	tcase_add_test(tests, the_documented_matrix_and_parameters_agree);
	tcase_add_test(tests, a_plain_circle_is_ours);
	tcase_add_test(tests, angles_turn_as_documented);
	tcase_add_test(tests, values_hold_until_they_change);
	tcase_add_loop_test(tests, views_come_back_from_the_file, 0, ORBIT_COUNT);
	tcase_add_test(tests, what_is_the_same_stands_once_and_short);
	tcase_add_test(tests, a_stack_may_be_turned_and_moved);
	tcase_add_test(tests, contradictions_name_view_and_size);
	tcase_add_loop_test(tests, broken_files_are_refused_with_a_reason, 0, REFUSAL_COUNT);
	tcase_add_test(tests, impossible_geometries_are_refused);
	tcase_add_test(tests, detectors_beyond_the_parameters_are_refused);
	suite_add_tcase(suite, tests);
	return suite;
}

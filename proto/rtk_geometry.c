/*
 * RTK's geometry files. With the rotations about the axes
 *
 *   M_R = Rz(-in plane) Rx(-out of plane) Ry(-gantry)
 *
 * the rows of M_R are the detector's axes rx, ry and its normal rz in RTK's world.
 * The source stands at (source offset x, y, source to isocentre) along them, the
 * detector's point (u, v) at (u + projection offset x, v + projection offset y,
 * source to isocentre - source to detector), so that
 *
 *   P = [-d 0 s_x-p_x; 0 -d s_y-p_y; 0 0 1] (M_R (x, y, z) - source),  d = source to detector,
 *
 * has w negative in front of the source (RTK's documentation, "3D Projection
 * Geometry", final matrix).
 */
#include "proto/rtk_geometry.h"

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include <expat.h>

#include "proto/json.h"

const char *const rtk_trust_names[RTK_TRUST_COUNT] = {"both", "parameters", "matrices"};

static const double degree = M_PI / 180;
static const double number_most = 1e7; /* mm or degrees */

static const char root_name[] = "RTKThreeDCircularGeometry";

/* The parameters of a projection, in the order in which they are written. */
static const struct parameter {
	const char *name;
	size_t offset;
	double equal; /* two values are one number, written more neatly, within this: mm or degrees */
} parameters[] = {
    {"GantryAngle", offsetof(struct rtk_projection, gantry_angle), 1e-12},
    {"SourceToIsocenterDistance", offsetof(struct rtk_projection, source_to_isocentre), 1e-11},
    {"SourceToDetectorDistance", offsetof(struct rtk_projection, source_to_detector), 1e-11},
    {"SourceOffsetX", offsetof(struct rtk_projection, source_offset[0]), 1e-11},
    {"SourceOffsetY", offsetof(struct rtk_projection, source_offset[1]), 1e-11},
    {"ProjectionOffsetX", offsetof(struct rtk_projection, projection_offset[0]), 1e-11},
    {"ProjectionOffsetY", offsetof(struct rtk_projection, projection_offset[1]), 1e-11},
    {"InPlaneAngle", offsetof(struct rtk_projection, in_plane_angle), 1e-12},
    {"OutOfPlaneAngle", offsetof(struct rtk_projection, out_of_plane_angle), 1e-12},
    /* An older name, read and never written. */
    {"Angle", offsetof(struct rtk_projection, gantry_angle), 0},
};
enum { PARAMETER_COUNT = sizeof(parameters) / sizeof(parameters[0]), PARAMETERS_WRITTEN = PARAMETER_COUNT - 1 };

static const char *const collimations[] = {"CollimationUInf", "CollimationUSup", "CollimationVInf", "CollimationVSup"};

static double *parameter_of(struct rtk_projection *projection, int i)
{
	return (double *)((char *)projection + parameters[i].offset);
}

void rtk_geometry_clear(struct rtk_geometry *geometry)
{
	free(geometry->projections);
	memset(geometry, 0, sizeof(*geometry));
}

/* ---- reading ---- */

enum { TEXT_MAX = 2000 }; /* of an element: 12 numbers with as many blanks */

struct reader {
	XML_Parser parser;
	struct rtk_geometry geometry;
	int room;
	struct rtk_projection now; /* what holds at this place of the file */
	int depth;
	bool in_projection, in_leaf; /* a leaf has text and no elements */
	char text[TEXT_MAX];
	int length;
	int code; /* first failure */
	struct error *err;
};

__attribute__((format(printf, 3, 4))) static void fail(struct reader *reader, int code, const char *format, ...)
{
	char text[240];
	va_list args;

	if (reader->code != 0)
		return;
	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	reader->code =
	    error_set(reader->err, code, "line %lu: %s", (unsigned long)XML_GetCurrentLineNumber(reader->parser), text);
	XML_StopParser(reader->parser, XML_FALSE);
}

static bool name_is(const char *name, const char *known)
{
	return strcasecmp(name, known) == 0; /* as RTK compares them */
}

static int parameter_find(const char *name)
{
	for (int i = 0; i < PARAMETER_COUNT; i++)
		if (name_is(name, parameters[i].name))
			return i;
	return -1;
}

static bool is_collimation(const char *name)
{
	for (size_t i = 0; i < sizeof(collimations) / sizeof(collimations[0]); i++)
		if (name_is(name, collimations[i]))
			return true;
	return false;
}

static void check_version(struct reader *reader, const char **attributes)
{
	const char *version = "none";

	for (; attributes[0] != NULL; attributes += 2)
		if (name_is(attributes[0], "version"))
			version = attributes[1];
	if (strcmp(version, "3") != 0 && strcmp(version, "2") != 0)
		fail(reader, ERR_INVALID, "version %.20s of RTK's geometry, 3 or 2 is expected", version);
}

static void XMLCALL start_element(void *context, const char *name, const char **attributes)
{
	struct reader *reader = context;
	bool known = parameter_find(name) >= 0 || is_collimation(name);

	reader->depth++;
	reader->in_leaf = false;
	reader->length = 0;
	if (reader->depth == 1) {
		if (!name_is(name, root_name))
			fail(reader, ERR_INVALID, "<%.60s>, <%s> is expected", name, root_name);
		else
			check_version(reader, attributes);
	} else if (reader->depth == 2 && name_is(name, "Projection")) {
		reader->in_projection = true;
		reader->now.has_matrix = false;
	} else if (reader->depth == (reader->in_projection ? 3 : 2)) {
		known = known || name_is(name, reader->in_projection ? "Matrix" : "RadiusCylindricalDetector");
		if (!known)
			fail(reader, ERR_INVALID, "<%.60s> is not known %s", name,
			     reader->in_projection ? "in a projection" : "here");
		reader->in_leaf = true;
	} else {
		fail(reader, ERR_INVALID, "<%.60s> stands too deep", name);
	}
}

static void XMLCALL add_text(void *context, const char *text, int length)
{
	struct reader *reader = context;

	if (!reader->in_leaf || reader->code != 0)
		return;
	if (length >= TEXT_MAX - reader->length) {
		fail(reader, ERR_INVALID, "an element of more than %d characters", TEXT_MAX - 1);
		return;
	}
	memcpy(reader->text + reader->length, text, (size_t)length);
	reader->length += length;
}

/* `count` finite numbers and nothing else in the element's text. */
static bool read_numbers(struct reader *reader, const char *name, int count, double most, double *ret)
{
	const char *at = reader->text;
	double numbers[12];
	int found = 0;

	reader->text[reader->length] = '\0';
	for (;;) {
		char *end;
		double number;

		at += strspn(at, " \t\r\n");
		if (*at == '\0')
			break;
		number = strtod(at, &end);
		if (end == at || (*end != '\0' && strchr(" \t\r\n", *end) == NULL) || !isfinite(number) ||
		    fabs(number) > most) {
			fail(reader, ERR_INVALID, "<%s>: \"%.*s\" is no number within +-%g", name,
			     (int)(strcspn(at, " \t\r\n") < 40 ? strcspn(at, " \t\r\n") : 40), at, most);
			return false;
		}
		if (found < count)
			numbers[found] = number;
		found++;
		at = end;
	}
	if (found != count) {
		fail(reader, ERR_INVALID, "<%s> has %d numbers, %d %s expected", name, found, count,
		     count == 1 ? "is" : "are");
		return false;
	}
	memcpy(ret, numbers, (size_t)count * sizeof(*ret));
	return true;
}

static void add_projection(struct reader *reader)
{
	struct rtk_geometry *geometry = &reader->geometry;

	if (geometry->count == VIEWS_MAX) {
		fail(reader, ERR_IMPOSSIBLE, "more than %d projections", VIEWS_MAX);
		return;
	}
	if (geometry->count == reader->room) {
		int room = reader->room > 0 ? 2 * reader->room : 256;
		void *grown = realloc(geometry->projections, (size_t)room * sizeof(*geometry->projections));

		if (grown == NULL) {
			fail(reader, ERR_NO_MEMORY, "no memory for %d projections", room);
			return;
		}
		geometry->projections = grown;
		reader->room = room;
	}
	geometry->projections[geometry->count++] = reader->now;
}

static void XMLCALL end_element(void *context, const char *name)
{
	struct reader *reader = context;
	int parameter = parameter_find(name);
	double ignored;

	if (reader->code != 0)
		return;
	if (reader->depth == 2 && name_is(name, "Projection")) {
		add_projection(reader);
		reader->in_projection = false;
	} else if (parameter >= 0) {
		read_numbers(reader, parameters[parameter].name, 1, number_most, parameter_of(&reader->now, parameter));
	} else if (name_is(name, "Matrix")) {
		reader->now.has_matrix = read_numbers(reader, "Matrix", 12, 1e100, reader->now.matrix);
	} else if (name_is(name, "RadiusCylindricalDetector")) {
		if (read_numbers(reader, "RadiusCylindricalDetector", 1, 1e100, &ignored) && ignored != 0)
			fail(reader, ERR_IMPOSSIBLE,
			     "RadiusCylindricalDetector is %g: curved detectors are not reconstructed, only flat ones "
			     "(0) are",
			     ignored);
	} else if (is_collimation(name)) {
		/* RTK writes the largest double where there is none. */
		if (read_numbers(reader, name, 1, INFINITY, &ignored) && ignored < 1e300)
			reader->geometry.collimated = true;
	}
	reader->in_leaf = false;
	reader->depth--;
}

/* An entity may stand for a thousand others; RTK's files have none. */
static void XMLCALL refuse_entity(void *context, const XML_Char *name, int is_parameter, const XML_Char *value,
				  int value_length, const XML_Char *base, const XML_Char *system_id,
				  const XML_Char *public_id, const XML_Char *notation)
{
	(void)is_parameter;
	(void)value;
	(void)value_length;
	(void)base;
	(void)system_id;
	(void)public_id;
	(void)notation;
	fail(context, ERR_INVALID, "the entity %.60s: a geometry declares none", name);
}

int rtk_geometry_parse(const char *text, size_t length, struct rtk_geometry *ret_geometry, struct error *err)
{
	struct reader reader = {.err = err};

	if (length > RTK_BYTES_MAX)
		return error_set(err, ERR_TOO_LARGE, "a geometry of %zu bytes, at most %d are read", length,
				 RTK_BYTES_MAX);
	reader.parser = XML_ParserCreate(NULL);
	if (reader.parser == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for an XML parser");
	XML_SetUserData(reader.parser, &reader);
	XML_SetElementHandler(reader.parser, start_element, end_element);
	XML_SetCharacterDataHandler(reader.parser, add_text);
	XML_SetEntityDeclHandler(reader.parser, refuse_entity);
	if (XML_Parse(reader.parser, text, (int)length, 1) != XML_STATUS_OK && reader.code == 0)
		fail(&reader, ERR_INVALID, "no XML: %s", XML_ErrorString(XML_GetErrorCode(reader.parser)));
	if (reader.code == 0 && reader.geometry.count == 0)
		fail(&reader, ERR_INVALID, "no <Projection> in the geometry");
	XML_ParserFree(reader.parser);
	if (reader.code != 0)
		rtk_geometry_clear(&reader.geometry);
	else
		*ret_geometry = reader.geometry;
	return reader.code;
}

/* ---- parameters to views ---- */

/* The rows of M_R: the detector's axes and its normal towards the source, in RTK's world. */
static void rotation(const struct rtk_projection *p, double ret[3][3])
{
	double cg = cos(p->gantry_angle * degree), sg = sin(p->gantry_angle * degree);
	double co = cos(p->out_of_plane_angle * degree), so = sin(p->out_of_plane_angle * degree);
	double ci = cos(p->in_plane_angle * degree), si = sin(p->in_plane_angle * degree);
	const double x[3] = {cg, 0, -sg}, y[3] = {so * sg, co, so * cg};

	for (int i = 0; i < 3; i++) {
		ret[0][i] = ci * x[i] + si * y[i];
		ret[1][i] = -si * x[i] + ci * y[i];
	}
	ret[2][0] = co * sg;
	ret[2][1] = -so;
	ret[2][2] = co * cg;
}

/* A vector along the detector's axes, in our world: (x, y, z) of ours = (z, x, y) of RTK's. */
static void to_world(double axes[3][3], double along_x, double along_y, double along_z, double ret[3])
{
	for (int i = 0; i < 3; i++) {
		int rtk = (i + 2) % 3;

		ret[i] = along_x * axes[0][rtk] + along_y * axes[1][rtk] + along_z * axes[2][rtk];
	}
}

static void parameters_view(const struct rtk_projection *p, const struct rtk_stack *stack, struct view *ret)
{
	double axes[3][3];

	rotation(p, axes);
	to_world(axes, p->source_offset[0], p->source_offset[1], p->source_to_isocentre, ret->source);
	to_world(axes, stack->origin[0] + p->projection_offset[0], stack->origin[1] + p->projection_offset[1],
		 p->source_to_isocentre - p->source_to_detector, ret->pixel0);
	to_world(axes, stack->column_step[0], stack->column_step[1], 0, ret->column_step);
	to_world(axes, stack->row_step[0], stack->row_step[1], 0, ret->row_step);
}

static void parameters_matrix(const struct rtk_projection *p, double ret[12])
{
	const double source[3] = {p->source_offset[0], p->source_offset[1], p->source_to_isocentre};
	double axes[3][3], d = p->source_to_detector;
	double shift[2] = {p->source_offset[0] - p->projection_offset[0],
			   p->source_offset[1] - p->projection_offset[1]};

	rotation(p, axes);
	for (int column = 0; column < 4; column++) {
		double along[3]; /* column of [M_R | -source] */

		for (int i = 0; i < 3; i++)
			along[i] = column < 3 ? axes[i][column] : -source[i];
		for (int i = 0; i < 2; i++)
			ret[4 * i + column] = -d * along[i] + shift[i] * along[2];
		ret[8 + column] = along[2];
	}
}

/*
 * How far a matrix puts some points from where the parameters put them, mm on the
 * detector: the isocentre and points along the axes at a quarter of the way to the
 * source, as wide as an object is. A matrix that takes one of them to infinity
 * gives infinity.
 */
static double disagreement(const struct rtk_projection *p)
{
	double matrix[12], worst = 0;

	parameters_matrix(p, matrix);
	for (int i = 0; i < 7; i++) {
		double point[3] = {0, 0, 0}, u[2], v[2], distance;

		if (i < 6)
			point[i / 2] = (i % 2 ? -0.25 : 0.25) * p->source_to_isocentre;
		view_project(matrix, point, &u[0], &v[0]);
		view_project(p->matrix, point, &u[1], &v[1]);
		distance = hypot(u[1] - u[0], v[1] - v[0]);
		worst = isnan(distance) ? INFINITY : fmax(worst, distance);
	}
	return worst;
}

static double pitch_of(const double step[2])
{
	return hypot(step[0], step[1]);
}

static int check_agreement(const struct rtk_geometry *from, const struct rtk_stack *stack, struct error *err)
{
	double pitch = fmin(pitch_of(stack->column_step), pitch_of(stack->row_step)), worst = 0;
	int at = -1, others = -1;

	for (int k = 0; k < from->count; k++) {
		double pixels;

		if (!from->projections[k].has_matrix)
			continue;
		pixels = disagreement(&from->projections[k]) / pitch;
		if (pixels > RTK_AGREEMENT)
			others++;
		if (pixels > worst) {
			worst = pixels;
			at = k;
		}
	}
	if (worst <= RTK_AGREEMENT)
		return 0;
	return error_set(err, ERR_CONFLICT,
			 "view %d: the matrix contradicts the parameters by %.4g pixels, %.4g mm on the detector "
			 "(%d other views do, too)",
			 at, worst, worst * pitch, others);
}

static int check_parameters(const struct rtk_geometry *from, struct error *err)
{
	for (int k = 0; k < from->count; k++) {
		const struct rtk_projection *p = &from->projections[k];

		if (p->source_to_detector == 0)
			return error_set(err, ERR_IMPOSSIBLE,
					 "view %d: SourceToDetectorDistance is missing or 0, parallel rays: only a "
					 "cone beam is reconstructed",
					 k);
		if (!(p->source_to_detector > 0) || !(p->source_to_isocentre > 0))
			return error_set(err, ERR_IMPOSSIBLE,
					 "view %d: SourceToIsocenterDistance is %.10g and SourceToDetectorDistance "
					 "%.10g, both must be positive",
					 k, p->source_to_isocentre, p->source_to_detector);
	}
	return 0;
}

static int views_of_parameters(const struct rtk_geometry *from, const struct rtk_stack *stack, int columns, int rows,
			       struct geometry *ret_geometry, struct error *err)
{
	struct view *views = calloc((unsigned)from->count, sizeof(*views));
	int code;

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", from->count);
	for (int k = 0; k < from->count; k++)
		parameters_view(&from->projections[k], stack, &views[k]);
	code = geometry_views(ret_geometry, columns, rows, from->count, views, err);
	free(views);
	return code;
}

/* To pixels in place of mm, from our world in place of RTK's. */
static void matrix_to_ours(const double from[12], const struct rtk_stack *stack, double ret[12])
{
	const double *u = stack->column_step, *v = stack->row_step, *o = stack->origin;
	double det = u[0] * v[1] - u[1] * v[0];

	for (int i = 0; i < 4; i++) {
		int rtk = i < 3 ? (i + 2) % 3 : 3;
		double x = from[rtk] - o[0] * from[8 + rtk], y = from[4 + rtk] - o[1] * from[8 + rtk];

		ret[i] = (v[1] * x - v[0] * y) / det;
		ret[4 + i] = (u[0] * y - u[1] * x) / det;
		ret[8 + i] = from[8 + rtk];
	}
}

static int views_of_matrices(const struct rtk_geometry *from, const struct rtk_stack *stack, int columns, int rows,
			     struct geometry *ret_geometry, struct error *err)
{
	const double pitch[2] = {pitch_of(stack->column_step), pitch_of(stack->row_step)};
	double *matrices = calloc((size_t)from->count, 12 * sizeof(*matrices));
	int code = 0;

	if (matrices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d matrices", from->count);
	for (int k = 0; k < from->count && code == 0; k++) {
		if (!from->projections[k].has_matrix)
			code = error_set(err, ERR_INVALID, "view %d has no <Matrix>", k);
		else
			matrix_to_ours(from->projections[k].matrix, stack, matrices + 12 * (size_t)k);
	}
	if (code == 0)
		code = geometry_matrices(ret_geometry, columns, rows, from->count, matrices, pitch, err);
	free(matrices);
	return code;
}

static int check_stack(const struct rtk_stack *stack, struct error *err)
{
	const double *u = stack->column_step, *v = stack->row_step;
	double area = fabs(u[0] * v[1] - u[1] * v[0]);

	if (!(area > 1e-6 * pitch_of(u) * pitch_of(v)) || !isfinite(area) || !isfinite(stack->origin[0]) ||
	    !isfinite(stack->origin[1]))
		return error_set(err, ERR_INVALID, "the stack's pixels have no area: steps (%g, %g) and (%g, %g) mm",
				 u[0], u[1], v[0], v[1]);
	return 0;
}

int rtk_geometry_views(const struct rtk_geometry *from, const struct rtk_stack *stack, int columns, int rows,
		       enum rtk_trust trust, struct geometry *ret_geometry, struct error *err)
{
	int code = check_stack(stack, err);

	if (code == 0 && trust == RTK_MATRICES)
		return views_of_matrices(from, stack, columns, rows, ret_geometry, err);
	if (code == 0)
		code = check_parameters(from, err);
	if (code == 0 && trust == RTK_BOTH)
		code = check_agreement(from, stack, err);
	if (code == 0)
		code = views_of_parameters(from, stack, columns, rows, ret_geometry, err);
	return code;
}

/* ---- views to parameters ---- */

/*
 * The detector's axes in RTK's world: rx along the columns' direction, ry along the
 * rows', rz across both towards the source. *ret_sign is -1 where the rows run
 * against ry. What columns and rows lack of a right angle, each gives half.
 */
static void view_axes(const struct view *view, double ret_axes[3][3], double *ret_sign)
{
	double u[3], v[3], to_source[3], skew;
	double length_u = vec_norm(view->column_step), length_v = vec_norm(view->row_step);

	for (int i = 0; i < 3; i++) {
		int ours = (i + 1) % 3;

		u[i] = view->column_step[ours] / length_u;
		v[i] = view->row_step[ours] / length_v;
		to_source[i] = view->source[ours] - view->pixel0[ours];
	}
	skew = vec_dot(u, v);
	for (int i = 0; i < 3; i++) {
		ret_axes[0][i] = u[i] - 0.5 * skew * v[i];
		ret_axes[1][i] = v[i] - 0.5 * skew * u[i];
	}
	length_u = vec_norm(ret_axes[0]);
	length_v = vec_norm(ret_axes[1]);
	for (int i = 0; i < 3; i++) {
		ret_axes[0][i] /= length_u;
		ret_axes[1][i] /= length_v;
	}
	vec_cross(ret_axes[0], ret_axes[1], ret_axes[2]);
	*ret_sign = 1;
	if (vec_dot(ret_axes[2], to_source) < 0) {
		*ret_sign = -1;
		for (int i = 0; i < 3; i++) {
			ret_axes[1][i] = -ret_axes[1][i];
			ret_axes[2][i] = -ret_axes[2][i];
		}
	}
}

/* rz = (cos o sin g, -sin o, cos o cos g); rx turned back by g and o is (cos i, sin i). */
static void axes_angles(double axes[3][3], struct rtk_projection *ret)
{
	const double *x = axes[0], *z = axes[2];
	double in_plane_x, in_plane_y, g = atan2(z[0], z[2]), o = atan2(-z[1], hypot(z[0], z[2]));

	in_plane_x = cos(g) * x[0] - sin(g) * x[2];
	in_plane_y = sin(o) * sin(g) * x[0] + cos(o) * x[1] + sin(o) * cos(g) * x[2];
	ret->gantry_angle = g / degree + (g < 0 ? 360 : 0);
	ret->out_of_plane_angle = o / degree;
	ret->in_plane_angle = atan2(in_plane_y, in_plane_x) / degree;
}

/* The stack's origin is its centre, and so is what is held fast of a detector that is not quite rectangular. */
static void view_parameters(const struct view *view, const struct geometry *geometry, struct rtk_projection *ret)
{
	double axes[3][3], sign, source[3] = {0, 0, 0}, centre[3] = {0, 0, 0};

	view_axes(view, axes, &sign);
	axes_angles(axes, ret);
	for (int i = 0; i < 3; i++) {
		int ours = (i + 1) % 3;
		double at = view->pixel0[ours] + 0.5 * (geometry->columns - 1) * view->column_step[ours] +
			    0.5 * (geometry->rows - 1) * view->row_step[ours];

		for (int axis = 0; axis < 3; axis++) {
			source[axis] += axes[axis][i] * view->source[ours];
			centre[axis] += axes[axis][i] * at;
		}
	}
	for (int i = 0; i < 2; i++) {
		ret->source_offset[i] = source[i];
		ret->projection_offset[i] = centre[i];
	}
	ret->source_to_isocentre = source[2];
	ret->source_to_detector = source[2] - centre[2];
}

/* Checks what RTK has one number for in a whole stack: pitch, square corners, handedness. */
static int check_pixels(const struct geometry *from, int k, const struct rtk_stack *stack, double tolerance,
			struct error *err)
{
	const struct view *view = &from->views[k];
	double pitch[2] = {vec_norm(view->column_step), vec_norm(view->row_step)};
	double expected[2] = {pitch_of(stack->column_step), pitch_of(stack->row_step)};
	double axes[3][3], sign, skew;

	skew = vec_dot(view->column_step, view->row_step) / (pitch[0] * pitch[0]) * from->rows;
	if (fabs(skew) > tolerance)
		return error_set(err, ERR_IMPOSSIBLE,
				 "view %d: its pixels are skewed by %.4g columns over the detector's rows, which RTK's "
				 "parameters cannot express (%.4g pixels are tolerated)",
				 k, skew, tolerance);
	for (int i = 0; i < 2; i++)
		if (fabs(pitch[i] / expected[i] - 1) * (i == 0 ? from->columns : from->rows) > tolerance)
			return error_set(err, ERR_IMPOSSIBLE,
					 "view %d: a pixel pitch of %.10g mm along the %s, view 0 has %.10g: RTK's "
					 "stacks have one pitch for all views",
					 k, pitch[i], i == 0 ? "columns" : "rows", expected[i]);
	view_axes(view, axes, &sign);
	if (sign * stack->row_step[1] < 0)
		return error_set(err, ERR_IMPOSSIBLE,
				 "view %d is mirrored against view 0, RTK's stacks have one "
				 "handedness for all views",
				 k);
	return 0;
}

/* Rounding leaves 619.9999999999999 where 620 is meant: the number with few digits, if it is as near as that. */
static double neat(double value, double equal)
{
	double rounded = rint(value * 1e9) / 1e9;

	return fabs(rounded - value) <= equal ? rounded + 0.0 : value;
}

int rtk_geometry_from_views(const struct geometry *from, double tolerance, struct rtk_geometry *ret_geometry,
			    struct rtk_stack *ret_stack, struct error *err)
{
	struct rtk_geometry geometry = {.count = from->count};
	const struct view *first = &from->views[0];
	struct rtk_stack stack = {
	    {0, 0}, {neat(vec_norm(first->column_step), 1e-13), 0}, {0, neat(vec_norm(first->row_step), 1e-13)}};
	double axes[3][3], sign;
	int code = 0;

	view_axes(first, axes, &sign);
	stack.row_step[1] *= sign;
	stack.origin[0] = -0.5 * (from->columns - 1) * stack.column_step[0];
	stack.origin[1] = -0.5 * (from->rows - 1) * stack.row_step[1];
	geometry.projections = calloc((size_t)from->count, sizeof(*geometry.projections));
	if (geometry.projections == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d projections", from->count);
	for (int k = 0; k < from->count && code == 0; k++) {
		struct rtk_projection *p = &geometry.projections[k];

		code = check_pixels(from, k, &stack, tolerance, err);
		if (code != 0)
			break;
		view_parameters(&from->views[k], from, p);
		for (int i = 0; i < PARAMETERS_WRITTEN; i++)
			*parameter_of(p, i) = neat(*parameter_of(p, i), parameters[i].equal);
		parameters_matrix(p, p->matrix);
		p->has_matrix = true;
	}
	if (code != 0) {
		rtk_geometry_clear(&geometry);
		return code;
	}
	*ret_geometry = geometry;
	*ret_stack = stack;
	return 0;
}

/* ---- writing ---- */

static void write_parameter(FILE *to, const char *indent, const char *name, double value)
{
	char number[NUMBER_TEXT_MAX];

	number_print(value, number);
	fprintf(to, "%s<%s>%s</%s>\n", indent, name, number, name);
}

static void write_projection(FILE *to, struct rtk_projection *p, const bool common[PARAMETERS_WRITTEN])
{
	fputs("  <Projection>\n", to);
	for (int i = 0; i < PARAMETERS_WRITTEN; i++)
		if (!common[i])
			write_parameter(to, "    ", parameters[i].name, *parameter_of(p, i));
	if (p->has_matrix) {
		fputs("    <Matrix>\n", to);
		for (int row = 0; row < 3; row++) {
			for (int column = 0; column < 4; column++) {
				char number[NUMBER_TEXT_MAX];

				number_print(p->matrix[4 * row + column], number);
				fprintf(to, "%s%s", column == 0 ? "      " : " ", number);
			}
			fputc('\n', to);
		}
		fputs("    </Matrix>\n", to);
	}
	fputs("  </Projection>\n", to);
}

char *rtk_geometry_print(const struct rtk_geometry *geometry, size_t *ret_length)
{
	bool common[PARAMETERS_WRITTEN];
	char *text = NULL;
	size_t length = 0;
	FILE *to = open_memstream(&text, &length);

	if (to == NULL)
		return NULL;
	fprintf(to, "<?xml version=\"1.0\"?>\n<!DOCTYPE RTKGEOMETRY>\n<%s version=\"3\">\n", root_name);
	for (int i = 0; i < PARAMETERS_WRITTEN; i++) {
		double first = *parameter_of(&geometry->projections[0], i);

		/* RTK's readers look for the angle in each projection, as its writer puts it there. */
		common[i] = i > 0;
		for (int k = 1; k < geometry->count && common[i]; k++)
			common[i] = *parameter_of(&geometry->projections[k], i) == first;
		if (common[i] && first != 0)
			write_parameter(to, "  ", parameters[i].name, first);
	}
	for (int k = 0; k < geometry->count; k++)
		write_projection(to, &geometry->projections[k], common);
	fprintf(to, "</%s>\n", root_name);
	if (fclose(to) != 0) {
		free(text);
		return NULL;
	}
	*ret_length = length;
	return text;
}

/*
 * Geometries of other tools in the words of a scan's document. Files of RTK and
 * DICOM become views (source and detector as vectors), 3x4 matrices stay what they
 * are, and angles become a circular orbit.
 */
#include "clients/cbct/import_geometry.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/numbers.h"
#include "clients/cbct/view_json.h"
#include "proto/scan_directory.h"

static const double degree = M_PI / 180;

#define ROW(name, kind, member, argument, help, least, most, count, names)                                             \
	{                                                                                                              \
		name, 0, kind, offsetof(struct import_geometry, member), argument, help, least, most, count, names     \
	}
const struct option import_geometry_rows[] = {
    ROW("rtk", OPTION_TEXT, rtk, "FILE.xml",
	"RTK's geometry; its world turns about y, ours about z: (z, x, y) of RTK's", 0, 0, 0, NULL),
    ROW("trust", OPTION_CHOICE, trust, "WHICH",
	"what counts in RTK's file; both: a matrix that contradicts its parameters is an error", 0, 0, RTK_TRUST_COUNT,
	rtk_trust_names),
    ROW("matrices", OPTION_TEXT, matrices, "FILE",
	"3x4 matrices from (x, y, z, 1) in mm to w (column, row, 1) in pixels: text, 12 numbers a line or 3 lines of "
	"4, "
	"or .npy",
	0, 0, 0, NULL),
    ROW("first-pixel", OPTION_NUMBER, first_pixel, "N",
	"what the matrices call the centre of the first column and row: 0, 0.5 or 1", -10, 10, 0, NULL),
    ROW("astra", OPTION_TEXT, astra, "FILE",
	"ASTRA's cone_vec in mm: 12 numbers for each image, source, detector's centre, u and v; text or .npy", 0, 0, 0,
	NULL),
    ROW("angles", OPTION_TEXT, angles, "FILE", "gantry angles in degrees, one for each image: text or .npy", 0, 0, 0,
	NULL),
    ROW("first-angle", OPTION_NUMBER, first_angle, "DEG", "of the first image, where there is no list", -36000, 36000,
	0, NULL),
    ROW("angle-step", OPTION_NUMBER, angle_step, "DEG", "from image to image, where there is no list", -360, 360, 0,
	NULL),
    ROW("clockwise", OPTION_FLAG, clockwise, NULL, "angles grow clockwise as seen from +z", 0, 0, 0, NULL),
    ROW("radians", OPTION_FLAG, radians, NULL, "the list of angles is in radians", 0, 0, 0, NULL),
    ROW("pixel", OPTION_EACH, pixel, "MM[,MM]", "pixel pitch along columns and rows, in place of the images' own", 1e-6,
	1e6, 2, NULL),
    ROW("source-to-isocentre", OPTION_NUMBER, source_to_isocentre, "MM",
	"distance, for angles; in place of a DICOM file's own", 1e-6, 1e6, 0, NULL),
    ROW("source-to-detector", OPTION_NUMBER, source_to_detector, "MM",
	"distance, for angles; in place of a DICOM file's own", 1e-6, 1e6, 0, NULL),
    ROW("detector-offset", OPTION_NUMBERS, detector_offset, "U,V", "moves the detector along its columns and rows, mm",
	0, 0, 2, NULL),
    ROW("patient", OPTION_TEXT, patient, "POSITION",
	"how the patient lies: HFS, HFP, FFS, FFP, HFDL, HFDR, FFDL, FFDR or unknown, in place of a DICOM file's own "
	"Patient Position",
	0, 0, 0, NULL),
    ROW("source-offset", OPTION_NUMBERS, source_offset, "U,V", "moves the source, mm; for angles", 0, 0, 2, NULL),
    {0},
};

static int count_differs(const char *what, size_t count, const struct images *images, struct error *err)
{
	return error_set(err, ERR_INVALID, "%zu %s for %d images", count, what, images->count);
}

static int need_pixel(const double pixel[2], struct error *err)
{
	if (pixel[0] > 0 && pixel[1] > 0)
		return 0;
	return error_set(err, ERR_USAGE, "the images do not tell their pixel pitch: --pixel is needed");
}

static cJSON *views_json(const struct geometry *geometry)
{
	cJSON *json = cJSON_CreateObject(), *list;

	cJSON_AddStringToObject(json, "kind", "views");
	list = cJSON_AddArrayToObject(json, "views");
	for (int k = 0; k < geometry->count; k++)
		cJSON_AddItemToArray(list, view_json(&geometry->views[k]));
	return json;
}

/* ---- RTK ---- */

/* Images that are no stack of RTK's: centred, as RTK's own tools put them. */
static struct rtk_stack centred_stack(const struct images *images, const double pixel[2])
{
	return (struct rtk_stack){
	    .origin = {-0.5 * (images->columns - 1) * pixel[0], -0.5 * (images->rows - 1) * pixel[1]},
	    .column_step = {pixel[0], 0},
	    .row_step = {0, pixel[1]},
	};
}

static int from_rtk(const struct import_geometry *options, const struct images *images, const double pixel[2],
		    cJSON **ret_geometry, struct error *err)
{
	struct rtk_stack stack = images->has_stack ? images->stack : centred_stack(images, pixel);
	struct rtk_geometry rtk;
	struct geometry geometry;
	char *text = NULL;
	size_t length = 0;
	int code = file_read(options->rtk, RTK_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = rtk_geometry_parse(text, length, &rtk, err);
	free(text);
	if (code != 0)
		return code;
	if (rtk.count != images->count)
		code = count_differs("projections in the geometry", (size_t)rtk.count, images, err);
	if (code == 0)
		code = rtk_geometry_views(&rtk, &stack, images->columns, images->rows, (enum rtk_trust)options->trust,
					  &geometry, err);
	if (code == ERR_CONFLICT) {
		char why[200];

		snprintf(why, sizeof(why), "%.199s", err->text);
		error_set(err, code, "%s; --trust parameters or --trust matrices says which counts", why);
	}
	if (code == 0) {
		if (rtk.collimated)
			fprintf(stderr, "note: the geometry has collimations; pixels behind them are not masked\n");
		*ret_geometry = views_json(&geometry);
		geometry_clear(&geometry);
	}
	rtk_geometry_clear(&rtk);
	return code;
}

/* ---- matrices ---- */

static int from_matrices(const struct import_geometry *options, const struct images *images, cJSON **ret_geometry,
			 struct error *err)
{
	double *matrices = NULL;
	int count = 0, code = matrices_read(options->matrices, &matrices, &count, err);
	cJSON *json, *list;

	if (code == 0 && count != images->count)
		code = count_differs("matrices", (size_t)count, images, err);
	if (code != 0) {
		free(matrices);
		return code;
	}
	json = cJSON_CreateObject();
	cJSON_AddStringToObject(json, "kind", "matrices");
	list = cJSON_AddArrayToObject(json, "matrices");
	for (int k = 0; k < count; k++) {
		double *m = matrices + 12 * (size_t)k;

		for (int i = 0; i < 8; i++)
			m[i] -= options->first_pixel * m[8 + i % 4];
		cJSON_AddItemToArray(list, cJSON_CreateDoubleArray(m, 12));
	}
	free(matrices);
	*ret_geometry = json;
	return 0;
}

/* ---- ASTRA ---- */

/* The vectors tell the pixels' pitch as well, where nobody else does. */
static int from_astra(const struct import_geometry *options, const struct images *images, double pixel[2],
		      cJSON **ret_geometry, struct error *err)
{
	double *vectors = NULL;
	int count = 0, code = matrices_read(options->astra, &vectors, &count, err);
	struct view *views;
	struct geometry geometry;

	if (code == 0 && count != images->count)
		code = count_differs("vectors", (size_t)count, images, err);
	if (code != 0) {
		free(vectors);
		return code;
	}
	views = calloc((size_t)images->count, sizeof(*views));
	for (int k = 0; k < images->count && views != NULL; k++) {
		const double *v = vectors + 12 * (size_t)k;

		for (int i = 0; i < 3; i++) {
			views[k].source[i] = v[i];
			views[k].column_step[i] = v[6 + i];
			views[k].row_step[i] = v[9 + i];
			views[k].pixel0[i] =
			    v[3 + i] - 0.5 * (images->columns - 1) * v[6 + i] - 0.5 * (images->rows - 1) * v[9 + i];
		}
	}
	code = views != NULL ? geometry_views(&geometry, images->columns, images->rows, images->count, views, err)
			     : error_set(err, ERR_NO_MEMORY, "no memory for %d views", images->count);
	if (code == 0 && isnan(pixel[0])) {
		pixel[0] = vec_norm(views[0].column_step);
		pixel[1] = vec_norm(views[0].row_step);
	}
	free(views);
	free(vectors);
	if (code == 0) {
		*ret_geometry = views_json(&geometry);
		geometry_clear(&geometry);
	}
	return code;
}

/* ---- angles ---- */

static int list_angles(const struct import_geometry *options, const struct images *images, double *ret_degrees,
		       struct error *err)
{
	double *numbers = NULL, sign = options->clockwise ? -1 : 1;
	size_t count = 0;
	int code = 0;

	const bool told = options->angles == NULL && isnan(options->angle_step) && images->circle.degrees != NULL;

	if (options->angles != NULL)
		code = numbers_read(options->angles, &numbers, &count, err);
	else if (isnan(options->angle_step) && images->count > 1 && !told)
		code = error_set(
		    err, ERR_USAGE,
		    "nothing tells the geometry: --rtk, --matrices, --astra, --angles or --angle-step is needed");
	if (code == 0 && options->angles != NULL && count != (size_t)images->count)
		code = count_differs("angles", count, images, err);
	for (int k = 0; k < images->count && code == 0; k++) {
		double angle = options->first_angle + (k > 0 ? k * options->angle_step : 0);

		if (told)
			angle = options->first_angle + images->circle.degrees[k];
		if (numbers != NULL)
			angle = numbers[k] / (options->radians ? degree : 1);
		ret_degrees[k] = sign * angle;
	}
	free(numbers);
	return code;
}

/* RTK's stacks say where the detector is, others begin at 0: with angles nothing but the command line counts. */
static void note_centre(const struct images *images)
{
	const struct rtk_stack *stack = &images->stack;
	double centre[2], pixels = 0;

	for (int i = 0; i < 2; i++) {
		centre[i] = stack->origin[i] + 0.5 * (images->columns - 1) * stack->column_step[i] +
			    0.5 * (images->rows - 1) * stack->row_step[i];
		pixels = fmax(pixels, fabs(centre[i]) / images->pixel[i]);
	}
	if (pixels > RTK_AGREEMENT && (stack->origin[0] != 0 || stack->origin[1] != 0))
		fprintf(stderr,
			"note: the stack's Offset would put the detector's centre to (%.6g, %.6g) mm; with angles only "
			"--detector-offset moves it\n",
			centre[0], centre[1]);
}

static int from_angles(const struct import_geometry *options, const struct images *images, cJSON **ret_geometry,
		       struct error *err)
{
	const struct image_circle *told = &images->circle;
	const double to_isocentre =
	    isnan(options->source_to_isocentre) ? told->source_to_isocentre : options->source_to_isocentre;
	const double to_detector =
	    isnan(options->source_to_detector) ? told->source_to_detector : options->source_to_detector;
	const double offset[2] = {told->detector_offset[0] + options->detector_offset[0],
				  told->detector_offset[1] + options->detector_offset[1]};
	double *degrees;
	cJSON *json;
	int code;

	if (images->has_stack)
		note_centre(images);
	if (isnan(to_isocentre) || isnan(to_detector))
		return error_set(err, ERR_USAGE, "angles need --source-to-isocentre and --source-to-detector");
	degrees = malloc((size_t)images->count * sizeof(*degrees));
	if (degrees == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d angles", images->count);
	code = list_angles(options, images, degrees, err);
	if (code == 0) {
		json = cJSON_CreateObject();
		cJSON_AddStringToObject(json, "kind", "circular");
		cJSON_AddNumberToObject(json, "source_to_isocentre_mm", to_isocentre);
		cJSON_AddNumberToObject(json, "source_to_detector_mm", to_detector);
		cJSON_AddItemToObject(json, "angles_deg", cJSON_CreateDoubleArray(degrees, images->count));
		cJSON_AddItemToObject(json, "detector_offset_mm", cJSON_CreateDoubleArray(offset, 2));
		cJSON_AddItemToObject(json, "source_offset_mm", cJSON_CreateDoubleArray(options->source_offset, 2));
		*ret_geometry = json;
	}
	free(degrees);
	return code;
}

/* ---- DICOM ---- */

/*
 * DICOM's angles are the patient's: x left, y back, z head. At primary angle a
 * (towards LAO) and secondary angle b (towards CRA) the detector stands from the
 * isocentre along (sin a cos b, -cos a cos b, sin b), the source across from it. Images are
 * shown as one faces the patient: at a = b = 0 columns run to the patient's left
 * and rows to the feet.
 */
static void position_view(const struct image_position *position, const struct import_geometry *options,
			  const struct images *images, const double pixel[2], struct view *ret)
{
	double a = position->primary * degree, b = position->secondary * degree;
	const double out[3] = {sin(a) * cos(b), -cos(a) * cos(b), sin(b)};
	const double u[3] = {cos(a), sin(a), 0};
	const double v[3] = {sin(b) * sin(a), -sin(b) * cos(a), -cos(b)};

	for (int i = 0; i < 3; i++) {
		ret->source[i] = -position->source_to_isocentre * out[i] + options->source_offset[0] * u[i] +
				 options->source_offset[1] * v[i];
		ret->column_step[i] = pixel[0] * u[i];
		ret->row_step[i] = pixel[1] * v[i];
		ret->pixel0[i] = (position->source_to_detector - position->source_to_isocentre) * out[i] +
				 options->detector_offset[0] * u[i] + options->detector_offset[1] * v[i] -
				 0.5 * (images->columns - 1) * ret->column_step[i] -
				 0.5 * (images->rows - 1) * ret->row_step[i];
	}
}

/* From the patient's axes to the world's, which is fixed to the table: back along the patient's position. */
static void to_world(const struct patient *patient, double vector[3])
{
	double world[3];

	for (int i = 0; i < 3; i++)
		world[i] = patient->rotation[0][i] * vector[0] + patient->rotation[1][i] * vector[1] +
			   patient->rotation[2][i] * vector[2];
	memcpy(vector, world, sizeof(world));
}

static void view_to_world(const struct patient *patient, struct view *view)
{
	to_world(patient, view->source);
	to_world(patient, view->pixel0);
	to_world(patient, view->column_step);
	to_world(patient, view->row_step);
}

/* Whether a direction of the patient's has its greater part away from one of its sides. */
static bool runs_away(const double direction[3], char side)
{
	static const char towards[3] = {'L', 'P', 'H'}, away[3] = {'R', 'A', 'F'};

	for (int i = 0; i < 3; i++) {
		double part = direction[i] / vec_norm(direction);

		if ((side == towards[i] && part < -0.5) || (side == away[i] && part > 0.5))
			return true;
	}
	return false;
}

/*
 * Patient Orientation says where the columns and rows of the first image run to. An image that was mirrored when it
 * was stored would give the wrong side; against the angles it makes the sides unknown.
 */
static bool is_mirrored(const struct image_position *position, const struct images *images, const struct view *view)
{
	double columns[3], rows[3];

	for (int i = 0; i < 3; i++) {
		columns[i] = images->flip_columns ? -view->column_step[i] : view->column_step[i];
		rows[i] = images->flip_rows ? -view->row_step[i] : view->row_step[i];
	}
	return runs_away(columns, position->towards[0]) || runs_away(rows, position->towards[1]);
}

/* Without a word of the files on how the patient lies nobody told the C-arm what its angles are about. */
static struct patient patient_of(const struct images *images, const struct view *first)
{
	const struct image_position *positions = images->positions;

	for (int k = 0; k < images->count; k++)
		if (positions[k].patient < 0 || positions[k].patient != positions[0].patient) {
			fprintf(stderr,
				"note: the images do not say how the patient lies, so that left and right are not "
				"known; --patient tells it\n");
			return patient_unknown;
		}
	if (is_mirrored(&positions[0], images, first)) {
		fprintf(
		    stderr,
		    "note: Patient Orientation %c\\%c contradicts the angles: the images may be mirrored, and left and "
		    "right are taken as not known; --flip-columns and --flip-rows mirror them, --patient tells how the "
		    "patient lies\n",
		    positions[0].towards[0], positions[0].towards[1]);
		return patient_unknown;
	}
	return patient_in((enum patient_position)positions[0].patient);
}

static int from_positions(const struct import_geometry *options, const struct images *images, const double pixel[2],
			  cJSON **ret_geometry, struct patient *patient, struct error *err)
{
	struct geometry geometry;
	struct view *views = calloc((size_t)images->count, sizeof(*views));
	int code = views != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for %d views", images->count);

	for (int k = 0; k < images->count && code == 0; k++) {
		struct image_position position = images->positions[k];

		if (!isnan(options->source_to_isocentre))
			position.source_to_isocentre = options->source_to_isocentre;
		if (!isnan(options->source_to_detector))
			position.source_to_detector = options->source_to_detector;
		if (isnan(position.primary))
			code = error_set(err, ERR_INVALID,
					 "frame %d has no Positioner Primary Angle: --angles or "
					 "--angle-step tells it",
					 k);
		else if (isnan(position.source_to_isocentre) || isnan(position.source_to_detector))
			code = error_set(err, ERR_USAGE,
					 "frame %d does not tell the distances from its source: --source-to-isocentre "
					 "and --source-to-detector do",
					 k);
		else
			position_view(&position, options, images, pixel, &views[k]);
	}
	if (code == 0 && options->patient == NULL)
		*patient = patient_of(images, &views[0]);
	for (int k = 0; k < images->count && code == 0; k++)
		view_to_world(patient, &views[k]);
	if (code == 0)
		code = geometry_views(&geometry, images->columns, images->rows, images->count, views, err);
	free(views);
	if (code == 0) {
		*ret_geometry = views_json(&geometry);
		geometry_clear(&geometry);
	}
	return code;
}

/* ---- which of them ---- */

static int read_patient(const char *text, struct patient *ret, struct error *err)
{
	*ret = patient_unknown;
	if (text == NULL || strcmp(text, "unknown") == 0)
		return 0;
	for (int i = 0; i < PATIENT_POSITION_COUNT; i++)
		if (strcmp(text, patient_position_names[i]) == 0) {
			*ret = patient_in((enum patient_position)i);
			return 0;
		}
	return error_set(err, ERR_USAGE,
			 "--patient: '%.40s' is none of HFS, HFP, FFS, FFP, HFDL, HFDR, FFDL, FFDR and unknown", text);
}

static int check_options(const struct import_geometry *options, const struct images *images, struct error *err)
{
	bool offsets = options->detector_offset[0] != 0 || options->detector_offset[1] != 0 ||
		       options->source_offset[0] != 0 || options->source_offset[1] != 0;
	bool angles = options->angles != NULL || !isnan(options->angle_step);
	int given = (options->rtk != NULL) + (options->matrices != NULL) + (options->astra != NULL) + angles;

	if (given > 1 || (options->angles != NULL && !isnan(options->angle_step)))
		return error_set(err, ERR_USAGE,
				 "one of --rtk, --matrices, --astra, --angles and --angle-step at a time");
	if (options->radians && options->angles == NULL)
		return error_set(err, ERR_USAGE, "--radians goes with --angles");
	if (options->clockwise && !angles && images->circle.degrees == NULL)
		return error_set(err, ERR_USAGE, "--clockwise goes with --angles or --angle-step");
	if (options->first_pixel != 0 && options->matrices == NULL)
		return error_set(err, ERR_USAGE, "--first-pixel goes with --matrices");
	if ((options->rtk != NULL || options->matrices != NULL || options->astra != NULL) && offsets)
		return error_set(err, ERR_USAGE, "--detector-offset and --source-offset go with angles");
	return 0;
}

static cJSON *detector_json(const struct images *images, const double pixel[2])
{
	cJSON *json = cJSON_CreateObject();

	cJSON_AddNumberToObject(json, "columns", images->columns);
	cJSON_AddNumberToObject(json, "rows", images->rows);
	cJSON_AddItemToObject(json, "pixel_mm", cJSON_CreateDoubleArray(pixel, 2));
	return json;
}

int import_geometry(const struct import_geometry *options, const struct images *images, cJSON **ret_detector,
		    cJSON **ret_geometry, struct patient *ret_patient, struct error *err)
{
	bool given = !isnan(options->pixel[0]);
	double pixel[2];
	int code = check_options(options, images, err);

	if (code == 0)
		code = read_patient(options->patient, ret_patient, err);
	memcpy(pixel, given ? options->pixel : images->pixel, sizeof(pixel));
	if (code == 0 && given && options->rtk != NULL && images->has_stack)
		code = error_set(err, ERR_USAGE, "the stack tells its pixels to RTK's geometry, --pixel does not");
	if (code == 0 && options->astra == NULL)
		code = need_pixel(pixel, err);
	if (code != 0)
		return code;
	if (options->rtk != NULL)
		code = from_rtk(options, images, pixel, ret_geometry, err);
	else if (options->matrices != NULL)
		code = from_matrices(options, images, ret_geometry, err);
	else if (options->astra != NULL)
		code = from_astra(options, images, pixel, ret_geometry, err);
	else if (images->positions != NULL && options->angles == NULL && isnan(options->angle_step))
		code = from_positions(options, images, pixel, ret_geometry, ret_patient, err);
	else
		code = from_angles(options, images, ret_geometry, err);
	if (code == 0)
		*ret_detector = detector_json(images, pixel);
	return code;
}

/* How the patient lies: the eight positions, matrices, letters, files, and what is refused. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/scan/geometry.h"
#include "proto/format.h"
#include "proto/nifti.h"
#include "tests/unit/documents.h"
#include "tests/unit/volume_file.h"

static int read_text(const char *text, struct patient *ret, struct error *err)
{
	cJSON *json = NULL;
	int code;

	ck_assert_msg(json_parse(text, strlen(text), &json, err) == 0, "%s", text);
	code = patient_read(json, "/patient", ret, err);
	cJSON_Delete(json);
	return code;
}

/*
 * By hand, for a patient on a table seen from its end where z points to: x to the right, y to the floor. The
 * sides that x, y and z point to.
 */
static const struct {
	const char *position, *x, *y, *z;
} lying[] = {
    {"HFS", "L", "P", "S"},  {"HFP", "R", "A", "S"},  {"FFS", "R", "P", "I"},  {"FFP", "L", "A", "I"},
    {"HFDL", "A", "L", "S"}, {"HFDR", "P", "R", "S"}, {"FFDL", "P", "L", "I"}, {"FFDR", "A", "R", "I"},
};

START_TEST(each_position_has_its_sides)
{
	ck_assert_int_eq(sizeof(lying) / sizeof(lying[0]), PATIENT_POSITION_COUNT);
	for (int i = 0; i < PATIENT_POSITION_COUNT; i++) {
		const char *name = lying[i].position;
		char text[64], letters[3][PATIENT_LETTERS_MAX], head[PATIENT_LETTERS_MAX], below;
		struct patient patient;
		struct error err = {0};

		snprintf(text, sizeof(text), "{\"position\": \"%s\"}", name);
		ck_assert_msg(read_text(text, &patient, &err) == 0, "%s", err.text);
		ck_assert(patient.known);
		for (int axis = 0; axis < 3; axis++)
			patient_letters(&patient, axis, false, letters[axis]);
		ck_assert_msg(strcmp(letters[0], lying[i].x) == 0 && strcmp(letters[1], lying[i].y) == 0 &&
				  strcmp(letters[2], lying[i].z) == 0,
			      "%s: %s %s %s", name, letters[0], letters[1], letters[2]);
		/* What lies below is what the position's last letters say, and the head where its first says. */
		below = name[2] == 'S' ? 'P' : name[2] == 'P' ? 'A' : name[3];
		ck_assert_int_eq(letters[1][0], below);
		patient_letters(&patient, 2, name[0] == 'F', head);
		ck_assert_str_eq(head, "S");
	}
}
END_TEST

/* left x back = head, and nothing is stretched. */
START_TEST(no_position_is_a_mirror)
{
	for (int i = 0; i < PATIENT_POSITION_COUNT; i++) {
		const struct patient patient = patient_in((enum patient_position)i);
		const double world[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
		double to[3][3], cross[3];

		for (int j = 0; j < 3; j++)
			patient_direction(&patient, world[j], to[j]);
		vec_cross(to[0], to[1], cross);
		for (int j = 0; j < 3; j++)
			ck_assert_double_eq(cross[j], to[2][j]);
	}
}
END_TEST

START_TEST(unknown_is_told_by_neutral_letters)
{
	struct patient patient;
	struct error err = {0};
	char letters[PATIENT_LETTERS_MAX];
	cJSON *json;

	ck_assert_int_eq(patient_read(NULL, "/patient", &patient, &err), 0);
	ck_assert(!patient.known);
	ck_assert_int_eq(read_text("null", &patient, &err), 0);
	ck_assert(!patient.known);
	ck_assert(patient_same(&patient, &patient_unknown));
	patient_letters(&patient, 0, false, letters);
	ck_assert_str_eq(letters, "+x");
	patient_letters(&patient, 2, true, letters);
	ck_assert_str_eq(letters, "-z");
	json = patient_axes_json(&patient);
	ck_assert(cJSON_IsNull(json));
	cJSON_Delete(json);
	json = patient_json(&patient);
	ck_assert(cJSON_IsNull(json));
	cJSON_Delete(json);
}
END_TEST

START_TEST(a_matrix_of_few_digits_becomes_the_nearest_rotation)
{
	/* 30 degrees about z, three digits. */
	const char *text = "{\"world_to_patient\": [0.866, -0.5, 0, 10, 0.5, 0.866, 0, -20, 0, 0, 1, 30, 0, 0, 0, 1]}";
	const double point[3] = {1, 2, 3};
	struct patient patient, back;
	struct error err = {0};
	double to[3];
	char letters[PATIENT_LETTERS_MAX];
	cJSON *json;

	ck_assert_msg(read_text(text, &patient, &err) == 0, "%s", err.text);
	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			ck_assert_double_eq_tol(vec_dot(patient.rotation[i], patient.rotation[j]), i == j, 1e-14);
	ck_assert_double_eq_tol(patient.rotation[0][0], cos(M_PI / 6), 1e-4);
	patient_point(&patient, point, to);
	ck_assert_double_eq_tol(to[0], cos(M_PI / 6) - 2 * 0.5 + 10, 1e-3);
	ck_assert_double_eq_tol(to[1], 0.5 + 2 * cos(M_PI / 6) - 20, 1e-3);
	ck_assert_double_eq_tol(to[2], 33, 1e-12);
	patient_letters(&patient, 0, false, letters);
	ck_assert_str_eq(letters, "LP");
	patient_letters(&patient, 0, true, letters);
	ck_assert_str_eq(letters, "RA");
	patient_letters(&patient, 1, false, letters);
	ck_assert_str_eq(letters, "PR");
	/* There and back: the same. */
	json = patient_json(&patient);
	ck_assert_int_eq(patient_read(json, "", &back, &err), 0);
	ck_assert(patient_same(&patient, &back));
	cJSON_Delete(json);
}
END_TEST

static const struct {
	const char *text;
	int code;
	const char *pointer, *says;
} refused[] = {
    {"{}", ERR_INVALID, "/patient/position", "missing"},
    {"[]", ERR_INVALID, "/patient", "object"},
    {"{\"position\": \"HF\"}", ERR_INVALID, "/patient/position", "HFDL"},
    {"{\"position\": \"hfs\"}", ERR_INVALID, "/patient/position", "HFS"},
    {"{\"position\": 3}", ERR_INVALID, "/patient/position", "number"},
    {"{\"side\": \"left\"}", ERR_INVALID, "/patient/side", "position"},
    {"{\"position\": \"HFS\", \"world_to_patient\": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}", ERR_INVALID,
     "/patient/world_to_patient", "in place of"},
    {"{\"world_to_patient\": [1,0,0, 0,1,0, 0,0,1]}", ERR_INVALID, "/patient/world_to_patient", "16"},
    {"{\"world_to_patient\": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,\"1\"]}", ERR_INVALID, "/patient/world_to_patient/15",
     "string"},
    {"{\"world_to_patient\": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,1,1]}", ERR_IMPOSSIBLE, "/patient/world_to_patient",
     "last row is 0, 0, 1, 1"},
    {"{\"world_to_patient\": [-1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}", ERR_IMPOSSIBLE, "/patient/world_to_patient",
     "mirror"},
    {"{\"world_to_patient\": [2,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}", ERR_IMPOSSIBLE, "/patient/world_to_patient",
     "off by 3"},
    {"{\"world_to_patient\": [1,0.01,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}", ERR_IMPOSSIBLE, "/patient/world_to_patient",
     "rigid"},
    {"{\"world_to_patient\": [0,0,0,0, 0,0,0,0, 0,0,0,0, 0,0,0,1]}", ERR_IMPOSSIBLE, "/patient/world_to_patient",
     "rigid"},
    {"{\"world_to_patient\": [1,0,0,1e9, 0,1,0,0, 0,0,1,0, 0,0,0,1]}", ERR_IMPOSSIBLE, "/patient/world_to_patient/3",
     "1000000000"},
};

START_TEST(what_is_no_position_is_refused_by_its_pointer)
{
	for (size_t i = 0; i < sizeof(refused) / sizeof(refused[0]); i++) {
		struct patient patient = {.position = 77};
		struct error err = {0};
		int code = read_text(refused[i].text, &patient, &err);

		expect_refused(refused[i].text, code, &err, refused[i].code, refused[i].pointer, refused[i].says);
		ck_assert_int_eq(patient.position, 77);
	}
}
END_TEST

/* ---- files ---- */

static const struct grid grid = {{3, 4, 5}, {0.5, 0.75, 1.25}, {-10, 20.5, 0.125}};
enum { VOXELS = 3 * 4 * 5 };

static void write_volume(const struct volume_format *format, const struct patient *patient, bool sform)
{
	const struct provenance provenance = {.patient = *patient};
	uint8_t h[FORMAT_HEADER_MAX];
	size_t length;
	float voxels[VOXELS];
	struct error err = {0};

	for (int i = 0; i < VOXELS; i++)
		voxels[i] = (float)i;
	ck_assert_int_eq(format->header(&grid, VOLUME_FLOAT32, &provenance, h, &length, &err), 0);
	if (!sform)
		memset(h + NIFTI_SFORM_CODE, 0, 2);
	volume_file_write(h, length, voxels, sizeof(voxels));
}

/* Each voxel of the world stands in the patient's volume where the patient's position says. */
static void assert_placed(const struct patient *patient, const char *what)
{
	struct grid found = {.size = {0}};
	struct error err = {0};
	float *voxels = NULL;

	ck_assert_msg(volume_read(volume_file, &found, NULL, &voxels, &err) == 0, "%s: %s", what, err.text);
	for (int i = 0; i < VOXELS; i++) {
		const int at[3] = {i % 3, i / 3 % 4, i / 12};
		double world[3], point[3];
		size_t place = 0;

		for (int j = 0; j < 3; j++)
			world[j] = grid.origin[j] + at[j] * grid.spacing[j];
		patient_point(patient, world, point);
		for (int j = 2; j >= 0; j--) {
			double index = (point[j] - found.origin[j]) / found.spacing[j];

			ck_assert_msg(fabs(index - rint(index)) < 1e-4 && index > -0.5 && index < found.size[j] - 0.5,
				      "%s: voxel %g along %d", what, index, j);
			place = place * (size_t)found.size[j] + (size_t)lrint(index);
		}
		ck_assert_msg(voxels[place] == (float)i, "%s: voxel %d", what, i);
	}
	free(voxels);
}

START_TEST(every_format_puts_the_voxels_where_they_belong)
{
	for (int i = -1; i < PATIENT_POSITION_COUNT; i++) {
		struct patient patient = i < 0 ? patient_unknown : patient_in((enum patient_position)i);

		patient.offset[0] = i == 3 ? 5 : 0;
		for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
			if (strcmp(format->name, "raw") == 0)
				continue;
			write_volume(format, &patient, true);
			assert_placed(&patient, format->name);
		}
		/* And by NIfTI's quaternion alone. */
		write_volume(volume_formats, &patient, false);
		assert_placed(&patient, "qform");
	}
}
END_TEST

/* A turn about an axis of no symmetry, past half a turn and not: every branch of the quaternion. */
START_TEST(oblique_volumes_come_back_along_their_own_axes)
{
	for (int k = 0; k < 16; k++) {
		const double axis[3] = {1 / sqrt(14), k % 4 < 2 ? 2 / sqrt(14) : -2 / sqrt(14), 3 / sqrt(14)};
		const double angle = k * 0.4 + 0.05, c = cos(angle), s = sin(angle);
		const double cross[3][3] = {{0, -axis[2], axis[1]}, {axis[2], 0, -axis[0]}, {-axis[1], axis[0], 0}};
		struct patient patient = {.known = true, .position = -1, .offset = {7, -8, 9}};
		double of_matrix[3][3], of_quaternion[3][3];
		struct grid found[2] = {{.size = {0}}, {.size = {0}}};
		struct error err = {0};
		float *voxels;

		for (int i = 0; i < 3; i++)
			for (int j = 0; j < 3; j++)
				patient.rotation[i][j] =
				    (i == j ? c : 0) + s * cross[i][j] + (1 - c) * axis[i] * axis[j];
		write_volume(volume_formats, &patient, true);
		ck_assert_int_eq(volume_read(volume_file, &found[0], NULL, &voxels, &err), ERR_INVALID);
		ck_assert_msg(volume_read(volume_file, &found[0], of_matrix, &voxels, &err) == 0, "%s", err.text);
		free(voxels);
		write_volume(volume_formats, &patient, false);
		ck_assert_int_eq(volume_read(volume_file, &found[1], of_quaternion, &voxels, &err), 0);
		free(voxels);
		for (int i = 0; i < 3; i++) {
			ck_assert_int_eq(found[0].size[i], found[1].size[i]);
			ck_assert_double_eq_tol(found[0].origin[i], found[1].origin[i], 1e-3);
			for (int j = 0; j < 3; j++)
				ck_assert_double_eq_tol(of_matrix[i][j], of_quaternion[i][j], 1e-4);
			ck_assert_double_gt(of_matrix[i][i], 0);
		}
	}
}
END_TEST

/* A kept volume's header tells the patient, and one that is damaged is no volume of an unknown patient. */
START_TEST(a_damaged_header_does_not_make_sides_unknown)
{
	const struct patient patient = patient_in(PATIENT_FFDL);
	struct provenance provenance;
	struct error err = {0};
	size_t start = 0;
	FILE *file;

	write_volume(volume_formats, &patient, true);
	file = fopen(volume_file, "r+b");
	ck_assert_ptr_nonnull(file);
	ck_assert_int_eq(volume_own_head(fileno(file), volume_file, &grid, &start, &provenance, &err), 0);
	ck_assert_uint_eq(start, NIFTI_VOXELS);
	ck_assert(patient_same(&provenance.patient, &patient));
	provenance_clear(&provenance);
	for (int at = NIFTI_EXTENSION_TEXT; at < NIFTI_EXTENSION_TEXT + 90; at++) {
		char before, after = '\x01';

		ck_assert_int_eq(pread(fileno(file), &before, 1, at), 1);
		ck_assert_int_eq(pwrite(fileno(file), &after, 1, at), 1);
		ck_assert_int_eq(volume_own_head(fileno(file), volume_file, &grid, &start, &provenance, &err),
				 ERR_INVALID);
		ck_assert_int_eq(pwrite(fileno(file), &before, 1, at), 1);
	}
	ck_assert_int_eq(ftruncate(fileno(file), NIFTI_VOXELS + VOXELS * 4 - 1), 0);
	ck_assert_int_eq(volume_own_head(fileno(file), volume_file, &grid, &start, &provenance, &err), ERR_INVALID);
	fclose(file);
}
END_TEST

Suite *patient_suite(void)
{
	Suite *suite = suite_create("patient");
	TCase *lies = tcase_create("lies"), *files = tcase_create("files");

	tcase_add_test(lies, each_position_has_its_sides);
	tcase_add_test(lies, no_position_is_a_mirror);
	tcase_add_test(lies, unknown_is_told_by_neutral_letters);
	tcase_add_test(lies, a_matrix_of_few_digits_becomes_the_nearest_rotation);
	tcase_add_test(lies, what_is_no_position_is_refused_by_its_pointer);
	suite_add_tcase(suite, lies);
	tcase_add_checked_fixture(files, volume_file_make, volume_file_remove);
	tcase_add_test(files, every_format_puts_the_voxels_where_they_belong);
	tcase_add_test(files, oblique_volumes_come_back_along_their_own_axes);
	tcase_add_test(files, a_damaged_header_does_not_make_sides_unknown);
	suite_add_tcase(suite, files);
	return suite;
}

/* How the patient lies: see patient.h. */
#include "proto/patient.h"

#include <math.h>
#include <string.h>

#include "core/scan/geometry.h"

const char *const patient_position_names[PATIENT_POSITION_COUNT + 1] = {"HFS",  "HFP",  "FFS",  "FFP", "HFDL",
									"HFDR", "FFDL", "FFDR", NULL};

/*
 * The rows are the patient's left, back and head in the world, whose +y is down
 * and whose +z is the end of the table that comes first. The first two letters
 * give the head: +z or -z. What lies below gives one more axis: the back (S), the
 * front (P), the left (DL) or the right (DR) is +y. The third follows from
 * left x back = head.
 */
static const double rotations[PATIENT_POSITION_COUNT][3][3] = {
    [PATIENT_HFS] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}},   [PATIENT_HFP] = {{-1, 0, 0}, {0, -1, 0}, {0, 0, 1}},
    [PATIENT_FFS] = {{-1, 0, 0}, {0, 1, 0}, {0, 0, -1}}, [PATIENT_FFP] = {{1, 0, 0}, {0, -1, 0}, {0, 0, -1}},
    [PATIENT_HFDL] = {{0, 1, 0}, {-1, 0, 0}, {0, 0, 1}}, [PATIENT_HFDR] = {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}},
    [PATIENT_FFDL] = {{0, 1, 0}, {1, 0, 0}, {0, 0, -1}}, [PATIENT_FFDR] = {{0, -1, 0}, {-1, 0, 0}, {0, 0, -1}},
};

const struct patient patient_unknown = {.position = -1, .rotation = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};

struct patient patient_in(enum patient_position position)
{
	struct patient patient = {.known = true, .position = (int)position};

	memcpy(patient.rotation, rotations[position], sizeof(patient.rotation));
	return patient;
}

/* ---- reading ---- */

/* How far rows are from a unit length and a right angle with each other. */
static double skew_of(double m[3][3])
{
	double worst = 0;

	for (int i = 0; i < 3; i++)
		for (int j = 0; j <= i; j++)
			worst = fmax(worst, fabs(vec_dot(m[i], m[j]) - (i == j)));
	return worst;
}

static double determinant(double m[3][3])
{
	double normal[3];

	vec_cross(m[0], m[1], normal);
	return vec_dot(normal, m[2]);
}

/* Newton's iteration for the orthogonal factor of the polar decomposition (Higham 1986): R <- (R + R^-T) / 2. */
static void make_orthogonal(double m[3][3])
{
	enum { TURNS = 8 }; /* each squares the error; the first is below 1e-3 */
	const double enough = 1e-14;

	for (int turn = 0; turn < TURNS && skew_of(m) > enough; turn++) {
		double cofactor[3][3], det = determinant(m);

		for (int i = 0; i < 3; i++)
			vec_cross(m[(i + 1) % 3], m[(i + 2) % 3], cofactor[i]);
		for (int i = 0; i < 3; i++)
			for (int j = 0; j < 3; j++)
				m[i][j] = (m[i][j] + cofactor[i][j] / det) / 2;
	}
}

static void read_matrix(struct json_reader *reader, struct patient *patient)
{
	const char *const name = "world_to_patient";
	const double most = 1e6;     /* mm */
	const double printed = 1e-3; /* matrices with three digits behind the point are read */
	double numbers[16], skew;

	json_numbers(reader, name, true, 16, -most, most, numbers);
	if (reader->code != 0)
		return;
	for (int i = 0; i < 4; i++)
		if (numbers[12 + i] != (i == 3))
			json_fail(reader, ERR_IMPOSSIBLE, name,
				  "the last row is %.10g, %.10g, %.10g, %.10g; 0, 0, 0, 1 is expected", numbers[12],
				  numbers[13], numbers[14], numbers[15]);
	for (int i = 0; i < 3; i++) {
		memcpy(patient->rotation[i], numbers + (size_t)4 * (size_t)i, sizeof(patient->rotation[i]));
		patient->offset[i] = numbers[4 * i + 3];
	}
	skew = skew_of(patient->rotation);
	if (!(skew <= printed))
		json_fail(
		    reader, ERR_IMPOSSIBLE, name,
		    "no rigid transform: lengths and angles of its rotation are off by %.3g, at most %g is expected",
		    skew, printed);
	else if (determinant(patient->rotation) < 0)
		json_fail(reader, ERR_IMPOSSIBLE, name,
			  "a mirror (determinant -1) would exchange left and right; a rotation is expected");
	patient->known = true;
	patient->position = -1;
	if (reader->code == 0)
		make_orthogonal(patient->rotation);
}

void patient_members(struct json_reader *reader, bool required, struct patient *ret_patient)
{
	struct patient patient = patient_unknown;
	int position = -1;
	bool has_position = json_has(reader, "position"), has_matrix = json_has(reader, "world_to_patient");

	if (has_position && has_matrix)
		json_fail(reader, ERR_INVALID, "world_to_patient", "stands in place of position");
	if (has_matrix)
		read_matrix(reader, &patient);
	else
		json_choice(reader, "position", required, patient_position_names, PATIENT_POSITION_COUNT, &position);
	if (reader->code == 0 && (has_matrix || position >= 0))
		*ret_patient = has_matrix ? patient : patient_in((enum patient_position)position);
}

int patient_read(const cJSON *value, const char *base, struct patient *ret_patient, struct error *err)
{
	struct patient patient = patient_unknown;
	struct json_reader reader;
	int code = 0;

	if (value != NULL && !cJSON_IsNull(value)) {
		json_begin(&reader, value, base, err);
		patient_members(&reader, true, &patient);
		code = json_end(&reader);
	}
	if (code == 0)
		*ret_patient = patient;
	return code;
}

cJSON *patient_json(const struct patient *patient)
{
	cJSON *json, *value;
	double numbers[16] = {[15] = 1};

	if (!patient->known)
		return cJSON_CreateNull();
	for (int i = 0; i < 3; i++) {
		memcpy(numbers + (size_t)4 * (size_t)i, patient->rotation[i], sizeof(patient->rotation[i]));
		numbers[4 * i + 3] = patient->offset[i];
	}
	json = cJSON_CreateObject();
	if (patient->position >= 0)
		value = cJSON_CreateString(patient_position_names[patient->position]);
	else
		value = cJSON_CreateDoubleArray(numbers, 16);
	if (json_add(json, patient->position >= 0 ? "position" : "world_to_patient", value))
		return json;
	cJSON_Delete(json);
	return NULL;
}

bool patient_same(const struct patient *a, const struct patient *b)
{
	return a->known == b->known && a->position == b->position &&
	       memcmp(a->rotation, b->rotation, sizeof(a->rotation)) == 0 &&
	       memcmp(a->offset, b->offset, sizeof(a->offset)) == 0;
}

/* ---- using ---- */

void patient_direction(const struct patient *patient, const double world[3], double ret[3])
{
	double direction[3];

	for (int i = 0; i < 3; i++)
		direction[i] = vec_dot(patient->rotation[i], world) + 0.0; /* no negative zeros */
	memcpy(ret, direction, sizeof(direction));
}

void patient_point(const struct patient *patient, const double world[3], double ret[3])
{
	patient_direction(patient, world, ret);
	for (int i = 0; i < 3; i++)
		ret[i] += patient->offset[i];
}

void axes_nearest(double axes[3][3], int ret_nearest[3])
{
	bool taken[3] = {false}, placed[3] = {false};

	for (int turn = 0; turn < 3; turn++) {
		int axis = -1, along = -1;

		for (int i = 0; i < 3; i++)
			for (int j = 0; j < 3; j++)
				if (!placed[i] && !taken[j] &&
				    (axis < 0 || fabs(axes[i][j]) > fabs(axes[axis][along]))) {
					axis = i;
					along = j;
				}
		placed[axis] = taken[along] = true;
		ret_nearest[axis] = along;
	}
}

void patient_letters_towards(const struct patient *patient, const double world[3],
			     char ret_letters[PATIENT_LETTERS_MAX])
{
	static const char towards[3] = {'L', 'P', 'S'}, away[3] = {'R', 'A', 'I'};
	const double least = 0.2; /* of a unit vector: 11.5 degrees off another axis are told */
	double part[3];
	int count = 0;

	if (patient->known)
		patient_direction(patient, world, part);
	else
		memcpy(part, world, sizeof(part));
	for (;;) {
		int longest = 0;

		for (int i = 1; i < 3; i++)
			if (fabs(part[i]) > fabs(part[longest]))
				longest = i;
		if (fabs(part[longest]) < least)
			break;
		if (patient->known) {
			ret_letters[count++] = part[longest] > 0 ? towards[longest] : away[longest];
		} else {
			ret_letters[count++] = part[longest] > 0 ? '+' : '-';
			ret_letters[count++] = "xyz"[longest];
		}
		part[longest] = 0;
	}
	ret_letters[count] = '\0';
}

void patient_letters(const struct patient *patient, int axis, bool negative, char ret_letters[PATIENT_LETTERS_MAX])
{
	double world[3] = {0};

	world[axis] = negative ? -1 : 1;
	patient_letters_towards(patient, world, ret_letters);
}

cJSON *patient_axes_json(const struct patient *patient)
{
	static const char *const names[3] = {"x", "y", "z"};
	cJSON *json;

	if (!patient->known)
		return cJSON_CreateNull();
	json = cJSON_CreateObject();
	for (int i = 0; i < 3; i++) {
		char letters[PATIENT_LETTERS_MAX];

		patient_letters(patient, i, false, letters);
		cJSON_AddStringToObject(json, names[i], letters);
	}
	return json;
}

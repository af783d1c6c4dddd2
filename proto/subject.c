/* The patient and the study of a scan: see subject.h. */
#include "proto/subject.h"

#include <ctype.h>
#include <stdio.h>
#include <string.h>

const struct subject_row subject_rows[SUBJECT_COUNT] = {
    [PATIENT_NAME] = {"patient", "name", "PN", 0x0010, 0x0010},
    [PATIENT_ID] = {"patient", "id", "LO", 0x0010, 0x0020},
    [PATIENT_BIRTH_DATE] = {"patient", "birth_date", "DA", 0x0010, 0x0030},
    [PATIENT_SEX] = {"patient", "sex", "CS", 0x0010, 0x0040},
    [STUDY_UID] = {"study", "uid", "UI", 0x0020, 0x000d},
    [STUDY_ID] = {"study", "id", "SH", 0x0020, 0x0010},
    [STUDY_ACCESSION_NUMBER] = {"study", "accession_number", "SH", 0x0008, 0x0050},
    [STUDY_DESCRIPTION] = {"study", "description", "LO", 0x0008, 0x1030},
    [STUDY_REFERRING_PHYSICIAN] = {"study", "referring_physician", "PN", 0x0008, 0x0090},
    [STUDY_DATE] = {"study", "date", "DA", 0x0008, 0x0020},
    [STUDY_TIME] = {"study", "time", "TM", 0x0008, 0x0030},
    [STUDY_STEP_ID] = {"study", "step_id", "SH", 0x0040, 0x0009},
    [STUDY_PROCEDURE_ID] = {"study", "procedure_id", "SH", 0x0040, 0x1001},
};

/* ---- value representations, PS3.5 6.2 ---- */

/* NULL: the text is a value. Otherwise what is expected; *ret_code: ERR_INVALID, or ERR_IMPOSSIBLE. */
typedef const char *check_value(const char *text, int *ret_code);

/* 1 to 3 component groups ("="), of at most 64 characters and 5 components ("^") each. */
static const char *check_name(const char *text, int *ret_code)
{
	const char *const expected = "at most 3 groups (\"=\") of at most 64 characters and 5 components (\"^\") are "
				     "expected, without a backslash";
	const char *const empty = "a name is expected, \"^\" and \"=\" stand between its parts";
	int groups = 1, components = 1, characters = 0;

	if (strspn(text, "^= ") == strlen(text))
		return empty;

	(void)ret_code;
	for (; *text != '\0'; text++) {
		if (*text == '=') {
			groups++;
			components = 1;
			characters = 0;
			continue;
		}
		components += *text == '^';
		characters += ((unsigned char)*text & 0xc0) != 0x80; /* the first byte of each */
		if (*text == '\\' || components > 5 || characters > 64)
			return expected;
	}
	return groups > 3 ? expected : NULL;
}

static const char *check_long(const char *text, int *ret_code)
{
	(void)ret_code;
	return strchr(text, '\\') != NULL || utf8_length(text) > 64 ? "at most 64 characters without a backslash are "
								      "expected"
								    : NULL;
}

static const char *check_short(const char *text, int *ret_code)
{
	(void)ret_code;
	return strchr(text, '\\') != NULL || utf8_length(text) > 16 ? "at most 16 characters without a backslash are "
								      "expected"
								    : NULL;
}

static const char *check_sex(const char *text, int *ret_code)
{
	(void)ret_code;
	return strchr("MFO", text[0]) == NULL || text[1] != '\0' ? "M, F or O is expected" : NULL;
}

/* Components are numbers without leading zeros. */
bool uid_valid(const char *text)
{
	bool good = strlen(text) <= UID_MOST && strspn(text, "0123456789.") == strlen(text);

	for (const char *at = text; good; at++) {
		good = isdigit((unsigned char)at[0]) && !(at[0] == '0' && isdigit((unsigned char)at[1]));
		at = strchr(at, '.');
		if (at == NULL)
			break;
	}
	return good;
}

static const char *check_uid(const char *text, int *ret_code)
{
	(void)ret_code;
	return uid_valid(text) ? NULL : UID_EXPECTED;
}

/* Numbers of `pattern`'s digits 'd' in their places, with its other characters between them. */
static bool has_form(const char *text, const char *pattern)
{
	for (; *text != '\0' && *pattern != '\0'; text++, pattern++)
		if (*pattern == 'd' ? !isdigit((unsigned char)*text) : *text != *pattern)
			return false;
	return *text == '\0' && *pattern == '\0';
}

static int two_digits(const char *text)
{
	return 10 * (text[0] - '0') + text[1] - '0';
}

static const char *check_date(const char *text, int *ret_code)
{
	static const int days[12] = {31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31};
	int year, month, day;
	bool leap;

	if (!has_form(text, "dddd-dd-dd"))
		return "a date YYYY-MM-DD is expected";
	year = 100 * two_digits(text) + two_digits(text + 2);
	month = two_digits(text + 5);
	day = two_digits(text + 8);
	leap = (year % 4 == 0 && year % 100 != 0) || year % 400 == 0;
	/* The calendar that DICOM's dates are of begins with the year 1. */
	if (year >= 1 && month >= 1 && month <= 12 && day >= 1 && day <= days[month - 1] + (month == 2 && leap))
		return NULL;
	*ret_code = ERR_IMPOSSIBLE;
	return "no calendar has this date";
}

static const char *check_time(const char *text, int *ret_code)
{
	if (!has_form(text, "dd:dd:dd"))
		return "a time HH:MM:SS is expected";
	if (two_digits(text) < 24 && two_digits(text + 3) < 60 && two_digits(text + 6) < 60)
		return NULL;
	*ret_code = ERR_IMPOSSIBLE;
	return "no clock has this time";
}

static const struct {
	char vr[3];
	check_value *check;
	const char *separators; /* in the documents, which DICOM writes without them */
	int places[2];          /* where the separators stand */
} representations[] = {
    {"PN", check_name, "", {0}},     {"LO", check_long, "", {0}}, {"SH", check_short, "", {0}},
    {"CS", check_sex, "", {0}},      {"UI", check_uid, "", {0}},  {"DA", check_date, "-", {4, 7}},
    {"TM", check_time, ":", {2, 5}},
};

static int representation_of(enum subject_field field)
{
	int i = 0;

	while (strcmp(representations[i].vr, subject_rows[field].vr) != 0)
		i++;
	return i;
}

/*
 * Controls beyond ASCII, U+0080 .. U+009F, and those that turn what follows round for the eye alone, U+202A .. U+202E
 * and U+2066 .. U+2069: a name that is not what it looks like.
 */
static bool has_unseen(const char *text)
{
	const unsigned char *at = (const unsigned char *)text;

	for (; *at != '\0'; at++) {
		if ((at[0] == 0xc2 && at[1] < 0xa0) ||
		    (at[0] == 0xe2 && at[1] == 0x80 && at[2] >= 0xaa && at[2] <= 0xae) ||
		    (at[0] == 0xe2 && at[1] == 0x81 && at[2] >= 0xa6 && at[2] <= 0xa9))
			return true;
	}
	return false;
}

static const char *check(enum subject_field field, const char *text, int *ret_code)
{
	const size_t length = strlen(text);

	*ret_code = ERR_INVALID;
	if (has_unseen(text))
		return "no control character and no change of the direction of writing is expected";
	if (text[0] == ' ' || text[length - 1] == ' ')
		return "no blank at either end is expected: DICOM does not keep it";
	return representations[representation_of(field)].check(text, ret_code);
}

/* ---- documents ---- */

void subject_members(struct json_reader *reader, const char *object, struct subject *ret_subject)
{
	for (int i = 0; i < SUBJECT_COUNT; i++) {
		const char *expected = NULL;
		int code;

		if (strcmp(subject_rows[i].object, object) != 0)
			continue;
		json_text(reader, subject_rows[i].name, false, SUBJECT_MOST, ret_subject->text[i]);
		if (reader->code == 0 && ret_subject->text[i][0] != '\0')
			expected = check((enum subject_field)i, ret_subject->text[i], &code);
		if (expected != NULL)
			json_fail(reader, code, subject_rows[i].name, "%s", expected);
	}
}

bool subject_known(const struct subject *subject, const char *object)
{
	for (int i = 0; i < SUBJECT_COUNT; i++)
		if (subject->text[i][0] != '\0' && (object == NULL || strcmp(subject_rows[i].object, object) == 0))
			return true;
	return false;
}

cJSON *subject_json(const struct subject *subject)
{
	cJSON *document = cJSON_CreateObject();

	for (int i = 0; i < SUBJECT_COUNT && document != NULL; i++) {
		const struct subject_row *row = &subject_rows[i];
		cJSON *object = cJSON_GetObjectItemCaseSensitive(document, row->object);

		if (subject->text[i][0] == '\0')
			continue;
		if (object == NULL)
			object = cJSON_AddObjectToObject(document, row->object);
		if (object == NULL || cJSON_AddStringToObject(object, row->name, subject->text[i]) == NULL) {
			cJSON_Delete(document);
			document = NULL;
		}
	}
	return document;
}

static int read_object(const cJSON *value, const char *object, struct subject *subject, struct error *err)
{
	struct json_reader reader;

	if (value == NULL)
		return 0;
	json_begin(&reader, value, "", err);
	subject_members(&reader, object, subject);
	return json_end(&reader);
}

int subject_parse(const char *text, struct subject *ret_subject, struct error *err)
{
	struct json_reader reader;
	const cJSON *patient, *study;
	cJSON *document;
	int code;

	memset(ret_subject, 0, sizeof(*ret_subject));
	if (text[0] == '\0')
		return 0;
	code = json_parse(text, strlen(text), &document, err);
	if (code != 0)
		return code;
	json_begin(&reader, document, "", err);
	patient = json_member(&reader, "patient", false);
	study = json_member(&reader, "study", false);
	json_member(&reader, "source", false); /* source.h's */
	code = json_end(&reader);
	if (code == 0)
		code = read_object(patient, "patient", ret_subject, err);
	if (code == 0)
		code = read_object(study, "study", ret_subject, err);
	cJSON_Delete(document);
	return code;
}

/* ---- DICOM ---- */

void subject_value(const struct subject *subject, enum subject_field field, char ret[TEXT_BYTES(SUBJECT_MOST)])
{
	const char *separators = representations[representation_of(field)].separators;
	size_t used = 0;

	for (const char *at = subject->text[field]; *at != '\0'; at++)
		if (strchr(separators, *at) == NULL)
			ret[used++] = *at;
	ret[used] = '\0';
}

bool subject_take(struct subject *subject, enum subject_field field, const char *value)
{
	const int representation = representation_of(field);
	const char *separators = representations[representation].separators;
	char text[TEXT_BYTES(SUBJECT_MOST)];
	size_t length, used = 0;
	int code;

	value += strspn(value, " ");
	length = strlen(value);
	while (length > 0 && value[length - 1] == ' ')
		length--;
	/* A time may have fractions of a second. */
	if (strcmp(representations[representation].vr, "TM") == 0 && length > 6 && value[6] == '.')
		length = 6;
	if (length == 0 || length + 2 >= sizeof(text))
		return false;
	for (size_t i = 0; i < length; i++) {
		if (separators[0] != '\0' && (used == (size_t)representations[representation].places[0] ||
					      used == (size_t)representations[representation].places[1]))
			text[used++] = separators[0];
		if ((unsigned char)value[i] < 0x20 || value[i] == 0x7f)
			return false;
		text[used++] = value[i];
	}
	text[used] = '\0';
	if (utf8_length(text) > SUBJECT_MOST || check(field, text, &code) != NULL)
		return false;
	memcpy(subject->text[field], text, used + 1);
	return true;
}

/* Who was scanned: what is accepted as a patient's and a study's values, what is refused, and both ways to DICOM. */
#include <check.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/subject.h"
#include "tests/unit/documents.h"

static int read_member(const char *object, const char *text, struct subject *ret, struct error *err)
{
	struct json_reader reader;
	cJSON *json = NULL;
	int code;

	memset(ret, 0, sizeof(*ret));
	ck_assert_msg(json_parse(text, strlen(text), &json, err) == 0, "%s: %s", text, err->text);
	json_begin(&reader, json, object, err);
	subject_members(&reader, object + 1, ret);
	code = json_end(&reader);
	cJSON_Delete(json);
	return code;
}

static const char x64[] = "xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx";

static const struct {
	enum subject_field field;
	const char *good, *dicom;
} goods[] = {
    {PATIENT_NAME, "Doe^Jane^^Dr.^PhD", "Doe^Jane^^Dr.^PhD"},
    {PATIENT_NAME, "Yamada^Tarou=\xe5\xb1\xb1\xe7\x94\xb0^\xe5\xa4\xaa\xe9\x83\x8e=x",
     "Yamada^Tarou=\xe5\xb1\xb1\xe7\x94\xb0^\xe5\xa4\xaa\xe9\x83\x8e=x"},
    {PATIENT_ID, x64, x64},
    {PATIENT_BIRTH_DATE, "2000-02-29", "20000229"},
    {PATIENT_SEX, "O", "O"},
    {STUDY_UID, "1.2.0.34567", "1.2.0.34567"},
    {STUDY_ID, "S 1", "S 1"},
    {STUDY_ACCESSION_NUMBER, "\xc3\xa4 2345678901234", "\xc3\xa4 2345678901234"},
    {STUDY_DESCRIPTION, "left/right \"x\"", "left/right \"x\""},
    {STUDY_REFERRING_PHYSICIAN, "House", "House"},
    {STUDY_DATE, "1999-12-31", "19991231"},
    {STUDY_TIME, "23:59:59", "235959"},
};

START_TEST(what_dicom_can_hold_is_accepted_and_comes_back)
{
	for (size_t i = 0; i < sizeof(goods) / sizeof(goods[0]); i++) {
		const struct subject_row *row = &subject_rows[goods[i].field];
		char object[16], value[TEXT_BYTES(SUBJECT_MOST)], *text;
		struct subject subject, again, taken = {0};
		cJSON *json = cJSON_CreateObject();
		struct error err = {0};

		cJSON_AddStringToObject(json, row->name, goods[i].good);
		text = json_print(json, NULL);
		cJSON_Delete(json);
		snprintf(object, sizeof(object), "/%s", row->object);
		ck_assert_msg(read_member(object, text, &subject, &err) == 0, "%s: %s", text, err.text);
		free(text);
		subject_value(&subject, goods[i].field, value);
		ck_assert_str_eq(value, goods[i].dicom);
		ck_assert(subject_known(&subject, row->object) && subject_known(&subject, NULL));
		ck_assert(!subject_known(&subject, strcmp(row->object, "study") == 0 ? "patient" : "study"));
		ck_assert(subject_take(&taken, goods[i].field, value));
		ck_assert(memcmp(&taken, &subject, sizeof(taken)) == 0);
		json = subject_json(&subject);
		text = json_print(json, NULL);
		cJSON_Delete(json);
		ck_assert_msg(subject_parse(text, &again, &err) == 0, "%s: %s", text, err.text);
		free(text);
		ck_assert(memcmp(&again, &subject, sizeof(again)) == 0);
	}
}
END_TEST

static const struct {
	const char *object, *text;
	int code;
	const char *pointer;
} bads[] = {
    {"/patient", "{\"name\": \"a\\\\b\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"name\": \"^\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"name\": \"==\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"birth_date\": \"0000-01-01\"}", ERR_IMPOSSIBLE, "/patient/birth_date"},
    {"/patient", "{\"name\": \"a=b=c=d\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"name\": \"a^b^c^d^e^f\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"name\": \" a\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"name\": \"a\\u0007\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"id\": 4711}", ERR_INVALID, "/patient/id"},
    {"/patient", "{\"id\": \"a\\\\b\"}", ERR_INVALID, "/patient/id"},
    {"/patient", "{\"id\": \"a\\u0085b\"}", ERR_INVALID, "/patient/id"},
    {"/patient", "{\"name\": \"Doe^\\u202enaJ\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"name\": \"Doe^\\u2067naJ\"}", ERR_INVALID, "/patient/name"},
    {"/patient", "{\"birth_date\": \"19700228\"}", ERR_INVALID, "/patient/birth_date"},
    {"/patient", "{\"birth_date\": \"1900-02-29\"}", ERR_IMPOSSIBLE, "/patient/birth_date"},
    {"/patient", "{\"birth_date\": \"1970-00-10\"}", ERR_IMPOSSIBLE, "/patient/birth_date"},
    {"/patient", "{\"sex\": \"female\"}", ERR_INVALID, "/patient/sex"},
    {"/patient", "{\"nmae\": \"a\"}", ERR_INVALID, "/patient/nmae"},
    {"/study", "{\"uid\": \"1..2\"}", ERR_INVALID, "/study/uid"},
    {"/study", "{\"uid\": \"1.02\"}", ERR_INVALID, "/study/uid"},
    {"/study", "{\"uid\": \"1.2.\"}", ERR_INVALID, "/study/uid"},
    {"/study", "{\"uid\": \".1\"}", ERR_INVALID, "/study/uid"},
    {"/study", "{\"accession_number\": \"12345678901234567\"}", ERR_INVALID, "/study/accession_number"},
    {"/study", "{\"time\": \"24:00:00\"}", ERR_IMPOSSIBLE, "/study/time"},
    {"/study", "{\"time\": \"9:00\"}", ERR_INVALID, "/study/time"},
};

START_TEST(what_dicom_cannot_hold_is_refused_by_its_place_and_not_shown)
{
	char text[600];

	for (size_t i = 0; i < sizeof(bads) / sizeof(bads[0]); i++) {
		struct subject subject;
		struct error err = {0};

		ck_assert_msg(read_member(bads[i].object, bads[i].text, &subject, &err) == bads[i].code, "%s: %d, %s",
			      bads[i].text, err.code, err.text);
		ck_assert_str_eq(err.pointer, bads[i].pointer);
	}
	for (int groups = 1; groups <= 3; groups++) {
		struct subject subject;
		struct error err = {0};

		/* 64 characters in the last group, then 65. */
		snprintf(text, sizeof(text), "{\"name\": \"%s%s\"}", &"a=b="[2 * (3 - groups)], x64);
		ck_assert_int_eq(read_member("/patient", text, &subject, &err), 0);
		snprintf(text, sizeof(text), "{\"name\": \"%s%sx\"}", &"a=b="[2 * (3 - groups)], x64);
		ck_assert_int_eq(read_member("/patient", text, &subject, &err), ERR_INVALID);
		ck_assert(strstr(err.text, "xxx") == NULL);
	}
}
END_TEST

START_TEST(dicoms_texts_that_are_no_value_are_not_taken)
{
	static const struct {
		enum subject_field field;
		const char *text, *taken;
	} texts[] = {
	    {PATIENT_NAME, "Doe^J ", "Doe^J"},
	    {PATIENT_ID, "  ", NULL},
	    {PATIENT_ID, " 1 2 ", "1 2"},
	    {PATIENT_BIRTH_DATE, "19701301", NULL},
	    {PATIENT_BIRTH_DATE, "1970", NULL},
	    {PATIENT_BIRTH_DATE, "1970.01.02", NULL},
	    {PATIENT_SEX, "m", NULL},
	    {STUDY_TIME, "235959.123456", "23:59:59"},
	    {STUDY_TIME, "12", NULL},
	    {STUDY_UID, "abc", NULL},
	    {STUDY_ACCESSION_NUMBER, "a\\b", NULL},
	    {STUDY_DESCRIPTION, "a\tb", NULL},
	};

	for (size_t i = 0; i < sizeof(texts) / sizeof(texts[0]); i++) {
		struct subject subject = {0};
		bool taken = subject_take(&subject, texts[i].field, texts[i].text);

		ck_assert_msg(taken == (texts[i].taken != NULL), "%s", texts[i].text);
		ck_assert_str_eq(subject.text[texts[i].field], taken ? texts[i].taken : "");
	}
}
END_TEST

Suite *subject_suite(void)
{
	Suite *suite = suite_create("subject");
	TCase *tests = tcase_create("subject");

	tcase_add_test(tests, what_dicom_can_hold_is_accepted_and_comes_back);
	tcase_add_test(tests, what_dicom_cannot_hold_is_refused_by_its_place_and_not_shown);
	tcase_add_test(tests, dicoms_texts_that_are_no_value_are_not_taken);
	suite_add_tcase(suite, tests);
	return suite;
}

/* struct error: what it holds, how pointers nest, and that nothing overflows. */
#include <check.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>

#include "core/error.h"
#include "core/warning.h"

START_TEST(an_error_has_code_pointer_and_text)
{
	struct error err = {0};

	ck_assert_int_eq(error_set_at(&err, ERR_INVALID, "/grid/size/0", "%d voxels, expected %s", -3, "more"),
			 ERR_INVALID);
	ck_assert_int_eq(err.code, ERR_INVALID);
	ck_assert_str_eq(err.pointer, "/grid/size/0");
	ck_assert_str_eq(err.text, "-3 voxels, expected more");
	/* The next error leaves nothing of the one before. */
	ck_assert_int_eq(error_set(&err, ERR_DEVICE, "gone"), ERR_DEVICE);
	ck_assert_str_eq(err.pointer, "");
	ck_assert_str_eq(err.text, "gone");
}
END_TEST

START_TEST(pointers_nest_from_the_inside_out)
{
	struct error err = {0};

	error_set_at(&err, ERR_INVALID, "/0", "x");
	error_nest(&err, "/size");
	error_nest(&err, "/grid");
	ck_assert_str_eq(err.pointer, "/grid/size/0");
}
END_TEST

START_TEST(long_texts_are_cut)
{
	struct error err = {0};
	char text[1000];

	memset(text, 'x', sizeof(text) - 1);
	text[sizeof(text) - 1] = '\0';
	error_set_at(&err, ERR_INVALID, text, "%s", text);
	error_nest(&err, text);
	ck_assert_uint_eq(strlen(err.pointer), sizeof(err.pointer) - 1);
	ck_assert_uint_eq(strlen(err.text), sizeof(err.text) - 1);
	error_set_errno(&err, EIO, "%s", text);
	ck_assert_ptr_nonnull(strstr(err.text, strerror(EIO)));
}
END_TEST

START_TEST(errno_values_keep_their_meaning)
{
	static const struct {
		int value, code;
	} rows[] = {
	    {ENOSPC, ERR_NO_SPACE}, {EDQUOT, ERR_NO_SPACE}, {ENOMEM, ERR_NO_MEMORY}, {EIO, ERR_IO}, {ENOENT, ERR_IO}};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct error err = {0};

		ck_assert_int_eq(error_set_errno(&err, rows[i].value, "write %s", "file"), rows[i].code);
		ck_assert_int_eq(strncmp(err.text, "write file: ", 12), 0);
		ck_assert_ptr_nonnull(strstr(err.text, strerror(rows[i].value)));
	}
}
END_TEST

/* The table of warnings is complete and the schema of record names each of its codes. */
START_TEST(every_warning_has_a_sentence_and_is_in_the_schema)
{
	static char schema[1 << 20];
	FILE *file = fopen("proto/openapi.yaml", "re");
	size_t length;

	ck_assert_msg(file != NULL, "proto/openapi.yaml is read from the project's root");
	length = fread(schema, 1, sizeof(schema) - 1, file);
	ck_assert_uint_lt(length, sizeof(schema) - 1);
	fclose(file);
	for (const struct warning_kind *kind = warning_kinds; kind->code != NULL; kind++) {
		const size_t end = strlen(kind->summary);
		char quoted[80];

		ck_assert_ptr_eq(warning_kind(kind->code), kind);
		ck_assert_msg(end > 20 && kind->summary[end - 1] == '.', "%s: one sentence", kind->code);
		snprintf(quoted, sizeof(quoted), "`%s`", kind->code);
		ck_assert_msg(strstr(schema, quoted) != NULL, "%s is not in proto/openapi.yaml", quoted);
	}
	ck_assert(!warning_is_known("none_of_ours"));
	ck_assert_int_eq(warning_kind("none_of_ours")->severity, SEVERITY_CAUTION);
}
END_TEST

Suite *error_suite(void);
Suite *error_suite(void)
{
	Suite *suite = suite_create("error");
	TCase *cases = tcase_create("error");

	tcase_add_test(cases, an_error_has_code_pointer_and_text);
	tcase_add_test(cases, pointers_nest_from_the_inside_out);
	tcase_add_test(cases, long_texts_are_cut);
	tcase_add_test(cases, errno_values_keep_their_meaning);
	tcase_add_test(cases, every_warning_has_a_sentence_and_is_in_the_schema);
	suite_add_tcase(suite, cases);
	return suite;
}

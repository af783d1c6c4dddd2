/* Ramp filters: the response against the kernel's definition and against |f|. */
#include <check.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>

#include "core/filter.h"

static void response(enum window window, double cutoff, double pitch, int length, float *ret)
{
	struct error err = {0};

	ck_assert_msg(filter_response(window, cutoff, pitch, length, ret, &err) == 0, "%s", err.text);
}

static bool is_smooth(int n)
{
	static const int primes[] = {2, 3, 5};

	for (int i = 0; i < 3; i++)
		while (n % primes[i] == 0)
			n /= primes[i];
	return n == 1;
}

START_TEST(lengths_are_the_smallest_that_do_not_wrap_round)
{
	for (int columns = 1; columns <= 3000; columns++) {
		int length = filter_length(columns);

		ck_assert_int_ge(length, 2 * columns - 1);
		ck_assert(length % 2 == 0 && is_smooth(length));
		for (int less = 2 * columns - 1; less < length; less++)
			ck_assert(less % 2 != 0 || !is_smooth(less));
	}
	ck_assert_int_eq(filter_length(16384), 32768);
}
END_TEST

/* h[n] of the contract's notes, at distance n pixels. */
static double kernel(int n, double pitch)
{
	if (n == 0)
		return 1 / (4 * pitch);
	return n % 2 == 0 ? 0 : -1 / (M_PI * M_PI * (double)n * n * pitch);
}

START_TEST(the_ramp_is_the_transform_of_its_kernel)
{
	static const int lengths[] = {2, 4, 6, 10, 30, 48, 250};
	static const double pitches[] = {1, 0.25, 3};

	for (size_t l = 0; l < sizeof(lengths) / sizeof(*lengths); l++)
		for (size_t p = 0; p < sizeof(pitches) / sizeof(*pitches); p++) {
			int length = lengths[l];
			float got[126];

			response(WINDOW_RAM_LAK, 1, pitches[p], length, got);
			/* Back again: the inverse transform has the kernel at every distance that a row can hold. */
			for (int n = 0; n < length / 2; n++) {
				double sum = 0;

				for (int k = 0; k < length; k++)
					sum += got[k <= length / 2 ? k : length - k] * cos(2 * M_PI * k * n / length);
				/* Floats of at most 2 / pitch. */
				ck_assert_double_eq_tol(sum / length, kernel(n, pitches[p]), 2e-7 / pitches[p]);
			}
		}
}
END_TEST

START_TEST(the_ramp_grows_with_frequency)
{
	enum { LENGTH = 1024 };
	float got[LENGTH / 2 + 1];

	response(WINDOW_RAM_LAK, 1, 0.5, LENGTH, got);
	/* |f| = k / (length pitch), but for the kernel's cut at half of the length: 2 / (pi^2 length pitch) at 0. */
	for (int k = 0; k <= LENGTH / 2; k++)
		ck_assert_double_eq_tol(got[k], k / (LENGTH * 0.5), 2.1 / (M_PI * M_PI * LENGTH * 0.5));
	ck_assert(got[0] > 0);
}
END_TEST

START_TEST(windows_have_their_textbook_values)
{
	enum { LENGTH = 240 };
	/* At 0, a half and the whole of the cutoff. */
	static const double values[WINDOW_COUNT][3] = {
	    [WINDOW_RAM_LAK] = {1, 1, 1},        [WINDOW_SHEPP_LOGAN] = {1, 2 * M_SQRT2 / M_PI, 2 / M_PI},
	    [WINDOW_COSINE] = {1, M_SQRT1_2, 0}, [WINDOW_HAMMING] = {1, 0.54, 0.08},
	    [WINDOW_HANN] = {1, 0.5, 0},
	};
	static const double cutoffs[] = {1, 0.5, 0.25};
	float ramp[LENGTH / 2 + 1], got[LENGTH / 2 + 1];

	response(WINDOW_RAM_LAK, 1, 1, LENGTH, ramp);
	for (int window = 0; window < WINDOW_COUNT; window++)
		for (size_t c = 0; c < sizeof(cutoffs) / sizeof(*cutoffs); c++) {
			int end = (int)lround(cutoffs[c] * LENGTH / 2);

			response((enum window)window, cutoffs[c], 1, LENGTH, got);
			for (int i = 0; i < 3; i++)
				ck_assert_double_eq_tol(got[i * end / 2], ramp[i * end / 2] * values[window][i], 1e-7);
			for (int k = 1; k <= end; k++)
				ck_assert(got[k] <= ramp[k] && got[k] >= -1e-9);
			for (int k = end + 1; k <= LENGTH / 2; k++)
				ck_assert_float_eq(got[k], 0);
		}
}
END_TEST

START_TEST(every_window_has_a_name_of_its_own)
{
	static const char *const names[] = {"ram-lak", "shepp-logan", "cosine", "hamming", "hann"};

	ck_assert_uint_eq(sizeof(names) / sizeof(*names), WINDOW_COUNT);
	for (int i = 0; i < WINDOW_COUNT; i++)
		ck_assert_str_eq(window_names[i], names[i]);
}
END_TEST

START_TEST(bad_filters_are_refused)
{
	static const struct {
		int window;
		double cutoff, pitch;
		int length;
		const char *pointer;
	} rows[] = {
	    {WINDOW_COUNT, 1, 1, 8, "/window"},
	    {-1, 1, 1, 8, "/window"},
	    {0, 0, 1, 8, "/cutoff"},
	    {0, -1, 1, 8, "/cutoff"},
	    {0, 1.01, 1, 8, "/cutoff"},
	    {0, NAN, 1, 8, "/cutoff"},
	    {0, 1, 0, 8, ""},
	    {0, 1, INFINITY, 8, ""},
	    {0, 1, 1, 7, ""},
	    {0, 1, 1, 0, ""},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct error err = {0};
		float got[5] = {-7};

		ck_assert_int_eq(filter_response((enum window)rows[i].window, rows[i].cutoff, rows[i].pitch,
						 rows[i].length, got, &err),
				 ERR_INVALID);
		ck_assert_str_eq(err.pointer, rows[i].pointer);
		ck_assert_float_eq(got[0], -7);
	}
}
END_TEST

Suite *filter_suite(void);
Suite *filter_suite(void)
{
	Suite *suite = suite_create("filter");
	TCase *cases = tcase_create("filter");

	tcase_add_test(cases, lengths_are_the_smallest_that_do_not_wrap_round);
	tcase_add_test(cases, the_ramp_is_the_transform_of_its_kernel);
	tcase_add_test(cases, the_ramp_grows_with_frequency);
	tcase_add_test(cases, windows_have_their_textbook_values);
	tcase_add_test(cases, every_window_has_a_name_of_its_own);
	tcase_add_test(cases, bad_filters_are_refused);
	suite_add_tcase(suite, cases);
	return suite;
}

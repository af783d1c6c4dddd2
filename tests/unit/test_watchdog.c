/* Decisions about workers that depend on times. */
#include <check.h>

#include "daemon/jobs/watchdog.h"

START_TEST(patience_is_for_a_scan_whose_projections_come)
{
	static const struct {
		double arrived, since, attended;
	} cases[] = {
	    {0, 98, 0},                   /* none has come yet */
	    {90, 98, 0},                  /* the arm stands still */
	    {98, 98, 0},   {99, 98, 100}, /* it turns */
	    {95, 94, 100},                /* it turned when the worker was asked to make room for it */
	};

	for (unsigned i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
		ck_assert_double_eq(watchdog_attended(cases[i].arrived, cases[i].since, 100), cases[i].attended);
}
END_TEST

Suite *watchdog_suite(void);
Suite *watchdog_suite(void)
{
	Suite *suite = suite_create("watchdog");
	TCase *tests = tcase_create("decisions");

	tcase_add_test(tests, patience_is_for_a_scan_whose_projections_come);
	suite_add_tcase(suite, tests);
	return suite;
}

/* Decisions about workers that depend on times. */
#include <check.h>

#include "daemon/watchdog.h"

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

START_TEST(silence_and_standing_still_are_told_from_work)
{
	static const struct {
		struct watchdog_signs signs;
		double now;
		enum watchdog_verdict verdict;
	} cases[] = {
	    /* idle: it counts steps too */
	    {{.heard = 100, .stepped = 100}, 100, WATCHDOG_ALIVE},
	    {{.heard = 100, .stepped = 99}, 102, WATCHDOG_ALIVE},
	    {{.heard = 100, .stepped = 100}, 104.1, WATCHDOG_SILENT},
	    {{.heard = 104, .stepped = 100}, 104.1, WATCHDOG_HUNG},
	    {{.heard = 104, .stepped = 100, .step_seconds = 60}, 104.1, WATCHDOG_HUNG}, /* it has no long steps */
	    /* busy */
	    {{.busy = true, .heard = 100, .stepped = 90}, 102, WATCHDOG_ALIVE},
	    {{.busy = true, .heard = 100, .stepped = 100}, 104.1, WATCHDOG_SILENT},
	    {{.busy = true, .heard = 112, .stepped = 100}, 112.9, WATCHDOG_ALIVE},
	    {{.busy = true, .heard = 113, .stepped = 100}, 113.1, WATCHDOG_HUNG},
	    {{.busy = true, .heard = 113, .stepped = 100, .step_seconds = 3}, 113.1, WATCHDOG_HUNG},
	    /* a step that announced itself, and silence in it */
	    {{.busy = true, .heard = 159, .stepped = 100, .step_seconds = 60}, 160, WATCHDOG_ALIVE},
	    {{.busy = true, .heard = 160, .stepped = 100, .step_seconds = 60}, 160.1, WATCHDOG_HUNG},
	    {{.busy = true, .heard = 110, .stepped = 100, .step_seconds = 60}, 114.1, WATCHDOG_SILENT},
	};

	for (unsigned i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		const double due = watchdog_due(&cases[i].signs);

		ck_assert_int_eq(watchdog_judge(&cases[i].signs, cases[i].now), cases[i].verdict);
		/* The look at the time that is due finds it, and none before does. */
		ck_assert_int_eq(watchdog_judge(&cases[i].signs, due), WATCHDOG_ALIVE);
		ck_assert_int_ne(watchdog_judge(&cases[i].signs, due + 1e-6), WATCHDOG_ALIVE);
	}
}
END_TEST

START_TEST(a_worker_is_not_said_to_answer_before_it_is_killed)
{
	static const struct {
		struct watchdog_signs signs;
		double now;
		bool answers;
	} cases[] = {
	    {{.heard = 100, .stepped = 100}, 104, true},
	    {{.heard = 100, .stepped = 100}, 104.1, false},
	    {{.busy = true, .heard = 104, .stepped = 100}, 104, true},
	    {{.busy = true, .heard = 105, .stepped = 100}, 105, false},
	    {{.busy = true, .heard = 105, .stepped = 100, .step_seconds = 60}, 105, true},
	    {{.busy = true, .heard = 100, .stepped = 100, .step_seconds = 60}, 105, false},
	};

	for (unsigned i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
		ck_assert_int_eq(watchdog_answers(&cases[i].signs, cases[i].now), cases[i].answers);
}
END_TEST

Suite *watchdog_suite(void);
Suite *watchdog_suite(void)
{
	Suite *suite = suite_create("watchdog");
	TCase *tests = tcase_create("decisions");

	tcase_add_test(tests, patience_is_for_a_scan_whose_projections_come);
	tcase_add_test(tests, silence_and_standing_still_are_told_from_work);
	tcase_add_test(tests, a_worker_is_not_said_to_answer_before_it_is_killed);
	suite_add_tcase(suite, tests);
	return suite;
}

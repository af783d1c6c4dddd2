/*
 * A hand that moves amid the sweep: thin, small and beside the axis, with little bone (tests/bench/bodies.h), by exact
 * line integrals with noise. What its motion costs of the image, and what is left of that once it is followed.
 */
#include <check.h>
#include <math.h>

#include "tests/bench/departed.h"

enum { COLUMNS = 84, VIEWS = 60, VOXELS = 84 };

/* Root mean square errors of the volume, HU, and of where points lie, mm; all but the first in the best place. */
struct followed {
	bool accepted;
	double still, told, found;
	double before, after;
};

static struct followed follow(enum departed_motion motion)
{
	const struct departure departure = {.kind = REFINE_MOTION, .motion = motion, .photons = 2e4};
	const double rest[PATH_NUMBERS] = {0};
	double there[2][PATH_NUMBERS], seconds[2];
	struct geometry refined = {0};
	struct refinement refinement;
	struct followed followed;
	struct departed scan;
	struct error err;

	ck_assert_msg(departed_open(&scan, &departure, HAND, 5, COLUMNS, VIEWS, 200, &err) == 0, "%s", err.text);
	ck_assert_msg(departed_refine(&scan, REFINE_MOTION, &backend_cpu, NULL, &refined, &refinement, seconds, &err) ==
			  0,
		      "%s", err.text);
	ck_assert_int_eq(departed_compare(&scan.truth, &scan.said, &followed.before, there[0], &err), 0);
	ck_assert_int_eq(departed_compare(&scan.truth, &refined, &followed.after, there[1], &err), 0);
	ck_assert_int_eq(departed_error(&backend_cpu, &scan, &scan.truth, rest, VOXELS, &followed.still, &err), 0);
	ck_assert_int_eq(departed_error(&backend_cpu, &scan, &scan.said, there[0], VOXELS, &followed.told, &err), 0);
	ck_assert_int_eq(departed_error(&backend_cpu, &scan, &refined, there[1], VOXELS, &followed.found, &err), 0);
	followed.accepted = refinement.accepted;
	geometry_clear(&refined);
	departed_close(&scan);
	return followed;
}

/* Within a tenth of the sweep about its long axis, which is nearly the arm's: the views before and behind agree. */
START_TEST(a_hand_that_turns_is_followed)
{
	const struct followed followed = follow(MOTION_TURN);

	ck_assert(followed.accepted);
	ck_assert_msg(followed.after < .65 * followed.before, "%g mm of %g", followed.after, followed.before);
	ck_assert_msg(followed.found < 1.1 * followed.still, "%g HU, %g of the hand at rest", followed.found,
		      followed.still);
	ck_assert_msg(followed.told > 1.1 * followed.still, "%g HU as told, %g of the hand at rest", followed.told,
		      followed.still);
}
END_TEST

Suite *motion_suite(void);
Suite *motion_suite(void)
{
	Suite *suite = suite_create("motion");
	TCase *hands = tcase_create("hands");

	tcase_set_timeout(hands, 300);
	tcase_add_test(hands, a_hand_that_turns_is_followed);
	suite_add_tcase(suite, hands);
	return suite;
}

/*
 * Runs the suites of the table below; `unit NAME ...` runs those named only,
 * `unit -NAME ...` all but those; `unit --list` prints their names.
 * CK_FORK=no keeps the tests in one process, for debuggers and sanitizers.
 *
 * A new suite is a file tests/unit/test_NAME.c that exports NAME_suite, and a row.
 */
#include <check.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SUITES(row)                                                                                                    \
	row(error) row(geometry) row(orbit) row(filter) row(phantom) row(raw) row(detector) row(content)               \
	    row(misplaced) row(impulses) row(recon) row(algorithm) row(stopping) row(weights) row(quality)             \
		row(support) row(noise) row(averaging) row(binning) row(alternation) row(exterior) row(metal)          \
		    row(dense) row(stuck) row(shadow) row(agreement) row(breathing) row(refine) row(motion)            \
			row(outofcore) row(cards) row(study) row(backend) row(json) row(scan) row(recipe)              \
			    row(parameter) row(format) row(patient) row(subject) row(metaimage) row(rtk_geometry)      \
				row(slice) row(sums) row(scan_directory) row(message) row(queue) row(outcome)          \
				    row(watchdog) row(host_memory) row(route) row(lock) row(log) row(store)            \
					row(catalogue) row(upgrade) row(ledger) row(job) row(calibrate)                \
					    row(calibrate_views)

/* Weak: a row may stand here before its file does. What is missing is said aloud. */
#define DECLARE(name) Suite *name##_suite(void) __attribute__((weak));
SUITES(DECLARE)

#define ROW(name) {#name, name##_suite},
static const struct {
	const char *name;
	Suite *(*make)(void);
} suites[] = {SUITES(ROW)};

static bool wanted(const char *name, int count, char **names)
{
	bool some = false;

	for (int i = 0; i < count; i++) {
		if (names[i][0] == '-' && strcmp(name, names[i] + 1) == 0)
			return false;
		if (strcmp(name, names[i]) == 0)
			return true;
		some = some || names[i][0] != '-';
	}
	return !some;
}

int main(int argc, char **argv)
{
	SRunner *runner;
	int failed, found = 0, named = 0;

	if (argc == 2 && strcmp(argv[1], "--list") == 0) {
		for (size_t i = 0; i < sizeof(suites) / sizeof(*suites); i++)
			printf("%s\n", suites[i].name);
		return EXIT_SUCCESS;
	}
	runner = srunner_create(NULL);
	for (size_t i = 0; i < sizeof(suites) / sizeof(*suites); i++) {
		if (!wanted(suites[i].name, argc - 1, argv + 1))
			continue;
		found++;
		if (suites[i].make != NULL)
			srunner_add_suite(runner, suites[i].make());
		else
			printf("SKIP unit suite %s is not linked\n", suites[i].name);
	}
	for (int i = 1; i < argc; i++)
		named += argv[i][0] != '-';
	if (found < named) {
		fprintf(stderr, "unit: a suite of that name does not exist\n");
		srunner_free(runner);
		return EXIT_FAILURE;
	}
	srunner_run_all(runner, CK_ENV);
	failed = srunner_ntests_failed(runner);
	srunner_free(runner);
	return failed == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}

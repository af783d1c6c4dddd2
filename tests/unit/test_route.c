/* Decisions about devices: where a job goes on whose run was lost, and when a device is tested again. */
#include <check.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "daemon/jobs/kernel_log.h"
#include "daemon/jobs/route.h"

static const struct {
	struct route_facts facts;
	enum route expected;
} cases[] = {
    /* One death may be anybody's fault. */
    {{.deaths = 1, .runs = 1}, ROUTE_SAME},
    {{.deaths = 1, .runs = 1, .other = true, .processor = true}, ROUTE_SAME},
    {{.deaths = 1, .runs = 3, .other = true}, ROUTE_SAME},
    /* A device error, or a second death without progress: elsewhere. */
    {{.deaths = 2, .runs = 2, .other = true, .processor = true}, ROUTE_OTHER},
    {{.device_error = true, .deaths = 1, .runs = 1, .other = true, .processor = true}, ROUTE_OTHER},
    {{.device_error = true, .deaths = 1, .runs = 3, .other = true}, ROUTE_OTHER},
    /* No job takes one device after the other with it. */
    {{.deaths = 2, .runs = 4, .other = true, .processor = true}, ROUTE_PROCESSOR},
    {{.deaths = 2, .runs = 4, .other = true}, ROUTE_END},
    {{.device_error = true, .deaths = 1, .runs = 4, .other = true}, ROUTE_END},
    /* No other device answers. */
    {{.deaths = 2, .runs = 2, .processor = true}, ROUTE_PROCESSOR},
    {{.device_error = true, .deaths = 1, .runs = 1, .processor = true}, ROUTE_PROCESSOR},
    {{.deaths = 2, .runs = 2}, ROUTE_SAME},
    {{.device_error = true, .deaths = 1, .runs = 1}, ROUTE_SAME},
    {{.device_error = true, .deaths = 2, .runs = 2}, ROUTE_SAME},
    {{.deaths = 3, .runs = 3}, ROUTE_END},
    {{.device_error = true, .deaths = 1, .runs = 3}, ROUTE_END},
};

START_TEST(a_job_goes_on_elsewhere)
{
	ck_assert_int_eq(route_of(&cases[_i].facts), cases[_i].expected);
}
END_TEST

START_TEST(no_job_goes_on_for_ever)
{
	for (int i = 0; i < 16; i++) {
		const struct route_facts facts = {.device_error = i & 1,
						  .deaths = i & 8 ? 1 : ROUTE_DEATHS,
						  .runs = ROUTE_RUNS_MOST,
						  .other = i & 2,
						  .processor = i & 4};

		ck_assert_int_eq(route_of(&facts), facts.processor ? ROUTE_PROCESSOR : ROUTE_END);
	}
}
END_TEST

START_TEST(tests_of_a_device_come_later_and_later)
{
	double before = device_test_delay(0);

	ck_assert_double_eq(before, 60);
	for (unsigned failed = 1; failed < 100; failed++) {
		ck_assert_double_ge(device_test_delay(failed), before);
		before = device_test_delay(failed);
	}
	ck_assert_double_eq(before, 3600);
}
END_TEST

/* Lines as Linux 6.1 writes them to /dev/kmsg. */
static const char log_text[] =
    "6,339,5140900,-;NET: Registered PF_INET6 protocol family\n"
    "3,340,90000000,-;NVRM: Xid (PCI:0000:01:00): 13, pid=4711, an error before this process\n"
    "4,341,100500000,-;cbct-worker[4711]: segfault at 0 ip 0000 sp 0000 error 4 in libcuda.so\n"
    " SUBSYSTEM=none\n"
    "3,342,101000000,-;Out of memory: Killed process 47110 (cbct-worker) total-vm:8kB\n"
    "6,343,102000000,-;usb 1-1: new high-speed USB device\n";

static void expect_line(const char *text, pid_t pid, double since, const char *expected)
{
	char path[] = "/tmp/cbct-kernel-XXXXXX", line[200];
	int file = mkstemp(path);
	FILE *out = fdopen(file, "w");

	ck_assert_int_ge(file, 0);
	fputs(text, out);
	fclose(out);
	kernel_log_line(path, pid, since, line, sizeof(line));
	unlink(path);
	ck_assert_str_eq(line, expected);
}

START_TEST(the_kernels_last_word_about_a_worker)
{
	expect_line(log_text, 4711, 99, "cbct-worker[4711]: segfault at 0 ip 0000 sp 0000 error 4 in libcuda.so");
	expect_line(log_text, 47110, 99, "Out of memory: Killed process 47110 (cbct-worker) total-vm:8kB");
	expect_line(log_text, 4711, 101, "");
	expect_line(log_text, 7, 80, "NVRM: Xid (PCI:0000:01:00): 13, pid=4711, an error before this process");
	expect_line(log_text, 7, 99, "");
	expect_line("", 7, 0, "");
	expect_line("no record\n;\n1,2;x 7\n", 7, 0, "");
}
END_TEST

START_TEST(a_log_that_may_not_be_read)
{
	char line[20] = "before";

	kernel_log_line("/nowhere/kmsg", 1, 0, line, sizeof(line));
	ck_assert_str_eq(line, "");
}
END_TEST

Suite *route_suite(void);
Suite *route_suite(void)
{
	Suite *suite = suite_create("route");
	TCase *test = tcase_create("route");

	tcase_add_loop_test(test, a_job_goes_on_elsewhere, 0, sizeof(cases) / sizeof(cases[0]));
	tcase_add_test(test, no_job_goes_on_for_ever);
	tcase_add_test(test, tests_of_a_device_come_later_and_later);
	tcase_add_test(test, the_kernels_last_word_about_a_worker);
	tcase_add_test(test, a_log_that_may_not_be_read);
	suite_add_tcase(suite, test);
	return suite;
}

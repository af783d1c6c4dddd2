/* The order of locks is asserted: a program that breaks it ends (tests/lock_order.c, which this one is linked with). */
#include <check.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "daemon/lock.h"

static pthread_mutex_t change, jobs, other_jobs, unknown = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t condition = PTHREAD_COND_INITIALIZER;

/* How a process ends that does this: its exit status, or minus the signal. */
static int end_of(void (*act)(void))
{
	pid_t pid;
	int status = 0;

	pid = fork();
	ck_assert(pid >= 0);
	if (pid == 0) {
		signal(SIGABRT, SIG_DFL);
		lock_init(&change, LOCK_CHANGE);
		lock_init(&jobs, LOCK_JOBS);
		lock_init(&other_jobs, LOCK_JOBS);
		act();
		_exit(0);
	}
	ck_assert_int_eq(waitpid(pid, &status, 0), pid);
	return WIFSIGNALED(status) ? -WTERMSIG(status) : WEXITSTATUS(status);
}

static void in_order(void)
{
	pthread_mutex_lock(&change);
	pthread_mutex_lock(&jobs);
	pthread_mutex_lock(&unknown);
	/* In any order. */
	pthread_mutex_unlock(&change);
	pthread_mutex_unlock(&unknown);
	pthread_mutex_unlock(&jobs);
	pthread_mutex_lock(&change);
	pthread_mutex_unlock(&change);
}

static void against_the_order(void)
{
	pthread_mutex_lock(&jobs);
	pthread_mutex_lock(&change);
}

static void two_of_one_rank(void)
{
	pthread_mutex_lock(&jobs);
	pthread_mutex_lock(&other_jobs);
}

static void under_an_unknown_one(void)
{
	pthread_mutex_lock(&unknown);
	pthread_mutex_lock(&jobs);
}

static void wait_alone(void)
{
	const struct timespec past = {0};

	pthread_mutex_lock(&jobs);
	pthread_cond_timedwait(&condition, &jobs, &past);
	pthread_mutex_unlock(&jobs);
}

static void wait_with_another(void)
{
	const struct timespec past = {0};

	pthread_mutex_lock(&change);
	pthread_mutex_lock(&jobs);
	pthread_cond_timedwait(&condition, &jobs, &past);
}

static void give_back_twice(void)
{
	in_order();
	pthread_mutex_unlock(&jobs);
}

START_TEST(locks_in_order_are_fine)
{
	ck_assert_int_eq(end_of(in_order), 0);
	ck_assert_int_eq(end_of(wait_alone), 0);
}
END_TEST

START_TEST(a_lock_against_the_order_ends_the_program)
{
	ck_assert_int_eq(end_of(against_the_order), -SIGABRT);
	ck_assert_int_eq(end_of(two_of_one_rank), -SIGABRT);
	ck_assert_int_eq(end_of(under_an_unknown_one), -SIGABRT);
	ck_assert_int_eq(end_of(wait_with_another), -SIGABRT);
	ck_assert_int_eq(end_of(give_back_twice), -SIGABRT);
}
END_TEST

Suite *lock_suite(void)
{
	Suite *suite = suite_create("lock");
	TCase *tests = tcase_create("lock");

	tcase_add_test(tests, locks_in_order_are_fine);
	tcase_add_test(tests, a_lock_against_the_order_ends_the_program);
	suite_add_tcase(suite, tests);
	return suite;
}

/* Control groups of both versions, as files that look like the kernel's. */
#include <check.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/host_memory.h"

static char root[64], list[96];

static void make_root(void)
{
	snprintf(root, sizeof(root), "/tmp/cbct-groups-XXXXXX");
	ck_assert_ptr_nonnull(mkdtemp(root));
	snprintf(list, sizeof(list), "%s/list", root);
}

static void remove_root(void)
{
	char command[96];

	snprintf(command, sizeof(command), "rm -rf %s", root);
	ck_assert_int_eq(system(command), 0);
}

static void make_directory(const char *name)
{
	char path[256];

	snprintf(path, sizeof(path), "%s/%s", root, name);
	ck_assert_int_eq(mkdir(path, 0700), 0);
}

static void make_file(const char *name, const char *text)
{
	char path[256];
	FILE *file;

	snprintf(path, sizeof(path), "%s/%s", root, name);
	file = fopen(path, "w");
	ck_assert_ptr_nonnull(file);
	fputs(text, file);
	fclose(file);
}

static void expect(size_t limit, size_t left, unsigned long kills)
{
	struct memory_group group;
	size_t got_limit, got_left;

	memory_group_find(root, list, &group);
	memory_group_bounds(&group, &got_limit, &got_left);
	ck_assert_uint_eq(got_limit, limit);
	ck_assert_uint_eq(got_left, left);
	ck_assert_uint_eq(memory_group_kills(&group), kills);
}

START_TEST(the_second_version_is_read_with_the_groups_above)
{
	make_file("list", "0::/system.slice/cbctd.service\n");
	make_directory("system.slice");
	make_directory("system.slice/cbctd.service");
	make_file("system.slice/cbctd.service/memory.max", "max\n");
	make_file("system.slice/cbctd.service/memory.current", "3000\n");
	make_file("system.slice/cbctd.service/memory.stat", "anon 1000\ninactive_file 900\nactive_file 100\n");
	make_file("system.slice/cbctd.service/memory.events", "low 0\noom 3\noom_kill 2\noom_group_kill 0\n");
	expect(SIZE_MAX, SIZE_MAX, 2);
	make_file("system.slice/cbctd.service/memory.max", "10000\n");
	expect(10000, 8000, 2);
	make_file("system.slice/memory.max", "9000\n");
	make_file("system.slice/memory.current", "8800\n");
	make_file("system.slice/memory.stat", "inactive_file 300\nactive_file 0\n");
	expect(9000, 500, 2);
	make_file("system.slice/memory.current", "99999\n");
	expect(9000, 0, 2);
}
END_TEST

START_TEST(the_first_version_is_read)
{
	make_file("list", "9:name=systemd:/\n4:memory:/docker/abc\n0::/\n");
	make_directory("memory");
	make_directory("memory/docker");
	make_directory("memory/docker/abc");
	make_file("memory/memory.limit_in_bytes", "9223372036854771712\n");
	make_file("memory/docker/memory.limit_in_bytes", "9223372036854771712\n");
	make_file("memory/docker/abc/memory.limit_in_bytes", "5000\n");
	make_file("memory/docker/abc/memory.usage_in_bytes", "4000\n");
	make_file("memory/docker/abc/memory.stat",
		  "inactive_file 1\nactive_file 1\ntotal_inactive_file 1500\ntotal_active_file 500\n");
	make_file("memory/docker/abc/memory.oom_control", "oom_kill_disable 0\nunder_oom 0\noom_kill 7\n");
	expect(5000, 3000, 7);
}
END_TEST

/* A container sees its own group where groups are mounted, and the path of the host in its list. */
START_TEST(a_container_has_what_is_mounted)
{
	make_file("list", "4:memory:/docker/abc\n");
	make_directory("memory");
	make_file("memory/memory.limit_in_bytes", "7000\n");
	make_file("memory/memory.usage_in_bytes", "1000\n");
	make_file("memory/memory.oom_control", "oom_kill 1\n");
	expect(7000, 6000, 1);
}
END_TEST

START_TEST(nothing_is_bounded_without_a_group)
{
	expect(SIZE_MAX, SIZE_MAX, 0);
	make_file("list", "0::/\n");
	expect(SIZE_MAX, SIZE_MAX, 0);
	make_file("list", "nonsense");
	expect(SIZE_MAX, SIZE_MAX, 0);
}
END_TEST

START_TEST(this_machine_has_memory)
{
	struct host_memory host;

	host_memory(&host);
	ck_assert(host.available > 0 && host.available <= host.total);
	ck_assert(host.limit == SIZE_MAX || host.limit == host.total);
}
END_TEST

Suite *host_memory_suite(void)
{
	Suite *suite = suite_create("host_memory");
	TCase *tests = tcase_create("host_memory");

	tcase_add_checked_fixture(tests, make_root, remove_root);
	tcase_add_test(tests, the_second_version_is_read_with_the_groups_above);
	tcase_add_test(tests, the_first_version_is_read);
	tcase_add_test(tests, a_container_has_what_is_mounted);
	tcase_add_test(tests, nothing_is_bounded_without_a_group);
	tcase_add_test(tests, this_machine_has_memory);
	suite_add_tcase(suite, tests);
	return suite;
}

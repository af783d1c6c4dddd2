#ifndef CBCT_CORE_HOST_MEMORY_H
#define CBCT_CORE_HOST_MEMORY_H

#include <stdbool.h>
#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/*
 * Memory of this machine, and the control group (cgroup) of a container or service that bounds it. Version 2 of the
 * kernel's interface and version 1 are both read (Documentation/admin-guide/cgroup-v2.rst, cgroup-v1/memory.rst). Files
 * of the kernel alone are read, which wait for nobody. Any thread.
 */

#define CONTROL_GROUPS "/sys/fs/cgroup"

/* The group that bounds a process's memory. */
struct memory_group {
	char directory[512]; /* "": none is known, and nothing is bounded or counted */
	size_t root_length;  /* of the part of `directory` above which there are no groups */
	bool unified;        /* version 2 */
};

/*
 * groups: where control groups are mounted, CONTROL_GROUPS; list: the process's own list of them, "/proc/PID/cgroup" or
 * "/proc/self/cgroup". In a container the list may name the group by a path outside of it: then what is mounted is
 * taken.
 */
void memory_group_find(const char *groups, const char *list, struct memory_group *ret_group);

/*
 * Bytes that the group and those above it allow, and what of them can be had without swapping, the page cache counted
 * as free. SIZE_MAX each where nothing is bounded.
 */
void memory_group_bounds(const struct memory_group *group, size_t *ret_limit, size_t *ret_left);

/* Processes of the group that the kernel has killed for want of memory; 0 where it does not count them. */
unsigned long memory_group_kills(const struct memory_group *group);

struct host_memory {
	size_t total;     /* bytes of the machine, or the limit of this process's group where that is less */
	size_t available; /* of them, without swapping, the page cache counted as free */
	size_t limit;     /* of the group; SIZE_MAX: none, or more than the machine has */
};
void host_memory(struct host_memory *ret_memory);

#ifdef __cplusplus
}
#endif

#endif

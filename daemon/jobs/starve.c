/*
 * Workers that the kernel ends for want of memory, of the machine or of the control group that they are in. Such an end
 * looks like any kill from outside. The kernel's log names the process where it may be read; a hardened service may not
 * read it, but the group counts such kills, and one that came since explains one worker that was killed.
 */
#include <stdio.h>
#include <string.h>

#include "daemon/jobs/kernel_log.h"
#include "daemon/jobs/workers.h"

void starve_begin(struct worker *worker)
{
	char list[32];

	snprintf(list, sizeof(list), "/proc/%ld/cgroup", (long)worker->child.process.pid);
	memory_group_find(CONTROL_GROUPS, list, &worker->group);
	worker->kills = memory_group_kills(&worker->group);
	worker->starved = false;
}

/* A kill that explains this worker's end explains no other's. */
static void take_kill(struct supervise *supervise, const struct worker *worker)
{
	for (int i = 0; i < supervise->count; i++) {
		struct worker *other = &supervise->workers[i];

		if (strcmp(other->group.directory, worker->group.directory) == 0)
			other->kills++;
	}
}

size_t starve_limit(const struct worker *worker)
{
	struct host_memory host;
	size_t limit, left;

	memory_group_bounds(&worker->group, &limit, &left);
	host_memory(&host);
	return limit > host.total ? 0 : limit;
}

bool starve_ended(struct supervise *supervise, struct worker *worker, char *how, size_t size)
{
	static const char killed[] = "signal 9 ";
	const bool counted = memory_group_kills(&worker->group) > worker->kills;
	const size_t limit = starve_limit(worker), length = strlen(how);
	char line[240];

	/* A worker that the daemon itself has killed hung, or did not heed it. */
	if (worker->remote || worker->killed[0] != '\0' || strncmp(how, killed, strlen(killed)) != 0)
		return false;
	kernel_log_line(KERNEL_LOG, worker->child.process.pid, worker->born, line, sizeof(line));
	worker->starved = counted || strstr(line, "ut of memory") != NULL;
	if (!worker->starved)
		return false;
	if (counted)
		take_kill(supervise, worker);
	if (limit > 0)
		snprintf(how + length, size - length,
			 " by the kernel for want of memory; its control group allows %zu MiB", limit >> 20);
	else
		snprintf(how + length, size - length, " by the kernel for want of memory");
	return true;
}

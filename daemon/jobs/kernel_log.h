#ifndef CBCT_DAEMON_JOBS_KERNEL_LOG_H
#define CBCT_DAEMON_JOBS_KERNEL_LOG_H

#include <stddef.h>
#include <sys/types.h>

#define KERNEL_LOG "/dev/kmsg"

/*
 * The last line of the kernel's log (Documentation/ABI/testing/dev-kmsg) since `since` (s of CLOCK_MONOTONIC) that is
 * about process `pid` or about a graphics driver: out of memory, a segmentation fault, "NVRM: Xid". "" where there is
 * none, or where the log may not be read. Any thread; reads memory of the kernel alone.
 */
void kernel_log_line(const char *path, pid_t pid, double since, char *ret_line, size_t size);

#endif

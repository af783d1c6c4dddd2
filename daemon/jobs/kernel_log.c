/* Lines of the kernel's log: kernel_log.h. A record is "PRIORITY,NUMBER,MICROSECONDS,FLAGS;TEXT". */
#include "daemon/jobs/kernel_log.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { RECORD_MAX = 8192, RECORDS_MAX = 100000 };

/* The number stands alone: "process 123 (", "[123]", "pid=123,". */
static bool has_number(const char *text, const char *number)
{
	const size_t length = strlen(number);

	for (const char *at = strstr(text, number); at != NULL; at = strstr(at + 1, number)) {
		bool before = at > text && at[-1] >= '0' && at[-1] <= '9';
		bool after = at[length] >= '0' && at[length] <= '9';

		if (!before && !after)
			return true;
	}
	return false;
}

static bool is_about(const char *text, pid_t pid)
{
	static const char *const drivers[] = {"NVRM", "Xid", "nvidia"};
	char number[24];

	for (size_t i = 0; i < sizeof(drivers) / sizeof(drivers[0]); i++) {
		if (strstr(text, drivers[i]) != NULL)
			return true;
	}
	snprintf(number, sizeof(number), "%ld", (long)pid);
	return pid > 0 && has_number(text, number);
}

/* Takes one line into ret_line where it is wanted. */
static void look_at(char *line, pid_t pid, double since, char *ret_line, size_t size)
{
	char *text = strchr(line, ';');
	unsigned long long microseconds;

	if (text == NULL || sscanf(line, "%*u,%*u,%llu", &microseconds) != 1 || (double)microseconds * 1e-6 < since)
		return;
	*text++ = '\0';
	if (is_about(text, pid))
		snprintf(ret_line, size, "%s", text);
}

void kernel_log_line(const char *path, pid_t pid, double since, char *ret_line, size_t size)
{
	char record[RECORD_MAX + 1];
	int file = open(path, O_RDONLY | O_NONBLOCK | O_CLOEXEC);

	ret_line[0] = '\0';
	for (int i = 0; file >= 0 && i < RECORDS_MAX; i++) {
		ssize_t got = read(file, record, RECORD_MAX);
		char *rest = record;

		/* EPIPE: records were overwritten meanwhile, the next read goes on behind them. */
		if (got < 0 && (errno == EPIPE || errno == EINTR))
			continue;
		if (got <= 0)
			break;
		record[got] = '\0';
		for (char *line = strtok_r(rest, "\n", &rest); line != NULL; line = strtok_r(NULL, "\n", &rest))
			look_at(line, pid, since, ret_line, size);
	}
	if (file >= 0)
		close(file);
}

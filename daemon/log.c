/* Log lines on standard error: log.h. */
#include "daemon/log.h"

#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "core/error.h"
#include "proto/clock.h"

const char *const log_level_names[LEVEL_COUNT] = {"error", "warning", "info", "debug"};
/* sd-daemon(3): what the journal takes as a priority. */
static const char *const journal_prefixes[LEVEL_COUNT] = {"<3>", "<4>", "<6>", "<7>"};

static _Atomic int level_now = LEVEL_INFO;

void log_set_level(enum log_level level)
{
	atomic_store(&level_now, (int)level);
}

static size_t write_prefix(enum log_level level, char *ret_text, size_t size)
{
	char now[CLOCK_TEXT_SIZE];

	/* The journal has its own clock. */
	if (getenv("JOURNAL_STREAM") != NULL)
		return (size_t)snprintf(ret_text, size, "%s", journal_prefixes[level]);
	clock_text(clock_realtime(), now);
	return (size_t)snprintf(ret_text, size, "%s %s: ", now, log_level_names[level]);
}

void log_line(enum log_level level, const char *format, ...)
{
	char line[1200];
	size_t start, length;
	va_list args;
	int wanted;

	if ((int)level > atomic_load(&level_now))
		return;
	start = write_prefix(level, line, 64);
	va_start(args, format);
	wanted = vsnprintf(line + start, sizeof(line) - start - 1, format, args);
	va_end(args);
	if (wanted < 0)
		return;
	length = start + (size_t)wanted;
	if (length > sizeof(line) - 2)
		length = sizeof(line) - 2;
	for (size_t i = start; i < length; i++) {
		if ((unsigned char)line[i] < 0x20 || line[i] == 0x7f)
			line[i] = '?';
	}
	line[length++] = '\n';
	/* One write, so that lines of several threads and processes do not mix; a log that is gone cannot be reported.
	 */
	if (write(STDERR_FILENO, line, length) < 0)
		return;
}

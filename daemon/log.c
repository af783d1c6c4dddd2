/* Log lines: log.h. */
#include "daemon/log.h"

#include <stdarg.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include "core/error.h"
#include "daemon/id.h"
#include "proto/clock.h"
#include "proto/json.h"

const char *const log_level_names[LEVEL_COUNT] = {"error", "warning", "info", "debug"};
const char *const log_format_names[LOG_FORMAT_COUNT] = {"auto", "text", "json", "journal"};
/* syslog(3): what the journal takes as a priority. */
static const int priorities[LEVEL_COUNT] = {3, 4, 6, 7};

enum { LINE_BYTES = 1200 };

static _Atomic int level_now = LEVEL_INFO;
static enum log_format format_now = LOG_TEXT; /* constant once there are threads, as are the next three */
static bool read_by_journal;
static int journal_socket = -1;
static struct sockaddr_un journal;
static _Thread_local const char *request_now, *trace_now;

void log_set_level(enum log_level level)
{
	atomic_store(&level_now, (int)level);
}

void log_set_request(const char *id, const char *trace)
{
	request_now = id;
	trace_now = trace;
}

/* systemd.exec(5): JOURNAL_STREAM has device and inode of what it has connected; a pipe behind it is none. */
static bool is_journal(int file)
{
	const char *stream = getenv("JOURNAL_STREAM");
	unsigned long long device, inode;
	struct stat status;

	return stream != NULL && sscanf(stream, "%llu:%llu", &device, &inode) == 2 && fstat(file, &status) == 0 &&
	       (unsigned long long)status.st_dev == device && (unsigned long long)status.st_ino == inode;
}

void log_set_format(enum log_format format, const char *path)
{
	read_by_journal = is_journal(STDERR_FILENO);
	if (format == LOG_AUTO)
		format = read_by_journal ? LOG_JOURNAL : LOG_TEXT;
	if (format == LOG_JOURNAL && journal_socket < 0) {
		journal.sun_family = AF_UNIX;
		snprintf(journal.sun_path, sizeof(journal.sun_path), "%s",
			 path != NULL ? path : "/run/systemd/journal/socket");
		journal_socket = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
	}
	format_now = format;
}

/* ---- what a line is about ---- */

struct fact {
	const char *name;
	char value[ID_SIZE];
};

/* "job ID" at the beginning of the text, and what else there is of that form. */
static bool read_subject(const char *text, struct fact *ret_fact)
{
	static const struct {
		const char *name;
		bool is_id; /* otherwise a number */
	} subjects[] = {{"job", true}, {"scan", true}, {"calibration", true}, {"worker", false}};

	for (size_t i = 0; i < sizeof(subjects) / sizeof(*subjects); i++) {
		size_t name = strlen(subjects[i].name), length;

		if (strncmp(text, subjects[i].name, name) != 0 || text[name] != ' ')
			continue;
		text += name + 1;
		length = strcspn(text, " :,");
		if (length == 0 || length >= sizeof(ret_fact->value))
			return false;
		ret_fact->name = subjects[i].name;
		snprintf(ret_fact->value, sizeof(ret_fact->value), "%.*s", (int)length, text);
		return subjects[i].is_id ? id_valid(ret_fact->value) : strspn(ret_fact->value, "0123456789") == length;
	}
	return false;
}

/* ---- the forms ---- */

static void write_text(enum log_level level, const char *text)
{
	char line[LINE_BYTES + 160], now[CLOCK_TEXT_SIZE];
	int length;

	clock_text(clock_realtime(), now);
	if (read_by_journal) /* which has its own clock */
		length = snprintf(line, sizeof(line), "<%d>%s", priorities[level], text);
	else
		length = snprintf(line, sizeof(line), "%s %s: %s", now, log_level_names[level], text);
	if (request_now != NULL && strncmp(text, "request ", 8) != 0)
		length += snprintf(line + length, sizeof(line) - (size_t)length, " request=%s", request_now);
	line[length++] = '\n';
	/* One write, so that lines of several threads and processes do not mix; a log that is gone cannot be reported.
	 */
	if (write(STDERR_FILENO, line, (size_t)length) < 0)
		return;
}

/* False when memory has run out. */
static bool write_json(enum log_level level, const char *text)
{
	bool missing = json_set_missing(false); /* of a tree in whose midst this line is written */
	cJSON *line = cJSON_CreateObject();
	char now[CLOCK_TEXT_SIZE], *printed;
	struct fact subject;
	size_t length = 0;

	clock_text(clock_realtime(), now);
	cJSON_AddStringToObject(line, "time", now);
	cJSON_AddStringToObject(line, "level", log_level_names[level]);
	cJSON_AddStringToObject(line, "message", text);
	if (request_now != NULL)
		cJSON_AddStringToObject(line, "request", request_now);
	if (request_now != NULL && trace_now[0] != '\0')
		cJSON_AddStringToObject(line, "trace", trace_now);
	if (read_subject(text, &subject))
		cJSON_AddStringToObject(line, subject.name, subject.value);
	printed = json_print(line, &length);
	cJSON_Delete(line);
	json_set_missing(missing);
	if (printed == NULL)
		return false;
	printed[length] = '\n'; /* in place of the zero byte */
	if (write(STDERR_FILENO, printed, length + 1) < 0)
		length = 0; /* a log that is gone cannot be reported */
	free(printed);
	return true;
}

static size_t put_field(char *fields, size_t size, size_t length, const char *prefix, const char *name,
			const char *value)
{
	size_t start = length + strlen(prefix);

	length += (size_t)snprintf(fields + length, size - length, "%s%s=%s\n", prefix, name, value);
	for (size_t i = start; i < length && fields[i] != '='; i++) {
		if (fields[i] >= 'a' && fields[i] <= 'z')
			fields[i] = (char)(fields[i] - 'a' + 'A');
	}
	return length;
}

/* The journal's native protocol: a datagram of lines NAME=VALUE. False when nobody takes it. */
static bool write_journal(enum log_level level, const char *text)
{
	char fields[LINE_BYTES + 512], number[8];
	struct fact subject;
	size_t length;

	snprintf(number, sizeof(number), "%d", priorities[level]);
	length = put_field(fields, sizeof(fields), 0, "", "MESSAGE", text);
	length = put_field(fields, sizeof(fields), length, "", "PRIORITY", number);
	length = put_field(fields, sizeof(fields), length, "", "SYSLOG_IDENTIFIER", "cbctd");
	if (request_now != NULL)
		length = put_field(fields, sizeof(fields), length, "CBCT_", "REQUEST", request_now);
	if (request_now != NULL && trace_now[0] != '\0')
		length = put_field(fields, sizeof(fields), length, "CBCT_", "TRACE", trace_now);
	if (read_subject(text, &subject))
		length = put_field(fields, sizeof(fields), length, "CBCT_", subject.name, subject.value);
	return sendto(journal_socket, fields, length, MSG_NOSIGNAL, (const struct sockaddr *)&journal,
		      sizeof(journal)) == (ssize_t)length;
}

void log_line(enum log_level level, const char *format, ...)
{
	char text[LINE_BYTES];
	va_list args;

	if ((int)level > atomic_load(&level_now))
		return;
	va_start(args, format);
	if (vsnprintf(text, sizeof(text), format, args) < 0)
		text[0] = '\0';
	va_end(args);
	for (char *c = text; *c != '\0'; c++) {
		if ((unsigned char)*c < 0x20 || *c == 0x7f)
			*c = '?';
	}
	if (format_now == LOG_JSON && write_json(level, text))
		return;
	if (format_now == LOG_JOURNAL && write_journal(level, text))
		return;
	write_text(level, text);
}

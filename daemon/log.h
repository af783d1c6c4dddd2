#ifndef CBCT_DAEMON_LOG_H
#define CBCT_DAEMON_LOG_H

/*
 * One line for each thing that an operator should know. Only the daemon logs. Any thread; a line is written in one
 * piece.
 *
 *   text     on standard error, with the time, or with systemd's level prefix where the journal reads it
 *   json     on standard error, an object a line: time, level, message, and where they apply request, trace, job, scan,
 *            calibration, worker
 *   journal  to the journal's socket, with the same as fields: MESSAGE, PRIORITY, CBCT_REQUEST, CBCT_TRACE, CBCT_JOB
 * ... auto     journal where standard error goes there, else text
 *
 * What a line is about stands at its beginning: "job ID: ...", "worker 0 ended ..."; that is read from there. The
 * request is the one that the thread serves.
 */
enum log_level { LEVEL_ERROR, LEVEL_WARNING, LEVEL_INFO, LEVEL_DEBUG, LEVEL_COUNT };
extern const char *const log_level_names[LEVEL_COUNT]; /* "error", "warning", "info", "debug" */
enum log_format { LOG_AUTO, LOG_TEXT, LOG_JSON, LOG_JOURNAL, LOG_FORMAT_COUNT };
extern const char *const log_format_names[LOG_FORMAT_COUNT];

/* Lines above this level are dropped; LEVEL_INFO at first. */
void log_set_level(enum log_level level);
/* LOG_TEXT at first. journal: path of the journal's socket, NULL: systemd's. Once, before there are threads. */
void log_set_format(enum log_format format, const char *journal);

/*
 * Lines of this thread are about that request, until it is NULL. Both texts are the caller's and are read at each
 * line; the trace is "" without one.
 */
void log_set_request(const char *id, const char *trace);

/* No newline at the end; control characters (a client's names) are written as '?'. */
void log_line(enum log_level level, const char *format, ...) __attribute__((format(printf, 2, 3)));

#endif

#ifndef CBCT_DAEMON_LOG_H
#define CBCT_DAEMON_LOG_H

/*
 * One line for each thing that an operator should know, on standard error;
 * with systemd's level prefix where the journal reads it. Only the daemon and
 * the worker's main log. Any thread; a line is written in one piece.
 */
enum log_level { LEVEL_ERROR, LEVEL_WARNING, LEVEL_INFO, LEVEL_DEBUG, LEVEL_COUNT };
extern const char *const log_level_names[LEVEL_COUNT]; /* "error", "warning", "info", "debug" */

/* Lines above this level are dropped; LEVEL_INFO at first. */
void log_set_level(enum log_level level);

/* No newline at the end; control characters (a client's names) are written as '?'. */
void log_line(enum log_level level, const char *format, ...) __attribute__((format(printf, 2, 3)));

#endif

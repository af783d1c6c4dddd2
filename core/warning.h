#ifndef CBCT_CORE_WARNING_H
#define CBCT_CORE_WARNING_H

#include <stdbool.h>

/*
 * Every warning that a scan or a job may carry: one row for each code. Where a
 * warning arises, the program gives the code and a technical detail with the
 * numbers; how serious the fact is and the plain sentence for a clinician stand
 * here, once. Adding a warning: one row in warning.c, and its code in
 * proto/openapi.yaml.
 */
enum severity {
	SEVERITY_INFO,    /* how the data were treated; the image is as good as it can be */
	SEVERITY_CAUTION, /* part of the image is uncertain, or the scan is not what it could be */
	SEVERITY_SERIOUS, /* the image may be wrong: not to be relied on before somebody has looked at the cause */
	SEVERITY_COUNT
};
extern const char *const severity_names[SEVERITY_COUNT]; /* "info", "caution", "serious" */

struct warning_kind {
	const char *code;
	enum severity severity;
	const char *summary; /* one plain sentence */
};

/* Ends with a row whose code is NULL. */
extern const struct warning_kind warning_kinds[];

/*
 * The row of a code. A code without a row, which a catalogue written by another
 * version of the program may hold, gets a row of caution with a general sentence;
 * never NULL.
 */
const struct warning_kind *warning_kind(const char *code);
/* True if the code has a row; every code that this program emits must have one. */
bool warning_is_known(const char *code);

/* The receiver of a reconstruction's warnings, called in the thread that runs the reconstruction. */
struct warning_sink {
	void *context;
	void (*tell)(void *context, const char *code, const char *detail); /* NULL: nobody */
};
/* A code of the table, and the technical detail, which is cut off at 319 characters. */
__attribute__((format(printf, 3, 4))) void warning_tell(const struct warning_sink *sink, const char *code,
							const char *format, ...);

#endif

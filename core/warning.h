#ifndef CBCT_CORE_WARNING_H
#define CBCT_CORE_WARNING_H

#include <stdbool.h>
#include <stddef.h>

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
/*
 * The projections that a warning is about. In the text that `tell` gets they stand behind the detail and a tab; whoever
 * shows or keeps a warning takes it apart with warning_parse.
 */
enum { WARNING_RANGES_MOST = 24 };
struct warning_views {
	int count;                                 /* of all of them; 0: the warning has no list */
	int left_out, mended;                      /* of these: not in the image; made whole again, and in it */
	int ranges, range[WARNING_RANGES_MOST][2]; /* first and last, rising; those that do not fit are only counted */
};
/* Adds a projection to the list, the next one in rising order. */
void warning_views_add(struct warning_views *views, int projection);
enum { WARNING_DETAIL_SIZE = 448, WARNING_TEXT_SIZE = 640 };
void warning_parse(const char *text, char ret_detail[WARNING_DETAIL_SIZE], struct warning_views *ret_views);
/* "7 to 10, 12 and 3 more"; "" where there are none. */
void warning_views_describe(const struct warning_views *views, char *ret, size_t size);

/* The same as warning_tell, with a list. */
__attribute__((format(printf, 4, 5))) void warning_tell_views(const struct warning_sink *sink, const char *code,
							      const struct warning_views *views, const char *format,
							      ...);
/* A code of the table, and the technical detail, which is cut off at 319 characters. */
__attribute__((format(printf, 3, 4))) void warning_tell(const struct warning_sink *sink, const char *code,
							const char *format, ...);

#endif

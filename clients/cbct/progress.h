#ifndef CBCT_CLIENTS_PROGRESS_H
#define CBCT_CLIENTS_PROGRESS_H

#include <stdio.h>

/*
 * How far something is: a bar that is drawn over and over on a terminal;
 * elsewhere a plain line whenever the words change, or nothing.
 */
struct progress;
enum progress_style { PROGRESS_BAR_ONLY, PROGRESS_OR_LINES };

/* Never fails: without memory it is NULL, and nothing is shown. */
struct progress *progress_new(FILE *to, enum progress_style style, const char *label);
/* fraction 0..1; seconds_left < 0: guessed from the time so far. */
void progress_show(struct progress *progress, double fraction, double seconds_left, const char *format, ...)
    __attribute__((format(printf, 4, 5)));
/* Takes the bar off the line, so that something else can be printed there. */
void progress_clear(struct progress *progress);
/* Leaves the last bar standing. */
void progress_free(struct progress *progress);

#endif

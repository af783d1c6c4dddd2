/* Progress bars and lines: see progress.h. */
#include "clients/cbct/progress.h"

#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "proto/clock.h"

enum { BAR_CELLS = 24 };

struct progress {
	FILE *to;
	const char *label;
	bool terminal, lines, drawn;
	char text[160];
	double started, shown; /* s */
};

struct progress *progress_new(FILE *to, enum progress_style style, const char *label)
{
	struct progress *progress = calloc(1, sizeof(*progress));

	if (progress == NULL)
		return NULL;
	progress->to = to;
	progress->label = label;
	progress->terminal = isatty(fileno(to)) == 1;
	progress->lines = style == PROGRESS_OR_LINES;
	progress->started = clock_monotonic();
	return progress;
}

/* "1:05", or nothing when it cannot be known. */
static void time_text(double seconds, char *ret, size_t size)
{
	long whole = (long)(seconds + 0.5);

	if (!(seconds >= 0) || seconds > 1e7)
		ret[0] = 0;
	else if (whole >= 3600)
		snprintf(ret, size, "%ld:%02ld:%02ld left", whole / 3600, whole / 60 % 60, whole % 60);
	else
		snprintf(ret, size, "%ld:%02ld left", whole / 60, whole % 60);
}

static void draw(struct progress *progress, double fraction, const char *left)
{
	static const char full[] = "########################", none[] = "........................";
	int cells = (int)(fraction * BAR_CELLS + 0.5);

	fprintf(progress->to, "\r%s [%.*s%.*s] %3.0f %%  %s  %s\033[K", progress->label, cells, full, BAR_CELLS - cells,
		none, floor(100 * fraction), progress->text, left);
	fflush(progress->to);
	progress->drawn = true;
}

void progress_show(struct progress *progress, double fraction, double seconds_left, const char *format, ...)
{
	char text[sizeof(progress->text)], left[40];
	double time = clock_monotonic();
	bool changed;
	va_list args;

	if (progress == NULL)
		return;
	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	changed = strcmp(text, progress->text) != 0;
	memcpy(progress->text, text, sizeof(text));
	fraction = fmin(fmax(fraction, 0), 1);
	if (seconds_left < 0 && fraction > 0.01)
		seconds_left = (time - progress->started) * (1 - fraction) / fraction;
	time_text(fraction < 1 ? seconds_left : -1, left, sizeof(left));
	if (progress->terminal) {
		/* Ten times a second is enough for eyes. */
		if (time - progress->shown >= 0.1 || fraction == 1) {
			progress->shown = time;
			draw(progress, fraction, left);
		}
	} else if (progress->lines && changed) {
		fprintf(progress->to, "%s %3.0f %%  %s%s%s\n", progress->label, floor(100 * fraction), text,
			left[0] != 0 ? "  " : "", left);
		fflush(progress->to);
	}
}

void progress_clear(struct progress *progress)
{
	if (progress == NULL || !progress->drawn)
		return;
	fputs("\r\033[K", progress->to);
	fflush(progress->to);
	progress->drawn = false;
}

void progress_free(struct progress *progress)
{
	if (progress == NULL)
		return;
	if (progress->drawn)
		fputc('\n', progress->to);
	free(progress);
}

/* cbct fit-hardening: water's polynomial of beam hardening from a step wedge, or from rays through a bottle. */
#include <math.h>
#include <stdlib.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/fit.h"
#include "clients/cbct/numbers.h"
#include "core/fit/hardening.h"

struct fit_hardening_options {
	const char *points, *output;
	long degree;
	double attenuation;
};

#define ROW(name, letter, kind, member, argument, help, least, most)                                                   \
	{                                                                                                              \
		name, letter, kind, offsetof(struct fit_hardening_options, member), argument, help, least, most, 0,    \
		    NULL                                                                                               \
	}
static const struct option rows[] = {
    ROW("degree", 0, OPTION_INTEGER, degree, "N", "of the polynomial", 1, HARDENING_MOST - 1),
    ROW("attenuation", 0, OPTION_NUMBER, attenuation, "MU",
	"of water in 1/mm, which the corrected line integrals shall have; by default what the shortest steps have",
	1e-6, 1),
    ROW("output", 'o', OPTION_TEXT, output, "FILE",
	"the member \"beam_hardening\" of a scan's projections as JSON, - for standard output", 0, 0),
    {0},
};
static const struct option_group groups[] = {{"options", rows, 0}, {0}};

static int points_read(const char *path, struct hardening_point **ret_points, int *ret_count, struct error *err)
{
	struct hardening_point *points;
	double *numbers = NULL;
	size_t count;
	int code = numbers_read(path, &numbers, &count, err);

	if (code != 0)
		return code;
	points = malloc((count / 2 + 1) * sizeof(*points));
	if (points == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %zu points", count / 2);
	else if (count % 2 != 0 || count == 0)
		code = error_set(err, ERR_INVALID,
				 "%.160s: %zu numbers; a length in mm and a line integral for each step are expected",
				 path, count);
	for (size_t i = 0; i < count / 2 && code == 0; i++)
		points[i] = (struct hardening_point){numbers[2 * i], numbers[2 * i + 1]};
	free(numbers);
	if (code != 0) {
		free(points);
		return code;
	}
	*ret_points = points;
	*ret_count = (int)(count / 2);
	return 0;
}

static int fit_hardening_run(const void *values, struct error *err)
{
	const struct fit_hardening_options *options = values;
	struct hardening_point *points = NULL;
	struct hardening_fit fit;
	int count, code = points_read(options->points, &points, &count, err);

	if (code == 0)
		code = hardening_fit(points, count, (int)options->degree,
				     isnan(options->attenuation) ? 0 : options->attenuation, &fit, err);
	if (code == 0) {
		fprintf(
		    stderr,
		    "%d points, attenuation %.5g/mm; line integrals are off by %.3g (root mean square), %.3g without "
		    "the polynomial\n",
		    count, fit.attenuation, fit.rms, fit.rms_without);
		code = fit_write(options->output, "beam_hardening",
				 cJSON_CreateDoubleArray(fit.coefficients, fit.count), err);
	}
	free(points);
	return code;
}

static const struct fit_hardening_options defaults = {.output = "-", .degree = 3, .attenuation = OPTION_UNSET_NUMBER};
static const struct positional positionals[] = {{"POINTS",
						 "a text file with a line for each step of a wedge, or each ray "
						 "through a bottle of water: millimetres of water (of a "
						 "ray its chord, 2 sqrt(r^2 - d^2) at a distance d from the bottle's "
						 "axis), and the line integral measured behind it",
						 offsetof(struct fit_hardening_options, points), true},
						{0}};

const struct command command_fit_hardening = {
    "fit-hardening",  "water's polynomial of beam hardening from a step wedge or a bottle",
    positionals,      groups,
    &defaults,        sizeof(defaults),
    fit_hardening_run};

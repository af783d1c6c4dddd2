/*
 * What the check of the geometry (core/refine/agreement.h) says of scans whose geometry is known: heads, truncated
 * abdomens, knees with screws, heads with a neck, even cylinders and hands, of ellipsoids, cylinders and boxes with
 * exact line integrals, against a geometry that fits and against others. `make bench-agreement` builds and runs it;
 * tests/bench/results/agreement.txt has a table of bodies of the same kinds. Arguments: the first seed and how many.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/refine/agreement.h"
#include "tests/bench/bodies.h"
#include "tests/unit/arm.h"

enum { COLUMNS = 77, ROWS = 60 };
static const double PIXEL = 4.928; /* mm */

/* ---- scans ---- */

static const struct {
	double arc;
	int views;
} sweeps[] = {{200, 120}, {360, 90}, {210, 80}, {195, 100}, {360, 64}};

/* How the geometry that the scan is given departs from the one that it was taken with. */
static const struct departure {
	const char *name;
	double photons;                  /* in a bin of the open beam; 0: no noise */
	double sag, jitter, aside, lift; /* aside: mm on the detector; lift: mm, behind the middle view */
	bool backwards;
} departures[] = {
    {"fits, no noise", 0, 0, 0, 0, 0, false},           {"fits", 2e4, 0, 0, 0, 0, false},
    {"fits, much noise", 2e3, 0, 0, 0, 0, false},       {"a tenth of the sag", 2e4, .1, 0, 0, 0, false},
    {"a third of the sag", 2e4, .3, 0, 0, 0, false},    {"the sag", 2e4, 1, 0, 0, 0, false},
    {"jitter of .15 mm", 2e4, 1e-9, .15, 0, 0, false},  {"jitter of .5 mm", 2e4, 1e-9, .5, 0, 0, false},
    {"detector aside, .56 mm", 2e4, 0, 0, 1, 0, false}, {"detector aside, 1.7 mm", 2e4, 0, 0, 3, 0, false},
    {"detector rises by 3 mm", 2e4, 0, 0, 0, 3, false}, {"the other way round", 2e4, 0, 0, 0, 0, true},
};
enum { DEPARTURES = sizeof(departures) / sizeof(departures[0]) };

static struct view said_view(const struct departure *departure, struct arm arm, int k)
{
	const double passed = (k - arm.count / 2) / (.1 * arm.count);
	struct view view;

	arm.sag = departure->sag;
	arm.jitter = departure->jitter;
	if (departure->backwards)
		arm.step = -arm.step;
	view = arm_view(&arm, k);
	for (int a = 0; a < 3; a++)
		view.pixel0[a] += departure->aside * view.column_step[a] / PIXEL;
	view.pixel0[2] += departure->lift * 1100 / 620 * fmin(1, fmax(0, passed));
	return view;
}

static int check(const struct departure *departure, const struct arm *arm, const float *pictures, int seed,
		 struct agreement *ret_agreement, enum agreement_grade *ret_grade, struct error *err)
{
	const size_t pixels = (size_t)COLUMNS * ROWS;
	struct view *views = malloc((size_t)arm->count * sizeof(*views));
	float *picture = malloc(pixels * sizeof(*picture));
	struct geometry geometry = {0};
	struct orbit orbit = {0};
	struct reduced reduced = {0};
	int code = views == NULL || picture == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a scan") : 0;

	for (int k = 0; k < arm->count && code == 0; k++)
		views[k] = said_view(departure, *arm, k);
	if (code == 0)
		code = geometry_views(&geometry, COLUMNS, ROWS, arm->count, views, err);
	if (code == 0)
		code = orbit_analyse(&orbit, &geometry, err);
	if (code == 0)
		code = reduced_open(&reduced, &geometry, &orbit, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST, err);
	random_seed((uint64_t)seed);
	for (int k = 0; k < arm->count && code == 0; k++) {
		memcpy(picture, pictures + (size_t)k * pixels, pixels * sizeof(*picture));
		for (size_t i = 0; i < pixels && departure->photons > 0; i++) {
			const double mean = departure->photons * exp(-(double)picture[i]);

			picture[i] = (float)-log(fmax(.5, mean + sqrt(mean) * normal()) / departure->photons);
		}
		if (reduced_wants(&reduced, k))
			reduced_take(&reduced, k, picture);
	}
	if (code == 0)
		code = agreement_measure(&reduced, NULL, ret_agreement, err);
	if (code == 0)
		*ret_grade = agreement_grade(ret_agreement, reduced_bin(&reduced, &orbit));
	reduced_clear(&reduced);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	free(views);
	free(picture);
	return code;
}

static int compare(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

/* All departures of one scan: the mm found, and its grade. */
static int measure(enum kind kind, int seed, double ret_mm[DEPARTURES], int ret_grade[DEPARTURES], struct error *err)
{
	const int sweep = (seed + (int)kind) % (int)(sizeof(sweeps) / sizeof(sweeps[0])), views = sweeps[sweep].views;
	const struct arm arm = {.columns = COLUMNS,
				.rows = ROWS,
				.count = views,
				.pixel = PIXEL,
				.first = .3 + seed,
				.step = sweeps[sweep].arc * M_PI / 180 / (sweeps[sweep].arc < 360 ? views - 1 : views),
				.seed = (unsigned)seed};
	float *pictures = malloc((size_t)views * COLUMNS * ROWS * sizeof(*pictures));
	struct body body;
	int code = pictures == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %d views", views) : 0;

	make_body(&body, kind, seed);
	for (int k = 0; k < views && code == 0; k++) {
		const struct view view = arm_view(&arm, k);

		body_take(&body, &view, COLUMNS, ROWS, pictures + (size_t)k * COLUMNS * ROWS);
	}
	for (int d = 0; d < DEPARTURES && code == 0; d++) {
		struct agreement agreement;
		enum agreement_grade grade = AGREEMENT_GOOD;

		code = check(&departures[d], &arm, pictures, seed, &agreement, &grade, err);
		if (code < 0)
			break;
		ret_mm[d] = agreement.mm;
		ret_grade[d] = (int)grade;
		agreement_clear(&agreement);
	}
	free(pictures);
	return code;
}

int main(int argc, char **argv)
{
	enum { SEEDS_MOST = 64 };
	const int first = argc > 1 ? atoi(argv[1]) : 1, seeds = argc > 2 ? atoi(argv[2]) : 4;
	double mm[DEPARTURES][KINDS][SEEDS_MOST];
	int told[DEPARTURES][KINDS][2] = {{{0}}};

	if (seeds < 1 || seeds > SEEDS_MOST)
		return EXIT_FAILURE;
	for (int kind = 0; kind < KINDS; kind++)
		for (int i = 0; i < seeds; i++) {
			double found[DEPARTURES];
			int grades[DEPARTURES];
			struct error err;

			if (measure((enum kind)kind, first + i, found, grades, &err) < 0) {
				fprintf(stderr, "%s\n", err.text);
				return EXIT_FAILURE;
			}
			for (int d = 0; d < DEPARTURES; d++) {
				mm[d][kind][i] = found[d];
				told[d][kind][0] += grades[d] == AGREEMENT_DOUBTFUL;
				told[d][kind][1] += grades[d] == AGREEMENT_WRONG;
			}
		}
	printf("%d scans of each; median mm, told doubtful + wrong\n%-24s", seeds, "");
	for (int kind = 0; kind < KINDS; kind++)
		printf("%20s", kind_names[kind]);
	for (int d = 0; d < DEPARTURES; d++) {
		printf("\n%-24s", departures[d].name);
		for (int kind = 0; kind < KINDS; kind++) {
			qsort(mm[d][kind], (size_t)seeds, sizeof(double), compare);
			printf("%10.3f %3d + %3d", mm[d][kind][seeds / 2], told[d][kind][0], told[d][kind][1]);
		}
	}
	puts("");
	return EXIT_SUCCESS;
}

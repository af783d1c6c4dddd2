/*
 * What the check of the geometry (core/refine/agreement.h) says of scans whose geometry is known: heads, truncated
 * abdomens, knees with screws, heads with a neck, even cylinders and hands, of ellipsoids, cylinders and boxes with
 * exact line integrals, against a geometry that fits and against others. `make bench-agreement` builds and runs it;
 * tests/bench/results/agreement.txt has a table of bodies of the same kinds. Arguments: the first seed and how many.
 * With `right` behind these: false alarms, one scan a seed whose geometry is exact, of bodies, boards, metal,
 * detectors, sweeps and doses that are drawn.
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

/* The views of a geometry that the scan is given, with noise, where photons is not 0. */
static int check(const struct geometry *said, double photons, const float *pictures, int seed,
		 struct agreement *ret_agreement, enum agreement_grade *ret_grade, struct error *err)
{
	const size_t pixels = (size_t)said->columns * (size_t)said->rows;
	float *picture = malloc(pixels * sizeof(*picture));
	struct orbit orbit = {0};
	struct reduced reduced = {0};
	int code = picture == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a view") : 0;

	if (code == 0)
		code = orbit_analyse(&orbit, said, err);
	if (code == 0)
		code = reduced_open(&reduced, said, &orbit, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST, err);
	random_seed((uint64_t)seed);
	for (int k = 0; k < said->count && code == 0; k++) {
		memcpy(picture, pictures + (size_t)k * pixels, pixels * sizeof(*picture));
		for (size_t i = 0; i < pixels && photons > 0; i++) {
			const double mean = photons * exp(-(double)picture[i]);

			picture[i] = (float)-log(fmax(.5, mean + sqrt(mean) * normal()) / photons);
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
	free(picture);
	return code;
}

static int check_departure(const struct departure *departure, const struct arm *arm, const float *pictures, int seed,
			   struct agreement *ret_agreement, enum agreement_grade *ret_grade, struct error *err)
{
	struct view *views = malloc((size_t)arm->count * sizeof(*views));
	struct geometry geometry = {0};
	int code = views == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a scan") : 0;

	for (int k = 0; k < arm->count && code == 0; k++)
		views[k] = said_view(departure, *arm, k);
	if (code == 0)
		code = geometry_views(&geometry, COLUMNS, ROWS, arm->count, views, err);
	if (code == 0)
		code = check(&geometry, departure->photons, pictures, seed, ret_agreement, ret_grade, err);
	geometry_clear(&geometry);
	free(views);
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

		code = check_departure(&departures[d], &arm, pictures, seed, &agreement, &grade, err);
		if (code < 0)
			break;
		ret_mm[d] = agreement.mm;
		ret_grade[d] = (int)grade;
		agreement_clear(&agreement);
	}
	free(pictures);
	return code;
}

/* ---- scans whose geometry is right ---- */

enum trait { PLAIN, BOARD, RODS, DISPLACED, NARROW, SHORT_ARC, NO_NOISE, MUCH_NOISE, SMALL_PANEL, TRAITS };
static const char *const trait_names[TRAITS] = {"none of these", "board",           "metal rods",
						"displaced",     "narrow detector", "short scan",
						"no noise",      "2,000 photons",   "small panel"};

struct right {
	struct body body;
	struct arm arm;
	enum kind kind;
	double aside, photons; /* aside: pixels */
	bool traits[TRAITS];
};

static void put(struct body *body, enum shape shape, const double semi_axes[3], const double centre[3], double hu)
{
	struct ellipsoid part = {.shape = shape, .density = BODY_WATER * hu / 1000};

	memcpy(part.semi_axes, semi_axes, sizeof(part.semi_axes));
	memcpy(part.centre, centre, sizeof(part.centre));
	if (body->count == BODY_PARTS_MOST)
		abort();
	body->parts[body->count++] = part;
}

/* What is drawn of a seed: the body's own numbers first, which are make_body's. */
static void draw(struct right *right, int seed)
{
	bool *traits = right->traits;
	double width = COLUMNS * PIXEL;

	*right = (struct right){.kind = (enum kind)(seed % KINDS)};
	make_body(&right->body, right->kind, seed);
	random_seed((uint64_t)seed * 104729 + 5);
	traits[BOARD] = uniform() < .3;
	traits[RODS] = uniform() < .25;
	traits[DISPLACED] = uniform() < .2;
	traits[NARROW] = uniform() < .3;
	traits[SHORT_ARC] = !traits[DISPLACED] && uniform() < .6;
	traits[SMALL_PANEL] = uniform() < .35;
	right->photons = uniform() < .25 ? 0 : 2e3 * pow(50, uniform());
	traits[NO_NOISE] = right->photons == 0;
	traits[MUCH_NOISE] = right->photons > 0 && right->photons < 6e3;
	if (traits[BOARD])
		put(&right->body, SHAPE_BOX, (double[]){150 + 60 * uniform(), 6 + 6 * uniform(), 300},
		    (double[]){0, right->kind == HAND ? 30 : 125, 0}, 200 + 800 * uniform());
	for (int i = 0; i < 2 && traits[RODS]; i++)
		put(&right->body, SHAPE_CYLINDER, (double[]){2 + uniform(), 2 + uniform(), 10 + 20 * uniform()},
		    (double[]){30 * (uniform() - .5), 16 * (uniform() - .5), 40 * (uniform() - .5)}, 8000);
	traits[PLAIN] = true;
	for (int i = PLAIN + 1; i < TRAITS; i++)
		traits[PLAIN] = traits[PLAIN] && !traits[i];
	width *= traits[NARROW] ? .5 + .2 * uniform() : 1;
	right->arm = (struct arm){.columns = traits[SMALL_PANEL] ? 48 : COLUMNS - (int)(17.9 * uniform()),
				  .count = 64 + (int)(37 * uniform()),
				  .first = 6 * uniform(),
				  .seed = (unsigned)seed};
	right->arm.rows = right->arm.columns * ROWS / COLUMNS;
	right->arm.pixel = width / right->arm.columns;
	right->arm.step = traits[SHORT_ARC] ? (195 + 25 * uniform()) * M_PI / 180 / (right->arm.count - 1)
					    : 2 * M_PI / right->arm.count;
	right->aside = traits[DISPLACED] ? (.2 + .15 * uniform()) * right->arm.columns : 0;
}

/* Whether it is told: false alarms of one seed. */
static int measure_right(const struct right *right, int seed, struct agreement *ret_agreement,
			 enum agreement_grade *ret_grade, struct error *err)
{
	const size_t pixels = (size_t)right->arm.columns * (size_t)right->arm.rows;
	float *pictures = malloc((size_t)right->arm.count * pixels * sizeof(*pictures));
	struct geometry geometry = {0};
	struct body body = right->body;
	int code = arm_nominal_geometry(&right->arm, &geometry, err);

	if (code == 0 && pictures == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", right->arm.count);
	for (int k = 0; k < right->arm.count && code == 0; k++) {
		struct view *view = &geometry.views[k];

		for (int a = 0; a < 3; a++)
			view->pixel0[a] += right->aside * view->column_step[a];
		body_take(&body, view, right->arm.columns, right->arm.rows, pictures + (size_t)k * pixels);
	}
	if (code == 0)
		code = check(&geometry, right->photons, pictures, seed, ret_agreement, ret_grade, err);
	geometry_clear(&geometry);
	free(pictures);
	return code;
}

static int count_false_alarms(int first, int seeds)
{
	int scans[KINDS + TRAITS] = {0}, told[KINDS + TRAITS][2] = {{0}};

	for (int seed = first; seed < first + seeds; seed++) {
		enum agreement_grade grade = AGREEMENT_GOOD;
		struct agreement agreement;
		struct right right;
		struct error err;

		draw(&right, seed);
		if (measure_right(&right, seed, &agreement, &grade, &err) < 0) {
			fprintf(stderr, "%s\n", err.text);
			return EXIT_FAILURE;
		}
		if (grade != AGREEMENT_GOOD)
			printf(
			    "%s %d: %s, %d views of %d columns, %.0f degrees, %.0f photons, aside %.0f; %.3f +- %.3f "
			    "mm, %.2f unexplained, firm %.2f\n",
			    grade == AGREEMENT_DOUBTFUL ? "doubtful" : "wrong", seed, kind_names[right.kind],
			    right.arm.count, right.arm.columns, right.arm.step * right.arm.count * 180 / M_PI,
			    right.photons, right.aside, agreement.mm, agreement.sigma_mm, agreement.unexplained,
			    agreement.firm);
		fflush(stdout);
		agreement_clear(&agreement);
		for (int i = 0; i < KINDS + TRAITS; i++)
			if (i < KINDS ? (int)right.kind == i : right.traits[i - KINDS]) {
				scans[i]++;
				told[i][0] += grade == AGREEMENT_DOUBTFUL;
				told[i][1] += grade != AGREEMENT_DOUBTFUL && grade != AGREEMENT_GOOD;
			}
	}
	for (int i = 0; i < KINDS + TRAITS; i++)
		printf("%-20s %4d scans, told doubtful + wrong %3d + %3d\n",
		       i < KINDS ? kind_names[i] : trait_names[i - KINDS], scans[i], told[i][0], told[i][1]);
	return EXIT_SUCCESS;
}

/* ---- departures ---- */

static int compare_departures(int first, int seeds)
{
	enum { SEEDS_MOST = 64 };
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

int main(int argc, char **argv)
{
	const int first = argc > 1 ? atoi(argv[1]) : 1, seeds = argc > 2 ? atoi(argv[2]) : 4;

	return argc > 3 && strcmp(argv[3], "right") == 0 ? count_false_alarms(first, seeds)
							 : compare_departures(first, seeds);
}

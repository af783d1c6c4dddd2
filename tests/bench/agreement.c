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
#include "core/scan/phantom.h"
#include "tests/unit/arm.h"

enum { COLUMNS = 77, ROWS = 60, PARTS_MOST = 256 };
static const double PIXEL = 4.928, WATER = 0.0192; /* mm; 1/mm */

/* ---- random numbers: splitmix64 (Steele, Lea and Flood 2014) ---- */

static uint64_t state;

static double uniform(void)
{
	uint64_t z = state += 0x9e3779b97f4a7c15u;

	z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
	z = (z ^ z >> 27) * 0x94d049bb133111ebu;
	return ((double)((z ^ z >> 31) >> 11) + 0.5) / 9007199254740992.0;
}

static double normal(void)
{
	const double radius = sqrt(-2 * log(uniform()));

	return radius * cos(2 * M_PI * uniform());
}

/* ---- bodies ---- */

struct body {
	struct ellipsoid parts[PARTS_MOST];
	int count;
};

static void add(struct body *body, enum shape shape, double a, double b, double c, double x, double y, double z,
		double angle, double hu)
{
	if (body->count == PARTS_MOST)
		abort();
	body->parts[body->count++] = (struct ellipsoid){
	    .shape = shape, .semi_axes = {a, b, c}, .centre = {x, y, z}, .angle = angle, .density = WATER * hu / 1000};
}

/* Small ellipsoids within an elliptic cylinder of these semi-axes and this half length, of r[0] .. r[1] mm. */
static void scatter(struct body *body, int count, const double within[3], const double r[2], const double hu[2])
{
	for (int i = 0; i < count; i++) {
		const double turn = 2 * M_PI * uniform(), out = .85 * sqrt(uniform());
		const double a = r[0] + (r[1] - r[0]) * uniform(), b = a * (.6 + .8 * uniform());
		const double c = a * (.6 + .8 * uniform()), z = within[2] * (2 * uniform() - 1), angle = 3 * uniform();
		const double contrast = hu[0] + (hu[1] - hu[0]) * uniform();

		add(body, SHAPE_ELLIPSOID, a, b, c, within[0] * out * cos(turn), within[1] * out * sin(turn), z, angle,
		    uniform() < .5 ? -contrast : contrast);
	}
}

static void make_head(struct body *body, bool neck)
{
	const double z = neck ? 25 : 0;

	add(body, SHAPE_ELLIPSOID, 74, 92, 80, 0, 0, z, 0, 1000);
	add(body, SHAPE_ELLIPSOID, 70, 88, 76, 0, 0, z, 0, 700);
	add(body, SHAPE_ELLIPSOID, 64, 82, 70, 0, 0, z, 0, -660);
	add(body, SHAPE_ELLIPSOID, 14, 10, 12, -20, -66, z - 20, 0, -1000);
	add(body, SHAPE_ELLIPSOID, 14, 10, 12, 20, -66, z - 20, 0, -1000);
	add(body, SHAPE_ELLIPSOID, 9, 14, 18, 0, -70, z - 40, 0, -900);
	for (int i = -5; i <= 5; i++)
		add(body, SHAPE_BOX, 2.5, 4, 6, i * 7, -55 - 14 * cos(i * .25), z - 62, i * .2, 1200);
	add(body, SHAPE_ELLIPSOID, 12, 8, 10, -55, 8, z - 40, .4, 600);
	add(body, SHAPE_ELLIPSOID, 12, 8, 10, 55, 8, z - 40, -.4, 600);
	if (neck) {
		add(body, SHAPE_CYLINDER, 45, 50, 80, 0, 10, -95, 0, 1000);
		add(body, SHAPE_CYLINDER, 12, 11, 70, 0, 20, -90, 0, 400);
		for (int i = 0; i < 5; i++)
			add(body, SHAPE_CYLINDER, 14, 12, 7, 0, 22, -45 - 20 * i, 0, 300);
	}
	scatter(body, 25, (double[]){55, 70, 60}, (double[]){2, 9}, (double[]){20, 120});
	scatter(body, 20, (double[]){66, 84, 70}, (double[]){1, 3}, (double[]){150, 500});
}

static void make_abdomen(struct body *body)
{
	add(body, SHAPE_CYLINDER, 160, 112, 140, 0, 0, 0, 0, 900);
	add(body, SHAPE_CYLINDER, 144, 96, 140, 0, 0, 0, 0, 140);
	add(body, SHAPE_ELLIPSOID, 60, 52, 70, -70, -12, 10, .3, 45);
	add(body, SHAPE_ELLIPSOID, 26, 32, 50, 78, 28, 0, 0, 55);
	for (int i = -4; i <= 4; i++) {
		add(body, SHAPE_CYLINDER, 22, 18, 12, 0, 62, i * 30, 0, 300);
		add(body, SHAPE_BOX, 4, 14, 6, 0, 88, i * 30 + 6, 0, 500);
		add(body, SHAPE_BOX, 22, 3, 4, 0, 76, i * 30, 0, 400);
	}
	for (int i = -4; i <= 4; i++) {
		add(body, SHAPE_ELLIPSOID, 40, 5, 5, -118, 30, i * 24, 1.1, 700);
		add(body, SHAPE_ELLIPSOID, 40, 5, 5, 118, 30, i * 24, -1.1, 700);
	}
	scatter(body, 14, (double[]){100, 60, 60}, (double[]){5, 16}, (double[]){20, 100});
	scatter(body, 8, (double[]){90, 60, 60}, (double[]){5, 15}, (double[]){900, 1000});
}

static void make_knee(struct body *body)
{
	add(body, SHAPE_CYLINDER, 58, 52, 140, 0, 0, 0, 0, 1000);
	add(body, SHAPE_CYLINDER, 17, 16, 60, 0, 0, 75, 0, 500);
	add(body, SHAPE_CYLINDER, 12, 11, 60, 0, 0, 75, 0, -350);
	add(body, SHAPE_ELLIPSOID, 36, 26, 24, 0, 2, 18, 0, 450);
	add(body, SHAPE_ELLIPSOID, 38, 27, 18, 0, 2, -20, 0, 450);
	add(body, SHAPE_CYLINDER, 15, 14, 60, 0, 4, -80, 0, 500);
	add(body, SHAPE_CYLINDER, 6, 6, 60, 30, 14, -80, 0, 600);
	add(body, SHAPE_ELLIPSOID, 18, 8, 20, 0, -38, 15, 0, 500);
	for (int i = 0; i < 5; i++) {
		const double length = 22 + 10 * uniform(), x = 8 * (uniform() - .5), y = 4 + 10 * (uniform() - .5);
		const double z = 40 * (uniform() - .5) - 10;

		add(body, SHAPE_ELLIPSOID, length, 1.6, 1.6, x, y, z, .8 * (uniform() - .5) + (i % 2) * 1.2, 9000);
	}
	add(body, SHAPE_BOX, 2, 8, 30, 34, 0, -25, .1, 8000);
	scatter(body, 30, (double[]){30, 22, 20}, (double[]){1, 3}, (double[]){80, 250});
}

static void make_even(struct body *body)
{
	add(body, SHAPE_CYLINDER, 75, 75, 140, 0, 0, 0, 0, 1000);
	for (int i = 0; i < 6; i++)
		add(body, SHAPE_ELLIPSOID, 8, 8, 8, 45 * cos(i), 45 * sin(i), 8 * (i - 3), 0, 50 + 30 * i);
}

static void make_hand(struct body *body)
{
	add(body, SHAPE_ELLIPSOID, 40, 16, 90, 0, 0, 0, 0, 1000);
	for (int i = 0; i < 5; i++)
		for (int j = 0; j < 4; j++) {
			const double x = -28 + 14 * i, z = -55 + 34 * j + 3 * i;

			add(body, SHAPE_ELLIPSOID, 5, 4.5, 14, x, 0, z, 0, 700);
			add(body, SHAPE_ELLIPSOID, 3.4, 3, 12, x, 0, z, 0, -450);
		}
	scatter(body, 20, (double[]){30, 8, 60}, (double[]){1, 2.5}, (double[]){80, 300});
}

enum kind { HEAD, ABDOMEN, KNEE, HEAD_AND_NECK, EVEN, HAND, KINDS };
static const char *const kind_names[KINDS] = {"head", "abdomen, truncated", "knee, screws", "head and neck", "even",
					      "hand"};

static void make_body(struct body *body, enum kind kind, int seed)
{
	double scale, shift[3];

	body->count = 0;
	state = (uint64_t)seed * 7919 + (uint64_t)kind;
	scale = .93 + .14 * uniform();
	for (int a = 0; a < 3; a++)
		shift[a] = (a < 2 ? 12 : 10) * (uniform() - .5);
	if (kind == ABDOMEN)
		make_abdomen(body);
	else if (kind == KNEE)
		make_knee(body);
	else if (kind == EVEN)
		make_even(body);
	else if (kind == HAND)
		make_hand(body);
	else
		make_head(body, kind == HEAD_AND_NECK);
	for (int i = 0; i < body->count; i++)
		for (int a = 0; a < 3; a++) {
			body->parts[i].semi_axes[a] *= scale;
			body->parts[i].centre[a] = body->parts[i].centre[a] * scale + shift[a];
		}
}

/* ---- scans ---- */

/* The means of four rays through a bin, as counts add up. */
static void take(struct body *body, const struct view *view, float *ret_picture)
{
	const struct phantom phantom = {.count = body->count, .parts = body->parts};

#pragma omp parallel for schedule(dynamic)
	for (int r = 0; r < ROWS; r++)
		for (int c = 0; c < COLUMNS; c++) {
			double counts = 0;

			for (int i = 0; i < 4; i++) {
				const double column = c + i % 2 * .5 - .25, row = r + i / 2 * .5 - .25;
				double to[3];

				for (int a = 0; a < 3; a++)
					to[a] =
					    view->pixel0[a] + column * view->column_step[a] + row * view->row_step[a];
				counts += exp(-phantom_line_integral(&phantom, view->source, to)) / 4;
			}
			ret_picture[r * COLUMNS + c] = (float)-log(counts);
		}
}

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
	state = (uint64_t)seed;
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

		take(&body, &view, pictures + (size_t)k * COLUMNS * ROWS);
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

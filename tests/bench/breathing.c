/*
 * Who is told to have breathed (core/refine/breathing.h): trunks with lungs, and the abdomen of tests/bench/bodies.c,
 * whose diaphragm and front wall move while the arm turns, and the same and other bodies at rest, on tables, with metal
 * and with a tube that swings. Exact line integrals, the means of four rays through a bin. `make bench-breathing`
 * builds and runs it; tests/bench/results/refine.txt has its table. Arguments: the first seed, and how many.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/refine/agreement.h"
#include "tests/bench/bodies.h"
#include "tests/unit/arm.h"

enum part { STILL, WALL, ORGAN };
struct moving {
	struct body body;
	enum part parts[BODY_PARTS_MOST];
	double shares[BODY_PARTS_MOST]; /* of the diaphragm's way that an organ goes */
};

static void add(struct moving *moving, const struct ellipsoid *shape, enum part part, double share)
{
	struct body *body = &moving->body;

	if (body->count == BODY_PARTS_MOST)
		abort();
	moving->parts[body->count] = part;
	moving->shares[body->count] = share;
	body->parts[body->count] = *shape;
	body->parts[body->count++].density *= BODY_WATER;
}

static void add_rib_cage(struct moving *moving)
{
	for (int i = -4; i <= 4; i++) {
		add(moving, &(struct ellipsoid){SHAPE_CYLINDER, {20, 17, 12}, {0, 62, i * 30}, 0, .3}, STILL, 0);
		add(moving, &(struct ellipsoid){SHAPE_BOX, {4, 14, 6}, {0, 88, i * 30 + 6}, 0, .5}, STILL, 0);
		for (int side = -1; side <= 1; side += 2) {
			add(moving,
			    &(struct ellipsoid){SHAPE_ELLIPSOID, {40, 5, 5}, {side * 116, 30, i * 26}, side * -1.1, .7},
			    STILL, 0);
			/* In front they rise. */
			add(moving,
			    &(struct ellipsoid){
				SHAPE_ELLIPSOID, {36, 4, 5}, {side * 90, -70, i * 26 - 12}, side * .6, .6},
			    ORGAN, -.4);
		}
	}
}

static void make_thorax(struct moving *moving)
{
	add(moving, &(struct ellipsoid){SHAPE_CYLINDER, {155, 108, 150}, {0}, 0, .95}, WALL, 0);
	add(moving, &(struct ellipsoid){SHAPE_CYLINDER, {140, 93, 150}, {0}, 0, .08}, WALL, 0);
	for (int side = -1; side <= 1; side += 2) {
		const double dome = -10 - 6 * side + 10 * (uniform() - .5);

		add(moving, &(struct ellipsoid){SHAPE_ELLIPSOID, {50, 70, 120}, {side * 68, 0, 60}, 0, -.76}, STILL, 0);
		add(moving, &(struct ellipsoid){SHAPE_ELLIPSOID, {38, 52, 46}, {side * 68, 0, dome}, 0, .78}, ORGAN, 1);
		add(moving, &(struct ellipsoid){SHAPE_ELLIPSOID, {8, 9, 7}, {side * 70, 15, 75}, 0, .7}, ORGAN, .3);
	}
	add(moving, &(struct ellipsoid){SHAPE_ELLIPSOID, {15, 45, 50}, {0, -20, 40}, .3, .06}, ORGAN, .5);
	add_rib_cage(moving);
	for (int i = 0; i < 24; i++) {
		const double r = 1.5 + 4 * uniform(), x = (i % 2 ? 68 : -68) + 35 * (uniform() - .5);
		const double y = 70 * (uniform() - .5), z = 35 + 90 * uniform();

		add(moving, &(struct ellipsoid){SHAPE_ELLIPSOID, {r, r, 1.5 * r}, {x, y, z}, 0, .6}, ORGAN,
		    .6 * uniform());
	}
}

enum { THORAX = KINDS };
enum { TABLE = 1, METAL = 2, HARDENED = 4, SWINGING = 8 };

static void make_moving(struct moving *moving, int kind, int seed, double scale, int extras)
{
	enum { ABDOMEN_REST = 49 }; /* parts: two walls, two organs, spine and ribs */

	memset(moving, 0, sizeof(*moving));
	if (kind == THORAX) {
		random_seed((uint64_t)seed * 104729 + 5);
		make_thorax(moving);
	} else {
		make_body(&moving->body, (enum kind)kind, seed);
	}
	for (int i = 0; i < moving->body.count && kind == ABDOMEN; i++)
		if (i < 4 || i >= ABDOMEN_REST) {
			moving->parts[i] = i < 2 ? WALL : ORGAN;
			moving->shares[i] = i == 2 ? 1 : .4 + .6 * uniform();
		}
	if (extras & TABLE)
		add(moving, &(struct ellipsoid){SHAPE_BOX, {230, 9, 200}, {0, 130, 0}, 0, .25}, STILL, 0);
	for (int side = -1; side <= 1 && extras & METAL; side += 2) {
		add(moving, &(struct ellipsoid){SHAPE_ELLIPSOID, {15, 15, 15}, {side * 62, 5 * side, 10}, 0, 7}, STILL,
		    0);
		add(moving, &(struct ellipsoid){SHAPE_CYLINDER, {7, 7, 40}, {side * 70, 5 * side, -40}, 0, 7}, STILL,
		    0);
	}
	for (int i = 0; i < moving->body.count; i++)
		for (int a = 0; a < 3; a++) {
			moving->body.parts[i].semi_axes[a] *= scale;
			moving->body.parts[i].centre[a] *= scale;
		}
}

/* mm: of the diaphragm. */
static void breathe(const struct moving *moving, double mm, struct body *ret_body)
{
	*ret_body = moving->body;
	for (int i = 0; i < ret_body->count; i++) {
		struct ellipsoid *part = &ret_body->parts[i];

		if (moving->parts[i] == WALL) {
			part->semi_axes[1] += .3 * mm;
			part->centre[1] -= .3 * mm;
		} else if (moving->parts[i] == ORGAN) {
			part->centre[2] -= moving->shares[i] * mm;
			part->centre[1] -= part->centre[1] < 0 ? .15 * mm : 0;
		}
	}
}

struct scan {
	int kind, extras, seed;
	double scale, depth, times; /* mm; breaths in the sweep, 0: one deep one */
	double photons;
	bool coarse;
};

static double breath_at(const struct scan *scan, double share, double phase)
{
	if (scan->times > 0)
		return pow(cos(M_PI * (share * scan->times + phase + .25 * sin(2 * M_PI * (1.3 * share + phase)))), 4);
	return exp(-pow((share - .2 - .6 * phase) / .1, 2) / 2);
}

/* True if it is told. */
static bool take_and_check(const struct scan *scan)
{
	static const struct {
		double arc;
		int views;
	} sweeps[] = {{200, 120}, {360, 120}, {210, 96}, {195, 100}, {360, 90}};
	const int sweep = scan->seed % 5, views = sweeps[sweep].views;
	const struct arm arm = {.columns = scan->coarse ? 48 : 77,
				.rows = scan->coarse ? 40 : 60,
				.count = views,
				.pixel = scan->coarse ? 7.9 : 4.928,
				.first = .3 + scan->seed,
				.step = sweeps[sweep].arc * M_PI / 180 / (sweeps[sweep].arc < 360 ? views - 1 : views)};
	const int pixels = arm.columns * arm.rows;
	float *picture = malloc((size_t)pixels * sizeof(*picture));
	struct moving *moving = malloc(sizeof(*moving));
	struct geometry geometry = {0};
	struct orbit orbit = {0};
	struct reduced reduced = {0};
	struct agreement agreement = {0};
	struct error err;
	double phase;
	bool told;
	int code = picture == NULL || moving == NULL ? error_set(&err, ERR_NO_MEMORY, "no memory for a view")
						     : arm_nominal_geometry(&arm, &geometry, &err);

	if (code == 0)
		code = orbit_analyse(&orbit, &geometry, &err);
	if (code == 0)
		code = reduced_open(&reduced, &geometry, &orbit, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST, &err);
	if (code == 0)
		make_moving(moving, scan->kind, scan->seed, scan->scale, scan->extras);
	random_seed((uint64_t)scan->seed * 31 + 7);
	phase = uniform();
	for (int k = 0; k < views && code == 0; k++) {
		const double swing = scan->extras & SWINGING ? .01 * sin(2 * M_PI * 9 * k / views) : 0;
		struct body body;

		breathe(moving, scan->depth > 0 ? scan->depth * breath_at(scan, (double)k / views, phase) : 0, &body);
		body_take(&body, &geometry.views[k], arm.columns, arm.rows, picture);
		for (int i = 0; i < pixels; i++) {
			const double hard = scan->extras & HARDENED ? 1 - .015 * (double)picture[i] : 1;
			const double mean = scan->photons * exp(swing - hard * (double)picture[i]);

			picture[i] = (float)-log(fmax(.5, mean + sqrt(mean) * normal()) / scan->photons);
		}
		reduced_take(&reduced, k, picture);
	}
	if (code == 0)
		code = agreement_measure(&reduced, NULL, &agreement, &err);
	if (code < 0) {
		fprintf(stderr, "%s\n", err.text);
		exit(EXIT_FAILURE);
	}
	told = breathing_is_told(&agreement.breathing);
	agreement_clear(&agreement);
	reduced_clear(&reduced);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	free(moving);
	free(picture);
	return told;
}

static void tell(const char *name, struct scan scan, int first, int seeds)
{
	int told = 0;

	for (int seed = first; seed < first + seeds; seed++) {
		scan.seed = seed;
		scan.coarse = seed % 3 == 1;
		scan.photons = seed % 4 == 2 ? 2e3 : 2e4;
		told += take_and_check(&scan);
	}
	printf("%-44s %2d of %d\n", name, told, seeds);
	fflush(stdout);
}

int main(int argc, char **argv)
{
	static const struct {
		const char *name;
		int kind;
		double scale;
	} trunks[] = {{"abdomen, cut off", ABDOMEN, 1},
		      {"thorax, cut off", THORAX, 1},
		      {"child's abdomen", ABDOMEN, .6},
		      {"child's thorax", THORAX, .6}};
	static const struct {
		const char *name;
		int extras;
	} rests[] = {{"", 0},
		     {", a table", TABLE},
		     {", hips of metal", METAL},
		     {", both", TABLE | METAL},
		     {", hardened", HARDENED},
		     {", a tube that swings", SWINGING}};
	static const double depths[] = {2, 5, 10, 15}, times[] = {0, 3, 6, 8, 10, 12, 15};
	const int first = argc > 1 ? atoi(argv[1]) : 1, seeds = argc > 2 ? atoi(argv[2]) : 5;
	char name[80];

	for (int t = 0; t < 4; t++) {
		for (int r = 0; r < 6; r++) {
			snprintf(name, sizeof(name), "%s at rest%s", trunks[t].name, rests[r].name);
			tell(name,
			     (struct scan){.kind = trunks[t].kind, .scale = trunks[t].scale, .extras = rests[r].extras},
			     first, seeds);
		}
		for (int i = 0; i < 4 * 7; i++) {
			const double depth = depths[i / 7], often = times[i % 7];

			snprintf(name, sizeof(name), "%s, %g mm, %g times", trunks[t].name, depth,
				 often > 0 ? often : 1);
			tell(name,
			     (struct scan){
				 .kind = trunks[t].kind, .scale = trunks[t].scale, .depth = depth, .times = often},
			     first, seeds);
		}
	}
	for (int kind = HEAD; kind < KINDS; kind++)
		if (kind != ABDOMEN)
			tell(kind_names[kind], (struct scan){.kind = kind, .scale = 1}, first, seeds);
	return EXIT_SUCCESS;
}

/* Bodies with exact line integrals: see bodies.h. */
#include "tests/bench/bodies.h"

#include <math.h>
#include <stdlib.h>

/* ---- random numbers: splitmix64 (Steele, Lea and Flood 2014) ---- */

static uint64_t state;

void random_seed(uint64_t seed)
{
	state = seed;
}

double uniform(void)
{
	uint64_t z = state += 0x9e3779b97f4a7c15u;

	z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
	z = (z ^ z >> 27) * 0x94d049bb133111ebu;
	return ((double)((z ^ z >> 31) >> 11) + 0.5) / 9007199254740992.0;
}

double normal(void)
{
	const double radius = sqrt(-2 * log(uniform()));

	return radius * cos(2 * M_PI * uniform());
}

/* ---- bodies ---- */

static void add(struct body *body, enum shape shape, double a, double b, double c, double x, double y, double z,
		double angle, double hu)
{
	if (body->count == BODY_PARTS_MOST)
		abort();
	body->parts[body->count++] = (struct ellipsoid){.shape = shape,
							.semi_axes = {a, b, c},
							.centre = {x, y, z},
							.angle = angle,
							.density = BODY_WATER * hu / 1000};
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

/* A bone along z: its shell's density over the flesh's, and marrow within. */
static void add_shaft(struct body *body, double radius, double half, const double at[3])
{
	add(body, SHAPE_CYLINDER, radius, .9 * radius, half, at[0], at[1], at[2], 0, 900);
	add(body, SHAPE_CYLINDER, .6 * radius, .5 * radius, half, at[0], at[1], at[2], 0, -750);
	for (int end = -1; end <= 1; end += 2)
		add(body, SHAPE_ELLIPSOID, 1.3 * radius, 1.2 * radius, radius, at[0], at[1], at[2] + end * half, 0,
		    300);
}

/* A short bone, or one that lies across z. */
static void add_nodule(struct body *body, const double semi_axes[3], const double at[3], double angle)
{
	add(body, SHAPE_ELLIPSOID, semi_axes[0], semi_axes[1], semi_axes[2], at[0], at[1], at[2], angle, 700);
	add(body, SHAPE_ELLIPSOID, semi_axes[0] - 1.5, semi_axes[1] - 1.5, semi_axes[2] - 1.5, at[0], at[1], at[2],
	    angle, -450);
}

/* Along z, the fingers up and a little bent, beside the axis; the arm goes on beyond the rows. */
static void make_hand(struct body *body)
{
	static const double x0 = 16, y0 = -22, lengths[3] = {20, 12, 8.5}, bent[3] = {0, 3, 8};

	add(body, SHAPE_CYLINDER, 27, 18, 60, x0, y0, -124, 0, 1000);
	add(body, SHAPE_CYLINDER, 41, 14, 40, x0, y0, -24, 0, 1000);
	add_shaft(body, 11, 50, (double[]){x0 - 10, y0, -122});
	add_shaft(body, 7, 50, (double[]){x0 + 13, y0 + 3, -122});
	for (int i = 0; i < 8; i++)
		add_nodule(body, (double[]){6.5 + i % 3 * .5, 6, 5.5 + i % 2},
			   (double[]){x0 - 20 + 13.5 * (i % 4), y0 + 2 * (i % 3) - 2, -60 + i / 4 * 13}, .3 * i);
	for (int i = 0; i < 4; i++) {
		double z = 16;

		add_shaft(body, 4.3 - .2 * i, 24, (double[]){x0 - 29 + 19 * i, y0 + (i - 1.5) * (i - 1.5), -13});
		for (int j = 0; j < 3; j++) {
			const double half = lengths[j] * (i == 3 ? .8 : i == 1 ? 1.1 : 1);
			const double x = x0 + (-29 + 19 * i) * (1 + .06 * j), y = y0 + bent[j];

			add(body, SHAPE_CYLINDER, 8.8 - .9 * j, 8 - .7 * j, half, x, y, z + half, 0, 1000);
			add_shaft(body, 4.2 - .7 * j, half - 2.5, (double[]){x, y, z + half});
			z += 2 * half;
		}
	}
	/* The thumb, across. */
	add(body, SHAPE_ELLIPSOID, 42, 12, 13, x0 - 72, y0 + 34, -36, -.7, 1000);
	add_nodule(body, (double[]){18, 5.5, 5.5}, (double[]){x0 - 55, y0 + 20, -38}, -.7);
	add_nodule(body, (double[]){14, 4.5, 4.5}, (double[]){x0 - 80, y0 + 41, -36}, -.7);
	add_nodule(body, (double[]){10, 4, 4}, (double[]){x0 - 98, y0 + 56, -35}, -.7);
	for (int i = 0; i < 24; i++)
		add(body, SHAPE_ELLIPSOID, 1 + 1.5 * uniform(), 1 + 1.5 * uniform(), 2 + 6 * uniform(),
		    x0 + 70 * (uniform() - .5), y0 + 18 * (uniform() - .5), -24 + 70 * (uniform() - .5), 0,
		    40 + 160 * uniform());
}

const char *const kind_names[KINDS] = {"head", "abdomen, truncated", "knee, screws", "head and neck", "even", "hand"};

void make_body(struct body *body, enum kind kind, int seed)
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

/* The means of four rays through a bin, as counts add up. */
void body_take(struct body *body, const struct view *view, int columns, int rows, float *ret_picture)
{
	const struct phantom phantom = {.count = body->count, .parts = body->parts};

#pragma omp parallel for schedule(dynamic)
	for (int r = 0; r < rows; r++)
		for (int c = 0; c < columns; c++) {
			double counts = 0;

			for (int i = 0; i < 4; i++) {
				const double column = c + i % 2 * .5 - .25, row = r + i / 2 * .5 - .25;
				double to[3];

				for (int a = 0; a < 3; a++)
					to[a] =
					    view->pixel0[a] + column * view->column_step[a] + row * view->row_step[a];
				counts += exp(-phantom_line_integral(&phantom, view->source, to)) / 4;
			}
			ret_picture[r * columns + c] = (float)-log(counts);
		}
}

/* Scattered photons by Monte Carlo with forced detection: see montecarlo.h. */
#include "tests/unit/montecarlo.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

enum { COLLISIONS_MOST = 8 };
static const double ENERGY = 65, REST = 510.999; /* keV */
static const double SCATTERED = 0.92;            /* share of the attenuation of water at 65 keV */

struct photon {
	double at[3], way[3], energy, weight;
};

/* SplitMix64. */
static double uniform(unsigned long long *state)
{
	unsigned long long z = (*state += 0x9e3779b97f4a7c15ull);

	z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
	z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
	return (double)((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

/* The cross section for Compton scattering of all angles, in 2 pi r_e^2 (Klein and Nishina 1929). */
static double cross_section(double energy)
{
	const double a = energy / REST, b = 1 + 2 * a;

	return (1 + a) / (a * a) * (2 * (1 + a) / b - log(b) / a) + log(b) / (2 * a) - (1 + 3 * a) / (b * b);
}

static double scattered_energy(double energy, double cosine)
{
	return energy / (1 + energy / REST * (1 - cosine));
}

/* Share of scattered photons per steradian. */
static double per_steradian(double energy, double cosine)
{
	const double ratio = scattered_energy(energy, cosine) / energy;

	return 0.5 * ratio * ratio * (ratio + 1 / ratio - 1 + cosine * cosine) / (2 * M_PI * cross_section(energy));
}

/* Attenuation against that at 65 keV; absorption falls with the third power of the energy. */
static double attenuation(double energy)
{
	return SCATTERED * cross_section(energy) / cross_section(ENERGY) + (1 - SCATTERED) * pow(ENERGY / energy, 3);
}

/* Turns a direction by an angle about which only the cosine is known. */
static void turn(double way[3], double cosine, unsigned long long *state)
{
	const double sine = sqrt(fmax(0, 1 - cosine * cosine)), turned = 2 * M_PI * uniform(state);
	double across[3] = {0}, other[3], length = 0;

	across[fabs(way[0]) < 0.6 ? 0 : 1] = 1;
	other[0] = way[1] * across[2] - way[2] * across[1];
	other[1] = way[2] * across[0] - way[0] * across[2];
	other[2] = way[0] * across[1] - way[1] * across[0];
	for (int i = 0; i < 3; i++)
		length += other[i] * other[i];
	for (int i = 0; i < 3; i++)
		other[i] /= sqrt(length);
	across[0] = other[1] * way[2] - other[2] * way[1];
	across[1] = other[2] * way[0] - other[0] * way[2];
	across[2] = other[0] * way[1] - other[1] * way[0];
	for (int i = 0; i < 3; i++)
		way[i] = cosine * way[i] + sine * (cos(turned) * across[i] + sin(turned) * other[i]);
}

static double sample_cosine(double energy, unsigned long long *state)
{
	const double most = per_steradian(energy, 1);
	double cosine;

	do
		cosine = 2 * uniform(state) - 1;
	while (uniform(state) * most > per_steradian(energy, cosine));
	return cosine;
}

/* Where the way enters and leaves the ball about the isocentre; false: it misses. */
static bool through_ball(const struct photon *photon, double radius, double ret[2])
{
	double b = 0, c = -radius * radius;

	for (int i = 0; i < 3; i++) {
		b += photon->at[i] * photon->way[i];
		c += photon->at[i] * photon->at[i];
	}
	if (b * b < c)
		return false;
	ret[0] = fmax(0, -b - sqrt(b * b - c));
	ret[1] = -b + sqrt(b * b - c);
	return ret[1] > 0;
}

/* Moves the photon to its next collision; false: it leaves. */
static bool fly(const struct montecarlo *montecarlo, struct photon *photon, double densest, unsigned long long *state)
{
	const double most = densest * attenuation(photon->energy);
	double range[2], t;

	if (!through_ball(photon, montecarlo->radius, range))
		return false;
	t = range[0];
	for (;;) {
		double point[3];

		t -= log(1 - uniform(state)) / most;
		if (t > range[1])
			return false;
		for (int i = 0; i < 3; i++)
			point[i] = photon->at[i] + t * photon->way[i];
		if (uniform(state) * densest < phantom_density(montecarlo->phantom, point)) {
			memcpy(photon->at, point, sizeof(point));
			return true;
		}
	}
}

static void pixel_at(const struct view *view, double column, double row, double ret[3])
{
	for (int i = 0; i < 3; i++)
		ret[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
}

/* Cosine against the detector's normal over the square of the distance: what a pixel sees of a point. */
static double solid_angle(const double from[3], const double to[3], const double normal[3], double ret_way[3])
{
	double square = 0, cosine = 0;

	for (int i = 0; i < 3; i++) {
		ret_way[i] = to[i] - from[i];
		square += ret_way[i] * ret_way[i];
	}
	for (int i = 0; i < 3; i++) {
		ret_way[i] /= sqrt(square);
		cosine += ret_way[i] * normal[i];
	}
	return fabs(cosine) / square;
}

struct cells {
	double (*at)[3]; /* centres */
	const double *normal;
	int count;
};

static void detect(const struct montecarlo *montecarlo, const struct photon *photon, const struct cells *cells,
		   double *sums)
{
	for (int i = 0; i < cells->count; i++) {
		double way[3], cosine = 0, energy;
		const double seen = solid_angle(photon->at, cells->at[i], cells->normal, way);

		for (int k = 0; k < 3; k++)
			cosine += way[k] * photon->way[k];
		energy = scattered_energy(photon->energy, cosine);
		sums[i] +=
		    photon->weight * SCATTERED * per_steradian(photon->energy, cosine) * seen * energy / ENERGY *
		    exp(-attenuation(energy) * phantom_line_integral(montecarlo->phantom, photon->at, cells->at[i]));
	}
}

static void follow(const struct montecarlo *montecarlo, struct photon photon, double densest, const struct cells *cells,
		   unsigned long long *state, double *sums)
{
	for (int n = 0; n < COLLISIONS_MOST && fly(montecarlo, &photon, densest, state); n++) {
		double cosine;

		detect(montecarlo, &photon, cells, sums);
		cosine = sample_cosine(photon.energy, state);
		photon.energy = scattered_energy(photon.energy, cosine);
		photon.weight *= SCATTERED;
		turn(photon.way, cosine, state);
	}
}

static void normal_of(const struct view *view, double ret[3])
{
	const double *u = view->column_step, *v = view->row_step;
	const double cross[3] = {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]};
	const double length = sqrt(cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]);

	for (int i = 0; i < 3; i++)
		ret[i] = cross[i] / length;
}

static double densest_of(const struct phantom *phantom)
{
	double sum = 0;

	for (int i = 0; i < phantom->count; i++)
		sum += fmax(0, phantom->parts[i].density);
	return sum;
}

void montecarlo_scatter(const struct montecarlo *montecarlo, int index, float *ret)
{
	const struct geometry *geometry = montecarlo->geometry;
	const struct view *view = &geometry->views[index];
	const int count = montecarlo->across * montecarlo->along;
	const double densest = densest_of(montecarlo->phantom);
	double at[count][3], sums[count], normal[3], area, way[3];
	const struct cells cells = {at, normal, count};
	unsigned long long state = montecarlo->seed + 1000003ull * (unsigned long long)index;

	normal_of(view, normal);
	for (int i = 0; i < count; i++) {
		const int c = i % montecarlo->across, r = i / montecarlo->across;

		pixel_at(view, (c + 0.5) * geometry->columns / montecarlo->across - 0.5,
			 (r + 0.5) * geometry->rows / montecarlo->along - 0.5, at[i]);
		sums[i] = 0;
	}
	area = vec_norm(view->column_step) * vec_norm(view->row_step) * geometry->columns * geometry->rows;
	for (int n = 0; n < montecarlo->photons; n++) {
		struct photon photon = {.energy = ENERGY};
		double target[3];

		pixel_at(view, uniform(&state) * geometry->columns - 0.5, uniform(&state) * geometry->rows - 0.5,
			 target);
		photon.weight = area / montecarlo->photons * solid_angle(view->source, target, normal, photon.way);
		memcpy(photon.at, view->source, sizeof(photon.at));
		follow(montecarlo, photon, densest, &cells, &state, sums);
	}
	for (int i = 0; i < count; i++)
		ret[i] = (float)(sums[i] / solid_angle(view->source, at[i], normal, way));
}

/* Noise, streaks, rings and edges of a volume's slices: quality.h. */
#include "core/recon/quality.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/noise.h"

struct slices {
	const float *voxels;
	const struct grid *grid;
	size_t stride[3];
	double level, mean; /* between background and object, and of the object; 1/mm */
};

static double at(const struct slices *s, int x, int y, int z)
{
	return (double)s->voxels[(size_t)z * s->stride[2] + (size_t)y * s->stride[1] + (size_t)x];
}

/* Halfway between the means of both classes (Ridler and Calvard 1978). */
static void classify(struct slices *s)
{
	const size_t voxels = grid_voxels(s->grid), step = voxels / 100000 + 1;

	s->level = 0;
	for (int pass = 0; pass < 20; pass++) {
		double sum[2] = {0, 0};
		size_t count[2] = {0, 0};

		for (size_t i = 0; i < voxels; i += step) {
			const double v = (double)s->voxels[i];

			if (isfinite(v)) {
				sum[v > s->level] += v;
				count[v > s->level]++;
			}
		}
		if (count[1] == 0)
			return;
		s->mean = sum[1] / (double)count[1];
		s->level = (s->mean + (count[0] > 0 ? sum[0] / (double)count[0] : 0)) / 2;
	}
}

static int ascending(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

/* Within a quarter of the object's mean: neither air nor bone. */
static bool is_soft(const struct slices *s, double v)
{
	return fabs(v / s->mean - 1) < 0.25;
}

/* ---- streaks ---- */

enum { CUBE = 6, APART = 2 };

struct cube {
	double across,
	    within; /* variances by differences across slices and within them; across comes first: sorted by it */
};

/* The mean square of mixed differences along two axes, over 4: the variance of white noise that makes them. */
static double variance_of(const struct slices *s, const int corner[3], int a, int b)
{
	int end[3] = {CUBE, CUBE, CUBE}, count = 0;
	const size_t first = s->stride[a] * APART, second = s->stride[b] * APART;
	double sum = 0;

	end[a] -= APART;
	end[b] -= APART;
	for (int z = 0; z < end[2]; z++)
		for (int y = 0; y < end[1]; y++)
			for (int x = 0; x < end[0]; x++, count++) {
				const float *v = s->voxels + (size_t)(corner[2] + z) * s->stride[2] +
						 (size_t)(corner[1] + y) * s->stride[1] + (size_t)(corner[0] + x);
				const double d =
				    (double)v[0] - (double)v[first] - (double)v[second] + (double)v[first + second];

				sum += d * d;
			}
	return sum / (4 * count);
}

static bool cube_is_soft(const struct slices *s, const int corner[3])
{
	double sum = 0;

	for (int z = 0; z < CUBE; z++)
		for (int y = 0; y < CUBE; y++)
			for (int x = 0; x < CUBE; x++)
				sum += at(s, corner[0] + x, corner[1] + y, corner[2] + z);
	return is_soft(s, sum / (CUBE * CUBE * CUBE));
}

/* The median of what differences within slices have more, over the half of the cubes with the least noise: no edges. */
static int measure_streaks(const struct slices *s, double *ret_sigma, struct error *err)
{
	enum { LEAST = 12 };
	const int *size = s->grid->size;
	struct cube *cubes = malloc(sizeof(*cubes) * (grid_voxels(s->grid) / (CUBE * CUBE * CUBE) + 1));
	double *more = malloc(sizeof(*more) * (grid_voxels(s->grid) / (CUBE * CUBE * CUBE) + 1));
	size_t count = 0;

	*ret_sigma = NAN;
	if (cubes == NULL || more == NULL) {
		free(cubes);
		free(more);
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume's quality");
	}
	for (int z = 0; z + CUBE <= size[2]; z += CUBE)
		for (int y = 0; y + CUBE <= size[1]; y += CUBE)
			for (int x = 0; x + CUBE <= size[0]; x += CUBE) {
				const int corner[3] = {x, y, z};
				struct cube *cube = &cubes[count];

				if (!cube_is_soft(s, corner))
					continue;
				cube->across = (variance_of(s, corner, 0, 2) + variance_of(s, corner, 1, 2)) / 2;
				cube->within = variance_of(s, corner, 0, 1);
				count += isfinite(cube->across) && isfinite(cube->within);
			}
	if (count >= LEAST) {
		qsort(cubes, count, sizeof(*cubes), ascending);
		for (size_t i = 0; i < count / 2; i++)
			more[i] = cubes[i].within - cubes[i].across;
		qsort(more, count / 2, sizeof(*more), ascending);
		*ret_sigma = sqrt(fmax(0, more[count / 4]));
	}
	free(cubes);
	free(more);
	return 0;
}

/* ---- rings ---- */

/* Means over circles of a slice, from the soft voxels on them. */
struct circle {
	double sum, square;
	int count;
};

/* Soft, with soft tissue around it: the blur of a surface or of bone is no ring. */
static bool is_inside(const struct slices *s, int x, int y, int z)
{
	enum { AROUND = 3 };
	const int *size = s->grid->size;

	return x >= AROUND && y >= AROUND && x + AROUND < size[0] && y + AROUND < size[1] &&
	       is_soft(s, at(s, x, y, z)) && is_soft(s, at(s, x - AROUND, y, z)) &&
	       is_soft(s, at(s, x + AROUND, y, z)) && is_soft(s, at(s, x, y - AROUND, z)) &&
	       is_soft(s, at(s, x, y + AROUND, z));
}

/* Adds the squares of rings of one slice, less what noise has in them. */
static void add_rings(const struct slices *s, int z, struct circle *circles, int most, double *sum, int *count)
{
	enum { LEAST = 40, FIRST = 3, AWAY = 2 };
	const struct grid *grid = s->grid;

	memset(circles, 0, sizeof(*circles) * (size_t)most);
	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const double v = at(s, x, y, z), r = hypot(grid->origin[0] + x * grid->spacing[0],
								   grid->origin[1] + y * grid->spacing[1]);
			const int bin = (int)lrint(r / grid->spacing[0]);

			if (bin >= most || !is_inside(s, x, y, z))
				continue;
			circles[bin].sum += v;
			circles[bin].square += v * v;
			circles[bin].count++;
		}
	for (int i = FIRST; i + AWAY < most; i++) {
		double mean[3], noise[3];
		bool whole = true;

		for (int k = 0; k < 3; k++) {
			const struct circle *c = &circles[i + (k - 1) * AWAY];

			whole = whole && c->count >= LEAST;
			mean[k] = c->sum / c->count;
			noise[k] = (c->square / c->count - mean[k] * mean[k]) / c->count;
		}
		if (whole) {
			const double d = mean[1] - (mean[0] + mean[2]) / 2;

			*sum += (d * d - noise[1] - (noise[0] + noise[2]) / 4) / 1.5;
			(*count)++;
		}
	}
}

static int measure_rings(const struct slices *s, double *ret_rms, struct error *err)
{
	enum { LEAST = 20 };
	const int *size = s->grid->size, most = size[0] > size[1] ? size[0] : size[1];
	struct circle *circles = malloc(sizeof(*circles) * (size_t)most);
	double sum = 0;
	int count = 0;

	*ret_rms = NAN;
	if (circles == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume's quality");
	for (int z = 0; z < size[2]; z += 3)
		add_rings(s, z, circles, most, &sum, &count);
	free(circles);
	if (count >= LEAST)
		*ret_rms = sqrt(fmax(0, sum / count));
	return 0;
}

/* ---- edges ---- */

enum { REACH = 8, FINE = 4, BINS = 2 * REACH * FINE }; /* voxels on both sides; parts of a voxel */

struct profile {
	double sum[BINS], spacing; /* spacing: mm of a voxel */
	int count[BINS], edges;
};

/* Mean of three voxels from `from` on along an axis; false where they are no plateau beside a step of that height. */
static bool plateau(const float *v, size_t stride, int from, double height, double *ret_mean)
{
	double least = INFINITY, most = -INFINITY, sum = 0;

	for (int k = from; k < from + 3; k++) {
		const double value = (double)v[(ptrdiff_t)k * (ptrdiff_t)stride];

		least = fmin(least, value);
		most = fmax(most, value);
		sum += value;
	}
	*ret_mean = sum / 3;
	return most - least < 0.25 * height;
}

/* Adds the edge between this voxel and the next along an axis, where there is a clean one. */
static void add_edge(const struct slices *s, const int place[3], int axis, struct profile *profile)
{
	const size_t along = s->stride[axis], beside = s->stride[1 - axis];
	const float *v =
	    s->voxels + (size_t)place[2] * s->stride[2] + (size_t)place[1] * s->stride[1] + (size_t)place[0];
	const double mm = s->grid->spacing[axis], *spacing = s->grid->spacing;
	const double here = (double)v[0], next = (double)v[along];
	double low, high, middle, cosine, crossing, slope[2];

	if ((here < s->level) == (next < s->level) || !plateau(v, along, -7, s->mean, &low) ||
	    !plateau(v, along, 6, s->mean, &high) || fabs(high - low) < 0.5 * s->mean)
		return;
	middle = (low + high) / 2;
	if ((here < middle) == (next < middle))
		return;
	slope[0] = (next - here) / mm;
	slope[1] =
	    ((double)v[beside] + (double)v[along + beside] - (double)(v - beside)[0] - (double)(v - beside)[along]) /
	    (4 * spacing[1 - axis]);
	cosine = fabs(slope[0]) / hypot(slope[0], slope[1]);
	if (!(cosine > 0.866))
		return;
	crossing = (middle - here) / (next - here);
	for (int k = -7; k <= 8; k++) {
		const double value = ((double)v[(ptrdiff_t)k * (ptrdiff_t)along] - low) / (high - low);
		const int bin = (int)floor(((k - crossing) * mm * cosine / profile->spacing + REACH) * FINE);

		if (bin >= 0 && bin < BINS) {
			profile->sum[bin] += value;
			profile->count[bin]++;
		}
	}
	profile->edges++;
}

/* Where the mean profile goes through a share of its height, mm; NaN where it does not. */
static double crossing_of(const struct profile *profile, double share)
{
	double before = NAN, place = 0;

	for (int i = 0; i < BINS; i++) {
		const double value = profile->sum[i] / profile->count[i], here = (i + 0.5) / FINE;

		if (profile->count[i] == 0)
			continue;
		if (before < share && value >= share)
			return (place + (here - place) * (share - before) / (value - before)) * profile->spacing;
		before = value;
		place = here;
	}
	return NAN;
}

static double edge_width(const struct slices *s)
{
	enum { LEAST = 30 };
	/* An error function's quartiles are 2 * .67449 sigma apart, its derivative's half maxima 2.35482. */
	const double of_quartiles = 2.35482 / (2 * 0.67449);
	const int *size = s->grid->size;
	struct profile profile = {.spacing = fmin(s->grid->spacing[0], s->grid->spacing[1])};

	for (int z = 0; z < size[2]; z += 2)
		for (int y = REACH; y < size[1] - REACH - 1; y++)
			for (int x = REACH; x < size[0] - REACH - 1; x++)
				for (int axis = 0; axis < 2; axis++)
					add_edge(s, (const int[3]){x, y, z}, axis, &profile);
	if (profile.edges < LEAST)
		return NAN;
	return of_quartiles * (crossing_of(&profile, 0.75) - crossing_of(&profile, 0.25));
}

int quality_of_slices(const float *slices, const struct grid *grid, double mu_water, struct volume_quality *ret_quality,
		      struct error *err)
{
	struct slices s = {.voxels = slices,
			   .grid = grid,
			   .stride = {1, (size_t)grid->size[0], (size_t)grid->size[0] * (size_t)grid->size[1]}};
	const double hu = 1000 / mu_water;
	struct volume_quality quality = {NAN, NAN, NAN, NAN};
	struct volume_noise noise;
	int code = noise_of_slices(slices, grid->size, &noise, err);

	classify(&s);
	if (code == 0 && s.mean > 0) {
		code = measure_streaks(&s, &quality.streak_hu, err);
		if (code == 0)
			code = measure_rings(&s, &quality.ring_hu, err);
		quality.edge_mm = edge_width(&s);
		quality.noise_hu = noise.contrast > 0 || noise.sigma > 0 ? noise.sigma * hu : NAN;
		quality.streak_hu *= hu;
		quality.ring_hu *= hu;
	}
	if (code == 0)
		*ret_quality = quality;
	return code;
}

/* Noise, streaks, rings and edges of a volume's slices: quality.h. */
#include "core/recon/quality.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

struct slices {
	const float *voxels;
	const struct grid *grid;
	size_t stride[3];
	double level, mean;  /* between background and object, and of the object; 1/mm */
	unsigned char *even; /* owned; of each voxel: it lies in soft tissue, away from air and bone */
};

static size_t place_of(const struct slices *s, int x, int y, int z)
{
	return (size_t)z * s->stride[2] + (size_t)y * s->stride[1] + (size_t)x;
}

static double at(const struct slices *s, int x, int y, int z)
{
	return (double)s->voxels[place_of(s, x, y, z)];
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

/* ---- even tissue ---- */

/* Within a quarter of the object's mean: neither air nor bone. */
static bool is_soft(const struct slices *s, double v)
{
	return fabs(v / s->mean - 1) < 0.25;
}

/* Mean of the 27 voxels around one; at the volume's faces of those that are there. */
static double mean_around(const struct slices *s, int x, int y, int z)
{
	const int *size = s->grid->size;
	double sum = 0;
	int count = 0;

	for (int k = z - 1; k <= z + 1; k++)
		for (int j = y - 1; j <= y + 1; j++)
			for (int i = x - 1; i <= x + 1; i++)
				if (k >= 0 && j >= 0 && i >= 0 && k < size[2] && j < size[1] && i < size[0]) {
					sum += at(s, i, j, k);
					count++;
				}
	return sum / count;
}

/* A voxel is even where it and whatever is at most three voxels away in its slice are soft on the mean of 27 voxels. */
static int find_even(struct slices *s, struct error *err)
{
	enum { AWAY = 3 };
	const int *size = s->grid->size;
	const size_t voxels = grid_voxels(s->grid);
	unsigned char *soft = calloc(voxels, 1);

	s->even = calloc(voxels, 1);
	if (soft == NULL || s->even == NULL) {
		free(soft);
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume's quality");
	}
#pragma omp parallel for schedule(static)
	for (int z = 0; z < size[2]; z++)
		for (int y = 0; y < size[1]; y++)
			for (int x = 0; x < size[0]; x++)
				soft[place_of(s, x, y, z)] = is_soft(s, mean_around(s, x, y, z));
#pragma omp parallel for schedule(static)
	for (int z = 0; z < size[2]; z++)
		for (int y = AWAY; y < size[1] - AWAY; y++)
			for (int x = AWAY; x < size[0] - AWAY; x++) {
				bool even = true;

				for (int j = -AWAY; j <= AWAY && even; j++)
					for (int i = -AWAY; i <= AWAY && even; i++)
						even = soft[place_of(s, x + i, y + j, z)];
				s->even[place_of(s, x, y, z)] = even;
			}
	free(soft);
	return 0;
}

/* ---- noise and streaks ---- */

enum { CUBE = 6, CUBES_LEAST = 8, CUBES_MOST = 20000, SCALE_MOST = 4 };

/* A block of even tissue, as wide and deep as it is high where there are slices enough. */
struct cube {
	double spread; /* between the means of its eighths: of structure, more than of noise; cubes are sorted by it */
	double noise;  /* variance by differences of slices half its height apart */
	double shared; /* covariance of the means of both halves of its slices, each less its plane */
};

static int by_spread(const void *a, const void *b)
{
	const double x = ((const struct cube *)a)->spread, y = ((const struct cube *)b)->spread;

	return (x > y) - (x < y);
}

/* Half the sum of squares about the mean of each difference between a slice and that half the cube's height above. */
static double noise_in(const struct slices *s, const int corner[3], int side, int half)
{
	const int pixels = side * side;
	double squares = 0;

	for (int z = 0; z < half; z++) {
		double sum = 0, square = 0;

		for (int y = 0; y < side; y++)
			for (int x = 0; x < side; x++) {
				const double d = at(s, corner[0] + x, corner[1] + y, corner[2] + z) -
						 at(s, corner[0] + x, corner[1] + y, corner[2] + z + half);

				sum += d;
				square += d * d;
			}
		squares += (square - sum * sum / pixels) / 2;
	}
	return squares / ((double)half * (pixels - 1));
}

/* Sums over a slice of a product of two images and of each with 1, x and y, about the middle. */
struct moments {
	double product, one[2], x[2], y[2];
};

/* The covariance of the means of the lower and the upper slices, a plane fitted to each of them taken off. */
static double shared_in(const struct slices *s, const int corner[3], int side, int half)
{
	const double middle = (side - 1) / 2.0, pixels = (double)side * side, steps = pixels * (pixels - 1) / 12;
	struct moments m = {0};

	for (int y = 0; y < side; y++)
		for (int x = 0; x < side; x++) {
			double mean[2] = {0, 0};

			for (int z = 0; z < 2 * half; z++)
				mean[z >= half] += at(s, corner[0] + x, corner[1] + y, corner[2] + z) / half;
			m.product += mean[0] * mean[1];
			for (int i = 0; i < 2; i++) {
				m.one[i] += mean[i];
				m.x[i] += mean[i] * (x - middle);
				m.y[i] += mean[i] * (y - middle);
			}
		}
	/* `steps` is the sum of (x - middle)^2: pixels (side^2 - 1) / 12. */
	return (m.product - m.one[0] * m.one[1] / pixels - m.x[0] * m.x[1] / steps - m.y[0] * m.y[1] / steps) /
	       (pixels - 3);
}

static double spread_in(const struct slices *s, const int corner[3], int side, int half)
{
	double eighths[8] = {0}, least = INFINITY, most = -INFINITY;

	for (int z = 0; z < 2 * half; z++)
		for (int y = 0; y < side; y++)
			for (int x = 0; x < side; x++)
				eighths[(z >= half) * 4 + (2 * y >= side) * 2 + (2 * x >= side)] +=
				    at(s, corner[0] + x, corner[1] + y, corner[2] + z);
	for (int i = 0; i < 8; i++) {
		least = fmin(least, eighths[i]);
		most = fmax(most, eighths[i]);
	}
	return most - least;
}

static bool is_even(const struct slices *s, const int corner[3], int side, int height)
{
	for (int z = 0; z < height; z++)
		for (int y = 0; y < side; y++)
			for (int x = 0; x < side; x++)
				if (!s->even[place_of(s, corner[0] + x, corner[1] + y, corner[2] + z)])
					return false;
	return true;
}

/* Cubes that overlap by half of each side, or lie apart where there would be too many. */
static size_t take_cubes(const struct slices *s, int side, int height, struct cube *cubes)
{
	const int *size = s->grid->size, half = height / 2;
	const double all = (double)size[0] * size[1] * size[2] / ((double)side * side * height);
	const int apart = (int)fmax(side / 2, ceil(side * cbrt(all / CUBES_MOST)));
	const int above = (int)fmax(half, ceil(height * cbrt(all / CUBES_MOST)));
	size_t count = 0;

	for (int z = 0; z + height <= size[2]; z += above)
		for (int y = 0; y + side <= size[1]; y += apart)
			for (int x = 0; x + side <= size[0] && count < CUBES_MOST; x += apart) {
				const int corner[3] = {x, y, z};
				struct cube *cube = &cubes[count];

				if (!is_even(s, corner, side, height))
					continue;
				cube->spread = spread_in(s, corner, side, half);
				cube->noise = noise_in(s, corner, side, half);
				cube->shared = shared_in(s, corner, side, half);
				count += isfinite(cube->spread) && isfinite(cube->noise) && isfinite(cube->shared);
			}
	return count;
}

static double median(double *values, size_t count)
{
	qsort(values, count, sizeof(*values), ascending);
	return count % 2 ? values[count / 2] : (values[count / 2 - 1] + values[count / 2]) / 2;
}

/*
 * Over the quarter of the cubes with the least structure: the mean of the noise, which TV leaves in few of them, and
 * the median of what slices share. `scale`: of the cubes, as the image is blurred. NaN stays where there are too few.
 */
static int measure_noise(const struct slices *s, int scale, struct volume_quality *quality, struct error *err)
{
	const int side = CUBE * scale, height = s->grid->size[2] < side ? s->grid->size[2] & ~1 : side;
	struct cube *cubes;
	double *values, noise = 0;
	size_t count, chosen;

	if (height < 2)
		return 0;
	cubes = malloc(CUBES_MOST * sizeof(*cubes));
	values = malloc(CUBES_MOST * sizeof(*values));
	if (cubes == NULL || values == NULL) {
		free(cubes);
		free(values);
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume's quality");
	}
	count = take_cubes(s, side, height, cubes);
	qsort(cubes, count, sizeof(*cubes), by_spread);
	chosen = count / 4 < CUBES_LEAST ? CUBES_LEAST : count / 4;
	if (count >= CUBES_LEAST) {
		for (size_t i = 0; i < chosen; i++)
			noise += cubes[i].noise;
		quality->noise_hu = sqrt(noise / (double)chosen);
		for (size_t i = 0; i < chosen; i++)
			values[i] = cubes[i].shared;
		quality->streak_hu = sqrt(fmax(0, median(values, chosen)));
	}
	free(cubes);
	free(values);
	return 0;
}

/* ---- rings ---- */

/* Means over circles of a slice, from the even voxels on them. */
struct circle {
	double sum, square;
	int count;
};

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

			if (bin >= most || !s->even[place_of(s, x, y, z)])
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

/* Mean of a voxel and of those in the slices below and above it. */
static double mean_along_z(const struct slices *s, const float *v)
{
	return ((double)v[0] + (double)(v - s->stride[2])[0] + (double)v[s->stride[2]]) / 3;
}

/*
 * Adds the edge between this voxel and the next along an axis, where there is a clean one. Where it crosses is taken
 * from three slices: by its own noise alone each profile would be put too well, and their mean be too narrow.
 */
static void add_edge(const struct slices *s, const int place[3], int axis, struct profile *profile)
{
	const size_t along = s->stride[axis], beside = s->stride[1 - axis];
	const float *v =
	    s->voxels + (size_t)place[2] * s->stride[2] + (size_t)place[1] * s->stride[1] + (size_t)place[0];
	const double mm = s->grid->spacing[axis], *spacing = s->grid->spacing;
	const double here = mean_along_z(s, v), next = mean_along_z(s, v + along);
	double low, high, middle, cosine, crossing, slope[2];

	if ((here < s->level) == (next < s->level) || !plateau(v, along, -7, s->mean, &low) ||
	    !plateau(v, along, 6, s->mean, &high) || fabs(high - low) < 0.5 * s->mean)
		return;
	middle = (low + high) / 2;
	if ((here < middle) == (next < middle))
		return;
	slope[0] = (next - here) / mm;
	slope[1] = (mean_along_z(s, v + beside) + mean_along_z(s, v + along + beside) - mean_along_z(s, v - beside) -
		    mean_along_z(s, v + along - beside)) /
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

	for (int z = 1; z < size[2] - 1; z += 2)
		for (int y = REACH; y < size[1] - REACH - 1; y++)
			for (int x = REACH; x < size[0] - REACH - 1; x++)
				for (int axis = 0; axis < 2; axis++)
					add_edge(s, (const int[3]){x, y, z}, axis, &profile);
	if (profile.edges < LEAST)
		return NAN;
	return of_quartiles * (crossing_of(&profile, 0.75) - crossing_of(&profile, 0.25));
}

/* Where blur makes neighbours alike, cubes are larger by so much: by edges beyond two voxels. */
static int blur_scale(double edge_mm, const struct grid *grid)
{
	const double voxels = edge_mm / fmin(grid->spacing[0], grid->spacing[1]);

	return isfinite(voxels) ? (int)fmin(SCALE_MOST, fmax(1, lrint(voxels / 2))) : 1;
}

int quality_of_slices(const float *slices, const struct grid *grid, double mu_water, struct volume_quality *ret_quality,
		      struct error *err)
{
	struct slices s = {.voxels = slices,
			   .grid = grid,
			   .stride = {1, (size_t)grid->size[0], (size_t)grid->size[0] * (size_t)grid->size[1]}};
	const double hu = 1000 / mu_water;
	struct volume_quality quality = {NAN, NAN, NAN, NAN};
	int code = 0;

	classify(&s);
	if (s.mean > 0) {
		code = find_even(&s, err);
		quality.edge_mm = edge_width(&s);
		for (int scale = blur_scale(quality.edge_mm, grid); scale > 0 && code == 0 && isnan(quality.noise_hu);
		     scale--)
			code = measure_noise(&s, scale, &quality, err);
		if (code == 0)
			code = measure_rings(&s, &quality.ring_hu, err);
		quality.noise_hu *= hu;
		quality.streak_hu *= hu;
		quality.ring_hu *= hu;
	}
	free(s.even);
	if (code == 0)
		*ret_quality = quality;
	return code;
}

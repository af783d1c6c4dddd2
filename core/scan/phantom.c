/*
 * Objects whose line integrals are known exactly.
 *
 * Each part is a unit ball, cylinder or cube after its own shift, turn about z and
 * scaling, an affine map under which a ray stays a ray: with s the source and d
 * the way to the pixel, both mapped, the ray s + t d, 0 <= t <= 1, is inside for
 * t0 < t < t1, and its integral is density (t1 - t0) |d before the map|.
 */
#include "core/scan/phantom.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { CHUNK = 256 }; /* of a row, summed in double on the stack */

/* ---- the named ones, in units of the scale ---- */

#define DEGREES(x) ((x) * (M_PI / 180))

struct model {
	const char *name;
	int count;
	const struct ellipsoid *parts;
	const double *densities; /* [count], or NULL for those of the parts */
};

/* The 3D head of Kak and Slaney, Principles of Computerized Tomographic Imaging, chapter 3, high contrast. */
static const struct ellipsoid head_parts[] = {
    {SHAPE_ELLIPSOID, {.69, .92, .9}, {0, 0, 0}, 0, 1},
    {SHAPE_ELLIPSOID, {.6624, .874, .88}, {0, 0, 0}, 0, -.8},
    {SHAPE_ELLIPSOID, {.41, .16, .21}, {-.22, 0, -.25}, DEGREES(108), -.2},
    {SHAPE_ELLIPSOID, {.31, .11, .22}, {.22, 0, -.25}, DEGREES(72), -.2},
    {SHAPE_ELLIPSOID, {.21, .25, .5}, {0, .35, -.25}, 0, .1},
    {SHAPE_ELLIPSOID, {.046, .046, .046}, {0, .1, -.25}, 0, .1},
    {SHAPE_ELLIPSOID, {.046, .023, .02}, {-.08, -.65, -.25}, 0, .1},
    {SHAPE_ELLIPSOID, {.046, .023, .02}, {.06, -.65, -.25}, DEGREES(90), .1},
    {SHAPE_ELLIPSOID, {.056, .04, .1}, {.06, -.105, .625}, DEGREES(90), .1},
    {SHAPE_ELLIPSOID, {.056, .056, .1}, {0, .1, .625}, 0, .1},
};
/* The same head with its original, low contrast. */
static const double shepp_logan_densities[] = {2, -.98, -.02, -.02, .02, .02, .01, .01, .02, -.02};

static const struct ellipsoid ball_parts[] = {{SHAPE_ELLIPSOID, {1, 1, 1}, {0, 0, 0}, 0, 1}};
static const struct ellipsoid cylinder_parts[] = {{SHAPE_CYLINDER, {1, 1, 1}, {0, 0, 0}, 0, 1}};
static const struct ellipsoid disc_parts[] = {{SHAPE_CYLINDER, {1, 1, .05}, {0, 0, 0}, 0, 1}};

/* No two parts alike, none in the mirror image of another: whatever is swapped or mirrored shows. */
static const struct ellipsoid asymmetric_parts[] = {
    {SHAPE_ELLIPSOID, {.85, .7, .75}, {.03, -.02, .04}, DEGREES(20), 1},
    {SHAPE_ELLIPSOID, {.13, .13, .13}, {.45, .1, .2}, 0, 1},
    {SHAPE_ELLIPSOID, {.12, .12, .12}, {-.15, .38, -.3}, 0, -.5},
    {SHAPE_BOX, {.1, .06, .12}, {-.4, -.22, .3}, DEGREES(30), .8},
    {SHAPE_BOX, {.06, .12, .05}, {.25, .25, -.4}, DEGREES(-15), .6},
    {SHAPE_CYLINDER, {.08, .05, .2}, {.1, -.4, -.15}, DEGREES(50), 1.5},
};

#define MODEL(name, parts, densities)                                                                                  \
	{                                                                                                              \
		name, sizeof(parts) / sizeof(*(parts)), parts, densities                                               \
	}
static const struct model models[] = {
    MODEL("shepp-logan", head_parts, shepp_logan_densities),
    MODEL("head", head_parts, NULL),
    MODEL("ball", ball_parts, NULL),
    MODEL("cylinder", cylinder_parts, NULL),
    MODEL("disc", disc_parts, NULL),
    MODEL("asymmetric", asymmetric_parts, NULL),
};
enum { MODELS = sizeof(models) / sizeof(*models) };

const char *const phantom_names[] = {"shepp-logan", "head", "ball", "cylinder", "disc", "asymmetric", NULL};
_Static_assert(sizeof(phantom_names) / sizeof(*phantom_names) == MODELS + 1, "a name for each model");

int phantom_named(struct phantom *ret_phantom, const char *name, double scale, double density, struct error *err)
{
	const struct model *model = models;
	struct ellipsoid *parts;

	while (model < models + MODELS && strcmp(name, model->name) != 0)
		model++;
	if (model == models + MODELS)
		return error_set(err, ERR_INVALID, "no phantom is called \"%.40s\"", name);
	if (!(scale > 0 && isfinite(scale)) || !isfinite(density))
		return error_set(err, ERR_INVALID, "a phantom of scale %g mm and density %g/mm", scale, density);
	parts = malloc((size_t)model->count * sizeof(*parts));
	if (parts == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a phantom of %d parts", model->count);
	for (int i = 0; i < model->count; i++) {
		parts[i] = model->parts[i];
		for (int axis = 0; axis < 3; axis++) {
			parts[i].semi_axes[axis] *= scale;
			parts[i].centre[axis] *= scale;
		}
		parts[i].density = density * (model->densities ? model->densities[i] : parts[i].density);
	}
	*ret_phantom = (struct phantom){.count = model->count, .parts = parts};
	return 0;
}

void phantom_clear(struct phantom *phantom)
{
	free(phantom->parts);
	memset(phantom, 0, sizeof(*phantom));
}

void phantom_move(struct phantom *phantom, const double shift[3])
{
	for (int i = 0; i < phantom->count; i++)
		for (int axis = 0; axis < 3; axis++)
			phantom->parts[i].centre[axis] += shift[axis];
}

/* ---- a part's own coordinates ---- */

struct map {
	double cosine, sine;
	const struct ellipsoid *part;
};

static struct map part_map(const struct ellipsoid *part)
{
	return (struct map){cos(part->angle), sin(part->angle), part};
}

static void map_direction(const struct map *map, const double d[3], double ret[3])
{
	ret[0] = (map->cosine * d[0] + map->sine * d[1]) / map->part->semi_axes[0];
	ret[1] = (map->cosine * d[1] - map->sine * d[0]) / map->part->semi_axes[1];
	ret[2] = d[2] / map->part->semi_axes[2];
}

static void map_point(const struct map *map, const double point[3], double ret[3])
{
	double d[3];

	for (int i = 0; i < 3; i++)
		d[i] = point[i] - map->part->centre[i];
	map_direction(map, d, ret);
}

/* The norm whose unit ball the shape is. */
static double gauge(enum shape shape, const double p[3])
{
	switch (shape) {
	case SHAPE_CYLINDER:
		return fmax(hypot(p[0], p[1]), fabs(p[2]));
	case SHAPE_BOX:
		return fmax(fmax(fabs(p[0]), fabs(p[1])), fabs(p[2]));
	case SHAPE_ELLIPSOID:
		break;
	}
	return vec_norm(p);
}

double phantom_density(const struct phantom *phantom, const double point[3])
{
	double sum = 0;

	for (int i = 0; i < phantom->count; i++) {
		struct map map = part_map(&phantom->parts[i]);
		double p[3];

		map_point(&map, point, p);
		if (gauge(map.part->shape, p) <= 1)
			sum += map.part->density;
	}
	return sum;
}

/* ---- chords: the part of 0 <= t <= 1 that s + t d spends inside; selects in place of branches, for vectors ---- */

struct span {
	double from, to;
};

static inline double span_length(struct span a)
{
	double from = a.from > 0 ? a.from : 0, to = a.to < 1 ? a.to : 1;

	return to > from ? to - from : 0;
}

static inline struct span span_meet(struct span a, struct span b)
{
	return (struct span){a.from > b.from ? a.from : b.from, a.to < b.to ? a.to : b.to};
}

/* a t^2 + 2 b t + c <= 0; a ray that stands still (a = 0) is inside for ever or never. */
static inline struct span span_quadratic(double a, double b, double c)
{
	double square = b * b - a * c;
	double root = sqrt(square > 0 ? square : 0);
	double inverse = 1 / (a > 0 ? a : 1);
	struct span moving = {(-b - root) * inverse, square > 0 ? (-b + root) * inverse : -INFINITY};
	struct span still = {-INFINITY, c < 0 ? INFINITY : -INFINITY};

	return a > 0 ? moving : still;
}

/* |s + t d| <= 1 */
static inline struct span span_slab(double s, double d)
{
	double inverse = 1 / (d != 0 ? d : 1);
	double t0 = (-1 - s) * inverse, t1 = (1 - s) * inverse;
	struct span moving = {t0 < t1 ? t0 : t1, t0 < t1 ? t1 : t0};
	struct span still = {-INFINITY, fabs(s) < 1 ? INFINITY : -INFINITY};

	return d != 0 ? moving : still;
}

static inline double ellipsoid_chord(const double s[3], const double d[3])
{
	return span_length(span_quadratic(vec_dot(d, d), vec_dot(s, d), vec_dot(s, s) - 1));
}

static inline double cylinder_chord(const double s[3], const double d[3])
{
	struct span round =
	    span_quadratic(d[0] * d[0] + d[1] * d[1], s[0] * d[0] + s[1] * d[1], s[0] * s[0] + s[1] * s[1] - 1);

	return span_length(span_meet(round, span_slab(s[2], d[2])));
}

static inline double box_chord(const double s[3], const double d[3])
{
	return span_length(span_meet(span_meet(span_slab(s[0], d[0]), span_slab(s[1], d[1])), span_slab(s[2], d[2])));
}

/* sum[i] += density * chord of the ray s + t (d + i step), i = 0 .. count - 1, as a share of the whole ray. */
static void add_chords(const struct ellipsoid *part, const double s[3], const double d[3], const double step[3],
		       int count, double *sum)
{
#define EACH_RAY(chord)                                                                                                \
	for (int i = 0; i < count; i++) {                                                                              \
		double ray[3] = {d[0] + i * step[0], d[1] + i * step[1], d[2] + i * step[2]};                          \
		sum[i] += part->density * chord(s, ray);                                                               \
	}
	switch (part->shape) {
	case SHAPE_ELLIPSOID:
		EACH_RAY(ellipsoid_chord)
		break;
	case SHAPE_CYLINDER:
		EACH_RAY(cylinder_chord)
		break;
	case SHAPE_BOX:
		EACH_RAY(box_chord)
		break;
	}
#undef EACH_RAY
}

double phantom_line_integral(const struct phantom *phantom, const double a[3], const double b[3])
{
	const double still[3] = {0, 0, 0};
	double way[3], sum = 0;

	for (int i = 0; i < 3; i++)
		way[i] = b[i] - a[i];
	for (int i = 0; i < phantom->count; i++) {
		struct map map = part_map(&phantom->parts[i]);
		double s[3], d[3];

		map_point(&map, a, s);
		map_direction(&map, way, d);
		add_chords(map.part, s, d, still, 1, &sum);
	}
	return sum * vec_norm(way);
}

/* From the source to the centre of a pixel. */
static void pixel_ray(const struct view *view, double column, double row, double ret[3])
{
	for (int i = 0; i < 3; i++)
		ret[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i] - view->source[i];
}

void phantom_project(const struct phantom *phantom, const struct geometry *geometry, int view_index,
		     float *ret_projection)
{
	const struct view *view = &geometry->views[view_index];
	int columns = geometry->columns;

/* Threads for a row or two would wait for each other longer than they work. */
#pragma omp parallel for schedule(dynamic, 4) if (geometry->rows >= 8)
	for (int row = 0; row < geometry->rows; row++) {
		float *line = ret_projection + (size_t)row * (size_t)columns;

		for (int first = 0; first < columns; first += CHUNK) {
			int count = columns - first < CHUNK ? columns - first : CHUNK;
			double way[3], sum[CHUNK] = {0};

			pixel_ray(view, first, row, way);
			for (int i = 0; i < phantom->count; i++) {
				struct map map = part_map(&phantom->parts[i]);
				double s[3], d[3], step[3];

				map_point(&map, view->source, s);
				map_direction(&map, way, d);
				map_direction(&map, view->column_step, step);
				add_chords(map.part, s, d, step, count, sum);
			}
			for (int i = 0; i < count; i++) {
				pixel_ray(view, first + i, row, way);
				line[first + i] = (float)(sum[i] * vec_norm(way));
			}
		}
	}
}

/* ---- voxels ---- */

/* Share of the voxel around `centre` that lies in the part, from samples^3 points. */
static double sampled_share(const struct map *map, const struct grid *grid, const double centre[3], int samples)
{
	long inside = 0;

	for (int k = 0; k < samples; k++)
		for (int j = 0; j < samples; j++)
			for (int i = 0; i < samples; i++) {
				double point[3] = {centre[0] + ((i + 0.5) / samples - 0.5) * grid->spacing[0],
						   centre[1] + ((j + 0.5) / samples - 0.5) * grid->spacing[1],
						   centre[2] + ((k + 0.5) / samples - 0.5) * grid->spacing[2]};
				double p[3];

				map_point(map, point, p);
				inside += gauge(map->part->shape, p) <= 1;
			}
	return (double)inside / ((double)samples * samples * samples);
}

/* sum[i] += density of the part, as a mean over the voxel at first + i * spacing along x. */
static void add_voxels(const struct map *map, const struct grid *grid, const double first[3], int count, int samples,
		       double *sum)
{
	const double *spacing = grid->spacing, *semi = map->part->semi_axes;
	double c = fabs(map->cosine), s = fabs(map->sine);
	/* Half of a voxel, seen along the part's axes: what lies deeper than its gauge is wholly inside. */
	double half[3] = {0.5 * (c * spacing[0] + s * spacing[1]) / semi[0],
			  0.5 * (c * spacing[1] + s * spacing[0]) / semi[1], 0.5 * spacing[2] / semi[2]};
	double reach = gauge(map->part->shape, half);

	if (fabs(first[2] - map->part->centre[2]) / semi[2] > 1 + reach)
		return;
	for (int i = 0; i < count; i++) {
		double centre[3] = {first[0] + i * spacing[0], first[1], first[2]};
		double p[3], depth, share = 1;

		map_point(map, centre, p);
		depth = gauge(map->part->shape, p);
		if (depth > 1 + reach)
			continue;
		if (depth > 1 - reach)
			share = sampled_share(map, grid, centre, samples);
		sum[i] += share * map->part->density;
	}
}

void phantom_voxelise(const struct phantom *phantom, const struct grid *grid, int samples, float *ret_volume)
{
	int nx = grid->size[0], ny = grid->size[1];

#pragma omp parallel for schedule(dynamic, 16)
	for (long row = 0; row < (long)ny * grid->size[2]; row++) {
		float *line = ret_volume + (size_t)row * (size_t)nx;

		for (int first = 0; first < nx; first += CHUNK) {
			int count = nx - first < CHUNK ? nx - first : CHUNK;
			double sum[CHUNK] = {0};
			double centre[3] = {grid->origin[0] + first * grid->spacing[0],
					    grid->origin[1] + (double)(row % ny) * grid->spacing[1],
					    grid->origin[2] + (double)(row / ny) * grid->spacing[2]};

			for (int i = 0; i < phantom->count; i++) {
				struct map map = part_map(&phantom->parts[i]);

				add_voxels(&map, grid, centre, count, samples, sum);
			}
			for (int i = 0; i < count; i++)
				line[first + i] = (float)sum[i];
		}
	}
}

/* ---- fine ray sampling of a voxel object ---- */

struct box {
	const float *volume;
	const struct grid *grid;
	size_t next[3]; /* from a voxel to its neighbour; 0 along an axis of one voxel */
	float last[3];  /* the outer voxel's centre */
	int low[3];     /* the last voxel that has a neighbour above it */
};

static struct box box_make(const float *volume, const struct grid *grid)
{
	struct box box = {.volume = volume, .grid = grid};
	size_t stride = 1;

	for (int i = 0; i < 3; i++) {
		box.next[i] = grid->size[i] > 1 ? stride : 0;
		box.last[i] = (float)(grid->size[i] - 1);
		box.low[i] = grid->size[i] > 1 ? grid->size[i] - 2 : 0;
		stride *= (size_t)grid->size[i];
	}
	return box;
}

static inline int at_most(int value, int most)
{
	return value < most ? value : most;
}

/* x, y, z in voxels; beyond the outer centres the values there are held. */
static inline float take_nearest(const struct box *box, const float p[3])
{
	return box->volume[(size_t)(p[0] + 0.5f) * box->next[0] + (size_t)(p[1] + 0.5f) * box->next[1] +
			   (size_t)(p[2] + 0.5f) * box->next[2]];
}

static inline float take_trilinear(const struct box *box, const float p[3])
{
	int x = at_most((int)p[0], box->low[0]), y = at_most((int)p[1], box->low[1]),
	    z = at_most((int)p[2], box->low[2]);
	float fx = p[0] - (float)x, fy = p[1] - (float)y, fz = p[2] - (float)z;
	size_t dx = box->next[0], dy = box->next[1];
	const float *near = box->volume + (size_t)x * dx + (size_t)y * dy + (size_t)z * box->next[2];
	const float *far = near + box->next[2];
	float n0 = near[0] + fx * (near[dx] - near[0]), n1 = near[dy] + fx * (near[dy + dx] - near[dy]);
	float f0 = far[0] + fx * (far[dx] - far[0]), f1 = far[dy] + fx * (far[dy + dx] - far[dy]);
	float n = n0 + fy * (n1 - n0), f = f0 + fy * (f1 - f0);

	return n + fz * (f - n);
}

/* Integral over the ray source + t way, 0 <= t <= 1, at the middles of equal steps between entry and exit. */
static double sample_ray(const struct box *box, const double source[3], const double way[3], enum sampling sampling,
			 double step)
{
	struct span inside = {0, 1};
	double s[3], d[3], length, sum = 0;
	float first[3], by[3];
	long count;

	for (int i = 0; i < 3; i++) {
		double half = 0.5 * box->grid->size[i];

		s[i] = (source[i] - box->grid->origin[i]) / box->grid->spacing[i];
		d[i] = way[i] / box->grid->spacing[i];
		inside = span_meet(inside, span_slab((s[i] - half + 0.5) / half, d[i] / half));
	}
	length = span_length(inside) * vec_norm(way);
	count = (long)ceil(length / step);
	for (int i = 0; i < 3 && count > 0; i++) {
		double width = (inside.to - inside.from) / (double)count;

		first[i] = (float)(s[i] + (inside.from + 0.5 * width) * d[i]);
		by[i] = (float)(width * d[i]);
	}
	for (long n = 0; n < count; n++) {
		float p[3];

		for (int i = 0; i < 3; i++) {
			float along = first[i] + (float)n * by[i];

			along = along > 0 ? along : 0;
			p[i] = along < box->last[i] ? along : box->last[i];
		}
		sum += (double)(sampling == SAMPLE_NEAREST ? take_nearest(box, p) : take_trilinear(box, p));
	}
	return count > 0 ? sum * length / (double)count : 0;
}

void volume_project_fine(const float *volume, const struct grid *grid, const struct geometry *geometry, int view_index,
			 enum sampling sampling, double step, float *ret_projection)
{
	const struct view *view = &geometry->views[view_index];
	const struct box box = box_make(volume, grid);

#pragma omp parallel for schedule(dynamic, 1)
	for (int row = 0; row < geometry->rows; row++)
		for (int column = 0; column < geometry->columns; column++) {
			double way[3];

			pixel_ray(view, column, row, way);
			ret_projection[(size_t)row * (size_t)geometry->columns + (size_t)column] =
			    (float)sample_ray(&box, view->source, way, sampling, step);
		}
}

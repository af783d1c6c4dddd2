/* Anatomy with exact line integrals, and figures of its images: see anatomy.h. */
#include "tests/unit/anatomy.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

const char *const anatomy_names[ANATOMY_COUNT] = {"head", "head and neck", "wrist", "abdomen"};

static const double WATER = 0.0192; /* 1/mm */

/* ---- random numbers: splitmix64 (Steele, Lea and Flood 2014) ---- */

static double uniform(uint64_t *state)
{
	uint64_t z = *state += 0x9e3779b97f4a7c15u;

	z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
	z = (z ^ z >> 27) * 0x94d049bb133111ebu;
	return ((double)((z ^ z >> 31) >> 11) + 0.5) / 9007199254740992.0;
}

/* Knuth's products for few, the normal approximation for many. */
static double poisson(uint64_t *state, double mean)
{
	const double many = 60, limit = exp(-mean);
	double product = 1;
	int count = -1;

	if (mean > many)
		return fmax(0, floor(mean + 0.5 +
				     sqrt(mean) * sqrt(-2 * log(uniform(state))) * cos(2 * M_PI * uniform(state))));
	do {
		product *= uniform(state);
		count++;
	} while (product > limit);
	return count;
}

/* ---- the objects: densities are HU above what is already there ---- */

struct body {
	struct phantom phantom;
	int room;
	double scale, half; /* half: of the object's length along z, mm */
	uint64_t random;
	double edge[3];
	bool failed; /* out of memory */
};

static void add(struct body *body, enum shape shape, const double axes[3], const double centre[3], double angle,
		double hu)
{
	struct phantom *phantom = &body->phantom;

	if (phantom->count == body->room) {
		const int room = 2 * body->room + 64;
		struct ellipsoid *parts = realloc(phantom->parts, (size_t)room * sizeof(*parts));

		if (parts == NULL) {
			body->failed = true;
			return;
		}
		phantom->parts = parts;
		body->room = room;
	}
	phantom->parts[phantom->count++] = (struct ellipsoid){.shape = shape,
							      .semi_axes = {axes[0], axes[1], axes[2]},
							      .centre = {centre[0], centre[1], centre[2]},
							      .angle = angle,
							      .density = WATER * hu / 1000};
}

/* All along z. */
static void add_tube(struct body *body, double x, double y, double a, double b, double angle, double hu)
{
	const double s = body->scale;

	add(body, SHAPE_CYLINDER, (double[3]){a * s, b * s, body->half}, (double[3]){x * s, y * s, 0}, angle, hu);
}

static void add_bone(struct body *body, double x, double y, double a, double b, double angle, double shell,
		     double cortical, double trabecular)
{
	add_tube(body, x, y, a, b, angle, cortical);
	add_tube(body, x, y, a - shell, b - shell, angle, trabecular - cortical);
}

static void add_rod(struct body *body, double x, double y, double radius, double hu)
{
	add_tube(body, x, y, radius, radius, 0, hu);
	body->edge[0] = x * body->scale;
	body->edge[1] = y * body->scale;
	body->edge[2] = radius * body->scale;
}

/* Ellipsoids at random places of an ellipse, brighter or darker by least to most HU. */
static void scatter(struct body *body, int count, const double ellipse[4], const double radius[2], double least,
		    double most)
{
	for (int i = 0; i < count; i++) {
		const double turn = 2 * M_PI * uniform(&body->random), out = sqrt(uniform(&body->random));
		const double r = radius[0] + (radius[1] - radius[0]) * uniform(&body->random), s = body->scale;
		const double place[3] = {s * (ellipse[0] + out * ellipse[2] * cos(turn)),
					 s * (ellipse[1] + out * ellipse[3] * sin(turn)),
					 (2 * uniform(&body->random) - 1) * 0.8 * body->half};
		const double axes[3] = {s * r, s * r * (0.7 + 0.6 * uniform(&body->random)),
					s * r * (0.7 + 0.6 * uniform(&body->random))};
		const double hu = least + (most - least) * uniform(&body->random);

		add(body, SHAPE_ELLIPSOID, axes, place, 3 * uniform(&body->random),
		    uniform(&body->random) < 0.5 ? -hu : hu);
	}
}

static void make_head(struct body *body)
{
	add_tube(body, 0, 0, 74, 93, 0, 1000);
	add_tube(body, 0, 0, 70, 89, 0, 850);
	add_tube(body, 0, 0, 64, 83, 0, -815);
	add_tube(body, -9, 12, 7, 24, 0.25, -28);
	add_tube(body, 10, 12, 7, 23, -0.25, -28);
	add_tube(body, 0, -72, 9, 5, 0, -1000);
	add_rod(body, -27, -34, 9, 300);
	scatter(body, 12, (double[4]){0, 0, 50, 68}, (double[2]){3, 10}, 20, 100);
	scatter(body, 80, (double[4]){0, 38, 34, 24}, (double[2]){1, 3}, 20, 60);
}

static void make_neck(struct body *body)
{
	add_tube(body, 0, 0, 62, 58, 0, 950);
	add_tube(body, 0, 0, 55, 51, 0, 95);
	add_tube(body, 0, -24, 9, 8, 0, -1045);
	add_bone(body, 0, 13, 13, 10, 0, 1.5, 900, 250);
	add_bone(body, -15, 33, 4, 9, 0.6, 1.2, 800, 300);
	add_bone(body, 15, 33, 4, 9, -0.6, 1.2, 800, 300);
	add_bone(body, 0, -44, 30, 6, 0, 1.8, 1100, 400);
	add_rod(body, -32, -8, 6, 280);
	scatter(body, 9, (double[4]){0, 0, 42, 36}, (double[2]){2, 7}, 20, 100);
	scatter(body, 120, (double[4]){0, 13, 10, 7}, (double[2]){0.6, 1.4}, 50, 150);
}

static void make_wrist(struct body *body)
{
	add_tube(body, 0, 0, 30, 21, 0, 1040);
	add_bone(body, -12, 2, 9, 7, 0.2, 1.3, 1050, 220);
	add_bone(body, 11, -2, 7, 6, -0.3, 1.2, 950, 280);
	add_rod(body, 1, 13, 3, 300);
	scatter(body, 260, (double[4]){-12, 2, 6.5, 4.5}, (double[2]){0.4, 0.9}, 70, 220);
	scatter(body, 150, (double[4]){11, -2, 5, 4}, (double[2]){0.4, 0.8}, 70, 220);
	scatter(body, 6, (double[4]){0, 0, 22, 15}, (double[2]){1, 3}, 20, 100);
}

static void make_abdomen(struct body *body)
{
	add_tube(body, 0, 0, 160, 112, 0, 900);
	add_tube(body, 0, 0, 144, 96, 0, 140);
	add_tube(body, -70, -12, 60, 52, 0.3, 45);
	add_tube(body, 78, 28, 26, 32, 0, 55);
	add_bone(body, 0, 62, 22, 18, 0, 3, 600, 170);
	add_tube(body, 0, 24, 12, 12, 0, 110);
	add_bone(body, -112, 40, 12, 5, 0.9, 2, 800, 200);
	add_bone(body, 112, 40, 12, 5, -0.9, 2, 800, 200);
	add(body, SHAPE_ELLIPSOID, (double[3]){15 * body->scale, 9 * body->scale, body->half * 0.5},
	    (double[3]){42 * body->scale, -52 * body->scale, 0}, 0.4, -1000);
	add_rod(body, -18, -56, 11, 260);
	scatter(body, 18, (double[4]){0, 0, 110, 65}, (double[2]){4, 14}, 20, 100);
	scatter(body, 80, (double[4]){30, -20, 70, 45}, (double[2]){3, 8}, 20, 60);
}

/* ---- small spheres ---- */

/* Lengths in voxels. Tissue is even where it varies by a share of water's attenuation at most. */
static const double SPHERE_RADIUS = 2, SPHERE_ROOM = 5, SPHERES_APART = 8, SPHERE_HU = 30, EVEN = 0.035;

/* Whether the tissue is even around this voxel, and no other sphere is near. */
static bool has_room(const struct anatomy_scan *scan, const int place[3])
{
	const int *size = scan->grid.size, room = (int)SPHERE_ROOM;
	const size_t row = (size_t)size[0], slice = row * (size_t)size[1];
	const float *at = scan->background + (size_t)place[2] * slice + (size_t)place[1] * row + place[0];

	for (int z = -room; z <= room; z++)
		for (int y = -room; y <= room; y++)
			for (int x = -room; x <= room; x++)
				if (x * x + y * y + z * z <= room * room &&
				    fabs((double)(at[z * (long)slice + y * (long)row + x] - *at)) > EVEN * WATER)
					return false;
	for (int i = 0; i < scan->sphere_count; i++) {
		double square = 0;

		for (int a = 0; a < 3; a++) {
			const double away =
			    scan->grid.origin[a] + place[a] * scan->grid.spacing[a] - scan->spheres[i][a];

			square += away * away;
		}
		if (square < pow(SPHERES_APART * scan->grid.spacing[0], 2))
			return false;
	}
	return (double)*at > 0.8 * WATER && (double)*at < 1.2 * WATER;
}

/* Darker and brighter ones in turn, so that a slope beneath them does not count. */
static void add_spheres(struct anatomy_scan *scan, struct body *body)
{
	const double radius = SPHERE_RADIUS * scan->grid.spacing[0];

	for (int tries = 0; tries < 20000 && scan->sphere_count < SPHERES_MOST; tries++) {
		double *sphere = scan->spheres[scan->sphere_count];
		int place[3];

		for (int a = 0; a < 3; a++) {
			const int margin = (int)SPHERE_ROOM + (a == 2 ? 1 : 0);

			place[a] = margin + (int)((scan->grid.size[a] - 2 * margin) * uniform(&body->random));
			sphere[a] = scan->grid.origin[a] + place[a] * scan->grid.spacing[a];
		}
		if (!has_room(scan, place))
			continue;
		sphere[3] = scan->sphere_count++ % 2 ? SPHERE_HU : -SPHERE_HU;
		add(body, SHAPE_ELLIPSOID, (double[3]){radius, radius, radius}, sphere, 0, sphere[3]);
	}
}

/* ---- the scan ---- */

static int make_geometry(struct geometry *ret_geometry, const struct anatomy_spec *spec, struct error *err)
{
	const struct circular circular = {
	    620, 1100, {spec->pixel * 1100 / 620, spec->pixel * 1100 / 620}, {0, 0}, {0, 0}};
	const double across = spec->voxel * hypot(spec->size[0], spec->size[1]), along = spec->voxel * spec->size[2];
	double *angles = malloc(sizeof(*angles) * (size_t)spec->views);
	int code;

	if (angles == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d angles", spec->views);
	for (int i = 0; i < spec->views; i++)
		angles[i] = spec->arc * M_PI / 180 * i / (spec->arc < 360 ? spec->views - 1 : spec->views);
	/* The cone is wider in front of the isocentre than at it. */
	code = geometry_circular(ret_geometry, (int)(1.04 * across / spec->pixel) + 4,
				 (int)(1.25 * along / spec->pixel) + 6, spec->views, &circular, angles, err);
	free(angles);
	return code;
}

static void add_noise(float *projection, size_t pixels, double photons, uint64_t seed)
{
	uint64_t random = seed;

	for (size_t i = 0; i < pixels; i++) {
		const double counted = poisson(&random, photons * exp(-(double)projection[i]));

		projection[i] = (float)-log(fmax(counted, 0.5) / photons);
	}
}

int anatomy_scan_make(struct anatomy_scan *ret_scan, const struct anatomy_spec *spec, struct error *err)
{
	static void (*const makers[ANATOMY_COUNT])(struct body *) = {make_head, make_neck, make_wrist, make_abdomen};
	struct body body = {.scale = spec->scale, .half = 0.42 * spec->voxel * spec->size[2], .random = spec->seed};
	struct anatomy_scan scan = {0};
	size_t pixels;
	int code;

	makers[spec->what](&body);
	scan.grid = (struct grid){.size = {spec->size[0], spec->size[1], spec->size[2]},
				  .spacing = {spec->voxel, spec->voxel, spec->voxel}};
	grid_centre(&scan.grid);
	memcpy(scan.edge, body.edge, sizeof(scan.edge));
	code = make_geometry(&scan.geometry, spec, err);
	if (code < 0)
		goto out;
	pixels = (size_t)scan.geometry.columns * (size_t)scan.geometry.rows;
	scan.projections = malloc(sizeof(float) * pixels * (size_t)spec->views);
	scan.truth = malloc(sizeof(float) * grid_voxels(&scan.grid));
	scan.background = malloc(sizeof(float) * grid_voxels(&scan.grid));
	if (!body.failed && scan.background != NULL) {
		phantom_voxelise(&body.phantom, &scan.grid, 3, scan.background);
		add_spheres(&scan, &body);
	}
	if (body.failed || scan.projections == NULL || scan.truth == NULL || scan.background == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a scan of %d views", spec->views);
		goto out;
	}
	phantom_voxelise(&body.phantom, &scan.grid, 3, scan.truth);
	for (int view = 0; view < spec->views; view++) {
		float *projection = scan.projections + pixels * (size_t)view;

		phantom_project(&body.phantom, &scan.geometry, view, projection);
		if (spec->photons > 0)
			add_noise(projection, pixels, spec->photons, (uint64_t)spec->seed << 32 | (uint64_t)view);
	}
	*ret_scan = scan;
out:
	if (code < 0)
		anatomy_scan_clear(&scan);
	phantom_clear(&body.phantom);
	return code;
}

void anatomy_scan_clear(struct anatomy_scan *scan)
{
	geometry_clear(&scan->geometry);
	free(scan->projections);
	free(scan->truth);
	free(scan->background);
	*scan = (struct anatomy_scan){0};
}

/* ---- what an image is worth ---- */

static double hu_of(float value)
{
	return 1000 * ((double)value / WATER - 1);
}

/* Sums over bins of a line through a constant and an error function, for least squares. */
struct edge_fit {
	double count, step, step2, value, product, value2;
};

enum { BINS = 80 };
static const double BIN = 0.125; /* voxels */

/* Mean values over the distance to the rod's surface, five voxels to either side. */
static void edge_profile(const struct anatomy_scan *scan, const float *volume, double ret_sum[BINS],
			 double ret_count[BINS])
{
	const int *size = scan->grid.size;
	const double voxel = scan->grid.spacing[0];

	memset(ret_sum, 0, BINS * sizeof(*ret_sum));
	memset(ret_count, 0, BINS * sizeof(*ret_count));
	for (int y = 0; y < size[1]; y++)
		for (int x = 0; x < size[0]; x++) {
			const double away = hypot(scan->grid.origin[0] + x * voxel - scan->edge[0],
						  scan->grid.origin[1] + y * voxel - scan->edge[1]) -
					    scan->edge[2];
			const int bin = (int)floor(away / voxel / BIN) + BINS / 2;

			if (bin < 0 || bin >= BINS || fabs(away) > 0.6 * scan->edge[2])
				continue;
			for (int z = size[2] / 4; z < size[2] * 3 / 4; z++) {
				ret_sum[bin] += hu_of(
				    volume[((size_t)z * (size_t)size[1] + (size_t)y) * (size_t)size[0] + (size_t)x]);
				ret_count[bin]++;
			}
		}
}

/* The squared error of the best edge of this place and width (standard deviation), both in voxels. */
static double edge_error(const double sum[BINS], const double count[BINS], double place, double width)
{
	struct edge_fit f = {0};
	double determinant, low, high;

	for (int i = 0; i < BINS; i++) {
		const double m = 0.5 * erfc(((i - BINS / 2 + 0.5) * BIN - place) / width / sqrt(2));
		const double n = count[i], v = n > 0 ? sum[i] / n : 0;

		f.count += n;
		f.step += n * m;
		f.step2 += n * m * m;
		f.value += n * v;
		f.product += n * m * v;
		f.value2 += n * v * v;
	}
	determinant = f.count * f.step2 - f.step * f.step;
	low = (f.step2 * f.value - f.step * f.product) / determinant;
	high = (f.count * f.product - f.step * f.value) / determinant;
	return f.value2 - low * f.value - high * f.product;
}

static double edge_width(const struct anatomy_scan *scan, const float *volume)
{
	double sum[BINS], count[BINS], least = INFINITY, best = 0;

	edge_profile(scan, volume, sum, count);
	for (double width = 0.1; width < 4; width *= 1.04)
		for (double place = -1.5; place <= 1.5; place += 0.25) {
			const double error = edge_error(sum, count, place, width);

			if (error < least) {
				least = error;
				best = width;
			}
		}
	return best * 2 * sqrt(2 * log(2));
}

/* How far the inner voxels of a sphere are above those of a shell around it. */
static double sphere_contrast(const struct anatomy_scan *scan, const float *volume, const double sphere[4])
{
	const int *size = scan->grid.size, room = (int)SPHERE_ROOM;
	double sum[2] = {0, 0}, count[2] = {0, 0};
	int place[3];

	for (int a = 0; a < 3; a++)
		place[a] = (int)lround((sphere[a] - scan->grid.origin[a]) / scan->grid.spacing[a]);
	for (int z = -room; z <= room; z++)
		for (int y = -room; y <= room; y++)
			for (int x = -room; x <= room; x++) {
				const double away = sqrt(x * x + y * y + z * z);
				const size_t i = ((size_t)(place[2] + z) * (size_t)size[1] + (size_t)(place[1] + y)) *
						     (size_t)size[0] +
						 (size_t)(place[0] + x);

				if (away > 0.75 * SPHERE_RADIUS && (away < SPHERE_RADIUS + 1 || away > SPHERE_ROOM))
					continue;
				sum[away < SPHERE_RADIUS] += hu_of(volume[i]) - hu_of(scan->background[i]);
				count[away < SPHERE_RADIUS]++;
			}
	return sum[1] / count[1] - sum[0] / count[0];
}

struct image_figures anatomy_figures(const struct anatomy_scan *scan, const float *volume)
{
	const int *size = scan->grid.size;
	const size_t slice = (size_t)size[0] * (size_t)size[1];
	struct image_figures figures = {0};
	double body = 0, bone = 0;

	for (size_t i = slice * (size_t)(size[2] / 4); i < slice * (size_t)(size[2] * 3 / 4); i++) {
		const double truth = hu_of(scan->truth[i]), away = hu_of(volume[i]) - truth;

		if (truth > -500) {
			figures.rmse += away * away;
			body++;
		}
		if (truth > 500) {
			figures.bone += away;
			bone++;
		}
	}
	figures.rmse = sqrt(figures.rmse / fmax(body, 1));
	figures.bone /= fmax(bone, 1);
	figures.fwhm = edge_width(scan, volume);
	for (int i = 0; i < scan->sphere_count; i++)
		figures.contrast +=
		    sphere_contrast(scan, volume, scan->spheres[i]) / scan->spheres[i][3] / scan->sphere_count;
	return figures;
}

/* ---- reconstruction ---- */

struct taken {
	const struct recipe *recipe;
	float **volumes;
	int count;
	double noise, alpha;
};

static int on_keep(void *context, struct recon *recon, const struct kept_volume *volume, struct error *err)
{
	struct taken *taken = context;
	const size_t voxels = grid_voxels(volume->grid);
	float *slices = malloc(sizeof(*slices) * voxels);

	if (slices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", voxels);
	/* As many as are emitted, and the final one; the last emitted may be the final one too. */
	free(taken->volumes[taken->count]);
	taken->volumes[taken->count] = slices;
	if (taken->count < taken->recipe->emits)
		taken->count++;
	return recon_read(recon, 0, volume->grid->size[2], slices, err);
}

static void on_denoising(void *context, double noise_hu, double alpha)
{
	struct taken *taken = context;

	taken->noise = noise_hu;
	taken->alpha = alpha;
}

int anatomy_reconstruct(const struct anatomy_scan *scan, const struct backend *backend, struct device *device,
			const struct recipe *recipe, float **ret_volumes, double *ret_noise, double *ret_alpha,
			struct error *err)
{
	struct taken taken = {.recipe = recipe, .volumes = ret_volumes};
	const struct recon_hooks hooks = {.context = &taken, .keep = on_keep, .denoising = on_denoising};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	int *views = malloc(sizeof(*views) * (size_t)scan->geometry.count), code;
	struct recon *recon = NULL;

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of views");
	for (int i = 0; i < scan->geometry.count; i++)
		views[i] = i;
	memset(ret_volumes, 0, ((size_t)recipe->emits + 1) * sizeof(*ret_volumes));
	code = recon_open(backend, device, &scan->geometry, &linearise, recipe, &hooks, &recon, err);
	if (code == 0)
		code = recon_push(recon, scan->projections, views, scan->geometry.count, err);
	if (code == 0)
		code = recon_run(recon, err);
	recon_free(recon);
	free(views);
	*ret_noise = taken.noise;
	*ret_alpha = taken.alpha;
	return code;
}

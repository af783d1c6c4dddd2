/* Scans by an arm, or of a body, that departs from what they say: see departed.h. */
#include "tests/bench/departed.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "core/fit/least_squares.h"
#include "tests/bench/fdk_volume.h"

enum { POINTS = 18, STRIDE = 3 };
static const double HU = 1000 / BODY_WATER, WIDTH = 379.456; /* mm, of the detector */

/* A turn about a point, then a shift: mm, and a vector of rotation about one axis. */
static void turn_about(const double centre[3], int axis, double angle, const double shift[3],
		       double ret_motion[PATH_NUMBERS])
{
	const int a = (axis + 1) % 3, b = (axis + 2) % 3;

	memset(ret_motion, 0, PATH_NUMBERS * sizeof(*ret_motion));
	memcpy(ret_motion, shift, 3 * sizeof(*ret_motion));
	ret_motion[3 + axis] = angle;
	ret_motion[a] += centre[a] - (cos(angle) * centre[a] - sin(angle) * centre[b]);
	ret_motion[b] += centre[b] - (sin(angle) * centre[a] + cos(angle) * centre[b]);
}

/* Where the object lies at a share of the sweep. What is there behind a nod or a turn stays so. */
static void motion_at(enum departed_motion motion, double share, double ret_motion[PATH_NUMBERS])
{
	static const double neck[3] = {0, 20, -60}, wrist[3] = {16, -22, -64}, degree = M_PI / 180;
	const double passed = fmin(.5, fmax(-.5, (share - .5) / .1));
	const double behind = .5 + .5 * sin(M_PI * passed), amid = pow(cos(M_PI * passed), 2);
	const double tremor = sin(2 * M_PI * 25 * share);

	switch (motion) {
	case MOTION_NONE:
		memset(ret_motion, 0, PATH_NUMBERS * sizeof(*ret_motion));
		break;
	case MOTION_NOD:
		turn_about(neck, 0, 3 * degree * behind, (double[]){0, 3 / sqrt(2) * behind, 3 / sqrt(2) * behind},
			   ret_motion);
		break;
	case MOTION_DRIFT:
		turn_about(wrist, 1, 2 * degree * share, (double[]){2 * share, -1 * share, 2 * share}, ret_motion);
		break;
	case MOTION_TURN:
		turn_about(wrist, 2, 3 * degree * behind, (double[]){0, 3 / sqrt(2) * behind, 3 / sqrt(2) * behind},
			   ret_motion);
		break;
	case MOTION_JERK:
		turn_about(wrist, 0, 3 * degree * amid, (double[]){2 * amid, 1 * amid, 2 * amid}, ret_motion);
		break;
	case MOTION_TREMOR:
		turn_about(wrist, 0, .3 * degree * tremor, (double[]){.3 * tremor, .25 * tremor, .3 * tremor},
			   ret_motion);
		break;
	}
}

int departed_open(struct departed *scan, const struct departure *departure, enum kind kind, int seed, int columns,
		  int count, double arc, struct error *err)
{
	const size_t pixels = (size_t)columns * (size_t)(columns * 60 / 77);
	int code;

	*scan = (struct departed){.arm = {.columns = columns,
					  .rows = columns * 60 / 77,
					  .count = count,
					  .pixel = WIDTH / columns,
					  .first = .3 + seed,
					  .step = arc * M_PI / 180 / (arc < 360 ? count - 1 : count),
					  .seed = (unsigned)seed,
					  .sag = departure->sag,
					  .jitter = departure->jitter}};
	code = arm_nominal_geometry(&scan->arm, &scan->said, err);
	if (code == 0)
		code = geometry_copy(&scan->truth, &scan->said, err);
	scan->projections = malloc((size_t)count * pixels * sizeof(float));
	if (code == 0 && scan->projections == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	if (code < 0)
		return code;
	for (int k = 0; k < count; k++)
		for (int a = 0; a < 3; a++)
			scan->said.views[k].pixel0[a] +=
			    departure->aside * columns * scan->said.views[k].column_step[a];
	make_body(&scan->body, kind, seed);
	for (int k = 0; k < count; k++) {
		double motion[PATH_NUMBERS];
		struct view view = arm_view(&scan->arm, k);

		for (int a = 0; a < 3; a++)
			view.pixel0[a] += departure->aside * columns * view.column_step[a];
		motion_at(departure->motion, (double)k / count, motion);
		scan->truth.views[k] = view_of_moved(&view, motion);
		body_take(&scan->body, &scan->truth.views[k], columns, scan->arm.rows,
			  scan->projections + (size_t)k * pixels);
	}
	random_seed((uint64_t)seed);
	for (size_t i = 0; i < (size_t)count * pixels && departure->photons > 0; i++) {
		const double mean = departure->photons * exp(-(double)scan->projections[i]);

		scan->projections[i] = (float)-log(fmax(.5, mean + sqrt(mean) * normal()) / departure->photons);
	}
	return 0;
}

void departed_close(struct departed *scan)
{
	geometry_clear(&scan->truth);
	geometry_clear(&scan->said);
	free(scan->projections);
}

/* ---- how far a geometry is off ---- */

struct pair {
	const struct geometry *truth, *said;
};

/* Pixels between where points lie and where the geometry says, moved as a whole, at the isocentre in mm. */
static void distances(void *context, const double *motion, double *ret)
{
	const struct pair *pair = context;
	const double mm = vec_norm(pair->said->views[0].column_step) * 620 / 1100;

	for (int k = 0; k < pair->truth->count; k += STRIDE) {
		const struct view moved = view_of_moved(&pair->said->views[k], motion);
		double there[12], here[12];

		view_matrix(&pair->truth->views[k], there);
		view_matrix(&moved, here);
		for (int i = 0; i < POINTS; i++) {
			const double point[3] = {60 * cos(i * M_PI / 3), 60 * sin(i * M_PI / 3), 45 * (i / 6 - 1)};
			double a[2], b[2];

			view_project(there, point, &a[0], &a[1]);
			view_project(here, point, &b[0], &b[1]);
			*ret++ = mm * (a[0] - b[0]);
			*ret++ = mm * (a[1] - b[1]);
		}
	}
}

int departed_compare(const struct geometry *truth, const struct geometry *said, double *ret_mm,
		     double ret_motion[PATH_NUMBERS], struct error *err)
{
	struct pair pair = {truth, said};
	const struct least_squares problem = {.parameters = PATH_NUMBERS,
					      .residuals = 2 * POINTS * ((truth->count + STRIDE - 1) / STRIDE),
					      .context = &pair,
					      .residuals_of = distances,
					      .step = 1e-4,
					      .most = 30};
	double rms;
	int code;

	memset(ret_motion, 0, PATH_NUMBERS * sizeof(*ret_motion));
	code = least_squares(&problem, ret_motion, &rms, err);
	*ret_mm = rms * sqrt(2);
	return code;
}

/* ---- the volume's error ---- */

int departed_error(const struct backend *backend, const struct departed *scan, const struct geometry *geometry,
		   const double motion[PATH_NUMBERS], int voxels, double *ret_hu, struct error *err)
{
	const struct phantom phantom = {.count = scan->body.count, .parts = (struct ellipsoid *)scan->body.parts};
	struct geometry moved = {0};
	struct grid grid;
	struct orbit orbit;
	float *volume = NULL;
	double squares = 0, radius = 0;
	long count = 0;
	int code = orbit_analyse(&orbit, &scan->said, err);

	if (code == 0) {
		orbit_default_grid(&orbit, &scan->said, voxels, &grid);
		radius = .45 * orbit.field_of_view;
		volume = malloc(grid_voxels(&grid) * sizeof(float));
		code = geometry_copy(&moved, geometry, err);
	}
	for (int k = 0; k < geometry->count && code == 0; k++)
		moved.views[k] = view_of_moved(&geometry->views[k], motion);
	if (code == 0)
		code = fdk_volume(backend, &moved, WINDOW_HANN, scan->projections, &grid, volume, err);
#pragma omp parallel for reduction(+ : squares, count) schedule(dynamic)
	for (int z = 2; z < grid.size[2] - 2; z += 2)
		for (int y = 0; y < grid.size[1]; y += 2)
			for (int x = 0; x < grid.size[0] && code == 0; x += 2) {
				const double p[3] = {grid.origin[0] + x * grid.spacing[0],
						     grid.origin[1] + y * grid.spacing[1],
						     grid.origin[2] + z * grid.spacing[2]};
				double density = 0;

				if (hypot(p[0], p[1]) > radius)
					continue;
				for (int i = 0; i < 8; i++) {
					double q[3];

					for (int a = 0; a < 3; a++)
						q[a] = p[a] + ((i >> a & 1) - .5) / 2 * grid.spacing[a];
					density += phantom_density(&phantom, q) / 8;
				}
				if (density < .3 * BODY_WATER || density > 3 * BODY_WATER)
					continue;
				squares += pow(HU * ((double)volume[grid_voxel(&grid, x, y, z)] - density), 2);
				count++;
			}
	*ret_hu = sqrt(squares / (double)(count > 0 ? count : 1));
	geometry_clear(&moved);
	orbit_clear(&orbit);
	free(volume);
	return code;
}

double departed_distance(const struct geometry *a, const struct geometry *b)
{
	static const double still[PATH_NUMBERS] = {0};
	const int residuals = 2 * POINTS * ((a->count + STRIDE - 1) / STRIDE);
	struct pair pair = {a, b};
	double *each = malloc((size_t)residuals * sizeof(double)), squares = 0;

	if (each == NULL)
		return NAN;
	distances(&pair, still, each);
	for (int i = 0; i < residuals; i++)
		squares += each[i] * each[i] / residuals;
	free(each);
	return sqrt(2 * squares);
}

/* ---- what is found ---- */

/* Of all processors together, and of the clock on the wall. */
static void read_clocks(double ret_seconds[2])
{
	struct timespec now;

	clock_gettime(CLOCK_MONOTONIC, &now);
	ret_seconds[0] = (double)clock() / CLOCKS_PER_SEC;
	ret_seconds[1] = (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

int departed_refine(const struct departed *scan, enum refine_kind kind, const struct backend *backend,
		    const struct refine_reference *reference, struct geometry *ret_geometry,
		    struct refinement *ret_refinement, double ret_seconds[2], struct error *err)
{
	const size_t pixels = (size_t)scan->arm.columns * (size_t)scan->arm.rows;
	struct refine_device on = {.backend = backend};
	struct reduced reduced = {0};
	struct orbit orbit = {0};
	double began[2] = {0};
	int code = orbit_analyse(&orbit, &scan->said, err);

	if (code == 0)
		code = backend->open(0, &(struct device_options){0}, &on.device, err);
	read_clocks(began);
	if (code == 0)
		code = reduced_open(&reduced, &scan->said, &orbit, REFINE_VIEWS_MOST, REFINE_BINS_MOST, err);
	for (int k = 0; k < scan->said.count && code == 0; k++)
		if (reduced_wants(&reduced, k))
			reduced_take(&reduced, k, scan->projections + (size_t)k * pixels);
	if (code == 0)
		code = refine_find(&reduced, &orbit, kind, BODY_WATER, &on, reference, NULL, ret_refinement, err);
	read_clocks(ret_seconds);
	for (int i = 0; i < 2; i++)
		ret_seconds[i] -= began[i];
	if (code == 0)
		code = geometry_copy(ret_geometry, &scan->said, err);
	for (int k = 0; k < scan->said.count && code == 0; k++) {
		double motion[PATH_NUMBERS];

		path_motion(&ret_refinement->path, refine_place(&orbit, k), &scan->said.views[k], motion);
		ret_geometry->views[k] = view_of_moved(&scan->said.views[k], motion);
	}
	backend->close(on.device);
	reduced_clear(&reduced);
	orbit_clear(&orbit);
	return code;
}

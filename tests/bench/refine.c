/*
 * What the refinement (core/refine/refine.h) makes of scans that were taken by an arm that sags, or of a head that
 * nods: bodies with exact line integrals (tests/bench/bodies.h), given with the circle's geometry. For each scan the
 * mean distance between where points lie and where the geometry says, in mm at the isocentre, before and after, and the
 * FDK volume's root mean square error within the body, HU. Both are taken where the geometry fits the truth best as a
 * whole, for no scan tells where the object lay; HU also where each geometry has it: "said" and "lies". `make
 * bench-refine` builds and runs it; tests/bench/results/refine.txt has its table. Arguments: pixels along a row, views,
 * degrees, first seed, seeds, first departure, the one behind the last, the only body (0: head, 1: abdomen, 2: knee;
 * -1: all), the most voxels along a side of the FDK volume, and the backend that refines and makes that volume. Where
 * that is not the CPU's the CPU's refines, too, and how far apart the two put points is told in mm at the isocentre.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "core/fit/least_squares.h"
#include "core/refine/refine.h"
#include "tests/bench/bodies.h"
#include "tests/bench/fdk_volume.h"
#include "tests/unit/arm.h"

enum { POINTS = 18, STRIDE = 3 };
static const double HU = 1000 / BODY_WATER, WIDTH = 379.456; /* mm, of the detector */

/* How the arm, or the object, departs from what the scan says. */
static const struct departure {
	const char *name;
	enum refine_kind kind;
	double sag, jitter, nod, photons;
	double aside; /* of the detector, along its columns: a share of its width */
} departures[] = {
    {"fits", REFINE_GEOMETRY, 0, 0, 0, 0, 0},
    {"fits, 20,000 photons", REFINE_GEOMETRY, 0, 0, 0, 2e4, 0},
    {"a tenth of the sag", REFINE_GEOMETRY, .1, 0, 0, 0, 0},
    {"the same, 20,000 photons", REFINE_GEOMETRY, .1, 0, 0, 2e4, 0},
    {"a third of the sag", REFINE_GEOMETRY, .3, 0, 0, 0, 0},
    {"still", REFINE_MOTION, 0, 0, 0, 2e4, 0},
    {"nod of 3 degrees, 3 mm", REFINE_MOTION, 0, 0, 3, 2e4, 0},
    {"fits, 2,000 photons", REFINE_GEOMETRY, 0, 0, 0, 2e3, 0},
    {"fits, displaced detector", REFINE_GEOMETRY, 0, 0, 0, 2e4, .3},
};
enum { DEPARTURES = sizeof(departures) / sizeof(departures[0]) };

struct scan {
	struct body body;
	struct arm arm;
	struct geometry truth, said;
	float *projections;
};

/* The nod: within a tenth of the sweep, about a neck, and along y and z; and in another place before and behind. */
static void nod_at(double share, double nod, double ret_motion[PATH_NUMBERS])
{
	static const double neck[3] = {0, 20, -60};
	const double passed = fmin(.5, fmax(-.5, (share - .5) / .1)), part = .5 + .5 * sin(M_PI * passed);
	const double turn = nod * M_PI / 180 * part;

	memset(ret_motion, 0, PATH_NUMBERS * sizeof(*ret_motion));
	ret_motion[3] = turn;
	ret_motion[1] = neck[1] - (cos(turn) * neck[1] - sin(turn) * neck[2]) + nod / sqrt(2) * part;
	ret_motion[2] = neck[2] - (sin(turn) * neck[1] + cos(turn) * neck[2]) + nod / sqrt(2) * part;
}

static int open_scan(struct scan *scan, const struct departure *departure, enum kind kind, int seed, int columns,
		     int count, double arc, struct error *err)
{
	const size_t pixels = (size_t)columns * (size_t)(columns * 60 / 77);
	int code;

	*scan = (struct scan){.arm = {.columns = columns,
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
		nod_at((double)k / count, departure->nod, motion);
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

static void close_scan(struct scan *scan)
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

/* *ret_mm, and the motion of all of it that leaves the least. */
static int compare(const struct geometry *truth, const struct geometry *said, double *ret_mm,
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

/* HU, within the body but for its metal, in every other voxel along each axis. */
static int body_error(const struct backend *backend, const struct scan *scan, const struct geometry *geometry,
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

/* ---- one scan ---- */

/* Of all processors together, and of the clock on the wall. */
static void read_clocks(double ret_seconds[2])
{
	struct timespec now;

	clock_gettime(CLOCK_MONOTONIC, &now);
	ret_seconds[0] = (double)clock() / CLOCKS_PER_SEC;
	ret_seconds[1] = (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int refine(const struct scan *scan, enum refine_kind kind, const struct backend *backend,
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

/* Root mean square distance between where two geometries put points. */
static double distance(const struct geometry *a, const struct geometry *b)
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

/* A job of that body, which nothing moved: FDK of 120 views over a full turn. Free the voxels. */
static int make_reference(enum kind kind, int seed, const struct backend *backend, struct refine_reference *ret,
			  struct error *err)
{
	static const struct departure good = {.kind = REFINE_GEOMETRY, .photons = 2e4};
	struct refine_reference reference;
	struct orbit orbit = {0};
	struct scan scan;
	float *voxels = NULL;
	int code = open_scan(&scan, &good, kind, seed, 200, 120, 360, err);

	if (code == 0)
		code = orbit_analyse(&orbit, &scan.said, err);
	if (code == 0) {
		orbit_default_grid(&orbit, &scan.said, 200, &reference.grid);
		voxels = malloc(grid_voxels(&reference.grid) * sizeof(float));
		code = fdk_volume(backend, &scan.truth, WINDOW_HANN, scan.projections, &reference.grid, voxels, err);
	}
	orbit_clear(&orbit);
	close_scan(&scan);
	reference.voxels = voxels;
	*ret = reference;
	return code;
}

static enum kind reference_kind;
static int reference_seed;

static int measure(const struct departure *departure, enum kind kind, int seed, int columns, int count, double arc,
		   int voxels, const struct backend *backend, struct error *err)
{
	const bool referred = reference_seed != 0;
	struct refine_reference reference = {0};
	static const double still[PATH_NUMBERS] = {0};
	struct scan scan;
	struct geometry refined = {0}, beside = {0};
	struct refinement refinement, other;
	double mm[2], hu[5], motion[2][PATH_NUMBERS], seconds[2] = {0}, cpu_seconds[2] = {0};
	int code = open_scan(&scan, departure, kind, seed, columns, count, arc, err);

	if (code == 0 && referred)
		code = make_reference(reference_kind, reference_seed, backend, &reference, err);
	if (code == 0)
		code = refine(&scan, departure->kind, backend, referred ? &reference : NULL, &refined, &refinement,
			      seconds, err);
	if (code == 0 && backend != &backend_cpu)
		code = refine(&scan, departure->kind, &backend_cpu, referred ? &reference : NULL, &beside, &other,
			      cpu_seconds, err);
	if (code == 0)
		code = compare(&scan.truth, &scan.said, &mm[0], motion[0], err);
	if (code == 0)
		code = compare(&scan.truth, &refined, &mm[1], motion[1], err);
	if (code == 0)
		code = body_error(backend, &scan, &scan.truth, still, voxels, &hu[0], err);
	if (code == 0)
		code = body_error(backend, &scan, &scan.said, still, voxels, &hu[1], err);
	if (code == 0)
		code = body_error(backend, &scan, &scan.said, motion[0], voxels, &hu[2], err);
	if (code == 0)
		code = body_error(backend, &scan, &refined, motion[1], voxels, &hu[3], err);
	if (code == 0)
		code = body_error(backend, &scan, &refined, still, voxels, &hu[4], err);
	if (code == 0)
		printf("%-26s %-18s %3d  %5.0f %6.1f %6.1f %6.1f %6.1f %6.1f  %6.3f %6.3f  %-4s %5.2f %% %3d/%2d %5d "
		       "%7.1f "
		       "%6.1f\n",
		       departure->name, kind_names[kind], seed, arc, hu[0], hu[1], hu[2], hu[3], hu[4], mm[0], mm[1],
		       refinement.accepted ? "yes" : "no", 100 * (1 - refinement.held_after / refinement.held_before),
		       refinement.better, refinement.held_out, refinement.path.knots, seconds[0], seconds[1]);
	if (code == 0 && referred)
		printf("%-26s alike %.2f; of the scan's own volume %.2f %% less is unexplained\n", "", refinement.alike,
		       100 * (1 - refinement.own_after / refinement.own_before));
	if (code == 0 && backend != &backend_cpu)
		printf("%-26s %-18s the CPU's is %.4f mm apart, unexplained less %.3f %% beside %.3f, %.1f s of "
		       "processor, %.1f s\n",
		       "", "", distance(&beside, &refined), 100 * (1 - other.held_after / other.held_before),
		       100 * (1 - refinement.held_after / refinement.held_before), cpu_seconds[0], cpu_seconds[1]);
	fflush(stdout);
	geometry_clear(&refined);
	geometry_clear(&beside);
	close_scan(&scan);
	free((void *)reference.voxels);
	return code;
}

int main(int argc, char **argv)
{
	const int columns = argc > 1 ? atoi(argv[1]) : 154, views = argc > 2 ? atoi(argv[2]) : 120;
	const double arc = argc > 3 ? atof(argv[3]) : 200;
	const int first = argc > 4 ? atoi(argv[4]) : 21, seeds = argc > 5 ? atoi(argv[5]) : 1;
	const int from = argc > 6 ? atoi(argv[6]) : 0, to = argc > 7 ? atoi(argv[7]) : DEPARTURES;
	const int only = argc > 8 ? atoi(argv[8]) : -1, voxels = argc > 9 ? atoi(argv[9]) : 160;
	const struct backend *backend = backend_find(argc > 10 ? argv[10] : "cpu");
	reference_kind = (enum kind)(argc > 11 ? atoi(argv[11]) : 0);
	reference_seed = argc > 12 ? atoi(argv[12]) : 0;
	const int body = only < 0 ? HEAD : only, bodies = only < 0 ? KNEE + 1 : only + 1;

	if (backend == NULL) {
		fprintf(stderr, "no backend %s\n", argv[10]);
		return EXIT_FAILURE;
	}
	printf("%-26s %-18s %3s  %5s %6s %6s %6s %6s %6s  %6s %6s  %-4s %7s %6s %5s %7s %6s\n", "departure", "body", "",
	       "arc", "true", "said", "whole", "after", "lies", "mm", "after", "kept", "better", "views", "knots",
	       "seconds", "wall");
	fflush(stdout);
	for (int d = from; d < to && d < DEPARTURES; d++)
		for (int kind = body; kind < bodies; kind++)
			for (int seed = first; seed < first + seeds; seed++) {
				struct error err;

				if (departures[d].kind == REFINE_MOTION && kind != HEAD)
					continue;
				if (measure(&departures[d], (enum kind)kind, seed, columns, views, arc, voxels, backend,
					    &err) < 0) {
					fprintf(stderr, "%s\n", err.text);
					return EXIT_FAILURE;
				}
			}
	return EXIT_SUCCESS;
}

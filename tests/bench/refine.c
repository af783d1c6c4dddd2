/*
 * What the refinement (core/refine/refine.h) makes of scans that were taken by an arm that sags, of a head that nods,
 * or of a hand that drifts, turns, jerks or trembles (tests/bench/departed.h): bodies with exact line integrals, given
 * with the circle's geometry. For each scan the mean distance between where points lie and where the geometry says, in
 * mm at the isocentre, before and after, and the FDK volume's root mean square error within the body, HU. Both are
 * taken where the geometry fits the truth best as a whole, for no scan tells where the object lay; HU also where each
 * geometry has it: "said" and "lies". `make bench-refine` builds and runs it; tests/bench/results/refine.txt has its
 * table. Arguments: pixels along a row, views, degrees, first seed, seeds, first departure, the one behind the last,
 * the only body (0: head, 1: abdomen, 2: knee, 5: hand; -1: the first three), the most voxels along a side of the FDK
 * volume, and the backend that refines and makes that volume. Where that is not the CPU's the CPU's refines, too, and
 * how far apart the two put points is told in mm at the isocentre.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "tests/bench/departed.h"
#include "tests/bench/fdk_volume.h"

/* How the arm, or the object, departs from what the scan says. */
static const struct departure departures[] = {
    {"fits", REFINE_GEOMETRY, 0, 0, MOTION_NONE, 0, 0},
    {"fits, 20,000 photons", REFINE_GEOMETRY, 0, 0, MOTION_NONE, 2e4, 0},
    {"a tenth of the sag", REFINE_GEOMETRY, .1, 0, MOTION_NONE, 0, 0},
    {"the same, 20,000 photons", REFINE_GEOMETRY, .1, 0, MOTION_NONE, 2e4, 0},
    {"a third of the sag", REFINE_GEOMETRY, .3, 0, MOTION_NONE, 0, 0},
    {"still", REFINE_MOTION, 0, 0, MOTION_NONE, 2e4, 0},
    {"nod of 3 degrees, 3 mm", REFINE_MOTION, 0, 0, MOTION_NOD, 2e4, 0},
    {"fits, 2,000 photons", REFINE_GEOMETRY, 0, 0, MOTION_NONE, 2e3, 0},
    {"fits, displaced detector", REFINE_GEOMETRY, 0, 0, MOTION_NONE, 2e4, .3},
    {"drift", REFINE_MOTION, 0, 0, MOTION_DRIFT, 2e4, 0},
    {"turn of 3 degrees, 3 mm", REFINE_MOTION, 0, 0, MOTION_TURN, 2e4, 0},
    {"jerk", REFINE_MOTION, 0, 0, MOTION_JERK, 2e4, 0},
    {"tremor", REFINE_MOTION, 0, 0, MOTION_TREMOR, 2e4, 0},
};
enum { DEPARTURES = sizeof(departures) / sizeof(departures[0]) };

/* A job of that body, which nothing moved: FDK of 120 views over a full turn. Free the voxels. */
static int make_reference(enum kind kind, int seed, const struct backend *backend, struct refine_reference *ret,
			  struct error *err)
{
	static const struct departure good = {.kind = REFINE_GEOMETRY, .photons = 2e4};
	struct refine_reference reference;
	struct orbit orbit = {0};
	struct departed scan;
	float *voxels = NULL;
	int code = departed_open(&scan, &good, kind, seed, 200, 120, 360, err);

	if (code == 0)
		code = orbit_analyse(&orbit, &scan.said, err);
	if (code == 0) {
		orbit_default_grid(&orbit, &scan.said, 200, &reference.grid);
		voxels = malloc(grid_voxels(&reference.grid) * sizeof(float));
		code = fdk_volume(backend, &scan.truth, WINDOW_HANN, scan.projections, &reference.grid, voxels, err);
	}
	orbit_clear(&orbit);
	departed_close(&scan);
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
	struct departed scan;
	struct geometry refined = {0}, beside = {0};
	struct refinement refinement, other;
	double mm[2], hu[5], motion[2][PATH_NUMBERS], seconds[2] = {0}, cpu_seconds[2] = {0};
	int code = departed_open(&scan, departure, kind, seed, columns, count, arc, err);

	if (code == 0 && referred)
		code = make_reference(reference_kind, reference_seed, backend, &reference, err);
	if (code == 0)
		code = departed_refine(&scan, departure->kind, backend, referred ? &reference : NULL, &refined,
				       &refinement, seconds, err);
	if (code == 0 && backend != &backend_cpu)
		code = departed_refine(&scan, departure->kind, &backend_cpu, referred ? &reference : NULL, &beside,
				       &other, cpu_seconds, err);
	if (code == 0)
		code = departed_compare(&scan.truth, &scan.said, &mm[0], motion[0], err);
	if (code == 0)
		code = departed_compare(&scan.truth, &refined, &mm[1], motion[1], err);
	if (code == 0)
		code = departed_error(backend, &scan, &scan.truth, still, voxels, &hu[0], err);
	if (code == 0)
		code = departed_error(backend, &scan, &scan.said, still, voxels, &hu[1], err);
	if (code == 0)
		code = departed_error(backend, &scan, &scan.said, motion[0], voxels, &hu[2], err);
	if (code == 0)
		code = departed_error(backend, &scan, &refined, motion[1], voxels, &hu[3], err);
	if (code == 0)
		code = departed_error(backend, &scan, &refined, still, voxels, &hu[4], err);
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
		       "", "", departed_distance(&beside, &refined), 100 * (1 - other.held_after / other.held_before),
		       100 * (1 - refinement.held_after / refinement.held_before), cpu_seconds[0], cpu_seconds[1]);
	fflush(stdout);
	geometry_clear(&refined);
	geometry_clear(&beside);
	departed_close(&scan);
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

				if (departures[d].kind == REFINE_MOTION && kind != HEAD && only < 0)
					continue;
				if (measure(&departures[d], (enum kind)kind, seed, columns, views, arc, voxels, backend,
					    &err) < 0) {
					fprintf(stderr, "%s\n", err.text);
					return EXIT_FAILURE;
				}
			}
	return EXIT_SUCCESS;
}

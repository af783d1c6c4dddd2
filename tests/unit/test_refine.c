/*
 * Refinement of poses: paths of motions against what they are made of, and a scan by exact line integrals, as an arm
 * takes it that does not stand where the scan says, or of a head that moves.
 */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "core/cards/cards.h"
#include "core/fit/least_squares.h"
#include "core/outofcore/outofcore.h"
#include "core/refine/refine.h"
#include "core/refine/rest.h"
#include "core/scan/phantom.h"
#include "tests/unit/arm.h"
#include "tests/unit/scene.h"

enum { COLUMNS = 44, ROWS = 36, VIEWS = 56, PARTS = 24 };
static const double PIXEL = 8.4, WATER = 0.0192;

static void project(const struct view *view, const double point[3], double ret[2])
{
	double matrix[12];

	view_matrix(view, matrix);
	view_project(matrix, point, &ret[0], &ret[1]);
}

/* A point of the moved object in a view is where the point at rest is in the view that is told for it. */
START_TEST(a_moved_object_is_seen_by_a_moved_view)
{
	static const double motion[PATH_NUMBERS] = {3, -2, 5, .2, -.1, .3}, point[3] = {40, -25, 30};
	static const double turn[3] = {.2, -.1, .3};
	const struct arm arm = {.columns = COLUMNS, .rows = ROWS, .count = 4, .pixel = PIXEL, .step = 1};
	const struct view view = arm_nominal(&arm, 1), moved = view_of_moved(&view, motion);
	const double angle = vec_norm(turn), axis[3] = {turn[0] / angle, turn[1] / angle, turn[2] / angle};
	double across[3], there[3], here[2], expected[2];

	vec_cross(axis, point, across);
	for (int a = 0; a < 3; a++)
		there[a] = cos(angle) * point[a] + sin(angle) * across[a] +
			   (1 - cos(angle)) * vec_dot(axis, point) * axis[a] + motion[a];
	project(&view, there, expected);
	project(&moved, point, here);
	ck_assert_double_eq_tol(here[0], expected[0], 1e-9);
	ck_assert_double_eq_tol(here[1], expected[1], 1e-9);
}
END_TEST

START_TEST(more_knots_do_not_change_a_path)
{
	struct path path, fine;

	path_open(&path, true, 3, 7);
	for (int k = 0; k < path.knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++)
			path.numbers[k][i] = sin(5 * k + i);
	fine = path;
	path_double(&fine);
	ck_assert_int_eq(fine.knots, 11);
	for (double at = 0; at <= 3; at += .1) {
		double a[PATH_NUMBERS], b[PATH_NUMBERS];

		path_at(&path, at, a);
		path_at(&fine, at, b);
		for (int i = 0; i < PATH_NUMBERS; i++)
			ck_assert_double_eq_tol(a[i], b[i], 1e-12);
	}
}
END_TEST

/* Residuals that are the derivatives times known numbers: one step finds these, about the views' axes or the world's.
 */
START_TEST(a_step_finds_what_made_the_residuals)
{
	static const double far[PATH_NUMBERS] = {1e6, 1e6, 1e6, 1e6, 1e6, 1e6};
	const bool of_views = _i == 0;
	const struct arm arm = {.columns = COLUMNS, .rows = ROWS, .count = VIEWS, .pixel = PIXEL, .step = .06};
	struct path_view *views = calloc(VIEWS, sizeof(*views));
	struct path truth, path;
	struct error err;
	uint64_t random = 3;

	path_open(&truth, of_views, .06 * (VIEWS - 1), 7);
	path = truth;
	for (int k = 0; k < truth.knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++)
			truth.numbers[k][i] = cos(3 * k + 2 * i);
	for (int v = 0; v < VIEWS; v++) {
		double motion[PATH_NUMBERS];

		views[v] = (struct path_view){.used = v % 9 != 4, .at = .06 * v, .view = arm_nominal(&arm, v)};
		path_motion(&truth, views[v].at, &views[v].view, motion);
		for (int pixel = 0; pixel < 20; pixel++) {
			double value[PATH_NUMBERS + 1] = {0};
			int at = 0;

			for (int i = 1; i <= PATH_NUMBERS; i++) {
				random = random * 6364136223846793005u + 1442695040888963407u;
				value[i] = (double)(random >> 33) / 1e9 - 1;
				value[0] += value[i] * motion[i - 1] * (i > 3 ? 100 : 1);
			}
			for (int i = 0; i <= PATH_NUMBERS; i++)
				for (int j = 0; j <= i; j++)
					views[v].products[at++] += value[i] * value[j];
		}
	}
	ck_assert_int_eq(path_step(&path, views, VIEWS, far, INFINITY, 1, &err), 0);
	for (int v = 0; v < VIEWS; v += 5) {
		double found[PATH_NUMBERS], expected[PATH_NUMBERS], other[PATH_NUMBERS], start[PATH_NUMBERS];

		path_at(&path, views[v].at, found);
		path_at(&truth, views[v].at, expected);
		/* About the world's axes the mean is taken off: differences along the path stay. */
		path_at(&path, 0, other);
		path_at(&truth, 0, start);
		for (int i = 0; i < PATH_NUMBERS; i++)
			ck_assert_double_eq_tol(found[i] - (of_views ? 0 : other[i]),
						expected[i] - (of_views ? 0 : start[i]), 1e-6);
	}
	free(views);
}
END_TEST

/* An object that stands aside in all views is a common motion, whatever is expected of the path. */
START_TEST(what_all_views_share_is_no_path)
{
	static const double small[PATH_NUMBERS] = {.1, .1, .01, .01, .01, .1},
			    aside[PATH_NUMBERS] = {1, -2, 3, .5, 1, -1};
	const struct arm arm = {.columns = COLUMNS, .rows = ROWS, .count = VIEWS, .pixel = PIXEL, .step = .06};
	struct path_view *views = calloc(VIEWS, sizeof(*views));
	struct path path;
	struct error err;

	path_open(&path, true, .06 * (VIEWS - 1), 7);
	for (int v = 0; v < VIEWS; v++) {
		int at = 0;

		views[v] = (struct path_view){.used = true, .at = .06 * v, .view = arm_nominal(&arm, v)};
		for (int i = 0; i <= PATH_NUMBERS; i++)
			for (int j = 0; j <= i; j++, at++)
				views[v].products[at] = i == j ? 1e4 : j == 0 ? 1e4 * aside[i - 1] : 0;
	}
	ck_assert_int_eq(path_step(&path, views, VIEWS, small, INFINITY, 1, &err), 0);
	for (int i = 0; i < PATH_NUMBERS; i++)
		ck_assert_double_eq_tol(path.common[i], aside[i], .01);
	ck_assert_double_lt(path_size(&path), .02);
	free(views);
}
END_TEST

/*
 * An object that is nearer to all views is a larger one in its place: a path does not follow that, unless the size is
 * known, and follows what else there is.
 */
START_TEST(what_is_nearer_to_all_views_is_no_path)
{
	static const double far[PATH_NUMBERS] = {1e3, 1e3, 1e3, 1e3, 1e3, 1e3};
	const bool sized = _i == 0;
	const struct arm arm = {.columns = COLUMNS, .rows = ROWS, .count = VIEWS, .pixel = PIXEL, .step = .06};
	struct path_view *views = calloc(VIEWS, sizeof(*views));
	double axes[3][3], first[PATH_NUMBERS], last[PATH_NUMBERS], nearer = 0;
	struct path path;
	struct error err;

	path_open(&path, false, .06 * (VIEWS - 1), 12);
	for (int v = 0; v < VIEWS; v++) {
		views[v] = (struct path_view){.used = true, .at = .06 * v, .view = arm_nominal(&arm, v)};
		view_axes(&views[v].view, axes);
		for (int i = 0, at = 0; i <= PATH_NUMBERS; i++)
			for (int j = 0; j <= i; j++, at++)
				views[v].products[at] = i == j ? 1 : i < 4 && j == 0 ? 2 * axes[2][i - 1] : 0;
		views[v].products[6] = 3. * v / (VIEWS - 1); /* along z */
	}
	ck_assert_int_eq(path_step(&path, views, VIEWS, far, sized ? INFINITY : .05, 1, &err), 0);
	for (int v = 0; v < VIEWS; v++) {
		double numbers[PATH_NUMBERS];

		path_at(&path, views[v].at, numbers);
		view_axes(&views[v].view, axes);
		nearer += vec_dot(axes[2], numbers) / VIEWS;
	}
	path_at(&path, 0, first);
	path_at(&path, path.length, last);
	ck_assert_double_eq_tol(last[2] - first[2], 3, 1e-3);
	if (sized)
		ck_assert_double_gt(nearer, 1);
	else
		ck_assert_double_lt(fabs(nearer), .1);
	free(views);
}
END_TEST

/* Bins of two by two are those of a scan that is taken into bins of twice the pixels. */
START_TEST(halved_bins_are_those_of_larger_ones)
{
	enum { WIDE = 64, HIGH = 64, FEW = 56 };
	const struct arm arm = {
	    .columns = WIDE, .rows = HIGH, .count = FEW, .pixel = 5, .first = .2, .step = 3.5 / (FEW - 1)};
	float *projection = malloc(sizeof(float) * WIDE * HIGH);
	struct reduced fine, half, coarse;
	struct geometry geometry;
	struct orbit orbit;
	struct error err;

	ck_assert_int_eq(arm_nominal_geometry(&arm, &geometry, &err), 0);
	ck_assert_int_eq(orbit_analyse(&orbit, &geometry, &err), 0);
	ck_assert_int_eq(reduced_open(&fine, &geometry, &orbit, FEW, 32, &err), 0);
	ck_assert_int_eq(reduced_open(&coarse, &geometry, &orbit, FEW, 16, &err), 0);
	for (int i = 0; i < WIDE * HIGH; i++)
		projection[i] = (float)(i % 7) + (float)i / WIDE;
	for (int k = 0; k < FEW; k += 3) {
		reduced_take(&fine, k, projection);
		reduced_take(&coarse, k, projection);
	}
	ck_assert_int_eq(reduced_halve(&fine, &half, &err), 0);
	ck_assert_int_eq(half.geometry.columns, coarse.geometry.columns);
	ck_assert_int_eq(half.geometry.rows, coarse.geometry.rows);
	ck_assert_mem_eq(half.known, coarse.known, FEW * sizeof(bool));
	ck_assert_mem_eq(half.views, coarse.views, FEW * sizeof(int));
	for (int i = 0; i < FEW * half.geometry.columns * half.geometry.rows; i++)
		ck_assert_float_eq_tol(half.projections[i], coarse.projections[i], 1e-4f);
	for (int k = 0; k < FEW; k++)
		for (int a = 0; a < 3; a++) {
			ck_assert_double_eq_tol(half.geometry.views[k].pixel0[a], coarse.geometry.views[k].pixel0[a],
						1e-9);
			ck_assert_double_eq_tol(half.geometry.views[k].row_step[a],
						coarse.geometry.views[k].row_step[a], 1e-9);
		}
	reduced_clear(&fine);
	reduced_clear(&half);
	reduced_clear(&coarse);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	free(projection);
}
END_TEST

/* ---- scans ---- */

static void fill(struct ellipsoid parts[PARTS])
{
	const struct ellipsoid first[] = {
	    {.semi_axes = {74, 90, 78}, .centre = {0, 0, 5}, .density = 1.6 * WATER},
	    {.semi_axes = {66, 82, 70}, .centre = {0, 0, 5}, .density = -.6 * WATER},
	    {.shape = SHAPE_BOX, .semi_axes = {9, 12, 8}, .centre = {20, -35, 10}, .angle = .4, .density = .9 * WATER},
	    {.shape = SHAPE_BOX, .semi_axes = {8, 9, 12}, .centre = {-30, 15, -20}, .angle = 1, .density = -.9 * WATER},
	};

	memcpy(parts, first, sizeof(first));
	for (int i = 4; i < PARTS; i++)
		parts[i] = (struct ellipsoid){.semi_axes = {4 + i % 5, 5 + i % 4, 4 + i % 6},
					      .centre = {45 * sin(2. * i), 55 * cos(3. * i), 5 * (i - 14)},
					      .density = (i % 2 ? .5 : -.4) * WATER};
}

/* A leg that goes on beyond the rows, with screws and a plate: what of it turns about x shows in few places. */
static void fill_knee(struct ellipsoid parts[PARTS])
{
	const struct ellipsoid first[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {58, 52, 140}, .density = WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {17, 16, 60}, .centre = {0, 0, 75}, .density = .5 * WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {12, 11, 60}, .centre = {0, 0, 75}, .density = -.35 * WATER},
	    {.semi_axes = {36, 26, 24}, .centre = {0, 2, 18}, .density = .45 * WATER},
	    {.semi_axes = {38, 27, 18}, .centre = {0, 2, -20}, .density = .45 * WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {15, 14, 60}, .centre = {0, 4, -80}, .density = .5 * WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {6, 6, 60}, .centre = {30, 14, -80}, .density = .6 * WATER},
	    {.semi_axes = {18, 8, 20}, .centre = {0, -38, 15}, .density = .5 * WATER},
	    {.semi_axes = {26, 1.6, 1.6}, .centre = {2, 5, -20}, .angle = .2, .density = 9 * WATER},
	    {.semi_axes = {30, 1.6, 1.6}, .centre = {-3, 8, -8}, .angle = 1.3, .density = 9 * WATER},
	    {.semi_axes = {24, 1.6, 1.6}, .centre = {1, 1, 4}, .angle = -.3, .density = 9 * WATER},
	    {.shape = SHAPE_BOX, .semi_axes = {2, 8, 30}, .centre = {34, 0, -25}, .angle = .1, .density = 8 * WATER},
	};
	const int count = (int)(sizeof(first) / sizeof(first[0]));

	memcpy(parts, first, sizeof(first));
	for (int i = count; i < PARTS; i++)
		parts[i] = (struct ellipsoid){.semi_axes = {1 + i % 3, 2, 1 + i % 2},
					      .centre = {24 * sin(2. * i), 18 * cos(3. * i), 3 * (i - 18)},
					      .density = .2 * WATER};
}

/* By Box and Muller (1958). */
static double normal(uint64_t *state)
{
	double numbers[2];

	for (int i = 0; i < 2; i++) {
		*state = *state * 6364136223846793005u + 1442695040888963407u;
		numbers[i] = ((double)(*state >> 33) + .5) / 2147483648.0;
	}
	return sqrt(-2 * log(numbers[0])) * cos(2 * M_PI * numbers[1]);
}

/* photons: for each pixel in air; 0: no noise. */
static void take(const struct geometry *truth, bool of_knee, double photons, float *ret)
{
	struct ellipsoid parts[PARTS];
	const struct phantom phantom = {.count = PARTS, .parts = parts};
	uint64_t random = 5;

	(of_knee ? fill_knee : fill)(parts);
	for (int k = 0; k < truth->count; k++)
		phantom_project(&phantom, truth, k, ret + (size_t)k * COLUMNS * ROWS);
	for (int i = 0; i < truth->count * COLUMNS * ROWS && photons > 0; i++) {
		const double mean = photons * exp(-(double)ret[i]);

		ret[i] = (float)-log(fmax(.5, mean + sqrt(mean) * normal(&random)) / photons);
	}
}

/* The densities themselves, moved aside by so many mm: what a job of the object would show. Free the voxels. */
static struct refine_reference refer(double aside)
{
	static const struct grid grid = {.size = {72, 88, 76}, .spacing = {2.4, 2.4, 2.4}, .origin = {-85, -104, -90}};
	float *voxels = malloc(grid_voxels(&grid) * sizeof(float));
	struct ellipsoid parts[PARTS];
	const struct phantom phantom = {.count = PARTS, .parts = parts};

	fill(parts);
	for (int z = 0; z < grid.size[2]; z++)
		for (int y = 0; y < grid.size[1]; y++)
			for (int x = 0; x < grid.size[0]; x++) {
				const double point[3] = {grid.origin[0] + x * grid.spacing[0] - aside,
							 grid.origin[1] + y * grid.spacing[1],
							 grid.origin[2] + z * grid.spacing[2]};

				voxels[grid_voxel(&grid, x, y, z)] = (float)phantom_density(&phantom, point);
			}
	return (struct refine_reference){grid, voxels};
}

struct pair {
	const struct geometry *truth, *said;
};
enum { POINTS = 4 };

/* Where two geometries show points, one of them moved as a whole: at the isocentre, mm. */
static void distances(void *context, const double *motion, double *ret)
{
	static const double points[POINTS][3] = {{60, 0, 40}, {-60, 20, -40}, {0, -60, 30}, {10, 60, -30}};
	const struct pair *pair = context;

	for (int p = 0; p < POINTS; p++)
		for (int k = 0; k < pair->truth->count; k++) {
			const struct view moved = view_of_moved(&pair->said->views[k], motion);
			double a[2], b[2];

			project(&pair->truth->views[k], points[p], a);
			project(&moved, points[p], b);
			*ret++ = (a[0] - b[0]) * PIXEL * 620 / 1100;
			*ret++ = (a[1] - b[1]) * PIXEL * 620 / 1100;
		}
}

/*
 * Root mean square distance, mm, less what all views share: no scan tells where the object lies. With a reference,
 * which does, from the place where that is, `aside` mm along x.
 */
static double distance(const struct geometry *truth, const struct geometry *said, bool referred, double aside)
{
	struct pair pair = {truth, said};
	const struct least_squares problem = {.parameters = PATH_NUMBERS,
					      .residuals = 2 * POINTS * truth->count,
					      .context = &pair,
					      .residuals_of = distances,
					      .step = 1e-4,
					      .most = 30};
	double motion[PATH_NUMBERS] = {aside}, residuals[2 * POINTS * VIEWS], rms = 0;
	struct error err;

	if (!referred) {
		ck_assert_int_eq(least_squares(&problem, motion, &rms, &err), 0);
		return rms * sqrt(2);
	}
	distances(&pair, motion, residuals);
	for (int i = 0; i < problem.residuals; i++)
		rms += residuals[i] * residuals[i] / problem.residuals;
	return sqrt(2 * rms);
}

/* ---- where the object is shown ---- */

/* A path and the views that it moves. */
struct resting {
	struct path path;
	struct path_view views[VIEWS];
	struct geometry said, before, after;
};

static void move_all(const struct resting *resting, struct geometry *geometry)
{
	for (int v = 0; v < VIEWS; v++) {
		double motion[PATH_NUMBERS];

		path_motion(&resting->path, resting->views[v].at, &resting->said.views[v], motion);
		geometry->views[v] = view_of_moved(&resting->said.views[v], motion);
	}
}

/* Rests. Free with clear_rest. */
static void let_rest(struct resting *resting)
{
	static const struct grid shown = {.size = {60, 60, 50}, .spacing = {3, 3, 3}, .origin = {-88.5, -88.5, -73.5}};
	const struct arm arm = {.columns = COLUMNS, .rows = ROWS, .count = VIEWS, .pixel = PIXEL, .step = .06};
	struct error err;

	ck_assert_int_eq(arm_nominal_geometry(&arm, &resting->said, &err), 0);
	ck_assert_int_eq(geometry_copy(&resting->before, &resting->said, &err), 0);
	ck_assert_int_eq(geometry_copy(&resting->after, &resting->said, &err), 0);
	for (int v = 0; v < VIEWS; v++)
		resting->views[v] = (struct path_view){.at = .06 * v, .view = resting->said.views[v]};
	move_all(resting, &resting->before);
	ck_assert_int_eq(path_rest(&resting->path, resting->views, VIEWS, &shown, &err), 0);
	move_all(resting, &resting->after);
	/* Seen from the object the views stand to each other as they did. */
	ck_assert_double_lt(distance(&resting->before, &resting->after, false, 0), 1e-6);
}

static void clear_rest(struct resting *resting)
{
	geometry_clear(&resting->said);
	geometry_clear(&resting->before);
	geometry_clear(&resting->after);
}

/* What the views of a refined geometry share is taken off, so that they have the object where the told ones do. */
START_TEST(a_geometry_shows_the_object_where_it_was_told)
{
	static const double common[PATH_NUMBERS] = {2, -1, 1.5, 1, -2, .5};
	struct resting resting;
	double before, after, least;

	path_open(&resting.path, true, .06 * (VIEWS - 1), 9);
	memcpy(resting.path.common, common, sizeof(common));
	for (int k = 0; k < resting.path.knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++)
			resting.path.numbers[k][i] = .3 * cos(3 * k + 2 * i);
	let_rest(&resting);
	before = distance(&resting.said, &resting.before, true, 0);
	after = distance(&resting.said, &resting.after, true, 0);
	least = distance(&resting.said, &resting.after, false, 0);
	ck_assert_double_gt(before, 2);
	ck_assert_msg(after < 1.1 * least, "%g mm, %g in the best place", after, least);
	clear_rest(&resting);
}
END_TEST

/* ---- what is found of a scan ---- */

struct found {
	struct refinement refinement;
	double before, after; /* mm, in the best place, */
	double told, lies;    /* and where the told and the refined views have it */
	double share;         /* of the work, as it was told last */
	double largest;       /* step of it */
	int shares;           /* how often it was */
};

/* What is told of the work grows with each step. */
static void note_share(void *context, double share)
{
	struct found *found = context;

	ck_assert_double_gt(share, found->share);
	found->largest = fmax(found->largest, share - found->share);
	found->share = share;
	found->shares++;
}

struct taken {
	double sway; /* mm, of the detector along its columns and rows, that no common motion explains */
	double sag;  /* of the arm */
	double nod;  /* radians, of the head, or of the knee */
	bool knee;
	int views;
	bool displaced;                           /* the detector, by .3 of its width, and a full turn */
	const struct refine_reference *reference; /* NULL: none; with one the views are noisy, */
	double aside;                             /* and it lies so many mm along x */
};

static struct found find_on(const struct refine_device *on, const struct taken *taken)
{
	const bool referred = taken->reference != NULL;
	const int views = taken->views;
	const struct arm arm = {.columns = COLUMNS,
				.rows = ROWS,
				.count = views,
				.pixel = PIXEL,
				.first = .2,
				.sag = taken->sag,
				.step = taken->displaced ? 2 * M_PI / views : 3.5 / (views - 1)};
	float *projections = malloc(sizeof(float) * VIEWS * COLUMNS * ROWS);
	struct geometry said, truth, refined;
	struct reduced reduced;
	struct orbit orbit;
	struct found found = {.shares = 0};
	const struct refine_watch watch = {.progress = note_share, .context = &found};
	struct error err;

	ck_assert_int_eq(arm_nominal_geometry(&arm, &said, &err), 0);
	ck_assert_int_eq(geometry_copy(&truth, &said, &err), 0);
	ck_assert_int_eq(geometry_copy(&refined, &said, &err), 0);
	for (int k = 0; k < views; k++) {
		const double share = (double)k / (views - 1);
		const double motion[PATH_NUMBERS] = {0, 0, 0, taken->nod * tanh(8 * (share - .5)), 0, 0};
		struct view *view = &truth.views[k];

		if (taken->sag > 0)
			*view = arm_view(&arm, k);
		for (int a = 0; a < 3 && taken->displaced; a++) {
			view->pixel0[a] += .3 * COLUMNS * view->column_step[a];
			said.views[k].pixel0[a] = view->pixel0[a];
		}
		for (int a = 0; a < 3; a++)
			view->pixel0[a] +=
			    taken->sway * 1100 / 620 / PIXEL *
			    (sin(9 * share) * view->column_step[a] + cos(11 * share) * view->row_step[a]);
		*view = view_of_moved(view, motion);
	}
	take(&truth, taken->knee, referred ? 3000 : 0, projections);
	ck_assert_int_eq(orbit_analyse(&orbit, &said, &err), 0);
	ck_assert(refine_is_possible(&said, &orbit, referred));
	ck_assert_int_eq(reduced_open(&reduced, &said, &orbit, REFINE_VIEWS_MOST, REFINE_BINS_MOST, &err), 0);
	for (int k = 0; k < views; k++)
		reduced_take(&reduced, k, projections + (size_t)k * COLUMNS * ROWS);
	ck_assert_msg(refine_find(&reduced, &orbit, taken->nod != 0 ? REFINE_MOTION : REFINE_GEOMETRY, WATER, on,
				  taken->reference, &watch, &found.refinement, &err) == 0,
		      "%s", err.text);
	for (int k = 0; k < views; k++) {
		double motion[PATH_NUMBERS];

		path_motion(&found.refinement.path, refine_place(&orbit, k), &said.views[k], motion);
		refined.views[k] = view_of_moved(&said.views[k], motion);
	}
	ck_assert_double_eq_tol(found.share, 1, 1e-12);
	ck_assert_double_lt(found.largest, referred ? .3 : .1);
	ck_assert_int_gt(found.shares, referred ? 7 : 30);
	found.before = distance(&truth, &said, referred, taken->aside);
	found.after = distance(&truth, &refined, referred, taken->aside);
	found.told = distance(&truth, &said, true, taken->aside);
	found.lies = distance(&truth, &refined, true, taken->aside);
	reduced_clear(&reduced);
	orbit_clear(&orbit);
	geometry_clear(&said);
	geometry_clear(&truth);
	geometry_clear(&refined);
	free(projections);
	return found;
}

static struct found find(const struct taken *taken)
{
	struct refine_device on = {.backend = &backend_cpu};
	struct found found;
	struct error err;

	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){0}, &on.device, &err), 0);
	found = find_on(&on, taken);
	backend_cpu.close(on.device);
	return found;
}

START_TEST(a_detector_that_sways_is_found)
{
	const struct found found = find(&(struct taken){.sway = 1.5, .views = VIEWS});

	ck_assert_msg(found.refinement.accepted, "%d of %d views are better", found.refinement.better,
		      found.refinement.held_out);
	ck_assert_int_eq(found.refinement.held_out, VIEWS / 8);
	ck_assert_double_lt(found.refinement.held_after, found.refinement.held_before);
	ck_assert_msg(found.after < .5 * found.before, "%g mm of %g", found.after, found.before);
}
END_TEST

/* What all views share of a sag is not known, and stays; no other is put in its place. */
START_TEST(a_head_under_an_arm_that_sags_stays_where_it_is)
{
	const struct found found = find(&(struct taken){.sag = .5, .views = VIEWS});

	ck_assert(found.refinement.accepted);
	ck_assert_msg(found.after < .6 * found.before, "%g mm of %g", found.after, found.before);
	ck_assert_msg(found.lies < found.told, "%g mm aside, %g as told", found.lies, found.told);
	ck_assert_double_eq_tol(sqrt(found.lies * found.lies - found.after * found.after),
				sqrt(found.told * found.told - found.before * found.before), .05);
}
END_TEST

START_TEST(a_head_that_nods_is_followed)
{
	const struct found found = find(&(struct taken){.nod = .03, .views = VIEWS});

	ck_assert(found.refinement.accepted);
	ck_assert_msg(found.after < .5 * found.before, "%g mm of %g", found.after, found.before);
}
END_TEST

/* A path that trusts the others as much as a head's turns such a leg elsewhere: held-out views choose another. */
START_TEST(a_knee_that_nods_is_followed)
{
	const struct found found = find(&(struct taken){.nod = .03, .knee = true, .views = VIEWS});

	ck_assert_msg(found.after < .8 * found.before, "%g mm of %g, %d of %d views are better", found.after,
		      found.before, found.refinement.better, found.refinement.held_out);
}
END_TEST

START_TEST(a_geometry_that_fits_is_left_alone)
{
	const struct found found = find(&(struct taken){.views = VIEWS});

	ck_assert_msg(!found.refinement.accepted || found.after < .1, "%g mm where nothing was to be found",
		      found.after);
	ck_assert(found.refinement.accepted || found.after == 0);
}
END_TEST

/*
 * 28 noisy views, too few to be refined alone, of an arm that sways: against a volume of the object, which lies 2 mm
 * aside there, their poses are those of the volume's world.
 */
START_TEST(few_noisy_views_are_registered_with_a_reference)
{
	enum { FEW = 28 };
	const double aside = _i == 0 ? 0 : 2;
	struct refine_reference reference = refer(aside);
	const struct found found =
	    find(&(struct taken){.sway = 1.5, .views = FEW, .reference = &reference, .aside = aside});

	ck_assert_msg(found.refinement.accepted, "%d of %d views are better, %g alike", found.refinement.better,
		      found.refinement.held_out, found.refinement.alike);
	ck_assert_msg(found.after < .3 * found.before, "%g mm of %g", found.after, found.before);
	free((void *)reference.voxels);
}
END_TEST

/* The object a quarter larger is another one, and fits nowhere. */
START_TEST(a_reference_of_something_else_is_not_followed)
{
	struct refine_reference reference = refer(0);
	struct found found;

	for (int a = 0; a < 3; a++) {
		reference.grid.spacing[a] *= 1.25;
		reference.grid.origin[a] *= 1.25;
	}
	found = find(&(struct taken){.sway = 1.5, .views = VIEWS, .reference = &reference});
	ck_assert_msg(!found.refinement.accepted, "%g alike, %g mm of %g", found.refinement.alike, found.after,
		      found.before);
	free((void *)reference.voxels);
}
END_TEST

/* Another head: each of its parts of another size and in another place. */
static struct refine_reference refer_other(uint64_t seed)
{
	static const double apart = .05;
	struct refine_reference reference = refer(0);
	float *voxels = (float *)(uintptr_t)reference.voxels;
	struct ellipsoid parts[PARTS];
	const struct phantom phantom = {.count = PARTS, .parts = parts};
	double skull[3];

	fill(parts);
	for (int a = 0; a < 3; a++)
		skull[a] = 1 + .5 * apart * normal(&seed);
	for (int i = 0; i < PARTS; i++)
		for (int a = 0; a < 3; a++) {
			parts[i].semi_axes[a] *= i < 2 ? skull[a] : 1 + apart * normal(&seed);
			parts[i].centre[a] += i < 2 ? 0 : 40 * apart * normal(&seed);
		}
	for (size_t i = 0; i < grid_voxels(&reference.grid); i++) {
		const size_t across = (size_t)reference.grid.size[0], down = (size_t)reference.grid.size[1];
		const size_t at[3] = {i % across, i / across % down, i / (across * down)};
		double point[3];

		for (int a = 0; a < 3; a++)
			point[a] = reference.grid.origin[a] + (double)at[a] * reference.grid.spacing[a];
		voxels[i] = (float)phantom_density(&phantom, point);
	}
	return reference;
}

/*
 * Its detail is as much alike as that of the object itself, and views that are held out agree with it better by a tenth
 * in other poses; but not with each other, where the geometry fitted.
 */
START_TEST(a_reference_of_another_head_is_not_followed)
{
	struct refine_reference reference = refer_other(7 + 26 * (uint64_t)_i);
	const struct found found = find(&(struct taken){.views = 28, .reference = &reference});

	ck_assert_double_gt(found.refinement.alike, .9);
	ck_assert_double_lt(found.refinement.held_after, .95 * found.refinement.held_before);
	ck_assert_double_gt(found.refinement.own_after, found.refinement.own_before);
	ck_assert_msg(!found.refinement.accepted, "%g mm where nothing was to be found", found.after);
	free((void *)reference.voxels);
}
END_TEST

/* Where each view has half of the object a reference tells where they stood, in its own world. */
START_TEST(a_displaced_detector_is_registered_with_a_reference)
{
	const double aside = _i == 0 ? 0 : 2;
	struct refine_reference reference = refer(aside);
	const struct found found = find(
	    &(struct taken){.sway = 1.5, .views = VIEWS, .displaced = true, .reference = &reference, .aside = aside});

	ck_assert_msg(found.refinement.accepted, "%d of %d views are better, %g alike", found.refinement.better,
		      found.refinement.held_out, found.refinement.alike);
	ck_assert_msg(found.after < .5 * found.before, "%g mm of %g", found.after, found.before);
	free((void *)reference.voxels);
}
END_TEST

/* Half of the object in each view: only a reference tells where these stood. */
START_TEST(a_displaced_detector_needs_a_reference)
{
	const struct arm arm = {
	    .columns = COLUMNS, .rows = ROWS, .count = VIEWS, .pixel = PIXEL, .first = .2, .step = 2 * M_PI / VIEWS};
	struct geometry geometry;
	struct orbit orbit;
	struct error err;

	for (int aside = 0; aside < 2; aside++) {
		ck_assert_int_eq(arm_nominal_geometry(&arm, &geometry, &err), 0);
		for (int k = 0; k < VIEWS && aside; k++)
			for (int a = 0; a < 3; a++)
				geometry.views[k].pixel0[a] += .3 * COLUMNS * geometry.views[k].column_step[a];
		ck_assert_int_eq(orbit_analyse(&orbit, &geometry, &err), 0);
		ck_assert(refine_is_possible(&geometry, &orbit, false) == !aside);
		ck_assert(refine_is_possible(&geometry, &orbit, true));
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

START_TEST(any_number_of_threads_finds_the_same)
{
#ifdef _OPENMP
	const int threads = omp_get_max_threads();
	struct found one, three;

	omp_set_num_threads(1);
	one = find(&(struct taken){.sway = 1, .views = VIEWS});
	omp_set_num_threads(3);
	three = find(&(struct taken){.sway = 1, .views = VIEWS});
	omp_set_num_threads(threads);
	ck_assert_mem_eq(&one.refinement.path, &three.refinement.path, sizeof(one.refinement.path));
#endif
}
END_TEST

/* _i: out of core, and on two cards. They differ from the whole by rounding. */
START_TEST(what_is_made_of_a_backend_finds_the_same)
{
	const struct found whole = find(&(struct taken){.sway = 1.5, .views = VIEWS});
	struct device *below;
	struct refine_device on = {.backend = _i == 0 ? &backend_outofcore : &backend_cards};
	const struct device_options options = {.threads = 2};
	struct found found;
	struct error err;
	double most = 0;

	ck_assert_int_eq(backend_cpu.open(0, &options, &below, &err), 0);
	ck_assert_int_eq(_i == 0 ? outofcore_open(&backend_cpu, below, &on.device, &err)
				 : cards_open(&backend_cpu, NULL, 2, &options, &on.device, &err),
			 0);
	found = find_on(&on, &(struct taken){.sway = 1.5, .views = VIEWS});
	on.backend->close(on.device);
	backend_cpu.close(below);
	ck_assert(found.refinement.accepted && found.refinement.path.knots == whole.refinement.path.knots);
	for (int k = 0; k < whole.refinement.path.knots; k++)
		for (int i = 0; i < PATH_NUMBERS; i++)
			most =
			    fmax(most, fabs(found.refinement.path.numbers[k][i] - whole.refinement.path.numbers[k][i]));
	ck_assert_double_lt(most, 1e-3);
}
END_TEST

/* ---- in a job ---- */

/* Asks how often it was asked, and says yes from one time on. */
struct asked {
	int yields, cancels; /* 0: never */
	int times;
};

static bool asked_yield(void *context)
{
	struct asked *asked = context;

	return asked->yields > 0 && asked->times >= asked->yields;
}

static bool asked_cancel(void *context)
{
	struct asked *asked = context;

	return ++asked->times >= asked->cancels && asked->cancels > 0;
}

/* A job that has all its views; those of a head, `more` times as dense. */
static struct recon *open_job(const struct geometry *geometry, float more, const struct recon_hooks *hooks,
			      struct device *device)
{
	static float projections[VIEWS * COLUMNS * ROWS];
	static int views[VIEWS];
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL};
	struct recipe recipe =
	    recipe_on(&(struct grid){.size = {20, 20, 16}, .spacing = {8, 8, 8}, .origin = {-76, -76, -60}});
	struct recon *recon = NULL;
	struct error err;

	recipe.fdk.on = recipe.refine.geometry = true;
	take(geometry, false, 0, projections);
	for (int i = 0; i < VIEWS * COLUMNS * ROWS; i++)
		projections[i] *= more;
	for (int k = 0; k < VIEWS; k++)
		views[k] = k;
	ck_assert_msg(recon_open(&backend_cpu, device, geometry, &linearise, &recipe, hooks, &recon, &err) == 0, "%s",
		      err.text);
	ck_assert_msg(recon_push(recon, projections, views, VIEWS, &err) == 0, "%s", err.text);
	recipe_clear(&recipe);
	return recon;
}

/* ---- a run that is broken off ---- */

/* What a refinement has reached, in memory; it yields behind each `every` steps, 0: never. */
struct kept {
	char *bytes;
	size_t size;
	int every, steps;
};

static bool kept_yields(void *context)
{
	struct kept *kept = context;

	return kept->every > 0 && ++kept->steps % kept->every == 0;
}

static bool kept_due(void *context, bool leaves)
{
	(void)context;
	return leaves;
}

static int kept_keep(void *context, const struct refine_state *state, struct error *err)
{
	struct kept *kept = context;
	char *bytes = NULL;
	size_t size = 0;

	(void)err;
	for (int i = 0; i < REFINE_PIECES; i++) {
		bytes = realloc(bytes, size + state->pieces[i].size + 1);
		if (state->pieces[i].size > 0)
			memcpy(bytes + size, state->pieces[i].bytes, state->pieces[i].size);
		size += state->pieces[i].size;
	}
	free(kept->bytes);
	kept->bytes = bytes;
	kept->size = size;
	return 0;
}

/* A run from what was kept, without `lacks` of its last bytes. */
static int run_kept(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind,
		    const struct refine_reference *reference, struct kept *kept, size_t lacks,
		    struct refinement *ret_refinement)
{
	struct refine_device on = {.backend = &backend_cpu};
	const size_t size = kept->size > lacks ? kept->size - lacks : 0;
	char *state = size > 0 ? malloc(size) : NULL; /* a copy, which an earlier run's file is, too */
	const struct refine_keep keep = {kept, kept_due, kept_keep, state, size};
	const struct refine_watch watch = {.yield = kept_yields, .context = kept, .keep = &keep};
	struct error err;
	int code;

	if (size > 0)
		memcpy(state, kept->bytes, size);
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){.threads = 2}, &on.device, &err), 0);
	code = refine_find(reduced, orbit, kind, WATER, &on, reference, &watch, ret_refinement, &err);
	ck_assert_msg(code == 0 || code == ERR_BUSY, "%s", err.text);
	backend_cpu.close(on.device);
	free(state);
	return code;
}

static void expect_same(const struct refinement *a, const struct refinement *b)
{
	ck_assert_int_eq(a->accepted, b->accepted);
	ck_assert_int_eq(a->better, b->better);
	ck_assert_int_eq(a->path.knots, b->path.knots);
	ck_assert_mem_eq(a->path.numbers, b->path.numbers, sizeof(a->path.numbers));
	ck_assert_mem_eq(a->path.common, b->path.common, sizeof(a->path.common));
	ck_assert_double_eq(a->held_before, b->held_before);
	ck_assert_double_eq(a->held_after, b->held_after);
	ck_assert_double_eq(a->alike, b->alike);
	ck_assert_double_eq(a->own_before, b->own_before);
	ck_assert_double_eq(a->own_after, b->own_after);
}

/*
 * A refinement that makes room behind every few steps goes on from there each time, and ends with the bits of one that
 * nobody disturbed: in two levels of bins, with a reference, and of a motion, for which several paths are tried.
 */
START_TEST(a_refinement_goes_on_from_where_it_left_off)
{
	enum { FINE_COLUMNS = 84, FINE_ROWS = 50, FINE_VIEWS = 48 };
	const bool referred = _i == 1;
	const enum refine_kind kind = _i == 2 ? REFINE_MOTION : REFINE_GEOMETRY;
	const struct arm arm = {.columns = FINE_COLUMNS,
				.rows = FINE_ROWS,
				.count = FINE_VIEWS,
				.pixel = PIXEL * COLUMNS / FINE_COLUMNS,
				.first = .2,
				.step = 3.5 / (FINE_VIEWS - 1)};
	struct refine_reference reference = refer(0);
	float *view = malloc(sizeof(float) * FINE_COLUMNS * FINE_ROWS);
	struct refinement undisturbed, found;
	struct geometry said, truth;
	struct ellipsoid parts[PARTS];
	const struct phantom phantom = {.count = PARTS, .parts = parts};
	struct kept kept = {.every = 0};
	struct reduced reduced;
	struct orbit orbit;
	struct error err;
	int runs = 1;

	fill(parts);
	ck_assert_int_eq(arm_nominal_geometry(&arm, &said, &err), 0);
	ck_assert_int_eq(geometry_copy(&truth, &said, &err), 0);
	ck_assert_int_eq(orbit_analyse(&orbit, &said, &err), 0);
	ck_assert_int_eq(reduced_open(&reduced, &said, &orbit, REFINE_VIEWS_MOST, REFINE_BINS_MOST, &err), 0);
	for (int k = 0; k < FINE_VIEWS; k++) {
		for (int a = 0; a < 3; a++)
			truth.views[k].pixel0[a] += 3 * sin(.2 * k) * truth.views[k].column_step[a];
		phantom_project(&phantom, &truth, k, view);
		reduced_take(&reduced, k, view);
	}
	ck_assert_int_eq(run_kept(&reduced, &orbit, kind, referred ? &reference : NULL, &kept, 0, &undisturbed), 0);
	ck_assert_ptr_null(kept.bytes);
	kept.every = referred ? 3 : kind == REFINE_MOTION ? 15 : 7;
	while (run_kept(&reduced, &orbit, kind, referred ? &reference : NULL, &kept, 0, &found) == ERR_BUSY)
		runs++;
	ck_assert_int_gt(runs, 5);
	ck_assert_int_lt(runs, 12);
	expect_same(&found, &undisturbed);
	/* What is not there whole is not gone on from. */
	kept.every = kept.steps = 0;
	if (referred) {
		ck_assert_int_eq(run_kept(&reduced, &orbit, kind, &reference, &kept, 1, &found), 0);
		expect_same(&found, &undisturbed);
	}
	free(kept.bytes);
	free(view);
	free((void *)reference.voxels);
	reduced_clear(&reduced);
	orbit_clear(&orbit);
	geometry_clear(&said);
	geometry_clear(&truth);
}
END_TEST

/* It is asked between its steps whether it goes on. What it goes by is the same again, and not that of other views. */
START_TEST(a_refinement_makes_room)
{
	const struct arm arm = {
	    .columns = COLUMNS, .rows = ROWS, .count = VIEWS, .pixel = PIXEL, .first = .2, .step = 3.5 / (VIEWS - 1)};
	struct geometry geometry, moved = {.count = 0};
	struct refinement refinement = {.held_out = -1};
	uint64_t basis[3];
	struct device *device;
	struct error err;

	ck_assert_int_eq(arm_nominal_geometry(&arm, &geometry, &err), 0);
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){.threads = 2}, &device, &err), 0);
	for (int i = 0; i < 3; i++) {
		struct asked asked = {.cancels = i == 0 ? 100000 : 0};
		const struct recon_hooks hooks = {.context = &asked, .cancelled = asked_cancel, .yield = asked_yield};
		struct recon *recon = open_job(&geometry, i == 2 ? 1.01f : 1, &hooks, device);

		basis[i] = recon_refine_basis(recon);
		asked = (struct asked){.yields = i == 0 ? 20 : 0, .cancels = i == 0 ? 0 : 20};
		ck_assert_int_eq(recon_refine(recon, NULL, NULL, &refinement, &moved, &err),
				 i == 0 ? ERR_BUSY : ERR_CANCELLED);
		/* Cancelled at once, yielded behind the step, in which it is asked some 20 times. */
		ck_assert_int_ge(asked.times, 20);
		ck_assert_int_le(asked.times, i == 0 ? 60 : 20);
		ck_assert_int_eq(recon_iteration(recon), 0);
		ck_assert_int_eq(refinement.held_out, -1);
		recon_free(recon);
	}
	ck_assert(basis[0] == basis[1] && basis[0] != basis[2] && basis[0] != 0);
	backend_cpu.close(device);
	geometry_clear(&geometry);
}
END_TEST

Suite *refine_suite(void);
Suite *refine_suite(void)
{
	Suite *suite = suite_create("refine");
	TCase *paths = tcase_create("paths"), *scans = tcase_create("scans"), *longer = tcase_create("long");

	tcase_add_test(paths, a_moved_object_is_seen_by_a_moved_view);
	tcase_add_test(paths, more_knots_do_not_change_a_path);
	tcase_add_loop_test(paths, a_step_finds_what_made_the_residuals, 0, 2);
	tcase_add_test(paths, what_all_views_share_is_no_path);
	tcase_add_loop_test(paths, what_is_nearer_to_all_views_is_no_path, 0, 2);
	tcase_add_test(paths, a_geometry_shows_the_object_where_it_was_told);
	tcase_add_test(paths, halved_bins_are_those_of_larger_ones);
	tcase_add_test(paths, a_displaced_detector_needs_a_reference);
	suite_add_tcase(suite, paths);
	tcase_set_timeout(scans, 300);
	tcase_set_timeout(longer, 300);
	tcase_set_tags(longer, "long");
	tcase_add_test(scans, a_detector_that_sways_is_found);
	tcase_add_test(scans, a_head_under_an_arm_that_sags_stays_where_it_is);
	tcase_add_test(scans, a_head_that_nods_is_followed);
	tcase_add_test(scans, a_knee_that_nods_is_followed);
	tcase_add_test(scans, a_geometry_that_fits_is_left_alone);
	tcase_add_loop_test(scans, few_noisy_views_are_registered_with_a_reference, 0, 2);
	tcase_add_loop_test(scans, a_displaced_detector_is_registered_with_a_reference, 0, 2);
	tcase_add_test(scans, a_reference_of_something_else_is_not_followed);
	tcase_add_loop_test(scans, a_reference_of_another_head_is_not_followed, 0, 2);
	tcase_add_loop_test(longer, a_refinement_goes_on_from_where_it_left_off, 0, 1);
	tcase_add_loop_test(scans, a_refinement_goes_on_from_where_it_left_off, 1, 3);
	tcase_add_test(scans, any_number_of_threads_finds_the_same);
	tcase_add_loop_test(scans, what_is_made_of_a_backend_finds_the_same, 0, 1);
	tcase_add_loop_test(longer, what_is_made_of_a_backend_finds_the_same, 1, 2);
	tcase_add_test(scans, a_refinement_makes_room);
	suite_add_tcase(suite, scans);
	suite_add_tcase(suite, longer);
	return suite;
}

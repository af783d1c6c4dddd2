/* Phantoms: exact integrals against brute force, and the voxel forms against the exact ones. */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/scan/phantom.h"

static double uniform(unsigned long long *seed, double from, double to)
{
	*seed = *seed * 6364136223846793005ULL + 1442695040888963407ULL;
	return from + (to - from) * (double)(*seed >> 11) / 9007199254740992.0;
}

static struct phantom named(const char *name, double scale)
{
	struct phantom phantom;
	struct error err = {0};

	ck_assert_msg(phantom_named(&phantom, name, scale, 0.02, &err) == 0, "%s", err.text);
	return phantom;
}

static struct phantom single(struct ellipsoid part)
{
	struct phantom phantom = {.count = 1, .parts = malloc(sizeof(part))};

	ck_assert_ptr_nonnull(phantom.parts);
	*phantom.parts = part;
	return phantom;
}

static struct ellipsoid random_part(unsigned long long *seed, enum shape shape)
{
	struct ellipsoid part = {.shape = shape, .angle = uniform(seed, -7, 7), .density = uniform(seed, -1, 1)};

	for (int i = 0; i < 3; i++) {
		part.semi_axes[i] = uniform(seed, 5, 40);
		part.centre[i] = uniform(seed, -30, 30);
	}
	return part;
}

static double distance(const double a[3], const double b[3])
{
	double d[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};

	return vec_norm(d);
}

/* Sum over the middles of many short steps: wrong by at most a step's part at each surface that the line crosses. */
enum { STEPS = 20000 };
static double brute_force(const struct phantom *phantom, const double a[3], const double b[3])
{
	double sum = 0;

	for (int n = 0; n < STEPS; n++) {
		double t = (n + 0.5) / STEPS;
		double point[3] = {a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])};

		sum += phantom_density(phantom, point);
	}
	return sum * distance(a, b) / STEPS;
}

/* Each part's surface is crossed at most twice, at an error of half a step each. */
static double brute_force_error(const struct phantom *phantom, const double a[3], const double b[3])
{
	double sum = 0;

	for (int i = 0; i < phantom->count; i++)
		sum += fabs(phantom->parts[i].density);
	return 1.001 * sum * distance(a, b) / STEPS + 1e-12;
}

static void assert_integral(const struct phantom *phantom, const double a[3], const double b[3])
{
	ck_assert_double_eq_tol(phantom_line_integral(phantom, a, b), brute_force(phantom, a, b),
				brute_force_error(phantom, a, b));
}

START_TEST(integrals_of_any_part_are_those_of_its_density)
{
	unsigned long long seed = 1;

	for (int n = 0; n < 90; n++) {
		struct phantom phantom = single(random_part(&seed, (enum shape)(n % 3)));
		double a[3], b[3];

		/* Towards the part, or along an axis beside its centre; one in six begins inside. */
		for (int i = 0; i < 3; i++) {
			double out = n % 6 == 0 ? 10 : 200;

			b[i] = phantom.parts[0].centre[i] + uniform(&seed, -20, 20);
			a[i] = b[i] + uniform(&seed, -out, out);
		}
		if (n % 5 == 0)
			for (int i = 0; i < 3; i++)
				a[i] = b[i] + (i == n % 3 ? 150 : 0);
		assert_integral(&phantom, a, b);
		for (int i = 0; i < 3; i++)
			b[i] += b[i] - a[i];
		assert_integral(&phantom, a, b);
		ck_assert_double_eq_tol(phantom_line_integral(&phantom, a, b), phantom_line_integral(&phantom, b, a),
					1e-9);
		phantom_clear(&phantom);
	}
}
END_TEST

START_TEST(every_named_phantom_integrates_exactly)
{
	unsigned long long seed = 2;

	for (const char *const *name = phantom_names; *name != NULL; name++) {
		struct phantom phantom = named(*name, 100);

		for (int n = 0; n < 12; n++) {
			double a[3], b[3];

			for (int i = 0; i < 3; i++) {
				a[i] = uniform(&seed, -300, 300);
				b[i] = uniform(&seed, -60, 60);
				b[i] += b[i] - a[i];
			}
			assert_integral(&phantom, a, b);
		}
		phantom_clear(&phantom);
	}
}
END_TEST

START_TEST(chords_that_anyone_can_check)
{
	static const struct {
		struct ellipsoid part;
		double a[3], b[3], integral;
	} rows[] = {
	    {{SHAPE_ELLIPSOID, {10, 10, 10}, {0, 0, 0}, 0, 2}, {-100, 0, 0}, {100, 0, 0}, 40},
	    {{SHAPE_ELLIPSOID, {10, 10, 10}, {0, 0, 0}, 0, 2}, {-100, 6, 0}, {100, 6, 0}, 32},
	    {{SHAPE_ELLIPSOID, {10, 10, 10}, {0, 0, 0}, 0, 2}, {-100, 10.001, 0}, {100, 10.001, 0}, 0},
	    {{SHAPE_ELLIPSOID, {10, 10, 10}, {0, 0, 0}, 0, 2}, {0, 0, 0}, {100, 0, 0}, 20},
	    {{SHAPE_ELLIPSOID, {10, 10, 10}, {0, 0, 0}, 0, 2}, {-3, 0, 0}, {4, 0, 0}, 14},
	    {{SHAPE_ELLIPSOID, {10, 10, 10}, {0, 0, 0}, 0, 2}, {20, 0, 0}, {100, 0, 0}, 0},
	    {{SHAPE_ELLIPSOID, {10, 20, 30}, {5, 6, 7}, M_PI / 2, 1}, {-100, 6, 7}, {100, 6, 7}, 40},
	    {{SHAPE_CYLINDER, {10, 10, 30}, {0, 0, 0}, 0, 1}, {0, 3, -100}, {0, 3, 100}, 60},
	    {{SHAPE_CYLINDER, {10, 10, 30}, {0, 0, 0}, 0, 1}, {0, 10.5, -100}, {0, 10.5, 100}, 0},
	    {{SHAPE_CYLINDER, {10, 10, 30}, {0, 0, 0}, 0, 1}, {-50, 0, 29.9}, {50, 0, 29.9}, 20},
	    {{SHAPE_CYLINDER, {10, 10, 30}, {0, 0, 0}, 0, 1}, {-50, 0, 30.1}, {50, 0, 30.1}, 0},
	    {{SHAPE_BOX, {10, 20, 30}, {0, 0, 0}, 0, 1}, {-50, 19, 29}, {50, 19, 29}, 20},
	    {{SHAPE_BOX, {10, 20, 30}, {0, 0, 0}, 0, 1}, {0, -70, 0}, {0, 70, 0}, 40},
	    {{SHAPE_BOX, {10, 10, 30}, {0, 0, 0}, M_PI / 4, 1}, {-50, 0, 0}, {50, 0, 0}, 20 * M_SQRT2},
	    {{SHAPE_BOX, {10, 20, 30}, {0, 0, 0}, 0, 1}, {1, 1, 1}, {1, 1, 1}, 0},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct phantom phantom = single(rows[i].part);

		ck_assert_msg(fabs(phantom_line_integral(&phantom, rows[i].a, rows[i].b) - rows[i].integral) < 1e-9,
			      "row %zu", i);
		phantom_clear(&phantom);
	}
}
END_TEST

static void turn_about_z(const double p[3], double angle, double ret[3])
{
	ret[0] = cos(angle) * p[0] - sin(angle) * p[1];
	ret[1] = sin(angle) * p[0] + cos(angle) * p[1];
	ret[2] = p[2];
}

START_TEST(moving_and_turning_object_and_line_changes_nothing)
{
	unsigned long long seed = 3;

	for (int n = 0; n < 30; n++) {
		struct phantom phantom = named("asymmetric", 100);
		double a[3], b[3], a2[3], b2[3], shift[3], angle = uniform(&seed, -4, 4), before;

		for (int i = 0; i < 3; i++) {
			a[i] = uniform(&seed, -300, 300);
			b[i] = uniform(&seed, -30, 30) - a[i];
			shift[i] = uniform(&seed, -50, 50);
		}
		before = phantom_line_integral(&phantom, a, b);
		ck_assert(before > 0);
		for (int i = 0; i < phantom.count; i++) {
			double centre[3];

			memcpy(centre, phantom.parts[i].centre, sizeof(centre));
			turn_about_z(centre, angle, phantom.parts[i].centre);
			phantom.parts[i].angle += angle;
		}
		phantom_move(&phantom, shift);
		turn_about_z(a, angle, a2);
		turn_about_z(b, angle, b2);
		for (int i = 0; i < 3; i++) {
			a2[i] += shift[i];
			b2[i] += shift[i];
		}
		ck_assert_double_eq_tol(phantom_line_integral(&phantom, a2, b2), before, 1e-10);
		phantom_clear(&phantom);
	}
}
END_TEST

START_TEST(parts_add_and_scales_multiply)
{
	const double a[3] = {-200, 30, 20}, b[3] = {200, -40, -10};

	for (const char *const *name = phantom_names; *name != NULL; name++) {
		struct phantom whole = named(*name, 100), twice;
		struct error err = {0};
		double sum = 0, all = phantom_line_integral(&whole, a, b), a2[3], b2[3];

		for (int i = 0; i < whole.count; i++)
			sum += phantom_line_integral(&(struct phantom){1, &whole.parts[i]}, a, b);
		ck_assert_double_eq_tol(all, sum, 1e-12);
		ck_assert_int_eq(phantom_named(&twice, *name, 200, 0.06, &err), 0);
		for (int i = 0; i < 3; i++) {
			a2[i] = 2 * a[i];
			b2[i] = 2 * b[i];
		}
		ck_assert_double_eq_tol(phantom_line_integral(&twice, a2, b2), 6 * all, 1e-12);
		phantom_clear(&whole);
		phantom_clear(&twice);
	}
}
END_TEST

START_TEST(known_densities_stand_at_known_places)
{
	static const struct {
		const char *name;
		double at[3], density;
	} rows[] = {
	    {"shepp-logan", {0, 0, 0}, 1.02},
	    {"shepp-logan", {0, .9, 0}, 2},
	    {"shepp-logan", {.22, 0, -.25}, 1},
	    {"head", {0, 0, 0}, .2},
	    {"head", {0, .9, 0}, 1},
	    {"head", {-.22, .1, -.25}, 0},
	    {"head", {0, .35, -.25}, .3},
	    {"ball", {.57, .57, .57}, 1},
	    {"ball", {.58, .58, .58}, 0},
	    {"cylinder", {.7, .7, .99}, 1},
	    {"cylinder", {.71, .71, 0}, 0},
	    {"disc", {0, 0, .049}, 1},
	    {"disc", {0, 0, .051}, 0},
	    {"asymmetric", {.45, .1, .2}, 2},
	    {"asymmetric", {-.45, .1, .2}, 1},
	    {"asymmetric", {.45, .1, -.2}, 1},
	    {"asymmetric", {-.15, .38, -.3}, .5},
	    {"asymmetric", {.1, -.4, 0}, 2.5},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct phantom phantom;
		struct error err = {0};

		ck_assert_int_eq(phantom_named(&phantom, rows[i].name, 1, 1, &err), 0);
		ck_assert_msg(fabs(phantom_density(&phantom, rows[i].at) - rows[i].density) < 1e-12, "row %zu", i);
		phantom_clear(&phantom);
	}
}
END_TEST

START_TEST(unknown_names_and_bad_numbers_are_refused)
{
	static const struct {
		const char *name;
		double scale, density;
	} rows[] = {{"potato", 1, 1}, {"", 1, 1},       {"ball", 0, 1},
		    {"ball", -1, 1},  {"ball", NAN, 1}, {"ball", 1, INFINITY}};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct phantom phantom = {.count = -7};
		struct error err = {0};

		ck_assert_int_eq(phantom_named(&phantom, rows[i].name, rows[i].scale, rows[i].density, &err),
				 ERR_INVALID);
		ck_assert_int_eq(phantom.count, -7);
	}
}
END_TEST

/* ---- projections and voxels ---- */

static struct geometry one_view(int columns, int rows, double pixel, double angle)
{
	struct circular orbit = {.source_to_isocentre = 620, .source_to_detector = 1100, .pixel = {pixel, 0.7 * pixel}};
	struct geometry geometry;
	struct error err = {0};

	ck_assert_int_eq(geometry_circular(&geometry, columns, rows, 1, &orbit, &angle, &err), 0);
	return geometry;
}

START_TEST(a_projection_has_each_pixel_s_integral)
{
	enum { COLUMNS = 300, ROWS = 11 }; /* more columns than are summed in one go */
	struct geometry geometry = one_view(COLUMNS, ROWS, 1.3, 0.7);
	const struct view *view = &geometry.views[0];
	struct phantom phantom = named("asymmetric", 100);
	float *projection = malloc(sizeof(float) * COLUMNS * ROWS);

	ck_assert_ptr_nonnull(projection);
	phantom_project(&phantom, &geometry, 0, projection);
	for (int row = 0; row < ROWS; row++)
		for (int column = 0; column < COLUMNS; column++) {
			double pixel[3];

			for (int i = 0; i < 3; i++)
				pixel[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
			/* Half a unit in the last place of a float below 8. */
			ck_assert_double_eq_tol(projection[row * COLUMNS + column],
						phantom_line_integral(&phantom, view->source, pixel), 2.5e-7);
		}
	free(projection);
	phantom_clear(&phantom);
	geometry_clear(&geometry);
}
END_TEST

static struct grid grid_of(int nx, int ny, int nz, double dx, double dy, double dz)
{
	struct grid grid = {.size = {nx, ny, nz}, .spacing = {dx, dy, dz}};

	grid_centre(&grid);
	return grid;
}

static double volume_sum(const float *volume, const struct grid *grid)
{
	double sum = 0;

	for (size_t i = 0; i < grid_voxels(grid); i++)
		sum += volume[i];
	return sum * grid->spacing[0] * grid->spacing[1] * grid->spacing[2];
}

START_TEST(voxels_hold_the_object_s_mass_and_its_place)
{
	static const double volume_of_unit[] = {4 * M_PI / 3, 2 * M_PI, 8};
	struct grid grid = grid_of(40, 44, 36, 2.5, 2, 3);
	float *volume = malloc(sizeof(float) * grid_voxels(&grid));
	unsigned long long seed = 5;

	ck_assert_ptr_nonnull(volume);
	for (int n = 0; n < 9; n++) {
		struct ellipsoid part = random_part(&seed, (enum shape)(n % 3));
		struct phantom phantom;
		double mass, moment[3] = {0}, sum = 0;

		for (int i = 0; i < 3; i++) {
			part.semi_axes[i] = uniform(&seed, 8, 16);
			part.centre[i] = uniform(&seed, -15, 15);
		}
		phantom = single(part);
		mass = part.density * volume_of_unit[part.shape] * part.semi_axes[0] * part.semi_axes[1] *
		       part.semi_axes[2];
		phantom_voxelise(&phantom, &grid, 4, volume);
		/* A flat end lies anywhere between two points 0.75 mm apart, on a part at least 16 mm long. */
		ck_assert_double_eq_tol(volume_sum(volume, &grid), mass, 0.75 / 16 * fabs(mass));
		for (int z = 0; z < grid.size[2]; z++)
			for (int y = 0; y < grid.size[1]; y++)
				for (int x = 0; x < grid.size[0]; x++) {
					double v = volume[(z * grid.size[1] + y) * grid.size[0] + x];

					moment[0] += v * (grid.origin[0] + x * grid.spacing[0]);
					moment[1] += v * (grid.origin[1] + y * grid.spacing[1]);
					moment[2] += v * (grid.origin[2] + z * grid.spacing[2]);
					sum += v;
				}
		for (int i = 0; i < 3; i++)
			ck_assert_double_eq_tol(moment[i] / sum, part.centre[i], 0.375);
		phantom_clear(&phantom);
	}
	free(volume);
}
END_TEST

START_TEST(voxels_are_means_of_points)
{
	struct grid grid = grid_of(17, 15, 13, 11, 13, 14);
	float *volume = malloc(sizeof(float) * grid_voxels(&grid));
	struct phantom phantom = named("asymmetric", 90);

	ck_assert_ptr_nonnull(volume);
	for (int samples = 1; samples <= 3; samples++) {
		phantom_voxelise(&phantom, &grid, samples, volume);
		for (size_t at = 0; at < grid_voxels(&grid); at += 7) {
			size_t index[3] = {at % 17, at / 17 % 15, at / (17 * 15)};
			double sum = 0;

			for (int n = 0; n < samples * samples * samples; n++) {
				int part[3] = {n % samples, n / samples % samples, n / samples / samples};
				double point[3];

				for (int i = 0; i < 3; i++)
					point[i] =
					    grid.origin[i] +
					    ((double)index[i] + (part[i] + 0.5) / samples - 0.5) * grid.spacing[i];
				sum += phantom_density(&phantom, point);
			}
			ck_assert_double_eq_tol(volume[at], sum / (samples * samples * samples), 1e-7);
		}
	}
	free(volume);
	phantom_clear(&phantom);
}
END_TEST

START_TEST(fine_sampling_of_a_uniform_block_is_its_chord)
{
	struct geometry geometry = one_view(61, 41, 2.1, 0.4);
	struct grid grid = grid_of(10, 12, 7, 8, 6, 5);
	struct phantom block = single((struct ellipsoid){
	    SHAPE_BOX, {40, 36, 17.5}, {3, -2, 5}, 0, 0.5}); /* the grid with its outer half voxels */
	float volume[10 * 12 * 7], exact[61 * 41], fine[61 * 41];

	for (int i = 0; i < 3; i++)
		grid.origin[i] += block.parts[0].centre[i];
	for (size_t i = 0; i < grid_voxels(&grid); i++)
		volume[i] = 0.5f;
	phantom_project(&block, &geometry, 0, exact);
	for (int sampling = SAMPLE_NEAREST; sampling <= SAMPLE_TRILINEAR; sampling++) {
		volume_project_fine(volume, &grid, &geometry, 0, (enum sampling)sampling, 3, fine);
		for (int i = 0; i < 61 * 41; i++)
			ck_assert_float_eq_tol(fine[i], exact[i], 1e-5f); /* floats of about 50 */
	}
	phantom_clear(&block);
	geometry_clear(&geometry);
}
END_TEST

/* Relative L2 distance of fine sampling of the voxelised phantom from the exact integrals. */
static double fine_distance(const struct phantom *phantom, int size, enum sampling sampling)
{
	struct geometry geometry = one_view(50, 50, 4.5, 2.5);
	struct grid grid = grid_of(size, size, size, 200.0 / size, 200.0 / size, 200.0 / size);
	float *volume = malloc(sizeof(float) * grid_voxels(&grid)), exact[2500], fine[2500];
	double difference = 0, norm = 0;

	ck_assert_ptr_nonnull(volume);
	phantom_voxelise(phantom, &grid, 3, volume);
	phantom_project(phantom, &geometry, 0, exact);
	volume_project_fine(volume, &grid, &geometry, 0, sampling, 50.0 / size, fine);
	for (int i = 0; i < 2500; i++) {
		difference += ((double)fine[i] - exact[i]) * ((double)fine[i] - exact[i]);
		norm += (double)exact[i] * exact[i];
	}
	free(volume);
	geometry_clear(&geometry);
	return sqrt(difference / norm);
}

START_TEST(fine_sampling_comes_to_the_exact_integrals_as_voxels_shrink)
{
	struct phantom phantom = named("asymmetric", 100);

	for (int sampling = SAMPLE_NEAREST; sampling <= SAMPLE_TRILINEAR; sampling++) {
		double coarse = fine_distance(&phantom, 25, (enum sampling)sampling);
		double fine = fine_distance(&phantom, 100, (enum sampling)sampling);

		/* The error is at surfaces, so it shrinks at least with the voxel; a mistake in place would not. */
		ck_assert_msg(fine < 0.02 && fine < coarse / 3, "%g at 25 voxels, %g at 100", coarse, fine);
	}
	phantom_clear(&phantom);
}
END_TEST

Suite *phantom_suite(void);
Suite *phantom_suite(void)
{
	Suite *suite = suite_create("phantom");
	TCase *exact = tcase_create("exact"), *made = tcase_create("projections and voxels");

	tcase_add_test(exact, integrals_of_any_part_are_those_of_its_density);
	tcase_add_test(exact, every_named_phantom_integrates_exactly);
	tcase_add_test(exact, chords_that_anyone_can_check);
	tcase_add_test(exact, moving_and_turning_object_and_line_changes_nothing);
	tcase_add_test(exact, parts_add_and_scales_multiply);
	tcase_add_test(exact, known_densities_stand_at_known_places);
	tcase_add_test(exact, unknown_names_and_bad_numbers_are_refused);
	suite_add_tcase(suite, exact);
	tcase_add_test(made, a_projection_has_each_pixel_s_integral);
	tcase_add_test(made, voxels_hold_the_object_s_mass_and_its_place);
	tcase_add_test(made, voxels_are_means_of_points);
	tcase_add_test(made, fine_sampling_of_a_uniform_block_is_its_chord);
	tcase_add_test(made, fine_sampling_comes_to_the_exact_integrals_as_voxels_shrink);
	/* Sanitizers are slow. */
	tcase_set_timeout(exact, 60);
	tcase_set_timeout(made, 60);
	suite_add_tcase(suite, made);
	return suite;
}

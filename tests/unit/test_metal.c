/*
 * Metal is found, its shadows are replaced, and every kept volume shows it: on a
 * body with screws and a bar whose projections are exact integrals of several
 * energies, with noise, starved behind the metal.
 */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/metal.h"
#include "tests/unit/scene.h"

static const double MU_WATER = 0.0192;

/* ---- a body with metal ---- */

static struct ellipsoid body_parts[] = {{SHAPE_CYLINDER, {60, 48, 8}, {0, 0, 0}, 0, 1},
					{SHAPE_CYLINDER, {9, 7, 8}, {14, 20, 0}, .3, -1}};
static struct ellipsoid bone_parts[] = {{SHAPE_CYLINDER, {14, 11, 8}, {0, -22, 0}, 0, 1}};
static struct ellipsoid metal_parts[] = {{SHAPE_CYLINDER, {3, 3, 8}, {-16, -18, 0}, 0, 1},
					 {SHAPE_CYLINDER, {3, 3, 8}, {16, -18, 0}, 0, 1},
					 {SHAPE_BOX, {8, 2.5, 8}, {30, 8, 0}, .5, 1}};
static const struct phantom body = {2, body_parts}, bone = {1, bone_parts}, metal = {3, metal_parts};

/* Shares of the counts, and attenuation in 1/mm of water, bone and titanium. */
enum { ENERGIES = 3 };
static const struct {
	double share, water, bone, metal;
} energies[ENERGIES] = {{.3, .0227, .0727, .70}, {.4, .0190, .0454, .36}, {.3, .0168, .0340, .22}};

static uint64_t random_state;

static double uniform(void) /* 0 .. 1, neither of them */
{
	random_state = random_state * 6364136223846793005u + 1442695040888963407u;
	return ((double)(random_state >> 11) + .5) / 9007199254740992.;
}

static double normal(void)
{
	return sqrt(-2 * log(uniform())) * cos(2 * M_PI * uniform());
}

/* The water that attenuates as much: Newton's method. */
static double water_length(double transmission)
{
	double length = 0;

	for (int step = 0; step < 8; step++) {
		double sum = 0, slope = 0;

		for (int e = 0; e < ENERGIES; e++) {
			const double part = energies[e].share * exp(-energies[e].water * length);

			sum += part;
			slope += part * energies[e].water;
		}
		length += log(sum / transmission) * sum / slope;
	}
	return length;
}

/* Line integrals as of water, from 200000 counts in air. */
static float sample_of(double in_body, double in_bone, double in_metal)
{
	const double air = 200000, water = fmax(in_body - in_bone - in_metal, 0);
	double counts = 0;

	for (int e = 0; e < ENERGIES; e++)
		counts += air * energies[e].share *
			  exp(-energies[e].water * water - energies[e].bone * in_bone - energies[e].metal * in_metal);
	counts = fmax(counts + sqrt(counts + 9) * normal(), 1);
	return (float)(MU_WATER * water_length(counts / air));
}

/* FEWER: where bits are held against bits, and errors against nothing. */
enum { COLUMNS = 112, ROWS = 24, VIEWS = 120, FEWER = 30 };

static void scene_make(struct scene *ret, int views, bool with_metal)
{
	const struct orbit_spec spec = {COLUMNS, ROWS,        views, {620, 1100, {2.4, 2.4}, {0, 0}, {0, 0}},
					3.7,     360. / views};
	const size_t pixels = (size_t)COLUMNS * ROWS;
	float *parts[3];

	scene_orbit(ret, &spec);
	random_state = 7;
	for (int i = 0; i < 3; i++) {
		parts[i] = malloc(sizeof(float) * pixels);
		ck_assert_ptr_nonnull(parts[i]);
	}
	for (int view = 0; view < views; view++) {
		phantom_project(&body, &ret->geometry, view, parts[0]);
		phantom_project(&bone, &ret->geometry, view, parts[1]);
		phantom_project(&metal, &ret->geometry, view, parts[2]);
		for (size_t i = 0; i < pixels; i++)
			ret->projections[(size_t)view * pixels + i] =
			    sample_of((double)parts[0][i], (double)parts[1][i], with_metal ? (double)parts[2][i] : 0);
	}
	for (int i = 0; i < 3; i++)
		free(parts[i]);
}

static struct recipe recipe_make(bool with_metal)
{
	const struct grid grid = grid_of(84, 68, 14, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_on(&grid);

	recipe.fdk.on = true;
	recipe.metal.on = with_metal;
	return recipe;
}

/* Root of the mean square in HU against another volume, over soft tissue: in the body, two voxels from all bone and
 * metal. */
static double soft_error(const float *volume, const float *other, const struct grid *grid)
{
	const size_t voxels = grid_voxels(grid);
	float *parts[3];
	double sum = 0;
	size_t count = 0;

	for (int i = 0; i < 3; i++) {
		parts[i] = malloc(sizeof(float) * voxels);
		ck_assert_ptr_nonnull(parts[i]);
		phantom_voxelise(i == 0 ? &body : i == 1 ? &bone : &metal, grid, 1, parts[i]);
	}
	for (int z = 4; z < grid->size[2] - 4; z++) /* not near the body's ends either */
		for (int y = 2; y < grid->size[1] - 2; y++)
			for (int x = 2; x < grid->size[0] - 2; x++) {
				const size_t row = (size_t)grid->size[0];
				const size_t at = ((size_t)z * (size_t)grid->size[1] + (size_t)y) * row + (size_t)x;
				bool soft = true;

				for (int j = -2; j <= 2; j++)
					for (int i = -2; i <= 2; i++) {
						const size_t near = (size_t)((ptrdiff_t)at + j * (ptrdiff_t)row + i);

						soft = soft && parts[0][near] == 1 && parts[1][near] == 0 &&
						       parts[2][near] == 0;
					}
				if (!soft)
					continue;
				sum += pow(((double)volume[at] - (double)other[at]) / MU_WATER * 1000, 2);
				count++;
			}
	for (int i = 0; i < 3; i++)
		free(parts[i]);
	ck_assert_uint_gt(count, 1000);
	return sqrt(sum / (double)count);
}

/* ---- the stage ---- */

/* Against the same body without metal: the FDK volume, and that of SART and TV after it. */
START_TEST(streaks_fall_and_the_metal_stays)
{
	struct recipe without, with = recipe_make(true);
	struct outcome clean = {0}, streaks = {0}, outcome = {0};
	struct scene bare, scene;
	const double screw[3] = {-16, -18, 0}, bar[3] = {30, 8, 0};
	int emit[2] = {EMIT_FDK, 1};

	scene_make(&bare, VIEWS, false);
	scene_make(&scene, VIEWS, true);
	with.algorithm = &algorithm_sart;
	with.iterate.iterations = 2;
	/* The same steps in all volumes: TV that goes by the noise would smooth the streaks more than the rest. */
	with.tv.on = true;
	with.tv.automatic = false;
	with.tv.options.method = TV_GRADIENT;
	with.tv.options.alpha = with.tv.options.step = 0.1;
	with.tv.options.iterations = 10;
	with.emit = emit;
	with.emits = 2;
	without = with;
	without.metal.on = false;
	scene_run(&bare, &without, &clean);
	scene_run(&scene, &without, &streaks);
	scene_run(&scene, &with, &outcome);
	for (int i = 0; i < 2; i++) {
		const char *name = i == 0 ? "fdk" : "final";
		const float *want = outcome_volume(&clean, name);
		const double before = soft_error(outcome_volume(&streaks, name), want, &clean.grid);
		const double after = soft_error(outcome_volume(&outcome, name), want, &clean.grid);

		ck_assert_msg(after < .7 * before, "%s: %g HU with streaks, %g without", name, before, after);
	}
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "metal: "));
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "are metal: of 2500 HU or more"));
	ck_assert_ptr_null(strstr(streaks.warnings, "metal"));
	for (int i = 0; i < outcome.kept_count; i++) {
		const float *volume = outcome.kept[i].voxels;
		double highest = 0;

		/* titanium has at least 10000 HU at these energies, here blurred over a screw of 4 voxels */
		ck_assert_double_gt(mean_near(volume, &outcome.grid, screw, 1.5), 4.5 * MU_WATER);
		ck_assert_double_gt(mean_near(volume, &outcome.grid, bar, 1.5), 4.5 * MU_WATER);
		for (size_t k = 0; k < grid_voxels(&outcome.grid); k++)
			highest = fmax(highest, (double)volume[k]);
		ck_assert_double_eq(highest, outcome.kept[i].norms.maximum); /* statistics are those of what is kept */
		ck_assert_double_eq(outcome.kept[i].estimate_mm, 10);
		ck_assert_double_eq(streaks.kept[i].estimate_mm, 0);
		/* Across the axis metal has 137 mm^2 of the body's 8850, what is within 10 mm of it about 1830. */
		ck_assert_double_gt(outcome.kept[i].support.metal, 0.8 * 0.0154);
		ck_assert_double_lt(outcome.kept[i].support.metal, 2 * 0.0154);
		ck_assert_double_gt(outcome.kept[i].support.estimated, 0.18);
		ck_assert_double_lt(outcome.kept[i].support.estimated, 0.26);
		ck_assert_double_eq(streaks.kept[i].support.metal, 0);
		ck_assert_double_lt(streaks.kept[i].support.estimated, 0.01);
	}
	for (int i = 0; i < outcome.row_count; i++) /* the metal is not in what is iterated */
		ck_assert_double_lt(outcome.rows[i].residual, streaks.rows[i].residual);
	outcome_clear(&outcome);
	outcome_clear(&streaks);
	outcome_clear(&clean);
	scene_clear(&scene);
	scene_clear(&bare);
}
END_TEST

/* _i: FDK alone, SART after it. */
START_TEST(without_metal_nothing_changes)
{
	struct recipe without = recipe_make(false), with = recipe_make(true);
	struct outcome plain = {0}, outcome = {0};
	struct scene scene;

	scene_make(&scene, FEWER, false);
	without.algorithm = with.algorithm = _i == 1 ? &algorithm_sart : NULL;
	without.iterate.iterations = with.iterate.iterations = 1;
	scene_run(&scene, &without, &plain);
	scene_run(&scene, &with, &outcome);
	ck_assert_mem_eq(outcome_volume(&outcome, "final"), outcome_volume(&plain, "final"),
			 sizeof(float) * grid_voxels(&plain.grid));
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "no_metal: nothing in the FDK volume has 2500 HU or more"));
	ck_assert_uint_eq(outcome.metal_bytes, 0);
	ck_assert_double_eq(outcome.kept[0].estimate_mm, 0);
	outcome_clear(&outcome);
	outcome_clear(&plain);
	scene_clear(&scene);
}
END_TEST

/*
 * _i: in a grid that holds the body, in one that cuts the metal, and in one with none in it, and of those two volumes
 * that are held against their start.
 */
START_TEST(a_run_with_metal_goes_on_with_the_same_bits)
{
	static const int sizes[][2] = {{84, 68}, {84, 24}, {14, 20}};
	const struct grid grid = grid_of(sizes[_i][0], sizes[_i][1], 14, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_make(true);
	struct outcome whole = {0}, first = {.yield_at = 1}, second = {.threads = 1};
	struct scene scene;

	scene_make(&scene, FEWER, true);
	recipe.grid = grid;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 2;
	recipe.tv.on = recipe.tv.after_fdk = _i > 0;
	if (_i > 0)
		recipe_automatic_tv(&recipe, TV_PROXIMAL);
	scene_run(&scene, &recipe, &whole);
	ck_assert_ptr_nonnull(strstr(whole.warnings, "metal: "));
	scene_run(&scene, &recipe, &first);
	ck_assert((first.metal_bytes > 0) == (_i < 2));
	outcome_resume(&second, &first);
	scene_run(&scene, &recipe, &second);
	ck_assert_mem_eq(outcome_volume(&second, "final"), outcome_volume(&whole, "final"),
			 sizeof(float) * grid_voxels(&whole.grid));
	ck_assert_double_eq(second.rows[0].residual, whole.rows[1].residual);
	outcome_clear(&second);
	outcome_clear(&first);
	/* And in no more memory than is said, of which what is found outside takes a part. */
	expect_same_after_a_yield(&scene, &recipe, 1, &whole);
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_list_of_another_grid_is_refused)
{
	struct recipe recipe = recipe_make(true);
	struct outcome first = {.yield_at = 1}, second = {0};
	struct scene scene;

	scene_make(&scene, FEWER, true);
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 2;
	scene_run(&scene, &recipe, &first);
	((struct metal_voxel *)first.metal)[1].z = 14;
	second = (struct outcome){.resume = first.last, .resume_metal = first.metal};
	second.resume_metal_bytes = first.metal_bytes;
	scene_run(&scene, &recipe, &second);
	ck_assert_int_eq(second.code, ERR_INVALID);
	outcome_clear(&second);
	outcome_clear(&first);
	scene_clear(&scene);
}
END_TEST

START_TEST(cancel_ends_the_stage_wherever_it_is)
{
	struct recipe recipe = recipe_make(true);
	struct outcome whole = {.at_once = 1};
	struct scene scene;

	scene_make(&scene, FEWER, true);
	scene_run(&scene, &recipe, &whole);
	ck_assert_int_eq(whole.code, 0);
	/* it is asked for each view that is pushed, and then at least for each slice, batch and view of the stage */
	ck_assert_int_gt(whole.asked, 3 * FEWER);
	/* Behind the volume the geometry is checked. */
	for (int at = FEWER + 1; at <= whole.kept[0].asked; at += whole.kept[0].asked / 12) {
		struct outcome outcome = {.at_once = 1, .cancel_at = at};

		scene_run(&scene, &recipe, &outcome);
		ck_assert_int_eq(outcome.code, ERR_CANCELLED);
		ck_assert_int_eq(outcome.kept_count, 0);
		outcome_clear(&outcome);
	}
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

/* _i: FDK alone, SART after it, TV after it. */
START_TEST(memory_is_known_beforehand)
{
	struct recipe without = recipe_make(false), with = recipe_make(true);
	const struct recon_hooks hooks = {0};
	const struct linearise linearise = {0};
	struct device_options options = {.threads = 1};
	struct recon_memory alone, plain, memory;
	struct device *device;
	struct recon *recon = NULL;
	struct scene scene;
	struct error err;

	scene_make(&scene, FEWER, true);
	/* All of it on one thread: what is worked in grows with them. */
	ck_assert_int_eq(backend_cpu.open(0, &options, &device, &err), 0);
	ck_assert_int_eq(recon_memory(&backend_cpu, device, &scene.geometry, &linearise, &without, &alone, &err), 0);
	without.algorithm = with.algorithm = _i == 1 ? &algorithm_sart : NULL;
	without.tv.on = with.tv.on = _i == 2;
	without.tv.after_fdk = with.tv.after_fdk = true;
	ck_assert_int_eq(recon_memory(&backend_cpu, device, &scene.geometry, &linearise, &without, &plain, &err), 0);
	ck_assert_int_eq(recon_memory(&backend_cpu, device, &scene.geometry, &linearise, &with, &memory, &err), 0);
	backend_cpu.close(device);
	ck_assert_uint_ge(memory.projections, sizeof(float) * COLUMNS * ROWS * FEWER);
	ck_assert_uint_gt(memory.total, plain.total);
	/* a volume to work in, which SART's copy of the iterate is */
	ck_assert_uint_eq(memory.volumes, plain.volumes + (_i == 1 ? 0 : alone.volumes));
	options.memory_limit = memory.total;
	ck_assert_int_eq(backend_cpu.open(0, &options, &device, &err), 0);
	ck_assert_msg(recon_open(&backend_cpu, device, &scene.geometry, &linearise, &with, &hooks, &recon, &err) == 0,
		      "%s", err.text);
	recon_free(recon);
	backend_cpu.close(device);
	scene_clear(&scene);
}
END_TEST

/* ---- what is beside metal ---- */

static struct ellipsoid spine_body[] = {{SHAPE_CYLINDER, {60, 48, 14}, {0, 0, 0}, 0, 1},
					{SHAPE_ELLIPSOID, {9, 7, 9}, {14, 22, 0}, .3, -1}};
static struct ellipsoid spine_bone[] = {{SHAPE_CYLINDER, {15, 12, 12}, {0, -16, 0}, 0, 1.2}};
/* Densities against water: 17000 HU, 8000 HU, and contrast medium of 3000 HU. */
static struct ellipsoid screw_parts[] = {{SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {-13, -20, 5}, .5, 18},
					 {SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {13, -20, 5}, -.5, 18},
					 {SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {-13, -20, -5}, .5, 18},
					 {SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {13, -20, -5}, -.5, 18}};
static struct ellipsoid wire_parts[] = {{SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {-13, -20, 5}, .5, 18},
					{SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {13, -20, 5}, -.5, 18},
					{SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {-13, -20, -5}, .5, 18},
					{SHAPE_ELLIPSOID, {17, 2.5, 2.5}, {13, -20, -5}, -.5, 18},
					{SHAPE_ELLIPSOID, {20, .8, .8}, {-14, 10, 2}, .3, 8}};
static struct ellipsoid rod_parts[] = {{SHAPE_CYLINDER, {3, 3, 40}, {-17, -26, 0}, 0, 9},
				       {SHAPE_CYLINDER, {3, 3, 40}, {18, -24, 0}, 0, 9}};
static struct ellipsoid vessel_parts[] = {{SHAPE_ELLIPSOID, {24, 2.2, 2.2}, {-6, 12, 2}, .4, 3}};

static const struct object {
	const char *name;
	struct phantom parts;
	double threshold; /* HU */
	/* Beside it, against the same without the stage, at most; HU of the bone in the mean, infinite: none is beside
	 * it. */
	double most, bone;
	int nx, ny;   /* voxels of the grid, 0: as many as hold the body */
	bool outside; /* all of it lies outside of that */
} objects[] = {{"four screws", {4, screw_parts}, 2500, .35, 60, 0, 0, false},
	       {"two rods", {2, rod_parts}, 2500, 1.1, 60, 0, 0, false},
	       {"a vessel", {1, vessel_parts}, 2000, 1.1, INFINITY, 0, 0, false},
	       {"a wire that the grid's side cuts", {1, &wire_parts[4]}, 1400, 1.1, INFINITY, 16, 68, false},
	       {"screws that the grid's sides cut", {4, screw_parts}, 2500, .5, 60, 22, 34, false},
	       {"two rods outside of the grid", {2, rod_parts}, 2500, 1.1, INFINITY, 84, 26, true},
	       {"two rods beside the grid's side", {2, rod_parts}, 2500, 1.1, INFINITY, 84, 37, false},
	       {"four screws in a grid within the body", {4, screw_parts}, 2500, .35, 60, 50, 50, false}};
enum { OBJECTS = sizeof(objects) / sizeof(*objects), LONG_OBJECTS = 2 /* the last ones */ };

/* Water and bone and metal add up; exact, or with Poisson noise of 40000 counts in air. NULL: the body alone. */
static void object_make(struct scene *ret, const struct phantom *object, bool exact)
{
	const struct orbit_spec spec = {COLUMNS, 32, VIEWS, {620, 1100, {2.4, 2.4}, {0, 0}, {0, 0}}, 3.7, 360. / VIEWS};
	struct phantom parts[3] = {{2, spine_body}, {1, spine_bone}, {0}};
	const double air = 40000;

	scene_orbit(ret, &spec);
	random_state = 11;
	if (object != NULL)
		parts[2] = *object;
	for (int i = 0; i < (object != NULL ? 3 : 2); i++)
		scene_add(ret, &parts[i]);
	for (size_t i = 0; i < (size_t)COLUMNS * 32 * VIEWS; i++) {
		const double p = MU_WATER * (double)ret->projections[i], counts = air * exp(-p);

		ret->projections[i] = (float)(exact ? p : -log(fmax(counts + sqrt(counts) * normal(), .5) / air));
	}
}

/* In HU against a volume of the same body: the root of the mean square beside the metal, and the mean in bone there. */
struct beside {
	double error, bone;
};
static struct beside beside_metal(const float *volume, const float *clean, const struct grid *grid,
				  const struct phantom *object)
{
	const double nearest = 3.2, farthest = 10;
	double squares = 0, bones = 0;
	size_t count = 0, bone_count = 0;
	struct beside ret;

	for (size_t i = 0; i < grid_voxels(grid); i++) {
		const int at[3] = {(int)(i % (size_t)grid->size[0]),
				   (int)(i / (size_t)grid->size[0] % (size_t)grid->size[1]),
				   (int)(i / (size_t)grid->size[0] / (size_t)grid->size[1])};
		const double error = ((double)volume[i] - (double)clean[i]) / MU_WATER * 1000;
		double place[3], away = INFINITY;

		for (int a = 0; a < 3; a++)
			place[a] = grid->origin[a] + at[a] * grid->spacing[a];
		if (fabs(place[2]) > 9 || hypot(place[0] / 56, place[1] / 44) > 1)
			continue;
		/* How far the shapes must grow to reach it: near enough to the distance for thin ones. */
		for (int k = 0; k < object->count; k++) {
			struct ellipsoid grown = object->parts[k], largest = grown;
			const struct phantom one = {1, &grown}, all = {1, &largest};
			double mm = 0;

			for (int a = 0; a < 3; a++)
				largest.semi_axes[a] += farthest;
			if (phantom_density(&all, place) == 0)
				continue;
			for (; mm < farthest && phantom_density(&one, place) == 0; mm += .4)
				for (int a = 0; a < 3; a++)
					grown.semi_axes[a] += .4;
			away = fmin(away, mm);
		}
		if (away < nearest || away >= farthest)
			continue;
		squares += error * error;
		count++;
		if (hypot(place[0] / 13, (place[1] + 16) / 10) < 1) {
			bones += error;
			bone_count++;
		}
	}
	ret.error = sqrt(squares / (double)count);
	ret.bone = bones / fmax((double)bone_count, 1);
	return ret;
}

static int emit_fdk[] = {EMIT_FDK};

/* The FDK volume is kept, too. */
static struct recipe object_recipe(const struct object *object, bool with_metal, int iterations)
{
	const struct grid grid =
	    grid_of(object->nx > 0 ? object->nx : 84, object->ny > 0 ? object->ny : 68, 16, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_on(&grid);

	recipe.fdk.on = true;
	recipe.metal.on = with_metal;
	recipe.algorithm = iterations > 0 ? &algorithm_sart : NULL;
	recipe.iterate.iterations = iterations;
	recipe.emit = emit_fdk;
	recipe.emits = 1;
	return recipe;
}

/* What a volume has more than the body alone up to some mm from a thin part, in HU mm^3. */
static double mass_of(const struct ellipsoid *part, const float *volume, const float *clean, const struct grid *grid)
{
	struct ellipsoid wide = *part;
	const struct phantom around = {1, &wide};
	double sum = 0;

	for (int a = 0; a < 3; a++)
		wide.semi_axes[a] += 3.2;
	for (size_t i = 0; i < grid_voxels(grid); i++) {
		const size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1];
		const size_t at[3] = {i % nx, i / nx % ny, i / nx / ny};
		double place[3];

		for (int a = 0; a < 3; a++)
			place[a] = grid->origin[a] + (double)at[a] * grid->spacing[a];
		if (phantom_density(&around, place) > 0)
			sum += ((double)volume[i] - (double)clean[i]) / MU_WATER * 1000 * 1.6 * 1.6 * 1.6;
	}
	return sum;
}

/* That a thin part has its mass, after FDK and after SART. */
static void expect_whole(struct ellipsoid *part, const struct outcome *clean, const struct outcome *after)
{
	const struct phantom alone = {1, part};
	const struct recipe fdk = object_recipe(&objects[0], false, 0);
	const float *volume = outcome_volume(clean, "final");
	struct outcome whole = {0};
	struct scene just;
	double all;

	/* One ray a pixel meets thin things too often or not often enough: all of it is what exact data show. */
	object_make(&just, &alone, true);
	scene_run(&just, &fdk, &whole);
	all = mass_of(part, outcome_volume(&whole, "final"), volume, &clean->grid);
	ck_assert_double_eq_tol(mass_of(part, outcome_volume(after, "fdk"), volume, &clean->grid) / all, 1, .07);
	ck_assert_double_eq_tol(mass_of(part, outcome_volume(after, "final"), volume, &clean->grid) / all, 1, .07);
	outcome_clear(&whole);
	scene_clear(&just);
}

/* _i: of the objects. */
START_TEST(beside_metal_it_is_not_worse_than_without)
{
	const struct object *object = &objects[_i];
	struct recipe without = object_recipe(object, false, 2), with = object_recipe(object, true, 2);
	const struct recipe fdk = object_recipe(object, false, 0);
	struct outcome clean = {0}, before = {0}, after = {0};
	struct scene bare, scene;

	with.metal.threshold_hu = object->threshold;
	object_make(&bare, NULL, true);
	object_make(&scene, &object->parts, false);
	scene_run(&bare, &fdk, &clean);
	scene_run(&scene, &without, &before);
	scene_run(&scene, &with, &after);
	ck_assert_ptr_nonnull(strstr(after.warnings, "metal: "));
	ck_assert((strstr(after.warnings, "values within 10 mm of metal are estimates") == NULL) == object->outside);
	ck_assert((strstr(after.warnings, "nothing in the grid is metal") != NULL) == object->outside);
	for (int i = 0; i < 2; i++) {
		const char *name = i == 0 ? "fdk" : "final";
		const float *want = outcome_volume(&clean, "final");
		const struct beside was =
		    beside_metal(outcome_volume(&before, name), want, &clean.grid, &object->parts);
		const struct beside is = beside_metal(outcome_volume(&after, name), want, &clean.grid, &object->parts);

		ck_assert_msg(is.error < object->most * was.error, "%s, %s: %g HU, %g without", object->name, name,
			      is.error, was.error);
		ck_assert_msg(fabs(is.bone) < object->bone, "%s, %s: bone is off by %g HU, %g without", object->name,
			      name, is.bone, was.bone);
	}
	/* It is partly above the threshold. */
	if (object->parts.parts == vessel_parts)
		expect_whole(vessel_parts, &clean, &after);
	outcome_clear(&after);
	outcome_clear(&before);
	outcome_clear(&clean);
	scene_clear(&scene);
	scene_clear(&bare);
}
END_TEST

/* ---- few views, few photons ---- */

static struct ellipsoid thigh_body[] = {{SHAPE_CYLINDER, {36, 28, 40}, {0, 0, 0}, 0, 1}};
static struct ellipsoid thigh_bone[] = {{SHAPE_CYLINDER, {6, 6, 40}, {0, 0, 0}, 0, 1}};
static struct ellipsoid thigh_rods[] = {{SHAPE_CYLINDER, {2.8, 2.8, 30}, {-11, 0, 0}, 0, 22},
					{SHAPE_CYLINDER, {2.8, 2.8, 30}, {11, 0, 0}, 0, 22}};

/* Rods of steel at a bone: exact line integrals, or of counts with Poisson's noise. */
static void thigh_make(struct scene *ret, int views, bool with_rods, double air)
{
	const struct orbit_spec spec = {100, 24, views, {620, 1100, {1.45, 1.45}, {0, 0}, {0, 0}}, 3.7, 360. / views};
	const struct phantom parts[3] = {{1, thigh_body}, {1, thigh_bone}, {2, thigh_rods}};

	scene_orbit(ret, &spec);
	random_state = 13;
	for (int i = 0; i < (with_rods ? 3 : 2); i++)
		scene_add(ret, &parts[i]);
	for (size_t i = 0; i < (size_t)100 * 24 * (size_t)views; i++) {
		const double p = MU_WATER * (double)ret->projections[i], counts = air * exp(-p);

		ret->projections[i] =
		    (float)(air > 0 ? -log(fmax(floor(counts + sqrt(counts) * normal() + .5), .5) / air) : p);
	}
}

/* In HU against a volume of the same without rods: the mean in the bone, and far from metal the root of the mean
 * square. */
static struct beside thigh_errors(const float *volume, const float *clean, const struct grid *grid)
{
	double squares = 0, bones = 0;
	size_t far = 0, bone_count = 0;

	for (size_t i = 0; i < grid_voxels(grid); i++) {
		const size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1];
		const double x = grid->origin[0] + (double)(i % nx) * grid->spacing[0];
		const double y = grid->origin[1] + (double)(i / nx % ny) * grid->spacing[1];
		const double error = ((double)volume[i] - (double)clean[i]) / MU_WATER * 1000;

		if (hypot(x, y) < 4.5) {
			bones += error;
			bone_count++;
		} else if (hypot(x / 34, y / 26) < 1 && hypot(fabs(x) - 11, y) > 13) {
			squares += error * error;
			far++;
		}
	}
	return (struct beside){.error = sqrt(squares / (double)far), .bone = bones / (double)bone_count};
}

/*
 * _i: few views, whose streaks go with the metal and are not taken for what the shadows know; few photons, of which the
 * shadows know the bone between the rods all the same.
 */
START_TEST(few_views_and_few_photons_are_told_apart)
{
	static const struct {
		int views;
		double air, far; /* of what the error is without the stage, at most */
	} few[] = {{48, 1e5, .5}, {90, 5000, .6}};
	const struct grid grid = grid_of(52, 44, 8, 1.45, 1.45, 1.45);
	struct recipe recipe = recipe_on(&grid);
	struct outcome clean = {0}, without = {0}, with = {0};
	struct scene bare, scene;
	struct beside was, is;

	recipe.fdk.on = true;
	thigh_make(&bare, few[_i].views, false, 0);
	thigh_make(&scene, few[_i].views, true, few[_i].air);
	scene_run(&bare, &recipe, &clean);
	scene_run(&scene, &recipe, &without);
	recipe.metal.on = true;
	scene_run(&scene, &recipe, &with);
	was = thigh_errors(outcome_volume(&without, "final"), outcome_volume(&clean, "final"), &grid);
	is = thigh_errors(outcome_volume(&with, "final"), outcome_volume(&clean, "final"), &grid);
	ck_assert_msg(is.error < few[_i].far * was.error, "far from metal: %g HU, %g without", is.error, was.error);
	ck_assert_msg(fabs(is.bone) < 60, "bone is off by %g HU, %g without", is.bone, was.bone);
	outcome_clear(&with);
	outcome_clear(&without);
	outcome_clear(&clean);
	scene_clear(&scene);
	scene_clear(&bare);
}
END_TEST

/* The first number before `word` in the warnings. */
static double told(const char *warnings, const char *word)
{
	const char *end = strstr(warnings, word);

	ck_assert_ptr_nonnull(end);
	while (end > warnings && end[-1] != ' ' && end[-1] != '\n')
		end--;
	return atof(end);
}

/* A ball whose shadow has no counts in its middle: linearise bridges that from its rim, metal has all of it. */
START_TEST(samples_without_counts_are_metals)
{
	static struct ellipsoid ball_parts[] = {{SHAPE_ELLIPSOID, {13, 13, 9}, {-22, 4, 0}, 0, 18}};
	const struct phantom ball = {1, ball_parts};
	const double air = 4000, voxels = 4. / 3 * M_PI * 13 * 13 * 9 / (1.6 * 1.6 * 1.6);
	struct recipe without = object_recipe(&objects[0], false, 0), with = object_recipe(&objects[0], true, 0);
	struct outcome clean = {0}, before, after;
	struct scene bare, scene;
	const size_t samples = (size_t)COLUMNS * 32 * VIEWS;
	float *counts = malloc(samples * sizeof(float));
	size_t dark = 0;
	double was, is;

	object_make(&bare, NULL, true);
	object_make(&scene, &ball, true);
	for (size_t i = 0; i < samples; i++) {
		const double mean = air * exp(-(double)scene.projections[i]);

		counts[i] = (float)fmax(floor(mean + sqrt(mean) * normal() + .5), 0);
		dark += counts[i] == 0;
	}
	ck_assert_uint_gt(dark, samples / 100);
	before = (struct outcome){.samples = counts,
				  .linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = air}};
	after = before;
	scene_run(&bare, &without, &clean);
	scene_run(&scene, &without, &before);
	scene_run(&scene, &with, &after);
	was = beside_metal(outcome_volume(&before, "final"), outcome_volume(&clean, "final"), &clean.grid, &ball).error;
	is = beside_metal(outcome_volume(&after, "final"), outcome_volume(&clean, "final"), &clean.grid, &ball).error;
	ck_assert_msg(is < .4 * was, "%g HU beside the ball, %g without", is, was);
	ck_assert_double_eq_tol(told(after.warnings, " voxels ("), voxels, .1 * voxels);
	outcome_clear(&after);
	outcome_clear(&before);
	outcome_clear(&clean);
	scene_clear(&scene);
	scene_clear(&bare);
	free(counts);
}
END_TEST

/* A wire of 1.6 mm beside screws, partly above the threshold; after FDK, and after SART. */
START_TEST(a_wire_beside_screws_stays_whole)
{
	const struct object wire = {"a wire", {5, wire_parts}, 1400, 0, 0, 0, 0, false};
	const struct recipe fdk = object_recipe(&wire, false, 0);
	struct recipe with = object_recipe(&wire, true, 2);
	struct outcome clean = {0}, after = {0};
	struct scene bare, scene;

	with.metal.threshold_hu = wire.threshold;
	object_make(&bare, NULL, true);
	object_make(&scene, &wire.parts, false);
	scene_run(&bare, &fdk, &clean);
	scene_run(&scene, &with, &after);
	ck_assert_ptr_nonnull(strstr(after.warnings, "metal: "));
	expect_whole(&wire_parts[4], &clean, &after);
	outcome_clear(&after);
	outcome_clear(&clean);
	scene_clear(&scene);
	scene_clear(&bare);
}
END_TEST

/* ---- one view ---- */

enum { WIDE = 16, HIGH = 9 };

/* Pixels first .. last of the rows low .. high. */
static void mark(bool *trace, int first, int last, int low, int high)
{
	for (int r = low; r <= high; r++)
		for (int c = first; c <= last; c++)
			trace[r * WIDE + c] = true;
}

START_TEST(a_view_is_filled_with_lines)
{
	bool trace[HIGH * WIDE] = {false};
	float view[HIGH * WIDE], prior[HIGH * WIDE];
	const struct metal_view plain = {.columns = WIDE, .rows = HIGH, .values = view, .trace = trace};
	struct metal_view with_prior = plain;

	/* on a plane already, whatever the trace held */
	mark(trace, 4, 6, 0, HIGH - 1);
	mark(trace, 8, 12, 3, 4);
	mark(trace, 9, 9, 7, 8);
	for (int i = 0; i < HIGH * WIDE; i++)
		view[i] = trace[i] && i / WIDE < 7 ? 99 : 10 + (float)(i % WIDE) + 2 * (float)(i / WIDE);
	for (int c = 9; c <= 9; c++) /* two rows at the edge: the column alone would hold them */
		view[7 * WIDE + c] = view[8 * WIDE + c] = 99;
	metal_fill_view(&plain);
	for (int i = 0; i < 7 * WIDE; i++)
		ck_assert_float_eq_tol(view[i], 10 + (float)(i % WIDE) + 2 * (float)(i / WIDE), 1e-4f);
	ck_assert_float_eq_tol(view[7 * WIDE + 9], 33, 1);
	/* what the prior knows but for a plane comes back exactly */
	with_prior.prior = prior;
	for (int i = 0; i < HIGH * WIDE; i++) {
		prior[i] = (float)(i * i % 7);
		view[i] = trace[i] ? 99 : prior[i] + 3;
	}
	metal_fill_view(&with_prior);
	for (int i = 0; i < HIGH * WIDE; i++)
		ck_assert_float_eq_tol(view[i], prior[i] + 3, 1e-4f);
	/* a row that is all trace goes by its columns, and a view that is stays as it is */
	memset(trace, 0, sizeof(trace));
	mark(trace, 0, WIDE - 1, 5, 5);
	for (int i = 0; i < HIGH * WIDE; i++)
		view[i] = trace[i] ? 99 : (float)(i / WIDE);
	metal_fill_view(&plain);
	for (int c = 0; c < WIDE; c++)
		ck_assert_float_eq_tol(view[5 * WIDE + c], 5, 1e-5f);
	mark(trace, 0, WIDE - 1, 0, HIGH - 1);
	view[40] = 77;
	metal_fill_view(&plain);
	ck_assert_float_eq(view[40], 77);
}
END_TEST

Suite *metal_suite(void)
{
	Suite *suite = suite_create("metal");
	TCase *stage = tcase_create("stage"), *few = tcase_create("few"), *rows = tcase_create("views");
	TCase *longer = tcase_create("long");

	tcase_set_timeout(stage, 120);
	tcase_set_timeout(few, 120);
	tcase_set_timeout(longer, 120);
	tcase_set_tags(longer, "long");
	tcase_add_test(stage, streaks_fall_and_the_metal_stays);
	tcase_add_loop_test(stage, without_metal_nothing_changes, 0, 2);
	tcase_add_loop_test(stage, beside_metal_it_is_not_worse_than_without, 0, OBJECTS - LONG_OBJECTS);
	tcase_add_loop_test(longer, beside_metal_it_is_not_worse_than_without, OBJECTS - LONG_OBJECTS, OBJECTS);
	tcase_add_loop_test(few, few_views_and_few_photons_are_told_apart, 0, 2);
	tcase_add_test(stage, samples_without_counts_are_metals);
	tcase_add_test(stage, a_wire_beside_screws_stays_whole);
	tcase_add_loop_test(stage, a_run_with_metal_goes_on_with_the_same_bits, 0, 3);
	tcase_add_test(stage, a_list_of_another_grid_is_refused);
	tcase_add_test(stage, cancel_ends_the_stage_wherever_it_is);
	tcase_add_loop_test(stage, memory_is_known_beforehand, 0, 3);
	tcase_add_test(rows, a_view_is_filled_with_lines);
	suite_add_tcase(suite, stage);
	suite_add_tcase(suite, few);
	suite_add_tcase(suite, rows);
	suite_add_tcase(suite, longer);
	return suite;
}

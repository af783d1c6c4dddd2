/* A scan and its reconstruction for the tests of the pipeline: see scene.h. */
#include "tests/unit/scene.h"

#include "core/cards/cards.h"

#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tests/unit/data.h"

bool scene_sweep(struct geometry *ret_geometry, const struct sweep_spec *spec)
{
	enum { VIEWS = 248 };
	const int bin = spec->bin, count = VIEWS / spec->every;
	const double pitch[2] = {0.616 * bin, 0.616 * bin}, middle = 0.5 * (bin - 1);
	double *matrices = data_npy("carm_kct_248.npy", VIEWS * 12);
	struct error err;

	if (matrices == NULL)
		return false;
	for (int k = 0; k < count; k++) {
		double *matrix = matrices + 12 * (size_t)k;

		memmove(matrix, matrices + 12 * (size_t)(k * spec->every), 12 * sizeof(*matrix));
		for (int j = 0; j < 4; j++) {
			matrix[j] = (matrix[j] - middle * matrix[8 + j]) / bin - spec->first * matrix[8 + j];
			matrix[4 + j] = (matrix[4 + j] - middle * matrix[8 + j]) / bin;
		}
	}
	ck_assert_int_eq(geometry_matrices(ret_geometry, spec->columns, 480 / bin, count, matrices, pitch, &err), 0);
	free(matrices);
	return true;
}

static size_t scene_samples(const struct scene *scene)
{
	return (size_t)scene->geometry.columns * (size_t)scene->geometry.rows;
}

void scene_orbit(struct scene *ret_scene, const struct orbit_spec *spec)
{
	double *angles = malloc(sizeof(double) * (size_t)spec->views);
	struct error err;

	ck_assert_ptr_nonnull(angles);
	for (int i = 0; i < spec->views; i++)
		angles[i] = (spec->first_deg + i * spec->step_deg) * M_PI / 180;
	if (geometry_circular(&ret_scene->geometry, spec->columns, spec->rows, spec->views, &spec->circular, angles,
			      &err) < 0)
		ck_abort_msg("%s", err.text);
	free(angles);
	ret_scene->projections = calloc(scene_samples(ret_scene) * (size_t)spec->views, sizeof(float));
	ck_assert_ptr_nonnull(ret_scene->projections);
}

void scene_add(struct scene *scene, const struct phantom *phantom)
{
	size_t samples = scene_samples(scene);
	float *one = malloc(sizeof(float) * samples);

	ck_assert_ptr_nonnull(one);
	for (int view = 0; view < scene->geometry.count; view++) {
		float *projection = scene->projections + samples * (size_t)view;

		phantom_project(phantom, &scene->geometry, view, one);
		for (size_t i = 0; i < samples; i++)
			projection[i] += one[i];
	}
	free(one);
}

void scene_clear(struct scene *scene)
{
	geometry_clear(&scene->geometry);
	free(scene->projections);
	*scene = (struct scene){0};
}

/* ---- hooks ---- */

static void note(struct outcome *outcome, const char *what, const char *end)
{
	size_t used = strlen(outcome->log), length = strlen(what) + strlen(end) + 2;

	ck_assert_uint_lt(used + length, sizeof(outcome->log));
	snprintf(outcome->log + used, sizeof(outcome->log) - used, "%s%s%s", used > 0 ? " " : "", what, end);
}

static bool on_cancelled(void *context)
{
	struct outcome *outcome = context;

	return ++outcome->asked == outcome->cancel_at;
}

static bool on_yield(void *context)
{
	struct outcome *outcome = context;

	return outcome->yield_at > 0 && outcome->rows[outcome->row_count - 1].iteration == outcome->yield_at;
}

static int on_state(void *context, const void *bytes, size_t size, struct error *err)
{
	struct outcome *outcome = context;

	(void)err;
	memcpy(outcome->state + outcome->state_bytes, bytes, size);
	outcome->state_bytes += size;
	return 0;
}

static void on_progress(void *context, enum stage stage, int iteration, double fraction)
{
	struct outcome *outcome = context;

	ck_assert_int_ge(iteration, 0);
	ck_assert_double_ge(fraction, outcome->fraction);
	ck_assert_double_le(fraction, 1);
	outcome->fraction = fraction;
	if (stage != STAGE_SAVE)
		note(outcome, stage_names[stage], "");
}

static void on_row(void *context, const struct history_row *row)
{
	struct outcome *outcome = context;
	char text[16];

	ck_assert_int_lt(outcome->row_count, SCENE_ROWS_MOST);
	outcome->rows[outcome->row_count++] = *row;
	snprintf(text, sizeof(text), "%d", row->iteration);
	note(outcome, "row", text);
}

static int on_keep(void *context, struct recon *recon, const struct kept_volume *volume, struct error *err)
{
	struct outcome *outcome = context;
	int i = outcome->kept_count;

	ck_assert_int_lt(i, SCENE_KEPT_MOST);
	outcome->kept_count++;
	snprintf(outcome->kept[i].name, sizeof(outcome->kept[i].name), "%s", volume->name);
	snprintf(outcome->kept[i].stage, sizeof(outcome->kept[i].stage), "%s", volume->stage);
	outcome->kept[i].iteration = volume->iteration;
	outcome->kept[i].asked = outcome->asked;
	outcome->kept[i].norms = volume->norms;
	outcome->kept[i].estimate_mm = volume->estimate_mm;
	outcome->kept[i].support = volume->support;
	outcome->kept[i].voxels = malloc(sizeof(float) * grid_voxels(volume->grid));
	ck_assert_ptr_nonnull(outcome->kept[i].voxels);
	note(outcome, volume->name, "!");
	return recon_read(recon, 0, volume->grid->size[2], outcome->kept[i].voxels, err);
}

static void on_stopped(void *context, const struct recon_stop *stop)
{
	struct outcome *outcome = context;

	outcome->stops++;
	outcome->stop = *stop;
}

static void on_agreement(void *context, const struct recon_agreement *agreement)
{
	((struct outcome *)context)->agreement = *agreement;
}

static void on_denoising(void *context, double noise_hu, double alpha)
{
	struct outcome *outcome = context;

	outcome->told_noise++;
	outcome->noise_hu = noise_hu;
	outcome->alpha = alpha;
}

static void on_warning(void *context, const char *code, const char *detail)
{
	struct outcome *outcome = context;
	size_t used = strlen(outcome->warnings);

	snprintf(outcome->warnings + used, sizeof(outcome->warnings) - used, "%s: %s\n", code, detail);
}

/* ---- the run ---- */

static int push_all(const struct scene *scene, struct outcome *outcome, struct recon *recon)
{
	int all = scene->geometry.count, at_once = outcome->at_once > 0 ? outcome->at_once : all, code = 0;
	size_t sample = outcome->linearise.sample == SAMPLE_UINT16 ? 2 : 4;
	size_t bytes = sample * scene_samples(scene);
	const char *samples = outcome->samples != NULL ? outcome->samples : scene->projections;
	char *block = malloc(bytes * (size_t)at_once);
	int *views = malloc(sizeof(int) * (size_t)at_once);

	ck_assert(block != NULL && views != NULL);
	for (int begin = 0; begin < all && code == 0; begin += at_once) {
		int count = all - begin < at_once ? all - begin : at_once;

		for (int i = 0; i < count; i++) {
			views[i] = outcome->order != NULL ? outcome->order[begin + i] : begin + i;
			memcpy(block + bytes * (size_t)i, samples + bytes * (size_t)views[i], bytes);
		}
		code = recon_push(recon, block, views, count, &outcome->err);
	}
	free(block);
	free(views);
	return code;
}

void scene_run(const struct scene *scene, const struct recipe *recipe, struct outcome *outcome)
{
	const struct device_options options = {.threads = outcome->threads, .memory_limit = outcome->memory_limit};
	const struct recon_hooks hooks = {
	    .context = outcome,
	    .cancelled = on_cancelled,
	    .yield = on_yield,
	    .progress = on_progress,
	    .row = on_row,
	    .keep = on_keep,
	    .denoising = on_denoising,
	    .agreement = on_agreement,
	    .stopped = on_stopped,
	    .warning = on_warning,
	};
	const struct backend *backend = outcome->cards > 0 ? &backend_cards : &backend_cpu;
	struct device *device;
	struct recon *recon = NULL;
	struct error state_err;
	const void *metal;

	if ((outcome->cards > 0 ? cards_open(&backend_cpu, NULL, outcome->cards, &options, &device, &outcome->err)
				: backend->open(0, &options, &device, &outcome->err)) < 0)
		ck_abort_msg("%s", outcome->err.text);
	outcome->code =
	    recon_open(backend, device, &scene->geometry, &outcome->linearise, recipe, &hooks, &recon, &outcome->err);
	if (outcome->code < 0)
		goto out;
	outcome->grid = *recon_grid(recon);
	if (outcome->resume != NULL)
		outcome->code = recon_resume(recon, outcome->resume, outcome->resume_iteration, &outcome->err);
	if (outcome->code == 0 && outcome->resume_state_bytes > 0)
		outcome->code =
		    recon_resume_state(recon, outcome->resume_state, outcome->resume_state_bytes, &outcome->err);
	if (outcome->code == 0 && outcome->resume_metal_bytes > 0)
		outcome->code =
		    recon_resume_found(recon, outcome->resume_metal, outcome->resume_metal_bytes, &outcome->err);
	if (outcome->code == 0 && outcome->resume_noise != NULL)
		outcome->code = recon_resume_noise(recon, outcome->resume_noise, &outcome->err);
	if (outcome->code == 0)
		outcome->code = push_all(scene, outcome, recon);
	if (outcome->code == 0)
		outcome->code = recon_run(recon, &outcome->err);
	outcome->iteration = recon_iteration(recon);
	outcome->state = malloc(recon_state_bytes(recon) + 1);
	ck_assert_ptr_nonnull(outcome->state);
	if (outcome->code == 0 || outcome->code == ERR_BUSY)
		ck_assert_int_eq(recon_save_state(recon, &(struct checkpoint_sink){outcome, on_state}, &state_err), 0);
	outcome->noise = recon_noise(recon) != NULL ? *recon_noise(recon) : (struct volume_noise){-1, -1};
	metal = recon_found(recon, &outcome->metal_bytes);
	outcome->metal = malloc(outcome->metal_bytes + 1);
	ck_assert_ptr_nonnull(outcome->metal);
	if (outcome->metal_bytes > 0)
		memcpy(outcome->metal, metal, outcome->metal_bytes);
	outcome->last = malloc(sizeof(float) * grid_voxels(&outcome->grid));
	ck_assert_ptr_nonnull(outcome->last);
	ck_assert_int_eq(recon_read(recon, 0, outcome->grid.size[2], outcome->last, &outcome->err), 0);
out:
	recon_free(recon);
	backend->close(device);
}

void run(const struct scene *scene, const struct recipe *recipe, struct outcome *outcome)
{
	scene_run(scene, recipe, outcome);
	if (outcome->code < 0)
		ck_abort_msg("%s %s", outcome->err.pointer, outcome->err.text);
}

void outcome_resume(struct outcome *outcome, const struct outcome *yielded)
{
	ck_assert_int_eq(yielded->code, ERR_BUSY);
	outcome->resume = yielded->last;
	outcome->resume_iteration = yielded->iteration;
	outcome->resume_state = yielded->state;
	outcome->resume_state_bytes = yielded->state_bytes;
	outcome->resume_metal = yielded->metal;
	outcome->resume_metal_bytes = yielded->metal_bytes;
	outcome->resume_noise = yielded->noise.sigma >= 0 ? &yielded->noise : NULL;
}

void expect_same_after_a_yield(const struct scene *scene, const struct recipe *recipe, int yield_at,
			       const struct outcome *whole)
{
	const size_t bytes = sizeof(float) * grid_voxels(&recipe->grid);
	struct outcome first = {.threads = 2, .yield_at = yield_at}, second = {.threads = 2};
	struct recon_memory memory;
	struct device *device;
	struct error err;

	scene_run(scene, recipe, &first);
	outcome_resume(&second, &first);
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){.threads = 2}, &device, &err), 0);
	ck_assert_int_eq(recon_memory(&backend_cpu, device, &scene->geometry, &whole->linearise, recipe, &memory, &err),
			 0);
	backend_cpu.close(device);
	second.memory_limit = memory.total;
	run(scene, recipe, &second);
	ck_assert_mem_eq(second.last, whole->last, bytes);
	ck_assert_mem_eq(outcome_volume(&second, "final"), outcome_volume(whole, "final"), bytes);
	outcome_clear(&first);
	outcome_clear(&second);
}

const float *outcome_volume(const struct outcome *outcome, const char *name)
{
	if (outcome->code < 0)
		ck_abort_msg("the run failed: %s", outcome->err.text);
	for (int i = 0; i < outcome->kept_count; i++)
		if (strcmp(outcome->kept[i].name, name) == 0)
			return outcome->kept[i].voxels;
	ck_abort_msg("no volume %s was kept", name);
}

void outcome_clear(struct outcome *outcome)
{
	for (int i = 0; i < outcome->kept_count; i++)
		free(outcome->kept[i].voxels);
	free(outcome->last);
	free(outcome->state);
	free(outcome->metal);
	*outcome = (struct outcome){0};
}

struct grid grid_of(int nx, int ny, int nz, double dx, double dy, double dz)
{
	struct grid grid = {.size = {nx, ny, nz}, .spacing = {dx, dy, dz}};

	grid_centre(&grid);
	return grid;
}

struct recipe recipe_on(const struct grid *grid)
{
	struct recipe recipe;

	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = *grid;
	return recipe;
}

/* ---- measures ---- */

double relative_error(const float *volume, const float *truth, size_t count)
{
	double difference2 = 0, norm2 = 0;

	for (size_t i = 0; i < count; i++) {
		difference2 += ((double)volume[i] - truth[i]) * ((double)volume[i] - truth[i]);
		norm2 += (double)truth[i] * truth[i];
	}
	return sqrt(difference2 / norm2);
}

double mean_error(const float *volume, const float *truth, size_t count)
{
	double sum = 0;

	for (size_t i = 0; i < count; i++)
		sum += fabs((double)volume[i] - truth[i]);
	return sum / (double)count;
}

double psnr_of(const float *volume, const float *truth, size_t count, double range)
{
	double sum = 0;

	for (size_t i = 0; i < count; i++)
		sum += ((double)volume[i] - truth[i]) * ((double)volume[i] - truth[i]);
	return 20 * log10(range) - 10 * log10(sum / (double)count);
}

double mean_near(const float *volume, const struct grid *grid, const double point[3], double radius)
{
	double sum = 0;
	size_t count = 0, at = 0;

	for (int k = 0; k < grid->size[2]; k++)
		for (int j = 0; j < grid->size[1]; j++)
			for (int i = 0; i < grid->size[0]; i++, at++) {
				double x = grid->origin[0] + i * grid->spacing[0] - point[0];
				double y = grid->origin[1] + j * grid->spacing[1] - point[1];
				double z = grid->origin[2] + k * grid->spacing[2] - point[2];

				if (x * x + y * y + z * z > radius * radius)
					continue;
				sum += volume[at];
				count++;
			}
	ck_assert_uint_gt(count, 0);
	return sum / (double)count;
}

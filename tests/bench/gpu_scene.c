#include "tests/bench/gpu_scene.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

const char *const bend_names[BEND_COUNT] = {"circular", "rows down", "turned", "tilted", "steep"};

void must(int code, const struct error *err, const char *what)
{
	if (code >= 0)
		return;
	fprintf(stderr, "%s: %s (%d)\n", what, err->text, code);
	exit(1);
}

double seconds(void)
{
	struct timespec now;

	clock_gettime(CLOCK_MONOTONIC, &now);
	return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Turns a vector by an angle about one of the coordinate axes. */
static void turn(double vector[3], int axis, double angle)
{
	int a = (axis + 1) % 3, b = (axis + 2) % 3;
	double x = vector[a], y = vector[b];

	vector[a] = x * cos(angle) - y * sin(angle);
	vector[b] = x * sin(angle) + y * cos(angle);
}

/* Turns the detector about its own centre, or the whole view about the isocentre. */
static void bend_view(struct view *view, enum bend bend, int index, int columns, int rows)
{
	double wobble = 0.02 * sin(1.7 * index), centre[3];

	for (int i = 0; i < 3; i++)
		centre[i] =
		    view->pixel0[i] + .5 * (columns - 1) * view->column_step[i] + .5 * (rows - 1) * view->row_step[i];
	switch (bend) {
	case BEND_ROWS_DOWN:
		for (int i = 0; i < 3; i++) {
			view->pixel0[i] += (rows - 1) * view->row_step[i];
			view->row_step[i] = -view->row_step[i];
		}
		return;
	case BEND_TURNED: /* in its plane, by a degree */
	case BEND_TILTED: /* out of it, another way in each view */
		for (int i = 0; i < 2; i++) {
			double *step = i == 0 ? view->column_step : view->row_step, u[3], v[3];

			memcpy(u, view->column_step, sizeof(u));
			memcpy(v, view->row_step, sizeof(v));
			if (bend == BEND_TILTED) {
				turn(step, 0, wobble);
				turn(step, 1, 1.3 * wobble);
				turn(step, 2, 0.7 * wobble);
			} else if (i == 1) {
				double s = sin(0.0175), c = cos(0.0175), pu = vec_norm(u), pv = vec_norm(v);

				for (int k = 0; k < 3; k++) {
					view->column_step[k] = c * u[k] + s * v[k] * pu / pv;
					view->row_step[k] = c * v[k] - s * u[k] * pv / pu;
				}
			}
		}
		break;
	case BEND_STEEP: /* the whole arm laid over: rays along z */
		turn(view->source, 0, 1.0 + wobble);
		turn(view->column_step, 0, 1.0 + wobble);
		turn(view->row_step, 0, 1.0 + wobble);
		turn(centre, 0, 1.0 + wobble);
		break;
	case BEND_NONE:
	case BEND_COUNT:
		return;
	}
	for (int i = 0; i < 3; i++)
		view->pixel0[i] =
		    centre[i] - .5 * (columns - 1) * view->column_step[i] - .5 * (rows - 1) * view->row_step[i];
}

void scene_make(struct scene *ret_scene, const char *name, const struct scene_options *options)
{
	const struct circular circular = {
	    .source_to_isocentre = 620,
	    .source_to_detector = 1100,
	    .pixel = {options->pixel[0], options->pixel[1]},
	    .detector_offset = {options->offset[0], options->offset[1]},
	};
	double *angles = malloc(sizeof(*angles) * (size_t)options->views);
	struct scene scene = {0};
	struct error err = {0};

	snprintf(scene.name, sizeof(scene.name), "%s", name);
	for (int i = 0; i < options->views; i++)
		angles[i] = options->arc * i / options->views + 0.002;
	must(geometry_circular(&scene.geometry, options->columns, options->rows, options->views, &circular, angles,
			       &err),
	     &err, name);
	free(angles);
	for (int i = 0; i < options->views; i++)
		bend_view(&scene.geometry.views[i], options->bend, i, options->columns, options->rows);
	for (int i = 0; i < 3; i++) {
		scene.grid.size[i] = options->size[i];
		scene.grid.spacing[i] = options->spacing[i];
	}
	grid_centre(&scene.grid);
	must(grid_check(&scene.grid, &err), &err, name);
	must(grid_check_geometry(&scene.grid, &scene.geometry, &err), &err, name);
	must(orbit_analyse(&scene.orbit, &scene.geometry, &err), &err, name);
	must(fdk_weights_make(&scene.weights, &scene.orbit, &scene.geometry, options->window, 1, options->extend, &err),
	     &err, name);
	*ret_scene = scene;
}

void scene_clear(struct scene *scene)
{
	fdk_weights_clear(&scene->weights);
	orbit_clear(&scene->orbit);
	geometry_clear(&scene->geometry);
}

struct plan_options scene_plan(const struct scene *scene, struct sart_options *sart, int subsets,
			       const struct tv_options *tv, bool reference)
{
	struct error err = {0};

	if (subsets > 0)
		must(subsets_make(&sart->subsets, &scene->orbit, subsets, &err), &err, "subsets");
	return (struct plan_options){
	    .geometry = &scene->geometry,
	    .grid = &scene->grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = scene->weights.columns,
	    .filter_response = scene->weights.response,
	    .pad = {scene->weights.pad[0], scene->weights.pad[1]},
	    .extend = scene->weights.extend,
	    .extended_response = scene->weights.extended,
	    .sart = subsets > 0 ? sart : NULL,
	    .tv = tv,
	    .reference_precision = reference,
	};
}

static unsigned int hash(unsigned int x)
{
	x ^= x >> 16;
	x *= 0x7feb352du;
	x ^= x >> 15;
	x *= 0x846ca68bu;
	return x ^ x >> 16;
}

void fill_random(float *values, size_t count, unsigned int seed)
{
#pragma omp parallel for
	for (size_t i = 0; i < count; i++) {
		float noise = (float)(hash((unsigned int)i + 0x9e3779b9u * seed) >> 8) * (1.f / 16777216.f);

		values[i] = .25f + .25f * sinf(.013f * (float)(i % 100003)) + .5f * noise;
	}
}

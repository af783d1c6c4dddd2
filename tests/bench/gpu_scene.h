#ifndef CBCT_TESTS_BENCH_GPU_SCENE_H
#define CBCT_TESTS_BENCH_GPU_SCENE_H

/* What the GPU's checks and benchmarks share: geometries, grids and data of every kind. */
#include <stdbool.h>

#include "core/backend.h"
#include "core/fdk.h"
#include "core/recon/recon.h"

struct scene {
	char name[64];
	struct geometry geometry;
	struct grid grid;
	struct orbit orbit;
	struct fdk_weights weights;
};

/* How a circular orbit is bent into another kind of geometry. */
enum bend { BEND_NONE, BEND_ROWS_DOWN, BEND_TURNED, BEND_TILTED, BEND_STEEP, BEND_COUNT };
extern const char *const bend_names[BEND_COUNT];

struct scene_options {
	int columns, rows, views;
	double arc;      /* radians */
	double pixel[2]; /* mm */
	double offset[2];
	int size[3];
	double spacing[3];
	enum bend bend;
	enum window window;
	bool extend; /* truncated rows, where the backend can */
};

/* Source to isocentre 620 mm, source to detector 1100 mm. Exits on failure: these are test programs. */
void scene_make(struct scene *ret_scene, const char *name, const struct scene_options *options);
void scene_clear(struct scene *scene);

/* Everything that a plan can do; subsets 0: no SART; tv NULL: none. */
struct plan_options scene_plan(const struct scene *scene, struct sart_options *sart, int subsets,
			       const struct tv_options *tv, bool reference);

/* Values in 0 .. 1, the same for the same seed: half of it smooth, half of it noise. */
void fill_random(float *values, size_t count, unsigned int seed);

/* Ends the program with the error's text when the code is negative. */
void must(int code, const struct error *err, const char *what);
double seconds(void);

#endif

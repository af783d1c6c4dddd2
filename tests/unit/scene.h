#ifndef CBCT_TESTS_SCENE_H
#define CBCT_TESTS_SCENE_H

#include "core/scan/phantom.h"
#include "core/recon/recon.h"

/* A scan made from exact line integrals, and all that a reconstruction of it said: for the tests of the pipeline. */
struct orbit_spec {
	int columns, rows, views;
	struct circular circular;
	double first_deg, step_deg;
};

struct scene {
	struct geometry geometry;
	float *projections; /* [view][row][column], line integrals */
};

/* The real C-arm's sweep of 248 views, one in so many; columns first .. first + columns - 1 of its pixels, which are
 * `bin` times as wide and high as they were. */
struct sweep_spec {
	int bin, first, columns, every;
};
/* False, said aloud, where the test data are not there. */
bool scene_sweep(struct geometry *ret_geometry, const struct sweep_spec *spec);

/* These end the test where they fail. */
void scene_orbit(struct scene *ret_scene, const struct orbit_spec *spec);
void scene_add(struct scene *scene, const struct phantom *phantom);
void scene_clear(struct scene *scene);

enum { SCENE_KEPT_MOST = 64, SCENE_ROWS_MOST = 256, SCENE_LOG_MOST = 4096 };
struct outcome {
	/* asked for beforehand */
	struct linearise linearise; /* zero: float32 line integrals */
	const void *samples;        /* raw samples in place of the scene's projections */
	const int *order;           /* [views] in which they come; NULL: as they are */
	int at_once;                /* views in a push; 0: all */
	int cancel_at;              /* the n-th question is answered with yes, from 1; 0: never */
	int yield_at;               /* iteration; 0: never */
	int threads;                /* 0: all */
	int cards;                  /* shares of the processor that are cards of one job; 0: it is one device */
	size_t memory_limit;        /* of the device, bytes; 0: none */
	const float *resume;        /* iterate, or NULL */
	int resume_iteration;
	const char *resume_state; /* of resume_state_bytes */
	size_t resume_state_bytes;
	const void *resume_metal; /* of resume_metal_bytes */
	size_t resume_metal_bytes;
	const struct volume_noise *resume_noise; /* or NULL */

	/* what came of it */
	int code; /* of the first call that failed */
	struct error err;
	struct grid grid;
	struct {
		char name[32], stage[8];
		int iteration;
		int asked; /* so often until then */
		struct volume_norms norms;
		double estimate_mm;
		struct volume_support support;
		float *voxels;
	} kept[SCENE_KEPT_MOST];
	int kept_count;
	struct history_row rows[SCENE_ROWS_MOST];
	int row_count;
	char log[SCENE_LOG_MOST];         /* each hook in its order: "fdk tv fdk-tv! sart tv row1 ..." */
	char warnings[1024];              /* "code: detail\n" */
	struct recon_agreement agreement; /* told last; views 0: none was */
	struct recon_stop stop;           /* told last; rule STOP_NOT: none was */
	int stops;                        /* times that one was told */
	double fraction;                  /* of the last progress; the test ends where it falls */
	int asked;
	float *last; /* the iterate as it was at the end, kept or not */
	char *state; /* what recon_save_state gave then */
	size_t state_bytes;
	void *metal; /* what recon_found gave then */
	size_t metal_bytes;
	struct volume_noise noise; /* what recon_noise gave then; -1 where that was nothing */
	int told_noise;            /* calls of the hook, */
	double noise_hu, alpha;    /* and what the last one said */
	int iteration;
};

/* Opens the CPU, pushes, runs. */
void scene_run(const struct scene *scene, const struct recipe *recipe, struct outcome *outcome);
/* The same; ends the test where the run fails. */
void run(const struct scene *scene, const struct recipe *recipe, struct outcome *outcome);
/* What a run that goes on is given of one that has yielded, which must outlive it. */
void outcome_resume(struct outcome *outcome, const struct outcome *yielded);
/*
 * Ends the test unless a run on two threads that yields after this iteration and goes on, within the memory that was
 * forecast, has the bits of `whole`, a run on one.
 */
void expect_same_after_a_yield(const struct scene *scene, const struct recipe *recipe, int yield_at,
			       const struct outcome *whole);
const float *outcome_volume(const struct outcome *outcome, const char *name); /* ends the test where it is not there */
void outcome_clear(struct outcome *outcome);

struct grid grid_of(int nx, int ny, int nz, double dx, double dy, double dz);
/* fdk and sart off, no TV, this grid. */
struct recipe recipe_on(const struct grid *grid);

/* Over whole volumes. */
double relative_error(const float *volume, const float *truth, size_t count); /* ||v - t|| / ||t|| */
double mean_error(const float *volume, const float *truth, size_t count);     /* mean |v - t| */
double psnr_of(const float *volume, const float *truth, size_t count, double range);
double mean_near(const float *volume, const struct grid *grid, const double point[3], double radius);

#endif

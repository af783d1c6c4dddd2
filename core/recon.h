#ifndef CBCT_CORE_RECON_H
#define CBCT_CORE_RECON_H

#include "core/backend.h"

/*
 * One reconstruction: FDK, then SART, with TV after the FDK volume and after
 * each SART iteration. Opened with a geometry and a recipe, fed with views in
 * any order, then run; everything is allocated at the opening. One thread at a
 * time; the hooks are called in that thread.
 */
enum { EMIT_FDK = 0, EMIT_FDK_TV = -1 }; /* beside iterations 1, 2, ... */

struct recipe {
	bool has_grid; /* otherwise chosen from field of view and resolution */
	struct grid grid;
	bool has_origin; /* grid.origin was given; otherwise centred */
	struct {
		bool on;
		enum window window;
		double cutoff;
	} fdk;
	struct {
		bool on;
		int iterations;
		double relaxation;
		int subsets; /* 1 .. views; SUBSETS_VIEWS: an update after each view; SUBSETS_DEFAULT: 10 or fewer */
		bool nonnegative;
		double stop_residual, stop_change; /* 0: never */
	} sart;
	struct {
		bool on;
		bool after_fdk; /* false with "after": "sart" */
		struct tv_options options;
	} tv;
	double mu_water; /* 1/mm */
	int *emit;       /* [emits], owned; iterations, EMIT_FDK, EMIT_FDK_TV */
	int emits;
	bool reference_precision;
};
enum { SUBSETS_DEFAULT = 0, SUBSETS_VIEWS = -1 };

void recipe_defaults(struct recipe *ret_recipe); /* nothing on; the values that `{}` stages take */
void recipe_clear(struct recipe *recipe);
int recipe_check(const struct recipe *recipe, const struct geometry *geometry, struct error *err);

struct history_row {
	int iteration;
	double residual, change, tv, seconds;
};

enum stage { STAGE_LOAD, STAGE_FDK, STAGE_SART, STAGE_TV, STAGE_SAVE, STAGE_COUNT };
extern const char *const stage_names[STAGE_COUNT]; /* "load", "fdk", "sart", "tv", "save" */

struct kept_volume {
	const char *name; /* "fdk", "fdk-tv", "iter-5", "final" */
	const char *stage; /* "fdk", "tv", "sart" */
	int iteration;    /* 0 for fdk */
	const struct grid *grid;
	struct volume_norms norms;
};

struct recon;

struct recon_hooks {
	void *context;
	bool (*cancelled)(void *context);
	/* Asked after each iteration; true ends the run with ERR_BUSY, recon_iterate_state tells where. */
	bool (*yield)(void *context);
	void (*progress)(void *context, enum stage stage, int iteration, double fraction /* of the whole, 0..1 */);
	void (*row)(void *context, const struct history_row *row);
	/* Called for each volume that is to be kept; reads it with recon_read. Non-zero ends the run. */
	int (*keep)(void *context, struct recon *recon, const struct kept_volume *volume, struct error *err);
	void (*warning)(void *context, const char *code, const char *detail);
};

struct recon_memory {
	size_t projections, volumes, scratch, total; /* bytes on the device */
	size_t available;                            /* bytes free there */
};

/* What a job will take, before it is opened. device NULL (the daemon, that opens none): available is 0. */
int recon_memory(const struct backend *backend, struct device *device, const struct geometry *geometry,
                 const struct recipe *recipe, struct recon_memory *ret_memory, struct error *err);

/* geometry, linearise's images and hooks are borrowed until recon_free; the recipe is copied. */
int recon_open(const struct backend *backend, struct device *device, const struct geometry *geometry,
               const struct linearise *linearise, const struct recipe *recipe, const struct recon_hooks *hooks,
               struct recon **ret_recon, struct error *err);
void recon_free(struct recon *recon);

/* Views as raw samples, in any order, each once: linearised, and filtered and backprojected where FDK is on. */
int recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err);

/* After the last view: finishes FDK, then TV, SART and TV in turn, calling the hooks. */
int recon_run(struct recon *recon, struct error *err);

/*
 * Goes on behind `iteration` with the iterate that was there: instead of the
 * FDK that recon_run would finish. Call before the first recon_push, which then skips FDK.
 */
int recon_resume(struct recon *recon, const float *volume, int iteration, struct error *err);

/* Slices of the current iterate, 1/mm. */
int recon_read(struct recon *recon, int z_first, int z_count, float *ret_slices, struct error *err);

const struct grid *recon_grid(const struct recon *recon);
int recon_iteration(const struct recon *recon); /* iterations done so far */
size_t recon_defects(const struct recon *recon);
const char *recon_plan(const struct recon *recon); /* how the backend does it */

/* ---- sart.c: subsets ---- */
/*
 * Views ordered by largest angular distance to those before, then cut into
 * `count` ordered subsets: subset s takes every count-th view, so that each is
 * spread over the whole arc. Free with subsets_clear.
 */
int subsets_make(struct subsets *ret_subsets, const struct orbit *orbit, int count, struct error *err);
void subsets_clear(struct subsets *subsets);

#endif

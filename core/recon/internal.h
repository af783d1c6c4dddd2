#ifndef CBCT_CORE_RECON_INTERNAL_H
#define CBCT_CORE_RECON_INTERNAL_H

#include "core/correct/correction.h"
#include "core/correct/input.h"
#include "core/fdk.h"
#include "core/recon/algorithm.h"
#include "core/recon/alternation.h"
#include "core/recon/ends.h"
#include "core/recon/held_out.h"
#include "core/recon/means.h"
#include "core/recon/refining.h"
#include "core/recon/restraint.h"
#include "core/recon/rim.h"
#include "core/recon/stripes.h"
#include "core/recon/stopping.h"
#include "core/recon/support.h"
#include "core/warning.h"

/* Declarations that recon.c (life, views), run.c (the run) and memory.c (the memory it takes) share. */

struct recon {
	const struct backend *backend;
	struct device *device;
	struct device *outofcore;        /* out-of-core wrapper around `device`; NULL when the job fits as a whole */
	const struct geometry *given;    /* of the samples as they come */
	const struct geometry *geometry; /* that all goes by: given, `binned` or `upright` */
	struct geometry binned, upright; /* owned, empty where pixels are taken as they are and rows as they lie */
	const struct recon_hooks *hooks;
	struct cancel cancel;
	struct warning_sink warnings;

	struct recipe recipe; /* resolved */
	struct orbit orbit;
	struct input input;
	struct fdk_weights weights;
	struct sart_options sart; /* where the algorithm goes by subsets */

	struct recon_memory memory; /* counted before anything was allocated */
	struct plan *plan;
	struct fdk fdk;            /* where FDK is on */
	struct stack *projections; /* a slot for each view where they are kept, else for each view of an FDK batch */
	struct volume *volume;     /* the iterate */
	struct volume *before;     /* the iterate before the iteration, and for corrections; NULL without both */
	struct stack *batch;       /* for corrections to work in; NULL without */
	struct correction_chain corrections;
	struct problem problem; /* of the algorithm, where there is one */
	void *algorithm_state;
	struct ends *ends;               /* the end slices of volumes that are kept; NULL: they are the iterate's */
	struct alternation *alternation; /* from slice to slice, not in volumes that are kept; NULL: views see it */
	struct rim *rim;                 /* of the field of view, in volumes that are kept; NULL: it is the iterate's */
	struct restraint *restraint;     /* of volumes that are kept, beside their start; NULL: there is none */
	struct stripes *stripes;         /* that FDK has none of, not in volumes that are kept; NULL: there are none */
	struct means *means;             /* of FDK over voxels, in volumes that are kept; NULL: they have none */
	bool left_out_dense;             /* rays through what is very dense have no part in the iterations */
	bool outside;                    /* matter outside of the grid was taken out of the projections */
	struct support *support;         /* NULL until a volume is kept */
	struct refining *refining;       /* NULL where the geometry is not refined */
	struct held_out *held_out;       /* NULL where no view is held out */
	struct stack *forecast;          /* what a volume says of views that are held out; NULL where none are */
	bool smoothed;                   /* while a volume is kept, `before` has the iterate */

	unsigned char *pushed; /* [views] */
	int *views;            /* [views]: 0, 1, 2 ... */
	int pushed_count;

	struct volume_noise noise; /* where it is measured */
	bool noise_measured;

	bool resumed, looked, ran, ended; /* looked: behind input_settle; ended: behind the last iteration */
	int left_out;                     /* views that input_settle has found */
	int iteration;                    /* done so far */
	struct recon_agreement agreement;
	double settled; /* iterations after which relaxation falls; INFINITY: never */
	bool moved;     /* the iterate is not the one that the algorithm left */
	struct volume_norms norms;
	struct stopping stopping;     /* of automatic iterations */
	double work_done, work_total; /* in FDKs of the whole scan */
	double refine_work;           /* of that, what finding the views' poses takes, */
	double refine_from;           /* and what was done before it */
	double fraction;              /* of the work, as it was told last: it does not fall */
};

/*
 * Cost of the stages relative to an FDK of the whole scan, roughly, as measured on CPU and GPU alike: used for the
 * progress bar only.
 */
static const double WORK_LOAD = 0.2, WORK_FDK = 1, WORK_TV = 0.2, WORK_MEANS = MEANS_PLACES + 1;
/*
 * What a refinement takes on a device with memory of its own, as many times as on the processor beside an FDK there:
 * its volumes are small, and the processor has a part in each step. .7 s on an H200, 73e9 updates a second.
 */
static const double WORK_DEVICE = 5;

static inline double iteration_work(const struct recipe *recipe)
{
	return recipe->algorithm->work + (recipe->tv.on ? WORK_TV : 0);
}

/* Iterations to come behind `iteration`: of automatic ones as many as most runs have. */
static inline int iterations_left(const struct recipe *recipe, int iteration)
{
	const int most = recipe_iterations(recipe) - iteration;
	const struct stop_limits limits = stopping_limits(recipe);
	const int usual = limits.least > STOPPING_TYPICAL ? limits.least : STOPPING_TYPICAL;
	const int typical = iteration < usual ? usual - iteration : 1;

	return recipe->iterate.automatic && typical < most ? typical : most;
}

/* A resumed run starts from an iterate and makes no FDK volume. */
static inline bool recon_runs_fdk(const struct recon *recon)
{
	return recon->recipe.fdk.on && !recon->resumed;
}

/* Without FDK, or with one of a short arc, there is nothing to hold the end slices against. */
static inline bool recipe_has_ends(const struct recipe *recipe, const struct orbit *orbit)
{
	return recipe->fdk.on && recipe->algorithm != NULL && orbit_fdk_is_sound(orbit);
}

/* Without FDK, or without its noise taken out before the iterations, the rim is the iterate's. */
static inline bool recipe_has_rim(const struct recipe *recipe, const struct orbit *orbit)
{
	return recipe_has_ends(recipe, orbit) && (!recipe->tv.on || recipe->tv.after_fdk);
}

/* Calls the hook at the beginning of what `stage` says. */
void recon_tell_progress(struct recon *recon, enum stage stage, int iteration);

/*
 * Makes of the iterate what a volume that is kept has of it, and its norms where that differs; warns of it once the
 * iterations have ended. recon_hide gives the iterate back, and takes out what corrections have shown, too.
 */
int recon_show(struct recon *recon, struct volume_norms *norms, struct error *err);
int recon_hide(struct recon *recon, struct error *err);

/* True if all projections are kept on the device, and not a batch of FDK's at a time. */
bool keeps_projections(const struct recipe *recipe);
/* True if the recipe's algorithm is the backend's own update over ordered subsets. */
bool has_subsets(const struct recipe *recipe);
/* Iterations that nobody has set: they begin with FDK, and TV finds its strength. */
static inline bool recipe_has_restraint(const struct recipe *recipe, const struct orbit *orbit)
{
	return recipe_has_rim(recipe, orbit) && has_subsets(recipe) && recipe->tv.on && recipe->tv.automatic;
}

/* Of a job that takes metal out FDK's own means have the metal still. */
static inline bool recipe_has_means(const struct recipe *recipe, const struct orbit *orbit)
{
	return recipe_has_restraint(recipe, orbit) && !recipe->metal.on;
}

/* The options point into recon, which is described, has its input, and its weights where FDK is on. */
struct plan_options plan_options(const struct recon *recon);

/*
 * The first step of an opening, from recon->given: the recipe resolved, the geometry that all goes by and its orbit,
 * and the subsets. All that takes no memory of the device. Whatever it returns, recon_clear.
 */
int recon_describe(struct recon *recon, const struct recipe *recipe, struct error *err);
/*
 * Counts the memory that the job takes, recon->memory, and goes out of core (recon->outofcore, backend and device)
 * where the device is too small for the whole. Sets options->beside and lends.
 */
int recon_choose_device(struct recon *recon, struct plan_options *options, struct error *err);
/* Everything that lies on the device beside the plan, which is there; released before the plan is freed. */
int recon_allocate(struct recon *recon, struct error *err);
void recon_release(struct recon *recon);
/* Frees all that recon holds, but not itself. */
void recon_clear(struct recon *recon);

#endif

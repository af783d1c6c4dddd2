#ifndef CBCT_CORE_RECON_H
#define CBCT_CORE_RECON_H

#include "core/backend.h"
#include "core/recon/recipe.h"
#include "core/refine/refine.h"

/*
 * One reconstruction: FDK, then an iterative algorithm, with TV after the FDK volume
 * and after each iteration. Opened with a geometry and a recipe, fed with views in
 * any order, then run; everything is allocated at the opening. One thread at a
 * time; the hooks are called in that thread.
 */

/* Noise measured in a volume, see core/recon/noise.h; both 0 where nothing stands out of the background. */
struct volume_noise {
	double sigma;    /* 1/mm: standard deviation of the noise */
	double contrast; /* 1/mm: standard deviation of the object's gray levels without it */
};

/* Always finite. */
struct history_row {
	int iteration;
	double residual; /* ||p - A v|| / ||p||, each view's as it was met; 0 where all of it is zero */
	double change;  /* ||v - v_before|| / ||v_before|| over the iteration, TV included; 1 where v_before was zero */
	double tv;      /* sum |grad u| of the volume in gray levels */
	double seconds; /* that the iteration took */
};

enum stage { STAGE_LOAD, STAGE_FDK, STAGE_SART, STAGE_TV, STAGE_SAVE, STAGE_CGLS, STAGE_FISTA, STAGE_COUNT };
extern const char *const stage_names[STAGE_COUNT]; /* "load", "fdk", "sart", "tv", "save", "cgls", "fista" */

/* How far a kept volume stands on what was measured: core/recon/support.h, core/recon/held_out.h. */
struct volume_support {
	double metal, estimated;             /* shares of the object, 0 .. 1; NaN: the volume shows none */
	int held_out;                        /* views that had no part in it; 0: none, and the residuals are NaN */
	double held_residual, used_residual; /* ||p - A v|| / ||p|| over them, and over as many views beside them */
};

struct kept_volume {
	const char *name;  /* "fdk", "fdk-tv", "iter-5", "final" */
	const char *stage; /* "fdk", "tv" (TV after the FDK), "sart" (an iteration, its TV included) */
	int iteration;     /* 0 before the first */
	const struct grid *grid;
	struct volume_norms norms;
	double estimate_mm; /* what is nearer to metal is an estimate (METAL_ESTIMATE_MM); 0: there is no metal */
	struct volume_support support;
};

/* Rules that end iterations that are left to the program: core/recon/stopping.h. */
enum stop_rule { STOP_NOT, STOP_NOISE, STOP_RESIDUAL, STOP_CHANGE, STOP_CEILING, STOP_RULE_COUNT };
extern const char *const stop_rule_names[STOP_RULE_COUNT]; /* "none", "noise", "residual", "change", "ceiling" */

/* How such iterations ended. */
struct recon_stop {
	enum stop_rule rule;
	int iteration;
	double residual, change, noise; /* of the last row; noise: ||noise|| / ||p||, estimated */
};

struct recon;

struct recon_hooks {
	void *context;
	bool (*cancelled)(void *context);
	/*
	 * Asked after each iteration but the last; true ends the run with ERR_BUSY:
	 * recon_iteration and recon_read then give what recon_resume wants. Asked often while the geometry is refined,
	 * too; then there is no iteration to go on from, recon_iteration is 0.
	 */
	bool (*yield)(void *context);
	/* Called at the beginning of a stage; the fraction is of the whole job, 0..1. */
	void (*progress)(void *context, enum stage stage, int iteration, double fraction);
	void (*row)(void *context, const struct history_row *row);
	/*
	 * Called for each volume that is to be kept; reads it with recon_read. Below zero ends the run. The last volume
	 * comes as "final", and before that under its own name where the recipe asks for that too.
	 */
	int (*keep)(void *context, struct recon *recon, const struct kept_volume *volume, struct error *err);
	/*
	 * With TV in the recipe, once, before the first TV: the noise in Hounsfield units, and the alpha of the TV that
	 * follows SART, or FDK where there is no SART; 0 where nothing is to be smoothed.
	 */
	void (*denoising)(void *context, double noise_hu, double alpha);
	/* With automatic iterations, behind the row of the last one. */
	void (*stopped)(void *context, const struct recon_stop *stop);
	/* Once all views have come, where they show enough: how well they agree with the geometry. */
	void (*agreement)(void *context, const struct recon_agreement *agreement);
	/* A code of core/warning.h and the technical detail. */
	void (*warning)(void *context, const char *code, const char *detail);
}; /* any of them may be NULL */

struct recon_memory {
	size_t projections, volumes, scratch, total; /* bytes on the device */
	size_t available;                            /* bytes free there */
	size_t
	    host; /* 0; or out of core (outofcore.h): bytes in the host's memory, where projections and volumes lie */
};

/*
 * The most memory that a job will take, known before it is opened. The projections are all kept for iterations; FDK
 * alone needs a few at a time. device NULL (the daemon, which opens none): available is 0. Of linearise's images it
 * matters only which there are.
 */
int recon_memory(const struct backend *backend, struct device *device, const struct geometry *geometry,
		 const struct linearise *linearise, const struct recipe *recipe, struct recon_memory *ret_memory,
		 struct error *err);

/*
 * geometry, linearise's images, hooks, backend and device are borrowed until
 * recon_free; the recipe is copied and resolved. Checks, then refuses with
 * ERR_NO_MEMORY what does not fit, then allocates.
 */
int recon_open(const struct backend *backend, struct device *device, const struct geometry *geometry,
	       const struct linearise *linearise, const struct recipe *recipe, const struct recon_hooks *hooks,
	       struct recon **ret_recon, struct error *err);
void recon_free(struct recon *recon);

/*
 * Views as raw samples [view][row][column], in any order, each once (ERR_CONFLICT):
 * linearised, and filtered and backprojected where FDK is on, however many a call brings.
 */
int recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err);

/*
 * After the last view, where the recipe asks to refine the geometry: fits it (core/refine/refine.h). What is accepted
 * makes *ret_geometry, which a reconstruction opened anew goes by; free with geometry_clear. Where nothing was tried or
 * accepted it stays untouched, and this reconstruction goes on. reference: where the recipe names one, else NULL; keep:
 * who keeps what a run has reached that ends with ERR_BUSY, or breaks off; NULL: nobody. The same views give the same
 * bits, so that a resumed run gets the geometry that its checkpoint was made with.
 */
int recon_refine(struct recon *recon, const struct refine_reference *reference, const struct refine_keep *keep,
		 struct refinement *ret_refinement, struct geometry *ret_geometry, struct error *err);
/* All but the reference that recon_refine would go by, as a number; refinement.basis of what was found has it. */
uint64_t recon_refine_basis(struct recon *recon);
/* In place of recon_refine where the same views have been refined before: goes by what was found then. */
int recon_refine_again(struct recon *recon, const struct refinement *refinement, struct geometry *ret_geometry,
		       struct error *err);
/* The motion that it has found for a view: as path_motion. */
void recon_motion(const struct recon *recon, const struct refinement *refinement, int view,
		  double ret_motion[PATH_NUMBERS]);

/*
 * After the last view, before recon_run: whether there are spoiled views which could be made whole, or left out, if all
 * projections were kept: by a reconstruction opened anew with recipe.keep_all.
 */
int recon_lacks(struct recon *recon, bool *ret_lacks, struct error *err);

/* Called once, after the last view: finishes FDK, then TV, iterations and TV in turn, calling the hooks. */
int recon_run(struct recon *recon, struct error *err);

/*
 * Goes on behind `iteration` (0 .. iterate.iterations) with the iterate that was
 * there, instead of FDK: the same bits as if it had never stopped. Call before
 * the first recon_push, which then skips FDK. A recipe without an algorithm is refused.
 */
int recon_resume(struct recon *recon, const float *volume, int iteration, struct error *err);

/*
 * Findings of the corrections in the FDK volume, the list of metal, as bytes that belong to the recon; 0 bytes where
 * there are none. A resumed run must get them back after recon_resume: its projections then become what they were.
 */
const void *recon_found(const struct recon *recon, size_t *ret_bytes);
int recon_resume_found(struct recon *recon, const void *found, size_t bytes, struct error *err);

/* Part of a checkpoint goes out: 0 or a negative code. */
struct checkpoint_sink {
	void *context;
	int (*write)(void *context, const void *bytes, size_t size, struct error *err);
};
/*
 * The algorithm's state beside the iterate, and the end slices that its iterations began with (core/recon/ends.h); 0
 * bytes where there is neither. A resumed run must get them back after recon_resume, to keep the same volumes.
 */
size_t recon_state_bytes(const struct recon *recon);
/* Whether a run of the same recipe may have had so many: what they hold depends on what it found in the projections. */
bool recon_state_fits(const struct recon *recon, size_t size);
int recon_save_state(struct recon *recon, const struct checkpoint_sink *sink, struct error *err);
int recon_resume_state(struct recon *recon, const char *bytes, size_t size, struct error *err);

/*
 * The noise that was measured; NULL before that and without TV. A resumed run must get it back
 * after recon_resume: the FDK volume that showed it is not made again. Without TV nothing is taken.
 */
const struct volume_noise *recon_noise(const struct recon *recon);
int recon_resume_noise(struct recon *recon, const struct volume_noise *noise, struct error *err);

/* Slices of the current iterate, 1/mm; while a volume is kept, with the metal in it. */
int recon_read(struct recon *recon, int z_first, int z_count, float *ret_slices, struct error *err);

const struct grid *recon_grid(const struct recon *recon);
int recon_iteration(const struct recon *recon);                           /* iterations done so far */
const struct recon_memory *recon_memory_taken(const struct recon *recon); /* as recon_open counted it */
size_t recon_defects(const struct recon *recon);
const char *recon_plan(const struct recon *recon); /* how the backend does it */

#endif

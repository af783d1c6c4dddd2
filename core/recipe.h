#ifndef CBCT_CORE_RECIPE_H
#define CBCT_CORE_RECIPE_H

#include "core/backend.h"

/*
 * The recipe of a job: what it asks for, as plain data that every room of core/ may read.
 * core/recon/recipe.h has its defaults, its ranges, and what is filled in.
 */
enum { EMIT_FDK = 0, EMIT_FDK_TV = -1 }; /* beside iterations 1, 2, ... */
enum { RECIPE_ID_SIZE = 64 };

/* Backprojection of the iterations: plan_options.matched. */
enum projector { PROJECTOR_INTERPOLATING, PROJECTOR_MATCHED, PROJECTOR_COUNT };

/* What a ray counts for beside its length: the same for all, or by the noise of its value (core/recon/weights.h). */
enum ray_weights { RAYS_EVEN, RAYS_COUNTS, RAYS_NOISE, RAY_WEIGHTS_COUNT };

/* "light", "medium", "strong": half, once, twice the balance that is found. */
enum tv_strength { TV_LIGHT, TV_MEDIUM, TV_STRONG, TV_STRENGTH_COUNT };

struct algorithm; /* core/recon/algorithm.h */

struct recipe {
	bool has_grid; /* otherwise chosen from field of view and resolution */
	struct grid grid;
	bool has_origin; /* grid.origin was given; otherwise centred */
	struct {
		bool on;
		enum window window;
		double cutoff;
		bool extend; /* rows that the detector cuts off, core/truncation.h */
	} fdk;
	const struct algorithm *algorithm; /* of algorithms[], core/recon/algorithm.h; NULL: no iterations */
	struct {
		int iterations;
		bool automatic;                    /* they end by themselves (core/recon/stopping.h) ... */
		int most;                          /* ... behind so many at the latest */
		bool nonnegative;                  /* no voxel below 0 */
		double stop_residual, stop_change; /* 0: never */
		enum ray_weights weights;          /* of algorithms that weigh rays */
	} iterate;                                 /* whatever the algorithm */
	struct {
		double relaxation;
		int subsets;   /* 1 .. views; SUBSETS_VIEWS: an update after each view; SUBSETS_DEFAULT: 10 or fewer */
		bool momentum; /* core/recon/sart.c */
	} sart;
	struct {
		bool on;
		bool after_fdk;            /* false with "after": "sart" */
		bool automatic;            /* alpha is found from the noise (core/recon/noise.h); not for TV_GRADIENT */
		enum tv_strength strength; /* of what is found */
		struct tv_options options; /* alpha counts for nothing where it is found */
	} tv;
	enum projector projector;
	bool rings;    /* errors of pixels' gain are looked for and mended (core/correct/rings.h) */
	bool hold_out; /* some views have no part in the volumes, which are held against them (core/recon/held_out.h) */
	struct {
		bool geometry, motion; /* one of them at most: how views are moved to fit (core/refine/refine.h) */
		/* The job whose last volume is the reference, by its id; "": none. Needs one of them. */
		char reference[RECIPE_ID_SIZE];
	} refine;
	bool keep_all; /* not asked for: all projections are kept, so that spoiled ones can be mended (recon_lacks) */
	int binning;   /* pixels a side that are taken as one (core/correct/binning.h); BINNING_AUTO until resolved */
	struct {
		bool on; /* needs fdk.on */
		double threshold_hu;
	} metal;         /* core/correct/metal.h */
	double mu_water; /* 1/mm */
	int *emit;       /* [emits], owned; iterations, EMIT_FDK, EMIT_FDK_TV */
	int emits;
	bool reference_precision;
};

/* Iterations that the recipe's algorithm has at most. */
static inline int recipe_iterations(const struct recipe *recipe)
{
	return recipe->iterate.automatic ? recipe->iterate.most : recipe->iterate.iterations;
}

enum { BINNING_AUTO = -1, BINNING_MOST = 8 };

/* How well the projections agree with the geometry, core/refine/agreement.h. */
struct recon_agreement {
	int views;           /* that were measured; 0: they say nothing, and all is 0 */
	double mm, sigma_mm; /* at the isocentre */
	double unexplained;  /* share of a view's detail that the others do not show there, median */
};

enum { ITERATIONS_MAX = 100000, GRID_DEFAULT_MOST = 512, METAL_HU_LEAST = 500, METAL_HU_MOST = 1000000 };
/* Voxels nearer to metal than this are an estimate: most of their rays lie in the metal's shadows. */
enum { METAL_ESTIMATE_MM = 10 };

#endif

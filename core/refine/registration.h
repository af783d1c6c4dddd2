#ifndef CBCT_CORE_REGISTRATION_H
#define CBCT_CORE_REGISTRATION_H

#include "core/refine/refine.h"

/*
 * One level of the refinement: the views in bins of one size, the volume that the views in use make, and what moving
 * each view would change of what that volume does not explain. A level belongs to one thread at a time, and works with
 * as many as there are.
 */
enum { REGISTRATION_IMAGES = 1 + PATH_NUMBERS };

struct registration {
	const struct reduced *reduced;
	const struct refine_watch *watch;
	enum refine_kind kind;
	bool referred;            /* the volume is a reference, and stays what it is */
	bool cut;                 /* the body goes on beside the detector */
	struct geometry geometry; /* of the bins, as the path moves it */
	struct grid grid;
	struct orbit orbit; /* of the bins */
	struct sart_options sart;
	struct tv_options tv;
	const struct backend *backend;
	struct device *device; /* borrowed */
	struct plan *plan;     /* of `geometry` */
	struct stack *measured, *made;
	struct volume *volume, *work;
	float *voxels, *derived; /* of the grid */
	/* [REGISTRATION_IMAGES][used, or held][row][column]: the residual, and derivatives. */
	float *images;
	float *scratch;          /* [threads][4][row][column] */
	struct path_view *views; /* [geometry.count] */
	int *used, *held;        /* numbers of views, */
	int used_count, held_count;
};

/* All that is pointed to is borrowed. */
struct registration_options {
	const struct refine_device *on; /* all but registration_updates need it */
	const struct reduced *reduced;
	const struct orbit *orbit; /* of the scan; only registration_open needs it */
	enum refine_kind kind;
	double mu_water; /* 1/mm */
	bool referred;
	int bins; /* the most voxels along the grid's sides, but for what is added for a body that is cut */
	const struct refine_watch *watch; /* NULL: nobody watches */
	/* Before the views have come: nothing is known of the body, and it is taken to be cut or not as `wide` says. */
	bool empty, wide;
};

/* Adds the memory that it takes, and how many updates of a voxel by a view an FDK of the level is. */
int registration_add_bytes(const struct registration_options *options, struct refine_bytes *bytes, struct error *err);
int registration_updates(const struct registration_options *options, double *ret_updates, struct error *err);
/* Free with registration_clear. */
int registration_open(struct registration *ret_fit, const struct registration_options *options, struct error *err);
void registration_clear(struct registration *fit);

/* The views stand as the path moves them; NULL: as the scan says. */
int registration_place(struct registration *fit, const struct path *path, struct error *err);
/* One iteration of SART, and TV. */
int registration_iterate(struct registration *fit, struct error *err);
/*
 * One step of the path, from the volume as it is. The residual is no noise but what the volume lacks, which is alike
 * over far more than a smoothed bin's neighbours: its variance counts `alike` times.
 */
int registration_step(struct registration *fit, struct path *path, double alike, struct error *err);
/* Squares of the detail of each held-out view that the volume does not explain, [held_count], and their sum. */
int registration_measure(struct registration *fit, double *ret_squares, double *ret_sum, struct error *err);
/*
 * Behind registration_measure, of the same views: by which factor the volume's detail stands in the views, the slope of
 * the regression of what was measured upon it. About 1 for a volume of the object in its place, whatever the noise.
 */
int registration_alike(struct registration *fit, double *ret_alike, struct error *err);
/* How many bins these are sums over. */
double registration_bins(const struct registration *fit);

/* The volume, for another level: [z][y][x] of fit->grid; malloc'ed, NULL without memory. */
float *registration_keep_volume(struct registration *fit, struct error *err);
/* The volume becomes that of another level's grid, trilinear; without `voxels` it is 0. */
int registration_start(struct registration *fit, const struct grid *grid, const float *voxels, struct error *err);
/* The volume becomes the reference's, in the mean over each voxel; outside of its grid 0. */
int registration_refer(struct registration *fit, const struct refine_reference *reference, struct error *err);

#endif

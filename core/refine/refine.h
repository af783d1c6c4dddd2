#ifndef CBCT_CORE_REFINE_H
#define CBCT_CORE_REFINE_H

#include <stdint.h>

#include "core/backend.h"
#include "core/refine/path.h"
#include "core/refine/reduced.h"

/*
 * Where source and detector really stood, or how the object moved meanwhile, from nothing but the projections: 3D-2D
 * registration of each view with a volume of the others, in turn with that volume's reconstruction.
 *
 * A volume that FDK makes follows the views of a short scan wherever they stand. Therefore it is made by SART with
 * total variation in between, which draws it to what is even between edges: a volume that a wrong geometry has doubled
 * edges in does not explain the views, and what it leaves unexplained, held against the derivatives of the projections
 * by a rigid motion (projections of the volume's gradient), says how each view is to be moved (Gauss and Newton). Views
 * far off, metal and what lies outside of the grid count for less (Cauchy's weights). The motions are a smooth path
 * over the sweep, with few knots at first and then with more; and a motion that all views share, which leaves the
 * volume where it is while the path is found that is small about the views' own axes. First this is done in bins of
 * twice the size, then from there on in those that are given.
 *
 * How far a residual is to be trusted depends on what the volume lacks, which differs from a head to a leg with screws:
 * a motion is looked for with three degrees of trust, and views that are held out have the choice.
 *
 * One view in eight has no part in volume and path. What the volume says of these views, moved as the path says, is
 * held against what the same iterations say of them without any motion; a path is kept only where that is better, and
 * where the path is larger than most that are found where there is nothing to find (one of 24 such scans keeps one, of
 * .06 mm, and is the better for it).
 *
 * A volume of the same object in the same world, of an earlier scan, can be the reference: then no volume is made, the
 * views are registered with it as it is, and what they share is found, too. A reference whose detail the views that are
 * held out do not show is of another object, and is not followed; nor is one by whose path the scan contradicts itself:
 * views that are held out then agree worse with a volume of the scan's own others than they do as the scan has them.
 *
 * Without a reference what all views share is no motion: a refined geometry has the object, on the whole, where the
 * told one has it (core/refine/rest.h), aside of the truth by what the departures of all views share; and an object
 * that moved lies in the mean place of its path over the views. Nor does a scan tell how large the object is: the way
 * along the beam is expected to be small, of an object that moves in the mean over the views. Bins limit what can be
 * found, to about a thirtieth of one.
 */
enum { REFINE_VIEWS_MOST = 120, REFINE_BINS_MOST = 160 };

enum refine_kind {
	REFINE_NONE,
	REFINE_GEOMETRY, /* source and detector, as one body: smooth about the view's own axes */
	REFINE_MOTION,   /* the object: smooth in the world */
	REFINE_KINDS
};

/* What the views are registered with in place of a volume of their own: a volume in voxels of a bin or so is enough. */
enum { REFERENCE_VOXELS_MOST = 256 /* a side */ };
#define REFERENCE_BYTES ((size_t)REFERENCE_VOXELS_MOST * REFERENCE_VOXELS_MOST * REFERENCE_VOXELS_MOST * sizeof(float))
struct refine_reference {
	struct grid grid;    /* 2 to REFERENCE_VOXELS_MOST voxels along each axis */
	const float *voxels; /* [z][y][x], 1/mm; borrowed */
};

struct refinement {
	struct path path; /* no motion where it is not accepted */
	bool accepted;
	int held_out; /* views, */
	/* and the root mean square of their detail that is unexplained, without and with the path, kept or not */
	double held_before, held_after;
	int better;   /* views among them that are explained better */
	double alike; /* of a reference's projections the share that the views' detail has, 1: the same; else 0 */
	/* With a reference what the scan's own volume leaves unexplained of the views held out, in the coarser bins;
	 * else 0. */
	double own_before, own_after;
	uint64_t basis; /* refine_basis */
};

/*
 * True if a scan has views, rows and columns enough; with a reference (`is_referred`) half of the views are. Without
 * one not of a displaced detector: opposite views do not show the same there, and held-out views preferred a path that
 * made the image worse in both heads that need none (tests/bench/results/refine.txt).
 */
bool refine_is_possible(const struct geometry *geometry, const struct orbit *orbit, bool is_referred);
/* Where a view stands on the path, radians from the first of the sweep on. */
double refine_place(const struct orbit *orbit, int view);
/*
 * What a motion of the object, as path_motion has it, is for people: mm, and a vector of rotation in degrees about the
 * isocentre. Of a geometry how source and detector of `view` were moved as one body, along and about its columns, its
 * rows and across both; of a motion the object's along and about x, y and z.
 */
void refine_change(enum refine_kind kind, const struct view *view, const double motion[PATH_NUMBERS],
		   double ret_change[PATH_NUMBERS]);
/*
 * A number of all that a refinement is found from but the reference: who has what was found from the same need not look
 * for it again.
 */
uint64_t refine_basis(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water);
/* Where the volumes and their projections are computed. Borrowed; `device` NULL: before it is open, for refine_bytes.
 */
struct refine_device {
	const struct backend *backend;
	struct device *device;
};
/* Memory that refine_find takes. */
struct refine_bytes {
	size_t device; /* the backend's device's */
	size_t host;   /* out of core (core/outofcore/outofcore.h): the host's, too */
	size_t aside;  /* the host's whatever the device is */
};
int refine_bytes(const struct reduced *reduced, const struct refine_device *on, struct refine_bytes *ret_bytes,
		 struct error *err);
/* What it takes, in updates of a voxel by a view as FDK makes them. */
int refine_work(const struct reduced *reduced, enum refine_kind kind, bool is_referred, double *ret_updates,
		struct error *err);

/*
 * What a refinement has reached behind a step, in pieces that follow each other in a file; borrowed for the call. Such
 * bytes, whole, are what another run of the same views goes on from.
 */
enum { REFINE_PIECES = 7 };
struct refine_state {
	struct refine_piece {
		const void *bytes;
		size_t size; /* 0: it is left out */
	} pieces[REFINE_PIECES];
};
/*
 * Who keeps what was reached. A run that goes on from there ends with the bits of one that was never broken off, on the
 * same backend.
 */
struct refine_keep {
	void *context;
	bool (*due)(void *context,
		    bool leaves); /* asked behind each step; leaves: the run ends there, to go on later */
	int (*keep)(void *context, const struct refine_state *state, struct error *err);
	/* What an earlier run has kept, all of it; NULL: there is none. That of other views, or no whole state: as
	 * none. */
	const void *state;
	size_t bytes;
};

/* Who watches it. */
struct refine_watch {
	const struct cancel *cancel;                   /* NULL: nobody can cancel it */
	void (*progress)(void *context, double share); /* behind each step: the share of all of them that is done */
	bool (*yield)(void *context); /* asked behind each step, NULL: nobody asks; true: ends with ERR_BUSY there */
	void *context;
	const struct refine_keep *keep; /* NULL: what was reached is not kept */
};
/*
 * orbit: of the scan. mu_water in 1/mm. reference: NULL for none. On one backend the same bits for any number of
 * threads; what CUDA and the CPU find of a view is less than .001 mm apart (tests/gpu/end_to_end.sh).
 */
int refine_find(const struct reduced *reduced, const struct orbit *orbit, enum refine_kind kind, double mu_water,
		const struct refine_device *on, const struct refine_reference *reference,
		const struct refine_watch *watch, struct refinement *ret_refinement, struct error *err);

#endif

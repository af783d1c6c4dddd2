#ifndef CBCT_CORE_INPUT_H
#define CBCT_CORE_INPUT_H

#include "core/correct/binning.h"
#include "core/correct/content.h"
#include "core/correct/defects.h"
#include "core/correct/impulses.h"
#include "core/correct/mend.h"
#include "core/correct/narrow.h"
#include "core/correct/outliers.h"

/* Views of a job that keeps no projections which may have to be taken out of the FDK volume again, at most. */
enum { COPIES_MOST = 12 };

/* The samples that a reconstruction was given: how they come, and statistics of those seen so far. */
struct input {
	struct binning binning;     /* of the samples as they come */
	struct linearise given;     /* of samples with their pixels binned */
	struct linearise linearise; /* with the whole map, of counts that were corrected; exchanged where `turned` */
	bool turned;                /* rows and columns of all images are exchanged on their way in */
	int columns, rows;          /* as they come, binned */
	/* Owned, with rows and columns exchanged; NULL where not turned: linearise's images, and room for a view. */
	void *image[IMAGE_COUNT], *stuck, *projection;
	struct defect_map map;
	struct defect_counts counts;
	int views, defective_views; /* linearised so far, and those of them with defects */
	/*
	 * [counts.blank], owned: views without a good pixel or of a closed shutter, in the order they came, and behind
	 * them, once all have come, those that show nothing, outliers that are left out, and views that are held out.
	 * `empty` of them have good pixels, `left_out` of those are outliers, and `held_out` are held out.
	 */
	int *blank, empty, left_out, held_out;
	bool *stood_in; /* [views of the scan], owned: of the blank ones, those of input_stand_in */
	/* [views of the scan], owned; the last one of input_settle. */
	struct view_profile *profiles;
	struct view_strips *strips;
	struct outlier *outliers;
	/* [all_views], owned, as their pixels: single samples that may be wrong, behind input_check those that are; and
	 * what was replaced, behind input_mend. */
	struct view_impulses *impulses;
	int all_views, replaced_views;
	size_t replaced;
	/*
	 * [views of the scan], owned, of input_settle: runs between two steps, and [mended_count] those of their views
	 * that are made whole again. Such a view is an outlier as well, and none of the blank ones.
	 */
	struct step *steps;
	int *mended, mended_count;
	double opposite; /* the share of mended parts that comes from the rays that run the other way */
	/* [views of the scan], owned: the defects of each view, and what was seen at its edges where it was looked at.
	 */
	struct defect_counts *defects;
	struct view_edges {
		bool looked_at, ends[2], far_off, board;
		float air, air_ends[2]; /* air_level */
	} * edges;
	/* [row][column], line integrals as FDK took them, of views that may be outliers, owned. */
	struct {
		int view;
		float *slot;
	} copies[COPIES_MOST];
	int copy_count;
	int good[2]; /* the last view that input_copy did not copy, and the one before it; -1: none */
	/*
	 * Rows that the filter has counted as cut off and that are none more: twice those of blank views which it had
	 * before it was known that they show nothing, since they are filtered once more when they are taken out, and
	 * those of views that were filtered once more for a volume of every other view.
	 */
	size_t cut_again[2];
	bool even;                    /* no view shows an object; of those that have come, until all have */
	struct view_content *content; /* [views of the scan], owned */
	size_t pixels;                /* of a view */
	float log_air; /* of the latest view's own air: line integrals are larger by it; 0 without a region */
	/* Statistics of about 4096 pixels of each view. */
	double sum; /* of line integrals */
	float most; /* of them, at least 0 */
	size_t looked_at;
	/*
	 * About 32 views are looked at, but for those that are mended: how many were, and how many had something that
	 * is not air on the first row and on the last one. Known behind input_settle, as the following.
	 */
	int look_every, views_looked_at, ends[2];
	/*
	 * How many of these had air that is not 0 (core/correct/air.h), how many so far from 0 that it does not pass
	 * for air; the least and the largest level of air that is not 0.
	 */
	int off, far_off;
	float air_least, air_most;
	/*
	 * For uint16, as it is and with its bytes exchanged: the sum of differences of neighbours; and the largest
	 * value when exchanged.
	 */
	double rough[2];
	int largest;
};

/*
 * Checks linearise against the detector; looks for defects in its images. geometry is that of the samples as they come,
 * n x n of whose pixels are taken as one. turned: rows and columns are exchanged behind that, for a job whose geometry
 * is geometry_exchange's. Free with input_clear.
 */
int input_open(struct input *ret_input, const struct linearise *linearise, const struct geometry *geometry, int n,
	       bool turned, struct error *err);
void input_clear(struct input *input);

/* Of the samples as they come. */
size_t input_view_bytes(const struct input *input);
/* Looks at a view's samples as they come, for signs that their bytes are in the wrong order. */
void input_look_at_bytes(struct input *input, const void *samples);
/* A view's samples with their pixels binned; valid until the next call. */
const void *input_bin(struct input *input, const void *samples);

/* linearise of one view into a slot; the samples are those that corrections of counts have left. *ret_upright: the
 * samples, or their rows and columns exchanged where `turned`. */
int input_take(struct input *input, const struct backend *backend, struct plan *plan, const void *samples, int view,
	       int slot, struct stack *to, const void **ret_upright, struct error *err);

/*
 * Copies a view's slot of `from`, as FDK takes it, where the view differs from the last one that was not copied and may
 * be an outlier: for jobs that keep no projections.
 */
int input_copy(struct input *input, const struct backend *backend, struct stack *from, int view, int slot,
	       struct error *err);
/* The copy of a view; NULL: there is none. */
const float *input_copy_of(const struct input *input, int view);
/* Whether input_settle has found the view to lie between two steps, and to be mended. */
bool input_is_mended(const struct input *input, int view);

/*
 * Called once, when all views have come: those that show nothing (content.h), and outliers (outliers.h) if all views
 * are kept or there is a copy, are blank ones from now on. Returns how many it found, the last ones of the list;
 * ERR_IMPOSSIBLE where no view has a good pixel. Views between two steps (steps.h) are to be mended then.
 */
int input_settle(struct input *input, const struct orbit *orbit, bool keeps_all, struct error *err);

/* Behind input_settle of a job that keeps no projections: whether there are views that it could mend, or leave out, if
 * it did. */
bool input_lacks(const struct input *input, int views);
/* Outliers that are neither mended nor left out. */
int input_kept_in(const struct input *input, int views);

/* Behind input_settle of a job that keeps all projections: single samples of them that are wrong are to be mended, too.
 */
int input_check(struct input *input, const struct backend *backend, struct stack *projections,
		const struct geometry *geometry, const struct orbit *orbit, const struct cancel *cancel,
		struct error *err);
/* The part of input_mend that replaces those. */
int input_mend_impulses(struct input *input, const struct mend_tools *tools, struct error *err);

/*
 * Makes the views that are to be mended whole in `projections`, which keeps all views where keeps_all; otherwise the
 * levels alone are to be taken off the copies.
 */
int input_mend(struct input *input, const struct backend *backend, struct stack *projections,
	       const struct geometry *geometry, const struct orbit *orbit, bool keeps_all, const struct cancel *cancel,
	       struct error *err);
/* Bytes of the host that input_mend works in, where all views are kept. */
size_t input_mend_bytes(const struct geometry *geometry);

/*
 * Behind input_mend of a job that keeps all projections: blank views that have good ones near on both sides, in shares
 * by the angle, show what those do from now on, until iterations leave them out. A sum over the views that lacks one
 * has streaks, of a body wider than a displaced detector more than all its other errors.
 */
int input_stand_in(struct input *input, const struct backend *backend, struct stack *projections,
		   const struct geometry *geometry, const struct orbit *orbit, const struct cancel *cancel,
		   struct error *err);
/* Whether FDK has nothing of a view: it is blank, and nothing stands in for it; how many there are. */
bool input_is_absent(const struct input *input, int view);
int input_absent(const struct input *input);

/* Called once, behind input_settle: these views, none of them blank, are blank ones from now on. */
void input_hold_out(struct input *input, const int *views, int count);

/* Makes a view's slot 0, as that of a view without a good pixel. */
int input_empty_slot(const struct input *input, const struct backend *backend, struct stack *to, int slot,
		     struct error *err);

/*
 * Tells whether the object extends beyond the first row, [0], and the last one, [1]: more than a quarter of the views
 * looked at have it there.
 */
void input_goes_on(const struct input *input, bool ret_ends[2]);

/* Adds up what was seen at the edges of the views that are taken as they are: part of input_settle. ERR_NO_MEMORY. */
int input_add_edges(struct input *input, const struct orbit *orbit, struct error *err);

/* The mean of p^2 of what the views show, without their noise; blank views count as nothing. */
double input_shown(const struct input *input);

/* The share of views in which air is so far from 0 that it does not pass for air: none of that is an object. */
double input_air_off_share(const struct input *input);
/* The share that absent views have in FDK's density on the axis, 0 .. 1. */
double input_absent_share(const struct input *input, const struct orbit *orbit);

#endif

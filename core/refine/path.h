#ifndef CBCT_CORE_PATH_H
#define CBCT_CORE_PATH_H

#include <stdbool.h>

#include "core/scan/geometry.h"

/*
 * Rigid motions of the object, one for each view, as a smooth path over the sweep: cubic B-splines of six numbers,
 * three shifts in mm and three turns in hundredths of a radian, about the isocentre, so that a unit of each moves the
 * object by about as much.
 */
#define PATH_TURN_UNIT 0.01 /* radians */
enum { PATH_NUMBERS = 6, PATH_KNOTS_MOST = 48 };
/* Squares and products of a residual (the first) and its derivatives by the six numbers; the lower triangle's rows. */
enum { PATH_PRODUCTS = (PATH_NUMBERS + 1) * (PATH_NUMBERS + 2) / 2 };

struct path {
	/*
	 * The numbers are along and about each view's columns, rows and beam, in this order; otherwise along and about
	 * x, y and z, and their mean over the views is 0.
	 */
	bool of_views;
	double length; /* of the sweep, radians */
	int knots;
	double numbers[PATH_KNOTS_MOST][PATH_NUMBERS];
	/*
	 * A motion that all views share, before the path's own, along and about x, y and z. What the numbers are
	 * expected to be says nothing of where the object lies, so that with of_views a step finds both.
	 */
	double common[PATH_NUMBERS];
};

/* A path of no motion; knots at least 4. */
void path_open(struct path *ret_path, bool of_views, double length, int knots);
/*
 * Root mean square over the sweep of the six numbers, in their units, but for the way along the beam, which shows
 * least: about the millimetres by which a path moves what is seen.
 */
double path_size(const struct path *path);
/* The same path with twice as many intervals between its knots, as many as there may be. */
void path_double(struct path *path);
/* The six numbers at `at`, 0 .. length. */
void path_at(const struct path *path, double at, double ret_numbers[PATH_NUMBERS]);

/* Unit vectors along a view's columns, its rows, and across both. */
void view_axes(const struct view *view, double ret_axes[3][3]);
/* The motion at `at` of a view that stands there: mm and radians about the world's axes. */
void path_motion(const struct path *path, double at, const struct view *view, double ret_motion[PATH_NUMBERS]);
/* The view to which the object at rest looks as the moved one does to `view`. motion: mm, and a vector of rotation. */
struct view view_of_moved(const struct view *view, const double motion[PATH_NUMBERS]);

/* One view's part in the equations of a step. */
struct path_view {
	bool used;
	double at;
	struct view view;               /* as it stood before */
	double products[PATH_PRODUCTS]; /* by numbers along and about x, y and z, divided by the residual's variance */
};
/*
 * A step of Gauss and Newton, `factor` times its length; the numbers along and about a view's axes are expected to be
 * within sigma[] of 0, and their way along the beam in the mean over the views within `nearer` mm, for no scan tells an
 * object that is nearer to the source in all views from a larger one (INFINITY: nothing is expected). Returns 0, or
 * ERR_NO_MEMORY.
 */
int path_step(struct path *path, const struct path_view *views, int count, const double sigma[PATH_NUMBERS],
	      double nearer, double factor, struct error *err);

#endif

#ifndef CBCT_CORE_ORBIT_H
#define CBCT_CORE_ORBIT_H

#include <stdbool.h>

#include "core/scan/geometry.h"
#include "core/scan/grid.h"

/*
 * Description of a geometry in a radiographer's terms: the arc, which way round,
 * short or full, how wide the fan is, how far the detector is off centre; and the
 * FDK weights that follow from it. It is found from the actual sources, so it holds
 * for calibrated C-arms as well. Every decision stands in these fields, which the
 * scan's `derived` shows.
 *
 * All of it is in the orbit's own frame: its axis is z, unless the sources
 * lie in a plane that leans against z's by more than LEAN_LEAST (an arm swung out,
 * a sweep about another axis of the patient). Then it is that plane's normal
 * through the isocentre, on z's side.
 */
struct orbit {
	int count;
	double frame[3][3]; /* its x, y and z, unit vectors in the world: turns the world's axes as little as it can */
	double lean;        /* radians, of its z against the world's; 0 below LEAN_LEAST */
	/*
	 * The detector lies on its side: its rows are nearer to the orbit's axis than to
	 * the plane across it, and than its columns. Rows and columns below are then those after they were
	 * exchanged, by which FDK goes, too.
	 */
	bool turned;
	/* [count], radians, gantry angle of each view's source, 0 <= angle < 2 pi */
	double *angle;
	/*
	 * [count], radians: half of the gaps to both neighbours; the ends of a short
	 * scan have one neighbour only, views at one angle share. Their sum is the arc,
	 * or pi when all stand at one angle.
	 */
	double *weight;
	double arc;      /* radians, from the first source to the last, 2 pi for a full turn */
	double holes;    /* radians that the views of a short scan leave out inside of the arc, see below */
	int direction;   /* +1 counter-clockwise seen from the axis' end, -1 clockwise, 0 when all views stand at one
			    angle */
	int first;       /* the view at which the arc begins, in the sense of `direction` */
	bool short_scan; /* the arc has a gap: Parker weights apply */
	/*
	 * Radians: mean angles of the rays through the detector's two outer edges
	 * against the line from source to axis, signed as Parker's formula wants them;
	 * fan is their difference, the full fan angle that the detector sees.
	 */
	double fan, half_fan_min, half_fan_max;
	double source_radius;      /* mm, mean distance of the sources from the axis */
	double source_to_detector; /* mm, mean, along the normal */
	/*
	 * mm, in the world: about it, along the frame's z, are angles and FDK's weights, the field of view, what is
	 * sought outside of a grid, and the grids below. It is the origin; but where the sources' circle has its middle
	 * beside that and has surely the wider field of view there (a real arm's is some mm beside it), or a displaced
	 * detector sees hardly any of both sides of the origin, that middle; and its height is the mean of those
	 * of the middle row on the axis, unless fewer views see that or there is one row alone.
	 */
	double centre[3];
	double field_of_view; /* mm, diameter of the cylinder that all views see, or one half when displaced */
	double displacement;  /* mm at the detector, along +u, of its centre from the ray through the axis, mean */
	bool displaced; /* half-fan weights: full turn, displaced by more than 2 % of the width and half a pixel */
	/*
	 * Columns that FDK adds before column 0 and behind the last one, zero before
	 * the filter, when displaced; else 0. The filtered row has tails there, and
	 * points that one view in two does not see need them: without them the density
	 * is wrong by some percent.
	 */
	int pad[2];
	double parker_delta;          /* radians, (arc - pi) / 2 */
	bool arc_too_short;           /* arc - holes < pi + fan: a warning, not an error */
	double pixel_at_isocentre[2]; /* mm, mean */
	/* Radians, mean angle between the detector's rows, along which FDK filters, and the plane across the axis. */
	double tilt;
};

/*
 * The rule for a full turn: of the gaps between neighbouring angles, the largest
 * is at most 5 degrees or at most 2.25 times the second largest, so that 359
 * degrees, 4 views a quarter turn apart, a lost view and uneven steps are full
 * turns. With a displaced detector, whose views have no conjugates to spare, up
 * to 20 degrees. Otherwise the largest gap is what the arc leaves out.
 *
 * A gap of more than 40 degrees and three times the fourth largest is never part of
 * a full turn, whatever the second is: that is a sweep with one or two holes, or
 * a view apart from it. Gaps inside of the arc that are three times the fourth largest
 * and wider than 20 degrees are holes.
 */

/* Allocates the arrays; free with orbit_clear. Fails for no memory only: any checked geometry has an orbit. */
int orbit_analyse(struct orbit *ret_orbit, const struct geometry *geometry, struct error *err);
void orbit_clear(struct orbit *orbit);

/*
 * The part of the FDK weight that changes with view and column only, so that
 *
 *   f(x) = sum over views of (D/depth(x))^2 * q(column(x), row(x)),
 *   q = ramp (pitch 1 pixel) along the row of (weight[view][column] * cos(gamma) * p)
 *
 * is Feldkamp's integral in 1/mm for any source radius R, any perpendicular
 * detector distance d and any turn of the detector about the source:
 *
 *   weight = 1/2 * angular weight * short-scan or displaced weight * R d / (pitch D^2),
 *
 * D = depth of the isocentre and d of the detector in the plane of row and central
 * ray, gamma = angle between the ray and the line from the source to the isocentre
 * (a change of variables in the fan-beam formula; for an untilted detector it is
 * the usual SDD / ray length and D^2/depth^2).
 * Parker: a ray and its conjugate sum to 2 when both are measured, and a ray that
 * is measured once has 2, however short the arc; 1 everywhere on a full turn.
 * Fan angles are those of the rays in the middle row about the rotation axis,
 * signed by the direction of the rotation. ret is [count][columns]. The orbit is not
 * turned: geometry_exchange goes first.
 */
void orbit_column_weights(const struct orbit *orbit, const struct geometry *geometry, float *ret_weights);

/* Counts the directions that the views look along; those within a degree of another or of its opposite are one with it.
 */
int orbit_directions(const struct orbit *orbit);

/*
 * False where FDK's densities are too low all over the volume, by hundreds of HU, as those of a short arc are, or the
 * rows along which it filters lean: such a volume says nothing of what iterations find. Real sweeps lack some degrees,
 * and that is at the rim: where it is up to 23 degrees, FDK is a better start of iterations than the model of the
 * exterior (tests/bench/results/exterior.txt).
 */
bool orbit_fdk_is_sound(const struct orbit *orbit);

/*
 * Weight of the view in FDK's density on the axis: its angular weight times the short-scan or displaced weight of its
 * ray through the axis.
 */
double orbit_axis_weight(const struct orbit *orbit, int view);

/*
 * A view about the orbit's centre in its frame, rows and columns exchanged where the detector is on its side, and the
 * geometry with the sides of that detector, its views those given and borrowed. For core/orbit*.c only.
 */
struct view orbit_view(const struct orbit *orbit, const struct view *view);
struct geometry orbit_sides(const struct orbit *orbit, const struct geometry *geometry);
/*
 * For core/orbit*.c only, too, and of that geometry: the angle of the ray through (column, middle row) of such a view
 * against the line from source to axis, counter-clockwise seen from +z; where the detector's middle row meets the axis,
 * mm along it from the centre, in the mean of all views, NAN where it does not; the field of view, the cylinder about
 * the centre that the detector's outer edges leave; the fan angle up to which a displaced detector sees both sides of
 * the axis in every view, negative where it does not see the axis.
 */
double orbit_ray_angle(const struct geometry *geometry, const struct view *view, double column);
double orbit_middle_row(const struct orbit *orbit, const struct geometry *geometry);
double orbit_field_of_view(const struct orbit *orbit, const struct geometry *geometry);
double orbit_overlap(const struct orbit *orbit, const struct geometry *geometry);
/* Sets the centre of an orbit described about the origin; true if it is beside that, so that all is to be described
 * again. */
bool orbit_find_centre(struct orbit *orbit, const struct geometry *geometry);

/* A place in the world from the centre, in the frame; and how far it is from the axis through the centre, mm. */
void orbit_from_centre(const struct orbit *orbit, const double place[3], double ret[3]);
double orbit_from_axis(const struct orbit *orbit, const double place[3]);
/* True in the field of view, whatever the height. */
bool orbit_is_in_view(const struct orbit *orbit, const double place[3]);

/*
 * A grid where none is given: cubic voxels at the resolution of the detector at the isocentre, coarsened so that no
 * side has more than `most` voxels, their slices where rows meet the axis and as high as those where they are higher;
 * across, the field of view, and along z all slices in which every view has the whole field of view on its rows, not
 * centred where the detector is not. One slice, where its plane meets the axis, for a detector of one row. An orbit
 * that leans so far that this leaves less than half of the height gets all slices that its axis meets where all views
 * see the field of view, and one whose views have next to no height in common the grid of orbit_covering_grid:
 * orbit_unseen_slices counts what some views do not see.
 */
void orbit_default_grid(const struct orbit *orbit, const struct geometry *geometry, int most, struct grid *ret_grid);
/*
 * The same about the orbit's centre and with all that the cone covers on the axis along z: the slices at its ends
 * are not seen by all views.
 */
void orbit_covering_grid(const struct orbit *orbit, const struct geometry *geometry, int most, struct grid *ret_grid);
/*
 * How many slices of a grid, from its first and from its last one on, have a place of the field of view that is not on
 * the rows of every view: FDK is too low there.
 */
int orbit_unseen_slices(const struct orbit *orbit, const struct geometry *geometry, const struct grid *grid,
			int ret_slices[2], struct error *err);

#endif

#ifndef CBCT_CORE_CALIBRATE_H
#define CBCT_CORE_CALIBRATE_H

#include <stdbool.h>

#include "core/error.h"
#include "core/scan/geometry.h"

/*
 * Where source and detector of an arm stood in each view of a sweep, from the shadows of balls whose places are known.
 *
 *   shadows.c  background, candidates, and for each the centroid of its shadow            (an image -> shadows)
 *   blur.c     whether a detector blurs them
 *   match.c    which shadow is of which ball: votes with the nominal geometry             (shadows -> pairs)
 *   lean.c     a phantom that leans
 *   resect.c   a view from its pairs: RANSAC over the normalised DLT                      (pairs -> a first pose)
 *   pose.c     a view's nine numbers by Levenberg-Marquardt                               (pairs -> pose)
 *   certainty.c  what a view's shadows leave open of its pose
 *   touching.c shadows that touch, fitted together, where few stand clear          (an image, a pose -> pairs)
 *   view.c     all of these for each view
 *   bundle.c   all views and the balls' own places at once, where that is asked for
 *   diameters.c  the balls' diameters against the drawing's
 *   presence.c  balls that were never seen, shadows that are of none
 *   motions.c  places at which a phantom looks the same
 *   placing.c  which of these is each view's, and that of all
 *   follow.c   views that look the same from another side
 *   sweep.c    views that do not follow their neighbours; poses between calibrated ones
 *
 * The world's frame of the result is the one that the balls' coordinates are given in: with the phantom's axis on the
 * arm's rotation axis it is the contract's. The nominal geometry only has to be right to some degrees and some
 * centimetres; nothing in the result is drawn towards it or towards neighbouring views.
 *
 * Pixels are square to each other and their pitch is known, so that a view has nine unknowns: the source (3), the
 * detector's place (3) and its three turns.
 */

struct ball {
	double centre[3]; /* mm */
	double diameter;  /* mm */
};

struct balls {
	int count;
	struct ball *ball; /* [count], owned */
};

enum { BALLS_LEAST = 8, BALLS_MOST = 512 };

/* Circles of balls about z, in planes across it; those of odd circles stand `shift` further on. */
struct ball_circles {
	int circles, balls; /* of each circle */
	double diameter;    /* mm, of the circles */
	double distance;    /* mm, between neighbouring circles along z; centred on the isocentre */
	double ball;        /* mm, diameter of a ball */
	double first;       /* radians, of ball 0 */
	double shift;       /* radians */
};

/*
 * Balls on a helix about z, centred on the isocentre. `large`: which of them are the large ones, the code by which a
 * ball is known wherever the phantom was put down; NULL: all have the first diameter.
 */
struct ball_helix {
	int balls;
	double diameter, pitch; /* mm, of the helix; mm along z for a turn */
	double first, step;     /* radians, of ball 0 and from ball to ball */
	double ball[2];         /* mm, diameters: small, large */
	const bool *large;      /* [balls] */
};

/*
 * Each allocates ret->ball (free with balls_clear) and checks the phantom: ERR_INVALID for numbers that are no lengths
 * or a number of balls out of range, ERR_IMPOSSIBLE for balls that overlap, lie on a line or in a plane, and for codes
 * that read the same backwards: a view cannot be found from these. Pointers are those of the phantom's JSON.
 */
int balls_copy(struct balls *ret_balls, const struct ball *ball, int count, struct error *err);
int balls_circles(struct balls *ret_balls, const struct ball_circles *circles, struct error *err);
int balls_helix(struct balls *ret_balls, const struct ball_helix *helix, struct error *err);
void balls_clear(struct balls *balls);

/*
 * Writes the line integrals of a view, [row][column], all finite. Called from several threads at once, for any view
 * in any order.
 */
typedef int calibrate_image(void *context, int view, float *ret_image, struct error *err);

struct calibrate_request {
	const struct geometry *nominal; /* the scan's own; borrowed */
	const double *pixel_mm;         /* [2] */
	const struct balls *balls;      /* borrowed */
	bool adjust_balls;              /* the balls' places, too: errors of machining drop out */
	calibrate_image *image;
	void *context;
};

struct calibrated_view {
	struct view view; /* of a view that is not used: between its neighbours' */
	bool used;
	int shadows;          /* that look like a ball's */
	int balls;            /* whose shadows were used */
	double rms, worst;    /* pixels; of a refused view, as far as it could be fitted: 0 when not at all */
	double rms_isocentre; /* mm */
	char refused[192];    /* one sentence with the numbers, "" when used */
};

/* Views that are used and should show a ball clear of others', and those of them in which its shadow was. */
struct ball_presence {
	int expected, found;
	int sized,
	    unlike; /* views in which it stands clear and a shadow is in its place; in which that has another size */
};

struct calibration {
	int count, used;                /* views */
	struct calibrated_view *views;  /* [count], owned */
	struct balls balls;             /* as they are, or as they were adjusted; owned */
	struct ball_presence *presence; /* [balls.count], owned */
	int strays, stray_views;        /* shadows like a ball's that are of no ball, and views with such a one */
	double rms, rms_isocentre;      /* pixels, mm: over all shadows used */
	double turn;                    /* radians about z by which the phantom stood turned against its drawing */
	/*
	 * By how much the phantom could as well stand turned further, radians, or further along z, mm: balls of one
	 * size at equal steps look the same, and so do like circles where not all are in the picture. The place nearest
	 * to the nominal geometry was taken. 0: no other fits.
	 */
	double rival_turn, rival_height;
	double diameter_ratio; /* median of shadow's to expected diameter */
	double diameter_error; /* of this ratio: what noise and blur leave open */
	double explained;      /* mm at the isocentre, of rms_isocentre, that noise and centring may make up */
	double distance_ratio; /* of the sources' mean distance to the nominal one, from z or the arm's axis: nearer to
				  1 */
	/*
	 * Of this ratio: the standard deviation of the views' own, of which noise goes out of the mean with their
	 * number. An arm that sags, and a phantom beside the axis, which over a short sweep has most sources on its one
	 * side, make views differ; what they have in common may be as large.
	 */
	double distance_error;
	/*
	 * Pixels and mm, RMS over the balls and views: how far views that are used stand from where views that are not
	 * used are put, by neighbours as far away as those of the longest run of these have them. 0: not known.
	 */
	double between, between_isocentre;
	double adjusted_rms; /* mm, by which balls were moved; 0 unless asked for */
};

/*
 * Allocates ret->views, ret->balls.ball and ret->presence; free with calibration_clear. ERR_IMPOSSIBLE with the
 * numbers: pictures without shadows or of counts, another phantom, another diameter, or more than a quarter of the
 * views refused. Uses all threads; the same images give the same bits for any number of them.
 */
int calibrate(struct calibration *ret_calibration, const struct calibrate_request *request, struct error *err);
void calibration_clear(struct calibration *calibration);

/*
 * The views of another sweep of the same arm, by the angles of its sources: poses between those of the calibrated
 * views, linear in source, detector and turns, each in its own nominal frame. `nominal` is the sweep that was
 * calibrated, `views` what was found for it, `angles` [count] in radians modulo a full turn. Allocates
 * ret_geometry->views. ERR_IMPOSSIBLE for an angle more than half a degree, or half a step, beyond the sweep's ends.
 */
int calibration_between(struct geometry *ret_geometry, const struct geometry *nominal, const struct view *views,
			const double *angles, int count, struct error *err);

/*
 * Where a ball's shadow lies in a view: its centroid in pixels. Returns its radius in pixels; 0 for a ball behind the
 * source, whose ret_pixel is not set.
 */
double ball_shadow(const struct view *view, const struct ball *ball, double ret_pixel[2]);

#endif

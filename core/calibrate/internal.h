#ifndef CBCT_CORE_CALIBRATE_INTERNAL_H
#define CBCT_CORE_CALIBRATE_INTERNAL_H

#include <stddef.h>

#include "core/calibrate/calibrate.h"

/* ---- dense.c: small dense systems, row by row ---- */
/*
 * a = L L^T in place, of which only the lower triangle is read and written; a is symmetric. Negative when a is not
 * positive definite.
 */
int dense_cholesky(double *a, int n);
/* x := (L L^T)^-1 x */
void dense_solve(const double *l, int n, double *x);
/* Eigenvalues of a symmetric 3x3, largest first. */
void dense_eigenvalues(const double a[3][3], double ret_values[3]);

/* ---- balls.c ---- */
/* RMS extents of the balls' places in three directions across each other, mm, the largest first. */
void balls_extent(const struct balls *balls, double ret_extent[3]);
/* "on a line", "in a plane" or, for extents in three directions, "". */
const char *balls_flat(const double extent[3]);

/* ---- shadows.c ---- */
/* What a ball's shadow looks like: its chords, or, where a detector blurs them, a bell. */
enum shape { SHAPE_CHORDS, SHAPE_BELL, SHAPES };

struct shadow {
	double column, row; /* pixels: centroid of the line integrals above the background */
	double radius;      /* pixels, of the ball that has this second moment */
	double height;      /* at the centre, line integral above the background */
	double as[SHAPES];  /* share of the variance that a shape explains */
	double likeness;    /* of these that of the scan's shape */
};

enum { SHADOWS_MOST = 768 };

struct shadow_scale {
	double small, large; /* pixels: expected radii of the smallest and of the largest ball's shadow */
};

/* Scratch of one thread for images of one size. */
struct shadow_finder;
struct shadow_finder *shadow_finder_open(int columns, int rows, const struct shadow_scale *scale);
struct shadow_finder *shadow_finder_free(struct shadow_finder *finder);

/* Statistics of a picture; they tell why one has no shadows. */
struct shadow_facts {
	double median, noise; /* of the picture's line integrals and of its background's residual */
	double highest;       /* above the background */
	int candidates;       /* bumps above the noise, of any shape */
};

/* Writes at most SHADOWS_MOST shadows that have either shape, each maybe twice, and returns how many, highest first. */
int shadows_find(struct shadow_finder *finder, const float *image, struct shadow *ret_shadows,
		 struct shadow_facts *ret_facts);
/* Keeps those of a shape, each once; returns how many. */
int shadows_keep(struct shadow *shadows, int count, enum shape shape);

/* ---- pose.c ---- */
struct pose {
	double source[3];   /* mm */
	double axes[3][3];  /* unit vectors along columns' step, rows' step, and their cross product */
	double detector[3]; /* mm, of pixel 0, 0 from the source along the axes */
};

void pose_of_view(struct pose *ret_pose, const struct view *view);
void pose_view(const struct pose *pose, const double pixel_mm[2], struct view *ret_view);
/* Pixel coordinates of a point, and pixels for a millimetre across there; 0 for a point behind the source. */
double pose_project(const struct pose *pose, const double pixel_mm[2], const double point[3], double ret_pixel[2]);
/*
 * Where the centroid of a ball's shadow lies: its centre's projection and the part by which the ellipse's is further
 * out. Returns the radius in pixels, of the circle that has the ellipse's area.
 */
double pose_shadow(const struct pose *pose, const double pixel_mm[2], const struct ball *ball, double ret_pixel[2]);

/* A ball and its shadow in one view. */
struct pair {
	int ball;
	int shadow;              /* its index in the view's list; -1: fitted together with others (touching.c) */
	double pixel[2], radius; /* of its shadow */
	double sigma;            /* pixels, of either coordinate, by the picture's noise; of a fitted one alone */
	double blur;             /* pixels, standard deviation, beside a pixel's own side; of a fitted one alone */
};

/* Residuals' Jacobian of a ball in a view: by the pose's nine steps and by the ball's place. */
struct pose_row {
	double residual[2]; /* measured - modelled, pixels */
	double pose[2][9];  /* d modelled / d (source, turns, detector) */
	double place[2][3]; /* d modelled / d place */
};
void pose_row(const struct pose *pose, const double pixel_mm[2], const struct ball *ball, const double pixel[2],
	      struct pose_row *ret_row);
/* Moves a pose by nine steps: source in mm, turns in radians about its axes, detector in mm along them. */
void pose_step(struct pose *pose, const double step[9]);
/* Levenberg-Marquardt over one view; the pose is moved to the least sum of squares. Returns the RMS in pixels. */
double pose_fit(struct pose *pose, const double pixel_mm[2], const struct balls *balls, const struct pair *pairs,
		int count);
double pose_rms(const struct pose *pose, const double pixel_mm[2], const struct balls *balls, const struct pair *pairs,
		int count, double *ret_worst);

/* ---- certainty.c ---- */
/* Standard deviations for a noise of one pixel in each of a shadow's coordinates; INFINITY: not determined at all. */
struct certainty {
	double pixels;   /* of where the view has the phantom's balls, RMS over all of them */
	double distance; /* mm, of its source from the isocentre */
};
/* Pixels, of a shadow's either coordinate, that are left of `count` shadows by a pose's nine numbers with this RMS. */
double noise_of(double rms, int count);
struct certainty certainty_of(const struct pose *pose, const double pixel_mm[2], const struct balls *balls,
			      const struct pair *pairs, int count);

/* ---- resect.c ---- */
/*
 * A first pose by RANSAC over the normalised DLT; pairs that do not agree with it are dropped from the list, ret_count
 * is how many are left. Negative when no six of the pairs say where the view stood.
 */
int resect(const struct balls *balls, struct pair *pairs, int count, const double pixel_mm[2], unsigned seed,
	   struct pose *ret_pose, int *ret_count);

/* ---- match.c ---- */
/* The shadows of a view, and where the nominal geometry expects each ball. */
struct match_view {
	const struct shadow *shadows;
	int count;
	struct pose nominal;
	int columns, rows;
	double blur; /* pixels, of run.blur */
};

/* Pairs of shadows and balls, the phantom turned about z by an angle; returns their number, at most balls->count. */
int match_view(const struct match_view *view, const double pixel_mm[2], const struct balls *balls, double turn,
	       struct pair *ret_pairs);
/* The pairs under a pose: for each ball the nearest shadow within `reach` pixels whose nearest ball it is. */
int match_pose(const struct match_view *view, const struct pose *pose, const double pixel_mm[2],
	       const struct balls *balls, double reach, struct pair *ret_pairs);
/*
 * The angle about z by which the phantom stood turned, to a few degrees: of those under which poses explain about as
 * many balls' shadows of some views as under any, the smallest; and how many those are.
 */
int match_turn(const struct match_view *views, int count, const double pixel_mm[2], const struct balls *balls,
	       double *ret_turn, int *ret_explained, struct error *err);

/* ---- touching.c ---- */
/*
 * The places of balls' shadows that touch, from a pose that has each within about a radius of its own: each with those
 * beside it, by what their thicknesses together let through. Writes a pair, of no shadow in the view's list, for each
 * ball that is wholly on the picture, of this shape, and whose place the picture determines; returns how many.
 */
int touching_fit(const struct match_view *view, const float *image, const struct pose *pose, const double pixel_mm[2],
		 const struct balls *balls, struct pair *ret_pairs);

/* ---- lean.c ---- */
/*
 * How a phantom leans under which poses explain surely more of its shadows than so many, and the turn it has then:
 * allocates ret_stands->ball, which is NULL where none does.
 */
struct run;
int lean_find(const struct run *run, int upright, struct balls *ret_stands, double *ret_turn, struct error *err);

/* ---- motions.c ---- */
enum { MOTIONS_MOST = 48 };

/* A turn about z, radians, and a way along it, mm, under which many of a phantom's balls are others of them. */
struct motion {
	double turn, along;
	double way; /* mm, of a ball, RMS */
	bool whole; /* all balls are others then: nothing in a picture tells of it */
};

/* The first is none at all; then by their ways. */
struct motions {
	struct motion motion[MOTIONS_MOST];
	int count;
};

int motions_of(const struct balls *balls, struct motions *ret_motions, struct error *err);
/* A view's pose that sees the same of the phantom, each ball in the place of the one that the motion moves there. */
void pose_move(struct pose *pose, const struct motion *motion);

/* ---- bundle.c ---- */
struct bundle_view {
	struct pose *pose;
	const struct pair *pairs;
	int count; /* 0: not used */
};
/*
 * All poses and all balls' places at once; the drawing is known to `drawing` mm, which also fixes the frame. Poses and
 * balls are moved.
 */
int bundle_fit(const struct bundle_view *views, int count, const double pixel_mm[2], struct balls *balls,
	       double drawing, struct error *err);

/* ---- view.c ---- */
enum { PAIRS_LEAST = 7 }; /* of a view: nine unknowns, and some balls to hold them against */
enum { RMS_MOST = 1 };    /* pixels, of a view */

/* Findings in one view while the scan is calibrated. */
struct work {
	struct shadow *shadows; /* [count], owned */
	struct shadow_facts facts;
	struct pair *pairs; /* [pair_count], owned, of as many as there are balls */
	int count, pair_count;
	struct pose pose;
};

struct run {
	const struct calibrate_request *request;
	struct calibration *calibration;
	struct work *works;         /* [views] */
	struct match_view *matches; /* [views] */
	struct motions motions;     /* of the drawing */
	const struct balls *stands; /* as the drawing, or leaning: where views begin from; borrowed */
	double least, most;         /* mm, the balls' diameters */
	double blur;                /* pixels, standard deviation: of a detector that blurs the balls, about; else 0 */
};

/* ---- blur.c ---- */
/*
 * Keeps of each view's shadows those of the shape that the scan's have, `scale` the radii that are expected, and takes
 * from their radii what the detector's blur adds. Writes run->blur.
 */
int blur_measure(struct run *run, const struct shadow_scale *scale, struct error *err);

/* Pose and pairs of each view that can be used, the phantom turned about z by an angle; of the others the reason. */
int find_views(struct run *run, double turn, struct error *err);
/* Finds views anew that are used, each from a pose of `poses`, of which those with `moved` are. */
int find_moved(const struct run *run, const struct pose *poses, const bool *moved, struct error *err);
/* How many views are used. */
int views_used(const struct calibration *calibration);
/* Residuals of a view that has its pose and pairs. */
void measure_view(const struct run *run, int view);

/* ---- diameters.c ---- */
/* What shadows tell of the balls, by some of the views that are used. */
struct diameters {
	double ratio; /* of the shadows' diameters to the expected ones: the median */
	double error; /* of the ratio: noise, and what no fit can tell from the detector's blur */
	double noise; /* pixels: by how much the picture's noise moves a shadow, RMS */
};
/* There is a view that is used. */
int diameters_measure(const struct run *run, struct diameters *ret, struct error *err);

/* ---- presence.c ---- */
/* Writes calibration->presence, strays and stray_views, by the views that are used. */
void presence_count(struct run *run);
/*
 * What a view shows that a pose does not explain: balls of which nothing is where they should stand clear on the
 * picture, and shadows that are of none.
 */
int presence_unexplained(const struct run *run, int view, const struct pose *pose);
/* Of these the shadows alone, and those of another size than the ball has that is there. */
int presence_strays(const struct run *run, int view, const struct pose *pose);

/* ---- sweep.c ---- */
enum { STRAY_LEAST = 1 }; /* mm at the detector: below it no view strays from its neighbours */
/* A view's place in the order of the angles. */
struct station {
	double angle; /* radians, -pi to pi, of its nominal source */
	int view;
};
/* Radians from a direction on to another, 0 to 2 pi. */
double onward(double from, double to);
/* All views in that order, the caller's to free; NULL: no memory. */
struct station *stations_of(const struct geometry *nominal);
/*
 * Where the sweep begins among its stations: behind its widest gap, the opening of a short scan; of gaps as wide behind
 * the one between views that are farthest from each other in the list, where a full turn ends as it began.
 */
int first_station(const struct station *stations, int count);
/*
 * Distance of the balls' shadows under one pose from where they are under another: RMS, pixels; and, unless that is
 * NULL, their mean way there.
 */
double poses_apart(const struct balls *balls, const double pixel_mm[2], const struct pose *a, const struct pose *b,
		   double ret_mean[2]);
/* Turns source and detector about z. */
void pose_turn(struct pose *pose, double angle);
/* The arm's axis in the drawing's world: a phantom may stand beside it, and lean. */
struct axis {
	double frame[3][3]; /* its x, y and z, unit vectors, the last along it */
	double at[2];       /* mm along these x and y, where it stands */
};
extern const struct axis axis_z; /* the drawing's */
void pose_turn_about(struct pose *pose, const struct axis *axis, double angle);
/* A view's source, in the order of the sweep. */
struct source {
	double angle, place[3]; /* radians, nominal; mm */
};
/*
 * The axis goes along the median normal of three sources each, through the median of the points about which sources
 * turn from a view to the next by their nominal angle: the arm sags, and views may stand elsewhere about the phantom.
 * Where such normals have no median direction, along z.
 */
int arm_axis(const struct source *sources, int count, struct axis *ret_axis, struct error *err);
/* That of the views that are used. */
int axis_of(const struct calibration *calibration, const struct geometry *nominal, struct axis *ret_axis,
	    struct error *err);
/* mm, across it. */
double axis_distance(const struct axis *axis, const double place[3]);
/*
 * Refuses views that do not follow their neighbours: from the shift of the balls' shadows against the nominal
 * geometry, which is smooth over a sweep.
 */
int sweep_refuse(struct calibration *calibration, const struct calibrate_request *request, struct error *err);
/* What each view would be were it not used: between its neighbours that are; where none is, as it is. */
int sweep_between(const struct calibration *calibration, const struct geometry *nominal, struct view *ret_views,
		  struct error *err);
/* Gives views that are not used the pose between their neighbours'. */
int sweep_fill(struct calibration *calibration, const struct geometry *nominal, struct error *err);
/* What poses between neighbours are worth, by those that are used: calibration->between and between_isocentre. */
int sweep_error(struct calibration *calibration, const struct calibrate_request *request, struct error *err);

/* ---- placing.c ---- */
/*
 * Of the places at which a phantom looks the same, each view's and that of all views. Moves views, refuses those of
 * which it is not known, and turns *turn, by which the phantom stands, with them.
 */
int place_views(struct run *run, double *turn, struct error *err);

/* ---- follow.c ---- */
/*
 * Refuses views whose poses are far from the nominal geometry's, the phantom turned about z by an angle, or leap from
 * those of the most views that follow each other.
 */
int follow_refuse(struct calibration *calibration, const struct calibrate_request *request, double turn,
		  struct error *err);

#endif

#ifndef CBCT_CORE_CORRECT_AVERAGING_H
#define CBCT_CORE_CORRECT_AVERAGING_H

#include <stddef.h>

#include "core/recipe.h"
#include "core/scan/grid.h"
#include "core/scan/orbit.h"

/*
 * Projections whose pixels are much finer than the grid's voxels, averaged before iterations, where they show more
 * than the grid can hold.
 *
 * An iterative method takes the object for what linear interpolation makes of the voxels. The rays of fine pixels show
 * what no such object has: edges within a voxel. The voxels then overshoot beside bone, more with every iteration. FDK
 * needs no averaging: its filter's window does this. An object that is smooth on the scale of a voxel is only blurred
 * by a mean, so that the projections themselves decide.
 *
 * The decision. D(L) is the mean square of the second differences p(u - L) - 2 p(u) + p(u + L) along the detector's
 * rows, that of structure: each is multiplied by the same of the next row, which shares the object but not the noise.
 * Projections of edges have a power spectrum that falls with the third power of the frequency: D goes with L^2, and
 * D(v/2) / D(v) is 1/4, v being the voxel. Projections of linear interpolation have kinks at the voxels' distance
 * and nothing finer: D goes with L^3, the ratio is 1/8. Measured, for 1e3 photons in a pixel to no noise and 2.2 to 5
 * pixels a voxel: objects of voxels .119 to .137, the abdomen of a real CT on its own grid .105 to .122, on one three
 * times as coarse .227; heads, necks, wrists and abdomens with edges .17 to .30 (tests/bench/results/denoise.txt).
 */

/*
 * Iterations that settle. Pixels from 1.2 a voxel on show edges that voxels cannot hold, too few of them to average.
 * What iterations make of them is best at the second to the sixth, and overshoots from then on. The change of later
 * iterations is halved with every ten updates: 3 to 5 % of error beside the best iteration in place of 10 to 60 %
 * (tests/bench/results/denoise.txt). Where pixels are averaged, the pixels that are left in a voxel count.
 *
 * The decision. At less than four pixels a voxel, D is known at one pixel and at two, and D(1) / D(2) of an object of
 * voxels depends on their size, as two pixels may be more than a voxel. Measured: objects of voxels .185 to .12 for
 * 1.3 to 2.5 pixels a voxel, the abdomen of a real CT .14 to .12, on a grid twice as coarse .19 to .15; anatomies with
 * edges .21 to .38.
 */
#define SETTLING_NONE 1.2

/*
 * The mean. The volume's linear interpolation c converges to the projections of the object, hat * c = k * f, k being
 * the mean over pixels; what an image shows is the mean over voxels, box * f. In second moments, a voxel's width being
 * 1, hat has 1/6 and box 1/12: both agree where k has 1/4, three boxes of a voxel. Ten iterations do not converge, and
 * an image that is a little sharper is nearer to the truth: two boxes of .85 voxel, at any number of pixels a voxel.
 * TV with explicit numbers lowers what is narrow by as much as iterations overshoot there, and keeps one box
 * (tests/bench/results/denoise.txt).
 */
struct averaging_mean {
	double none, full; /* pixels a voxel: up to `none` there is no mean, from `full` on it has its width */
	double voxels;     /* its width */
	int passes;        /* it is taken so many times */
};
struct averaging_mean averaging_mean(const struct recipe *recipe);

/*
 * The mean of the default, SART with TV that finds its strength (recipe_averages). From 1.2 pixels a voxel on, edges
 * that are tilted against the rows look as an object of voxels does, and iterations overshoot at them until they are
 * worse than FDK: skulls, heads, soft bodies. A mean that is taken where none was needed costs such iterations less
 * than that, and leaves them better than FDK: the default has it wherever projections do not show an object of voxels,
 * which they can from 2 pixels a voxel on. It is known by its variance, the smaller the less voxels would overshoot.
 * TV takes out what noise is, and with a wide mean what little of the object stands above it.
 *
 * Its variance in voxels' squares, that of both passes together. ratio: averaging_ratio, or averaging_own_ratio where
 * that is more; 0 where either is hidden by noise, since rows of a body whose outline is tilted everywhere look as
 * those of voxels beside each other: then the mean is taken, and from 2.2 pixels a voxel on as wide as without noise;
 * noise: the share of the power of second differences that is noise, 0 .. 1; edges: settling_share, where neighbouring
 * pixels show edges that are not tilted, the mean is narrower up to 2 pixels a voxel; shells: shells_share, where bone
 * is thinner than voxels can hold it is as wide as with finer pixels. 0: no mean.
 */
double averaging_variance(double pixels, double ratio, double noise, double edges, double shells);
/* How far pixels are so fine that FDK has edges as sharp as voxels can hold, 0 .. 1: nothing up to 2 pixels a voxel. */
double averaging_sharpness(double pixels);
/*
 * Beside the model of the exterior the mean is not of what that has in the grid. How much of that is the model's own
 * mean over voxels, 0 .. 1: nothing up to 2 pixels a voxel, nor where half of the power of second differences is noise,
 * for TV blurs there.
 */
double averaging_model_share(double pixels, double noise);
/* Whether voxels of so many pixels may get that mean, 0 .. 1. */
double averaging_part(double pixels);
/* The width, 1 .. 9 pixels, of a mean (stack_average) of this variance in pixels' squares. */
double averaging_width(double variance);

/* Ratios D(v/2) / D(v) up to which an object is the grid's, and from which on it has edges. */
#define AVERAGING_SMOOTH 0.145
#define AVERAGING_SHARP 0.165

/* Voxels' sizes in pixels at the isocentre: across the orbit's axis, as columns go, and along it, as rows go. */
void averaging_pixels(const struct orbit *orbit, const struct grid *grid, double ret_pixels[2]);
/* 0 up to mean->none pixels, 1 from mean->full on, and linear between them. */
double averaging_fineness(const struct averaging_mean *mean, double pixels);

/* Sums over pairs of rows: of products of second differences, and of the squares of these products. */
struct averaging_sums {
	struct averaging_sum {
		double product, square;
		size_t count;
	} of_rows[2], own; /* one and two apart; each row with itself, which has the noise */
};
/*
 * Adds one view's, [row][column], at a distance of `apart` columns, from every row_step-th row on; pairs with NaN are
 * left out. The same bits for any number of threads. ERR_NO_MEMORY.
 */
int averaging_add(const float *view, int columns, int rows, int row_step, int apart, struct averaging_sums *sums,
		  struct error *err);
/*
 * D(pixels / 2) / D(pixels) from D at whole distances: sums[i] at averaging_distances' i-th. The larger of what rows
 * one apart say and what, with those two apart, rows 0 apart would. 0 where noise hides it, or where there is nothing.
 */
enum { AVERAGING_DISTANCES = 4 };
void averaging_distances(double pixels, int ret_distances[AVERAGING_DISTANCES]);
double averaging_ratio(double pixels, const struct averaging_sums sums[AVERAGING_DISTANCES]);
/*
 * Whether what there is of strong contrast are thin shells, 0 .. 1: a skull of 1.5 voxels. Both of its edges overshoot
 * into each other, and ten iterations on means that suit single edges are worse than FDK. D grows with L^2 where edges
 * are further apart than L, and hardly where a second edge undoes the first: D(4v) / D(2v) is 4 and more for single
 * edges and thick shells. sums[i] at shells_distances' i-th, two and four voxels with the whole distances around them.
 * 0 where noise hides it.
 */
enum { SHELL_DISTANCES = 4 };
void shells_distances(double pixels, int ret_distances[SHELL_DISTANCES]);
double shells_share(double pixels, const struct averaging_sums sums[SHELL_DISTANCES]);
/*
 * The same where neighbouring rows say little: outlines that are tilted everywhere, as a ball's. From each row with
 * itself, less half of what noise of this variance adds, so that it is rather too large; 0 where that is not little.
 */
double averaging_own_ratio(double pixels, const struct averaging_sums sums[AVERAGING_DISTANCES], double noise2);
/* Share of a voxel's width, 0 .. 1, over which the mean goes. */
double averaging_share(double ratio);

/* Whether there are edges within voxels, 0 .. 1, from D(1) and D(2); 0 where noise hides it. */
double settling_share(double pixels, const struct averaging_sums sums[2]);
/*
 * Iterations of ten updates after which the change falls; INFINITY: never. averaged: the share of a voxel's width, 0 ..
 * 1, over which a mean went.
 */
double settling_after(double pixels, double averaged, double share);
/* The same in iterations of so many updates. The first two bring most of what there is, and stay whole. */
double settling_from(double after, double updates);
/* Returns the share of an iteration's change that is kept; iterations count from 1. */
double settling_relaxation(int iteration, double after, double updates);

#endif

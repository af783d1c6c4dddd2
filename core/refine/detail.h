#ifndef CBCT_CORE_DETAIL_H
#define CBCT_CORE_DETAIL_H

/* What images of one size, [row][column], show between two sizes. Any thread. */
enum { DETAIL_REACH_MOST = 24 }; /* bins on either side of one that a Gaussian takes in */

/* Smooths with a Gaussian of standard deviation `sigma`, at most DETAIL_REACH_MOST / 3; the edge's value goes on beyond
 * it. work: an image. */
void image_smooth(const float *from, int columns, int rows, double sigma, float *work, float *ret_to);
/* The difference of two Gaussians; ret_to may be `from`. work: three images. */
void image_detail(const float *from, int columns, int rows, double fine, double coarse, float *work, float *ret_to);

#endif

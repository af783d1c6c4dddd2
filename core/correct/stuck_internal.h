#ifndef CBCT_CORE_CORRECT_STUCK_INTERNAL_H
#define CBCT_CORE_CORRECT_STUCK_INTERNAL_H

#include "core/correct/stuck.h"

/* What the files that look for stuck pixels share: stuck.c, which adds up the views, stuck_pixel.c, which decides. */

enum { NEIGHBOURS = 8, AWAY = 2, SUMS = 8 };
#define STUCK_MOST 0.1 /* of all pixels */

/*
 * Over the views looked at, [row][column] each, so that many pixels are added at once; p counts from the first view
 * that a pixel is good in, so that rounding leaves no variance.
 */
struct sums {
	float *views; /* those that the pixel is good in */
	float *first, *p, *p2;
	float *e, *e2, *magnitude; /* of e */
	float *beyond2;            /* squares of what p lies beyond all of its neighbours by */
	float *all;                /* the memory of these */
};

struct stuck {
	const struct linearise *linearise;
	const struct geometry *geometry;
	int views;
	struct sums sums;
	float *values;  /* [row][column], line integrals of a view */
	float *medians; /* [row][column], of each pixel's neighbours in the view */
	float *beyond;  /* [row][column], what the pixel lies beyond all of them by, 0 within their range */
	float *good;    /* [row][column], of the view: 1; 0 where the pixel says nothing */
	bool *some_bad; /* [row], of the view */
	unsigned char *map;
	float largest;         /* line integral */
	bool tells_dead;       /* a pixel that never changes is none of the object's */
	struct beside *beside; /* NULL: the caller's thread does it all */
};

/* The pixels around one: row, column. */
extern const int stuck_around[NEIGHBOURS][2];
/* 1: a pixel has no neighbours before it in its row or column; -1: none behind it; 0: both. */
int stuck_edge(int index, int count);
void stuck_neighbours(const struct geometry *geometry, int column, int row, size_t ret[NEIGHBOURS]);
void stuck_sort(float values[NEIGHBOURS], int count);

/* False where many pixels never change: in a scan without noise those in air do not, nor what is round. */
bool stuck_tells_dead(const struct stuck *stuck);
bool stuck_is(const struct stuck *stuck, int column, int row);

#endif

#ifndef CBCT_CORE_CORRECT_MISPLACED_INTERNAL_H
#define CBCT_CORE_CORRECT_MISPLACED_INTERNAL_H

#include "core/correct/misplaced.h"

/* What the files that look for misplaced views share: misplaced_order.c, which puts them in order, and misplaced.c,
 * which compares them and finds single ones. */

enum { MISPLACED_PIECES = 96 }; /* of the ring, at most */

/* The views that stand in a row along the ring. */
struct search {
	const struct ring *ring;
	const struct view_strips *strips; /* [views] */
	int samples[2];
	double gap;    /* radians from a view to the next, in the mean */
	double least;  /* squares: what is usual is no less, */
	double faint;  /* and what is off by no more than this is little beside what views show */
	int *views;    /* [count], of the places in the order that was found so far */
	double *apart; /* [count], of a place from the next, mean squares */
	double *usual; /* [count] */
	int *work;     /* [count] */
	double *costs; /* [MISPLACED_PIECES][MISPLACED_PIECES] */
	bool *out;     /* [count], places whose view does not belong there */
	bool *known;   /* [count], places that were looked at */
	bool *sure;    /* [count], of those that are out */
};

/* How far a view is off another one, a squared mean. */
double misplaced_apart(const struct search *search, int a, int b);
/* What a third of the values about each place do not exceed, itself excepted, and no less than what rounding makes.
 * values: [count], squares. */
void misplaced_usual(const struct search *search, const double *values, double *ret);
/* Puts the views in order, as far as one is found. */
void misplaced_order(const struct search *search);

#endif

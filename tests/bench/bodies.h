#ifndef CBCT_TESTS_BODIES_H
#define CBCT_TESTS_BODIES_H

#include <stdint.h>

#include "core/scan/phantom.h"

/*
 * Heads, truncated abdomens, knees with screws, even cylinders and hands, of ellipsoids, cylinders and boxes with exact
 * line integrals. One thread at a time, but for body_take, which has its own.
 */
enum { BODY_PARTS_MOST = 256 };
struct body {
	struct ellipsoid parts[BODY_PARTS_MOST];
	int count;
};

enum kind { HEAD, ABDOMEN, KNEE, HEAD_AND_NECK, EVEN, HAND, KINDS };
extern const char *const kind_names[KINDS];
#define BODY_WATER 0.0192 /* 1/mm */

void make_body(struct body *body, enum kind kind, int seed);
/* One picture, the means of four rays through a pixel, as counts add up. */
void body_take(struct body *body, const struct view *view, int columns, int rows, float *ret_picture);

/* Random numbers: splitmix64 (Steele, Lea and Flood 2014), and normal ones. */
void random_seed(uint64_t seed);
double uniform(void);
double normal(void);

#endif

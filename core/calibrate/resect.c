/*
 * A view from pairs of balls and shadows: RANSAC (Fischler and Bolles 1981) over the normalised direct linear
 * transform (Hartley and Zisserman, Multiple View Geometry, 7.1). The eigenvector of A^T A to its least eigenvalue is
 * found by inverse iteration; Levenberg-Marquardt makes up afterwards for what the normal equations lose.
 */
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "core/calibrate/internal.h"

enum { SAMPLE = 6, TRIES_MOST = 300, INVERSE_STEPS = 8 };
static const double REACH = 2.5;   /* pixels, within which a pair agrees with a matrix */
static const double MISSED = 1e-4; /* probability that no sample was of good pairs only */

/* Shift and scale that bring points to mean 0 and RMS distance sqrt(dimension). */
struct scaling {
	double mean[3], scale;
};

static struct scaling scaling_of(const double (*points)[3], int count, int dimension)
{
	struct scaling s = {{0}, 1};
	double squares = 0;

	for (int i = 0; i < count; i++)
		for (int a = 0; a < dimension; a++)
			s.mean[a] += points[i][a] / count;
	for (int i = 0; i < count; i++)
		for (int a = 0; a < dimension; a++)
			squares += (points[i][a] - s.mean[a]) * (points[i][a] - s.mean[a]);
	s.scale = squares > 0 ? sqrt(dimension * count / squares) : 1;
	return s;
}

/* p of the scaled points becomes that of the points themselves. */
static void undo_scaling(const struct scaling *world, const struct scaling *picture, const double p[12],
			 double ret_matrix[12])
{
	double half[12];

	for (int row = 0; row < 3; row++) {
		half[4 * row + 3] = p[4 * row + 3];
		for (int a = 0; a < 3; a++) {
			half[4 * row + a] = p[4 * row + a] * world->scale;
			half[4 * row + 3] -= half[4 * row + a] * world->mean[a];
		}
	}
	for (int k = 0; k < 4; k++) {
		ret_matrix[8 + k] = half[8 + k];
		for (int row = 0; row < 2; row++)
			ret_matrix[4 * row + k] = half[4 * row + k] / picture->scale + picture->mean[row] * half[8 + k];
	}
}

/* The matrix of some pairs; false where they do not determine one. */
static bool transform(const struct balls *balls, const struct pair *pairs, const int *chosen, int count,
		      double ret_matrix[12])
{
	double places[BALLS_MOST][3], pixels[BALLS_MOST][3], normal[144] = {0}, p[12], trace = 0;
	struct scaling world, picture;

	for (int i = 0; i < count; i++) {
		memcpy(places[i], balls->ball[pairs[chosen[i]].ball].centre, sizeof(places[i]));
		pixels[i][0] = pairs[chosen[i]].pixel[0];
		pixels[i][1] = pairs[chosen[i]].pixel[1];
	}
	world = scaling_of((const double(*)[3])places, count, 3);
	picture = scaling_of((const double(*)[3])pixels, count, 2);
	for (int i = 0; i < count; i++)
		for (int e = 0; e < 2; e++) {
			const double pixel = (pixels[i][e] - picture.mean[e]) * picture.scale;
			double row[12] = {0};

			for (int a = 0; a < 4; a++) {
				row[4 * e + a] = a < 3 ? (places[i][a] - world.mean[a]) * world.scale : 1;
				row[8 + a] = -pixel * row[4 * e + a];
			}
			for (int a = 0; a < 12; a++)
				for (int b = 0; b <= a; b++)
					normal[12 * a + b] += row[a] * row[b];
		}
	for (int a = 0; a < 12; a++)
		trace += normal[13 * a];
	for (int a = 0; a < 12; a++)
		normal[13 * a] += 1e-12 * trace;
	if (dense_cholesky(normal, 12) < 0)
		return false;
	for (int a = 0; a < 12; a++)
		p[a] = 1 + .1 * a;
	for (int i = 0; i < INVERSE_STEPS; i++) {
		double length = 0;

		dense_solve(normal, 12, p);
		for (int a = 0; a < 12; a++)
			length += p[a] * p[a];
		for (int a = 0; a < 12; a++)
			p[a] /= sqrt(length);
	}
	undo_scaling(&world, &picture, p, ret_matrix);
	return isfinite(ret_matrix[0]);
}

/* Chooses the pairs that agree with a matrix; all of them lie on the same side of the source. */
static int agreeing(const struct balls *balls, const struct pair *pairs, int count, const double matrix[12],
		    int *ret_chosen)
{
	int chosen = 0, positive = 0;

	for (int i = 0; i < count; i++) {
		double column, row;
		const double depth = view_project(matrix, balls->ball[pairs[i].ball].centre, &column, &row);

		if (hypot(column - pairs[i].pixel[0], row - pairs[i].pixel[1]) > REACH)
			continue;
		positive += depth > 0;
		ret_chosen[chosen++] = i;
	}
	return positive == 0 || positive == chosen ? chosen : 0;
}

static unsigned next_random(unsigned *state)
{
	*state = *state * 1664525U + 1013904223U;
	return *state >> 8;
}

/* SAMPLE of count, all different. */
static void draw(unsigned *state, int count, int chosen[SAMPLE])
{
	for (int i = 0; i < SAMPLE; i++) {
		bool again = true;

		while (again) {
			chosen[i] = (int)(next_random(state) % (unsigned)count);
			again = false;
			for (int j = 0; j < i; j++)
				again = again || chosen[j] == chosen[i];
		}
	}
}

/* The largest set of pairs that one matrix explains, and that matrix; how many they are. */
static int consent(const struct balls *balls, const struct pair *pairs, int count, unsigned seed, int *ret_chosen,
		   double ret_matrix[12])
{
	int best = 0, needed = TRIES_MOST, sample[BALLS_MOST];

	for (int i = 0; i < count; i++)
		sample[i] = i;
	/* The first try is of all pairs: mostly they are good. */
	for (int i = 0, size = count; i < needed; i++, size = SAMPLE) {
		double matrix[12], share;
		int agree, chosen[BALLS_MOST];

		if (i > 0)
			draw(&seed, count, sample);
		if (!transform(balls, pairs, sample, size, matrix))
			continue;
		agree = agreeing(balls, pairs, count, matrix, chosen);
		if (agree <= best)
			continue;
		best = agree;
		memcpy(ret_chosen, chosen, (size_t)agree * sizeof(*chosen));
		memcpy(ret_matrix, matrix, sizeof(matrix));
		share = pow((double)agree / count, SAMPLE);
		needed = share >= 1 ? 0 : (int)fmin(TRIES_MOST, ceil(log(MISSED) / log(1 - share)));
	}
	return best;
}

int resect(const struct balls *balls, struct pair *pairs, int count, const double pixel_mm[2], unsigned seed,
	   struct pose *ret_pose, int *ret_count)
{
	int chosen[BALLS_MOST], agree;
	double matrix[12];
	struct geometry geometry;
	struct error ignored = {0};

	if (count < SAMPLE)
		return -1;
	agree = consent(balls, pairs, count, seed, chosen, matrix);
	for (int i = 0; i < 3 && agree >= SAMPLE; i++) {
		if (!transform(balls, pairs, chosen, agree, matrix))
			return -1;
		agree = agreeing(balls, pairs, count, matrix, chosen);
	}
	if (agree < SAMPLE || geometry_matrices(&geometry, 1, 1, 1, matrix, pixel_mm, &ignored) < 0)
		return -1;
	pose_of_view(ret_pose, &geometry.views[0]);
	geometry_clear(&geometry);
	for (int i = 0; i < agree; i++)
		pairs[i] = pairs[chosen[i]];
	*ret_count = agree;
	return 0;
}

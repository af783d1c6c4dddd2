/*
 * All poses and all balls' places at once (Triggs and others 2000, Bundle adjustment): a view's nine numbers touch no
 * other view's, so the normal equations are reduced to the balls' (Schur's complement) and solved there. The drawing
 * is a measurement of the places, too; without it the frame would be free.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/pulse.h"

enum { ROUNDS = 12 };
static const double PIXEL_SIGMA = .1; /* pixels, of a shadow's centroid, against which the drawing is weighed */

struct system {
	int size;               /* 3 * balls */
	double *matrix, *right; /* of the balls' places, reduced */
	double *half;           /* [balls][9][3], L^-1 W of a view's pairs */
	struct balls drawing;
};

static double cost_of(const struct bundle_view *views, int count, const struct pose *poses, const double pixel_mm[2],
		      const struct balls *balls, const struct balls *drawing, double sigma)
{
	double cost = 0;

	for (int v = 0; v < count; v++) {
		const double rms = views[v].count == 0
				       ? 0
				       : pose_rms(&poses[v], pixel_mm, balls, views[v].pairs, views[v].count, NULL);

		cost += rms * rms * views[v].count / (PIXEL_SIGMA * PIXEL_SIGMA);
	}
	for (int b = 0; b < balls->count; b++)
		for (int a = 0; a < 3; a++) {
			const double moved = balls->ball[b].centre[a] - drawing->ball[b].centre[a];

			cost += moved * moved / (sigma * sigma);
		}
	return cost;
}

/* x := L^-1 x for one column of a matrix with `stride` columns. */
static void solve_lower(const double l[81], double *x, int stride)
{
	for (int i = 0; i < 9; i++) {
		for (int k = 0; k < i; k++)
			x[i * stride] -= l[9 * i + k] * x[k * stride];
		x[i * stride] /= l[10 * i];
	}
}

/*
 * The view's normal equations: its own block factored, z = L^-1 right, half[pair] = L^-1 (own x ball's). Also adds the
 * balls' own blocks to the system. Negative when the view is not determined.
 */
static int view_blocks(const struct bundle_view *view, const struct pose *pose, const double pixel_mm[2],
		       const struct balls *balls, double damping, struct system *system, double factor[81], double z[9])
{
	memset(factor, 0, 81 * sizeof(*factor));
	memset(z, 0, 9 * sizeof(*z));
	for (int i = 0; i < view->count; i++) {
		const int ball = view->pairs[i].ball;
		double(*half)[3] = (double(*)[3])(system->half + (size_t)i * 27);
		struct pose_row row;

		pose_row(pose, pixel_mm, &balls->ball[ball], view->pairs[i].pixel, &row);
		memset(half, 0, 27 * sizeof(double));
		for (int e = 0; e < 2; e++)
			for (int a = 0; a < 9; a++) {
				z[a] += row.pose[e][a] * row.residual[e];
				for (int b = 0; b <= a; b++)
					factor[9 * a + b] += row.pose[e][a] * row.pose[e][b];
				for (int b = 0; b < 3; b++)
					half[a][b] += row.pose[e][a] * row.place[e][b];
			}
		for (int e = 0; e < 2; e++)
			for (int a = 0; a < 3; a++) {
				double *line = system->matrix + (size_t)(3 * ball + a) * (size_t)system->size;

				system->right[3 * ball + a] += row.place[e][a] * row.residual[e];
				for (int b = 0; b < 3; b++)
					line[3 * ball + b] += row.place[e][a] * row.place[e][b];
			}
	}
	for (int a = 0; a < 9; a++)
		factor[10 * a] *= 1 + damping;
	if (dense_cholesky(factor, 9) < 0)
		return -1;
	solve_lower(factor, z, 1);
	for (int i = 0; i < view->count; i++)
		for (int a = 0; a < 3; a++)
			solve_lower(factor, system->half + (size_t)i * 27 + a, 3);
	return 0;
}

/* Takes from the balls' system what the view's own numbers can explain. */
static void reduce(const struct bundle_view *view, struct system *system, const double z[9])
{
	for (int i = 0; i < view->count; i++)
		for (int a = 0; a < 3; a++) {
			const double *mine = system->half + (size_t)i * 27 + a;
			const int at = 3 * view->pairs[i].ball + a;

			for (int k = 0; k < 9; k++)
				system->right[at] -= mine[3 * k] * z[k];
			for (int j = 0; j < view->count; j++)
				for (int b = 0; b < 3; b++) {
					const double *other = system->half + (size_t)j * 27 + b;
					double sum = 0;

					for (int k = 0; k < 9; k++)
						sum += mine[3 * k] * other[3 * k];
					system->matrix[(size_t)at * (size_t)system->size +
						       (size_t)(3 * view->pairs[j].ball + b)] -= sum;
				}
		}
}

/* One step of Gauss and Newton for the balls. Negative when the system is not determined. */
static int step(const struct bundle_view *views, int count, const double pixel_mm[2], const struct balls *balls,
		double sigma, double damping, struct system *system, struct balls *ret_balls)
{
	const double weight = PIXEL_SIGMA * PIXEL_SIGMA / (sigma * sigma);
	double factor[81], z[9];
	int code = 0;

	memset(system->matrix, 0, (size_t)system->size * (size_t)system->size * sizeof(double));
	for (int i = 0; i < system->size; i++) {
		system->matrix[(size_t)i * (size_t)system->size + (size_t)i] = weight;
		system->right[i] =
		    weight * (system->drawing.ball[i / 3].centre[i % 3] - balls->ball[i / 3].centre[i % 3]);
	}
	for (int v = 0; v < count && code == 0; v++) {
		if (views[v].count == 0)
			continue;
		code = view_blocks(&views[v], views[v].pose, pixel_mm, balls, damping, system, factor, z);
		if (code == 0)
			reduce(&views[v], system, z);
		pulse_beat();
	}
	if (code < 0 || dense_cholesky(system->matrix, system->size) < 0)
		return -1;
	dense_solve(system->matrix, system->size, system->right);
	for (int b = 0; b < balls->count; b++) {
		ret_balls->ball[b] = balls->ball[b];
		for (int a = 0; a < 3; a++)
			ret_balls->ball[b].centre[a] += system->right[3 * b + a];
	}
	return 0;
}

/* The poses' steps to given moves of the balls. */
static void step_poses(const struct bundle_view *views, int count, const double pixel_mm[2], const struct balls *balls,
		       double damping, struct system *system, const double *moves, struct pose *ret_poses)
{
	for (int v = 0; v < count; v++) {
		double factor[81], z[9];

		if (views[v].count == 0)
			continue;
		ret_poses[v] = *views[v].pose;
		if (view_blocks(&views[v], views[v].pose, pixel_mm, balls, damping, system, factor, z) < 0)
			continue;
		for (int i = 0; i < views[v].count; i++)
			for (int k = 0; k < 9; k++)
				for (int a = 0; a < 3; a++)
					z[k] -= system->half[(size_t)i * 27 + (size_t)(3 * k + a)] *
						moves[3 * views[v].pairs[i].ball + a];
		for (int i = 8; i >= 0; i--) {
			for (int k = i + 1; k < 9; k++)
				z[i] -= factor[9 * k + i] * z[k];
			z[i] /= factor[10 * i];
		}
		pose_step(&ret_poses[v], z);
	}
}

static int system_open(struct system *system, const struct balls *balls, struct error *err)
{
	const size_t size = 3 * (size_t)balls->count;

	*system = (struct system){.size = (int)size};
	system->matrix = malloc(size * size * sizeof(double));
	system->right = malloc(2 * size * sizeof(double));
	system->half = malloc((size_t)balls->count * 27 * sizeof(double));
	system->drawing.count = balls->count;
	system->drawing.ball = malloc((size_t)balls->count * sizeof(struct ball));
	if (system->matrix == NULL || system->right == NULL || system->half == NULL || system->drawing.ball == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to adjust %d balls", balls->count);
	memcpy(system->drawing.ball, balls->ball, (size_t)balls->count * sizeof(struct ball));
	return 0;
}

static void system_close(struct system *system)
{
	free(system->matrix);
	free(system->right);
	free(system->half);
	free(system->drawing.ball);
}

int bundle_fit(const struct bundle_view *views, int count, const double pixel_mm[2], struct balls *balls,
	       double drawing, struct error *err)
{
	struct system system;
	struct pose *poses = malloc((size_t)count * sizeof(*poses));
	struct balls tried = {.count = balls->count, .ball = malloc((size_t)balls->count * sizeof(struct ball))};
	double cost = INFINITY, damping = 1e-6;
	int code = system_open(&system, balls, err);

	if (code == 0 && (poses == NULL || tried.ball == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int v = 0; v < count && code == 0; v++)
		poses[v] = *views[v].pose;
	if (code == 0)
		cost = cost_of(views, count, poses, pixel_mm, balls, &system.drawing, drawing);
	for (int i = 0; i < ROUNDS && code == 0 && damping < 1e6; i++) {
		double after, *moves = system.right + system.size;

		if (step(views, count, pixel_mm, balls, drawing, damping, &system, &tried) < 0) {
			damping *= 100;
			continue;
		}
		memcpy(moves, system.right, (size_t)system.size * sizeof(double));
		step_poses(views, count, pixel_mm, balls, damping, &system, moves, poses);
		after = cost_of(views, count, poses, pixel_mm, &tried, &system.drawing, drawing);
		if (!(after < cost)) {
			damping *= 100;
			continue;
		}
		for (int v = 0; v < count; v++)
			if (views[v].count > 0)
				*views[v].pose = poses[v];
		memcpy(balls->ball, tried.ball, (size_t)balls->count * sizeof(struct ball));
		if (cost - after < 1e-6 * cost)
			break;
		cost = after;
		damping *= .1;
	}
	system_close(&system);
	free(poses);
	free(tried.ball);
	return code;
}

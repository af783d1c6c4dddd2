/*
 * Which shadow is of which ball.
 *
 * The nominal geometry predicts a constellation; the sag of the arm and the phantom's place shift, turn and stretch
 * it. For some turns and sizes of the predicted constellation every pair of a ball and a shadow votes for the shift
 * between them, the shift with most votes starts an affine map that is fitted to mutual nearest neighbours under
 * a closing reach, and the map that pairs most balls is taken. Where a phantom has balls of different sizes, a shadow
 * is paired with a ball of its own size only: that is the code of a helix.
 */
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/pulse.h"

enum { BINS_MOST = 96, TURN_STEPS = 120, TURN_VIEWS = 8 };
static const double SHIFT_MOST = .25;             /* of the detector's longer side, to either side */
static const double REACHES[] = {6, 4.5, 3.5, 3}; /* mm at the detector */
static const double TURN_LIKE_BEST = .8;          /* of the pairs of the best turn */
static const double TURN_AS_GOOD = .9;            /* of the pairs that poses explain at the best turn */

struct expected {
	double pixel[2], radius; /* radius 0: not in front of the source */
};

/* Steps of the search: turns of the model in the picture, in degrees, and its sizes. */
struct search {
	int turns, sizes;
	double turn, size; /* step */
};
static const struct search search_all = {.turns = 9, .sizes = 7, .turn = 1.5, .size = .04};
static const struct search search_few = {.turns = 3, .sizes = 3, .turn = 3, .size = .04};

struct task {
	const struct match_view *view;
	const double *pixel_mm;
	int balls;
	struct expected expected[BALLS_MOST];
	double unlike; /* largest |log| of shadow's over expected radius; INFINITY: sizes tell nothing */
};

/* Half of the step from small to large, and room for distances that are not nominal. */
static double size_tolerance(const struct balls *balls)
{
	double least = INFINITY, most = 0;

	for (int i = 0; i < balls->count; i++) {
		least = fmin(least, balls->ball[i].diameter);
		most = fmax(most, balls->ball[i].diameter);
	}
	return most > 1.25 * least ? fmax(.12, .5 * log(most / least)) : INFINITY;
}

static bool alike(const struct task *task, const struct shadow *shadow, const struct expected *expected)
{
	return expected->radius > 0 &&
	       (isinf(task->unlike) || fabs(log(shadow->radius / expected->radius)) <= task->unlike);
}

/* [0] [1] [2]; [3] [4] [5]: predicted pixel to the found one's. */
struct affine {
	double by[6];
};

static void mapped(const struct affine *map, const double from[2], double to[2])
{
	to[0] = map->by[0] * from[0] + map->by[1] * from[1] + map->by[2];
	to[1] = map->by[3] * from[0] + map->by[4] * from[1] + map->by[5];
}

/* Mutual nearest neighbours under places of the balls, within reach. */
static int pair_up(const struct task *task, const double (*places)[2], double reach, struct pair *ret_pairs)
{
	const struct match_view *view = task->view;
	int nearest[SHADOWS_MOST], count = 0;
	double distance[SHADOWS_MOST];

	for (int s = 0; s < view->count; s++) {
		nearest[s] = -1;
		distance[s] = reach * reach;
	}
	for (int b = 0; b < task->balls; b++) {
		double least = reach * reach;
		int own = -1;

		for (int s = 0; s < view->count; s++) {
			const double dx = view->shadows[s].column - places[b][0],
				     dy = view->shadows[s].row - places[b][1];
			const double square = dx * dx + dy * dy;

			if ((square >= least && square >= distance[s]) ||
			    !alike(task, &view->shadows[s], &task->expected[b]))
				continue;
			if (square < least) {
				least = square;
				own = s;
			}
			if (square < distance[s]) {
				distance[s] = square;
				nearest[s] = b;
			}
		}
		if (own >= 0)
			ret_pairs[count++] = (struct pair){.ball = b, .shadow = own};
	}
	for (int i = 0, kept = 0;; i++) {
		if (i == count)
			return kept;
		if (nearest[ret_pairs[i].shadow] != ret_pairs[i].ball)
			continue;
		ret_pairs[kept] = ret_pairs[i];
		ret_pairs[kept].radius = view->shadows[ret_pairs[i].shadow].radius;
		ret_pairs[kept].pixel[0] = view->shadows[ret_pairs[i].shadow].column;
		ret_pairs[kept++].pixel[1] = view->shadows[ret_pairs[i].shadow].row;
	}
}

static int map_pairs(const struct task *task, const struct affine *map, double reach, struct pair *ret_pairs)
{
	double places[BALLS_MOST][2];

	for (int b = 0; b < task->balls; b++)
		mapped(map, task->expected[b].pixel, places[b]);
	return pair_up(task, (const double(*)[2])places, reach, ret_pairs);
}

static bool fit_map(const struct task *task, const struct pair *pairs, int count, struct affine *map)
{
	const double middle[2] = {.5 * task->view->columns, .5 * task->view->rows}, scale = middle[0] + middle[1];
	double normal[9] = {0}, right[2][3] = {{0}};

	for (int i = 0; i < count; i++) {
		const double *from = task->expected[pairs[i].ball].pixel;
		const double x[3] = {(from[0] - middle[0]) / scale, (from[1] - middle[1]) / scale, 1};

		for (int a = 0; a < 3; a++) {
			for (int e = 0; e < 2; e++)
				right[e][a] += x[a] * (pairs[i].pixel[e] - from[e]);
			for (int b = 0; b <= a; b++)
				normal[3 * a + b] += x[a] * x[b];
		}
	}
	/* A little is drawn towards the constellation as predicted: few pairs tell little of its stretch. */
	normal[0] += .01;
	normal[4] += .01;
	if (dense_cholesky(normal, 3) < 0)
		return false;
	for (int e = 0; e < 2; e++) {
		dense_solve(normal, 3, right[e]);
		map->by[3 * e + 0] = right[e][0] / scale + (e == 0);
		map->by[3 * e + 1] = right[e][1] / scale + (e == 1);
		map->by[3 * e + 2] = right[e][2] - (right[e][0] * middle[0] + right[e][1] * middle[1]) / scale;
	}
	return true;
}

/* Sums over two by two bins of two rows, and the largest of them. */
static int sum_windows(const unsigned short *above, const unsigned short *below, int count, int *ret_sums)
{
	int most = 0;

#pragma omp simd reduction(max : most)
	for (int x = 0; x < count; x++) {
		ret_sums[x] = above[x] + above[x + 1] + below[x] + below[x + 1];
		most = ret_sums[x] > most ? ret_sums[x] : most;
	}
	return most;
}

/* Shifts a map by what most pairs vote for; returns how many do. */
static int vote(const struct task *task, struct affine *map)
{
	const struct match_view *view = task->view;
	const double most = SHIFT_MOST * fmax(view->columns, view->rows);
	const double bin = fmax(2 * most / (BINS_MOST - 2), 2.5 / task->pixel_mm[0]);
	const int bins = (int)(2 * most / bin) + 1;
	unsigned short votes[BINS_MOST][BINS_MOST];
	double nearest = INFINITY, by_votes[2] = {0};
	int best = 1; /* no shift without a vote */

	for (int y = 0; y < bins; y++)
		memset(votes[y], 0, (size_t)bins * sizeof(**votes));
	for (int b = 0; b < task->balls; b++) {
		double place[2];

		mapped(map, task->expected[b].pixel, place);
		for (int s = 0; s < view->count; s++) {
			const double x = (view->shadows[s].column - place[0] + most) / bin;
			const double y = (view->shadows[s].row - place[1] + most) / bin;

			if (x >= 0 && y >= 0 && x < bins && y < bins &&
			    alike(task, &view->shadows[s], &task->expected[b]))
				votes[(int)y][(int)x]++;
		}
	}
	for (int y = 0; y + 1 < bins; y++) {
		int sums[BINS_MOST];

		if (sum_windows(votes[y], votes[y + 1], bins - 1, sums) < best)
			continue;
		for (int x = 0; x + 1 < bins; x++) {
			const double shift[2] = {(x + 1) * bin - most, (y + 1) * bin - most};
			const double square = shift[0] * shift[0] + shift[1] * shift[1];

			if (sums[x] < best || (sums[x] == best && square >= nearest))
				continue;
			best = sums[x];
			nearest = square;
			by_votes[0] = shift[0];
			by_votes[1] = shift[1];
		}
	}
	map->by[2] += by_votes[0];
	map->by[5] += by_votes[1];
	return best;
}

/* Turn and size about the detector's middle. */
static struct affine start_map(const struct match_view *view, double turn, double size)
{
	const double c = size * cos(turn), s = size * sin(turn), x = .5 * view->columns, y = .5 * view->rows;

	return (struct affine){{c, -s, x - c * x + s * y, s, c, y - s * x - c * y}};
}

static int search_pairs(const struct task *task, const struct search *search, struct pair *ret_pairs)
{
	const int reaches = sizeof(REACHES) / sizeof(*REACHES);
	int best = 0;

	for (int t = 0; t < search->turns; t++)
		for (int z = 0; z < search->sizes; z++) {
			struct pair pairs[BALLS_MOST];
			struct affine map = start_map(task->view, (t - search->turns / 2) * search->turn * M_PI / 180,
						      1 + (z - search->sizes / 2) * search->size);
			int count = 0;

			if (vote(task, &map) < best / 2)
				continue;
			for (int i = 0; i < reaches; i++) {
				count = map_pairs(task, &map, REACHES[i] / task->pixel_mm[0], pairs);
				if (count < 4 || (i + 1 < reaches && !fit_map(task, pairs, count, &map)))
					break;
			}
			if (count <= best)
				continue;
			best = count;
			memcpy(ret_pairs, pairs, (size_t)count * sizeof(*pairs));
		}
	return best;
}

static void make_task(struct task *task, const struct match_view *view, const double pixel_mm[2],
		      const struct balls *balls, double turn)
{
	task->view = view;
	task->pixel_mm = pixel_mm;
	task->balls = balls->count;
	task->unlike = size_tolerance(balls);
	for (int b = 0; b < balls->count; b++) {
		struct ball ball = balls->ball[b];
		const double x = ball.centre[0], y = ball.centre[1];

		ball.centre[0] = cos(turn) * x - sin(turn) * y;
		ball.centre[1] = sin(turn) * x + cos(turn) * y;
		task->expected[b] = (struct expected){{0}, 0};
		task->expected[b].radius = pose_shadow(&view->nominal, pixel_mm, &ball, task->expected[b].pixel);
	}
}

int match_view(const struct match_view *view, const double pixel_mm[2], const struct balls *balls, double turn,
	       struct pair *ret_pairs)
{
	struct task task;

	make_task(&task, view, pixel_mm, balls, turn);
	return search_pairs(&task, &search_all, ret_pairs);
}

int match_pose(const struct match_view *view, const struct pose *pose, const double pixel_mm[2],
	       const struct balls *balls, double reach, struct pair *ret_pairs)
{
	struct match_view here = *view;
	struct task task;
	double places[BALLS_MOST][2];

	here.nominal = *pose;
	make_task(&task, &here, pixel_mm, balls, 0);
	for (int b = 0; b < balls->count; b++)
		memcpy(places[b], task.expected[b].pixel, sizeof(places[b]));
	return pair_up(&task, (const double(*)[2])places, reach, ret_pairs);
}

/* Climbs from a turn to the one near it with the most pairs, over dips of a step. */
static int climb(const int pairs[TURN_STEPS], int turn)
{
	for (bool higher = true; higher;) {
		higher = false;
		for (int i = -2; i <= 2; i++) {
			const int other = (turn + i + TURN_STEPS) % TURN_STEPS;

			if (pairs[other] > pairs[turn]) {
				turn = other;
				higher = true;
				break;
			}
		}
	}
	return turn;
}

/* How many shadows of a view one pose explains, the phantom turned by an angle. */
static int explained(const struct match_view *view, const double pixel_mm[2], const struct balls *balls, double turn)
{
	struct pair pairs[BALLS_MOST];
	struct pose pose;
	int count = match_view(view, pixel_mm, balls, turn, pairs);

	pulse_beat();
	if (count < PAIRS_LEAST || resect(balls, pairs, count, pixel_mm, 0, &pose, &count) < 0 ||
	    pose_fit(&pose, pixel_mm, balls, pairs, count) > RMS_MOST)
		return 0;
	return count;
}

/* The smallest of the turns at which about as many, by a share, are found as at any. */
static int smallest_turn(const int found[TURN_STEPS], double share)
{
	int most = 0, best = 0;

	for (int t = 0; t < TURN_STEPS; t++)
		most = found[t] > most ? found[t] : most;
	for (int t = 0; t < TURN_STEPS; t++)
		if (found[t] >= share * most && abs(t - TURN_STEPS / 2) < abs(best - TURN_STEPS / 2))
			best = t;
	return best;
}

/*
 * Among many balls there are pairs at any turn: of the turns that have more than those beside them, and about as many
 * as any, those count of which poses explain the pairs.
 */
static int explained_turn(const struct match_view *views, int count, int used, const double pixel_mm[2],
			  const struct balls *balls, const int pairs[TURN_STEPS], int *ret_explained)
{
	int found[TURN_STEPS] = {0}, most = 0, any = 0, best;

	for (int t = 0; t < TURN_STEPS; t++)
		most = pairs[t] > most ? pairs[t] : most;
#pragma omp parallel for schedule(dynamic) reduction(+ : any)
	for (int t = 0; t < TURN_STEPS; t++) {
		if (pairs[t] < TURN_LIKE_BEST * most || climb(pairs, t) != t)
			continue;
		for (int i = 0; i < used; i++)
			found[t] += explained(&views[(2 * i + 1) * count / (2 * used)], pixel_mm, balls,
					      2 * M_PI * (t - TURN_STEPS / 2) / TURN_STEPS);
		any += found[t];
	}
	best = any > 0 ? smallest_turn(found, TURN_AS_GOOD) : climb(pairs, smallest_turn(pairs, TURN_LIKE_BEST));
	*ret_explained = found[best];
	return best;
}

int match_turn(const struct match_view *views, int count, const double pixel_mm[2], const struct balls *balls,
	       double *ret_turn, int *ret_explained, struct error *err)
{
	const int used = count < TURN_VIEWS ? count : TURN_VIEWS;
	int pairs[TURN_STEPS] = {0}, best, failed = 0;

#pragma omp parallel for schedule(dynamic)
	for (int t = 0; t < TURN_STEPS; t++) {
		struct task *task = malloc(sizeof(*task));
		struct pair *list = malloc(BALLS_MOST * sizeof(*list));

		for (int i = 0; i < used && task != NULL && list != NULL; i++) {
			make_task(task, &views[(2 * i + 1) * count / (2 * used)], pixel_mm, balls,
				  2 * M_PI * (t - TURN_STEPS / 2) / TURN_STEPS);
			pairs[t] += search_pairs(task, &search_few, list);
			pulse_beat();
		}
		if (task == NULL || list == NULL) {
#pragma omp atomic write
			failed = 1;
		}
		free(task);
		free(list);
	}
	if (failed)
		return error_set(err, ERR_NO_MEMORY, "no memory to match %d balls", balls->count);
	best = explained_turn(views, count, used, pixel_mm, balls, pairs, ret_explained);
	*ret_turn = 2 * M_PI * (best - TURN_STEPS / 2) / TURN_STEPS;
	return 0;
}

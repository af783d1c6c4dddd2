/* What the samples of all views say of the object together: see input.h. */
#include <math.h>
#include <stdlib.h>

#include "core/correct/input.h"
#include "core/correct/ring.h"
#include "core/error.h"

/* ---- air that is off, or a board ---- */

/*
 * A board wider than the detector, as a table, has a level at both ends of nearly all rows, too, seen along its normal.
 * As the arm turns on, its end comes into the detector at the one side, so that there is air there while the other end
 * still has the board, which takes the more the more obliquely it is seen. A tube that drifts does the same to both
 * ends, so that behind a board there is no air there either.
 */

/* Air, and little beside what the other end has. */
static const double AIR = 0.02, BESIDE = 0.5;
/* What a board's level grows by from a place to the next, at most; what it falls by is as from this angle from its
 * normal on, in degrees, but for noise. */
static const double GROWS = 3, OBLIQUE = 65, NOISE = 0.05;

enum sign { AGAINST = -1, NO_SIGN, FOR };

/* The least that a board has in a place of what it has in the one before. */
static double fall_of(const struct ring *ring, int place, int next)
{
	const double degree = acos(-1) / 180;
	const double turn =
	    fmin(next > place ? ring_turn(ring, place, next) : ring_turn(ring, next, place), OBLIQUE * degree);

	return cos(OBLIQUE * degree) / cos(OBLIQUE * degree - turn) - NOISE;
}

/* What follows on one side of a place that is off says for a board, or against it, where one of its ends comes in. */
static enum sign board_sign(const struct input *input, const struct ring *ring, int place, int side)
{
	const float *ends = input->edges[ring_place(ring, place)->view].air_ends;
	double level[2] = {(double)ends[0], (double)ends[1]};
	bool has[2] = {true, true};

	for (int k = 1; k < ring->count && (has[0] || has[1]); k++) {
		const struct ring_place *next = ring_place(ring, place + side * k);
		double least[2];

		if (next == NULL)
			return NO_SIGN;
		ends = input->edges[next->view].air_ends;
		for (int end = 0; end < 2; end++) {
			const double here = (double)ends[end];

			least[end] = level[end] * fall_of(ring, place + side * (k - 1), place + side * k);
			has[end] = has[end] && here >= fmax(AIR, least[end]) && here <= GROWS * level[end];
			if (has[end])
				level[end] = here;
		}
		for (int end = 0; end < 2; end++) {
			const double other = (double)ends[1 - end];

			if (!has[end] || has[1 - end])
				continue;
			if (fabs(other) < fmin(AIR, BESIDE * level[end]))
				return FOR;
			if (other < least[1 - end])
				return AGAINST;
		}
	}
	return NO_SIGN;
}

static bool is_off(const struct input *input, const struct ring *ring, int place)
{
	return input->edges[ring_place(ring, place)->view].air != 0;
}

/* Air that is a board's is none that is off. */
static void find_boards(struct input *input, const struct ring *ring)
{
	for (int i = 0; i < ring->count; i++) {
		enum sign ahead, back;

		if (!is_off(input, ring, i))
			continue;
		ahead = board_sign(input, ring, i, 1);
		back = board_sign(input, ring, i, -1);
		input->edges[ring_place(ring, i)->view].board =
		    (ahead == FOR || back == FOR) && ahead != AGAINST && back != AGAINST;
	}
}

static void add_edges_of(struct input *input, const struct view_edges *edges)
{
	input->views_looked_at++;
	for (int end = 0; end < 2; end++)
		input->ends[end] += edges->ends[end];
	if (edges->air == 0 || edges->board)
		return;
	input->air_least = input->off == 0 ? edges->air : fminf(input->air_least, edges->air);
	input->air_most = input->off == 0 ? edges->air : fmaxf(input->air_most, edges->air);
	input->off++;
	input->far_off += edges->far_off;
}

int input_add_edges(struct input *input, const struct orbit *orbit, struct error *err)
{
	bool *skip = calloc((size_t)orbit->count, sizeof(*skip));
	struct ring ring = {0};
	int code = 0;

	if (skip == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", orbit->count);
	for (int view = 0; view < orbit->count; view++)
		skip[view] = !input->edges[view].looked_at || input->outliers[view].kind != OUTLIER_NONE;
	code = ring_open(&ring, NULL, skip, orbit, err);
	if (code == 0)
		find_boards(input, &ring);
	for (int i = 0; i < ring.count; i++)
		add_edges_of(input, &input->edges[ring.places[i].view]);
	ring_clear(&ring);
	free(skip);
	return code;
}

/* ---- of the object ---- */

void input_goes_on(const struct input *input, bool ret_ends[2])
{
	for (int end = 0; end < 2; end++)
		ret_ends[end] = 4 * input->ends[end] > input->views_looked_at;
}

double input_shown(const struct input *input)
{
	double sum = 0;

	for (int i = 0; i < input->views; i++)
		sum += pow((double)input->content[i].mean, 2) + pow((double)input->content[i].structure, 2);
	for (int i = 0; i < input->counts.blank; i++)
		sum -= pow((double)input->content[input->blank[i]].mean, 2) +
		       pow((double)input->content[input->blank[i]].structure, 2);
	return input->views > 0 ? fmax(0, sum) / input->views : 0;
}

double input_air_off_share(const struct input *input)
{
	/* Between two views that are looked at, one such and the other not, all may be such. */
	return input->far_off > 0 ? fmin(1, (input->far_off + 1.) / input->views_looked_at) : 0;
}

int input_stand_in(struct input *input, const struct backend *backend, struct stack *projections,
		   const struct geometry *geometry, const struct orbit *orbit, const struct cancel *cancel,
		   struct error *err)
{
	const int count = input->counts.blank;
	bool *bad = calloc((size_t)orbit->count, sizeof(*bad)), *there = calloc((size_t)count + 1, sizeof(*there));
	const struct mend_tools tools = {backend, projections, geometry, orbit, bad, cancel};
	int code = 0;

	if (bad == NULL || there == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", orbit->count);
	for (int i = 0; i < count && code == 0; i++)
		bad[input->blank[i]] = true;
	if (code == 0 && count > 0)
		code = mend_views(&tools, input->blank, count, there, err);
	for (int i = 0; i < count && code == 0; i++)
		input->stood_in[input->blank[i]] = there[i];
	free(bad);
	free(there);
	return code;
}

bool input_is_absent(const struct input *input, int view)
{
	for (int i = 0; i < input->counts.blank; i++)
		if (input->blank[i] == view)
			return !input->stood_in[view];
	return false;
}

int input_absent(const struct input *input)
{
	int count = 0;

	for (int i = 0; i < input->counts.blank; i++)
		count += !input->stood_in[input->blank[i]];
	return count;
}

double input_absent_share(const struct input *input, const struct orbit *orbit)
{
	double absent = 0, all = 0;

	for (int i = 0; i < input->counts.blank; i++)
		if (!input->stood_in[input->blank[i]])
			absent += orbit_axis_weight(orbit, input->blank[i]);
	for (int k = 0; k < orbit->count; k++)
		all += orbit_axis_weight(orbit, k);
	/* Views that weigh next to nothing on the axis, as an arc's two ends, cannot stand in for the absent ones. */
	return absent < (1 - 1e-6) * all ? absent / all : 0;
}

/* What the samples of all views say of the object together: see input.h. */
#include <math.h>

#include "core/correct/input.h"
#include "core/truncation.h"

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

/* The angle of a ray about z, in radians; of the middle row. */
static double ray_angle(const struct geometry *geometry, int view, double column)
{
	const struct view *at = &geometry->views[view];
	double way[2];

	for (int i = 0; i < 2; i++)
		way[i] = at->pixel0[i] + column * at->column_step[i] + 0.5 * (geometry->rows - 1) * at->row_step[i] -
			 at->source[i];
	return atan2(way[1], way[0]);
}

/*
 * The sum of squares that the differences of both ends have from those behind a board with such a normal, in radians;
 * from one and the same difference where that is NAN, as of a flat image that is off. ret_views: how many there are.
 */
static double board_misfit(const struct input *input, const struct geometry *geometry, double normal, int *ret_views)
{
	const double inside = truncation_edge(geometry->columns) - 0.5;
	double sum = 0, square = 0;

	*ret_views = 0;
	for (int i = 0; i < geometry->count; i++) {
		const struct view_edges *edges = &input->edges[i];
		const double off = (double)edges->air_ends[0] - (double)edges->air_ends[1];
		double expected = 0, cosine[2] = {1, 1};

		if (!edges->looked_at || edges->air == 0)
			continue;
		for (int end = 0; end < 2 && !isnan(normal); end++)
			cosine[end] =
			    fabs(cos(ray_angle(geometry, i, end ? geometry->columns - 1 - inside : inside) - normal));
		if (!isnan(normal))
			expected = (double)(edges->air_ends[0] + edges->air_ends[1]) * (cosine[1] - cosine[0]) /
				   (cosine[0] + cosine[1]);
		sum += off - expected;
		square += (off - expected) * (off - expected);
		(*ret_views)++;
	}
	return isnan(normal) && *ret_views > 0 ? square - sum * sum / *ret_views : square;
}

bool input_air_is_a_board(const struct input *input, const struct geometry *geometry)
{
	/*
	 * Of 26 tables that random scans had so, 18 have 5 views at least and less than .074 of what is left of one
	 * difference; of 1650 scans with tubes that drift, the least with so many has .15.
	 */
	const double left = 0.08;
	const int least = 5, steps = 180;
	double best = INFINITY, same;
	int views;

	same = board_misfit(input, geometry, NAN, &views);
	for (int i = 0; i < steps && views >= least; i++)
		best = fmin(best, board_misfit(input, geometry, i * acos(-1) / steps, &views));
	return views >= least && best < left * same;
}

double input_blank_share(const struct input *input, const struct orbit *orbit)
{
	double blank = 0, all = 0;

	for (int i = 0; i < input->counts.blank; i++)
		blank += orbit_axis_weight(orbit, input->blank[i]);
	for (int k = 0; k < orbit->count; k++)
		all += orbit_axis_weight(orbit, k);
	/* Views that weigh next to nothing on the axis, as an arc's two ends, cannot stand in for the blank ones. */
	return blank < (1 - 1e-6) * all ? blank / all : 0;
}

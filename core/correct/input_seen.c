/* What the samples of all views say of the object together: see input.h. */
#include <math.h>

#include "core/correct/input.h"

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

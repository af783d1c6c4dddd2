/* Single samples that are wrong, over all views: see input.h and impulses.h. */
#include <stdlib.h>

#include "core/correct/input.h"

/*
 * Of what stands out of its surroundings, the share that no view beside shows, from which on it is impulses: an object
 * of rods and thin plates makes hundreds, all but a few of which go on in the views beside.
 */
static const double SHARE = 0.2;

/* Leaves those that no view beside shows; how many there are, and were. */
static int check_all(struct input *input, const struct mend_tools *tools, size_t *ret_left, size_t *ret_all,
		     struct error *err)
{
	int code = 0;

	*ret_left = *ret_all = 0;
	for (int view = 0; view < input->all_views && code == 0; view++) {
		if (tools->bad[view])
			input->impulses[view].count = 0;
		if (input->impulses[view].count == 0)
			continue;
		*ret_all += (size_t)input->impulses[view].count;
		code = impulses_check(tools, view, input->impulses, err);
		if (code == 0)
			code = cancel_check(tools->cancel, err);
	}
	for (int view = 0; view < input->all_views; view++) {
		impulses_keep(&input->impulses[view]);
		*ret_left += (size_t)input->impulses[view].count;
	}
	return code;
}

int input_check(struct input *input, const struct backend *backend, struct stack *projections,
		const struct geometry *geometry, const struct orbit *orbit, const struct cancel *cancel,
		struct error *err)
{
	bool *bad = calloc((size_t)orbit->count, sizeof(*bad));
	const struct mend_tools tools = {backend, projections, geometry, orbit, bad, cancel};
	size_t left, all;
	int code;

	if (bad == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", orbit->count);
	for (int i = 0; i < input->counts.blank; i++)
		bad[input->blank[i]] = true;
	code = check_all(input, &tools, &left, &all, err);
	for (int view = 0; view < input->all_views && code == 0; view++) {
		if ((double)left < SHARE * (double)all)
			input->impulses[view].count = 0;
		if (input->impulses[view].count > 0 && !input_is_mended(input, view))
			input->mended[input->mended_count++] = view;
	}
	free(bad);
	return code;
}

int input_mend_impulses(struct input *input, const struct mend_tools *tools, struct error *err)
{
	int code = 0;

	for (int i = 0; i < input->mended_count && code == 0; i++) {
		const struct view_impulses *impulses = &input->impulses[input->mended[i]];

		if (impulses->count == 0)
			continue;
		code = impulses_mend(tools, input->mended[i], impulses, err);
		input->replaced += (size_t)impulses->count;
		input->replaced_views++;
	}
	return code;
}

/* Blank views: see blank.h. */
#include "core/correct/blank.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/correct/input.h"

double blank_factor(const struct correction_job *job)
{
	return 1 / (1 - input_absent_share(job->input, job->orbit));
}

int blank_make_up(const struct correction_job *job, struct volume *volume, bool *ret_changed, struct error *err)
{
	const struct grid *grid = &job->recipe->grid;
	const size_t voxels = grid_voxels(grid);
	const float factor = (float)blank_factor(job);
	float *host;
	int code;

	if (input_absent(job->input) == 0)
		return 0;
	host = malloc(voxels * sizeof(*host));
	if (host == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", voxels);
	code = job->backend->volume_download(volume, 0, grid->size[2], host, err);
	for (size_t i = 0; code == 0 && i < voxels; i++)
		host[i] *= factor;
	if (code == 0)
		code = job->backend->volume_upload(volume, host, err);
	free(host);
	*ret_changed = true;
	return code;
}

/*
 * Where most of what stands in for parts is what opposite rays have measured, the iterations take it, too: 2.1 HU in
 * place of 3.2 of a head with half of 12 in 120 views dark, 4.5 in place of 6.8 with a cone of 20 degrees. What views
 * beside say is no measurement of these rays, and they are left out.
 */
static const double OPPOSITE = 0.5;

/* The rays of parts that were mended are left out of the iterations. */
static int leave_out_parts(const struct correction_job *job, struct error *err)
{
	const int columns = job->geometry->columns, rows = job->geometry->rows;
	float *values = malloc((size_t)columns * (size_t)rows * sizeof(*values));
	int code = 0;

	if (values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (int i = 0; i < job->input->mended_count && code == 0; i++) {
		const int view = job->input->mended[i];
		const struct step *step = &job->input->steps[view];
		const struct mend_area area = mend_area_of(step, columns, rows);

		if (step->kind != STEP_PART)
			continue;
		code = job->backend->stack_download(job->projections, view, 1, values, err);
		for (int r = area.first[1]; r < area.end[1]; r++)
			for (int c = area.first[0]; c < area.end[0]; c++)
				values[(size_t)r * (size_t)columns + (size_t)c] = RAY_LEFT_OUT;
		if (code == 0)
			code = job->backend->stack_upload(job->projections, view, 1, values, err);
	}
	free(values);
	return code;
}

/* The rays of blank views are left out of the iterations. */
static int leave_out(const struct correction_job *job, struct error *err)
{
	const size_t pixels = (size_t)job->geometry->columns * (size_t)job->geometry->rows;
	float *nothing;
	const bool doubtful = job->input->mended_count > 0 && job->input->opposite < OPPOSITE;
	int code = doubtful ? leave_out_parts(job, err) : 0;

	if (code < 0 || job->input->counts.blank == 0)
		return code;
	nothing = malloc(pixels * sizeof(*nothing));
	if (nothing == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (size_t i = 0; i < pixels; i++)
		nothing[i] = RAY_LEFT_OUT;
	for (int i = 0; i < job->input->counts.blank && code == 0; i++)
		code = job->backend->stack_upload(job->projections, job->input->blank[i], 1, nothing, err);
	free(nothing);
	return code;
}

static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	(void)state;
	return time == CORRECT_AFTER_FDK ? blank_make_up(job, job->volume, ret_changed, err) : leave_out(job, err);
}

/* A view's number among all projections of the scan, of which some may have never come. */
static int number_of(const struct input *input, int view)
{
	return input->given.numbers != NULL ? input->given.numbers[view] : view;
}

/* Outliers of a kind, numbers of the scan's projections: the first of them, and the one that is the worst. */
struct outlier_report {
	struct warning_views views;
	int first, worst;
	float amount; /* of the worst */
};

static struct outlier_report report_of(const struct input *input, int views, enum outlier_kind kind)
{
	struct outlier_report report = {.first = -1};

	for (int i = 0; i < views; i++) {
		const struct outlier *outlier = &input->outliers[i];
		const int number = number_of(input, i);

		if (outlier->kind != kind)
			continue;
		warning_views_add(&report.views, number);
		report.views.mended += input_is_mended(input, i);
		report.first = report.first < 0 ? number : report.first;
		if (fabsf(outlier->amount) > fabsf(report.amount) || report.views.count == 1) {
			report.worst = number;
			report.amount = outlier->amount;
		}
	}
	for (int i = input->counts.blank - input->held_out - input->left_out; i < input->counts.blank - input->held_out;
	     i++)
		report.views.left_out += input->outliers[input->blank[i]].kind == kind;
	return report;
}

/* Where no projections are kept, and there is no memory for it, some spoiled views go into the image as they are. */
static void warn_of_kept(const struct input *input, int views, const struct warning_sink *sink)
{
	const int kept = input_kept_in(input, views);

	if (kept > 0)
		warning_tell(sink, "spoiled_views",
			     "%d projections, %.2g %% of all, are in the image as they are, though they do not follow "
			     "those beside them: FDK alone keeps up to %d projections to leave them out, and there is "
			     "no memory to keep all of them",
			     kept, 100.0 * kept / views, COPIES_MOST);
}

/* Those between two steps are mended, the others left out. */
static void warn_of_outliers(const struct input *input, int views, const struct warning_sink *sink)
{
	struct outlier_report reports[OUTLIER_KINDS];
	const struct outlier_report *dark = &reports[OUTLIER_DARK], *frozen = &reports[OUTLIER_FROZEN],
				    *level = &reports[OUTLIER_LEVEL], *shifted = &reports[OUTLIER_SHIFTED],
				    *misplaced = &reports[OUTLIER_MISPLACED];
	char done[96], parts[96];
	int count = 0;

	for (int kind = OUTLIER_DARK; kind < OUTLIER_KINDS; kind++) {
		reports[kind] = report_of(input, views, (enum outlier_kind)kind);
		count += reports[kind].views.count - reports[kind].views.mended;
	}
	snprintf(parts, sizeof(parts), "Opposite rays stand in for %.0f %% of that, the views beside for the rest",
		 100 * input->opposite);
	if (input->left_out == count)
		snprintf(done, sizeof(done), "They are left out, the others stand in for them");
	else
		snprintf(done, sizeof(done), "%d of them and of other such ones are left out", input->left_out);
	if (dark->views.count > 0)
		warning_tell_views(sink, "dark_parts", &dark->views,
				   "%d projections, the first of them is %d, have parts without a usable sample, or "
				   "with another signal, that those beside them do not have, %.3g %% of projection %d. "
				   "%s",
				   dark->views.count, dark->first, 100 * (double)dark->amount, dark->worst,
				   dark->views.mended == dark->views.count ? parts : done);
	if (frozen->views.count > 0)
		warning_tell_views(sink, "frozen_views", &frozen->views,
				   "%d projections, the first of them is %d, are the very ones before them. %s",
				   frozen->views.count, frozen->first, done);
	if (level->views.count > 0)
		warning_tell_views(sink, "dose_steps", &level->views,
				   "%d projections, the first of them is %d, were taken with another dose than those "
				   "beside them: %.3g times as bright all over in projection %d. %s",
				   level->views.count, level->first, exp(-(double)level->amount), level->worst,
				   level->views.mended == level->views.count ? "That was taken off them" : done);
	if (shifted->views.count > 0)
		warning_tell_views(
		    sink, "shifted_views", &shifted->views,
		    "%d projections, the first of them is %d, lie aside of those beside them, by %.3g %% of "
		    "the detector in projection %d: did the patient or the arm move? %s",
		    shifted->views.count, shifted->first, 100 * fabs((double)shifted->amount), shifted->worst, done);
	if (misplaced->views.count > 0)
		warning_tell_views(sink, "misplaced_views", &misplaced->views,
				   "%d projections, the first of them is %d, do not fit where the scan says that they "
				   "were taken, and fit elsewhere: were projections exchanged, or numbered in another "
				   "order? %d of them were put where they fit, %d were left out",
				   misplaced->views.count, misplaced->first, misplaced->views.mended,
				   misplaced->views.left_out);
}

static int compare_numbers(const void *a, const void *b)
{
	const int x = *(const int *)a, y = *(const int *)b;

	return (x > y) - (x < y);
}

/* Views without a good pixel, and behind them those that show nothing. */
static int warn_of_nothing(const struct input *input, int nothing, int empty, const struct warning_sink *sink,
			   struct error *err)
{
	struct warning_views views = {0};
	int *numbers = malloc((size_t)nothing * sizeof(*numbers));

	if (numbers == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", nothing);
	for (int i = 0; i < nothing; i++)
		numbers[i] = number_of(input, input->blank[i]);
	qsort(numbers, (size_t)nothing, sizeof(*numbers), compare_numbers);
	for (int i = 0; i < nothing; i++)
		warning_views_add(&views, numbers[i]);
	views.left_out = nothing;
	if (empty > 0)
		warning_tell_views(
		    sink, "blank_views", &views,
		    "%d projections show nothing, the first of them is %d: %d have no good pixel, and %d one "
		    "value or mere noise all over, as with a closed shutter or without the patient. They are "
		    "left out, the others stand in for them",
		    nothing, numbers[0], nothing - empty, empty);
	else
		warning_tell_views(
		    sink, "blank_views", &views,
		    "%d projections have no good pixel, the first of them is %d: they are left out, the others stand "
		    "in for them",
		    nothing, numbers[0]);
	free(numbers);
	return 0;
}

static int warn(const struct correction_job *job, void *state, struct error *err)
{
	const struct input *input = job->input;
	const int others = input->left_out + input->held_out;
	const int nothing = input->counts.blank - others, empty = input->empty - others;

	(void)state;
	/* Outliers and views that are held out are the last ones of the list. */
	warn_of_outliers(input, job->geometry->count, job->warnings);
	warn_of_kept(input, job->geometry->count, job->warnings);
	return nothing > 0 ? warn_of_nothing(input, nothing, empty, job->warnings, err) : 0;
}

extern const struct correction correction_blank_views;
const struct correction correction_blank_views = {
    .name = "blank_views",
    .summary = "views without a good pixel, that show nothing, do not follow those beside them or are held out: the "
	       "others stand in for them in FDK, iterations leave them out",
    .times = 1U << CORRECT_AFTER_FDK | 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_VOLUME,
    .apply = apply,
    .warn = warn,
};

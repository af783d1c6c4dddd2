/* The samples of a reconstruction on their way in, and what has to be said of them. */
#include "core/correct/input.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/air.h"
#include "core/correct/correction.h"
#include "core/correct/counts.h"
#include "core/correct/misplaced.h"
#include "core/truncation.h"

/* Columns and rows, exchanged where `turned`. */
struct upright {
	int pixels[2];
};
static struct upright upright(const struct input *input)
{
	return input->turned ? (struct upright){{input->rows, input->columns}}
			     : (struct upright){{input->columns, input->rows}};
}

/* [row][column] to [column][row], pixels of 1, 2 or 4 bytes. */
static void exchange(const struct input *input, const void *from, size_t bytes, void *to)
{
	const char *source = from;
	char *target = to;

#pragma omp parallel for schedule(static)
	for (int column = 0; column < input->columns; column++)
		for (int row = 0; row < input->rows; row++)
			memcpy(target + ((size_t)column * (size_t)input->rows + (size_t)row) * bytes,
			       source + ((size_t)row * (size_t)input->columns + (size_t)column) * bytes, bytes);
}

/* Room for an image; exchanges it where there is one. */
static int turn_image(struct input *input, const void *image, size_t bytes, void **ret_exchanged, struct error *err)
{
	*ret_exchanged = malloc((size_t)input->columns * (size_t)input->rows * bytes);
	if (*ret_exchanged == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for images of %d x %d pixels", input->columns,
				 input->rows);
	if (image != NULL)
		exchange(input, image, bytes, *ret_exchanged);
	return 0;
}

/* linearise's images and region as the turned detector has them, and room for a projection. */
static int turn(struct input *input, struct error *err)
{
	struct linearise *linearise = &input->linearise;
	const int region[] = {linearise->air_region[1], linearise->air_region[0], linearise->air_region[3],
			      linearise->air_region[2]};
	int code = turn_image(input, NULL, linearise_sample_bytes(linearise), &input->projection, err);

	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		if (linearise->image[i] == NULL)
			continue;
		code = turn_image(input, linearise->image[i], image_bytes(i, 1, 1), &input->image[i], err);
		linearise->image[i] = input->image[i];
	}
	if (code == 0 && linearise->stuck != NULL) {
		code = turn_image(input, linearise->stuck, 1, &input->stuck, err);
		linearise->stuck = input->stuck;
	}
	memcpy(linearise->air_region, region, sizeof(region));
	return code;
}

/* Defects are counted among the detector's own pixels; the map, and what is wide in it, is that of the blocks. */
static void take_found(struct defect_map *map, const struct defect_map *found)
{
	map->given = found->given;
	map->dead = found->dead;
	map->hot = found->hot;
	map->noisy = found->noisy;
	map->stuck = found->stuck;
}

int input_open(struct input *ret_input, const struct linearise *linearise, const struct geometry *geometry, int n,
	       bool turned, struct error *err)
{
	struct input input = {.turned = turned};
	int code = corrections_check(linearise, geometry, err), columns, rows;

	if (code == 0)
		code = binning_open(&input.binning, linearise, geometry, n, err);
	if (code < 0)
		return code;
	input.given = input.binning.binned;
	input.linearise = counts_linearise(&input.given);
	input.columns = input.binning.blocks.count[0];
	input.rows = input.binning.blocks.count[1];
	columns = turned ? input.rows : input.columns;
	rows = turned ? input.columns : input.rows;
	if (turned)
		code = turn(&input, err);
	if (code == 0)
		code = defect_map_make(&input.map, &input.linearise, columns, rows, err);
	if (code == 0 && n > 1)
		take_found(&input.map, &input.binning.found);
	if (code == 0) {
		input.linearise.image[IMAGE_DEFECTS] = input.map.map;
		input.pixels = (size_t)columns * (size_t)rows;
		input.look_every = geometry->count / 32 + 1;
		input.even = true;
		input.good[0] = input.good[1] = -1;
		input.blank = calloc((size_t)geometry->count, sizeof(*input.blank));
		input.stood_in = calloc((size_t)geometry->count, sizeof(*input.stood_in));
		input.content = calloc((size_t)geometry->count, sizeof(*input.content));
		input.profiles = calloc((size_t)geometry->count, sizeof(*input.profiles));
		input.strips = calloc((size_t)geometry->count, sizeof(*input.strips));
		input.all_views = geometry->count;
		input.impulses = calloc((size_t)geometry->count, sizeof(*input.impulses));
		input.outliers = calloc((size_t)geometry->count, sizeof(*input.outliers));
		input.steps = calloc((size_t)geometry->count, sizeof(*input.steps));
		input.mended = calloc((size_t)geometry->count, sizeof(*input.mended));
		input.defects = calloc((size_t)geometry->count, sizeof(*input.defects));
		input.edges = calloc((size_t)geometry->count, sizeof(*input.edges));
		if (input.blank == NULL || input.content == NULL || input.profiles == NULL || input.strips == NULL ||
		    input.impulses == NULL || input.outliers == NULL || input.steps == NULL || input.mended == NULL ||
		    input.defects == NULL || input.edges == NULL || input.stood_in == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", geometry->count);
	}
	if (code < 0)
		input_clear(&input);
	else
		*ret_input = input;
	return code;
}

size_t input_view_bytes(const struct input *input)
{
	const struct binning *binning = &input->binning;

	return linearise_sample_bytes(&binning->given) * (size_t)binning->columns * (size_t)binning->rows;
}

void input_clear(struct input *input)
{
	for (int i = 0; i < IMAGE_COUNT; i++)
		free(input->image[i]);
	free(input->stuck);
	free(input->projection);
	defect_map_clear(&input->map);
	binning_clear(&input->binning);
	free(input->blank);
	free(input->stood_in);
	free(input->content);
	free(input->profiles);
	free(input->strips);
	free(input->outliers);
	for (int i = 0; i < input->all_views && input->impulses != NULL; i++)
		free(input->impulses[i].pixels);
	free(input->impulses);
	free(input->steps);
	free(input->mended);
	free(input->defects);
	free(input->edges);
	for (int i = 0; i < input->copy_count; i++)
		free(input->copies[i].slot);
	*input = (struct input){0};
}

/* The line integral of a pixel, NAN for a defect; against the view's own air, without hardening. */
static float line_integral(const struct input *input, const void *samples, size_t at)
{
	float p = NAN;

	return linearise_pixel(&input->linearise, samples, at, &p) == PIXEL_GOOD ? p + input->log_air : NAN;
}

/* Samples of a view, about 4096 spread over it in blocks; unusable: share of all of its samples. */
static struct view_content look_at_line_integrals(struct input *input, const void *samples, int columns, int rows,
						  double unusable, struct view_profile *ret_profile)
{
	const int most = CONTENT_BLOCKS * CONTENT_SAMPLES;
	const int across = columns < most ? columns : most, along = rows < most ? rows : most;
	struct content_sums sums = {.any = false};
	struct profile_sums profile = {0};
	struct view_content content;

	for (int j = 0; j < along; j++) {
		const size_t row = (size_t)((long long)j * rows / along);

		for (int i = 0; i < across; i++) {
			const size_t column = (size_t)((long long)i * columns / across);
			const float p = line_integral(input, samples, row * (size_t)columns + column);
			const int block = j * CONTENT_BLOCKS / along * CONTENT_BLOCKS + i * CONTENT_BLOCKS / across;

			profile_add(&profile, i, j, block, p);
			if (isnan(p))
				continue;
			content_add(&sums, block, p);
			input->sum += (double)p;
			input->most = p > input->most ? p : input->most;
			input->looked_at++;
		}
	}
	content = content_of(&sums);
	*ret_profile = profile_of(&profile, &sums, content.noise, unusable);
	return content;
}

/* Looks for a small object at every pixel of a view, while no view before has shown anything. */
static int look_at_all(struct input *input, const void *samples, int columns, int rows, struct view_content *view,
		       struct error *err)
{
	float *image;

	input->even = input->even && !content_shows(view);
	if (!input->even)
		return 0;
	image = malloc(input->pixels * sizeof(*image));
	if (image == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (size_t i = 0; i < input->pixels; i++)
		image[i] = line_integral(input, samples, i);
	content_search(image, columns, rows, view->brightest);
	free(image);
	return 0;
}

static int exchanged(uint16_t sample)
{
	return sample >> 8 | (sample & 255) << 8;
}

void input_look_at_bytes(struct input *input, const void *raw)
{
	const size_t pixels = (size_t)input->binning.columns * (size_t)input->binning.rows;
	const uint16_t *samples = raw;

	if (input->binning.given.sample != SAMPLE_UINT16)
		return;
	for (size_t i = 1; i < pixels; i += pixels / 4096 + 1) {
		input->rough[0] += abs(samples[i] - samples[i - 1]);
		input->rough[1] += abs(exchanged(samples[i]) - exchanged(samples[i - 1]));
		if (exchanged(samples[i]) > input->largest)
			input->largest = exchanged(samples[i]);
	}
}

const void *input_bin(struct input *input, const void *samples)
{
	return binning_view(&input->binning, samples);
}

/* True if the mean of a piece of the row, 1/32 of it or 8 pixels, reaches the level. */
static bool row_reaches(const struct input *input, const void *samples, size_t first, int columns, float level)
{
	const int piece = columns > 256 ? columns / 32 : 8;

	for (int from = 0; from < columns; from += piece) {
		float sum = 0;
		int good = 0;

		for (int c = from; c < columns && c < from + piece; c++) {
			const float p = line_integral(input, samples, first + (size_t)c);

			sum += isnan(p) ? 0 : p;
			good += !isnan(p);
		}
		if (good >= piece / 2 && good > 0 && sum > 0 && sum >= level * (float)good)
			return true;
	}
	return false;
}

/* Notes the level of air at the ends of the rows, where no air region makes up for it. */
static int look_at_air(struct input *input, const void *samples, int columns, int rows, float largest,
		       struct view_edges *edges, struct error *err)
{
	const int edge = truncation_edge(columns), wide = 4 * edge, looked_at = rows < 64 ? rows : 64;
	float *ends;

	if (input->linearise.has_air_region || columns < wide)
		return 0;
	ends = malloc(sizeof(*ends) * (size_t)looked_at * (size_t)wide);
	if (ends == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the ends of %d rows", looked_at);
	for (int i = 0; i < looked_at; i++)
		for (int c = 0; c < wide; c++) {
			const int row = (int)((long long)i * rows / looked_at);
			const int column = c < 2 * edge ? c : columns - wide + c;

			ends[i * wide + c] =
			    line_integral(input, samples, (size_t)row * (size_t)columns + (size_t)column);
		}
	edges->air = air_level(ends, wide, looked_at, edge, largest, edges->air_ends);
	edges->far_off = edges->air != 0 && edges->air >= truncation_level(largest);
	free(ends);
	return 0;
}

/* Notes whether the object extends beyond the first and the last row, and the level of air beside it. */
static int look_at_ends(struct input *input, const void *samples, int columns, int rows, struct view_edges *edges,
			struct error *err)
{
	float largest = 0, level;

	for (size_t i = 0; i < input->pixels; i += input->pixels / 4096 + 1)
		largest = fmaxf(largest, line_integral(input, samples, i)); /* NAN is never the larger */
	level = truncation_level(largest);
	for (int end = 0; end < 2; end++)
		edges->ends[end] =
		    row_reaches(input, samples, end ? (size_t)(rows - 1) * (size_t)columns : 0, columns, level);
	edges->looked_at = true;
	return look_at_air(input, samples, columns, rows, largest, edges, err);
}

bool input_is_mended(const struct input *input, int view)
{
	for (int i = 0; i < input->mended_count; i++)
		if (input->mended[i] == view)
			return true;
	return false;
}

static void add_counts(struct defect_counts *counts, const struct defect_counts *view)
{
	counts->mapped += view->mapped;
	counts->not_finite += view->not_finite;
	counts->saturated += view->saturated;
	counts->zero += view->zero;
	counts->blank += view->blank;
	counts->no_air += view->no_air;
	if (view->air_least > 0 && (view->air_least < counts->air_least || counts->air_least == 0))
		counts->air_least = view->air_least;
	counts->air_most = fmaxf(counts->air_most, view->air_most);
}

/* True for a closed shutter: many samples have no count at all, and the others no more structure than noise. */
static bool is_dark(const struct defect_counts *counts, const struct view_content *content, size_t pixels)
{
	const double many = 0.2;

	return counts->blank == 0 && content->plain && (double)counts->zero > many * (double)pixels;
}

int input_empty_slot(const struct input *input, const struct backend *backend, struct stack *to, int slot,
		     struct error *err)
{
	float *zero = calloc(input->pixels, sizeof(*zero));
	int code;

	if (zero == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	code = backend->stack_upload(to, slot, 1, zero, err);
	free(zero);
	return code;
}

/* Of a view, without the map's; 0 where they are too few to tell. */
static double unusable_share(const struct defect_counts *counts, size_t pixels)
{
	const size_t least = 1024;

	return pixels < least ? 0 : (double)(defects_total(counts) - counts->mapped) / (double)pixels;
}

static void add_blank(struct input *input, int view)
{
	input->blank[input->counts.blank++] = view;
	input->empty++;
}

int input_take(struct input *input, const struct backend *backend, struct plan *plan, const void *samples, int view,
	       int slot, struct stack *to, const void **ret_upright, struct error *err)
{
	/* Views are linearised one by one, so that those with defects, and each one's own air, are known. */
	const struct defect_counts before = input->counts;
	const int columns = upright(input).pixels[0], rows = upright(input).pixels[1];
	struct defect_counts counts = {0};
	int code;

	if (input->turned) {
		exchange(input, samples, linearise_sample_bytes(&input->linearise), input->projection);
		samples = input->projection;
	}
	code = backend->linearise(plan, samples, 1, &slot, to, &counts, err);
	if (code < 0)
		return code;
	add_counts(&input->counts, &counts);
	input->defects[view] = counts;
	if (counts.blank > 0)
		input->blank[before.blank] = view;
	input->log_air = counts.air_most > 0 ? logf(counts.air_most) : 0;
	input->content[view] = look_at_line_integrals(input, samples, columns, rows,
						      unusable_share(&counts, input->pixels), &input->profiles[view]);
	narrow_look(&input->linearise, samples, (const int[2]){columns, rows}, input->log_air, &input->strips[view]);
	if (is_dark(&counts, &input->content[view], input->pixels)) {
		add_blank(input, view);
		code = input_empty_slot(input, backend, to, slot, err);
	} else if (counts.blank == 0) {
		code = look_at_all(input, samples, columns, rows, &input->content[view], err);
		if (code == 0)
			code = impulses_look(&input->linearise, samples, (const int[2]){columns, rows},
					     &input->impulses[view], err);
	}
	if (code == 0 && view % input->look_every == 0)
		code = look_at_ends(input, samples, columns, rows, &input->edges[view], err);
	if (code < 0)
		return code;
	input->views++;
	/* Defects of the map do not count: every view has them. */
	input->defective_views +=
	    defects_total(&input->counts) - input->counts.mapped > defects_total(&before) - before.mapped;
	*ret_upright = samples;
	return 0;
}

/* Whether a view of the scan is blank, [count], owned by the caller; NULL for no memory. */
static bool *blank_flags(const struct input *input, int count)
{
	bool *flags = calloc((size_t)count, sizeof(*flags));

	for (int i = 0; flags != NULL && i < input->counts.blank; i++)
		flags[input->blank[i]] = true;
	return flags;
}

int input_copy(struct input *input, const struct backend *backend, struct stack *from, int view, int slot,
	       struct error *err)
{
	const struct view_profile *profiles = input->profiles;
	const int good = input->good[0], earlier = input->good[1], gap = abs(view - good);
	float *copy;
	int code;

	/* What lasts for longer is no outlier. */
	if (good < 0 || gap > OUTLIERS_RUN ||
	    !outliers_suspect(&profiles[view], &profiles[good], gap, earlier < 0 ? NULL : &profiles[earlier])) {
		input->good[1] = good < 0 || gap > OUTLIERS_RUN ? -1 : good;
		input->good[0] = view;
		return 0;
	}
	if (input->copy_count == COPIES_MOST)
		return 0;
	copy = malloc(input->pixels * sizeof(*copy));
	if (copy == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	code = backend->stack_download(from, slot, 1, copy, err);
	if (code < 0) {
		free(copy);
		return code;
	}
	input->copies[input->copy_count].view = view;
	input->copies[input->copy_count++].slot = copy;
	return 0;
}

const float *input_copy_of(const struct input *input, int view)
{
	for (int i = 0; i < input->copy_count; i++)
		if (input->copies[i].view == view)
			return input->copies[i].slot;
	return NULL;
}

/* A view between two steps, as an outlier. */
static struct outlier outlier_of(const struct step *step)
{
	const double share = (step->end[0] - step->first[0]) * (step->end[1] - step->first[1]);

	if (step->kind == STEP_PART)
		return (struct outlier){OUTLIER_DARK, (float)share};
	if (step->kind == STEP_MISPLACED)
		return (struct outlier){OUTLIER_MISPLACED, 1};
	return (struct outlier){step->kind == STEP_ASIDE ? OUTLIER_SHIFTED : OUTLIER_LEVEL, step->level};
}

/* Line integrals behind a hardening polynomial are not another dose's by an offset. */
static bool can_mend(const struct input *input, int view, bool keeps_all)
{
	if (input->steps[view].kind == STEP_LEVEL)
		return input->linearise.hardening_count == 0 && (keeps_all || input_copy_of(input, view) != NULL);
	return keeps_all && steps_can_mend(&input->steps[view]);
}

/* The views between two steps. `skip`: views that are none of them; these are marked as well. */
static int add_steps(struct input *input, bool *skip, const struct orbit *orbit, bool keeps_all, struct error *err)
{
	int code = steps_find(input->profiles, input->strips, upright(input).pixels, skip, orbit, input->steps, err);

	for (int view = 0; view < orbit->count && code > 0; view++) {
		struct step *step = &input->steps[view];
		float level;

		if (step->kind == STEP_NONE)
			continue;
		skip[view] = true;
		if (step->kind == STEP_LEVEL && steps_air(input->profiles, step, view, &level))
			step->level = level;
		if (!can_mend(input, view, keeps_all))
			continue;
		input->mended[input->mended_count++] = view;
		if (step->kind == STEP_LEVEL)
			input->content[view].mean -= step->level;
	}
	return code < 0 ? code : 0;
}

/* The views that were taken elsewhere. `skip`: as above; outliers are marked as well. */
static int add_misplaced(struct input *input, bool *skip, const struct orbit *orbit, bool keeps_all, struct error *err)
{
	int code;

	for (int view = 0; view < orbit->count; view++)
		skip[view] = skip[view] || input->outliers[view].kind != OUTLIER_NONE;
	code = misplaced_find(input->strips, upright(input).pixels, skip, orbit, input->steps, err);
	for (int view = 0; view < orbit->count && code > 0; view++)
		if (input->steps[view].kind == STEP_MISPLACED && can_mend(input, view, keeps_all))
			input->mended[input->mended_count++] = view;
	return code;
}

/* What a view that is left out or mended had no counts in is told as a part that is dark, and as nothing else. */
static void forget_defects(struct input *input, int view)
{
	struct defect_counts *all = &input->counts;
	const struct defect_counts *own = &input->defects[view];

	input->defective_views -= own->not_finite + own->saturated + own->zero > 0;
	all->not_finite -= own->not_finite;
	all->saturated -= own->saturated;
	all->zero -= own->zero;
}

/*
 * Adds the outliers that can be left out to the blank views, but those that are mended; returns how many. `skip`: views
 * that are none, or lie between two steps.
 */
static int add_outliers(struct input *input, bool *skip, const struct orbit *orbit, bool keeps_all, struct error *err)
{
	const int before = input->left_out;
	int code = outliers_find(input->profiles, skip, orbit, input->outliers, err);

	if (code >= 0)
		code = add_misplaced(input, skip, orbit, keeps_all, err);
	for (int view = 0; view < orbit->count && code >= 0; view++) {
		const bool mended = input_is_mended(input, view);

		if (input->steps[view].kind != STEP_NONE)
			input->outliers[view] = outlier_of(&input->steps[view]);
		if (input->outliers[view].kind == OUTLIER_NONE ||
		    (!mended && !keeps_all && input_copy_of(input, view) == NULL))
			continue;
		if (input->outliers[view].kind == OUTLIER_DARK)
			forget_defects(input, view);
		if (mended)
			continue;
		add_blank(input, view);
		input->left_out++;
	}
	return code < 0 ? code : input->left_out - before;
}

int input_settle(struct input *input, const struct orbit *orbit, bool keeps_all, struct error *err)
{
	bool *blank = blank_flags(input, orbit->count), *empty = calloc((size_t)orbit->count, sizeof(*empty));
	int code = 0, found = 0, edges = 0;

	if (input->views > 0 && input->counts.blank == input->views)
		code = error_set(err, ERR_IMPOSSIBLE,
				 "none of the %d projections has a good pixel: %zu of their samples are in the defect "
				 "map, %zu not above the dark, %zu saturated, %zu not finite",
				 input->views, input->counts.mapped, input->counts.zero, input->counts.saturated,
				 input->counts.not_finite);
	else if (blank == NULL || empty == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", orbit->count);
	if (code == 0)
		code = content_find_empty(input->content, blank, orbit, empty, err);
	if (code >= 0) {
		const struct upright size = upright(input);

		found = code;
		code = content_is_even(input->content, blank, orbit, size.pixels[0], size.pixels[1], &input->even, err);
	}
	for (int view = 0; view < orbit->count && code >= 0; view++) {
		if (empty[view])
			add_blank(input, view);
		blank[view] = blank[view] || empty[view];
	}
	if (code >= 0)
		code = add_steps(input, blank, orbit, keeps_all, err);
	if (code >= 0)
		code = add_outliers(input, blank, orbit, keeps_all, err);
	if (code >= 0)
		edges = input_add_edges(input, orbit, err);
	free(blank);
	free(empty);
	return code < 0 ? code : edges < 0 ? edges : found + code;
}

int input_kept_in(const struct input *input, int views)
{
	int count = -input->left_out;

	for (int view = 0; view < views; view++)
		count += input->outliers[view].kind != OUTLIER_NONE && !input_is_mended(input, view);
	return count;
}

bool input_lacks(const struct input *input, int views)
{
	bool lacks = input_kept_in(input, views) > 0;

	for (int view = 0; view < views; view++)
		lacks = lacks || input->impulses[view].count > 0 ||
			(steps_can_mend(&input->steps[view]) && !input_is_mended(input, view));
	return lacks;
}

/* Takes a level off the copy of a view. */
static void take_off_copy(struct input *input, int view, float level)
{
	for (int i = 0; i < input->copy_count; i++)
		for (size_t at = 0; input->copies[i].view == view && at < input->pixels; at++)
			input->copies[i].slot[at] -= level;
}

size_t input_mend_bytes(const struct geometry *geometry)
{
	return mend_bytes(geometry->columns, geometry->rows);
}

int input_mend(struct input *input, const struct backend *backend, struct stack *projections,
	       const struct geometry *geometry, const struct orbit *orbit, bool keeps_all, const struct cancel *cancel,
	       struct error *err)
{
	bool *bad = blank_flags(input, orbit->count);
	const struct mend_tools tools = {backend, projections, geometry, orbit, bad, cancel};
	int *parts = malloc(sizeof(*parts) * ((size_t)input->mended_count + 1)), count = 0, code = 0;

	if (bad == NULL || parts == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", orbit->count);
	if (code == 0 && keeps_all)
		code = input_mend_impulses(input, &tools, err);
	if (code == 0 && keeps_all)
		code = mend_places(&tools, input->steps, err);
	for (int i = 0; i < input->mended_count && code == 0; i++) {
		const int view = input->mended[i];
		const struct step *step = &input->steps[view];

		if (step->kind == STEP_MISPLACED || step->kind == STEP_NONE)
			continue;
		if (step->kind == STEP_PART) {
			bad[view] = true;
			parts[count++] = view;
		} else if (keeps_all) {
			code = mend_level(&tools, view, step->level, err);
		} else {
			take_off_copy(input, view, step->level);
		}
	}
	if (code == 0 && count > 0)
		code = mend_parts(&tools, input->steps, parts, count, &input->opposite, err);
	free(bad);
	free(parts);
	return code;
}

void input_hold_out(struct input *input, const int *views, int count)
{
	for (int i = 0; i < count; i++)
		add_blank(input, views[i]);
	input->held_out += count;
}

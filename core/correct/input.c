/* The samples of a reconstruction on their way in, and what has to be said of them. */
#include "core/correct/input.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/air.h"
#include "core/truncation.h"

/* Air regions that differ by more than this tell of a tube or a detector that drifts. */
static const double DRIFT = 0.05;
/* Of the flat: below it something stands before the air region, in all views alike where they do not differ. */
static const double FAINT = 0.7;

/* Means of line integrals that no object has: no photon passes the one, and no flat is a tenth too dark for the other.
 */
static const double COUNTS = 1000, NEGATIVE = -0.1;

static int check(const struct linearise *linearise, const struct geometry *geometry, struct error *err)
{
	const int *region = linearise->air_region;

	if (linearise->hardening_count < 0 || linearise->hardening_count > HARDENING_MOST)
		return error_set(err, ERR_INVALID, "a beam-hardening polynomial of %d coefficients, at most %d",
				 linearise->hardening_count, HARDENING_MOST);
	if (!linearise->has_air_region)
		return 0;
	if (linearise->quantity != QUANTITY_INTENSITY)
		return error_set(err, ERR_INVALID, "line integrals have no air region, intensities do");
	if (region[0] < 0 || region[0] > region[2] || region[2] >= geometry->columns || region[1] < 0 ||
	    region[1] > region[3] || region[3] >= geometry->rows)
		return error_set(err, ERR_INVALID,
				 "air region of columns %d to %d and rows %d to %d on a detector of %d x %d", region[0],
				 region[2], region[1], region[3], geometry->columns, geometry->rows);
	return 0;
}

static size_t sample_bytes(const struct input *input)
{
	return input->linearise.sample == SAMPLE_UINT16 ? sizeof(uint16_t) : sizeof(float);
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

/* linearise's images and region as the turned detector has them, and room for a projection. */
static int turn(struct input *input, struct error *err)
{
	struct linearise *linearise = &input->linearise;
	const void *const images[] = {linearise->flat, linearise->dark, linearise->defects, linearise->stuck};
	const size_t bytes[] = {sizeof(float), sizeof(float), 1, 1, sample_bytes(input)};
	enum { IMAGES = 4 };
	const int region[] = {linearise->air_region[1], linearise->air_region[0], linearise->air_region[3],
			      linearise->air_region[2]};

	for (int i = 0; i <= IMAGES; i++) {
		if (i < IMAGES && images[i] == NULL)
			continue;
		input->exchanged[i] = malloc((size_t)input->columns * (size_t)input->rows * bytes[i]);
		if (input->exchanged[i] == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for images of %d x %d pixels", input->columns,
					 input->rows);
		if (i < IMAGES)
			exchange(input, images[i], bytes[i], input->exchanged[i]);
	}
	linearise->flat = input->exchanged[0];
	linearise->dark = input->exchanged[1];
	linearise->defects = input->exchanged[2];
	linearise->stuck = input->exchanged[3];
	memcpy(linearise->air_region, region, sizeof(region));
	return 0;
}

int input_open(struct input *ret_input, const struct linearise *linearise, const struct geometry *geometry, bool turned,
	       struct error *err)
{
	struct input input = {.linearise = *linearise,
			      .turned = turned,
			      .columns = turned ? geometry->rows : geometry->columns,
			      .rows = turned ? geometry->columns : geometry->rows};
	int code = turned ? turn(&input, err) : 0;

	if (code == 0)
		code = check(&input.linearise, geometry, err);
	if (code == 0)
		code = defect_map_make(&input.map, &input.linearise, geometry->columns, geometry->rows, err);
	if (code == 0) {
		input.linearise.defects = input.map.map;
		input.pixels = (size_t)geometry->columns * (size_t)geometry->rows;
		input.look_every = geometry->count / 32 + 1;
		input.blank = calloc((size_t)geometry->count, sizeof(*input.blank));
		if (input.blank == NULL)
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
	return sample_bytes(input) * (size_t)input->columns * (size_t)input->rows;
}

void input_clear(struct input *input)
{
	for (size_t i = 0; i < sizeof(input->exchanged) / sizeof(*input->exchanged); i++)
		free(input->exchanged[i]);
	defect_map_clear(&input->map);
	free(input->blank);
	*input = (struct input){0};
}

static void look_at_line_integrals(struct input *input, const void *samples)
{
	for (size_t i = 0; i < input->pixels; i += input->pixels / 4096 + 1) {
		const float p = input->linearise.sample == SAMPLE_UINT16 ? ((const uint16_t *)samples)[i]
									 : ((const float *)samples)[i];

		if (!isfinite(p) || (input->map.map != NULL && input->map.map[i]))
			continue;
		input->sum += (double)p;
		input->most = p > input->most ? p : input->most;
		input->looked_at++;
	}
}

static int exchanged(uint16_t sample)
{
	return sample >> 8 | (sample & 255) << 8;
}

static void look_at_bytes(struct input *input, const uint16_t *samples)
{
	for (size_t i = 1; i < input->pixels; i += input->pixels / 4096 + 1) {
		input->rough[0] += abs(samples[i] - samples[i - 1]);
		input->rough[1] += abs(exchanged(samples[i]) - exchanged(samples[i - 1]));
		if (exchanged(samples[i]) > input->largest)
			input->largest = exchanged(samples[i]);
	}
}

/* The line integral of a pixel as it comes, NAN for a defect; without the air region and hardening. */
static float line_integral(const struct input *input, const void *samples, size_t at)
{
	const struct linearise *linearise = &input->linearise;
	const float sample =
	    linearise->sample == SAMPLE_UINT16 ? ((const uint16_t *)samples)[at] : ((const float *)samples)[at];
	const float dark = linearise->dark != NULL ? linearise->dark[at] : 0;
	const float flat = linearise->flat != NULL ? linearise->flat[at] : (float)linearise->air;

	if ((input->map.map != NULL && input->map.map[at]) || !isfinite(sample))
		return NAN;
	if (linearise->quantity == QUANTITY_LINE_INTEGRAL)
		return sample;
	return sample < linearise_saturation(linearise) && sample > dark && flat > dark
		   ? -logf((sample - dark) / (flat - dark))
		   : NAN;
}

/* Whether the mean of a piece of the row, 1/32 of it or 8 pixels, reaches the level. */
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

/* What air has at the ends of the rows, where no air region makes up for that. */
static int look_at_air(struct input *input, const void *samples, int columns, int rows, float largest,
		       struct error *err)
{
	const int edge = truncation_edge(columns), wide = 4 * edge, looked_at = rows < 64 ? rows : 64;
	float *ends, air;

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
	air = air_level(ends, wide, looked_at, edge, largest);
	free(ends);
	if (air == 0)
		return 0;
	input->air_least = input->off == 0 ? air : fminf(input->air_least, air);
	input->air_most = input->off == 0 ? air : fmaxf(input->air_most, air);
	input->off++;
	input->far_off += air >= truncation_level(largest);
	return 0;
}

/* Whether the object goes on beyond the first and the last row, and what air has beside it. */
static int look_at_ends(struct input *input, const void *samples, int columns, int rows, struct error *err)
{
	float largest = 0, level;

	for (size_t i = 0; i < input->pixels; i += input->pixels / 4096 + 1)
		largest = fmaxf(largest, line_integral(input, samples, i)); /* NAN is never the larger */
	level = truncation_level(largest);
	for (int end = 0; end < 2; end++)
		input->ends[end] +=
		    row_reaches(input, samples, end ? (size_t)(rows - 1) * (size_t)columns : 0, columns, level);
	input->views_looked_at++;
	return look_at_air(input, samples, columns, rows, largest, err);
}

/* Not above the dark, where the detector could have counted. */
static bool has_no_counts(const struct input *input, const void *samples, size_t at)
{
	const struct linearise *linearise = &input->linearise;
	const float sample =
	    linearise->sample == SAMPLE_UINT16 ? ((const uint16_t *)samples)[at] : ((const float *)samples)[at];
	const float dark = linearise->dark != NULL ? linearise->dark[at] : 0;
	const float flat = linearise->flat != NULL ? linearise->flat[at] : (float)linearise->air;

	return sample <= dark && isfinite(sample) && flat > dark &&
	       (linearise->defects == NULL || !linearise->defects[at]);
}

/* Notes the view's samples without counts; how many there are to *ret_count. */
static int note_dark(const struct input *input, const void *samples, int columns, int view, struct metal *metal,
		     size_t *ret_count, struct error *err)
{
	const int rows = (int)(input->pixels / (size_t)columns);
	size_t count = 0;
	int code = 0;

	for (int row = 0; row < rows && code == 0; row++)
		for (int first = 0, last; first < columns && code == 0; first = last + 1) {
			const size_t at = (size_t)row * (size_t)columns;

			last = first;
			if (!has_no_counts(input, samples, at + (size_t)first))
				continue;
			while (last + 1 < columns && has_no_counts(input, samples, at + (size_t)last + 1))
				last++;
			count += (size_t)(last - first + 1);
			code = metal_note_dark(metal, view, row, first, last, err);
		}
	*ret_count = count;
	return code;
}

/* Of the view's largest line integral: in such a shadow a sample without counts is no dead pixel. */
static const float SHADOW = 0.5f;

/*
 * Where a shadow has no counts, its line integrals are above all that was
 * measured, and linearise has bridged them from the shadow's rim: metal would hardly be found.
 */
static int darken(const struct input *input, const struct backend *backend, const void *samples, int slot,
		  struct stack *to, struct error *err)
{
	float *view = malloc(input->pixels * sizeof(float)), largest = 0;
	int code;

	if (view == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	code = backend->stack_download(to, slot, 1, view, err);
	for (size_t i = 0; i < input->pixels && code == 0; i++)
		largest = fmaxf(largest, view[i]);
	for (size_t i = 0; i < input->pixels && code == 0; i++)
		if (view[i] >= SHADOW * largest && has_no_counts(input, samples, i))
			view[i] = largest;
	if (code == 0)
		code = backend->stack_upload(to, slot, 1, view, err);
	free(view);
	return code;
}

int input_take(struct input *input, const struct backend *backend, struct plan *plan, const void *samples, int view,
	       int slot, struct stack *to, struct metal *metal, struct error *err)
{
	/* One by one, so that the views with defects are known. */
	const struct defect_counts before = input->counts;
	size_t dark = 0;
	int code;

	if (input->turned) {
		exchange(input, samples, sample_bytes(input), input->exchanged[4]);
		samples = input->exchanged[4];
	}
	code = backend->linearise(plan, samples, 1, &slot, to, &input->counts, err);
	if (code < 0)
		return code;
	if (input->linearise.quantity == QUANTITY_LINE_INTEGRAL)
		look_at_line_integrals(input, samples);
	if (input->linearise.sample == SAMPLE_UINT16)
		look_at_bytes(input, samples);
	if (view % input->look_every == 0)
		code = look_at_ends(input, samples, input->turned ? input->rows : input->columns,
				    input->turned ? input->columns : input->rows, err);
	if (code < 0)
		return code;
	input->views++;
	/* Those of the map are in every view. */
	input->defective_views +=
	    defects_total(&input->counts) - input->counts.mapped > defects_total(&before) - before.mapped;
	if (input->counts.blank > before.blank)
		input->blank[before.blank] = view;
	if (metal == NULL || input->linearise.quantity != QUANTITY_INTENSITY || input->counts.zero == before.zero ||
	    input->counts.blank > before.blank)
		return 0;
	code = note_dark(input, samples, input->turned ? input->rows : input->columns, view, metal, &dark, err);
	return code < 0 || dark == 0 ? code : darken(input, backend, samples, slot, to, err);
}

void input_goes_on(const struct input *input, bool ret_ends[2])
{
	for (int end = 0; end < 2; end++)
		ret_ends[end] = 4 * input->ends[end] > input->views_looked_at;
}

double input_air_off_share(const struct input *input)
{
	return input->views_looked_at > 0 ? (double)input->far_off / input->views_looked_at : 0;
}

double input_blank_share(const struct input *input, const struct orbit *orbit)
{
	double blank = 0, all = 0;

	for (int i = 0; i < input->counts.blank; i++)
		blank += orbit_axis_weight(orbit, input->blank[i]);
	for (int k = 0; k < orbit->count; k++)
		all += orbit_axis_weight(orbit, k);
	/* Where the others are next to nothing on the axis, as an arc's two ends, they cannot stand in. */
	return blank < (1 - 1e-6) * all ? blank / all : 0;
}

int input_check(const struct input *input, struct error *err)
{
	if (input->views == 0 || input->counts.blank < input->views)
		return 0;
	return error_set(err, ERR_IMPOSSIBLE,
			 "none of the %d projections has a good pixel: %zu of their samples are in the defect map, %zu "
			 "not above the dark, %zu saturated, %zu not finite",
			 input->views, input->counts.mapped, input->counts.zero, input->counts.saturated,
			 input->counts.not_finite);
}

static int lowest(const int *views, int count)
{
	int least = views[0];

	for (int i = 1; i < count; i++)
		least = views[i] < least ? views[i] : least;
	return least;
}

static void warn_of_air(const struct input *input, const struct warning_sink *sink)
{
	const double least = (double)input->counts.air_least, most = (double)input->counts.air_most;

	if (input->counts.no_air > 0)
		warning_tell(
		    sink, "air_region",
		    "the air region has no good pixel in %d projections: those are taken against the flat as they are",
		    input->counts.no_air);
	if (least > 0 && (most > (1 + DRIFT) * least || least < FAINT))
		warning_tell(
		    sink, "air_region",
		    "the air region lies between %.4g and %.4g of the flat; each projection was held against its own%s",
		    least, most,
		    most > 2 * least || least < FAINT ? ". That is more than a tube drifts: is the object in it?" : "");
}

static void warn_of_air_level(const struct input *input, const struct warning_sink *sink)
{
	if (input->off == 0)
		return;
	warning_tell(
	    sink, "air_level",
	    "both ends of nearly all rows have line integrals between %.3g and %.3g, where air is 0, in %d of %d "
	    "projections that were looked at: the tube gave less or more than the flat or \"air\" says. Nothing "
	    "of that is taken out; an air_region makes up for it",
	    (double)input->air_least, (double)input->air_most, input->off, input->views_looked_at);
}

static void warn_of_line_integrals(const struct input *input, const struct warning_sink *sink)
{
	const double mean = input->looked_at > 0 ? input->sum / (double)input->looked_at : 0;

	if (mean > COUNTS)
		warning_tell(sink, "line_integrals",
			     "the line integrals are %.4g in the mean: are they counts, which would be intensities?",
			     mean);
	if (mean < NEGATIVE)
		warning_tell(
		    sink, "line_integrals",
		    "the line integrals are %.4g in the mean, where air is 0 and all else more: is their sign turned?",
		    mean);
	else if (input->looked_at > 0 && input->most <= 0)
		warning_tell(
		    sink, "line_integrals",
		    "none of %zu line integrals that were looked at is above 0: there is nothing but air in the scan",
		    input->looked_at);
}

/* What has its bytes exchanged is noise. So are 8 bits in the upper byte, but for being below 256 the other way. */
static void warn_of_bytes(const struct input *input, const struct warning_sink *sink)
{
	const double smoother = 8;

	if (input->largest > 255 && input->rough[0] > smoother * input->rough[1])
		warning_tell(
		    sink, "byte_order",
		    "pixels differ from their neighbours by %.3g times as much as with their bytes exchanged: are they "
		    "big-endian?",
		    input->rough[0] / fmax(input->rough[1], 1));
}

void input_warn(const struct input *input, const struct geometry *geometry, const struct warning_sink *sink)
{
	const struct defect_counts *counts = &input->counts;
	const struct defect_map *map = &input->map;
	const size_t found = defects_total(counts) - counts->mapped;
	const double pixels = (double)geometry->columns * geometry->rows;

	/* Who gives air as a number may have taken the offset away; a flat is what the detector gave. */
	if (input->linearise.quantity == QUANTITY_INTENSITY && input->linearise.flat != NULL &&
	    input->linearise.dark == NULL)
		warning_tell(sink, "no_dark",
			     "a flat image is there, but no dark one: an offset that the detector adds to its counts "
			     "makes all that is measured too thin");
	if (map->map != NULL && map->given + map->dead + map->hot + map->noisy > 0) {
		const size_t all = map->given + map->dead + map->hot + map->noisy;

		warning_tell(
		    sink, "defect_map",
		    "%zu pixels (%.3g %%) of every projection were replaced from their neighbours: %zu of the given "
		    "map, and %zu dead, %zu hot and %zu noisy ones that the flat and dark images show",
		    all, 100 * (double)all / pixels, map->given, map->dead, map->hot, map->noisy);
	}
	if (map->stuck > 0)
		warning_tell(
		    sink, "stuck_pixels",
		    "%zu pixels (%.3g %%) do not follow their neighbours over the views and were replaced from them; "
		    "a map of the detector's defects with the scan is the surer way",
		    map->stuck, 100 * (double)map->stuck / pixels);
	if (found > 0)
		warning_tell(
		    sink, "defects",
		    "%zu samples (%.3g %%) in %d projections were replaced from their neighbours: %zu not above the "
		    "dark, %zu saturated, %zu not finite or without a flat",
		    found, 100 * (double)found / (pixels * input->views), input->defective_views, counts->zero,
		    counts->saturated, counts->not_finite);
	if (counts->blank > 0)
		warning_tell(
		    sink, "blank_views",
		    "%d projections have no good pixel, the first of them is %d: they are left out, the others stand "
		    "in for them",
		    counts->blank, lowest(input->blank, counts->blank));
	warn_of_air(input, sink);
	warn_of_air_level(input, sink);
	warn_of_line_integrals(input, sink);
	warn_of_bytes(input, sink);
}

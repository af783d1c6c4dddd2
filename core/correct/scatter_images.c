/* Images of scattered radiation between views and between pixels: see scatter_images.h. */
#include "core/correct/scatter_images.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/scatter_spikes.h"

/* What a pixel, or a block of them, has of those of an image along one axis. */
struct parts {
	int first, count;
	float *share; /* [count], of the axis' list */
};

struct scatter_stack {
	struct scatter_images images;
	const struct scatter_source *source;
	int count[2]; /* pixels along a row and a column */
	struct parts *along[2];
	float *shares[2];
	struct {
		int at; /* of the source's; -1: none yet */
		float *image;
	} read[2];
	size_t *spikes; /* [source->count] */
	double *levels; /* likewise: the mean of each, below 0 before it was read */
	float *image;   /* of the projection */
};

/* Shares of one pixel's value, at `within` image pixels from the first centre, added to those of the block it is in. */
static void add_pixel(double within, int most, float weight, struct parts *parts)
{
	const int first = within < most - 1 || most == 1 ? (int)within : most - 2;
	const float behind = (float)(within - first);

	if (parts->count == 0)
		parts->first = first;
	if (parts->count < first - parts->first + (most > 1 ? 2 : 1))
		parts->count = first - parts->first + (most > 1 ? 2 : 1);
	parts->share[first - parts->first] += weight * (1 - behind);
	if (most > 1)
		parts->share[first - parts->first + 1] += weight * behind;
}

/* The most image pixels that a block of `size` can touch: those that its pixels' centres lie between. */
static size_t parts_most(int size, int detector, int most)
{
	return (size_t)(ceil((double)(size - 1) * most / detector) + 2);
}

static int place_pixels(struct scatter_stack *stack, int axis, const struct pixel_blocks *blocks, int detector,
			int most)
{
	const int size = blocks->size[axis];
	const size_t each = parts_most(size, detector, most);

	stack->along[axis] = calloc((size_t)blocks->count[axis], sizeof(struct parts));
	stack->shares[axis] = calloc((size_t)blocks->count[axis] * each, sizeof(float));
	if (stack->along[axis] == NULL || stack->shares[axis] == NULL)
		return ERR_NO_MEMORY;
	for (int i = 0; i < blocks->count[axis]; i++) {
		struct parts *parts = &stack->along[axis][i];

		parts->share = stack->shares[axis] + (size_t)i * each;
		for (int k = 0; k < size; k++) {
			const double at = (blocks->first[axis] + i * size + k + 0.5) * most / detector - 0.5;

			add_pixel(fmin(fmax(at, 0), most - 1), most, 1.0F / (float)size, parts);
		}
	}
	return 0;
}

int scatter_stack_new(const struct scatter_images *images, const struct scatter_source *source,
		      const struct pixel_blocks *blocks, const int detector[2], struct scatter_stack **ret_stack,
		      struct error *err)
{
	const int most[2] = {images->columns, images->rows};
	struct scatter_stack *stack;
	bool lacks = false;

	if (source == NULL || source->count == 0)
		return error_set(err, ERR_IMPOSSIBLE, "no projection of the scan has an image of its scatter");
	stack = calloc(1, sizeof(*stack));
	if (stack == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for images of scatter");
	stack->images = *images;
	stack->source = source;
	stack->image = malloc(scatter_image_bytes(images));
	stack->spikes = calloc((size_t)source->count, sizeof(*stack->spikes));
	stack->levels = malloc((size_t)source->count * sizeof(*stack->levels));
	for (int i = 0; i < 2; i++) {
		stack->count[i] = blocks->count[i];
		stack->read[i].at = -1;
		stack->read[i].image = malloc(scatter_image_bytes(images));
		lacks |= place_pixels(stack, i, blocks, detector[i], most[i]) != 0 || stack->read[i].image == NULL;
	}
	if (lacks || stack->image == NULL || stack->spikes == NULL || stack->levels == NULL) {
		scatter_stack_free(stack);
		return error_set(err, ERR_NO_MEMORY, "no memory for images of %zu bytes", scatter_image_bytes(images));
	}
	for (int i = 0; i < source->count; i++)
		stack->levels[i] = -1;
	*ret_stack = stack;
	return 0;
}

void scatter_stack_free(struct scatter_stack *stack)
{
	if (stack == NULL)
		return;
	for (int i = 0; i < 2; i++) {
		free(stack->along[i]);
		free(stack->shares[i]);
		free(stack->read[i].image);
	}
	free(stack->image);
	free(stack->spikes);
	free(stack->levels);
	free(stack);
}

static double mean_of(const struct scatter_images *images, const float *image)
{
	const int pixels = images->columns * images->rows;
	double sum = 0;

	for (int i = 0; i < pixels; i++)
		sum += (double)image[i];
	return sum / pixels;
}

/* The image of the source's, which takes the place of one that is not `other`. */
static int read_image(struct scatter_stack *stack, int at, int other, const float **ret_image, struct error *err)
{
	const int slot = stack->read[0].at == at || (stack->read[1].at != at && stack->read[0].at != other) ? 0 : 1;
	int code = 0;

	if (stack->read[slot].at != at) {
		stack->read[slot].at = -1;
		code = stack->source->read(stack->source->context, at, stack->read[slot].image, err);
		if (code == 0)
			code = scatter_spikes_replace(stack->read[slot].image, stack->images.columns,
						      stack->images.rows, &stack->spikes[at], err);
		if (code == 0)
			stack->levels[at] = mean_of(&stack->images, stack->read[slot].image);
	}
	if (code == 0) {
		stack->read[slot].at = at;
		*ret_image = stack->read[slot].image;
	}
	return code;
}

int scatter_stack_take(struct scatter_stack *stack, int projection, struct error *err)
{
	const struct scatter_source *source = stack->source;
	const size_t pixels = (size_t)stack->images.columns * (size_t)stack->images.rows;
	const float *before, *behind;
	int first = 0, last, code;
	float share = 0;

	while (first + 1 < source->count && source->projections[first + 1] <= projection)
		first++;
	last = projection > source->projections[first] && first + 1 < source->count ? first + 1 : first;
	code = read_image(stack, first, last, &before, err);
	if (code == 0)
		code = read_image(stack, last, first, &behind, err);
	if (code < 0)
		return code;
	if (last > first)
		share = (float)(projection - source->projections[first]) /
			(float)(source->projections[last] - source->projections[first]);
	for (size_t i = 0; i < pixels; i++)
		stack->image[i] = before[i] + share * (behind[i] - before[i]);
	return 0;
}

void scatter_stack_row(const struct scatter_stack *stack, int row, float *ret_row)
{
	const struct parts *down = &stack->along[1][row];
	const size_t columns = (size_t)stack->images.columns;
	float line[SCATTER_IMAGE_MOST];

	memset(line, 0, columns * sizeof(*line));
	for (int k = 0; k < down->count; k++) {
		const float *image = stack->image + (size_t)(down->first + k) * columns;

		for (size_t c = 0; c < columns; c++)
			line[c] += down->share[k] * image[c];
	}
	for (int i = 0; i < stack->count[0]; i++) {
		const struct parts *across = &stack->along[0][i];
		float sum = 0;

		for (int k = 0; k < across->count; k++)
			sum += across->share[k] * line[across->first + k];
		ret_row[i] = sum;
	}
}

size_t scatter_stack_spikes(const struct scatter_stack *stack, int *ret_images, int *ret_first)
{
	size_t spikes = 0;

	*ret_images = 0;
	*ret_first = -1;
	for (int at = stack->source->count - 1; at >= 0; at--) {
		spikes += stack->spikes[at];
		*ret_images += stack->spikes[at] > 0;
		if (stack->spikes[at] > 0)
			*ret_first = stack->source->projections[at];
	}
	return spikes;
}

double scatter_stack_level(const struct scatter_stack *stack, int at)
{
	return stack->levels[at];
}

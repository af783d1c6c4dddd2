/* Images of scattered radiation between views and between pixels: see scatter_images.h. */
#include "core/correct/scatter_images.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Where a pixel lies among those of an image, along one axis. */
struct between {
	int first;   /* the one before it, or the last but one */
	float share; /* of the one behind */
};

struct scatter_stack {
	struct scatter_images images;
	const struct scatter_source *source;
	int count[2]; /* pixels along a row and a column */
	struct between *along[2];
	struct {
		int at; /* of the source's; -1: none yet */
		float *image;
	} read[2];
	float *image; /* of the projection */
};

static void place_pixels(struct between *ret, int count, int first, int size, int detector, int most)
{
	for (int i = 0; i < count; i++) {
		const double at = (first + (i + 0.5) * size) * most / detector - 0.5;
		const double within = fmin(fmax(at, 0), most - 1);

		ret[i].first = within < most - 1 || most == 1 ? (int)within : most - 2;
		ret[i].share = (float)(within - ret[i].first);
	}
}

int scatter_stack_new(const struct scatter_images *images, const struct scatter_source *source,
		      const struct pixel_blocks *blocks, const int detector[2], struct scatter_stack **ret_stack,
		      struct error *err)
{
	const int most[2] = {images->columns, images->rows};
	struct scatter_stack *stack;

	if (source == NULL || source->count == 0)
		return error_set(err, ERR_IMPOSSIBLE, "no projection of the scan has an image of its scatter");
	stack = calloc(1, sizeof(*stack));
	if (stack == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for images of scatter");
	stack->images = *images;
	stack->source = source;
	stack->image = malloc(scatter_image_bytes(images));
	for (int i = 0; i < 2; i++) {
		stack->count[i] = blocks->count[i];
		stack->along[i] = malloc((size_t)blocks->count[i] * sizeof(struct between));
		stack->read[i].at = -1;
		stack->read[i].image = malloc(scatter_image_bytes(images));
	}
	if (stack->image == NULL || stack->along[0] == NULL || stack->along[1] == NULL ||
	    stack->read[0].image == NULL || stack->read[1].image == NULL) {
		scatter_stack_free(stack);
		return error_set(err, ERR_NO_MEMORY, "no memory for images of %zu bytes", scatter_image_bytes(images));
	}
	for (int i = 0; i < 2; i++)
		place_pixels(stack->along[i], blocks->count[i], blocks->first[i], blocks->size[i], detector[i],
			     most[i]);
	*ret_stack = stack;
	return 0;
}

void scatter_stack_free(struct scatter_stack *stack)
{
	if (stack == NULL)
		return;
	for (int i = 0; i < 2; i++) {
		free(stack->along[i]);
		free(stack->read[i].image);
	}
	free(stack->image);
	free(stack);
}

/* The image of the source's, which takes the place of one that is not `other`. */
static int read_image(struct scatter_stack *stack, int at, int other, const float **ret_image, struct error *err)
{
	const int slot = stack->read[0].at == at || (stack->read[1].at != at && stack->read[0].at != other) ? 0 : 1;
	int code = 0;

	if (stack->read[slot].at != at) {
		stack->read[slot].at = -1;
		code = stack->source->read(stack->source->context, at, stack->read[slot].image, err);
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
	const struct between *at = &stack->along[1][row];
	const float *above = stack->image + (size_t)at->first * (size_t)stack->images.columns;
	const float *below = above + (stack->images.rows > 1 ? stack->images.columns : 0);
	const int next = stack->images.columns > 1;

	for (int i = 0; i < stack->count[0]; i++) {
		const struct between *across = &stack->along[0][i];
		const int c = across->first;
		const float first = above[c] + across->share * (above[c + next] - above[c]);
		const float second = below[c] + across->share * (below[c + next] - below[c]);

		ret_row[i] = first + at->share * (second - first);
	}
}

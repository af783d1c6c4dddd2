/* A scan in bins and with some of its views: see reduced.h. */
#include "core/refine/reduced.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const double PI = 3.14159265358979323846;

struct place {
	double angle; /* radians from the first view on, in the direction of the rotation */
	int view;
};

static int compare_places(const void *a, const void *b)
{
	const struct place *x = a, *y = b;

	return x->angle != y->angle ? (x->angle > y->angle) - (x->angle < y->angle)
				    : (x->view > y->view) - (x->view < y->view);
}

/* Spreads the views over those of the orbit, by the angle. */
static int choose_views(struct reduced *reduced, const struct orbit *orbit, struct error *err)
{
	struct place *places = malloc((size_t)orbit->count * sizeof(*places));

	if (places == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the order of %d views", orbit->count);
	for (int i = 0; i < orbit->count; i++) {
		const double turn = (orbit->angle[i] - orbit->angle[orbit->first]) * orbit->direction;

		places[i] = (struct place){turn < 0 ? turn + 2 * PI : turn, i};
		reduced->index[i] = -1;
	}
	qsort(places, (size_t)orbit->count, sizeof(*places), compare_places);
	for (int i = 0; i < reduced->geometry.count; i++) {
		const int view = places[(long long)i * orbit->count / reduced->geometry.count].view;

		reduced->views[i] = view;
		reduced->index[view] = i;
	}
	free(places);
	return 0;
}

/* Pixels of a bin, a whole number of them; pixels left over at the far side belong to none. */
static int pixels_of_a_bin(int pixels, int bins)
{
	return (pixels + bins - 1) / bins;
}

static struct view view_in_bins(const struct view *view, int across, int along)
{
	struct view ret = *view;

	for (int i = 0; i < 3; i++) {
		ret.pixel0[i] += 0.5 * (across - 1) * view->column_step[i] + 0.5 * (along - 1) * view->row_step[i];
		ret.column_step[i] *= across;
		ret.row_step[i] *= along;
	}
	return ret;
}

int reduced_open(struct reduced *ret_reduced, const struct geometry *geometry, const struct orbit *orbit, int views,
		 int bins, struct error *err)
{
	const int count = geometry->count < views ? geometry->count : views;
	const int across = pixels_of_a_bin(geometry->columns, bins), along = pixels_of_a_bin(geometry->rows, bins);
	struct reduced reduced = {
	    .geometry = {.columns = geometry->columns / across, .rows = geometry->rows / along, .count = count},
	    .columns = geometry->columns,
	    .rows = geometry->rows,
	    .all = geometry->count,
	    .pixels_of_a_bin = {across, along},
	    .views = malloc((size_t)count * sizeof(int)),
	    .index = malloc((size_t)geometry->count * sizeof(int)),
	};
	const size_t pixels = (size_t)reduced.geometry.columns * (size_t)reduced.geometry.rows;
	int code = 0;

	reduced.geometry.views = malloc((size_t)count * sizeof(struct view));
	reduced.projections = calloc((size_t)count * pixels, sizeof(float));
	reduced.known = calloc((size_t)count, sizeof(bool));
	if (reduced.views == NULL || reduced.index == NULL || reduced.geometry.views == NULL ||
	    reduced.projections == NULL || reduced.known == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views in bins", count);
	if (code == 0)
		code = choose_views(&reduced, orbit, err);
	for (int i = 0; i < count && code == 0; i++)
		reduced.geometry.views[i] = view_in_bins(&geometry->views[reduced.views[i]], across, along);
	if (code < 0)
		reduced_clear(&reduced);
	else
		*ret_reduced = reduced;
	return code;
}

/* The mean of two by two bins of a view, [row][column] of `columns` bins. */
static void halve_view(const float *from, int columns, const struct geometry *half, float *ret)
{
	for (int r = 0; r < half->rows; r++)
		for (int c = 0; c < half->columns; c++) {
			const float *bins = from + (size_t)(2 * r) * (size_t)columns + 2 * c;

			*ret++ = (bins[0] + bins[1] + bins[columns] + bins[columns + 1]) / 4;
		}
}

int reduced_halve(const struct reduced *reduced, struct reduced *ret_half, struct error *err)
{
	const struct geometry *fine = &reduced->geometry;
	const size_t count = (size_t)fine->count, all = (size_t)reduced->all;
	const size_t bins = (size_t)fine->columns * (size_t)fine->rows;
	struct reduced half = *reduced;
	size_t pixels;
	int code;

	half.geometry = (struct geometry){0};
	half.views = malloc(count * sizeof(int));
	half.index = malloc(all * sizeof(int));
	half.projections = malloc(count * bins / 4 * sizeof(float));
	half.known = malloc(count * sizeof(bool));
	code = geometry_copy(&half.geometry, fine, err);
	if (code == 0 && (half.views == NULL || half.index == NULL || half.projections == NULL || half.known == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views in bins", fine->count);
	if (code < 0) {
		reduced_clear(&half);
		return code;
	}
	half.geometry.columns = fine->columns / 2;
	half.geometry.rows = fine->rows / 2;
	pixels = (size_t)half.geometry.columns * (size_t)half.geometry.rows;
	for (int a = 0; a < 2; a++)
		half.pixels_of_a_bin[a] *= 2;
	memcpy(half.views, reduced->views, count * sizeof(int));
	memcpy(half.index, reduced->index, all * sizeof(int));
	memcpy(half.known, reduced->known, count * sizeof(bool));
#pragma omp parallel for schedule(static)
	for (int k = 0; k < fine->count; k++) {
		half.geometry.views[k] = view_in_bins(&fine->views[k], 2, 2);
		halve_view(reduced->projections + (size_t)k * bins, fine->columns, &half.geometry,
			   half.projections + (size_t)k * pixels);
	}
	*ret_half = half;
	return 0;
}

void reduced_clear(struct reduced *reduced)
{
	geometry_clear(&reduced->geometry);
	free(reduced->views);
	free(reduced->index);
	free(reduced->projections);
	free(reduced->known);
	*reduced = (struct reduced){0};
}

size_t reduced_bytes(const struct geometry *geometry, int views, int bins)
{
	const size_t count = (size_t)(geometry->count < views ? geometry->count : views);
	const size_t columns = (size_t)(geometry->columns / pixels_of_a_bin(geometry->columns, bins));
	const size_t rows = (size_t)(geometry->rows / pixels_of_a_bin(geometry->rows, bins));

	return sizeof(float) * count * columns * rows + sizeof(int) * (count + (size_t)geometry->count) +
	       (sizeof(struct view) + sizeof(bool)) * count;
}

double reduced_bin(const struct reduced *reduced, const struct orbit *orbit)
{
	return sqrt(orbit->pixel_at_isocentre[0] * reduced->pixels_of_a_bin[0] * orbit->pixel_at_isocentre[1] *
		    reduced->pixels_of_a_bin[1]);
}

bool reduced_wants(const struct reduced *reduced, int view)
{
	return reduced->index[view] >= 0;
}

void reduced_take(struct reduced *reduced, int view, const float *projection)
{
	const int columns = reduced->geometry.columns, rows = reduced->geometry.rows, index = reduced->index[view];
	const int across = reduced->pixels_of_a_bin[0], along = reduced->pixels_of_a_bin[1];
	const float share = 1.0f / (float)(across * along);
	float *to = reduced->projections + (size_t)index * (size_t)columns * (size_t)rows;
	int lost = 0;

#pragma omp parallel for schedule(static) reduction(+ : lost)
	for (int r = 0; r < rows; r++) {
		float *sums = to + (size_t)r * (size_t)columns;

		memset(sums, 0, (size_t)columns * sizeof(*sums));
		for (int j = 0; j < along; j++) {
			const float *row =
			    projection + ((size_t)r * (size_t)along + (size_t)j) * (size_t)reduced->columns;

			for (int c = 0; c < columns; c++)
				for (int i = 0; i < across; i++)
					sums[c] += row[c * across + i];
		}
		for (int c = 0; c < columns; c++) {
			sums[c] *= share;
			lost += !isfinite(sums[c]);
		}
	}
	reduced->known[index] = true;
	if (lost > 0)
		reduced_leave_out(reduced, view);
}

void reduced_leave_out(struct reduced *reduced, int view)
{
	const size_t pixels = (size_t)reduced->geometry.columns * (size_t)reduced->geometry.rows;
	const int index = reduced->index[view];

	if (index < 0)
		return;
	reduced->known[index] = false;
	memset(reduced->projections + (size_t)index * pixels, 0, pixels * sizeof(float));
}

/* Alternation from slice to slice that views hardly see: see alternation.h. */
#include "core/recon/alternation.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* So many views are asked at most. */
enum { VIEWS = 24 };
/*
 * The weights stand on a lattice of places this many voxels apart, or more on a grid of more than NODES_MOST of them a
 * side; each is the mean of those beside it.
 */
enum { STEP_LEAST = 8, NODES_MOST = 32 };
/* Rows per slice. Beyond these, rows and slices fall in and out of step within a few slices: of more rows there is
 * enough for every slice, and of fewer a slice's own height is seen by none. */
static const double ROWS_LEAST = 0.7, ROWS_MOST = 1.6;
/* A slice whose body is smaller says nothing. */
enum { BODY_LEAST = 16 };
/* Shares of water's density: what is told, 40 HU, and T of alternation.h. */
static const double LITTLE = 0.04, DOUBT = 0.02;
/* L of a, in parts of w; and the visibility from which on nothing is taken out as it is. */
static const double STRENGTH = 0.6, UNSEEN = 0.2;
/* Voxels to either side, of the means that are asked and of the most of them; and slices. */
enum { MEAN = 3, SPREAD = 3, SPREAD_SLICES = 2 };
/* Slices at hand at a time, and those of them to either side that are only looked at. */
enum { INNER = 24, MARGIN = 12, WINDOW = INNER + 2 * MARGIN };
/* Columns beside each other that are asked at a time. */
enum { CHUNK = 64 };
/* Of the alternating direction method of multipliers, and the weight of its constraint. */
enum { STEPS = 20 };
static const double CONSTRAINT = 0.5;
/* The least that H may have, so that a column has one answer. */
static const double LEAST_SEEN = 0.05;

struct alternation {
	int size[3];
	int step;        /* of the lattice, in voxels */
	int nodes[2];    /* along x and y */
	double mu_water; /* 1/mm */
	bool nonnegative;
	float *weight; /* [z][node y][node x]: w */
	float *values; /* [WINDOW] slices of V */
	float *found;  /* [WINDOW] slices: means of A V, a, then V' */
	float *work;   /* a slice */
};

/* A stretch of slices: those from `first` to before `last` are asked for, and `count` from `begin` on are at hand. */
struct stretch {
	int first, last, begin, count;
};

/* ---- what views see ---- */

/* Some of a scan's views, VIEWS at most. */
struct sights {
	int count, columns, rows;
	double matrix[VIEWS][12];
};

static void sights_make(const struct geometry *geometry, int most, struct sights *ret)
{
	const int every = (geometry->count - 1) / most + 1;

	*ret = (struct sights){.columns = geometry->columns, .rows = geometry->rows};
	for (int view = 0; view < geometry->count; view += every)
		view_matrix(&geometry->views[view], ret->matrix[ret->count++]);
}

/* Adds the rows of one view at this place: the sum of (1 - |s|) (1 - 2 |s|)^2, and that of the weights. */
static bool add_view(const struct sights *sights, int view, const double world[3], double height, double sums[2])
{
	const double above[3] = {world[0], world[1], world[2] + height};
	double column, row, next, column_above;

	if (!(view_project(sights->matrix[view], world, &column, &row) > 0) ||
	    !(view_project(sights->matrix[view], above, &column_above, &next) > 0))
		return true;
	if (column < 0 || row < 0 || column > sights->columns - 1 || row > sights->rows - 1)
		return true;
	if (fabs(next - row) < ROWS_LEAST || fabs(next - row) > ROWS_MOST)
		return false;
	for (int k = -1; k <= 2; k++) {
		const double s = fabs(floor(row) + k - row) / fabs(next - row);

		if (s >= 1)
			continue;
		sums[0] += (1 - s) * (1 - 2 * s) * (1 - 2 * s);
		sums[1] += 1 - s;
	}
	return true;
}

static double visibility(const struct sights *sights, const struct grid *grid, const double place[3])
{
	double world[3], sums[2] = {0, 0};

	for (int a = 0; a < 3; a++)
		world[a] = grid->origin[a] + place[a] * grid->spacing[a];
	for (int view = 0; view < sights->count; view++)
		if (!add_view(sights, view, world, grid->spacing[2], sums))
			return 1;
	return sums[1] > 0 ? sums[0] / sums[1] : 1;
}

double alternation_visibility(const struct geometry *geometry, const struct grid *grid, const double place[3])
{
	struct sights sights;

	sights_make(geometry, VIEWS, &sights);
	return visibility(&sights, grid, place);
}

static int held(int index, int count)
{
	return index < 0 ? 0 : index < count ? index : count - 1;
}

/*
 * The weights of a slice, from the visibility at its nodes [y][x]. Near the axis of the cone all views agree, but what
 * is narrower than the lattice is not held apart from the rest. Returns whether there are any.
 */
static bool weigh_slice(const struct alternation *alternation, const float *seen, float *ret_weight)
{
	const int *nodes = alternation->nodes;
	bool any = false;

	for (int y = 0; y < nodes[1]; y++)
		for (int x = 0; x < nodes[0]; x++) {
			const float *row = seen + (size_t)y * (size_t)nodes[0];
			const double mean =
			    0.25 * ((double)row[held(x - 1, nodes[0])] + (double)row[held(x + 1, nodes[0])] +
				    (double)seen[(size_t)held(y - 1, nodes[1]) * (size_t)nodes[0] + (size_t)x] +
				    (double)seen[(size_t)held(y + 1, nodes[1]) * (size_t)nodes[0] + (size_t)x]);

			ret_weight[(size_t)y * (size_t)nodes[0] + (size_t)x] = (float)fmax(0, 1 - mean);
			any = any || mean < 1;
		}
	return any;
}

/* Whether any place has a weight. What is seen is worked out behind the weights. */
static bool find_weights(struct alternation *alternation, const struct geometry *geometry, const struct grid *grid)
{
	const int *nodes = alternation->nodes, step = alternation->step, slices = alternation->size[2];
	const size_t count = (size_t)nodes[0] * (size_t)nodes[1];
	float *all_seen = alternation->weight + (size_t)slices * count;
	struct sights sights;
	bool any = false;

	sights_make(geometry, VIEWS, &sights);
#pragma omp parallel for schedule(dynamic) reduction(|| : any)
	for (int z = 0; z < slices; z++) {
		float *seen = all_seen + (size_t)z * count;

		for (int y = 0; y < nodes[1]; y++)
			for (int x = 0; x < nodes[0]; x++) {
				const double place[3] = {fmin(x * step, alternation->size[0] - 1),
							 fmin(y * step, alternation->size[1] - 1), z};

				seen[(size_t)y * (size_t)nodes[0] + (size_t)x] =
				    (float)visibility(&sights, grid, place);
			}
		any = weigh_slice(alternation, seen, alternation->weight + (size_t)z * count) || any;
	}
	return any;
}

/* ---- life ---- */

static int step_of(const struct grid *grid)
{
	const int side = grid->size[0] > grid->size[1] ? grid->size[0] : grid->size[1];

	return side > STEP_LEAST * NODES_MOST ? (side - 1) / NODES_MOST + 1 : STEP_LEAST;
}

static int nodes_along(int voxels, int step)
{
	return (voxels - 1) / step + 2;
}

static size_t weights_of(const struct grid *grid)
{
	const int step = step_of(grid);

	return (size_t)nodes_along(grid->size[0], step) * (size_t)nodes_along(grid->size[1], step) *
	       (size_t)grid->size[2];
}

static size_t pixels_of(const int size[3])
{
	return (size_t)size[0] * (size_t)size[1];
}

/* Slices at hand at most. */
static size_t window_of(const int size[3])
{
	return (size_t)(size[2] < WINDOW ? size[2] : WINDOW);
}

size_t alternation_bytes(const struct grid *grid)
{
	return sizeof(float) * (2 * weights_of(grid) + (2 * window_of(grid->size) + 1) * pixels_of(grid->size));
}

/* Whether the rows that pass the grid's centre are about as far apart as its slices. */
static bool may_alternate(const struct geometry *geometry, const struct grid *grid)
{
	const double centre[3] = {(grid->size[0] - 1) / 2, (grid->size[1] - 1) / 2, (grid->size[2] - 1) / 2};
	double world[3], sums[2] = {0, 0};
	struct sights first;

	sights_make(geometry, 1, &first);
	for (int a = 0; a < 3; a++)
		world[a] = grid->origin[a] + centre[a] * grid->spacing[a];
	return grid->size[2] > 2 && geometry->rows > 1 && add_view(&first, 0, world, grid->spacing[2], sums);
}

int alternation_new(const struct grid *grid, const struct geometry *geometry, double mu_water, bool nonnegative,
		    struct alternation **ret_alternation, struct error *err)
{
	struct alternation *alternation;

	if (!may_alternate(geometry, grid))
		return 0;
	alternation = malloc(sizeof(*alternation));
	if (alternation == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for some slices");
	*alternation = (struct alternation){
	    .size = {grid->size[0], grid->size[1], grid->size[2]},
	    .step = step_of(grid),
	    .nodes = {nodes_along(grid->size[0], step_of(grid)), nodes_along(grid->size[1], step_of(grid))},
	    .mu_water = mu_water,
	    .nonnegative = nonnegative,
	    .weight = calloc(alternation_bytes(grid), 1),
	};
	if (alternation->weight == NULL) {
		free(alternation);
		return error_set(err, ERR_NO_MEMORY, "no memory for some slices");
	}
	alternation->values = alternation->weight + 2 * weights_of(grid);
	alternation->found = alternation->values + window_of(grid->size) * pixels_of(grid->size);
	alternation->work = alternation->found + window_of(grid->size) * pixels_of(grid->size);
	if (!find_weights(alternation, geometry, grid)) {
		alternation_free(alternation);
		return 0;
	}
	*ret_alternation = alternation;
	return 0;
}

void alternation_free(struct alternation *alternation)
{
	if (alternation == NULL)
		return;
	free(alternation->weight);
	free(alternation);
}

/* ---- what alternates ---- */

/* Between the nodes of slice z. */
static double weight_between(const struct alternation *alternation, int x, int y, int z)
{
	const int *nodes = alternation->nodes, step = alternation->step;
	const float *at = alternation->weight + ((size_t)z * (size_t)nodes[1] + (size_t)(y / step)) * (size_t)nodes[0] +
			  (size_t)(x / step);
	const double u = (double)(x % step) / step, v = (double)(y % step) / step;

	return (1 - v) * ((1 - u) * (double)at[0] + u * (double)at[1]) +
	       v * ((1 - u) * (double)at[nodes[0]] + u * (double)at[nodes[0] + 1]);
}

/* A V of slice k of the stretch; beyond its ends it goes on as it is. */
static void away_of(const struct alternation *alternation, int count, int k, float *ret_away)
{
	const size_t pixels = pixels_of(alternation->size);
	const float *here = alternation->values + (size_t)k * pixels;
	const float *before = k > 0 ? here - pixels : here, *behind = k + 1 < count ? here + pixels : here;

#pragma omp parallel for simd schedule(static)
	for (size_t i = 0; i < pixels; i++)
		ret_away[i] = (2 * here[i] - before[i] - behind[i]) / 4;
}

/* Sums over MEAN to either side in a row that goes on as at its ends. */
static void sum_row(const float *row, int columns, float *ret_sums)
{
	for (int x = 0; x < columns; x++) {
		float sum = 0;

		if (x >= MEAN && x < columns - MEAN)
			continue;
		for (int k = -MEAN; k <= MEAN; k++)
			sum += row[held(x + k, columns)];
		ret_sums[x] = sum;
	}
	for (int x = MEAN; x < columns - MEAN; x++) {
		float sum = 0;

		for (int k = -MEAN; k <= MEAN; k++)
			sum += row[x + k];
		ret_sums[x] = sum;
	}
}

/* The mean over voxels of a slice, in place; beyond its edges it goes on as there. */
static void mean_around(const struct alternation *alternation, float *slice)
{
	const int columns = alternation->size[0], rows = alternation->size[1];
	const float share = 1.0f / ((2 * MEAN + 1) * (2 * MEAN + 1));
	float *work = alternation->work;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		sum_row(slice + (size_t)y * (size_t)columns, columns, work + (size_t)y * (size_t)columns);
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++) {
		float *row = slice + (size_t)y * (size_t)columns;

		memset(row, 0, (size_t)columns * sizeof(*row));
		for (int k = -MEAN; k <= MEAN; k++) {
			const float *beside = work + (size_t)held(y + k, rows) * (size_t)columns;

			for (int x = 0; x < columns; x++)
				row[x] += share * beside[x];
		}
	}
}

/* The most of the voxels around of a slice, in place. */
static void most_around(const struct alternation *alternation, float *slice)
{
	const int columns = alternation->size[0], rows = alternation->size[1];
	float *work = alternation->work;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const float *row = slice + (size_t)y * (size_t)columns;
			float most = 0;

			for (int k = -SPREAD; k <= SPREAD; k++)
				most = fmaxf(most, row[held(x + k, columns)]);
			work[(size_t)y * (size_t)columns + (size_t)x] = most;
		}
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++) {
		float *row = slice + (size_t)y * (size_t)columns;

		memset(row, 0, (size_t)columns * sizeof(*row));
		for (int k = -SPREAD; k <= SPREAD; k++) {
			const float *beside = work + (size_t)held(y + k, rows) * (size_t)columns;

			for (int x = 0; x < columns; x++)
				row[x] = beside[x] > row[x] ? beside[x] : row[x];
		}
	}
}

/*
 * a of columns beside each other, from the means of A V there: the most of the threes that a slice or one near it is
 * in. Returns whether any is more than the doubt.
 */
static bool columns_alternate(float *columns, int wide, size_t apart, int count, float doubt)
{
	float away[WINDOW][CHUNK], least[WINDOW][CHUNK] = {{0}};
	bool any = false;

	for (int k = 0; k < count; k++)
		memcpy(away[k], columns + (size_t)k * apart, (size_t)wide * sizeof(float));
	for (int k = 1; k + 1 < count; k++)
		for (int x = 0; x < wide; x++) {
			const float before = away[k - 1][x], here = away[k][x], behind = away[k + 1][x];
			const float two = fabsf(before) < fabsf(behind) ? fabsf(before) : fabsf(behind);
			const float three = fabsf(here) < two ? fabsf(here) : two;

			least[k][x] = before * here < 0 && here * behind < 0 ? three : 0;
			any = any || least[k][x] > doubt;
		}
	for (int k = 0; k < count; k++) {
		float *most = columns + (size_t)k * apart;
		const int last = held(k + 1 + SPREAD_SLICES, count);

		memset(most, 0, (size_t)wide * sizeof(*most));
		for (int i = held(k - 1 - SPREAD_SLICES, count); i <= last && any; i++)
			for (int x = 0; x < wide; x++)
				most[x] = least[i][x] > most[x] ? least[i][x] : most[x];
	}
	return any;
}

/* a of a stretch's voxels; false where nothing alternates by more than the doubt. */
static bool find_alternation(const struct alternation *alternation, const struct stretch *stretch)
{
	const int columns = alternation->size[0], rows = alternation->size[1];
	const size_t pixels = pixels_of(alternation->size);
	const float doubt = (float)(DOUBT * alternation->mu_water / 2);
	bool any = false;

	for (int k = 0; k < stretch->count; k++) {
		away_of(alternation, stretch->count, k, alternation->found + (size_t)k * pixels);
		mean_around(alternation, alternation->found + (size_t)k * pixels);
	}
#pragma omp parallel for schedule(static) reduction(|| : any)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x += CHUNK) {
			float *at = alternation->found + (size_t)y * (size_t)columns + (size_t)x;
			const int wide = columns - x < CHUNK ? columns - x : CHUNK;

			any = columns_alternate(at, wide, pixels, stretch->count, doubt) || any;
		}
	for (int k = 0; k < stretch->count && any; k++)
		most_around(alternation, alternation->found + (size_t)k * pixels);
	return any;
}

/* ---- a column ---- */

/* What the minimum of a column is asked of. */
struct column {
	int count;
	double values[WINDOW]; /* U */
	double weight[WINDOW]; /* w */
	double bound[WINDOW];  /* L of the face behind a slice */
};

/* Adds f of the difference at each face to the slice behind it, and takes it from the one before. */
static void add_differences(int count, const double *of_face, double *values)
{
	for (int k = 0; k + 1 < count; k++) {
		values[k] -= of_face[k];
		values[k + 1] += of_face[k];
	}
}

/* H + CONSTRAINT D'D is tridiagonal (D takes differences): its factors. */
static void factorise(const struct column *column, const double *share, double *ret_pivot, double *ret_ratio)
{
	for (int k = 0; k < column->count; k++) {
		double diagonal = 1;

		if (k > 0)
			diagonal += CONSTRAINT - share[k - 1];
		if (k + 1 < column->count)
			diagonal += CONSTRAINT - share[k];
		if (k > 0)
			diagonal -= ret_ratio[k - 1] * (share[k - 1] - CONSTRAINT);
		ret_pivot[k] = diagonal;
		if (k + 1 < column->count)
			ret_ratio[k] = (share[k] - CONSTRAINT) / diagonal;
	}
}

static void substitute(int count, const double *pivot, const double *ratio, double *x)
{
	for (int k = 1; k < count; k++)
		x[k] -= ratio[k - 1] * x[k - 1];
	for (int k = 0; k < count; k++)
		x[k] /= pivot[k];
	for (int k = count - 2; k >= 0; k--)
		x[k] -= ratio[k] * x[k + 1];
}

/* V' of a column: Boyd et al., Found. Trends Mach. Learn. 3, 2011, ch. 6.4.1, with H in place of the identity. */
static void settle_column(const struct column *column, double *ret_x)
{
	const int count = column->count;
	double share[WINDOW], pivot[WINDOW], ratio[WINDOW], asked[WINDOW], split[WINDOW], scaled[WINDOW] = {0};

	for (int k = 0; k + 1 < count; k++) {
		share[k] = fmin((column->weight[k] + column->weight[k + 1]) / 2, 1 - LEAST_SEEN) / 4;
		split[k] = column->values[k + 1] - column->values[k];
		asked[k] = -share[k] * split[k];
	}
	factorise(column, share, pivot, ratio);
	for (int step = 0; step < STEPS; step++) {
		double face[WINDOW];

		memcpy(ret_x, column->values, (size_t)count * sizeof(*ret_x));
		for (int k = 0; k + 1 < count; k++)
			face[k] = asked[k] + CONSTRAINT * (split[k] - scaled[k]);
		add_differences(count, face, ret_x);
		substitute(count, pivot, ratio, ret_x);
		for (int k = 0; k + 1 < count; k++) {
			const double there = ret_x[k + 1] - ret_x[k] + scaled[k];
			const double beyond = fmax(fabs(there) - column->bound[k] / CONSTRAINT, 0);

			split[k] = copysign(beyond, there);
			scaled[k] = there - split[k];
		}
	}
}

/* Takes of the values what alternates, each slice's share of it. */
static void take_unseen(int count, const double *share, double *values)
{
	double before = values[0];

	for (int k = 0; k < count; k++) {
		const double here = values[k], behind = k + 1 < count ? values[k + 1] : here;

		values[k] -= share[k] * (2 * here - before - behind) / 4;
		before = here;
	}
}

/* Fills in the column of a pixel; false where nothing alternates in it. */
static bool read_column(const struct alternation *alternation, const struct stretch *stretch, int x, int y,
			struct column *ret_column)
{
	const size_t pixels = pixels_of(alternation->size);
	const size_t i = (size_t)y * (size_t)alternation->size[0] + (size_t)x;
	const double doubt = DOUBT * alternation->mu_water / 2;
	double unseen[WINDOW], bound[WINDOW];
	bool any = false;

	for (int k = 0; k < stretch->count && !any; k++)
		any = (double)alternation->found[(size_t)k * pixels + i] > doubt;
	for (int k = 0; k < stretch->count && any; k++) {
		const double a = (double)alternation->found[(size_t)k * pixels + i], e = fmax(a - doubt, 0);
		const double weight = weight_between(alternation, x, y, stretch->begin + k);
		const double sure = e * e / (e * e + doubt * doubt);

		unseen[k] = sure * fmax(0, 1 - (1 - weight) / UNSEEN);
		bound[k] = STRENGTH * weight * (1 - unseen[k]) * a * sure;
		ret_column->weight[k] = weight;
		ret_column->values[k] = (double)alternation->values[(size_t)k * pixels + i];
	}
	if (!any)
		return false;
	ret_column->count = stretch->count;
	for (int k = 0; k + 1 < stretch->count; k++)
		ret_column->bound[k] = (bound[k] + bound[k + 1]) / 2;
	take_unseen(stretch->count, unseen, ret_column->values);
	return true;
}

/* V' of a stretch in place of a. */
static void settle(const struct alternation *alternation, const struct stretch *stretch)
{
	const size_t pixels = pixels_of(alternation->size);

#pragma omp parallel for schedule(dynamic)
	for (int y = 0; y < alternation->size[1]; y++)
		for (int x = 0; x < alternation->size[0]; x++) {
			const size_t i = (size_t)y * (size_t)alternation->size[0] + (size_t)x;
			struct column column;
			double settled[WINDOW];
			const bool any = read_column(alternation, stretch, x, y, &column);

			if (any)
				settle_column(&column, settled);
			for (int k = 0; k < stretch->count; k++) {
				float *at = alternation->found + (size_t)k * pixels + i;

				*at = any ? (float)settled[k] : alternation->values[(size_t)k * pixels + i];
				if (any && alternation->nonnegative)
					*at = fmaxf(*at, 0);
			}
		}
}

/* ---- a volume that is kept ---- */

/* Slice k of the stretch. */
static void measure_slice(const struct alternation *alternation, int k, struct alternation_report *report)
{
	const size_t pixels = pixels_of(alternation->size);
	const float *before = alternation->values + (size_t)k * pixels,
		    *after = alternation->found + (size_t)k * pixels;
	double sum = 0;
	size_t count = 0;

	for (size_t i = 0; i < pixels; i++) {
		if (!((double)fmaxf(before[i], after[i]) > 0.5 * alternation->mu_water))
			continue;
		sum += fabs((double)after[i] - (double)before[i]);
		count++;
	}
	if (count < BODY_LEAST)
		return;
	report->slices += sum > LITTLE * alternation->mu_water * (double)count;
	report->change = fmax(report->change, sum / (double)count);
}

static int show_stretch(struct alternation *alternation, const struct stretch *stretch, const struct backend *backend,
			struct volume *from, struct volume *to, struct alternation_report *report, struct error *err)
{
	const size_t pixels = pixels_of(alternation->size), bytes = pixels * sizeof(float);
	int code = backend->volume_download(from, stretch->begin, stretch->count, alternation->values, err);

	if (code < 0)
		return code;
	if (!find_alternation(alternation, stretch))
		return 0;
	settle(alternation, stretch);
	for (int z = stretch->first; z < stretch->last && code == 0; z++) {
		const size_t k = (size_t)(z - stretch->begin);
		const float *after = alternation->found + k * pixels;

		if (memcmp(alternation->values + k * pixels, after, bytes) == 0)
			continue;
		report->changed = true;
		measure_slice(alternation, (int)k, report);
		code = backend->volume_put(to, z, 1, after, err);
	}
	return code;
}

int alternation_show(struct alternation *alternation, const struct backend *backend, struct volume *from,
		     struct volume *to, struct alternation_report *ret_report, struct error *err)
{
	const int slices = alternation->size[2];
	struct alternation_report report = {0};
	int code = 0;

	for (int first = 0; first < slices && code == 0;) {
		const int begin = first > MARGIN ? first - MARGIN : 0;
		const int end = begin + WINDOW < slices ? begin + WINDOW : slices;
		const int last = end < slices ? end - MARGIN : slices;
		const struct stretch stretch = {first, last, begin, end - begin};

		code = show_stretch(alternation, &stretch, backend, from, to, &report, err);
		first = last;
	}
	if (code == 0)
		*ret_report = report;
	return code;
}

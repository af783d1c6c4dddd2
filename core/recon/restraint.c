/* How far the default's iterations are followed: see restraint.h. */
#include "core/recon/restraint.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/restraint_places.h"

/* Voxels a side of a cube; so many cubes say something, so many across. */
enum { CELL = PLACE_CELL, CELLS_LEAST = 16, ACROSS_LEAST = 4 };
/* Layers of cubes that are asked for their roughness, at most: the others are left out evenly. */
enum { LAYERS_MOST = 24 };
/* c beside the volume there, in thousandths; and the noise that values differ by anyway, for a, HU. */
static const double FLOOR = 4, EVEN = 30;
/* Shares of water: the object, and what is too bright for bone. */
static const double OBJECT = 0.7, BRIGHT = 2.6;
/* The share of even voxels in places that iterations make rougher, from which on places are told apart in any case. */
static const double MOST = 2.0 / 3;
/* What TV took, HU, that is nothing; times the rest of it, that an iterate gets back at most; and what is told. */
static const double LITTLE = 10, LOST = 3, TOLD = 25;
/* HU of a step of `limit`. */
static const double STEP = 8;

/* Sums over a cube's voxels: the first five over those that are not too bright. */
enum { GUIDE, OTHER, PRODUCT, SQUARE, COUNT, START2, CROSS, CHANGE2, SUMS };
struct cell {
	double sum[SUMS];
};

/* At a corner of cubes: g = a V + b. */
struct node {
	float a, b;
};

struct restraint {
	struct grid grid;
	double mu_water, blur, most; /* 1/mm; of FDK, mm; of S, times water */
	bool nonnegative;
	int cells[3];
	size_t slice, voxels;
	float *start;       /* [z][y][x], S, owned; in between what TV took; NULL before either is known */
	signed char *limit; /* [z][y][x], behind start: what an iterate gets back at most, with its sign */
	bool lost, begun;   /* TV took something; S is there */
	bool holds_dense;   /* what is very dense stays as S has it */
};

static size_t cells_of(const struct grid *grid)
{
	return (size_t)(grid->size[0] / CELL) * (size_t)(grid->size[1] / CELL) * (size_t)(grid->size[2] / CELL);
}

static size_t nodes_of(const struct grid *grid)
{
	return (size_t)(grid->size[0] / CELL + 1) * (size_t)(grid->size[1] / CELL + 1) *
	       (size_t)(grid->size[2] / CELL + 1);
}

static size_t kept_bytes(const struct grid *grid)
{
	return grid_voxels(grid) * (sizeof(float) + sizeof(signed char));
}

size_t restraint_kept_bytes(const struct restraint *restraint)
{
	return kept_bytes(&restraint->grid);
}

size_t restraint_bytes(const struct grid *grid)
{
	const size_t slice = (size_t)grid->size[0] * (size_t)grid->size[1];
	const int across = CELL * ACROSS_LEAST;

	if (grid->size[0] < across || grid->size[1] < across || grid->size[2] < CELL)
		return 0;
	return kept_bytes(grid) + cells_of(grid) * (sizeof(struct cell) + sizeof(float)) +
	       nodes_of(grid) * sizeof(struct node) + 2 * slice * sizeof(float) + places_bytes(grid);
}

int restraint_new(const struct grid *grid, double mu_water, double blur, bool nonnegative,
		  struct restraint **ret_restraint, struct error *err)
{
	struct restraint *restraint;

	*ret_restraint = NULL;
	if (restraint_bytes(grid) == 0)
		return 0;
	restraint = malloc(sizeof(*restraint));
	if (restraint == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a restraint");
	*restraint = (struct restraint){
	    .grid = *grid,
	    .mu_water = mu_water,
	    .blur = blur,
	    .nonnegative = nonnegative,
	    .cells = {grid->size[0] / CELL, grid->size[1] / CELL, grid->size[2] / CELL},
	    .slice = (size_t)grid->size[0] * (size_t)grid->size[1],
	    .voxels = grid_voxels(grid),
	};
	*ret_restraint = restraint;
	return 0;
}

void restraint_free(struct restraint *restraint)
{
	if (restraint == NULL)
		return;
	free(restraint->start);
	free(restraint);
}

/* All of it 0. */
static int make_room(struct restraint *restraint, struct error *err)
{
	if (restraint->start != NULL)
		return 0;
	restraint->start = calloc(1, restraint_kept_bytes(restraint));
	if (restraint->start == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a start of %zu voxels", restraint->voxels);
	restraint->limit = (signed char *)(restraint->start + restraint->voxels);
	return 0;
}

/* ---- sums over cubes ---- */

/* v(x, y) less the mean of its neighbours. */
static double roughness(const float *at, int columns)
{
	return (double)at[0] - 0.25 * ((double)at[-1] + (double)at[1] + (double)at[-columns] + (double)at[columns]);
}

static void add_voxel(const struct restraint *restraint, const float *guide, const float *other, bool edge,
		      struct cell *cell)
{
	const double most = BRIGHT * restraint->mu_water, v = (double)*guide, d = (double)*other - v;

	if (v < most && (double)*other < most) {
		cell->sum[GUIDE] += v;
		cell->sum[OTHER] += d;
		cell->sum[PRODUCT] += v * d;
		cell->sum[SQUARE] += v * v;
		cell->sum[COUNT] += 1;
	}
	if (!edge) {
		const double start = roughness(other, restraint->grid.size[0]);
		const double change = roughness(guide, restraint->grid.size[0]) - start;

		cell->sum[START2] += start * start;
		cell->sum[CROSS] += start * change;
		cell->sum[CHANGE2] += change * change;
	}
}

/* Adds a slice of both volumes to the sums of its layer of cubes. */
static void add_slice(const struct restraint *restraint, const float *guide, const float *other, struct cell *layer)
{
	const int columns = restraint->grid.size[0], rows = restraint->grid.size[1];
	const int across = restraint->cells[0];

#pragma omp parallel for schedule(static)
	for (int block = 0; block < restraint->cells[1]; block++)
		for (int y = block * CELL; y < (block + 1) * CELL; y++)
			for (int x = 0; x < across * CELL; x++) {
				const size_t at = (size_t)y * (size_t)columns + (size_t)x;
				const bool edge = x == 0 || y == 0 || x == columns - 1 || y == rows - 1;

				add_voxel(restraint, guide + at, other + at, edge,
					  layer + (size_t)block * (size_t)across + (size_t)(x / CELL));
			}
}

/* What sums are made from: a volume, the guide, and beside it another one or the start. */
struct pair {
	const struct backend *backend;
	struct volume *guide, *other; /* other NULL: the start */
	float *slices;                /* [2] */
};

static int read_pair(const struct restraint *restraint, const struct pair *pair, int z, const float **ret_other,
		     struct error *err)
{
	int code = pair->backend->volume_download(pair->guide, z, 1, pair->slices, err);

	*ret_other = restraint->start + (size_t)z * restraint->slice;
	if (code == 0 && pair->other != NULL) {
		code = pair->backend->volume_download(pair->other, z, 1, pair->slices + restraint->slice, err);
		*ret_other = pair->slices + restraint->slice;
	}
	return code;
}

/* The sums of every `step`-th layer, [z][y][x] of cubes; the others are 0. */
static int add_layers(const struct restraint *restraint, const struct pair *pair, int step, struct cell *cells,
		      struct error *err)
{
	const size_t layer = (size_t)restraint->cells[0] * (size_t)restraint->cells[1];
	int code = 0;

	memset(cells, 0, cells_of(&restraint->grid) * sizeof(*cells));
	for (int k = 0; k < restraint->cells[2]; k += step)
		for (int z = k * CELL; z < (k + 1) * CELL && code == 0; z++) {
			const float *other;

			code = read_pair(restraint, pair, z, &other, err);
			if (code == 0)
				add_slice(restraint, pair->slices, other, cells + (size_t)k * layer);
		}
	return code;
}

/* ---- means: g ---- */

/* The cubes around the corner at (x, y, z), those beyond the grid's ends being the outermost ones. */
static struct node node_at(const struct restraint *restraint, const struct cell *cells, const int at[3])
{
	const double even = EVEN * restraint->mu_water / 1000;
	double sum[COUNT + 1] = {0}, a;

	for (int corner = 0; corner < 8; corner++) {
		size_t place = 0;

		for (int axis = 2; axis >= 0; axis--) {
			int i = at[axis] - 1 + (corner >> axis & 1);

			i = i < 0 ? 0 : i < restraint->cells[axis] ? i : restraint->cells[axis] - 1;
			place = place * (size_t)restraint->cells[axis] + (size_t)i;
		}
		for (int k = 0; k <= COUNT; k++)
			sum[k] += cells[place].sum[k];
	}
	if (sum[COUNT] < CELL * CELL * CELL)
		return (struct node){0, 0};
	for (int k = 0; k < COUNT; k++)
		sum[k] /= sum[COUNT];
	a = (sum[PRODUCT] - sum[GUIDE] * sum[OTHER]) / (sum[SQUARE] - sum[GUIDE] * sum[GUIDE] + even * even);
	return (struct node){(float)a, (float)(sum[OTHER] - a * sum[GUIDE])};
}

static void make_nodes(const struct restraint *restraint, const struct cell *cells, struct node *nodes)
{
	const int *count = restraint->cells;

#pragma omp parallel for schedule(static)
	for (int z = 0; z <= count[2]; z++)
		for (int y = 0; y <= count[1]; y++)
			for (int x = 0; x <= count[0]; x++) {
				const int at[3] = {x, y, z};

				nodes[((size_t)z * (size_t)(count[1] + 1) + (size_t)y) * (size_t)(count[0] + 1) +
				      (size_t)x] = node_at(restraint, cells, at);
			}
}

/* Place of a voxel's centre between two corners: the first of them, and the second one's share. */
static int between(int voxel, int cells, float *ret_share)
{
	const float place = fminf(((float)voxel + 0.5F) / CELL, (float)cells);
	const int first = (int)place < cells ? (int)place : cells - 1;

	*ret_share = place - (float)first;
	return first;
}

/* g of a voxel with this value, 1/mm; 0 of what is too bright. */
static float taken_at(const struct restraint *restraint, const struct node *nodes, int x, int y, int z, float value)
{
	const int *count = restraint->cells;
	const size_t along[3] = {1, (size_t)(count[0] + 1), (size_t)(count[0] + 1) * (size_t)(count[1] + 1)};
	const int at[3] = {x, y, z};
	float share[3], a = 0, b = 0;
	size_t first = 0;

	if (value >= (float)(BRIGHT * restraint->mu_water))
		return 0;
	for (int axis = 0; axis < 3; axis++)
		first += along[axis] * (size_t)between(at[axis], count[axis], &share[axis]);
	for (int corner = 0; corner < 8; corner++) {
		size_t place = first;
		float weight = 1;

		for (int axis = 0; axis < 3; axis++) {
			const bool second = corner >> axis & 1;

			place += second ? along[axis] : 0;
			weight *= second ? share[axis] : 1 - share[axis];
		}
		a += weight * nodes[place].a;
		b += weight * nodes[place].b;
	}
	return a * value + b;
}

/* Scratch of both passes over the volumes. */
struct scratch {
	struct cell *cells;
	struct node *nodes;
	float *slices; /* [2] */
	float *scores; /* [cells] */
};

static void scratch_free(struct scratch *scratch)
{
	free(scratch->cells);
	free(scratch->nodes);
	free(scratch->slices);
	free(scratch->scores);
}

static int scratch_new(const struct restraint *restraint, struct scratch *ret_scratch, struct error *err)
{
	const struct grid *grid = &restraint->grid;

	*ret_scratch = (struct scratch){
	    .cells = malloc(cells_of(grid) * sizeof(struct cell)),
	    .nodes = malloc(nodes_of(grid) * sizeof(struct node)),
	    .slices = malloc(2 * restraint->slice * sizeof(float)),
	    .scores = malloc(cells_of(grid) * sizeof(float)),
	};
	if (ret_scratch->cells != NULL && ret_scratch->nodes != NULL && ret_scratch->slices != NULL &&
	    ret_scratch->scores != NULL)
		return 0;
	scratch_free(ret_scratch);
	return error_set(err, ERR_NO_MEMORY, "no memory for sums over %zu cubes", cells_of(grid));
}

/* What TV took of a slice, and the limits that follow. What is very dense keeps FDK's own values. */
static void note_loss(struct restraint *restraint, const struct node *nodes, const float *fdk, const float *smoothed,
		      int z)
{
	const float dense = (float)(RESTRAINT_METAL * restraint->mu_water);
	const int columns = restraint->grid.size[0], rows = restraint->grid.size[1];
	const float hu = (float)(restraint->mu_water / 1000);
	float *start = restraint->start + (size_t)z * restraint->slice;
	signed char *limit = restraint->limit + (size_t)z * restraint->slice;
	bool lost = false;

#pragma omp parallel for schedule(static) reduction(|| : lost)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t at = (size_t)y * (size_t)columns + (size_t)x;
			const float taken = taken_at(restraint, nodes, x, y, z, smoothed[at]);
			const float over = fmaxf(0, fabsf(taken) / hu - (float)LITTLE);
			const int steps = (int)fminf(127, (float)LOST * over / (float)STEP);

			start[at] = smoothed[at] < dense ? taken : fdk[at] - smoothed[at];
			limit[at] = (signed char)(taken < 0 ? -steps : steps);
			lost = lost || steps > 0;
		}
	restraint->lost = restraint->lost || lost;
}

int restraint_see_loss(struct restraint *restraint, const struct backend *backend, struct volume *fdk,
		       struct volume *smoothed, struct error *err)
{
	struct scratch scratch;
	struct pair pair = {backend, smoothed, fdk, NULL};
	int code = make_room(restraint, err);

	if (code == 0)
		code = scratch_new(restraint, &scratch, err);
	if (code < 0)
		return code;
	pair.slices = scratch.slices;
	code = add_layers(restraint, &pair, 1, scratch.cells, err);
	if (code == 0)
		make_nodes(restraint, scratch.cells, scratch.nodes);
	for (int z = 0; z < restraint->grid.size[2] && code == 0; z++) {
		const float *other;

		code = read_pair(restraint, &pair, z, &other, err);
		if (code == 0)
			note_loss(restraint, scratch.nodes, other, scratch.slices, z);
	}
	scratch_free(&scratch);
	return code;
}

static void find_most(struct restraint *restraint)
{
	float most = 0;

#pragma omp parallel for schedule(static) reduction(max : most)
	for (size_t i = 0; i < restraint->voxels; i++)
		most = fmaxf(most, restraint->start[i]);
	restraint->most = (double)most / restraint->mu_water;
}

int restraint_begin(struct restraint *restraint, const struct backend *backend, struct volume *volume,
		    struct error *err)
{
	float *slice = malloc(restraint->slice * sizeof(*slice));
	int code = slice != NULL ? make_room(restraint, err) : error_set(err, ERR_NO_MEMORY, "no memory for a slice");

	for (int z = 0; z < restraint->grid.size[2] && code == 0; z++) {
		float *start = restraint->start + (size_t)z * restraint->slice;

		code = backend->volume_download(volume, z, 1, slice, err);
		for (size_t i = 0; i < restraint->slice && code == 0; i++) {
			const float value = slice[i] + start[i];

			start[i] = restraint->nonnegative ? fmaxf(value, 0) : value;
		}
	}
	restraint->begun = code == 0;
	if (restraint->begun)
		find_most(restraint);
	free(slice);
	return code;
}

/* ---- a run that goes on ---- */

size_t restraint_state_bytes(const struct restraint *restraint)
{
	return restraint != NULL && restraint->begun ? restraint_kept_bytes(restraint) : 0;
}

const void *restraint_state(const struct restraint *restraint)
{
	return restraint->start;
}

int restraint_resume(struct restraint *restraint, const char *bytes, struct error *err)
{
	int code = make_room(restraint, err);

	if (code < 0)
		return code;
	memcpy(restraint->start, bytes, restraint_kept_bytes(restraint));
	for (size_t i = 0; i < restraint->voxels && !restraint->lost; i++)
		restraint->lost = restraint->limit[i] != 0;
	find_most(restraint);
	restraint->begun = true;
	return 0;
}

/* ---- a volume that is kept ---- */

static int compare_floats(const void *a, const void *b)
{
	const float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

/* Roughness of both volumes in a cube of the object; negative: it is none. */
static double score(const struct restraint *restraint, const struct cell *cell, int x, int y)
{
	const double least = OBJECT * restraint->mu_water * CELL * CELL * CELL;

	if (x == 0 || y == 0 || x == restraint->cells[0] - 1 || y == restraint->cells[1] - 1)
		return -1;
	if (!(cell->sum[GUIDE] > least) || !(cell->sum[GUIDE] + cell->sum[OTHER] > least))
		return -1;
	return 2 * (cell->sum[START2] + cell->sum[CROSS]) + cell->sum[CHANGE2];
}

/* w, and the roughness that it comes from. */
static void find_share(const struct restraint *restraint, const struct cell *cells, float *scores,
		       struct restraint_report *report)
{
	const size_t across = (size_t)restraint->cells[0], layer = across * (size_t)restraint->cells[1];
	double sum[SUMS] = {0}, voxels = 0, c;
	size_t count = 0;
	float quiet = 0;

	for (int pass = 0; pass < 2; pass++) {
		for (size_t i = 0; i < cells_of(&restraint->grid); i++) {
			const double s = score(restraint, &cells[i], (int)(i % across), (int)(i % layer / across));

			if (s < 0)
				continue;
			if (pass == 0)
				scores[count++] = (float)s;
			else if ((float)s <= quiet) {
				for (int k = 0; k < SUMS; k++)
					sum[k] += cells[i].sum[k];
				voxels += CELL * CELL * CELL;
			}
		}
		if (count < CELLS_LEAST)
			return;
		if (pass == 0)
			qsort(scores, count, sizeof(*scores), compare_floats);
		quiet = scores[count / 4];
	}
	c = FLOOR / 1000 * (sum[GUIDE] + sum[OTHER]) / voxels;
	report->share = fmax(0, (c * c - sum[CROSS] / voxels) / (c * c + sum[CHANGE2] / voxels));
	report->rough[0] = sqrt(sum[START2] / voxels);
	report->rough[1] = sqrt(fmax(0, sum[START2] + 2 * sum[CROSS] + sum[CHANGE2]) / voxels);
}

/* What the iterate gets back of its means: g, held between 0 and the limit. */
static float given_back(float taken, float limit)
{
	return limit > 0 ? fminf(fmaxf(taken, 0), limit) : fmaxf(fminf(taken, 0), limit);
}

/* What a slice gets back of its means, in place. */
static void give_back(const struct restraint *restraint, const struct node *nodes, int z, float *values,
		      size_t counts[2], struct restraint_report *report)
{
	const int columns = restraint->grid.size[0], rows = restraint->grid.size[1];
	const float step = (float)(STEP * restraint->mu_water / 1000), object = (float)(OBJECT * restraint->mu_water);
	const float told = (float)(TOLD * restraint->mu_water / 1000);
	const signed char *limit = restraint->limit + (size_t)z * restraint->slice;
	size_t inside = 0, back = 0;
	float most = 0;

#pragma omp parallel for schedule(static) reduction(+ : inside, back) reduction(max : most)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t at = (size_t)y * (size_t)columns + (size_t)x;

			if (limit[at] != 0) {
				const float taken = taken_at(restraint, nodes, x, y, z, values[at]);
				const float given = given_back(taken, step * (float)limit[at]);

				values[at] += given;
				back += fabsf(given) > told && values[at] >= object;
				most = fmaxf(most, fabsf(given));
			}
			inside += values[at] >= object;
		}
	counts[0] += inside;
	counts[1] += back;
	report->most = fmax(report->most, (double)most);
}

/* V' of a slice in place, once it has its means. */
static void hold_back(const struct restraint *restraint, struct places *places, double most, int z, float *values)
{
	const float dense = restraint->holds_dense ? (float)(RESTRAINT_METAL * restraint->mu_water) : INFINITY;
	const float *start = restraint->start + (size_t)z * restraint->slice, share = places != NULL ? 1 : (float)most;

	if (places != NULL)
		places_restrain(places, z, most, start, values);
#pragma omp parallel for schedule(static)
	for (size_t at = 0; at < restraint->slice; at++) {
		float value = values[at];

		if (start[at] >= dense)
			value = start[at];
		else if (share < 1)
			value = start[at] + share * (value - start[at]);
		values[at] = restraint->nonnegative ? fmaxf(value, 0) : value;
	}
}

/* Volumes that are shown, and what is worked in. */
struct showing {
	const struct backend *backend;
	struct volume *volume;
	const struct node *nodes;             /* NULL: its means stay */
	const struct correction_chain *dense; /* whose rays are left out, or NULL */
	float *slice;
	size_t counts[2]; /* voxels of the object, and those that got back much */
};

static int read_slice(const struct restraint *restraint, struct showing *showing, int z,
		      struct restraint_report *report, struct error *err)
{
	int code = showing->backend->volume_download(showing->volume, z, 1, showing->slice, err);

	if (code == 0 && showing->nodes != NULL)
		give_back(restraint, showing->nodes, z, showing->slice, showing->counts, report);
	return code;
}

/* Asks the places of every `step`-th layer of cubes. */
static int ask_places(const struct restraint *restraint, struct showing *showing, struct places *places, int step,
		      double *ret_rougher, struct error *err)
{
	struct restraint_report unused = {0};
	struct showing asked = *showing;
	int code = 0;

	places_begin(places);
	for (int k = 0; k < restraint->cells[2]; k += step)
		for (int z = k * CELL; z < (k + 1) * CELL && code == 0; z++) {
			code = read_slice(restraint, &asked, z, &unused, err);
			if (code == 0)
				places_add(places, z, restraint->start + (size_t)z * restraint->slice, asked.slice);
		}
	if (code == 0)
		*ret_rougher = places_finish(places);
	return code;
}

/* *ret_places stays NULL where places are not told apart. */
static int find_places(const struct restraint *restraint, struct showing *showing, struct restraint_report *report,
		       struct places **ret_places, struct error *err)
{
	const int step = (restraint->cells[2] - 1) / LAYERS_MOST + 1;
	bool wanted = restraint->most >= RESTRAINT_METAL || restraint->holds_dense || report->share < 1;
	struct places *places;
	double rougher = 0;
	int code = places_new(&restraint->grid, restraint->mu_water, restraint->blur, &places, err);

	if (code == 0)
		code = ask_places(restraint, showing, places, wanted ? 1 : step, &rougher, err);
	if (code == 0 && !wanted && rougher > MOST) {
		wanted = true;
		code = step > 1 ? ask_places(restraint, showing, places, 1, &rougher, err) : 0;
	}
	if (code == 0 && wanted && showing->dense != NULL)
		code = places_see(places, showing->dense, err);
	if (code < 0 || !wanted) {
		places_free(places);
		return code;
	}
	report->changed = true;
	report->places = true;
	report->rougher = rougher;
	*ret_places = places;
	return 0;
}

/* V is held back. */
static int follow(struct restraint *restraint, struct showing *showing, struct restraint_report *report,
		  struct error *err)
{
	const int step = restraint->lost ? 1 : (restraint->cells[2] - 1) / LAYERS_MOST + 1;
	struct scratch scratch;
	struct places *places = NULL;
	struct pair pair = {showing->backend, showing->volume, NULL, NULL};
	int code = scratch_new(restraint, &scratch, err);

	if (code < 0)
		return code;
	pair.slices = showing->slice = scratch.slices;
	code = add_layers(restraint, &pair, step, scratch.cells, err);
	if (code == 0)
		find_share(restraint, scratch.cells, scratch.scores, report);
	report->share = places_kept(report->share);
	report->changed = report->share < 1 || restraint->lost || restraint->holds_dense;
	if (code == 0 && restraint->lost) {
		make_nodes(restraint, scratch.cells, scratch.nodes);
		showing->nodes = scratch.nodes;
	}
	if (code == 0)
		code = find_places(restraint, showing, report, &places, err);
	for (int z = 0; z < restraint->grid.size[2] && code == 0 && report->changed; z++) {
		code = read_slice(restraint, showing, z, report, err);
		if (code == 0) {
			hold_back(restraint, places, report->share, z, showing->slice);
			code = showing->backend->volume_put(showing->volume, z, 1, showing->slice, err);
		}
	}
	places_free(places);
	scratch_free(&scratch);
	return code;
}

int restraint_show(struct restraint *restraint, const struct backend *backend, struct volume *volume,
		   const struct correction_chain *dense, struct restraint_report *ret_report, struct error *err)
{
	struct showing showing = {.backend = backend, .volume = volume, .dense = dense};
	int code;

	*ret_report = (struct restraint_report){.share = 1};
	if (!restraint->begun)
		return 0;
	restraint->holds_dense = dense != NULL;
	code = follow(restraint, &showing, ret_report, err);
	if (showing.counts[0] > 0)
		ret_report->restored = (double)showing.counts[1] / (double)showing.counts[0];
	return code;
}

#ifndef CBCT_CORE_CPU_H
#define CBCT_CORE_CPU_H

#include <math.h>
#include <stdint.h>

#include "core/arena.h"
#include "core/backend.h"

/*
 * The CPU backend's own: what cpu.c, cpu_*.c and *_simd.c share.
 *
 * Layout. Volumes are kept as [y][x][z] and stacks as [slot][column][row]: z is
 * the rotation axis and rows lie along it, so in an untilted geometry a column
 * of voxels along z and a column of pixels see each other through one line, and
 * both directions run over contiguous memory. Rows of the ramp filter are then
 * taken many at a time. Uploads and downloads turn the order.
 *
 * Threads. A piece of work that is handed out (a few columns of one view, a
 * tile of voxels, a plane) is computed by one thread in one order whatever the
 * number of threads, so that the bits are the same for any number.
 *
 * Reads may run over the end of a column, never past SLACK floats behind the
 * last one; every allocation has them, zeroed.
 */
enum {
	SLACK = 96,
	LANES_MOST = 16,    /* of any instruction set */
	BLOCK_COLUMNS = 16, /* of a projection that are handed out together */
	TILE_ACROSS = 16,   /* voxels of a tile across its lines at most: few pixels are then read for two tiles */
	TILE_ALONG = 512,   /* and at most so many along one */
	TILE_LINES = TILE_ACROSS * TILE_ACROSS,
	PULSE_TILES = 16, /* one in so many small tiles counts as a step: the counter is shared by all threads */
	BLEND_MARGIN = 2 * LANES_MOST, /* floats beside a column of voxels in scratch, for windows beyond its ends */
	ROWS_MARGIN = 4 * LANES_MOST,  /* the same beside a column of pixels */
};

struct device {
	int threads;
	const struct cpu_kernels *kernels;
	size_t memory_limit, memory_used; /* bytes */
	char name[96];
};

struct volume {
	struct device *device;
	int size[3];  /* nx, ny, nz */
	size_t row;   /* floats from one x to the next: nz */
	size_t plane; /* floats from one y to the next, a little more than nx nz: see volume_strides */
	float *data;  /* [y][x][z], 1/mm */
};

struct stack {
	struct device *device;
	int columns, rows, slots;
	float *data; /* [slot][column][row], line integrals */
};

/* A view in voxel units (indices of the grid, counted from voxel 0,0,0). */
struct cpu_view {
	double source[3];
	double pixel0[3], column_step[3], row_step[3]; /* pixel0: from the source to pixel 0,0 */
	double matrix[12];                             /* (i, j, k, 1) to depth (column, row, 1), depth in mm */
	double isocentre_depth;                        /* mm */
};

struct filter_engine; /* filter.c */

/* TGV's dual of E w: along slow, middle, fast, and across slow-middle, slow-fast, middle-fast. */
enum { TGV_BENDS = 6 };

struct plan {
	struct device *device;
	void *memory; /* everything that plan_walk takes, memory_bytes of it */
	size_t memory_bytes;
	int columns, rows, views;
	struct grid grid;
	size_t row, plane; /* strides of every volume of this grid, floats */
	struct cpu_view *view;
	double spacing_least; /* mm */
	bool untilted;        /* rows of the detector across z, columns along z, lanes along both */
	bool fans;            /* untilted, and no ray passes more voxels along z than across */
	int across;           /* voxels of a tile across its lines */
	bool along_z;         /* backprojection takes voxels along z together, else along x */
	bool along_rows;      /* projection takes pixels along a column of the detector together, else along a row */
	bool matched;         /* plain backprojection is the transpose of the projection */
	char summary[96];

	struct linearise linearise;
	unsigned char *defective; /* [column][row] of one view */

	struct filter_engine *filter; /* NULL without FDK */
	int wide;                     /* columns of a filtered view, plan_options.pad included */
	/* The plan as FDK's backprojection sees filtered views: this one, or a copy with `wide` columns and
	 * filtered_view. */
	struct plan *filtered;
	struct cpu_view *filtered_view;
	int filter_batch;   /* views that FDK should filter at once */
	size_t extended[2]; /* rows that `filter` has extended on either side */

	struct sart_options sart;
	int batch;                       /* views whose corrections are held at once; 0 without SART */
	float *corrections;              /* [batch][column][row], 1/mm */
	double *ray_sums;                /* [batch][blocks of columns][2]: squares of p - A v and of p */
	struct iteration_sums corrected; /* by sart_correct since the iteration began */
	struct volume work; /* SART's numerators when a subset takes several batches; TV's f; without data: neither */

	bool has_tv;
	struct tv_options tv;
	struct volume dual[3], ahead;                            /* proximal TV and TGV; without data: none */
	struct volume slope[3], slope_ahead[3], bend[TGV_BENDS]; /* TGV; without data: none */
	float *planes;                                           /* TV's rolling planes, [threads][planes_floats] */
	size_t planes_floats;

	float *scratch;        /* [threads][scratch_floats] */
	size_t scratch_floats; /* of one thread */
	double *reduce;        /* [ny][REDUCE] partial sums */
};

/* Partial results of one plane: norm2, difference2, tv, minimum, maximum, sum, not finite. */
enum { REDUCE = 8 };

/* A box of voxels. Its sums are lines along z (along x when the grid is flat), each of `stride` floats. */
struct tile {
	int first[3], count[3]; /* along x, y, z */
	size_t stride;
};

/* ---- rows of TV's passes, tv.c ---- */
struct tv_weights {
	float slow, middle, fast; /* smallest spacing / spacing along each axis */
};
/* A row and the two behind it; where there is none, the row itself. */
struct tv_row {
	int count;
	const float *u, *middle, *slow;
};
struct tv_flux {
	float *slow, *middle, *fast; /* [count]; fast[-1] is 0 where a divergence is taken */
};
struct tv_step {
	float flow, fidelity; /* v += flow div p + fidelity (f - v) */
	float epsilon2;       /* explicit: what smooths |grad v|, squared */
	float sigma, theta;   /* proximal */
};
/*
 * The volume as TV sees it: `fast` is contiguous. A flat volume is [y][x][1], and
 * x takes the place of z there, so that the inner loops stay long.
 */
struct tv_box {
	int slow, middle, fast;
	size_t plane, row; /* floats */
	struct tv_weights weights;
};

/* ---- rows of TGV's passes, tgv.c ---- */

/* A row of all its volumes; [2]: along slow and middle. */
struct tgv_row {
	int count;
	ptrdiff_t behind[2], before[2];                     /* floats to the rows beside, 0 where there is none */
	float weight[2], to_behind[2], to_before[2], along; /* of differences; 0 where there is no row; along: fast */
	float within[2];                                    /* 0 but where there are rows on both sides */
	const float *f;
	float *v, *ahead, *p[3], *w[3], *w_ahead[3], *q[TGV_BENDS];
};
struct tgv_step {
	float sigma, inverse_unit, bend2; /* p += sigma (grad v / unit - w), q += sigma E w; bend2 |q|^2 <= 1 */
	float flow, fidelity, tau;        /* v += flow div p + fidelity (f - v); w += tau (p - E^T q) */
};

/*
 * The inner loops, one table for each instruction set.
 */
struct cpu_kernels {
	const char *isa;  /* "avx512": device_options.isa */
	const char *name; /* "AVX-512" */

	/*
	 * Line integrals of columns column .. column + count - 1 of one view, all rows;
	 * ret and ret_length (mm inside the grid) are [column][row] from `column` on.
	 * scratch: project_scratch_floats.
	 */
	void (*project)(const struct plan *plan, int view, int column, int count, const float *volume, float *ret,
			float *ret_length, float *scratch);
	/*
	 * Adds weight * bilinear sample of the projection to the tile's sums, [line][stride],
	 * and the sum of the bilinear weights to `cover`; either may be NULL. Returns
	 * true when every voxel lies inside of the detector; the cover is 1 all over
	 * then and `cover` is left alone.
	 */
	bool (*backproject)(const struct plan *plan, int view, const struct tile *tile, enum backprojection weight,
			    const float *projection, float *sums, float *cover);
	/*
	 * Adds the transpose of `project` of one view to the tile's sums, and that of
	 * ones to `cover`; either may be NULL. scratch: matched_scratch_floats.
	 */
	void (*backproject_matched)(const struct plan *plan, int view, const struct tile *tile, const float *projection,
				    float *sums, float *cover, float *scratch);

	void (*tv_flux)(const struct tv_row *row, const struct tv_weights *weights, float epsilon2,
			const struct tv_flux *ret);
	void (*tv_dual)(const struct tv_row *row, const struct tv_weights *weights, float sigma,
			const struct tv_flux *old, const struct tv_flux *ret);
	void (*tv_update)(int count, const struct tv_flux *flux, const struct tv_flux *before,
			  const struct tv_weights *weights, const struct tv_step *step, const float *f, float *v,
			  float *ahead);
	void (*tgv_dual)(const struct tgv_row *row, const struct tgv_step *step);
	void (*tgv_primal)(const struct tgv_row *row, const struct tgv_step *step);
};

extern const struct cpu_kernels cpu_kernels_base;
#if defined(__x86_64__)
extern const struct cpu_kernels cpu_kernels_avx2, cpu_kernels_avx512;
#endif

/*
 * Zeroed memory, aligned for cpu_take and counted against the device's limit; 0 bytes are none at all. NULL: there is
 * not enough, err is filled.
 */
void *cpu_allocate(struct device *device, size_t bytes, const char *what, struct error *err);
void cpu_release(struct device *device, void *memory, size_t bytes);

/* Bytes of so many floats and the SLACK behind them. */
static inline size_t floats_bytes(size_t count)
{
	return (count + SLACK) * sizeof(float);
}

/* A piece on cache lines of its own; a large one on pages of its own, so that arrays agree in their sets of the cache.
 */
static inline void *cpu_take(struct arena *arena, size_t bytes)
{
	enum { LINE = 64, PAGE = 4096, LARGE = 64 << 10 };

	return arena_take(arena, bytes, bytes >= LARGE ? PAGE : LINE);
}

/* Floats with their SLACK; none for 0. */
static inline float *cpu_take_floats(struct arena *arena, size_t count)
{
	return cpu_take(arena, count > 0 ? floats_bytes(count) : 0);
}

/* Number of the calling thread in the current parallel region. */
int cpu_thread(void);
/* The number that 0 stands for, else what was asked; 1 without OpenMP. */
int cpu_threads(int asked);

static inline size_t volume_floats(const struct volume *volume)
{
	return volume->plane * (size_t)volume->size[1];
}

static inline const float *stack_slot(const struct stack *stack, int slot)
{
	return stack->data + (size_t)slot * (size_t)stack->columns * (size_t)stack->rows;
}

static inline size_t stack_floats(const struct stack *stack)
{
	return (size_t)stack->slots * (size_t)stack->columns * (size_t)stack->rows;
}

static inline size_t lanes_padded(int count)
{
	return ((size_t)count + LANES_MOST - 1) / LANES_MOST * LANES_MOST;
}

/* Three floats and, for groups of no less than four, four integers for each row; two columns of voxels. */
static inline size_t project_scratch_floats(const struct plan *plan)
{
	return 4 * lanes_padded(plan->rows) + 2 * (lanes_padded(plan->grid.size[2]) + 2 * BLEND_MARGIN);
}

/* Scratch for a column: of each row its height, its ray, and two floats for each voxel across a tile; with margins. */
static inline size_t matched_scratch_floats(const struct plan *plan)
{
	return plan->matched ? (10 + 2 * TILE_ACROSS) * (lanes_padded(plan->rows) + 2 * ROWS_MARGIN) : 0;
}

static inline float *plan_scratch(const struct plan *plan)
{
	return plan->scratch + (size_t)cpu_thread() * plan->scratch_floats;
}

/* to[i * to_stride + j] = from[j * from_stride + i], i < from_columns, j < from_rows. */
void transpose(const float *from, size_t from_stride, int from_rows, int from_columns, float *to, size_t to_stride);
void volume_strides(const struct grid *grid, size_t *ret_row, size_t *ret_plane);
size_t cpu_volume_bytes(const struct grid *grid);

/* plan.c */
int cpu_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		   struct error *err);
int cpu_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan, struct error *err);
void cpu_plan_free(struct plan *plan);
const char *cpu_plan_summary(const struct plan *plan);
int cpu_plan_batch(const struct plan *plan);

/* linearise.c */
int cpu_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		  struct defect_counts *counts, struct error *err);

/* filter.c */
/* Takes the filter of a plan from the arena and fills it; NULL while the walk measures. */
struct filter_engine *filter_engine_walk(const struct plan_options *options, int threads, struct arena *arena);
int cpu_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
	       struct stack *to, struct error *err);
int cpu_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err);

/* project.c */
int cpu_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		struct error *err);
/* Blocks of columns that a view is handed out in. */
int column_blocks(const struct plan *plan);

/* backproject.c */
int cpu_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		    enum backprojection weight, struct volume *to, struct error *err);
/* Tiles that the grid is cut into; tile_at gives one of them. */
int tile_count(const struct plan *plan);
void tile_at(const struct plan *plan, int index, struct tile *ret_tile);
size_t tile_floats(const struct plan *plan); /* of the largest tile's sums */
int tile_lines(const struct plan *plan, const struct tile *tile);
/* The voxels of one line of a tile: first float in a volume, floats from one to the next, how many. */
size_t tile_line(const struct plan *plan, const struct tile *tile, int line, size_t *ret_stride, int *ret_count);

/* sart.c */
int cpu_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		     const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err);
int cpu_sart_correct(struct plan *plan, const struct geometry *geometry, const struct grid *grid,
		     const struct stack *measured, const int *views, int count, const int left_out[2], int before,
		     struct stack *rays, struct error *err);
int cpu_sart_sums(struct plan *plan, int count, struct iteration_sums *ret_sums, struct error *err);
int cpu_sart_squares(struct plan *plan, const struct stack *stack, int count, const int left_out[2], double *ret_sum,
		     struct error *err);
int cpu_sart_coverage(struct plan *plan, const int *views, int count, struct volume *to, struct error *err);
int cpu_sart_update(const struct sart_options *options, double least, const struct volume *sums,
		    const struct volume *coverage, struct volume *volume, struct error *err);

/* tv.c */
void tv_box_of(const struct plan *plan, struct tv_box *ret_box);
/* Sum of the squared weights of the axes that have differences; |grad|^2 <= 4 times that. */
double tv_box_weights(const struct tv_box *box);
size_t tv_planes_floats(const struct plan *plan);
int cpu_tv_steps(struct plan *plan, struct volume *volume, const struct tv_options *options, int first, int count,
		 const struct cancel *cancel, struct error *err);
int cpu_tv_pass(struct plan *from, const struct volume *from_volume, int z_from, struct plan *to,
		struct volume *to_volume, int z_to, int count, const struct tv_options *options, int done,
		struct error *err);
int cpu_tv(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	   struct error *err);

/* tgv.c */
int tgv_run(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	    struct error *err);

/* algebra.c */
int cpu_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err);
int cpu_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
		    struct error *err);
int cpu_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
		   struct error *err);
int cpu_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y, int count,
		  double *ret_sum, struct error *err);
int cpu_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err);
int cpu_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err);
int cpu_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err);
int cpu_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err);
int cpu_stack_fill(struct stack *y, int count, float value, struct error *err);
int cpu_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err);
int cpu_stack_average(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err);

/* norms.c */
int cpu_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
	      struct volume_norms *ret_norms, struct error *err);

#endif

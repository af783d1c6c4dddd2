#ifndef CBCT_KERNELS_INTERNAL_CUH
#define CBCT_KERNELS_INTERNAL_CUH

/*
 * Declarations that the files of the CUDA backend share: the four structs, the layouts of
 * their memory, and how errors and allocations go.
 *
 * All work of a device runs on one stream in the order it was asked for; copies
 * from and to the host have streams of their own, and wait only for the work on
 * their volume or stack. Lengths on the device are in voxels and pixels, counted
 * from the centre of the grid and of the detector, so that float32 keeps four
 * digits behind the point.
 */
#include <cstddef>
#include <cstdint>
#include <cuda_runtime.h>

extern "C" {
#include "core/arena.h"
#include "core/backend.h"
#include "core/fdk.h"
}
#include "kernels/neighbours.cuh"

/* Returns from the calling function, which has `err`, when a CUDA call fails. */
#define CUDA_TRY(call)                                                                                                 \
	do {                                                                                                           \
		cudaError_t status_ = (call);                                                                          \
		if (status_ != cudaSuccess)                                                                            \
			return cuda_error(err, status_, #call);                                                        \
	} while (0)
#define TRY(call)                                                                                                      \
	do {                                                                                                           \
		int code_ = (call);                                                                                    \
		if (code_ < 0)                                                                                         \
			return code_;                                                                                  \
	} while (0)
/* After a kernel's launch: a wrong configuration shows here, a fault in the kernel at the next synchronisation. */
#define LAUNCHED() CUDA_TRY(cudaGetLastError())

int cuda_error(struct error *err, cudaError_t status, const char *what);

static inline int divide_up(int a, int b)
{
	return (a + b - 1) / b;
}
static inline int round_up(int a, int b)
{
	return divide_up(a, b) * b;
}

/* Pinned memory, used in turn: one half is on the bus while the other is filled or emptied by the host. */
enum { STAGING_BYTES = 16 << 20 };
struct staging {
	char *pinned[2];
	cudaEvent_t done[2]; /* behind the copy that used it last */
	int next;
};

/* The views whose matrices stand in the constant memory of a GPU (backproject.cu); no plan: none. */
struct constants {
	const struct plan *plan;
	unsigned long list; /* plan.views_list */
	int first, count, pad;
	float flip;
};
enum { GPUS_MOST = 64 };

struct device {
	int index;
	struct constants *constants;
	int multiprocessors;
	cudaStream_t stream; /* everything that computes */
	cudaStream_t copy;   /* what comes in, raw projections made line integrals included */
	cudaStream_t back;   /* what goes out; idle whenever no operation runs */
	struct staging in, out;
	size_t limit; /* bytes that may be allocated in all */
	size_t used;
	double *sums;        /* pinned, [SUMS]: results of reductions, written by the device */
	double *sums_device; /* the same memory as the device sees it */
};
enum { SUMS = 16 };

int device_enter(struct device *device, struct error *err);
/* Counted against the limit; ERR_NO_MEMORY names what was wanted and what is left. */
int device_allocate(struct device *device, size_t bytes, void **ret_memory, struct error *err);
void device_release(struct device *device, void *memory, size_t bytes);
int device_wait(struct device *device, struct error *err);

/* The next `count` elements of an arena on the device, aligned for textures and vector loads; not cleared. */
enum { DEVICE_ALIGNED = 512 };
template <typename T>
static inline void take(struct arena *arena, T **ret_memory, size_t count)
{
	*ret_memory = (T *)arena_take(arena, count * sizeof(T), DEVICE_ALIGNED);
}

/* ---- memory.cu: copies through pinned memory ---- */
/*
 * Rows of `width` bytes into rows `pitch` bytes apart on the device, on the copy
 * stream. `from` has been read when it returns.
 */
int copy_in(struct device *device, void *to, size_t pitch, const void *from, size_t width, size_t rows,
	    struct error *err);
/* The other way, on the stream for what goes out; all of it is there when it returns. */
int copy_out(struct device *device, void *to, const void *from, size_t pitch, size_t width, size_t rows,
	     struct error *err);
/* `used` is behind the last that touched a volume or stack: what comes in waits for it, and what is asked next for
 * that. */
int begin_arrival(struct device *device, cudaEvent_t used, struct error *err);
int end_arrival(struct device *device, cudaEvent_t used, struct error *err);
int mark_used(struct device *device, cudaEvent_t used, struct error *err);

/* [z][y][x], no padding. */
struct volume {
	struct device *device;
	int size[3];
	size_t bytes;
	float *data;
	cudaEvent_t used;
};

/*
 * [slot][row][column] with rows of `pitch` floats and STACK_PAD rows of zeros
 * before, between and behind the slots; at least two zeros end each row. So a
 * bilinear sample anywhere needs its coordinates clamped to -1..count only, and
 * reads the zeros that surround a detector. The zeros are written at creation
 * and by nobody later.
 */
enum { STACK_PAD = 8 };
struct stack_shape {
	int columns, rows;
	int pitch;     /* floats from row to row */
	size_t slot;   /* floats from slot to slot */
	size_t floats; /* in all */
};
struct stack {
	struct device *device;
	struct stack_shape shape;
	int slots;
	float *memory; /* allocation */
	float *data;   /* row 0, column 0 of slot 0 */
	cudaEvent_t used;
};

struct stack_shape stack_shape_make(int columns, int rows, int slots);
size_t cuda_stack_bytes(int columns, int rows, int slots);
/* Takes a stack of a plan's own, without an event; stack_clear writes its zeros. */
void stack_walk(int columns, int rows, int slots, struct stack *ret_stack, struct arena *arena);
int stack_clear(struct device *device, struct stack *stack, struct error *err);

/* The pixels whose rays may meet the grid, with a margin. */
struct shadow {
	int first_column, end_column, first_row, end_row;
};

/*
 * One view as the kernels need it, in centred voxels g = index - (size - 1) / 2
 * and centred pixels c' = column - (columns - 1) / 2, r' likewise.
 *
 * A ray is a line through the source s along d(c', r'), both linear forms in c' and r':
 * value = [0] + [1] c' + [2] r'. With its moment m = s x d (Pluecker), the
 * ray crosses the plane x = t at y = (-m_z + d_y t) / d_x, z = (m_y + d_z t) / d_x
 * and so on cyclically, without the source's large coordinates cancelling.
 */
struct device_view {
	float direction[3][3];
	float moment[3][3];
	float matrix[3][4]; /* of voxel indices: column * w, row * w, w = depth / depth of the isocentre */
	float central[3];   /* unit vector from the source across to the axis */
	float source[3];    /* roughly: how steep rays can be at a voxel */
	struct shadow shadow;
};

/*
 * The volume as a stack of slices across one axis, for the forward projection:
 * [slice][row][fast], SLICE_PAD rows between the slices, padded with edge values.
 *
 * The untilted kernel reads many rows below each other and wants a distance from
 * row to row that the compiler knows: there the fast axis is cut into panels,
 * [slice][panel][row][PANEL], the last SLICE_SHARED values of a panel being the
 * first of the next, so that the four columns of a sample are always in one.
 *
 * A value is a float or, in standard precision, a __half2 of the voxel and the
 * next one along the row axis: one load brings both that a sample lies between.
 */
enum { SLICE_PAD = 8, SLICE_HELD = 2, PANEL = 64, SLICE_SHARED = 3, SLICE_STEP = PANEL - SLICE_SHARED };
struct slices_shape {
	int slices, rows, fast;
	int row;      /* floats from row to row */
	int panel;    /* floats from panel to panel; 0: rows are whole */
	size_t slice; /* floats from slice to slice */
	size_t floats;
};
struct slices {
	float *data; /* row 0 of slice 0; where rows are whole, its value 0, else -SLICE_HELD is first in its panel */
	size_t slice;
	int row, panel;
};
struct slices_shape slices_shape_make(int slices, int rows, int fast, bool panels);
struct slices slices_at(float *memory, const struct slices_shape *shape);

/*
 * A batch of projections for the backprojection by rows, [slot][panel][row][PANEL]. In float
 * an element is a pixel and the next one along the row; in half precision a pixel and the one
 * below it, all scaled by a power of two (layout.cu). A panel begins PAIRS_BEFORE columns before
 * the first that is looked up in it, and its last PAIRS_SHARED columns are the first of the next.
 */
enum { PAIRS_BEFORE = 3, PAIRS_SHARED = 4, PAIRS_STEP = PANEL - PAIRS_SHARED };
struct pairs_shape {
	int panel;     /* elements from panel to panel */
	size_t slot;   /* elements from slot to slot */
	size_t before; /* elements in front of row 0 of slot 0 */
};
struct pairs_shape pairs_shape_make(int columns, int rows);

/* The volume with z fastest, [x][y][z], columns of `pitch` floats. */
struct columns_shape {
	int nx, ny, nz, pitch;
	size_t floats;
};
struct columns_shape columns_shape_make(const int size[3]);

/* A layered 2D array with its texture: hardware bilinear samples, 0 beyond its sides. */
struct layered {
	int width, height, layers;
	size_t bytes; /* 0: there is none */
	cudaArray_t array;
	cudaTextureObject_t texture;
	cudaTextureObject_t held;    /* the same with the edges held */
	cudaSurfaceObject_t surface; /* to write it */
};
/* Sizes alone; layered_new allocates what they say, nothing for 0 bytes. */
struct layered layered_make(int width, int height, int layers);
int layered_new(struct device *device, struct layered *layered, struct error *err);
void layered_free(struct device *device, struct layered *layered);

struct device_grid {
	int size[3];
	float spacing[3];
};

enum { BATCH_MOST = 128 }; /* views that are filtered and backprojected in one go */
enum {
	LEANING_RUN = 16
};                       /* voxels along z, in whose height the matched pair's columns may lean by less than a voxel */
enum { ROWS_APART = 4 }; /* rows of a thread that share columns, but no values */

/*
 * How a plan saves memory, if at all: the corrections of a subset are laid out in
 * halves; are made and laid out in two, three or four parts; or few at a time and
 * without arrays. Each takes more time than the one before.
 */
enum thrift { THRIFT_NONE, THRIFT_HALVES, THRIFT_2_PARTS, THRIFT_3_PARTS, THRIFT_4_PARTS, THRIFT_LEAN };

/*
 * The matched backprojection, by what its rays are like: any; no ray along z; none, and the
 * detector's columns along z but for a little; the same, along z.
 */
enum matched { MATCHED_ANY, MATCHED_TILTED, MATCHED_LEANING, MATCHED_UPRIGHT };

/* Length of the filter's transform of a row: in one kernel, or by cuFFT where that is too short. */
struct transform_length {
	int fused; /* 0: cuFFT's */
	int fft;   /* 0: the fused one's */
};

/* How a plan does its work; chosen once from geometry and options. */
struct plan_shape {
	bool untilted;    /* the fast kernels apply */
	bool rows_down;   /* untilted, and rows count against z */
	int forward_rows; /* rows of one thread in the forward projection by rows; 0: the general one */
	enum neighbours forward_neighbours;
	int view_warps;  /* of forward_rows by 32 rays that meet the grid: of the view with most */
	int view_rows;   /* forward_rows where SART goes by copies: fewer where a single view sees little of the grid */
	bool rows_apart; /* they share columns, but no values */
	bool halves;     /* the forward projection reads pairs in half precision */
	int back_voxels; /* voxels of one window in the untilted backprojection; 0: the general one */
	bool is_small;   /* launches take longer than samples: the plainest kernels */
	enum neighbours back_neighbours;
	bool back_pairs;      /* it reads pairs in half precision */
	bool textures;        /* 8-bit interpolation weights are allowed */
	bool z_rays;          /* some ray runs closer to z than to x and y */
	enum matched matched; /* how the matched backprojection goes */
	int batch;            /* views filtered and backprojected in one go */
	enum thrift thrift;
	int correction;    /* slots of the correction stack, 0 without SART */
	bool parts;        /* it holds a part of a subset only */
	int views_at_once; /* that one launch of the backprojection takes; layers of the projection array */
	int pairs_at_once; /* that there is room for as pairs */
	int subset;        /* views of SART's largest subset, 0 without SART */
	bool indexed;      /* voxels are counted by an int */
	bool few_views;    /* an update has too few views to fill the card by whole rays */
	bool copied;       /* the volume may be projected from copies in half precision (by_view.cu) */
	bool covered;      /* every view sees the whole grid: sum_S w_ij = views of S */
	/* Lengths of the filter's transforms, of rows as they are and of extended ones; 0: none are extended. */
	struct transform_length plain, extended;
};

/* Data with a scale in half precision: projections as pairs, those of ones, the volume. */
enum { MOST_PAIRS, MOST_ONES, MOST_VOLUME, MOST_COUNT };

struct filter;   /* filter.cu */
struct strategy; /* below: how SART iterates */

struct plan {
	struct device *device;
	struct plan_options options;
	struct plan_shape shape;
	const struct strategy *strategy; /* NULL without SART */
	struct device_grid grid;
	struct slices_shape along_x, along_y;
	struct columns_shape columns;
	struct stack_shape stack;
	struct stack_shape filtered; /* with plan_options.pad */
	char summary[224];

	char *memory; /* everything that plan_walk takes, memory_bytes of it */
	size_t memory_bytes;

	int *views_host; /* what `views` holds, so that the same list is not copied again */
	int views_held;
	unsigned long views_list;     /* counts the lists that there have been */
	int *views;                   /* [count], device: the views of the call in hand */
	int *slots;                   /* [count], device: their slots, for those that need them */
	struct device_view *geometry; /* [count], device */
	struct device_view *in_order; /* the same in the order of SART, NULL without */

	/*
	 * One block that the stages use in turn, and another plan that borrows it: slices of
	 * the forward projection or copies of SART (the first `slices_bytes`), TV's copies,
	 * cuFFT's rows. Samples of weight 0 are read from slices where nothing was put, so that
	 * numbers must stand there.
	 */
	float *scratch;
	size_t scratch_bytes, slices_bytes;
	struct plan *lender;           /* whose scratch it is, NULL: its own */
	const struct plan *slices_of;  /* of its own scratch: whose slices alone are there */
	struct layered projections;    /* a batch of projections, with textures */
	struct layered filtered_array; /* the same of padded rows, where they are longer */
	char *pairs;                   /* a batch of projections as pairs of float or half, for the rows */
	char *ones;                    /* a projection of ones, where column sums are made of it */
	unsigned *most;  /* [MOST_COUNT]: the largest magnitudes, as bits, of what is kept in half precision */
	float *coverage; /* [z][y][x], sum_S w_ij of subset `coverage_subset`, where not all is covered */
	int coverage_subset;
	float *work; /* [z][y][x], where an update takes more views than one launch */
	struct stack correction;
	float *sampled_from;         /* the correction where SART goes view by view and by rows, */
	cudaTextureObject_t sampled; /* and its texture */
	float2 *partial; /* SART: squares of residuals and projections, one for each block of the forward projection */
	size_t partial_count;
	float2 *rays_partial;          /* the same of rays that are corrected by themselves, where there is no SART */
	cudaEvent_t projected, summed; /* the last of them is there; all are summed up */
	double *reduce;                /* partial sums of reductions, reduce_count of them */
	float *matrices;               /* of the views in hand, on their way into constant memory */

	struct filter *filter; /* NULL without FDK */

	/* linearise: raw samples of some views */
	int raw_views;    /* projections of the buffer; 0: the plan does not linearise */
	size_t raw_bytes; /* of one projection */
	char *raw;
	char *image[IMAGE_COUNT];    /* those of linearise; NULL for none */
	unsigned char *marks[2];     /* defects of one view */
	struct linearised *counters; /* linearise.cu */

	/* A whole SART iteration, recorded at its first run for this volume and this stack. */
	cudaGraphExec_t recorded;
	const float *recorded_volume, *recorded_stack;
};

/* The list of views on the device; nothing is copied when it is there already. */
int plan_set_views(struct plan *plan, const int *views, int count, struct error *err);
int plan_set_slots(struct plan *plan, const int *slots, int count, const struct stack *from, struct error *err);
/* The scratch is to hold slices: zeros where anything else has been. */
int plan_begin_slices(struct plan *plan, struct error *err);
/* The scratch is to hold something else than slices. */
void plan_end_slices(struct plan *plan);
/* Checks the views, and a stack of projections of this shape. */
int plan_check_views(const struct plan *plan, const int *views, int count, const struct stack_shape *shape,
		     const struct stack *stack, int slots, struct error *err);

struct shadow shadow_of(const struct geometry *geometry, const struct grid *grid, int index);

/* ---- layout.cu ---- */
/* The scale of the volume in half precision; `projections`: it is going to be what these are of, or NULL. */
int layout_scale(struct plan *plan, const float *volume, const float *projections, struct error *err);
/* -> scratch; in half precision by the scale found last */
int layout_slices(struct plan *plan, const float *volume, struct error *err);
/*
 * Rows that lean are backprojected by rows for FDK only: at the detector's edges a voxel's line meets other pixels than
 * the voxel does, which SART's division by column sums would show.
 */
static inline bool back_by_pairs(const struct plan *plan, bool fdk)
{
	return plan->shape.back_voxels > 0 && (fdk || plan->shape.untilted);
}
/*
 * Factor before half precision, a power of two, from the largest magnitude of all, as bits. Nearly always, from 2^least
 * to 2^most, it is HALF_SCALE; else it brings the largest to 2^target .. 2^(target + 1). NaN stays NaN.
 */
static const float HALF_SCALE = 64.0f;
static __device__ __forceinline__ float half_scale(unsigned magnitude, int least, int most, int target)
{
	int exponent = (int)(magnitude >> 23) - 127;

	if ((exponent >= least && exponent < most) || exponent < -110 || exponent > 127)
		return HALF_SCALE;
	return __uint_as_float((unsigned)(target - exponent + 127) << 23);
}
static __device__ __forceinline__ float unscale(float scale)
{
	return __uint_as_float((254u << 23) - __float_as_uint(scale)); /* 1 / scale, a power of two */
}
/*
 * The scale of projections: with it the largest is 2^-10 to 2^12, the least step 2^-15 of it; sums of eight stay
 * finite.
 */
static __device__ __forceinline__ float pairs_scale(unsigned most)
{
	return half_scale(most, -16, 6, 11);
}
/*
 * The scale of a volume: with it the largest is 2^-6 to 2^9, which leaves room for what SART's first update makes of
 * it.
 */
static __device__ __forceinline__ float volume_scale(unsigned most)
{
	return half_scale(most, -12, 3, 3);
}
/* -> pairs; where they are in half precision, also most */
int layout_pairs(struct plan *plan, const struct stack_shape *shape, const float *from, int count, struct error *err);
/* -> ones */
int layout_ones(struct plan *plan, struct error *err);
int layout_to_columns(struct plan *plan, const float *volume, float *columns, struct error *err);
int layout_from_columns(struct plan *plan, const float *columns, float *volume, struct error *err);

/* ---- project.cu ---- */
/* The use of a ray's sum. */
struct ray_use {
	const float *measured;     /* NULL: the sum itself is wanted; else (p - sum) / row sum, slot = view */
	float2 *partial;           /* one a block: residual^2, p^2 */
	float least;               /* mm that a ray must have in the grid to correct it */
	cudaSurfaceObject_t array; /* not 0: into this array, too, layer = slot */
};
/* Before project_rays: the volume as it reads it. */
int project_prepare(struct plan *plan, const float *volume, struct error *err);
/* Rays of plan->views[first .. first + count - 1] into slots 0 .. count - 1. */
int project_rays(struct plan *plan, const float *volume, int first, int count, struct ray_use use, float *to,
		 struct error *err);
size_t project_blocks(const struct plan *plan, int count);
const char *projector_name(const struct plan *plan); /* of projectors[] */

/* ---- backproject.cu ---- */
/* The use of a voxel's sum. */
struct voxel_use {
	bool update; /* false: added to the volume */
	bool fdk;    /* weight (D/depth)^2 */
	bool nonnegative;
	float scale;           /* update: relaxation, over the number of views where all is covered */
	const float *coverage; /* update: else divided by this, voxel by voxel */
	float least;           /* what a voxel has of it at least, if any */
	bool laid_out;         /* the array has the projections already */
};
int backproject_views(struct plan *plan, const float *from, int first, int count, struct voxel_use use, float *volume,
		      struct error *err);
/* The update from plan->work, where sums were made in parts. */
int update_volume(struct plan *plan, struct voxel_use use, float *volume, struct error *err);
/* Views that one launch takes. */
enum { VIEWS_AT_ONCE = 1024 };
/*
 * The matrices of the next call stay in constant memory until another list of
 * views is used: what is recorded finds them there when they are brought before.
 */
int backproject_prepare(struct plan *plan, int first, int count, struct error *err);
void backproject_forget(struct device *device);
struct constants *backproject_constants(int gpu);
/* Column sums of these views into `to`, [z][y][x]. */
int coverage_sum(struct plan *plan, int first, int count, float *to, struct error *err);
const char *backprojector_name(const struct plan *plan, bool fdk); /* of backprojectors[], or matched */

/* ---- matched.cu ---- */
/*
 * The transpose of project_rays. The plan's own corrections are changed on the way, and any number of them is
 * one launch; other projections take the scratch, and are added to the volume.
 */
int matched_views(struct plan *plan, const float *from, int first, int count, struct voxel_use use, float *volume,
		  struct error *err);
/* Column sums into `to`; takes the scratch. */
int matched_coverage(struct plan *plan, int first, int count, float *to, struct error *err);
size_t matched_scratch_bytes(const struct plan *plan); /* at least */

/* ---- filter.cu ---- */
struct transform_length filter_choose(int columns);
/* plan->filter, before the walk that carves; filter_free takes NULL. */
int filter_new(struct plan *plan, struct error *err);
void filter_free(struct filter *filter);
/* The filter's part of the plan's memory; only measured where plan->filter is NULL. */
void filter_walk(struct plan *plan, struct arena *arena);
/* Fills the filter's memory. */
int filter_prepare(struct plan *plan, struct error *err);
/* Bytes of plan->scratch that the filter takes, which has `others` for other stages anyway. */
size_t filter_scratch_bytes(const struct plan *plan, size_t others);

/* ---- linearise.cu ---- */
/* linearise's part of the plan's memory, nothing with plan_options.no_samples; and what is written there beforehand. */
void linearise_walk(struct plan *plan, struct arena *arena);
int linearise_prepare(struct plan *plan, struct error *err);

/* ---- norms.cu ---- */
size_t reduce_count(void);
/* partial[0 .. count - 1] -> sums[0], sums[1] += in a fixed order. */
int reduce_pairs(struct plan *plan, const float2 *partial, size_t count, double *sums, cudaStream_t stream,
		 struct error *err);

/* ---- cards.cu ---- */
/* Partial sums that sart_correct leaves of all views. */
size_t rays_partials(const struct plan *plan);

/* ---- by_view.cu: one or few views an update, by rows, from copies in half precision in scratch ---- */
size_t copies_bytes(const struct plan *plan);
size_t copies_partials(const struct plan *plan, int count); /* of so many views */
int copies_lay_out(struct plan *plan, const float *volume, struct error *err);
/* The same as project_rays with `use.measured`, from the copies. */
int copies_project(struct plan *plan, const float *volume, int first, int count, struct ray_use use, float *to,
		   struct error *err);
int copies_view_rows(const struct plan *plan); /* what view_rows is to be */
/* An iteration view by view; partial sums of each view are left in plan->partial. */
void by_view_rows_walk(struct plan *plan, struct arena *arena);
int by_view_rows_prepare(struct plan *plan, struct error *err);
int by_view_rows_iterate(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
			 struct error *err);

/* ---- sart.cu ---- */
/* Least length in the grid of a ray that corrects it, mm. */
float length_least(const struct plan *plan);

/*
 * How SART iterates: strategies[] of sart.cu, of which the first that applies is used. Those of one view an
 * update do it all in `iterate`; the others share theirs and differ in how a subset is projected.
 */
struct strategy {
	const char *name;
	bool by_view;                             /* an update after each view, else after each subset */
	bool (*applies)(const struct plan *plan); /* options and shape are known */
	/* Bytes of plan->scratch, beside the slices that are there for `project`. */
	size_t (*scratch_bytes)(const struct plan *plan);
	/* The strategy's own part of the plan's memory, and what is written there beforehand. */
	void (*walk)(struct plan *plan, struct arena *arena);
	int (*prepare)(struct plan *plan, struct error *err);
	/* Partial sums that `count` projections leave, those of all views or what one launch has. */
	size_t (*partials)(const struct plan *plan, int count);
	int (*iterate)(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
		       struct error *err);
	/* By subsets: the volume as it is projected from, and the projection of some views. */
	int (*lay_out)(struct plan *plan, const float *volume, struct error *err);
	int (*project)(struct plan *plan, const float *volume, int first, int count, struct ray_use use, float *to,
		       struct error *err);
};
/* NULL without SART. */
const struct strategy *strategy_choose(const struct plan *plan);
size_t strategy_partials(const struct plan *plan); /* of an iteration */

/* ---- tv.cu ---- */
size_t tv_scratch_bytes(const struct plan_options *options);
/* What steps have come to, `done` of them behind the beginning: pieces of [z][y][x], so many bytes a voxel. Returns how
 * many. */
enum { TV_PIECES = 5 };
struct tv_piece {
	void *data;
	size_t voxel;
};
int tv_state(struct plan *plan, struct volume *volume, const struct tv_options *options, int done,
	     struct tv_piece ret_pieces[TV_PIECES]);
/* Smallest spacing / spacing along the axis; and the sum of their squares over the axes that have differences. */
double tv_weight(const struct plan *plan, int axis);
double tv_squared_weights(const struct plan *plan);

/* ---- tgv.cu ---- */
/* Volumes of scratch: v, u^, p, w, w^ and q. */
enum { TGV_VOLUMES = 1 + 1 + 3 + 3 + 3 + 6 };
int tgv_run(struct plan *plan, float *volume, const struct tv_options *tv, const struct cancel *cancel,
	    struct error *err);

/* ---- the operations of the table ---- */
int cuda_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		   struct defect_counts *counts, struct error *err);
int cuda_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err);
int cuda_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		struct stack *to, struct error *err);
int cuda_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		     enum backprojection weight, struct volume *to, struct error *err);
int cuda_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		 struct error *err);
int cuda_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		      const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err);
int cuda_sart_correct(struct plan *plan, const struct geometry *geometry, const struct grid *grid,
		      const struct stack *measured, const int *views, int count, const int left_out[2], int before,
		      struct stack *rays, struct error *err);
int cuda_sart_sums(struct plan *plan, int count, struct iteration_sums *ret_sums, struct error *err);
int cuda_sart_squares(struct plan *plan, const struct stack *stack, int count, const int left_out[2], double *ret_sum,
		      struct error *err);
bool cuda_sart_covered(const struct plan_options *options);
int cuda_sart_take(struct plan *plan, const struct sart_options *options, double least, const struct stack *rays,
		   const int *views, int count, const struct volume *coverage, struct volume *volume,
		   struct error *err);
int cuda_sart_coverage(struct plan *plan, const int *views, int count, struct volume *to, struct error *err);
int cuda_sart_update(const struct sart_options *options, double least, const struct volume *sums,
		     const struct volume *coverage, struct volume *volume, struct error *err);
bool cuda_connect(struct device *const devices[], int count);
int cuda_stack_pass(const struct stack *from, const int *from_slots, int from_row, struct stack *to,
		    const int *to_slots, int to_row, int rows, int count, bool add, struct error *err);
int cuda_volume_pass(const struct volume *from, int z_from, struct volume *to, int z_to, int count, struct error *err);
int cuda_tv(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	    struct error *err);
int cuda_tv_steps(struct plan *plan, struct volume *volume, const struct tv_options *options, int first, int count,
		  const struct cancel *cancel, struct error *err);
int cuda_tv_pass(struct plan *from, const struct volume *from_volume, int z_from, struct plan *to,
		 struct volume *to_volume, int z_to, int count, const struct tv_options *options, int done,
		 struct error *err);
void cuda_release(int index);
int cuda_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
	       struct volume_norms *ret_norms, struct error *err);
int cuda_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err);
int cuda_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
		     struct error *err);
int cuda_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
		    struct error *err);
int cuda_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y, int count,
		   double *ret_sum, struct error *err);
int cuda_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err);
int cuda_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err);
int cuda_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err);
int cuda_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err);
int cuda_stack_fill(struct stack *y, int count, float value, struct error *err);
int cuda_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err);
int cuda_stack_average(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err);
int cuda_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		    struct error *err);
int cuda_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan, struct error *err);
void cuda_plan_free(struct plan *plan);
const char *cuda_plan_summary(const struct plan *plan);
int cuda_plan_batch(const struct plan *plan);
int cuda_volume_new(struct device *device, const struct grid *grid, struct volume **ret_volume, struct error *err);
void cuda_volume_free(struct volume *volume);
size_t cuda_volume_bytes(const struct grid *grid);
int cuda_volume_upload(struct volume *volume, const float *from, struct error *err);
int cuda_volume_put(struct volume *volume, int z_first, int z_count, const float *from, struct error *err);
int cuda_volume_download(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err);
int cuda_volume_fill(struct volume *volume, float value, struct error *err);
int cuda_volume_copy(struct volume *to, const struct volume *from, struct error *err);
int cuda_stack_new(struct device *device, int columns, int rows, int slots, struct stack **ret_stack,
		   struct error *err);
void cuda_stack_free(struct stack *stack);
int cuda_stack_upload(struct stack *stack, int slot, int count, const float *from, struct error *err);
int cuda_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err);

#endif

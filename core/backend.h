#ifndef CBCT_CORE_BACKEND_H
#define CBCT_CORE_BACKEND_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include "core/error.h"
#include "core/filter.h"
#include "core/linearise.h"
#include "core/pulse.h"
#include "core/scan/geometry.h"
#include "core/scan/grid.h"
#include "core/scan/orbit.h"
#include "core/subsets.h"

#ifdef __cplusplus
extern "C" {
#endif

/*
 * One table of operations for each kind of device. The algorithms in fdk.c,
 * sart.c and recon.c are written once above it; the CPU's table is the readable
 * reference and every other one is tested against it, row by row.
 *
 * Rules for all of them:
 * - The four structs are each backend's own; nobody else looks inside.
 * - A device and what hangs on it belong to one thread at a time.
 * - Everything is allocated by *_new and plan_new; the other operations allocate
 *   nothing. They may return before the device has finished; volume_download,
 *   stack_download, sart_iterate, norms and sync do not.
 * - The same inputs give the same bits, on every run and for any number of threads.
 * - A failed device (ERR_DEVICE) is good for nothing but closing.
 */
struct device; /* a card, or the CPU's cores */
struct volume; /* [z][y][x] float, 1/mm */
struct stack;  /* [slot][row][column] float, line integrals: one slot for each view, or a few as scratch */
struct plan;   /* one geometry, one grid, one set of weights, and all scratch that a job needs */

struct device_options {
	int threads;         /* CPU: 0 = all the process may use */
	size_t memory_limit; /* bytes to use at most; 0 = what is free */
	const char *isa;     /* CPU: "base", "avx2", "avx512"; NULL = the best that it has */
	bool apart;          /* several cards: they pass everything through the host, as where they cannot do else */
};

struct device_info {
	char name[96];   /* "Intel Xeon ... (2 threads, AVX-512)", "NVIDIA H200" */
	char driver[64]; /* "" on the CPU */
	size_t bytes_total, bytes_free;
};

/*
 * Counts of the defects that linearise met, summed over its calls and never reset. A pixel counts once, in the first
 * field that applies.
 */
struct defect_counts {
	size_t mapped;     /* pixels of the map */
	size_t not_finite; /* NaN, infinite, or no flat above the dark to hold it against */
	size_t saturated;
	size_t zero; /* nothing above the dark */
	int blank;   /* views without one good pixel: all of their slot is 0, and says nothing */
	int no_air;  /* views whose air region has no good pixel: divided by the flat as they are */
	/* The least and the most of the air regions' means so far; both 0 before the first. */
	float air_least, air_most;
};
static inline size_t defects_total(const struct defect_counts *counts)
{
	return counts->mapped + counts->not_finite + counts->saturated + counts->zero;
}

/*
 * TV in gray levels u = v / unit. Differences are weighted by (smallest spacing
 * / spacing) along each axis, so that isotropic voxels have h = 1.
 */
enum tv_method { TV_GRADIENT, TV_PROXIMAL, TV_GENERALISED, TV_METHOD_COUNT }; /* in order of their memory */
extern const char *const tv_method_names[TV_METHOD_COUNT];
struct tv_options {
	enum tv_method method;
	double alpha, step;
	int iterations;
	double unit; /* 1/mm for one gray level */
};

/*
 * TV_GENERALISED: what a bend counts for beside a slope that is not met; and the length of its steps times alpha, with
 * which 50 steps come nearest to the minimiser where 1 / alpha is from a tenth of the noise to its size.
 */
#define TGV_BEND 2.0
#define TGV_TAU 0.15

struct sart_options {
	struct subsets subsets; /* borrowed, must outlive the plan */
	double relaxation;
	bool nonnegative;
};

/* Inputs of plan_new and plan_bytes. Everything pointed to is borrowed and must outlive the plan. */
struct plan_options {
	const struct geometry *geometry;
	const struct grid *grid;
	struct linearise linearise;
	/* FDK, or NULL when none runs: orbit_column_weights and filter_response (pitch 1, length filter_length of the
	 * padded columns). */
	const float *column_weights;  /* [count][columns] */
	struct rotation_axis axis;    /* of the rotation; the cosine is against the way to it */
	const float *filter_response; /* [length/2 + 1] */
	/*
	 * Filtered rows reach pad[0] columns before column 0 and pad[1] after the
	 * last (orbit.pad): `filter` writes and `backproject` with BACKPROJECT_FDK
	 * reads stacks of pad[0] + columns + pad[1] columns. 0 but for displaced detectors.
	 */
	int pad[2];
	/*
	 * Columns by which `filter` extends truncated rows on either side before the
	 * ramp (core/truncation.h), 0: none; and the response of filter_length(padded columns
	 * + extend) that these rows need. Other rows are filtered as without.
	 */
	int extend;
	const float *extended_response;  /* [length/2 + 1], or NULL without extend */
	const struct sart_options *sart; /* NULL: no SART */
	/*
	 * SART's forward and backward weights are those of one matrix and its exact
	 * transpose: `project` and plain `backproject` are matched then. FDK's
	 * backprojection stays the interpolating one.
	 */
	bool matched;
	const struct tv_options *tv; /* the most that `tv` is asked for, see there; NULL: no TV */
	bool reference_precision;    /* float everywhere; otherwise storage may be packed within the stated bound */
	/*
	 * Bytes that the job takes on the device beside this plan, its projections and
	 * its volumes, so that the plan sees what is left.
	 */
	size_t beside;
	/*
	 * Another plan of this device whose plan_bytes.block it works in, NULL: none; and the
	 * bytes that this plan has of that at least, for another one. Calls to the two take turns, and
	 * the borrower is freed first.
	 */
	struct plan *lender;
	size_t lends;
	bool no_samples;    /* linearise will not be asked for */
	bool no_projection; /* neither project nor sart_iterate will be asked for: no scratch for them */
	int resident;       /* slots of the stacks that are on the device beside the plan; 0: one for each view */
	bool unbounded;     /* no bound of its own is kept beside the device's: a part of a job whose whole has one */
	int together;       /* views that sart_correct and sart_take are asked for at a time, at most; 0: none */
};

/* Bytes, known before anything is allocated. */
struct plan_bytes {
	size_t volumes; /* the iterate and the copies that the recipe needs */
	size_t scratch; /* the rest, */
	size_t block;   /* and of it what another plan can lend */
	size_t raw;     /* one projection on its way in */
	size_t host;    /* beside the device's own memory, of outofcore.h; 0 elsewhere */
};

struct iteration_sums {
	double residual2;   /* sum of (p - A v)^2, each view's as it is met, over the rays that are not left out */
	double projection2; /* sum of p^2 over the same rays */
};

struct volume_norms {
	double norm2, difference2; /* sum v^2, sum (v - other)^2 (0 without other) */
	double tv;                 /* sum |grad u| with u = v / unit, forward differences */
	double minimum, maximum, mean;
	size_t not_finite;
};

/*
 * In a stack of projections that sart_iterate reads, a line integral that is not a number is a ray that is left
 * out: its measured value says nothing.
 */
#define RAY_LEFT_OUT NAN

/* Asked between steps; true ends the operation with ERR_CANCELLED. */
struct cancel {
	bool (*asked)(void *context); /* NULL: never */
	void *context;
};

/* Between two steps: counts one, and gives ERR_CANCELLED when somebody asked; cancel NULL: nobody can. */
static inline int cancel_check(const struct cancel *cancel, struct error *err)
{
	pulse_beat();
	if (cancel != NULL && cancel->asked != NULL && cancel->asked(cancel->context))
		return error_set(err, ERR_CANCELLED, "cancelled");
	return 0;
}

/*
 * Least length inside the grid of a ray that corrects it, as a share of the smallest voxel spacing: see sart_iterate.
 */
#define RAY_LENGTH_LEAST 0.5
/*
 * Least column sum that the matched pair divides by, as a share of the same spacing. Symmetric scans have rays that
 * pass at exactly the distance where their weight ends: a voxel that rounding alone lets them touch must hardly move.
 */
#define COLUMN_SUM_LEAST 0.01

enum backprojection { BACKPROJECT_PLAIN, BACKPROJECT_FDK /* times (D/depth)^2 */ };

struct backend {
	const char *name;    /* "cpu", "cuda" */
	const char *summary; /* for --help */
	/* The devices have memory of their own: a job too large for it can run out of core, in slabs (outofcore.h). */
	bool own_memory;
	/* `filter` only notes what is to be filtered and `backproject` does it: FDK takes all views in one go. */
	bool defers_filter;

	/* Devices that answer now; 0 when there is none. Never fails. */
	int (*count)(void);
	int (*open)(int index, const struct device_options *options, struct device **ret_device, struct error *err);
	void (*close)(struct device *device); /* NULL is fine */
	void (*describe)(struct device *device, struct device_info *ret_info);

	int (*volume_new)(struct device *device, const struct grid *grid, struct volume **ret_volume,
			  struct error *err);
	void (*volume_free)(struct volume *volume); /* NULL is fine */
	/* Bytes that volume_new takes of the device's memory; device may be NULL but for several cards. */
	size_t (*volume_bytes)(const struct device *device, const struct grid *grid);
	int (*volume_upload)(struct volume *volume, const float *from, struct error *err);
	/* Slices z_first .. z_first + z_count - 1; the others stay. */
	int (*volume_put)(struct volume *volume, int z_first, int z_count, const float *from, struct error *err);
	/* Waits for what changes the volume, not for what was asked of the device since. */
	int (*volume_download)(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err);
	int (*volume_fill)(struct volume *volume, float value, struct error *err);
	int (*volume_copy)(struct volume *to, const struct volume *from, struct error *err);

	int (*stack_new)(struct device *device, int columns, int rows, int slots, struct stack **ret_stack,
			 struct error *err);
	void (*stack_free)(struct stack *stack); /* NULL is fine */
	/* Bytes that stack_new takes of the device's memory; likewise. */
	size_t (*stack_bytes)(const struct device *device, int columns, int rows, int slots);
	int (*stack_download)(struct stack *stack, int slot, int count, float *ret_to, struct error *err);
	/* Line integrals [slot][row][column]; `from` has been read when it returns. */
	int (*stack_upload)(struct stack *stack, int slot, int count, const float *from, struct error *err);

	/* Touches no device memory, device may be NULL: it is how a job that cannot fit is refused beforehand. */
	int (*plan_bytes)(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
			  struct error *err);
	int (*plan_new)(struct device *device, const struct plan_options *options, struct plan **ret_plan,
			struct error *err);
	void (*plan_free)(struct plan *plan); /* NULL is fine */
	/* Says how this plan does its work, e.g. "untilted, 16 x 16 tiles, AVX-512": said in the job's document. */
	const char *(*plan_summary)(const struct plan *plan);
	/* Views that FDK should filter and backproject in one go. */
	int (*plan_batch)(const struct plan *plan);

	/*
	 * Raw samples of `count` views -> line integrals in the slots named by `slots`.
	 * Defects (of the map, zero, negative, saturated, not finite) are replaced from
	 * their neighbours in the row and column and counted.
	 */
	int (*linearise)(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
			 struct defect_counts *counts, struct error *err);
	/*
	 * q = ramp of weights and cosine times p: view views[i] from slot slots[i] of `from` into slot i of `to`.
	 * slots NULL: slot = view. FDK alone keeps no stack of all views, its slots are those of one batch.
	 * With plan_options.extend truncated rows are extended, see core/truncation.h.
	 */
	int (*filter)(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		      struct stack *to, struct error *err);
	/*
	 * Rows that `filter` has extended since the plan was made: before column 0 and
	 * behind the last one. Waits for the device, so that `filter` need not.
	 */
	int (*filter_extended)(struct plan *plan, size_t ret_rows[2], struct error *err);
	/* volume += sum over i of (weight) * slot i, seen from views[i]. Bilinear; outside of the detector is 0. */
	int (*backproject)(struct plan *plan, const struct stack *from, const int *views, int count,
			   enum backprojection weight, struct volume *to, struct error *err);
	/*
	 * Slot i = line integrals of the volume's linear interpolation along the rays
	 * of views[i]: slice by slice of the ray's dominant axis between entry and exit,
	 * each with its bilinear interpolation averaged over the way between the two
	 * slices beside it (weight 1 - |s|; exactly so along b, the first of the other
	 * two axes, and as at the slice itself along the last one, where a C-arm's rays
	 * hardly rise), times the step's length in mm. The object ends half a voxel
	 * beyond the outer centres in every direction, values there held.
	 * Dominant is the axis along which the ray passes the most voxels (x before y
	 * before z where equal). A slice stands for half a voxel to either side of its
	 * centres; the first and last count with the part that lies between entry and
	 * exit, so that the weights of a ray add up to its length inside the grid.
	 */
	int (*project)(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		       struct error *err);
	/*
	 * One iteration over all subsets, in place:
	 *   v_j += relaxation * (sum_S w_ij (p_i - sum_m w_im v_m) / sum_m w_im) / sum_S w_ij
	 * forward weights are those of `project`, backward ones those of plain
	 * `backproject`; row and column sums come from the same operators. Rays that
	 * miss the grid and voxels that no ray of the subset sees stay as they are;
	 * a ray that only grazes it, with less than RAY_LENGTH_LEAST of the smallest
	 * spacing inside, counts as one that misses, and the matched pair divides by
	 * COLUMN_SUM_LEAST of that spacing at least. A ray that is left out (p_i is
	 * RAY_LEFT_OUT) has the correction 0, whatever the volume is. The column sums count
	 * it still, so that its voxels move less; they need no pass of their own then.
	 */
	int (*sart_iterate)(struct plan *plan, const struct stack *projections, struct volume *volume,
			    const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err);
	/*
	 * TV in place. Method and iterations are at most what plan_options.tv has, which the plan has memory for;
	 * alpha, step and unit are free.
	 */
	int (*tv)(struct plan *plan, struct volume *volume, const struct tv_options *options,
		  const struct cancel *cancel, struct error *err);
	/* `other` may be NULL; unit as in tv_options. */
	int (*norms)(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
		     struct volume_norms *ret_norms, struct error *err);
	/*
	 * The algebra that iterative methods are written in. Volumes are of one grid. Stacks are of one detector; slot
	 * i of y, the first `count` of them, goes with slot slots[i] of x; slots NULL: slot i. A ray that is left out
	 * is NaN in the projections, and is made 0 by stack_mask before it meets a sum.
	 */
	/* y = a x + b y; with b = 0 whatever y was. */
	int (*volume_axpby)(double a, const struct volume *x, double b, struct volume *y, struct error *err);
	int (*stack_axpby)(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
			   struct error *err);
	/* Sum over all elements of x y, for stacks of w x y; w NULL: 1. */
	int (*volume_dot)(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
			  struct error *err);
	int (*stack_dot)(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y,
			 int count, double *ret_sum, struct error *err);
	/* y / x where x is at least `least`, 0 elsewhere. */
	int (*volume_divide)(const struct volume *x, double least, struct volume *y, struct error *err);
	int (*stack_divide)(const struct stack *x, double least, int count, struct stack *y, struct error *err);
	/* y = x y. */
	int (*stack_multiply)(const struct stack *x, int count, struct stack *y, struct error *err);
	/* y = max(y, a x); x may be y, which with a = 0 clips y at 0. */
	int (*volume_maximum)(double a, const struct volume *x, struct volume *y, struct error *err);
	int (*stack_fill)(struct stack *y, int count, float value, struct error *err);
	/* y = 0 where x is NaN. */
	int (*stack_mask)(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err);
	/*
	 * Each pixel of one slot becomes the mean over width[0] columns and width[1] rows (>= 1, odd numbers of pixels
	 * or with shares of the outermost ones) around it. At the detector's edge the range shrinks on both sides, so
	 * that its centre stays; NaN stays NaN, and is no part of others' means. work: a stack of the same detector,
	 * whose slot 0 is overwritten.
	 */
	int (*stack_average)(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err);
	int (*sync)(struct device *device, struct error *err);

	/*
	 * The parts of an iteration that several devices share (core/cards/cards.h); NULL in a backend that is made of
	 * another one.
	 */
	/*
	 * Slot i of `rays`, the projection of a volume, becomes (p - A v) / L: p is slot views[i] of `measured`, L the
	 * length of the rays of views[i] in `grid`, of the whole volume. The rest is as with sart_iterate. Squares are
	 * kept for sart_sums of all rows but those from left_out[0] to left_out[1] - 1; `before` views of the iteration
	 * have been corrected already.
	 */
	int (*sart_correct)(struct plan *plan, const struct geometry *geometry, const struct grid *grid,
			    const struct stack *measured, const int *views, int count, const int left_out[2],
			    int before, struct stack *rays, struct error *err);
	/* Over the rays of the `count` views that have been corrected since the iteration began; waits for them. */
	int (*sart_sums)(struct plan *plan, int count, struct iteration_sums *ret_sums, struct error *err);
	/* Sum of squares of slots 0 .. count - 1, but of rows left_out and of what is no number. */
	int (*sart_squares)(struct plan *plan, const struct stack *stack, int count, const int left_out[2],
			    double *ret_sum, struct error *err);
	/*
	 * All views see all of the grid: column sums are numbers of views, of which a plan with these options takes its
	 * own account. NULL: nobody looks.
	 */
	bool (*sart_covered)(const struct plan_options *options);
	/*
	 * The update from slots of `rays` in one go: v += relaxation * (their plain backprojection) / coverage, as
	 * sart_update; coverage NULL where sart_covered. NULL: by backproject and sart_update.
	 */
	int (*sart_take)(struct plan *plan, const struct sart_options *options, double least, const struct stack *rays,
			 const int *views, int count, const struct volume *coverage, struct volume *volume,
			 struct error *err);
	/* Column sums: to = sum over i of w_ij of the rays of views[i], as plain `backproject` has of ones. */
	int (*sart_coverage)(struct plan *plan, const int *views, int count, struct volume *to, struct error *err);
	/* v += relaxation sums / coverage, where coverage is divided by as `least` if it is smaller, and not at all at
	 * 0; coverage NULL: 1 everywhere. */
	int (*sart_update)(const struct sart_options *options, double least, const struct volume *sums,
			   const struct volume *coverage, struct volume *volume, struct error *err);
	/*
	 * `tv` in parts: its steps first .. first + count - 1, options->iterations of them in all. Between two calls
	 * the volume is what has been smoothed, and the plan keeps what the next steps need. TV_GENERALISED not.
	 */
	int (*tv_steps)(struct plan *plan, struct volume *volume, const struct tv_options *options, int first,
			int count, const struct cancel *cancel, struct error *err);
	/*
	 * Between two calls, `done` steps behind the beginning: what `count` slices from z_from on have come to, to
	 * those of another device's plan from z_to on. Called by the thread that has the device of `to`.
	 */
	int (*tv_pass)(struct plan *from, const struct volume *from_volume, int z_from, struct plan *to,
		       struct volume *to_volume, int z_to, int count, const struct tv_options *options, int done,
		       struct error *err);
	/*
	 * Lets these devices read each other's memory. True: stack_pass and volume_pass work between any two of them,
	 * and the memory that they read is not overwritten before. NULL, as the next two, where that goes through the
	 * host.
	 */
	bool (*connect)(struct device *const devices[], int count);
	/*
	 * Rows row .. row + rows - 1 of slots from_slots[i] to row to_row and on of slots to_slots[i]; add: they are
	 * added to what is there. Both have the same columns. Called by the thread that has the device of `to`.
	 */
	int (*stack_pass)(const struct stack *from, const int *from_slots, int from_row, struct stack *to,
			  const int *to_slots, int to_row, int rows, int count, bool add, struct error *err);
	/* `count` slices from z_from on to z_to and on; likewise. */
	int (*volume_pass)(const struct volume *from, int z_from, struct volume *to, int z_to, int count,
			   struct error *err);
	/* Gives back what the process keeps of a device whose last has been closed. NULL: nothing. */
	void (*release)(int index);
};

/*
 * The table of backends, best first. A row is NULL where the program was linked
 * without it: the daemon and a build without nvcc have no CUDA.
 */
enum { BACKEND_COUNT = 2 };
extern const struct backend *const backends[BACKEND_COUNT];
extern const struct backend backend_cpu;
/*
 * How many threads of the host the calling thread's work is shared among, on any backend: what is done beside the
 * device, and for the CPU's default. 0: all that the process may use.
 */
void backend_host_threads(int threads);
/* Finds a backend by its name; "auto" gives the first that has a device. NULL when there is none. */
const struct backend *backend_find(const char *name);

#ifdef __cplusplus
}
#endif

#endif

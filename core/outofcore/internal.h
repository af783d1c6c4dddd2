#ifndef CBCT_CORE_OUTOFCORE_INTERNAL_H
#define CBCT_CORE_OUTOFCORE_INTERNAL_H

#include "core/arena.h"
#include "core/outofcore/outofcore.h"

/*
 * Declarations that the files of core/outofcore share. Members of these four structs that
 * belong to the backend below are used through device->backend only.
 */
struct device {
	const struct backend *backend; /* the one below */
	struct device *below;
};

struct volume {
	struct device *device;
	int size[3];
	size_t slice; /* floats */
	float *data;  /* [z][y][x], host */
	bool is_zero; /* nothing but zeros so far */
};

struct stack {
	struct device *device;
	int columns, rows, slots;
	size_t pixels;
	size_t bytes; /* of `data`, `from` and `views`, in one piece that `data` begins */
	float *data;  /* [slot][row][column], host; not touched where `by` is set */
	/* Views that `filter` only noted: slot i is views[i] filtered, from slot from[i] of `source`. */
	struct plan *by;
	const struct stack *source;
	int *from, *views;
	int filtered;
};

/* Purpose of a slab on the device: it decides on the slab's plan and on the memory beside it. */
enum purpose { FOR_FDK, FOR_SUMS, FOR_TV, PURPOSE_COUNT };

enum { OUTOFCORE_BATCH = 32 }; /* views on the device at a time: by then launches are long hidden */

struct plan {
	struct device *device;
	struct plan_options options;
	int batch;                 /* views on the device at a time */
	int slices[PURPOSE_COUNT]; /* of a slab, 0 where the purpose has none */
	struct plan_bytes bytes;
	void *memory; /* everything of the host's that plan_walk takes, memory_bytes of it */
	size_t memory_bytes;
	int identity[OUTOFCORE_BATCH]; /* 0, 1, 2 ... */
	char summary[192];

	struct plan *intake; /* linearises, knows no volume but one of a voxel */
	struct grid one;     /* that one */
	struct stack *taken; /* one slot */
	/* A slab's sums and column sums, or the slices that TV keeps: [slice][y][x]. */
	float *sums;
	float *partial;          /* [batch][row][column] */
	double *rows;            /* [rows][2] of sums over a view */
	struct stack correction; /* of the largest subset; no slots without SART */
	size_t extended[2];
};

/* Slices first .. first + count - 1 of the grid on the device, `below` and `above` more on either side. */
struct slab {
	int first, count, below, above;
	struct grid grid;
	struct plan *plan;
	struct volume *volume;
};

/* Stacks on the device for batches of views: two in turn, one filled while the other is in use, and one of filtered
 * views. */
struct transfer {
	struct stack *in[2], *filtered;
};

/* Zeros of the host's memory, not counted before they are touched; NULL: no memory. */
void *outofcore_allocate(size_t bytes);
void outofcore_release(void *memory, size_t bytes);
/* A piece on pages of its own, or on a cache line. */
static inline void *outofcore_take(struct arena *arena, size_t bytes)
{
	enum { LINE = 64, PAGE = 4096, LARGE = 64 << 10 };

	return arena_take(arena, bytes, bytes >= LARGE ? PAGE : LINE);
}
/* Walk over the memory of a stack of these sizes, into *ret_stack. */
void stack_walk(struct device *device, int columns, int rows, int slots, struct stack *ret_stack, struct arena *arena);

/* ---- plan.c ---- */
int outofcore_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
			 struct error *err);
int outofcore_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan,
		       struct error *err);
void outofcore_plan_free(struct plan *plan);
/* Slices of the volume, that many beyond a slab for its neighbours' sake. */
int outofcore_halo(const struct plan_options *options, enum purpose purpose);
int slab_open(struct plan *plan, enum purpose purpose, int first, struct slab *ret_slab, struct error *err);
void slab_close(struct plan *plan, struct slab *slab); /* a closed one is fine */
int transfer_open(struct plan *plan, enum purpose purpose, struct transfer *ret_transfer, struct error *err);
void transfer_close(struct plan *plan, struct transfer *transfer);

/* ---- project.c ---- */
int outofcore_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		      struct error *err);
int outofcore_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
			  enum backprojection weight, struct volume *to, struct error *err);
int outofcore_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err);

/* ---- sart.c ---- */
int outofcore_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
			   const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err);

/* ---- algebra.c ---- */
int outofcore_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err);
int outofcore_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
			  struct error *err);
int outofcore_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
			 struct error *err);
int outofcore_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y,
			int count, double *ret_sum, struct error *err);
int outofcore_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err);
int outofcore_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err);
int outofcore_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err);
int outofcore_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err);
int outofcore_stack_fill(struct stack *y, int count, float value, struct error *err);
int outofcore_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err);
int outofcore_stack_average(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err);

/* ---- tv.c ---- */
int outofcore_tv(struct plan *plan, struct volume *volume, const struct tv_options *options,
		 const struct cancel *cancel, struct error *err);
int outofcore_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
		    struct volume_norms *ret_norms, struct error *err);

#endif

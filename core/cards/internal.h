#ifndef CBCT_CORE_CARDS_INTERNAL_H
#define CBCT_CORE_CARDS_INTERNAL_H

#include "core/cards/cards.h"
#include "core/cards/crew.h"

/*
 * Declarations that the files of core/cards share. Members that belong to the backend below, of its types by the same
 * names, are used through device->backend only.
 */
struct device {
	const struct backend *backend; /* the one below */
	int count;
	struct device *card[CARDS_MOST];
	bool shared;            /* the cards are shares of one memory, with no limit each */
	bool connected;         /* they pass stacks and slices to each other without the host */
	unsigned long writings; /* counts the writings to stacks */
	struct crew *crew;
};

/* Slices first[c] .. first[c + 1] - 1 on card c, for all cards but the last ones where there are fewer slices. */
struct volume {
	struct device *device;
	int size[3];
	int first[CARDS_MOST + 1];
	struct volume *part[CARDS_MOST]; /* NULL: no slice */
};

/* Slot s is slot slot_place(s) of the part on card slot_card(s). */
struct stack {
	struct device *device;
	int columns, rows, slots;
	unsigned long written; /* the last writing to it, of device->writings: its contents have a number */
	struct stack *part[CARDS_MOST];
};

/* Called by whatever writes to a stack. */
static inline void stack_written(struct stack *stack)
{
	stack->written = ++stack->device->writings;
}

static inline int slot_place(const struct device *device, int slot)
{
	return slot / device->count;
}
/*
 * Of as many slots as there are cards, one after the other, each card has one; which is which changes from lot to lot
 * without a pattern, so that the cards have equal shares of every tenth view, too.
 */
static inline int slot_card(const struct device *device, int slot)
{
	const unsigned lot = (unsigned)(slot / device->count);

	return (int)(((unsigned)slot + (lot * 2654435761u >> 16)) % (unsigned)device->count);
}
/* How many of the first `count` slots card c has. */
static inline int slots_on(const struct device *device, int count, int c)
{
	int slots = count / device->count;

	for (int s = slots * device->count; s < count; s++)
		slots += slot_card(device, s) == c;
	return slots;
}

/* A view's place among the cards' stacks. */
struct place {
	int card, slot;
};

/* What a plan has on one card. */
struct card_plan {
	struct plan *intake; /* of the whole detector and one voxel: linearises, filters, corrects */
	/* Of the slab, NULL where the card has none, and the rows that see it: row and on, geometry.rows of them. */
	struct plan *slab;
	struct grid grid;
	struct geometry geometry;
	int row;
	/*
	 * To project, and to backproject by the transpose of that: the slab between slices of zeros, where it has
	 * neighbours. They are zeros whenever no operation runs.
	 */
	struct plan *between;
	struct grid between_grid;
	struct volume *padded;
	int below; /* slices of zeros before it: 0 or 1 */
	/* TV: the slab with slices of its neighbours, tv_first being the first of them. */
	struct plan *tv;
	struct grid tv_grid;
	struct volume *smoothed;
	int tv_first;

	struct stack *in[2];   /* [batch] of these rows, in turn */
	struct stack *wide[2]; /* the same of filtered rows, where they are longer */
	struct stack *taken;   /* views to be filtered here that lie elsewhere */
	/* SART: these rows of all measured projections, and which of them other cards have that come before. */
	struct stack *measured;
	int counted_before[2];
	bool covered; /* every view sees all of the slab: there are no column sums */
	struct volume *sums, *coverage;
	int *from, *to, *views; /* [count], lists */
	float *host;            /* where nothing is connected: two views, or two slices */
};

struct plan {
	struct device *device;
	struct plan_options options;
	struct grid one;
	int parts;                 /* cards that have a slab */
	int tv_steps;              /* of TV between two exchanges, and slices of the neighbours for it */
	int batch;                 /* views that a card projects or backprojects in one go */
	int filter_batch, covered; /* slots of taken; subset whose column sums are there, -1: none */
	int seen[2];               /* rows that any slab is seen by: from and to */
	unsigned long measured;    /* the contents that the cards' `measured` have; 0: none */
	double unseen;             /* squares of the rows that see no slab */
	struct card_plan card[CARDS_MOST];
	struct place *places; /* [count], of the views in hand */
	int *lists;           /* all cards' */
	float *host;          /* all cards' */
	char summary[320];
};

/* ---- cards.c ---- */
/* The first slices of the cards' slabs of so many slices. */
void slabs_cut(const struct device *device, int slices, int ret_first[CARDS_MOST + 1]);
/* What cards do to each other: at once where they are connected, else one after the other. */
int cards_exchange(struct device *device, crew_work *work, void *context, struct error *err);
/* Rows from card to card, through `host` where they are not connected: room for a slot of either stack. */
struct passage {
	const struct stack *from;
	struct stack *to;
	int columns, from_rows, to_rows; /* of the stacks below */
	int from_row, to_row, rows;      /* that are passed */
	bool add;
	float *host;
};
int cards_pass(const struct device *device, const struct passage *passage, const int *from_slots, const int *to_slots,
	       int count, struct error *err);
/* Slices from card to card; `host` has room for one. */
int cards_pass_slices(const struct device *device, const struct volume *from, int z_from, struct volume *to, int z_to,
		      int count, float *host, struct error *err);

/* ---- plan.c ---- */
int cards_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		     struct error *err);
int cards_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan,
		   struct error *err);
void cards_plan_free(struct plan *plan);

/* ---- project.c ---- */
/* Where the first `count` slots of any stack lie, to plan->places. */
void place_slots(struct plan *plan, int count);
/* A x of these views into parts[card], by plan->places; all else of their first slots becomes 0. */
int project_through(struct plan *plan, const struct volume *from, const int *views, int count,
		    struct stack *const parts[], const struct cancel *cancel, struct error *err);
/* True if plain backprojection goes through the volumes between slices of zeros. */
static inline bool goes_between(const struct plan *plan, enum backprojection weight)
{
	return plan->options.matched && weight == BACKPROJECT_PLAIN;
}
/* Views of a batch, of so many: as few batches as can be, alike. */
static inline int batch_of(const struct plan *plan, int count)
{
	const int batches = (count + plan->batch - 1) / plan->batch;

	return batches == 0 ? 0 : (count + batches - 1) / batches;
}
/* The slab from and to its place between slices of zeros; the second leaves zeros there. */
int slab_enter(struct plan *plan, int c, const struct volume *from, struct error *err);
int slab_leave(struct plan *plan, int c, struct volume *to, struct error *err);
/* The other way, added to the cards' volumes. */
int backproject_through(struct plan *plan, struct stack *const parts[], const int *views, int count,
			enum backprojection weight, struct volume *const to[], const struct cancel *cancel,
			struct error *err);
int cards_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		    struct defect_counts *counts, struct error *err);
int cards_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		 struct stack *to, struct error *err);
int cards_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err);
int cards_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		  struct error *err);
int cards_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		      enum backprojection weight, struct volume *to, struct error *err);

/* ---- sart.c ---- */
int cards_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		       const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err);

/* ---- tv.c ---- */
int cards_tv(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	     struct error *err);
int cards_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
		struct volume_norms *ret_norms, struct error *err);

/* ---- algebra.c ---- */
int cards_volume_fill(struct volume *volume, float value, struct error *err);
int cards_volume_copy(struct volume *to, const struct volume *from, struct error *err);
int cards_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err);
int cards_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
		      struct error *err);
int cards_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
		     struct error *err);
int cards_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y, int count,
		    double *ret_sum, struct error *err);
int cards_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err);
int cards_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err);
int cards_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err);
int cards_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err);
int cards_stack_fill(struct stack *y, int count, float value, struct error *err);
int cards_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err);
int cards_stack_average(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err);

#endif

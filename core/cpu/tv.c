/*
 * Total variation, in place. With u = v / unit the stage either takes explicit
 * steps of
 *
 *   (u' - u) / step = div(grad u / |grad u|) - alpha (u - f),   f = u at entry
 *
 * (Rudin, Osher and Fatemi, Physica D 60, 1992) or finds the minimiser of
 *
 *   sum |grad u| + alpha / 2 sum (u - f)^2
 *
 * by Chambolle and Pock's accelerated primal-dual steps (J. Math. Imaging Vis.
 * 40, 2011, algorithm 2). Forward differences, weighted along each axis by
 * smallest spacing / spacing; nothing flows over the border; div is minus the
 * adjoint of grad.
 *
 * A pass goes over the planes once, in place: a voxel's update needs the flux p
 * of itself and of its three predecessors, and theirs needs its old value. So
 * the flux along y of one plane and that along x of one row are kept, and where
 * two threads meet, each first saves what the other will overwrite.
 */
#include "core/cpu/cpu.h"

#include <string.h>

void tv_box_of(const struct plan *plan, struct tv_box *ret)
{
	const int *size = plan->grid.size;
	float w[3];

	for (int i = 0; i < 3; i++)
		w[i] = (float)(plan->spacing_least / plan->grid.spacing[i]);
	if (size[2] == 1)
		*ret = (struct tv_box){size[1], 1, size[0], plan->plane, plan->plane, {w[1], w[2], w[0]}};
	else
		*ret = (struct tv_box){size[1], size[0], size[2], plan->plane, plan->row, {w[1], w[0], w[2]}};
}

double tv_box_weights(const struct tv_box *box)
{
	double slow = box->weights.slow, middle = box->weights.middle, fast = box->weights.fast;

	return (box->slow > 1) * slow * slow + (box->middle > 1) * middle * middle + (box->fast > 1) * fast * fast;
}

/* State of a thread that goes through its planes. */
struct part {
	int begin, end;      /* planes */
	float *next;         /* plane `end` as it was before the pass */
	float *slow;         /* flux along y: of this plane up to the row in hand, from there on of the one before */
	float *middle;       /* flux along x of the row before */
	struct tv_flux flux; /* of the row in hand */
};

static size_t padded(size_t floats)
{
	return (floats + LANES_MOST - 1) / LANES_MOST * LANES_MOST + LANES_MOST;
}

size_t tv_planes_floats(const struct plan *plan)
{
	struct tv_box box;

	tv_box_of(plan, &box);
	return 2 * padded(box.plane) + 5 * padded((size_t)box.fast);
}

static struct part part_of(const struct plan *plan, const struct tv_box *box, int index)
{
	const long long parts = plan->device->threads;
	const size_t plane = padded(box->plane), row = padded((size_t)box->fast);
	float *next = plan->planes + (size_t)index * plan->planes_floats, *rows = next + 2 * plane;

	return (struct part){
	    .begin = (int)(box->slow * (long long)index / parts),
	    .end = (int)(box->slow * (index + 1LL) / parts),
	    .next = next,
	    .slow = next + plane,
	    .middle = rows,
	    .flux = {rows + row, rows + 2 * row, rows + 3 * row + LANES_MOST},
	};
}

/* A pass of either method. The volumes are [slow][middle][fast]. */
struct pass {
	const struct tv_box *box;
	const struct cpu_kernels *kernels;
	float *ahead; /* whose gradient is taken: the iterate itself, or its overrelaxed twin */
	float *v;     /* the iterate */
	const float *f;
	float *dual[3]; /* flux along slow, middle, fast; NULL for explicit steps */
	struct tv_step step;
	int first, count; /* steps that are taken */
};

/* Flux of one row. `next` is the plane behind, NULL at the last: then differences to the row itself, 0, are taken. */
static void flux_row(const struct pass *pass, int plane, int row, const float *next, struct tv_flux *ret_flux)
{
	const struct tv_box *box = pass->box;
	const size_t at = (size_t)plane * box->plane + (size_t)row * box->row;
	const float *u = pass->ahead + at;
	const struct tv_row from = {
	    .count = box->fast,
	    .u = u,
	    .middle = row + 1 < box->middle ? u + box->row : u,
	    .slow = next != NULL ? next + (size_t)row * box->row : u,
	};

	if (pass->dual[0] == NULL) {
		pass->kernels->tv_flux(&from, &box->weights, pass->step.epsilon2, ret_flux);
	} else {
		const struct tv_flux old = {pass->dual[0] + at, pass->dual[1] + at, pass->dual[2] + at};

		pass->kernels->tv_dual(&from, &box->weights, pass->step.sigma, &old, ret_flux);
	}
}

/* Before anything is overwritten: the plane behind the part, and the flux of the plane before it. */
static void part_begin(const struct pass *pass, const struct part *part)
{
	const struct tv_box *box = pass->box;
	const size_t fast = (size_t)box->fast * sizeof(float);

	if (part->end < box->slow)
		memcpy(part->next, pass->ahead + (size_t)part->end * box->plane, box->plane * sizeof(float));
	if (part->begin == 0) {
		memset(part->slow, 0, box->plane * sizeof(float));
		return;
	}
	for (int row = 0; row < box->middle; row++) {
		struct tv_flux flux = part->flux;

		flux_row(pass, part->begin - 1, row, pass->ahead + (size_t)part->begin * box->plane, &flux);
		memcpy(part->slow + (size_t)row * box->row, flux.slow, fast);
	}
}

static void part_run(const struct pass *pass, const struct part *part)
{
	const struct tv_box *box = pass->box;
	const size_t fast = (size_t)box->fast * sizeof(float);

	for (int plane = part->begin; plane < part->end; plane++) {
		const float *next = plane + 1 >= box->slow   ? NULL
				    : plane + 1 == part->end ? part->next
							     : pass->ahead + (size_t)(plane + 1) * box->plane;

		memset(part->middle, 0, fast);
		for (int row = 0; row < box->middle; row++) {
			const size_t at = (size_t)plane * box->plane + (size_t)row * box->row;
			const struct tv_flux before = {part->slow + (size_t)row * box->row, part->middle, NULL};
			struct tv_flux flux = part->flux;

			flux_row(pass, plane, row, next, &flux);
			if (pass->dual[0] != NULL) {
				memcpy(pass->dual[0] + at, flux.slow, fast);
				memcpy(pass->dual[1] + at, flux.middle, fast);
				memcpy(pass->dual[2] + at, flux.fast, fast);
			}
			pass->kernels->tv_update(box->fast, &flux, &before, &box->weights, &pass->step, pass->f + at,
						 pass->v + at, pass->ahead + at);
			memcpy(before.slow, flux.slow, fast);
			memcpy(before.middle, flux.middle, fast);
		}
	}
}

static void run_pass(const struct plan *plan, const struct pass *pass)
{
	const int parts = plan->device->threads;

#pragma omp parallel for num_threads(parts) schedule(static, 1)
	for (int i = 0; i < parts; i++) {
		const struct part part = part_of(plan, pass->box, i);

		part_begin(pass, &part);
	}
#pragma omp parallel for num_threads(parts) schedule(static, 1)
	for (int i = 0; i < parts; i++) {
		const struct part part = part_of(plan, pass->box, i);

		part_run(pass, &part);
	}
}

/*
 * Explicit steps. |grad u| is smoothed to sqrt(|grad u|^2 + epsilon^2): then the
 * diffusion coefficient is at most 1 / epsilon, the eigenvalues of the step lie
 * between -(4 W / epsilon + alpha) and 0, W the sum of the squared weights (3 in a
 * cubic grid), and the steps are stable when step times that is at most 2. The
 * smallest epsilon for which they are is taken: 6 step for alpha = 0.
 */
static int run_gradient(const struct plan *plan, struct pass *pass, const struct tv_options *tv,
			const struct cancel *cancel, struct error *err)
{
	const double damping = fmax(2 - tv->alpha * tv->step, .1);
	/* a single voxel has no differences and needs none: but 0, not 0 / 0 */
	const double epsilon = fmax(4 * tv_box_weights(pass->box) * tv->step / damping * tv->unit, 1e-15);

	pass->step = (struct tv_step){
	    .flow = (float)(tv->step * tv->unit),
	    .fidelity = (float)(tv->step * tv->alpha),
	    .epsilon2 = (float)(epsilon * epsilon),
	};
	for (int i = 0; i < pass->count; i++) {
		int code = cancel_check(cancel, err);

		if (code < 0)
			return code;
		run_pass(plan, pass);
	}
	return 0;
}

/*
 * With the overrelaxed u^ = `ahead`, |grad|^2 <= L^2 and sigma tau L^2 = 1:
 *   p  = project(p + sigma grad u^) on |p| <= 1
 *   u' = (u + tau (div p + alpha f)) / (1 + tau alpha)
 *   theta = 1 / sqrt(1 + 2 alpha tau), tau *= theta, sigma /= theta
 *   u^ = u' + theta (u' - u)
 */
static const double TAU_FIRST = 1; /* times 1 / alpha */

static int run_proximal(const struct plan *plan, struct pass *pass, const struct tv_options *tv,
			const struct cancel *cancel, struct error *err)
{
	const double square = fmax(4 * tv_box_weights(pass->box), 1);
	double tau = TAU_FIRST / tv->alpha, sigma = 1 / (square * tau);

	for (int i = 0; i < pass->first + pass->count; i++) {
		const double theta = 1 / sqrt(1 + 2 * tv->alpha * tau);
		int code = i < pass->first ? 0 : cancel_check(cancel, err);

		if (code < 0)
			return code;
		pass->step = (struct tv_step){
		    .flow = (float)(tau * tv->unit / (1 + tau * tv->alpha)),
		    .fidelity = (float)(tau * tv->alpha / (1 + tau * tv->alpha)),
		    .sigma = (float)(sigma / tv->unit),
		    .theta = (float)theta,
		};
		if (i >= pass->first)
			run_pass(plan, pass);
		tau *= theta;
		sigma /= theta;
	}
	return 0;
}

/* f, and where the primal-dual steps begin. */
static int begin(struct plan *plan, const struct volume *volume, enum tv_method method, struct error *err)
{
	int code = backend_cpu.volume_copy(&plan->work, volume, err);

	if (code == 0 && method != TV_GRADIENT)
		code = backend_cpu.volume_copy(&plan->ahead, volume, err);
	for (int i = 0; code == 0 && method == TV_PROXIMAL && i < 3; i++)
		code = backend_cpu.volume_fill(&plan->dual[i], 0, err);
	return code;
}

int cpu_tv_steps(struct plan *plan, struct volume *volume, const struct tv_options *options, int first, int count,
		 const struct cancel *cancel, struct error *err)
{
	struct tv_box box;
	struct pass pass = {.box = &box, .kernels = plan->device->kernels, .v = volume->data};
	int code = 0;

	if (!plan->has_tv || options->method > plan->tv.method)
		return error_set(err, ERR_INTERNAL, "the plan was made without this TV");
	tv_box_of(plan, &box);
	if (first == 0)
		code = begin(plan, volume, options->method, err);
	if (code < 0)
		return code;
	pass.f = plan->work.data;
	pass.first = first;
	pass.count = count;
	if (options->method == TV_GRADIENT) {
		pass.ahead = pass.v;
		return run_gradient(plan, &pass, options, cancel, err);
	}
	pass.ahead = plan->ahead.data;
	for (int i = 0; i < 3; i++)
		pass.dual[i] = plan->dual[i].data;
	return run_proximal(plan, &pass, options, cancel, err);
}

int cpu_tv(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	   struct error *err)
{
	int code;

	if (options->method != TV_GENERALISED)
		return cpu_tv_steps(plan, volume, options, 0, options->iterations, cancel, err);
	if (!plan->has_tv || options->method > plan->tv.method)
		return error_set(err, ERR_INTERNAL, "the plan was made without this TV");
	code = begin(plan, volume, options->method, err);
	return code < 0 ? code : tgv_run(plan, volume, options, cancel, err);
}

static void pass_slices(const struct volume *from, int z_from, struct volume *to, int z_to, int count)
{
	for (int y = 0; y < to->size[1]; y++)
		for (int x = 0; x < to->size[0]; x++)
			memcpy(to->data + (size_t)y * to->plane + (size_t)x * to->row + z_to,
			       from->data + (size_t)y * from->plane + (size_t)x * from->row + z_from,
			       (size_t)count * sizeof(float));
}

int cpu_tv_pass(struct plan *from, const struct volume *from_volume, int z_from, struct plan *to,
		struct volume *to_volume, int z_to, int count, const struct tv_options *options, int done,
		struct error *err)
{
	(void)done;
	(void)err;
	pass_slices(from_volume, z_from, to_volume, z_to, count);
	if (options->method == TV_GRADIENT)
		return 0;
	pass_slices(&from->ahead, z_from, &to->ahead, z_to, count);
	for (int i = 0; i < 3; i++)
		pass_slices(&from->dual[i], z_from, &to->dual[i], z_to, count);
	return 0;
}

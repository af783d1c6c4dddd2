/*
 * Raw samples to line integrals with the rules of core/cpu/linearise.c:
 *
 *   p  = -ln((I - dark) / (a (flat - dark))),  a the view's own air (1 without an air region),
 *   p' = hardening[0] + hardening[1] p + hardening[2] p^2 + ...
 *
 * Defects take the values of the nearest good pixels in their row and column,
 * weighted by 1 / distance, in two passes.
 *
 * All of it runs on the stream for what comes in, beside whatever computes.
 */
#include <cmath>

#include "kernels/internal.cuh"

struct samples {
	struct linearise how; /* its images are on the device; its hardening is not, and stands below */
	const void *raw;
	float saturation;
	int columns, rows;
	float hardening[HARDENING_MOST];
};

/* Defects that a call met: struct defect_counts in numbers that a kernel can add to. */
struct linearised {
	unsigned long long kinds[PIXEL_KINDS]; /* PIXEL_GOOD is not counted */
	int blank, no_air;
	float air; /* of the view in hand */
	float air_least, air_most;
};

static size_t pixel_bytes(int image)
{
	return image_bytes((enum image)image, 1, 1);
}

void linearise_walk(struct plan *plan, struct arena *arena)
{
	const struct linearise *options = &plan->options.linearise;
	size_t pixels = (size_t)plan->stack.columns * (size_t)plan->stack.rows;

	if (plan->raw_views == 0)
		return;
	take(arena, &plan->raw, plan->raw_bytes * (size_t)plan->raw_views);
	for (int i = 0; i < 2; i++)
		take(arena, &plan->marks[i], pixels);
	take(arena, &plan->counters, 1);
	for (int i = 0; i < IMAGE_COUNT; i++)
		take(arena, &plan->image[i], options->image[i] != NULL ? pixels * pixel_bytes(i) : 0);
}

int linearise_prepare(struct plan *plan, struct error *err)
{
	const struct linearise *options = &plan->options.linearise;
	size_t pixels = (size_t)plan->stack.columns * (size_t)plan->stack.rows;

	for (int i = 0; i < IMAGE_COUNT; i++)
		if (plan->image[i] != NULL)
			CUDA_TRY(cudaMemcpy(plan->image[i], options->image[i], pixels * pixel_bytes(i),
					    cudaMemcpyHostToDevice));
	return 0;
}

static __device__ __forceinline__ enum pixel_kind transmission(const samples &s, size_t at, float &ret)
{
	return linearise_transmission(&s.how, linearise_sample(&s.how, s.raw, at), at, s.saturation, &ret);
}

/* The mean transmission of the air region's good pixels, in a fixed order; 0 where there is none. */
static __global__ void __launch_bounds__(256) find_air(const samples s, linearised *found)
{
	__shared__ double sums[256];
	__shared__ int counts[256];
	const int *region = s.how.air_region;
	int wide = region[2] - region[0] + 1, pixels = wide * (region[3] - region[1] + 1), good = 0;
	double sum = 0;

	for (int i = threadIdx.x; i < pixels; i += 256) {
		size_t at = (size_t)(region[1] + i / wide) * s.columns + (size_t)(region[0] + i % wide);
		float value;

		if (linearise_mapped(&s.how, at) || transmission(s, at, value) != PIXEL_GOOD)
			continue;
		sum += (double)value;
		good++;
	}
	sums[threadIdx.x] = sum;
	counts[threadIdx.x] = good;
	for (int half = 128; half > 0; half /= 2) {
		__syncthreads();
		if (threadIdx.x < half) {
			sums[threadIdx.x] += sums[threadIdx.x + half];
			counts[threadIdx.x] += counts[threadIdx.x + half];
		}
	}
	if (threadIdx.x > 0)
		return;
	float air = counts[0] > 0 ? (float)(sums[0] / counts[0]) : 0.0f;
	found->air = air > 0 ? air : 1.0f;
	if (!(air > 0)) {
		found->no_air++;
		return;
	}
	if (air < found->air_least || found->air_least == 0)
		found->air_least = air;
	if (air > found->air_most)
		found->air_most = air;
}

/* Linearises one view, [row][column], into a slot, with a mark for each defect. */
static __global__ void __launch_bounds__(256)
    to_integrals(const samples s, float *slot, int pitch, unsigned char *marks, linearised *found)
{
	int column = blockIdx.x * 32 + threadIdx.x, row = blockIdx.y * 8 + threadIdx.y;
	size_t at = (size_t)row * s.columns + column;
	enum pixel_kind what = PIXEL_GOOD;
	float p;

	if (column >= s.columns || row >= s.rows)
		return;
	if (linearise_mapped(&s.how, at)) {
		what = PIXEL_MAPPED;
		p = 0;
	} else {
		p = linearise_sample(&s.how, s.raw, at);
		if (s.how.quantity == QUANTITY_INTENSITY) {
			what = transmission(s, at, p);
			p = -logf(s.how.has_air_region ? p / found->air : p);
		}
		if (s.how.hardening_count > 0) {
			float sum = 0;

			for (int k = s.how.hardening_count - 1; k >= 0; k--)
				sum = fmaf(sum, p, s.hardening[k]);
			p = sum;
		}
		if (what == PIXEL_GOOD && !isfinite(p))
			what = PIXEL_NOT_FINITE;
	}
	slot[(size_t)row * pitch + column] = what == PIXEL_GOOD ? p : 0.0f;
	marks[at] = what != PIXEL_GOOD;
	if (what != PIXEL_GOOD)
		atomicAdd(&found->kinds[what], 1ull); /* defects are rare */
}

/* Adds the nearest good pixel in one direction, weighted by 1 / distance. */
static __device__ void look(const samples &s, const float *slot, int pitch, const unsigned char *marks, int column,
			    int row, int column_step, int row_step, float &sum, float &weights)
{
	int c = column + column_step, r = row + row_step;

	for (int distance = 1; c >= 0 && c < s.columns && r >= 0 && r < s.rows;
	     c += column_step, r += row_step, distance++) {
		if (marks[(size_t)r * s.columns + c])
			continue;
		sum += slot[(size_t)r * pitch + c] / (float)distance;
		weights += 1.0f / (float)distance;
		return;
	}
}

/*
 * Only marked pixels are written and only unmarked ones read. A pixel that is
 * marked after the second pass (the one with `found`) is of a view without a good one.
 */
static __global__ void __launch_bounds__(256)
    replace(const samples s, float *slot, int pitch, const unsigned char *marks, unsigned char *ret_marks,
	    linearised *found)
{
	int column = blockIdx.x * 32 + threadIdx.x, row = blockIdx.y * 8 + threadIdx.y;
	float sum = 0, weights = 0;

	if (column >= s.columns || row >= s.rows)
		return;
	size_t at = (size_t)row * s.columns + column;
	unsigned char mark = marks[at];
	if (mark) {
		look(s, slot, pitch, marks, column, row, -1, 0, sum, weights);
		look(s, slot, pitch, marks, column, row, 1, 0, sum, weights);
		look(s, slot, pitch, marks, column, row, 0, -1, sum, weights);
		look(s, slot, pitch, marks, column, row, 0, 1, sum, weights);
		if (weights > 0) {
			slot[(size_t)row * pitch + column] = sum / weights;
			mark = 0;
		}
	}
	ret_marks[at] = mark;
	if (mark && at == 0 && found != NULL)
		found->blank++;
}

static samples samples_make(const struct plan *plan)
{
	const struct linearise *options = &plan->options.linearise;
	samples s = {};

	s.how = *options;
	for (int i = 0; i < IMAGE_COUNT; i++)
		s.how.image[i] = plan->image[i];
	s.how.has_air_region = options->has_air_region && options->quantity == QUANTITY_INTENSITY;
	s.raw = plan->raw;
	s.saturation = linearise_saturation(options);
	s.columns = plan->stack.columns;
	s.rows = plan->stack.rows;
	for (int k = 0; k < options->hardening_count; k++)
		s.hardening[k] = (float)options->hardening[k];
	return s;
}

/* Views on the device -> their slots. Every view is looked through for marks: a view without any costs two reads. */
static int linearise_piece(struct plan *plan, int count, const int *slots, struct stack *to, struct error *err)
{
	cudaStream_t stream = plan->device->copy;
	samples s = samples_make(plan);
	dim3 blocks(divide_up(s.columns, 32), divide_up(s.rows, 8)), threads(32, 8);

	for (int i = 0; i < count; i++) {
		float *slot = to->data + (size_t)slots[i] * to->shape.slot;

		s.raw = plan->raw + (size_t)i * plan->raw_bytes;
		if (s.how.has_air_region) {
			find_air<<<1, 256, 0, stream>>>(s, plan->counters);
			LAUNCHED();
		}
		to_integrals<<<blocks, threads, 0, stream>>>(s, slot, to->shape.pitch, plan->marks[0], plan->counters);
		LAUNCHED();
		replace<<<blocks, threads, 0, stream>>>(s, slot, to->shape.pitch, plan->marks[0], plan->marks[1], NULL);
		LAUNCHED();
		replace<<<blocks, threads, 0, stream>>>(s, slot, to->shape.pitch, plan->marks[1], plan->marks[0],
							plan->counters);
		LAUNCHED();
	}
	return 0;
}

static void add_counts(struct defect_counts *counts, const linearised *found)
{
	counts->mapped += (size_t)found->kinds[PIXEL_MAPPED];
	counts->not_finite += (size_t)found->kinds[PIXEL_NOT_FINITE];
	counts->saturated += (size_t)found->kinds[PIXEL_SATURATED];
	counts->zero += (size_t)found->kinds[PIXEL_ZERO];
	counts->blank += found->blank;
	counts->no_air += found->no_air;
	if (found->air_least > 0 && (found->air_least < counts->air_least || counts->air_least == 0))
		counts->air_least = found->air_least;
	if (found->air_most > counts->air_most)
		counts->air_most = found->air_most;
}

int cuda_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		   struct defect_counts *counts, struct error *err)
{
	struct device *device = plan->device;
	size_t view = plan->raw_bytes;
	linearised found;

	if (plan->raw_views == 0)
		return error_set(err, ERR_INTERNAL, "the plan was made without raw samples");
	for (int i = 0; i < count; i++)
		if (slots[i] < 0 || slots[i] >= to->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], to->slots);
	TRY(device_enter(device, err));
	CUDA_TRY(cudaMemsetAsync(plan->counters, 0, sizeof(found), device->copy));
	for (int done = 0; done < count; done += plan->raw_views) {
		int now = count - done < plan->raw_views ? count - done : plan->raw_views;

		TRY(copy_in(device, plan->raw, view, (const char *)samples + view * (size_t)done, view, (size_t)now,
			    err));
		/* The raw samples may come while the slots are still in use. */
		if (done == 0)
			TRY(begin_arrival(device, to->used, err));
		TRY(linearise_piece(plan, now, slots + done, to, err));
	}
	TRY(end_arrival(device, to->used, err));
	CUDA_TRY(cudaMemcpyAsync(&found, plan->counters, sizeof(found), cudaMemcpyDeviceToHost, device->copy));
	CUDA_TRY(cudaStreamSynchronize(device->copy));
	add_counts(counts, &found);
	return 0;
}

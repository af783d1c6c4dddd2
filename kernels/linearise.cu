/*
 * Raw samples to line integrals, p = -ln((I - dark) / (flat - dark)), with the
 * rules of core/cpu_linearise.c: defects take the values of the nearest good
 * pixels in their row and column, weighted by 1 / distance, in two passes.
 *
 * Samples are copied into pinned memory and from there to the device in pieces,
 * two in turn, on the stream of their own: while one is on its way the caller's
 * next one is copied, and whatever computes on the device goes on.
 */
#include <cmath>
#include <cstring>

#include "kernels/internal.cuh"

struct samples {
	const void *raw;
	bool is_uint16, is_intensity;
	float air, saturation;
	const float *flat, *dark; /* NULL: air, 0 */
	int columns, rows;
};

/* Order of plan->defects. */
enum { NOT_FINITE, SATURATED, ZERO, BLANK, COUNTERS };

/* One view: [row][column] into a slot, and a mark for each defect. */
static __global__ void __launch_bounds__(256)
    to_integrals(const samples s, float *slot, int pitch, unsigned char *marks, unsigned long long *defects)
{
	int column = blockIdx.x * 32 + threadIdx.x, row = blockIdx.y * 8 + threadIdx.y, kind = NOT_FINITE;
	bool inside = column < s.columns && row < s.rows, good = true;

	if (inside) {
		size_t at = (size_t)row * s.columns + column;
		float sample = s.is_uint16 ? (float)((const unsigned short *)s.raw)[at] : ((const float *)s.raw)[at];
		float value = sample;

		if (s.is_intensity) {
			float dark = s.dark != NULL ? s.dark[at] : 0.0f;
			float above = sample - dark, range = (s.flat != NULL ? s.flat[at] : s.air) - dark;

			value = -logf(above / range);
			good = above > 0 && range > 0 && sample < s.saturation && isfinite(range);
			if (isfinite(sample) && range > 0 && isfinite(range))
				kind = sample >= s.saturation ? SATURATED : ZERO;
		}
		good = good && isfinite(value);
		slot[(size_t)row * pitch + column] = good ? value : 0.0f;
		marks[at] = !good;
	}
	if (!good)
		atomicAdd(defects + kind, 1ull); /* defects are rare */
}

/* What the nearest good pixel in one direction says. */
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
 * marked after the second pass (the one with `defects`) is of a view without a good one.
 */
static __global__ void __launch_bounds__(256)
    replace(const samples s, float *slot, int pitch, const unsigned char *marks, unsigned char *ret_marks,
	    unsigned long long *defects)
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
	if (mark && at == 0 && defects != NULL)
		atomicAdd(defects + BLANK, 1ull);
}

size_t linearise_counters_bytes(void)
{
	return COUNTERS * sizeof(unsigned long long);
}

static samples samples_make(const struct plan *plan)
{
	const struct linearise *options = &plan->options.linearise;
	samples s = {};

	s.is_uint16 = options->sample == SAMPLE_UINT16;
	s.is_intensity = options->quantity == QUANTITY_INTENSITY;
	s.air = (float)options->air;
	s.saturation = options->saturation > 0 ? (float)options->saturation : s.is_uint16 ? 65535.0f : INFINITY;
	s.flat = plan->flat;
	s.dark = plan->dark;
	s.columns = plan->stack.columns;
	s.rows = plan->stack.rows;
	return s;
}

/* A piece on the device -> its slots. Every view is looked through for marks: a view without any costs two reads. */
static int linearise_piece(struct plan *plan, const void *raw, int count, const int *slots, struct stack *to,
			   struct error *err)
{
	cudaStream_t stream = plan->device->copy;
	samples s = samples_make(plan);
	size_t pixels = (size_t)s.columns * (size_t)s.rows, sample = s.is_uint16 ? 2 : 4;
	dim3 blocks(divide_up(s.columns, 32), divide_up(s.rows, 8)), threads(32, 8);

	for (int i = 0; i < count; i++) {
		float *slot = to->data + (size_t)slots[i] * to->shape.slot;

		s.raw = (const char *)raw + (size_t)i * pixels * sample;
		to_integrals<<<blocks, threads, 0, stream>>>(s, slot, to->shape.pitch, plan->marks[0], plan->defects);
		LAUNCHED();
		replace<<<blocks, threads, 0, stream>>>(s, slot, to->shape.pitch, plan->marks[0], plan->marks[1], NULL);
		LAUNCHED();
		replace<<<blocks, threads, 0, stream>>>(s, slot, to->shape.pitch, plan->marks[1], plan->marks[0],
							plan->defects);
		LAUNCHED();
	}
	return 0;
}

/* One core copies a fifth of what the bus takes, and waits for the disk's pages on the way. */
static void copy_to_pinned(char *to, const char *from, size_t bytes)
{
	const int stripes = 8;
	size_t each = (bytes + (size_t)stripes - 1) / (size_t)stripes;

#pragma omp parallel for num_threads(stripes) if (bytes > (1 << 20))
	for (int i = 0; i < stripes; i++) {
		size_t first = each * (size_t)i;

		if (first < bytes)
			memcpy(to + first, from + first, bytes - first < each ? bytes - first : each);
	}
}

int cuda_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
		   struct defect_counts *counts, struct error *err)
{
	struct device *device = plan->device;
	size_t view = plan->bytes.raw;
	unsigned long long found[COUNTERS];

	for (int i = 0; i < count; i++)
		if (slots[i] < 0 || slots[i] >= to->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], to->slots);
	TRY(device_enter(device, err));
	/* What was asked for before may still read these slots. */
	CUDA_TRY(cudaEventRecord(plan->asked, device->stream));
	CUDA_TRY(cudaMemsetAsync(plan->defects, 0, linearise_counters_bytes(), device->copy));
	for (int done = 0; done < count; done += plan->raw_views) {
		int half = plan->raw_next, now = count - done < plan->raw_views ? count - done : plan->raw_views;
		size_t bytes = view * (size_t)now;

		plan->raw_next = 1 - half;
		CUDA_TRY(cudaEventSynchronize(plan->raw_copied[half]));
		copy_to_pinned((char *)plan->raw_pinned[half], (const char *)samples + view * (size_t)done, bytes);
		CUDA_TRY(cudaMemcpyAsync(plan->raw[half], plan->raw_pinned[half], bytes, cudaMemcpyHostToDevice,
					 device->copy));
		CUDA_TRY(cudaEventRecord(plan->raw_copied[half], device->copy));
		if (done == 0)
			CUDA_TRY(cudaStreamWaitEvent(device->copy, plan->asked, 0));
		TRY(linearise_piece(plan, plan->raw[half], now, slots + done, to, err));
	}
	CUDA_TRY(cudaMemcpyAsync(found, plan->defects, sizeof(found), cudaMemcpyDeviceToHost, device->copy));
	CUDA_TRY(cudaEventRecord(plan->linearised, device->copy));
	CUDA_TRY(cudaStreamWaitEvent(device->stream, plan->linearised, 0));
	CUDA_TRY(cudaStreamSynchronize(device->copy));
	counts->not_finite += (size_t)found[NOT_FINITE];
	counts->saturated += (size_t)found[SATURATED];
	counts->zero += (size_t)found[ZERO];
	counts->blank += (int)found[BLANK];
	return 0;
}

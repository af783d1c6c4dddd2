/*
 * The algebra of iterative methods: sums, products and quotients of volumes and
 * stacks, element by element, at the speed of memory. Dots are in norms.cu.
 */
#include "kernels/internal.cuh"

static const int THREADS = 256, BLOCKS = 4096;

/* One element of y from one of x: the forms that backend.h names. */
struct axpby {
	float a, b;
	__device__ float operator()(float x, float y) const
	{
		return b == 0 ? a * x : fmaf(a, x, b * y);
	}
};
struct multiply {
	__device__ float operator()(float x, float y) const
	{
		return x * y;
	}
};
struct divide {
	float least;
	__device__ float operator()(float x, float y) const
	{
		return x >= least ? y / x : 0.0f;
	}
};
struct maximum {
	float a;
	__device__ float operator()(float x, float y) const
	{
		const float least = a * x;

		return y > least ? y : least;
	}
};
struct mask {
	__device__ float operator()(float x, float y) const
	{
		return isnan(x) ? 0.0f : y;
	}
};
struct fill {
	float value;
	__device__ float operator()(float, float) const
	{
		return value;
	}
};

/* Columns 0 .. width - 1 of rows that are `pitch` floats apart; x may be y. */
template <class Form>
static __global__ void __launch_bounds__(THREADS)
    each(Form form, const float *x, float *y, size_t rows, size_t width, size_t pitch)
{
	for (size_t i = (size_t)blockIdx.x * THREADS + threadIdx.x; i < rows * width;
	     i += (size_t)gridDim.x * THREADS) {
		size_t at = i / width * pitch + i % width;

		y[at] = form(x[at], y[at]);
	}
}

template <class Form>
static int over_volume(Form form, const struct volume *x, struct volume *y, struct error *err)
{
	struct device *device = y->device;
	size_t voxels = y->bytes / sizeof(float);

	TRY(device_enter(device, err));
	each<<<BLOCKS, THREADS, 0, device->stream>>>(form, x->data, y->data, (size_t)1, voxels, voxels);
	LAUNCHED();
	TRY(mark_used(device, x->used, err));
	return mark_used(device, y->used, err);
}

/* The zeros between rows and slots stay zeros. */
template <class Form>
static int over_stack(Form form, const struct stack *x, const int *slots, int count, struct stack *y, struct error *err)
{
	struct device *device = y->device;
	const struct stack_shape *shape = &y->shape;
	size_t rows = (size_t)shape->rows, width = (size_t)shape->columns, pitch = (size_t)shape->pitch;

	TRY(device_enter(device, err));
	for (int i = 0; i < count; i++) {
		const float *from = x->data + (size_t)(slots != NULL ? slots[i] : i) * x->shape.slot;

		each<<<BLOCKS, THREADS, 0, device->stream>>>(form, from, y->data + (size_t)i * shape->slot, rows, width,
							     pitch);
		LAUNCHED();
	}
	TRY(mark_used(device, x->used, err));
	return mark_used(device, y->used, err);
}

int cuda_volume_axpby(double a, const struct volume *x, double b, struct volume *y, struct error *err)
{
	return over_volume(axpby{(float)a, (float)b}, x, y, err);
}

int cuda_stack_axpby(double a, const struct stack *x, const int *slots, int count, double b, struct stack *y,
		     struct error *err)
{
	return over_stack(axpby{(float)a, (float)b}, x, slots, count, y, err);
}

int cuda_volume_divide(const struct volume *x, double least, struct volume *y, struct error *err)
{
	return over_volume(divide{(float)least}, x, y, err);
}

int cuda_stack_divide(const struct stack *x, double least, int count, struct stack *y, struct error *err)
{
	return over_stack(divide{(float)least}, x, NULL, count, y, err);
}

int cuda_stack_multiply(const struct stack *x, int count, struct stack *y, struct error *err)
{
	return over_stack(multiply{}, x, NULL, count, y, err);
}

int cuda_volume_maximum(double a, const struct volume *x, struct volume *y, struct error *err)
{
	return over_volume(maximum{(float)a}, x, y, err);
}

int cuda_stack_fill(struct stack *y, int count, float value, struct error *err)
{
	return over_stack(fill{value}, y, NULL, count, y, err);
}

int cuda_stack_mask(const struct stack *x, const int *slots, int count, struct stack *y, struct error *err)
{
	return over_stack(mask{}, x, slots, count, y, err);
}

/* As algebra_mean_around of core/algebra.h; a thread for each pixel, `along` floats between neighbours of its line. */
static __global__ void __launch_bounds__(THREADS)
    average(const float *x, float *y, int rows, int columns, int pitch, bool by_rows, float width)
{
	int column = blockIdx.x * blockDim.x + threadIdx.x, row = blockIdx.y * blockDim.y + threadIdx.y;

	if (column >= columns || row >= rows)
		return;
	int at = by_rows ? row : column, last = (by_rows ? rows : columns) - 1, along = by_rows ? pitch : 1;
	int room = min(at, last - at);
	float reach = fminf((width - 1) / 2, (float)room);
	int whole = (int)reach, most = min(whole + 1, room);
	size_t place = (size_t)row * pitch + column;
	float sum = 0, weights = 0;

	for (int k = -most; k <= most; k++) {
		float value = x[(long)place + (long)k * along], weight = abs(k) > whole ? reach - whole : 1.0f;

		if (!isnan(value)) {
			sum += weight * value;
			weights += weight;
		}
	}
	y[place] = isnan(x[place]) ? x[place] : sum / weights;
}

int cuda_stack_average(struct stack *y, int slot, const double width[2], struct stack *work, struct error *err)
{
	struct device *device = y->device;
	const struct stack_shape *shape = &y->shape;
	float *data = y->data + (size_t)slot * shape->slot;
	dim3 threads(32, THREADS / 32), blocks(divide_up(shape->columns, 32), divide_up(shape->rows, THREADS / 32));

	TRY(device_enter(device, err));
	average<<<blocks, threads, 0, device->stream>>>(data, work->data, shape->rows, shape->columns, shape->pitch,
							false, (float)width[0]);
	LAUNCHED();
	average<<<blocks, threads, 0, device->stream>>>(work->data, data, shape->rows, shape->columns, shape->pitch,
							true, (float)width[1]);
	LAUNCHED();
	TRY(mark_used(device, work->used, err));
	return mark_used(device, y->used, err);
}

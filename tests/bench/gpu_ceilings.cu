/*
 * What the card can do at most, measured beside the benchmarks: copies, and
 * bilinear and trilinear samples of single floats by the texture unit, from an
 * array that the second cache holds. Prints and writes JSON lines.
 */
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <cuda_runtime.h>

static void must(cudaError_t status, const char *what)
{
	if (status == cudaSuccess)
		return;
	fprintf(stderr, "%s: %s\n", what, cudaGetErrorString(status));
	exit(1);
}

enum { SIDE = 256, LAYERS = 64, SAMPLES = 256 };

/* Each warp walks through the layers beside its neighbours, as projectors do. */
template <bool LAYERED>
static __global__ void sample(cudaTextureObject_t texture, float *to)
{
	float x = (float)(blockIdx.x % 8 * 32 + threadIdx.x) + 0.7f,
	      y = (float)(blockIdx.x / 8 % 32 * 8 + threadIdx.y) + 0.3f;
	float sum = 0;

#pragma unroll 8
	for (int i = 0; i < SAMPLES; i++) {
		int layer = i % LAYERS;
		float u = x + 0.01f * (float)i, v = y + 0.013f * (float)i;

		sum += LAYERED ? tex2DLayered<float>(texture, u, v, layer)
			       : tex3D<float>(texture, u, v, (float)layer + 0.4f);
	}
	to[(blockIdx.x * blockDim.y + threadIdx.y) * blockDim.x + threadIdx.x] = sum;
}

template <typename WORK>
static double milliseconds(const WORK &work)
{
	cudaEvent_t begin, end;
	float times[7];

	must(cudaEventCreate(&begin), "event");
	must(cudaEventCreate(&end), "event");
	work();
	for (float &time : times) {
		must(cudaEventRecord(begin), "record");
		work();
		must(cudaEventRecord(end), "record");
		must(cudaEventSynchronize(end), "wait");
		must(cudaEventElapsedTime(&time, begin, end), "time");
	}
	must(cudaGetLastError(), "kernel");
	std::sort(times, times + 7);
	return times[3];
}

static cudaTextureObject_t texture_make(bool layered)
{
	cudaChannelFormatDesc channel = cudaCreateChannelDesc<float>();
	cudaResourceDesc resource = {};
	cudaTextureDesc description = {};
	cudaTextureObject_t texture;
	cudaArray_t array;

	must(cudaMalloc3DArray(&array, &channel, make_cudaExtent(SIDE, SIDE, LAYERS), layered ? cudaArrayLayered : 0),
	     "array");
	resource.resType = cudaResourceTypeArray;
	resource.res.array.array = array;
	description.addressMode[0] = description.addressMode[1] = description.addressMode[2] = cudaAddressModeBorder;
	description.filterMode = cudaFilterModeLinear;
	must(cudaCreateTextureObject(&texture, &resource, &description, NULL), "texture");
	return texture;
}

int main(void)
{
	const size_t bytes = (size_t)2 << 30;
	const int blocks = 132 * 64;
	const double samples = (double)blocks * 256 * SAMPLES;
	float *from, *to;

	must(cudaMalloc(&from, bytes), "memory");
	must(cudaMalloc(&to, bytes), "memory");
	must(cudaMemset(from, 1, bytes), "fill");
	double copy = milliseconds([&] { cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToDevice); });
	cudaTextureObject_t flat = texture_make(true), solid = texture_make(false);
	double layered = milliseconds([&] { sample<true><<<blocks, dim3(32, 8)>>>(flat, to); });
	double volume = milliseconds([&] { sample<false><<<blocks, dim3(32, 8)>>>(solid, to); });
	printf("{\"copy_tb_s\": %.2f, \"layered_bilinear_g_s\": %.0f, \"trilinear_g_s\": %.0f}\n",
	       2 * bytes / copy * 1e-9, samples / layered * 1e-6, samples / volume * 1e-6);
	return 0;
}

#ifndef CBCT_KERNELS_FFT_CUH
#define CBCT_KERNELS_FFT_CUH

/*
 * Discrete Fourier transforms of a few points in registers, in place, input and
 * output in natural order; INVERSE turns the sign of the exponent, nothing is scaled.
 */
#include <cuda_runtime.h>

static __device__ __forceinline__ float2 operator+(float2 a, float2 b)
{
	return {a.x + b.x, a.y + b.y};
}
static __device__ __forceinline__ float2 operator-(float2 a, float2 b)
{
	return {a.x - b.x, a.y - b.y};
}
static __device__ __forceinline__ float2 operator*(float s, float2 a)
{
	return {s * a.x, s * a.y};
}
static __device__ __forceinline__ float2 multiply(float2 a, float2 b)
{
	return {fmaf(a.x, b.x, -a.y * b.y), fmaf(a.x, b.y, a.y * b.x)};
}
/* a times the conjugate of b */
static __device__ __forceinline__ float2 multiply_conjugate(float2 a, float2 b)
{
	return {fmaf(a.x, b.x, a.y * b.y), fmaf(a.y, b.x, -a.x * b.y)};
}
template <bool INVERSE>
static __device__ __forceinline__ float2 turn(float2 a, float2 root)
{
	return INVERSE ? multiply_conjugate(a, root) : multiply(a, root);
}
/* times -i, or i for the inverse */
template <bool INVERSE>
static __device__ __forceinline__ float2 quarter(float2 a)
{
	return INVERSE ? make_float2(-a.y, a.x) : make_float2(a.y, -a.x);
}

template <bool INVERSE>
static __device__ __forceinline__ void dft2(float2 &a, float2 &b)
{
	float2 sum = a + b;

	b = a - b;
	a = sum;
}

template <bool INVERSE>
static __device__ __forceinline__ void dft3(float2 &a, float2 &b, float2 &c)
{
	const float sine = 0.866025404f;
	float2 sum = b + c, difference = quarter<INVERSE>(sine * (b - c)), middle = a + (-0.5f) * sum;

	a = a + sum;
	b = middle + difference;
	c = middle - difference;
}

template <bool INVERSE>
static __device__ __forceinline__ void dft4(float2 &a, float2 &b, float2 &c, float2 &d)
{
	float2 s = a + c, t = a - c, u = b + d, v = quarter<INVERSE>(b - d);

	a = s + u;
	b = t + v;
	c = s - u;
	d = t - v;
}

template <bool INVERSE>
static __device__ __forceinline__ void dft5(float2 x[5])
{
	const float c1 = 0.309016994f, c2 = -0.809016994f, s1 = 0.951056516f, s2 = 0.587785252f;
	float2 a = x[1] + x[4], b = x[1] - x[4], c = x[2] + x[3], d = x[2] - x[3];
	float2 m1 = x[0] + c1 * a + c2 * c, m2 = x[0] + c2 * a + c1 * c;
	float2 n1 = quarter<INVERSE>(s1 * b + s2 * d), n2 = quarter<INVERSE>(s2 * b - s1 * d);

	x[0] = x[0] + a + c;
	x[1] = m1 + n1;
	x[2] = m2 + n2;
	x[3] = m2 - n2;
	x[4] = m1 - n1;
}

/* 6 = 2 x 3: the prime factors need no twiddles between them. */
template <bool INVERSE>
static __device__ __forceinline__ void dft6(float2 x[6])
{
	float2 a[3] = {x[0] + x[3], x[2] + x[5], x[4] + x[1]}, b[3] = {x[0] - x[3], x[2] - x[5], x[4] - x[1]};

	dft3<INVERSE>(a[0], a[1], a[2]);
	dft3<INVERSE>(b[0], b[1], b[2]);
	x[0] = a[0];
	x[1] = b[1];
	x[2] = a[2];
	x[3] = b[0];
	x[4] = a[1];
	x[5] = b[2];
}

template <bool INVERSE>
static __device__ __forceinline__ void dft8(float2 x[8])
{
	const float half = 0.707106781f;

	dft4<INVERSE>(x[0], x[2], x[4], x[6]);
	dft4<INVERSE>(x[1], x[3], x[5], x[7]);
	float2 a = turn<INVERSE>(x[3], make_float2(half, -half)), b = quarter<INVERSE>(x[5]);
	float2 c = turn<INVERSE>(x[7], make_float2(-half, -half)), odd = x[1];
	float2 even[4] = {x[0], x[2], x[4], x[6]};

	x[0] = even[0] + odd, x[4] = even[0] - odd;
	x[1] = even[1] + a, x[5] = even[1] - a;
	x[2] = even[2] + b, x[6] = even[2] - b;
	x[3] = even[3] + c, x[7] = even[3] - c;
}

template <bool INVERSE>
static __device__ __forceinline__ void dft16(float2 x[16])
{
	const float cosine[10] = {1,  0.923879533f,  0.707106781f,  0.382683432f,
				  0,  -0.382683432f, -0.707106781f, -0.923879533f,
				  -1, -0.923879533f};
	const float sine[10] = {
	    0, 0.382683432f, 0.707106781f, 0.923879533f, 1, 0.923879533f, 0.707106781f, 0.382683432f, 0, -0.382683432f};

#pragma unroll
	for (int i = 0; i < 4; i++)
		dft4<INVERSE>(x[i], x[i + 4], x[i + 8], x[i + 12]);
#pragma unroll
	for (int k = 1; k < 4; k++)
#pragma unroll
		for (int i = 1; i < 4; i++)
			x[4 * k + i] = turn<INVERSE>(x[4 * k + i], make_float2(cosine[i * k], -sine[i * k]));
#pragma unroll
	for (int k = 0; k < 4; k++)
		dft4<INVERSE>(x[4 * k], x[4 * k + 1], x[4 * k + 2], x[4 * k + 3]);
	/* a transposition of names only: all indices are constants */
	float2 y[16];
#pragma unroll
	for (int k = 0; k < 16; k++)
		y[k] = x[k];
#pragma unroll
	for (int k = 0; k < 16; k++)
		x[k] = y[4 * (k % 4) + k / 4];
}

/* 10 = 2 x 5, likewise. */
template <bool INVERSE>
static __device__ __forceinline__ void dft10(float2 x[10])
{
	float2 a[5] = {x[0] + x[5], x[2] + x[7], x[4] + x[9], x[6] + x[1], x[8] + x[3]};
	float2 b[5] = {x[0] - x[5], x[2] - x[7], x[4] - x[9], x[6] - x[1], x[8] - x[3]};

	dft5<INVERSE>(a);
	dft5<INVERSE>(b);
#pragma unroll
	for (int k = 0; k < 5; k++) {
		x[6 * k % 10] = a[k];
		x[(6 * k + 5) % 10] = b[k];
	}
}

template <int COUNT, bool INVERSE>
static __device__ __forceinline__ void dft(float2 x[COUNT])
{
	static_assert(COUNT == 1 || COUNT == 2 || COUNT == 3 || COUNT == 4 || COUNT == 5 || COUNT == 6 || COUNT == 8 ||
			  COUNT == 10,
		      "a transform of this many points is not here");
	if constexpr (COUNT == 2)
		dft2<INVERSE>(x[0], x[1]);
	else if constexpr (COUNT == 3)
		dft3<INVERSE>(x[0], x[1], x[2]);
	else if constexpr (COUNT == 4)
		dft4<INVERSE>(x[0], x[1], x[2], x[3]);
	else if constexpr (COUNT == 5)
		dft5<INVERSE>(x);
	else if constexpr (COUNT == 6)
		dft6<INVERSE>(x);
	else if constexpr (COUNT == 8)
		dft8<INVERSE>(x);
	else if constexpr (COUNT == 10)
		dft10<INVERSE>(x);
}

#endif

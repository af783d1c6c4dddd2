/* The matched projector's backprojection: matched.cuh has the method and the work of a thread. */
#include "kernels/matched.cuh"

enum { SIDE = 16 }; /* of a block across z */

static __global__ void __launch_bounds__(SIDE *SIDE, 3) backproject_matched(const matched_job job)
{
	matched_thread(job, blockIdx.x * SIDE + threadIdx.x, blockIdx.y * SIDE + threadIdx.y, blockIdx.z * MATCHED_RUN);
}

int matched_views(struct plan *plan, const float *from, int first, int count, struct voxel_use use, float *volume,
		  float *cover, struct error *err)
{
	const int *size = plan->grid.size;
	dim3 blocks(divide_up(size[0], SIDE), divide_up(size[1], SIDE), divide_up(size[2], MATCHED_RUN));
	matched_job job = {};

	job.geometry = plan->geometry;
	job.views = plan->views + first;
	job.count = count;
	job.from = from;
	job.columns = plan->stack.columns;
	job.rows = plan->stack.rows;
	job.pitch = plan->stack.pitch;
	job.slot = plan->stack.slot;
	job.grid = plan->grid;
	job.z_rays = plan->shape.z_rays;
	job.use = use;
	job.volume = volume;
	job.cover = cover;
	backproject_matched<<<blocks, dim3(SIDE, SIDE), 0, plan->device->stream>>>(job);
	LAUNCHED();
	return 0;
}

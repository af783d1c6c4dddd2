/*
 * What makes cbct-worker-faulty of the worker: TV, once the file named by
 * CBCT_FAULT is there, takes that away and writes where nothing is. Linked in
 * front of the backend's own by the linker's --wrap; no other program has it.
 */
#include <cstdlib>
#include <cuda_runtime.h>
#include <unistd.h>

struct plan;
struct volume;
struct cancel;
struct tv_options;
struct error;

extern "C" int __real__Z7cuda_tvP4planP6volumePK10tv_optionsPK6cancelP5error(struct plan *, struct volume *,
									     const struct tv_options *,
									     const struct cancel *, struct error *);

static __global__ void write_nowhere(int *nowhere)
{
	nowhere[threadIdx.x] = 1;
}

extern "C" int __wrap__Z7cuda_tvP4planP6volumePK10tv_optionsPK6cancelP5error(struct plan *plan, struct volume *volume,
									     const struct tv_options *options,
									     const struct cancel *cancel,
									     struct error *err)
{
	const char *file = getenv("CBCT_FAULT");

	if (file != NULL && unlink(file) == 0)
		write_nowhere<<<1, 32>>>((int *)64);
	return __real__Z7cuda_tvP4planP6volumePK10tv_optionsPK6cancelP5error(plan, volume, options, cancel, err);
}

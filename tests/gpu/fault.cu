/*
 * What makes cbct-worker-faulty of the worker: TV, once the file named by CBCT_FAULT is there, takes that away and
 * writes where nothing is. A number in the file names the device that does; else it is the first that comes. Linked in
 * front of the backend's own by the linker's --wrap; no other program has it.
 */
#include <cstdio>
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

/* Each card of a job has a thread of its own, which has made the card its current one before it comes here. */
static bool is_wanted(const char *name)
{
	FILE *file = name != NULL ? fopen(name, "re") : NULL;
	int wanted, device = -1;
	bool any;

	if (file == NULL)
		return false;
	any = fscanf(file, "%d", &wanted) != 1;
	fclose(file);
	return any || (cudaGetDevice(&device) == cudaSuccess && device == wanted);
}

extern "C" int __wrap__Z7cuda_tvP4planP6volumePK10tv_optionsPK6cancelP5error(struct plan *plan, struct volume *volume,
									     const struct tv_options *options,
									     const struct cancel *cancel,
									     struct error *err)
{
	const char *file = getenv("CBCT_FAULT");

	if (is_wanted(file) && unlink(file) == 0)
		write_nowhere<<<1, 32>>>((int *)64);
	return __real__Z7cuda_tvP4planP6volumePK10tv_optionsPK6cancelP5error(plan, volume, options, cancel, err);
}

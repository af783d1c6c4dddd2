/* Whether a job fits into the memory that the workers have: supervise.h. */
#include <string.h>

#include "core/host_memory.h"
#include "daemon/jobs/workers.h"

/*
 * The memory that may come free until the job's turn; the worker looks again when it begins. A job that does not fit on
 * a card runs out of core, with its volumes in the host's memory.
 */
static size_t memory_available(const struct worker_facts *facts)
{
	struct host_memory host;

	host_memory(&host);
	return strcmp(facts->backend, "cpu") == 0 || facts->bytes_total > host.total ? facts->bytes_total : host.total;
}

/*
 * The daemon has no CUDA to ask, so for a card it takes what no recipe can do
 * without: the projections as floats, the iterate and its copy.
 */
static int memory_needed(const char *backend, const struct scan *scan, const struct recipe *recipe,
			 struct recon_memory *ret_memory, struct error *err)
{
	const struct backend *row = backend_find(backend);
	const struct geometry *geometry = &scan->geometry;
	const struct linearise linearise = scan_linearise(scan);
	struct pixel_blocks blocks;

	if (row != NULL)
		return recon_memory(row, NULL, geometry, &linearise, recipe, ret_memory, err);
	blocks = geometry_blocks(geometry, recipe->binning);
	*ret_memory = (struct recon_memory){.projections = (size_t)blocks.count[0] * (size_t)blocks.count[1] *
							   (size_t)geometry->count * sizeof(float),
					    .volumes = 2 * grid_voxels(&recipe->grid) * sizeof(float)};
	ret_memory->total = ret_memory->projections + ret_memory->volumes;
	return 0;
}

int supervise_check_memory(struct supervise *supervise, const struct scan *scan, const struct job_request *request,
			   struct recon_memory *ret_memory, struct error *err)
{
	const struct recipe *recipe = &request->recipe;
	struct worker_facts facts[SLOTS_MAX];
	struct recon_memory memory, best = {0};
	size_t most = 0;
	int count = supervise_workers(supervise, facts, SLOTS_MAX), code;
	double bytes[WORKERS_MAX];

	/* What other hosts have, they know alone. */
	if (!where_fits(&request->where, supervise->options.remote.host, bytes, devices_memory(facts, count, bytes)))
		count = 0;

	for (int i = 0; i < count; i++) {
		if (facts[i].bytes_free == 0)
			continue; /* has not said yet */
		code = memory_needed(facts[i].backend, scan, recipe, &memory, err);
		if (code != 0)
			return code;
		memory.available = memory_available(&facts[i]);
		if (memory.total <= memory.available) {
			*ret_memory = memory;
			return 0;
		}
		if (memory.available > most) {
			most = memory.available;
			best = memory;
		}
	}
	if (most > 0)
		return error_set_at(err, ERR_IMPOSSIBLE, "/grid/size",
				    "the job needs %zu bytes of memory, and %zu are available", best.total, most);
	return memory_needed("cpu", scan, recipe, ret_memory, err);
}

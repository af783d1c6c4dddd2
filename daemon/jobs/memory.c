/* Whether a job fits into the memory that the workers have: supervise.h. */
#include <string.h>

#include "core/cards/cards.h"
#include "core/host_memory.h"
#include "daemon/jobs/workers.h"

int supervise_check_devices(const struct supervise *supervise, struct job_request *request, struct error *err)
{
	const int most = supervise->regular, standard = supervise->options.devices_per_job;

	if (request->devices == 0)
		request->devices = standard == DEVICES_ALL || standard < most ? standard : most;
	if (request->devices > most && supervise->options.remote.program == NULL)
		return error_set_at(err, ERR_IMPOSSIBLE, "/devices", "%d devices, and this host has %d",
				    request->devices, most);
	return 0;
}

/* What a process has of a card before it does anything there: 524 to 535 MiB, by tests/bench/results/cards.txt. */
static const size_t CONTEXT_BYTES = (size_t)544 << 20;

/*
 * The memory that may come free until the job's turn; the worker looks again when it begins. A card has its worker's
 * context, and that of the job's process while it is lent. A job that does not fit on its cards runs out of core, with
 * its volumes in the host's memory. Shares of the processor have one memory.
 */
static size_t memory_available(const char *backend, size_t bytes_total, int devices)
{
	const bool shared = strcmp(backend, "cpu") == 0;
	const size_t contexts = CONTEXT_BYTES * (devices > 1 ? 2 : 1);
	const size_t card = bytes_total > contexts ? bytes_total - contexts : 0;
	const size_t bytes = shared ? bytes_total : card * (size_t)devices;
	struct host_memory host;

	host_memory(&host);
	return shared || bytes > host.total ? bytes : host.total;
}

/*
 * The daemon has no CUDA to ask, so for a card it takes what no recipe can do
 * without: the projections as floats, the iterate and its copy.
 */
static int memory_needed(const char *backend, int devices, const struct scan *scan, const struct recipe *recipe,
			 struct recon_memory *ret_memory, struct error *err)
{
	const struct device_options options = {.threads = devices};
	const struct backend *row = backend_find(backend);
	const struct geometry *geometry = &scan->geometry;
	const struct linearise linearise = scan_linearise(scan);
	struct pixel_blocks blocks;
	struct device *cards;
	int code;

	if (row != NULL && devices > 1) {
		code = cards_open(row, NULL, devices, &options, &cards, err);
		if (code != 0)
			return code;
		code = recon_memory(&backend_cards, cards, geometry, &linearise, recipe, ret_memory, err);
		backend_cards.close(cards);
		/* Not even in parts: what another attempt would not change. */
		if (code == ERR_NO_MEMORY)
			return error_set_at(err, ERR_IMPOSSIBLE, "/grid/size",
					    "the job does not fit into the memory of %d devices, not even in parts",
					    devices);
		/* Where the job would not fit just now, it is counted as it would run out of core. */
		ret_memory->total += code == 0 ? ret_memory->host : 0;
		return code;
	}
	if (row != NULL)
		return recon_memory(row, NULL, geometry, &linearise, recipe, ret_memory, err);
	blocks = geometry_blocks(geometry, recipe->binning);
	*ret_memory = (struct recon_memory){.projections = (size_t)blocks.count[0] * (size_t)blocks.count[1] *
							   (size_t)geometry->count * sizeof(float),
					    .volumes = 2 * grid_voxels(&recipe->grid) * sizeof(float)};
	ret_memory->total = ret_memory->projections + ret_memory->volumes;
	return 0;
}

bool devices_have_room(const struct worker *worker, const struct job *job, int count)
{
	return job_least_bytes(job) <= memory_available(worker->backend, worker->info.bytes_total, count);
}

int supervise_check_memory(struct supervise *supervise, const struct scan *scan, const struct job_request *request,
			   struct recon_memory *ret_memory, struct error *err)
{
	const struct recipe *recipe = &request->recipe;
	struct worker_facts facts[SLOTS_MAX];
	struct recon_memory memory, best = {0};
	size_t most = 0;
	int count = supervise_workers(supervise, facts, SLOTS_MAX), devices = request->devices, code;
	double bytes[WORKERS_MAX];

	/* What other hosts have, they know alone. */
	if (!where_fits(&request->where, supervise->options.remote.host, bytes, devices_memory(facts, count, bytes)))
		count = 0;

	if (devices == DEVICES_ALL || devices > supervise->regular)
		devices = supervise->regular;
	devices = devices > CARDS_MOST ? CARDS_MOST : devices > 1 ? devices : 1;
	for (int i = 0; i < count; i++) {
		if (facts[i].bytes_free == 0)
			continue; /* has not said yet */
		code = memory_needed(facts[i].backend, devices, scan, recipe, &memory, err);
		if (code != 0)
			return code;
		memory.available = memory_available(facts[i].backend, facts[i].bytes_total, devices);
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
	return memory_needed("cpu", devices, scan, recipe, ret_memory, err);
}

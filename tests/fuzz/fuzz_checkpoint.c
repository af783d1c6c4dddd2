/*
 * Any bytes as a checkpoint of a running job. The first byte says of which algorithm, and whether the bytes are the
 * whole file or a content that gets checksums which fit, as a checkpoint has that was written by another program.
 * Refused with a reason, or a history that belongs to its iteration.
 */
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "proto/checkpoint.h"
#include "proto/recipe.h"
#include "proto/seal.h"
#include "tests/fuzz/fuzz.h"

static const char scan_text[] = "{\"detector\":{\"columns\":8,\"rows\":6,\"pixel_mm\":[4,4]},"
				"\"projections\":{\"count\":4,\"sample\":\"float32\",\"quantity\":\"line_integral\"},"
				"\"geometry\":{\"kind\":\"circular\",\"source_to_isocentre_mm\":600,"
				"\"source_to_detector_mm\":1000,\"angle_step_deg\":90}}";
#define GRID "{\"scan\":\"s\",\"grid\":{\"size\":[6,6,5],\"spacing_mm\":[4,4,4]},"
static const char *const jobs[] = {
    GRID "\"fdk\":{},\"sart\":{\"iterations\":9},\"tv\":{}}",
    GRID "\"sart\":{\"iterations\":9,\"momentum\":true}}",
    GRID "\"cgls\":{\"iterations\":9}}",
    GRID "\"fdk\":{},\"fista\":{\"iterations\":9},\"tv\":{}}",
    GRID "\"fdk\":{},\"sart\":{\"iterations\":9},\"metal\":{\"threshold_hu\":2500}}",
};
enum { JOBS = sizeof(jobs) / sizeof(jobs[0]), ITERATIONS = 9, USES = 100 };
static struct scan *scan;
static struct linearise linearise;
static struct job_request requests[JOBS];
static struct device *device;
static char path[64];

static void prepare(void)
{
	const struct device_options options = {.threads = 1};
	struct error err = {0};

	PROMISE(scan_parse(scan_text, sizeof(scan_text) - 1, &scan, &err) == 0);
	linearise = scan_linearise(scan);
	for (int i = 0; i < JOBS; i++) {
		PROMISE(job_request_parse(jobs[i], strlen(jobs[i]), &requests[i], &err) == 0);
		PROMISE(job_request_resolve(&requests[i], scan, &err) == 0);
	}
	PROMISE(backend_cpu.open(0, &options, &device, &err) == 0);
	snprintf(path, sizeof(path), "/dev/shm/fuzz-checkpoint.%ld", (long)getpid());
}

static void write_file(const uint8_t *data, size_t size, bool sealed)
{
	char *end = malloc(seal_bytes(size));
	struct seal_maker maker;
	struct error err = {0};
	FILE *file = fopen(path, "wb");

	PROMISE(file != NULL && end != NULL && fwrite(data, 1, size, file) == size);
	if (sealed && seal_maker_new(size, &maker, &err) == 0) {
		seal_maker_add(&maker, data, size);
		seal_write(maker.blocks, size, end);
		PROMISE(fwrite(end, 1, seal_bytes(size), file) == seal_bytes(size));
		seal_maker_clear(&maker);
	}
	PROMISE(fclose(file) == 0);
	free(end);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	const struct checkpoint_target target = {.iteration = 3, .latest = ITERATIONS};
	static const struct recon_hooks hooks;
	static struct recon *recons[JOBS]; /* opening one takes longer than all else */
	static int uses;
	struct history history = {0};
	struct error damage, err = {0};
	struct recon **recon;

	if (scan == NULL)
		prepare();
	if (size < 1)
		return 0;
	write_file(data + 1, size - 1, (data[0] & 0x80) == 0);
	recon = &recons[data[0] % JOBS];
	if (++uses % USES == 0) {
		recon_free(*recon);
		*recon = NULL;
	}
	if (*recon == NULL)
		PROMISE(recon_open(&backend_cpu, device, &scan->geometry, &linearise, &requests[data[0] % JOBS].recipe,
				   &hooks, recon, &err) == 0);
	if (checkpoint_resume(*recon, path, &target, &history, &damage, &err) == 0)
		PROMISE(history.count >= 0 && history.count <= ITERATIONS);
	else
		PROMISE(err.code < 0 && err.text[0] != '\0');
	free(history.rows);
	unlink(path);
	return 0;
}

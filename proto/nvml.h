#ifndef CBCT_PROTO_NVML_H
#define CBCT_PROTO_NVML_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/*
 * What the driver says of NVIDIA cards: memory, temperature, memory errors. Its management library (NVML) comes with
 * the driver, so it is loaded when it is asked for and is no dependency; it neither needs nor touches CUDA, and
 * disturbs no process that computes. Function names, argument types and numbers are those of NVIDIA's NVML API
 * reference manual; only functions that every driver since 2012 has are used.
 *
 * Calls may wait for the driver, for ever when a card hangs. One thread at a time for each struct nvml.
 */
struct nvml;

struct nvml_card {
	char name[96], uuid[96]; /* "" when it does not say */
	bool answers;            /* false: it is lost, and of the rest only what was read is there */
	bool has_memory, has_temperature, has_errors; /* what the card can tell: many have no error correction */
	unsigned long long bytes_total, bytes_used;
	unsigned celsius;
	unsigned long long errors[2]; /* of memory since the driver was loaded: corrected; uncorrected */
};

/* ERR_NOT_FOUND: there is no such library here. ERR_DEVICE: the driver does not answer it. */
int nvml_open(struct nvml **ret_nvml, struct error *err);
void nvml_close(struct nvml *nvml); /* NULL is fine */

/* The version of the driver, "" when it does not say. */
void nvml_driver(struct nvml *nvml, char *ret_version, size_t size);
/* Cards, 0 when the driver does not answer. Their order is the bus', which need not be CUDA's: the uuid tells. */
int nvml_count(struct nvml *nvml);
void nvml_read(struct nvml *nvml, int index, struct nvml_card *ret_card);

#endif

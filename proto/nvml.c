/* NVIDIA's management library, loaded at run time: nvml.h. */
#include "proto/nvml.h"

#include <dlfcn.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { NVML_OK = 0, TEMPERATURE_GPU = 0, ERRORS_CORRECTED = 0, ERRORS_VOLATILE = 0 };

struct memory {
	unsigned long long total, free, used;
};

/* A row for each function: member, name in the library, arguments. All return 0 for success. */
#define FUNCTIONS(row)                                                                                                 \
	row(init, "nvmlInit_v2", (void)) row(shutdown, "nvmlShutdown", (void))                                         \
	    row(driver, "nvmlSystemGetDriverVersion", (char *, unsigned))                                              \
		row(count, "nvmlDeviceGetCount_v2", (unsigned *))                                                      \
		    row(handle, "nvmlDeviceGetHandleByIndex_v2", (unsigned, void **))                                  \
			row(name, "nvmlDeviceGetName", (void *, char *, unsigned))                                     \
			    row(uuid, "nvmlDeviceGetUUID", (void *, char *, unsigned))                                 \
				row(memory, "nvmlDeviceGetMemoryInfo", (void *, struct memory *))                      \
				    row(temperature, "nvmlDeviceGetTemperature", (void *, int, unsigned *))            \
					row(errors, "nvmlDeviceGetTotalEccErrors",                                     \
					    (void *, int, int, unsigned long long *))

struct nvml {
	void *library;
#define MEMBER(member, name, arguments) int(*member) arguments;
	FUNCTIONS(MEMBER)
#undef MEMBER
};

static int find_functions(struct nvml *nvml, struct error *err)
{
/* POSIX: what dlsym returns may be taken for a function; C has no cast for it. */
#define FIND(member, name, arguments)                                                                                  \
	{                                                                                                              \
		void *found = dlsym(nvml->library, name);                                                              \
		if (found == NULL)                                                                                     \
			return error_set(err, ERR_DEVICE, "the driver's library has no %s", name);                     \
		memcpy(&nvml->member, &found, sizeof(found));                                                          \
	}
	FUNCTIONS(FIND)
#undef FIND
	return 0;
}

int nvml_open(struct nvml **ret_nvml, struct error *err)
{
	struct nvml *nvml = calloc(1, sizeof(*nvml));
	int code, status;

	if (nvml == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the driver's library");
	nvml->library = dlopen("libnvidia-ml.so.1", RTLD_NOW | RTLD_LOCAL);
	if (nvml->library == NULL) {
		free(nvml);
		return error_set(err, ERR_NOT_FOUND, "libnvidia-ml.so.1, a part of NVIDIA's driver, is not here");
	}
	code = find_functions(nvml, err);
	if (code == 0) {
		status = nvml->init();
		if (status != NVML_OK)
			code =
			    error_set(err, ERR_DEVICE, "NVIDIA's driver does not answer: nvmlInit returns %d", status);
	}
	if (code != 0) {
		dlclose(nvml->library);
		free(nvml);
		return code;
	}
	*ret_nvml = nvml;
	return 0;
}

void nvml_close(struct nvml *nvml)
{
	if (nvml == NULL)
		return;
	nvml->shutdown();
	dlclose(nvml->library);
	free(nvml);
}

void nvml_driver(struct nvml *nvml, char *ret_version, size_t size)
{
	if (nvml->driver(ret_version, (unsigned)size) != NVML_OK)
		ret_version[0] = '\0';
}

int nvml_count(struct nvml *nvml)
{
	unsigned count = 0;

	return nvml->count(&count) == NVML_OK ? (int)count : 0;
}

void nvml_read(struct nvml *nvml, int index, struct nvml_card *ret_card)
{
	struct nvml_card card = {.answers = false};
	struct memory memory;
	void *device = NULL;

	*ret_card = card;
	if (nvml->handle((unsigned)index, &device) != NVML_OK)
		return;
	if (nvml->name(device, card.name, sizeof(card.name)) != NVML_OK)
		card.name[0] = '\0';
	if (nvml->uuid(device, card.uuid, sizeof(card.uuid)) != NVML_OK)
		card.uuid[0] = '\0';
	card.has_memory = nvml->memory(device, &memory) == NVML_OK;
	card.has_temperature = nvml->temperature(device, TEMPERATURE_GPU, &card.celsius) == NVML_OK;
	card.has_errors = true;
	for (int i = 0; i < 2; i++)
		card.has_errors &=
		    nvml->errors(device, ERRORS_CORRECTED + i, ERRORS_VOLATILE, &card.errors[i]) == NVML_OK;
	if (card.has_memory) {
		card.bytes_total = memory.total;
		card.bytes_used = memory.used;
	}
	/* Every card has memory and a sensor: one that tells of neither is not there any more. */
	card.answers = card.has_memory || card.has_temperature;
	*ret_card = card;
}

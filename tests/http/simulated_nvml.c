/*
 * In place of libnvidia-ml.so.1, the management library of NVIDIA's driver, for machines without a card: two cards
 * whose readings stand in the file $CBCT_TEST_NVML, a line for each: temperature, bytes in use, corrected and
 * uncorrected errors (negative: it has no error correction). A card without a line is lost.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { OK = 0, NOT_SUPPORTED = 3, LOST = 15, CARDS = 2 };

struct memory {
	unsigned long long total, free, used;
};
struct reading {
	unsigned celsius;
	unsigned long long used;
	long long errors[2];
};

static char handles[CARDS]; /* a card's handle is the address of its place */

static int read_card(const void *device, struct reading *ret)
{
	const char *path = getenv("CBCT_TEST_NVML");
	long index = (const char *)device - handles;
	FILE *file = path != NULL ? fopen(path, "r") : NULL;
	int result = LOST;

	for (long i = 0; file != NULL && i <= index; i++) {
		int got =
		    fscanf(file, "%u %llu %lld %lld", &ret->celsius, &ret->used, &ret->errors[0], &ret->errors[1]);

		result = i == index && got == 4 ? OK : LOST;
	}
	if (file != NULL)
		fclose(file);
	return result;
}

int nvmlInit_v2(void);
int nvmlInit_v2(void)
{
	return OK;
}

int nvmlShutdown(void);
int nvmlShutdown(void)
{
	return OK;
}

int nvmlSystemGetDriverVersion(char *version, unsigned size);
int nvmlSystemGetDriverVersion(char *version, unsigned size)
{
	snprintf(version, size, "570.86.15");
	return OK;
}

int nvmlDeviceGetCount_v2(unsigned *count);
int nvmlDeviceGetCount_v2(unsigned *count)
{
	*count = CARDS;
	return OK;
}

int nvmlDeviceGetHandleByIndex_v2(unsigned index, void **device);
int nvmlDeviceGetHandleByIndex_v2(unsigned index, void **device)
{
	struct reading reading;

	*device = &handles[index];
	return read_card(*device, &reading);
}

int nvmlDeviceGetName(void *device, char *name, unsigned size);
int nvmlDeviceGetName(void *device, char *name, unsigned size)
{
	(void)device;
	snprintf(name, size, "A \"test\" card"); /* quotes are for whoever writes the name */
	return OK;
}

int nvmlDeviceGetUUID(void *device, char *uuid, unsigned size);
int nvmlDeviceGetUUID(void *device, char *uuid, unsigned size)
{
	snprintf(uuid, size, "GPU-0000-%ld", (long)((const char *)device - handles));
	return OK;
}

int nvmlDeviceGetMemoryInfo(void *device, struct memory *memory);
int nvmlDeviceGetMemoryInfo(void *device, struct memory *memory)
{
	struct reading reading;
	int result = read_card(device, &reading);

	if (result == OK)
		*memory = (struct memory){24ull << 30, (24ull << 30) - reading.used, reading.used};
	return result;
}

int nvmlDeviceGetTemperature(void *device, int sensor, unsigned *celsius);
int nvmlDeviceGetTemperature(void *device, int sensor, unsigned *celsius)
{
	struct reading reading;
	int result = read_card(device, &reading);

	(void)sensor;
	if (result == OK)
		*celsius = reading.celsius;
	return result;
}

int nvmlDeviceGetTotalEccErrors(void *device, int type, int counter, unsigned long long *count);
int nvmlDeviceGetTotalEccErrors(void *device, int type, int counter, unsigned long long *count)
{
	struct reading reading;
	int result = read_card(device, &reading);

	(void)counter;
	if (result == OK && reading.errors[type] < 0)
		return NOT_SUPPORTED;
	if (result == OK)
		*count = (unsigned long long)reading.errors[type];
	return result;
}

/* Any bytes as the file of destinations: refused with a reason, or destinations that each have a name of their own. */
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "daemon/sendings/internal.h"
#include "tests/fuzz/fuzz.h"

static void check_names(const struct destination *list, int count)
{
	for (int i = 0; i < count; i++) {
		PROMISE(destination_name_valid(list[i].name) && list[i].row != NULL && list[i].address[0] != '\0');
		PROMISE(list[i].kind >= 0 && list[i].kind < DESTINATION_KIND_COUNT);
		for (int k = 0; k < i; k++)
			PROMISE(strcmp(list[i].name, list[k].name) != 0);
	}
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static int file = -1;
	struct destination *list = NULL;
	struct application application;
	struct error err = {0};
	char path[64];
	int count = 0;

	if (file < 0)
		file = memfd_create("destinations", MFD_CLOEXEC);
	PROMISE(file >= 0 && ftruncate(file, 0) == 0 && pwrite(file, data, size, 0) == (ssize_t)size);
	snprintf(path, sizeof(path), "/proc/self/fd/%d", file);
	if (destinations_read(path, &list, &count, &application, &err) != 0) {
		PROMISE(list == NULL && count == 0 && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	check_names(list, count);
	destinations_free(list, count);
	application_free(&application);
	return 0;
}

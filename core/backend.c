/* The table of backends. */
#include "core/backend.h"

#include <string.h>

/* Weak: kernels/ is linked into some programs only, and its row is NULL in the others. */
extern const struct backend backend_cuda __attribute__((weak));

const struct backend *const backends[BACKEND_COUNT] = {&backend_cuda, &backend_cpu};

const char *const tv_method_names[TV_METHOD_COUNT] = {"gradient", "proximal", "tgv"};

const struct backend *backend_find(const char *name)
{
	for (int i = 0; i < BACKEND_COUNT; i++) {
		const struct backend *backend = backends[i];

		if (backend == NULL)
			continue;
		if (strcmp(name, "auto") == 0 ? backend->count() > 0 : strcmp(name, backend->name) == 0)
			return backend;
	}
	return NULL;
}

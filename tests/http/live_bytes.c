/*
 * Counts what a process has allocated and not freed, for tests: loaded with LD_PRELOAD into the daemon and its workers.
 * The file CBCT_LIVE_BYTES.PID, mapped, holds two numbers of 8 bytes: bytes (as malloc_usable_size has them) and blocks
 * that are live. Resident memory has the allocator's own slack beside them, so that a leak shows here first.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <malloc.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

extern void *__libc_malloc(size_t size);
extern void *__libc_calloc(size_t count, size_t size);
extern void *__libc_realloc(void *memory, size_t size);
extern void *__libc_memalign(size_t alignment, size_t size);
extern void __libc_free(void *memory);

struct live {
	atomic_long bytes, blocks;
};
static struct live before; /* what was allocated before the file was there */
static struct live *live = &before;

__attribute__((constructor)) static void arm(void)
{
	const char *prefix = getenv("CBCT_LIVE_BYTES");
	char path[600];
	struct live *mapped;
	int file;

	if (prefix == NULL || prefix[0] == '\0')
		return;
	snprintf(path, sizeof(path), "%s.%ld", prefix, (long)getpid());
	file = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
	if (file < 0)
		return;
	mapped = ftruncate(file, sizeof(*live)) == 0
		     ? mmap(NULL, sizeof(*live), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0)
		     : MAP_FAILED;
	close(file);
	if (mapped == MAP_FAILED)
		return;
	/* No other thread runs yet. */
	mapped->bytes = before.bytes;
	mapped->blocks = before.blocks;
	live = mapped;
}

static void *count(void *memory)
{
	if (memory != NULL) {
		atomic_fetch_add_explicit(&live->bytes, (long)malloc_usable_size(memory), memory_order_relaxed);
		atomic_fetch_add_explicit(&live->blocks, 1, memory_order_relaxed);
	}
	return memory;
}

static void uncount(void *memory)
{
	if (memory != NULL) {
		atomic_fetch_sub_explicit(&live->bytes, (long)malloc_usable_size(memory), memory_order_relaxed);
		atomic_fetch_sub_explicit(&live->blocks, 1, memory_order_relaxed);
	}
}

void *malloc(size_t size)
{
	return count(__libc_malloc(size));
}

void *calloc(size_t number, size_t size)
{
	return count(__libc_calloc(number, size));
}

void *realloc(void *memory, size_t size)
{
	long bytes = memory != NULL ? (long)malloc_usable_size(memory) : 0;
	void *moved = __libc_realloc(memory, size);

	/* A block that could not grow stays as it was; a size of 0 frees it. */
	if (moved == NULL && size != 0)
		return NULL;
	atomic_fetch_sub_explicit(&live->bytes, bytes, memory_order_relaxed);
	atomic_fetch_sub_explicit(&live->blocks, memory != NULL, memory_order_relaxed);
	return count(moved);
}

void *memalign(size_t alignment, size_t size)
{
	return count(__libc_memalign(alignment, size));
}

void *aligned_alloc(size_t alignment, size_t size)
{
	return count(__libc_memalign(alignment, size));
}

int posix_memalign(void **ret_memory, size_t alignment, size_t size)
{
	void *memory = __libc_memalign(alignment, size);

	if (memory == NULL)
		return ENOMEM;
	*ret_memory = count(memory);
	return 0;
}

void free(void *memory)
{
	int saved = errno;

	uncount(memory);
	__libc_free(memory);
	errno = saved;
}

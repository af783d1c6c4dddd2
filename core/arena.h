#ifndef CBCT_CORE_ARENA_H
#define CBCT_CORE_ARENA_H

#include <stddef.h>
#include <stdint.h>

#if defined(__SANITIZE_ADDRESS__) && !defined(__CUDACC__)
#define ARENA_GUARDED
#include <sanitizer/asan_interface.h>
#endif

#ifdef __cplusplus
extern "C" {
#endif

/*
 * Memory as one walk (the malloc_and_point of Karpathy's llm.c). A function takes every piece that an object
 * needs from an arena, one after the other. Without a base the walk only measures; with a base it carves:
 *
 *	struct arena arena = {0};
 *	walk(object, &arena);                     arena.used bytes are needed
 *	arena = (struct arena){.base = allocate(arena.used)};
 *	walk(object, &arena);                     the object's pointers are set
 *
 * So the estimate and the allocation come from the same lines, and the base is all that is freed. A
 * walk must take the same pieces both times. The memory is as it was allocated: nothing is cleared here. The
 * base may lie on a device.
 */
struct arena {
	char *base;  /* aligned to the largest alignment that is asked for; NULL: the walk measures */
	size_t used; /* bytes, gaps for alignment included; ARENA_MOST: more than any memory has */
};

#define ARENA_MOST (SIZE_MAX / 2)

#ifdef ARENA_GUARDED
/* The address sanitizer guards this many bytes behind each piece of the host's memory. */
enum { ARENA_GUARD = 64 };
#else
enum { ARENA_GUARD = 0 };
#endif

/* The next piece; NULL while the walk measures, and for 0 bytes. alignment: a power of two. */
static inline void *arena_take(struct arena *arena, size_t bytes, size_t alignment)
{
	const size_t first = (arena->used + alignment - 1) / alignment * alignment;

	if (bytes == 0)
		return NULL;
	if (arena->used >= ARENA_MOST || bytes >= ARENA_MOST - first - ARENA_GUARD) {
		arena->used = ARENA_MOST;
		return NULL;
	}
	arena->used = first + bytes + ARENA_GUARD;
	if (arena->base == NULL)
		return NULL;
#ifdef ARENA_GUARDED
	__asan_poison_memory_region(arena->base + first + bytes, ARENA_GUARD);
#endif
	return arena->base + first;
}

/* Before memory goes back by munmap: the guards are lifted, so that whoever has these addresses next may use them. */
static inline void arena_forget(void *base, size_t bytes)
{
#ifdef ARENA_GUARDED
	__asan_unpoison_memory_region(base, bytes);
#else
	(void)base;
	(void)bytes;
#endif
}

#ifdef __cplusplus
}
#endif

#endif

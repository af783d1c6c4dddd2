/* The count of finished steps: pulse.h. */
#include "core/pulse.h"

#include <stdatomic.h>

static atomic_ulong steps;

void pulse_beat(void)
{
	atomic_fetch_add_explicit(&steps, 1, memory_order_relaxed);
}

unsigned long pulse_count(void)
{
	return atomic_load_explicit(&steps, memory_order_relaxed);
}

#ifndef CBCT_PROTO_CLOCK_H
#define CBCT_PROTO_CLOCK_H

#include <time.h>

#include "core/clock.h"

/* The time beside core's clock_monotonic, for all that is above core. Any thread. */

/* Seconds since 1970; an operator or NTP may set this clock back: for what people read. */
double clock_realtime(void);

/* A moment of clock_monotonic for pthread_cond_timedwait, on a condition that has CLOCK_MONOTONIC. */
struct timespec clock_timespec(double at);

/* Seconds since 1970 as "2025-01-31T12:34:56.789Z". */
enum { CLOCK_TEXT_SIZE = 32 };
void clock_text(double seconds, char ret_text[CLOCK_TEXT_SIZE]);

#endif

#ifndef CBCT_CORE_CLOCK_H
#define CBCT_CORE_CLOCK_H

/* Returns seconds since some moment in the past; never goes back: for waiting and for measuring. Any thread. */
double clock_monotonic(void);

#endif

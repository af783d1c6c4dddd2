#ifndef CBCT_CORE_SELECT_H
#define CBCT_CORE_SELECT_H

/* The k-th smallest, from 0, of count values, which are reordered: none before it is larger, none behind it smaller. */
float select_kth(float *values, int count, int k);
/* The median of count values, which are reordered, of an even number the mean of the two in the middle; 0: of none. */
float select_median(float *values, int count);

#endif

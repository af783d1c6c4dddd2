#ifndef CBCT_CORE_SELECT_H
#define CBCT_CORE_SELECT_H

/* The k-th smallest, from 0, of count values, which are reordered: none before it is larger, none behind it smaller. */
float select_kth(float *values, int count, int k);

#endif

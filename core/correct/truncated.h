#ifndef CBCT_CORE_TRUNCATED_H
#define CBCT_CORE_TRUNCATED_H

#include "core/correct/correction.h"

/*
 * Warns of rows that the detector cuts off: rows[0] of all views at the first column, rows[1] at the last, as
 * backend.filter_extended counts them, which extended them by up to `extend` columns. A few rows give no warning.
 * Returns whether there was one.
 */
bool truncated_warn(const struct correction_job *job, const size_t rows[2], int extend);
/* "row" or "column": what FDK calls rows, and the sides of a detector, are named as they came. */
const char *truncated_row_name(const struct correction_job *job);

#endif

#ifndef CBCT_CORE_METAL_INTERNAL_H
#define CBCT_CORE_METAL_INTERNAL_H

#include "core/correct/metal.h"

/* Declarations that the files of the metal stage share: metal_find.c, metal.c, metal_traces.c, metal_blend.c. */

size_t metal_slice_voxels(const struct grid *grid);
/* `items` with room for one more than `count`; NULL, and they are as they were, where there is no memory. */
void *metal_grown(void *items, size_t size, size_t count, size_t *room);

/* Returns the new value of voxel i of the list, which has the value `there` in the volume. */
typedef float metal_change(struct metal *metal, size_t i, float there, double value);
/* Downloads each slice with metal, changes it at the list's voxels, and puts it back. */
int metal_change_slices(struct metal *metal, const struct metal_tools *tools, struct volume *volume,
			metal_change *change, double value, struct error *err);

/* First of the list's voxels of this slice or a later one. */
size_t metal_voxels_from(const struct metal *metal, int z);
/*
 * Pixels on either side of a trace whose mean the line starts from: one alone
 * would draw its noise over the trace, with more the line starts too far away.
 */
enum { METAL_FLANK = 2 };

/* For qsort: by view, row, column. */
int metal_compare_traces(const void *left, const void *right);

/* The neighbourhood of a voxel: an ellipsoid, in voxels along the axes. */
struct metal_rim {
	double radius[3];
	int reach[3];
};
/* The neighbourhood of so many widths of FDK's blur. */
struct metal_rim metal_rim_of(const struct metal_tools *tools, double widths);
/*
 * For each voxel of the slice the highest metal that has it in its rim, 0: none; and infinite where it is metal
 * itself. False, and nothing is written, where all are 0.
 */
bool metal_mark_slice(const struct metal *metal, const struct grid *grid, const struct metal_rim *rim, int z,
		      float *ret_peaks);

/* Views first .. first + count - 1 of a volume; the host's buffers are [slots][row][column]. */
struct metal_batch {
	int first, count;
	float *shadow; /* the volume's projections */
	float *views;  /* those of the scan */
	bool *trace;
};
/* Their line integrals through a volume, to `shadow`. */
int metal_project_batch(const struct metal_tools *tools, const struct volume *volume, const struct metal_batch *batch,
			struct error *err);

#endif

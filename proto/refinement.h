#ifndef CBCT_PROTO_REFINEMENT_H
#define CBCT_PROTO_REFINEMENT_H

#include <cjson/cJSON.h>

#include "core/refine/refine.h"

/*
 * What a refinement has changed, as a document:
 *
 *   {"kind": "geometry" | "motion", "accepted", "held_out": {"views", "better", "unexplained_before",
 *    "unexplained_after"}, "reference": refinement.alike, or null, "own": {"unexplained_before", "unexplained_after"},
 *    or null without a reference, "rms_mm", "rms_deg", "most_mm", "most_deg",
 *    "views": [{"projection", "shift_mm": [3], "turn_deg": [3]}, ...], "geometry": matrices, or null, "basis"}
 *
 * Changes are those of refine_change. Where none was accepted `views` is empty. The geometry is the whole detector's,
 * in the order of `views`; null where none was accepted, and of a motion, which is no place where an arm stood.
 */
#define REFINEMENT_FILE "refinement.json" /* in a job's directory */

struct refined {
	const struct refinement *refinement;
	enum refine_kind kind;
	int count;                      /* views */
	double (*change)[PATH_NUMBERS]; /* [count], refine_change; owned */
	int *projections;               /* [count], of the scan as it was announced; owned */
	struct view *views;             /* [count], moved; owned */
	double rms[2], most[2];         /* mm, degrees */
};
/* No views when refinement, which is borrowed, was not accepted. refined_measure makes rms and most of `change`. */
int refined_open(struct refined *ret_refined, const struct refinement *refinement, enum refine_kind kind, int count,
		 struct error *err);
void refined_measure(struct refined *refined);
void refined_clear(struct refined *refined);

/* NULL for no memory; the caller's to delete. */
cJSON *refined_json(const struct refined *refined);
/*
 * What refined_json says of the refinement itself, to the bit. ERR_INVALID or ERR_IMPOSSIBLE: it is no such document.
 */
int refinement_parse(const cJSON *json, struct refinement *ret_refinement, struct error *err);
/*
 * Such a document as a plot: shifts above, turns below, three lines each over the views; 8 bit gray. Allocates *ret_png
 * (free). ERR_CONFLICT: nothing was changed.
 */
int refinement_picture(const cJSON *document, char **ret_png, size_t *ret_length, struct error *err);
/* One sentence with the numbers, and the code of the warning that tells it. */
const char *refined_tell(const struct refined *refined, char *ret_detail, size_t size);
/* Whether a warning of this code is one of refined_tell's, which come after the document. */
bool refined_told(const char *code);

#endif

#ifndef CBCT_CORE_REST_H
#define CBCT_CORE_REST_H

#include "core/refine/path.h"
#include "core/scan/grid.h"

/*
 * Where the object is shown. Projections are the same when the object and all views move as one body, so that they
 * tell a path but for a motion that all views share; whatever a registration has made of that motion is left to chance.
 * path->common becomes the motion by which the middles of the faces of `shown` lie in the views, on the whole, where
 * the told ones have them: least squares of the distances on the detector. There the told geometry's volume has the
 * object, too. Returns 0, or ERR_NO_MEMORY.
 */
int path_rest(struct path *path, const struct path_view *views, int count, const struct grid *shown, struct error *err);

#endif

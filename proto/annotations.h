#ifndef CBCT_PROTO_ANNOTATIONS_H
#define CBCT_PROTO_ANNOTATIONS_H

#include "proto/json.h"

/*
 * Annotations of a job: measurements in its volumes, and views that people have chosen to show:
 *
 *   {"measurements": [{"id": "1", "kind": "ruler", "points": [[x, y, z], ...], "label": "..."}],
 *    "key_images": [{"id": "1", "volume": "final", "caption": "...", "created": "...", "window": 2000, "level": 300,
 *                    "normal": [3], "up": [3], "center": [3], "thickness": 0, "mode": "mean"}]}
 *
 * Places are mm in the world. ruler: two points; angle: an end, the vertex, the other end; ellipse: its middle and the
 * ends of two half axes; freehand: the corners of a region. A key image is what the slices of the API take. Either list
 * may be left out; both are there in what is returned.
 */
enum {
	ANNOTATIONS_BYTES_MAX = 4 << 20,
	ANNOTATIONS_MAX = 1000,
	ANNOTATION_POINTS_MAX = 5000,
	ANNOTATION_TEXT_MAX = 400
};

/* Reads it strictly and prints it anew: *ret_text is the caller's (free). Errors point to the member. */
int annotations_read(const char *text, size_t length, char **ret_text, size_t *ret_length, struct error *err);
/* The document of a job without annotations. */
#define ANNOTATIONS_NONE "{\"measurements\":[],\"key_images\":[]}"

#endif

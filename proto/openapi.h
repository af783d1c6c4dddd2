#ifndef CBCT_PROTO_OPENAPI_H
#define CBCT_PROTO_OPENAPI_H

#include <stddef.h>

/* proto/openapi.yaml as JSON, converted when this is built (proto/openapi.py). */
extern const unsigned char openapi_json[];
extern const size_t openapi_json_size;
extern const char openapi_json_etag[]; /* quoted, strong */

#endif

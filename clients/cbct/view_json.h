#ifndef CBCT_CLIENTS_VIEW_JSON_H
#define CBCT_CLIENTS_VIEW_JSON_H

#include <cjson/cJSON.h>

#include "core/scan/geometry.h"

/* An entry of a scan document's "views". */
cJSON *view_json(const struct view *view);

#endif

/*
 * The API: one row for each endpoint. The schema of record is
 * proto/openapi.yaml.
 */
#include "daemon/api/internal.h"

#include "proto/json.h"

#define IMAGE_ROUTE(id, name, ...)                                                                                     \
	{"PUT", "/v1/scans/{}/{" name "}", image_put, BODY_STREAM, 0, image_begin, upload_take, NULL},                 \
	    {"DELETE", "/v1/scans/{}/{" name "}", image_delete, BODY_NONE, 0, NULL, NULL, NULL},

/* GET is HEAD as well. A body that is streamed has begin and data beside handle. */
const struct route api_routes[] = {
    {"GET", "/", page_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/assets/{}", asset_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/plain", plain_list, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/plain.css", plain_style, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/plain/{}", plain_job, BODY_NONE, 0, NULL, NULL, "volume window"},

    {"GET", "/livez", live_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/readyz", ready_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/metrics", metrics_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/devices", device_list, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/quarantine", quarantine_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/openapi.json", schema_get, BODY_NONE, 0, NULL, NULL, NULL},

    {"GET", "/v1/scans", scan_list, BODY_NONE, 0, NULL, NULL, "limit after"},
    {"POST", "/v1/scans", scan_post, BODY_WHOLE, JSON_BYTES_MAX, NULL, NULL, NULL},
    {"GET", "/v1/scans/{}", scan_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/scans/{}", scan_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"POST", "/v1/scans/{}/complete", scan_complete, BODY_NONE, 0, NULL, NULL, NULL},
    IMAGES(IMAGE_ROUTE) // one for each
    {"PUT", "/v1/scans/{}/projections", projections_put, BODY_STREAM, 0, projections_begin, upload_take, NULL},
    {"GET", "/v1/scans/{}/projections/{}", projection_get, BODY_NONE, 0, NULL, NULL, "format"},
    {"PUT", "/v1/scans/{}/projections/{}", projections_put, BODY_STREAM, 0, projections_begin, upload_take, NULL},

    {"GET", "/v1/jobs", job_list, BODY_NONE, 0, NULL, NULL, "limit after"},
    {"POST", "/v1/jobs", job_post, BODY_WHOLE, JSON_BYTES_MAX, NULL, NULL, NULL},
    {"GET", "/v1/jobs/{}", job_get, BODY_NONE, 0, NULL, NULL, "wait"},
    {"DELETE", "/v1/jobs/{}", job_delete, BODY_NONE, 0, NULL, NULL, "wait"},
    {"GET", "/v1/jobs/{}/events", job_events, BODY_NONE, 0, NULL, NULL, "after"},
    {"GET", "/v1/events", all_events, BODY_NONE, 0, NULL, NULL, "after"},
    {"GET", "/v1/jobs/{}/volumes", volume_list, BODY_NONE, 0, NULL, NULL, "limit after wait"},
    {"GET", "/v1/jobs/{}/volumes/{}", volume_get, BODY_NONE, 0, NULL, NULL, "format type scale"},
    {"GET", "/v1/jobs/{}/volumes/{}/slice", slice_get, BODY_NONE, 0, NULL, NULL, "axis index window level sheet"},
    {"GET", "/v1/jobs/{}/stream", volume_stream, BODY_NONE, 0, NULL, NULL, "format type scale after"},
    {NULL, NULL, NULL, BODY_NONE, 0, NULL, NULL, NULL},
};

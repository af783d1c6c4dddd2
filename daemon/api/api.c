/*
 * The API: one row for each endpoint. The schema of record is
 * proto/openapi.yaml.
 */
#include "daemon/api/internal.h"

#include "proto/annotations.h"
#include "proto/json.h"

#define IMAGE_ROUTE(id, name, ...)                                                                                     \
	{"PUT", "/v1/scans/{}/{" name "}", ROLE_ACQUIRE, image_put, BODY_STREAM, 0, image_begin, upload_take, NULL},   \
	    {"DELETE", "/v1/scans/{}/{" name "}", ROLE_ACQUIRE, image_delete, BODY_NONE, 0, NULL, NULL, NULL},

/* Each row says the least role that may. GET is HEAD as well. A body that is streamed has begin and data beside handle.
 */
const struct route api_routes[] = {
    {"GET", "/", ROLE_ANYONE, page_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/assets/{}", ROLE_ANYONE, asset_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/plain", ROLE_VIEW, plain_list, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/plain.css", ROLE_ANYONE, plain_style, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/plain/{}", ROLE_VIEW, plain_job, BODY_NONE, 0, NULL, NULL, "volume window"},

    {"GET", "/livez", ROLE_ANYONE, live_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/readyz", ROLE_ANYONE, ready_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/metrics", ROLE_VIEW, metrics_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/devices", ROLE_VIEW, device_list, BODY_NONE, 0, NULL, NULL, NULL},
    {"POST", "/v1/devices/{}/clear", ROLE_ADMIN, device_clear_post, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/limits", ROLE_VIEW, limits_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/quarantine", ROLE_VIEW, quarantine_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/openapi.json", ROLE_ANYONE, schema_get, BODY_NONE, 0, NULL, NULL, NULL},

    {"POST", "/v1/session", ROLE_VIEW, session_post, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/session", ROLE_VIEW, session_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/session", ROLE_VIEW, session_delete, BODY_NONE, 0, NULL, NULL, NULL},

    {"GET", "/v1/scans", ROLE_VIEW, scan_list, BODY_NONE, 0, NULL, NULL, "limit after state label text"},
    {"POST", "/v1/scans", ROLE_ACQUIRE, scan_post, BODY_WHOLE, JSON_BYTES_MAX, NULL, NULL, NULL},
    {"GET", "/v1/scans/{}", ROLE_VIEW, scan_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/scans/{}", ROLE_ACQUIRE, scan_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"PUT", "/v1/scans/{}/pin", ROLE_ACQUIRE, scan_pin_put, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/scans/{}/pin", ROLE_ACQUIRE, scan_pin_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"POST", "/v1/scans/{}/complete", ROLE_ACQUIRE, scan_complete, BODY_NONE, 0, NULL, NULL, NULL},
    IMAGES(IMAGE_ROUTE) // one for each
    {"GET", "/v1/scans/{}/scatter/{}", ROLE_VIEW, scatter_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/scans/{}/scatter", ROLE_ACQUIRE, scatter_delete_all, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/scans/{}/scatter/{}", ROLE_ACQUIRE, scatter_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"PUT", "/v1/scans/{}/scatter/{}", ROLE_ACQUIRE, projections_put, BODY_STREAM, 0, scatter_begin, upload_take, NULL},
    {"PUT", "/v1/scans/{}/projections", ROLE_ACQUIRE, projections_put, BODY_STREAM, 0, projections_begin, upload_take,
     NULL},
    {"GET", "/v1/scans/{}/projections/{}", ROLE_VIEW, projection_get, BODY_NONE, 0, NULL, NULL, "format"},
    {"PUT", "/v1/scans/{}/projections/{}", ROLE_ACQUIRE, projections_put, BODY_STREAM, 0, projections_begin,
     upload_take, NULL},

    {"GET", "/v1/calibrations", ROLE_VIEW, calibration_list, BODY_NONE, 0, NULL, NULL, "limit after"},
    {"POST", "/v1/calibrations", ROLE_ACQUIRE, calibration_post, BODY_WHOLE, JSON_BYTES_MAX, NULL, NULL, NULL},
    {"GET", "/v1/calibrations/{}", ROLE_VIEW, calibration_get, BODY_NONE, 0, NULL, NULL, "wait"},
    {"DELETE", "/v1/calibrations/{}", ROLE_ACQUIRE, calibration_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/calibrations/{}/views/{}", ROLE_VIEW, calibration_view_get, BODY_NONE, 0, NULL, NULL, NULL},

    {"GET", "/v1/jobs", ROLE_VIEW, job_list, BODY_NONE, 0, NULL, NULL, "limit after state scan priority label text"},
    {"POST", "/v1/jobs", ROLE_ACQUIRE, job_post, BODY_WHOLE, JSON_BYTES_MAX, NULL, NULL, "resume"},
    {"GET", "/v1/jobs/{}", ROLE_VIEW, job_get, BODY_NONE, 0, NULL, NULL, "wait"},
    {"DELETE", "/v1/jobs/{}", ROLE_ACQUIRE, job_delete, BODY_NONE, 0, NULL, NULL, "wait"},
    {"PUT", "/v1/jobs/{}/pin", ROLE_ACQUIRE, job_pin_put, BODY_NONE, 0, NULL, NULL, NULL},
    {"DELETE", "/v1/jobs/{}/pin", ROLE_ACQUIRE, job_pin_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/jobs/{}/events", ROLE_VIEW, job_events, BODY_NONE, 0, NULL, NULL, "after"},
    {"GET", "/v1/events", ROLE_VIEW, all_events, BODY_NONE, 0, NULL, NULL, "after"},
    {"GET", "/v1/jobs/{}/annotations", ROLE_VIEW, annotations_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"PUT", "/v1/jobs/{}/annotations", ROLE_ACQUIRE, annotations_put, BODY_WHOLE, ANNOTATIONS_BYTES_MAX, NULL, NULL,
     NULL},
    {"GET", "/v1/jobs/{}/refinement", ROLE_VIEW, refinement_get, BODY_NONE, 0, NULL, NULL, "format"},
    {"GET", "/v1/jobs/{}/checkpoint", ROLE_VIEW, checkpoint_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"PUT", "/v1/jobs/{}/checkpoint/{}", ROLE_ACQUIRE, checkpoint_put, BODY_STREAM, 0, checkpoint_begin,
     checkpoint_data, NULL},
    {"GET", "/v1/destinations", ROLE_VIEW, destination_list, BODY_NONE, 0, NULL, NULL, "wait"},
    {"GET", "/v1/worklist", ROLE_ACQUIRE, worklist_get, BODY_NONE, 0, NULL, NULL, "wait"},
    {"GET", "/v1/jobs/{}/send", ROLE_VIEW, send_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"POST", "/v1/jobs/{}/send", ROLE_ACQUIRE, send_post, BODY_WHOLE, JSON_BYTES_MAX, NULL, NULL, NULL},
    {"DELETE", "/v1/jobs/{}/send/{}", ROLE_ACQUIRE, send_delete, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/jobs/{}/volumes", ROLE_VIEW, volume_list, BODY_NONE, 0, NULL, NULL, "limit after wait"},
    {"GET", "/v1/jobs/{}/volumes/{}", ROLE_VIEW, volume_get, BODY_NONE, 0, NULL, NULL,
     "format type scale dicom position"},
    {"GET", "/v1/jobs/{}/volumes/{}/provenance", ROLE_VIEW, provenance_get, BODY_NONE, 0, NULL, NULL, NULL},
    {"GET", "/v1/jobs/{}/volumes/{}/slice", ROLE_VIEW, slice_get, BODY_NONE, 0, NULL, NULL,
     "axis index window level sheet normal up center size spacing thickness mode"},
    {"GET", "/v1/jobs/{}/stream", ROLE_VIEW, volume_stream, BODY_NONE, 0, NULL, NULL, "format type scale after"},
    {NULL, NULL, ROLE_UNSAID, NULL, BODY_NONE, 0, NULL, NULL, NULL},
};

/* A job's rows as the API and its events show them: document.h. */
#include "daemon/jobs/document.h"

#include <math.h>
#include <stdio.h>

#include "daemon/problem.h"
#include "proto/digest.h"
#include "proto/json.h"

cJSON *job_error_document(const struct job_record *record)
{
	cJSON *document = cJSON_CreateObject();
	cJSON *report = record->error_report[0] != '\0' ? cJSON_Parse(record->error_report) : NULL;

	problem_add_type(document, problem_of_code(record->error_code));
	cJSON_AddStringToObject(document, "detail", record->error_text);
	if (record->error_pointer[0] != '\0')
		cJSON_AddStringToObject(document, "pointer", record->error_pointer);
	if (report != NULL)
		json_add(document, "report", report);
	return document;
}

cJSON *history_row_document(const struct history_row *row)
{
	cJSON *document = cJSON_CreateObject();

	cJSON_AddNumberToObject(document, "iteration", row->iteration);
	cJSON_AddNumberToObject(document, "residual", row->residual);
	cJSON_AddNumberToObject(document, "change", row->change);
	cJSON_AddNumberToObject(document, "tv", row->tv);
	/* An iteration on a GPU may take less than a millisecond. */
	cJSON_AddNumberToObject(document, "seconds", round(row->seconds * 1e6) / 1e6);
	return document;
}

cJSON *stop_document(const struct recon_stop *stop)
{
	static const char *const reasons[STOP_RULE_COUNT] = {
	    [STOP_NOISE] = "the volume has taken up most of the projections' noise",
	    [STOP_RESIDUAL] = "the last iteration explained next to nothing more of the projections",
	    [STOP_CHANGE] = "the last iteration changed next to nothing",
	    [STOP_CEILING] = "max_iterations were run",
	};
	cJSON *document = cJSON_CreateObject();

	cJSON_AddStringToObject(document, "rule", stop_rule_names[stop->rule]);
	cJSON_AddNumberToObject(document, "iteration", stop->iteration);
	cJSON_AddNumberToObject(document, "residual", stop->residual);
	cJSON_AddNumberToObject(document, "change", stop->change);
	if (stop->noise > 0)
		cJSON_AddNumberToObject(document, "noise", stop->noise);
	else
		cJSON_AddNullToObject(document, "noise");
	cJSON_AddStringToObject(document, "reason", reasons[stop->rule]);
	return document;
}

cJSON *sending_document(const struct sending_record *sending)
{
	cJSON *document = cJSON_CreateObject();

	if (document == NULL)
		return NULL;
	cJSON_AddStringToObject(document, "to", sending->destination);
	if (sending->volume[0] != '\0')
		cJSON_AddStringToObject(document, "volume", sending->volume);
	else
		cJSON_AddNullToObject(document, "volume");
	json_add(document, "volumes", send_volumes_json(sending->volumes));
	cJSON_AddStringToObject(document, "state", sending_state_names[sending->state]);
	cJSON_AddNumberToObject(document, "attempts", sending->attempts);
	cJSON_AddNumberToObject(document, "instances", sending->instances);
	cJSON_AddNumberToObject(document, "stored", sending->stored);
	if (sending->error[0] != '\0')
		cJSON_AddStringToObject(document, "error", sending->error);
	else
		cJSON_AddNullToObject(document, "error");
	json_add_time(document, "created", sending->created);
	json_add_time(document, "next", sending->next);
	json_add_time(document, "ended", sending->ended);
	return document;
}

static void add_measured(cJSON *object, const char *name, double value)
{
	if (isfinite(value))
		cJSON_AddNumberToObject(object, name, value);
	else
		cJSON_AddNullToObject(object, name);
}

static void add_quality(cJSON *document, const struct volume_record *volume)
{
	const struct volume_quality *quality = &volume->quality;
	const struct volume_support *support = &volume->support;
	cJSON *object = cJSON_AddObjectToObject(document, "quality"), *held_out;

	add_measured(object, "noise_hu", quality->noise_hu);
	add_measured(object, "streak_hu", quality->streak_hu);
	add_measured(object, "ring_hu", quality->ring_hu);
	add_measured(object, "edge_mm", quality->edge_mm);
	add_measured(object, "metal_share", support->metal);
	add_measured(object, "estimated_share", support->estimated);
	if (support->held_out == 0) {
		cJSON_AddNullToObject(object, "held_out");
		return;
	}
	held_out = cJSON_AddObjectToObject(object, "held_out");
	cJSON_AddNumberToObject(held_out, "views", support->held_out);
	add_measured(held_out, "residual", support->held_residual);
	add_measured(held_out, "used_residual", support->used_residual);
}

cJSON *volume_document(const char *job, const struct volume_record *volume)
{
	cJSON *document = cJSON_CreateObject(), *statistics;
	char href[128], digest[DIGEST_TEXT_MAX];

	snprintf(href, sizeof(href), "/v1/jobs/%s/volumes/%s", job, volume->name);
	cJSON_AddStringToObject(document, "name", volume->name);
	cJSON_AddStringToObject(document, "href", href);
	cJSON_AddStringToObject(document, "stage", volume->stage);
	cJSON_AddNumberToObject(document, "iteration", volume->iteration);
	json_add(document, "size", cJSON_CreateIntArray(volume->grid.size, 3));
	json_add(document, "spacing_mm", cJSON_CreateDoubleArray(volume->grid.spacing, 3));
	json_add(document, "origin_mm", cJSON_CreateDoubleArray(volume->grid.origin, 3));
	cJSON_AddNumberToObject(document, "bytes", (double)volume->bytes);
	if (volume->hashed) { /* of the raw float32 voxels */
		digest_text(volume->sha256, digest);
		cJSON_AddStringToObject(document, "digest", digest);
	}
	snprintf(href, sizeof(href), "/v1/jobs/%s/volumes/%s/provenance", job, volume->name);
	cJSON_AddStringToObject(document, "provenance", href);
	statistics = cJSON_AddObjectToObject(document, "statistics");
	cJSON_AddNumberToObject(statistics, "minimum", volume->norms.minimum);
	cJSON_AddNumberToObject(statistics, "maximum", volume->norms.maximum);
	cJSON_AddNumberToObject(statistics, "mean", volume->norms.mean);
	cJSON_AddNumberToObject(statistics, "norm", sqrt(volume->norms.norm2));
	cJSON_AddNumberToObject(statistics, "tv", volume->norms.tv);
	cJSON_AddNumberToObject(statistics, "not_finite", (double)volume->norms.not_finite);
	if (volume->estimate_mm > 0)
		cJSON_AddNumberToObject(cJSON_AddObjectToObject(document, "metal"), "estimate_within_mm",
					volume->estimate_mm);
	if (volume->hashed)
		add_quality(document, volume);
	json_add_time(document, "created", volume->created);
	return document;
}

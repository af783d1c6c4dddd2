/* A job's rows as the API and its events show them: document.h. */
#include "daemon/jobs/document.h"

#include <math.h>
#include <openssl/evp.h>
#include <stdio.h>

#include "daemon/problem.h"
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
		cJSON_AddItemToObject(document, "report", report);
	return document;
}

cJSON *history_row_document(const struct history_row *row)
{
	cJSON *document = cJSON_CreateObject();

	cJSON_AddNumberToObject(document, "iteration", row->iteration);
	cJSON_AddNumberToObject(document, "residual", row->residual);
	cJSON_AddNumberToObject(document, "change", row->change);
	cJSON_AddNumberToObject(document, "tv", row->tv);
	json_add_seconds(document, "seconds", row->seconds);
	return document;
}

/* As RFC 9530 writes it in Content-Digest: of the raw float32 voxels. */
static void add_digest(cJSON *object, const uint8_t sha256[32])
{
	unsigned char base64[64];
	char text[96];

	EVP_EncodeBlock(base64, sha256, 32);
	snprintf(text, sizeof(text), "sha-256=:%s:", (const char *)base64);
	cJSON_AddStringToObject(object, "digest", text);
}

cJSON *volume_document(const char *job, const struct volume_record *volume)
{
	cJSON *document = cJSON_CreateObject(), *statistics;
	char href[128];

	snprintf(href, sizeof(href), "/v1/jobs/%s/volumes/%s", job, volume->name);
	cJSON_AddStringToObject(document, "name", volume->name);
	cJSON_AddStringToObject(document, "href", href);
	cJSON_AddStringToObject(document, "stage", volume->stage);
	cJSON_AddNumberToObject(document, "iteration", volume->iteration);
	cJSON_AddItemToObject(document, "size", cJSON_CreateIntArray(volume->grid.size, 3));
	cJSON_AddItemToObject(document, "spacing_mm", cJSON_CreateDoubleArray(volume->grid.spacing, 3));
	cJSON_AddItemToObject(document, "origin_mm", cJSON_CreateDoubleArray(volume->grid.origin, 3));
	cJSON_AddNumberToObject(document, "bytes", (double)volume->bytes);
	if (volume->hashed)
		add_digest(document, volume->sha256);
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
	json_add_time(document, "created", volume->created);
	return document;
}

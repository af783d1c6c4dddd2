/* The table of presets. proto/openapi.yaml and the page name them too: tests/http/test_job.sh,
 * tests/web/parameters.mjs. */
#include "proto/preset.h"

#include <stdio.h>
#include <string.h>

#include "core/recon/algorithm.h"
#include "proto/json.h"

const struct job_preset job_presets[JOB_PRESET_COUNT] = {
    {"preview", "The first picture: FDK alone, there when the last projection is.", "{\"fdk\":{}}"},
    {"fast", "Near balanced in about two thirds of its time: four iterations with momentum.",
     "{\"fdk\":{},\"sart\":{\"iterations\":4,\"momentum\":true},\"tv\":{}}"},
    {"balanced", "What a job has that names no stage: smoothed as much as the noise asks for.",
     "{\"fdk\":{},\"sart\":{},\"tv\":{}}"},
    {"low-noise", "Smoother than balanced; contrasts of 30 HU in a few voxels are lost.",
     "{\"fdk\":{},\"sart\":{},\"tv\":{\"strength\":\"strong\"}}"},
    {"bone", "Sharper and noisier than balanced: for edges of bone.",
     "{\"fdk\":{\"window\":\"ram-lak\"},\"sart\":{},\"tv\":{\"strength\":\"light\",\"after\":\"sart\"}}"},
    {"metal", "Balanced, and streaks of metal are removed.", "{\"fdk\":{},\"sart\":{},\"tv\":{},\"metal\":{}}"},
};

static int find(const cJSON *name, const struct job_preset **ret_preset, struct error *err)
{
	char known[128] = "";
	size_t used = 0;

	if (!cJSON_IsString(name))
		return error_set_at(err, ERR_INVALID, "/preset", "the name of a preset is expected");
	for (int i = 0; i < JOB_PRESET_COUNT; i++) {
		if (strcmp(job_presets[i].name, name->valuestring) == 0) {
			*ret_preset = &job_presets[i];
			return 0;
		}
		used += (size_t)snprintf(known + used, sizeof(known) - used, "%s%s", i == 0 ? "" : ", ",
					 job_presets[i].name);
	}
	return error_set_at(err, ERR_IMPOSSIBLE, "/preset", "\"%.40s\" is no preset: %s", name->valuestring, known);
}

static bool is_algorithm(const char *name)
{
	return algorithm_find(name) != NULL;
}

static bool names_algorithm(const cJSON *request)
{
	const cJSON *member;

	cJSON_ArrayForEach(member, request)
	{
		if (is_algorithm(member->string))
			return true;
	}
	return false;
}

/* Moves the stages that the request does not name into it. */
static void take_stages(cJSON *request, cJSON *stages)
{
	const bool own_algorithm = names_algorithm(request);
	cJSON *stage, *next;

	for (stage = stages->child; stage != NULL; stage = next) {
		next = stage->next;
		if (cJSON_GetObjectItemCaseSensitive(request, stage->string) != NULL ||
		    (own_algorithm && is_algorithm(stage->string)))
			continue;
		cJSON_DetachItemViaPointer(stages, stage);
		json_append(request, stage); /* under its own name */
	}
}

int job_preset_expand(const cJSON *request, cJSON **ret_expanded, struct error *err)
{
	const cJSON *name = cJSON_GetObjectItemCaseSensitive(request, "preset");
	const struct job_preset *preset = NULL;
	cJSON *expanded, *stages;
	int code = 0;

	*ret_expanded = NULL;
	if (!cJSON_IsObject(request) || name == NULL)
		return 0;
	if (!cJSON_IsNull(name))
		code = find(name, &preset, err);
	if (code != 0)
		return code;
	expanded = cJSON_Duplicate(request, 1);
	stages = cJSON_Parse(preset != NULL ? preset->stages : "{}");
	if (expanded == NULL || stages == NULL) {
		cJSON_Delete(expanded);
		cJSON_Delete(stages);
		return error_set(err, ERR_NO_MEMORY, "no memory for a job's request");
	}
	cJSON_DeleteItemFromObjectCaseSensitive(expanded, "preset");
	take_stages(expanded, stages);
	cJSON_Delete(stages);
	*ret_expanded = expanded;
	return 0;
}

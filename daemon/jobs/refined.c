/* What a job's refinement has changed: job.h. */
#include <stdio.h>
#include <stdlib.h>

#include "daemon/jobs/internal.h"
#include "proto/calibration_files.h"
#include "proto/refinement.h"

/* Why there is no file of what the job has refined. */
static int say_why(struct job *job, const struct job_facts *facts, struct error *err)
{
	struct warning_record *warnings;
	bool told = false;
	int count;

	if (store_job_warnings(job->jobs->store, job->id, &warnings, &count, err) != 0)
		return err->code;
	for (int i = 0; i < count; i++)
		told = told || refined_told(warnings[i].code);
	free(warnings);
	if (told)
		return error_set(err, ERR_DAMAGED, "what job %s has refined is gone: its file %s", facts->id,
				 REFINEMENT_FILE);
	if (!facts->ended)
		return error_set(err, ERR_CONFLICT, "job %s has not refined anything yet: its state is %s", facts->id,
				 job_state_names[facts->state]);
	return error_set(err, ERR_NOT_FOUND, "job %s ended before anything was refined", facts->id);
}

int job_refinement(struct job *job, cJSON **ret_document, struct error *err)
{
	const struct job_request *request;
	char directory[1024], path[1100];
	struct job_facts facts;
	int code = job_request(job, &request, err);

	if (code != 0)
		return code;
	job_facts(job, &facts);
	if (!request->recipe.refine.geometry && !request->recipe.refine.motion)
		return error_set(err, ERR_NOT_FOUND, "job %s was not asked to refine anything", facts.id);
	store_job_directory(job->jobs->store, facts.id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, REFINEMENT_FILE);
	code = sealed_read(path, ret_document, err);
	return code == ERR_NOT_FOUND ? say_why(job, &facts, err) : code;
}

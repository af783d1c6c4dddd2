/* What a job's refinement has changed: job.h. */
#include <stdio.h>

#include "daemon/jobs/internal.h"
#include "proto/calibration_files.h"
#include "proto/refinement.h"

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
	if (code == ERR_NOT_FOUND && !facts.ended)
		return error_set(err, ERR_CONFLICT, "job %s has not refined anything yet: its state is %s", facts.id,
				 job_state_names[facts.state]);
	return code == ERR_NOT_FOUND ? error_set(err, code, "job %s ended before anything was refined", facts.id)
				     : code;
}

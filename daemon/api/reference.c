/* The reference of a job that refines: another job's volume, held against what the job wants. */
#include <math.h>
#include <stdio.h>

#include "daemon/api/internal.h"

enum { VOXELS_LEAST = 8 };               /* along each axis of a reference */
static const double COVERED_LEAST = 0.5; /* of the smaller one of both grids */

/* The share of the smaller grid that both have. */
static double common_share(const struct grid *a, const struct grid *b)
{
	double both = 1, volumes[2] = {1, 1};

	for (int i = 0; i < 3; i++) {
		const double first = fmax(a->origin[i] - a->spacing[i] / 2, b->origin[i] - b->spacing[i] / 2);
		const double behind = fmin(a->origin[i] + (a->size[i] - 0.5) * a->spacing[i],
					   b->origin[i] + (b->size[i] - 0.5) * b->spacing[i]);

		both *= fmax(0, behind - first);
		volumes[0] *= a->size[i] * a->spacing[i];
		volumes[1] *= b->size[i] * b->spacing[i];
	}
	return both / fmin(volumes[0], volumes[1]);
}

static int check_place(const struct job_request *wanted, const struct job_request *other,
		       const struct volume_record *volume, struct error *err)
{
	const double share = common_share(&wanted->recipe.grid, &volume->grid);

	if (wanted->patient.known && other->patient.known && !patient_same(&wanted->patient, &other->patient))
		return error_set(err, ERR_IMPOSSIBLE,
				 "the patient lies otherwise in the reference: its world is another one");
	for (int a = 0; a < 3; a++)
		if (volume->grid.size[a] < VOXELS_LEAST)
			return error_set(err, ERR_IMPOSSIBLE, "the reference has %d x %d x %d voxels, %d are wanted",
					 volume->grid.size[0], volume->grid.size[1], volume->grid.size[2],
					 VOXELS_LEAST);
	return share >= COVERED_LEAST
		   ? 0
		   : error_set(
			 err, ERR_IMPOSSIBLE,
			 "the reference is of another place: of the smaller one of both grids %.0f %% are in both, "
			 "%.0f %% are wanted",
			 100 * share, 100 * COVERED_LEAST);
}

static int check(struct api *api, const struct job_request *wanted, struct job *job, struct error *err)
{
	const struct job_request *other;
	struct volume_record volume;
	struct job_facts facts;
	int code = job_request(job, &other, err);

	if (code != 0)
		return code;
	job_facts(job, &facts);
	if (facts.state != JOB_SUCCEEDED)
		return error_set(err, ERR_CONFLICT, "job %s is %s: a reference is a volume of one that has succeeded",
				 facts.id, job_state_names[facts.state]);
	code = volume_find(api, &facts, REFERENCE_VOLUME, &volume, err);
	if (code == ERR_NOT_FOUND)
		code = ERR_CONFLICT;
	return code == 0 ? check_place(wanted, other, &volume, err) : code;
}

int reference_check(struct api *api, const struct job_request *wanted, struct error *err)
{
	struct job *job;
	int code;

	if (wanted->recipe.refine.reference[0] == '\0')
		return 0;
	code = jobs_find(api->jobs, wanted->recipe.refine.reference, &job, err);
	if (code == 0) {
		code = check(api, wanted, job, err);
		job_release(job);
	}
	if (code != 0)
		snprintf(err->pointer, sizeof(err->pointer), "/refine/reference/job");
	return code;
}

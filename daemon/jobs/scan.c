/* Scans that go, or lose an image, while jobs may need them; what jobs have found of them: job.h. */
#include <string.h>

#include "daemon/jobs/internal.h"

/* A job over the scan for which `uses` holds, "" for none. With jobs.change held, so that the answer lasts. */
static void find_user(struct jobs *jobs, const char *scan, bool (*uses)(const struct job_record *record),
		      char ret_user[ID_SIZE])
{
	ret_user[0] = '\0';
	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count && ret_user[0] == '\0'; i++) {
		if (uses(&jobs->all[i]->record) && strcmp(jobs->all[i]->scan, scan) == 0)
			memcpy(ret_user, jobs->all[i]->id, ID_SIZE);
	}
	pthread_mutex_unlock(&jobs->lock);
}

static bool has_not_ended(const struct job_record *record)
{
	return !job_state_ended(record->state);
}

static bool runs(const struct job_record *record)
{
	return record->state == JOB_RUNNING;
}

/* It runs, or goes on later from what it has. */
static bool has_begun(const struct job_record *record)
{
	return runs(record) || (record->state == JOB_QUEUED && record->attempts > 0);
}

bool jobs_agreement(struct jobs *jobs, const char *scan, struct recon_agreement *ret_agreement)
{
	bool found = false;

	pthread_mutex_lock(&jobs->lock);
	for (int i = jobs->count - 1; i >= 0 && !found; i--) {
		const struct job *job = jobs->all[i];

		found = job->record.agreement.views > 0 && strcmp(job->scan, scan) == 0;
		if (found)
			*ret_agreement = job->record.agreement;
	}
	pthread_mutex_unlock(&jobs->lock);
	return found;
}

int jobs_delete_scan(struct jobs *jobs, struct stored_scan *scan, struct error *err)
{
	const char *id = stored_scan_id(scan);
	char user[ID_SIZE];
	int code;

	pthread_mutex_lock(&jobs->change);
	find_user(jobs, id, has_not_ended, user);
	if (user[0] != '\0')
		code = error_set(err, ERR_CONFLICT, "job %s still uses scan %s", user, id);
	else
		code = store_scan_delete(jobs->store, scan, err);
	pthread_mutex_unlock(&jobs->change);
	if (code == 0)
		store_scan_remove_files(jobs->store, id);
	return code;
}

int jobs_remove_image(struct jobs *jobs, struct stored_scan *scan, enum image image, struct error *err)
{
	char user[ID_SIZE];
	int code;

	pthread_mutex_lock(&jobs->change);
	find_user(jobs, stored_scan_id(scan), runs, user);
	if (user[0] != '\0')
		code = error_set(err, ERR_CONFLICT, "job %s runs with the %s of scan %s", user,
				 image_kinds[image].title, stored_scan_id(scan));
	else
		code = store_remove_image(jobs->store, scan, image, err);
	pthread_mutex_unlock(&jobs->change);
	return code;
}

int jobs_remove_scatter(struct jobs *jobs, struct stored_scan *scan, int image, struct error *err)
{
	char user[ID_SIZE];
	int code;

	pthread_mutex_lock(&jobs->change);
	find_user(jobs, stored_scan_id(scan), has_begun, user);
	if (user[0] != '\0')
		code = error_set(err, ERR_CONFLICT, "job %s has begun with the images of scatter of scan %s", user,
				 stored_scan_id(scan));
	else
		code = store_remove_scatter(scan, image, err);
	pthread_mutex_unlock(&jobs->change);
	return code;
}

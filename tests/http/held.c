/*
 * What a volume waits for held up, so that tests can look at it meanwhile, and the catalogue made to refuse: linked
 * with --wrap=fdatasync, a worker whose syncs do not return while the file that
 * CBCT_TEST_HOLD names is there; with --wrap=recon_push, a worker that takes no projection while that of
 * CBCT_TEST_HANG is; with --wrap=job_digest_volume, a daemon whose
 * digests do not come while that of CBCT_TEST_HOLD_DIGEST is; and with the calls
 * of the store below, a daemon that cannot record what the file of
 * CBCT_TEST_REFUSE names: "running", "digest" or "volume NAME".
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "daemon/jobs/job.h"

/* Weak: a program has one of them. */
int __real_fdatasync(int file) __attribute__((weak));
int __wrap_fdatasync(int file);
int __real_recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err)
    __attribute__((weak));
int __wrap_recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err);
int __real_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
    __attribute__((weak));
int __wrap_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err);

int __real_store_job_update(struct store *store, const struct job_record *job, const struct event *event,
			    const struct event *end, enum job_past past, struct error *err) __attribute__((weak));
int __wrap_store_job_update(struct store *store, const struct job_record *job, const struct event *event,
			    const struct event *end, enum job_past past, struct error *err);
int __real_store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
				const struct event *event, struct error *err) __attribute__((weak));
int __wrap_store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
				const struct event *event, struct error *err);
int __real_store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume,
				   struct error *err) __attribute__((weak));
int __wrap_store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume,
				   struct error *err);

static void hold(const char *variable)
{
	const struct timespec moment = {.tv_nsec = 10000000};
	const char *path = getenv(variable);

	while (path != NULL && access(path, F_OK) == 0)
		nanosleep(&moment, NULL);
}

int __wrap_fdatasync(int file)
{
	hold("CBCT_TEST_HOLD");
	return __real_fdatasync(file);
}

int __wrap_recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err)
{
	hold("CBCT_TEST_HANG");
	return __real_recon_push(recon, samples, views, count, err);
}

int __wrap_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	hold("CBCT_TEST_HOLD_DIGEST");
	return __real_job_digest_volume(job, volume, err);
}

static int refuse(const char *what, struct error *err)
{
	const char *path = getenv("CBCT_TEST_REFUSE");
	FILE *file = path == NULL ? NULL : fopen(path, "re");
	char wanted[64] = "";

	if (file == NULL)
		return 0;
	if (fgets(wanted, sizeof(wanted), file) != NULL)
		wanted[strcspn(wanted, "\n")] = '\0';
	fclose(file);
	return strcmp(wanted, what) == 0 ? error_set(err, ERR_INTERNAL, "catalogue: refused") : 0;
}

int __wrap_store_job_update(struct store *store, const struct job_record *job, const struct event *event,
			    const struct event *end, enum job_past past, struct error *err)
{
	if (job->state == JOB_RUNNING && refuse("running", err) != 0)
		return err->code;
	return __real_store_job_update(store, job, event, end, past, err);
}

int __wrap_store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
				const struct event *event, struct error *err)
{
	char what[64];

	snprintf(what, sizeof(what), "volume %s", volume->name);
	if (refuse(what, err) != 0)
		return err->code;
	return __real_store_job_add_volume(store, id, volume, event, err);
}

int __wrap_store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume,
				   struct error *err)
{
	if (refuse("digest", err) != 0)
		return err->code;
	return __real_store_job_digest_volume(store, id, volume, err);
}

/*
 * What a volume waits for held up, so that tests can look at it meanwhile: linked
 * with --wrap=fdatasync, a worker whose syncs do not return while the file that
 * CBCT_TEST_HOLD names is there; with --wrap=job_digest_volume, a daemon whose
 * digests do not come while that of CBCT_TEST_HOLD_DIGEST is.
 */
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "daemon/job.h"

/* Weak: a program has one of them. */
int __real_fdatasync(int file) __attribute__((weak));
int __wrap_fdatasync(int file);
int __real_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
    __attribute__((weak));
int __wrap_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err);

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

int __wrap_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	hold("CBCT_TEST_HOLD_DIGEST");
	return __real_job_digest_volume(job, volume, err);
}

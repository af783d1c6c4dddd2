/* The SHA-256 of kept volumes: digest.h. */
#include "daemon/jobs/digest.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <openssl/evp.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/regular.h"
#include "proto/seal.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"
#include "proto/format.h"

enum { NICENESS = 10 /* behind the workers, too */ };
/* s until what failed is tried again; each time twice as long. */
static const double RETRY_FIRST = 1, RETRY_LAST = 300;

/* Volumes of a job that have no digest yet. */
struct task {
	struct task *next;
	char job[ID_SIZE];
	char name[32]; /* "": all of them */
	double due;    /* clock_monotonic: not before */
	double retry;  /* s to the next time, should it fail */
};

struct digester {
	struct jobs *jobs; /* constant, as the next */
	int count;
	_Atomic bool stop;
	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	struct task *first, **last;
	pthread_t threads[];
};

/* ---- one volume ---- */

/* Where the voxels of a volume's file begin and end. */
struct voxels {
	size_t start, end;
	struct seal seal; /* of no blocks: the file has none */
};

static int find_voxels(int file, const char *path, const struct volume_record *volume, struct voxels *ret,
		       struct error *err)
{
	struct voxels voxels = {.start = 0};
	struct stat status;
	int code = seal_read(file, &voxels.seal, err);

	if (code != 0 && code != ERR_NOT_FOUND)
		return code;
	if (volume_own_start(file, path, &volume->grid, &voxels.start, err) != 0 || fstat(file, &status) != 0)
		code = store_volume_damaged(volume->name, "its header", err);
	else
		code = 0;
	voxels.end = voxels.seal.count > 0 ? voxels.seal.content : voxels.start + volume->bytes;
	/* The file is of a version that wrote no checksums, or they are damaged. */
	if (code == 0 && voxels.seal.count == 0 && (size_t)status.st_size != voxels.end)
		code = store_volume_damaged(volume->name, "its checksums are gone", err);
	if (code != 0)
		seal_clear(&voxels.seal);
	else
		*ret = voxels;
	return code;
}

/* Block by block, each held against its checksum: a digest is never made of damaged bytes. */
static int hash_voxels(int file, const char *name, const struct voxels *voxels, const _Atomic bool *stop,
		       EVP_MD_CTX *digest, struct error *err)
{
	char *block = malloc(SEAL_BLOCK);
	int code = block == NULL ? error_set_errno(err, ENOMEM, "digest") : 0, number = 0;

	for (size_t at = 0; at < voxels->end && code == 0; at += SEAL_BLOCK, number++) {
		size_t bytes = voxels->end - at < SEAL_BLOCK ? voxels->end - at : SEAL_BLOCK;
		size_t skip = voxels->start <= at ? 0 : voxels->start - at < bytes ? voxels->start - at : bytes;

		code = file_read_at(file, block, bytes, at, name, err);
		if (code == 0 && voxels->seal.count > 0 && checksum(0, block, bytes) != voxels->seal.blocks[number]) {
			char why[80];

			snprintf(why, sizeof(why), "block %d of %d does not fit its checksum", number,
				 voxels->seal.count);
			code = store_volume_damaged(name, why, err);
		}
		if (code == 0 && EVP_DigestUpdate(digest, block + skip, bytes - skip) != 1)
			code = error_set(err, ERR_INTERNAL, "SHA-256 failed");
		if (atomic_load(stop))
			code = error_set(err, ERR_CANCELLED, "the daemon stops");
	}
	free(block);
	return code;
}

static int hash_volume(const char *path, const struct volume_record *volume, const _Atomic bool *stop,
		       uint8_t ret_sha256[32], struct error *err)
{
	int file = regular_open(path, O_RDONLY, 0), code;
	struct voxels voxels = {.start = 0};
	EVP_MD_CTX *digest;
	uint8_t sha256[32];

	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	digest = EVP_MD_CTX_new();
	if (digest == NULL || EVP_DigestInit_ex(digest, EVP_sha256(), NULL) != 1)
		code = error_set_errno(err, ENOMEM, "digest");
	else
		code = find_voxels(file, path, volume, &voxels, err);
	if (code == 0)
		code = hash_voxels(file, volume->name, &voxels, stop, digest, err);
	if (code == 0 && EVP_DigestFinal_ex(digest, sha256, NULL) != 1)
		code = error_set(err, ERR_INTERNAL, "SHA-256 failed");
	EVP_MD_CTX_free(digest);
	seal_clear(&voxels.seal);
	close(file);
	if (code == 0)
		memcpy(ret_sha256, sha256, sizeof(sha256));
	return code;
}

/* What the slices in the middle show. The file has just been held against its checksums. */
static int measure_quality(const char *path, const struct volume_record *volume, double mu_water,
			   struct volume_quality *ret_quality, struct error *err)
{
	struct grid grid = volume->grid;
	const size_t slice = (size_t)grid.size[0] * (size_t)grid.size[1] * sizeof(float);
	int file = regular_open(path, O_RDONLY, 0), first, code;
	float *slices;
	size_t start;

	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	if (grid.size[2] > QUALITY_SLICES)
		grid.size[2] = QUALITY_SLICES;
	first = (volume->grid.size[2] - grid.size[2]) / 2;
	slices = malloc(slice * (size_t)grid.size[2]);
	code = slices == NULL ? error_set_errno(err, ENOMEM, "slices") : 0;
	if (code == 0)
		code = volume_own_start(file, path, &volume->grid, &start, err);
	if (code == 0)
		code =
		    file_read_at(file, slices, slice * (size_t)grid.size[2], start + slice * (size_t)first, path, err);
	if (code == 0)
		code = quality_of_slices(slices, &grid, mu_water, ret_quality, err);
	free(slices);
	close(file);
	return code;
}

static bool same_file(const char *a, const char *b)
{
	struct stat of_a, of_b;

	return stat(a, &of_a) == 0 && stat(b, &of_b) == 0 && of_a.st_dev == of_b.st_dev && of_a.st_ino == of_b.st_ino;
}

/* "final" may be another name of the file of a volume that has its digest. */
static bool copy_digest(struct store *store, const char *job, const struct volume_record *volumes, int count,
			struct volume_record *volume)
{
	char path[1024], other[1024];

	store_volume_path(store, job, volume->name, path);
	for (int i = 0; i < count; i++) {
		store_volume_path(store, job, volumes[i].name, other);
		if (volumes[i].hashed && same_file(path, other)) {
			memcpy(volume->sha256, volumes[i].sha256, sizeof(volume->sha256));
			volume->quality = volumes[i].quality;
			return true;
		}
	}
	return false;
}

static int make_digest(struct digester *digester, struct job *job, const struct volume_record *volumes, int count,
		       struct volume_record *volume, struct error *err)
{
	struct store *store = jobs_store(digester->jobs);
	struct job_facts facts;
	char path[1024];
	int code = 0;

	job_facts(job, &facts);
	store_volume_path(store, facts.id, volume->name, path);
	if (!copy_digest(store, facts.id, volumes, count, volume)) {
		code = hash_volume(path, volume, &digester->stop, volume->sha256, err);
		if (code == 0)
			code = measure_quality(path, volume, facts.mu_water, &volume->quality, err);
	}
	/* The volume was settled when it was announced; but it may have been made again since. */
	if (code == 0)
		code = durable_settle_named(path, err);
	if (code == 0)
		code = job_digest_volume(job, volume, err);
	volume->hashed = code == 0;
	/* It may have been made again because the disk had damaged it. */
	if (code == 0)
		job_volume_whole(job, volume->name);
	return code;
}

/* ---- the threads ---- */

/* The job began anew meanwhile, so that the volume is gone: rows go before their files. */
static bool is_void(struct store *store, const char *job, const struct volume_record *volume)
{
	struct volume_record *volumes = NULL;
	struct error ignored;
	int count = 0;
	bool there = store_job_volumes(store, job, &volumes, &count, &ignored) != 0;

	for (int i = 0; i < count && !there; i++)
		there = strcmp(volumes[i].name, volume->name) == 0;
	free(volumes);
	return !there;
}

/* Whether what failed is worth another try. */
static bool complain(struct job *job, const struct task *task, const struct error *err)
{
	struct job_facts facts;

	job_facts(job, &facts);
	if (err->code == ERR_CANCELLED || facts.removed)
		return false;
	if (err->code == ERR_SYNC) {
		/* A second sync would succeed, and mean nothing: the volume is made again after the next start. */
		store_distrust(jobs_store(job_jobs(job)), err);
		return false;
	}
	if (err->code == ERR_DAMAGED) {
		struct error ignored;

		log_line(LEVEL_ERROR, "job %s: %s", facts.id, err->text);
		job_add_warning(job, "damaged_volume", err->text, &ignored);
		return false;
	}
	log_line(LEVEL_ERROR, "job %s: a volume has no digest, tried again in %g s: %s", facts.id, task->retry,
		 err->text);
	return true;
}

/* False: to be done again. */
static bool carry_out(struct digester *digester, const struct task *task)
{
	struct volume_record *volumes = NULL;
	struct job *job;
	struct error err;
	int count = 0;
	bool again = false;

	if (jobs_find(digester->jobs, task->job, &job, &err) != 0)
		return true;
	if (store_job_volumes(jobs_store(digester->jobs), task->job, &volumes, &count, &err) != 0)
		again = complain(job, task, &err);
	for (int i = 0; i < count; i++) {
		if (volumes[i].hashed || (task->name[0] != '\0' && strcmp(task->name, volumes[i].name) != 0))
			continue;
		if (make_digest(digester, job, volumes, count, &volumes[i], &err) != 0 &&
		    (err.code != ERR_IO || !is_void(jobs_store(digester->jobs), task->job, &volumes[i])))
			again |= complain(job, task, &err);
	}
	free(volumes);
	job_release(job);
	return !again;
}

static void append(struct digester *digester, struct task *task)
{
	task->next = NULL;
	*digester->last = task;
	digester->last = &task->next;
	pthread_cond_signal(&digester->changed);
}

/* The first task that is due, or NULL after a sleep until one may be; holding the lock. */
static struct task *next_task(struct digester *digester)
{
	double at = clock_monotonic(), until = INFINITY;

	for (struct task **place = &digester->first; *place != NULL; place = &(*place)->next) {
		struct task *task = *place;

		if (task->due <= at) {
			*place = task->next;
			if (task->next == NULL)
				digester->last = place;
			return task;
		}
		until = fmin(until, task->due);
	}
	if (until == INFINITY) {
		pthread_cond_wait(&digester->changed, &digester->lock);
	} else {
		const struct timespec end = clock_timespec(until);

		pthread_cond_timedwait(&digester->changed, &digester->lock, &end);
	}
	return NULL;
}

static void *digest_loop(void *context)
{
	struct digester *digester = context;
	struct task *task;

	/* The priority is that of this thread alone; a failure is no trouble. */
	setpriority(PRIO_PROCESS, (id_t)gettid(), NICENESS);
	backend_host_threads(1); /* of this thread's own */
	pthread_mutex_lock(&digester->lock);
	while (!atomic_load(&digester->stop)) {
		bool done;

		task = next_task(digester);
		if (task == NULL)
			continue;
		pthread_mutex_unlock(&digester->lock);
		done = carry_out(digester, task);
		pthread_mutex_lock(&digester->lock);
		if (done) {
			free(task);
			continue;
		}
		task->due = clock_monotonic() + task->retry;
		task->retry = fmin(2 * task->retry, RETRY_LAST);
		append(digester, task);
	}
	pthread_mutex_unlock(&digester->lock);
	return NULL;
}

void digester_add(struct digester *digester, const char *job, const char *name)
{
	struct task *task = calloc(1, sizeof(*task));

	if (task == NULL) {
		log_line(LEVEL_ERROR, "job %s: no memory for the digest of a volume", job);
		return;
	}
	snprintf(task->job, sizeof(task->job), "%s", job);
	snprintf(task->name, sizeof(task->name), "%s", name == NULL ? "" : name);
	task->retry = RETRY_FIRST;
	pthread_mutex_lock(&digester->lock);
	append(digester, task);
	pthread_mutex_unlock(&digester->lock);
}

/* ---- start and stop ---- */

static void add_from_catalogue(void *context, const char *job)
{
	digester_add(context, job, NULL);
}

int digester_start(struct jobs *jobs, int threads, struct digester **ret_digester, struct error *err)
{
	struct digester *digester = calloc(1, sizeof(*digester) + (size_t)threads * sizeof(digester->threads[0]));
	pthread_condattr_t monotonic;
	int code;

	if (digester == NULL)
		return error_set_errno(err, ENOMEM, "digests");
	digester->jobs = jobs;
	digester->last = &digester->first;
	lock_init(&digester->lock, LOCK_DIGESTS);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&digester->changed, &monotonic);
	pthread_condattr_destroy(&monotonic);
	code = store_jobs_undigested(jobs_store(jobs), add_from_catalogue, digester, err);
	while (code == 0 && digester->count < threads) {
		code = pthread_create(&digester->threads[digester->count], NULL, digest_loop, digester);
		if (code == 0)
			digester->count++;
		else
			code = error_set_errno(err, code, "thread that makes digests");
	}
	if (code != 0)
		digester_stop(digester);
	else
		*ret_digester = digester;
	return code;
}

void digester_stop(struct digester *digester)
{
	struct task *task;

	if (digester == NULL)
		return;
	pthread_mutex_lock(&digester->lock);
	atomic_store(&digester->stop, true);
	pthread_cond_broadcast(&digester->changed);
	pthread_mutex_unlock(&digester->lock);
	for (int i = 0; i < digester->count; i++)
		pthread_join(digester->threads[i], NULL);
	while ((task = digester->first) != NULL) {
		digester->first = task->next;
		free(task);
	}
	pthread_cond_destroy(&digester->changed);
	pthread_mutex_destroy(&digester->lock);
	free(digester);
}

/*
 * Checkpoints that go from daemon to daemon, so that a job goes on where another host had it: job.h.
 *
 * Nothing is synced: the owner has a copy, and a worker that finds its checkpoint damaged begins the job anew.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/jobs/internal.h"
#include "proto/checkpoint.h"
#include "proto/regular.h"

#define GIVEN_FILE "checkpoint-given.tmp" /* while its pieces come; a temporary one that the next start removes */

int job_checkpoint_open(struct job *job, int *ret_file, int *ret_iteration, struct error *err)
{
	struct job_record record;
	char directory[1024];
	int code;

	job_record(job, &record);
	if (record.checkpoint == 0)
		return error_set(err, ERR_NOT_FOUND, "job %s has no checkpoint just now", job->id);
	store_job_directory(job->jobs->store, job->id, directory);
	code = checkpoint_open(directory, record.checkpoint, ret_file, err);
	if (code == 0)
		*ret_iteration = record.checkpoint;
	return code;
}

/* What has come of the checkpoint is in no count of bytes, so that the limits are asked for all of it. */
static int write_piece(const struct job *job, int file, long piece, const void *data, size_t length, struct error *err)
{
	const off_t first = (off_t)piece * CHECKPOINT_PIECE;
	struct stat status;
	ssize_t written;

	if (fstat(file, &status) < 0)
		return error_set_errno(err, errno, "checkpoint");
	if (status.st_size < first)
		return error_set(err, ERR_CONFLICT, "piece %ld came, expected is piece %lld", piece,
				 (long long)(status.st_size / CHECKPOINT_PIECE));
	if (store_check_bytes(job->jobs->store, job->record.client, (unsigned long long)first + length, err) != 0)
		return err->code;
	written = pwrite(file, data, length, first);
	if (written < 0 || (size_t)written < length)
		return error_set_errno(err, written < 0 ? errno : ENOSPC, "checkpoint");
	return ftruncate(file, first + (off_t)length) < 0 ? error_set_errno(err, errno, "checkpoint") : 0;
}

/* With jobs->change held. */
static int begin_with(struct job *job, int file, const char *given, const char *directory, struct error *err)
{
	struct jobs *jobs = job->jobs;
	struct job_record record;
	struct scan_facts facts;
	char path[1100];
	int code = store_scan_look(jobs->store, job->scan, &facts, err);

	if (code != 0)
		return code;
	if (checkpoint_iteration(file) != job->request.resume)
		return error_set(err, ERR_INVALID, "what came is no checkpoint of iteration %d", job->request.resume);
	snprintf(path, sizeof(path), "%s/%s", directory, CHECKPOINT_FILE);
	if (rename(given, path) < 0)
		return error_set_errno(err, errno, "checkpoint");
	job_record(job, &record);
	record.checkpoint = job->request.resume;
	record.basis = facts.basis;
	code = store_job_update(jobs->store, &record, NULL, NULL, PAST_STAYS, err);
	if (code != 0)
		return code;
	pthread_mutex_lock(&jobs->lock);
	job->record.checkpoint = record.checkpoint;
	job->record.basis = record.basis;
	pthread_mutex_unlock(&jobs->lock);
	return 0;
}

int job_checkpoint_take(struct job *job, long piece, const void *data, size_t length, struct error *err)
{
	const bool last = length < CHECKPOINT_PIECE;
	char directory[1024], given[1100];
	int file = -1, code = 0;

	store_job_directory(job->jobs->store, job->id, directory);
	snprintf(given, sizeof(given), "%s/%s", directory, GIVEN_FILE);
	pthread_mutex_lock(&job->jobs->change);
	if (job_obstacle(job) != JOB_NO_CHECKPOINT)
		code = error_set(err, ERR_CONFLICT, "job %s waits for no checkpoint", job->id);
	if (code == 0)
		code = directory_make(directory, err);
	if (code == 0) {
		file = regular_open(given, O_RDWR | O_CREAT, 0640);
		code = file < 0 ? error_set_errno(err, errno, "checkpoint")
				: write_piece(job, file, piece, data, length, err);
	}
	if (code == 0 && last)
		code = begin_with(job, file, given, directory, err);
	if (file >= 0)
		close(file);
	pthread_mutex_unlock(&job->jobs->change);
	if (code == 0 && last)
		job_wake(job);
	return code;
}

/* A checkpoint of a job that another daemon computes: remote.h. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/remote.h"
#include "core/pulse.h"
#include "proto/checkpoint.h"
#include "proto/clock.h"

enum { SYNC_BYTES = 32 << 20 }; /* that a disk takes in one step */
static const double SHARE = 10; /* fetching takes at most one part in so many of the time */

struct fetching {
	struct durable *file;
	size_t unsynced; /* bytes */
	struct error err;
};

static bool take(void *context, const void *data, size_t length)
{
	struct fetching *fetching = context;

	pulse_beat();
	if (durable_write(fetching->file, data, length, &fetching->err) != 0)
		return false;
	fetching->unsynced += length;
	if (fetching->unsynced < SYNC_BYTES)
		return true;
	fetching->unsynced = 0;
	if (fdatasync(fetching->file->file) == 0)
		return true;
	error_set_errno(&fetching->err, errno, "checkpoint");
	return false;
}

/* The iteration of the other daemon's checkpoint, by its first line; 0: it has none. */
static int iteration_there(struct http *http, const char *path)
{
	const struct http_request request = {.method = "GET", .path = path, .headers = {"Range: bytes=0-159"}};
	struct http_reply reply = {0};
	struct error ignored;
	int iteration = 0;

	if (http_send(http, &request, &reply, &ignored) != 0 ||
	    sscanf(reply.body, "cbctd checkpoint %d of", &iteration) != 1)
		iteration = 0;
	http_reply_clear(&reply);
	return iteration;
}

static int fetch(struct http *http, const char *path, const struct message *start, struct remote_checkpoint *checkpoint,
		 struct error *err)
{
	const size_t least = grid_voxels(&start->request.recipe.grid) * sizeof(float);
	struct fetching fetching = {.file = &checkpoint->file};
	const struct http_request request = {.method = "GET", .path = path, .write = take, .context = &fetching};
	struct http_reply reply = {0};
	int code;

	snprintf(checkpoint->path, sizeof(checkpoint->path), "%s/%s", start->job_directory, CHECKPOINT_FILE);
	code = durable_open(&checkpoint->file, checkpoint->path, least, err);
	if (code != 0)
		return code;
	code = http_send(http, &request, &reply, err);
	http_reply_clear(&reply);
	if (code == 0)
		code = checkpoint_check(checkpoint->file.file, err);
	if (code == 0)
		checkpoint->pending = checkpoint_iteration(checkpoint->file.file);
	if (checkpoint->pending <= checkpoint->iteration) {
		checkpoint->pending = 0;
		durable_abandon(&checkpoint->file);
	}
	return code;
}

void remote_fetch_checkpoint(struct http *http, const char *job, const struct message *start,
			     struct remote_checkpoint *checkpoint)
{
	const double began = clock_monotonic();
	struct error ignored;
	double pause;
	char path[120];

	if (checkpoint->pending > 0 || start->checkpoint_seconds <= 0 || began < checkpoint->due)
		return;
	snprintf(path, sizeof(path), "/v1/jobs/%.63s/checkpoint", job);
	if (iteration_there(http, path) > checkpoint->iteration)
		fetch(http, path, start, checkpoint, &ignored);
	pause = SHARE * (clock_monotonic() - began);
	checkpoint->due = clock_monotonic() + (pause > start->checkpoint_seconds ? pause : start->checkpoint_seconds);
}

int remote_keep_checkpoint(struct remote_checkpoint *checkpoint, struct error *err)
{
	char before[1120];
	int code;

	snprintf(before, sizeof(before), "%.*s%s", (int)(strrchr(checkpoint->path, '/') + 1 - checkpoint->path),
		 checkpoint->path, CHECKPOINT_FILE_BEFORE);
	if (rename(checkpoint->path, before) != 0 && errno != ENOENT) {
		code = error_set_errno(err, errno, "checkpoint");
		durable_abandon(&checkpoint->file);
	} else {
		code = durable_commit(&checkpoint->file, err);
	}
	if (code == 0)
		checkpoint->iteration = checkpoint->pending;
	checkpoint->pending = 0;
	return code;
}

void remote_drop_checkpoint(struct remote_checkpoint *checkpoint)
{
	if (checkpoint->pending > 0)
		durable_abandon(&checkpoint->file);
	checkpoint->pending = 0;
}

/* What becomes of a job that another daemon computes: remote_internal.h. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "clients/cbct/remote_internal.h"
#include "proto/calibration_files.h"
#include "proto/clock.h"
#include "proto/json.h"
#include "proto/refinement.h"

static const double LOOK = 0.1; /* s between two looks at the job there */

static int choice_of(const char *text, const char *const *names, int count)
{
	for (int i = 0; i < count; i++) {
		if (strcmp(text, names[i]) == 0)
			return i;
	}
	return 0;
}

static int tell_rows(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *history = cJSON_GetObjectItemCaseSensitive(job, "history"), *row;
	int index = 0, code = 0;

	cJSON_ArrayForEach(row, history)
	{
		struct message message = {.kind = MESSAGE_ROW};

		/* One that begins anew there repeats what was told. */
		if (index++ < remote->rows || member_number(row, "iteration", 0) <= remote->iteration)
			continue;
		message.row = (struct history_row){.iteration = (int)member_number(row, "iteration", 0),
						   .residual = member_number(row, "residual", NAN),
						   .change = member_number(row, "change", NAN),
						   .tv = member_number(row, "tv", NAN),
						   .seconds = member_number(row, "seconds", 0)};
		code = remote_tell(remote, &message, err);
		if (code != 0)
			return code;
		remote->rows = index;
		remote->iteration = message.row.iteration;
	}
	return 0;
}

/* What was refined there is here before it is told. */
static int fetch_refinement(struct remote *remote, struct error *err)
{
	cJSON *document = NULL;
	char path[1200];
	int code;

	snprintf(path, sizeof(path), "/v1/jobs/%.63s/refinement", remote->job);
	code = remote_ask(remote, "GET", path, &document, err);
	if (code == 0)
		code = path_join(path, sizeof(path), remote->start->job_directory, REFINEMENT_FILE, "", err);
	if (code == 0)
		code = sealed_write(path, document, err);
	cJSON_Delete(document);
	return code;
}

static int tell_warnings(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *warnings = cJSON_GetObjectItemCaseSensitive(job, "warnings"), *warning;
	int index = 0, code = 0;

	cJSON_ArrayForEach(warning, warnings)
	{
		struct message message = {.kind = MESSAGE_WARNING};

		if (index++ < remote->warnings)
			continue;
		snprintf(message.code_name, sizeof(message.code_name), "%s", member_text(warning, "code", ""));
		snprintf(message.text, sizeof(message.text), "%s", member_text(warning, "detail", ""));
		if (refined_told(message.code_name))
			code = fetch_refinement(remote, err);
		if (code == 0)
			code = remote_tell(remote, &message, err);
		if (code != 0)
			return code;
		remote->warnings = index;
	}
	return 0;
}

static int tell_plan(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *memory = cJSON_GetObjectItemCaseSensitive(job, "memory");
	struct message message = {.kind = MESSAGE_OPENED};

	if (remote->opened || member_text(job, "plan", NULL) == NULL || !cJSON_IsObject(memory))
		return 0;
	remote->opened = true;
	message.memory = (struct recon_memory){.projections = (size_t)member_number(memory, "projections", 0),
					       .volumes = (size_t)member_number(memory, "volumes", 0),
					       .scratch = (size_t)member_number(memory, "scratch", 0),
					       .total = (size_t)member_number(memory, "total", 0),
					       .host = (size_t)member_number(memory, "host", 0)};
	snprintf(message.plan, sizeof(message.plan), "%s", member_text(job, "plan", ""));
	return remote_tell(remote, &message, err);
}

static int tell_findings(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *denoising = cJSON_GetObjectItemCaseSensitive(job, "denoising");
	const cJSON *agreement = cJSON_GetObjectItemCaseSensitive(job, "geometry_agreement");
	const cJSON *stopped = cJSON_GetObjectItemCaseSensitive(job, "stopped");
	struct message noise = {.kind = MESSAGE_NOISE, .noise_hu = member_number(denoising, "noise_hu", 0)};
	struct message fit = {.kind = MESSAGE_AGREEMENT};
	struct message stop = {.kind = MESSAGE_STOPPED};
	int code = 0;

	fit.agreement = (struct recon_agreement){.views = (int)member_number(agreement, "views", 0),
						 .mm = member_number(agreement, "mm", 0),
						 .sigma_mm = member_number(agreement, "sigma_mm", 0),
						 .unexplained = member_number(agreement, "unexplained", 0)};
	noise.alpha = member_number(denoising, "alpha", 0);
	stop.stop = (struct recon_stop){
	    .rule = (enum stop_rule)choice_of(member_text(stopped, "rule", ""), stop_rule_names, STOP_RULE_COUNT),
	    .iteration = (int)member_number(stopped, "iteration", 0),
	    .residual = member_number(stopped, "residual", 0),
	    .change = member_number(stopped, "change", 0),
	    .noise = member_number(stopped, "noise", 0)};
	if (!remote->denoised && cJSON_IsObject(denoising)) {
		remote->denoised = true;
		code = remote_tell(remote, &noise, err);
	}
	if (code == 0 && !remote->agreed && cJSON_IsObject(agreement)) {
		remote->agreed = true;
		code = remote_tell(remote, &fit, err);
	}
	if (code == 0 && !remote->stopped && cJSON_IsObject(stopped)) {
		remote->stopped = true;
		code = remote_tell(remote, &stop, err);
	}
	return code;
}

static int tell_progress(struct remote *remote, const cJSON *job, struct error *err)
{
	struct message message = {
	    .kind = MESSAGE_PROGRESS,
	    .stage = (enum stage)choice_of(member_text(job, "stage", "load"), stage_names, STAGE_COUNT),
	    .iteration = (int)member_number(job, "iteration", 0),
	    .fraction = member_number(job, "progress", 0)};

	return member_text(job, "stage", NULL) == NULL ? 0 : remote_tell(remote, &message, err);
}

static bool is_fetched(const struct remote *remote, const char *name)
{
	for (int i = 0; i < remote->volumes; i++) {
		if (strcmp(remote->fetched[i], name) == 0)
			return true;
	}
	return false;
}

static int fetch(struct remote *remote, const cJSON *document, struct error *err)
{
	struct message volume, settled = {.kind = MESSAGE_SETTLED};
	bool done, here;
	int code;

	if (remote->volumes == REMOTE_VOLUMES_MOST)
		return error_set(err, ERR_IMPOSSIBLE, "more than %d volumes", REMOTE_VOLUMES_MOST);
	do {
		code = remote_fetch_volume(remote->http, remote->job, document, remote->start, &remote->source,
					   remote->saver, &volume, &here, err);
		if (code == 0 || !here)
			code = remote_judge(remote, code, err);
	} while (code > 0);
	if (code == 0)
		code = remote_tell(remote, &volume, err);
	if (code == 0)
		code = saver_finish(remote->saver, true, &done, err);
	snprintf(settled.name, sizeof(settled.name), "%s", volume.name);
	if (code == 0)
		code = remote_tell(remote, &settled, err);
	if (code == 0)
		snprintf(remote->fetched[remote->volumes++], sizeof(remote->fetched[0]), "%s", volume.name);
	return code;
}

/* Those with a digest. *ret_all: there is no other. */
static int fetch_volumes(struct remote *remote, bool *ret_all, struct error *err)
{
	cJSON *document = NULL;
	const cJSON *volume;
	char path[120];
	int code;

	*ret_all = true;
	snprintf(path, sizeof(path), "/v1/jobs/%.63s/volumes", remote->job);
	code = remote_ask(remote, "GET", path, &document, err);
	cJSON_ArrayForEach(volume, cJSON_GetObjectItemCaseSensitive(document, "volumes"))
	{
		if (code != 0 || is_fetched(remote, member_text(volume, "name", "")))
			continue;
		if (member_text(volume, "digest", "")[0] == '\0')
			*ret_all = false;
		else
			code = fetch(remote, volume, err);
	}
	cJSON_Delete(document);
	return code;
}

static int failure_there(const struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *error = cJSON_GetObjectItemCaseSensitive(job, "error");

	return error_set(err, ERR_IMPOSSIBLE, "on %.60s it is %s: %.200s", remote->options->host,
			 member_text(job, "state", "lost"), member_text(error, "detail", "no reason was told"));
}

/* The pending checkpoint was made before the job was looked at: all before it is here when all that is there is. */
static int keep_checkpoint(struct remote *remote, struct error *err)
{
	struct message message = {.kind = MESSAGE_CHECKPOINT};
	int code;

	if (remote->checkpoint.pending == 0)
		return 0;
	code = remote_keep_checkpoint(&remote->checkpoint, err);
	message.iteration = remote->checkpoint.iteration;
	return code == 0 ? remote_tell(remote, &message, err) : code;
}

/* Whether a worker has it, and it waits for nothing but that. */
static bool waits_for_worker(const cJSON *job)
{
	const cJSON *list = cJSON_GetObjectItemCaseSensitive(job, "waiting_for");
	const char *only = cJSON_GetStringValue(cJSON_GetArrayItem(list, 0));

	return member_text(job, "stage", NULL) != NULL && cJSON_GetArraySize(list) == 1 && only != NULL &&
	       strcmp(only, "worker") == 0;
}

/*
 * A job that has been sent all that it needs, and still waits for something, or for somebody to take it in: something
 * was lost there. One whose worker is slower than the way waits for that one alone until it has come to the last.
 */
static int heed_waiting(struct remote *remote, const cJSON *job, bool waits, struct error *err)
{
	const bool attended = waits_for_worker(job);

	if (!waits || attended || remote->sent < remote->files.scan->count) {
		remote->waits = 0;
		return 0;
	}
	if (remote->waits == 0)
		remote->waits = clock_monotonic();
	return clock_monotonic() < remote->waits + remote->options->lease
		   ? 0
		   : error_set(err, ERR_BUSY, "on %.60s something of it was lost", remote->options->host);
}

int remote_follow(struct remote *remote, bool *ret_done, struct error *err)
{
	cJSON *job = NULL;
	const char *state;
	char path[100];
	bool all = true;
	int code;

	*ret_done = false;
	snprintf(path, sizeof(path), "/v1/jobs/%.63s", remote->job);
	code = remote_ask(remote, "GET", path, &job, err);
	state = member_text(job, "state", "");
	if (code == 0 && (strcmp(state, "failed") == 0 || strcmp(state, "cancelled") == 0))
		code = failure_there(remote, job, err);
	if (code == 0)
		code = tell_plan(remote, job, err);
	if (code == 0)
		code = tell_progress(remote, job, err);
	if (code == 0)
		code = tell_findings(remote, job, err);
	if (code == 0)
		code = tell_rows(remote, job, err);
	if (code == 0)
		code = tell_warnings(remote, job, err);
	/* Before its last projection was sent nobody can say what a volume must have been made from. */
	if (code == 0 && remote->source.projections[0] != '\0' && member_number(job, "volumes", 0) > remote->volumes)
		code = fetch_volumes(remote, &all, err);
	if (code == 0 && all)
		code = keep_checkpoint(remote, err);
	if (code == 0)
		code = heed_waiting(remote, job, strcmp(state, "waiting") == 0, err);
	if (code == 0 && strcmp(state, "running") == 0)
		remote_fetch_checkpoint(remote->http, remote->job, remote->start, &remote->checkpoint);
	*ret_done = code == 0 && all && strcmp(state, "succeeded") == 0 && remote->volumes > 0;
	cJSON_Delete(job);
	remote->look = clock_monotonic() + LOOK;
	return code;
}

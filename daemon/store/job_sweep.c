/* Jobs at the start: their rows are held against their directories. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/internal.h"
#include "daemon/store/quarantine.h"

/* The numbers of removed jobs' events count, too: a client may have seen them. */
int store_load_last_event(struct store *store, struct error *err)
{
	long long number;
	int code = catalogue_last_event(store->catalogue, &number, err);

	if (code == 0)
		atomic_store(&store->last_event, number);
	return code;
}

/*
 * Removes volumes that were announced and may not be whole on the disk: their job was not
 * through with them. A checkpoint may be of a later iteration than the catalogue
 * knows: a run that went on from there would not make them again.
 */
static int remove_unsettled(struct store *store, const char *id, struct volume_record *volumes, int *count,
			    struct error *err)
{
	int kept = 0, code = 0;
	char path[1024];

	for (int i = 0; i < *count && code == 0; i++) {
		if (volumes[i].hashed) {
			volumes[kept++] = volumes[i];
			continue;
		}
		log_line(LEVEL_INFO, "job %s: its volume %s had not reached the disk, it is made again", id,
			 volumes[i].name);
		code = store_job_remove_volume(store, id, volumes[i].name, err);
		store_volume_path(store, id, volumes[i].name, path);
		if (code == 0)
			unlink(path);
	}
	if (code == 0 && kept < *count)
		store_job_remove_checkpoint(store, id);
	*count = kept;
	return code;
}

struct sweep {
	struct store *store;
	const struct job_record *jobs; /* [job_count], by id */
	int job_count;
	const char *id; /* of the job whose directory is looked at, as all that follows */
	struct volume_record *volumes;
	int count;
	bool ended; /* else it makes the volumes that have no row again */
};

static bool has_row(const struct sweep *sweep, const char *name, size_t length)
{
	for (int i = 0; i < sweep->count; i++) {
		if (strlen(sweep->volumes[i].name) == length && strncmp(sweep->volumes[i].name, name, length) == 0)
			return true;
	}
	return false;
}

/* Half-written files go. A volume without a row is set aside, unless the job makes it again over it. */
static int sweep_file(void *context, const char *name, struct error *err)
{
	const struct sweep *sweep = context;
	const char *extension = strrchr(name, '.');
	char directory[1024], path[1400];

	if (!name_is_temporary(name)) {
		if (extension == NULL || strcmp(extension, ".nii") != 0 || !sweep->ended ||
		    has_row(sweep, name, (size_t)(extension - name)))
			return 0;
		snprintf(path, sizeof(path), "jobs/%s/%s", sweep->id, name);
		return quarantine_move(sweep->store->directory, path, "the catalogue does not know this volume", err);
	}
	store_job_directory(sweep->store, sweep->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, name);
	if (unlink(path) < 0)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

/* A damaged volume is a warning of its job; where that fails, a request for the volume says so. */
static void warn(const struct sweep *sweep, const char *damage)
{
	struct warning_record warning = {.detail = ""};
	struct event event = {.kind = "warning"};
	cJSON *document;
	struct error err;
	bool new;

	log_line(LEVEL_ERROR, "job %s: %s", sweep->id, damage);
	snprintf(warning.code, sizeof(warning.code), "%s", damage_code);
	snprintf(warning.detail, sizeof(warning.detail), "%s", damage);
	document = json_warning(warning.code, warning.detail);
	event.data = json_print(document, NULL);
	cJSON_Delete(document);
	if (event.data == NULL)
		return;
	if (store_job_add_warning(sweep->store, sweep->id, &warning, &event, &new, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: a warning cannot be written: %s", sweep->id, err.text);
	free(event.data);
}

/* Somebody may have put the good file of a volume back that a warning calls damaged. */
static void check_damaged(const struct sweep *sweep, const struct volume_record *volume)
{
	struct error err;
	bool gone;
	int code = store_volume_verify(sweep->store, sweep->id, volume, 0, volume->bytes, &err);

	if (code == ERR_DAMAGED)
		warn(sweep, err.text);
	if (code == 0)
		code = store_job_volume_whole(sweep->store, sweep->id, volume->name, &gone, &err);
	if (code != 0 && code != ERR_DAMAGED)
		log_line(LEVEL_WARNING, "job %s: the warning of its volume %s stays: %s", sweep->id, volume->name,
			 err.text);
}

static int check_volumes(const struct sweep *sweep, struct error *err)
{
	struct warning_record *warnings;
	int count;

	if (store_job_warnings(sweep->store, sweep->id, &warnings, &count, err) != 0)
		return err->code;
	for (int i = 0; i < sweep->count; i++) {
		const struct volume_record *volume = &sweep->volumes[i];
		struct error damage;
		char path[1024];

		store_volume_path(sweep->store, sweep->id, volume->name, path);
		if (access(path, F_OK) != 0 && errno == ENOENT) {
			store_volume_gone(volume, &damage);
			warn(sweep, damage.text);
		} else if (damage_told_of(warnings, count, volume->name)) {
			check_damaged(sweep, volume);
		}
	}
	free(warnings);
	return 0;
}

static int compare_id(const void *id, const void *job)
{
	return strcmp(id, ((const struct job_record *)job)->id);
}

/* Directories that are no job's are passed over. */
static int sweep_directory(void *context, const char *name, struct error *err)
{
	const struct sweep *all = context;
	const struct job_record *job =
	    all->job_count == 0 ? NULL
				: bsearch(name, all->jobs, (size_t)all->job_count, sizeof(*all->jobs), compare_id);
	struct sweep sweep = {.store = all->store, .id = name};
	enum job_state state;
	char path[1024];
	int code;

	if (job == NULL)
		return 0;
	state = job->state;
	store_job_directory(sweep.store, name, path);
	sweep.ended = state == JOB_SUCCEEDED || state == JOB_FAILED || state == JOB_CANCELLED;
	if (sweep.ended) /* the daemon may have died before it was through with this */
		store_job_remove_reached(sweep.store, name);
	code = store_job_volumes(sweep.store, name, &sweep.volumes, &sweep.count, err);
	if (code != 0)
		return code;
	if (state == JOB_WAITING || state == JOB_RUNNING) /* a worker has it, or had it */
		code = remove_unsettled(sweep.store, name, sweep.volumes, &sweep.count, err);
	if (code == 0)
		code = check_volumes(&sweep, err);
	if (code == 0)
		code = directory_visit(path, sweep_file, &sweep, err);
	free(sweep.volumes);
	return code;
}

int store_sweep_jobs(struct store *store, struct error *err)
{
	struct sweep sweep = {.store = store};
	struct job_record *jobs = NULL;
	char path[1024];
	int ended, code = catalogue_list(store->catalogue, NULL, &jobs, &sweep.job_count, err);

	/* All rows are read as of one moment, which saves a start with many jobs much time: none changes before it is
	 * read. */
	if (code == 0)
		code = catalogue_freeze(store->catalogue, true, err);
	if (code == 0) {
		sweep.jobs = jobs;
		snprintf(path, sizeof(path), "%s/jobs", store->directory);
		code = directory_visit(path, sweep_directory, &sweep, err);
		/* Who goes on with what was frozen never sees what is written after it. */
		ended = catalogue_freeze(store->catalogue, false, code == 0 ? err : &(struct error){0});
		if (code == 0)
			code = ended;
	}
	job_records_free(jobs, sweep.job_count);
	return code;
}

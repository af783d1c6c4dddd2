/* Jobs, their history, volumes, warnings and events: groups of the catalogue, with the files that belong to them. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/internal.h"
#include "daemon/store/deleted.h"
#include "daemon/store/record.h"
#include "proto/checkpoint.h"
#include "proto/clock.h"
#include "proto/refining_file.h"

const char *const job_state_names[JOB_STATE_COUNT] = {"waiting",   "queued", "running",
						      "succeeded", "failed", "cancelled"};

const char *const sending_state_names[SENDING_STATE_COUNT] = {"waiting",   "queued", "sending", "sent",
							      "committed", "failed", "stopped"};

void store_job_directory(const struct store *store, const char *id, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/jobs/%s", store->directory, id);
}

void store_volume_path(const struct store *store, const char *id, const char *name, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/jobs/%s/%s.nii", store->directory, id, name);
}

void job_record_clear(struct job_record *job)
{
	free(job->request);
	free(job->key);
	free(job->subject);
	job->request = job->key = job->subject = NULL;
}

void job_records_free(struct job_record *jobs, int count)
{
	for (int i = 0; i < count; i++)
		job_record_clear(&jobs[i]);
	free(jobs);
}

/* ---- writing ---- */

static int add_event(struct store *store, const char *id, const struct event *event, struct error *err)
{
	struct catalogue_event row;
	long long number = 0;
	int code;

	if (event == NULL)
		return 0;
	row = (struct catalogue_event){
	    .created = clock_realtime(), .kind = event->kind, .data = event->data, .once = event->once};
	code = catalogue_put(store->catalogue, id, &row, &number, err);
	if (code == 0 && number != 0)
		store->event_written = number;
	return code;
}

/*
 * Ends a group that changed rows of the job's record: the record is written first. It is synced where a client has or
 * will have an acknowledgement; after a power cut any other record is written again from the rows.
 */
static int end_with_record(struct store *store, const char *id, bool synced, int code, struct error *err)
{
	bool written = code == 0;

	if (code == 0)
		code = record_write(store, RECORD_JOB, id, synced, err);
	code = store_end(store, code, err);
	if (code != 0 && written)
		record_undo(store, RECORD_JOB, id);
	return code;
}

int store_job_insert(struct store *store, const struct job_record *job, const struct sending_record *sendings,
		     int count, const struct event *event, struct error *err)
{
	char directory[1024];
	int code;

	store_job_directory(store, job->id, directory);
	/*
	 * Its name is synced for itself: that of the record below, in a directory whose name is lost, would keep
	 * nothing where a file system does not sync the names on the way to a file with it, as the journals of ext4 and
	 * XFS do.
	 */
	code = directory_make(directory, err);
	if (code == 0)
		code = store_begin(store, err);
	if (code != 0) {
		rmdir(directory);
		return code;
	}
	code = catalogue_put(store->catalogue, NULL, job, NULL, err);
	for (int i = 0; i < count && code == 0; i++)
		code = catalogue_put(store->catalogue, job->id, &sendings[i], NULL, err);
	if (code == 0)
		code = add_event(store, job->id, event, err);
	code = end_with_record(store, job->id, true, code, err);
	if (code != 0)
		rmdir(directory); /* empty but for a record that could not be taken back: then the next start sees to it
				   */
	return code;
}

int store_job_update(struct store *store, const struct job_record *job, const struct event *event,
		     const struct event *end, enum job_past past, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	code = catalogue_update_job(store->catalogue, job, past, err);
	if (code == 0)
		code = add_event(store, job->id, event, err);
	if (code == 0)
		code = add_event(store, job->id, end, err);
	return end_with_record(store, job->id, job->cancel_asked || job->ended != 0, code, err);
}

/* Takes a number from the job's own events, which go with it. */
static int note_removal(struct store *store, const char *id, struct error *err)
{
	struct event event = {.kind = "removed", .data = (char[]){"{}"}};
	struct catalogue_removal removal = {.number = 0};

	if (add_event(store, id, &event, err) != 0)
		return err->code;
	removal.number = store->event_written;
	snprintf(removal.job, sizeof(removal.job), "%s", id);
	return catalogue_put(store->catalogue, NULL, &removal, NULL, err);
}

int store_job_delete(struct store *store, const char *id, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	code = store_note_deletion(store, DELETED_JOB, id, err);
	if (code != 0)
		return store_end(store, code, err);
	code = note_removal(store, id, err);
	if (code == 0)
		code = catalogue_remove(store->catalogue, RECORD_JOB, id, err);
	code = store_end(store, code, err);
	/* The job counts as deleted from its note on: its row goes at the next start, where it cannot now. */
	return code == ERR_NO_SPACE || code == ERR_AWAY ? 0 : code;
}

void store_job_remove_files(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_job_directory(store, id, directory);
	if (directory_remove(directory, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: files stay until the next start: %s", id, err.text);
	store_reserve_save(store);
}

static void remove_file(const struct store *store, const char *id, const char *name)
{
	char directory[1024], path[1100];

	store_job_directory(store, id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, name);
	if (unlink(path) < 0 && errno != ENOENT && errno != ENOTDIR)
		log_line(LEVEL_WARNING, "job %s: %s stays: %s", id, path, strerror(errno));
}

void store_job_remove_checkpoint(const struct store *store, const char *id)
{
	remove_file(store, id, CHECKPOINT_FILE);
	remove_file(store, id, CHECKPOINT_FILE_BEFORE);
}

void store_job_remove_reached(const struct store *store, const char *id)
{
	store_job_remove_checkpoint(store, id);
	remove_file(store, id, REFINING_FILE);
}

static int remove_volume(void *context, const char *name, struct error *err)
{
	const char *extension = strrchr(name, '.');
	char path[1400];

	snprintf(path, sizeof(path), "%s/%s", (const char *)context, name);
	if (extension != NULL && strcmp(extension, ".nii") == 0 && unlink(path) < 0 && errno != ENOENT)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

void store_job_remove_volumes(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_job_directory(store, id, directory);
	if (directory_visit(directory, remove_volume, directory, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: volumes that are void are still there: %s", id, err.text);
}

static int remove_temporary(void *context, const char *name, struct error *err)
{
	char path[1400];

	/* A record is written whenever a digest is known. */
	if (!name_is_temporary(name) || strncmp(name, RECORD_FILE, strlen(RECORD_FILE)) == 0)
		return 0;
	snprintf(path, sizeof(path), "%s/%s", (const char *)context, name);
	if (unlink(path) < 0 && errno != ENOENT)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

void store_job_tidy(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_job_remove_reached(store, id);
	store_job_directory(store, id, directory);
	if (directory_visit(directory, remove_temporary, directory, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: half-written files stay until the next start: %s", id, err.text);
}

int store_job_add_rows(struct store *store, const char *id, const struct history_row *rows, const struct event *events,
		       int count, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		code = catalogue_put(store->catalogue, id, &rows[i], NULL, err);
		if (code == 0)
			code = add_event(store, id, &events[i], err);
	}
	return store_end(store, code, err);
}

int store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
			 const struct event *event, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	/* A job that starts again keeps its volumes again: the later one is what the file holds. */
	code = catalogue_put(store->catalogue, id, volume, NULL, err);
	if (code == 0)
		code = add_event(store, id, event, err);
	return store_end(store, code, err);
}

int store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	return end_with_record(store, id, false, catalogue_set_digest(store->catalogue, id, volume, err), err);
}

int store_job_remove_volume(struct store *store, const char *id, const char *name, struct error *err)
{
	struct volume_record volume = {.hashed = false};
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	snprintf(volume.name, sizeof(volume.name), "%s", name);
	return end_with_record(store, id, false, catalogue_take(store->catalogue, id, &volume, err), err);
}

int store_job_add_warning(struct store *store, const char *id, const struct warning_record *warning,
			  const struct event *event, bool *ret_new, struct error *err)
{
	char beginning[DAMAGE_SIZE];
	long long new = 0;
	int gone = 0, code = store_begin(store, err);

	if (code != 0)
		return code;
	if (damage_told(warning, beginning))
		code = catalogue_take_warnings(store->catalogue, id, beginning, warning, &gone, err);
	if (code == 0)
		code = catalogue_put(store->catalogue, id, warning, &new, err);
	if (code == 0 && new != 0)
		code = add_event(store, id, event, err);
	code = new != 0 || gone != 0 ? end_with_record(store, id, false, code, err) : store_end(store, code, err);
	if (code == 0)
		*ret_new = new != 0;
	return code;
}

int store_job_volume_whole(struct store *store, const char *id, const char *volume, bool *ret_gone, struct error *err)
{
	struct warning_record none = {.detail = ""}, *warnings;
	char beginning[DAMAGE_SIZE];
	int count, gone = 0, code = store_job_warnings(store, id, &warnings, &count, err);
	bool told;

	if (code != 0)
		return code;
	/* Whole volumes are read often: only a warning that is there is worth a group. */
	told = damage_told_of(warnings, count, volume);
	free(warnings);
	if (told)
		code = store_begin(store, err);
	if (told && code == 0) {
		snprintf(none.code, sizeof(none.code), "%s", damage_code);
		damage_beginning(volume, beginning);
		code = catalogue_take_warnings(store->catalogue, id, beginning, &none, &gone, err);
		code = end_with_record(store, id, false, code, err);
	}
	if (code == 0)
		*ret_gone = gone != 0;
	return code;
}

int store_job_put_sendings(struct store *store, const char *id, const struct sending_record *sendings,
			   const struct event *events, int count, const char *taken, struct error *err)
{
	struct sending_record gone = {.name = ""};
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	if (taken != NULL) {
		snprintf(gone.name, sizeof(gone.name), "%s", taken);
		code = catalogue_take(store->catalogue, id, &gone, err);
	}
	for (int i = 0; i < count && code == 0; i++) {
		code = catalogue_put(store->catalogue, id, &sendings[i], NULL, err);
		if (code == 0)
			code = add_event(store, id, &events[i], err);
	}
	return end_with_record(store, id, true, code, err);
}

int store_job_annotated(struct store *store, const char *id, const struct event *event, struct error *err)
{
	const struct job_record job = {.annotated = true};
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	code = catalogue_set(store->catalogue, id, &job, &job.annotated, err);
	if (code == 0)
		code = add_event(store, id, event, err);
	return end_with_record(store, id, true, code, err);
}

/* ---- reading ---- */

int store_job_load(struct store *store, struct job_record **ret_jobs, int *ret_count, struct error *err)
{
	return catalogue_list(store->catalogue, NULL, ret_jobs, ret_count, err);
}

int store_job_rows(struct store *store, const char *id, struct history_row **ret_rows, int *ret_count,
		   struct error *err)
{
	return catalogue_list(store->catalogue, id, ret_rows, ret_count, err);
}

int store_job_volumes(struct store *store, const char *id, struct volume_record **ret_volumes, int *ret_count,
		      struct error *err)
{
	return catalogue_list(store->catalogue, id, ret_volumes, ret_count, err);
}

int store_job_warnings(struct store *store, const char *id, struct warning_record **ret_warnings, int *ret_count,
		       struct error *err)
{
	return catalogue_list(store->catalogue, id, ret_warnings, ret_count, err);
}

int store_job_sendings(struct store *store, const char *id, struct sending_record **ret_sendings, int *ret_count,
		       struct error *err)
{
	return catalogue_list(store->catalogue, id, ret_sendings, ret_count, err);
}

int store_jobs_unsent(struct store *store, void (*visit)(void *context, const char *id), void *context,
		      struct error *err)
{
	return catalogue_unsent(store->catalogue, visit, context, err);
}

int store_jobs_undigested(struct store *store, void (*visit)(void *context, const char *id), void *context,
			  struct error *err)
{
	return catalogue_undigested(store->catalogue, visit, context, err);
}

void event_records_free(struct event_record *events, int count)
{
	for (int i = 0; i < count; i++)
		free(events[i].data);
	free(events);
}

int store_job_events(struct store *store, const char *id, long long after, int limit, struct event_record **ret_events,
		     int *ret_count, struct error *err)
{
	return catalogue_events(store->catalogue, id, after, limit, ret_events, ret_count, err);
}

long long store_last_event(const struct store *store)
{
	return atomic_load(&store->last_event);
}

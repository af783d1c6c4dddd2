/* The calibrations that there are: read at the start, posted, deleted, shown. calibrations.h. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "daemon/calibrations/internal.h"
#include "daemon/files.h"
#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/calibration.h"
#include "proto/clock.h"

enum { ARM_MOST = 255 }; /* characters */

void calibration_path(const struct calibrations *calibrations, const char *id, const char *file, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/calibrations/%s%s%s", store_directory(calibrations->store), id,
		 file[0] != '\0' ? "/" : "", file);
}

/* The place of an id among the entries, or where it would stand; the lock is held. */
static int place_of(const struct calibrations *calibrations, const char *id)
{
	int low = 0, high = calibrations->count;

	while (low < high) {
		const int middle = low + (high - low) / 2;

		if (strcmp(calibrations->entries[middle].id, id) < 0)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

struct entry *calibration_entry(struct calibrations *calibrations, const char *id)
{
	const int place = place_of(calibrations, id);

	return place < calibrations->count && strcmp(calibrations->entries[place].id, id) == 0
		   ? &calibrations->entries[place]
		   : NULL;
}

static int no_such(const char *id, struct error *err)
{
	return error_set(err, ERR_NOT_FOUND, "there is no calibration \"%.64s\"", id);
}

/* Takes entry->brief on success. */
static int insert(struct calibrations *calibrations, const struct entry *entry, struct error *err)
{
	int place, code = 0;

	pthread_mutex_lock(&calibrations->lock);
	if (calibrations->count == calibrations->space) {
		const int space = calibrations->space == 0 ? 16 : 2 * calibrations->space;
		struct entry *entries = realloc(calibrations->entries, (size_t)space * sizeof(*entries));

		if (entries == NULL)
			code = error_set_errno(err, ENOMEM, "list of calibrations");
		else {
			calibrations->entries = entries;
			calibrations->space = space;
		}
	}
	if (code == 0) {
		place = place_of(calibrations, entry->id);
		memmove(calibrations->entries + place + 1, calibrations->entries + place,
			(size_t)(calibrations->count - place) * sizeof(*entry));
		calibrations->entries[place] = *entry;
		calibrations->count++;
	}
	pthread_mutex_unlock(&calibrations->lock);
	return code;
}

/* ---- limits ---- */

static bool is_of(const struct entry *entry, const char *client)
{
	return client == NULL || strcmp(entry->client, client) == 0;
}

static unsigned long long bytes_of(void *context, const char *client)
{
	struct calibrations *calibrations = context;
	unsigned long long sum = 0;

	pthread_mutex_lock(&calibrations->lock);
	for (int i = 0; i < calibrations->count; i++)
		sum += is_of(&calibrations->entries[i], client) ? calibrations->entries[i].bytes : 0;
	pthread_mutex_unlock(&calibrations->lock);
	return sum;
}

static bool has_ended(const struct entry *entry)
{
	return entry->state == CALIBRATION_SUCCEEDED || entry->state == CALIBRATION_FAILED;
}

static long unended_of(void *context, const char *client)
{
	struct calibrations *calibrations = context;
	long count = 0;

	pthread_mutex_lock(&calibrations->lock);
	for (int i = 0; i < calibrations->count; i++)
		count += is_of(&calibrations->entries[i], client) && !has_ended(&calibrations->entries[i]);
	pthread_mutex_unlock(&calibrations->lock);
	return count;
}

void calibrations_expire(struct calibrations *calibrations, double before)
{
	char id[ID_SIZE];
	struct error err;
	bool found;

	do {
		found = false;
		pthread_mutex_lock(&calibrations->lock);
		for (int i = 0; i < calibrations->count && !found; i++) {
			const struct entry *entry = &calibrations->entries[i];

			found = entry->state == CALIBRATION_FAILED && entry->ended > 0 && entry->ended < before;
			if (found)
				memcpy(id, entry->id, sizeof(id));
		}
		pthread_mutex_unlock(&calibrations->lock);
		if (found && calibrations_delete(calibrations, id, &err) != 0) {
			log_line(LEVEL_WARNING, "calibration %s stays: %s", id, err.text);
			return;
		}
	} while (found);
}

/* ---- the start ---- */

/* A deletion that was under way is completed, a half-made directory goes; what cannot be read is set aside. */
static int load_directory(void *context, const char *name, struct error *err)
{
	struct calibrations *calibrations = context;
	char path[1024];
	struct entry entry;
	struct error why;
	int code;

	calibration_path(calibrations, name, "", path);
	if (name_is_temporary(name))
		return directory_remove(path, err);
	code = id_valid(name) ? calibration_load(calibrations, name, &entry, &why)
			      : error_set(&why, ERR_DAMAGED, "its name is none of a calibration");
	if (code == ERR_NO_MEMORY || code == ERR_IO) {
		*err = why;
		return code;
	}
	if (code != 0) {
		snprintf(path, sizeof(path), "calibrations/%s", name);
		return quarantine_move(store_directory(calibrations->store), path, why.text, err);
	}
	id_floor(name);
	return insert(calibrations, &entry, err);
}

int calibrations_open(struct store *store, const struct calibrations_options *options,
		      struct calibrations **ret_calibrations, struct error *err)
{
	struct calibrations *calibrations = calloc(1, sizeof(*calibrations));
	char path[1024];
	int code;

	if (calibrations == NULL)
		return error_set_errno(err, ENOMEM, "library of calibrations");
	calibrations->store = store;
	calibrations->threads = options->threads;
	calibrations->age = options->age;
	if (options->worker != NULL)
		snprintf(calibrations->worker, sizeof(calibrations->worker), "%s", options->worker);
	else
		worker_path(calibrations->worker, sizeof(calibrations->worker));
	lock_init(&calibrations->lock, LOCK_CALIBRATED);
	store_count(store, &(struct store_counter){bytes_of, unended_of, calibrations});
	watch_list_init(&calibrations->watchers);
	calibrations->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	code = calibrations->wake < 0 ? error_set_errno(err, errno, "library of calibrations") : 0;
	calibration_path(calibrations, "", "", path);
	if (code == 0)
		code = directory_make(path, err);
	if (code == 0)
		code = directory_visit(path, load_directory, calibrations, err);
	if (code == 0)
		code = calibrator_start(calibrations, err);
	if (code != 0) {
		calibrations_close(calibrations);
		return code;
	}
	*ret_calibrations = calibrations;
	return 0;
}

void calibrations_close(struct calibrations *calibrations)
{
	if (calibrations == NULL)
		return;
	calibrator_stop(calibrations);
	for (int i = 0; i < calibrations->count; i++)
		cJSON_Delete(calibrations->entries[i].brief);
	free(calibrations->entries);
	watch_list_destroy(&calibrations->watchers);
	pthread_mutex_destroy(&calibrations->lock);
	if (calibrations->wake >= 0)
		close(calibrations->wake);
	free(calibrations);
}

/* ---- POST ---- */

/* All projections, and air where there are intensities. */
static int check_scan(struct stored_scan *scan, struct error *err)
{
	struct scan_facts facts;

	stored_scan_facts(scan, &facts);
	if (facts.received < facts.count)
		return error_set_at(err, ERR_CONFLICT, "/scan",
				    "%d of the scan's %d projections are there, a calibration needs all of them",
				    facts.received, facts.count);
	if (!facts.convertible)
		return error_set_at(err, ERR_CONFLICT, "/scan",
				    "the scan has counts, and neither an air value nor a flat image: they are no line "
				    "integrals");
	return 0;
}

/* The members of the body, checked; `request` becomes request.json. */
static int read_body(const cJSON *body, char ret_scan[64], cJSON *request, struct error *err)
{
	char arm[TEXT_BYTES(ARM_MOST)] = "";
	struct json_reader reader;
	const cJSON *phantom;
	struct balls balls = {0};
	bool adjust = false;
	int code;

	json_begin(&reader, body, "", err);
	json_string(&reader, "scan", true, ret_scan, 64);
	json_text(&reader, "arm", false, ARM_MOST, arm);
	json_bool(&reader, "adjust_balls", false, &adjust);
	phantom = json_member(&reader, "phantom", true);
	code = json_end(&reader);
	if (code != 0)
		return code;
	code = balls_read(phantom, &balls, err);
	balls_clear(&balls);
	if (code != 0) {
		error_nest(err, "/phantom");
		return code;
	}
	cJSON_AddStringToObject(request, "scan", ret_scan);
	if (arm[0] != '\0')
		cJSON_AddStringToObject(request, "arm", arm);
	else
		cJSON_AddNullToObject(request, "arm");
	json_add(request, "phantom", cJSON_Duplicate(phantom, true));
	cJSON_AddBoolToObject(request, "adjust_balls", adjust);
	return 0;
}

static int add_scan(struct calibrations *calibrations, const char *id, cJSON *request, struct error *err)
{
	struct scan_facts facts;
	struct stored_scan *scan;
	int code = store_scan_find(calibrations->store, id, &scan, err);

	if (code == ERR_NOT_FOUND)
		snprintf(err->pointer, sizeof(err->pointer), "/scan");
	if (code != 0)
		return code;
	code = check_scan(scan, err);
	if (code == 0) {
		stored_scan_facts(scan, &facts);
		cJSON_AddNumberToObject(request, "created", clock_realtime());
		cJSON_AddNumberToObject(request, "acquired", facts.created);
		json_add(request, "sweep", cJSON_Duplicate(stored_scan_parsed(scan)->document, true));
	}
	stored_scan_release(scan);
	return code;
}

/* The directory under its name, with request.json and, where there is one, result.json; or nothing. */
static int make_directory(struct calibrations *calibrations, const char *id, const cJSON *request, const cJSON *result,
			  struct error *err)
{
	char name[ID_SIZE + 8], beside[1024], path[1024], parent[1024];
	int code;

	snprintf(name, sizeof(name), "%s.tmp", id);
	calibration_path(calibrations, name, "", beside);
	calibration_path(calibrations, id, "", path);
	calibration_path(calibrations, "", "", parent);
	code = directory_make(beside, err);
	if (code != 0)
		return code;
	calibration_path(calibrations, name, CALIBRATION_REQUEST, path);
	code = sealed_write(path, request, err);
	calibration_path(calibrations, name, CALIBRATION_RESULT, path);
	if (code == 0 && result != NULL)
		code = sealed_write(path, result, err);
	calibration_path(calibrations, id, "", path);
	if (code == 0 && rename(beside, path) != 0)
		code = error_set_errno(err, errno, "rename of %s", beside);
	if (code == 0)
		code = directory_sync(parent, err);
	if (code != 0) {
		struct error ignored;

		directory_remove(beside, &ignored);
		store_distrust(calibrations->store, err);
	}
	return code;
}

/* Within the client's limits it gets an id, its directory and its place in the list. */
static int take_up(struct calibrations *calibrations, const char *client, size_t bytes, const cJSON *request,
		   const cJSON *result, char ret_id[ID_SIZE], struct error *err)
{
	char id[ID_SIZE];
	struct entry entry;
	int code = store_check_bytes(calibrations->store, client, bytes, err);

	if (code == 0)
		code = id_make(id, err);
	if (code == 0)
		code = make_directory(calibrations, id, request, result, err);
	if (code == 0)
		code = calibration_load(calibrations, id, &entry, err);
	if (code == 0)
		code = insert(calibrations, &entry, err);
	if (code != 0)
		return code;
	watch_wake(&calibrations->watchers);
	memcpy(ret_id, id, sizeof(id));
	return 0;
}

int calibrations_post(struct calibrations *calibrations, const char *client, const cJSON *body, size_t length,
		      char ret_id[ID_SIZE], struct error *err)
{
	cJSON *request = cJSON_CreateObject();
	char scan[64] = "";
	int code = read_body(body, scan, request, err);

	if (code == 0)
		code = add_scan(calibrations, scan, request, err);
	cJSON_AddStringToObject(request, "client", client);
	if (code == 0)
		code = store_check_unended(calibrations->store, client, err);
	if (code == 0)
		code = take_up(calibrations, client, length, request, NULL, ret_id, err);
	cJSON_Delete(request);
	if (code == 0)
		calibrator_wake(calibrations);
	return code;
}

/* The sweep of the views that a refinement had, where the scan lacks others: their places as the scan has them. */
static int sweep_of_some(const struct scan *scan, const cJSON *refinement, cJSON **ret_sweep, struct error *err)
{
	const cJSON *list = cJSON_GetObjectItemCaseSensitive(refinement, "views"), *view;
	cJSON *sweep = cJSON_CreateObject(), *projections = cJSON_AddObjectToObject(sweep, "projections");
	struct view *views = malloc((size_t)scan->count * sizeof(*views));
	int count = 0, code = 0;

	if (views == NULL || projections == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", scan->count);
	cJSON_ArrayForEach(view, list)
	{
		const cJSON *projection = cJSON_GetObjectItemCaseSensitive(view, "projection");
		const int index = cJSON_IsNumber(projection) ? projection->valueint : -1;

		if (code == 0 && (index < 0 || index >= scan->count || count == scan->count))
			code = error_set(err, ERR_DAMAGED, "what was refined names projection %d of %d", index,
					 scan->count);
		if (code == 0)
			views[count++] = scan->geometry.views[index];
	}
	if (code == 0) {
		cJSON_AddNumberToObject(projections, "count", count);
		cJSON_AddStringToObject(projections, "sample", "float32");
		cJSON_AddStringToObject(projections, "quantity", "line_integral");
		json_add(sweep, "detector",
			 cJSON_Duplicate(cJSON_GetObjectItemCaseSensitive(scan->document, "detector"), true));
		json_add(sweep, "geometry", matrices_json(views, count));
		*ret_sweep = sweep;
	} else {
		cJSON_Delete(sweep);
	}
	free(views);
	return code;
}

/* Scan, sweep and times of a refinement. */
static int describe_kept(struct calibrations *calibrations, const struct calibration_kept *kept, cJSON *request,
			 struct error *err)
{
	const cJSON *geometry = cJSON_GetObjectItemCaseSensitive(kept->refinement, "geometry");
	const int views = cJSON_GetArraySize(cJSON_GetObjectItemCaseSensitive(geometry, "matrices"));
	struct scan_facts facts;
	struct stored_scan *scan;
	cJSON *sweep = NULL;
	int code = store_scan_find(calibrations->store, kept->scan, &scan, err);

	if (code == ERR_NOT_FOUND)
		return error_set_at(err, ERR_CONFLICT, "/job",
				    "the scan %s of this job has been deleted: its sweep is not known any more",
				    kept->scan);
	if (code != 0)
		return code;
	stored_scan_facts(scan, &facts);
	if (views != facts.count)
		code = sweep_of_some(stored_scan_parsed(scan), kept->refinement, &sweep, err);
	else
		sweep = cJSON_Duplicate(stored_scan_parsed(scan)->document, true);
	cJSON_AddStringToObject(request, "scan", kept->scan);
	cJSON_AddStringToObject(request, "job", kept->job);
	cJSON_AddBoolToObject(request, "adjust_balls", false);
	if (kept->arm[0] != '\0')
		cJSON_AddStringToObject(request, "arm", kept->arm);
	else
		cJSON_AddNullToObject(request, "arm");
	cJSON_AddNumberToObject(request, "created", clock_realtime());
	cJSON_AddNumberToObject(request, "acquired", facts.created);
	json_add(request, "sweep", sweep);
	stored_scan_release(scan);
	return code;
}

int calibrations_keep(struct calibrations *calibrations, const char *client, const struct calibration_kept *kept,
		      char ret_id[ID_SIZE], struct error *err)
{
	const cJSON *geometry = cJSON_GetObjectItemCaseSensitive(kept->refinement, "geometry");
	cJSON *request = cJSON_CreateObject(), *result = cJSON_CreateObject();
	char *text = NULL;
	size_t length = 0;
	int code = describe_kept(calibrations, kept, request, err);

	cJSON_AddStringToObject(request, "client", client);
	cJSON_AddTrueToObject(request, CALIBRATION_MADE);
	cJSON_AddNumberToObject(result, "ended", clock_realtime());
	cJSON_AddNullToObject(result, "error");
	json_add(result, "geometry", cJSON_Duplicate(geometry, true));
	if (code == 0) {
		text = json_print(result, &length);
		code = text == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a calibration")
				    : take_up(calibrations, client, length, request, result, ret_id, err);
	}
	free(text);
	cJSON_Delete(request);
	cJSON_Delete(result);
	return code;
}

/* ---- DELETE ---- */

/* Takes an entry out of the list: of two requests one gets it. */
static bool take_out(struct calibrations *calibrations, const char *id, struct entry *ret_entry)
{
	struct entry *entry;

	pthread_mutex_lock(&calibrations->lock);
	entry = calibration_entry(calibrations, id);
	if (entry != NULL) {
		*ret_entry = *entry;
		memmove(entry, entry + 1,
			(size_t)(calibrations->entries + --calibrations->count - entry) * sizeof(*entry));
	}
	pthread_mutex_unlock(&calibrations->lock);
	return entry != NULL;
}

/* The rename is the deletion; the next start removes what a crash leaves of the rest. */
int calibrations_delete(struct calibrations *calibrations, const char *id, struct error *err)
{
	char name[ID_SIZE + 8], beside[1024], path[1024], parent[1024];
	struct entry entry;
	struct error ignored;
	int code = 0;

	if (!id_valid(id) || !take_out(calibrations, id, &entry))
		return no_such(id, err);
	snprintf(name, sizeof(name), "%s.tmp", entry.id);
	calibration_path(calibrations, name, "", beside);
	calibration_path(calibrations, "", "", parent);
	calibration_path(calibrations, entry.id, "", path);
	if (rename(path, beside) != 0 && errno != ENOENT)
		code = error_set_errno(err, errno, "removal of calibration %s", entry.id);
	if (code != 0 && insert(calibrations, &entry, &ignored) == 0)
		return code;
	cJSON_Delete(entry.brief);
	calibrator_wake(calibrations);
	watch_wake(&calibrations->watchers);
	if (code == 0)
		code = directory_sync(parent, err);
	if (code != 0) {
		store_distrust(calibrations->store, err);
		return code;
	}
	return directory_remove(beside, err);
}

/* ---- documents ---- */

/* A copy of the brief document with state and age; the lock is held. */
static cJSON *copy_brief(const struct entry *entry)
{
	cJSON *document = cJSON_Duplicate(entry->brief, true);

	cJSON_AddStringToObject(document, "state", calibration_state_names[entry->state]);
	json_add_seconds(document, "age_s", clock_realtime() - entry->acquired);
	return document;
}

int calibration_document(struct calibrations *calibrations, const char *id, bool brief, cJSON **ret_document,
			 bool *ret_ended, struct error *err)
{
	cJSON *document = NULL, *request = NULL, *result = NULL;
	const struct entry *entry;
	enum calibration_state state = CALIBRATION_QUEUED;
	bool ended = false;
	int code = 0;

	pthread_mutex_lock(&calibrations->lock);
	entry = calibration_entry(calibrations, id);
	if (entry != NULL) {
		document = copy_brief(entry);
		state = entry->state;
		ended = has_ended(entry);
	}
	pthread_mutex_unlock(&calibrations->lock);
	if (entry == NULL)
		return no_such(id, err);
	if (!brief) {
		code = calibration_read(calibrations, id, state == CALIBRATION_SUCCEEDED, &request, &result, err);
		if (code == 0)
			calibration_add_rest(document, request, ended ? result : NULL);
		cJSON_Delete(request);
		cJSON_Delete(result);
	}
	if (code != 0) {
		cJSON_Delete(document);
		return code;
	}
	*ret_document = document;
	if (ret_ended != NULL)
		*ret_ended = ended;
	return 0;
}

int calibrations_list(struct calibrations *calibrations, const char *after, int limit, cJSON *list,
		      char ret_last[ID_SIZE], bool *ret_more, struct error *err)
{
	int from;

	pthread_mutex_lock(&calibrations->lock);
	from = after != NULL ? place_of(calibrations, after) : calibrations->count;
	*ret_more = from > limit;
	for (int i = from - 1; i >= 0 && i >= from - limit; i--) {
		json_append(list, copy_brief(&calibrations->entries[i]));
		memcpy(ret_last, calibrations->entries[i].id, ID_SIZE);
	}
	pthread_mutex_unlock(&calibrations->lock);
	return list != NULL ? 0 : error_set_errno(err, ENOMEM, "list of calibrations");
}

void calibrations_watch(struct calibrations *calibrations, struct watch *watch)
{
	watch_add(&calibrations->watchers, watch);
}

void calibrations_unwatch(struct calibrations *calibrations, struct watch *watch)
{
	watch_remove(&calibrations->watchers, watch);
}

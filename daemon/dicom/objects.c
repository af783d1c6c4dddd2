/* The objects of a kept volume: dicom.h. */
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/dicom/dicom.h"
#include "proto/format.h"
#include "proto/json.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"

int task_subject(const cJSON *task, struct subject *ret_subject, struct error *err)
{
	const cJSON *subject = cJSON_GetObjectItemCaseSensitive(task, "subject");
	char *text;
	int code;

	if (subject == NULL)
		return 0;
	text = json_print(subject, NULL);
	code = text == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a patient")
			    : subject_parse(text, ret_subject, err);
	free(text);
	return code;
}

/* The members that the daemon has written; wrong ones are a mistake of its own. */
static int read_task(const cJSON *task, struct objects *objects, char ret_path[1024], char ret_job[64],
		     struct error *err)
{
	double size[3] = {0};
	struct json_reader reader;
	const cJSON *grid;

	json_begin(&reader, task, "", err);
	json_member(&reader, "destination", true);
	json_member(&reader, "subject", false);
	json_member(&reader, "again", false);
	json_member(&reader, "scan", true);
	json_string(&reader, "job", true, ret_job, 64);
	json_string(&reader, "path", true, ret_path, 1024);
	json_string(&reader, "volume", true, objects->words.volume, sizeof(objects->words.volume));
	json_number(&reader, "created", true, 0, 1e12, &objects->words.created);
	json_number(&reader, "mu_water", true, 0, 1e3, &objects->mu_water);
	grid = json_member(&reader, "grid", true);
	if (json_end(&reader) != 0)
		return err->code;
	json_begin(&reader, grid, "/grid", err);
	json_numbers(&reader, "size", true, 3, 1, 1e6, size);
	json_numbers(&reader, "spacing_mm", true, 3, 0, 1e6, objects->grid.spacing);
	json_numbers(&reader, "origin_mm", true, 3, -1e6, 1e6, objects->grid.origin);
	for (int i = 0; i < 3; i++)
		objects->grid.size[i] = (int)size[i];
	return json_end(&reader);
}

static int open_volume(struct objects *objects, const char *path, const char *job, struct error *err)
{
	objects->file = regular_open(path, O_RDONLY, 0);
	if (objects->file < 0)
		return errno == ENOENT ? error_set(err, ERR_DAMAGED, "the volume is not there any more")
				       : error_set_errno(err, errno, "open a volume");
	if (volume_own_head(objects->file, path, &objects->grid, &objects->start, &objects->provenance, err) != 0)
		return err->code;
	/* The patient is the job's: a file of another one is never sent with it. */
	if (strcmp(objects->provenance.job, job) != 0)
		return error_set(err, ERR_DAMAGED, "the volume's file is of job \"%.20s\", not of %.20s",
				 objects->provenance.job, job);
	return 0;
}

static int make_heads(struct objects *objects, struct error *err)
{
	const size_t bytes = objects->plane_voxels * (size_t)objects->planes * sizeof(int16_t);
	int code = 0;

	objects->list = calloc((size_t)objects->count, sizeof(*objects->list));
	if (objects->list == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d objects", objects->count);
	if (bytes > UINT32_MAX)
		return error_set(err, ERR_IMPOSSIBLE, "%.4g GB of voxels, an object has at most 4.2",
				 (double)bytes * 1e-9);
	for (int i = 0; i < objects->count && code == 0; i++)
		code = dicom_head(&objects->words, &objects->grid, &objects->provenance, i, bytes,
				  &objects->list[i].head, err);
	return code;
}

int objects_open(const cJSON *task, struct objects *ret_objects, struct error *err)
{
	const cJSON *destination = cJSON_GetObjectItemCaseSensitive(task, "destination");
	struct objects objects = {.file = -1, .words = {.position = -1}};
	char path[1024], job[64];
	int code;

	for (int i = 0; i < DICOM_KIND_COUNT; i++)
		if (strcmp(destination_text(destination, "objects"), dicom_kind_names[i]) == 0)
			objects.words.kind = (enum dicom_kind)i;
	objects.class = dicom_class(objects.words.kind);
	objects.words.source = cJSON_Duplicate(
	    cJSON_GetObjectItemCaseSensitive(cJSON_GetObjectItemCaseSensitive(task, "subject"), "source"), true);
	code = read_task(task, &objects, path, job, err);
	if (code == 0)
		code = task_subject(task, &objects.words.subject, err);
	if (code == 0)
		code = open_volume(&objects, path, job, err);
	if (code == 0) {
		objects.count = objects.words.kind != DICOM_SLICES ? 1 : objects.grid.size[2];
		objects.planes = objects.words.kind != DICOM_SLICES ? objects.grid.size[2] : 1;
		objects.plane_voxels = (size_t)objects.grid.size[0] * (size_t)objects.grid.size[1];
		code = make_heads(&objects, err);
	}
	if (code != 0)
		objects_close(&objects);
	else
		*ret_objects = objects;
	return code;
}

void objects_close(struct objects *objects)
{
	for (int i = 0; i < objects->count && objects->list != NULL; i++)
		free(objects->list[i].head.bytes);
	free(objects->list);
	objects->list = NULL;
	cJSON_Delete(objects->words.source);
	objects->words.source = NULL;
	provenance_clear(&objects->provenance);
	if (objects->file >= 0)
		close(objects->file);
	objects->file = -1;
}

/* Meta information: 128 bytes, "DICM", then (0002,0000) with the length of what follows it up to the dataset. */
static size_t dataset_offset(const uint8_t *bytes)
{
	const size_t at = 128 + 4 + 8;

	return at + 4 +
	       ((size_t)bytes[at] | (size_t)bytes[at + 1] << 8 | (size_t)bytes[at + 2] << 16 |
		(size_t)bytes[at + 3] << 24);
}

int object_make(const struct objects *objects, int place, uint8_t **ret_bytes, size_t *ret_size, size_t *ret_dataset,
		struct error *err)
{
	const struct dicom_head *head = &objects->list[place].head;
	const size_t count = objects->plane_voxels, whole = count * (size_t)objects->planes * sizeof(int16_t);
	float *plane = malloc(count * sizeof(*plane));
	int16_t *units = malloc(count * sizeof(*units));
	uint8_t *bytes = malloc(head->size + whole);
	int code = 0;

	if (plane == NULL || units == NULL || bytes == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for an object");
	for (int i = 0; i < objects->planes && code == 0; i++) {
		const size_t z = (size_t)place * (size_t)objects->planes + (size_t)i;

		code = file_read_at(objects->file, plane, count * sizeof(*plane),
				    objects->start + z * count * sizeof(*plane), "the volume", err);
		if (code != 0)
			break;
		volume_to_hu(plane, count, objects->mu_water, units);
		memcpy(bytes + head->size + (size_t)i * count * sizeof(*units), units, count * sizeof(*units));
	}
	free(plane);
	free(units);
	if (code != 0) {
		free(bytes);
		return code;
	}
	memcpy(bytes, head->bytes, head->size);
	*ret_bytes = bytes;
	*ret_size = head->size + whole;
	*ret_dataset = dataset_offset(bytes);
	return 0;
}

int objects_stored(const struct objects *objects)
{
	int count = 0;

	for (int i = 0; i < objects->count; i++)
		count += objects->list[i].stored;
	return count;
}

void objects_mark(struct objects *objects, const char *instance)
{
	for (int i = 0; i < objects->count; i++)
		if (strcmp(objects->list[i].head.instance, instance) == 0)
			objects->list[i].stored = true;
}

/* ---- objects that several threads send ---- */

int load_next(struct load *load)
{
	int place;

	pthread_mutex_lock(&load->lock);
	while (load->next < load->objects->count && load->objects->list[load->next].stored)
		load->next++;
	place = load->error.code == 0 && load->next < load->objects->count ? load->next++ : -1;
	pthread_mutex_unlock(&load->lock);
	return place;
}

void load_fail(struct load *load, const struct error *err)
{
	pthread_mutex_lock(&load->lock);
	if (load->error.code == 0)
		load->error = *err;
	pthread_mutex_unlock(&load->lock);
}

int load_run(const cJSON *destination, const struct objects *objects, int threads, void *(*work)(void *load),
	     struct error *err)
{
	struct load load = {.destination = destination, .objects = objects, .lock = PTHREAD_MUTEX_INITIALIZER};
	pthread_t others[8];
	int count = 0;

	while (count < threads - 1 && count < 8 && pthread_create(&others[count], NULL, work, &load) == 0)
		count++;
	work(&load);
	for (int i = 0; i < count; i++)
		pthread_join(others[i], NULL);
	pthread_mutex_destroy(&load.lock);
	if (load.error.code != 0)
		*err = load.error;
	return load.error.code;
}

/* The uses of a calibration, by scans and for pictures: calibrations.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/calibrations/internal.h"
#include "proto/clock.h"

static const double day = 86400; /* s */

/* A calibration that has succeeded, from its files. */
static int open_calibrated(struct calibrations *calibrations, const char *id, struct calibrated *ret_calibrated,
			   char ret_scan[ID_SIZE], struct error *err)
{
	cJSON *request = NULL, *result = NULL;
	const struct entry *entry;
	enum calibration_state state = CALIBRATION_QUEUED;
	int code;

	pthread_mutex_lock(&calibrations->lock);
	entry = calibration_entry(calibrations, id);
	if (entry != NULL) {
		state = entry->state;
		memcpy(ret_scan, entry->scan, ID_SIZE);
	}
	pthread_mutex_unlock(&calibrations->lock);
	if (entry == NULL)
		return error_set(err, ERR_NOT_FOUND, "there is no calibration \"%.64s\"", id);
	if (state != CALIBRATION_SUCCEEDED)
		return error_set(err, ERR_CONFLICT, "calibration %s has no result: its state is %s", id,
				 calibration_state_names[state]);
	code = calibration_read(calibrations, id, true, &request, &result, err);
	if (code == 0)
		code = calibrated_read(request, result, ret_calibrated, err);
	cJSON_Delete(request);
	cJSON_Delete(result);
	return code;
}

int calibrations_check_scan(struct calibrations *calibrations, const char *scan, struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&calibrations->lock);
	for (int i = 0; i < calibrations->count && code == 0; i++) {
		const struct entry *entry = &calibrations->entries[i];

		if (entry->state < CALIBRATION_SUCCEEDED && strcmp(entry->scan, scan) == 0)
			code =
			    error_set(err, ERR_CONFLICT, "calibration %s of this scan is %s: delete it first, or wait",
				      entry->id, calibration_state_names[entry->state]);
	}
	pthread_mutex_unlock(&calibrations->lock);
	return code;
}

static void note_age(const struct calibrations *calibrations, const struct calibrated *calibrated, cJSON *notes)
{
	const double days = (clock_realtime() - calibrated->acquired) / day;
	char detail[160];
	cJSON *note;

	if (calibrations->age == 0 || days <= (double)calibrations->age)
		return;
	note = cJSON_CreateObject();
	snprintf(detail, sizeof(detail),
		 "the calibration's sweep was %.0f days old when this scan began, %ld are allowed", days,
		 calibrations->age);
	cJSON_AddStringToObject(note, "code", "calibration_old");
	cJSON_AddStringToObject(note, "detail", detail);
	json_append(notes, note);
}

int calibrations_find_views(void *context, const char *id, const struct scan *scan, const double *angles,
			    struct geometry *ret_geometry, cJSON *ret_notes, struct error *err)
{
	struct calibrations *calibrations = context;
	struct calibrated calibrated;
	char sweep[ID_SIZE];
	int code = open_calibrated(calibrations, id, &calibrated, sweep, err);

	if (code != 0) {
		snprintf(err->pointer, sizeof(err->pointer), "/geometry/id");
		return code;
	}
	code = calibrated_views(&calibrated, scan, angles, ret_geometry, ret_notes, err);
	if (code == 0)
		note_age(calibrations, &calibrated, ret_notes);
	calibrated_clear(&calibrated);
	return code;
}

/* Samples of a projection of the phantom's scan, held against their checksum. */
static int read_samples(struct calibrations *calibrations, const char *scan, int view, void *ret_samples,
			struct error *err)
{
	struct stored_scan *stored;
	struct sum sum;
	int descriptor, code = store_scan_find(calibrations->store, scan, &stored, err);

	if (code == ERR_NOT_FOUND)
		return error_set(err, code,
				 "the scan %s that was calibrated has been deleted: there is no picture of it", scan);
	if (code != 0)
		return code;
	code = stored_scan_open(stored, false, &descriptor, err);
	if (code == 0) {
		code = stored_scan_read(stored, descriptor, view, ret_samples, &sum, err);
		close(descriptor);
	}
	stored_scan_release(stored);
	return code;
}

int calibration_picture(struct calibrations *calibrations, const char *id, long view, char **ret_png,
			size_t *ret_length, struct error *err)
{
	struct calibrated calibrated;
	char scan[ID_SIZE];
	void *samples = NULL;
	int code = open_calibrated(calibrations, id, &calibrated, scan, err);

	if (code != 0)
		return code;
	if (calibrated.balls.count == 0)
		code = error_set(err, ERR_NOT_FOUND, "calibration %s is a job's: it has no phantom to be drawn", id);
	else if (view < 0 || view >= calibrated.sweep->count)
		code = error_set(err, ERR_NOT_FOUND, "view %ld is asked for, the calibration has 0 to %d", view,
				 calibrated.sweep->count - 1);
	if (code == 0) {
		samples = malloc(scan_projection_bytes(calibrated.sweep));
		if (samples == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for a picture");
	}
	if (code == 0)
		code = read_samples(calibrations, scan, (int)view, samples, err);
	if (code == 0)
		code = calibrated_picture(&calibrated, (int)view, samples, ret_png, ret_length, err);
	free(samples);
	calibrated_clear(&calibrated);
	return code;
}

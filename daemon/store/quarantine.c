/* Entries of the quarantine: store/quarantine.h. */
#include "daemon/store/quarantine.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/json.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

enum { NOTE_BYTES_MAX = 4096, FIRST_LINE = 21 /* {"crc32":"89abcdef",\n */ };

/* Of a note: the checksum of what is behind it. */
static void first_line(const char *rest, size_t length, char ret_line[FIRST_LINE + 1])
{
	snprintf(ret_line, FIRST_LINE + 1, "{\"crc32\":\"%08x\",\n", (unsigned)checksum(0, rest, length));
}

static void entry_path(const char *state, const char *name, const char *extension, char ret_path[1200])
{
	snprintf(ret_path, 1200, "%s/quarantine/%s%s", state, name, extension);
}

/* Makes a name from the path and the time; another one where that is in use. */
static void choose_name(const char *state, const char *path, double now, char ret_name[QUARANTINE_NAME_MAX])
{
	char entry[1200], note[1200];
	time_t seconds = (time_t)now;
	struct tm broken;
	size_t length;

	gmtime_r(&seconds, &broken);
	for (int i = 1;; i++) {
		length = (size_t)snprintf(ret_name, QUARANTINE_NAME_MAX - 24, "%s", path);
		length = strlen(ret_name);
		for (size_t j = 0; j < length; j++) {
			if (ret_name[j] == '/')
				ret_name[j] = '-';
		}
		length += strftime(ret_name + length, QUARANTINE_NAME_MAX - length, ".%Y%m%dT%H%M%SZ", &broken);
		if (i > 1)
			snprintf(ret_name + length, QUARANTINE_NAME_MAX - length, "-%d", i);
		entry_path(state, ret_name, "", entry);
		entry_path(state, ret_name, ".json", note);
		if (access(entry, F_OK) != 0 && access(note, F_OK) != 0)
			return;
	}
}

static int write_note(const char *state, const char *name, const char *path, double now, const char *why,
		      struct error *err)
{
	cJSON *document = cJSON_CreateObject();
	char file[1200], line[FIRST_LINE + 1], *text, *whole = NULL;
	size_t length = 0;
	int code;

	cJSON_AddStringToObject(document, "from", path);
	cJSON_AddNumberToObject(document, "time", floor(now));
	cJSON_AddStringToObject(document, "why", why);
	text = json_print(document, &length);
	cJSON_Delete(document);
	/* The checksum is the first member, in place of the text's own brace. */
	if (text != NULL) {
		first_line(text + 1, length - 1, line);
		if (asprintf(&whole, "%s%s", line, text + 1) < 0)
			whole = NULL;
	}
	free(text);
	if (whole == NULL)
		return error_set_errno(err, ENOMEM, "note of %s", path);
	entry_path(state, name, ".json", file);
	code = file_write_durable(file, whole, strlen(whole), err);
	free(whole);
	return code;
}

static int begin_entry(const char *state, const char *path, const char *why, char ret_name[QUARANTINE_NAME_MAX],
		       struct error *err)
{
	char directory[1200];
	double now = clock_realtime();
	int code;

	snprintf(directory, sizeof(directory), "%s/quarantine", state);
	code = directory_make(directory, err);
	if (code != 0)
		return code;
	choose_name(state, path, floor(now), ret_name);
	log_line(LEVEL_ERROR, "%s is set aside as quarantine/%s: %s", path, ret_name, why);
	return write_note(state, ret_name, path, floor(now), why, err);
}

int quarantine_note(const char *state, const char *path, const char *why, struct error *err)
{
	char name[QUARANTINE_NAME_MAX];

	return begin_entry(state, path, why, name, err);
}

int quarantine_move(const char *state, const char *path, const char *why, struct error *err)
{
	char name[QUARANTINE_NAME_MAX], from[1200], to[1200];
	int code = begin_entry(state, path, why, name, err);

	if (code != 0)
		return code;
	snprintf(from, sizeof(from), "%s/%s", state, path);
	entry_path(state, name, "", to);
	if (rename(from, to) != 0)
		return error_set_errno(err, errno, "%s cannot be moved to quarantine/", path);
	snprintf(to, sizeof(to), "%s/quarantine", state);
	code = directory_sync(to, err);
	if (code != 0)
		return code;
	*strrchr(from, '/') = '\0';
	return directory_sync(from, err);
}

int quarantine_forget(const char *state, const char *name, struct error *err)
{
	char path[1200];

	entry_path(state, name, ".json", path);
	if (unlink(path) != 0 && errno != ENOENT)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

/* ---- reading ---- */

/* The note's own members in ret_document; one of an earlier version has no checksum. */
static int parse_note(char *text, size_t length, cJSON **ret_document, struct error *err)
{
	static const char begins[] = "{\"crc32\":";
	char line[FIRST_LINE + 1];

	if (length < FIRST_LINE || memcmp(text, begins, sizeof(begins) - 1) != 0)
		return json_parse(text, length, ret_document, err);
	first_line(text + FIRST_LINE, length - FIRST_LINE, line);
	if (memcmp(text, line, FIRST_LINE) != 0)
		return error_set(err, ERR_DAMAGED, "a note does not fit its checksum");
	text[FIRST_LINE - 1] = '{';
	return json_parse(text + FIRST_LINE - 1, length - (FIRST_LINE - 1), ret_document, err);
}

static void read_note(const char *state, struct quarantined *entry)
{
	char path[1200], *text = NULL;
	struct json_reader reader;
	cJSON *document = NULL;
	struct error err;
	size_t length;

	entry_path(state, entry->name, ".json", path);
	if (file_read(path, NOTE_BYTES_MAX, &text, &length, &err) == 0 &&
	    parse_note(text, length, &document, &err) == 0) {
		json_begin(&reader, document, "", &err);
		json_string(&reader, "from", true, entry->from, sizeof(entry->from));
		json_number(&reader, "time", true, 0, 1e12, &entry->time);
		json_string(&reader, "why", true, entry->why, sizeof(entry->why));
		if (json_end(&reader) != 0)
			entry->from[0] = entry->why[0] = '\0';
	}
	cJSON_Delete(document);
	free(text);
}

struct listing {
	const char *state;
	struct quarantined *entries;
	int count, space;
};

static int compare_entries(const void *a, const void *b)
{
	return strcmp(((const struct quarantined *)a)->name, ((const struct quarantined *)b)->name);
}

/* A thing and its note are one entry, and either alone is one too. */
static int list_entry(void *context, const char *name, struct error *err)
{
	struct listing *listing = context;
	char entry[QUARANTINE_NAME_MAX], path[1200];
	const char *extension = strrchr(name, '.');
	bool note = extension != NULL && strcmp(extension, ".json") == 0;

	if (name_is_temporary(name) || strlen(name) >= sizeof(entry))
		return 0;
	snprintf(entry, sizeof(entry), "%.*s", note ? (int)(extension - name) : (int)strlen(name), name);
	entry_path(listing->state, entry, "", path);
	if (note && access(path, F_OK) == 0)
		return 0;
	if (listing->count == listing->space) {
		int space = listing->space == 0 ? 16 : 2 * listing->space;
		struct quarantined *entries = realloc(listing->entries, (size_t)space * sizeof(*entries));

		if (entries == NULL)
			return error_set_errno(err, ENOMEM, "list of quarantine/");
		listing->entries = entries;
		listing->space = space;
	}
	listing->entries[listing->count] = (struct quarantined){0};
	memcpy(listing->entries[listing->count++].name, entry, sizeof(entry));
	return 0;
}

int quarantine_list(const char *state, struct quarantined **ret_entries, int *ret_count, struct error *err)
{
	struct listing listing = {.state = state};
	char directory[1200];
	int code;

	snprintf(directory, sizeof(directory), "%s/quarantine", state);
	code = directory_visit(directory, list_entry, &listing, err);
	if (code != 0) {
		free(listing.entries);
		return code;
	}
	if (listing.count > 0)
		qsort(listing.entries, (size_t)listing.count, sizeof(*listing.entries), compare_entries);
	for (int i = 0; i < listing.count; i++)
		read_note(state, &listing.entries[i]);
	*ret_entries = listing.entries;
	*ret_count = listing.count;
	return 0;
}

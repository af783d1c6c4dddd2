/*
 * STATE/jobs/ID/annotations.json: a document that clients keep with a job. Its first line has the checksum of what
 * follows; the file is replaced whole, synced, and goes with the job's directory. Of it the catalogue knows, behind
 * that, that there is one: a file that is gone is a loss then.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/internal.h"
#include "proto/durable.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

enum { FIRST_LINE = 36 /* {"crc32":"89abcdef","annotations":\n */, LAST_LINE = 2 /* }\n */ };

static void annotations_path(const struct store *store, const char *id, char ret_path[1100])
{
	char directory[1024];

	store_job_directory(store, id, directory);
	snprintf(ret_path, 1100, "%s/annotations.json", directory);
}

static void first_line(const char *text, size_t length, char ret_line[FIRST_LINE])
{
	snprintf(ret_line, FIRST_LINE, "{\"crc32\":\"%08x\",\"annotations\":\n", (unsigned)checksum(0, text, length));
}

int store_annotations_read(const struct store *store, const char *id, char **ret_text, size_t *ret_length,
			   struct error *err)
{
	size_t head = FIRST_LINE - 1, length;
	char path[1100], line[FIRST_LINE], *text;
	int code;

	annotations_path(store, id, path);
	code = file_read(path, STORE_ANNOTATIONS_MAX + head + LAST_LINE, &text, &length, err);
	if (code != 0)
		return code;
	if (length >= head + LAST_LINE)
		first_line(text + head, length - head - LAST_LINE, line);
	if (length < head + LAST_LINE || memcmp(text, line, head) != 0) {
		free(text);
		return error_set(err, ERR_DAMAGED, "the annotations of job %s do not fit their checksum", id);
	}
	length -= head + LAST_LINE;
	memmove(text, text + head, length);
	text[length] = '\0';
	*ret_text = text;
	*ret_length = length;
	return 0;
}

int store_annotations_write(struct store *store, const char *id, const char *text, size_t length,
			    const struct event *event, struct error *err)
{
	char path[1100], line[FIRST_LINE];
	struct durable durable;
	int code;

	annotations_path(store, id, path);
	first_line(text, length, line);
	code = durable_open(&durable, path, 0, err);
	if (code != 0)
		return code;
	code = durable_write(&durable, line, FIRST_LINE - 1, err);
	if (code == 0)
		code = durable_write(&durable, text, length, err);
	if (code == 0)
		code = durable_write(&durable, "}\n", LAST_LINE, err);
	if (code != 0)
		durable_abandon(&durable);
	else
		code = durable_commit(&durable, err);
	store_distrust(store, err);
	return code == 0 ? store_job_annotated(store, id, event, err) : code;
}

/* What a volume's file says of where it comes from: provenance_of_file of provenance.h. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <zlib.h>

#include "proto/format.h"
#include "proto/header.h"
#include "proto/nifti.h"
#include "proto/regular.h"

/* The beginning of a file, as plain bytes where gzip has packed it. */
static int read_head(const char *path, char *ret_head, size_t size, size_t *ret_length, struct error *err)
{
	int file = regular_open(path, O_RDONLY, 0), got;
	gzFile unpacked = file >= 0 ? gzdopen(file, "rb") : NULL;

	if (unpacked == NULL) {
		const int code = error_set_errno(err, errno, "%s cannot be opened", path);

		if (file >= 0)
			close(file);
		return code;
	}
	got = gzread(unpacked, ret_head, (unsigned)size);
	gzclose(unpacked);
	if (got < 0)
		return error_set(err, ERR_IO, "%.200s cannot be read", path);
	*ret_length = (size_t)got;
	return 0;
}

/* The JSON of NIfTI's extension; NULL where there is none. */
static cJSON *from_extension(const char *head, size_t length)
{
	const char *text = head + NIFTI_EXTENSION_TEXT;
	cJSON *json = NULL;
	struct error ignored;

	if (length < NIFTI_VOXELS || head[NIFTI_EXTENDER] == 0)
		return NULL;
	json_parse(text, strnlen(text, NIFTI_VOXELS - NIFTI_EXTENSION_TEXT), &json, &ignored);
	return json;
}

/* Takes the second of two backslashes out, which NRRD has for one. */
static void unescape(char *text)
{
	char *to = text;

	for (const char *from = text; *from != '\0'; from++) {
		from += from[0] == '\\' && from[1] == '\\';
		*to++ = *from;
	}
	*to = '\0';
}

/* A value as key_line of format.c writes it: JSON, or a text without its quotes. NULL for no memory. */
static cJSON *value_of(const char *text, bool is_text)
{
	char quoted[600];
	cJSON *json = NULL;
	struct error ignored;

	if (!is_text && json_parse(text, strlen(text), &json, &ignored) == 0)
		return json;
	snprintf(quoted, sizeof(quoted), "\"%.590s\"", text);
	return json_parse(quoted, strlen(quoted), &json, &ignored) == 0 ? json : NULL;
}

/* The keys cbct_NAME and cbct_recipe_NAME of a text header as one object; NULL where there are none. */
static cJSON *from_keys(const char *head, size_t length, bool nrrd)
{
	static const char *const no_texts[] = {"iteration", "images", "patient", "world_to_patient"};
	static const char own[] = "cbct_", of_recipe[] = "cbct_recipe_", digest[] = "cbct_recipe_digest";
	cJSON *json = cJSON_CreateObject(), *recipe = cJSON_CreateObject();
	const char *between = nrrd ? ":=" : " = ";
	char row[600];
	size_t at = 0;

	while (header_line(head, length, &at, row, sizeof(row)) && row[0] != '\0' &&
	       strncmp(row, "ElementDataFile", 15) != 0) {
		char *value = strstr(row, between);
		bool in_recipe, is_text;

		if (value == NULL || strncmp(row, own, sizeof(own) - 1) != 0)
			continue;
		*value = '\0';
		value += strlen(between);
		if (nrrd)
			unescape(value);
		in_recipe = strncmp(row, of_recipe, sizeof(of_recipe) - 1) == 0 && strcmp(row, digest) != 0;
		is_text = !in_recipe;
		for (size_t i = 0; i < sizeof(no_texts) / sizeof(no_texts[0]); i++)
			is_text = is_text && strcmp(row + sizeof(own) - 1, no_texts[i]) != 0;
		json_add(in_recipe ? recipe : json, row + (in_recipe ? sizeof(of_recipe) : sizeof(own)) - 1,
			 value_of(value, is_text));
	}
	if (recipe != NULL && recipe->child != NULL)
		json_add(json, "recipe", recipe);
	else
		cJSON_Delete(recipe);
	if (json != NULL && json->child != NULL)
		return json;
	cJSON_Delete(json);
	return NULL;
}

int provenance_of_file(const char *path, struct provenance *ret_provenance, bool *ret_hu, struct error *err)
{
	char *head = calloc(1, FORMAT_HEADER_MAX + 1);
	cJSON *json = NULL;
	size_t length = 0;
	int code = head == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a header")
				: read_head(path, head, FORMAT_HEADER_MAX, &length, err);

	if (code == 0 && length >= NIFTI_HEADER && memcmp(head + NIFTI_MAGIC, "n+1", 4) == 0)
		json = from_extension(head, length);
	else if (code == 0)
		json = from_keys(head, length, length >= 5 && memcmp(head, "NRRD0", 5) == 0);
	if (code == 0 && json == NULL)
		code = error_set(err, ERR_INVALID, "%.200s does not say where it comes from", path);
	if (code == 0)
		code = provenance_read(json, ret_provenance, err);
	if (code == 0) {
		const char *unit = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(json, "unit"));

		*ret_hu = unit != NULL && strcmp(unit, "HU") == 0;
	}
	cJSON_Delete(json);
	free(head);
	return code;
}

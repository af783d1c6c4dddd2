/* Measurements and key images of a job: annotations.h. */
#include "proto/annotations.h"

#include <stdio.h>
#include <string.h>

static const double far = 1e5; /* mm, HU: nothing of a scan is further */

struct kind {
	const char *name;
	int least, most; /* points */
};
static const struct kind kinds[] = {
    {"ruler", 2, 2}, {"angle", 3, 3}, {"ellipse", 3, 3}, {"freehand", 3, ANNOTATION_POINTS_MAX}};
enum { KINDS = sizeof(kinds) / sizeof(kinds[0]) };

/* Reads an id of 1 to 40 characters, which no entry before `entry` has. */
static void read_id(struct json_reader *reader, const cJSON *entry)
{
	char id[TEXT_BYTES(40)] = "";

	json_text(reader, "id", true, 40, id);
	if (reader->code == 0 && id[0] == '\0')
		json_fail(reader, ERR_INVALID, "id", "is empty");
	for (const cJSON *other = entry->prev; reader->code == 0 && other != NULL && other->next != NULL;
	     other = other->prev) {
		const cJSON *member = cJSON_GetObjectItemCaseSensitive(other, "id");

		if (cJSON_IsString(member) && strcmp(member->valuestring, id) == 0)
			json_fail(reader, ERR_INVALID, "id", "is \"%.60s\", as that of an entry before it", id);
	}
}

static void read_points(struct json_reader *reader, const struct kind *kind)
{
	const cJSON *points = json_member(reader, "points", true), *point;
	int count = cJSON_IsArray(points) ? cJSON_GetArraySize(points) : -1, i = 0;

	if (reader->code != 0)
		return;
	if (count < kind->least || count > kind->most) {
		json_fail(reader, ERR_INVALID, "points", "%d points of a %s, expected %d to %d", count < 0 ? 0 : count,
			  kind->name, kind->least, kind->most);
		return;
	}
	cJSON_ArrayForEach(point, points)
	{
		char pointer[200];
		double place[3];

		snprintf(pointer, sizeof(pointer), "%s/points/%d", reader->base, i++);
		if (reader->code == 0)
			reader->code = json_array(point, pointer, 3, -far, far, place, reader->err);
	}
}

static int read_measurement(const cJSON *entry, const char *base, struct error *err)
{
	const char *names[KINDS];
	char label[TEXT_BYTES(ANNOTATION_TEXT_MAX)] = "";
	struct json_reader reader;
	int kind = 0;

	for (int i = 0; i < KINDS; i++)
		names[i] = kinds[i].name;
	json_begin(&reader, entry, base, err);
	read_id(&reader, entry);
	json_choice(&reader, "kind", true, names, KINDS, &kind);
	json_text(&reader, "label", false, ANNOTATION_TEXT_MAX, label);
	read_points(&reader, &kinds[kind]);
	return json_end(&reader);
}

static int read_key_image(const cJSON *entry, const char *base, struct error *err)
{
	static const char *const modes[] = {"mean", "max", "min"};
	char caption[TEXT_BYTES(ANNOTATION_TEXT_MAX)] = "", volume[64] = "", created[40] = "";
	struct json_reader reader;
	double number = 0, triple[3];
	int mode = 0;

	json_begin(&reader, entry, base, err);
	read_id(&reader, entry);
	json_string(&reader, "volume", true, volume, sizeof(volume));
	json_text(&reader, "caption", false, ANNOTATION_TEXT_MAX, caption);
	json_string(&reader, "created", false, created, sizeof(created));
	json_number(&reader, "window", true, 1, 1e6, &number);
	json_number(&reader, "level", true, -1e6, 1e6, &number);
	json_numbers(&reader, "normal", true, 3, -far, far, triple);
	json_numbers(&reader, "up", true, 3, -far, far, triple);
	json_numbers(&reader, "center", true, 3, -far, far, triple);
	json_number(&reader, "thickness", false, 0, 1000, &number);
	json_choice(&reader, "mode", false, modes, 3, &mode);
	return json_end(&reader);
}

/* Adds the list to `document`, as it came; an empty one where it was left out. */
static int read_list(struct json_reader *reader, const char *name,
		     int (*read)(const cJSON *entry, const char *base, struct error *err), cJSON *document)
{
	const cJSON *list = json_member(reader, name, false), *entry;
	int count = 0;

	if (reader->code != 0 || list == NULL || cJSON_IsNull(list)) {
		cJSON_AddArrayToObject(document, name);
		return reader->code;
	}
	if (!cJSON_IsArray(list) || cJSON_GetArraySize(list) > ANNOTATIONS_MAX)
		return json_fail(reader, ERR_INVALID, name, "expected a list of at most %d", ANNOTATIONS_MAX);
	cJSON_ArrayForEach(entry, list)
	{
		char base[80];

		snprintf(base, sizeof(base), "/%s/%d", name, count++);
		if (reader->code == 0)
			reader->code = read(entry, base, reader->err);
	}
	json_add(document, name, cJSON_Duplicate(list, true));
	return reader->code;
}

int annotations_read(const char *text, size_t length, char **ret_text, size_t *ret_length, struct error *err)
{
	cJSON *value, *document;
	struct json_reader reader;
	char *printed = NULL;
	int code = json_parse(text, length, &value, err);

	if (code != 0)
		return code;
	document = cJSON_CreateObject();
	json_begin(&reader, value, "", err);
	read_list(&reader, "measurements", read_measurement, document);
	read_list(&reader, "key_images", read_key_image, document);
	code = json_end(&reader);
	if (code == 0) {
		printed = json_print(document, ret_length);
		if (printed == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for annotations");
		else
			*ret_text = printed;
	}
	cJSON_Delete(document);
	cJSON_Delete(value);
	return code;
}

/* Where a volume comes from: see provenance.h. */
#include "proto/provenance.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void provenance_clear(struct provenance *provenance)
{
	cJSON_Delete(provenance->recipe);
	provenance->recipe = NULL;
}

/* The members that are texts, in their order. */
static const struct {
	const char *name;
	size_t offset, size;
} texts[] = {
#define TEXT(member)                                                                                                   \
	{                                                                                                              \
#member, offsetof(struct provenance, member), sizeof(((struct provenance *)0)->member)                 \
	}
    TEXT(program),       TEXT(stage),   TEXT(job),    TEXT(scan),        TEXT(scan_name),
    TEXT(commit),        TEXT(backend), TEXT(device), TEXT(scan_digest), TEXT(projections_digest),
    TEXT(recipe_digest),
#undef TEXT
};
enum { TEXTS = sizeof(texts) / sizeof(texts[0]) };

static void add_text(cJSON *json, const char *name, const char *text)
{
	if (text[0] != '\0')
		cJSON_AddStringToObject(json, name, text);
}

static void add_images(cJSON *json, const struct provenance *provenance)
{
	cJSON *images = cJSON_CreateObject();

	for (int i = 0; i < IMAGE_COUNT; i++)
		add_text(images, image_kinds[i].name, provenance->image_digest[i]);
	add_text(images, "scatter", provenance->scatter_digest);
	if (images != NULL && images->child != NULL)
		json_add(json, "images", images);
	else
		cJSON_Delete(images);
}

cJSON *provenance_json(const struct provenance *provenance, const char *unit)
{
	const struct patient *patient = &provenance->patient;
	cJSON *json = cJSON_CreateObject(), *matrix;

	for (int i = 0; i < TEXTS; i++) {
		add_text(json, texts[i].name, (const char *)provenance + texts[i].offset);
		if (strcmp(texts[i].name, "program") == 0)
			cJSON_AddStringToObject(json, "unit", unit);
		if (strcmp(texts[i].name, "stage") == 0 && provenance->stage[0] != '\0')
			cJSON_AddNumberToObject(json, "iteration", provenance->iteration);
	}
	add_images(json, provenance);
	cJSON_AddStringToObject(json, "left_right", patient->known ? "known" : "not known");
	json_add(json, "patient", patient_json(patient));
	if (patient->known) {
		matrix = cJSON_AddArrayToObject(json, "world_to_patient");
		for (int i = 0; i < 16; i++) {
			int row = i / 4, column = i % 4;
			double last = row < 3 ? patient->offset[row] : 1;

			if (column < 3)
				last = row < 3 ? patient->rotation[row][column] : 0;
			json_append(matrix, cJSON_CreateNumber(last));
		}
	}
	if (provenance->recipe != NULL)
		json_add(json, "recipe", cJSON_Duplicate(provenance->recipe, true));
	return json;
}

static void read_text(const cJSON *json, const char *name, char *ret, size_t size)
{
	const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(json, name));

	if (text != NULL)
		snprintf(ret, size, "%s", text);
}

int provenance_read(const cJSON *json, struct provenance *ret_provenance, struct error *err)
{
	struct provenance provenance = {0};
	const cJSON *iteration = cJSON_GetObjectItemCaseSensitive(json, "iteration");
	const cJSON *recipe = cJSON_GetObjectItemCaseSensitive(json, "recipe");
	const cJSON *images = cJSON_GetObjectItemCaseSensitive(json, "images");
	int code =
	    patient_read(cJSON_GetObjectItemCaseSensitive(json, "patient"), "/patient", &provenance.patient, err);

	if (code != 0)
		return code;
	for (int i = 0; i < TEXTS; i++)
		read_text(json, texts[i].name, (char *)&provenance + texts[i].offset, texts[i].size);
	for (int i = 0; i < IMAGE_COUNT; i++)
		read_text(images, image_kinds[i].name, provenance.image_digest[i], DIGEST_TEXT_MAX);
	read_text(images, "scatter", provenance.scatter_digest, DIGEST_TEXT_MAX);
	if (cJSON_IsNumber(iteration))
		provenance.iteration = iteration->valueint;
	if (cJSON_IsObject(recipe)) {
		provenance.recipe = cJSON_Duplicate(recipe, true);
		if (provenance.recipe == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a recipe");
	}
	*ret_provenance = provenance;
	return 0;
}

/* Adds one more part to the sentence where there is room for all of it. */
__attribute__((format(printf, 3, 4))) static void add_part(char *text, size_t size, const char *format, ...)
{
	char part[400];
	size_t length = strlen(text);
	va_list args;

	va_start(args, format);
	vsnprintf(part, sizeof(part), format, args);
	va_end(args);
	if (length + 2 + strlen(part) < size)
		snprintf(text + length, size - length, "%s%s", length > 0 ? ", " : "", part);
}

void provenance_sentence(const struct provenance *provenance, const char *unit, char *ret_text, size_t size)
{
	const struct patient *patient = &provenance->patient;

	ret_text[0] = '\0';
	add_part(ret_text, size, "%s", unit);
	if (!patient->known)
		add_part(ret_text, size, "left and right are not known");
	else
		add_part(ret_text, size, "patient %s",
			 patient->position >= 0 ? patient_position_names[patient->position] : "by world_to_patient");
	if (provenance->stage[0] != '\0')
		add_part(ret_text, size, "%s iteration %d", provenance->stage, provenance->iteration);
	if (provenance->job[0] != '\0')
		add_part(ret_text, size, "job %s", provenance->job);
	if (provenance->program[0] != '\0')
		add_part(ret_text, size, "%s", provenance->program);
	if (provenance->scan[0] != '\0')
		add_part(ret_text, size, "scan %s", provenance->scan);
}

/* The code point at *at, which then stands behind it; the text is UTF-8, as json_print writes it. */
static unsigned long next_character(const unsigned char **at)
{
	const unsigned char *c = *at;
	int more = c[0] < 0x80 ? 0 : c[0] < 0xe0 ? 1 : c[0] < 0xf0 ? 2 : 3;
	unsigned long code = more == 0 ? c[0] : c[0] & (0x3fu >> more);

	for (int i = 1; i <= more; i++)
		code = code << 6 | (c[i] & 0x3fu);
	*at = c + 1 + more;
	return code;
}

char *provenance_text(const cJSON *json)
{
	size_t length = 0, used = 0;
	char *text = json_print(json, &length);
	/* Two bytes become six at most, four become twelve. */
	char *ascii = text != NULL ? malloc(3 * length + 1) : NULL;
	const unsigned char *at = (const unsigned char *)text;

	while (ascii != NULL && *at != '\0') {
		unsigned long code = next_character(&at);

		if (code < 0x80)
			ascii[used++] = (char)code;
		else if (code < 0x10000)
			used += (size_t)snprintf(ascii + used, 7, "\\u%04lx", code);
		else
			used += (size_t)snprintf(ascii + used, 13, "\\u%04lx\\u%04lx", 0xd7c0 + (code >> 10),
						 0xdc00 + (code & 0x3ff));
	}
	if (ascii != NULL)
		ascii[used] = '\0';
	free(text);
	return ascii;
}

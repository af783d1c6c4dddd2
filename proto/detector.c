/* Lag and scatter in a scan's document: see detector.h. */
#include "proto/detector.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "core/scan/geometry.h"

static const double share_sum_most = 0.9;

struct number {
	const char *name;
	size_t offset; /* of a double in struct scatter_kernel */
	double least, most;
	bool required;
};
static const struct number kernel_numbers[] = {
    {"amplitude", offsetof(struct scatter_kernel, amplitude), 0, SCATTER_AMPLITUDE_MOST, true},
    {"exponent", offsetof(struct scatter_kernel, exponent), SCATTER_EXPONENT_LEAST, SCATTER_EXPONENT_MOST, false},
    {"power", offsetof(struct scatter_kernel, power), 0, SCATTER_POWER_MOST, true},
    {"width_mm", offsetof(struct scatter_kernel, width_mm), 0.1, 10000, true},
    {"asymmetry", offsetof(struct scatter_kernel, asymmetry), -SCATTER_ASYMMETRY_MOST, SCATTER_ASYMMETRY_MOST, false},
};
enum { KERNEL_NUMBERS = sizeof(kernel_numbers) / sizeof(kernel_numbers[0]) };

/* A list of 1 to `most` objects; NULL: it is absent or wrong. */
static const cJSON *list_of(struct json_reader *reader, const char *name, int most, const char *what)
{
	const cJSON *list = json_member(reader, name, false);
	const int count = list != NULL ? cJSON_GetArraySize(list) : 0;

	if (list == NULL)
		return NULL;
	if (cJSON_IsArray(list) && count >= 1 && count <= most)
		return list;
	json_fail(reader, ERR_INVALID, name, "a list of 1 to %d %s is expected", most, what);
	return NULL;
}

/* The reader of an entry of a list; its errors are those of the reader of the list. */
static void entry_begin(const struct json_reader *reader, const char *name, const cJSON *entry, int index,
			struct json_reader *ret_reader)
{
	char base[sizeof(reader->base)];

	snprintf(base, sizeof(base), "%.100s/%s/%d", reader->base, name, index);
	json_begin(ret_reader, entry, base, reader->err);
}

static void entry_end(struct json_reader *reader, struct json_reader *entry)
{
	const int code = json_end(entry);

	if (reader->code == 0)
		reader->code = code;
}

void lag_read(struct json_reader *reader, struct lag_model *ret_model)
{
	const cJSON *list = list_of(reader, "lag", LAG_TERMS_MOST, "terms"), *entry;
	double sum = 0;

	cJSON_ArrayForEach(entry, list)
	{
		struct lag_term *term = &ret_model->terms[ret_model->count];
		struct json_reader inner;

		if (reader->code != 0)
			return;
		entry_begin(reader, "lag", entry, ret_model->count++, &inner);
		json_number(&inner, "share", true, 0, share_sum_most, &term->share);
		json_number(&inner, "frames", true, 0.01, LAG_FRAMES_MOST, &term->frames);
		entry_end(reader, &inner);
		sum += term->share;
	}
	if (reader->code == 0 && sum > share_sum_most)
		json_fail(reader, ERR_IMPOSSIBLE, "lag", "shares of %.4g in all, at most %.4g are possible", sum,
			  share_sum_most);
}

static void kernels_read(struct json_reader *reader, struct scatter_model *model)
{
	const cJSON *list = list_of(reader, "kernels", SCATTER_KERNELS_MOST, "kernels"), *entry;

	cJSON_ArrayForEach(entry, list)
	{
		struct scatter_kernel *kernel = &model->kernels[model->count];
		struct json_reader inner;

		if (reader->code != 0)
			return;
		entry_begin(reader, "kernels", entry, model->count++, &inner);
		for (int i = 0; i < KERNEL_NUMBERS; i++) {
			const struct number *number = &kernel_numbers[i];

			json_number(&inner, number->name, number->required, number->least, number->most,
				    (double *)(void *)((char *)kernel + number->offset));
		}
		entry_end(reader, &inner);
	}
}

static void images_read(struct json_reader *reader, struct scatter_images *images)
{
	long columns = 0, rows = 0, every = 1;

	json_integer(reader, "columns", true, 1, SCATTER_IMAGE_MOST, &columns);
	json_integer(reader, "rows", true, 1, SCATTER_IMAGE_MOST, &rows);
	json_integer(reader, "every", false, 1, VIEWS_MAX, &every);
	*images = (struct scatter_images){(int)columns, (int)rows, (int)every};
}

static void body_read(struct json_reader *reader, struct scatter_body *body)
{
	json_number(reader, "amplitude", true, SCATTER_BODY_LEAST, SCATTER_AMPLITUDE_MOST, &body->amplitude);
	json_number(reader, "multiple", true, 0, SCATTER_MULTIPLE_MOST, &body->multiple);
}

static void kind_read(struct json_reader *reader, struct scatter_model *model)
{
	const cJSON *kind = json_member(reader, "kind", false);

	if (kind == NULL)
		return;
	if (cJSON_IsString(kind) && strcmp(kind->valuestring, "images") == 0)
		images_read(reader, &model->images);
	else if (cJSON_IsString(kind) && strcmp(kind->valuestring, "body") == 0)
		body_read(reader, &model->body);
	else
		json_fail(reader, ERR_INVALID, "kind",
			  "\"body\" or \"images\" is expected, or no kind beside kernels or a fraction");
}

void scatter_read(struct json_reader *reader, struct scatter_model *ret_model)
{
	const cJSON *object = json_member(reader, "scatter", false);
	struct json_reader inner;
	char base[sizeof(reader->base)];

	if (object == NULL || reader->code != 0)
		return;
	snprintf(base, sizeof(base), "%.120s/scatter", reader->base);
	json_begin(&inner, object, base, reader->err);
	kernels_read(&inner, ret_model);
	json_number(&inner, "fraction", false, 0.001, SCATTER_FRACTION_MOST, &ret_model->fraction);
	kind_read(&inner, ret_model);
	if (inner.code == 0 && (ret_model->count > 0) + (ret_model->fraction > 0) + (ret_model->body.amplitude > 0) +
				       (ret_model->images.columns > 0) !=
				   1)
		json_fail(&inner, ERR_INVALID, "",
			  "either \"kernels\" or a \"fraction\" is expected, or \"body\" or \"images\" as \"kind\"");
	entry_end(reader, &inner);
}

cJSON *lag_json(const struct lag_model *model)
{
	cJSON *list = cJSON_CreateArray();

	for (int i = 0; i < model->count; i++) {
		cJSON *term = cJSON_CreateObject();

		cJSON_AddNumberToObject(term, "share", model->terms[i].share);
		cJSON_AddNumberToObject(term, "frames", model->terms[i].frames);
		json_append(list, term);
	}
	return list;
}

cJSON *scatter_json(const struct scatter_model *model)
{
	cJSON *object = cJSON_CreateObject(), *list;

	if (model->fraction > 0) {
		cJSON_AddNumberToObject(object, "fraction", model->fraction);
		return object;
	}
	if (model->body.amplitude > 0) {
		cJSON_AddStringToObject(object, "kind", "body");
		cJSON_AddNumberToObject(object, "amplitude", model->body.amplitude);
		cJSON_AddNumberToObject(object, "multiple", model->body.multiple);
		return object;
	}
	list = cJSON_AddArrayToObject(object, "kernels");
	for (int k = 0; k < model->count; k++) {
		cJSON *kernel = cJSON_CreateObject();

		for (int i = 0; i < KERNEL_NUMBERS; i++)
			cJSON_AddNumberToObject(kernel, kernel_numbers[i].name,
						*(const double *)(const void *)((const char *)&model->kernels[k] +
										kernel_numbers[i].offset));
		json_append(list, kernel);
	}
	return object;
}

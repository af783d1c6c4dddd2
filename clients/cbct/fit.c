/* What cbct fit-lag and cbct fit-scatter share: see fit.h. */
#include "clients/cbct/fit.h"

#include <stdio.h>
#include <stdlib.h>

#include "clients/cbct/output.h"

static int add_images(struct images *images, size_t pixels, float *image, double *sums, struct error *err)
{
	int code = 0;

	for (int k = 0; k < images->count && code == 0; k++) {
		code = images_read(images, k, image, err);
		for (size_t i = 0; i < pixels && code == 0; i++)
			sums[i] += (double)image[i] / images->count;
	}
	return code;
}

int fit_mean(const char *path, const struct image_options *how, const struct images *like, float **ret_mean,
	     struct error *err)
{
	const size_t pixels = (size_t)like->columns * (size_t)like->rows;
	float *mean = calloc(pixels, sizeof(*mean));
	double *sums = calloc(pixels, sizeof(*sums));
	struct images *images = NULL;
	int code = 0;

	if (mean == NULL || sums == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %zu pixels", pixels);
	if (code == 0 && path != NULL)
		code = images_open(path, how, &images, err);
	if (code == 0 && images != NULL && (images->columns != like->columns || images->rows != like->rows))
		code = error_set(err, ERR_INVALID, "%.160s: images of %d x %d pixels, the others have %d x %d", path,
				 images->columns, images->rows, like->columns, like->rows);
	if (code == 0 && images != NULL)
		code = add_images(images, pixels, mean, sums, err);
	for (size_t i = 0; i < pixels && code == 0; i++)
		mean[i] = (float)sums[i];
	images_free(images);
	free(sums);
	if (code == 0)
		*ret_mean = mean;
	else
		free(mean);
	return code;
}

int fit_write(const char *path, const char *name, cJSON *value, struct error *err)
{
	cJSON *document = cJSON_CreateObject();
	char *text;
	FILE *file;
	int code;

	cJSON_AddItemToObject(document, name, value);
	text = json_print(document, NULL);
	code = text != NULL ? output_open(path, &file, err) : error_set(err, ERR_NO_MEMORY, "no memory for a document");
	if (code == 0) {
		fprintf(file, "%s\n", text);
		code = output_close(file, path, err);
	}
	free(text);
	cJSON_Delete(document);
	return code;
}

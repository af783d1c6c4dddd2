/* /v1/jobs/{}/volumes/{}/slice: planes of a volume as PNG, drawn from the mapped file. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/slice.h"

/* HU: from air to hard bone. */
static const double window_default = 2000, level_default = 0;
static const char *const axis_names[] = {"x", "y", "z", NULL};

struct asked {
	struct slice slice;
	double window, level; /* HU */
	int index;
	bool sheet;
};

static int read_number(struct request *request, const char *name, double least, double initial, double *ret,
		       struct error *err)
{
	const char *text = request_query(request, name);
	const double most = 1e6;
	bool negative = text != NULL && text[0] == '-';
	double number = initial;

	if (text != NULL && !number_parse(text + negative, 0, most, &number))
		number = NAN;
	*ret = negative ? -number : number;
	if (!(*ret >= least))
		return error_set(err, ERR_INVALID, "%s is \"%.40s\", expected a number from %g to %g", name, text,
				 least, most);
	return 0;
}

static int read_index(struct request *request, int count, const char *axis, int *ret_index, struct error *err)
{
	const char *text = request_query(request, "index");
	long index = count / 2;

	if (text != NULL && !index_parse(text, strlen(text), count - 1, &index))
		return error_set(err, ERR_INVALID, "index is \"%.40s\", expected a whole number from 0 to %d along %s",
				 text, count - 1, axis);
	*ret_index = (int)index;
	return 0;
}

static int read_asked(struct request *request, const struct grid *grid, double mu_water, struct asked *ret,
		      struct error *err)
{
	static const char *const switches[] = {"0", "1", NULL};
	int axis = 2, sheet;

	if ((request_query(request, "axis") != NULL && query_choice(request, "axis", axis_names, &axis, err) != 0) ||
	    query_choice(request, "sheet", switches, &sheet, err) != 0 ||
	    read_index(request, grid->size[axis], axis_names[axis], &ret->index, err) != 0 ||
	    read_number(request, "window", 1, window_default, &ret->window, err) != 0 ||
	    read_number(request, "level", -1e6, level_default, &ret->level, err) != 0)
		return err->code;
	ret->sheet = sheet == 1;
	ret->slice = (struct slice){.axis = axis,
				    .black = mu_water * (1 + (ret->level - ret->window / 2) / 1000),
				    .white = mu_water * (1 + (ret->level + ret->window / 2) / 1000)};
	return 0;
}

static int draw(const float *voxels, const struct grid *grid, const struct asked *asked, char **ret_png,
		size_t *ret_length, struct error *err)
{
	struct sheet sheet;
	int size[2], code = 0;
	double pixel_mm[2];
	unsigned char *pixels;

	slice_size(grid, asked->slice.axis, size, pixel_mm);
	if (asked->sheet) {
		sheet_plan(grid, asked->slice.axis, &sheet);
		memcpy(size, sheet.size, sizeof(size));
		pixel_mm[0] *= sheet.step;
		pixel_mm[1] *= sheet.step;
	}
	pixels = malloc((size_t)size[0] * (size_t)size[1]);
	if (pixels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture");
	if (asked->sheet)
		code = sheet_make(voxels, grid, &asked->slice, &sheet, pixels, err);
	else
		slice_make(voxels, grid, &asked->slice, asked->index, pixels);
	if (code == 0)
		code = gray_png(pixels, size[0], size[1], pixel_mm, ret_png, ret_length, err);
	free(pixels);
	return code;
}

static void make_etag(const char *job, const struct volume_record *volume, const struct asked *asked, char *ret_etag,
		      size_t size)
{
	char tag[VOLUME_TAG_MAX];

	volume_tag(job, volume, tag);
	snprintf(ret_etag, size, "\"%s-%s-%d-%g-%g\"", tag, asked->sheet ? "sheet" : axis_names[asked->slice.axis],
		 asked->sheet ? asked->slice.axis : asked->index, asked->window, asked->level);
}

static int reply_drawn(struct api *api, struct request *request, const char *job, const struct volume_record *volume,
		       const struct asked *asked, struct error *err)
{
	size_t plane = (size_t)volume->grid.size[0] * (size_t)volume->grid.size[1] * sizeof(float), length;
	bool one = asked->slice.axis == 2 && !asked->sheet;
	const struct grid *grid = &volume->grid;
	struct mapping *mapping;
	char path[1024], *png;
	int code =
	    volume_verify(api, job, volume, one ? (uint64_t)asked->index * plane : 0, one ? plane : volume->bytes, err);

	if (code != 0)
		return code;
	store_volume_path(api->store, job, volume->name, path);
	if (mapping_get(api->mappings, path, grid, &mapping, err) != 0)
		return err->code;
	code = draw(mapping_voxels(mapping), grid, asked, &png, &length, err);
	mapping_release(api->mappings, mapping);
	return code == 0 ? request_reply_bytes(request, 200, png, length, err) : code;
}

int slice_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct volume_record volume;
	struct job_facts facts;
	struct asked asked;
	char etag[160];
	struct entity entity = {.etag = etag, .size = UNKNOWN_SIZE};
	struct selection selection;
	bool done;

	if (volume_asked(api, request, &facts, &volume, err) != 0 ||
	    read_asked(request, &volume.grid, facts.mu_water, &asked, err) != 0)
		return err->code;
	make_etag(facts.id, &volume, &asked, etag, sizeof(etag));
	if (entity_select(request, &entity, &selection, &done, err) != 0 || done)
		return done ? 0 : err->code;
	if (reply_drawn(api, request, facts.id, &volume, &asked, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Type", "image/png");
	request_reply_header(request, "ETag", "%s", etag);
	request_reply_header(request, "Cache-Control", "private, no-cache");
	return 0;
}

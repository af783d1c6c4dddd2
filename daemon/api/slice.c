/*
 * /v1/jobs/{}/volumes/{}/slice: planes of a volume as PNG, drawn from the mapped file. Along the volume's axes with a
 * pixel for each voxel; with ?normal= at any angle. Slabs with ?thickness=.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/oblique.h"
#include "proto/slice.h"

/* HU: from air to hard bone. */
static const double window_default = 2000, level_default = 0;
static const double number_most = 1e6;
static const char *const axis_names[] = {"x", "y", "z", NULL};
/* Samples: a fifth of a second of a processor. A 30 mm slab of 512 x 512 pixels through voxels of .5 mm is within. */
static const double samples_most = 1 << 24;

struct asked {
	struct slice slice;
	double window, level; /* HU */
	int index;
	bool sheet, sampled; /* sampled: drawn from `oblique`; else from voxels as they are */
	struct oblique oblique;
};

/* A number as programs print them, 6.1e-17 too; NAN where the text is none or beyond number_most. */
static double number_of(const char *text)
{
	double number;
	char *end;

	/* Neither spaces, hexadecimals, infinity nor nan, all of which strtod takes. */
	if (text[0] == '\0' || strspn(text, "0123456789.eE+-") != strlen(text))
		return NAN;
	number = strtod(text, &end);
	return *end == '\0' && fabs(number) <= number_most ? number : NAN;
}

static int read_number(struct request *request, const char *name, double least, double most, double initial,
		       double *ret, struct error *err)
{
	const char *text = request_query(request, name);
	double number = text == NULL ? initial : number_of(text);

	if (!(number >= least && number <= most))
		return error_set(err, ERR_INVALID, "%s is \"%.40s\", expected a number from %g to %g", name, text,
				 least, most);
	*ret = number;
	return 0;
}

/* "1,0,-0.5": `count` numbers from least to most. Without the parameter ret stays as it is. */
static int read_numbers(struct request *request, const char *name, int count, double least, double most, double *ret,
			struct error *err)
{
	const char *text = request_query(request, name), *at = text;
	double numbers[3];
	int found = 0;

	while (at != NULL && found < count) {
		size_t length = strcspn(at, ",");
		char part[40] = "";

		if (length < sizeof(part))
			memcpy(part, at, length);
		numbers[found] = number_of(part);
		if (!(numbers[found] >= least && numbers[found] <= most))
			break;
		found++;
		at = at[length] == ',' ? at + length + 1 : NULL;
	}
	if (text != NULL && (found < count || at != NULL))
		return error_set(err, ERR_INVALID,
				 "%s is \"%.60s\", expected %d numbers from %g to %g with commas between", name, text,
				 count, least, most);
	if (text != NULL)
		memcpy(ret, numbers, (size_t)count * sizeof(*ret));
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

/* Refuses the parameters `names` (which end with NULL), saying how they stand. */
static int refuse(struct request *request, const char *const *names, const char *how, struct error *err)
{
	for (; *names != NULL; names++) {
		if (request_query(request, *names) != NULL)
			return error_set(err, ERR_INVALID, "%s is given %s", *names, how);
	}
	return 0;
}

/* ---- planes at any angle ---- */

/* "400,300": whole numbers, in digits. */
static int read_size(struct request *request, int *ret_size, struct error *err)
{
	const char *text = request_query(request, "size");
	const char *comma = text != NULL ? strchr(text, ',') : NULL;
	long columns, rows;

	if (text == NULL)
		return 0;
	if (comma == NULL || !index_parse(text, (size_t)(comma - text), OBLIQUE_SIZE_MAX, &columns) ||
	    !index_parse(comma + 1, strlen(comma + 1), OBLIQUE_SIZE_MAX, &rows) || columns < 1 || rows < 1)
		return error_set(err, ERR_INVALID,
				 "size is \"%.40s\", expected two whole numbers from 1 to %d with a comma between",
				 text, OBLIQUE_SIZE_MAX);
	ret_size[0] = (int)columns;
	ret_size[1] = (int)rows;
	return 0;
}

/* Upwards is z, or the table's front where one looks along z. */
static void default_up(const double normal[3], double ret_up[3])
{
	/* hypot() takes components whose squares would be 0 or infinite. */
	bool along = fabs(normal[2]) > 0.99 * hypot(hypot(normal[0], normal[1]), normal[2]);

	memcpy(ret_up, along ? (double[]){0, -1, 0} : (double[]){0, 0, 1}, 3 * sizeof(*ret_up));
}

static int read_oblique(struct request *request, const struct grid *grid, struct oblique *ret, struct error *err)
{
	static const char *const along_axes[] = {"axis", "index", "sheet", NULL};
	const double *spacing = grid->spacing;
	double pixel = fmin(fmin(spacing[0], spacing[1]), spacing[2]), normal[3] = {0}, up[3];
	struct oblique oblique = {0};

	for (int i = 0; i < 3; i++)
		oblique.center[i] = grid->origin[i] + (grid->size[i] - 1) * spacing[i] / 2;
	if (refuse(request, along_axes, "beside normal, expected one of them", err) != 0 ||
	    read_numbers(request, "normal", 3, -number_most, number_most, normal, err) != 0)
		return err->code;
	default_up(normal, up);
	if (read_numbers(request, "up", 3, -number_most, number_most, up, err) != 0 ||
	    read_numbers(request, "center", 3, -number_most, number_most, oblique.center, err) != 0 ||
	    read_number(request, "spacing", 0.001, 1000, pixel, &pixel, err) != 0)
		return err->code;
	oblique.pixel_mm[0] = oblique.pixel_mm[1] = pixel;
	if (normal[0] == 0 && normal[1] == 0 && normal[2] == 0)
		return error_set(err, ERR_INVALID, "normal is 0,0,0, expected a direction");
	if (up[0] == 0 && up[1] == 0 && up[2] == 0)
		return error_set(err, ERR_INVALID, "up is 0,0,0, expected a direction");
	if (!oblique_turn(&oblique, normal, up))
		return error_set(err, ERR_INVALID, "up is %g,%g,%g, parallel to the normal %g,%g,%g", up[0], up[1],
				 up[2], normal[0], normal[1], normal[2]);
	oblique_fit(&oblique, grid);
	if (read_size(request, oblique.size, err) != 0)
		return err->code;
	*ret = oblique;
	return 0;
}

static int read_slab(struct request *request, const struct grid *grid, struct asked *asked, struct error *err)
{
	static const char *const alone[] = {"mode", NULL}, *const sheet[] = {"thickness", "mode", NULL};
	struct oblique *oblique = &asked->oblique;
	double samples;
	int mode;

	if (asked->sheet)
		return refuse(request, sheet, "for a contact sheet, which has none", err);
	if (request_query(request, "thickness") == NULL)
		return refuse(request, alone, "without thickness", err);
	if (read_number(request, "thickness", 0.001, 1000, 0, &oblique->thickness, err) != 0 ||
	    query_choice(request, "mode", slab_mode_names, &mode, err) != 0)
		return err->code;
	asked->sampled = true;
	oblique->mode = (enum slab_mode)mode;
	samples = (double)oblique_layers(oblique, grid) * oblique->size[0] * oblique->size[1];
	if (samples > samples_most)
		return error_set(err, ERR_INVALID,
				 "thickness is %g mm, that is %.0f samples for %d x %d pixels, expected at most %.0f: "
				 "ask for a smaller size or a larger spacing",
				 oblique->thickness, samples, oblique->size[0], oblique->size[1], samples_most);
	return 0;
}

static int check_reach(const struct oblique *oblique, const struct grid *grid, struct error *err)
{
	double reach[2], half = oblique->thickness / 2;

	oblique_reach(oblique, grid, reach);
	if (reach[0] <= half && reach[1] >= -half)
		return 0;
	return error_set(err, ERR_INVALID,
			 "center is %g,%g,%g, the plane through it misses the volume, which lies %g to %g mm from it",
			 oblique->center[0], oblique->center[1], oblique->center[2], reach[0], reach[1]);
}

/* ---- what was asked ---- */

static int read_along(struct request *request, const struct grid *grid, struct asked *ret, struct error *err)
{
	static const char *const switches[] = {"0", "1", NULL};
	static const char *const at_angles[] = {"up", "center", "size", "spacing", NULL};
	static const char *const one[] = {"index", NULL};
	int axis = 2, sheet;

	if (refuse(request, at_angles, "without normal", err) != 0 ||
	    (request_query(request, "axis") != NULL && query_choice(request, "axis", axis_names, &axis, err) != 0) ||
	    query_choice(request, "sheet", switches, &sheet, err) != 0 ||
	    (sheet == 1 && refuse(request, one, "for a contact sheet, which shows all", err) != 0) ||
	    read_index(request, grid->size[axis], axis_names[axis], &ret->index, err) != 0)
		return err->code;
	ret->sheet = sheet == 1;
	ret->slice.axis = axis;
	ret->oblique = oblique_along(grid, axis, ret->index);
	return 0;
}

static int read_asked(struct request *request, const struct grid *grid, double mu_water, struct asked *ret,
		      struct error *err)
{
	ret->sampled = request_query(request, "normal") != NULL;
	if ((ret->sampled ? read_oblique(request, grid, &ret->oblique, err) : read_along(request, grid, ret, err)) !=
		0 ||
	    read_slab(request, grid, ret, err) != 0 || check_reach(&ret->oblique, grid, err) != 0 ||
	    read_number(request, "window", 1, number_most, window_default, &ret->window, err) != 0 ||
	    read_number(request, "level", -number_most, number_most, level_default, &ret->level, err) != 0)
		return err->code;
	ret->slice.black = ret->oblique.black = mu_water * (1 + (ret->level - ret->window / 2) / 1000);
	ret->slice.white = ret->oblique.white = mu_water * (1 + (ret->level + ret->window / 2) / 1000);
	return 0;
}

/* ---- the picture ---- */

static int draw(const float *voxels, const struct grid *grid, const struct asked *asked, struct picture *picture,
		char **ret_png, size_t *ret_length, struct error *err)
{
	struct sheet sheet;
	int size[2], code = 0;
	double pixel_mm[2];
	unsigned char *pixels;

	memcpy(size, asked->oblique.size, sizeof(size));
	memcpy(pixel_mm, asked->oblique.pixel_mm, sizeof(pixel_mm));
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
	else if (asked->sampled && !oblique_make(voxels, grid, &asked->oblique, picture_wanted, picture, pixels))
		code = error_set(err, ERR_CANCELLED, "nobody waits for the picture");
	else if (!asked->sampled)
		slice_make(voxels, grid, &asked->slice, asked->index, pixels);
	if (code == 0)
		code = gray_png(pixels, size[0], size[1], pixel_mm, ret_png, ret_length, err);
	free(pixels);
	return code;
}

/* Other numbers, another tag: all of those that the picture is made from. */
static void make_etag(const char *job, const struct volume_record *volume, const struct asked *asked, char *ret_etag,
		      size_t size)
{
	const struct oblique *o = &asked->oblique;
	char tag[VOLUME_TAG_MAX];

	volume_tag(job, volume, tag);
	if (asked->sampled)
		snprintf(ret_etag, size,
			 "\"%s-%.9g,%.9g,%.9g-%.9g,%.9g,%.9g-%.9g,%.9g,%.9g-%d,%d-%.9g,%.9g-%.9g-%s-%.9g-%.9g\"", tag,
			 o->center[0], o->center[1], o->center[2], o->right[0], o->right[1], o->right[2], o->down[0],
			 o->down[1], o->down[2], o->size[0], o->size[1], o->pixel_mm[0], o->pixel_mm[1], o->thickness,
			 slab_mode_names[o->mode], asked->window, asked->level);
	else
		snprintf(ret_etag, size, "\"%s-%s-%d-%.9g-%.9g\"", tag,
			 asked->sheet ? "sheet" : axis_names[asked->slice.axis],
			 asked->sheet ? asked->slice.axis : asked->index, asked->window, asked->level);
}

/* A picture that a request waits for. */
struct wanted {
	struct api *api;
	char job[ID_SIZE];
	struct volume_record volume;
	struct asked asked;
	struct selection selection;
	char etag[480];
};

static struct entity entity_of(const struct wanted *wanted)
{
	return (struct entity){.etag = wanted->etag, .size = UNKNOWN_SIZE, .media_type = "image/png"};
}

static int draw_wanted(void *subject, struct picture *picture, char **ret_png, size_t *ret_length, struct error *err)
{
	const struct wanted *wanted = subject;
	const struct volume_record *volume = &wanted->volume;
	const struct asked *asked = &wanted->asked;
	size_t plane = (size_t)volume->grid.size[0] * (size_t)volume->grid.size[1] * sizeof(float);
	bool one = asked->slice.axis == 2 && !asked->sheet && !asked->sampled;
	struct mapping *mapping;
	char path[1024];
	int code = volume_verify(wanted->api, wanted->job, volume, one ? (uint64_t)asked->index * plane : 0,
				 one ? plane : volume->bytes, err);

	if (code != 0)
		return code;
	store_volume_path(wanted->api->store, wanted->job, volume->name, path);
	if (mapping_get(wanted->api->mappings, path, &volume->grid, &mapping, err) != 0)
		return err->code;
	code = draw(mapping_voxels(mapping), &volume->grid, asked, picture, ret_png, ret_length, err);
	mapping_release(wanted->api->mappings, mapping);
	return code;
}

/* Which sides of the patient, or ends of the world's axes, lie at the edges of the picture. */
static void reply_sides(struct api *api, struct request *request, const struct oblique *oblique)
{
	const struct job_request *wanted;
	struct patient patient = patient_unknown;
	struct error ignored;
	struct job *job = NULL;
	char edge[4][PATIENT_LETTERS_MAX];

	if (jobs_find(api->jobs, request_argument(request, 0), &job, &ignored) == 0 &&
	    job_request(job, &wanted, &ignored) == 0)
		patient = wanted->patient;
	job_release(job);
	for (int i = 0; i < 4; i++) {
		const double *towards = i < 2 ? oblique->right : oblique->down;
		double direction[3];

		for (int k = 0; k < 3; k++)
			direction[k] = i % 2 == 0 ? -towards[k] : towards[k];
		patient_letters_towards(&patient, direction, edge[i]);
	}
	request_reply_header(request, "CBCT-Sides", "left=\"%s\", right=\"%s\", top=\"%s\", bottom=\"%s\"", edge[0],
			     edge[1], edge[2], edge[3]);
}

static void add_headers(void *subject, struct request *request)
{
	const struct wanted *wanted = subject;
	const struct entity entity = entity_of(wanted);

	entity_headers(request, &entity, &wanted->selection);
	reply_sides(wanted->api, request, &wanted->asked.oblique);
}

static const struct picture_kind slices = {draw_wanted, add_headers, NULL};

/* What the request asks for; *ret_done: it has its reply. */
static int read_wanted(struct request *request, struct wanted *wanted, bool *ret_done, struct error *err)
{
	struct entity entity = entity_of(wanted);
	struct job_facts facts;

	if (volume_asked(wanted->api, request, &facts, &wanted->volume, err) != 0 ||
	    read_asked(request, &wanted->volume.grid, facts.mu_water, &wanted->asked, err) != 0)
		return err->code;
	snprintf(wanted->job, sizeof(wanted->job), "%s", facts.id);
	make_etag(facts.id, &wanted->volume, &wanted->asked, wanted->etag, sizeof(wanted->etag));
	return entity_select(request, &entity, &wanted->selection, ret_done, err);
}

int slice_get(void *context, struct request *request, struct error *err)
{
	struct wanted *wanted;
	bool done = false;
	int code;

	if (request_state(request) != NULL)
		return picture_go_on(request, err);
	wanted = calloc(1, sizeof(*wanted));
	if (wanted == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture");
	wanted->api = context;
	code = read_wanted(request, wanted, &done, err);
	if (code == 0 && !done)
		return picture_begin(context, request, &slices, wanted, err);
	free(wanted);
	return code;
}

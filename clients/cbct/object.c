/* The object of a simulation: see object.h. */
#include "clients/cbct/object.h"

#include <math.h>
#include <stdlib.h>

#include "proto/calibration.h"

static const char *const sampling_names[] = {"nearest", "trilinear", NULL};

#define ROW(name, kind, member, argument, help, least, most, count, names)                                             \
	{                                                                                                              \
		name, 0, kind, offsetof(struct object_options, member), argument, help, least, most, count, names      \
	}
const struct option object_phantom_rows[] = {
    ROW("phantom", OPTION_CHOICE, phantom, "NAME", "shapes with exact line integrals", 0, 0, 0, phantom_names),
    ROW("balls", OPTION_TEXT, balls, "FILE", "a phantom of balls in place of a name: what cbct calibrate is given", 0,
	0, 0, NULL),
    ROW("scale", OPTION_NUMBER, scale, "MM", "the phantom's unit of length", 1e-6, 1e6, 0, NULL),
    ROW("density", OPTION_NUMBER, density, "MU", "the phantom's unit of density, 1/mm", -1e6, 1e6, 0, NULL),
    ROW("shift", OPTION_NUMBERS, shift, "X,Y,Z", "moves the phantom or volume, mm", 0, 0, 3, NULL),
    {0},
};
const struct option object_volume_rows[] = {
    ROW("volume", OPTION_TEXT, volume, "FILE", "a volume file (.nii, .mha, .nrrd, anything else is raw float32)", 0, 0,
	0, NULL),
    ROW("sampling", OPTION_CHOICE, sampling, "HOW", "how rays sample it", 0, 0, 0, sampling_names),
    ROW("step", OPTION_NUMBER, step, "MM", "between samples along a ray (default half of the smallest spacing)", 1e-6,
	1e6, 0, NULL),
    {0},
};

static int volume_open(const struct object_options *options, struct object *object, struct error *err)
{
	const struct volume_options *file = &options->file;
	int code = volume_load(options->volume, file, NULL, &object->grid, NULL, &object->voxels, err);

	if (code != 0)
		return code;
	if (file->hu)
		volume_from_hu(object->voxels, grid_voxels(&object->grid), file->mu_water);
	for (int i = 0; i < 3; i++)
		object->grid.origin[i] += options->shift[i];
	object->sampling = (enum sampling)options->sampling;
	object->step = options->step;
	if (isnan(object->step))
		object->step =
		    0.5 * fmin(object->grid.spacing[0], fmin(object->grid.spacing[1], object->grid.spacing[2]));
	return 0;
}

/* Each ball is an ellipsoid of three equal axes. */
static int balls_open(const struct object_options *options, struct phantom *ret_phantom, struct error *err)
{
	struct phantom phantom = {0};
	struct balls balls;
	char *text = NULL;
	size_t length;
	int code = file_read(options->balls, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = balls_parse(text, length, &balls, err);
	free(text);
	if (code != 0)
		return code;
	phantom.parts = calloc((size_t)balls.count, sizeof(*phantom.parts));
	if (phantom.parts == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d balls", balls.count);
	for (int i = 0; i < balls.count && code == 0; i++) {
		struct ellipsoid *part = &phantom.parts[phantom.count++];

		part->shape = SHAPE_ELLIPSOID;
		part->density = options->density;
		for (int axis = 0; axis < 3; axis++) {
			part->semi_axes[axis] = .5 * balls.ball[i].diameter;
			part->centre[axis] = balls.ball[i].centre[axis];
		}
	}
	balls_clear(&balls);
	if (code == 0)
		*ret_phantom = phantom;
	return code;
}

int object_open(const struct object_options *options, struct object *ret_object, struct error *err)
{
	struct object object = {0};
	int code;

	if ((options->phantom != OPTION_UNSET_CHOICE) + (options->volume != NULL) + (options->balls != NULL) != 1)
		return error_set(err, ERR_USAGE, "either --phantom NAME, --balls FILE or --volume FILE is expected");
	if (options->balls != NULL) {
		code = balls_open(options, &object.phantom, err);
		if (code == 0)
			phantom_move(&object.phantom, options->shift);
	} else if (options->volume == NULL) {
		code = phantom_named(&object.phantom, phantom_names[options->phantom], options->scale, options->density,
				     err);
		if (code == 0)
			phantom_move(&object.phantom, options->shift);
	} else {
		code = volume_open(options, &object, err);
	}
	if (code == 0)
		*ret_object = object;
	return code;
}

void object_close(struct object *object)
{
	phantom_clear(&object->phantom);
	free(object->voxels);
	object->voxels = NULL;
}

void object_project(const struct object *object, const struct geometry *geometry, int view, float *ret_projection)
{
	if (object->voxels == NULL)
		phantom_project(&object->phantom, geometry, view, ret_projection);
	else
		volume_project_fine(object->voxels, &object->grid, geometry, view, object->sampling, object->step,
				    ret_projection);
}

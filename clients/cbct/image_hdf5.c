/*
 * Projections in HDF5: NeXus's NXtomo (instrument/detector/data with image_key, sample/rotation_angle) and Data
 * Exchange (exchange/data, exchange/theta), [image][row][column] in each. libhdf5 is loaded when the first such file
 * comes, so that nothing else needs it; its types are those of versions 1.10 to 1.14, and another one is refused. Of
 * NXtomo the images of the key 0 are read; flat and dark ones (1, 2) among them are passed over and told.
 */
#include <dlfcn.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/images.h"

typedef int64_t hid;     /* hid_t, negative: failed */
typedef uint64_t extent; /* hsize_t */

/* What is called of the library, as its manual declares it. */
static struct {
	int (*open_library)(void);
	int (*get_libversion)(unsigned *major, unsigned *minor, unsigned *release);
	int (*set_auto)(hid stack, void *function, void *context);
	hid (*open_file)(const char *name, unsigned flags, hid access);
	int (*close_file)(hid file);
	hid (*open_dataset)(hid file, const char *name, hid access);
	int (*close_dataset)(hid dataset);
	hid (*get_space)(hid dataset);
	hid (*get_type)(hid dataset);
	int (*read)(hid dataset, hid type, hid memory, hid space, hid transfer, void *to);
	int (*get_ndims)(hid space);
	int (*get_dims)(hid space, extent *dims, extent *most);
	hid (*create_space)(int rank, const extent *dims, const extent *most);
	int (*select)(hid space, int operation, const extent *start, const extent *stride, const extent *count,
		      const extent *block);
	int (*close_space)(hid space);
	int (*get_class)(hid type);
	size_t (*get_size)(hid type);
	int (*get_sign)(hid type);
	int (*close_type)(hid type);
	int (*is_variable)(hid type);
	hid (*open_attribute)(hid object, const char *name, hid access);
	hid (*get_attribute_type)(hid attribute);
	int (*read_attribute)(hid attribute, hid type, void *to);
	int (*close_attribute)(hid attribute);
	int (*free_memory)(void *memory);
	const hid *native_float, *native_double; /* H5T_NATIVE_FLOAT, H5T_NATIVE_DOUBLE */
} h5;

static const struct {
	const char *name;
	void *to;
} symbols[] = {
    {"H5open", &h5.open_library},
    {"H5get_libversion", &h5.get_libversion},
    {"H5Eset_auto2", &h5.set_auto},
    {"H5Fopen", &h5.open_file},
    {"H5Fclose", &h5.close_file},
    {"H5Dopen2", &h5.open_dataset},
    {"H5Dclose", &h5.close_dataset},
    {"H5Dget_space", &h5.get_space},
    {"H5Dget_type", &h5.get_type},
    {"H5Dread", &h5.read},
    {"H5Sget_simple_extent_ndims", &h5.get_ndims},
    {"H5Sget_simple_extent_dims", &h5.get_dims},
    {"H5Screate_simple", &h5.create_space},
    {"H5Sselect_hyperslab", &h5.select},
    {"H5Sclose", &h5.close_space},
    {"H5Tget_class", &h5.get_class},
    {"H5Tget_size", &h5.get_size},
    {"H5Tget_sign", &h5.get_sign},
    {"H5Tclose", &h5.close_type},
    {"H5Tis_variable_str", &h5.is_variable},
    {"H5Aopen", &h5.open_attribute},
    {"H5Aget_type", &h5.get_attribute_type},
    {"H5Aread", &h5.read_attribute},
    {"H5Aclose", &h5.close_attribute},
    {"H5free_memory", &h5.free_memory},
    {"H5T_NATIVE_FLOAT_g", &h5.native_float},
    {"H5T_NATIVE_DOUBLE_g", &h5.native_double},
};

enum { CLASS_INTEGER = 0, CLASS_FLOAT = 1, RANK = 3, VERSION_LEAST = 10, VERSION_MOST = 14 };

struct hdf5 {
	hid file, data;
	extent *frames; /* [count], of the dataset: those that are projections */
};

/* Once; what was loaded stays until the program ends. */
static int load(struct error *err)
{
	static const char *const libraries[] = {"libhdf5_serial.so.103", "libhdf5.so.103", "libhdf5.so.200",
						"libhdf5.so.310", "libhdf5_serial.so"};
	unsigned major = 0, minor = 0, release = 0;
	static void *library;

	if (library != NULL)
		return 0;
	for (size_t i = 0; i < sizeof(libraries) / sizeof(libraries[0]) && library == NULL; i++)
		library = dlopen(libraries[i], RTLD_NOW);
	if (library == NULL)
		return error_set(err, ERR_NOT_FOUND,
				 "HDF5 is read by libhdf5, which is not here: it comes with the package libhdf5-103-1");
	for (size_t i = 0; i < sizeof(symbols) / sizeof(symbols[0]); i++) {
		void *found = dlsym(library, symbols[i].name);

		memcpy(symbols[i].to, &found, sizeof(found));
		if (found == NULL) {
			dlclose(library);
			library = NULL;
			return error_set(err, ERR_IMPOSSIBLE, "the library libhdf5 has no %s", symbols[i].name);
		}
	}
	h5.open_library();
	h5.get_libversion(&major, &minor, &release);
	if (major != 1 || minor < VERSION_LEAST || minor > VERSION_MOST) {
		dlclose(library);
		library = NULL;
		return error_set(err, ERR_IMPOSSIBLE, "libhdf5 %u.%u: 1.%d to 1.%d are known", major, minor,
				 VERSION_LEAST, VERSION_MOST);
	}
	/* It would write what it thinks to standard error. */
	h5.set_auto(0, NULL, NULL);
	return 0;
}

static bool hdf5_recognise(const unsigned char *head, size_t length)
{
	return length >= 8 && memcmp(head, "\211HDF\r\n\032\n", 8) == 0;
}

static void hdf5_close(struct image_file *file)
{
	struct hdf5 *hdf5 = file->state;

	if (hdf5 == NULL)
		return;
	if (hdf5->data >= 0)
		h5.close_dataset(hdf5->data);
	if (hdf5->file >= 0)
		h5.close_file(hdf5->file);
	free(hdf5->frames);
	free(hdf5);
}

/* The first of these that is there; -1: none. */
static hid open_any(const struct hdf5 *hdf5, const char *const *names)
{
	hid found = -1;

	for (; *names != NULL && found < 0; names++)
		found = h5.open_dataset(hdf5->file, *names, 0);
	return found;
}

/* The sizes of a dataset of at most RANK dimensions; how many it has, -1: more. */
static int sizes_of(hid dataset, extent ret[RANK])
{
	const hid space = h5.get_space(dataset);
	int rank = space >= 0 ? h5.get_ndims(space) : -1;

	if (rank >= 0 && rank <= RANK)
		h5.get_dims(space, ret, NULL);
	else
		rank = -1;
	if (space >= 0)
		h5.close_space(space);
	return rank;
}

/* All numbers of a list of `most` entries at most, or a single one, the caller's to free; NULL: there are none. */
static double *numbers_of(const struct hdf5 *hdf5, const char *const *names, extent most, extent *ret_count)
{
	const hid dataset = open_any(hdf5, names);
	extent sizes[RANK] = {1, 1, 1};
	double *numbers = NULL;

	*ret_count = 0;
	if (dataset < 0)
		return NULL;
	if (sizes_of(dataset, sizes) >= 0 && sizes[0] * sizes[1] * sizes[2] >= 1 && sizes[1] * sizes[2] == 1 &&
	    sizes[0] <= most) {
		*ret_count = sizes[0];
		numbers = malloc(sizes[0] * sizeof(*numbers));
	}
	if (numbers != NULL && h5.read(dataset, *h5.native_double, 0, 0, 0, numbers) < 0) {
		free(numbers);
		numbers = NULL;
		*ret_count = 0;
	}
	h5.close_dataset(dataset);
	return numbers;
}

/* The attribute "units" of a dataset; "" where it has none. */
static void units_of(const struct hdf5 *hdf5, const char *const *names, char ret[16])
{
	const hid dataset = open_any(hdf5, names);
	const hid attribute = dataset >= 0 ? h5.open_attribute(dataset, "units", 0) : -1;
	const hid type = attribute >= 0 ? h5.get_attribute_type(attribute) : -1;
	char text[64] = "", *pointer = NULL;

	ret[0] = '\0';
	if (type >= 0 && h5.is_variable(type) > 0) {
		if (h5.read_attribute(attribute, type, &pointer) >= 0 && pointer != NULL) {
			snprintf(ret, 16, "%s", pointer);
			h5.free_memory(pointer);
		}
	} else if (type >= 0 && h5.get_size(type) < sizeof(text) && h5.read_attribute(attribute, type, text) >= 0) {
		snprintf(ret, 16, "%.15s", text);
	}
	if (type >= 0)
		h5.close_type(type);
	if (attribute >= 0)
		h5.close_attribute(attribute);
	if (dataset >= 0)
		h5.close_dataset(dataset);
}

static const char *const data_names[] = {"/entry/instrument/detector/data",
					 "/entry1/instrument/detector/data",
					 "/entry/data/data",
					 "/entry1/tomo_entry/instrument/detector/data",
					 "/exchange/data",
					 NULL};
static const char *const key_names[] = {"/entry/instrument/detector/image_key", "/entry1/instrument/detector/image_key",
					"/entry/data/image_key", "/entry1/tomo_entry/instrument/detector/image_key",
					NULL};
static const char *const angle_names[] = {"/entry/sample/rotation_angle",
					  "/entry1/sample/rotation_angle",
					  "/entry/data/rotation_angle",
					  "/entry1/tomo_entry/sample/rotation_angle",
					  "/exchange/theta",
					  NULL};
static const char *const pixel_names[2][4] = {
    {"/entry/instrument/detector/x_pixel_size", "/entry1/instrument/detector/x_pixel_size",
     "/entry1/tomo_entry/instrument/detector/x_pixel_size", NULL},
    {"/entry/instrument/detector/y_pixel_size", "/entry1/instrument/detector/y_pixel_size",
     "/entry1/tomo_entry/instrument/detector/y_pixel_size", NULL}};
static const char *const distance_names[] = {"/entry/instrument/detector/distance",
					     "/entry1/instrument/detector/distance", NULL};
static const char *const source_names[] = {"/entry/instrument/source/distance", "/entry1/instrument/source/distance",
					   NULL};

/* A length in mm; NaN where it is not told, or in a unit that is not known. */
static double length_of(const struct hdf5 *hdf5, const char *const *names)
{
	static const struct {
		const char *name;
		double mm;
	} units[] = {{"m", 1e3}, {"cm", 10}, {"mm", 1}, {"um", 1e-3}, {"micron", 1e-3}, {"", 1e3}};
	extent count;
	double *numbers = numbers_of(hdf5, names, 1, &count), mm = NAN;
	char unit[16];

	units_of(hdf5, names, unit);
	for (size_t i = 0; i < sizeof(units) / sizeof(units[0]) && numbers != NULL; i++)
		if (strcmp(unit, units[i].name) == 0)
			mm = numbers[0] * units[i].mm;
	free(numbers);
	return isfinite(mm) && mm != 0 ? fabs(mm) : NAN;
}

static int pixel_type_of(hid dataset, enum pixel_type *ret, struct error *err)
{
	static const enum pixel_type whole[2][3] = {{PIXEL_UINT8, PIXEL_UINT16, PIXEL_UINT32},
						    {PIXEL_INT8, PIXEL_INT16, PIXEL_INT32}};
	const hid type = h5.get_type(dataset);
	const int kind = type >= 0 ? h5.get_class(type) : -1,
		  is_signed = kind == CLASS_INTEGER && h5.get_sign(type) != 0;
	const size_t size = type >= 0 ? h5.get_size(type) : 0;
	int code = 0;

	if (kind == CLASS_INTEGER && (size == 1 || size == 2 || size == 4))
		*ret = whole[is_signed][size == 1 ? 0 : size == 2 ? 1 : 2];
	else if (kind == CLASS_FLOAT && (size == 4 || size == 8))
		*ret = size == 4 ? PIXEL_FLOAT32 : PIXEL_FLOAT64;
	else
		code = error_set(err, ERR_INVALID, "numbers of %zu bytes and the class %d of HDF5 are not read", size,
				 kind);
	if (type >= 0)
		h5.close_type(type);
	return code;
}

/* Which images are projections, and where each was taken. */
static int take_frames(struct image_file *file, struct hdf5 *hdf5, extent all, struct error *err)
{
	extent keys = 0, angles = 0;
	double *key = numbers_of(hdf5, key_names, all, &keys);
	double *angle = numbers_of(hdf5, angle_names, all, &angles);
	int code = 0, passed = 0;

	hdf5->frames = malloc(all * sizeof(*hdf5->frames));
	file->circle.degrees = malloc(all * sizeof(*file->circle.degrees));
	if (hdf5->frames == NULL || file->circle.degrees == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %llu images", (unsigned long long)all);
	else if (key != NULL && keys != all)
		code = error_set(err, ERR_INVALID, "%llu keys for %llu images", (unsigned long long)keys,
				 (unsigned long long)all);
	for (extent k = 0; k < all && code == 0; k++) {
		if (key != NULL && key[k] != 0) {
			passed++;
			continue;
		}
		/* The object turns, not the source. */
		file->circle.degrees[file->count] = angle != NULL && k < angles ? -angle[k] : NAN;
		hdf5->frames[file->count++] = k;
	}
	if (passed > 0)
		fprintf(stderr,
			"note: %d images of the file are no projections by their image_key, and left out (--flat and "
			"--dark tell such images, --air the open beam)\n",
			passed);
	if (angles != all) {
		free(file->circle.degrees);
		file->circle.degrees = NULL;
	}
	free(key);
	free(angle);
	return code;
}

static int take_data(struct image_file *file, struct hdf5 *hdf5, struct error *err)
{
	struct image_circle *circle = &file->circle;
	extent sizes[RANK];
	double to_axis;
	int code;

	hdf5->data = open_any(hdf5, data_names);
	if (hdf5->data < 0)
		return error_set(err, ERR_INVALID,
				 "it has neither NeXus's instrument/detector/data nor Data Exchange's exchange/data");
	if (sizes_of(hdf5->data, sizes) != RANK)
		return error_set(err, ERR_INVALID, "its data are not [image][row][column]");
	if (sizes[0] < 1 || sizes[0] > VIEWS_MAX || sizes[1] < 1 || sizes[1] > DETECTOR_MAX || sizes[2] < 1 ||
	    sizes[2] > DETECTOR_MAX)
		return error_set(err, ERR_IMPOSSIBLE, "%llu images of %llu x %llu pixels", (unsigned long long)sizes[0],
				 (unsigned long long)sizes[2], (unsigned long long)sizes[1]);
	file->rows = (int)sizes[1];
	file->columns = (int)sizes[2];
	code = pixel_type_of(hdf5->data, &file->type, err);
	if (code == 0)
		code = take_frames(file, hdf5, sizes[0], err);
	for (int i = 0; i < 2; i++)
		file->pixel[i] = length_of(hdf5, pixel_names[i]);
	/* NeXus measures both distances from the object; those of parallel beams lead nowhere. */
	to_axis = length_of(hdf5, source_names);
	circle->source_to_isocentre = to_axis;
	circle->source_to_detector = to_axis + length_of(hdf5, distance_names);
	return code;
}

static int hdf5_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct hdf5 *hdf5;
	int code = load(err);

	(void)options;
	if (code != 0)
		return code;
	hdf5 = calloc(1, sizeof(*hdf5));
	if (hdf5 == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a file");
	hdf5->data = -1;
	file->state = hdf5;
	hdf5->file = h5.open_file(path, 0 /* for reading */, 0);
	if (hdf5->file < 0)
		return error_set(err, ERR_INVALID, "libhdf5 cannot read it");
	return take_data(file, hdf5, err);
}

static int hdf5_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	const struct hdf5 *hdf5 = file->state;
	const extent start[RANK] = {hdf5->frames[index], 0, 0};
	const extent count[RANK] = {1, (extent)file->rows, (extent)file->columns};
	const hid space = h5.get_space(hdf5->data), memory = h5.create_space(RANK, count, NULL);
	const int set = 0; /* H5S_SELECT_SET */
	int code = 0;

	if (space < 0 || memory < 0 || h5.select(space, set, start, NULL, count, NULL) < 0 ||
	    h5.read(hdf5->data, *h5.native_float, memory, space, 0, ret_pixels) < 0)
		code = error_set(
		    err, ERR_INVALID,
		    "image %d cannot be read: it is broken, or of a compression that libhdf5 does not know", index + 1);
	if (space >= 0)
		h5.close_space(space);
	if (memory >= 0)
		h5.close_space(memory);
	return code;
}

const struct image_format image_hdf5 = {"HDF5 (NeXus)", hdf5_recognise, hdf5_open, hdf5_read, hdf5_close};

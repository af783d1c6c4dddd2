/* Planes of a volume as gray pictures: which voxel stands where, how gray it is, and PNG that reads back. */
#include <check.h>
#include <math.h>
#include <png.h>
#include <stdlib.h>
#include <string.h>

#include "proto/refinement.h"
#include "proto/slice.h"

enum { NX = 7, NY = 5, NZ = 4, COUNT = NX * NY * NZ };
static const struct grid grid = {.size = {NX, NY, NZ}, .spacing = {0.5, 0.8, 2}};

/* Gray level of voxel x, y, z with black 0 and white 255. */
static int level_of(int x, int y, int z)
{
	return (z * NY + y) * NX + x;
}

static void fill(float voxels[COUNT])
{
	for (int i = 0; i < COUNT; i++)
		voxels[i] = (float)i;
}

START_TEST(each_voxel_stands_where_a_radiologist_looks_for_it)
{
	float voxels[COUNT];
	unsigned char pixels[COUNT];

	fill(voxels);
	for (int axis = 0; axis < 3; axis++) {
		const struct slice slice = {.axis = axis, .black = 0, .white = 255};
		int size[2];
		double pixel_mm[2];

		slice_size(&grid, axis, size, pixel_mm);
		ck_assert_int_eq(size[0] * size[1] * grid.size[axis], COUNT);
		ck_assert_double_eq(pixel_mm[0], grid.spacing[axis == 0 ? 1 : 0]);
		ck_assert_double_eq(pixel_mm[1], grid.spacing[axis == 2 ? 1 : 2]);
		for (int index = 0; index < grid.size[axis]; index++) {
			slice_make(voxels, &grid, &slice, index, pixels);
			for (int row = 0; row < size[1]; row++) {
				for (int column = 0; column < size[0]; column++) {
					int z = axis == 2 ? index : NZ - 1 - row;
					int y = axis == 2 ? row : axis == 1 ? index : column;
					int x = axis == 0 ? index : column;

					ck_assert_int_eq(pixels[row * size[0] + column], level_of(x, y, z));
				}
			}
		}
	}
}
END_TEST

START_TEST(window_clips_and_nothing_finite_is_black)
{
	static const struct grid row = {.size = {8, 1, 1}, .spacing = {1, 1, 1}};
	static const float voxels[8] = {-INFINITY, 0.0099f, 0.01f, 0.02f, 0.03f, 0.031f, INFINITY, NAN};
	static const int expected[8] = {0, 0, 0, 128, 255, 255, 255, 0};
	const struct slice slice = {.axis = 2, .black = 0.01, .white = 0.03};
	unsigned char pixels[8];

	slice_make(voxels, &row, &slice, 0, pixels);
	for (int i = 0; i < 8; i++)
		ck_assert_int_le(abs(pixels[i] - expected[i]), 1); /* float32 at the edges of a level */
}
END_TEST

START_TEST(a_sheet_has_every_plane_in_reading_order)
{
	const struct slice slice = {.axis = 2, .black = 0, .white = 255};
	float voxels[COUNT];
	unsigned char *pixels;
	struct error err;
	struct sheet sheet;

	fill(voxels);
	sheet_plan(&grid, 2, &sheet);
	ck_assert_int_eq(sheet.planes, NZ);
	ck_assert_int_eq(sheet.columns, NZ);
	ck_assert_int_eq(sheet.rows, 1);
	ck_assert_int_eq(sheet.step, 1);
	pixels = malloc((size_t)sheet.size[0] * (size_t)sheet.size[1]);
	ck_assert_int_eq(sheet_make(voxels, &grid, &slice, &sheet, pixels, &err), 0);
	for (int z = 0; z < NZ; z++) {
		for (int y = 0; y < NY; y++) {
			for (int x = 0; x < NX; x++)
				ck_assert_int_eq(pixels[y * sheet.size[0] + z * NX + x], level_of(x, y, z));
		}
	}
	free(pixels);
}
END_TEST

START_TEST(a_sheet_of_a_large_volume_is_made_smaller_and_stays_inside)
{
	static const struct grid large = {.size = {401, 3, 101}, .spacing = {1, 1, 1}};
	const struct slice slice = {.axis = 2, .black = 0, .white = 255};
	float *voxels = malloc(grid_voxels(&large) * sizeof(*voxels));
	unsigned char *pixels;
	struct error err;
	struct sheet sheet;

	for (size_t i = 0; i < grid_voxels(&large); i++)
		voxels[i] = 77;
	sheet_plan(&large, 2, &sheet);
	ck_assert_int_eq(sheet.planes, 36);
	ck_assert_int_eq(sheet.step, 3);
	ck_assert_int_eq(sheet.tile[0], 134); /* ceil(401 / 3) */
	ck_assert_int_eq(sheet.tile[1], 1);
	pixels = malloc((size_t)sheet.size[0] * (size_t)sheet.size[1]);
	ck_assert_int_eq(sheet_make(voxels, &large, &slice, &sheet, pixels, &err), 0);
	for (int i = 0; i < sheet.size[0] * sheet.size[1]; i++)
		ck_assert_int_eq(pixels[i], 77); /* a mean of equal ones, at the edges too */
	free(pixels);
	free(voxels);
}
END_TEST

START_TEST(png_reads_back_as_it_was)
{
	enum { WIDTH = 301, HEIGHT = 77 };
	static const double pixel_mm[2] = {0.5, 2};
	unsigned char *pixels = malloc(WIDTH * HEIGHT), *back = malloc(WIDTH * HEIGHT);
	png_image image = {.version = PNG_IMAGE_VERSION};
	struct error err;
	char *png;
	size_t length;

	srandom(7);
	for (int i = 0; i < WIDTH * HEIGHT; i++) /* flat, smooth and noisy parts */
		pixels[i] = (unsigned char)(i % WIDTH < 100 ? 9 : i % WIDTH < 200 ? i % 256 : random() % 256);
	ck_assert_int_eq(gray_png(pixels, WIDTH, HEIGHT, pixel_mm, &png, &length, &err), 0);
	ck_assert_int_ne(png_image_begin_read_from_memory(&image, png, length), 0);
	ck_assert_int_eq((int)image.width, WIDTH);
	ck_assert_int_eq((int)image.height, HEIGHT);
	ck_assert_int_eq((int)image.format, PNG_FORMAT_GRAY);
	ck_assert_int_ne(png_image_finish_read(&image, NULL, back, WIDTH, NULL), 0);
	ck_assert_mem_eq(back, pixels, WIDTH * HEIGHT);
	free(png);
	free(pixels);
	free(back);
}
END_TEST

/* Views whose shift along the columns grows from 0 to 1 mm. */
static cJSON *refinement_document(int views)
{
	cJSON *document = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(document, "views");

	cJSON_AddStringToObject(document, "kind", "geometry");
	for (int k = 0; k < views; k++) {
		cJSON *view = cJSON_CreateObject();

		cJSON_AddNumberToObject(view, "projection", k);
		cJSON_AddItemToObject(view, "shift_mm", cJSON_CreateDoubleArray((double[]){k / (views - 1.), 0, 0}, 3));
		cJSON_AddItemToObject(view, "turn_deg", cJSON_CreateDoubleArray((double[3]){0}, 3));
		cJSON_AddItemToArray(list, view);
	}
	return document;
}

START_TEST(a_refinement_is_plotted_over_its_views)
{
	enum { VIEWS = 11, WIDTH = 960, HEIGHT = 640 };
	cJSON *document = refinement_document(VIEWS), *none = refinement_document(0);
	unsigned char *pixels = malloc(WIDTH * HEIGHT);
	png_image image = {.version = PNG_IMAGE_VERSION};
	struct error err;
	char *png;
	size_t length;

	ck_assert_int_eq(refinement_picture(none, &png, &length, &err), ERR_CONFLICT);
	ck_assert_int_eq(refinement_picture(document, &png, &length, &err), 0);
	ck_assert_int_ne(png_image_begin_read_from_memory(&image, png, length), 0);
	ck_assert_int_eq((int)image.width, WIDTH);
	ck_assert_int_eq((int)image.height, HEIGHT);
	ck_assert_int_ne(png_image_finish_read(&image, NULL, pixels, WIDTH, NULL), 0);
	/* The panel is 232 pixels high from 44 on, and a twentieth of the range stays free above and below. */
	for (int k = 1; k < VIEWS - 1; k++) {
		const int column = 96 + 84 * k, row = 44 + (int)lround(232 * (1.05 - k / 10.) / 1.1);

		ck_assert_int_lt(pixels[row * WIDTH + column], 128); /* black covers at least half of it */
		ck_assert_int_gt(pixels[(row - 9) * WIDTH + column], 200);
	}
	free(png);
	free(pixels);
	cJSON_Delete(document);
	cJSON_Delete(none);
}
END_TEST

Suite *slice_suite(void)
{
	Suite *suite = suite_create("slice");
	TCase *planes = tcase_create("planes");

	tcase_add_test(planes, each_voxel_stands_where_a_radiologist_looks_for_it);
	tcase_add_test(planes, window_clips_and_nothing_finite_is_black);
	tcase_add_test(planes, a_sheet_has_every_plane_in_reading_order);
	tcase_add_test(planes, a_sheet_of_a_large_volume_is_made_smaller_and_stays_inside);
	tcase_add_test(planes, png_reads_back_as_it_was);
	tcase_add_test(planes, a_refinement_is_plotted_over_its_views);
	suite_add_tcase(suite, planes);
	return suite;
}

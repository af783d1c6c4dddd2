/* Volume files: headers byte by byte, orientation, Hounsfield units, and every format read back. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "proto/format.h"
#include "proto/nifti.h"
#include "tests/unit/volume_file.h"

static const struct grid grid = {{3, 2, 4}, {0.5, 0.75, 1.25}, {-10, 20.5, 0.1}};
enum { VOXELS = 3 * 2 * 4 };

/* ---- headers ---- */

static int at16(const uint8_t *h, int offset)
{
	return (int16_t)(h[offset] | h[offset + 1] << 8);
}

static float at_float(const uint8_t *h, int offset)
{
	float number;

	memcpy(&number, h + offset, 4); /* the tests run on little-endian machines */
	return number;
}

/* Of a file of which nothing but the voxels is known. */
static const struct provenance *nothing(void)
{
	static struct provenance provenance;

	provenance.patient = patient_unknown;
	return &provenance;
}

static size_t header_of(const char *name, const struct grid *of, enum volume_type type,
			const struct provenance *provenance, uint8_t *h)
{
	struct error err = {0};
	size_t length = 0;

	ck_assert_msg(volume_format_find(name)->header(of, type, provenance, h, &length, &err) == 0, "%s", err.text);
	return length;
}

START_TEST(nifti_headers_say_where_right_and_front_are)
{
	uint8_t h[FORMAT_HEADER_MAX];

	memset(h, 0xee, sizeof(h));
	ck_assert_uint_eq(header_of("nifti", &grid, VOLUME_FLOAT32, nothing(), h), 4096);
	/* offsets as in nifti1.h */
	ck_assert_int_eq(at16(h, 0), 348);
	ck_assert_int_eq(at16(h, 2), 0);
	ck_assert_int_eq(at16(h, 40), 3);
	ck_assert_int_eq(at16(h, 42), 3);
	ck_assert_int_eq(at16(h, 44), 2);
	ck_assert_int_eq(at16(h, 46), 4);
	for (int i = 48; i <= 54; i += 2)
		ck_assert_int_eq(at16(h, i), 1);
	ck_assert_int_eq(at16(h, 70), 16); /* float32 */
	ck_assert_int_eq(at16(h, 72), 32);
	ck_assert_float_eq(at_float(h, 76), 1); /* qfac */
	ck_assert_float_eq(at_float(h, 80), 0.5f);
	ck_assert_float_eq(at_float(h, 84), 0.75f);
	ck_assert_float_eq(at_float(h, 88), 1.25f);
	ck_assert_float_eq(at_float(h, 108), 4096); /* vox_offset */
	ck_assert_float_eq(at_float(h, 112), 1);    /* scl_slope */
	ck_assert_float_eq(at_float(h, 116), 0);    /* scl_inter */
	ck_assert_int_eq(h[123], 2);                /* mm */
	ck_assert_str_eq((char *)h + 148, "1/mm, left and right are not known");
	ck_assert_int_eq(at16(h, 252), 1); /* qform */
	ck_assert_int_eq(at16(h, 254), 1); /* sform */
	/* World x and y run to the patient's left and back; NIfTI's to the right and front. */
	const float quaternion[3] = {0, 0, 1}, offset[3] = {10, -20.5f, 0.1f};
	const float rows[3][4] = {{-0.5f, 0, 0, 10}, {0, -0.75f, 0, -20.5f}, {0, 0, 1.25f, 0.1f}};

	for (int i = 0; i < 3; i++) {
		ck_assert_float_eq(at_float(h, 256 + 4 * i), quaternion[i]);
		ck_assert_float_eq(at_float(h, 268 + 4 * i), offset[i]);
		for (int j = 0; j < 4; j++)
			ck_assert_float_eq(at_float(h, 280 + 16 * i + 4 * j), rows[i][j]);
	}
	ck_assert_mem_eq(h + 344, "n+1\0\1\0\0\0", 8);        /* and an extension: */
	ck_assert_mem_eq(h + 352, "\xa0\x0e\0\0\6\0\0\0", 8); /* 3744 bytes of a comment */
	ck_assert_str_eq((char *)h + 360, "{\"unit\":\"1/mm\",\"left_right\":\"not known\",\"patient\":null}");
	for (size_t i = 360 + strlen((char *)h + 360); i < 4096; i++)
		ck_assert_int_eq(h[i], 0);
	header_of("nifti", &grid, VOLUME_INT16, nothing(), h);
	ck_assert_int_eq(at16(h, 70), 4);
	ck_assert_int_eq(at16(h, 72), 16);
	ck_assert_float_eq(at_float(h, 112), 1);
	ck_assert_str_eq((char *)h + 148, "HU, left and right are not known");
}
END_TEST

static void assert_text_header(const char *name, enum volume_type type, const struct provenance *provenance,
			       const char *expected)
{
	uint8_t h[FORMAT_HEADER_MAX];
	size_t length = header_of(name, &grid, type, provenance, h);

	ck_assert_msg(length == strlen(expected) && memcmp(h, expected, length) == 0, "%.*s", (int)length, (char *)h);
}

/* Of a patient on the front, whose right is then at the world's +x and whose front is at +y. */
static struct provenance prone(void)
{
	struct provenance provenance = {.patient = patient_in(PATIENT_HFP),
					.program = "cbctd 9",
					.stage = "sart",
					.iteration = 3,
					.job = "j1",
					.scan = "s2",
					.scan_name = "a \\ b"};

	provenance.recipe = cJSON_Parse("{\"fdk\": {\"window\": \"hann\"}, \"tv\": null}");
	ck_assert_ptr_nonnull(provenance.recipe);
	return provenance;
}

START_TEST(mha_headers_are_dicoms_world)
{
	struct provenance provenance = prone();

	assert_text_header("mha", VOLUME_FLOAT32, &provenance,
			   "ObjectType = Image\nNDims = 3\n"
			   "Comment = 1/mm, patient HFP, sart iteration 3, job j1, cbctd 9, scan s2\n"
			   "cbct_program = cbctd 9\ncbct_unit = 1/mm\ncbct_stage = sart\ncbct_iteration = 3\n"
			   "cbct_job = j1\ncbct_scan = s2\ncbct_scan_name = a \\\\ b\ncbct_left_right = known\n"
			   "cbct_patient = {\"position\":\"HFP\"}\n"
			   "cbct_world_to_patient = [-1,0,0,0,0,-1,0,0,0,0,1,0,0,0,0,1]\n"
			   "cbct_recipe_fdk = {\"window\":\"hann\"}\ncbct_recipe_tv = null\nBinaryData = True\n"
			   "BinaryDataByteOrderMSB = False\nCompressedData = False\n"
			   "TransformMatrix = -1 0 0 0 -1 0 0 0 1\nOffset = 10 -20.5 0.1\nCenterOfRotation = 0 0 0\n"
			   "AnatomicalOrientation = LPI\nElementSpacing = 0.5 0.75 1.25\nDimSize = 3 2 4\n"
			   "ElementType = MET_FLOAT\nElementDataFile = LOCAL\n");
	provenance_clear(&provenance);
	assert_text_header("mha", VOLUME_INT16, nothing(),
			   "ObjectType = Image\nNDims = 3\nComment = HU, left and right are not known\n"
			   "cbct_unit = HU\ncbct_left_right = not known\ncbct_patient = null\nBinaryData = True\n"
			   "BinaryDataByteOrderMSB = False\nCompressedData = False\n"
			   "TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = -10 20.5 0.1\nCenterOfRotation = 0 0 0\n"
			   "AnatomicalOrientation = RAI\nElementSpacing = 0.5 0.75 1.25\nDimSize = 3 2 4\n"
			   "ElementType = MET_SHORT\nElementDataFile = LOCAL\n");
}
END_TEST

START_TEST(nrrd_headers_are_dicoms_world)
{
	struct provenance provenance = prone();

	assert_text_header("nrrd", VOLUME_INT16, nothing(),
			   "NRRD0004\n# HU, left and right are not known\ntype: short\ndimension: 3\n"
			   "space: left-posterior-superior\nsizes: 3 2 4\n"
			   "space directions: (0.5,0,0) (0,0.75,0) (0,0,1.25)\nkinds: domain domain domain\n"
			   "endian: little\nencoding: raw\nspace origin: (-10,20.5,0.1)\n"
			   "space units: \"mm\" \"mm\" \"mm\"\n"
			   "cbct_unit:=HU\ncbct_left_right:=not known\ncbct_patient:=null\n\n");
	provenance.patient = patient_in(PATIENT_HFDR);
	provenance.scan_name[0] = '\0';
	assert_text_header(
	    "nrrd", VOLUME_FLOAT32, &provenance,
	    "NRRD0004\n# 1/mm, patient HFDR, sart iteration 3, job j1, cbctd 9, scan s2\n"
	    "type: float\ndimension: 3\nspace: left-posterior-superior\nsizes: 3 2 4\n"
	    "space directions: (0,0.5,0) (-0.75,0,0) (0,0,1.25)\nkinds: domain domain domain\n"
	    "endian: little\nencoding: raw\nspace origin: (-20.5,-10,0.1)\n"
	    "space units: \"mm\" \"mm\" \"mm\"\n"
	    "cbct_program:=cbctd 9\ncbct_unit:=1/mm\ncbct_stage:=sart\ncbct_iteration:=3\n"
	    "cbct_job:=j1\ncbct_scan:=s2\ncbct_left_right:=known\ncbct_patient:={\"position\":\"HFDR\"}\n"
	    "cbct_world_to_patient:=[0,-1,0,0,1,0,0,0,0,0,1,0,0,0,0,1]\n"
	    "cbct_recipe_fdk:={\"window\":\"hann\"}\ncbct_recipe_tv:=null\n\n");
	provenance_clear(&provenance);
}
END_TEST

START_TEST(no_grid_and_no_provenance_overflows_a_header)
{
	const struct grid wide = {{8192, 8192, 8192},
				  {0.12345678901234567, 1.2345678901234567e-05, 999.99999999999989},
				  {-123456.78901234567, -1.2345678901234567e-05, -9999999.9999999981}};
	struct provenance provenance = {.patient = patient_unknown};
	char name[40], text[301];
	uint8_t h[FORMAT_HEADER_MAX];

	memset(provenance.program, 'p', sizeof(provenance.program) - 1);
	memset(provenance.stage, 's', sizeof(provenance.stage) - 1);
	memset(provenance.job, 'j', sizeof(provenance.job) - 1);
	memset(provenance.scan, 's', sizeof(provenance.scan) - 1);
	memset(provenance.scan_name, '\\', sizeof(provenance.scan_name) - 1);
	provenance.recipe = cJSON_CreateObject();
	memset(text, '"', sizeof(text) - 1);
	text[sizeof(text) - 1] = '\0';
	for (int i = 0; i < 60; i++) {
		snprintf(name, sizeof(name), "stage %d", i);
		cJSON_AddStringToObject(provenance.recipe, name, text + i * 5);
	}
	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		for (int type = 0; type < VOLUME_TYPE_COUNT; type++) {
			size_t length = header_of(format->name, &wide, (enum volume_type)type, &provenance, h);

			ck_assert_uint_lt(length, FORMAT_HEADER_MAX);
			if (length == NIFTI_VOXELS) { /* whole JSON, without what is too long */
				cJSON *json = cJSON_Parse((char *)h + NIFTI_EXTENSION_TEXT);

				ck_assert_ptr_nonnull(json);
				ck_assert_ptr_null(cJSON_GetObjectItem(json, "recipe"));
				cJSON_Delete(json);
			} else {
				ck_assert(length == 0 || h[length - 1] == '\n');
			}
		}
	}
	provenance_clear(&provenance);
}
END_TEST

START_TEST(formats_are_found_by_name)
{
	ck_assert_str_eq(volume_formats[0].name, "nifti");
	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		ck_assert_ptr_eq(volume_format_find(format->name), format);
		ck_assert_int_eq(format->extension[0], '.');
		ck_assert_ptr_nonnull(strchr(format->media_type, '/'));
	}
	ck_assert_ptr_null(volume_format_find("dicom"));
	ck_assert_ptr_null(volume_format_find(""));
}
END_TEST

/* ---- Hounsfield units ---- */

START_TEST(hounsfield_units_are_the_contracts)
{
	static const struct {
		double mu;
		int hu;
	} table[] = {{0.0192, 0},      {0, -1000},        {0.0384, 1000},      {0.02112, 100},
		     {-0.0192, -2000}, {1, 32767},        {-1, -32768},        {1e30, 32767},
		     {-1e30, -32768},  {INFINITY, 32767}, {-INFINITY, -32768}, {NAN, -32768}};
	enum { COUNT = 1000 };
	float mu[COUNT];
	int16_t hu[COUNT];

	for (size_t i = 0; i < sizeof(table) / sizeof(table[0]); i++) {
		for (int n = 0; n < COUNT; n++)
			mu[n] = (float)table[i].mu;
		volume_to_hu(mu, COUNT, 0.0192, hu);
		for (int n = 0; n < COUNT; n++) /* in the vectorised blocks and in the rest behind them */
			ck_assert_int_eq(hu[n], table[i].hu);
	}
}
END_TEST

START_TEST(hounsfield_units_are_rounded_to_the_nearest)
{
	enum { COUNT = 4321 };
	float mu[COUNT];
	int16_t hu[COUNT];

	for (int i = 0; i < COUNT; i++)
		mu[i] = 0.15f * (float)i / COUNT - 0.02f;
	for (int odd = 0; odd < 3; odd++) {
		volume_to_hu(mu + odd, (size_t)(COUNT - odd), 0.0207, hu + odd);
		for (int i = odd; i < COUNT; i++) {
			double exact = 1000 * (mu[i] - 0.0207) / 0.0207;

			/* Half a unit, and what a double leaves of a thousand. */
			ck_assert_double_le(fabs(hu[i] - exact), 0.5 + 1e-9);
		}
	}
}
END_TEST

/* ---- reading ---- */

static void fill(float *voxels)
{
	for (int i = 0; i < VOXELS; i++)
		voxels[i] = 0.25f * (float)(i * i % 37) - 2;
}

static void assert_grid(const struct grid *is, const struct grid *should)
{
	for (int i = 0; i < 3; i++) {
		ck_assert_int_eq(is->size[i], should->size[i]);
		/* NIfTI keeps single precision. */
		ck_assert_double_eq_tol(is->spacing[i], should->spacing[i], 1e-6);
		ck_assert_double_eq_tol(is->origin[i], should->origin[i], 1e-5);
	}
}

START_TEST(every_format_comes_back)
{
	float voxels[VOXELS], *back;
	int16_t counts[VOXELS];
	uint8_t h[FORMAT_HEADER_MAX];

	fill(voxels);
	for (int i = 0; i < VOXELS; i++)
		counts[i] = (int16_t)(i * 1000 - 5000);
	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		for (int type = 0; type < VOLUME_TYPE_COUNT; type++) {
			size_t length = header_of(format->name, &grid, (enum volume_type)type, nothing(), h);
			struct grid found = length == 0 ? grid : (struct grid){.size = {0}};
			struct error err = {0};

			if (length == 0 && type == VOLUME_INT16)
				continue; /* raw says nothing of its type: it is float32 */
			volume_file_write(h, length, type == VOLUME_INT16 ? (void *)counts : voxels,
					  VOXELS * volume_type_bytes((enum volume_type)type));
			ck_assert_msg(volume_read(volume_file, &found, NULL, &back, &err) == 0, "%s: %s", format->name,
				      err.text);
			assert_grid(&found, &grid);
			for (int i = 0; i < VOXELS; i++)
				ck_assert_float_eq(back[i], type == VOLUME_INT16 ? counts[i] : voxels[i]);
			free(back);
		}
	}
}
END_TEST

/* Where the voxel (0, 0, 0) of the file ends up when its axes run the other way. */
START_TEST(axes_that_run_the_other_way_are_turned_round)
{
	float voxels[VOXELS], *back;
	uint8_t h[FORMAT_HEADER_MAX];
	struct grid found;
	struct error err = {0};
	float row[4] = {0.5f, 0, 0, 9}; /* x to the right, as a scanner's own NIfTI often has it */

	fill(voxels);
	header_of("nifti", &grid, VOLUME_FLOAT32, nothing(), h);
	memcpy(h + 280, row, sizeof(row));
	volume_file_write(h, 4096, voxels, sizeof(voxels));
	ck_assert_msg(volume_read(volume_file, &found, NULL, &back, &err) == 0, "%s", err.text);
	/* RAS 9 .. 10 is LPS -10 .. -9: voxel 2 of the file comes first. */
	ck_assert_double_eq_tol(found.origin[0], -10, 1e-6);
	ck_assert_double_eq_tol(found.spacing[0], 0.5, 1e-6);
	for (int i = 0; i < VOXELS; i++)
		ck_assert_float_eq(back[i], voxels[i / 3 * 3 + 2 - i % 3]);
	free(back);
	/* The same by quaternion: none of it (0, 0, 0) is no turn, RAS along the axes. */
	header_of("nifti", &grid, VOLUME_FLOAT32, nothing(), h);
	memset(h + 254, 0, 2);
	memset(h + 256, 0, 12);
	volume_file_write(h, 4096, voxels, sizeof(voxels));
	ck_assert_msg(volume_read(volume_file, &found, NULL, &back, &err) == 0, "%s", err.text);
	ck_assert_double_eq_tol(found.origin[0], -10 - 2 * 0.5, 1e-6);
	ck_assert_double_eq_tol(found.origin[1], 20.5 - 0.75, 1e-6);
	ck_assert_float_eq(back[0], voxels[5]); /* both x and y */
	free(back);
	/* And with the header's own quaternion, half a turn about z, nothing moves. */
	header_of("nifti", &grid, VOLUME_FLOAT32, nothing(), h);
	memset(h + 254, 0, 2);
	volume_file_write(h, 4096, voxels, sizeof(voxels));
	ck_assert_msg(volume_read(volume_file, &found, NULL, &back, &err) == 0, "%s", err.text);
	assert_grid(&found, &grid);
	ck_assert_mem_eq(back, voxels, sizeof(voxels));
	free(back);
}
END_TEST

START_TEST(scale_and_offset_are_applied)
{
	int16_t counts[VOXELS];
	float *back, slope = 0.5f, offset = -3;
	uint8_t h[FORMAT_HEADER_MAX];
	struct grid found;
	struct error err = {0};

	for (int i = 0; i < VOXELS; i++)
		counts[i] = (int16_t)i;
	header_of("nifti", &grid, VOLUME_INT16, nothing(), h);
	memcpy(h + 112, &slope, 4);
	memcpy(h + 116, &offset, 4);
	volume_file_write(h, 4096, counts, sizeof(counts));
	ck_assert_int_eq(volume_read(volume_file, &found, NULL, &back, &err), 0);
	for (int i = 0; i < VOXELS; i++)
		ck_assert_float_eq(back[i], 0.5f * (float)i - 3);
	free(back);
}
END_TEST

static const struct {
	const char *header, *says;
} unread[] = {
    {"ObjectType = Image\nNDims = 3\nDimSize = 3 2 4\nElementType = MET_FLOAT\nElementDataFile = x.raw\n", "x.raw"},
    {"ObjectType = Image\nNDims = 2\nDimSize = 3 2\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n", "NDims"},
    {"NDims = 3\nCompressedData = True\nDimSize = 3 2 4\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n",
     "CompressedData"},
    {"NDims = 3\nBinaryDataByteOrderMSB = True\nDimSize = 3 2 4\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n",
     "MSB"},
    {"NDims = 3\nDimSize = 3 2\nElementDataFile = LOCAL\n", "DimSize"},
    {"NDims = 3\nDimSize = 3 2 0\nElementDataFile = LOCAL\n", "DimSize"},
    {"NDims = 3\nDimSize = 3 2 1e30\nElementDataFile = LOCAL\n", "DimSize"},
    {"NDims = 3\nDimSize = 8000 8000 8000\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n", "2048000000"},
    {"NDims = 3\nDimSize = 3 2 4\nElementType = MET_FLOAT_ARRAY\nElementDataFile = LOCAL\n", "ElementType"},
    {"NDims = 3\nDimSize = 3 2 4\nTransformMatrix = .8 .6 0 -.6 .8 0 0 0 1\nElementType = MET_FLOAT\nElementDataFile = "
     "LOCAL\n",
     "axes"},
    {"NDims = 3\nDimSize = 3 2 4\nElementSpacing = 1 0 1\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n",
     "spacing"},
    {"NDims = 3\nno equals sign here\n", "no line"},
    {"NDims = 3\n", "ElementDataFile"},
    {"NRRD0004\ntype: float\ndimension: 3\nsizes: 3 2 4\nencoding: gzip\n\n", "gzip"},
    {"NRRD0004\ntype: float\ndimension: 3\nsizes: 3 2 4\nencoding: raw\nendian: big\n\n", "big"},
    {"NRRD0004\ntype: float\ndimension: 3\nsizes: 3 2\nencoding: raw\n\n", "sizes"},
    {"NRRD0004\ntype: float\ndimension: 3\nspace: scanner-xyz\nsizes: 3 2 4\n\n", "scanner-xyz"},
    {"NRRD0004\ntype: float\ndimension: 3\n", "does not end"},
    {"something else", "no grid"},
    {"", "no grid"},
};

START_TEST(what_cannot_be_read_right_is_refused)
{
	float voxels[VOXELS] = {0}, *back = NULL;
	uint8_t h[FORMAT_HEADER_MAX];

	for (size_t i = 0; i < sizeof(unread) / sizeof(unread[0]); i++) {
		struct grid found = {.size = {0}};
		struct error err = {0};

		volume_file_write(unread[i].header, strlen(unread[i].header), voxels, i < 18 ? sizeof(voxels) : 0);
		ck_assert_msg(volume_read(volume_file, &found, NULL, &back, &err) < 0, "%s", unread[i].header);
		ck_assert_msg(strstr(err.text, unread[i].says) != NULL, "%s: %s", unread[i].header, err.text);
		ck_assert_ptr_null(back);
		ck_assert_int_eq(found.size[0], 0);
	}
	/* One byte short, in each format. */
	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		size_t length = header_of(format->name, &grid, VOLUME_FLOAT32, nothing(), h);
		struct grid found = grid;
		struct error err = {0};

		volume_file_write(h, length, voxels, sizeof(voxels) - 1);
		ck_assert_int_eq(volume_read(volume_file, &found, NULL, &back, &err), ERR_INVALID);
	}
	unlink(volume_file);
	ck_assert_int_lt(volume_read(volume_file, &(struct grid){.size = {1, 1, 1}}, NULL, &back, &(struct error){0}),
			 0);
}
END_TEST

/* A header with any one byte changed is refused or read, and a sanitizer has nothing to say. */
START_TEST(damaged_headers_do_no_harm)
{
	float voxels[VOXELS] = {0};
	uint8_t h[FORMAT_HEADER_MAX];

	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		size_t length = header_of(format->name, &grid, VOLUME_FLOAT32, nothing(), h);

		for (size_t at = 0; at < length && at < NIFTI_EXTENSION_TEXT + 64; at++) {
			static const uint8_t bytes[] = {0, 0x7f, 0x80, 0xff, '9', '\n', ' '};
			uint8_t before = h[at];

			for (size_t b = 0; b < sizeof(bytes); b++) {
				struct grid found = {.size = {0}};
				struct error err = {0};
				float *back = NULL;

				h[at] = bytes[b];
				volume_file_write(h, length, voxels, sizeof(voxels));
				if (volume_read(volume_file, &found, NULL, &back, &err) == 0)
					free(back);
			}
			h[at] = before;
		}
	}
}
END_TEST

Suite *format_suite(void)
{
	Suite *suite = suite_create("format");
	TCase *headers = tcase_create("headers"), *reading = tcase_create("reading");

	tcase_add_test(headers, nifti_headers_say_where_right_and_front_are);
	tcase_add_test(headers, mha_headers_are_dicoms_world);
	tcase_add_test(headers, nrrd_headers_are_dicoms_world);
	tcase_add_test(headers, no_grid_and_no_provenance_overflows_a_header);
	tcase_add_test(headers, formats_are_found_by_name);
	tcase_add_test(headers, hounsfield_units_are_the_contracts);
	tcase_add_test(headers, hounsfield_units_are_rounded_to_the_nearest);
	suite_add_tcase(suite, headers);
	tcase_set_timeout(reading, 60); /* thousands of small files on a loaded machine */
	tcase_add_checked_fixture(reading, volume_file_make, volume_file_remove);
	tcase_add_test(reading, every_format_comes_back);
	tcase_add_test(reading, axes_that_run_the_other_way_are_turned_round);
	tcase_add_test(reading, scale_and_offset_are_applied);
	tcase_add_test(reading, what_cannot_be_read_right_is_refused);
	tcase_add_test(reading, damaged_headers_do_no_harm);
	suite_add_tcase(suite, reading);
	return suite;
}

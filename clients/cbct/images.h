#ifndef CBCT_CLIENTS_IMAGES_H
#define CBCT_CLIENTS_IMAGES_H

#include <stdbool.h>
#include <stddef.h>

#include "clients/cbct/options.h"
#include "proto/source.h"
#include "proto/subject.h"
#include "proto/pixel.h"
#include "proto/rtk_geometry.h"

/*
 * Projections as other tools keep them: a file of one or many images, or a folder
 * or list of such files, as one numbered series. Formats are rows of a table in
 * images.c; each is one file image_NAME.c.
 */

/* Options of the command line about images. */
struct image_options {
	const char *pattern;          /* of the names in a folder, NULL: all that are images */
	double size[2];               /* columns, rows of raw files; NaN: none given */
	int type;                     /* enum pixel_type of raw files, or unset */
	bool big_endian;              /* raw files */
	long header;                  /* bytes before the first image of a raw file */
	bool flip_columns, flip_rows; /* mirror each image */
	bool inverted;                /* pixels fall with the beam */
};
extern const struct option image_option_rows[];
#define IMAGE_OPTIONS_DEFAULTS                                                                                         \
	{                                                                                                              \
		.size = {OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER}, .type = OPTION_UNSET_CHOICE                        \
	}

/* Where a C-arm stood in one frame of a DICOM file: see image_dicom.c. NaN: not told. */
struct image_position {
	double primary, secondary;                      /* degrees, LAO and CRA positive */
	double source_to_isocentre, source_to_detector; /* mm */
	int patient;                                    /* enum patient_position, -1: not told */
	char towards[2]; /* the patient's sides that columns and rows run to: L R A P H F; 0: not told */
};

/* The circle that a scanner's own file tells; NaN and NULL: not told. */
struct image_circle {
	double *degrees;                                /* gantry angles, one for each image, owned */
	double source_to_isocentre, source_to_detector; /* mm */
	double detector_offset[2];                      /* mm, 0 where it is not told */
	double air;                                     /* counts of the open beam */
};
#define IMAGE_CIRCLE_UNKNOWN                                                                                           \
	{                                                                                                              \
		.source_to_isocentre = OPTION_UNSET_NUMBER, .source_to_detector = OPTION_UNSET_NUMBER,                 \
		.air = OPTION_UNSET_NUMBER                                                                             \
	}

/* The DICOM object that a file is; "": not told, or none. */
struct image_source {
	char class[UID_MOST + 1], series[UID_MOST + 1], instance[UID_MOST + 1];
};

struct image_file {
	const struct image_format *format;
	int columns, rows, count; /* of one image; images */
	enum pixel_type type;
	double pixel[2]; /* mm, along columns and rows; NaN: not told */
	bool has_stack;
	struct rtk_stack stack;           /* where the pixels lie, of a MetaImage */
	struct image_position *positions; /* [count], owned; NULL but for DICOM */
	const char *intensity;            /* DICOM's Pixel Intensity Relationship, "" elsewhere; a literal */
	struct subject subject;           /* of a DICOM file; nothing told elsewhere */
	struct image_source source;
	struct image_circle circle;
	void *state; /* the format's own */
};

struct image_format {
	const char *name; /* "TIFF" */
	/* Whether a file that begins so is one of these; NULL for raw, which bears no mark. */
	bool (*recognise)(const unsigned char *head, size_t length);
	/* Fills all of *file but format; the caller closes it in any case. */
	int (*open)(struct image_file *file, const char *path, const struct image_options *options, struct error *err);
	/* [row][column] of image `index`, in the file's own order and numbers. */
	int (*read)(struct image_file *file, int index, float *ret_pixels, struct error *err);
	void (*close)(struct image_file *file); /* frees state, which may be NULL */
};
extern const struct image_format image_metaimage, image_tiff, image_npy, image_dicom, image_his, image_hnd, image_xim,
    image_hdf5, image_txrm, image_xtekct, image_raw;
enum { IMAGE_HEAD = 256 }; /* bytes that recognise gets */

struct images {
	int columns, rows, count;
	enum pixel_type type;
	double pixel[2];
	bool has_stack;
	struct rtk_stack stack;
	struct image_position *positions; /* [count] or NULL */
	bool flip_columns, flip_rows;     /* the images are mirrored as they are read */
	const char *intensity;
	struct subject subject;
	struct image_circle circle; /* of a series that is one file */
	cJSON *source;              /* proto/source.h, owned; NULL where not all files are objects of one series */
	struct images_files *files; /* images.c's own */
};

/*
 * `path` is a file, a folder (its images in the order of their numbers), or a .txt
 * or .lst file with a name a line, relative to it. All images must agree in size,
 * type, patient and study. ERR_INVALID names the file that does not.
 */
int images_open(const char *path, const struct image_options *options, struct images **ret_images, struct error *err);
/* [row][column] of image `index`, mirrored as asked for. One after the other is fast, to and fro need not be. */
int images_read(struct images *images, int index, float *ret_pixels, struct error *err);
void images_free(struct images *images); /* NULL is fine */

#endif

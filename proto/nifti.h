#ifndef CBCT_PROTO_NIFTI_H
#define CBCT_PROTO_NIFTI_H

/* Offsets in the 348 bytes of nifti1.h's struct nifti_1_header, for the files that write and read it. */
enum {
	NIFTI_SIZEOF_HDR = 0,
	NIFTI_DIM = 40,
	NIFTI_DATATYPE = 70,
	NIFTI_BITPIX = 72,
	NIFTI_PIXDIM = 76,
	NIFTI_VOX_OFFSET = 108,
	NIFTI_SCL_SLOPE = 112,
	NIFTI_SCL_INTER = 116,
	NIFTI_XYZT_UNITS = 123,
	NIFTI_DESCRIP = 148,
	NIFTI_QFORM_CODE = 252,
	NIFTI_SFORM_CODE = 254,
	NIFTI_QUATERN = 256,
	NIFTI_QOFFSET = 268,
	NIFTI_SROW = 280,
	NIFTI_MAGIC = 344,
	NIFTI_HEADER = 348,
	NIFTI_EXTENDER = 348, /* four bytes, the first of which says whether extensions follow */
	NIFTI_PLAIN = 352,    /* voxels of a file without them */
	/* The one extension that we write: length and code as int32, then JSON in ASCII, padded with zeros. */
	NIFTI_EXTENSION = 352,
	NIFTI_EXTENSION_TEXT = 360,
	NIFTI_ECODE_COMMENT = 6,
	NIFTI_VOXELS = 4096 /* of files with it: a page, so that a mapping's voxels begin with one */
};

#endif

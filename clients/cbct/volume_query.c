/* How volumes are wanted: see volume_query.h. */
#include "clients/cbct/volume_query.h"

#include "proto/format.h"

#define ROW(name, kind, member, argument, help, least, most, count, names)                                             \
	{                                                                                                              \
		name, 0, kind, offsetof(struct volume_query, member), argument, help, least, most, count, names        \
	}
const struct option volume_query_rows[] = {
    ROW("format", OPTION_TEXT, format, "FORMAT", "nifti, nifti.gz, mha, nrrd, raw or (get) dicom (default nifti)", 0, 0,
	0, NULL),
    ROW("type", OPTION_CHOICE, type, "TYPE", "float32 is 1/mm, int16 Hounsfield units", 0, 0, VOLUME_TYPE_COUNT,
	volume_type_names),
    ROW("scale", OPTION_INTEGER, scale, "N", "each voxel the mean of N x N x N", 1, 64, 0, NULL),
    ROW("zstd", OPTION_FLAG, zstd, NULL, "compressed on the way", 0, 0, 0, NULL),
    {0},
};

void volume_query_text(const struct volume_query *query, char ret_text[VOLUME_QUERY_MAX])
{
	bool has_format = query->format != NULL, has_type = query->type != OPTION_UNSET_CHOICE;

	snprintf(ret_text, VOLUME_QUERY_MAX, "scale=%ld%s%s%s%.100s", query->scale, has_type ? "&type=" : "",
		 has_type ? volume_type_names[query->type] : "", has_format ? "&format=" : "",
		 has_format ? query->format : "");
}

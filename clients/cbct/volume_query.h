#ifndef CBCT_CLIENTS_VOLUME_QUERY_H
#define CBCT_CLIENTS_VOLUME_QUERY_H

#include "clients/cbct/options.h"

/* How volumes are wanted: the options of every subcommand that fetches some. */
struct volume_query {
	const char *format; /* NULL: the daemon's default, nifti */
	int type;           /* enum volume_type, or unset: the daemon's default */
	long scale;
	bool zstd; /* on the way */
};
extern const struct option volume_query_rows[];
#define VOLUME_QUERY_DEFAULTS                                                                                          \
	{                                                                                                              \
		.type = OPTION_UNSET_CHOICE, .scale = 1                                                                \
	}

/* "scale=1&type=int16&format=mha" */
enum { VOLUME_QUERY_MAX = 200 };
void volume_query_text(const struct volume_query *query, char ret_text[VOLUME_QUERY_MAX]);

#endif

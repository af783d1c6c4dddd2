#ifndef CBCT_CLIENTS_RECIPE_OPTIONS_H
#define CBCT_CLIENTS_RECIPE_OPTIONS_H

#include <cjson/cJSON.h>

#include "clients/cbct/options.h"

/*
 * The document of POST /v1/jobs from a file, from options, or from a file with options over it. The options are made
 * from the tables of parameters (core/recon/parameters.h, proto/recipe.h): every parameter has one.
 */
enum { RECIPE_OPTIONS_MAX = 64 };
struct recipe_options {
	const char *values[RECIPE_OPTIONS_MAX]; /* as given; of the parameter of the same row; NULL: not given */
	bool flags[RECIPE_OPTIONS_MAX];
	bool no_fdk;
	const char *emit;
	const char *preset; /* proto/preset.h */
	const char *reference;
};
extern struct option recipe_option_rows[];
void recipe_options_make(void); /* fills the rows; once, before any command line is parsed */

/*
 * path may be NULL: without options that name a stage, the whole job with its defaults, as over HTTP; with them, the
 * FDK and those stages. Delete *ret_document.
 */
int recipe_document(const struct recipe_options *options, const char *path, const char *scan, cJSON **ret_document,
		    struct error *err);

#endif

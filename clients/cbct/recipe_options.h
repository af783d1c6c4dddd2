#ifndef CBCT_CLIENTS_RECIPE_OPTIONS_H
#define CBCT_CLIENTS_RECIPE_OPTIONS_H

#include <cjson/cJSON.h>

#include "clients/cbct/options.h"

/* The document of POST /v1/jobs from a file, from options, or from a file with options over it. */
struct recipe_options {
	double size[3], spacing[3], origin[3];
	int window;
	double cutoff;
	int truncation;
	bool no_fdk;
	long iterations, cgls;
	double relaxation;
	const char *subsets;
	bool negative;
	double stop_residual, stop_change;
	int method;
	const char *alpha;
	int strength;
	double step;
	long tv_iterations;
	double unit;
	bool tv_after_sart;
	int projector;
	double metal;
	const char *emit;
	int priority;
	double mu_water;
	bool reference_precision;
};
extern const struct option recipe_option_rows[];
#define RECIPE_OPTIONS_DEFAULTS                                                                                        \
	{                                                                                                              \
		.size = OPTION_UNSET_3, .spacing = OPTION_UNSET_3, .origin = OPTION_UNSET_3,                           \
		.window = OPTION_UNSET_CHOICE, .cutoff = OPTION_UNSET_NUMBER, .iterations = OPTION_UNSET_INTEGER,      \
		.truncation = OPTION_UNSET_CHOICE, .cgls = OPTION_UNSET_INTEGER, .relaxation = OPTION_UNSET_NUMBER,    \
		.stop_residual = OPTION_UNSET_NUMBER, .stop_change = OPTION_UNSET_NUMBER,                              \
		.method = OPTION_UNSET_CHOICE, .strength = OPTION_UNSET_CHOICE, .step = OPTION_UNSET_NUMBER,           \
		.tv_iterations = OPTION_UNSET_INTEGER, .unit = OPTION_UNSET_NUMBER, .projector = OPTION_UNSET_CHOICE,  \
		.metal = OPTION_UNSET_NUMBER, .priority = OPTION_UNSET_CHOICE, .mu_water = OPTION_UNSET_NUMBER         \
	}

/* path may be NULL: it starts from an FDK with its defaults. Delete *ret_document. */
int recipe_document(const struct recipe_options *options, const char *path, const char *scan, cJSON **ret_document,
		    struct error *err);

#endif

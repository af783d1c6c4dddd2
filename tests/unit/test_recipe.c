/* The job document: the contract's section 4, defaults written out, what is refused and where. */
#include <check.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/recipe.h"
#include "tests/unit/documents.h"

static struct scan *scan;

static void open_scan(void)
{
	static const char text[] = "{\"detector\":{\"columns\":64,\"rows\":48,\"pixel_mm\":[4,4]},"
				   "\"projections\":{\"count\":60,\"sample\":\"float32\","
				   "\"quantity\":\"line_integral\"},"
				   "\"geometry\":{\"kind\":\"circular\",\"source_to_isocentre_mm\":600,"
				   "\"source_to_detector_mm\":1000,\"angle_step_deg\":6}}";
	struct error err = {0};

	ck_assert_msg(scan_parse(text, strlen(text), &scan, &err) == 0, "%s", err.text);
}

static void close_scan(void)
{
	scan_free(scan);
	scan = NULL;
}

static int parse(const char *text, struct job_request *ret, struct error *err)
{
	return job_request_parse(text, strlen(text), ret, err);
}

static int parse_and_resolve(const char *text, struct job_request *ret, struct error *err)
{
	struct job_request request;
	int code = parse(text, &request, err);

	if (code == 0) {
		code = job_request_resolve(&request, scan, err);
		if (code == 0)
			*ret = request;
		else
			job_request_clear(&request);
	}
	return code;
}

static const char *const requests[] = {
    "{\"scan\":\"ID\",\"grid\":{\"size\":[256,256,256],\"spacing_mm\":[0.5,0.5,0.5]},"
    "\"fdk\":{\"window\":\"hann\",\"cutoff\":1.0},"
    "\"sart\":{\"iterations\":50,\"relaxation\":1.0,\"subsets\":1,\"nonnegative\":true,"
    "\"stop\":{\"residual\":0.01,\"change\":0.0001}},"
    "\"tv\":{\"method\":\"gradient\",\"alpha\":0.1,\"step\":0.1,\"iterations\":10},"
    "\"emit\":[\"fdk\",1,5,10,50],\"priority\":\"routine\"}",
    "{\"scan\":\"a\",\"fdk\":{}}",
    "{\"scan\":\"a\",\"sart\":{}}",
    "{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"tv\":{}}",
    "{\"scan\":\"a\",\"fdk\":null,\"sart\":{},\"tv\":null,\"grid\":null,\"emit\":null,\"priority\":null}",
    "{\"scan\":\"a\",\"fdk\":{\"window\":\"ram-lak\",\"cutoff\":0.3333333333333333},\"tv\":{\"after\":\"sart\"}}",
    "{\"scan\":\"a\",\"fdk\":{\"window\":\"shepp-logan\"},\"emit\":[\"fdk\"]}",
    "{\"scan\":\"a\",\"fdk\":{\"window\":\"cosine\"},\"tv\":{\"method\":\"proximal\",\"alpha\":0.7},"
    "\"emit\":[\"fdk-tv\",\"fdk\"]}",
    "{\"scan\":\"a\",\"fdk\":{\"window\":\"hamming\"},\"priority\":\"stat\",\"precision\":\"reference\"}",
    "{\"scan\":\"a\",\"sart\":{\"subsets\":\"views\",\"relaxation\":0.1,\"nonnegative\":false,\"stop\":null},"
    "\"priority\":\"urgent\",\"mu_water\":0.020000000000000004}",
    "{\"scan\":\"a\",\"cgls\":{\"iterations\":3,\"nonnegative\":false,\"stop\":{\"residual\":0.1}},\"projector\":"
    "\"interpolating\"}",
    "{\"scan\":\"a\",\"fdk\":{},\"cgls\":{},\"sart\":null}",
    "{\"scan\":\"a\",\"fdk\":{},\"sart\":{\"momentum\":true}}",
    "{\"scan\":\"a\",\"fista\":{\"iterations\":12}}",
    "{\"scan\":\"a\",\"preset\":\"fast\",\"tv\":null}",
    "{\"scan\":\"a\",\"preset\":\"low-noise\",\"cgls\":{}}",
    "{\"scan\":\"a\",\"preset\":\"bone\"}",
    "{\"preset\":\"metal\",\"scan\":\"a\"}",
    "{\"scan\":\"a\",\"sart\":{\"subsets\":60,\"iterations\":100000,\"stop\":{\"change\":1e-9}},"
    "\"emit\":[100000,7,3,7]}",
    "{\"scan\":\"a\",\"sart\":{},\"tv\":{\"alpha\":0,\"step\":0.25,\"iterations\":1,\"unit\":3.3e-5,"
    "\"after\":\"fdk+sart\"}}",
    "{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"tv\":{\"strength\":\"light\"}}",
    "{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"tv\":{\"method\":\"proximal\",\"alpha\":\"auto\",\"strength\":\"strong\"}"
    "}",
    "{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"tv\":{\"method\":\"gradient\"}}",
    "{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"projector\":\"matched\",\"metal\":{}}",
    "{\"scan\":\"a\",\"fdk\":{},\"projector\":null,\"metal\":{\"threshold_hu\":3071.5}}",
    "{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[1,8192,7],\"spacing_mm\":[0.1,0.012345678901234567,1],"
    "\"origin_mm\":[-0.1,-50.3,1e-3]}}",
    "{\"scan\":\"a\",\"where\":{\"host\":\"gpu-1.example\"}}",
    "{\"scan\":\"a\",\"where\":{\"host\":null,\"memory\":85899345920}}",
    "{\"scan\":\"a\",\"where\":{\"host\":\"gpu-1.example\",\"memory\":85899345920,\"devices\":4}}",
};
enum { REQUESTS = sizeof(requests) / sizeof(requests[0]) };

START_TEST(requests_come_back_the_same)
{
	for (int resolved = 0; resolved < 2; resolved++) {
		for (int i = 0; i < REQUESTS; i++) {
			struct job_request request, back;
			struct error err = {0};
			int code = resolved ? parse_and_resolve(requests[i], &request, &err)
					    : parse(requests[i], &request, &err);
			char *once, *twice;

			ck_assert_msg(code == 0, "%s: %s at %s", requests[i], err.text, err.pointer);
			once = request_printed(&request);
			ck_assert_msg(parse(once, &back, &err) == 0, "%s: %s at %s", once, err.text, err.pointer);
			ck_assert_msg(job_request_same(&request, &back), "%s is not %s", once, requests[i]);
			twice = request_printed(&back);
			ck_assert_str_eq(once, twice);
			free(once);
			free(twice);
			job_request_clear(&request);
			job_request_clear(&back);
		}
	}
}
END_TEST

/* A preset is its stages in numbers; `balanced`, what a request without stages has. */
START_TEST(a_preset_is_what_it_stands_for)
{
	static const char *const pairs[][2] = {
	    {"{\"scan\":\"a\",\"preset\":\"preview\"}", "{\"scan\":\"a\",\"fdk\":{}}"},
	    {"{\"scan\":\"a\",\"preset\":\"balanced\"}", "{\"scan\":\"a\"}"},
	    {"{\"scan\":\"a\",\"preset\":\"metal\",\"tv\":null}",
	     "{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"metal\":{}}"},
	    {"{\"scan\":\"a\",\"preset\":\"low-noise\",\"tv\":{},\"sart\":null}",
	     "{\"scan\":\"a\",\"fdk\":{},\"tv\":{}}"},
	    {"{\"scan\":\"a\",\"preset\":\"balanced\",\"fista\":{}}",
	     "{\"scan\":\"a\",\"fdk\":{},\"fista\":{},\"tv\":{}}"},
	    {"{\"scan\":\"a\",\"preset\":null,\"fdk\":{}}", "{\"scan\":\"a\",\"fdk\":{}}"},
	};
	struct job_request requests[2];
	struct error err;

	for (size_t k = 0; k < sizeof(pairs) / sizeof(pairs[0]); k++) {
		for (int i = 0; i < 2; i++)
			ck_assert_msg(job_request_parse(pairs[k][i], strlen(pairs[k][i]), &requests[i], &err) == 0,
				      "%s", err.text);
		ck_assert_msg(job_request_same(&requests[0], &requests[1]), "%s", pairs[k][0]);
		job_request_clear(&requests[0]);
		job_request_clear(&requests[1]);
	}
}
END_TEST

/* Each of the requests is told from each of the others. */
START_TEST(different_requests_are_not_the_same)
{
	struct job_request all[REQUESTS];
	struct error err = {0};

	for (int i = 0; i < REQUESTS; i++)
		ck_assert_int_eq(parse(requests[i], &all[i], &err), 0);
	for (int i = 0; i < REQUESTS; i++) {
		for (int j = 0; j < REQUESTS; j++) {
			bool twins = (i == 2 && j == 4) || (i == 4 && j == 2); /* null is as good as absent */

			ck_assert_int_eq(job_request_same(&all[i], &all[j]), i == j || twins);
		}
	}
	for (int i = 0; i < REQUESTS; i++)
		job_request_clear(&all[i]);
}
END_TEST

START_TEST(defaults_are_the_contracts)
{
	struct job_request request;
	struct error err = {0};
	const struct recipe *recipe = &request.recipe;

	ck_assert_int_eq(parse_and_resolve("{\"scan\":\"ID\",\"fdk\":{},\"sart\":{},\"tv\":{}}", &request, &err), 0);
	ck_assert_str_eq(request.scan, "ID");
	ck_assert_int_eq(request.priority, PRIORITY_ROUTINE);
	ck_assert(recipe->fdk.on && recipe->algorithm != NULL && recipe->tv.on);
	ck_assert_int_eq(recipe->fdk.window, WINDOW_HANN);
	ck_assert_double_eq(recipe->fdk.cutoff, 1);
	ck_assert_int_eq(recipe->iterate.iterations, 10);
	ck_assert_double_eq(recipe->sart.relaxation, 1);
	ck_assert_int_eq(recipe->sart.subsets, 10);
	ck_assert(recipe->iterate.nonnegative);
	ck_assert_double_eq(recipe->iterate.stop_residual, 0);
	ck_assert_double_eq(recipe->iterate.stop_change, 0);
	ck_assert(recipe->tv.after_fdk);
	ck_assert_int_eq(recipe->tv.options.method, TV_PROXIMAL);
	ck_assert(recipe->tv.automatic);
	ck_assert_int_eq(recipe->tv.strength, TV_MEDIUM);
	ck_assert_double_eq_tol(recipe->tv.options.unit, 0.0192 / 1000, 1e-18); /* one HU */
	ck_assert_double_eq(recipe->mu_water, 0.0192);
	ck_assert_int_eq(recipe->emits, 0);
	ck_assert(!recipe->reference_precision);
	ck_assert(!recipe->metal.on);
	ck_assert_double_eq(recipe->metal.threshold_hu, 2500);
	ck_assert_int_eq(recipe->projector, PROJECTOR_INTERPOLATING);
	ck_assert(recipe->has_grid && recipe->has_origin);
	/* The field of view, 128 mm at half of 1000 mm away, in pixels of 4 * 0.6 mm. */
	ck_assert_int_gt(recipe->grid.size[0], 40);
	ck_assert_int_lt(recipe->grid.size[0], 80);
	job_request_clear(&request);
}
END_TEST

/* What a "tv" means: explicit numbers are what they were before there was "auto". */
START_TEST(numbers_of_tv_mean_explicit_steps_and_none_means_auto)
{
	static const struct {
		const char *tv;
		enum tv_method method;
		bool automatic;
		enum tv_strength strength;
		double alpha, step; /* where they count */
		int iterations;
	} rows[] = {
	    {"{}", TV_PROXIMAL, true, TV_MEDIUM, 0, 0, 30},
	    {"{\"after\":\"sart\",\"unit\":1e-5}", TV_PROXIMAL, true, TV_MEDIUM, 0, 0, 30},
	    {"{\"alpha\":\"auto\"}", TV_PROXIMAL, true, TV_MEDIUM, 0, 0, 30},
	    {"{\"strength\":\"strong\"}", TV_PROXIMAL, true, TV_STRONG, 0, 0, 30},
	    {"{\"iterations\":30}", TV_PROXIMAL, true, TV_MEDIUM, 0, 0, 30},
	    {"{\"method\":\"proximal\"}", TV_PROXIMAL, true, TV_MEDIUM, 0, 0, 30},
	    {"{\"method\":\"proximal\",\"alpha\":0.2}", TV_PROXIMAL, false, TV_MEDIUM, .2, 0, 100},
	    {"{\"method\":\"proximal\",\"alpha\":0.2,\"iterations\":7}", TV_PROXIMAL, false, TV_MEDIUM, .2, 0, 7},
	    {"{\"method\":\"tgv\"}", TV_GENERALISED, true, TV_MEDIUM, 0, 0, 50},
	    {"{\"method\":\"tgv\",\"strength\":\"light\"}", TV_GENERALISED, true, TV_LIGHT, 0, 0, 50},
	    {"{\"method\":\"tgv\",\"alpha\":0.2}", TV_GENERALISED, false, TV_MEDIUM, .2, 0, 150},
	    {"{\"method\":\"gradient\"}", TV_GRADIENT, false, TV_MEDIUM, .1, .1, 10},
	    {"{\"method\":\"gradient\",\"iterations\":20}", TV_GRADIENT, false, TV_MEDIUM, .1, .1, 20},
	    {"{\"alpha\":0.02,\"step\":1,\"iterations\":20}", TV_GRADIENT, false, TV_MEDIUM, .02, 1, 20},
	    {"{\"alpha\":0}", TV_GRADIENT, false, TV_MEDIUM, 0, .1, 10},
	    {"{\"step\":0.25}", TV_GRADIENT, false, TV_MEDIUM, .1, .25, 10},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		struct job_request request;
		struct error err = {0};
		char text[200];

		snprintf(text, sizeof(text), "{\"scan\":\"a\",\"fdk\":{},\"tv\":%s}", rows[i].tv);
		ck_assert_msg(parse(text, &request, &err) == 0, "%s: %s", text, err.text);
		ck_assert_msg(request.recipe.tv.options.method == rows[i].method &&
				  request.recipe.tv.automatic == rows[i].automatic &&
				  request.recipe.tv.strength == rows[i].strength &&
				  request.recipe.tv.options.iterations == rows[i].iterations,
			      "%s", rows[i].tv);
		if (!rows[i].automatic)
			ck_assert_double_eq(request.recipe.tv.options.alpha, rows[i].alpha);
		if (rows[i].method == TV_GRADIENT)
			ck_assert_double_eq(request.recipe.tv.options.step, rows[i].step);
		job_request_clear(&request);
	}
}
END_TEST

START_TEST(the_grid_is_centred_unless_it_says_otherwise)
{
	struct job_request request;
	struct error err = {0};

	ck_assert_int_eq(parse_and_resolve("{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[5,4,1],"
					   "\"spacing_mm\":[2,3,4]}}",
					   &request, &err),
			 0);
	ck_assert_double_eq(request.recipe.grid.origin[0], -4);
	ck_assert_double_eq(request.recipe.grid.origin[1], -4.5);
	ck_assert_double_eq(request.recipe.grid.origin[2], 0);
	job_request_clear(&request);
	ck_assert_int_eq(parse_and_resolve("{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[5,4,1],"
					   "\"spacing_mm\":[2,3,4],\"origin_mm\":[7,8,9]}}",
					   &request, &err),
			 0);
	ck_assert_double_eq(request.recipe.grid.origin[0], 7);
	ck_assert_double_eq(request.recipe.grid.origin[2], 9);
	job_request_clear(&request);
}
END_TEST

START_TEST(emitted_volumes_are_sorted_and_each_once)
{
	static const int expected[] = {EMIT_FDK, EMIT_FDK_TV, 1, 3, 7, 10};
	struct job_request request;
	struct error err = {0};

	ck_assert_int_eq(parse_and_resolve("{\"scan\":\"a\",\"fdk\":{},\"sart\":{},\"tv\":{},"
					   "\"emit\":[10,3,\"fdk-tv\",7,\"fdk\",1,3,\"fdk\",10]}",
					   &request, &err),
			 0);
	ck_assert_int_eq(request.recipe.emits, 6);
	ck_assert_mem_eq(request.recipe.emit, expected, sizeof(expected));
	job_request_clear(&request);
}
END_TEST

static const struct {
	const char *text;
	int code;
	const char *pointer, *says;
} refused[] = {
    {"[]", ERR_INVALID, "", "an object is expected"},
    {"{}", ERR_INVALID, "/scan", "missing"},
    {"{\"scna\":\"a\",\"fdk\":{}}", ERR_INVALID, "/scna", "scan is needed"},
    {"{\"scan\":5,\"fdk\":{}}", ERR_INVALID, "/scan", "a string"},
    {"{\"scan\":\"a\",\"sart\":null}", ERR_IMPOSSIBLE, "", "nothing to run"},
    {"{\"scan\":\"a\",\"tv\":{}}", ERR_IMPOSSIBLE, "", "nothing to run"},
    {"{\"scan\":\"a\",\"fdk\":null,\"sart\":null}", ERR_IMPOSSIBLE, "", "nothing to run"},
    {"{\"scan\":\"a\",\"fdk\":[]}", ERR_INVALID, "/fdk", "an array"},
    {"{\"scan\":\"a\",\"fdk\":true}", ERR_INVALID, "/fdk", "a boolean"},
    {"{\"scan\":\"a\",\"fdk\":{},\"name\":\"x\"}", ERR_INVALID, "/name", "nobody knows"},
    {"{\"scan\":\"a\",\"fdk\":{\"window\":\"kaiser\"}}", ERR_INVALID, "/fdk/window", "hann"},
    {"{\"scan\":\"a\",\"fdk\":{\"window\":3}}", ERR_INVALID, "/fdk/window", "a number"},
    {"{\"scan\":\"a\",\"fdk\":{\"cutoff\":0}}", ERR_IMPOSSIBLE, "/fdk/cutoff", "0"},
    {"{\"scan\":\"a\",\"fdk\":{\"cutoff\":1.5}}", ERR_IMPOSSIBLE, "/fdk/cutoff", "1.5"},
    {"{\"scan\":\"a\",\"fdk\":{\"cutoff\":\"1\"}}", ERR_INVALID, "/fdk/cutoff", "a string"},
    {"{\"scan\":\"a\",\"fdk\":{\"Window\":\"hann\"}}", ERR_INVALID, "/fdk/Window", "nobody knows"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{}}", ERR_INVALID, "/grid/size", "missing"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8]}}", ERR_INVALID, "/grid/spacing_mm", "missing"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8],\"spacing\":[1,1,1],\"origin_mm\":[0,0,0]}}", ERR_INVALID,
     "/grid/spacing", "spacing_mm is needed"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":8,\"spacing_mm\":[1,1,1]}}", ERR_INVALID, "/grid/size", "array"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8],\"spacing_mm\":[1,1,1]}}", ERR_INVALID, "/grid/size",
     "2 numbers, 3"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[0,8,8],\"spacing_mm\":[1,1,1]}}", ERR_IMPOSSIBLE, "/grid/size/0",
     "0 voxels"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,-8,8],\"spacing_mm\":[1,1,1]}}", ERR_IMPOSSIBLE, "/grid/size/1",
     "-8 voxels"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8193],\"spacing_mm\":[1,1,1]}}", ERR_IMPOSSIBLE,
     "/grid/size/2", "8192"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,1e99],\"spacing_mm\":[1,1,1]}}", ERR_IMPOSSIBLE,
     "/grid/size/2", "1e+99"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8.5,8],\"spacing_mm\":[1,1,1]}}", ERR_INVALID, "/grid/size/1",
     "whole"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,\"8\",8],\"spacing_mm\":[1,1,1]}}", ERR_INVALID, "/grid/size/1",
     "a string"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8],\"spacing_mm\":[1,0,1]}}", ERR_IMPOSSIBLE,
     "/grid/spacing_mm/1", "0"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8],\"spacing_mm\":[1,1,-1]}}", ERR_IMPOSSIBLE,
     "/grid/spacing_mm/2", "-1"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8],\"spacing_mm\":[1,1,1],\"origin\":0}}", ERR_INVALID,
     "/grid/origin", "nobody knows"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[8,8,8],\"spacing_mm\":[1,1,1],\"origin_mm\":[0,0]}}", ERR_INVALID,
     "/grid/origin_mm", "2 numbers"},
    {"{\"scan\":\"a\",\"fdk\":{},\"grid\":{\"size\":[700,700,8],\"spacing_mm\":[2,2,2]}}", ERR_IMPOSSIBLE, "/grid",
     "inside"},
    {"{\"scan\":\"a\",\"sart\":{\"iterations\":0}}", ERR_IMPOSSIBLE, "/sart/iterations", "0"},
    {"{\"scan\":\"a\",\"sart\":{\"iterations\":100001}}", ERR_IMPOSSIBLE, "/sart/iterations", "100000"},
    {"{\"scan\":\"a\",\"sart\":{\"iterations\":1.5}}", ERR_INVALID, "/sart/iterations", "whole"},
    {"{\"scan\":\"a\",\"sart\":{\"relaxation\":0}}", ERR_IMPOSSIBLE, "/sart/relaxation", "0"},
    {"{\"scan\":\"a\",\"sart\":{\"relaxation\":2.1}}", ERR_IMPOSSIBLE, "/sart/relaxation", "2.1"},
    {"{\"scan\":\"a\",\"preset\":\"best\"}", ERR_IMPOSSIBLE, "/preset", "preview, fast"},
    {"{\"scan\":\"a\",\"preset\":[]}", ERR_INVALID, "/preset", "name"},
    {"{\"scan\":\"a\",\"preset\":\"fast\",\"sart\":{\"momentum\":1}}", ERR_INVALID, "/sart/momentum", "true or false"},
    {"{\"scan\":\"a\",\"preset\":\"fast\",\"speed\":1}", ERR_INVALID, "/speed", "nobody knows"},
    {"{\"scan\":\"a\",\"sart\":{},\"cgls\":{}}", ERR_IMPOSSIBLE, "/cgls", "one algorithm"},
    {"{\"scan\":\"a\",\"cgls\":{\"iterations\":0}}", ERR_IMPOSSIBLE, "/cgls/iterations", "0"},
    {"{\"scan\":\"a\",\"cgls\":{\"subsets\":2}}", ERR_INVALID, "/cgls/subsets", "nobody knows"},
    {"{\"scan\":\"a\",\"sart\":{\"subsets\":0}}", ERR_IMPOSSIBLE, "/sart/subsets", "0"},
    {"{\"scan\":\"a\",\"sart\":{\"subsets\":-1}}", ERR_IMPOSSIBLE, "/sart/subsets", "-1"},
    {"{\"scan\":\"a\",\"sart\":{\"subsets\":61}}", ERR_IMPOSSIBLE, "/sart/subsets", "60"},
    {"{\"scan\":\"a\",\"sart\":{\"subsets\":\"all\"}}", ERR_INVALID, "/sart/subsets", "views"},
    {"{\"scan\":\"a\",\"sart\":{\"subsets\":[1]}}", ERR_INVALID, "/sart/subsets", "views"},
    {"{\"scan\":\"a\",\"sart\":{\"nonnegative\":0}}", ERR_INVALID, "/sart/nonnegative", "true or false"},
    {"{\"scan\":\"a\",\"sart\":{\"stop\":0.1}}", ERR_INVALID, "/sart/stop", "an object"},
    {"{\"scan\":\"a\",\"sart\":{\"stop\":{\"residual\":-1}}}", ERR_IMPOSSIBLE, "/sart/stop/residual", "-1"},
    {"{\"scan\":\"a\",\"sart\":{\"stop\":{\"seconds\":1}}}", ERR_INVALID, "/sart/stop/seconds", "nobody knows"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"method\":\"rof\"}}", ERR_INVALID, "/tv/method", "proximal"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"alpha\":-0.1}}", ERR_IMPOSSIBLE, "/tv/alpha", "-0.1"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"method\":\"proximal\",\"alpha\":0}}", ERR_IMPOSSIBLE, "/tv/alpha", "0"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"alpha\":\"much\"}}", ERR_INVALID, "/tv/alpha", "auto"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"alpha\":true}}", ERR_INVALID, "/tv/alpha", "auto"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"method\":\"gradient\",\"alpha\":\"auto\"}}", ERR_IMPOSSIBLE, "/tv/alpha",
     "a number"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"alpha\":33.3}}", ERR_IMPOSSIBLE, "/tv/alpha", "at most 1.9 is stable"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"method\":\"gradient\",\"alpha\":2,\"step\":1}}", ERR_IMPOSSIBLE, "/tv/alpha",
     "at most 1.9 is stable"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"strength\":\"weak\"}}", ERR_INVALID, "/tv/strength", "medium"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"step\":0}}", ERR_IMPOSSIBLE, "/tv/step", "0"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"iterations\":0}}", ERR_IMPOSSIBLE, "/tv/iterations", "0"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"unit\":0}}", ERR_IMPOSSIBLE, "/tv/unit", "0"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"after\":\"fdk\"}}", ERR_INVALID, "/tv/after", "fdk+sart"},
    {"{\"scan\":\"a\",\"fdk\":{},\"emit\":\"fdk\"}", ERR_INVALID, "/emit", "list"},
    {"{\"scan\":\"a\",\"sart\":{},\"emit\":[1,\"2\"]}", ERR_INVALID, "/emit/1", "always kept"},
    {"{\"scan\":\"a\",\"sart\":{},\"emit\":[1,2,2.5]}", ERR_INVALID, "/emit/2", "number of an iteration"},
    {"{\"scan\":\"a\",\"sart\":{},\"emit\":[0]}", ERR_IMPOSSIBLE, "/emit/0", "0"},
    {"{\"scan\":\"a\",\"sart\":{},\"emit\":[1,1,11]}", ERR_IMPOSSIBLE, "/emit/2", "11"},
    {"{\"scan\":\"a\",\"fdk\":{},\"emit\":[1]}", ERR_IMPOSSIBLE, "/emit/0", "1"},
    {"{\"scan\":\"a\",\"sart\":{},\"emit\":[3,\"fdk\"]}", ERR_IMPOSSIBLE, "/emit/1", "FDK"},
    {"{\"scan\":\"a\",\"fdk\":{},\"emit\":[\"fdk-tv\"]}", ERR_IMPOSSIBLE, "/emit/0", "TV"},
    {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"after\":\"sart\"},\"emit\":[\"fdk\",\"fdk-tv\"]}", ERR_IMPOSSIBLE, "/emit/1",
     "TV"},
    {"{\"scan\":\"a\",\"sart\":{},\"tv\":{},\"emit\":[\"fdk-tv\"]}", ERR_IMPOSSIBLE, "/emit/0", "FDK"},
    {"{\"scan\":\"a\",\"fdk\":{},\"priority\":\"now\"}", ERR_INVALID, "/priority", "urgent"},
    {"{\"scan\":\"a\",\"fdk\":{},\"precision\":\"half\"}", ERR_INVALID, "/precision", "reference"},
    {"{\"scan\":\"a\",\"fdk\":{},\"projector\":\"siddon\"}", ERR_INVALID, "/projector", "matched"},
    {"{\"scan\":\"a\",\"fdk\":{},\"projector\":1}", ERR_INVALID, "/projector", "matched"},
    {"{\"scan\":\"a\",\"fdk\":{},\"metal\":2500}", ERR_INVALID, "/metal", "an object"},
    {"{\"scan\":\"a\",\"fdk\":{},\"metal\":{\"threshold\":2500}}", ERR_INVALID, "/metal/threshold", "nobody knows"},
    {"{\"scan\":\"a\",\"fdk\":{},\"metal\":{\"threshold_hu\":499}}", ERR_IMPOSSIBLE, "/metal/threshold_hu", "500"},
    {"{\"scan\":\"a\",\"fdk\":{},\"metal\":{\"threshold_hu\":\"2500\"}}", ERR_INVALID, "/metal/threshold_hu", "number"},
    {"{\"scan\":\"a\",\"sart\":{},\"metal\":{}}", ERR_IMPOSSIBLE, "/metal", "no FDK"},
    {"{\"scan\":\"a\",\"fdk\":{},\"mu_water\":0}", ERR_IMPOSSIBLE, "/mu_water", "0"},
    {"{\"scan\":\"a\",\"fdk\":{},\"mu_water\":1e999}", ERR_INVALID, "/mu_water", "double"},
    {"{\"scan\":\"0123456789012345678901234567890123456789012345678901234567890123\",\"fdk\":{}}", ERR_INVALID, "/scan",
     "64 bytes"},
};

/* .1 times 19 is a little more than 1.9 in binary. */
START_TEST(explicit_steps_at_their_bound_are_taken)
{
	static const char *const texts[] = {"{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"step\":19}}",
					    "{\"scan\":\"a\",\"fdk\":{},\"tv\":{\"alpha\":1,\"step\":1.9}}"};

	for (int i = 0; i < 2; i++) {
		struct job_request request = {.scan = ""};
		struct error err = {0};

		ck_assert_msg(parse_and_resolve(texts[i], &request, &err) == 0, "%s: %s", texts[i], err.text);
		job_request_clear(&request);
	}
}
END_TEST

START_TEST(bad_requests_are_refused_by_their_pointer)
{
	for (size_t i = 0; i < sizeof(refused) / sizeof(refused[0]); i++) {
		struct job_request request = {.scan = "untouched"};
		struct error err = {0};
		int code = parse_and_resolve(refused[i].text, &request, &err);

		expect_refused(refused[i].text, code, &err, refused[i].code, refused[i].pointer, refused[i].says);
		ck_assert_str_eq(request.scan, "untouched");
	}
}
END_TEST

START_TEST(a_list_of_too_many_volumes_is_refused)
{
	char *text = malloc(200000), *at = text;
	struct job_request request;
	struct error err = {0};

	ck_assert_ptr_nonnull(text);
	at += sprintf(at, "{\"scan\":\"a\",\"sart\":{\"iterations\":20000},\"emit\":[1");
	for (int i = 2; i <= EMITS_MAX; i++)
		at += sprintf(at, ",%d", i);
	memcpy(at, "]}", 3);
	ck_assert_int_eq(parse(text, &request, &err), 0);
	ck_assert_int_eq(request.recipe.emits, EMITS_MAX);
	job_request_clear(&request);
	memcpy(at, ",9]}", 5);
	ck_assert_int_eq(parse(text, &request, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.pointer, "/emit");
	free(text);
}
END_TEST

START_TEST(subsets_left_out_are_ten_or_as_many_as_views)
{
	struct scan *few = NULL;
	struct job_request request;
	struct error err = {0};
	char text[400];

	snprintf(text, sizeof(text),
		 "{\"detector\":{\"columns\":64,\"rows\":48,\"pixel_mm\":[4,4]},\"projections\":{\"count\":6,"
		 "\"sample\":\"float32\",\"quantity\":\"line_integral\"},\"geometry\":{\"kind\":\"circular\","
		 "\"source_to_isocentre_mm\":600,\"source_to_detector_mm\":1000,\"angle_step_deg\":60}}");
	ck_assert_int_eq(scan_parse(text, strlen(text), &few, &err), 0);
	ck_assert_int_eq(parse("{\"scan\":\"a\",\"sart\":{}}", &request, &err), 0);
	ck_assert_int_eq(job_request_resolve(&request, few, &err), 0);
	ck_assert_int_eq(request.recipe.sart.subsets, 6);
	job_request_clear(&request);
	ck_assert_int_eq(parse("{\"scan\":\"a\",\"sart\":{\"subsets\":\"views\"}}", &request, &err), 0);
	ck_assert_int_eq(job_request_resolve(&request, few, &err), 0);
	ck_assert_int_eq(request.recipe.sart.subsets, SUBSETS_VIEWS);
	job_request_clear(&request);
	scan_free(few);
}
END_TEST

Suite *recipe_suite(void)
{
	Suite *suite = suite_create("recipe");
	TCase *tests = tcase_create("job document");

	tcase_add_checked_fixture(tests, open_scan, close_scan);
	tcase_add_test(tests, requests_come_back_the_same);
	tcase_add_test(tests, different_requests_are_not_the_same);
	tcase_add_test(tests, a_preset_is_what_it_stands_for);
	tcase_add_test(tests, defaults_are_the_contracts);
	tcase_add_test(tests, numbers_of_tv_mean_explicit_steps_and_none_means_auto);
	tcase_add_test(tests, the_grid_is_centred_unless_it_says_otherwise);
	tcase_add_test(tests, emitted_volumes_are_sorted_and_each_once);
	tcase_add_test(tests, bad_requests_are_refused_by_their_pointer);
	tcase_add_test(tests, explicit_steps_at_their_bound_are_taken);
	tcase_add_test(tests, a_list_of_too_many_volumes_is_refused);
	tcase_add_test(tests, subsets_left_out_are_ten_or_as_many_as_views);
	suite_add_tcase(suite, tests);
	return suite;
}

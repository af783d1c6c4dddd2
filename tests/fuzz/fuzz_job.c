/* Any document of a job: refused with a reason, or a request that is written out and comes back the same. */
#include <string.h>

#include "proto/recipe.h"
#include "tests/fuzz/fuzz.h"

static const char document[] = "{\"detector\":{\"columns\":32,\"rows\":24,\"pixel_mm\":[4,4]},"
			       "\"projections\":{\"count\":12,\"sample\":\"float32\",\"quantity\":\"line_integral\"},"
			       "\"geometry\":{\"kind\":\"circular\",\"source_to_isocentre_mm\":600,"
			       "\"source_to_detector_mm\":1000,\"angle_step_deg\":30}}";

static void check_round_trip(const struct job_request *request)
{
	struct job_request back;
	struct error err = {0};
	cJSON *json = job_request_json(request);
	char *text = json != NULL ? json_print(json, NULL) : NULL;

	PROMISE(text != NULL && job_request_parse(text, strlen(text), &back, &err) == 0);
	PROMISE(job_request_same(request, &back));
	job_request_clear(&back);
	cJSON_Delete(json);
	free(text);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static struct scan *scan;
	struct job_request request;
	struct error err = {0};

	if (scan == NULL)
		PROMISE(scan_parse(document, sizeof(document) - 1, &scan, &err) == 0);
	if (job_request_parse((const char *)data, size, &request, &err) != 0) {
		PROMISE(err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	check_round_trip(&request);
	if (job_request_resolve(&request, scan, &err) == 0)
		check_round_trip(&request);
	else
		PROMISE(err.code < 0 && err.text[0] != '\0');
	job_request_clear(&request);
	return 0;
}

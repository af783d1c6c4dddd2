/*
 * Any bytes as a phantom of balls, and two texts, with a zero byte between them, as the documents of a calibration:
 * refused with a reason, or balls and poses that are finite.
 */
#include <math.h>
#include <string.h>

#include "proto/calibration.h"
#include "proto/calibration_files.h"
#include "tests/fuzz/fuzz.h"

static void check_phantom(const char *text, size_t length)
{
	struct balls balls;
	struct error err = {0};

	if (balls_parse(text, length, &balls, &err) != 0) {
		PROMISE(err.code < 0 && err.text[0] != '\0');
		return;
	}
	PROMISE(balls.count > 0);
	for (int i = 0; i < balls.count; i++) {
		const struct ball *ball = &balls.ball[i];

		PROMISE(isfinite(ball->centre[0]) && isfinite(ball->centre[1]) && isfinite(ball->centre[2]));
		PROMISE(isfinite(ball->diameter) && ball->diameter > 0);
	}
	balls_clear(&balls);
}

static void check_documents(const char *request_text, size_t request_length, const char *result_text,
			    size_t result_length)
{
	cJSON *request = NULL, *result = NULL;
	struct calibrated calibrated;
	struct error err = {0};

	if (json_parse(request_text, request_length, &request, &err) == 0 &&
	    json_parse(result_text, result_length, &result, &err) == 0) {
		if (calibrated_read(request, result, &calibrated, &err) == 0) {
			PROMISE(calibrated.sweep != NULL && calibrated.geometry.count == calibrated.sweep->count);
			calibrated_clear(&calibrated);
		} else {
			PROMISE(err.code < 0 && err.text[0] != '\0');
		}
	}
	cJSON_Delete(request);
	cJSON_Delete(result);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	const char *text = (const char *)data, *end = memchr(data, '\0', size);

	if (end == NULL)
		check_phantom(text, size);
	else
		check_documents(text, (size_t)(end - text), end + 1, size - (size_t)(end - text) - 1);
	return 0;
}

/* /v1/scans/{}/projections, the images of core/scan/image.h, and those of scatter */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/api/internal.h"
#include "proto/digest.h"
#include "proto/slice.h"

/* ---- in ---- */

/* "" (all), "k" or "a-b". */
static int read_run(const char *text, int count, struct upload_target *target, struct error *err)
{
	const char *dash = strchr(text, '-');
	size_t length = dash != NULL ? (size_t)(dash - text) : strlen(text);
	long first = 0, last = count - 1;

	if (text[0] != '\0') {
		if (!index_parse(text, length, 1000000000, &first))
			return error_set(err, ERR_NOT_FOUND, "\"%.60s\" is neither a projection nor a run of them",
					 text);
		last = first;
		if (dash != NULL && !index_parse(dash + 1, strlen(dash + 1), 1000000000, &last))
			return error_set(err, ERR_NOT_FOUND, "\"%.60s\" is no run of projections", text);
	}
	if (first >= count || last >= count)
		return error_set(err, ERR_NOT_FOUND, "projection %ld is asked for, the scan has 0 to %d",
				 last > first ? last : first, count - 1);
	if (last < first)
		return error_set(err, ERR_INVALID, "the run %.60s ends before it begins", text);
	*target = (struct upload_target){.kind = UPLOAD_PROJECTIONS, .first = (int)first, .last = (int)last};
	return 0;
}

static void release_upload(void *state)
{
	upload_release(state);
}

static int begin(struct api *api, struct request *request, struct stored_scan *scan, const struct upload_target *target,
		 struct error *err)
{
	struct upload *upload = NULL;

	if (upload_new(api->uploads, request, scan, target, &upload, err) != 0)
		return err->code;
	request_set_state(request, upload, release_upload);
	return 0;
}

int projections_begin(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct upload_target target;
	struct stored_scan *scan;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	if (read_run(request_argument(request, 1), stored_scan_parsed(scan)->count, &target, err) != 0) {
		stored_scan_release(scan);
		return err->code;
	}
	return begin(api, request, scan, &target, err);
}

/* The route's second argument is the name of an image. */
int image_begin(void *context, struct request *request, struct error *err)
{
	const int image = image_find(request_argument(request, 1));
	const struct upload_target target = {.kind = UPLOAD_IMAGE, .image = (enum image)image};
	struct api *api = context;
	struct stored_scan *scan;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	if (image_kinds[image].intensities && stored_scan_parsed(scan)->quantity != QUANTITY_INTENSITY) {
		stored_scan_release(scan);
		return error_set(err, ERR_IMPOSSIBLE, "the scan's quantity is line_integral; a %s is for intensity",
				 image_kinds[image].title);
	}
	return begin(api, request, scan, &target, err);
}

static int scatter_announced(const struct scan *scan, struct error *err)
{
	return scan->scatter.images.columns != 0
		   ? 0
		   : error_set(err, ERR_CONFLICT,
			       "the scan announces no images of scatter, as {\"kind\": \"images\"} in its member "
			       "projections.scatter would");
}

/* The image of scatter that the request's path names by its projection. */
static int scatter_asked(struct request *request, const struct scan *scan, int *ret_image, struct error *err)
{
	const struct scatter_images *images = &scan->scatter.images;
	const char *text = request_argument(request, 1);
	long projection;

	if (scatter_announced(scan, err) != 0)
		return err->code;
	if (!index_parse(text, strlen(text), scan->count - 1, &projection))
		return error_set(err, ERR_NOT_FOUND, "projection \"%.40s\" is asked for, the scan has 0 to %d", text,
				 scan->count - 1);
	*ret_image = scatter_image_of(images, scan->count, (int)projection);
	if (*ret_image < 0)
		return error_set(
		    err, ERR_NOT_FOUND,
		    "projection %ld has no image of its scatter in this scan: every %d-th has, and the last",
		    projection, images->every);
	return 0;
}

int scatter_begin(void *context, struct request *request, struct error *err)
{
	struct upload_target target = {.kind = UPLOAD_SCATTER};
	struct api *api = context;
	struct stored_scan *scan;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	if (scatter_asked(request, stored_scan_parsed(scan), &target.first, err) != 0) {
		stored_scan_release(scan);
		return err->code;
	}
	target.last = target.first;
	return begin(api, request, scan, &target, err);
}

int upload_take(void *context, struct request *request, const void *data, size_t size, size_t *ret_taken,
		struct error *err)
{
	(void)context;
	return upload_data(request_state(request), data, size, ret_taken, err);
}

int projections_put(void *context, struct request *request, struct error *err)
{
	struct upload_outcome outcome;
	cJSON *document;
	int code = upload_end(request_state(request), &outcome, err);

	(void)context;
	if (code != 0)
		return code;
	document = cJSON_CreateObject();
	cJSON_AddStringToObject(document, "scan", request_argument(request, 0));
	cJSON_AddNumberToObject(document, "stored", outcome.created);
	cJSON_AddNumberToObject(document, "same", outcome.same);
	if (outcome.warnings != NULL)
		json_add(document, "warnings", outcome.warnings);
	return request_reply_json(request, outcome.created > 0 ? 201 : 200, document, err);
}

int image_put(void *context, struct request *request, struct error *err)
{
	return projections_put(context, request, err);
}

int image_delete(void *context, struct request *request, struct error *err)
{
	const enum image image = (enum image)image_find(request_argument(request, 1));
	struct api *api = context;
	struct stored_scan *scan;
	int code;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = jobs_remove_image(api->jobs, scan, image, err);
	stored_scan_release(scan);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}

/* The image of scatter that the path names, or all of them. */
static int delete_scatter(struct api *api, struct request *request, bool all, struct error *err)
{
	struct stored_scan *scan;
	int image = -1, code;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = all ? scatter_announced(stored_scan_parsed(scan), err)
		   : scatter_asked(request, stored_scan_parsed(scan), &image, err);
	if (code == 0)
		code = jobs_remove_scatter(api->jobs, scan, image, err);
	stored_scan_release(scan);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}

int scatter_delete(void *context, struct request *request, struct error *err)
{
	return delete_scatter(context, request, false, err);
}

int scatter_delete_all(void *context, struct request *request, struct error *err)
{
	return delete_scatter(context, request, true, err);
}

/* ---- out ---- */

/* As float; the smallest finite sample and the largest. */
static void read_samples(const void *samples, const struct scan *scan, size_t count, float *ret_values,
			 struct slice *ret_range)
{
	float black = INFINITY, white = -INFINITY;

	for (size_t i = 0; i < count; i++) {
		uint16_t counts;

		if (scan->sample == SAMPLE_UINT16) {
			memcpy(&counts, (const char *)samples + i * sizeof(counts), sizeof(counts));
			ret_values[i] = counts;
		} else {
			memcpy(&ret_values[i], (const char *)samples + i * sizeof(float), sizeof(float));
		}
		if (isfinite(ret_values[i])) {
			black = fminf(black, ret_values[i]);
			white = fmaxf(white, ret_values[i]);
		}
	}
	ret_range->black = (double)black;
	ret_range->white = (double)white;
}

/* The smallest finite sample black, the largest white. */
static int draw(const void *samples, const struct scan *scan, char **ret_png, size_t *ret_length, struct error *err)
{
	const struct grid grid = {.size = {scan->geometry.columns, scan->geometry.rows, 1}, .spacing = {1, 1, 1}};
	const size_t count = grid_voxels(&grid);
	struct slice slice = {.axis = 2};
	float *values = malloc(count * sizeof(*values));
	unsigned char *pixels = malloc(count);
	int code = 0;

	if (values == NULL || pixels == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a picture of %zu pixels", count);
		goto out;
	}
	read_samples(samples, scan, count, values, &slice);
	slice_make(values, &grid, &slice, 0, pixels);
	code = gray_png(pixels, grid.size[0], grid.size[1], NULL, ret_png, ret_length, err);
out:
	free(values);
	free(pixels);
	return code;
}

enum { ETAG_MAX = 48 };

static void make_etag(const uint8_t sha256[32], const char *kind, char ret_etag[ETAG_MAX])
{
	char digest[33];

	for (int i = 0; i < 16; i++)
		snprintf(digest + 2 * i, sizeof(digest) - 2 * (size_t)i, "%02x", sha256[i]);
	snprintf(ret_etag, ETAG_MAX, "\"%s%s\"", digest, kind);
}

/* A picture that a request waits for. */
struct wanted {
	struct stored_scan *stored;
	int descriptor, index;
	struct selection selection;
	char etag[ETAG_MAX];
};

static struct entity entity_of(const struct wanted *wanted)
{
	return (struct entity){.etag = wanted->etag, .size = UNKNOWN_SIZE, .media_type = "image/png"};
}

static int draw_wanted(void *subject, struct picture *picture, char **ret_png, size_t *ret_length, struct error *err)
{
	const struct wanted *wanted = subject;
	const struct scan *scan = stored_scan_parsed(wanted->stored);
	void *samples = malloc(scan_projection_bytes(scan));
	struct sum sum;
	int code;

	(void)picture;
	if (samples == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture");
	code = stored_scan_read(wanted->stored, wanted->descriptor, wanted->index, samples, &sum, err);
	if (code == 0)
		code = draw(samples, scan, ret_png, ret_length, err);
	free(samples);
	return code;
}

static void add_headers(void *subject, struct request *request)
{
	const struct wanted *wanted = subject;
	const struct entity entity = entity_of(wanted);

	entity_headers(request, &entity, &wanted->selection);
}

static void free_wanted(void *subject)
{
	struct wanted *wanted = subject;

	close(wanted->descriptor);
	stored_scan_release(wanted->stored);
}

static const struct picture_kind projections = {draw_wanted, add_headers, free_wanted};

/* Takes the descriptor. */
static int reply_picture(struct api *api, struct request *request, struct stored_scan *stored, int descriptor,
			 int index, const uint8_t sha256[32], struct error *err)
{
	enum { PICTURE_PIXELS_MAX = 64 << 20 };
	const struct scan *scan = stored_scan_parsed(stored);
	const size_t pixels = scan_projection_bytes(scan) / sample_bytes(scan->sample);
	struct wanted *wanted = calloc(1, sizeof(*wanted)), read = {.descriptor = descriptor, .index = index};
	const struct entity entity = entity_of(&read);
	bool done = false;
	int code = 0;

	make_etag(sha256, "-png", read.etag);
	code = entity_select(request, &entity, &read.selection, &done, err);
	if (code == 0 && !done && pixels > PICTURE_PIXELS_MAX)
		code = error_set(err, ERR_IMPOSSIBLE, "a picture has at most %d pixels, the projection %zu",
				 PICTURE_PIXELS_MAX, pixels);
	if (code == 0 && !done && wanted == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a picture");
	if (code == 0 && !done) /* the picture's own reference */
		code = store_scan_find(api->store, request_argument(request, 0), &read.stored, err);
	if (code == 0 && !done) {
		*wanted = read;
		return picture_begin(api, request, &projections, wanted, err);
	}
	close(descriptor);
	free(wanted);
	return code;
}

/* From the file, once it was held against its checksum. Takes the descriptor. */
static int reply_samples(struct request *request, const struct scan *scan, int descriptor, int index,
			 const uint8_t sha256[32], struct error *err)
{
	char etag[ETAG_MAX], filename[96], digest[DIGEST_TEXT_MAX];
	struct entity entity = {.etag = etag,
				.size = scan_projection_bytes(scan),
				.media_type = "application/octet-stream",
				.filename = filename};
	struct selection selection;
	bool done;

	make_etag(sha256, "", etag);
	snprintf(filename, sizeof(filename), "%.40s-%d.raw", request_argument(request, 0), index);
	if (entity_select(request, &entity, &selection, &done, err) != 0 || done) {
		close(descriptor);
		return done ? 0 : err->code;
	}
	if (request_reply_file(request, selection.status, descriptor, (uint64_t)index * entity.size + selection.first,
			       selection.length, err) != 0)
		return err->code;
	entity_headers(request, &entity, &selection);
	digest_text(sha256, digest);
	request_reply_header(request, "Repr-Digest", "%s", digest);
	return 0;
}

static int reply_projection(struct api *api, struct request *request, struct stored_scan *stored, struct error *err)
{
	static const char *const formats[] = {"raw", "png", NULL};
	const struct scan *scan = stored_scan_parsed(stored);
	const char *text = request_argument(request, 1);
	int format, descriptor, code;
	struct sum sum;
	long index;

	if (query_choice(request, "format", formats, &format, err) != 0)
		return err->code;
	if (!index_parse(text, strlen(text), scan->count - 1, &index))
		return error_set(err, ERR_NOT_FOUND, "projection \"%.40s\" is asked for, the scan has 0 to %d", text,
				 scan->count - 1);
	if (stored_scan_open(stored, false, &descriptor, err) != 0)
		return err->code;
	code = stored_scan_verify(stored, descriptor, (int)index, &sum, err);
	if (code == 0 && format == 0)
		return reply_samples(request, scan, descriptor, (int)index, sum.sha256, err);
	if (code == 0)
		return reply_picture(api, request, stored, descriptor, (int)index, sum.sha256, err);
	close(descriptor);
	return code;
}

int projection_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *scan;
	int code;

	if (request_state(request) != NULL)
		return picture_go_on(request, err);
	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = reply_projection(api, request, scan, err);
	stored_scan_release(scan);
	return code;
}

static int reply_scatter(struct request *request, struct stored_scan *stored, struct error *err)
{
	const struct scan *scan = stored_scan_parsed(stored);
	char etag[ETAG_MAX], filename[96], digest[DIGEST_TEXT_MAX];
	struct entity entity = {
	    .etag = etag, .size = UNKNOWN_SIZE, .media_type = "application/octet-stream", .filename = filename};
	struct selection selection;
	struct sum sum;
	size_t size;
	void *pixels;
	bool done;
	int image;

	if (scatter_asked(request, scan, &image, err) != 0)
		return err->code;
	size = scatter_image_bytes(&scan->scatter.images);
	pixels = malloc(size);
	if (pixels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for an image of %zu bytes", size);
	if (store_read_scatter(stored, image, pixels, &sum, err) != 0) {
		free(pixels);
		return err->code;
	}
	make_etag(sum.sha256, "", etag);
	snprintf(filename, sizeof(filename), "%.40s-scatter-%.10s.raw", request_argument(request, 0),
		 request_argument(request, 1));
	if (entity_select(request, &entity, &selection, &done, err) != 0 || done) {
		free(pixels);
		return done ? 0 : err->code;
	}
	if (request_reply_bytes(request, 200, pixels, size, err) != 0)
		return err->code;
	entity_headers(request, &entity, &selection);
	digest_text(sum.sha256, digest);
	request_reply_header(request, "Repr-Digest", "%s", digest);
	return 0;
}

int scatter_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *scan;
	int code;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = reply_scatter(request, scan, err);
	stored_scan_release(scan);
	return code;
}

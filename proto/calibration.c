/* Calibrations between files and core/calibrate: see calibration.h. */
#include "proto/calibration.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/input.h"
#include "proto/sums.h"

static const double degree = M_PI / 180;
static const double length_least = 1e-3, length_most = 1000; /* mm, of phantoms */
static const double angle_most = 360;                        /* degrees */

/*
 * By how much an arm's distances may differ from the nominal ones without a word: as these are known, beside what the
 * scan itself leaves open. The second is of documents of before diameters had an error.
 */
static const double distance_open = .01, distance_open_before = .03;

/* ---- phantoms ---- */

static int read_places(struct json_reader *reader, struct balls *ret_balls)
{
	const cJSON *list = json_member(reader, "balls_mm", true), *entry;
	const int count = cJSON_IsArray(list) ? cJSON_GetArraySize(list) : 0;
	struct ball *balls = NULL;
	int code, index = 0;

	if (list != NULL && !cJSON_IsArray(list))
		json_fail(reader, ERR_INVALID, "balls_mm", "a list of [x, y, z, diameter] in mm is expected");
	code = json_end(reader);
	if (code != 0)
		return code;
	balls = calloc((size_t)count + 1, sizeof(*balls));
	if (balls == NULL)
		return error_set(reader->err, ERR_NO_MEMORY, "no memory for %d balls", count);
	cJSON_ArrayForEach(entry, list)
	{
		char pointer[64];
		double numbers[4];

		snprintf(pointer, sizeof(pointer), "/balls_mm/%d", index);
		code = json_array(entry, pointer, 4, -length_most, length_most, numbers, reader->err);
		if (code != 0)
			break;
		memcpy(balls[index].centre, numbers, sizeof(balls[index].centre));
		balls[index++].diameter = numbers[3];
	}
	if (code == 0)
		code = balls_copy(ret_balls, balls, count, reader->err);
	free(balls);
	return code;
}

static int read_circles(struct json_reader *reader, struct balls *ret_balls)
{
	struct ball_circles circles = {.circles = 2};
	long count = 2, balls = 0;
	double first = 0, shift = 0;

	json_integer(reader, "circles", false, 2, BALLS_MOST, &count);
	json_integer(reader, "balls", true, 3, BALLS_MOST, &balls);
	json_number(reader, "diameter_mm", true, length_least, length_most, &circles.diameter);
	json_number(reader, "distance_mm", true, length_least, length_most, &circles.distance);
	json_number(reader, "ball_mm", true, length_least, length_most, &circles.ball);
	json_number(reader, "first_angle_deg", false, -angle_most, angle_most, &first);
	json_number(reader, "shift_deg", false, -angle_most, angle_most, &shift);
	if (json_end(reader) != 0)
		return reader->code;
	circles.circles = (int)count;
	circles.balls = (int)balls;
	circles.first = first * degree;
	circles.shift = shift * degree;
	return balls_circles(ret_balls, &circles, reader->err);
}

static int read_helix(struct json_reader *reader, struct balls *ret_balls)
{
	struct ball_helix helix = {0};
	char code[BALLS_MOST + 1] = "";
	bool large[BALLS_MOST] = {false};
	long balls = 0;
	double first = 0, step = 0;

	json_integer(reader, "balls", true, BALLS_LEAST, BALLS_MOST, &balls);
	json_number(reader, "diameter_mm", true, length_least, length_most, &helix.diameter);
	json_number(reader, "pitch_mm", true, length_least, length_most, &helix.pitch);
	json_number(reader, "angle_step_deg", true, -angle_most, angle_most, &step);
	json_number(reader, "first_angle_deg", false, -angle_most, angle_most, &first);
	json_number(reader, "ball_mm", true, length_least, length_most, &helix.ball[0]);
	helix.ball[1] = helix.ball[0];
	json_number(reader, "large_ball_mm", json_has(reader, "code"), length_least, length_most, &helix.ball[1]);
	json_string(reader, "code", json_has(reader, "large_ball_mm"), code, sizeof(code));
	if (reader->code == 0 && code[0] != '\0' &&
	    (strlen(code) != (size_t)balls || strspn(code, "01") != (size_t)balls))
		json_fail(reader, ERR_INVALID, "code", "%ld characters 0 (small) or 1 (large) are expected", balls);
	if (json_end(reader) != 0)
		return reader->code;
	for (long i = 0; i < balls && code[0] != '\0'; i++)
		large[i] = code[i] == '1';
	helix.balls = (int)balls;
	helix.first = first * degree;
	helix.step = step * degree;
	helix.large = code[0] != '\0' ? large : NULL;
	return balls_helix(ret_balls, &helix, reader->err);
}

static const struct {
	const char *name;
	int (*read)(struct json_reader *reader, struct balls *ret_balls);
} kinds[] = {{"balls", read_places}, {"circles", read_circles}, {"helix", read_helix}};
enum { KINDS = sizeof(kinds) / sizeof(kinds[0]) };

int balls_read(const cJSON *phantom, struct balls *ret_balls, struct error *err)
{
	struct json_reader reader;
	const char *names[KINDS];
	int kind = 0;

	for (int i = 0; i < KINDS; i++)
		names[i] = kinds[i].name;
	json_begin(&reader, phantom, "", err);
	json_choice(&reader, "kind", false, names, KINDS, &kind);
	return reader.code != 0 ? reader.code : kinds[kind].read(&reader, ret_balls);
}

int balls_parse(const char *text, size_t length, struct balls *ret_balls, struct error *err)
{
	cJSON *phantom = NULL;
	int code = json_parse(text, length, &phantom, err);

	if (code == 0)
		code = balls_read(phantom, ret_balls, err);
	cJSON_Delete(phantom);
	return code;
}

/* ---- pictures ---- */

/* The plan and buffers with which one thread turns samples into line integrals. */
struct reader {
	struct plan *plan;
	struct stack *stack; /* one slot */
	void *samples;
	struct reader *next;
};

struct source {
	const struct scan_files *files;
	const struct backend *backend;
	struct device *device;
	struct input input;
	pthread_mutex_t lock; /* guards idle */
	struct reader *idle;
};

static struct reader *reader_free(const struct source *source, struct reader *reader)
{
	if (reader == NULL)
		return NULL;
	source->backend->plan_free(reader->plan);
	source->backend->stack_free(reader->stack);
	free(reader->samples);
	free(reader);
	return NULL;
}

static int reader_new(const struct source *source, struct reader **ret_reader, struct error *err)
{
	const struct geometry *geometry = &source->files->scan->geometry;
	const struct grid grid = {.size = {1, 1, 1}, .spacing = {1, 1, 1}};
	const struct plan_options options = {
	    .geometry = geometry, .grid = &grid, .linearise = source->input.linearise, .no_projection = true};
	struct reader *reader = calloc(1, sizeof(*reader));
	int code;

	if (reader == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a projection");
	reader->samples = malloc(scan_projection_bytes(source->files->scan));
	code = reader->samples != NULL ? source->backend->plan_new(source->device, &options, &reader->plan, err)
				       : error_set(err, ERR_NO_MEMORY, "no memory for a projection");
	if (code == 0)
		code = source->backend->stack_new(source->device, geometry->columns, geometry->rows, 1, &reader->stack,
						  err);
	if (code != 0)
		reader_free(source, reader);
	else
		*ret_reader = reader;
	return code;
}

static int reader_take(struct source *source, struct reader **ret_reader, struct error *err)
{
	struct reader *reader;

	pthread_mutex_lock(&source->lock);
	reader = source->idle;
	if (reader != NULL)
		source->idle = reader->next;
	pthread_mutex_unlock(&source->lock);
	if (reader == NULL)
		return reader_new(source, ret_reader, err);
	*ret_reader = reader;
	return 0;
}

static void reader_give_back(struct source *source, struct reader *reader)
{
	pthread_mutex_lock(&source->lock);
	reader->next = source->idle;
	source->idle = reader;
	pthread_mutex_unlock(&source->lock);
}

/* Samples of a projection, held against their checksum where the directory has some. */
static int read_samples(const struct scan_files *files, int view, void *ret_samples, struct error *err)
{
	const size_t bytes = scan_projection_bytes(files->scan);
	unsigned char state = SUM_NONE;
	struct sum sum = {0};
	int code = file_read_at(files->projections, ret_samples, bytes, (size_t)view * bytes, "projections.raw", err);

	if (code != 0 || files->sums < 0)
		return code;
	code = sums_get(files->sums, view, 1, bytes, &sum, &state, err);
	if (code == 0 && (state != SUM_GOOD || sum.lost || sum.crc != checksum(0, ret_samples, bytes)))
		code = error_set(err, ERR_DAMAGED, "projection %d is damaged: its samples do not fit their checksum",
				 view);
	return code;
}

/* The calibrate_image of a scan directory. */
static int read_view(void *context, int view, float *ret_image, struct error *err)
{
	struct source *source = context;
	const int slot = 0;
	struct defect_counts counts = {0};
	struct reader *reader = NULL;
	int code = reader_take(source, &reader, err);

	if (code != 0)
		return code;
	code = read_samples(source->files, view, reader->samples, err);
	if (code == 0)
		code = source->backend->linearise(reader->plan, reader->samples, 1, &slot, reader->stack, &counts, err);
	if (code == 0)
		code = source->backend->stack_download(reader->stack, 0, 1, ret_image, err);
	reader_give_back(source, reader);
	return code;
}

/* Without air, counts are taken for what they are, and the calibration tells that they are no line integrals. */
static int source_open(struct source *source, const struct scan_files *files, struct error *err)
{
	const struct device_options options = {.threads = 1};
	struct linearise linearise = scan_linearise(files->scan);
	int code;

	*source = (struct source){.files = files, .backend = backend_find("cpu")};
	for (int i = 0; i < IMAGE_COUNT; i++)
		linearise.image[i] = files->image[i];
	linearise.lag = NULL; /* neither moves a shadow's edges */
	linearise.scatter = NULL;
	pthread_mutex_init(&source->lock, NULL);
	if (linearise.quantity == QUANTITY_INTENSITY && linearise.air <= 0 && linearise.image[IMAGE_FLAT] == NULL)
		return error_set(err, ERR_IMPOSSIBLE, "intensities need an air value or a flat image, none is there");
	code = input_open(&source->input, &linearise, &files->scan->geometry, 1, false, err);
	return code == 0 ? source->backend->open(0, &options, &source->device, err) : code;
}

static void source_close(struct source *source)
{
	while (source->idle != NULL) {
		struct reader *reader = source->idle;

		source->idle = reader->next;
		reader_free(source, reader);
	}
	input_clear(&source->input);
	source->backend->close(source->device);
	pthread_mutex_destroy(&source->lock);
}

int calibration_from_directory(const struct scan_files *files, const struct balls *balls, bool adjust_balls,
			       struct calibration *ret_calibration, struct error *err)
{
	struct source source;
	const struct calibrate_request request = {.nominal = &files->scan->geometry,
						  .pixel_mm = files->scan->pixel_mm,
						  .balls = balls,
						  .adjust_balls = adjust_balls,
						  .image = read_view,
						  .context = &source};
	int code = source_open(&source, files, err);

	if (code == 0)
		code = calibrate(ret_calibration, &request, err);
	source_close(&source);
	return code;
}

/* ---- the document ---- */

cJSON *matrices_json(const struct view *views, int count)
{
	cJSON *geometry = cJSON_CreateObject(), *list;

	cJSON_AddStringToObject(geometry, "kind", "matrices");
	list = cJSON_AddArrayToObject(geometry, "matrices");
	for (int k = 0; k < count; k++) {
		double matrix[12];

		view_matrix(&views[k], matrix);
		json_append(list, cJSON_CreateDoubleArray(matrix, 12));
	}
	return geometry;
}

static cJSON *view_json(const struct calibrated_view *view)
{
	cJSON *json = cJSON_CreateObject();

	cJSON_AddBoolToObject(json, "used", view->used);
	if (view->used)
		cJSON_AddNullToObject(json, "refused");
	else
		cJSON_AddStringToObject(json, "refused", view->refused);
	cJSON_AddNumberToObject(json, "shadows", view->shadows);
	cJSON_AddNumberToObject(json, "balls", view->balls);
	cJSON_AddNumberToObject(json, "residual_pixels", view->rms);
	cJSON_AddNumberToObject(json, "largest_residual_pixels", view->worst);
	cJSON_AddNumberToObject(json, "residual_isocentre_mm", view->rms_isocentre);
	return json;
}

cJSON *calibration_json(const struct calibration *calibration)
{
	cJSON *json = cJSON_CreateObject(), *list;
	struct view *views = malloc((size_t)calibration->count * sizeof(*views));

	if (json == NULL || views == NULL) {
		cJSON_Delete(json);
		free(views);
		return NULL;
	}
	cJSON_AddNumberToObject(json, "residual_pixels", calibration->rms);
	cJSON_AddNumberToObject(json, "residual_isocentre_mm", calibration->rms_isocentre);
	cJSON_AddNumberToObject(json, "used", calibration->used);
	cJSON_AddNumberToObject(json, "turned_deg", calibration->turn / degree);
	if (calibration->rival_turn != 0)
		cJSON_AddNumberToObject(json, "other_turn_deg", calibration->rival_turn / degree);
	else
		cJSON_AddNullToObject(json, "other_turn_deg");
	if (calibration->rival_height != 0)
		cJSON_AddNumberToObject(json, "other_height_mm", calibration->rival_height);
	else
		cJSON_AddNullToObject(json, "other_height_mm");
	cJSON_AddNumberToObject(json, "diameter_ratio", calibration->diameter_ratio);
	cJSON_AddNumberToObject(json, "diameter_error", calibration->diameter_error);
	cJSON_AddNumberToObject(json, "distance_ratio", calibration->distance_ratio);
	cJSON_AddNumberToObject(json, "distance_error", calibration->distance_error);
	cJSON_AddNumberToObject(json, "interpolated_pixels", calibration->between);
	cJSON_AddNumberToObject(json, "interpolated_isocentre_mm", calibration->between_isocentre);
	cJSON_AddNumberToObject(json, "explained_mm", calibration->explained);
	cJSON_AddNumberToObject(json, "balls_moved_mm", calibration->adjusted_rms);
	list = cJSON_AddArrayToObject(json, "balls_mm");
	for (int b = 0; b < calibration->balls.count; b++) {
		const struct ball *ball = &calibration->balls.ball[b];
		const double numbers[4] = {ball->centre[0], ball->centre[1], ball->centre[2], ball->diameter};

		json_append(list, cJSON_CreateDoubleArray(numbers, 4));
	}
	list = cJSON_AddArrayToObject(json, "presence");
	for (int b = 0; b < calibration->balls.count; b++) {
		const int numbers[2] = {calibration->presence[b].expected, calibration->presence[b].found};

		json_append(list, cJSON_CreateIntArray(numbers, 2));
	}
	cJSON_AddNumberToObject(json, "stray_shadows", calibration->strays);
	cJSON_AddNumberToObject(json, "stray_views", calibration->stray_views);
	list = cJSON_AddArrayToObject(json, "views");
	for (int k = 0; k < calibration->count; k++) {
		views[k] = calibration->views[k].view;
		json_append(list, view_json(&calibration->views[k]));
	}
	json_add(json, "geometry", matrices_json(views, calibration->count));
	free(views);
	return json;
}

static double number_of(const cJSON *object, const char *name, double otherwise)
{
	const cJSON *number = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsNumber(number) ? number->valuedouble : otherwise;
}

static void add_doubt(cJSON *doubts, const char *code, const char *detail)
{
	cJSON *doubt = cJSON_CreateObject();

	cJSON_AddStringToObject(doubt, "code", code);
	cJSON_AddStringToObject(doubt, "detail", detail);
	json_append(doubts, doubt);
}

static const int views_least = 3; /* that tell of a ball */

/* Some of the drawing's balls, by their numbers. */
struct numbered {
	char balls[120];
	int count, views; /* views: that would show one of them alone, at most */
};

/* Balls that are not where they should be seen; or those that no view shows, or would show, alone. */
static struct numbered balls_not_found(const cJSON *json, bool off_picture)
{
	struct numbered ret = {.count = 0};
	const cJSON *entry;
	int ball = 0;

	cJSON_ArrayForEach(entry, cJSON_GetObjectItemCaseSensitive(json, "presence"))
	{
		const int expected = cJSON_GetArrayItem(entry, 0)->valueint,
			  found = cJSON_GetArrayItem(entry, 1)->valueint;
		const size_t length = strlen(ret.balls);

		/* Another's shadow may lie there by chance. */
		if (off_picture ? expected == 0 : expected >= views_least && 10 * found <= expected) {
			if (length + 16 < sizeof(ret.balls))
				snprintf(ret.balls + length, sizeof(ret.balls) - length, "%s%d",
					 ret.count > 0 ? ", " : "", ball);
			else if (ret.balls[length - 1] != '.')
				snprintf(ret.balls + length, sizeof(ret.balls) - length, " ...");
			ret.count++;
			ret.views = expected > ret.views ? expected : ret.views;
		}
		ball++;
	}
	return ret;
}

/* Balls of the drawing that were never seen, in words; "" for none. */
static void tell_unseen(const cJSON *json, char *text, size_t size)
{
	const struct numbered unseen = balls_not_found(json, false);

	text[0] = '\0';
	if (unseen.count == 1)
		snprintf(text, size,
			 "ball %s of the drawing (counted from 0) is not where the drawing has it, in %d views that "
			 "would show it alone",
			 unseen.balls, unseen.views);
	if (unseen.count > 1)
		snprintf(text, size,
			 "balls %s of the drawing (counted from 0) are not where the drawing has them, in up to %d "
			 "views that would show each alone",
			 unseen.balls, unseen.views);
}

/* Balls beside the picture in all views are no more than that, but of a tenth of a drawing one may want to know. */
static void doubt_hidden(const cJSON *json, cJSON *doubts)
{
	const struct numbered hidden = balls_not_found(json, true);
	const int count = cJSON_GetArraySize(cJSON_GetObjectItemCaseSensitive(json, "presence"));
	char detail[320];

	if (hidden.count == 0 || 10 * hidden.count < count)
		return;
	snprintf(detail, sizeof(detail),
		 "%d of the drawing's %d balls, %s (counted from 0), are clear on the picture in no view that is used: "
		 "nothing tells whether the phantom has them",
		 hidden.count, count, hidden.balls);
	add_doubt(doubts, "calibration_balls", detail);
}

/* The phantom may have a ball that the drawing has not, or the other way about. */
static void doubt_balls(const cJSON *json, cJSON *doubts)
{
	const double used = number_of(json, "used", 0), views = number_of(json, "stray_views", 0);
	char detail[480], unseen[280], strays[120] = "";

	doubt_hidden(json, doubts);
	tell_unseen(json, unseen, sizeof(unseen));
	/* As a ball of the drawing, one beside it stands clear in some views only. */
	if (views >= views_least && 4 * views >= used)
		snprintf(strays, sizeof(strays),
			 "%s%.0f shadows of balls, in %.0f of %.0f views, are of no ball of the drawing",
			 unseen[0] != '\0' ? "; " : "", number_of(json, "stray_shadows", 0), views, used);
	if (unseen[0] == '\0' && strays[0] == '\0')
		return;
	snprintf(detail, sizeof(detail), "%s%s: the drawing may have %s than the phantom", unseen, strays,
		 unseen[0] == '\0'   ? "fewer balls"
		 : strays[0] == '\0' ? "more balls"
				     : "other balls");
	add_doubt(doubts, "calibration_balls", detail);
}

/* Of like circles one above the other those in the pictures may be the next ones. */
static void doubt_height(const cJSON *json, cJSON *doubts)
{
	const double further = number_of(json, "other_height_mm", 0);
	char detail[240];

	if (further == 0)
		return;
	snprintf(detail, sizeof(detail),
		 "the pictures are explained as well by the phantom %.1f mm %s: which of the two is not known, and the "
		 "one nearer to the nominal geometry was taken",
		 fabs(further), further > 0 ? "higher along z" : "lower along z");
	add_doubt(doubts, "calibration_height", detail);
}

/*
 * The poses of a drawing of another scale are those of the same arm in that scale, with the same residual: only the
 * balls' diameters and the nominal distances know of it. A drawing of another shape leaves a residual.
 */
cJSON *calibration_doubts(const cJSON *json)
{
	const double machined = .1; /* mm, by which balls may lie off their drawing */
	const double shadows = number_of(json, "diameter_ratio", 1), sources = number_of(json, "distance_ratio", 1);
	const double shadows_open = number_of(json, "diameter_error", distance_open_before),
		     sources_open = cJSON_HasObjectItem(json, "diameter_error")
					? hypot(distance_open, number_of(json, "distance_error", 0))
					: distance_open_before;
	const double residual = number_of(json, "residual_isocentre_mm", 0),
		     moved = number_of(json, "balls_moved_mm", 0);
	const double limit = hypot(machined, number_of(json, "explained_mm", INFINITY));
	cJSON *doubts = cJSON_CreateArray();
	char detail[400];

	if (fabs(shadows - 1) > shadows_open || fabs(sources - 1) > sources_open) {
		snprintf(detail, sizeof(detail),
			 "the shadows are %.3f times as wide as those of the drawing's balls (expected within %.1f "
			 "%%), and the "
			 "sources stand %.3f times as far from the axis as the scan's geometry has them (within "
			 "%.1f %%): "
			 "the drawing may have another scale than the phantom",
			 shadows, 100 * shadows_open, sources, 100 * sources_open);
		add_doubt(doubts, "calibration_scale", detail);
	}
	if (residual > limit || moved > 2 * machined) {
		snprintf(
		    detail, sizeof(detail),
		    "the shadows lie %.2f mm from where the drawing has them, at the isocentre, and balls that were "
		    "adjusted "
		    "%.2f mm; noise and balls %.1f mm off their drawing explain %.2f mm: the drawing may be that of "
		    "another phantom",
		    residual, moved, machined, limit);
		add_doubt(doubts, "calibration_shape", detail);
	}
	doubt_balls(json, doubts);
	doubt_height(json, doubts);
	return doubts;
}

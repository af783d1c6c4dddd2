/* /v1/jobs/{}/volumes */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/api/internal.h"
#include "proto/regular.h"
#include "proto/source.h"

/* s that a list waits for digests: longer than a disk takes for a volume, or something is wrong with it. */
static const double patience = 30;

/* Newest first, as all lists; a page goes on behind the volume named by `after`. */
static int reply_page(struct request *request, const char *job, const struct page *page,
		      const struct volume_record *volumes, int count, struct error *err)
{
	cJSON *document, *list;
	int behind = count, first, last;

	for (int i = 0; page->after != NULL && i < count; i++) {
		if (strcmp(volumes[i].name, page->after) == 0)
			behind = i;
	}
	/* A first page instead would have a client go round for ever. */
	if (page->after != NULL && behind == count)
		return error_set(err, ERR_INVALID, "after is \"%.40s\", expected the name of a volume of the job",
				 page->after);
	document = cJSON_CreateObject();
	list = cJSON_AddArrayToObject(document, "volumes");
	first = behind - 1;
	last = first >= page->limit ? first - page->limit + 1 : 0;
	for (int i = first; i >= last; i--)
		json_append(list, volume_document(job, &volumes[i]));
	if (last > 0)
		cJSON_AddStringToObject(document, "next", volumes[last].name);
	else
		cJSON_AddNullToObject(document, "next");
	return request_reply_json(request, 200, document, err);
}

/* HTTP_WAIT while there is hope for the digests that are missing. */
static int list_volumes(struct api *api, struct request *request, const struct page *page, struct job *job,
			struct error *err)
{
	struct volume_record *volumes;
	struct job_facts facts;
	bool hashed = true;
	int count, code;

	job_facts(job, &facts);
	if (facts.removed)
		return error_set(err, ERR_NOT_FOUND, "job %s was removed", facts.id);
	code = store_job_volumes(api->store, facts.id, &volumes, &count, err);
	if (code != 0)
		return code;
	for (int i = 0; i < count; i++)
		hashed = hashed && volumes[i].hashed;
	if (!hashed && wait_goes_on(request))
		code = HTTP_WAIT;
	else
		code = reply_page(request, facts.id, page, volumes, count, err);
	free(volumes);
	return code;
}

int volume_list(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct page page;
	struct job *job;
	double seconds;

	if (page_read(request, &page, err) != 0)
		return err->code;
	if (wait_subject(request) == NULL && (wait_read(api, request, patience, &seconds, err) != 0 ||
					      jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0 ||
					      job_wait_begin(request, job, seconds, err) != 0))
		return err->code;
	return list_volumes(api, request, &page, wait_subject(request), err);
}

int volume_find(struct api *api, const struct job_facts *job, const char *name, struct volume_record *ret_volume,
		struct error *err)
{
	struct volume_record *volumes;
	int count, found = -1;

	if (store_job_volumes(api->store, job->id, &volumes, &count, err) != 0)
		return err->code;
	for (int i = 0; i < count && found < 0; i++) {
		if (strcmp(volumes[i].name, name) == 0)
			found = i;
	}
	if (found >= 0)
		*ret_volume = volumes[found];
	free(volumes);
	if (found < 0)
		return error_set(err, ERR_NOT_FOUND, "job %s has no volume \"%.40s\"%s", job->id, name,
				 job->ended ? "" : " yet");
	return 0;
}

int volume_asked(struct api *api, struct request *request, struct job_facts *ret_facts,
		 struct volume_record *ret_volume, struct error *err)
{
	struct job *job;

	if (jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0)
		return err->code;
	job_facts(job, ret_facts);
	job_release(job);
	return volume_find(api, ret_facts, request_argument(request, 1), ret_volume, err);
}

int volume_verify(struct api *api, const char *job, const struct volume_record *volume, uint64_t first, uint64_t bytes,
		  struct error *err)
{
	int code = store_volume_verify(api->store, job, volume, first, bytes, err);
	const bool whole = code == 0 && first == 0 && bytes >= volume->bytes;
	struct error ignored;
	struct job_facts facts;
	struct job *found;

	if ((code != ERR_DAMAGED && code != ERR_NOT_FOUND && !whole) ||
	    jobs_find(api->jobs, job, &found, &ignored) != 0)
		return code;
	job_facts(found, &facts);
	if (code == ERR_NOT_FOUND && !facts.removed) /* the files of a removed job go with it */
		code = store_volume_gone(volume, err);
	if (code == ERR_DAMAGED)
		job_add_warning(found, "damaged_volume", err->text, &ignored);
	if (whole)
		job_volume_whole(found, volume->name);
	job_release(found);
	return code;
}

/* The formats of files, the one that is for programs only, and the one that needs more than the volume's file. */
static const char shuffled_name[] = "shuffled", shuffled_media_type[] = "application/vnd.cbct.shuffled+zstd";
static const char dicom_name[] = "dicom";

static int read_format(struct request *request, struct content_options *options, struct error *err)
{
	const char *types[] = {volume_type_names[VOLUME_FLOAT32], volume_type_names[VOLUME_INT16], NULL};
	const char *formats[16] = {NULL};
	int format, type, count = 0;

	for (; volume_formats[count].name != NULL && count < 13; count++)
		formats[count] = volume_formats[count].name;
	formats[count] = shuffled_name;
	formats[count + 1] = dicom_name;
	if (query_choice(request, "format", formats, &format, err) != 0 ||
	    query_choice(request, "type", types, &type, err) != 0)
		return err->code;
	options->shuffled = format == count;
	options->dicom = format == count + 1;
	if (!options->shuffled && !options->dicom) {
		options->format = &volume_formats[format];
		options->type = (enum volume_type)type;
		return 0;
	}
	if (type != VOLUME_INT16 && request_query(request, "type") != NULL)
		return error_set(err, ERR_INVALID, "type is \"%.40s\", expected int16 with format=%s", types[type],
				 formats[format]);
	options->format = volume_format_find("raw");
	options->type = VOLUME_INT16;
	return 0;
}

int volume_options(struct request *request, const struct job_facts *job, struct content_options *ret_options,
		   struct error *err)
{
	const char *scale_text = request_query(request, "scale");
	struct content_options options = {.mu_water = job->mu_water};
	long scale = 1;

	if (read_format(request, &options, err) != 0)
		return err->code;
	if (scale_text != NULL &&
	    (!index_parse(scale_text, strlen(scale_text), CONTENT_SCALE_MAX, &scale) || scale == 0))
		return error_set(err, ERR_INVALID, "scale is \"%.40s\", expected a whole number from 1 to %d",
				 scale_text, CONTENT_SCALE_MAX);
	options.scale = (int)scale;
	*ret_options = options;
	return 0;
}

/* Reads the words that DICOM wants beside the volume's own file, from the job and from the request. */
static int read_words(struct api *api, struct request *request, const struct volume_record *volume,
		      struct content_options *options, struct error *err)
{
	struct dicom_words *words = &options->words;
	struct job_record record;
	struct job *job;
	int kind, position, code;

	if (query_choice(request, "dicom", dicom_kind_names, &kind, err) != 0 ||
	    query_choice(request, "position", patient_position_names, &position, err) != 0)
		return err->code;
	for (int i = 0; i < 2 && !options->dicom; i++) {
		const char *name = i == 0 ? "dicom" : "position";

		if (request_query(request, name) != NULL)
			return error_set(err, ERR_INVALID, "%s stands with format=dicom only", name);
	}
	if (!options->dicom)
		return 0;
	if (jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0)
		return err->code;
	job_record(job, &record);
	code = subject_parse(record.subject != NULL ? record.subject : "", &words->subject, err);
	if (code == 0)
		words->source = source_of(record.subject);
	job_release(job);
	words->kind = (enum dicom_kind)kind;
	words->position = request_query(request, "position") != NULL ? position : -1;
	words->created = volume->created;
	snprintf(words->volume, sizeof(words->volume), "%s", volume->name);
	return code;
}

/* DICOM's own way of two; the others say it themselves. */
static const char *dicom_or(const struct content_options *options, const char *slices, const char *frames,
			    const char *other)
{
	if (!options->dicom)
		return other;
	return options->words.kind != DICOM_SLICES ? frames : slices;
}

const char *volume_media_type(const struct content_options *options)
{
	return dicom_or(options, "application/zip", "application/dicom",
			options->shuffled ? shuffled_media_type : options->format->media_type);
}

void volume_filename(const char *job, const char *name, const struct content_options *options,
		     char ret_name[VOLUME_FILENAME_MAX])
{
	snprintf(ret_name, VOLUME_FILENAME_MAX, "%s-%s%s", job, name,
		 dicom_or(options, ".zip", ".dcm", options->shuffled ? ".shuffled.zst" : options->format->extension));
}

/* The digest would do as well, but comes later than the volume. */
void volume_tag(const char *job, const struct volume_record *volume, char ret_tag[VOLUME_TAG_MAX])
{
	snprintf(ret_tag, VOLUME_TAG_MAX, "%s-%s-%llx", job, volume->name, (unsigned long long)(volume->created * 1e6));
}

/* Tells voxels, format, type, scale and encoding apart. */
static void make_etag(const char *job, const struct volume_record *volume, const struct content_options *options,
		      bool zstd, char *ret_etag, size_t size)
{
	char tag[VOLUME_TAG_MAX];
	const char *format = dicom_or(options, "dicom-slices", dicom_kind_names[options->words.kind],
				      options->shuffled ? shuffled_name : options->format->name);
	const char *position = "";

	if (options->dicom && options->words.position >= 0)
		position = patient_position_names[options->words.position];
	volume_tag(job, volume, tag);
	snprintf(ret_etag, size, "\"%s-%s%s-%s-%d-%d%s\"", tag, format, position, volume_type_names[options->type],
		 options->scale, FORMAT_REVISION, zstd ? "-zstd" : "");
}

/* A part of the content that is made as it is sent. */
struct part {
	struct content *content;
	uint64_t first;
};

static ssize_t part_read(void *context, uint64_t offset, void *to, size_t size)
{
	struct part *part = context;

	return content_read(part->content, part->first + offset, to, size);
}

static void part_free(void *context)
{
	struct part *part = context;

	content_close(part->content);
	free(part);
}

static ssize_t stream_read(void *context, uint64_t offset, void *to, size_t size)
{
	(void)offset;
	return content_stream_read(context, to, size);
}

static void stream_free(void *context)
{
	content_stream_free(context);
}

/* Takes the content. */
static int reply_plain(struct request *request, struct content *content, const struct selection *selection,
		       struct error *err)
{
	uint64_t offset;
	int descriptor = content_descriptor(content, &offset);
	struct part *part;

	if (descriptor >= 0) {
		content_close(content);
		return request_reply_file(request, selection->status, descriptor, offset + selection->first,
					  selection->length, err);
	}
	part = malloc(sizeof(*part));
	if (part == NULL) {
		content_close(content);
		return error_set(err, ERR_NO_MEMORY, "no memory for a reply");
	}
	*part = (struct part){content, selection->first};
	return request_reply_read(request, selection->status, selection->length, part_read, part, part_free, err);
}

/* Takes the content. encoding: what compresses it is not the media type's own. */
static int reply_packed(struct request *request, struct content *content, bool encoding, struct error *err)
{
	const int workers = 1; /* so that the bytes are those of the encoded copy, whose maker has two */
	struct content_stream *stream;

	if (content_stream_new(content, workers, &stream, err) != 0 ||
	    request_reply_read(request, 200, UNKNOWN_SIZE, stream_read, stream, stream_free, err) != 0)
		return err->code;
	if (encoding)
		request_reply_header(request, "Content-Encoding", "zstd");
	return 0;
}

/* Checks the part of the file that these bytes of the content are made from; selection NULL: all of it. */
static int verify_selected(struct api *api, const char *job, const struct volume_record *volume,
			   const struct content *content, const struct selection *selection, struct error *err)
{
	uint64_t size = content_size(content), head = size - volume->bytes, first = 0, bytes = volume->bytes;

	/* Voxel for voxel behind a header. */
	if (selection != NULL && content_is_plain(content)) {
		first = selection->first > head ? selection->first - head : 0;
		bytes = selection->length;
	}
	return volume_verify(api, job, volume, first, bytes, err);
}

/* ---- ranges of what is packed ---- */

static void watch_copy(void *copy, struct watch *watch)
{
	encoded_watch(copy, watch);
}

static void leave_copy(void *copy, struct watch *watch)
{
	encoded_unwatch(copy, watch);
	encoded_release(copy);
}

/*
 * True if the request is for a range of bytes whose number nobody knows before they are made. The pages of DICOM are
 * not among the encoded copies.
 */
static bool wants_range_of_copy(struct request *request, const struct content_options *options, const char *etag)
{
	const char *condition = request_header(request, "If-Range");
	uint64_t first, length;

	return content_is_packed(options) && !options->dicom && !request_is_head(request) &&
	       (condition == NULL || etag_in(condition, etag, false)) &&
	       range_parse(request_header(request, "Range"), UNKNOWN_SIZE, &first, &length) != RANGE_NONE;
}

/* HTTP_WAIT while the encoded copy is made; without ret->made it cannot be, on a full disk for example. */
static int wait_for_copy(struct api *api, struct request *request, const char *job, const struct volume_record *volume,
			 const struct content_options *options, struct encoded_facts *ret, struct error *err)
{
	static const struct wait_kind kind = {watch_copy, leave_copy};
	struct encoded *copy = wait_subject(request);

	if (copy == NULL) {
		if (encoded_get(api->copies, job, volume, options, true, &copy, err) != 0)
			return err->code;
		if (wait_begin(request, &kind, copy, api->max_wait, err) != 0) {
			encoded_release(copy);
			return err->code;
		}
	}
	encoded_look(copy, ret);
	return !ret->made && !ret->failed && wait_goes_on(request) ? HTTP_WAIT : 0;
}

/* *ret_replied false: there is no copy, and all of the volume goes out, as RFC 9110, 14.2 leaves it to a server. */
static int reply_range_of_copy(struct api *api, struct request *request, const char *job,
			       const struct volume_record *volume, const struct content_options *options,
			       struct entity entity, bool *ret_replied, struct error *err)
{
	struct encoded_facts copy;
	struct selection selection;
	int descriptor, code = wait_for_copy(api, request, job, volume, options, &copy, err);

	if (code != 0 || !copy.made)
		return code;
	entity.size = copy.size;
	if (entity_select(request, &entity, &selection, ret_replied, err) != 0 || *ret_replied)
		return *ret_replied ? 0 : err->code;
	if (volume_verify(api, job, volume, 0, volume->bytes, err) != 0)
		return err->code;
	descriptor = fcntl(copy.descriptor, F_DUPFD_CLOEXEC, 0);
	if (descriptor < 0)
		return error_set_errno(err, errno, "an encoded copy of a volume");
	if (request_reply_file(request, selection.status, descriptor, copy.offset + selection.first, selection.length,
			       err) != 0)
		return err->code;
	entity_headers(request, &entity, &selection);
	*ret_replied = true;
	return 0;
}

/* ---- one volume ---- */

/* Takes what the words of the options own. */
static int reply_volume(struct api *api, struct request *request, const char *job, const struct volume_record *volume,
			const struct content_options *options, struct entity entity, bool zstd, struct error *err)
{
	bool done, packed = content_is_packed(options);
	struct selection selection;
	struct content *content;
	char path[1024];

	store_volume_path(api->store, job, volume->name, path);
	if (content_open(path, &volume->grid, options, &content, err) != 0)
		return err->code;
	if (!zstd && !packed)
		entity.size = content_size(content);
	if (entity_select(request, &entity, &selection, &done, err) != 0 || done) {
		content_close(content);
		return done ? 0 : err->code;
	}
	if (verify_selected(api, job, volume, content, zstd || packed ? NULL : &selection, err) != 0) {
		content_close(content);
		return err->code;
	}
	if ((zstd || packed ? reply_packed(request, content, !packed, err)
			    : reply_plain(request, content, &selection, err)) != 0)
		return err->code;
	entity_headers(request, &entity, &selection);
	return 0;
}

int volume_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct content_options options;
	struct volume_record volume;
	struct job_facts facts;
	struct entity entity;
	char etag[160], filename[VOLUME_FILENAME_MAX];
	/* A frame of zstd cannot be entered in the middle: a range is of the plain bytes, where they are acceptable. */
	bool zstd =
	    request_prefers_coding(request, "zstd") &&
	    (request_header(request, "Range") == NULL || request_is_head(request) || !request_takes_plain(request));
	bool packed, replied = false;
	int code;

	if (volume_asked(api, request, &facts, &volume, err) != 0 ||
	    volume_options(request, &facts, &options, err) != 0 ||
	    volume_verify(api, facts.id, &volume, 0, 0, err) != 0 ||
	    read_words(api, request, &volume, &options, err) != 0)
		return err->code;
	packed = content_is_packed(&options);
	zstd = options.shuffled || (zstd && !packed);
	make_etag(facts.id, &volume, &options, zstd, etag, sizeof(etag));
	volume_filename(facts.id, volume.name, &options, filename);
	entity = (struct entity){.etag = etag,
				 .size = UNKNOWN_SIZE,
				 .media_type = volume_media_type(&options),
				 .filename = filename,
				 .ranges = dicom_or(&options, "none", "none", packed ? "bytes" : NULL)};
	if (wants_range_of_copy(request, &options, etag)) {
		code = reply_range_of_copy(api, request, facts.id, &volume, &options, entity, &replied, err);
		if (code != 0 || replied)
			return code;
	}
	return reply_volume(api, request, facts.id, &volume, &options, entity, zstd, err);
}

static int job_started(struct api *api, const char *id, double *ret_started, struct error *err)
{
	struct job_record record;
	struct job *job;
	int code = jobs_find(api->jobs, id, &job, err);

	if (code != 0)
		return code;
	job_record(job, &record);
	*ret_started = record.started;
	job_release(job);
	return 0;
}

/* What the file says of where it comes from, and the times, which the file has not: it has the same bits each time. */
int provenance_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct provenance provenance = {0};
	struct volume_record volume;
	struct job_facts facts;
	struct grid grid;
	cJSON *document;
	char path[1024];
	size_t start;
	double started = 0;
	int file, code = volume_asked(api, request, &facts, &volume, err);

	if (code == 0)
		code = job_started(api, facts.id, &started, err);
	if (code == 0)
		code = volume_verify(api, facts.id, &volume, 0, 0, err);
	if (code != 0)
		return code;
	store_volume_path(api->store, facts.id, volume.name, path);
	file = regular_open(path, O_RDONLY, 0);
	if (file < 0)
		return error_set(err, ERR_NOT_FOUND, "the volume is not there any more");
	grid = volume.grid;
	code = volume_own_head(file, path, &grid, &start, &provenance, err);
	close(file);
	if (code != 0)
		return code;
	document = provenance_json(&provenance, volume_units[VOLUME_FLOAT32]);
	provenance_clear(&provenance);
	cJSON_AddStringToObject(document, "volume", volume.name);
	json_add_time(document, "made", volume.created);
	json_add_time(document, "started", started);
	return request_reply_json(request, 200, document, err);
}

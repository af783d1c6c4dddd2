/* Volumes as they are streamed: rendition.h. */
#include "daemon/volumes/rendition.h"

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/volumes/sink.h"

enum {
	THREADS_MAX = 8,
	WORKERS = 2 /* that compress, while the maker's thread reads and converts, and its sink hashes and writes */
};
static const int idle_max = 8;
static const uint64_t idle_bytes_max = 1ull << 30;

struct rendition {
	struct renditions *owner;
	struct rendition *next; /* of all; the one that was asked for before it */
	struct watch_list watchers;

	/* Constant. */
	char job[ID_SIZE];
	struct volume_record volume;
	struct content_options options;
	bool zstd;

	/* Guarded by the owner's lock. */
	int references; /* without the maker's */
	bool queued, making;
	struct rendition_facts facts;
};

struct renditions {
	struct store *store;
	pthread_mutex_t lock; /* guards the list, and of each its state; not held while one is made */
	pthread_cond_t due;
	struct rendition *first;
	pthread_t threads[THREADS_MAX];
	int thread_count;
	bool closing;
};

static void rendition_free(struct rendition *rendition)
{
	if (rendition->facts.descriptor >= 0)
		close(rendition->facts.descriptor);
	watch_list_destroy(&rendition->watchers);
	free(rendition);
}

/* ---- making one ---- */

/* Nobody waits for it any more, or the daemon stops. */
static bool is_unwanted(struct rendition *rendition)
{
	struct renditions *owner = rendition->owner;
	bool unwanted;

	pthread_mutex_lock(&owner->lock);
	unwanted = rendition->references == 0 || owner->closing;
	pthread_mutex_unlock(&owner->lock);
	return unwanted;
}

/* Reads on where it stands: of the content, or of what it is compressed to. */
struct source {
	struct content *content; /* NULL: the stream has it */
	struct content_stream *stream;
	uint64_t offset;
};

static ssize_t source_read(struct source *source, void *to, size_t size)
{
	ssize_t got = source->stream != NULL ? content_stream_read(source->stream, to, size)
					     : content_read(source->content, source->offset, to, size);

	source->offset += got > 0 ? (uint64_t)got : 0;
	return got;
}

/* All of it. */
static int pour(struct rendition *rendition, struct source *source, struct sink *sink, struct error *err)
{
	ssize_t got = 1;

	while (got > 0) {
		char *room = sink_room(sink);

		if (room == NULL)
			return 0; /* the sink tells why */
		if (is_unwanted(rendition))
			return error_set(err, ERR_CANCELLED, "nobody waits for it");
		got = source_read(source, room, SINK_BLOCK);
		if (got < 0)
			return error_set(err, ERR_IO, "the volume cannot be read or compressed");
		if (got > 0)
			sink_put(sink, (size_t)got);
	}
	return 0;
}

static int open_spool(struct rendition *rendition, int *ret_file, struct error *err)
{
	char directory[1024], path[1100];
	int file;

	store_job_directory(rendition->owner->store, rendition->job, directory);
	snprintf(path, sizeof(path), "%s/stream-XXXXXX.tmp", directory);
	file = mkostemps(path, 4, O_CLOEXEC);
	if (file < 0)
		return error_set_errno(err, errno, "a file for a volume to be streamed");
	unlink(path);
	*ret_file = file;
	return 0;
}

/* Its descriptor is the caller's to close, also after a failure. */
static int make(struct rendition *rendition, struct rendition_facts *ret, struct error *err)
{
	struct source source = {0};
	struct sink *sink = NULL;
	char path[1024];
	bool as_it_is;
	int code;

	store_volume_path(rendition->owner->store, rendition->job, rendition->volume.name, path);
	code = store_volume_verify(rendition->owner->store, rendition->job, &rendition->volume, 0,
				   rendition->volume.bytes, err);
	if (code == 0)
		code = content_open(path, &rendition->volume.grid, &rendition->options, &source.content, err);
	if (code != 0)
		return code;
	if (!rendition->zstd)
		ret->descriptor = content_descriptor(source.content, &ret->offset);
	as_it_is = ret->descriptor >= 0; /* only its digest is wanted */
	if (!as_it_is)
		code = open_spool(rendition, &ret->descriptor, err);
	if (code == 0 && rendition->zstd) {
		code = content_stream_new(source.content, WORKERS, &source.stream, err);
		source.content = NULL;
	}
	if (code == 0)
		code = sink_new(as_it_is ? -1 : ret->descriptor, &sink, err);
	if (code == 0)
		code = pour(rendition, &source, sink, err);
	if (code == 0)
		code = sink_end(sink, &ret->size, ret->sha256, err);
	sink_free(sink);
	content_stream_free(source.stream);
	content_close(source.content);
	return code;
}

static void make_one(struct rendition *rendition)
{
	struct rendition_facts facts = {.descriptor = -1};
	struct error err = {0};
	int code = make(rendition, &facts, &err);

	if (code != 0 && code != ERR_CANCELLED)
		log_line(LEVEL_WARNING, "job %s, volume %s: %s", rendition->job, rendition->volume.name, err.text);
	if (code != 0 && facts.descriptor >= 0)
		close(facts.descriptor);
	if (code != 0)
		facts = (struct rendition_facts){.failed = true, .descriptor = -1};
	else
		facts.made = true;
	pthread_mutex_lock(&rendition->owner->lock);
	/* Given up because all had gone, and then somebody came: once more. */
	if (code == ERR_CANCELLED && rendition->references > 0)
		rendition->queued = true;
	else
		rendition->facts = facts;
	pthread_mutex_unlock(&rendition->owner->lock);
}

/* ---- the list; its lock is held ---- */

/* Oldest ones beyond the bounds, failed ones, and all idle ones of this job when it is given. */
static void drop_idle(struct renditions *renditions, const char *job)
{
	struct rendition **at = &renditions->first;
	uint64_t bytes = 0;
	int count = 0;

	while (*at != NULL) {
		struct rendition *rendition = *at;
		bool idle = rendition->references == 0 && !rendition->making;
		bool keep =
		    rendition->facts.made && count < idle_max && bytes + rendition->facts.size <= idle_bytes_max;

		if (!idle || (keep && (job == NULL || strcmp(job, rendition->job) != 0))) {
			count += idle;
			bytes += idle ? rendition->facts.size : 0;
			at = &rendition->next;
			continue;
		}
		*at = rendition->next;
		rendition_free(rendition);
	}
}

static bool is_same(const struct rendition *rendition, const char *job, const struct volume_record *volume,
		    const struct content_options *options, bool zstd)
{
	const struct content_options *own = &rendition->options;

	return strcmp(rendition->job, job) == 0 && strcmp(rendition->volume.name, volume->name) == 0 &&
	       rendition->volume.created == volume->created && /* another one when it was made again */
	       own->format == options->format && own->type == options->type && own->shuffled == options->shuffled &&
	       own->scale == options->scale && rendition->zstd == zstd && !rendition->facts.failed;
}

static struct rendition *next_due(const struct renditions *renditions)
{
	struct rendition *due = NULL;

	/* The one that waits longest stands last. */
	for (struct rendition *r = renditions->first; r != NULL; r = r->next) {
		if (r->queued)
			due = r;
	}
	return due;
}

static void *run_maker(void *context)
{
	struct renditions *renditions = context;

	pthread_mutex_lock(&renditions->lock);
	while (!renditions->closing) {
		struct rendition *rendition = next_due(renditions);

		if (rendition == NULL) {
			pthread_cond_wait(&renditions->due, &renditions->lock);
			continue;
		}
		rendition->queued = false;
		rendition->making = true;
		pthread_mutex_unlock(&renditions->lock);
		make_one(rendition);
		watch_wake(&rendition->watchers);
		pthread_mutex_lock(&renditions->lock);
		rendition->making = false;
		drop_idle(renditions, NULL);
	}
	pthread_mutex_unlock(&renditions->lock);
	return NULL;
}

/* ---- what others call ---- */

int renditions_new(struct store *store, int threads, struct renditions **ret_renditions, struct error *err)
{
	struct renditions *renditions = calloc(1, sizeof(*renditions));

	if (renditions == NULL)
		return error_set_errno(err, ENOMEM, "volumes to be streamed");
	renditions->store = store;
	lock_init(&renditions->lock, LOCK_ENCODED);
	pthread_cond_init(&renditions->due, NULL);
	while (renditions->thread_count < threads && renditions->thread_count < THREADS_MAX) {
		int code = pthread_create(&renditions->threads[renditions->thread_count], NULL, run_maker, renditions);

		if (code != 0) {
			renditions_free(renditions);
			return error_set_errno(err, code, "thread for volumes to be streamed");
		}
		renditions->thread_count++;
	}
	*ret_renditions = renditions;
	return 0;
}

void renditions_free(struct renditions *renditions)
{
	if (renditions == NULL)
		return;
	pthread_mutex_lock(&renditions->lock);
	renditions->closing = true;
	pthread_cond_broadcast(&renditions->due);
	pthread_mutex_unlock(&renditions->lock);
	for (int i = 0; i < renditions->thread_count; i++)
		pthread_join(renditions->threads[i], NULL);
	while (renditions->first != NULL) {
		struct rendition *rendition = renditions->first;

		assert(rendition->references == 0);
		renditions->first = rendition->next;
		rendition_free(rendition);
	}
	pthread_cond_destroy(&renditions->due);
	pthread_mutex_destroy(&renditions->lock);
	free(renditions);
}

static struct rendition *rendition_new(struct renditions *renditions, const char *job,
				       const struct volume_record *volume, const struct content_options *options,
				       bool zstd)
{
	struct rendition *rendition = calloc(1, sizeof(*rendition));

	if (rendition == NULL)
		return NULL;
	rendition->owner = renditions;
	snprintf(rendition->job, sizeof(rendition->job), "%s", job);
	rendition->volume = *volume;
	rendition->options = *options;
	rendition->zstd = zstd;
	rendition->facts.descriptor = -1;
	rendition->queued = true;
	watch_list_init(&rendition->watchers);
	return rendition;
}

int rendition_get(struct renditions *renditions, const char *job, const struct volume_record *volume,
		  const struct content_options *options, bool zstd, struct rendition **ret_rendition, struct error *err)
{
	struct rendition *found;

	zstd = zstd || content_is_packed(options);
	pthread_mutex_lock(&renditions->lock);
	found = renditions->first;
	while (found != NULL && !is_same(found, job, volume, options, zstd))
		found = found->next;
	if (found == NULL) {
		found = rendition_new(renditions, job, volume, options, zstd);
		if (found != NULL) {
			found->next = renditions->first;
			renditions->first = found;
			pthread_cond_signal(&renditions->due);
		}
	}
	if (found != NULL)
		found->references++;
	pthread_mutex_unlock(&renditions->lock);
	if (found == NULL)
		return error_set_errno(err, ENOMEM, "a volume to be streamed");
	*ret_rendition = found;
	return 0;
}

void rendition_release(struct rendition *rendition)
{
	struct renditions *owner;

	if (rendition == NULL)
		return;
	owner = rendition->owner;
	pthread_mutex_lock(&owner->lock);
	rendition->references--;
	drop_idle(owner, NULL);
	pthread_mutex_unlock(&owner->lock);
}

void rendition_watch(struct rendition *rendition, struct watch *watch)
{
	watch_add(&rendition->watchers, watch);
}

void rendition_unwatch(struct rendition *rendition, struct watch *watch)
{
	watch_remove(&rendition->watchers, watch);
}

void rendition_look(struct rendition *rendition, struct rendition_facts *ret)
{
	pthread_mutex_lock(&rendition->owner->lock);
	*ret = rendition->facts;
	pthread_mutex_unlock(&rendition->owner->lock);
}

void renditions_forget(struct renditions *renditions, const char *job)
{
	pthread_mutex_lock(&renditions->lock);
	drop_idle(renditions, job);
	pthread_mutex_unlock(&renditions->lock);
}

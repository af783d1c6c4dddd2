/* Volumes as they are streamed: encoded.h. */
#include "daemon/volumes/encoded.h"

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

struct encoded {
	struct encoded_copies *owner;
	struct encoded *next; /* of all; the one that was asked for before it */
	struct watch_list watchers;

	/* Constant. */
	char job[ID_SIZE];
	struct volume_record volume;
	struct content_options options;
	bool zstd;

	/* Guarded by the owner's lock. */
	int references; /* without the maker's */
	bool queued, making;
	struct encoded_facts facts;
};

struct encoded_copies {
	struct store *store;
	pthread_mutex_t lock; /* guards the list, and of each its state; not held while one is made */
	pthread_cond_t due;
	struct encoded *first;
	pthread_t threads[THREADS_MAX];
	int thread_count;
	bool closing;
};

static void encoded_free(struct encoded *encoded)
{
	if (encoded->facts.descriptor >= 0)
		close(encoded->facts.descriptor);
	watch_list_destroy(&encoded->watchers);
	free(encoded);
}

/* ---- making one ---- */

/* True if nobody waits for the copy any more, or the daemon stops. */
static bool is_unwanted(struct encoded *encoded)
{
	struct encoded_copies *owner = encoded->owner;
	bool unwanted;

	pthread_mutex_lock(&owner->lock);
	unwanted = encoded->references == 0 || owner->closing;
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

/* Copies the whole source into the sink. */
static int pour(struct encoded *encoded, struct source *source, struct sink *sink, struct error *err)
{
	ssize_t got = 1;

	while (got > 0) {
		char *room = sink_room(sink);

		if (room == NULL)
			return 0; /* the sink says why */
		if (is_unwanted(encoded))
			return error_set(err, ERR_CANCELLED, "nobody waits for it");
		got = source_read(source, room, SINK_BLOCK);
		if (got < 0)
			return error_set(err, ERR_IO, "the volume cannot be read or compressed");
		if (got > 0)
			sink_put(sink, (size_t)got);
	}
	return 0;
}

static int open_temporary(struct encoded *encoded, int *ret_file, struct error *err)
{
	char directory[1024], path[1100];
	int file;

	store_job_directory(encoded->owner->store, encoded->job, directory);
	snprintf(path, sizeof(path), "%s/stream-XXXXXX.tmp", directory);
	file = mkostemps(path, 4, O_CLOEXEC);
	if (file < 0)
		return error_set_errno(err, errno, "a file for a volume to be streamed");
	unlink(path);
	*ret_file = file;
	return 0;
}

/* Makes the copy. ret->descriptor is the caller's to close, also after a failure. */
static int make(struct encoded *encoded, struct encoded_facts *ret, struct error *err)
{
	struct source source = {0};
	struct sink *sink = NULL;
	char path[1024];
	bool as_it_is;
	int code;

	store_volume_path(encoded->owner->store, encoded->job, encoded->volume.name, path);
	code =
	    store_volume_verify(encoded->owner->store, encoded->job, &encoded->volume, 0, encoded->volume.bytes, err);
	if (code == 0)
		code = content_open(path, &encoded->volume.grid, &encoded->options, &source.content, err);
	if (code != 0)
		return code;
	if (!encoded->zstd)
		ret->descriptor = content_descriptor(source.content, &ret->offset);
	as_it_is = ret->descriptor >= 0; /* only its digest is wanted */
	if (!as_it_is)
		code = open_temporary(encoded, &ret->descriptor, err);
	if (code == 0 && encoded->zstd) {
		code = content_stream_new(source.content, WORKERS, &source.stream, err);
		source.content = NULL;
	}
	if (code == 0)
		code = sink_new(as_it_is ? -1 : ret->descriptor, &sink, err);
	if (code == 0)
		code = pour(encoded, &source, sink, err);
	if (code == 0)
		code = sink_end(sink, &ret->size, ret->sha256, err);
	sink_free(sink);
	content_stream_free(source.stream);
	content_close(source.content);
	return code;
}

static void make_one(struct encoded *encoded)
{
	struct encoded_facts facts = {.descriptor = -1};
	struct error err = {0};
	int code = make(encoded, &facts, &err);

	if (code != 0 && code != ERR_CANCELLED)
		log_line(LEVEL_WARNING, "job %s, volume %s: %s", encoded->job, encoded->volume.name, err.text);
	if (code != 0 && facts.descriptor >= 0)
		close(facts.descriptor);
	if (code != 0)
		facts = (struct encoded_facts){.failed = true, .descriptor = -1};
	else
		facts.made = true;
	pthread_mutex_lock(&encoded->owner->lock);
	/* Given up because all had gone, and then somebody came: once more. */
	if (code == ERR_CANCELLED && encoded->references > 0)
		encoded->queued = true;
	else
		encoded->facts = facts;
	pthread_mutex_unlock(&encoded->owner->lock);
}

/* ---- the list; its lock is held ---- */

/* Oldest ones beyond the bounds, failed ones, and all idle ones of this job when it is given. */
static void drop_idle(struct encoded_copies *copies, const char *job)
{
	struct encoded **at = &copies->first;
	uint64_t bytes = 0;
	int count = 0;

	while (*at != NULL) {
		struct encoded *encoded = *at;
		bool idle = encoded->references == 0 && !encoded->making;
		bool keep = encoded->facts.made && count < idle_max && bytes + encoded->facts.size <= idle_bytes_max;

		if (!idle || (keep && (job == NULL || strcmp(job, encoded->job) != 0))) {
			count += idle;
			bytes += idle ? encoded->facts.size : 0;
			at = &encoded->next;
			continue;
		}
		*at = encoded->next;
		encoded_free(encoded);
	}
}

static bool is_same(const struct encoded *encoded, const char *job, const struct volume_record *volume,
		    const struct content_options *options, bool zstd)
{
	const struct content_options *own = &encoded->options;

	return strcmp(encoded->job, job) == 0 && strcmp(encoded->volume.name, volume->name) == 0 &&
	       encoded->volume.created == volume->created && /* another one when it was made again */
	       own->format == options->format && own->type == options->type && own->shuffled == options->shuffled &&
	       own->scale == options->scale && encoded->zstd == zstd && !encoded->facts.failed;
}

static struct encoded *next_due(const struct encoded_copies *copies)
{
	struct encoded *due = NULL;

	/* The one that waits longest stands last. */
	for (struct encoded *r = copies->first; r != NULL; r = r->next) {
		if (r->queued)
			due = r;
	}
	return due;
}

static void *run_maker(void *context)
{
	struct encoded_copies *copies = context;

	pthread_mutex_lock(&copies->lock);
	while (!copies->closing) {
		struct encoded *encoded = next_due(copies);

		if (encoded == NULL) {
			pthread_cond_wait(&copies->due, &copies->lock);
			continue;
		}
		encoded->queued = false;
		encoded->making = true;
		pthread_mutex_unlock(&copies->lock);
		make_one(encoded);
		watch_wake(&encoded->watchers);
		pthread_mutex_lock(&copies->lock);
		encoded->making = false;
		drop_idle(copies, NULL);
	}
	pthread_mutex_unlock(&copies->lock);
	return NULL;
}

/* ---- what others call ---- */

int encoded_copies_new(struct store *store, int threads, struct encoded_copies **ret_copies, struct error *err)
{
	struct encoded_copies *copies = calloc(1, sizeof(*copies));

	if (copies == NULL)
		return error_set_errno(err, ENOMEM, "volumes to be streamed");
	copies->store = store;
	lock_init(&copies->lock, LOCK_ENCODED);
	pthread_cond_init(&copies->due, NULL);
	while (copies->thread_count < threads && copies->thread_count < THREADS_MAX) {
		int code = pthread_create(&copies->threads[copies->thread_count], NULL, run_maker, copies);

		if (code != 0) {
			encoded_copies_free(copies);
			return error_set_errno(err, code, "thread for volumes to be streamed");
		}
		copies->thread_count++;
	}
	*ret_copies = copies;
	return 0;
}

void encoded_copies_free(struct encoded_copies *copies)
{
	if (copies == NULL)
		return;
	pthread_mutex_lock(&copies->lock);
	copies->closing = true;
	pthread_cond_broadcast(&copies->due);
	pthread_mutex_unlock(&copies->lock);
	for (int i = 0; i < copies->thread_count; i++)
		pthread_join(copies->threads[i], NULL);
	while (copies->first != NULL) {
		struct encoded *encoded = copies->first;

		assert(encoded->references == 0);
		copies->first = encoded->next;
		encoded_free(encoded);
	}
	pthread_cond_destroy(&copies->due);
	pthread_mutex_destroy(&copies->lock);
	free(copies);
}

static struct encoded *rendition_new(struct encoded_copies *copies, const char *job, const struct volume_record *volume,
				     const struct content_options *options, bool zstd)
{
	struct encoded *encoded = calloc(1, sizeof(*encoded));

	if (encoded == NULL)
		return NULL;
	encoded->owner = copies;
	snprintf(encoded->job, sizeof(encoded->job), "%s", job);
	encoded->volume = *volume;
	encoded->options = *options;
	encoded->zstd = zstd;
	encoded->facts.descriptor = -1;
	encoded->queued = true;
	watch_list_init(&encoded->watchers);
	return encoded;
}

int encoded_get(struct encoded_copies *copies, const char *job, const struct volume_record *volume,
		const struct content_options *options, bool zstd, struct encoded **ret_encoded, struct error *err)
{
	struct encoded *found;

	zstd = zstd || content_is_packed(options);
	pthread_mutex_lock(&copies->lock);
	found = copies->first;
	while (found != NULL && !is_same(found, job, volume, options, zstd))
		found = found->next;
	if (found == NULL) {
		found = rendition_new(copies, job, volume, options, zstd);
		if (found != NULL) {
			found->next = copies->first;
			copies->first = found;
			pthread_cond_signal(&copies->due);
		}
	}
	if (found != NULL)
		found->references++;
	pthread_mutex_unlock(&copies->lock);
	if (found == NULL)
		return error_set_errno(err, ENOMEM, "a volume to be streamed");
	*ret_encoded = found;
	return 0;
}

void encoded_release(struct encoded *encoded)
{
	struct encoded_copies *owner;

	if (encoded == NULL)
		return;
	owner = encoded->owner;
	pthread_mutex_lock(&owner->lock);
	encoded->references--;
	drop_idle(owner, NULL);
	pthread_mutex_unlock(&owner->lock);
}

void encoded_watch(struct encoded *encoded, struct watch *watch)
{
	watch_add(&encoded->watchers, watch);
}

void encoded_unwatch(struct encoded *encoded, struct watch *watch)
{
	watch_remove(&encoded->watchers, watch);
}

void encoded_look(struct encoded *encoded, struct encoded_facts *ret)
{
	pthread_mutex_lock(&encoded->owner->lock);
	*ret = encoded->facts;
	pthread_mutex_unlock(&encoded->owner->lock);
}

void encoded_copies_forget(struct encoded_copies *copies, const char *job)
{
	pthread_mutex_lock(&copies->lock);
	drop_idle(copies, job);
	pthread_mutex_unlock(&copies->lock);
}

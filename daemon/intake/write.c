/*
 * Uploads, the writers' side: from the queue to the disk and the catalogue. The bytes are synced, then the rows are
 * committed, many projections at once; then each upload learns its outcome. upload.c has the picture.
 */
#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "daemon/intake/internal.h"

#include "core/backend.h"
#include "core/correct/images.h"
#include "daemon/lock.h"
#include "proto/scan_directory.h"

enum {
	BATCH_SLOTS = 64,       /* in one commit */
	BATCH_BYTES = 64 << 20, /* in one sync, so that nobody waits for long */
	BUSY_SECONDS = 30       /* to wait for another request's claim */
};

/* ---- one slot ---- */

static int write_slot(const struct slot *slot, struct error *err)
{
	off_t offset = (off_t)slot->index * (off_t)slot->size;
	size_t done = 0;

	while (done < slot->size) {
		ssize_t wrote =
		    pwrite(slot->upload->descriptor, slot->data + done, slot->size - done, offset + (off_t)done);

		if (wrote < 0 && errno == EINTR)
			continue;
		if (wrote <= 0)
			return error_set_errno(err, wrote < 0 ? errno : EIO, "write projection %d", slot->index);
		done += (size_t)wrote;
	}
	return 0;
}

static int hash_slot(struct slot *slot, struct error *err)
{
	if (EVP_Digest(slot->data, slot->size, slot->sum.sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "the digest of a projection cannot be made");
	slot->sum.crc = checksum(0, slot->data, slot->size);
	slot->sum.bytes = slot->size;
	return 0;
}

/*
 * Against what the disk holds, not only what it is said to hold. *ret_lost: that is damaged, so that the projection can
 * be claimed after all.
 */
static int compare_with_stored(struct slot *slot, bool *ret_lost, struct error *err)
{
	struct stored_scan *scan = slot->upload->scan;
	unsigned char *stored = malloc(slot->size);
	struct sum sum;
	int code = stored == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a projection of %zu bytes", slot->size)
				  : stored_scan_read(scan, slot->upload->descriptor, slot->index, stored, &sum, err);

	*ret_lost = code == ERR_DAMAGED || code == ERR_NOT_FOUND;
	if (code == 0 && memcmp(stored, slot->data, slot->size) != 0)
		code = error_set(err, ERR_CONFLICT, "projection %d is stored already, with other bytes", slot->index);
	if (code == 0)
		slot->outcome = SLOT_SAME;
	free(stored);
	return *ret_lost ? 0 : code;
}

/* Another request has the claim: waits for its outcome, though not for ever. */
static int park(struct slot *slot, struct error *err)
{
	double now = clock_monotonic();

	if (slot->parked == 0)
		slot->parked = now;
	if (now - slot->parked > BUSY_SECONDS)
		return error_set(err, ERR_BUSY, "another request has been sending projection %d for %d s", slot->index,
				 BUSY_SECONDS);
	slot->outcome = SLOT_PARKED;
	return 0;
}

/* A projection that the disk has damaged is known by its digest: other bytes are another projection. */
static int check_lost(struct slot *slot, struct error *err)
{
	struct sum known;

	if (!stored_scan_lost_sum(slot->upload->scan, slot->index, &known))
		return 0;
	if (hash_slot(slot, err) != 0)
		return err->code;
	if (memcmp(slot->sum.sha256, known.sha256, sizeof(known.sha256)) == 0)
		return 0;
	return error_set(
	    err, ERR_CONFLICT,
	    "projection %d was stored with other bytes, and damaged by the disk: it is to be sent again as it "
	    "was",
	    slot->index);
}

/* Under its claim; the disk begins at once, while the bytes are hashed. */
static int write_claimed(struct slot *slot, struct error *err)
{
	const struct upload *upload = slot->upload;

	if (check_lost(slot, err) == 0 && stored_scan_take_room(upload->scan, upload->descriptor, err) == 0 &&
	    write_slot(slot, err) == 0) {
		sync_file_range(upload->descriptor, (off_t)slot->index * (off_t)slot->size, (off_t)slot->size,
				SYNC_FILE_RANGE_WRITE);
		if (hash_slot(slot, err) == 0) {
			slot->outcome = upload->holds ? SLOT_HELD : SLOT_WRITTEN;
			return 0;
		}
	}
	stored_scan_unclaim(upload->scan, slot->index);
	return err->code;
}

/* slot->outcome says how far the slot came. */
static int process_projection(struct slot *slot, struct error *err)
{
	enum claim claim;
	bool lost = true;

	do {
		if (stored_scan_claim(slot->upload->scan, slot->index, &claim, err) != 0)
			return err->code;
		if (claim == CLAIM_STORED && compare_with_stored(slot, &lost, err) != 0)
			return err->code;
	} while (claim == CLAIM_STORED && lost);
	if (claim == CLAIM_STORED)
		return 0;
	return claim == CLAIM_BUSY ? park(slot, err) : write_claimed(slot, err);
}

/*
 * An image that the scan has, NULL for none. One that is damaged counts as none: it must be sent again, and is held
 * against the others then.
 */
static int read_image(const struct upload *upload, enum image image, char **ret_pixels, struct error *err)
{
	const size_t expected = upload_image_bytes(stored_scan_parsed(upload->scan), image);
	char directory[1024], path[1100], *pixels = NULL;
	struct error why;
	size_t size = 0;
	int code;

	store_scan_directory(upload->uploads->store, stored_scan_id(upload->scan), directory);
	snprintf(path, sizeof(path), "%s/%s", directory, image_kinds[image].file);
	code = file_read(path, expected, &pixels, &size, &why);
	if (code == ERR_NO_MEMORY) {
		*err = why;
		return code;
	}
	if (code == 0 && size == expected)
		*ret_pixels = pixels;
	else
		free(pixels);
	return 0;
}

static void add_warning(void *context, const char *code, const char *detail)
{
	json_append(context, json_warning(code, detail));
}

/* Refuses what every job would be refused for with the images that are there; what is doubtful goes to *ret_warnings.
 */
static int check_image(const struct slot *slot, cJSON **ret_warnings, struct error *err)
{
	const struct upload *upload = slot->upload;
	const struct scan *scan = stored_scan_parsed(upload->scan);
	const int columns = scan->geometry.columns, rows = scan->geometry.rows;
	struct linearise linearise = scan_linearise(scan);
	struct warning_sink sink = {.tell = add_warning};
	char *others[IMAGE_COUNT] = {NULL};
	struct scan_facts facts;
	int code = 0;

	stored_scan_facts(upload->scan, &facts);
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		if (facts.image[i] && i != (int)upload->target.image)
			code = read_image(upload, i, &others[i], err);
		linearise.image[i] = i == (int)upload->target.image ? (char *)slot->data : others[i];
	}
	sink.context = cJSON_CreateArray();
	if (code == 0)
		code = images_check(&linearise, columns, rows, &sink, err);
	if (code == 0 && image_kinds[upload->target.image].pixel == IMAGE_COUNTS)
		images_warn(&linearise, columns, rows, &sink);
	if (code == 0)
		*ret_warnings = sink.context;
	else
		cJSON_Delete(sink.context);
	for (int i = 0; i < IMAGE_COUNT; i++)
		free(others[i]);
	return code;
}

/* Stores an image as it came, or converts it from the scan's sample type to float32. */
static int process_image(struct slot *slot, struct error *err)
{
	struct upload *upload = slot->upload;
	size_t pixels = upload_image_pixels(stored_scan_parsed(upload->scan));
	cJSON *warnings = NULL;
	bool created;

	if (slot->filled != upload_image_bytes(stored_scan_parsed(upload->scan), upload->target.image)) {
		for (size_t i = pixels; i-- > 0;) { /* from the end: the float of pixel i covers counts 2i and 2i + 1 */
			uint16_t sample;
			float value;

			memcpy(&sample, slot->data + i * sizeof(sample), sizeof(sample));
			value = (float)sample;
			memcpy(slot->data + i * sizeof(value), &value, sizeof(value));
		}
	}
	if (check_image(slot, &warnings, err) != 0)
		return err->code;
	if (store_put_image(upload->uploads->store, upload->scan, upload->target.image, slot->data, &created, err) !=
	    0) {
		cJSON_Delete(warnings);
		return err->code;
	}
	upload->warnings = warnings;
	slot->outcome = created ? SLOT_CREATED : SLOT_SAME;
	return 0;
}

static int process_scatter(struct slot *slot, struct error *err)
{
	const struct scatter_images *images = &stored_scan_parsed(slot->upload->scan)->scatter.images;
	const float *pixels = (const float *)(const void *)slot->data; /* malloc's alignment suits any type */
	bool created;

	for (int i = 0; i < images->columns * images->rows; i++)
		if (!isfinite(pixels[i]) || pixels[i] < 0)
			return error_set(err, ERR_IMPOSSIBLE,
					 "pixel (column %d, row %d) is %s; scatter must be finite counts of at least 0",
					 i % images->columns, i / images->columns,
					 isnan(pixels[i])   ? "NaN"
					 : isinf(pixels[i]) ? "infinite"
							    : "negative");
	if (store_put_scatter(slot->upload->scan, slot->index, pixels, &created, err) != 0)
		return err->code;
	slot->outcome = created ? SLOT_CREATED : SLOT_SAME;
	return 0;
}

static void process(struct slot *slot)
{
	slot->outcome = SLOT_OPEN;
	if (slot->data == NULL)
		slot->outcome = SLOT_WRITTEN; /* a pending commit: what is held was written before */
	else if (slot->upload->target.kind == UPLOAD_IMAGE)
		slot->code = process_image(slot, &slot->error);
	else if (slot->upload->target.kind == UPLOAD_SCATTER)
		slot->code = process_scatter(slot, &slot->error);
	else
		slot->code = process_projection(slot, &slot->error);
	if (slot->code != 0)
		slot->outcome = SLOT_FAILED;
}

/* ---- commits ---- */

static void report_failure(struct uploads *uploads, const char *what)
{
	bool first;

	pthread_mutex_lock(&uploads->lock);
	first = !uploads->failed;
	uploads->failed = true;
	pthread_mutex_unlock(&uploads->lock);
	if (first && uploads->options.failed != NULL)
		uploads->options.failed(uploads->options.context, what);
}

/*
 * A file that was removed takes what is written to it along: nothing of it may be acknowledged. That of a deleted scan
 * is told by the rows, which find no scan.
 */
static int check_linked(struct uploads *uploads, const struct upload *upload, struct error *err)
{
	const int files[] = {upload->descriptor, upload->sums};
	struct scan_facts facts;
	struct stat status;

	stored_scan_facts(upload->scan, &facts);
	for (size_t i = 0; i < sizeof(files) / sizeof(files[0]) && !facts.deleted; i++) {
		if (fstat(files[i], &status) != 0)
			return error_set_errno(err, errno, "file of scan %s", stored_scan_id(upload->scan));
		if (status.st_nlink > 0)
			continue;
		store_scan_suspect(uploads->store, stored_scan_id(upload->scan));
		return error_set(err, ERR_IO,
				 "a file of scan %s was removed while projections were written to it: send them again",
				 stored_scan_id(upload->scan));
	}
	return 0;
}

/* One sync for each file in the batch. A sync that failed is never repeated: the kernel may have dropped the pages. */
static int sync_batch(struct uploads *uploads, struct slot *const slots[], int count, struct error *err)
{
	for (int i = 0; i < count; i++) {
		double started = clock_monotonic();
		bool done = false;

		for (int j = 0; j < i && !done; j++)
			done = slots[j]->upload->scan == slots[i]->upload->scan;
		if (done)
			continue;
		if (fdatasync(slots[i]->upload->descriptor) != 0 || fdatasync(slots[i]->upload->sums) != 0) {
			error_set_sync(err, errno, "sync projections of scan %s",
				       stored_scan_id(slots[i]->upload->scan));
			if (err->code != ERR_NO_SPACE)
				report_failure(uploads, err->text);
			return err->code;
		}
		if (check_linked(uploads, slots[i]->upload, err) != 0)
			return err->code;
		pthread_mutex_lock(&uploads->lock);
		uploads->statistics.syncs++;
		uploads->statistics.sync_seconds += clock_monotonic() - started;
		pthread_mutex_unlock(&uploads->lock);
	}
	return 0;
}

/* Another file's sync failed meanwhile: the disk is no longer trusted with anything. */
static int check_trust(struct uploads *uploads, struct error *err)
{
	bool failed;

	pthread_mutex_lock(&uploads->lock);
	failed = uploads->failed;
	pthread_mutex_unlock(&uploads->lock);
	return failed ? error_set(err, ERR_IO, "a sync has failed before; nothing more is stored") : 0;
}

static void received_set(struct received_projection *received, const struct upload *upload, int index,
			 const struct sum *sum)
{
	received->scan = upload->scan;
	received->index = index;
	received->sum = *sum;
	received->stored = false;
}

static int gather(struct slot *const slots[], int count, struct received_projection **ret_batch, int *ret_total,
		  struct error *err)
{
	struct received_projection *batch;
	int total = 0;

	for (int i = 0; i < count; i++)
		total += slots[i]->weight;
	batch = malloc((size_t)total * sizeof(*batch));
	if (batch == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a commit");
	total = 0;
	for (int i = 0; i < count; i++) {
		const struct upload *upload = slots[i]->upload;

		if (slots[i]->data != NULL)
			received_set(&batch[total++], upload, slots[i]->index, &slots[i]->sum);
		for (int j = 0; slots[i]->data == NULL && j < slots[i]->weight; j++)
			received_set(&batch[total++], upload, upload->held[j].index, &upload->held[j].sum);
	}
	*ret_batch = batch;
	*ret_total = total;
	return 0;
}

/*
 * The records of a batch into projections.sums, in the order in which it will be stored; they are synced with the
 * samples. `number` is the batch's.
 */
static int write_sums(unsigned long long number, struct slot *const slots[], int count,
		      struct received_projection *batch, struct error *err)
{
	enum { MOST = 1 << 24 }; /* projections in a batch: BATCH_SLOTS times VIEWS_MAX */
	int at = 0;

	for (int i = 0; i < count; i++) {
		for (int j = 0; j < slots[i]->weight; j++, at++) {
			if (stored_scan_put_sum(&batch[at], slots[i]->upload->sums, number * MOST + (unsigned)at,
						err) != 0)
				return err->code;
		}
	}
	return 0;
}

/* Blanks the records of projections that were not stored; without a sync, since a record that stays is true. */
static void take_back_sums(struct slot *const slots[], int count, const struct received_projection *batch, bool all)
{
	struct error ignored;
	int at = 0;

	for (int i = 0; i < count; i++) {
		for (int j = 0; j < slots[i]->weight; j++, at++) {
			if (all || !batch[at].stored)
				sums_put(slots[i]->upload->sums, batch[at].index, NULL, &ignored);
		}
	}
}

static int why_not_stored(const struct received_projection *projection, struct error *err)
{
	struct scan_facts facts;

	stored_scan_facts(projection->scan, &facts);
	if (facts.deleted)
		return error_set(err, ERR_NOT_FOUND, "the scan was deleted meanwhile");
	return error_set(err, ERR_CONFLICT, "the scan was completed without projection %d", projection->index);
}

static void await_turn(struct uploads *uploads, unsigned long long batch)
{
	pthread_mutex_lock(&uploads->lock);
	while (uploads->over != batch)
		pthread_cond_wait(&uploads->turn, &uploads->lock);
	pthread_mutex_unlock(&uploads->lock);
}

/* The bytes and their records, then the rows. */
static int commit(struct uploads *uploads, unsigned long long number, struct slot *const slots[], int count,
		  struct error *err)
{
	struct received_projection *batch = NULL;
	int total = 0, at = 0, code;

	code = gather(slots, count, &batch, &total, err);
	if (code == 0)
		code = write_sums(number, slots, count, batch, err);
	if (code == 0)
		code = sync_batch(uploads, slots, count, err);
	if (code == 0)
		code = check_trust(uploads, err);
	await_turn(uploads, number);
	if (code == 0)
		code = store_put_projections(uploads->store, batch, total, err);
	if (batch != NULL)
		take_back_sums(slots, count, batch, code != 0);
	for (int i = 0; i < count && code == 0; i++) {
		slots[i]->outcome = SLOT_CREATED;
		slots[i]->committed = true;
		for (int j = 0; j < slots[i]->weight; j++, at++) {
			if (batch[at].stored)
				continue;
			slots[i]->outcome = SLOT_FAILED;
			slots[i]->code = why_not_stored(&batch[at], &slots[i]->error);
		}
	}
	free(batch);
	return code;
}

static void commit_written(struct uploads *uploads, unsigned long long number, struct slot *const slots[], int count)
{
	struct error err = {0};

	if (count == 0)
		await_turn(uploads, number);
	if (count == 0 || commit(uploads, number, slots, count, &err) == 0)
		return;
	for (int i = 0; i < count; i++) {
		if (slots[i]->data != NULL) /* held ones are given back with their upload */
			stored_scan_unclaim(slots[i]->upload->scan, slots[i]->index);
		slots[i]->outcome = SLOT_FAILED;
		slots[i]->code = err.code;
		slots[i]->error = err;
	}
}

/* ---- settling ---- */

/* Tells the upload what became of a slot; with uploads.lock held, which it releases and takes again. */
static void settle(struct uploads *uploads, struct slot *slot)
{
	struct upload *upload = slot->upload;

	if (slot->data == NULL && slot->committed)
		upload->held_count = 0;
	switch (slot->outcome) {
	case SLOT_CREATED:
		upload->outcome.created += slot->weight;
		break;
	case SLOT_SAME:
		upload->outcome.same++;
		break;
	case SLOT_HELD:
		upload->held[upload->held_count].index = slot->index;
		upload->held[upload->held_count++].sum = slot->sum;
		break;
	default:
		if (upload->error.code == 0)
			upload->error = slot->error;
		break;
	}
	upload->pending--;
	if (slot != &upload->commit)
		pool_give_back(uploads, slot);
	upload_commit_held(upload);
	if (upload->request != NULL && (upload->pending == 0 || upload->error.code != 0))
		request_wake(upload->request);
	upload_unreference_and_unlock(upload);
	pthread_mutex_lock(&uploads->lock);
}

/* With uploads.lock held. `releases` is from before the claims were asked for: one that came free since is tried at
 * once. */
static void settle_all(struct uploads *uploads, struct slot *const slots[], int count, unsigned long long releases)
{
	for (int i = 0; i < count; i++) {
		if (slots[i]->outcome != SLOT_PARKED)
			settle(uploads, slots[i]);
		else if (uploads->releases != releases)
			slots_add(&uploads->queue, slots[i]);
		else
			slots_add(&uploads->parked, slots[i]);
	}
}

static int take_batch(struct uploads *uploads, struct slot *slots[BATCH_SLOTS])
{
	size_t bytes = 0;
	int count = 0;

	while (count < BATCH_SLOTS && uploads->queue.first != NULL &&
	       (count == 0 || bytes + uploads->queue.first->size <= BATCH_BYTES)) {
		slots[count] = slots_take(&uploads->queue);
		bytes += slots[count++]->size;
	}
	return count;
}

/* With uploads.lock held; false when all is done and the end has come. */
static bool wait_for_work(struct uploads *uploads)
{
	while (uploads->queue.first == NULL) {
		if (uploads->stop && uploads->parked.first == NULL)
			return false;
		if (uploads->parked.first == NULL) {
			pthread_cond_wait(&uploads->work, &uploads->lock);
		} else { /* their patience has an end */
			const struct timespec until = clock_timespec(clock_monotonic() + 1);

			if (pthread_cond_timedwait(&uploads->work, &uploads->lock, &until) == ETIMEDOUT)
				uploads_requeue(uploads);
		}
	}
	return true;
}

static void *run_writer(void *context)
{
	struct uploads *uploads = context;
	struct slot *slots[BATCH_SLOTS], *written[BATCH_SLOTS];

	backend_host_threads(1); /* images are judged in this thread alone */
	pthread_mutex_lock(&uploads->lock);
	while (wait_for_work(uploads)) {
		int count = take_batch(uploads, slots), written_count = 0;
		unsigned long long releases = uploads->releases, number = uploads->taken++;
		bool claims_given_back = false;

		pthread_mutex_unlock(&uploads->lock);
		for (int i = 0; i < count; i++) {
			process(slots[i]);
			if (slots[i]->outcome == SLOT_WRITTEN)
				written[written_count++] = slots[i];
			claims_given_back |= slots[i]->outcome == SLOT_FAILED;
		}
		commit_written(uploads, number, written, written_count);
		pthread_mutex_lock(&uploads->lock);
		uploads->over++;
		pthread_cond_broadcast(&uploads->turn);
		settle_all(uploads, slots, count, releases);
		if (written_count > 0 || claims_given_back)
			uploads_requeue(uploads);
	}
	pthread_mutex_unlock(&uploads->lock);
	return NULL;
}

/* ---- the whole ---- */

int uploads_new(struct store *store, const struct uploads_options *options, struct uploads **ret_uploads,
		struct error *err)
{
	struct uploads *uploads = calloc(1, sizeof(*uploads));
	pthread_condattr_t monotonic;

	if (uploads == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for uploads");
	uploads->store = store;
	uploads->options = *options;
	slots_init(&uploads->queue);
	slots_init(&uploads->parked);
	uploads->starved_end = &uploads->starved_first;
	lock_init(&uploads->lock, LOCK_UPLOADS);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&uploads->work, &monotonic);
	pthread_cond_init(&uploads->turn, NULL);
	pthread_condattr_destroy(&monotonic);
	for (int i = 0; i < WRITERS; i++) {
		int code = pthread_create(&uploads->writers[i], NULL, run_writer, uploads);

		if (code != 0) {
			error_set_errno(err, code, "writer thread");
			uploads_free(uploads);
			return err->code;
		}
		uploads->writer_count++;
	}
	*ret_uploads = uploads;
	return 0;
}

void uploads_free(struct uploads *uploads)
{
	if (uploads == NULL)
		return;
	pthread_mutex_lock(&uploads->lock);
	uploads->stop = true;
	pthread_cond_broadcast(&uploads->work);
	pthread_mutex_unlock(&uploads->lock);
	for (int i = 0; i < uploads->writer_count; i++)
		pthread_join(uploads->writers[i], NULL);
	assert(uploads->used == 0);
	pool_free(uploads);
	pthread_cond_destroy(&uploads->turn);
	pthread_cond_destroy(&uploads->work);
	pthread_mutex_destroy(&uploads->lock);
	free(uploads);
}

void uploads_statistics(struct uploads *uploads, struct uploads_statistics *ret)
{
	pthread_mutex_lock(&uploads->lock);
	*ret = uploads->statistics;
	ret->buffered = uploads->used;
	pthread_mutex_unlock(&uploads->lock);
}

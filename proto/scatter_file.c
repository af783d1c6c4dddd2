/* Images of scatter in a scan directory: see scatter_file.h. */
#include "proto/scatter_file.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <openssl/evp.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "proto/durable.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"

static int open_samples(const char *directory, int flags, int *ret_file, struct error *err)
{
	char path[PATH_MAX];
	int code = path_join(path, sizeof(path), directory, SCATTER_FILE, "", err);

	if (code != 0)
		return code;
	*ret_file = regular_open(path, flags, 0640);
	if (*ret_file < 0 && errno == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "%.200s does not exist", path);
	return *ret_file < 0 ? error_set_errno(err, errno, "%s cannot be opened", path) : 0;
}

/* The samples' file with its full size, durably; *ret_mended is set where it had not. */
static int make_samples(const char *directory, const struct scatter_images *images, int count, bool *ret_mended,
			struct error *err)
{
	const off_t size = (off_t)scatter_image_bytes(images) * count;
	struct stat status;
	int file, code = open_samples(directory, O_RDWR | O_CREAT, &file, err);

	if (code != 0)
		return code;
	if (fstat(file, &status) != 0)
		code = error_set_errno(err, errno, SCATTER_FILE);
	else if (status.st_size == size)
		goto out;
	else if (ftruncate(file, size) != 0)
		code = error_set_errno(err, errno == EFBIG ? ENOSPC : errno, "file for %d images of scatter", count);
	else if (fsync(file) != 0)
		code = error_set_sync(err, errno, "sync " SCATTER_FILE);
	*ret_mended = true;
out:
	close(file);
	return code;
}

int scatter_file_create(const char *directory, const struct scatter_images *images, int projections, struct error *err)
{
	const int count = scatter_images_count(images, projections);
	const struct sum never = {.bytes = 0};
	bool mended;
	int code = make_samples(directory, images, count, &mended, err);

	return code == 0
		   ? sums_create_file(directory, SUMS_SCATTER_FILE, count, scatter_image_bytes(images), &never, err)
		   : code;
}

static int look_for_mark(struct scatter_file *file, bool whole, struct error *err)
{
	unsigned char state = SUM_NONE;
	struct sum sum;
	int code = sums_get(file->sums, SUMS_SCAN, 1, 0, &sum, &state, err);

	file->marked = !whole || state != SUM_NONE;
	return code;
}

int scatter_file_open(const char *directory, const struct scatter_images *images, int projections, bool writing,
		      struct scatter_file *ret_file, bool *ret_whole, struct error *err)
{
	struct scatter_file file = {.images = *images, .projections = projections, .sums = -1};
	const size_t bytes = scatter_image_bytes(images);
	struct stat status;
	int code = open_samples(directory, writing ? O_RDWR : O_RDONLY, &file.samples, err);

	if (code != 0)
		return code;
	file.count = scatter_images_count(images, projections);
	if (fstat(file.samples, &status) != 0)
		code = error_set_errno(err, errno, SCATTER_FILE);
	else if ((size_t)status.st_size != bytes * (size_t)file.count)
		code = error_set(
		    err, ERR_INVALID, SCATTER_FILE ": %zu bytes, but %d images of %d x %d float32 have %zu",
		    (size_t)status.st_size, file.count, images->columns, images->rows, bytes * (size_t)file.count);
	if (code == 0) {
		struct error why;
		const int got = sums_open_file(directory, SUMS_SCATTER_FILE, writing, file.count, bytes, &file.sums,
					       ret_whole, &why);

		if (got == ERR_NOT_FOUND)
			file.sums = -1;
		else if (got != 0)
			code = got, *err = why;
		else
			code = look_for_mark(&file, *ret_whole, err);
	}
	if (code != 0)
		scatter_file_close(&file);
	else
		*ret_file = file;
	return code;
}

void scatter_file_close(struct scatter_file *file)
{
	if (file->count > 0 && file->samples >= 0)
		close(file->samples);
	if (file->count > 0 && file->sums >= 0)
		close(file->sums);
	*file = (struct scatter_file){.samples = -1, .sums = -1};
}

static enum scatter_state state_of(const struct scatter_file *file, enum sum_state state, const struct sum *sum)
{
	if (state == SUM_NONE)
		return file->marked ? SCATTER_LOST : SCATTER_NONE;
	if (state == SUM_DAMAGED || sum->lost)
		return SCATTER_LOST;
	if (sum->bytes == 0)
		return SCATTER_NONE;
	return sum->bytes == scatter_image_bytes(&file->images) ? SCATTER_STORED : SCATTER_LOST;
}

/* The record says which bytes the image has, or had. */
static bool is_known(enum sum_state state, const struct sum *sum)
{
	static const uint8_t none[sizeof(sum->sha256)];

	return state == SUM_GOOD && memcmp(sum->sha256, none, sizeof(none)) != 0;
}

static unsigned other_of(const struct sum *sum)
{
	const uint8_t *sha256 = sum->sha256;

	if (sum->order == 0)
		return 0;
	return 1u | (unsigned)sha256[0] << 8 | (unsigned)sha256[1] << 16 | (unsigned)sha256[2] << 24;
}

int scatter_file_states(const struct scatter_file *file, unsigned char *ret_states, unsigned *ret_others,
			struct error *err)
{
	int code = 0;

	for (int i = 0; i < file->count && code == 0; i++) {
		unsigned char state = SUM_NONE;
		struct sum sum;

		code = sums_get(file->sums, i, 1, 0, &sum, &state, err);
		if (code != 0)
			break;
		ret_states[i] = (unsigned char)state_of(file, state, &sum);
		ret_others[i] = is_known(state, &sum) ? other_of(&sum) : 0;
	}
	return code;
}

static int damaged(const struct scatter_file *file, int image, struct error *err)
{
	return error_set(err, ERR_DAMAGED, "the image of projection %d's scatter is damaged, or was never received",
			 scatter_image_projection(&file->images, file->projections, image));
}

int scatter_file_read(const struct scatter_file *file, int image, float *ret_image, struct sum *ret_sum,
		      struct error *err)
{
	const size_t bytes = scatter_image_bytes(&file->images);
	unsigned char state = SUM_NONE;
	int code = file_read_at(file->samples, ret_image, bytes, bytes * (size_t)image, SCATTER_FILE, err);

	if (code != 0 || file->sums < 0)
		return code;
	code = sums_get(file->sums, image, 1, bytes, ret_sum, &state, err);
	if (code == 0 && (state != SUM_GOOD || ret_sum->lost || ret_sum->crc != checksum(0, ret_image, bytes)))
		code = damaged(file, image, err);
	return code;
}

static int put_record(const struct scatter_file *file, int image, const struct sum *sum, struct error *err)
{
	int code = sums_put(file->sums, image, sum, err);

	if (code == 0 && fdatasync(file->sums) != 0)
		code = error_set_sync(err, errno, "sync " SUMS_SCATTER_FILE);
	return code;
}

int scatter_file_describe(const struct scatter_file *file, int image, const float *pixels, struct sum *ret_sum,
			  unsigned *ret_other, struct error *err)
{
	const size_t bytes = scatter_image_bytes(&file->images);
	struct sum sum = {.crc = checksum(0, pixels, bytes), .bytes = bytes}, before;
	unsigned char state = SUM_NONE;
	int code = sums_get(file->sums, image, 1, 0, &before, &state, err);

	if (code != 0)
		return code;
	if (EVP_Digest(pixels, bytes, sum.sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "SHA-256 failed");
	if (is_known(state, &before) && memcmp(before.sha256, sum.sha256, sizeof(sum.sha256)) == 0)
		sum.order = before.order;
	else if (is_known(state, &before) && before.lost)
		return error_set(err, ERR_CONFLICT,
				 "the image of projection %d's scatter was stored with other bytes, and damaged by the "
				 "disk: it is to be sent again as it was; DELETE removes it",
				 scatter_image_projection(&file->images, file->projections, image));
	else
		sum.order = state != SUM_GOOD || before.bytes != 0 || before.lost;
	*ret_sum = sum;
	*ret_other = other_of(&sum);
	return 0;
}

int scatter_file_write(const struct scatter_file *file, int image, const float *pixels, const struct sum *sum,
		       struct error *err)
{
	const size_t bytes = scatter_image_bytes(&file->images);
	const off_t offset = (off_t)bytes * image;
	size_t done = 0;

	while (done < bytes) {
		const ssize_t wrote =
		    pwrite(file->samples, (const char *)pixels + done, bytes - done, offset + (off_t)done);

		if (wrote < 0 && errno == EINTR)
			continue;
		if (wrote <= 0)
			return error_set_errno(err, wrote < 0 ? errno : EIO, "write " SCATTER_FILE);
		done += (size_t)wrote;
	}
	if (fdatasync(file->samples) != 0)
		return error_set_sync(err, errno, "sync " SCATTER_FILE);
	return put_record(file, image, sum, err);
}

int scatter_file_lose(const struct scatter_file *file, int image, struct error *err)
{
	struct sum sum = {.bytes = scatter_image_bytes(&file->images)};
	unsigned char state = SUM_NONE;
	int code = sums_get(file->sums, image, 1, sum.bytes, &sum, &state, err);

	sum.lost = true;
	return code == 0 ? put_record(file, image, &sum, err) : code;
}

int scatter_file_forget(const struct scatter_file *file, const unsigned char *flags, struct error *err)
{
	const off_t bytes = (off_t)scatter_image_bytes(&file->images);
	const struct sum never = {.bytes = 0};
	int code = 0;

	for (int i = 0; i < file->count && code == 0; i++)
		if (flags[i])
			code = sums_put(file->sums, i, &never, err);
	if (code == 0 && fdatasync(file->sums) != 0)
		code = error_set_sync(err, errno, "sync " SUMS_SCATTER_FILE);
	for (int i = 0; i < file->count && code == 0; i++)
		if (flags[i])
			fallocate(file->samples, FALLOC_FL_PUNCH_HOLE | FALLOC_FL_KEEP_SIZE, bytes * i, bytes);
	return code;
}

/* ---- files that are not whole ---- */

/* Into new records, in which all images are lost so far: those of the old file that are good, also of images that were
 * lost, and images that never came. */
static int copy_records(const struct scatter_file *from, const struct scatter_file *to, const unsigned char *states,
			struct error *err)
{
	const struct sum never = {.bytes = 0};
	int code = 0;

	for (int i = 0; i < to->count && code == 0; i++) {
		unsigned char state = SUM_NONE;
		struct sum sum = never;

		if (from->sums >= 0)
			code = sums_get(from->sums, i, 1, 0, &sum, &state, err);
		if (code != 0)
			break;
		if (state_of(from, state, &sum) != SCATTER_LOST || (is_known(state, &sum) && sum.lost))
			code = sums_put(to->sums, i, &sum, err);
		else if (states != NULL && states[i] == SCATTER_NONE)
			code = sums_put(to->sums, i, &never, err);
	}
	if (code == 0 && fdatasync(to->sums) != 0)
		code = error_set_sync(err, errno, "sync " SUMS_SCATTER_FILE);
	return code;
}

static int make_records(const char *directory, const struct scatter_file *from, const unsigned char *states,
			struct error *err)
{
	const struct sum lost = {.lost = true};
	struct scatter_file to;
	bool whole;
	int code =
	    sums_create_file(directory, SUMS_SCATTER_FILE, from->count, scatter_image_bytes(&from->images), &lost, err);

	if (code == 0)
		code = scatter_file_open(directory, &from->images, from->projections, true, &to, &whole, err);
	if (code != 0)
		return code;
	code = to.sums < 0 ? error_set(err, ERR_IO, "there is no " SUMS_SCATTER_FILE)
			   : copy_records(from, &to, states, err);
	scatter_file_close(&to);
	return code;
}

int scatter_file_mend(const char *directory, const struct scatter_images *images, int projections,
		      const unsigned char *states, bool *ret_mended, struct error *err)
{
	struct scatter_file file;
	char path[PATH_MAX];
	struct error why;
	bool whole = false;
	int code;

	*ret_mended = false;
	code = path_join(path, sizeof(path), directory, SCATTER_FILE, "", err);
	if (code == 0)
		code = make_samples(directory, images, scatter_images_count(images, projections), ret_mended, err);
	if (code == 0 && *ret_mended)
		code = durable_sync_names(path, err);
	if (code != 0)
		return code;
	code = scatter_file_open(directory, images, projections, false, &file, &whole, &why);
	if (code == ERR_INVALID) { /* another scan's records: as if there were none */
		file = (struct scatter_file){.images = *images,
					     .projections = projections,
					     .count = scatter_images_count(images, projections),
					     .samples = -1,
					     .sums = -1,
					     .marked = true};
	} else if (code != 0) {
		*err = why;
		return code;
	}
	file.marked |= file.sums < 0;
	code = 0;
	if (file.sums < 0 || !whole) {
		*ret_mended = true;
		code = make_records(directory, &file, states, err);
	}
	scatter_file_close(&file);
	return code;
}

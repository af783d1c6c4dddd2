/* Checkpoints: see checkpoint.h. */
#include "proto/checkpoint.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include "proto/clock.h"
#include "proto/regular.h"
#include "proto/saver.h"
#include "proto/scan_directory.h"
#include "proto/seal.h"

enum {
	PIECE_BYTES = 8 << 20, /* voxels in one go on their way to the disk */
	ROWS_AHEAD = 4096      /* of the history, that may come between a file's preparation and its use */
};
static const double SHARE = 50;        /* a copy takes at most one part in so many of the time */
static const double SECONDS_AHEAD = 1; /* that a file is prepared before it is due */

/* ---- the history ---- */

enum { ROW_NUMBERS = 5, ROW_BYTES = ROW_NUMBERS * (int)sizeof(double) };

static void row_pack(const struct history_row *row, double ret[ROW_NUMBERS])
{
	ret[0] = row->iteration;
	ret[1] = row->residual;
	ret[2] = row->change;
	ret[3] = row->tv;
	ret[4] = row->seconds;
}

/* False where the row is not of that iteration, or not finite. */
static bool row_unpack(const char *bytes, int iteration, struct history_row *ret_row)
{
	double numbers[ROW_NUMBERS];

	memcpy(numbers, bytes, sizeof(numbers));
	for (int i = 0; i < ROW_NUMBERS; i++) {
		if (!isfinite(numbers[i]))
			return false;
	}
	*ret_row = (struct history_row){.iteration = iteration,
					.residual = numbers[1],
					.change = numbers[2],
					.tv = numbers[3],
					.seconds = numbers[4]};
	return numbers[0] == iteration;
}

int history_add(struct history *history, const struct history_row *row, struct error *err)
{
	if (history->count == history->room) {
		const int room = history->room == 0 ? 64 : 2 * history->room;
		struct history_row *rows = realloc(history->rows, (size_t)room * sizeof(*rows));

		if (rows == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for the history of %d iterations", room);
		history->rows = rows;
		history->room = room;
	}
	history->rows[history->count++] = *row;
	history->seconds += row->seconds;
	return 0;
}

static int read_history(const char *bytes, int count, struct history *history, struct error *err)
{
	int code = 0;

	history->count = 0;
	history->seconds = 0;
	for (int i = 0; i < count && code == 0; i++) {
		struct history_row row;

		if (row_unpack(bytes + (size_t)i * ROW_BYTES, i + 1, &row))
			code = history_add(history, &row, err);
		else
			code = error_set(err, ERR_INVALID, "row %d of the history makes no sense", i + 1);
	}
	return code;
}

/* ---- writing ---- */

/*
 * After the line come the iterate, then the algorithm's state, then the list of the metal that was removed, then the
 * history. No noise is written as 0.
 */
static void checkpoint_line(char ret_line[CHECKPOINT_FILE_OFFSET], int iteration, const struct grid *grid,
			    size_t state_bytes, size_t metal_bytes, int rows, const struct volume_noise *noise)
{
	char text[CHECKPOINT_FILE_OFFSET], state[32] = "";

	memset(ret_line, ' ', CHECKPOINT_FILE_OFFSET);
	if (state_bytes > 0)
		snprintf(state, sizeof(state), ", state %zu", state_bytes);
	snprintf(text, sizeof(text), "cbctd checkpoint %d of %d %d %d, metal %zu, rows %d, noise %a %a%s", iteration,
		 grid->size[0], grid->size[1], grid->size[2], metal_bytes, rows, noise->sigma, noise->contrast, state);
	memcpy(ret_line, text, strlen(text));
	ret_line[CHECKPOINT_FILE_OFFSET - 1] = '\n';
}

static int write_bytes(void *context, const void *bytes, size_t size, struct error *err)
{
	const char *from = bytes;
	size_t piece;
	int code = 0;

	for (size_t at = 0; at < size && code == 0; at += piece) {
		void *place;

		piece = size - at < PIECE_BYTES ? size - at : PIECE_BYTES;
		code = saver_piece(context, piece, &place, err);
		if (code == 0) {
			memcpy(place, from + at, piece);
			saver_give(context, piece);
		}
	}
	return code;
}

/* Whole slices, at least one. */
static int slices_of_a_piece(const struct grid *grid, size_t *ret_slice)
{
	const size_t slice = (size_t)grid->size[0] * (size_t)grid->size[1] * sizeof(float);
	const int slices = slice < PIECE_BYTES ? (int)(PIECE_BYTES / slice) : 1;

	*ret_slice = slice;
	return slices < grid->size[2] ? slices : grid->size[2];
}

/* The iterate behind what the file holds already, piece by piece, straight into it. */
static int write_iterate(struct recon *recon, struct saver *saver, struct error *err)
{
	const struct grid *grid = recon_grid(recon);
	size_t slice;
	int slices = slices_of_a_piece(grid, &slice), code = 0;

	for (int z = 0; z < grid->size[2] && code == 0; z += slices) {
		int count = z + slices <= grid->size[2] ? slices : grid->size[2] - z;
		void *place;

		code = saver_piece(saver, (size_t)count * slice, &place, err);
		if (code == 0)
			code = recon_read(recon, z, count, place, err);
		if (code == 0)
			saver_give(saver, (size_t)count * slice);
	}
	return code;
}

static int write_history(const struct history *history, struct saver *saver, struct error *err)
{
	int code = 0;

	for (int i = 0; i < history->count && code == 0; i++) {
		double numbers[ROW_NUMBERS];

		row_pack(&history->rows[i], numbers);
		code = write_bytes(saver, numbers, sizeof(numbers), err);
	}
	return code;
}

/* Of a checkpoint with that many rows. */
static size_t content_bytes(const struct recon *recon, int rows)
{
	size_t found;

	recon_found(recon, &found);
	return CHECKPOINT_FILE_OFFSET + grid_voxels(recon_grid(recon)) * sizeof(float) + recon_state_bytes(recon) +
	       found + (size_t)rows * ROW_BYTES;
}

/* All that is behind the line. */
static int write_content(struct recon *recon, const struct history *history, struct saver *saver, struct error *err)
{
	const struct checkpoint_sink sink = {.context = saver, .write = write_bytes};
	size_t metal_bytes;
	const void *metal = recon_found(recon, &metal_bytes);
	int code = write_iterate(recon, saver, err);

	if (code == 0)
		code = recon_save_state(recon, &sink, err);
	if (code == 0 && metal_bytes > 0)
		code = write_bytes(saver, metal, metal_bytes, err);
	return code == 0 ? write_history(history, saver, err) : code;
}

/*
 * The whole file, under its name and on its way to the disk; nothing is left of it when that fails. The checkpoint
 * that had the name is `before` from then on, since the new one may not survive a power cut yet.
 */
static int write_checkpoint(struct recon *recon, const struct history *history, struct saver *saver, const char *path,
			    const char *before, struct error *err)
{
	const struct volume_noise *noise = recon_noise(recon), none = {0};
	char line[CHECKPOINT_FILE_OFFSET];
	size_t metal_bytes;
	int code;

	recon_found(recon, &metal_bytes);
	checkpoint_line(line, recon_iteration(recon), recon_grid(recon), recon_state_bytes(recon), metal_bytes,
			history->count, noise != NULL ? noise : &none);
	code = saver_begin(saver, path, line, sizeof(line), content_bytes(recon, history->count) - sizeof(line), err);
	if (code != 0)
		return code;
	code = write_content(recon, history, saver, err);
	if (code == 0 && rename(path, before) != 0 && errno != ENOENT)
		code = error_set_errno(err, errno, "%s cannot be renamed", path);
	if (code != 0) {
		saver_abandon(saver);
		return code;
	}
	return saver_end(saver, err);
}

static int path_of(const char *directory, const char *name, char ret_path[PATH_MAX], struct error *err)
{
	return path_join(ret_path, PATH_MAX, directory, name, "", err);
}

void checkpoint_remove(const char *directory)
{
	static const char *const names[] = {CHECKPOINT_FILE, CHECKPOINT_FILE_BEFORE};
	char path[PATH_MAX];
	struct error ignored;

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
		if (path_of(directory, names[i], path, &ignored) == 0)
			unlink(path);
	}
}

int checkpoint_save(struct recon *recon, const struct history *history, const char *directory, struct error *err)
{
	char path[PATH_MAX], before[PATH_MAX];
	struct saver *saver = NULL;
	bool done;
	int code = path_of(directory, CHECKPOINT_FILE, path, err);

	if (code == 0)
		code = path_of(directory, CHECKPOINT_FILE_BEFORE, before, err);
	if (code == 0)
		code = saver_new(true, &saver, err);
	if (code == 0)
		code = write_checkpoint(recon, history, saver, path, before, err);
	if (code == 0)
		code = saver_finish(saver, true, &done, err);
	saver_free(saver);
	if (code == 0)
		unlink(before);
	return code;
}

/* ---- while the run goes on ---- */

struct checkpointer {
	char path[PATH_MAX], before[PATH_MAX], blank[PATH_MAX];
	double seconds, due; /* the latter by clock_monotonic */
	bool ahead;          /* the next file is prepared while the device computes */
	bool prepared;       /* it is, with its room on the disk, or that was tried */
	struct saver *saver;
	int iteration; /* of the checkpoint on its way */
};

int checkpointer_new(const char *directory, double seconds, bool ahead, struct checkpointer **ret, struct error *err)
{
	struct checkpointer *checkpointer = calloc(1, sizeof(*checkpointer));
	int code = checkpointer == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for checkpoints") : 0;

	if (code == 0)
		code = path_of(directory, CHECKPOINT_FILE, checkpointer->path, err);
	if (code == 0)
		code = path_of(directory, CHECKPOINT_FILE_BEFORE, checkpointer->before, err);
	if (code == 0)
		code = path_of(directory, "checkpoint-blank", checkpointer->blank, err);
	if (code == 0)
		code = saver_new(true, &checkpointer->saver, err);
	if (code != 0) {
		free(checkpointer);
		return code;
	}
	checkpointer->seconds = seconds;
	checkpointer->ahead = ahead;
	checkpointer->due = clock_monotonic() + seconds;
	*ret = checkpointer;
	return 0;
}

void checkpointer_free(struct checkpointer *checkpointer)
{
	if (checkpointer == NULL)
		return;
	saver_free(checkpointer->saver);
	free(checkpointer);
}

void checkpointer_discard(struct checkpointer *checkpointer)
{
	saver_discard(checkpointer->saver);
}

/* So many seconds before the run's end. */
static bool comes_too_late(const struct checkpointer *checkpointer, double left)
{
	return left < saver_seconds(checkpointer->saver);
}

bool checkpointer_due(const struct checkpointer *checkpointer, double left)
{
	return !saver_busy(checkpointer->saver) && clock_monotonic() >= checkpointer->due &&
	       !comes_too_late(checkpointer, left);
}

/* Beside the checkpoint, the disk must keep room for a volume of the job, and for the daemon's records. */
static bool has_room(const char *path, size_t bytes)
{
	char directory[PATH_MAX];
	struct statvfs disk;

	snprintf(directory, sizeof(directory), "%s", path);
	*strrchr(directory, '/') = '\0';
	return statvfs(directory, &disk) != 0 || (double)disk.f_bavail * (double)disk.f_frsize >= 2 * (double)bytes;
}

void checkpointer_prepare(struct checkpointer *checkpointer, const struct recon *recon, const struct history *history,
			  double left)
{
	const size_t content = content_bytes(recon, history->count + ROWS_AHEAD);
	const double until_due = fmax(checkpointer->due - clock_monotonic(), 0);

	if (!checkpointer->ahead || checkpointer->prepared || saver_busy(checkpointer->saver) ||
	    until_due > SECONDS_AHEAD || comes_too_late(checkpointer, left - until_due) ||
	    !has_room(checkpointer->path, content))
		return;
	checkpointer->prepared = true;
	saver_prepare(checkpointer->saver, checkpointer->blank, content);
}

int checkpointer_begin(struct checkpointer *checkpointer, struct recon *recon, const struct history *history,
		       struct error *err)
{
	const double begin = clock_monotonic();
	const bool room = checkpointer->prepared || has_room(checkpointer->path, content_bytes(recon, history->count));
	struct error why;
	int code = ERR_NO_SPACE;

	if (room)
		code = write_checkpoint(recon, history, checkpointer->saver, checkpointer->path, checkpointer->before,
					&why);
	checkpointer->prepared = false;
	checkpointer->due = clock_monotonic() + fmax(checkpointer->seconds, SHARE * (clock_monotonic() - begin));
	checkpointer->iteration = recon_iteration(recon);
	if (code != 0 && code != ERR_NO_SPACE)
		*err = why;
	return code == ERR_NO_SPACE ? 0 : code;
}

int checkpointer_settled(struct checkpointer *checkpointer, bool wait, int *ret_iteration, struct error *err)
{
	struct error why;
	bool done;
	int code;

	*ret_iteration = 0;
	if (!saver_busy(checkpointer->saver))
		return 0;
	code = saver_finish(checkpointer->saver, wait, &done, &why);
	if (code == 0 && done)
		*ret_iteration = checkpointer->iteration;
	if (code != 0 && code != ERR_NO_SPACE)
		*err = why;
	return code == ERR_NO_SPACE ? 0 : code;
}

/* ---- reading ---- */

struct checkpoint_facts {
	int iteration, rows;
	struct volume_noise noise;
	size_t state, metal; /* bytes */
};

static int check_checkpoint(const char *path, const char *bytes, const struct seal *seal, const struct recon *recon,
			    struct checkpoint_facts *ret_facts, struct error *err)
{
	const struct grid *grid = recon_grid(recon);
	const size_t least = CHECKPOINT_FILE_OFFSET + grid_voxels(grid) * sizeof(float);
	char text[CHECKPOINT_FILE_OFFSET + 1] = "", line[CHECKPOINT_FILE_OFFSET];
	struct checkpoint_facts facts = {.state = 0};
	int damaged = seal_first_damaged(seal, bytes);

	if (damaged >= 0)
		return error_set(err, ERR_INVALID, "%.200s: its block %d does not fit its checksum", path, damaged);
	if (seal->content < least)
		return error_set(err, ERR_INVALID, "%.200s: %zu bytes, at least %zu are expected", path, seal->content,
				 least);
	memcpy(text, bytes, CHECKPOINT_FILE_OFFSET);
	/* Without a state the line says nothing of it. */
	if (sscanf(text, "cbctd checkpoint %d of %*d %*d %*d, metal %zu, rows %d, noise %la %la, state %zu",
		   &facts.iteration, &facts.metal, &facts.rows, &facts.noise.sigma, &facts.noise.contrast,
		   &facts.state) < 5)
		return error_set(err, ERR_INVALID, "%.200s is no checkpoint", path);
	checkpoint_line(line, facts.iteration, grid, facts.state, facts.metal, facts.rows, &facts.noise);
	if (memcmp(line, bytes, sizeof(line)) != 0 || facts.rows != facts.iteration ||
	    !recon_state_fits(recon, facts.state) ||
	    seal->content != least + facts.state + facts.metal + (size_t)facts.rows * ROW_BYTES)
		return error_set(err, ERR_INVALID, "%.200s is of another grid or algorithm", path);
	*ret_facts = facts;
	return 0;
}

/* Mapped, not read: one volume less in memory at the worst moment. */
static int resume_from(struct recon *recon, const char *path, int latest, struct history *history, struct error *err)
{
	int file = regular_open(path, O_RDONLY, 0), code;
	struct checkpoint_facts facts = {0};
	struct seal seal = {0};
	size_t at, state;
	char *bytes = MAP_FAILED;

	if (file < 0 && errno == ENOENT)
		return error_set(err, ERR_INVALID, "%.200s does not exist", path);
	if (file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	code = seal_read(file, &seal, err);
	if (code == ERR_NOT_FOUND)
		code = error_set(err, ERR_INVALID, "%.200s is damaged: it has no whole checksums", path);
	if (code != 0)
		goto out;
	bytes = mmap(NULL, seal.content, PROT_READ, MAP_PRIVATE, file, 0);
	if (bytes == MAP_FAILED) {
		code = error_set(err, ERR_IO, "%.200s cannot be mapped", path);
		goto out;
	}
	code = check_checkpoint(path, bytes, &seal, recon, &facts, err);
	if (code == 0 && facts.iteration > latest)
		code = error_set(err, ERR_INVALID, "%.200s is of iteration %d: a volume of one before that is missing",
				 path, facts.iteration);
	at = CHECKPOINT_FILE_OFFSET + grid_voxels(recon_grid(recon)) * sizeof(float);
	state = facts.state;
	if (code == 0)
		code = read_history(bytes + at + state + facts.metal, facts.rows, history, err);
	if (code == 0)
		code = recon_resume(recon, (const float *)(const void *)(bytes + CHECKPOINT_FILE_OFFSET),
				    facts.iteration, err);
	if (code == 0)
		code = recon_resume_noise(recon, &facts.noise, err);
	if (code == 0)
		code = recon_resume_state(recon, bytes + at, state, err);
	if (code == 0 && facts.metal > 0)
		code = recon_resume_found(recon, bytes + at + state, facts.metal, err);
out:
	if (bytes != MAP_FAILED)
		munmap(bytes, seal.content);
	seal_clear(&seal);
	close(file);
	return code;
}

int checkpoint_iteration(int file)
{
	char line[CHECKPOINT_FILE_OFFSET + 1] = "";
	int iteration;

	if (pread(file, line, CHECKPOINT_FILE_OFFSET, 0) != CHECKPOINT_FILE_OFFSET ||
	    sscanf(line, "cbctd checkpoint %d of", &iteration) != 1)
		return 0;
	return iteration;
}

/* 0 where there is none. */
static int iteration_of(const char *path)
{
	int file = regular_open(path, O_RDONLY, 0), iteration;

	if (file < 0)
		return 0;
	iteration = checkpoint_iteration(file);
	close(file);
	return iteration;
}

int checkpoint_open(const char *directory, int iteration, int *ret_file, struct error *err)
{
	static const char *const names[] = {CHECKPOINT_FILE, CHECKPOINT_FILE_BEFORE};
	char path[PATH_MAX];

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
		int file;

		if (path_of(directory, names[i], path, err) != 0)
			return err->code;
		file = regular_open(path, O_RDONLY, 0);
		if (file >= 0 && checkpoint_iteration(file) == iteration) {
			*ret_file = file;
			return 0;
		}
		if (file >= 0)
			close(file);
	}
	return error_set(err, ERR_NOT_FOUND, "there is no checkpoint of iteration %d", iteration);
}

int checkpoint_check(int file, struct error *err)
{
	struct seal seal = {0};
	char *bytes;
	int damaged, code = seal_read(file, &seal, err);

	if (code == ERR_NOT_FOUND)
		return error_set(err, ERR_INVALID, "a checkpoint has no whole checksums");
	if (code != 0)
		return code;
	bytes = mmap(NULL, seal.content, PROT_READ, MAP_PRIVATE, file, 0);
	if (bytes == MAP_FAILED) {
		code = error_set(err, ERR_IO, "a checkpoint cannot be mapped");
	} else {
		damaged = seal_first_damaged(&seal, bytes);
		if (damaged >= 0)
			code =
			    error_set(err, ERR_INVALID, "block %d of a checkpoint does not fit its checksum", damaged);
		munmap(bytes, seal.content);
	}
	seal_clear(&seal);
	return code;
}

int checkpoint_resume(struct recon *recon, const char *path, const struct checkpoint_target *target,
		      struct history *history, struct error *ret_damage, struct error *err)
{
	const char *slash = strrchr(path, '/'), *first = path, *second;
	const int directory = slash == NULL ? 0 : (int)(slash - path) + 1;
	char before[PATH_MAX];
	struct error other;
	int code;

	ret_damage->code = 0;
	if (snprintf(before, sizeof(before), "%.*s%s", directory, path, CHECKPOINT_FILE_BEFORE) >= (int)sizeof(before))
		return error_set(err, ERR_INVALID, "a path of %zu bytes is too long", strlen(path));
	second = before;
	if (iteration_of(path) != target->iteration && iteration_of(before) == target->iteration) {
		first = before;
		second = path;
	}
	code = resume_from(recon, first, target->latest, history, err);
	if (code != ERR_INVALID || resume_from(recon, second, target->latest, history, &other) != 0)
		return code;
	*ret_damage = *err;
	return 0;
}

/* What a refinement has reached, in a file: refining_file.h. */
#include "proto/refining_file.h"

#include <fcntl.h>
#include <inttypes.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/scan_directory.h"
#include "proto/seal.h"

struct refining_file {
	char path[PATH_MAX], line[REFINING_OFFSET];
	double seconds, due; /* the latter by clock_monotonic */
	char *mapped;        /* MAP_FAILED: there is none */
	size_t content;
	struct refine_keep keep;
};

static bool is_due(void *context, bool leaves)
{
	const struct refining_file *file = context;

	return leaves || clock_monotonic() >= file->due;
}

static size_t size_of(const struct refine_state *state)
{
	size_t size = REFINING_OFFSET;

	for (int i = 0; i < REFINE_PIECES; i++)
		size += state->pieces[i].size;
	return size;
}

static int write_piece(struct durable *file, struct seal_maker *seal, const void *bytes, size_t size, struct error *err)
{
	seal_maker_add(seal, bytes, size);
	return size > 0 ? durable_write(file, bytes, size, err) : 0;
}

static int write_seal(struct durable *file, const struct seal_maker *seal, struct error *err)
{
	const size_t size = seal_bytes(seal->at);
	char *end = malloc(size);
	int code = end == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for checksums") : 0;

	if (code == 0) {
		seal_write(seal->blocks, seal->at, end);
		code = durable_write(file, end, size, err);
	}
	free(end);
	return code;
}

static int write_state(const struct refining_file *refining, const struct refine_state *state, struct error *err)
{
	const size_t size = size_of(state);
	struct seal_maker seal = {0};
	struct durable file;
	int code = seal_maker_new(size, &seal, err);

	if (code < 0)
		return code;
	code = durable_open(&file, refining->path, size + seal_bytes(size), err);
	if (code == 0) {
		code = write_piece(&file, &seal, refining->line, REFINING_OFFSET, err);
		for (int i = 0; i < REFINE_PIECES && code == 0; i++)
			code = write_piece(&file, &seal, state->pieces[i].bytes, state->pieces[i].size, err);
		if (code == 0)
			code = write_seal(&file, &seal, err);
		if (code == 0)
			code = durable_commit(&file, err);
		else
			durable_abandon(&file);
	}
	seal_maker_clear(&seal);
	return code;
}

/* A disk without room for it costs what was reached, and not the job. */
static int keep(void *context, const struct refine_state *state, struct error *err)
{
	struct refining_file *file = context;
	struct error why;
	const int code = write_state(file, state, &why);

	file->due = clock_monotonic() + file->seconds;
	if (code == 0 || code == ERR_NO_SPACE)
		return 0;
	*err = why;
	return code;
}

/* Maps what is there, if it is a whole file of that basis. */
static void read_state(struct refining_file *file)
{
	struct seal seal = {0};
	struct error ignored;
	int descriptor = open(file->path, O_RDONLY | O_CLOEXEC | O_NONBLOCK | O_NOFOLLOW);

	if (descriptor < 0)
		return;
	if (seal_read(descriptor, &seal, &ignored) == 0 && seal.content > REFINING_OFFSET)
		file->mapped = mmap(NULL, seal.content, PROT_READ, MAP_PRIVATE, descriptor, 0);
	file->content = seal.content;
	if (file->mapped != MAP_FAILED && seal_first_damaged(&seal, file->mapped) < 0 &&
	    memcmp(file->mapped, file->line, REFINING_OFFSET) == 0) {
		file->keep.state = file->mapped + REFINING_OFFSET;
		file->keep.bytes = seal.content - REFINING_OFFSET;
	}
	seal_clear(&seal);
	close(descriptor);
}

int refining_file_open(const char *directory, uint64_t basis, double seconds, struct refining_file **ret_file,
		       struct error *err)
{
	struct refining_file *file = calloc(1, sizeof(*file));
	char text[REFINING_OFFSET];
	int code;

	if (file == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for what a refinement reaches");
	file->mapped = MAP_FAILED;
	code = path_join(file->path, sizeof(file->path), directory, REFINING_FILE, "", err);
	if (code < 0) {
		refining_file_free(file);
		return code;
	}
	memset(file->line, ' ', sizeof(file->line));
	snprintf(text, sizeof(text), "cbctd refining of %016" PRIx64, basis);
	memcpy(file->line, text, strlen(text));
	file->line[REFINING_OFFSET - 1] = '\n';
	file->seconds = seconds;
	file->due = clock_monotonic() + seconds;
	file->keep = (struct refine_keep){.context = file, .due = is_due, .keep = keep};
	read_state(file);
	*ret_file = file;
	return 0;
}

void refining_file_free(struct refining_file *file)
{
	if (file == NULL)
		return;
	if (file->mapped != MAP_FAILED)
		munmap(file->mapped, file->content);
	free(file);
}

const struct refine_keep *refining_file_keep(const struct refining_file *file)
{
	return &file->keep;
}

void refining_file_remove(const char *directory)
{
	char path[PATH_MAX];
	struct error ignored;

	if (path_join(path, sizeof(path), directory, REFINING_FILE, "", &ignored) == 0)
		unlink(path);
}
